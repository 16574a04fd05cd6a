//! Shared helpers of tests with network namespaces and independent programs: namespaces, commands in them, nodes as
//! processes, and the peers of `tests/peers/README.md`.

#![allow(dead_code, reason = "each test program uses a part")]

pub(crate) mod fake_clock;
pub(crate) mod turn;

use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, ExitStatus, Stdio};
use std::str::FromStr;
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use sgc_testkit::netsim::{self, Namespace, NetsimError};

/// Longest wait for an event, far beyond what any takes.
pub(crate) const PATIENCE: Duration = Duration::from_secs(60);
/// Number of lines of each log that are shown when a test fails.
const LOG_LINES: usize = 40;

/// Prints to the terminal directly, because the test harness hides the output of passing tests.
pub(crate) fn say(text: &str) {
    let _ = writeln!(std::io::stderr(), "{text}");
}

/// Prints the end of a log.
pub(crate) fn say_log(whose: &str, log: &str) {
    let lines: Vec<_> = log.lines().collect();
    let tail = &lines[lines.len().saturating_sub(LOG_LINES)..];
    say(&format!("--- {whose}, last of {} lines ---\n{}", lines.len(), tail.join("\n")));
}

/// Returns the namespaces, or `None` where the kernel or the user cannot make them. Prints the fallback in that case.
pub(crate) fn namespaces<T>(made: Result<T, NetsimError>, instead: &str) -> Option<T> {
    made.inspect_err(|why| say(&format!("NO NETWORK NAMESPACES ({why}): {instead}"))).ok()
}

/// Returns a private network whose loopback interface has multicast, or `None` as [`namespaces`] does.
pub(crate) fn own_network(name: String) -> Option<Namespace> {
    let made = Namespace::create(name);
    let made = made.and_then(|own| own.ip(&["link", "set", "lo", "multicast", "on"]).map(|_| own));
    namespaces(made, "using this host's network")
}

/// Removes namespaces `PREFIX-PID-…` whose process is gone without having removed them: killed, or ended from the
/// terminal.
pub(crate) fn remove_abandoned(prefix: &str) {
    let Ok(list) = netsim::ip(&["netns", "list"]) else { return };
    for line in list.lines() {
        let name = line.split_whitespace().next().unwrap_or_default();
        let pid = name.strip_prefix(prefix).and_then(|rest| rest.split('-').nth(1));
        if pid.is_some_and(|pid| pid.parse::<u32>().is_ok() && !Path::new("/proc").join(pid).exists()) {
            let _ = netsim::ip(&["netns", "delete", name]);
        }
    }
}

/// Returns a value from the environment, for longer or other runs, or this one if there is none.
pub(crate) fn environment<T: FromStr>(key: &str, default: T) -> T {
    std::env::var(key).ok().and_then(|text| text.parse().ok()).unwrap_or(default)
}

/// Returns the path of a file of this repository.
pub(crate) fn repository(file: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").canonicalize().unwrap().join(file)
}

/// Returns a command in a namespace, or on this host, that runs in a directory with only `PATH` and `SGC_LOG` of our
/// environment. Its process id is that of the program, because `ip` replaces itself by it.
pub(crate) fn command(namespace: Option<&Namespace>, dir: &Path, program: &Path) -> Command {
    let mut command = namespace.map_or_else(|| Command::new(program), |namespace| namespace.command(program));
    let path = std::env::var_os("PATH").unwrap();
    command.env_clear().env("PATH", path).env("XDG_RUNTIME_DIR", dir);
    command.envs(std::env::var_os("SGC_LOG").map(|level| ("SGC_LOG", level)));
    command.current_dir(dir).stdin(Stdio::null());
    command
}

/// Returns such a command for the tested program, with core dumps allowed, because tests read its memory and open
/// files.
pub(crate) fn sgc(namespace: Option<&Namespace>, dir: &Path) -> Command {
    let mut command = command(namespace, dir, Path::new(env!("CARGO_BIN_EXE_sgc")));
    command.env("SGC_ALLOW_CORE_DUMPS", "1");
    command
}

/// Returns such a command for a Python program of `tests/peers/py`.
pub(crate) fn python(namespace: Option<&Namespace>, dir: &Path, program: &str) -> Command {
    let mut command = command(namespace, dir, &repository(".venv/bin/python"));
    command.arg("-B").arg(repository("tests/peers/py").join(program));
    command
}

/// Writes the files of the fleet `lab` and of its members to a directory. Each member is a name and further arguments
/// of `sgc fleet enroll`.
pub(crate) fn enroll<'a>(dir: &Path, members: impl IntoIterator<Item = &'a str>) {
    let good = |command: &str| {
        let output = sgc(None, dir).args(command.split_whitespace()).output().unwrap();
        assert!(output.status.success(), "{command}: {output:?}");
    };
    good("fleet create lab");
    members.into_iter().for_each(|member| good(&format!("fleet enroll {member}")));
}

