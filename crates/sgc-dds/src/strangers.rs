//! Programs of the local networks of this process that cannot be joined: what discovery shows of them, and what keeps them apart.
//!
//! Holds what [`crate::discovery`] and [`crate::log`] say, within bounds. Decides nothing.

use std::collections::BTreeMap;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use sgc_ros::Guid;

use crate::security::is_enclave;

/// Bound on programs that are remembered.
const PROGRAMS_MAX: usize = 64;

/// Time after which a participant that announces no endpoint counts as silent. Those of ROS 2 announce theirs at once, which takes a
/// second on a busy machine.
const SILENT_AFTER: Duration = Duration::from_secs(10);

/// The bit that is set in the first byte of GUIDs that DDS Security derives from a certificate, and not in a vendor's id, with which
/// all others begin (DDS Security 1.1, 9.3.3).
const SECURED_BIT: u8 = 0x80;

/// A reason why programs cannot be joined.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Barrier {
    /// DDS Security protects them, and this node has no enclave.
    Protected,
    /// DDS Security protects them and this node, and one does not admit the other.
    Refused,
    /// They have no DDS Security, which protects this node.
    Unprotected,
    /// They announce themselves, and nothing else of them arrives. Neither side has DDS Security.
    Silent,
}

/// Programs that cannot be joined, for the same reason.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Strangers {
    /// The reason.
    pub barrier: Barrier,
    /// The enclave that they name. `None` for [`Barrier::Unprotected`].
    pub enclave: Option<String>,
    /// Their number, as far as they are remembered.
    pub programs: usize,
}

/// A participant that may be one of them: no endpoint of it is known.
#[derive(Debug)]
struct Program {
    enclave: Option<String>,
    since: Instant,
    /// `true` if Cyclone has refused one of its endpoints, which those of discovery are, too.
    is_refused: bool,
    /// `true` if DDS Security protects the network of this process that it was seen on.
    here_secured: bool,
}

type Programs = BTreeMap<[u8; 12], Program>;

static PROGRAMS: Mutex<Programs> = Mutex::new(Programs::new());

fn programs() -> MutexGuard<'static, Programs> {
    PROGRAMS.lock().unwrap_or_else(PoisonError::into_inner)
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

/// Returns the programs on the local networks of this process that cannot be joined.
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

/// Notes a participant of ROS 2 that is announced and of which no endpoint is known.
pub(crate) fn note_participant(guid: &Guid, enclave: &str, here_secured: bool) {
    if is_enclave(enclave)
        && let Some(program) = entry(&mut programs(), guid.prefix(), here_secured)
    {
        program.enclave = Some(enclave.to_owned());
    }
}

/// Notes an endpoint of a participant without DDS Security that Cyclone refuses.
pub(crate) fn note_refused(guid: &Guid) {
    if let Some(program) = entry(&mut programs(), guid.prefix(), true) {
        program.is_refused = true;
    }
}

/// Forgets a participant, which is gone or has an endpoint that is known.
pub(crate) fn forget(guid: &Guid) {
    programs().remove(&guid.prefix());
}

/// Returns the entry of a participant if there is one, or room for one.
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

    /// A participant. They have one place in the whole process, so each test has its own.
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
