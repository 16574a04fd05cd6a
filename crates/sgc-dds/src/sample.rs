//! Samples: SGC's own sertype, for every topic and service.
//!
//! Cyclone lets the type of a topic serialise and deserialise, and knows nothing else about a sample. This type
//! - keeps the payload as it was serialised, and sends long payloads without a copy;
//! - reads the key hash and the related request from the inline QoS of a received sample, because it gets the whole
//!   packet;
//! - puts the key hash and the related request into the inline QoS of a sent sample;
//! - keeps the serialised key of a sample that has nothing else, for which Cyclone would look up the instance;
//! - spreads the samples of a writer over instances that only that writer knows, so that its history is as deep as
//!   memory allows ([`crate::writer`]).
//!
//! Cyclone DDS 11 writes a key hash only for readers that ask for it in Cyclone's own way, and neither reads nor
//! writes the parameter that names the related request. [`crate::inline_qos`] adds both. Another version of `cyclors`
//! does not compile: [`CYCLORS`].
//!
//! Everything else (discovery, matching, reliability, security) is Cyclone's, as for any other endpoint.

use std::ffi::{c_char, c_ulong, c_void};
use std::sync::atomic::{AtomicU64, Ordering};

use bytes::Bytes;
use cyclors::{
    DDSI_SERTYPE_FLAG_REQUEST_KEYHASH, DDSI_SERTYPE_FLAG_TOPICKIND_NO_KEY, DDSI_STATUSINFO_DISPOSE,
    dds_create_topic_sertype, ddsi_keyhash, ddsi_serdata, ddsi_serdata_init, ddsi_serdata_kind,
    ddsi_serdata_kind_SDK_DATA, ddsi_serdata_kind_SDK_KEY, ddsi_serdata_ops, ddsi_serdata_unref,
    ddsi_sertype, ddsi_sertype_fini, ddsi_sertype_init_flags, ddsi_sertype_ops, ddsi_sertype_unref,
    ddsrt_iovec_t,
};
use sgc_ros::{EndpointSpec, KeyHash, SampleKind};

use crate::entity::{Entity, c_string};
use crate::fragments::{self, ReceivedFragment};
use crate::identity::{
    CYCLONE, FAST_DDS, PID_KEY_HASH, PID_NOT_FOR_CYCLONE, PID_RELATED, PID_RELATED_FAST, SampleIdentity,
    key_hash,
};
use crate::inline_qos::{self, DATA, FLAG_INLINE_QOS, FLAG_LITTLE_ENDIAN, INLINE_QOS_BASE, Parameter};
use crate::payload::{Frame, PAYLOAD_BYTES_MAX};

/// The requirement of `Cargo.toml` for the only version of `cyclors` whose C code this module was written for. Cargo
/// builds no other version than the one that is written there with `=`, and whoever writes another one there meets the
/// assertion below. To be done then, in `cyclonedds/src/core/ddsi/src`: compare `struct ddsi_xmsg` and `struct
/// ddsi_xmsg_marker` (`ddsi_xmsg.c`, `ddsi__xmsg.h`), `struct ddsi_rdata` and `struct ddsi_rmsg` (`ddsi_radmin.h`),
/// `struct ddsi_sertype_plist` (`ddsi__serdata_plist.h`) and the users of `ddsi_serdata_ops_plist`, the callers of
/// `ddsi_serdata_to_ser_ref`, and the functions declared below, with the text here and in `inline_qos.rs`,
/// `announced.rs` and `fragments.rs`; all that `first_messages.rs`, `late_readers.rs` and `same_host.rs` name;
/// `domainId` and its readers (`plugin_domain.rs`); and in `cyclonedds/src/core/ddsc/src` the structures that `late.rs`
/// names.
const CYCLORS: &str = "\ncyclors = \"=0.4.0\"\n";

const _: () = assert!(
    contains(include_str!("../Cargo.toml").as_bytes(), CYCLORS.as_bytes()),
    "sample.rs was written for the C structs of another version of cyclors: see CYCLORS"
);

