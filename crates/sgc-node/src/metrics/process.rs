//! Metrics of the process, under the names that client libraries of Prometheus give them.

use std::fs;
use std::time::Duration;

use rustix::process::{Resource, getrlimit};
use rustix::time::{ClockId, clock_gettime};

/// The process at one moment. A value that the system does not tell is `None`.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Process {
    /// Time on processors.
    pub(super) cpu: Duration,
    pub(super) resident_bytes: Option<u64>,
    pub(super) threads: Option<u64>,
    pub(super) open_fds: Option<u64>,
    /// `None` also if there is no limit.
    pub(super) max_fds: Option<u64>,
}

impl Process {
    /// Reads the values of this process.
    pub(super) fn read() -> Self {
        let cpu = clock_gettime(ClockId::ProcessCPUTime);
        let cpu = Duration::new(
            u64::try_from(cpu.tv_sec).unwrap_or_default(),
            u32::try_from(cpu.tv_nsec).unwrap_or_default(),
        );
        let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
        // The entry by which the directory is read is among them.
        let open_fds = fs::read_dir("/proc/self/fd").ok().map(|fds| (fds.count() as u64).saturating_sub(1));
        Self {
            cpu,
            resident_bytes: number_of(&status, "VmRSS:").map(|kib| kib << 10),
            threads: number_of(&status, "Threads:"),
            open_fds,
            max_fds: getrlimit(Resource::Nofile).current,
        }
    }
}

/// Returns the number behind `key` in `/proc/PID/status` (`proc_pid_status(5)`).
fn number_of(status: &str, key: &str) -> Option<u64> {
    status.lines().find_map(|line| line.strip_prefix(key))?.split_whitespace().next()?.parse().ok()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    #[test]
    fn values_of_this_process_are_read() {
        let Process { cpu, resident_bytes, threads, open_fds, .. } = Process::read();
        assert!(!cpu.is_zero() && threads.unwrap() >= 1 && open_fds.unwrap() >= 3);
        assert!(resident_bytes.unwrap() > 1 << 20);
    }
}
