//! `sgc topic pub`: publishes as `ros2 topic pub` does, through the running node.

use std::io::{BufRead as _, BufReader, Write as _};
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use clap::{Args, ValueEnum};
use sgc_diagnosis::DiagnosisError;
use sgc_diagnosis::ask::{self, ANSWER_MAX, answer};
use sgc_node::admin::AdminRequest;
use sgc_node::shell::{PublishReport, PublishRequest};
use sgc_process::ProcessError;

use super::{BEGIN_MAX, type_and_message};
use crate::error::{CliError, EXIT_FAILURE};
use crate::node::NodeArgs;
use crate::span::{millis, parse_span};
use crate::{output, yaml};

/// Default time between messages that are given as an argument.
const PERIOD_DEFAULT: Duration = Duration::from_secs(1);
/// Longest time between messages.
const PERIOD_MAX: Duration = Duration::from_secs(365 * 24 * 60 * 60);

#[derive(Clone, Copy, Debug, ValueEnum, PartialEq, Eq)]
enum ReliabilityArg {
    Reliable,
    BestEffort,
}

#[derive(Clone, Copy, Debug, ValueEnum, PartialEq, Eq)]
enum DurabilityArg {
    Volatile,
    TransientLocal,
}

/// Publish messages on a topic, in JSON or YAML
///
/// The node that runs here publishes the messages on its local network like any program there, and shared topics go to
/// the far side. Omitted members have their defaults. Without MESSAGE, each line of standard input is a message.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  sgc topic pub /cmd_vel geometry_msgs/msg/Twist '{linear: {x: 0.5}}' --rate 10
  sgc topic pub --once /arm/mode 'data: hello'")]
pub(crate) struct PubArgs {
    /// Name of the topic
    topic: String,
    /// Type of the topic; may be omitted if the topic exists already
    #[arg(value_name = "TYPE")]
    first: Option<String>,
    /// Message in JSON or YAML
    #[arg(value_name = "MESSAGE")]
    second: Option<String>,
    /// Messages per second [default: 1; lines of standard input are published as they come]
    #[arg(short = 'r', long = "rate", value_name = "HZ", value_parser = period)]
    period: Option<Duration>,
    /// Wait for a subscriber, publish once and end
    #[arg(short = '1', long, conflicts_with = "count")]
    once: bool,
    /// End after N messages
    #[arg(short = 'n', long, value_name = "N")]
    count: Option<u64>,
    /// Wait first for N subscribers on the local network, including the node's own for the far side [default: 1 with
    /// --once, else 0]
    #[arg(long, value_name = "N")]
    wait_subscribers: Option<u32>,
    /// Longest time to wait for subscribers
    #[arg(long, value_name = "TIME", default_value = "10s", value_parser = parse_span)]
    timeout: Duration,
    #[arg(long, value_enum, default_value = "reliable")]
    reliability: ReliabilityArg,
    #[arg(long, value_enum, default_value = "volatile")]
    durability: DurabilityArg,
    /// Number of messages kept for slow or late subscribers
    #[arg(long, value_name = "N")]
    depth: Option<u32>,
    #[command(flatten)]
    node: NodeArgs,
}

/// The times of messages.
struct Pace {
    /// Time between messages; none publishes each at once.
    period: Option<Duration>,
    /// Time of the next message.
    next: Instant,
}

impl Pace {
    /// Returns the time to wait before a message that is at hand.
    fn wait(&mut self, now: Instant) -> Duration {
        let Some(period) = self.period else { return Duration::ZERO };
        let wait = self.next.saturating_duration_since(now);
        // A pause is not made up for.
        let at = if now > self.next + period { now } else { self.next };
        self.next = at + period;
        wait
    }
}

/// A running node that publishes for this command.
struct Publisher {
    socket: PathBuf,
    from: BufReader<UnixStream>,
    into: UnixStream,
}

impl Publisher {
    fn begin(socket: PathBuf, wish: PublishRequest) -> Result<(Self, PublishReport), CliError> {
        let patience = BEGIN_MAX + Duration::from_millis(wish.wait_ms);
        let no_node = |error: std::io::Error| ask::no_node(&socket, &error, patience);
        let mut into = ask::connect(&socket, patience)?;
        into.set_read_timeout(Some(patience)).map_err(no_node)?;
        into.write_all(AdminRequest::Publish(wish).to_line().as_bytes()).map_err(no_node)?;
        let from = BufReader::new(into.try_clone().map_err(no_node)?);
        let mut publisher = Self { socket, from, into };
        let published = publisher.answer()?;
        publisher.into.set_read_timeout(Some(ANSWER_MAX)).map_err(|e| publisher.broken(&e))?;
        Ok((publisher, published))
    }

