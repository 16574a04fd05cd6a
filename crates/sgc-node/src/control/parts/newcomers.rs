//! [`Newcomers`]: which local publishers began while this node was there to hear their first messages.

use std::collections::{BTreeSet, VecDeque};
use std::time::{Duration, Instant};

use sgc_ros::{DiscoveredEndpoint, DiscoveryEvent, EndpointKind, Guid};

/// Time after which publishers that existed before the local network was opened have been discovered: three announcements
/// of a participant of Fast DDS.
const DISCOVERED_WITHIN: Duration = Duration::from_secs(10);
/// Most publishers that are remembered after they are gone.
const GONE_MAX: usize = 1024;

/// The local publishers that may have published before this node heard them.
#[derive(Debug)]
pub(crate) struct Newcomers {
    opened: Instant,
    old: BTreeSet<Guid>,
    /// Publishers that are gone. One that comes back was out of reach, and has published meanwhile.
    gone: VecDeque<Guid>,
}

impl Newcomers {
    /// Knows no publisher, on a network that is open from now on.
    pub(crate) fn new(now: Instant) -> Self {
        Self { opened: now, old: BTreeSet::new(), gone: VecDeque::new() }
    }

    /// Notes that the local network is open again.
    pub(crate) fn reopened(&mut self, now: Instant) {
        self.opened = now;
    }

    /// Notes an event of the local network.
    pub(crate) fn note(&mut self, now: Instant, event: &DiscoveryEvent) {
        match event {
            DiscoveryEvent::Appeared(DiscoveredEndpoint { guid, kind: EndpointKind::Writer, .. }) => {
                let known = self.gone.iter().position(|gone| gone == guid);
                if known.and_then(|at| self.gone.remove(at)).is_some()
                    || now < self.opened + DISCOVERED_WITHIN
                {
                    self.old.insert(*guid);
                }
            }
            DiscoveryEvent::Vanished { guid } => {
                self.old.remove(guid);
                if self.gone.len() >= GONE_MAX {
                    self.gone.pop_front();
                }
                self.gone.push_back(*guid);
            }
            _ => {}
        }
    }

    /// Returns whether this node heard, or will hear, a publisher from its first message on.
    pub(crate) fn is_new(&self, publisher: &Guid) -> bool {
        !self.old.contains(publisher)
    }
}

#[cfg(test)]
mod tests {
    use sgc_wire::Qos;

    use super::*;

    fn appeared(guid: Guid, kind: EndpointKind) -> DiscoveryEvent {
        DiscoveryEvent::Appeared(DiscoveredEndpoint {
            kind,
            guid,
            topic: "rt/a".to_owned(),
            type_name: "p::msg::dds_::M_".to_owned(),
            keyless: true,
            type_hash: None,
            qos: Qos::default(),
        })
    }

    #[test]
    fn publishers_are_new_unless_they_were_there_before() {
        let begin = Instant::now();
        let [early, late, back] = [1, 2, 3].map(|n| Guid([n; 16]));
        let mut newcomers = Newcomers::new(begin);
        let writer = |guid| appeared(guid, EndpointKind::Writer);
        newcomers.note(begin + Duration::from_secs(1), &writer(early));
        let later = begin + Duration::from_secs(11);
        newcomers.note(later, &writer(late));
        newcomers.note(later, &writer(back));
        let is_new = |newcomers: &Newcomers| [early, late, back].map(|guid| newcomers.is_new(&guid));
        assert_eq!(is_new(&newcomers), [false, true, true]);
        newcomers.note(later, &DiscoveryEvent::Vanished { guid: back });
        newcomers.note(later, &writer(back));
        assert_eq!(is_new(&newcomers), [false, true, false]);
        newcomers.note(later, &DiscoveryEvent::Vanished { guid: back });
        (0..GONE_MAX as u128).for_each(|n| {
            newcomers.note(later, &DiscoveryEvent::Vanished { guid: Guid(n.to_be_bytes()) });
        });
        assert_eq!((newcomers.gone.len(), newcomers.old.len()), (GONE_MAX, 1));
        newcomers.reopened(later);
        newcomers.note(later, &writer(Guid([9; 16])));
        assert!(!newcomers.is_new(&Guid([9; 16])));
    }
}
