//! Cyclone's log, turned into `tracing` events and into the reasons of errors.
//!
//! Cyclone reports *why* a domain cannot be created only in its log, beside much that no operator needs on stderr.
//! Tracing to a file, if the user's `CYCLONEDDS_URI` asks for it, is not touched.
//!
//! Repeated errors are counted: each kind is logged once in [`QUIET`], in the operator's words if the kind is known.

use std::cell::RefCell;
use std::ffi::{CStr, c_void};
use std::net::SocketAddrV4;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, Once};
use std::time::{Duration, Instant};

use cyclors::{DDS_LC_ERROR, DDS_LC_FATAL, DDS_LC_WARNING, dds_log_data_t, dds_set_log_sink};
use sgc_ros::Guid;
use sgc_sync::lock;

use crate::strangers;

use crate::host_addresses;

/// Longest reason of one failure, in bytes.
const REASON_BYTES_MAX: usize = 1024;

/// Shortest time between two log lines of a kind.
const QUIET: Duration = Duration::from_secs(60);

/// Packets of the local network that could not be sent.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Unsent {
    /// Their number since the beginning of this process.
    pub packets: u64,
    /// The address of the last one.
    pub to: String,
    /// The time of the last one.
    pub last: Instant,
}

static UNSENT: Mutex<Option<Unsent>> = Mutex::new(None);
/// The time of the last packet for a program on another host.
static CUT_OFF: Mutex<Option<Instant>> = Mutex::new(None);

/// Returns the packets of this process's local networks that could not be sent, if there were any.
pub fn unsent() -> Option<Unsent> {
    lock(&UNSENT).clone()
}

/// Returns `true` if a packet for a program on another host could not be sent since `begin`.
pub(crate) fn is_cut_off_since(begin: Instant) -> bool {
    lock(&CUT_OFF).is_some_and(|last| last >= begin)
}

/// Returns `true` for the address of a program on another host.
fn is_elsewhere(to: &str) -> bool {
    to.parse::<SocketAddrV4>().is_ok_and(|to| !to.ip().is_multicast() && !host_addresses::is_known(*to.ip()))
}

/// The repeated lines of one kind.
#[derive(Debug)]
pub(crate) struct Repeats {
    logged: Option<Instant>,
    since: u64,
}

impl Repeats {
    pub(crate) const NONE: Self = Self { logged: None, since: 0 };

    /// Counts a line. If it should be logged, returns the number of earlier ones that were not.
    fn note(&mut self, now: Instant) -> Option<u64> {
        self.add(now, 1).map(|several| several - 1)
    }

    /// Counts several events of a kind. If a line should be logged, returns the number since the last line.
    pub(crate) fn add(&mut self, now: Instant, several: u64) -> Option<u64> {
        self.since += several;
        if self.logged.is_some_and(|logged| now.saturating_duration_since(logged) < QUIET) {
            return None;
        }
        self.logged = Some(now);
        Some(std::mem::take(&mut self.since))
    }
}

static REPEATS: Mutex<[Repeats; 3]> = Mutex::new([Repeats::NONE; 3]);

/// Returns the address of a packet that could not be sent, from Cyclone's line: `ddsi_udp_conn_write to
/// udp/10.0.0.1:7411 failed with retcode -1`.
fn unsent_to(message: &str) -> Option<&str> {
    let (to, _) = message.strip_prefix("ddsi_udp_conn_write to ")?.split_once(" failed with retcode")?;
    Some(to.strip_prefix("udp/").unwrap_or(to))
}

/// Returns the probable cause if Cyclone's line refuses a secured participant. The words are those of
/// `ddsi_handshake.c`, `ddsi_security_omg.c` and `ddsi_proxy_participant.c`.
fn refused_program(message: &str) -> Option<&'static str> {
    let says = |words: &str| message.contains(words);
    if says("handshake reply failed") && says("ASN1 integer") {
        Some(
            "Fast DDS before 3.2 proposes keys by DH, which it encodes in another way than Cyclone DDS: set its property \
             dds.sec.auth.builtin.PKI-DH.preferred_key_agreement to ECDH, or name the enclave of sgc `/bridge` (docs/how-to/sros2.md)",
        )
    } else if says("andshake")
        || says("Remote secure participant")
        || says("authenticate_peer_credential_token")
    {
        Some(
            "compare its identity CA and governance with those of this node's enclave, and when both certificates end",
        )
    } else if says("does not allow remote participant") {
        Some("its permissions do not grant it this ROS domain")
    } else {
        None
    }
}

