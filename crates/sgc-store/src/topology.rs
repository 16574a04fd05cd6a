//! The servers of a store, as one of them describes them.

use std::collections::BTreeSet;

use crate::config::ServerAddress;
use crate::key::SLOTS;
use crate::resp::Frame;

/// Most primaries, and most replicas, of a cluster. The descriptions of more are not believed.
pub(crate) const NODES_MAX: usize = 128;

/// The server for each slot.
#[derive(Clone, PartialEq, Eq)]
pub(crate) struct Topology {
    /// Indices of `primaries`.
    slots: Box<[Option<u16>; SLOTS]>,
    primaries: Vec<ServerAddress>,
    replicas: Vec<ServerAddress>,
    is_single: bool,
}

impl Topology {
    /// Returns the topology of a single server.
    pub(crate) fn single(server: ServerAddress) -> Self {
        Self {
            slots: Box::new([Some(0); SLOTS]),
            primaries: vec![server],
            replicas: Vec::new(),
            is_single: true,
        }
    }

    /// Reads the reply to `CLUSTER SLOTS` from a server. `None` if it has no meaning, or no slots.
    pub(crate) fn parse(reply: &Frame, from: &ServerAddress) -> Option<Self> {
        let mut topology = Self {
            slots: Box::new([None; SLOTS]),
            primaries: Vec::new(),
            replicas: Vec::new(),
            is_single: false,
        };
        let mut replicas = BTreeSet::new();
        for range in reply.array()? {
            let [Frame::Integer(first), Frame::Integer(last), primary, others @ ..] = range.array()? else {
                return None;
            };
            let (first, last) = (usize::try_from(*first).ok()?, usize::try_from(*last).ok()?);
            let index = topology.index_of(node(primary, from)?)?;
            topology.slots.get_mut(first..=last)?.fill(Some(index));
            // A replica with a host that has no meaning here is not needed.
            replicas.extend(others.iter().filter_map(|other| node(other, from)).take(NODES_MAX));
            if replicas.len() > NODES_MAX {
                return None;
            }
        }
        topology.replicas = replicas.into_iter().collect();
        (!topology.primaries.is_empty()).then_some(topology)
    }

    /// Sends a slot to another server, as a redirection says.
    pub(crate) fn move_slot(&mut self, slot: u16, to: ServerAddress) {
        if let (Some(index), Some(slot)) = (self.index_of(to), self.slots.get_mut(usize::from(slot))) {
            *slot = Some(index);
        }
    }

    fn index_of(&mut self, server: ServerAddress) -> Option<u16> {
        let index = match self.primaries.iter().position(|primary| *primary == server) {
            Some(index) => index,
            None if self.primaries.len() >= NODES_MAX => return None,
            None => {
                self.primaries.push(server);
                self.primaries.len() - 1
            }
        };
        u16::try_from(index).ok()
    }

    /// Returns the server for a slot.
    pub(crate) fn server(&self, slot: u16) -> Option<&ServerAddress> {
        self.primaries.get(usize::from((*self.slots.get(usize::from(slot))?)?))
    }

    /// Returns whether this is one server that is no cluster.
    pub(crate) fn is_single(&self) -> bool {
        self.is_single
    }

    /// Returns the servers that have slots.
    pub(crate) fn primaries(&self) -> &[ServerAddress] {
        &self.primaries
    }

    pub(crate) fn replicas(&self) -> &[ServerAddress] {
        &self.replicas
    }

    /// Returns whether every slot has the same server in both.
    pub(crate) fn has_same_slots(&self, other: &Self) -> bool {
        self.primaries.len() == other.primaries.len()
            && (0..SLOTS as u16).all(|slot| self.server(slot) == other.server(slot))
    }
}

/// Returns the address of a node in `CLUSTER SLOTS`. A node without a host has that of the server that was asked.
fn node(node: &Frame, from: &ServerAddress) -> Option<ServerAddress> {
    let [host, Frame::Integer(port), ..] = node.array()? else { return None };
    address(host.text().unwrap_or_default(), u16::try_from(*port).ok()?, from)
}