const fn contains(text: &[u8], part: &[u8]) -> bool {
    let mut at = 0;
    while at + part.len() <= text.len() {
        let mut n = 0;
        while n < part.len() && text[at + n] == part[n] {
            n += 1;
        }
        if n == part.len() {
            return true;
        }
        at += 1;
    }
    false
}

/// The properties of a received message besides its payload.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Origin {
    /// The sender's vendor, from the header of the RTPS message.
    pub(crate) vendor: [u8; 2],
    /// The sequence number of the message at its writer.
    pub(crate) number: i64,
    /// The related message, such as the request of a reply.
    pub(crate) related: Option<SampleIdentity>,
    /// The key hash.
    pub(crate) key_hash: Option<KeyHash>,
    /// The number of messages that the writer keeps, if the packet contains it.
    pub(crate) kept: Option<u64>,
}

/// The properties of a sent sample besides its payload.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Extra {
    /// `true` for a key alone.
    pub(crate) key_only: bool,
    /// The key hash, if the topic has a key and the hash is known.
    pub(crate) key_hash: Option<KeyHash>,
    /// The identity for the inline QoS.
    pub(crate) related: Option<SampleIdentity>,
    /// The number of the instance at the writer.
    pub(crate) instance: u32,
}

impl Extra {
    /// Adds these properties to the inline QoS of a message. Returns `false` if the message is not as Cyclone makes
    /// it.
    ///
    /// # Safety
    /// As of [`inline_qos::add`].
    unsafe fn add_to(&self, view: *mut ddsrt_iovec_t) -> bool {
        // No sample has both: services have no keys.
        let related = self.related.map(SampleIdentity::to_bytes);
        let parameters: &[Parameter<'_>] = match (&related, &self.key_hash) {
            (Some(related), _) => {
                &[(PID_RELATED, related), (PID_RELATED_FAST, related), (PID_NOT_FOR_CYCLONE, &[0; 4])]
            }
            (None, Some(hash)) => &[(PID_KEY_HASH, hash)],
            (None, None) => return true,
        };
        // SAFETY: by contract.
        unsafe { inline_qos::add(view, parameters) }
    }
}

/// Shortest payload that is shared. Shorter ones are copied, so that they do not keep alive a larger block.
const SHARED_BYTES_MIN: usize = 16 << 10;

/// A sample of SGC's sertype, in one block of C's memory. The payload follows it, unless it is shared. `common` is
/// first, because Cyclone knows no other field.
#[repr(C)]
struct Content {
    common: ddsi_serdata,
    /// Encapsulation header, body and padding, `bytes` long.
    payload: *const u8,
    bytes: usize,
    /// The block that contains the payload, if the payload does not follow.
    shared: Option<Bytes>,
    extra: Extra,
    /// The properties of the received message.
    origin: Option<Origin>,
    /// The number of discoveries that [`count_discovery`] had counted when the sample was made.
    discoveries: u64,
}

/// A reference to a sample of SGC's sertype.
#[derive(Debug)]
pub(crate) struct SampleRef(*mut ddsi_serdata);

// SAFETY: the reference count is atomic, the content is never changed once it is shared, and freeing it is possible on
// any thread, also when the domain that it came from is gone.
unsafe impl Send for SampleRef {}

impl SampleRef {
    /// Takes over a reference.
    ///
    /// # Safety
    /// The caller owns one reference to `sample`, which is of a topic that [`topic`] made.
    pub(crate) unsafe fn from_raw(sample: *mut ddsi_serdata) -> Self {
        Self(sample)
    }

    /// Builds a sample to write from a payload and its frame. Returns `None` if memory is exhausted.
    ///
    /// # Safety
    /// `sertype` must be that of a topic that [`topic`] made; Cyclone keeps it while the sample is in use.
    pub(crate) unsafe fn build(
        sertype: *const ddsi_sertype,
        payload: &Bytes,
        frame: &Frame<'_>,
        extra: Extra,
        source_timestamp_ns: i64,
    ) -> Option<Self> {
        let is_as_it_was = frame.bytes() == payload.len() && payload.starts_with(&frame.header);
        // SAFETY: the sertype is valid by contract.
        let sample = unsafe {
            if is_as_it_was && payload.len() >= SHARED_BYTES_MIN {
                let (data, bytes) = (payload.as_ptr(), payload.len());
                Content::allocate(sertype, 0).inspect(|sample| {
                    (**sample).shared = Some(payload.clone());
                    ((**sample).payload, (**sample).bytes) = (data, bytes);
                })
            } else {
                Self::copied(sertype, frame)
            }
        }?;
        // SAFETY: just made, and not shared yet.
        unsafe { Self::finish(sample, extra, source_timestamp_ns) }
    }