/// Returns the endpoint of a program without DDS Security that Cyclone's line refuses: `Non secure remote writer
/// 110a1b2:3:4:103 is not allowed.` (`ddsi_security_omg.c`).
fn refused_endpoint(message: &str) -> Option<Guid> {
    let rest = message.strip_prefix("Non secure remote ")?;
    let rest = rest.strip_prefix("writer ").or_else(|| rest.strip_prefix("reader "))?;
    let mut words = rest.strip_suffix(" is not allowed.")?.split(':');
    let mut guid = [0; 16];
    for place in guid.chunks_exact_mut(4) {
        place.copy_from_slice(&u32::from_str_radix(words.next()?, 16).ok()?.to_be_bytes());
    }
    words.next().is_none().then_some(Guid(guid))
}

/// The number of networks that are being opened.
static OPENING: AtomicUsize = AtomicUsize::new(0);

/// A network that is being opened. Until its domain has a participant, Cyclone refuses every secured participant.
pub(crate) struct Opening(());

impl Opening {
    /// Marks the beginning.
    pub(crate) fn begin() -> Self {
        OPENING.fetch_add(1, Ordering::Relaxed);
        Self(())
    }
}

impl Drop for Opening {
    fn drop(&mut self) {
        OPENING.fetch_sub(1, Ordering::Relaxed);
    }
}

/// Returns `true` for lines without meaning while a network is being opened (`ddsi_proxy_participant.c`).
fn is_premature(message: &str) -> bool {
    message.starts_with("Remote secure participant ") && OPENING.load(Ordering::Relaxed) > 0
}

/// Counts an error, and logs it unless its kind was logged recently.
fn complain(message: &str, now: Instant) {
    let to = unsent_to(message);
    if let Some(to) = to {
        let mut unsent = lock(&UNSENT);
        let packets = unsent.as_ref().map_or(0, |unsent| unsent.packets) + 1;
        *unsent = Some(Unsent { packets, to: to.to_owned(), last: now });
        if is_elsewhere(to) {
            *lock(&CUT_OFF) = Some(now);
        }
    }
    let refused = refused_program(message);
    let [sending, security, other] = &mut *lock(&REPEATS);
    let kind = match (to, refused) {
        (Some(_), _) => sending,
        (None, Some(_)) => security,
        (None, None) => other,
    };
    let Some(before) = kind.note(now) else { return };
    let more = if before == 0 { String::new() } else { format!(" ({before} more since the last such line)") };
    match to {
        Some(to) => tracing::warn!(
            "packets to the local ROS 2 network cannot be sent, this one to {to}{more}: no way leads there, or this host's address \
             changed"
        ),
        None => match refused {
            Some(cause) => {
                tracing::warn!("a program that DDS Security protects is not let in{more}: {message}; {cause}")
            }
            None => tracing::warn!(target: "cyclonedds", "{message}{more}"),
        },
    }
}

thread_local! {
    static HEARD: RefCell<Option<String>> = const { RefCell::new(None) };
}

/// Sends Cyclone's log to `tracing`, for the lifetime of the process.
pub(crate) fn install() {
    static INSTALLED: Once = Once::new();
    // SAFETY: the sink is a function that is valid for ever and ignores its user data.
    INSTALLED.call_once(|| unsafe { dds_set_log_sink(Some(sink), std::ptr::null_mut()) });
}

/// Runs `f` and returns the errors that Cyclone logged on this thread meanwhile, on one line.
pub(crate) fn listen<T>(f: impl FnOnce() -> T) -> (T, String) {
    HEARD.set(Some(String::new()));
    let result = f();
    (result, HEARD.take().unwrap_or_default())
}

