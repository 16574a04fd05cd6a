//! Programs on this process's local networks that cannot be joined, and the barrier that keeps them apart.
//!
//! This module keeps the reports of [`crate::discovery`] and [`crate::log`], within bounds.

use std::collections::BTreeMap;
use std::sync::{Mutex, MutexGuard};
use std::time::{Duration, Instant};

use sgc_ros::{Guid, is_enclave};
use sgc_sync::lock;

/// Most programs that are remembered.
const PROGRAMS_MAX: usize = 64;

/// Time after which a participant that announces no endpoint counts as silent. ROS 2 participants announce theirs at
/// once, which takes a second on a busy machine.
const SILENT_AFTER: Duration = Duration::from_secs(10);

/// The bit in the first byte of a GUID that DDS Security derives from a certificate. It is not set in a vendor's id,
/// with which all other GUIDs begin (DDS Security 1.1, 9.3.3).
const SECURED_BIT: u8 = 0x80;

/// The reason why programs cannot be joined.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Barrier {
    /// DDS Security protects the programs, and this node has no enclave.
    Protected,
    /// DDS Security protects the programs and this node, and one does not admit the other.
    Refused,
    /// DDS Security protects this node, but not the programs.
    Unprotected,
    /// The programs announce themselves, but nothing else of them arrives. Neither side has DDS Security.
    Silent,
}

/// Programs that cannot be joined for the same reason.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Strangers {
    /// The reason.
    pub barrier: Barrier,
    /// The enclave that the programs announce. `None` for [`Barrier::Unprotected`].
    pub enclave: Option<String>,
    /// The number of remembered programs.
    pub programs: usize,
}

/// A participant without a known endpoint, which may be a stranger.
#[derive(Debug)]
struct Program {
    enclave: Option<String>,
    since: Instant,
    /// `true` if Cyclone has refused one of its endpoints, including those of discovery.
    is_refused: bool,
    /// `true` if DDS Security protects the network on which it was seen.
    here_secured: bool,
}

type Programs = BTreeMap<[u8; 12], Program>;

static PROGRAMS: Mutex<Programs> = Mutex::new(Programs::new());

fn programs() -> MutexGuard<'static, Programs> {
    lock(&PROGRAMS)
}

impl Program {
    fn barrier(&self, prefix: &[u8; 12], now: Instant) -> Option<Barrier> {
        let is_silent = now.saturating_duration_since(self.since) >= SILENT_AFTER;
        if !is_silent && !self.is_refused {
            return None;
        }
        let is_secured = prefix[0] & SECURED_BIT != 0;
        Some(match (is_secured, self.here_secured) {
            (true, false) => Barrier::Protected,
            (true, true) => Barrier::Refused,
            (false, true) => Barrier::Unprotected,
            (false, false) => Barrier::Silent,
        })
    }
}

/// Returns the programs on this process's local networks that cannot be joined.
pub fn strangers() -> Vec<Strangers> {
    grouped(&programs(), Instant::now())
}

fn grouped(programs: &Programs, now: Instant) -> Vec<Strangers> {
    let mut groups: BTreeMap<(Barrier, Option<&str>), usize> = BTreeMap::new();
    for (prefix, program) in programs {
        let Some(barrier) = program.barrier(prefix, now) else { continue };
        let enclave = program.enclave.as_deref().filter(|_| barrier != Barrier::Unprotected);
        *groups.entry((barrier, enclave)).or_default() += 1;
    }
    let groups = groups.into_iter();
    groups
        .map(|((barrier, enclave), programs)| {
            let enclave = enclave.map(str::to_owned);
            Strangers { barrier, enclave, programs }
        })
        .collect()
}

/// Records a ROS 2 participant without a known endpoint.
pub(crate) fn note_participant(guid: &Guid, enclave: &str, here_secured: bool) {
    if is_enclave(enclave)
        && let Some(program) = entry(&mut programs(), guid.prefix(), here_secured)
    {
        program.enclave = Some(enclave.to_owned());
    }
}

/// Records an endpoint of a participant without DDS Security that Cyclone refuses.
pub(crate) fn note_refused(guid: &Guid) {
    if let Some(program) = entry(&mut programs(), guid.prefix(), true) {
        program.is_refused = true;
    }
}

/// Forgets a participant that is gone or has a known endpoint.
pub(crate) fn forget(guid: &Guid) {
    programs().remove(&guid.prefix());
}

/// Returns the entry of a participant, if it exists or there is room.
fn entry(programs: &mut Programs, prefix: [u8; 12], here_secured: bool) -> Option<&mut Program> {
    if programs.len() >= PROGRAMS_MAX && !programs.contains_key(&prefix) {
        return None;
    }
    let new = || Program { enclave: None, since: Instant::now(), is_refused: false, here_secured };
    Some(programs.entry(prefix).or_insert_with(new))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a participant. The table is global, so each test has its own participants.
    fn guid(first: u8, number: u8) -> Guid {
        let mut guid = [number; 16];
        guid[0] = first;
        Guid(guid)
    }

    fn barriers(participant: &Guid, later: Duration) -> Vec<(Barrier, Option<String>)> {
        let mut programs = programs();
        let prefix = participant.prefix();
        let Some(program) = programs.remove(&prefix) else { return Vec::new() };
        let one = Programs::from([(prefix, program)]);
        let found = grouped(&one, Instant::now() + later);
        programs.extend(one);
        found.into_iter().map(|strangers| (strangers.barrier, strangers.enclave)).collect()
    }

    #[test]
    fn silent_participants_are_told_by_who_is_secured() {
        for (participant, here_secured, barrier, enclave) in [
            (guid(0x81, 1), false, Barrier::Protected, Some("/arm")),
            (guid(0x81, 2), true, Barrier::Refused, Some("/arm")),
            (guid(0x01, 3), false, Barrier::Silent, Some("/arm")),
            (guid(0x01, 4), true, Barrier::Unprotected, None),
        ] {
            note_participant(&participant, "/arm", here_secured);
            assert_eq!(barriers(&participant, Duration::ZERO), [], "not yet");
            assert_eq!(barriers(&participant, SILENT_AFTER), [(barrier, enclave.map(str::to_owned))]);
            forget(&participant);
            assert_eq!(barriers(&participant, SILENT_AFTER), []);
        }
    }

    #[test]
    fn participants_are_told_at_once_when_they_are_refused() {
        let participant = guid(1, 5);
        note_refused(&participant);
        assert_eq!(barriers(&participant, Duration::ZERO), [(Barrier::Unprotected, None)]);
        forget(&participant);
    }

    #[test]
    fn programs_are_bounded() {
        let mut programs = Programs::new();
        for n in 0..=PROGRAMS_MAX {
            let made = entry(&mut programs, [n as u8; 12], true).is_some();
            assert_eq!(made, n < PROGRAMS_MAX);
        }
        let later = Instant::now() + SILENT_AFTER;
        assert_eq!(grouped(&programs, later).iter().map(|group| group.programs).sum::<usize>(), PROGRAMS_MAX);
    }
}
