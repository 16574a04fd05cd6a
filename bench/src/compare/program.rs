//! Processes of a comparison: spoken to in lines of JSON, measured by their process ids, ended with the value.

use std::collections::VecDeque;
use std::fs::{self, File};
use std::io::{BufRead as _, BufReader, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

use crate::process::{PATIENCE, cpu_seconds_of, resident_bytes_of};

/// Lines that are kept unread; a process that says more waits.
const LINES_MAX: usize = 1024;
/// Lines of a log that an error shows.
const LOG_LINES: usize = 8;
/// How long a process may take to end once its standard input has.
const GRACE: Duration = Duration::from_secs(3);
/// How often it is looked at meanwhile.
const LOOK_EVERY: Duration = Duration::from_millis(5);

/// A process. Its standard error goes to a file.
#[derive(Debug)]
pub(crate) struct Program {
    name: String,
    child: Child,
    orders: Option<ChildStdin>,
    lines: Receiver<String>,
    log: PathBuf,
    ending: Ending,
}

/// The way in which a process is ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Ending {
    /// It ends by itself once its standard input does.
    Input,
    /// It ends by itself at SIGTERM.
    Terminate,
    /// It is killed.
    Kill,
}

impl Program {
    /// Starts it, with its log in `dir`. When this is dropped its standard input ends, upon which it should.
    pub(crate) fn start(name: &str, mut command: Command, dir: &Path) -> Result<Self> {
        let log = dir.join(format!("{name}.log"));
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(File::create(&log)?);
        let mut child = command.spawn().with_context(|| format!("{command:?}"))?;
        let orders = child.stdin.take();
        let out = child.stdout.take().context("no standard output")?;
        let (sender, lines) = sync_channel(LINES_MAX);
        std::thread::spawn(move || {
            for line in BufReader::new(out).lines().map_while(Result::ok) {
                if sender.send(line).is_err() {
                    return;
                }
            }
        });
        Ok(Self { name: name.to_owned(), child, orders, lines, log, ending: Ending::Input })
    }

    /// Starts a process that ignores its standard input and is therefore killed at its end.
    pub(crate) fn start_daemon(name: &str, command: Command, dir: &Path) -> Result<Self> {
        let mut program = Self::start(name, command, dir)?;
        program.ending = Ending::Kill;
        Ok(program)
    }

    /// Starts a process that ends at SIGTERM.
    pub(crate) fn start_terminated(name: &str, command: Command, dir: &Path) -> Result<Self> {
        let mut program = Self::start(name, command, dir)?;
        program.ending = Ending::Terminate;
        Ok(program)
    }

    /// Sends it SIGTERM.
    pub(crate) fn terminate(&self) {
        // One that has ended is left alone.
        let _ = Pid::from_raw(self.pid() as i32).map(|pid| kill_process(pid, Signal::TERM));
    }

    /// The next line that it prints.
    pub(crate) fn line(&mut self, patience: Duration) -> Result<String> {
        match self.lines.recv_timeout(patience) {
            Ok(line) => Ok(line),
            Err(RecvTimeoutError::Timeout) => {
                bail!("{} says nothing for {patience:?}: {}", self.name, self.log_end())
            }
            Err(RecvTimeoutError::Disconnected) => {
                let status = self.child.wait()?;
                bail!("{} has ended, {status}: {}", self.name, self.log_end())
            }
        }
    }

    /// Waits for an event: a line that is the string `event`, or an object with such a member, which is returned.
    /// Other lines are skipped.
    pub(crate) fn until(&mut self, event: &str, patience: Duration) -> Result<Value> {
        let deadline = Instant::now() + patience;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            let line = self.line(left).with_context(|| format!("waiting for {event:?}"))?;
            match serde_json::from_str(&line) {
                Ok(Value::String(said)) if said == event => return Ok(Value::Null),
                Ok(Value::Object(mut said)) => {
                    if let Some(value) = said.remove(event) {
                        return Ok(value);
                    }
                }
                _ => {}
            }
        }
    }

    /// Waits for an object whose member `event` is this one, and returns the object. Other lines are skipped.
    pub(crate) fn until_event(&mut self, event: &str, patience: Duration) -> Result<Value> {
        let deadline = Instant::now() + patience;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            let line = self.line(left).with_context(|| format!("waiting for {event:?}"))?;
            match serde_json::from_str::<Value>(&line) {
                Ok(said) if said["event"] == event => return Ok(said),
                _ => {}
            }
        }
    }

    /// The same, with the patience for what takes no time of its own.
    pub(crate) fn soon(&mut self, event: &str) -> Result<Value> {
        self.until(event, PATIENCE)
    }

    /// Tells it something: a line on its standard input.
    pub(crate) fn order(&mut self, order: &Value) -> Result<()> {
        let orders = self.orders.as_mut().context("a program without standard input")?;
        writeln!(orders, "{order}").with_context(|| format!("{} takes no order", self.name))
    }

    /// Tells one that takes no JSON a line.
    pub(crate) fn tell(&mut self, line: &str) -> Result<()> {
        let orders = self.orders.as_mut().context("a program without standard input")?;
        writeln!(orders, "{line}").with_context(|| format!("{} takes no order", self.name))
    }

    /// Its process id.
    pub(crate) fn pid(&self) -> u32 {
        self.child.id()
    }

    /// CPU time of its threads, seconds.
    pub(crate) fn cpu_seconds(&self) -> f64 {
        cpu_seconds_of(self.pid())
    }

    /// Resident memory: now, and the most it ever was, bytes.
    pub(crate) fn resident_bytes(&self) -> (u64, u64) {
        resident_bytes_of(self.pid())
    }

    /// The last lines of its log.
    fn log_end(&self) -> String {
        let text = fs::read_to_string(&self.log).unwrap_or_default();
        let mut end = VecDeque::new();
        for line in text.lines() {
            end.push_back(line);
            if end.len() > LOG_LINES {
                end.pop_front();
            }
        }
        Vec::from(end).join("\n")
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        drop(self.orders.take());
        let grace = match self.ending {
            Ending::Input => GRACE,
            Ending::Terminate => {
                self.terminate();
                GRACE
            }
            Ending::Kill => Duration::ZERO,
        };
        let deadline = Instant::now() + grace;
        while Instant::now() < deadline {
            if !matches!(self.child.try_wait(), Ok(None)) {
                return;
            }
            std::thread::sleep(LOOK_EVERY);
        }
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
