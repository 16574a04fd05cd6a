//! The output: tables for people, JSON for programs, and the description of the machine.

use std::fs;
use std::path::Path;

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};

/// The figures of one part.
#[derive(Serialize)]
pub(crate) struct Report {
    machine: Machine,
    figures: serde_json::Value,
    #[serde(skip)]
    tables: Vec<Table>,
}

/// A table, and the sentence above it.
pub(crate) struct Table {
    pub(crate) title: String,
    pub(crate) columns: Vec<&'static str>,
    pub(crate) rows: Vec<Vec<String>>,
}

/// The machine, with enough detail for comparison and nothing that identifies it.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct Machine {
    cpu: String,
    cores: usize,
    /// Instructions for ciphers and hashes that this CPU has.
    #[serde(default)]
    instructions: Vec<String>,
    /// The machine is virtual.
    #[serde(default)]
    is_virtual: bool,
    memory_gib: u64,
    kernel: String,
    #[serde(default)]
    system: String,
    /// Load average of the last minute, the benchmark's own processes included.
    load: f64,
}

impl Report {
    pub(crate) fn new(figures: &impl Serialize, tables: Vec<Table>) -> Result<Self> {
        Ok(Self { machine: Machine::here(), figures: serde_json::to_value(figures)?, tables })
    }

    /// Prints the tables.
    pub(crate) fn print(&self) {
        print!("{}", self.markdown());
    }

    /// The machine and the tables.
    pub(crate) fn markdown(&self) -> String {
        let mut text = format!("Machine: {}\n\n", self.machine.sentence());
        for table in &self.tables {
            text += &format!("{}\n\n", table.title);
            text += &format!("| {} |\n", table.columns.join(" | "));
            text += &format!("|{}\n", "---|".repeat(table.columns.len()));
            for row in &table.rows {
                text += &format!("| {} |\n", row.join(" | "));
            }
            text += "\n";
        }
        text
    }

    /// Writes `NAME.json`.
    pub(crate) fn write(&self, dir: &Path, name: &str) -> Result<()> {
        let path = dir.join(format!("{name}.json"));
        fs::create_dir_all(dir).with_context(|| dir.display().to_string())?;
        let text = serde_json::to_string_pretty(self)? + "\n";
        fs::write(&path, text).with_context(|| path.display().to_string())
    }
}

/// Flags of `/proc/cpuinfo` that decide the speed of ciphers and hashes.
const INSTRUCTIONS: [&str; 7] = ["aes", "vaes", "pclmulqdq", "sha_ni", "avx2", "avx512f", "sha2"];

impl Machine {
    /// Describes this machine.
    pub(crate) fn here() -> Self {
        let read = |path| fs::read_to_string(path).unwrap_or_default();
        let cpu = read("/proc/cpuinfo");
        let line = |name: &str| {
            let line = cpu.lines().find_map(|l| l.strip_prefix(name));
            line.unwrap_or_default().trim_start_matches(['\t', ' ', ':'])
        };
        let flags: Vec<_> = line("flags").split(' ').chain(line("Features").split(' ')).collect();
        let load = read("/proc/loadavg");
        let os = read("/etc/os-release");
        let system = os.lines().find_map(|l| l.strip_prefix("PRETTY_NAME=")).unwrap_or_default();
        Self {
            cpu: line("model name").to_owned(),
            cores: std::thread::available_parallelism().map_or(0, usize::from),
            instructions: INSTRUCTIONS
                .into_iter()
                .filter(|name| flags.contains(name))
                .map(str::to_owned)
                .collect(),
            is_virtual: flags.contains(&"hypervisor"),
            memory_gib: crate::process::memory_kib("MemTotal") / (1 << 20),
            kernel: read("/proc/sys/kernel/osrelease").trim().to_owned(),
            system: system.trim_matches('"').to_owned(),
            load: load.split(' ').next().and_then(|l| l.parse().ok()).unwrap_or(0.0),
        }
    }

    /// Formats the description in a line.
    pub(crate) fn sentence(&self) -> String {
        let Self { cpu, cores, instructions, is_virtual, memory_gib, kernel, system, load } = self;
        let cpu = if cpu.is_empty() { "a CPU without a name" } else { cpu };
        let instructions =
            if instructions.is_empty() { String::new() } else { format!(" ({})", instructions.join(", ")) };
        let place = if *is_virtual { ", virtual" } else { "" };
        let system = if system.is_empty() { String::new() } else { format!(", {system}") };
        format!(
            "{cpu}{instructions}, {cores} cores{place}, {memory_gib} GiB, Linux {kernel}{system}, load {load}"
        )
    }
}

/// Median and tail of a sample, in its unit.
#[derive(Clone, Copy, Debug, Default, Deserialize, Serialize)]
pub(crate) struct Spread {
    pub(crate) mean: f64,
    pub(crate) p50: f64,
    pub(crate) p99: f64,
    pub(crate) max: f64,
}

impl Spread {
    pub(crate) fn from_samples(mut sample: Vec<f64>) -> Self {
        if sample.is_empty() {
            return Self::default();
        }
        sample.sort_unstable_by(f64::total_cmp);
        let at = |part: f64| sample[((sample.len() - 1) as f64 * part) as usize];
        Self {
            mean: sample.iter().sum::<f64>() / sample.len() as f64,
            p50: at(0.5),
            p99: at(0.99),
            max: at(1.0),
        }
    }
}

/// Returns the median of a few figures.
pub(crate) fn median(figures: impl IntoIterator<Item = f64>) -> f64 {
    Spread::from_samples(figures.into_iter().collect()).p50
}

/// Formats a figure with about three digits, which is its precision.
pub(crate) fn digits(figure: f64) -> String {
    match figure.abs() {
        f if f >= 100.0 => format!("{figure:.0}"),
        f if f >= 10.0 => format!("{figure:.1}"),
        _ => format!("{figure:.2}"),
    }
}

/// Formats a figure in thousands.
pub(crate) fn thousands(figure: f64) -> String {
    format!("{} k", digits(figure / 1000.0))
}
