//! What the tests with network namespaces and programs that are not ours have in common: namespaces, commands in them, nodes
//! as processes, and the peers of `tests/peers/README.md`.

#![allow(dead_code, reason = "each test program uses a part")]

use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, ExitStatus, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use sgc_testkit::netsim::{Namespace, NetsimError};

/// Longest wait for an event, far beyond what any takes.
pub(crate) const PATIENCE: Duration = Duration::from_secs(60);
/// Lines of each log that are shown when a test fails.
const LOG_LINES: usize = 40;

/// To the terminal, past the test harness, which shows nothing of a test that passes.
pub(crate) fn say(text: &str) {
    let _ = writeln!(std::io::stderr(), "{text}");
}

/// Says how a log ends.
pub(crate) fn say_log(whose: &str, log: &str) {
    let lines: Vec<_> = log.lines().collect();
    let tail = &lines[lines.len().saturating_sub(LOG_LINES)..];
    say(&format!("--- {whose}, last of {} lines ---\n{}", lines.len(), tail.join("\n")));
}

/// Namespaces, or nothing where the kernel or the user cannot make them; which is said, and what is used `instead`.
pub(crate) fn namespaces<T>(made: Result<T, NetsimError>, instead: &str) -> Option<T> {
    made.inspect_err(|why| say(&format!("NO NETWORK NAMESPACES ({why}): {instead}"))).ok()
}

/// A network of the test's own, its loopback interface with multicast, or nothing, as [`namespaces`] says.
pub(crate) fn own_network(name: String) -> Option<Namespace> {
    let made = Namespace::create(name);
    let made = made.and_then(|own| own.ip(&["link", "set", "lo", "multicast", "on"]).map(|_| own));
    namespaces(made, "using this host's network")
}

/// A file of this repository.
pub(crate) fn repository(file: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").canonicalize().unwrap().join(file)
}

/// A command in a namespace, or on this host, in a directory and with nothing of our environment but `PATH` and
/// `SGC_LOG`. Its process is the program's own: `ip` replaces itself by it.
pub(crate) fn command(namespace: Option<&Namespace>, dir: &Path, program: &Path) -> Command {
    let mut command = namespace.map_or_else(|| Command::new(program), |namespace| namespace.command(program));
    let path = std::env::var_os("PATH").unwrap();
    command.env_clear().env("PATH", path).env("XDG_RUNTIME_DIR", dir);
    command.envs(std::env::var_os("SGC_LOG").map(|level| ("SGC_LOG", level)));
    command.current_dir(dir).stdin(Stdio::null());
    command
}

/// The same of the program that is tested. Tests look into its memory and at its open files.
pub(crate) fn sgc(namespace: Option<&Namespace>, dir: &Path) -> Command {
    let mut command = command(namespace, dir, Path::new(env!("CARGO_BIN_EXE_sgc")));
    command.env("SGC_ALLOW_CORE_DUMPS", "1");
    command
}

/// The same of a Python program of `tests/peers/py`.
pub(crate) fn python(namespace: Option<&Namespace>, dir: &Path, program: &str) -> Command {
    let mut command = command(namespace, dir, &repository(".venv/bin/python"));
    command.arg("-B").arg(repository("tests/peers/py").join(program));
    command
}

/// The files of the fleet `lab` in a directory, and of its members: each a name, and what enrolling it takes besides.
pub(crate) fn enroll<'a>(dir: &Path, members: impl IntoIterator<Item = &'a str>) {
    let good = |command: &str| {
        let output = sgc(None, dir).args(command.split_whitespace()).output().unwrap();
        assert!(output.status.success(), "{command}: {output:?}");
    };
    good("fleet create lab");
    members.into_iter().for_each(|member| good(&format!("fleet enroll {member}")));
}

/// Waits for what will be so within [`PATIENCE`].
pub(crate) fn eventually(what: &str, mut is_so: impl FnMut() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !is_so() {
        assert!(Instant::now() < deadline, "never: {what}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// A node as a process of its own, which is ended with this.
pub(crate) struct Running {
    child: Child,
    /// What it listens on.
    pub(crate) addresses: Vec<String>,
}

impl Running {
    /// Starts one and waits until it is up; its log is appended to a file.
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

    /// SIGKILL or SIGTERM, and what it ended with.
    pub(crate) fn end(mut self, signal: Signal) -> ExitStatus {
        self.signal(signal);
        let mut ended = None;
        eventually("the node ends", || {
            ended = self.try_end();
            ended.is_some()
        });
        ended.unwrap()
    }

    /// What it ended with, if it did.
    pub(crate) fn try_end(&mut self) -> Option<ExitStatus> {
        self.child.try_wait().unwrap()
    }

    /// A signal to a node that goes on living.
    pub(crate) fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.child), signal).unwrap();
    }

    pub(crate) fn pid(&self) -> u32 {
        self.child.id()
    }

    /// What it has of the system now.
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

/// What a process has of the system.
#[derive(Debug)]
pub(crate) struct ResourceUse {
    pub(crate) resident_kb: u64,
    pub(crate) fds: usize,
    pub(crate) threads: usize,
}

/// A program that is not ours.
pub(crate) struct Peer {
    child: Child,
    stdin: Option<ChildStdin>,
    /// What it reports, and when we read it.
    pub(crate) events: Receiver<(Instant, Value)>,
}

impl Peer {
    /// The program of a vendor, `"cyclone"`, `"fastdds"` or `"rustdds"`.
    pub(crate) fn program(vendor: &str) -> PathBuf {
        let program = repository(".peers").join(vendor);
        assert!(program.exists(), "{} is missing: run `make peers`", program.display());
        program
    }

    /// Starts one, from a command with the program and all its arguments.
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

    /// The next event of a kind, which must come before the peer ends.
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

    /// Waits until it is matched. Not after what else it reports: it may be matched before it says that it is ready, since a far
    /// writer stays for a while when its publisher has gone, and is the next one's if that is alike.
    pub(crate) fn wait_matched(&mut self, what: &str) {
        self.wait(what, |event| event["event"] == "matched" && event["count"].as_u64() >= Some(1));
    }

    /// Lets it go on: one line on its standard input.
    pub(crate) fn go(&mut self) {
        self.tell("go");
    }

    /// Gives it a line on its standard input.
    pub(crate) fn tell(&mut self, line: &str) {
        writeln!(self.stdin.as_mut().unwrap(), "{line}").unwrap();
    }

    /// SIGTERM; its summary follows.
    pub(crate) fn end(&mut self) {
        self.signal(Signal::TERM);
    }

    pub(crate) fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.child), signal).unwrap();
    }

    /// What it sums up at its end.
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