unsafe extern "C" fn sink(_: *mut c_void, data: *const dds_log_data_t) {
    // SAFETY: Cyclone passes a valid record for the duration of the call.
    let Some(data) = (unsafe { data.as_ref() }) else { return };
    if data.message.is_null() {
        return;
    }
    // SAFETY: the message is a NUL-terminated string, valid for the duration of the call.
    let message = unsafe { CStr::from_ptr(data.message) }.to_string_lossy();
    let message = message.trim_end();
    if data.priority & (DDS_LC_FATAL | DDS_LC_ERROR) != 0 {
        let heard = HEARD.with_borrow_mut(|heard| match heard {
            Some(text) => {
                if !text.is_empty() {
                    text.push_str("; ");
                }
                let room = REASON_BYTES_MAX.saturating_sub(text.len());
                text.extend(message.chars().take(room));
                true
            }
            None => false,
        });
        if !heard {
            complain(message, Instant::now());
        }
    } else if data.priority & DDS_LC_WARNING != 0
        && refused_program(message).is_some()
        && !is_premature(message)
    {
        complain(message, Instant::now());
    } else if data.priority & DDS_LC_WARNING != 0 {
        if let Some(guid) = refused_endpoint(message) {
            strangers::note_refused(&guid);
        }
        // Cyclone's warnings name topics and types.
        tracing::debug!(target: "cyclonedds", "{message}");
    } else {
        tracing::trace!(target: "cyclonedds", "{message}");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_packet_that_is_not_sent_is_told_by_its_address() {
        let said = "ddsi_udp_conn_write to udp/239.255.0.1:7400 failed with retcode -1";
        assert_eq!(unsent_to(said), Some("239.255.0.1:7400"));
        assert_eq!(unsent_to("ddsi_udp_conn_write to nowhere"), None);
        assert_eq!(unsent_to("malformed packet received"), None);
    }

    #[test]
    fn refused_programs_are_told_with_the_cause() {
        let said = "Begin handshake reply failed: Failed to convert key string to ASN1 integer: (code: 200)";
        assert!(refused_program(said).is_some_and(|cause| cause.contains("ECDH")));
        assert!(refused_program("Remote secure participant 1:2:3:1c1 not allowed").is_some());
        assert_eq!(refused_program("Non secure remote writer 1:2:3:4 is not allowed."), None);
    }

    #[test]
    fn refusals_by_a_domain_without_participants_are_not_told() {
        let said = "Remote secure participant 1:2:3:1c1 not allowed";
        let opening = Opening::begin();
        assert!(is_premature(said));
        assert!(!is_premature("Begin handshake reply failed: x"));
        drop(opening);
        assert!(!is_premature(said));
    }

    #[test]
    fn refused_endpoints_are_told_by_their_guid() {
        let guid = Guid([1, 0x0f, 0xa1, 0xb2, 0, 0, 0, 3, 0, 0, 0, 4, 0, 0, 1, 3]);
        assert_eq!(refused_endpoint("Non secure remote writer 10fa1b2:3:4:103 is not allowed."), Some(guid));
        assert!(refused_endpoint("Non secure remote reader 1:2:3:4 is not allowed.").is_some());
        for other in ["writer 1:2:3 is not allowed.", "writer 1:2:3:4:5 is not allowed.", "writer x:2:3:4"] {
            assert_eq!(refused_endpoint(&format!("Non secure remote {other}")), None);
        }
    }

    #[test]
    fn lines_of_a_kind_are_counted_and_logged_once_in_a_while() {
        let (mut repeats, start) = (Repeats::NONE, Instant::now());
        assert_eq!(repeats.note(start), Some(0));
        for n in 1..=175 {
            assert_eq!(repeats.note(start + n * QUIET / 176), None);
        }
        assert_eq!(repeats.note(start + QUIET), Some(175));
        assert_eq!(repeats.note(start + 2 * QUIET), Some(0));
        assert_eq!(repeats.add(start + 2 * QUIET, 40), None);
        assert_eq!(repeats.add(start + 3 * QUIET, 2), Some(42));
    }

    #[test]
    fn only_packets_for_other_hosts_say_that_those_are_cut_off() {
        assert!(is_elsewhere("192.0.2.1:7411"));
        for here in ["239.255.0.1:7400", "127.0.0.1:7411", "[ff02::1]:7400", "nowhere"] {
            assert!(!is_elsewhere(here), "{here}");
        }
        let now = Instant::now();
        complain("ddsi_udp_conn_write to udp/192.0.2.1:7411 failed with retcode -1", now);
        assert!(is_cut_off_since(now));
        assert!(!is_cut_off_since(now + QUIET));
    }

    #[test]
    fn packets_that_are_not_sent_are_counted() {
        let now = Instant::now();
        let before = unsent().map_or(0, |unsent| unsent.packets);
        complain("ddsi_udp_conn_write to udp/239.255.0.1:7400 failed with retcode -1", now);
        assert!(unsent().is_some_and(|unsent| unsent.packets > before));
    }
}
