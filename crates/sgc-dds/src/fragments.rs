//! Fragments of received samples, as Cyclone hands them to a sample type.
//!
//! Cyclone considers a sample complete once its fragments reach the length that the first one announces. It does not
//! compare that length with those that the other fragments announce, so a fragment may reach beyond it. Cyclone
//! checks this only by assertions, which are not compiled in. [`cover_exactly`] checks it here, and
//! [`guard_discovery`] makes Cyclone's own sample types check it.
//!
//! This module also reads the submessages behind a sample in its packet: [`kept_by_writer`].
//!
//! The structs are those of the C code of `cyclors` =0.4.0: `CYCLORS` in `sample.rs`.

use std::ffi::{c_int, c_long, c_void};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicPtr, Ordering};

use cyclors::{ddsi_rdata, ddsi_serdata, ddsi_serdata_kind, ddsi_serdata_ops, ddsi_sertype};

use crate::files::read_file;
use crate::inline_qos::{DATA, DATA_FRAG, FLAG_LITTLE_ENDIAN};
use crate::payload::HEADER_BYTES;

/// Most submessages behind a sample that are examined.
const SUBMESSAGES_MAX: usize = 4;

/// The kind of a heartbeat (RTPS 2.5, 9.4.5.7), and its length up to the last number in bytes.
const HEARTBEAT: (u8, usize) = (0x07, 28);

/// INFO_TS and INFO_DST (RTPS 2.5, 9.4.5.11 and 9.4.5.9), which may precede the heartbeat.
const INFO: [u8; 2] = [0x09, 0x0e];

/// Positions of the writer's entity id in a sample and in a heartbeat, in bytes from the beginning of the submessage.
const WRITER_OFFSETS: [usize; 2] = [12, 8];

/// Length of the header of a submessage, bytes.
const SUBMESSAGE_HEAD_BYTES: usize = 4;

/// The beginning of `struct ddsi_rdata` (`ddsi_radmin.h`), a fragment of a received sample.
#[repr(C)]
pub(crate) struct ReceivedFragment {
    pub(crate) message: *const ReceivedMessage,
    pub(crate) next: *const ReceivedFragment,
    pub(crate) first: u32,
    pub(crate) end: u32,
    pub(crate) submessage_offset: u16,
    pub(crate) payload_offset: u16,
}

/// `struct ddsi_rmsg` (`ddsi_radmin.h`); the packet follows it.
#[repr(C)]
pub(crate) struct ReceivedMessage {
    references: u32,
    last_chunk: *mut c_void,
    trace: bool,
    chunk_buffer: *mut c_void,
    chunk_next: *mut c_void,
    chunk_bytes: u64,
}

/// Returns `true` if the fragments cover a sample of this length without a gap, and no fragment reaches beyond it.
///
/// # Safety
/// `fragments` must be a chain of fragments that Cyclone hands to a type of samples.
pub(crate) unsafe fn cover_exactly(fragments: *const ddsi_rdata, bytes: usize) -> bool {
    let mut covered = 0;
    let mut at = fragments.cast::<ReceivedFragment>();
    // SAFETY: a chain that ends with null, by contract.
    while let Some(fragment) = unsafe { at.as_ref() } {
        let (first, end) = (fragment.first as usize, fragment.end as usize);
        if first > covered || first > end || end > bytes {
            return false;
        }
        covered = covered.max(end);
        at = fragment.next;
    }
    covered == bytes
}

// Of `ddsi__serdata_plist.h`, `ddsi__serdata_pserop.h` and `ddsi__serdata_cdr.h`: the tables of functions of Cyclone's
// own types, which are those of participants and endpoints, of liveliness and DDS Security, and of questions for types.
// mprotect(2), sysconf(3).
#[allow(improper_ctypes)]
unsafe extern "C" {
    static ddsi_serdata_ops_plist: ddsi_serdata_ops;
    static ddsi_serdata_ops_pserop: ddsi_serdata_ops;
    static ddsi_serdata_ops_cdr: ddsi_serdata_ops;
    fn mprotect(start: *mut c_void, bytes: usize, protection: c_int) -> c_int;
    fn sysconf(name: c_int) -> c_long;
}

/// Linux: `_SC_PAGESIZE`, `PROT_READ`, `PROT_WRITE`.
const PAGE_SIZE: c_int = 30;
const READ: c_int = 1;
const WRITE: c_int = 2;

type FromSer = unsafe extern "C" fn(
    *const ddsi_sertype,
    ddsi_serdata_kind,
    *const ddsi_rdata,
    usize,
) -> *mut ddsi_serdata;

/// Cyclone's own functions, by table.
static FROM_SER: [AtomicPtr<c_void>; 3] = [const { AtomicPtr::new(std::ptr::null_mut()) }; 3];

