//! The extent of a whole run: the variants of `sgc` in each table, the number of turns of each system, and the number
//! of systems measured at the same time. The budget is in `bench/README.md`.

use super::lab::PathKind;
use super::tcp;

/// The variants of `sgc` in a table. The other systems are in all tables.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Breadth {
    /// Every variant.
    Whole,
    /// Every transport with `standard`, every suite with the default transport, no router.
    Cross,
    /// Every transport with `standard`, and the default transport with the default suite.
    Transports,
}

impl Breadth {
    /// Whether a system is in it.
    pub(crate) fn has(self, system: &str) -> bool {
        let is_in_all = system.ends_with("-standard") || system == "sgc-quic-pairwise";
        let is_default_transport = system.starts_with("sgc-quic-") && !system.contains("-router");
        match self {
            _ if !system.starts_with("sgc-") => true,
            Self::Whole => true,
            Self::Cross => is_in_all || is_default_transport,
            Self::Transports => is_in_all,
        }
    }

    /// Returns a description of the missing variants.
    pub(crate) fn lacks(self) -> &'static str {
        match self {
            Self::Whole => "nothing of sgc",
            Self::Cross => {
                "sgc over other transports than QUIC with other suites than `standard`, and with a router"
            }
            Self::Transports => "sgc with other suites than `standard` and `pairwise`, and with a router",
        }
    }
}

/// The floor of round trips; see [`super::system::relays`].
pub(crate) const RELAY: &str = "relay";

/// Those that goals compare where the machine is the limit: they have a turn in each round, the others in the first.
const OFTEN: [&str; 9] = [
    "direct",
    RELAY,
    "relay-gathers",
    "relay-forwarder",
    "zenoh-tcp",
    "sgc-quic-group",
    "sgc-quic-pairwise",
    "sgc-quic-standard",
    "sgc-quic-group-router",
];
pub(crate) const ROUNDS_MAX: usize = 3;

/// How often a system has its turn.
pub(crate) fn rounds(kind: &PathKind, system: &str) -> usize {
    match kind {
        PathKind::Bare if OFTEN.contains(&system) => ROUNDS_MAX,
        // On thin paths the path says how long it takes.
        _ => 1,
    }
}

/// How many go at the same time over paths of their own. 5 Mbit/s are little for a machine, and so is what TCP makes of
/// a path that loses packets; what copes with losses fills 50 Mbit/s.
const ABREAST_PAPER: usize = 6;
const ABREAST_LOSSY: usize = 2;
const ABREAST_LOSSY_TCP: usize = 6;

/// Groups the systems that are measured at the same time.
pub(crate) fn together<T>(kind: &PathKind, who: Vec<T>, name: impl Fn(&T) -> String) -> Vec<Vec<T>> {
    match kind {
        PathKind::Paper => chunks(who, ABREAST_PAPER),
        PathKind::Lossy => {
            let (by_tcp, others) = who.into_iter().partition(|one| is_by_tcp(&name(one)));
            let mut all = chunks(others, ABREAST_LOSSY);
            all.extend(chunks(by_tcp, ABREAST_LOSSY_TCP));
            all
        }
        _ => chunks(who, 1),
    }
}

/// Whether kernel TCP carries it.
fn is_by_tcp(system: &str) -> bool {
    system.split('-').any(|word| ["tcp", "tls"].contains(&word)) || [tcp::NAME, RELAY].contains(&system)
}

fn chunks<T>(all: Vec<T>, most: usize) -> Vec<Vec<T>> {
    let mut chunks: Vec<Vec<T>> = Vec::new();
    for one in all {
        match chunks.last_mut() {
            Some(last) if last.len() < most => last.push(one),
            _ => chunks.push(vec![one]),
        }
    }
    chunks
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn goals_are_asked_of_systems_that_every_breadth_has() {
        for breadth in [Breadth::Whole, Breadth::Cross, Breadth::Transports] {
            assert!(
                ["direct", "wireguard", "zenoh-tcp", "tcp", "sgc-quic-standard", "sgc-quic-pairwise"]
                    .iter()
                    .all(|s| breadth.has(s))
            );
        }
        assert!(Breadth::Cross.has("sgc-quic-group") && Breadth::Cross.has("sgc-tls-standard"));
        assert!(!Breadth::Cross.has("sgc-tls-group") && !Breadth::Cross.has("sgc-quic-standard-router"));
        assert!(!Breadth::Transports.has("sgc-quic-paper"));
    }

    #[test]
    fn nobody_shares_a_machine_that_is_the_limit() {
        let who = ["direct", "zenoh-tls", "sgc-dtls-standard", "tcp", "sgc-quic-standard"].to_vec();
        let together = |kind| super::together(&kind, who.clone(), |name| (*name).to_owned());
        assert!(together(PathKind::Bare).iter().all(|chunk| chunk.len() == 1));
        assert_eq!(together(PathKind::Paper), std::slice::from_ref(&who));
        assert_eq!(
            together(PathKind::Lossy),
            [&["direct", "sgc-dtls-standard"][..], &["sgc-quic-standard"], &["zenoh-tls", "tcp"]]
        );
    }
}
