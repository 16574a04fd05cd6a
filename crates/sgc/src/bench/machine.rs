//! What a machine is, without saying which: processor, cores, kernel; and what a process has used of it.

use std::fs;

use serde::{Deserialize, Serialize};

use crate::output;

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
    /// This one.
    pub(crate) fn here() -> Self {
        let info = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
        // ARM has no model name there.
        let cpu = info.lines().find_map(|line| line.strip_prefix("model name")?.split_once(':'));
        let cpu = cpu.map_or_else(|| std::env::consts::ARCH.to_owned(), |(_, name)| name.trim().to_owned());
        let name = rustix::system::uname();
        let kernel = [name.sysname(), name.release(), name.machine()];
        let kernel = kernel.map(|part| part.to_string_lossy().into_owned()).join(" ");
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        Self { cpu, cores, kernel }
    }

    /// What the other side says of itself, cut and without what a terminal would take for orders.
    pub(crate) fn cleaned(&self) -> Self {
        let clean = |text: &str| output::clean(&text.chars().take(TEXT_BYTES_MAX).collect::<String>());
        Self { cpu: clean(&self.cpu), cores: self.cores, kernel: clean(&self.kernel) }
    }
}

/// What a process has used of the processors so far, microseconds; `None` if it is gone.
pub(crate) fn cpu_us(process: u32) -> Option<u64> {
    let stat = fs::read_to_string(format!("/proc/{process}/stat")).ok()?;
    // The program's name is in parentheses and may hold anything (proc_pid_stat(5): utime and stime are 14 and 15).
    let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
    let ticks = |field: usize| fields.get(field - 3)?.parse::<u64>().ok();
    Some((ticks(14)? + ticks(15)?) * 1_000_000 / rustix::param::clock_ticks_per_second().max(1))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn this_machine_has_a_processor_and_this_process_has_used_it() {
        let machine = Machine::here();
        assert!(!machine.cpu.is_empty() && machine.cores > 0 && machine.kernel.starts_with("Linux "));
        // It ends once the kernel has counted one step more.
        let before = cpu_us(std::process::id()).unwrap();
        while cpu_us(std::process::id()).unwrap() <= before {
            std::hint::black_box((0..1000).sum::<u64>());
        }
        assert_eq!(cpu_us(u32::MAX), None);
    }

    #[test]
    fn what_another_machine_says_is_no_order_to_a_terminal() {
        let machine = Machine { cpu: "\x1b[2J".repeat(99), cores: 1, kernel: String::new() };
        let cleaned = machine.cleaned();
        assert!(!cleaned.cpu.contains('\x1b') && cleaned.cpu.chars().count() <= TEXT_BYTES_MAX);
    }
}
