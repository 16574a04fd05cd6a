//! Tests of `sgc bench` between two sides on the loopback interface: measurements, refusals, and the end with its cause
//! when the other side ends. They check that all figures are there and nothing was lost, and compare no figures.

#![allow(clippy::unwrap_used)]

mod support;

use std::fs;
use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Output, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use sgc_testkit::netsim::Namespace;
use tempfile::TempDir;

/// Longest wait for an event, far beyond what any takes.
const PATIENCE: Duration = Duration::from_secs(90);
static LABS: AtomicU32 = AtomicU32::new(0);

/// Identities of two fleets, and a private network where namespaces can be made.
struct Lab {
    dir: TempDir,
    namespace: Option<Namespace>,
}

impl Lab {
    fn new() -> Self {
        let name = format!("sgcb-{}-{}", std::process::id(), LABS.fetch_add(1, Ordering::Relaxed));
        let namespace = support::own_network(name);
        let lab = Self { dir: tempfile::tempdir().unwrap(), namespace };
        fs::create_dir(lab.tmp()).unwrap();
        for args in [
            &["fleet", "create", "lab"][..],
            &["fleet", "create", "other"],
            &["fleet", "enroll", "desk", "--fleet", "lab.fleet"],
            &["fleet", "enroll", "robot", "--fleet", "lab.fleet"],
            &["fleet", "enroll", "cloud", "--role", "router", "--fleet", "lab.fleet"],
            &["fleet", "enroll", "stranger", "--fleet", "other.fleet"],
        ] {
            let output = lab.sgc(args).output().unwrap();
            assert!(output.status.success(), "{output:?}");
        }
        lab
    }

    /// Returns the directory for temporary files of both sides.
    fn tmp(&self) -> std::path::PathBuf {
        self.dir.path().join("tmp")
    }

    fn sgc(&self, args: &[&str]) -> Command {
        let mut command = support::sgc(self.namespace.as_ref(), self.dir.path());
        command.args(args).env("TMPDIR", self.tmp()).env("ROS_DOMAIN_ID", "3");
        command
    }

    fn answer(&self, args: &[&str]) -> Side {
        Side::start(self.sgc(&[&["bench", "answer", "--identity", "desk.identity"][..], args].concat()))
    }

    /// Runs `sgc bench run` to its end.
    fn run(&self, identity: &str, args: &[&str]) -> Output {
        let args = [&["bench", "run", "--identity", identity][..], args].concat();
        let child = self.sgc(&args).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        end_of(child)
    }
}

/// Returns the output of a process, which must end within [`PATIENCE`].
fn end_of(child: Child) -> Output {
    let pid = Pid::from_child(&child);
    let (sender, ended) = channel();
    std::thread::spawn(move || sender.send(child.wait_with_output()));
    match ended.recv_timeout(PATIENCE) {
        Ok(output) => output.unwrap(),
        Err(error) => {
            let _ = kill_process(pid, Signal::KILL);
            panic!("it does not end: {error}");
        }
    }
}

/// A process whose standard output is read line by line.
struct Side {
    child: Child,
    lines: Receiver<String>,
}

impl Side {
    fn start(mut command: Command) -> Self {
        let mut child = command.stdout(Stdio::piped()).spawn().unwrap();
        let out = BufReader::new(child.stdout.take().unwrap());
        let (sender, lines) = channel();
        std::thread::spawn(move || {
            for line in out.lines().map_while(Result::ok) {
                let _ = sender.send(line);
            }
        });
        Self { child, lines }
    }

