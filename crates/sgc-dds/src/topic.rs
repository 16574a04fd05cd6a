//! Topics of raw samples: the type of samples of `cyclors`, which reads received samples in another way.
//!
//! - Samples whose fragments do not fill exactly the announced length are refused ([`fragments`](crate::fragments)):
//!   `cyclors` copies fragments without comparing them with the memory that it took.
//! - Content can be traced, of which `cyclors` would let Cyclone call a null pointer.
//! - In topics with keys a disposal keeps its payload. Cyclone keeps none for a sample that has a key only, since it finds
//!   the instance by it. The types here know no keys: to them a topic is one instance, in which the end of an instance is
//!   a sample like any other. So it keeps its place among them and its payload, the serialised key.

use std::ffi::c_char;
use std::sync::OnceLock;

use cyclors::{
    DDSI_SERTYPE_FLAG_TOPICKIND_NO_KEY, cdds_create_blob_topic, dds_alloc, dds_create_topic_sertype,
    dds_free, dds_get_entity_sertype, ddsi_rdata, ddsi_serdata, ddsi_serdata_kind,
    ddsi_serdata_kind_SDK_DATA, ddsi_serdata_kind_SDK_KEY, ddsi_serdata_ops, ddsi_sertype, ddsi_sertype_fini,
    ddsi_sertype_init_flags, ddsi_sertype_ops,
};

use sgc_ros::EndpointSpec;

use crate::entity::{Entity, c_string, check};
use crate::fragments;
use crate::network::Participant;

/// What marks a received sample as one of a key alone: Cyclone dates samples in this field when it sends them, and leaves
/// it at its least value in those that it receives.
const KEY_ONLY_MARK: i64 = 0x5347_4b45;

/// How samples are handled, for the life of the process.
struct Ops {
    sertype: *const ddsi_sertype_ops,
    keyless: ddsi_serdata_ops,
    keyed: ddsi_serdata_ops,
    /// As `cyclors` has it; never `None`.
    from_ser: unsafe extern "C" fn(
        *const ddsi_sertype,
        ddsi_serdata_kind,
        *const ddsi_rdata,
        usize,
    ) -> *mut ddsi_serdata,
}

// SAFETY: functions and tables of constants, which nobody writes to after they were made.
unsafe impl Send for Ops {}
// SAFETY: as above.
unsafe impl Sync for Ops {}

static OPS: OnceLock<Ops> = OnceLock::new();

/// Makes the topic of a spec.
pub(crate) fn topic(participant: &Participant, spec: &EndpointSpec) -> Result<Entity, String> {
    let (name, type_name) = (c_string(&spec.topic)?, c_string(&spec.type_name)?);
    let ops = ops(participant)?;
    let (serdata, flags) = match spec.keyless {
        true => (&ops.keyless, DDSI_SERTYPE_FLAG_TOPICKIND_NO_KEY),
        false => (&ops.keyed, 0),
    };
    // SAFETY: takes a size. The type is freed with C's `free`, which is the counterpart.
    let sertype = unsafe { dds_alloc(size_of::<ddsi_sertype>()) }.cast::<ddsi_sertype>();
    if sertype.is_null() {
        return Err("out of memory".into());
    }
    // SAFETY: memory for a type, which the call fills; the tables live as long as the process, the name is copied.
    unsafe { ddsi_sertype_init_flags(sertype, type_name.as_ptr(), ops.sertype, serdata, flags) };
    let mut taken = sertype;
    // SAFETY: the name is copied; on success the type belongs to Cyclone, which may have put another, equal one in `taken`.
    let handle = unsafe {
        dds_create_topic_sertype(
            participant.entity().handle(),
            name.as_ptr(),
            &mut taken,
            std::ptr::null(),
            std::ptr::null(),
            std::ptr::null(),
        )
    };
    Entity::new(handle).inspect_err(|_| {
        // SAFETY: Cyclone did not take the type, so it is still ours, and is given back once.
        unsafe {
            ddsi_sertype_fini(sertype);
            dds_free(sertype.cast());
        }
    })
}

/// True if a received sample holds a key alone.
///
/// # Safety
/// `sample` must be a valid sample.
pub(crate) unsafe fn is_key_only(sample: *const ddsi_serdata) -> bool {
    // SAFETY: valid by contract.
    unsafe { (*sample).twrite.v == KEY_ONLY_MARK }
}

fn ops(participant: &Participant) -> Result<&'static Ops, String> {
    if let Some(ops) = OPS.get() {
        return Ok(ops);
    }
    let (name, type_name) = (c_string("sgc_no_topic")?, c_string("sgc::NoType")?);
    // SAFETY: both strings are copied and, despite their type, not written to.
    let model = Entity::new(unsafe {
        cdds_create_blob_topic(
            participant.entity().handle(),
            name.as_ptr().cast_mut(),
            type_name.as_ptr().cast_mut(),
            false,
        )
    })?;
    let mut sertype = std::ptr::null();
    // SAFETY: the handle is checked by Cyclone, and `sertype` is a valid place for the result.
    check(unsafe { dds_get_entity_sertype(model.handle(), &mut sertype) })?;
    // SAFETY: the type of the topic, which keeps it alive; both tables are constants of `cyclors`.
    let (sertype, serdata) = unsafe { ((*sertype).ops, *(*sertype).serdata_ops) };
    let from_ser = serdata.from_ser.ok_or("this build of Cyclone cannot read samples")?;
    let keyless = ddsi_serdata_ops { from_ser: Some(received), print: Some(print), ..serdata };
    let keyed = ddsi_serdata_ops { from_ser: Some(received_keyed), ..keyless };
    Ok(OPS.get_or_init(|| Ops { sertype, keyless, keyed, from_ser }))
}

/// Makes a sample of received fragments, or refuses them.
///
/// # Safety
/// Called by Cyclone, with what it asks of `from_ser`.
unsafe extern "C" fn received(
    sertype: *const ddsi_sertype,
    kind: ddsi_serdata_kind,
    fragments: *const ddsi_rdata,
    size: usize,
) -> *mut ddsi_serdata {
    // It is in the table that it is called from; without it, as if there were no memory.
    let Some(ops) = OPS.get() else { return std::ptr::null_mut() };
    // SAFETY: the fragments are those that Cyclone gave for this function.
    if !unsafe { fragments::cover_exactly(fragments, size) } {
        return std::ptr::null_mut();
    }
    // SAFETY: the arguments are those that Cyclone gave for this function.
    unsafe { (ops.from_ser)(sertype, kind, fragments, size) }
}

/// As [`received`], but a key alone becomes data with a mark.
///
/// # Safety
/// As there.
unsafe extern "C" fn received_keyed(
    sertype: *const ddsi_sertype,
    kind: ddsi_serdata_kind,
    fragments: *const ddsi_rdata,
    size: usize,
) -> *mut ddsi_serdata {
    // SAFETY: the arguments are those that Cyclone gave for this function.
    let sample = unsafe { received(sertype, ddsi_serdata_kind_SDK_DATA, fragments, size) };
    if kind == ddsi_serdata_kind_SDK_KEY && !sample.is_null() {
        // SAFETY: a valid sample that nobody else has yet.
        unsafe { (*sample).twrite.v = KEY_ONLY_MARK };
    }
    sample
}

/// Shows nothing of a sample. Cyclone calls it without a look whether it is there, once a user has the content of samples
/// written to its trace.
///
/// # Safety
/// Called by Cyclone, with a buffer of so many bytes.
pub(crate) unsafe extern "C" fn print(
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