    /// Builds a sample to write whose frame differs from its payload.
    ///
    /// # Safety
    /// As of [`Self::build`].
    pub(crate) unsafe fn build_framed(
        sertype: *const ddsi_sertype,
        frame: &Frame<'_>,
        extra: Extra,
        source_timestamp_ns: i64,
    ) -> Option<Self> {
        // SAFETY: by contract; then just made, and not shared yet.
        unsafe {
            let sample = Self::copied(sertype, frame)?;
            Self::finish(sample, extra, source_timestamp_ns)
        }
    }

    /// # Safety
    /// As of [`Self::build`].
    unsafe fn copied(sertype: *const ddsi_sertype, frame: &Frame<'_>) -> Option<*mut Content> {
        const ZEROS: [u8; 4] = [0; 4];
        // SAFETY: by contract.
        let sample = unsafe { Content::allocate(sertype, frame.bytes()) }?;
        let pieces =
            [&frame.header[..], &frame.prefix[..frame.prefix_bytes], frame.body, &ZEROS[..frame.pad]];
        // SAFETY: just made, not shared yet, and with room for as many bytes as the pieces have together.
        unsafe {
            for piece in pieces {
                Content::push(sample, piece);
            }
        }
        Some(sample)
    }

    /// # Safety
    /// `sample` must be valid and not shared yet.
    unsafe fn finish(sample: *mut Content, extra: Extra, source_timestamp_ns: i64) -> Option<Self> {
        // SAFETY: by contract.
        unsafe {
            (*sample).extra = extra;
            if extra.key_only {
                (*sample).common.kind = ddsi_serdata_kind_SDK_KEY;
            }
            // Readers of the same participant get this very sample.
            let Extra { related, key_hash, .. } = extra;
            (*sample).origin = Some(Origin { vendor: CYCLONE, number: 0, related, key_hash, kept: None });
            (*sample).common.timestamp.v = source_timestamp_ns;
            (*sample).common.hash = extra.instance;
        }
        Some(Self(sample.cast()))
    }

    /// Sets the RTPS status info bits of a sample that is not shared yet.
    pub(crate) fn set_status(&mut self, statusinfo: u32) {
        // SAFETY: valid while the reference is held, which is the only one.
        unsafe { (*self.0).statusinfo = statusinfo }
    }

    /// Sets the sequence number that a sample, which is not shared yet, will get at its writer.
    pub(crate) fn set_number(&mut self, number: i64) {
        // SAFETY: valid while the reference is held, which is the only one.
        if let Some(origin) = unsafe { &mut (*self.0.cast::<Content>()).origin } {
            origin.number = number;
        }
    }

    /// Gives the reference away to a call that consumes it.
    pub(crate) fn into_raw(self) -> *mut ddsi_serdata {
        let sample = self.0;
        std::mem::forget(self);
        sample
    }

    fn content(&self) -> &Content {
        // SAFETY: of the sertype made here, by the contract of the constructors; a reference is held.
        unsafe { &*self.0.cast::<Content>() }
    }

    /// Returns the properties of a received sample besides its payload.
    pub(crate) fn origin(&self) -> Option<Origin> {
        self.content().origin
    }

    /// Returns the kind of the sample: data or the end of an instance.
    pub(crate) fn kind(&self) -> SampleKind {
        let content = self.content();
        match content.extra.key_only {
            true if content.common.statusinfo & DDSI_STATUSINFO_DISPOSE != 0 => SampleKind::Dispose,
            true => SampleKind::Unregister,
            false => SampleKind::Write,
        }
    }

    /// Returns the payload, which keeps the sample alive.
    pub(crate) fn into_payload(self) -> Bytes {
        Bytes::from_owner(self)
    }
}