    /// Returns the rest of the next line with this beginning.
    fn said(&self, begins: &str) -> String {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let line = self.lines.recv_timeout(deadline.saturating_duration_since(Instant::now()));
            if let Some(rest) = line.unwrap_or_else(|e| panic!("{begins}: {e}")).strip_prefix(begins) {
                return rest.to_owned();
            }
        }
    }

    fn end(mut self, signal: Signal) -> Option<i32> {
        kill_process(Pid::from_child(&self.child), signal).unwrap();
        let deadline = Instant::now() + PATIENCE;
        while Instant::now() < deadline {
            if let Some(status) = self.child.try_wait().unwrap() {
                return status.code();
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        panic!("it does not end");
    }
}

impl Drop for Side {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// Checks that each channel was measured at each size and lost nothing.
fn check(report: &Value, sealed: &[&str], others: &[&str], sizes: &[u64]) {
    let trips = report["trips"].as_array().unwrap();
    for way in sealed.iter().chain(others) {
        for size in sizes {
            let row = trips.iter().find(|row| row["way"] == **way && row["size"] == *size);
            let row = row.unwrap_or_else(|| panic!("no {way} of {size} bytes: {report}"));
            let [p50, p99, max] = ["p50_us", "p99_us", "max_us"].map(|key| row[key].as_u64().unwrap());
            assert!(row["count"].as_u64().unwrap() > 0 && 0 < p50 && p50 <= p99 && p99 <= max, "{row}");
            assert_eq!(row["lost"], 0, "{row}");
        }
    }
    let flows = report["flows"].as_array().unwrap();
    for way in sealed {
        for size in sizes {
            let row = flows.iter().find(|row| row["way"] == **way && row["size"] == *size).unwrap();
            assert!(row["sent"].as_u64().unwrap() > 1 && row["per_s"].as_f64().unwrap() > 0.0, "{row}");
            assert_eq!((&row["received"], &row["repeated"]), (&row["sent"], &0.into()), "{row}");
            assert!(row["cpu_us_here"].is_number() && row["cpu_us_there"].is_number(), "{row}");
        }
    }
    for machine in ["here", "there"] {
        assert!(report[machine]["cores"].as_u64().unwrap() > 0, "{report}");
        assert!(report[machine]["kernel"].as_str().unwrap().starts_with("Linux"), "{report}");
    }
}

#[test]
fn a_run_measures_every_way_and_loses_nothing() {
    let lab = Lab::new();
    let answer = lab.answer(&["--listen", "quic://127.0.0.1:0,tcp://127.0.0.1:0"]);
    let urls = answer.said("desk waits at ");
    let (quic, tcp) = urls.split_once(',').unwrap();
    let args = ["--with", "desk", "--connect", quic, "--sizes", "16,1000,100kB", "--duration", "1s"];
    let files = ["--json-file", "run.json", "--markdown", "run.md"];
    let output = lab.run("robot.identity", &[&args[..], &files].concat());
    assert!(output.status.success(), "{}", stderr(&output));
    assert_eq!(stderr(&output), "");
    answer.said("a run goes on: sgc group, sgc pairwise");
    answer.said("the run is over");
    let report: Value = serde_json::from_slice(&fs::read(lab.dir.path().join("run.json")).unwrap()).unwrap();
    check(&report, &["sgc group", "sgc pairwise"], &["TCP", "direct DDS"], &[16, 1000, 100_000]);
    check(&report, &[], &["UDP"], &[16, 1000]);
    assert!(report["tcp_mbit_s"].as_f64().unwrap() > 0.0);
    assert_eq!((&report["bare_not"], &report["direct_not"]), (&Value::Null, &Value::Null));
    assert_eq!(report["path"]["transports"], serde_json::json!(["quic"]));
    let (text, page) = (
        String::from_utf8(output.stdout.clone()).unwrap(),
        fs::read_to_string(lab.dir.path().join("run.md")).unwrap(),
    );
    for part in ["What that means:", "all arrived, once each", "DDS without sgc reaches"] {
        assert!(text.contains(part), "{text}");
    }
    assert!(page.contains("## What that means") && page.contains("| way | size |"), "{page}");
    assert!(
        !page.contains("127.0.0.1") && !text.contains("127.0.0.1"),
        "a place is nobody's business: {text}"
    );

    // The side is ready for another run, by another transport and with another suite.
    let args =
        ["--with", "desk", "--connect", tcp, "--sizes", "16", "--duration", "1s", "--suites", "group-chacha"];
    let output = lab.run("robot.identity", &[&args[..], &["--json-file", "run.json"]].concat());
    assert!(output.status.success(), "{}", stderr(&output));
    let report: Value = serde_json::from_slice(&fs::read(lab.dir.path().join("run.json")).unwrap()).unwrap();
    check(&report, &["sgc group-chacha"], &["TCP"], &[16]);

    assert_eq!(answer.end(Signal::INT), Some(0));
    assert!(fs::read_dir(lab.tmp()).unwrap().next().is_none(), "files are left over");
}

#[test]
fn through_a_router_all_but_the_bare_path_is_measured() {
    let lab = Lab::new();
    let args = ["run", "--identity", "cloud.identity", "--listen", "quic://127.0.0.1:0", "--print-ready"];
    let mut router = lab.sgc(&args);
    router.env("XDG_STATE_HOME", lab.dir.path()).stderr(Stdio::null());
    let router = Side::start(router);
    let ready: Value = serde_json::from_str(&format!("{{{}", router.said("{"))).unwrap();
    let url = ready["ready"][0].as_str().unwrap();
    let answer = lab.answer(&["--router", url]);
    answer.said("desk waits at ");
    let args = ["--with", "desk", "--router", url, "--sizes", "16", "--duration", "1s", "--suites", "group"];
    let output = lab.run("robot.identity", &[&args[..], &["--json"]].concat());
    assert!(output.status.success(), "{}", stderr(&output));
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    check(&report, &["sgc group"], &[], &[16]);
    for not in ["bare_not", "direct_not"] {
        assert!(report[not].as_str().unwrap().contains("through a router"), "{report}");
    }
}

#[test]
fn another_fleet_is_refused_and_told_so() {
    let lab = Lab::new();
    let answer = lab.answer(&["--listen", "quic://127.0.0.1:0"]);
    let url = answer.said("desk waits at ");
    let output = lab.run("stranger.identity", &["--with", "desk", "--connect", &url, "--duration", "1s"]);
    assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
    let said = stderr(&output);
    assert!(said.starts_with("sgc: bench: no link to desk\n"), "{said}");
    assert!(said.contains("fleet"), "{said}");
    assert!(output.stdout.is_empty());
}

#[test]
fn a_wrong_name_or_address_of_the_other_side_is_said_to_be_one() {
    let lab = Lab::new();
    let answer = lab.answer(&["--listen", "quic://127.0.0.1:0"]);
    let url = answer.said("desk waits at ");
    let output = lab.run("robot.identity", &["--with", "dask", "--connect", &url, "--duration", "1s"]);
    assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
    let said = stderr(&output);
    let address = url.strip_prefix("quic://").unwrap();
    assert!(said.starts_with(&format!("sgc: bench: the node at {address} is not dask\n")), "{said}");
    assert!(said.contains("prints the name of its node"), "{said}");
    let output = lab.run("robot.identity", &["--with", "desk", "--connect", address, "--duration", "1s"]);
    assert_eq!(output.status.code(), Some(2), "{}", stderr(&output));
    let said = stderr(&output);
    assert!(said.contains("for '--connect <URL>'") && !said.contains("`routers`"), "{said}");
    assert!(said.trim().ends_with("see `sgc bench run --help`"), "{said}");
}

#[test]
fn the_end_of_the_other_side_is_told_and_ends_a_run() {
    let lab = Lab::new();
    let answer = lab.answer(&["--listen", "quic://127.0.0.1:0"]);
    let url = answer.said("desk waits at ");
    let args = ["bench", "run", "--identity", "robot.identity", "--with", "desk", "--connect", &url];
    let mut run = lab.sgc(&[&args[..], &["--duration", "60s", "--sizes", "1000"]].concat());
    let run = run.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    answer.said("a run goes on");
    answer.end(Signal::KILL);
    let output = end_of(run);
    assert_eq!(output.status.code(), Some(1), "{}", stderr(&output));
    let said = stderr(&output);
    assert!(said.starts_with("sgc: bench: desk is silent"), "{said}");
    assert!(said.contains("the link broke"), "{said}");
}

#[test]
fn wrong_arguments_are_reported_before_anything_runs() {
    let lab = Lab::new();
    let url = "quic://127.0.0.1:9";
    for (args, part) in [
        (&["--with", "robot", "--connect", url][..], "cannot measure with itself"),
        (&["--with", "desk"], "--connect"),
        (&["--with", "desk", "--connect", "nonsense"], "nonsense"),
        (&["--with", "desk", "--connect", url, "--sizes", "1GB"], "1 to 32000000 bytes"),
        (&["--with", "desk", "--connect", url, "--suites", "rot13"], "rot13"),
    ] {
        let output = lab.run("robot.identity", args);
        assert_eq!(output.status.code(), Some(2), "{args:?}: {}", stderr(&output));
        assert!(stderr(&output).contains(part), "{args:?}: {}", stderr(&output));
    }
}
