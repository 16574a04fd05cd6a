//! Describes a machine anonymously by processor, cores and kernel, and measures the processor time of a process.

use std::fs;

use serde::{Deserialize, Serialize};

use sgc_process::output;

/// Longest description that is taken from the other side, bytes.
const TEXT_BYTES_MAX: usize = 200;

/// A machine, as a report tells of it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Machine {
    /// Model of the processor.
    pub(crate) cpu: String,
    /// How many of them this process may use.
    pub(crate) cores: usize,
    /// Kernel and architecture.
    pub(crate) kernel: String,
}

impl Machine {
    /// Describes this machine.
    pub(crate) fn here() -> Self {
        let info = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
        // On ARM, /proc/cpuinfo has no model name.
        let cpu = info.lines().find_map(|line| line.strip_prefix("model name")?.split_once(':'));
        let cpu = cpu.map_or_else(|| std::env::consts::ARCH.to_owned(), |(_, name)| name.trim().to_owned());
        let name = rustix::system::uname();
        let kernel = [name.sysname(), name.release(), name.machine()];
        let kernel = kernel.map(|part| part.to_string_lossy().into_owned()).join(" ");
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        Self { cpu, cores, kernel }
    }

    /// Returns the other side's description, shortened and without control characters.
    pub(crate) fn cleaned(&self) -> Self {
        let clean = |text: &str| output::clean(&text.chars().take(TEXT_BYTES_MAX).collect::<String>());
        Self { cpu: clean(&self.cpu), cores: self.cores, kernel: clean(&self.kernel) }
    }
}

/// Returns the processor time that a process has used so far, in microseconds, or `None` if it is gone.
pub(crate) fn cpu_us(process: u32) -> Option<u64> {
    let stat = fs::read_to_string(format!("/proc/{process}/stat")).ok()?;
    // The program's name is in parentheses and may hold anything (proc_pid_stat(5): utime and stime are fields 14 and
    // 15).
    let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
    let ticks = |field: usize| fields.get(field - 3)?.parse::<u64>().ok();
    Some((ticks(14)? + ticks(15)?) * 1_000_000 / rustix::param::clock_ticks_per_second().max(1))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn machine_has_processor_and_process_has_used_it() {
        let machine = Machine::here();
        assert!(!machine.cpu.is_empty() && machine.cores > 0 && machine.kernel.starts_with("Linux "));
        // The loop ends once the kernel has counted one more tick.
        let before = cpu_us(std::process::id()).unwrap();
        while cpu_us(std::process::id()).unwrap() <= before {
            std::hint::black_box((0..1000).sum::<u64>());
        }
        assert_eq!(cpu_us(u32::MAX), None);
    }

    #[test]
    fn description_of_other_machine_cannot_steer_terminal() {
        let machine = Machine { cpu: "\x1b[2J".repeat(99), cores: 1, kernel: String::new() };
        let cleaned = machine.cleaned();
        assert!(!cleaned.cpu.contains('\x1b') && cleaned.cpu.chars().count() <= TEXT_BYTES_MAX);
    }
}