impl AsRef<[u8]> for SampleRef {
    fn as_ref(&self) -> &[u8] {
        self.content().payload()
    }
}

impl Drop for SampleRef {
    fn drop(&mut self) {
        // SAFETY: one reference is owned and given back once.
        unsafe { ddsi_serdata_unref(self.0) }
    }
}

/// Creates the topic of a spec below a participant, with SGC's sertype.
pub(crate) fn topic(participant: &Entity, spec: &EndpointSpec) -> Result<Entity, String> {
    let (name, type_name) = (c_string(&spec.topic)?, c_string(&spec.type_name)?);
    // SAFETY: all zeros is a valid value of this plain C struct, and the call below fills it.
    let mut sertype = Box::into_raw(Box::new(unsafe { std::mem::zeroed::<ddsi_sertype>() }));
    let flags =
        if spec.keyless { DDSI_SERTYPE_FLAG_TOPICKIND_NO_KEY } else { DDSI_SERTYPE_FLAG_REQUEST_KEYHASH };
    // SAFETY: `sertype` has room, the name is copied, and both tables live for ever.
    unsafe { ddsi_sertype_init_flags(sertype, type_name.as_ptr(), &SERTYPE.0, &SERDATA.0, flags) };
    // SAFETY: the handle is checked by Cyclone, the name is copied; null means defaults, no listener and no
    // parameters. If it succeeds it has taken over the reference to the sertype.
    let handle = unsafe {
        dds_create_topic_sertype(
            participant.handle(),
            name.as_ptr(),
            &mut sertype,
            std::ptr::null(),
            std::ptr::null(),
            std::ptr::null(),
        )
    };
    if handle < 0 {
        // SAFETY: the reference is still ours.
        unsafe { ddsi_sertype_unref(sertype) };
    }
    Entity::new(handle)
}

/// Returns the number of messages sent without the identity or key hash that they should carry, because the linked
/// Cyclone differs from the expected one. Always 0 with the version in `Cargo.toml`.
pub fn unidentified_messages() -> u64 {
    UNIDENTIFIED.load(Ordering::Relaxed)
}

static UNIDENTIFIED: AtomicU64 = AtomicU64::new(0);

/// Discoveries of late readers in this process.
static DISCOVERIES: AtomicU64 = AtomicU64::new(0);

/// Counts a discovery. Samples that are made from here on know of it. Returns its number, from 1.
pub(crate) fn count_discovery() -> u64 {
    DISCOVERIES.fetch_add(1, Ordering::AcqRel) + 1
}

/// Returns how many discoveries were counted before a sample was made; `None` for a sample of another sertype.
///
/// # Safety
/// `sample` must be valid.
pub(crate) unsafe fn discoveries_before(sample: *const ddsi_serdata) -> Option<u64> {
    // SAFETY: by contract; a sample with this table is of the sertype made here.
    unsafe {
        let is_ours = std::ptr::eq((*sample).ops, &SERDATA.0);
        is_ours.then(|| (*sample.cast::<Content>()).discoveries)
    }
}

// A function of Cyclone that `cyclors` has no binding for. `ddsi_serdata.h`.
#[allow(improper_ctypes)]
unsafe extern "C" {
    fn ddsi_serdata_ref(sample: *const ddsi_serdata) -> *mut ddsi_serdata;
}

/// Position of the sequence number in either submessage, in bytes.
const NUMBER_OFFSET: usize = 16;

/// Length of the RTPS header, bytes (RTPS 2.5, 9.4.4).
const RTPS_HEADER_BYTES: usize = 20;

