//! Limits the number of arenas in the C library's allocator.
//!
//! glibc gives a thread that finds all arenas busy a new one, up to eight per core, and memory freed in one arena stays
//! there. A node has threads for all work that blocks, but hardly more of them run at a time than there are cores. With
//! one arena per core, threads reuse the memory that others freed.
#![allow(unsafe_code)]

/// Limits the arenas to the number of cores. Must be called before other threads exist.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
pub(crate) fn share_arenas() {
    let cores = std::thread::available_parallelism().map_or(1, |cores| cores.get());
    // SAFETY: the call only sets a parameter of the allocator. If it fails, there are more arenas, which is harmless.
    unsafe { libc::mallopt(libc::M_ARENA_MAX, i32::try_from(cores).unwrap_or(i32::MAX)) };
}

/// Does nothing: other allocators have no arenas, or few.
#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
pub(crate) fn share_arenas() {}