/// Waits until a condition holds, which it must within [`PATIENCE`].
pub(crate) fn eventually(what: &str, mut is_so: impl FnMut() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !is_so() {
        assert!(Instant::now() < deadline, "never: {what}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// A node as a process, which ends when this is dropped.
pub(crate) struct Running {
    child: Child,
    /// The addresses on which it listens.
    pub(crate) addresses: Vec<String>,
}

impl Running {
    /// Starts a node and waits until it is up. Appends its log to a file.
    pub(crate) fn start(mut command: Command, log: &Path) -> Self {
        let file = fs::File::options().create(true).append(true).open(log).unwrap();
        command.args(["--print-ready", "--until-stdin-closes"]);
        let child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(file).spawn().unwrap();
        let mut node = Self { child, addresses: Vec::new() };
        let mut line = String::new();
        BufReader::new(node.child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let said: Value = serde_json::from_str(&line).unwrap_or_default();
        let Some(addresses) = said["ready"].as_array() else {
            panic!("{line} {}", fs::read_to_string(log).unwrap_or_default());
        };
        node.addresses = addresses.iter().map(|address| address.as_str().unwrap().to_owned()).collect();
        node
    }

    /// Sends SIGKILL or SIGTERM and returns the exit status.
    pub(crate) fn end(mut self, signal: Signal) -> ExitStatus {
        self.signal(signal);
        let mut ended = None;
        eventually("the node ends", || {
            ended = self.try_end();
            ended.is_some()
        });
        ended.unwrap()
    }

    /// Returns the exit status if the node has ended.
    pub(crate) fn try_end(&mut self) -> Option<ExitStatus> {
        self.child.try_wait().unwrap()
    }

    /// Sends a signal that does not end the node.
    pub(crate) fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.child), signal).unwrap();
    }

    pub(crate) fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Returns the resources that the process uses now.
    pub(crate) fn held(&self) -> ResourceUse {
        let pid = self.pid();
        let status = fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
        let number = |key: &str| {
            let line = status.lines().find(|l| l.starts_with(key)).unwrap();
            line.split_whitespace().nth(1).unwrap().parse().unwrap()
        };
        let fds = fs::read_dir(format!("/proc/{pid}/fd")).unwrap().count();
        ResourceUse { resident_kb: number("VmRSS:"), fds, threads: number("Threads:") as usize }
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// The system resources of a process.
#[derive(Debug)]
pub(crate) struct ResourceUse {
    pub(crate) resident_kb: u64,
    pub(crate) fds: usize,
    pub(crate) threads: usize,
}

/// An independent program.
pub(crate) struct Peer {
    child: Child,
    stdin: Option<ChildStdin>,
    /// Its reports, with the times of reading.
    pub(crate) events: Receiver<(Instant, Value)>,
}

impl Peer {
    /// Returns the program of a vendor, `"cyclone"`, `"fastdds"` or `"rustdds"`.
    pub(crate) fn program(vendor: &str) -> PathBuf {
        let program = repository(".peers").join(vendor);
        assert!(program.exists(), "{} is missing: run `make peers`", program.display());
        program
    }

    /// Starts a peer from a command with the program and all its arguments.
    pub(crate) fn start(mut command: Command) -> Self {
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
        let (sender, events) = channel();
        let stdout = BufReader::new(child.stdout.take().unwrap());
        std::thread::spawn(move || {
            for line in stdout.lines().map_while(Result::ok) {
                match serde_json::from_str(&line) {
                    Ok(event) => drop(sender.send((Instant::now(), event))),
                    Err(error) => panic!("{line}: {error}"),
                }
            }
        });
        Self { stdin: child.stdin.take(), child, events }
    }

    /// Returns the next event of a kind, which must come before the peer ends.
    pub(crate) fn wait(&mut self, what: &str, is_it: impl Fn(&Value) -> bool) -> Value {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            match self.events.recv_timeout(left) {
                Ok((_, event)) if is_it(&event) => return event,
                Ok((_, event)) => assert_ne!(event["event"], "summary", "ended before {what}: {event}"),
                Err(error) => panic!("{what}: {error}"),
            }
        }
    }

    /// Waits until the peer is matched, in whatever order its reports come. It may be matched before it is ready: a
    /// writer on the far side outlives its publisher for a while, and serves the next one with equal settings.
    pub(crate) fn wait_matched(&mut self, what: &str) {
        self.wait(what, |event| event["event"] == "matched" && event["count"].as_u64() >= Some(1));
    }

    /// Lets the peer go on by a line on its standard input.
    pub(crate) fn go(&mut self) {
        self.tell("go");
    }

    /// Writes a line to the peer's standard input.
    pub(crate) fn tell(&mut self, line: &str) {
        writeln!(self.stdin.as_mut().unwrap(), "{line}").unwrap();
    }

    /// Sends SIGTERM. The peer's summary follows.
    pub(crate) fn end(&mut self) {
        self.signal(Signal::TERM);
    }

    pub(crate) fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.child), signal).unwrap();
    }

    /// Ends the peer and returns its summary.
    pub(crate) fn summary(&mut self) -> Value {
        let deadline = Instant::now() + 2 * PATIENCE;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            let (_, event) = self.events.recv_timeout(left).expect("a summary");
            if event["event"] == "summary" {
                self.child.wait().unwrap();
                return event;
            }
        }
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
