//! Measured processes: started, found by the address that they print, ended by closing their standard input.

use std::collections::HashMap;
use std::ffi::OsString;
use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};

/// Time-out that no working process reaches.
pub(crate) const PATIENCE: Duration = Duration::from_secs(60);

/// A process that serves until it is dropped.
pub(crate) struct Server {
    child: Child,
    /// The first line of its output.
    pub(crate) greeting: String,
}

impl Server {
    /// Starts a process and waits for its first line. The process has to end when its standard input does.
    pub(crate) fn start(command: &mut Command) -> Result<Self> {
        let mut child = command
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .with_context(|| format!("{command:?}"))?;
        let mut greeting = String::new();
        let stdout = child.stdout.take().context("no standard output")?;
        BufReader::new(stdout).read_line(&mut greeting)?;
        if greeting.is_empty() {
            bail!("{command:?} ends with {}", child.wait()?);
        }
        Ok(Self { child, greeting: greeting.trim().to_owned() })
    }

    /// Starts this program once more, as `role`.
    pub(crate) fn own(role: &str) -> Result<Self> {
        Self::start(Command::new(std::env::current_exe()?).arg(role))
    }

    /// Returns its process id.
    pub(crate) fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Returns the CPU time of its threads, user and system, in seconds.
    pub(crate) fn cpu_seconds(&self) -> f64 {
        cpu_seconds(&format!("/proc/{}/task", self.child.id()))
    }

