//! Memory of the process: the number of arenas in the C library's allocator, and the pages of the program.
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

/// Takes the pages of the program's code and constants out of the process's memory. Those that are used come back from
/// the file; those that only the start or a seldom event used do not.
///
/// The kernel maps the 64 KB around each page that is used once, and keeps them.
#[cfg(all(target_os = "linux", target_pointer_width = "64"))]
pub(crate) fn drop_program_pages() {
    // SAFETY: the callback and its data fit the declaration of the call.
    unsafe { libc::dl_iterate_phdr(Some(drop_unwritten_pages), std::ptr::null_mut()) };
}

/// Does nothing: only Linux on 64 bits was tried.
#[cfg(not(all(target_os = "linux", target_pointer_width = "64")))]
pub(crate) fn drop_program_pages() {}

/// Handles the first object, which is the program, and ends the iteration.
#[cfg(all(target_os = "linux", target_pointer_width = "64"))]
unsafe extern "C" fn drop_unwritten_pages(
    object: *mut libc::dl_phdr_info,
    _size: libc::size_t,
    _data: *mut libc::c_void,
) -> libc::c_int {
    // SAFETY: the caller passes a valid object, with so many headers.
    let (base, headers) = unsafe {
        let object = &*object;
        (object.dlpi_addr, std::slice::from_raw_parts(object.dlpi_phdr, object.dlpi_phnum.into()))
    };
    let page = rustix::param::page_size() as u64;
    for header in headers {
        // Pages of a segment that can be written may hold what the loader and the program wrote.
        if header.p_type != libc::PT_LOAD || header.p_flags & libc::PF_W != 0 {
            continue;
        }
        let begin = base.wrapping_add(header.p_vaddr) / page * page;
        let end = base.wrapping_add(header.p_vaddr).wrapping_add(header.p_memsz);
        let length = end.saturating_sub(begin).next_multiple_of(page);
        // SAFETY: the range is one mapping of the program's file that the program never writes, so that each page is read
        // from the file again when it is needed. A debugger or a uprobe may have written breakpoints, which are lost. A
        // failure leaves the pages where they are.
        unsafe { libc::madvise(begin as *mut libc::c_void, length as usize, libc::MADV_DONTNEED) };
    }
    1
}

#[cfg(all(test, target_os = "linux", target_pointer_width = "64"))]
mod tests {
    use super::*;

    /// Returns the mapped pages of files, those in memory alone included, KiB.
    fn mapped() -> u64 {
        let status = std::fs::read_to_string("/proc/self/status").expect("Linux has it");
        let is_meant = |line: &&str| line.starts_with("RssFile:") || line.starts_with("RssShmem:");
        let number =
            |line: &str| line.split_whitespace().nth(1).and_then(|number| number.parse::<u64>().ok());
        status.lines().filter(is_meant).filter_map(number).sum()
    }

    #[test]
    fn pages_of_the_program_go_and_come_back() {
        let before = mapped();
        drop_program_pages();
        let after = mapped();
        assert!(after < before, "{before} KiB, then {after} KiB");
        // Code, constants, and data that the loader relocated are as they were.
        let help = crate::command_line().render_long_help().to_string();
        assert!(help.contains("sgc demo") && help.contains("Usage: sgc"), "{help}");
    }
}