    fn broken(&self, error: &std::io::Error) -> CliError {
        ask::no_node(&self.socket, error, ANSWER_MAX).into()
    }

    fn answer<T: serde::de::DeserializeOwned>(&mut self) -> Result<T, CliError> {
        let mut line = String::new();
        match self.from.read_line(&mut line) {
            Ok(0) => Err(DiagnosisError::NotSeen { reason: "the node stopped".to_owned() }.into()),
            Ok(_) => Ok(answer(&self.socket, line.trim_end())?),
            Err(error) => Err(self.broken(&error)),
        }
    }

    /// Publishes a message and returns the number of subscribers.
    fn publish(&mut self, json: &str) -> Result<u32, CliError> {
        let written = self.into.write_all(json.as_bytes()).and_then(|()| self.into.write_all(b"\n"));
        written.map_err(|error| self.broken(&error))?;
        self.answer()
    }
}

pub(super) fn publish(args: &PubArgs) -> Result<ExitCode, CliError> {
    let (type_name, message) = type_and_message(args.first.as_deref(), args.second.as_deref());
    let not_a_message = |reason: String| CliError::Cannot { reason: format!("the message: {reason}") };
    let message = message.map(yaml::json_of).transpose().map_err(not_a_message)?;
    let period = args.period.or(message.is_some().then_some(PERIOD_DEFAULT));
    let wait_for = args.wait_subscribers.unwrap_or(u32::from(args.once));
    let wish = PublishRequest {
        topic: args.topic.clone(),
        type_name: type_name.map(str::to_owned),
        best_effort: args.reliability == ReliabilityArg::BestEffort,
        transient_local: args.durability == DurabilityArg::TransientLocal,
        depth: args.depth,
        wait_for,
        wait_ms: millis(args.timeout),
    };
    let (mut publisher, begun) = Publisher::begin(args.node.socket()?, wish)?;
    if begun.subscribers < wait_for {
        output::diagnostic(&format!(
            "sgc: {}: {} subscribers after {} s: nothing was published",
            args.topic,
            begun.subscribers,
            args.timeout.as_secs()
        ));
        return Ok(ExitCode::from(EXIT_FAILURE));
    }
    let mut pace = Pace { period, next: Instant::now() };
    let most = if args.once { 1 } else { args.count.unwrap_or(u64::MAX) };
    let Some(message) = message else {
        let mut lines = std::io::stdin().lock().lines();
        for _ in 0..most {
            let Some(line) = lines.next() else { break };
            let line =
                line.map_err(|source| ProcessError::System { what: "cannot read messages", source })?;
            let message = yaml::json_of(&line).map_err(not_a_message)?;
            std::thread::sleep(pace.wait(Instant::now()));
            publisher.publish(&message)?;
        }
        return Ok(ExitCode::SUCCESS);
    };
    for sent in 1..=most {
        std::thread::sleep(pace.wait(Instant::now()));
        publisher.publish(&message)?;
        output::line(format!("published {sent}: {message}"))?;
    }
    Ok(ExitCode::SUCCESS)
}

/// Parses a rate in messages per second, and returns the time between messages.
fn period(rate: &str) -> Result<Duration, String> {
    let period = rate.parse().ok().and_then(|rate: f64| Duration::try_from_secs_f64(1.0 / rate).ok());
    let period = period.filter(|period| *period <= PERIOD_MAX);
    period.ok_or_else(|| "10 or 0.5, for example, and at least one message a year".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rate_of_less_than_one_message_a_year_is_refused() {
        let periods = ["10", "0.5", "inf"].map(|rate| period(rate).unwrap());
        assert_eq!(periods, [Duration::from_millis(100), Duration::from_secs(2), Duration::ZERO]);
        assert!(period("1e-7").is_ok_and(|period| period < PERIOD_MAX));
        for rate in ["", "fast", "nan", "0", "-1", "1e-8", "1e-19", "1e-300"] {
            assert!(period(rate).is_err(), "{rate}");
        }
    }

    #[test]
    fn messages_keep_their_rate_and_do_not_make_up_for_a_pause() {
        let begin = Instant::now();
        let at = |ms| begin + Duration::from_millis(ms);
        let mut pace = Pace { period: Some(Duration::from_millis(100)), next: begin };
        let waits = [0, 0, 130, 1000, 1001].map(|ms| pace.wait(at(ms)).as_millis());
        assert_eq!(waits, [0, 100, 70, 0, 99]);
        let mut unpaced = Pace { period: None, next: begin };
        assert_eq!([0, 0].map(|ms| unpaced.wait(at(ms))), [Duration::ZERO; 2]);
    }
}