impl Content {
    /// Allocates an empty sample with room for a payload of `room` bytes.
    ///
    /// # Safety
    /// `sertype` must be of this module and outlive the sample.
    unsafe fn allocate(sertype: *const ddsi_sertype, room: usize) -> Option<*mut Self> {
        // Cyclone's own allocator zeroes memory, and aborts the process when memory is exhausted.
        // SAFETY: takes a size; the block is freed by `free`, with its counterpart.
        let sample = unsafe { cyclors::malloc((size_of::<Self>() + room) as c_ulong) }.cast::<Self>();
        if sample.is_null() {
            return None;
        }
        // SAFETY: the block has room for the struct, at an alignment for any type, and the payload follows it. All
        // zeros is a valid value of Cyclone's plain struct, which the call fills; the sertype is valid by contract.
        unsafe {
            sample.write(Self {
                common: std::mem::zeroed(),
                payload: sample.add(1).cast(),
                bytes: 0,
                shared: None,
                extra: Extra::default(),
                origin: None,
                discoveries: DISCOVERIES.load(Ordering::Acquire),
            });
            ddsi_serdata_init(&raw mut (*sample).common, sertype, ddsi_serdata_kind_SDK_DATA);
            (*sample).common.hash = 0;
        }
        Some(sample)
    }

    /// Appends to a payload that follows its sample.
    ///
    /// # Safety
    /// `sample` must be valid, not shared yet, and have been made with room for these bytes as well.
    unsafe fn push(sample: *mut Self, part: &[u8]) {
        // SAFETY: by contract.
        unsafe {
            let end = (*sample).payload.cast_mut().add((*sample).bytes);
            end.copy_from_nonoverlapping(part.as_ptr(), part.len());
            (*sample).bytes += part.len();
        }
    }

    fn payload(&self) -> &[u8] {
        // SAFETY: what follows the struct, or what `shared` keeps; so many bytes of it are written and never change.
        unsafe { std::slice::from_raw_parts(self.payload, self.bytes) }
    }
}

/// Reads the origin from the first fragment's message.
///
/// # Safety
/// `fragment` must be a fragment that Cyclone hands to a sertype: its message is valid, and both offsets are in it.
unsafe fn origin(fragment: &ReceivedFragment) -> Option<Origin> {
    let (submessage, payload) =
        (usize::from(fragment.submessage_offset), usize::from(fragment.payload_offset));
    if submessage < RTPS_HEADER_BYTES || payload < submessage + DATA.1 {
        return None;
    }
    // SAFETY: the packet follows the struct, and is at least as long as the offset of the payload in it.
    let packet = unsafe { std::slice::from_raw_parts(fragment.message.add(1).cast::<u8>(), payload) };
    let vendor = [packet[6], packet[7]];
    let head = packet[..4] == *b"RTPS";
    let submessage = &packet[submessage..];
    let (kind, flags) = (submessage[0], submessage[1]);
    if !head || !matches!(kind, 0x15 | 0x16) {
        return None;
    }
    // Cyclone has put the fixed part into the byte order of this machine. The inline QoS is as received.
    let number = submessage[NUMBER_OFFSET..].first_chunk::<8>()?;
    let (high, low) = (number.first_chunk::<4>()?, number.last_chunk::<4>()?);
    let number = i64::from(i32::from_ne_bytes(*high)) << 32 | i64::from(u32::from_ne_bytes(*low));
    let at = INLINE_QOS_BASE + usize::from(u16::from_ne_bytes([submessage[6], submessage[7]]));
    let inline_qos = submessage.get(at..).filter(|_| flags & FLAG_INLINE_QOS != 0);
    let big_endian = flags & FLAG_LITTLE_ENDIAN == 0;
    let related = inline_qos.and_then(|qos| SampleIdentity::related(qos, big_endian));
    let key_hash = inline_qos.and_then(|qos| key_hash(qos, big_endian));
    Some(Origin { vendor, number, related, key_hash, kept: None })
}

/// A table of functions that Cyclone reads from any thread.
struct Table<T>(T);

// SAFETY: the tables hold function pointers and null pointers, and are never written to.
unsafe impl<T> Sync for Table<T> {}

static SERTYPE: Table<ddsi_sertype_ops> = Table(ddsi_sertype_ops {
    version: Some(cyclors::ddsi_sertype_v0),
    arg: std::ptr::null_mut(),
    free: Some(sertype_free),
    zero_samples: None,
    realloc_samples: None,
    free_samples: None,
    equal: Some(sertype_equal),
    hash: Some(sertype_hash),
    type_id: None,
    type_map: None,
    type_info: None,
    derive_sertype: None,
    get_serialized_size: None,
    serialize_into: None,
});

