//! Nodes on hiroz, another implementation of rmw_zenoh's protocol, that do not know SGC.
//!
//! `../../README.md` specifies the command line and the printed lines.

mod actions;
mod interfaces;
mod options;
mod services;
mod topics;

use std::io::Write as _;
use std::process::ExitCode;
use std::time::Duration;

use clap::Parser as _;
use hiroz::context::{ZContext, ZContextBuilder};
use hiroz::node::ZNode;
use hiroz::{Builder as _, Result};
use options::{Options, Role, Session};
use serde_json::{Value, json};
use tokio::io::{AsyncBufReadExt as _, BufReader, stdin};
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::time::{Instant, sleep, sleep_until};

const OK: u8 = 0;
const WRONG: u8 = 1;
const REFUSED: u8 = 2;
const INCOMPLETE: u8 = 3;

const POLL: Duration = Duration::from_millis(20);

fn main() -> ExitCode {
    let options = Options::parse();
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    let code = runtime.block_on(perform(&options.role)).unwrap_or_else(|problem| {
        eprintln!("peer: {problem}");
        REFUSED
    });
    // A thread that reads standard input would keep the runtime.
    runtime.shutdown_background();
    ExitCode::from(code)
}

async fn perform(role: &Role) -> Result<u8> {
    match role {
        Role::Pub(options) => topics::publish(options, Run::new(&options.topic.session)?).await,
        Role::Sub(options) => topics::subscribe(options, Run::new(&options.topic.session)?).await,
        Role::Serve(options) => services::serve(options, Run::new(&options.session)?).await,
        Role::Call(options) => services::call(options, Run::new(&options.service.session)?).await,
        Role::ActionServe(options) => actions::serve(options, Run::new(&options.session)?).await,
        Role::ActionCall(options) => actions::call(options, Run::new(&options.action.session)?).await,
    }
}

fn emit(event: &str, fields: Value) {
    let mut line = json!({ "event": event });
    if let (Value::Object(line), Value::Object(fields)) = (&mut line, fields) {
        line.extend(fields);
    }
    let mut out = std::io::stdout().lock();
    if writeln!(out, "{line}").and_then(|()| out.flush()).is_err() {
        // The reader of standard output is gone.
        std::process::exit(INCOMPLETE.into());
    }
}

/// The end of a role: its deadline, or a signal.
struct Run {
    deadline: Instant,
    terminate: Signal,
    interrupt: Signal,
    by_signal: bool,
}

impl Run {
    fn new(session: &Session) -> Result<Self> {
        Ok(Self {
            deadline: Instant::now() + session.timeout,
            terminate: signal(SignalKind::terminate())?,
            interrupt: signal(SignalKind::interrupt())?,
            by_signal: false,
        })
    }

    fn is_over(&self) -> bool {
        self.by_signal || Instant::now() >= self.deadline
    }

    /// Returns the output of a future, or `None` if the end comes first.
    async fn within<T>(&mut self, future: impl Future<Output = T>) -> Option<T> {
        if self.is_over() {
            return None;
        }
        let by_signal = tokio::select! {
            output = future => return Some(output),
            () = sleep_until(self.deadline) => false,
            _ = self.terminate.recv() => true,
            _ = self.interrupt.recv() => true,
        };
        self.by_signal = by_signal;
        None
    }
}

/// Returns whether a line came on standard input.
async fn line() -> bool {
    let mut line = String::new();
    BufReader::new(stdin()).read_line(&mut line).await.is_ok_and(|bytes| bytes > 0)
}

/// Opens a session, waits for its router as a node of rmw_zenoh does, and makes a node.
async fn open(session: &Session, run: &Run) -> Result<(ZContext, ZNode)> {
    let context = ZContextBuilder::default()
        .with_domain_id(session.domain)
        .with_mode(&session.mode)
        .with_connect_endpoints([&session.connect])
        .build()?;
    let (namespace, name) = session.node.rsplit_once('/').unwrap_or(("", &session.node));
    let node = context.create_node(name).with_namespace(namespace).without_parameters().build()?;
    while node.session().info().routers_zid().await.next().is_none() {
        if run.is_over() {
            emit("no_router", json!({}));
            std::process::exit(INCOMPLETE.into());
        }
        sleep(POLL).await;
    }
    emit("session", json!({ "zid": node.session().zid().to_string() }));
    Ok((context, node))
}
