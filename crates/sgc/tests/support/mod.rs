//! What the tests with network namespaces and programs that are not ours have in common: commands in a namespace, and
//! the peers of `tests/peers/README.md`.

use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

/// Longest wait for an event, far beyond what any takes.
pub(crate) const PATIENCE: Duration = Duration::from_secs(60);

/// To the terminal, past the test harness, which shows nothing of a test that passes.
pub(crate) fn say(text: &str) {
    let _ = writeln!(std::io::stderr(), "{text}");
}

/// Runs `ip` of iproute2; what it complained of.
pub(crate) fn ip(args: &[&str]) -> Result<(), String> {
    let output = Command::new("ip").args(args).output().map_err(|e| format!("ip: {e}"))?;
    if output.status.success() {
        Ok(())
    } else {
        Err(String::from_utf8_lossy(&output.stderr).trim().to_owned())
    }
}

/// A command in a namespace, or on this host, in a directory and with nothing of our environment but `PATH` and
/// `SGC_LOG`. Its process is the program's own: `ip` replaces itself by it.
pub(crate) fn command(namespace: Option<&str>, dir: &Path, program: &Path) -> Command {
    let mut command = match namespace {
        Some(namespace) => {
            let mut command = Command::new("ip");
            command.args(["netns", "exec", namespace]).arg(program);
            command
        }
        None => Command::new(program),
    };
    let path = std::env::var_os("PATH").unwrap();
    command.env_clear().env("PATH", path).env("XDG_RUNTIME_DIR", dir);
    command.envs(std::env::var_os("SGC_LOG").map(|level| ("SGC_LOG", level)));
    command.current_dir(dir).stdin(Stdio::null());
    command
}

/// Waits for what will be so within [`PATIENCE`].
pub(crate) fn eventually(what: &str, mut is_so: impl FnMut() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !is_so() {
        assert!(Instant::now() < deadline, "never: {what}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// A program that is not ours.
pub(crate) struct Peer {
    child: Child,
    stdin: Option<ChildStdin>,
    /// What it reports, and when we read it.
    pub(crate) events: Receiver<(Instant, Value)>,
}

impl Peer {
    /// The program of a vendor, `"cyclone"` or `"fastdds"`.
    pub(crate) fn program(vendor: &str) -> PathBuf {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").canonicalize().unwrap();
        let program = root.join(".peers").join(vendor);
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

    /// Lets it go on: one line on its standard input.
    pub(crate) fn go(&mut self) {
        self.stdin.as_mut().unwrap().write_all(b"go\n").unwrap();
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