/// Makes Cyclone's own sample types refuse fragments that do not cover their sample exactly, for the lifetime of the
/// process. Call this before a domain exists.
///
/// The tables are constants in write-protected memory, whose protection is lifted for a moment.
///
/// # Errors
/// The memory is not as expected.
pub(crate) fn guard_discovery() -> Result<(), &'static str> {
    static DONE: OnceLock<Result<(), &'static str>> = OnceLock::new();
    *DONE.get_or_init(|| {
        let tables = [
            (&raw const ddsi_serdata_ops_plist, covered::<0> as FromSer),
            (&raw const ddsi_serdata_ops_pserop, covered::<1> as FromSer),
            (&raw const ddsi_serdata_ops_cdr, covered::<2> as FromSer),
        ];
        tables.into_iter().zip(&FROM_SER).try_for_each(|((table, ours), original)| {
            // SAFETY: a table of Cyclone's, which lives for ever.
            let field = unsafe { &raw const (*table).from_ser }.cast_mut().cast::<*mut c_void>();
            // SAFETY: a function of the table.
            original.store(unsafe { field.read_volatile() }, Ordering::Release);
            // SAFETY: ours has the signature of the one before, which it calls, and Cyclone reads the field whole.
            unsafe { replace(field, ours as *mut c_void) }
        })
    })
}

/// Writes a pointer to memory that may be protected against it.
///
/// # Safety
/// `field` must be aligned and valid for ever, its value one that all who read it can use.
unsafe fn replace(field: *mut *mut c_void, with: *mut c_void) -> Result<(), &'static str> {
    let maps = read_file("/proc/self/maps").unwrap_or_default();
    let is_writable = match protection(&maps, field as usize) {
        Some("rw-p") => true,
        Some("r--p") => false,
        _ => return Err("the memory of its functions is not as expected"),
    };
    // SAFETY: takes a number.
    let page_bytes = unsafe { sysconf(PAGE_SIZE) };
    let page_bytes = usize::try_from(page_bytes).ok().filter(|bytes| bytes.is_power_of_two());
    let page_bytes = page_bytes.ok_or("the length of a page is not known")?;
    let page = field.map_addr(|at| at & !(page_bytes - 1)).cast::<c_void>();
    // SAFETY: one page of this process. It stays readable throughout, and nothing in it is code.
    let protect = |protection| unsafe { mprotect(page, page_bytes, protection) } == 0;
    if !is_writable && !protect(READ | WRITE) {
        return Err("the memory of its functions cannot be written to");
    }
    // SAFETY: by contract, and writable now. An aligned pointer is in one page.
    unsafe { AtomicPtr::from_ptr(field) }.store(with, Ordering::Release);
    if !is_writable {
        // On failure the page stays writable, as it is where the linker does not protect it.
        protect(READ);
    }
    Ok(())
}

/// Returns the protection of an address, such as `r--p`, from `/proc/self/maps` (proc_pid_maps(5)).
fn protection(maps: &str, address: usize) -> Option<&str> {
    maps.lines().find_map(|line| {
        let mut words = line.split_ascii_whitespace();
        let (start, end) = words.next()?.split_once('-')?;
        let number = |text| usize::from_str_radix(text, 16).ok();
        (number(start)?..number(end)?).contains(&address).then(|| words.next()).flatten()
    })
}

/// Replaces Cyclone's own function of a table.
unsafe extern "C" fn covered<const TABLE: usize>(
    sertype: *const ddsi_sertype,
    kind: ddsi_serdata_kind,
    fragments: *const ddsi_rdata,
    bytes: usize,
) -> *mut ddsi_serdata {
    let original = FROM_SER[TABLE].load(Ordering::Acquire);
    // SAFETY: the fragments are those that Cyclone gave for this function.
    if original.is_null() || bytes < HEADER_BYTES || !unsafe { cover_exactly(fragments, bytes) } {
        return std::ptr::null_mut();
    }
    // SAFETY: the function that was there, with its own arguments.
    unsafe { std::mem::transmute::<*mut c_void, FromSer>(original)(sertype, kind, fragments, bytes) }
}

