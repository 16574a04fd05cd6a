//! Counts the instructions of the hot functions under `valgrind --tool=callgrind`, and checks whether they grew.
//!
//! Each case of `cases.rs` runs in a process of its own under callgrind, which counts inside of [`counted`] alone;
//! `profile.rs` reads the output and separates Rust code, AWS-LC and the C library; `baseline.rs` compares with the
//! committed `bench/instructions.json`. No case measures time or needs a network.

mod baseline;
mod cases;
mod profile;
// Frames of owners and subscribers, and the machine that takes them, are shared with the benchmark of routing.
#[allow(dead_code)]
#[path = "../../src/fleet.rs"]
mod fleet;
#[allow(dead_code)]
#[path = "../../src/rib/frames.rs"]
mod frames;
#[allow(dead_code)]
#[path = "../../src/rib/machine.rs"]
mod machine;

use std::hint::black_box;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode, Stdio};

use anyhow::{Context as _, Result, bail, ensure};
use clap::Parser;

use self::baseline::{Baseline, Counts, Tools};
use self::cases::CASES;
use self::profile::Profile;

/// Count the instructions of the hot functions, and compare them with bench/instructions.json.
#[derive(Debug, Parser)]
struct Args {
    /// Write the counts as the new baseline
    #[arg(long)]
    accept: bool,
    /// Run only cases whose names contain this text
    #[arg(value_name = "PART")]
    only: Option<String>,
    /// Run this case, in this process
    #[arg(long, hide = true, value_name = "NAME")]
    case: Option<String>,
    /// The flag that cargo passes to every benchmark
    #[arg(long, hide = true)]
    bench: bool,
}

/// Returns exit code 0 if no count grew, 1 if one did or could not be counted, 2 for wrong arguments.
pub fn main() -> ExitCode {
    match run(&Args::parse()) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(error) => {
            let _ = writeln!(std::io::stderr(), "{error:#}");
            ExitCode::FAILURE
        }
    }
}

fn run(args: &Args) -> Result<bool> {
    if let Some(name) = &args.case {
        let case = CASES.iter().find(|case| case.name == name).context("no such case")?;
        let mut counter = Counter { times: None };
        (case.run)(&mut counter).with_context(|| case.name)?;
        let times = counter.times.with_context(|| format!("{}: it counted nothing", case.name))?;
        say(&serde_json::to_string(&(times, features()))?)?;
        return Ok(true);
    }
    let is_meant = |name: &str| args.only.as_ref().is_none_or(|part| name.contains(part.as_str()));
    let cases: Vec<_> = CASES.iter().filter(|case| is_meant(case.name)).collect();
    ensure!(!cases.is_empty(), "no case has that in its name: {}", names().join(", "));
    let valgrind = valgrind_version()?;
    let (mut counts, mut seen) = (Counts::new(), String::new());
    for case in cases {
        let (count, features) = count(case.name).with_context(|| case.name)?;
        counts.insert(case.name.to_owned(), count);
        seen = features;
    }
    let tools = Tools { rustc: env!("BENCH_RUSTC").to_owned(), valgrind, cpu: seen };
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../instructions.json");
    let mut baseline = Baseline::read(&file)?;
    if args.accept {
        baseline.accept(tools, counts, args.only.is_none());
        baseline.write(&file)?;
        say(&format!("written to {}; commit it", file.display()))?;
        return Ok(true);
    }
    let verdict = baseline.compare(&tools, &counts, args.only.is_none());
    say(&verdict.table)?;
    Ok(verdict.is_good)
}

fn say(text: &str) -> Result<()> {
    writeln!(std::io::stdout(), "{text}").context("cannot write to standard output")
}

fn names() -> Vec<&'static str> {
    CASES.iter().map(|case| case.name).collect()
}

/// The counter of a case.
struct Counter {
    /// Number of repetitions of the counted work.
    times: Option<u64>,
}

impl Counter {
    /// Counts `work`, which repeats its work `times` times. May be called once; earlier work is not counted.
    fn count(&mut self, times: u64, mut work: impl FnMut()) {
        assert!(self.times.replace(times).is_none(), "a case counts once");
        counted(&mut work);
    }
}

/// The function in which callgrind counts.
#[inline(never)]
fn counted(work: &mut dyn FnMut()) {
    work();
    // Keeps the call above from becoming a tail jump, which would not return here.
    black_box(());
}
/// [`counted`] in callgrind's spelling.
const COUNTED: &str = "*sgc_bench_instructions::counted*";

/// Counts a case. Returns the instructions of one repetition and the processor that the case saw.
fn count(case: &str) -> Result<(profile::Parts, String)> {
    let dir = tempfile::tempdir()?;
    let out: PathBuf = dir.path().join("callgrind.out");
    let output = Command::new("valgrind")
        .args(["--tool=callgrind", "--collect-atstart=no", "--error-exitcode=99"])
        .arg(format!("--toggle-collect={COUNTED}"))
        .arg(format!("--callgrind-out-file={}", out.display()))
        .arg(std::env::current_exe()?)
        .args(["--case", case])
        .env_clear()
        .stdin(Stdio::null())
        .output()
        .context("cannot start valgrind")?;
    if !output.status.success() {
        bail!("{}: {}", output.status, String::from_utf8_lossy(&output.stderr));
    }
    let (times, features): (u64, String) =
        serde_json::from_slice(&output.stdout).context("it did not say how often it was done")?;
    let text = std::fs::read_to_string(&out).context("callgrind wrote nothing")?;
    let profile = Profile::parse(&text)?;
    ensure!(profile.sum() > 0, "nothing was counted: is the program stripped?");
    Ok((profile.parts(times), features))
}

fn valgrind_version() -> Result<String> {
    let output = Command::new("valgrind").arg("--version").output();
    let output = output.context("valgrind is missing: scripts/install-deps.sh bench")?;
    Ok(String::from_utf8_lossy(&output.stdout).trim().to_owned())
}

/// Returns the architecture and the features by which libraries choose their code, as this process sees them:
/// valgrind's processor differs from the machine's.
fn features() -> String {
    let mut seen = vec![std::env::consts::ARCH];
    #[cfg(target_arch = "x86_64")]
    seen.extend(
        [
            ("aes", std::is_x86_feature_detected!("aes")),
            ("avx", std::is_x86_feature_detected!("avx")),
            ("avx2", std::is_x86_feature_detected!("avx2")),
            ("bmi2", std::is_x86_feature_detected!("bmi2")),
            ("pclmulqdq", std::is_x86_feature_detected!("pclmulqdq")),
            ("sha", std::is_x86_feature_detected!("sha")),
            ("avx512f", std::is_x86_feature_detected!("avx512f")),
        ]
        .iter()
        .filter_map(|(name, is_there)| is_there.then_some(*name)),
    );
    seen.join(" ")
}