static SERDATA: Table<ddsi_serdata_ops> = Table(ddsi_serdata_ops {
    eqkey: Some(eqkey),
    get_size: Some(size),
    from_ser: Some(from_ser),
    from_ser_iov: Some(from_ser_iov),
    from_keyhash: Some(from_keyhash),
    from_sample: None,
    to_ser: Some(to_ser),
    to_ser_ref: Some(to_ser_ref),
    to_ser_unref: Some(to_ser_unref),
    to_sample: None,
    to_untyped: Some(to_untyped),
    untyped_to_sample: None,
    free: Some(free),
    print: Some(print),
    get_keyhash: Some(get_keyhash),
    from_loaned_sample: None,
    from_psmx: None,
});

// Cyclone calls the functions below, from its own threads, with arguments that are valid as its headers say.

unsafe extern "C" fn sertype_free(sertype: *mut ddsi_sertype) {
    // SAFETY: the last reference to what `topic` made of a box.
    unsafe {
        ddsi_sertype_fini(sertype);
        drop(Box::from_raw(sertype));
    }
}

/// The type has no fields beyond those that Cyclone has compared already.
unsafe extern "C" fn sertype_equal(_: *const ddsi_sertype, _: *const ddsi_sertype) -> bool {
    true
}

unsafe extern "C" fn sertype_hash(_: *const ddsi_sertype) -> u32 {
    0
}

/// The type knows no keys: a writer spreads its samples over instances of its choice, and received samples are one
/// instance.
unsafe extern "C" fn eqkey(a: *const ddsi_serdata, b: *const ddsi_serdata) -> bool {
    // SAFETY: of this sertype.
    unsafe { (*a).hash == (*b).hash }
}

unsafe extern "C" fn size(sample: *const ddsi_serdata) -> u32 {
    // SAFETY: of this sertype. The length is at most `PAYLOAD_BYTES_MAX`.
    unsafe { (*sample.cast::<Content>()).bytes as u32 }
}

unsafe extern "C" fn from_ser(
    sertype: *const ddsi_sertype,
    kind: ddsi_serdata_kind,
    fragments: *const cyclors::ddsi_rdata,
    bytes: usize,
) -> *mut ddsi_serdata {
    // SAFETY: the fragments are those that Cyclone gave for this function.
    if bytes > PAYLOAD_BYTES_MAX || !unsafe { fragments::cover_exactly(fragments, bytes) } {
        return std::ptr::null_mut();
    }
    // SAFETY: the sertype is this one; the fragments are a chain that ends with null and covers exactly so many bytes,
    // and each one's message holds its bytes at the offset of its payload.
    unsafe {
        let Some(sample) = Content::allocate(sertype, bytes) else { return std::ptr::null_mut() };
        let mut at = fragments.cast::<ReceivedFragment>();
        while let Some(fragment) = at.as_ref() {
            let had = (*sample).bytes;
            if fragment.first == 0 && (*sample).origin.is_none() {
                (*sample).origin = origin(fragment);
            }
            let (first, end) = (fragment.first as usize, fragment.end as usize);
            // Fragments may overlap.
            if end > had {
                let start = fragment.message.add(1).cast::<u8>().add(usize::from(fragment.payload_offset));
                Content::push(sample, std::slice::from_raw_parts(start.add(had - first), end - had));
            }
            if let Some(origin) =
                (*sample).origin.as_mut().filter(|o| fragment.next.is_null() && o.vendor == FAST_DDS)
            {
                origin.kept = fragments::kept_by_writer(fragment);
            }
            at = fragment.next;
        }
        // To Cyclone the end of an instance is an ordinary sample, which keeps its order and its payload, the
        // serialised key.
        (*sample).extra.key_only = kind == ddsi_serdata_kind_SDK_KEY;
        sample.cast()
    }
}