/// Returns the number of messages that the writer of a sample keeps, if a heartbeat follows in the packet and shows
/// that the writer has dropped older ones.
///
/// Fast DDS puts a heartbeat behind each sample of a reliable writer once its history is full, into the same packet
/// (`StatefulWriter::send_heartbeat_piggyback_nts_`). Its numbers are consecutive and begin with 1.
///
/// # Safety
/// `fragment` must be one that Cyclone hands to a type of samples, while it does so.
pub(crate) unsafe fn kept_by_writer(fragment: &ReceivedFragment) -> Option<u64> {
    // SAFETY: valid by contract, and the packet follows the struct.
    let (packet, bytes) = unsafe {
        let bytes = (&raw const (*fragment.message).chunk_bytes).cast::<u32>().read_volatile();
        (fragment.message.add(1).cast::<u8>(), bytes as usize)
    };
    // Cyclone allocates fragments behind the packet, in the same chunk while there is room.
    let distance = (std::ptr::from_ref(fragment) as usize).wrapping_sub(packet as usize);
    // SAFETY: the packet is as long, or what Cyclone allocated behind it is.
    let packet = unsafe { std::slice::from_raw_parts(packet, bytes.min(distance)) };
    kept_behind(packet, usize::from(fragment.submessage_offset))
}

/// Returns that number for the sample whose submessage begins at `at` in a packet.
fn kept_behind(packet: &[u8], mut at: usize) -> Option<u64> {
    let read = |at: usize, bytes: usize| packet.get(at..at.checked_add(bytes)?);
    let head = read(at, DATA.1)?;
    if ![DATA.0, DATA_FRAG.0].contains(&head[0]) {
        return None;
    }
    // Cyclone has put the header of the sample into the byte order of this machine. The later submessages are still
    // as received, because Cyclone handles them after this or at the same time.
    let writer = u32::from_ne_bytes(*head[WRITER_OFFSETS[0]..].first_chunk()?);
    let mut length = usize::from(u16::from_ne_bytes([head[2], head[3]]));
    for _ in 0..SUBMESSAGES_MAX {
        if length == 0 {
            // The submessage is the last one.
            return None;
        }
        at += SUBMESSAGE_HEAD_BYTES + length;
        let head = read(at, SUBMESSAGE_HEAD_BYTES)?;
        if (head[1] & FLAG_LITTLE_ENDIAN == 0) != cfg!(target_endian = "big") {
            return None;
        }
        length = usize::from(u16::from_ne_bytes([head[2], head[3]]));
        match head[0] {
            kind if kind == HEARTBEAT.0 => {
                let heartbeat = read(at, HEARTBEAT.1)?;
                let from = *heartbeat[WRITER_OFFSETS[1]..].first_chunk()?;
                let is_same = [u32::from_be_bytes(from), u32::from_ne_bytes(from)].contains(&writer);
                return is_same.then(|| kept(heartbeat)).flatten();
            }
            kind if INFO.contains(&kind) => {}
            _ => return None,
        }
    }
    None
}

/// Returns the number of messages that a heartbeat announces, unless they begin with the very first.
fn kept(heartbeat: &[u8]) -> Option<u64> {
    let number = |at: usize| {
        let (high, low) = (heartbeat[at..].first_chunk::<4>()?, heartbeat[at + 4..].first_chunk::<4>()?);
        u64::try_from(i64::from(i32::from_ne_bytes(*high)) << 32 | i64::from(u32::from_ne_bytes(*low))).ok()
    };
    let (first, last) = (number(12)?, number(20)?);
    (first > 1).then(|| last.checked_sub(first)?.checked_add(1)).flatten()
}

#[cfg(test)]
mod tests {
    use rand_chacha::ChaCha8Rng;
    use rand_core::{RngCore, SeedableRng};

    use super::*;

    /// A message of Cyclone with a packet of one sample and the submessages behind it.
    #[repr(C)]
    struct TestPacket {
        message: ReceivedMessage,
        packet: [u8; 128],
    }

    fn kept_in(behind: &[&[u8]], fragments: usize) -> Option<u64> {
        let mut packet = [0; 128];
        let sample =
            [&[DATA.0, FLAG_LITTLE_ENDIAN, 28, 0][..], &[0; 8], &0x1303_u32.to_ne_bytes(), &[0; 16]].concat();
        let all = [&[0; 20][..], &sample, &behind.concat()].concat();
        packet[..all.len()].copy_from_slice(&all);
        let message = ReceivedMessage {
            references: 1,
            last_chunk: std::ptr::null_mut(),
            trace: false,
            chunk_buffer: std::ptr::null_mut(),
            chunk_next: std::ptr::null_mut(),
            chunk_bytes: all.len().min(fragments) as u64,
        };
        let received = TestPacket { message, packet };
        let fragment = ReceivedFragment {
            message: &raw const received.message,
            next: std::ptr::null(),
            first: 0,
            end: 4,
            submessage_offset: 20,
            payload_offset: 44,
        };
        // SAFETY: as Cyclone has it.
        unsafe { kept_by_writer(&fragment) }
    }