    /// Returns its resident memory in bytes.
    pub(crate) fn resident_bytes(&self) -> u64 {
        resident_bytes(&format!("/proc/{}/status", self.child.id()))
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        drop(self.child.stdin.take());
        let deadline = Instant::now() + PATIENCE;
        while Instant::now() < deadline {
            if !matches!(self.child.try_wait(), Ok(None)) {
                return;
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Blocks until standard input ends, as a [`Server`] of this program does when it is up.
pub(crate) fn until_stdin_closes() {
    let mut rest = Vec::new();
    let _ = std::io::stdin().lock().read_to_end(&mut rest);
}

/// `sgc run` as a router.
pub(crate) struct SgcRouter {
    pub(crate) process: Server,
    /// The URL on which it listens.
    pub(crate) url: String,
    socket: PathBuf,
}

impl SgcRouter {
    /// Starts a router in `dir`, with the identity in `router.identity` there.
    pub(crate) fn start(sgc: &Path, dir: &Path) -> Result<Self> {
        Self::start_on("quic", sgc, dir)
    }

    /// Starts a router with a listener of this scheme.
    pub(crate) fn start_on(scheme: &str, sgc: &Path, dir: &Path) -> Result<Self> {
        Self::start_as(scheme, sgc, dir, "", "")
    }

    /// Starts one with further lines in `[node]` and in `[router]`.
    pub(crate) fn start_as(scheme: &str, sgc: &Path, dir: &Path, node: &str, router: &str) -> Result<Self> {
        let (config, socket) = (dir.join("router.toml"), dir.join("router.sock"));
        let text = format!(
            "identity = \"router.identity\"\n[node]\nstate = \"router.state\"\n\
             {node}[router]\n{router}listen = [\"{scheme}://127.0.0.1:0\"]\n[admin]\nsocket = {:?}\n",
            socket.display().to_string()
        );
        fs::write(&config, text)?;
        let sgc = sgc.canonicalize().with_context(|| format!("{}: is it built?", sgc.display()))?;
        let mut command = Command::new(sgc);
        command.args(["run", "--print-ready", "--until-stdin-closes", "--log", "warn", "--config"]);
        let process = Server::start(command.arg(&config))?;
        let ready: serde_json::Value = serde_json::from_str(&process.greeting)?;
        let url = ready["ready"][0].as_str().context("it listens nowhere")?.to_owned();
        Ok(Self { process, url, socket })
    }

    /// Returns its status document.
    pub(crate) fn status(&self) -> Result<serde_json::Value> {
        status(&self.socket)
    }

    /// Returns the number of names for which it has a route.
    pub(crate) fn routed_names(&self) -> Result<u64> {
        self.status()?["router"]["routed_names"].as_u64().context("a status without `routed_names`")
    }

    /// Returns the number of its links.
    pub(crate) fn links(&self) -> Result<usize> {
        Ok(self.status()?["links"].as_array().context("a status without `links`")?.len())
    }

    /// Waits until the router has a route for so many names, while their number grows. Counting them takes the router's
    /// time, so slow answers make it ask less often.
    pub(crate) fn until_routed(&self, names: u64) -> Result<()> {
        let (mut most, mut deadline) = (0, Instant::now() + PATIENCE);
        loop {
            let asked = Instant::now();
            let routed = self.routed_names()?;
            if routed == names {
                return Ok(());
            }
            if routed > most {
                (most, deadline) = (routed, asked + PATIENCE);
            }
            if asked > deadline {
                bail!("the router has {routed} names with a route instead of {names}");
            }
            std::thread::sleep((asked.elapsed() * 4).max(Duration::from_millis(2)));
        }
    }
}

/// Asks a node for its status.
pub(crate) fn status(socket: &Path) -> Result<serde_json::Value> {
    let mut stream = UnixStream::connect(socket).with_context(|| socket.display().to_string())?;
    stream.write_all(sgc_node::admin::AdminRequest::Status.to_line().as_bytes())?;
    let mut text = String::new();
    stream.read_to_string(&mut text)?;
    Ok(serde_json::from_str(&text)?)
}

/// CPU time that the threads of this process have taken, user and system, seconds.
pub(crate) fn own_cpu_seconds() -> f64 {
    cpu_seconds("/proc/self/task")
}

/// CPU time that the threads of a process have taken, those that have ended not counted, seconds.
pub(crate) fn cpu_seconds_of(pid: u32) -> f64 {
    cpu_seconds(&format!("/proc/{pid}/task"))
}

/// Resident memory of a process, bytes: now, and the most it ever was.
pub(crate) fn resident_bytes_of(pid: u32) -> (u64, u64) {
    let status = format!("/proc/{pid}/status");
    (field_kib(&status, "VmRSS") * 1024, field_kib(&status, "VmHWM") * 1024)
}

/// CPU time of each thread that a process has now, seconds.
pub(crate) fn thread_seconds_of(pid: u32) -> HashMap<OsString, f64> {
    let threads = fs::read_dir(format!("/proc/{pid}/task")).into_iter().flatten().flatten();
    let spent = |task: fs::DirEntry| {
        let text = fs::read_to_string(task.path().join("schedstat")).ok()?;
        Some((task.file_name(), text.split(' ').next()?.parse::<f64>().ok()? / 1e9))
    };
    threads.filter_map(spent).collect()
}

/// A number of a process's /proc/PID/status, in the unit that stands there.
pub(crate) fn status_field_of(pid: u32, field: &str) -> Result<u64> {
    let text = fs::read_to_string(format!("/proc/{pid}/status"))?;
    let line = text.lines().find_map(|line| line.strip_prefix(field)?.strip_prefix(':'));
    let value = line.and_then(|line| line.split_whitespace().next()?.parse().ok());
    value.with_context(|| format!("a process without {field}"))
}

fn cpu_seconds(tasks: &str) -> f64 {
    let spent = |task: fs::DirEntry| {
        let text = fs::read_to_string(task.path().join("schedstat")).ok()?;
        text.split(' ').next()?.parse::<f64>().ok()
    };
    fs::read_dir(tasks).into_iter().flatten().flatten().filter_map(spent).sum::<f64>() / 1e9
}

/// Resident memory of this process, bytes.
pub(crate) fn own_resident_bytes() -> u64 {
    resident_bytes("/proc/self/status")
}

fn resident_bytes(status: &str) -> u64 {
    field_kib(status, "VmRSS") * 1024
}

/// A line of /proc/meminfo.
pub(crate) fn memory_kib(field: &str) -> u64 {
    field_kib("/proc/meminfo", field)
}

fn field_kib(path: &str, field: &str) -> u64 {
    let text = fs::read_to_string(path).unwrap_or_default();
    let line = text.lines().find_map(|line| line.strip_prefix(field)?.strip_prefix(':'));
    line.and_then(|l| l.trim().trim_end_matches(" kB").parse().ok()).unwrap_or(0)
}
