//! `sgc bench`: what two machines of one fleet get from `sgc` between them, beside what the network itself gives.
//!
//! One side answers, the other measures. Both run a node with an ordinary identity and a DDS program in a private domain
//! beside it, as in [`crate::demo`], so the whole way is measured: DDS, node, network, node, DDS, and back. They talk over
//! topics that `sgc` carries, so nobody else is heard.

mod answer;
mod echo;
mod machine;
mod measure;
mod program;
mod report;
mod side;
mod words;

use std::process::ExitCode;
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::{Duration, Instant};

use clap::{Args, Subcommand};
use sgc_node::config::RouterUrl;
use sgc_transport::ListenAddr;

use self::side::Side;
use self::words::{Frame, Lane};
use crate::error::CliError;

/// Events that wait to be looked at.
const EVENTS_MAX: usize = 4096;
/// How long a node may take to start.
const READY_MAX: Duration = Duration::from_secs(30);

/// Measure what sgc gives you between two of your machines, beside what the network itself gives
///
/// On one machine `sgc bench answer`, on the other `sgc bench run`: round trips, throughput, loss and CPU, with DDS on both
/// ends; beside it plain TCP and UDP, and DDS without sgc if it reaches.
#[derive(Debug, Args)]
pub(crate) struct BenchArgs {
    #[command(subcommand)]
    command: BenchCommand,
}

#[derive(Debug, Subcommand)]
enum BenchCommand {
    Answer(answer::AnswerArgs),
    Run(measure::MeasureArgs),
}

/// Runs `sgc bench`.
pub(crate) fn bench(args: BenchArgs) -> Result<ExitCode, CliError> {
    match args.command {
        BenchCommand::Answer(args) => answer::answer(&args),
        BenchCommand::Run(args) => measure::measure(&args),
    }
    .map(|()| ExitCode::SUCCESS)
}

/// What happens to one side.
#[derive(Debug)]
enum Event {
    /// A message came, and when.
    Frame(Lane, Frame, Instant),
    /// The user has had enough.
    Interrupted,
    /// The node ended.
    NodeEnded,
    /// The node is up, and listens at these URLs.
    NodeReady(Vec<String>),
}

/// Where a router or the other side is, as it will stand in a configuration.
fn router_url(text: &str) -> Result<String, String> {
    text.parse::<RouterUrl>().map(|_| text.to_owned()).map_err(|fault| fault.to_string())
}

/// Where to listen, in the same way.
fn listen_addr(text: &str) -> Result<String, String> {
    text.parse::<ListenAddr>().map(|_| text.to_owned()).map_err(|fault| fault.to_string())
}

/// Why it does not go on, in one line.
fn failed(reason: impl Into<String>) -> CliError {
    CliError::Bench { reason: reason.into(), facts: Vec::new() }
}

/// The next event, if there is one by then. That the user has had enough, or the node ended, is an error.
fn next_event(events: &Receiver<Event>, side: &Side, until: Instant) -> Result<Option<Event>, CliError> {
    match events.recv_timeout(until.saturating_duration_since(Instant::now())) {
        Ok(Event::Interrupted) => Err(failed("interrupted")),
        Ok(Event::NodeEnded) => {
            let reason = "the node here ended; its last words:".to_owned();
            Err(CliError::Bench { reason, facts: side.last_words() })
        }
        Ok(event) => Ok(Some(event)),
        Err(RecvTimeoutError::Timeout) => Ok(None),
        Err(RecvTimeoutError::Disconnected) => Err(failed("nobody is left to say anything")),
    }
}

/// Waits for the node to be up: where it listens.
fn wait_ready(events: &Receiver<Event>, side: &Side) -> Result<Vec<String>, CliError> {
    let deadline = Instant::now() + READY_MAX;
    loop {
        match next_event(events, side, deadline)? {
            Some(Event::NodeReady(urls)) => return Ok(urls),
            Some(_) => {}
            None => {
                let reason =
                    format!("the node here is not up after {} s; its last words:", READY_MAX.as_secs());
                return Err(CliError::Bench { reason, facts: side.last_words() });
            }
        }
    }
}
