//! Tests of running nodes as their user sees them: start, status and end.

#![allow(clippy::unwrap_used)]

use std::io::{BufRead, BufReader, Read};
use std::os::unix::net::UnixDatagram;
use std::path::Path;
use std::process::{Child, ChildStdout, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use tempfile::TempDir;

/// Longest wait for an event, far beyond what any takes.
const PATIENCE: Duration = Duration::from_secs(30);

/// A router with a fleet of its own, listening on the loopback interface.
struct Router {
    place: TempDir,
    child: Child,
    _stdout: BufReader<ChildStdout>,
    address: String,
}

impl Router {
    fn start() -> Self {
        Self::start_with(|_, _| {})
    }

    /// Starts it with further variables, for which it gets its directory.
    fn start_with(variables: impl FnOnce(&mut Command, &Path)) -> Self {
        let place = tempfile::tempdir().unwrap();
        for args in [&["fleet", "create", "lab"][..], &["fleet", "enroll", "cloud", "--role", "router"]] {
            assert!(sgc(place.path(), args).output().unwrap().status.success());
        }
        let args = ["router", "--identity", "cloud.identity", "--listen", "quic://127.0.0.1:0"];
        let mut command =
            sgc(place.path(), &[&args[..], &["--print-ready", "--until-stdin-closes"]].concat());
        variables(&mut command, place.path());
        let mut child = command.stdin(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let mut stdout = BufReader::new(child.stdout.take().unwrap());
        let mut line = String::new();
        stdout.read_line(&mut line).unwrap();
        let ready: Value = serde_json::from_str(&line).unwrap();
        let address = ready["ready"][0].as_str().unwrap().to_owned();
        Self { place, child, _stdout: stdout, address }
    }

    fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.child), signal).unwrap();
    }

    /// Waits for the router's end and returns its log.
    fn end(mut self) -> (ExitStatus, String) {
        let status = wait(&mut self.child);
        let mut log = String::new();
        self.child.stderr.take().unwrap().read_to_string(&mut log).unwrap();
        (status, log)
    }
}

fn sgc(dir: &Path, args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_sgc"));
    command
        .args(args)
        .current_dir(dir)
        .env_clear()
        .env("XDG_RUNTIME_DIR", dir)
        .stdin(Stdio::null())
        .stdout(Stdio::piped());
    command
}

