//! The domain number that the plugins of DDS Security see.
//!
//! A second network of this process on a ROS domain has a Cyclone domain with another number ([`crate::domain`]),
//! and announces the ROS domain's number on the wire. Cyclone would pass its own number to the plugins, which no
//! governance and no permissions contain. This module makes Cyclone pass the ROS domain's number. Cyclone finds
//! domains by a copy of the number, which stays, and otherwise uses this field only for its log.
//!
//! This needs two neighbouring fields of `struct ddsi_config` (`ddsi_config.h`) of the Cyclone that `cyclors` =0.4.0
//! builds (`CYCLORS` in `sample.rs`). They are recognised by the values that this process has just written into the
//! configuration.

use std::ffi::c_void;
use std::sync::atomic::{AtomicU32, Ordering};

use cyclors::{dds_entity_t, dds_return_t};

use crate::entity::{Entity, check};

/// Bytes of `struct dds_domain` that are searched. The fields are some 900 bytes from its beginning, and it has some
/// 6000.
const LOOKED_AT_BYTES: usize = 2048;

// `dds__entity.h`.
unsafe extern "C" {
    fn dds_entity_pin(handle: dds_entity_t, entity: *mut *mut c_void) -> dds_return_t;
    fn dds_entity_unpin(entity: *mut c_void);
}

/// `domainId` and `extDomainId` of `struct ddsi_config`.
#[repr(C)]
struct Numbers {
    own: AtomicU32,
    is_default: i32,
    announced: u32,
}

/// Makes the plugins see the ROS domain in a new domain without participants.
///
/// # Errors
/// Cyclone differs from the one that this module knows.
pub(crate) fn install(domain: &Entity, own: u32, ros: u32) -> Result<(), String> {
    let mut entity = std::ptr::null_mut();
    // SAFETY: the handle is checked by Cyclone, and `entity` is a valid place for the result.
    check(unsafe { dds_entity_pin(domain.handle(), &mut entity) })?;
    // SAFETY: the entity of a domain is the beginning of its `struct dds_domain`, which lives as long as it is pinned.
    let result = unsafe { replace(entity.cast_const(), domain.handle(), own, ros) };
    // SAFETY: pinned above, once.
    unsafe { dds_entity_unpin(entity) };
    result
}

/// Replaces the domain's own number where it stands before the announced one.
///
/// # Safety
/// `domain` must be a `struct dds_domain` that no thread configures.
unsafe fn replace(domain: *const c_void, handle: dds_entity_t, own: u32, ros: u32) -> Result<(), String> {
    // SAFETY: it begins with the handle.
    if unsafe { *domain.cast::<dds_entity_t>() } != handle {
        return Err("a domain does not begin with its handle".into());
    }
    let places = (0..LOOKED_AT_BYTES - size_of::<Numbers>()).step_by(align_of::<Numbers>());
    let mut found = places.filter(|offset| {
        // SAFETY: inside of the struct, and aligned.
        let numbers = unsafe { &*domain.byte_add(*offset).cast::<Numbers>() };
        (numbers.own.load(Ordering::Relaxed), numbers.is_default, numbers.announced) == (own, 0, ros)
    });
    let (Some(offset), None) = (found.next(), found.next()) else {
        return Err("a domain does not hold its numbers".into());
    };
    // SAFETY: as above.
    unsafe { &*domain.byte_add(offset).cast::<Numbers>() }.own.store(ros, Ordering::Relaxed);
    Ok(())
}
