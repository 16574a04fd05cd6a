//! `sgc bench`: measures throughput and latency between two machines of one fleet, through `sgc` and through the bare network.
//!
//! One side answers, the other measures. Both run a node with an ordinary identity and a DDS program in a private domain, as
//! in [`crate::demo`]. So the measurement covers the whole path: DDS, node, network, node, DDS, and back. The sides talk
//! over topics that `sgc` carries, so they hear no other program.

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
use self::words::{Channel, Frame};
use crate::error::CliError;

/// Most events in the queue of one side.
const EVENTS_MAX: usize = 4096;
/// Longest time a node may take to start.
const READY_MAX: Duration = Duration::from_secs(30);

/// Measure throughput and latency between two of your machines, through sgc and through the bare network
///
/// Run `sgc bench answer` on one machine and `sgc bench run` on the other. They measure round trips, throughput, loss and CPU
/// with DDS on both ends, then plain TCP and UDP, and DDS without sgc if it can reach the other machine.
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

/// An event at one side.
#[derive(Debug)]
enum Event {
    /// A message arrived at this time.
    Frame(Channel, Frame, Instant),
    /// The user interrupted the program.
    Interrupted,
    /// The node ended.
    NodeEnded,
    /// The node is up and listens at these URLs.
    NodeReady(Vec<String>),
}

/// Checks the URL of a router or of the other side by the rules of a configuration.
fn router_url(text: &str) -> Result<String, String> {
    text.parse::<RouterUrl>().map(|_| text.to_owned()).map_err(|fault| fault.to_string())
}

/// Checks an address to listen on by the same rules.
fn listen_addr(text: &str) -> Result<String, String> {
    text.parse::<ListenAddr>().map(|_| text.to_owned()).map_err(|fault| fault.to_string())
}

/// Returns an error with this reason, in one line.
fn failed(reason: impl Into<String>) -> CliError {
    CliError::Bench { reason: reason.into(), facts: Vec::new() }
}

/// Returns the next event, or `None` if there is none by then. Fails if the user interrupts the program or the node ends.
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

/// Waits until the node is up. Returns the URLs at which it listens.
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