    fn heartbeat(writer: u8, first: u8, last: u8) -> Vec<u8> {
        let head = [HEARTBEAT.0, FLAG_LITTLE_ENDIAN, 28, 0, 0, 0, 0, 4, 0, 0, 0x13, writer];
        [&head[..], &[0, 0, 0, 0, first, 0, 0, 0], &[0, 0, 0, 0, last, 0, 0, 0], &[1, 0, 0, 0]].concat()
    }

    #[test]
    fn protection_of_an_address_is_that_of_its_mapping() {
        let maps = "1000-2000 r-xp 00000000 08:01 7 /usr/bin/a b\n2000-3000 r--p 0 08:01 7\n";
        assert_eq!(
            [0x1fff, 0x2000, 0x3000].map(|at| protection(maps, at)),
            [Some("r-xp"), Some("r--p"), None]
        );
    }

    #[test]
    fn a_heartbeat_behind_a_sample_tells_how_much_its_writer_keeps() {
        let destination = [&[0x0e, FLAG_LITTLE_ENDIAN, 12, 0][..], &[7; 12]].concat();
        assert_eq!(kept_in(&[&heartbeat(3, 6, 10)], 128), Some(5));
        assert_eq!(kept_in(&[&destination, &heartbeat(3, 10, 10)], 128), Some(1));
        assert_eq!(kept_in(&[], 128), None);
        assert_eq!(kept_in(&[&heartbeat(3, 1, 10)], 128), None, "it has dropped none");
        assert_eq!(kept_in(&[&heartbeat(4, 6, 10)], 128), None, "it is another writer's");
        assert_eq!(kept_in(&[&heartbeat(3, 10, 6)], 128), None, "numbers fall");
        assert_eq!(kept_in(&[&destination, &destination[..3]], 128), None, "the packet ends");
        assert_eq!(kept_in(&[&heartbeat(3, 6, 10)], 79), None, "the heartbeat is cut");
        let mut big_endian = heartbeat(3, 6, 10);
        big_endian[1] = 0;
        assert_eq!(kept_in(&[&big_endian], 128), None);
    }

    /// Panics if a packet, or one that was cut, shows a defect.
    fn check_kept(packet: &[u8], at: usize) {
        let kept = kept_behind(packet, at);
        assert_ne!(kept, Some(0));
        for cut in (0..packet.len()).step_by(1 + packet.len() / 16) {
            let of_cut = kept_behind(&packet[..cut], at);
            assert!(of_cut.is_none() || of_cut == kept, "{of_cut:?} of {cut} bytes, {kept:?} of all");
        }
    }

    /// Panics if fragments that leave a gap in a sample, or reach beyond it, are said to cover it.
    fn check_cover(ranges: &[(u8, u8)], bytes: u8) {
        let fragment = |(first, end): &(u8, u8)| ReceivedFragment {
            message: std::ptr::null(),
            next: std::ptr::null(),
            first: u32::from(*first),
            end: u32::from(*end),
            submessage_offset: 0,
            payload_offset: 0,
        };
        let mut fragments: Vec<_> = ranges.iter().map(fragment).collect();
        for at in (1..fragments.len()).rev() {
            let next: *const ReceivedFragment = &fragments[at];
            fragments[at - 1].next = next;
        }
        let first = fragments.first().map_or(std::ptr::null(), std::ptr::from_ref);
        // SAFETY: a chain that ends with null.
        if unsafe { cover_exactly(first.cast(), usize::from(bytes)) } {
            let is_covered = |byte| ranges.iter().any(|(first, end)| (*first..*end).contains(&byte));
            assert!((0..bytes).all(is_covered) && ranges.iter().all(|(_, end)| *end <= bytes), "{ranges:?}");
        }
    }

    #[test]
    fn altered_packets_tell_nothing_that_is_not_in_them() {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let mut below = |bound: usize| random.next_u32() as usize % bound;
        let data = [&[DATA.0, FLAG_LITTLE_ENDIAN, 24, 0][..], &[0; 24]].concat();
        let whole = [&[0; 20][..], &data, &heartbeat(0, 6, 10), &heartbeat(0, 6, 12)].concat();
        for _ in 0..20_000 {
            let mut altered = whole.clone();
            for _ in 0..below(4) {
                let at = 20 + below(altered.len() - 20);
                altered[at] = below(256) as u8;
            }
            check_kept(&altered, 20);
        }
    }

    #[test]
    fn random_fragments_cover_a_sample_only_without_gap_or_excess() {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let mut below = |bound: usize| (random.next_u32() as usize % bound) as u8;
        for _ in 0..20_000 {
            let ranges: Vec<_> = (0..1 + below(3)).map(|_| (below(5), below(6))).collect();
            check_cover(&ranges, below(6));
        }
    }
}