fn address(host: &[u8], port: u16, from: &ServerAddress) -> Option<ServerAddress> {
    match host {
        b"" | b"?" => Some(ServerAddress { host: from.host.clone(), port }).filter(|_| port != 0),
        host => ServerAddress::new(std::str::from_utf8(host).ok()?, port),
    }
}

/// Returns slot and server of `SLOT HOST:PORT`: the rest of the errors `MOVED` and `ASK`.
pub(crate) fn redirection(text: &[u8], from: &ServerAddress) -> Option<(u16, ServerAddress)> {
    let (slot, place) = std::str::from_utf8(text).ok()?.split_once(' ')?;
    let (host, port) = place.rsplit_once(':')?;
    let slot = slot.parse().ok().filter(|slot| usize::from(*slot) < SLOTS)?;
    Some((slot, address(host.as_bytes(), port.parse().ok()?, from)?))
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;

    use super::*;

    fn server(host: &str, port: u16) -> ServerAddress {
        ServerAddress::new(host, port).unwrap()
    }

    fn described(host: Option<&str>, port: i64) -> Frame {
        let host = host.map_or(Frame::Null, |host| Frame::Text(Bytes::copy_from_slice(host.as_bytes())));
        Frame::Array(vec![host, Frame::Integer(port), Frame::Null, Frame::Array(vec![])])
    }

    fn range(first: i64, last: i64, nodes: &[Frame]) -> Frame {
        let ends = [Frame::Integer(first), Frame::Integer(last)];
        Frame::Array(ends.into_iter().chain(nodes.iter().cloned()).collect())
    }

    #[test]
    fn slots_lead_to_primaries() {
        let reply = Frame::Array(vec![
            range(0, 99, &[described(Some("10.0.0.1"), 1), described(Some("10.0.0.9"), 2)]),
            range(101, 16_383, &[described(None, 7)]),
        ]);
        let mut topology = Topology::parse(&reply, &server("seed", 1)).unwrap();
        assert_eq!(topology.server(99), Some(&server("10.0.0.1", 1)));
        assert_eq!(topology.server(100), None);
        assert_eq!(topology.server(16_383), Some(&server("seed", 7)));
        assert_eq!(topology.replicas(), [server("10.0.0.9", 2)]);
        let before = topology.clone();
        topology.move_slot(100, server("10.0.0.3", 3));
        assert_eq!(topology.server(100), Some(&server("10.0.0.3", 3)));
        assert!(!topology.has_same_slots(&before));
    }

    #[test]
    fn descriptions_without_meaning_are_refused() {
        let seed = server("seed", 1);
        let node = described(Some("a"), 1);
        for reply in [
            Frame::Null,
            Frame::Array(vec![]),
            Frame::Array(vec![Frame::Null]),
            Frame::Array(vec![range(0, 16_384, std::slice::from_ref(&node))]),
            Frame::Array(vec![range(5, -1, std::slice::from_ref(&node))]),
            Frame::Array(vec![range(9, 3, std::slice::from_ref(&node))]),
            Frame::Array(vec![range(0, 1, &[])]),
            Frame::Array(vec![range(0, 1, &[described(Some("a b"), 1)])]),
            Frame::Array(vec![range(0, 1, &[described(Some("a"), 0)])]),
            Frame::Array(vec![range(0, 1, &[described(Some("a"), 65_536)])]),
            Frame::Array((0..600).map(|port| range(0, 1, &[described(Some("a"), port + 1)])).collect()),
        ] {
            assert!(Topology::parse(&reply, &seed).is_none(), "{reply:?}");
        }
    }

    #[test]
    fn redirections_are_parsed() {
        let from = server("seed", 1);
        assert_eq!(redirection(b"3999 127.0.0.1:6381", &from), Some((3999, server("127.0.0.1", 6381))));
        assert_eq!(redirection(b"1 ::1:6381", &from), Some((1, server("::1", 6381))));
        assert_eq!(redirection(b"1 :6381", &from), Some((1, server("seed", 6381))));
        for text in ["", "1", "1 a", "16384 a:1", "1 a:0", "1 a:99999", "x a:1", "1 a b:1"] {
            assert_eq!(redirection(text.as_bytes(), &from), None, "{text}");
        }
    }
}
