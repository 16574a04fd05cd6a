//! Volatile readers that join late, and the samples that are not for them.
//!
//! A writer keeps a sample until every reader has acknowledged it. A program that was killed acknowledges nothing, and
//! Cyclone waits for it until its lease ends: 20 s for Fast DDS. A reader that is discovered meanwhile hears by a
//! heartbeat which samples the writer keeps, and Fast DDS asks for all of them, also for a volatile reader. Cyclone
//! answers volatile readers of its own vendor with a GAP for what was written before the match (`handle_AckNack` in
//! `ddsi_receive.c`), as RTPS 2.5, 8.4.2.2.5 demands, but sends the samples to all others.
//!
//! So such a reader gets a filter when it is discovered, see [`spare`]. Cyclone asks a reader's filter before it
//! repeats a sample, and answers with a GAP if the filter declines. The filter declines samples that were made before
//! the reader was discovered. Cyclone has a filter for readers of its own security alone.
//!
//! This needs structs of the C code of `cyclors` =0.4.0, as [`crate::first_messages`] does. A reader is compared with a
//! new one of Cyclone, and left alone if it differs.

use std::collections::BTreeMap;
use std::ffi::{c_int, c_void};
use std::sync::{Mutex, MutexGuard, Once};

use cyclors::{dds_durability_kind_DDS_DURABILITY_VOLATILE, dds_qget_durability, dds_qos_t, ddsi_serdata};
use sgc_sync::lock;

use crate::identity::CYCLONE;
use crate::sample;

/// Most readers with a filter in a process. Beyond that late readers may hear old samples.
const READERS_MAX: usize = 16_384;

/// Flags of a proxy reader that are 0 in a new one: `deleting` and `is_fict_trans_reader`.
const FLAGS_OF_OLD: u32 = 0b11;

/// Least length of a reader's socket buffer that Cyclone assumes, bytes.
const SOCKET_BYTES_MIN: u32 = 128 << 10;

type Filter = unsafe extern "C" fn(*const c_void, *const c_void, *const ddsi_serdata) -> c_int;

/// The part of `struct ddsi_proxy_reader` (`ddsi_proxy_endpoint.h`) behind what is common to endpoints.
#[repr(C)]
pub(crate) struct ProxyReaderState {
    flags: u32,
    writers: *const c_void,
    socket_bytes: u32,
    filter: Option<Filter>,
}

impl ProxyReaderState {
    /// Returns `true` for exactly the state that `ddsi_new_proxy_reader` writes for a reader of a topic.
    pub(crate) fn is_new(&self) -> bool {
        self.flags & FLAGS_OF_OLD == 0
            && self.writers.is_null()
            && self.socket_bytes >= SOCKET_BYTES_MIN
            && self.filter.is_none()
    }
}

/// A reader with a filter.
struct LateReader {
    /// The domain that discovered it.
    domain: usize,
    /// Its number among the discoveries of this process, as [`sample::count_discovery`] returned it.
    discovery: u64,
}

/// The readers with a filter, by the address of their `struct ddsi_proxy_reader`.
static READERS: Mutex<BTreeMap<usize, LateReader>> = Mutex::new(BTreeMap::new());

fn readers() -> MutexGuard<'static, BTreeMap<usize, LateReader>> {
    lock(&READERS)
}

/// Gives a new volatile reader a filter for what was made before, unless Cyclone does the same itself.
///
/// # Safety
/// `reader` is a new proxy reader, which no writer is matched with yet, `qos` its QoS and `state` the rest of it, if it
/// was recognised. They live, and only Cyclone's threads that hold its lock use them, at least until [`forget`] is told
/// of it.
pub(crate) unsafe fn spare(
    domain: *const c_void,
    reader: *const c_void,
    vendor: [u8; 2],
    qos: *const dds_qos_t,
    state: Option<*mut ProxyReaderState>,
) {
    static DIFFERS: Once = Once::new();
    let mut durability = dds_durability_kind_DDS_DURABILITY_VOLATILE;
    // SAFETY: valid by contract; a place for the result. Without a durability it is volatile.
    unsafe { dds_qget_durability(qos, &mut durability) };
    if vendor == CYCLONE || durability != dds_durability_kind_DDS_DURABILITY_VOLATILE {
        return;
    }
    let Some(state) = state else {
        return DIFFERS.call_once(|| {
            tracing::warn!("this Cyclone DDS is another one: late subscribers may hear old messages");
        });
    };
    let mut all = readers();
    if all.len() >= READERS_MAX {
        tracing::debug!("too many readers: this one may hear old messages");
        return;
    }
    let discovery = sample::count_discovery();
    all.insert(reader as usize, LateReader { domain: domain as usize, discovery });
    // SAFETY: valid by contract.
    unsafe { (*state).filter = Some(is_for) };
}

/// Forgets a reader that is about to go.
pub(crate) fn forget(reader: *const c_void) {
    readers().remove(&(reader as usize));
}

/// The readers of a domain. Dropping forgets them.
#[derive(Debug)]
pub(crate) struct LateReaders(pub(crate) usize);

impl Drop for LateReaders {
    fn drop(&mut self) {
        readers().retain(|_, reader| reader.domain != self.0);
    }
}

/// The filter: returns 0 if a sample is older than the reader that asks for it again.
unsafe extern "C" fn is_for(_: *const c_void, reader: *const c_void, asked: *const ddsi_serdata) -> c_int {
    let discovery = readers().get(&(reader as usize)).map(|reader| reader.discovery);
    // SAFETY: Cyclone lends the filter a sample of the writer.
    let made_after = unsafe { sample::discoveries_before(asked) };
    discovery.zip(made_after).is_none_or(|(discovery, made_after)| made_after >= discovery).into()
}
