//! Consumers: a node's ROS 2 subscribers, publishers and service clients, as it reports them to the owner of the
//! interface.

use crate::codec::{Decode, DecodeError, Encode, Reader, Writer};
use crate::control::Role;
use crate::ids::Name;
use crate::qos::Qos;
use crate::ros_node::RosNode;
use crate::type_descriptions::TYPE_HASH_BYTES_MAX;

/// Most consumers in one answer.
pub const CONSUMERS_MAX: usize = 512;
/// Most consumers of one interface that a node reports, and that its owner shows of that node.
pub const CONSUMERS_PER_INTERFACE_MAX: usize = 16;

/// A subscriber, a service client, or a publisher on a topic that another node owns.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Consumer {
    /// The interface that it uses.
    pub interface: Name,
    /// Constant for as long as the consumer lives; tells apart those of one node and interface.
    pub id: [u8; 8],
    /// The role in which its node joined the interface: [`Role::Subscribe`] for a subscriber, [`Role::Publish`] for a
    /// publisher and for a service client.
    pub role: Role,
    /// `false` for a publisher whose liveliness lease has run out.
    pub is_alive: bool,
    /// The ROS 2 node that it belongs to.
    pub node: RosNode,
    /// `RIHS01_…` type hash, if its network says it.
    pub type_hash: Option<String>,
    /// The QoS that it requests or offers; for a service client, ROS 2's for services.
    pub qos: Qos,
}

impl Consumer {
    /// Returns `true` if the owner's network shows both in the same way: at most the liveliness differs.
    pub fn is_shown_as(&self, other: &Self) -> bool {
        let Self { interface, id, role, is_alive: _, node, type_hash, qos } = self;
        (interface, id, role, node) == (&other.interface, &other.id, &other.role, &other.node)
            && (type_hash, qos) == (&other.type_hash, &other.qos)
    }
}

impl Encode for Consumer {
    fn encode(&self, w: &mut Writer) {
        self.interface.encode(w);
        w.raw(&self.id);
        w.bool(self.role == Role::Publish);
        w.bool(self.is_alive);
        self.node.encode(w);
        w.option(self.type_hash.as_ref(), |w, hash| w.str(hash));
        self.qos.encode(w);
    }
}

impl Decode for Consumer {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        Ok(Self {
            interface: Name::decode(r)?,
            id: r.array("consumer")?,
            role: if r.bool("role")? { Role::Publish } else { Role::Subscribe },
            is_alive: r.bool("alive")?,
            node: RosNode::decode(r)?,
            type_hash: r.option("type hash", |r| r.str("type hash", TYPE_HASH_BYTES_MAX))?,
            qos: Qos::decode(r)?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::catalogue::GrantContent;
    use crate::control::SEALED_BYTES_MAX;

    fn consumer(name: &str) -> Consumer {
        let node = RosNode::new("/desk", name, None).unwrap();
        let (interface, type_hash) = (Name([7; 32]), Some("RIHS01_ab".to_owned()));
        let (id, role) = (*b"consumer", Role::Subscribe);
        Consumer { interface, id, role, is_alive: true, node, type_hash, qos: Qos::default() }
    }

    /// The bytes are normative.
    #[test]
    fn consumers_have_these_bytes() {
        let bytes = [
            &[7; 32][..],
            b"consumer",
            &[0, 1],
            &[0, 0, 0, 5],
            b"/desk",
            &[0, 0, 0, 4],
            b"rviz",
            &[0, 1, 0, 0, 0, 9],
            b"RIHS01_ab",
            &Qos::default().to_vec(),
        ]
        .concat();
        assert_eq!(consumer("rviz").to_vec(), bytes);
        assert_eq!(Consumer::from_slice(&bytes), Ok(consumer("rviz")));
        let publisher = Consumer { role: Role::Publish, ..consumer("rviz") };
        assert_eq!(publisher.to_vec(), [&bytes[..40], &[1], &bytes[41..]].concat());
        assert_eq!(Consumer::from_slice(&publisher.to_vec()), Ok(publisher.clone()));
        let lapsed = Consumer { is_alive: false, ..publisher };
        assert_eq!(lapsed.to_vec(), [&bytes[..40], &[1, 0], &bytes[42..]].concat());
        assert_eq!(Consumer::from_slice(&lapsed.to_vec()), Ok(lapsed));
        let content = GrantContent::Consumers(vec![consumer("rviz")]);
        assert_eq!(content.to_vec(), [&[5, 0, 0, 0, 1][..], &bytes].concat());
        assert_eq!(GrantContent::from_slice(&content.to_vec()), Ok(content));
    }

    #[test]
    fn the_longest_answer_has_room_and_a_longer_one_is_refused() {
        let long = "n".repeat(RosNode::NAME_BYTES_MAX - 1);
        let path = format!("/{long}");
        let node = RosNode::new(&path, &long, Some(&path)).unwrap();
        let type_hash = Some("h".repeat(TYPE_HASH_BYTES_MAX));
        let longest = vec![Consumer { node, type_hash, ..consumer("rviz") }; CONSUMERS_MAX + 1];
        let fits = GrantContent::Consumers(longest[1..].to_vec()).to_vec();
        assert!(fits.len() < SEALED_BYTES_MAX && GrantContent::from_slice(&fits).is_ok());
        let refused = GrantContent::from_slice(&GrantContent::Consumers(longest).to_vec());
        assert!(matches!(refused, Err(DecodeError::TooLong { field: "consumers", .. })), "{refused:?}");
    }

    #[test]
    fn hostile_node_names_are_refused() {
        let bytes = consumer("rviz").to_vec();
        let at = bytes.windows(4).position(|word| word == b"rviz").unwrap();
        for name in [b"rv/z", b"1viz", b"\x1b[2J", b"r iz"] {
            let mut hostile = bytes.clone();
            hostile[at..at + 4].copy_from_slice(name);
            assert!(Consumer::from_slice(&hostile).is_err(), "{name:?}");
        }
    }
}
