//! The demo's child processes: runs of this same program, watched and always ended.
//!
//! Each child reads a pipe whose other end only this process holds. When this process ends, however it does, the pipe
//! closes and the child ends itself. Children are in process groups of their own, so a Ctrl-C reaches only this
//! process, which ends them in order.

use std::fs::File;
use std::io;
use std::path::Path;
use std::process::{ExitStatus, Stdio};

use serde::Serialize;
use tokio::io::{AsyncBufReadExt, AsyncWriteExt, BufReader};
use tokio::process::{Child, ChildStdin, Command};
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinHandle;

use sgc_process::ProcessError;
use sgc_process::children::ROS_VARIABLES;

/// Most events of children in the queue.
const EVENTS_MAX: usize = 1024;
/// The name of a child process.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct ProcessName(pub(crate) &'static str);

/// An event of a child.
#[derive(Debug)]
pub(crate) enum ChildEvent {
    /// The child printed a line.
    Line(ProcessName, String),
    /// The child ended.
    Ended(ProcessName, io::Result<ExitStatus>),
}

impl ChildEvent {
    /// Returns the child and its failure, if it ended badly.
    fn failure(self) -> Option<(ProcessName, String)> {
        match self {
            Self::Ended(_, Ok(status)) if status.success() => None,
            Self::Ended(who, Ok(status)) => Some((who, status.to_string())),
            Self::Ended(who, Err(error)) => Some((who, error.to_string())),
            Self::Line(..) => None,
        }
    }
}

/// All children of a demo. Dropping it ends them.
pub(crate) struct Processes {
    children: Vec<ChildProcess>,
    events: mpsc::Sender<ChildEvent>,
    inbox: mpsc::Receiver<ChildEvent>,
}

struct ChildProcess {
    who: ProcessName,
    stdin: Option<ChildStdin>,
    kill: Option<oneshot::Sender<()>>,
    watcher: JoinHandle<()>,
}

impl Processes {
    /// Returns an empty set of children.
    pub(crate) fn new() -> Self {
        let (events, inbox) = mpsc::channel(EVENTS_MAX);
        Self { children: Vec::new(), events, inbox }
    }

    /// Starts `sgc` with these arguments. Its standard error goes to a file.
    pub(crate) fn start(&mut self, who: ProcessName, args: &[&str], log: &Path) -> Result<(), ProcessError> {
        let failed = |source| ProcessError::System { what: "cannot start a process of the demo", source };
        let log = File::create(log).map_err(|source| ProcessError::Write { path: log.to_owned(), source })?;
        let mut command = Command::new(std::env::current_exe().map_err(failed)?);
        command
            .args(args)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(log)
            .process_group(0)
            .kill_on_drop(true);
        for variable in ROS_VARIABLES {
            command.env_remove(variable);
        }
        let mut child = command.spawn().map_err(failed)?;
        let stdin = child.stdin.take();
        let (kill, killed) = oneshot::channel();
        let watcher = tokio::spawn(watch(who, child, self.events.clone(), killed));
        self.children.push(ChildProcess { who, stdin, kill: Some(kill), watcher });
        Ok(())
    }

    /// Sends a child a line of JSON.
    pub(crate) async fn tell(
        &mut self,
        who: ProcessName,
        message: &impl Serialize,
    ) -> Result<(), ProcessError> {
        let failed = |source| ProcessError::System { what: "cannot speak to a process of the demo", source };
        let mut line = serde_json::to_vec(message).map_err(|e| failed(e.into()))?;
        line.push(b'\n');
        let stdin = self.children.iter_mut().find(|c| c.who == who).and_then(|c| c.stdin.as_mut());
        match stdin {
            Some(stdin) => stdin.write_all(&line).await.map_err(failed),
            None => Err(failed(io::ErrorKind::NotConnected.into())),
        }
    }

    /// Returns the next event of a child. Cancel safe.
    pub(crate) async fn next(&mut self) -> ChildEvent {
        // Never `None`, because `self` holds a sender.
        match self.inbox.recv().await {
            Some(event) => event,
            None => std::future::pending().await,
        }
    }

    /// Asks these children to end by closing their standard input, and waits until they have. The caller bounds the
    /// wait. Appends children that ended badly to `failures`.
    pub(crate) async fn end(&mut self, those: &[ProcessName], failures: &mut Vec<(ProcessName, String)>) {
        for child in self.children.iter_mut().filter(|c| those.contains(&c.who)) {
            child.stdin = None;
        }
        for child in self.children.iter_mut().filter(|c| those.contains(&c.who)) {
            // A finished watcher must not be polled again.
            while !child.watcher.is_finished() {
                tokio::select! {
                    // A watcher that panicked has dropped its child, which kills it.
                    _ = &mut child.watcher => break,
                    // Events are taken meanwhile, because the channel is bounded.
                    Some(event) = self.inbox.recv() => failures.extend(event.failure()),
                }
            }
        }
        while let Ok(event) = self.inbox.try_recv() {
            failures.extend(event.failure());
        }
        self.children.retain(|c| !those.contains(&c.who));
    }

    /// Kills the remaining children.
    pub(crate) async fn kill(&mut self) {
        for child in &mut self.children {
            child.kill = None;
        }
        let left: Vec<ProcessName> = self.children.iter().map(|c| c.who).collect();
        self.end(&left, &mut Vec::new()).await;
    }
}

/// Waits for a child and passes on its lines. Kills the child when the other end of `killed` is dropped.
async fn watch(
    who: ProcessName,
    mut child: Child,
    events: mpsc::Sender<ChildEvent>,
    killed: oneshot::Receiver<()>,
) {
    let lines = child.stdout.take().map(|out| BufReader::new(out).lines());
    let printed = async {
        let Some(mut lines) = lines else { return };
        while let Ok(Some(line)) = lines.next_line().await {
            let _ = events.send(ChildEvent::Line(who, line)).await;
        }
    };
    let status = tokio::select! {
        // Reading ends with the child, so its lines come before its end.
        status = async { printed.await; child.wait().await } => status,
        _ = killed => match child.start_kill() {
            Ok(()) => child.wait().await,
            Err(error) => Err(error),
        },
    };
    let _ = events.send(ChildEvent::Ended(who, status)).await;
}
