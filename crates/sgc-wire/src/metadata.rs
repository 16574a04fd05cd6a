//! The metadata of an interface, from which its name derives, in its one canonical encoding.
//!
//! The derivation itself needs secrets and is in `sgc-trust`; the normative text is `docs/spec/names.md`.

use crate::codec::{Decode, DecodeError, Encode, Reader, Writer};

/// Version of the canonical encoding, its first byte.
pub const METADATA_VERSION: u8 = 1;
/// Longest text of one field, bytes.
pub const METADATA_FIELD_BYTES_MAX: usize = 1024;

/// The kind of interface that a name stands for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Kind {
    /// An owner's sealed list of its shares; the one name that follows from owner and fleet alone.
    Catalogue,
    /// A ROS 2 topic.
    Topic,
    /// A ROS 2 service.
    Service,
    /// A ROS 2 action.
    Action,
}

/// The metadata of an interface (paper, section III): every field is part of its name.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Metadata {
    /// Kind of interface.
    pub kind: Kind,
    /// Name of the owning node within its fleet.
    pub owner: String,
    /// Absolute ROS name, `/camera/image`.
    pub ros_name: String,
    /// ROS type, `sensor_msgs/msg/Image`; a type outside ROS naming as DDS spells it.
    pub type_name: String,
    /// ROS node that provides it, if the user wants it in the name.
    pub node: String,
    /// Author.
    pub author: String,
    /// Maintainer.
    pub maintainer: String,
    /// Interface description language or contract.
    pub interface: String,
    /// Free text.
    pub description: String,
    /// Any string that tells apart otherwise equal interfaces.
    pub unique: String,
}

impl Metadata {
    /// Returns the metadata of a topic, the optional fields empty.
    pub fn topic(owner: &str, ros_name: &str, type_name: &str) -> Self {
        Self {
            kind: Kind::Topic,
            owner: owner.to_owned(),
            ros_name: ros_name.to_owned(),
            type_name: type_name.to_owned(),
            node: String::new(),
            author: String::new(),
            maintainer: String::new(),
            interface: String::new(),
            description: String::new(),
            unique: String::new(),
        }
    }

    /// Returns the metadata of an owner's catalogue.
    pub fn catalogue(owner: &str) -> Self {
        Self { kind: Kind::Catalogue, ..Self::topic(owner, "", "") }
    }

    fn fields(&self) -> [&String; 9] {
        [
            &self.owner,
            &self.ros_name,
            &self.type_name,
            &self.node,
            &self.author,
            &self.maintainer,
            &self.interface,
            &self.description,
            &self.unique,
        ]
    }
}

impl Encode for Metadata {
    fn encode(&self, w: &mut Writer) {
        w.u8(METADATA_VERSION);
        w.u8(self.kind as u8);
        for field in self.fields() {
            w.str(field);
        }
    }
}

impl Decode for Metadata {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        let found = r.u8()?;
        if found != METADATA_VERSION {
            return Err(DecodeError::Version {
                what: "metadata",
                found: found.into(),
                known: METADATA_VERSION.into(),
            });
        }
        let kind = match r.u8()? {
            0 => Kind::Catalogue,
            1 => Kind::Topic,
            2 => Kind::Service,
            3 => Kind::Action,
            v => return Err(DecodeError::value("kind", v.into())),
        };
        let mut text = |field| r.str(field, METADATA_FIELD_BYTES_MAX);
        Ok(Self {
            kind,
            owner: text("owner")?,
            ros_name: text("ROS name")?,
            type_name: text("type")?,
            node: text("node")?,
            author: text("author")?,
            maintainer: text("maintainer")?,
            interface: text("interface")?,
            description: text("description")?,
            unique: text("unique string")?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The bytes are normative: a change of this vector is a new version.
    #[test]
    fn canonical_encoding_has_not_moved() {
        let mut expected = vec![1, 1, 0, 0, 0, 5];
        expected.extend(b"arm-1");
        expected.extend([0, 0, 0, 13]);
        expected.extend(b"/camera/image");
        expected.extend([0, 0, 0, 21]);
        expected.extend(b"sensor_msgs/msg/Image");
        expected.extend([0; 24]);
        let m = Metadata::topic("arm-1", "/camera/image", "sensor_msgs/msg/Image");
        assert_eq!(m.to_vec(), expected);
        assert_eq!(Metadata::from_slice(&expected), Ok(m));
    }

    #[test]
    fn fields_cannot_run_into_each_other() {
        let a = Metadata::topic("a", "b", "");
        let b = Metadata::topic("ab", "", "");
        assert_ne!(a.to_vec(), b.to_vec());
    }
}