fn wait(child: &mut Child) -> ExitStatus {
    let deadline = Instant::now() + PATIENCE;
    loop {
        if let Some(status) = child.try_wait().unwrap() {
            return status;
        }
        if Instant::now() >= deadline {
            let _ = child.kill();
            panic!("it did not end");
        }
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn a_router_says_where_it_listens_and_how_it_is() {
    let router = Router::start();
    assert!(router.address.starts_with("quic://127.0.0.1:"), "{}", router.address);
    assert!(!router.address.ends_with(":0"));

    // The only node need not be named.
    let output = sgc(router.place.path(), &["status", "--json"]).output().unwrap();
    let status: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(status["node"], "cloud");
    assert!(status["uptime_s"].is_u64() && status["links"] == Value::Array(Vec::new()));

    let output = sgc(router.place.path(), &["status"]).output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(text.starts_with("cloud: sgc ") && text.contains("\nLinks: none\n"), "{text}");
    router.signal(Signal::TERM);
    assert!(router.end().0.success());
}

#[test]
fn states_are_coloured_on_request_and_columns_stay_aligned() {
    let router = Router::start_with(|command, _| {
        command.args(["--peer", "quic://127.0.0.1:1"]);
    });
    let status = |variables: &[(&str, &str)], args: &[&str]| {
        let mut command = sgc(router.place.path(), &[&["status"], args].concat());
        String::from_utf8(command.envs(variables.iter().copied()).output().unwrap().stdout).unwrap()
    };
    let deadline = Instant::now() + PATIENCE;
    let red = "\x1b[31mtrying again in ";
    let mut coloured = String::new();
    while !coloured.contains(red) {
        assert!(Instant::now() < deadline, "{coloured}");
        std::thread::sleep(Duration::from_millis(20));
        coloured = status(&[("CLICOLOR_FORCE", "1")], &[]);
    }
    let plain =
        ["31", "33", "0"].iter().fold(coloured, |text, code| text.replace(&format!("\x1b[{code}m"), ""));
    assert!(!plain.contains('\x1b'), "{plain}");
    let column = |line: &str, text: &str| {
        let line = plain.lines().find(|found| found.trim_start().starts_with(line)).unwrap();
        line.find(text).unwrap_or_else(|| panic!("no {text} in {line}"))
    };
    let row = "quic://127.0.0.1:1 ";
    assert_eq!(column("router ", "state"), column(row, "trying again"));
    assert_eq!(column("router ", "last failure"), column(row, "quic://127.0.0.1:1: "));
    for text in [status(&[], &[]), status(&[("CLICOLOR_FORCE", "1")], &["--json"])] {
        assert!(text.contains("trying again") && !text.contains('\x1b'), "{text}");
    }
    router.signal(Signal::TERM);
    assert!(router.end().0.success());
}

#[test]
fn either_signal_ends_a_node_cleanly() {
    for signal in [Signal::TERM, Signal::INT] {
        let router = Router::start();
        let socket = router.place.path().join("sgc/cloud.sock");
        assert!(socket.exists());
        router.signal(signal);
        let (status, log) = router.end();
        assert!(status.success(), "{signal:?}: {status}\n{log}");
        assert!(!socket.exists());
    }
}

#[test]
fn service_manager_hears_of_start_life_and_end() {
    let notified = std::cell::OnceCell::new();
    let router = Router::start_with(|command, dir| {
        let path = dir.join("notify");
        let socket = UnixDatagram::bind(&path).unwrap();
        socket.set_read_timeout(Some(PATIENCE)).unwrap();
        command.env("NOTIFY_SOCKET", &path).env("WATCHDOG_USEC", "400000");
        notified.set(socket).unwrap();
    });
    let socket = notified.into_inner().unwrap();
    let hear = || {
        let mut bytes = [0; 256];
        let length = socket.recv(&mut bytes).unwrap();
        String::from_utf8(bytes[..length].to_vec()).unwrap()
    };
    let mut heard = vec![hear(), hear(), hear()];
    heard.sort();
    assert_eq!(heard, ["READY=1\n", "WATCHDOG=1\n", "WATCHDOG=1\n"]);
    router.signal(Signal::TERM);
    // The watchdog may be fed until it has stopped.
    while hear() != "STOPPING=1\n" {}
    let (status, log) = router.end();
    assert!(status.success(), "{log}");
    let first = log.lines().find(|line| line.contains("node cloud of fleet lab")).unwrap();
    assert!(first.contains(concat!("sgc ", env!("CARGO_PKG_VERSION"))), "{first}");
    assert!(
        first.contains("router at quic://127.0.0.1:") && first.contains("configured by arguments"),
        "{first}"
    );
}

#[test]
fn a_child_does_not_outlive_its_standard_input() {
    let mut router = Router::start();
    drop(router.child.stdin.take());
    assert!(router.end().0.success());
}

#[test]
fn an_address_in_use_is_a_failure_and_named() {
    let router = Router::start();
    let enrolled =
        sgc(router.place.path(), &["fleet", "enroll", "other", "--role", "router"]).output().unwrap();
    assert!(enrolled.status.success());
    let args = ["router", "--identity", "other.identity", "--listen", &router.address];
    let output = sgc(router.place.path(), &args).stderr(Stdio::piped()).output().unwrap();
    let stderr = String::from_utf8(output.stderr).unwrap();
    let last = stderr.lines().last().unwrap();
    assert_eq!(output.status.code(), Some(1));
    assert!(last.starts_with("sgc: ") && last.contains(&router.address), "{stderr}");
    router.signal(Signal::TERM);
    assert!(router.end().0.success());
}

#[test]
fn sharing_with_everyone_by_saying_nothing_is_said() {
    let router = Router::start();
    let dir = router.place.path();
    assert!(sgc(dir, &["fleet", "enroll", "arm-1"]).output().unwrap().status.success());
    let args = ["run", "--identity", "arm-1.identity", "--router", &router.address, "--share", "/t"];
    let hint = "every member of the fleet may subscribe";
    for (to, is_said) in [(&[][..], true), (&["--to", "desk"], false)] {
        let mut command = sgc(dir, &[&args[..], to, &["--print-ready"]].concat());
        command.env("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF").stderr(Stdio::piped());
        let mut child = command.spawn().unwrap();
        let mut stdout = BufReader::new(child.stdout.take().unwrap());
        stdout.read_line(&mut String::new()).unwrap();
        kill_process(Pid::from_child(&child), Signal::TERM).unwrap();
        let status = wait(&mut child);
        let mut log = String::new();
        child.stderr.take().unwrap().read_to_string(&mut log).unwrap();
        assert!(status.success() && log.contains(hint) == is_said, "{status}\n{log}");
    }
    router.signal(Signal::TERM);
    assert!(router.end().0.success());
}

#[test]
fn a_second_process_with_one_identity_does_not_start_and_names_the_first() {
    let router = Router::start();
    let dir = router.place.path();
    let second = |home: Option<&Path>, identity: &str| {
        let mut command =
            sgc(dir, &["router", "--identity", identity, "--listen", "quic://127.0.0.1:0", "--print-ready"]);
        command.envs(home.map(|home| ("HOME", home))).stderr(Stdio::piped());
        command
    };
    let output = second(None, "cloud.identity").output().unwrap();
    let stderr = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1), "{stderr}");
    let pid = router.child.id();
    let last = stderr.lines().last().unwrap();
    assert!(last.contains(&format!("process {pid}, see `ps -fp {pid}`")), "{stderr}");
    assert!(last.contains("cloud.identity") && last.contains("One identity is for one process"), "{stderr}");

    // One that is killed leaves nothing behind, and the next starts although it came before that end.
    let mut next = second(None, "cloud.identity").spawn().unwrap();
    let mut log = BufReader::new(next.stderr.take().unwrap());
    let mut line = String::new();
    while !line.contains("waiting") {
        line.clear();
        assert!(log.read_line(&mut line).unwrap() > 0, "it ended");
    }
    router.signal(Signal::KILL);
    let mut ready = String::new();
    BufReader::new(next.stdout.take().unwrap()).read_line(&mut ready).unwrap();
    assert!(ready.contains("quic://127.0.0.1:"), "{ready}");
    kill_process(Pid::from_child(&next), Signal::KILL).unwrap();
    wait(&mut next);

    // A copy of the identity has another lock, and its state in the same place.
    std::fs::copy(dir.join("cloud.identity"), dir.join("copy.identity")).unwrap();
    let mut first = second(Some(dir), "cloud.identity").spawn().unwrap();
    BufReader::new(first.stdout.take().unwrap()).read_line(&mut ready).unwrap();
    let output = second(Some(dir), "copy.identity").output().unwrap();
    let stderr = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1), "{stderr}");
    assert!(stderr.lines().last().unwrap().contains(&format!("process {}", first.id())), "{stderr}");
    kill_process(Pid::from_child(&first), Signal::KILL).unwrap();
    wait(&mut first);
}
