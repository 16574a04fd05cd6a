//! A known type, with its description for other nodes (REP 2016).

use std::sync::Arc;

use bytes::Bytes;
use sgc_cdr::{DescriptionError, Layout, TypeName};

/// A known type: a message's, or a service's with its messages.
#[derive(Clone, Debug)]
pub struct ResolvedType {
    name: TypeName,
    type_hash: String,
    description: Bytes,
    layout: Arc<Layout>,
}

/// The reason why a description is not believed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ResolveError {
    /// The description is invalid, or of another type than that of the hash.
    #[error(transparent)]
    Description(#[from] DescriptionError),
    /// The description is of a type with another name.
    #[error("the description is one of {found}, not of {expected}")]
    Name {
        /// The described type.
        found: String,
        /// The requested type.
        expected: String,
    },
}

impl ResolvedType {
    /// Describes the type of a layout.
    pub fn from_layout(layout: Layout) -> Result<Self, DescriptionError> {
        let description = layout.describe()?.into();
        Self::new(layout, description).ok_or_else(nameless)
    }

    /// Reads another node's description of the type of this name and hash.
    pub fn read(description: Bytes, name: &TypeName, type_hash: &str) -> Result<Self, ResolveError> {
        let layout = Layout::from_description(&description, type_hash)?;
        // Described anew, so that nothing outside of the hash is passed on.
        let this = Self::from_layout(layout)?;
        if this.name != *name {
            return Err(ResolveError::Name { found: this.name.to_string(), expected: name.to_string() });
        }
        Ok(this)
    }

    fn new(layout: Layout, description: Bytes) -> Option<Self> {
        let (name, type_hash) = (layout.name()?.clone(), layout.type_hash());
        Some(Self { name, type_hash, description, layout: Arc::new(layout) })
    }

    /// Returns the name of the type.
    pub fn name(&self) -> &TypeName {
        &self.name
    }

    /// Returns its hash: `RIHS01_` and 64 hexadecimal digits.
    pub fn type_hash(&self) -> &str {
        &self.type_hash
    }

    /// Returns `true` for the hashes that endpoints announce for the type: its own, and for a service those of its
    /// request and response, which `rmw_fastrtps` announces.
    pub fn is_announced_as(&self, type_hash: &str) -> bool {
        let is_of =
            |half: TypeName| self.layout.part(&half).is_some_and(|part| part.type_hash() == type_hash);
        let name = &self.name;
        self.type_hash == type_hash
            || name.kind() != "msg" && (is_of(name.request()) || is_of(name.response()))
    }

    /// Returns a serialised `type_description_interfaces/msg/TypeDescription`.
    pub fn description(&self) -> &Bytes {
        &self.description
    }

    /// Returns the layout of its messages.
    pub fn layout(&self) -> &Arc<Layout> {
        &self.layout
    }
}

/// Error for a layout without a type, which no library makes.
fn nameless() -> DescriptionError {
    DescriptionError::Content { what: "name of a type", found: String::new() }
}

#[cfg(test)]
mod tests {
    use sgc_cdr::{DESCRIPTION_BYTES_MAX, Library};

    use super::*;

    fn described(name: &str) -> ResolvedType {
        ResolvedType::from_layout(Library::empty().layout(&name.parse().unwrap(), &mut |_| None).unwrap())
            .unwrap()
    }

    #[test]
    fn descriptions_of_messages_and_services_are_read_again() {
        for name in ["geometry_msgs/msg/Twist", "std_srvs/srv/SetBool"] {
            let ours = described(name);
            let read = ResolvedType::read(ours.description().clone(), ours.name(), ours.type_hash()).unwrap();
            assert_eq!((read.name(), read.type_hash()), (ours.name(), ours.type_hash()));
            assert_eq!(read.layout().type_hash(), ours.type_hash());
        }
    }

    #[test]
    fn service_is_announced_by_its_hash_or_those_of_its_messages() {
        let (service, message) = (described("std_srvs/srv/SetBool"), described("std_msgs/msg/String"));
        // As the packages of Jazzy and Kilted have them.
        let service_hash = "RIHS01_abe9e4bb6b41b40e6789712c00ec8871923e089af3f667a79992a428cff2da0a";
        let request = "RIHS01_c62fbb99d94e1b25e8ef9e109f9581956bb1b3361a45a4e5810c36a90d29932e";
        let response = "RIHS01_d0814e7f7b4880ab77e9c57426c7aa1562ab69f11eef8e2e968812f9cbd0b059";
        for hash in [service_hash, request, response] {
            assert!(service.is_announced_as(hash) && !message.is_announced_as(hash), "{hash}");
        }
        assert!(
            !service.is_announced_as(message.type_hash()) && message.is_announced_as(message.type_hash())
        );
    }

    #[test]
    fn another_hash_another_name_and_too_much_are_not_believed() {
        let (twist, string) = (described("geometry_msgs/msg/Twist"), described("std_msgs/msg/String"));
        let read = |description: &Bytes, name: &TypeName, hash: &str| {
            ResolvedType::read(description.clone(), name, hash).map(|_| ()).unwrap_err()
        };
        let other_hash = read(twist.description(), twist.name(), string.type_hash());
        assert!(
            matches!(other_hash, ResolveError::Description(DescriptionError::Hash { .. })),
            "{other_hash}"
        );
        let other_name = read(twist.description(), string.name(), twist.type_hash());
        assert!(matches!(other_name, ResolveError::Name { .. }), "{other_name}");
        let long = vec![0; DESCRIPTION_BYTES_MAX + 1].into();
        let too_long = read(&long, twist.name(), twist.type_hash());
        assert!(
            matches!(too_long, ResolveError::Description(DescriptionError::TooLong { .. })),
            "{too_long}"
        );
    }
}