unsafe extern "C" fn from_ser_iov(
    sertype: *const ddsi_sertype,
    kind: ddsi_serdata_kind,
    count: usize,
    pieces: *const ddsrt_iovec_t,
    bytes: usize,
) -> *mut ddsi_serdata {
    // SAFETY: an array of so many pieces, each valid for its length, and together as long as `bytes`, which is checked.
    unsafe {
        let pieces = if count == 0 { &[] } else { std::slice::from_raw_parts(pieces, count) };
        if pieces.iter().map(|piece| piece.iov_len).sum::<usize>() != bytes {
            return std::ptr::null_mut();
        }
        let Some(sample) = Content::allocate(sertype, bytes) else { return std::ptr::null_mut() };
        for piece in pieces.iter().filter(|piece| piece.iov_len > 0) {
            Content::push(sample, std::slice::from_raw_parts(piece.iov_base.cast::<u8>(), piece.iov_len));
        }
        (*sample).extra.key_only = kind == ddsi_serdata_kind_SDK_KEY;
        sample.cast()
    }
}

unsafe extern "C" fn from_keyhash(_: *const ddsi_sertype, _: *const ddsi_keyhash) -> *mut ddsi_serdata {
    std::ptr::null_mut()
}

unsafe extern "C" fn to_ser(sample: *const ddsi_serdata, offset: usize, bytes: usize, to: *mut c_void) {
    // SAFETY: of this sertype; Cyclone asks for what is in it, and has room for it.
    unsafe {
        let payload = (*sample.cast::<Content>()).payload();
        if let Some(part) = offset.checked_add(bytes).and_then(|end| payload.get(offset..end)) {
            to.cast::<u8>().copy_from_nonoverlapping(part.as_ptr(), bytes);
        }
    }
}

unsafe extern "C" fn to_ser_ref(
    sample: *const ddsi_serdata,
    offset: usize,
    bytes: usize,
    view: *mut ddsrt_iovec_t,
) -> *mut ddsi_serdata {
    // SAFETY: of this sertype; payloads that are written are whole multiples of four, so the part is in it. Only a
    // message under construction asks a sample with an identity for its payload.
    unsafe {
        let content = &*sample.cast::<Content>();
        // The first fragment carries the parameters, like Cyclone's own.
        if offset == 0 && !content.extra.add_to(view) {
            UNIDENTIFIED.fetch_add(1, Ordering::Relaxed);
        }
        let offset = offset.min(content.bytes);
        (*view).iov_base = content.payload.add(offset).cast_mut().cast();
        (*view).iov_len = bytes.min(content.bytes - offset);
        ddsi_serdata_ref(sample)
    }
}

unsafe extern "C" fn to_ser_unref(sample: *mut ddsi_serdata, _: *const ddsrt_iovec_t) {
    // SAFETY: gives back what `to_ser_ref` took.
    unsafe { ddsi_serdata_unref(sample) }
}

unsafe extern "C" fn to_untyped(sample: *const ddsi_serdata) -> *mut ddsi_serdata {
    // SAFETY: a sample of this sertype; the copy has no type, as Cyclone wants it.
    unsafe {
        let Some(copy) = Content::allocate((*sample).type_, 0) else { return std::ptr::null_mut() };
        let copy = copy.cast::<ddsi_serdata>();
        (*copy).kind = ddsi_serdata_kind_SDK_KEY;
        (*copy).type_ = std::ptr::null();
        (*copy).hash = (*sample).hash;
        (*copy).timestamp.v = i64::MIN;
        copy
    }
}

unsafe extern "C" fn free(sample: *mut ddsi_serdata) {
    // SAFETY: the last reference to what `allocate` made.
    unsafe {
        sample.cast::<Content>().drop_in_place();
        cyclors::free(sample.cast());
    }
}

/// Prints nothing of a sample. Cyclone calls it unconditionally once the user has the content of samples traced.
unsafe extern "C" fn print(
    _: *const ddsi_sertype,
    _: *const ddsi_serdata,
    text: *mut c_char,
    bytes: usize,
) -> usize {
    if bytes > 0 {
        // SAFETY: there is room for one.
        unsafe { text.write(0) };
    }
    0
}

unsafe extern "C" fn get_keyhash(sample: *const ddsi_serdata, hash: *mut ddsi_keyhash, _: bool) {
    // SAFETY: of this sertype, and room for a hash.
    unsafe {
        let known = (*sample.cast::<Content>()).extra.key_hash;
        hash.cast::<KeyHash>().write(known.unwrap_or_default());
    }
}
