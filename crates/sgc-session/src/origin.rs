//! [`Origin`]: what a change of the network means for a link that this node dialled.
//!
//! Only the source address of the route to the peer matters. The driver looks it up.

use std::net::IpAddr;

/// Consequence of a change for a link that this node dialled.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Move {
    /// The link stays, or no route exists at present.
    Stay,
    /// The link continues on a new socket.
    Rebind,
    /// The link is bound to an address that no longer reaches the peer, so another link has to replace it.
    Redial,
}

/// Local address of a link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Origin {
    /// Last source address towards the peer.
    source: Option<IpAddr>,
    /// Whether a route to the peer exists now.
    is_there: bool,
}

impl Origin {
    /// Returns the origin of a link that is up, with the source address towards its peer.
    pub fn new(source: Option<IpAddr>) -> Self {
        Self { source, is_there: source.is_some() }
    }

    /// Treats the link as one whose route was gone, because its local address is not known for certain.
    pub fn distrust(&mut self) {
        self.is_there = false;
    }

    /// Handles a change with the present source address. Returns its consequence.
    pub fn moves(&mut self, source: Option<IpAddr>, over_udp: bool) -> Move {
        let came_back = !std::mem::replace(&mut self.is_there, source.is_some());
        let before = self.source;
        self.source = source.or(before);
        match source {
            None => Move::Stay,
            Some(_) if source == before && !came_back => Move::Stay,
            Some(_) if over_udp => Move::Rebind,
            Some(_) => Move::Redial,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_link_moves_when_its_source_is_another_or_came_back() {
        let (wifi, lte) = (IpAddr::from([192, 168, 0, 7]), IpAddr::from([10, 64, 1, 1]));
        for (over_udp, moved) in [(true, Move::Rebind), (false, Move::Redial)] {
            let mut origin = Origin::new(Some(wifi));
            let mut sees = |source| origin.moves(source, over_udp);
            // Another interface came up.
            assert_eq!(sees(Some(wifi)), Move::Stay);
            assert_eq!(sees(Some(lte)), moved);
            assert_eq!(sees(Some(lte)), Move::Stay);
            // The route disappears, and another appears.
            assert_eq!(sees(None), Move::Stay);
            assert_eq!(sees(None), Move::Stay);
            assert_eq!(sees(Some(lte)), moved);
            assert_eq!(sees(Some(lte)), Move::Stay);
            assert_eq!(sees(None), Move::Stay);
            assert_eq!(sees(Some(wifi)), moved);
        }
    }
}
