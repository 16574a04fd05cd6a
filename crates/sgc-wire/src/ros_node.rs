//! Publishers and subscribers on a ROS 2 network belong to ROS 2 nodes, which are not SGC nodes.

use std::fmt;

use crate::codec::{Decode, DecodeError, Encode, Reader, Writer};

/// A ROS 2 node: namespace, name and enclave. All follow ROS 2's rules, so that a name may be shown and announced as it
/// is.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct RosNode {
    namespace: String,
    name: String,
    enclave: Option<String>,
}

impl RosNode {
    /// Bound on a namespace and on a name, bytes (`rmw_dds_common/msg/NodeEntitiesInfo`: `string<=256`).
    pub const NAME_BYTES_MAX: usize = 256;
    /// Bound on an enclave, bytes.
    pub const ENCLAVE_BYTES_MAX: usize = 256;

    /// Returns a node; `None` if rcl does not accept namespace or name. An invalid enclave, or the default one, `/`, is
    /// left out.
    pub fn new(namespace: &str, name: &str, enclave: Option<&str>) -> Option<Self> {
        let is_word = |word: &str| {
            let mut bytes = word.bytes();
            let first = bytes.next();
            let letter = |b: u8| b.is_ascii_alphabetic() || b == b'_';
            first.is_some_and(letter) && bytes.all(|b| letter(b) || b.is_ascii_digit())
        };
        let is_path = |path: &str, bytes_max: usize| {
            let rest = path.strip_prefix('/');
            path.len() <= bytes_max
                && rest.is_some_and(|rest| rest.is_empty() || rest.split('/').all(is_word))
        };
        if !is_path(namespace, Self::NAME_BYTES_MAX) || name.len() > Self::NAME_BYTES_MAX || !is_word(name) {
            return None;
        }
        let enclave = enclave.filter(|path| *path != "/" && is_path(path, Self::ENCLAVE_BYTES_MAX));
        Some(Self { namespace: namespace.into(), name: name.into(), enclave: enclave.map(Into::into) })
    }

    /// Returns its namespace, `/` or `/robot1`.
    pub fn namespace(&self) -> &str {
        &self.namespace
    }

    /// Returns its name, `talker`.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns its enclave, if that is not `/`.
    pub fn enclave(&self) -> Option<&str> {
        self.enclave.as_deref()
    }
}

/// Writes the full name: `/robot1/talker`.
impl fmt::Display for RosNode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.namespace.as_str() {
            "/" => write!(f, "/{}", self.name),
            namespace => write!(f, "{namespace}/{}", self.name),
        }
    }
}

impl Encode for RosNode {
    fn encode(&self, w: &mut Writer) {
        w.str(&self.namespace);
        w.str(&self.name);
        w.option(self.enclave.as_ref(), |w, e| w.str(e));
    }
}

impl Decode for RosNode {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        let namespace = r.str("node namespace", Self::NAME_BYTES_MAX)?;
        let name = r.str("node name", Self::NAME_BYTES_MAX)?;
        let enclave = r.option("enclave", |r| r.str("enclave", Self::ENCLAVE_BYTES_MAX))?;
        // Each node has one encoding: an enclave that would be left out is refused, too.
        Self::new(&namespace, &name, enclave.as_deref())
            .filter(|node| node.enclave == enclave)
            .ok_or_else(|| DecodeError::value("ROS node name", 0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_ros_accepts_is_a_node() {
        let node = RosNode::new("/robot1/arm", "talker_2", Some("/arm")).unwrap();
        assert_eq!(node.to_string(), "/robot1/arm/talker_2");
        assert_eq!(RosNode::new("/", "_hidden", Some("/")).unwrap().to_string(), "/_hidden");
        let long = "a".repeat(RosNode::NAME_BYTES_MAX + 1);
        for (namespace, name) in [
            ("", "a"),
            ("robot", "a"),
            ("/robot/", "a"),
            ("//robot", "a"),
            ("/1robot", "a"),
            ("/", ""),
            ("/", "1a"),
            ("/", "a/b"),
            ("/", "a-b"),
            ("/", "\u{1b}[2J"),
            ("/", &long),
            (&format!("/{long}"), "a"),
        ] {
            assert_eq!(RosNode::new(namespace, name, None), None, "{namespace:?} {name:?}");
        }
        assert_eq!(RosNode::new("/", "a", Some("no path")).unwrap().enclave(), None);
    }

    #[test]
    fn nodes_round_trip_and_have_one_encoding() {
        for enclave in [None, Some("/arm")] {
            let node = RosNode::new("/a", "b", enclave).unwrap();
            assert_eq!(RosNode::from_slice(&node.to_vec()), Ok(node));
        }
        let mut w = Writer::default();
        ["/a", "b"].into_iter().for_each(|s| w.str(s));
        w.option(Some(&"/"), |w, e| w.str(e));
        assert!(RosNode::from_slice(&w.into_vec()).is_err());
        let mut w = Writer::default();
        ["/a", "b c"].into_iter().for_each(|s| w.str(s));
        w.bool(false);
        assert!(RosNode::from_slice(&w.into_vec()).is_err());
    }
}
