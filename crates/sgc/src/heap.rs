//! How the C library's allocator divides memory between threads.
//!
//! glibc gives each thread that finds an arena taken a new one, up to eight for each core, and memory that is freed in one stays there.
//! A node has a thread for each topic and others for work that takes long, hardly more of them at work than there are cores: so
//! what one of them freed is room for another.
#![allow(unsafe_code)]

/// Has at most so many arenas as there are cores. To be called before there are threads.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
pub(crate) fn share_arenas() {
    let cores = std::thread::available_parallelism().map_or(1, |cores| cores.get());
    // SAFETY: sets a number of the allocator's. That it is refused means that there are more arenas.
    unsafe { libc::mallopt(libc::M_ARENA_MAX, i32::try_from(cores).unwrap_or(i32::MAX)) };
}

/// Other allocators have no arenas, or few.
#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
pub(crate) fn share_arenas() {}
