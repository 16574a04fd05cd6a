//! `sgc topic`: shows topics of the local network and of the far side, without a ROS 2 installation.
//!
//! The running node lists topics and copies messages. This module prints them as tables, YAML and figures.

mod echo;
mod info;
mod list;
mod publish;
mod rates;
mod resume;

use std::io::{Read as _, Write as _};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use clap::{Args, Subcommand, ValueEnum};
use serde::Deserialize;
use sgc_cdr::DESCRIPTION_BYTES_MAX;
use sgc_diagnosis::DiagnosisError;
use sgc_diagnosis::ask::{self, answer};
use sgc_node::admin::{AdminRequest, TapHead};
use sgc_node::graph::Side;

use crate::error::CliError;
use crate::node::NodeArgs;

/// Longest time a node may take to create a local reader.
const BEGIN_MAX: Duration = Duration::from_secs(30);
/// Longest first line of a tap. A type description in base64 fits.
const FIRST_LINE_BYTES_MAX: usize = 4096 + DESCRIPTION_BYTES_MAX * 4 / 3;
/// Largest message that is read. Nodes carry only smaller ones.
const MESSAGE_BYTES_MAX: u32 = 256 << 20;

/// List, show, measure and publish topics here and on the far side, without a ROS 2 installation
#[derive(Debug, Args)]
pub(crate) struct TopicArgs {
    #[command(subcommand)]
    command: TopicCommand,
}

#[derive(Debug, Subcommand)]
enum TopicCommand {
    List(list::ListArgs),
    Info(info::InfoArgs),
    Echo(echo::EchoArgs),
    Pub(publish::PubArgs),
    Hz(rates::HzArgs),
    Bw(rates::BwArgs),
    Delay(rates::DelayArgs),
    Resume(resume::ResumeArgs),
}

/// The side on which messages of a topic are copied.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub(crate) enum SideArg {
    /// Messages published on the local network
    Local,
    /// Messages from the far side, as they are written to the local network
    Far,
    /// Messages sent from here to the far side
    Sent,
}

impl From<SideArg> for Side {
    fn from(side: SideArg) -> Self {
        match side {
            SideArg::Local => Self::Local,
            SideArg::Far => Self::Far,
            SideArg::Sent => Self::Sent,
        }
    }
}

/// A topic whose messages are shown.
#[derive(Debug, Args)]
struct TapArgs {
    /// Topic, by its name on this node's local network
    topic: String,
    /// Side on which messages are copied; without it, the far side if the topic is used here, else the local network
    #[arg(long, value_enum)]
    side: Option<SideArg>,
    #[command(flatten)]
    node: NodeArgs,
}

/// Runs `sgc topic`.
pub(crate) fn topic(args: &TopicArgs) -> Result<ExitCode, CliError> {
    match &args.command {
        TopicCommand::List(args) => list::list(args),
        TopicCommand::Info(args) => info::info(args),
        TopicCommand::Echo(args) => echo::echo(args),
        TopicCommand::Pub(args) => publish::publish(args),
        TopicCommand::Hz(args) => rates::hz(args),
        TopicCommand::Bw(args) => rates::bw(args),
        TopicCommand::Delay(args) => rates::delay(args),
        TopicCommand::Resume(args) => resume::resume(args),
    }
}

/// The first line of a tap: the type of the topic.
#[derive(Debug, Deserialize)]
struct TapType {
    #[serde(rename = "type")]
    type_name: String,
    type_hash: Option<String>,
    described: Option<TypeInfo>,
}

/// A type's hash and its description, as the node has it.
#[derive(Debug, Deserialize)]
struct TypeInfo {
    type_hash: String,
    /// In base64.
    description: String,
}

/// A stream of copied messages from a node.
#[derive(Debug)]
struct Tap {
    socket: PathBuf,
    stream: UnixStream,
    shown: TapType,
}

impl TapArgs {
    /// Opens the tap. `bytes` limits how much of each message the node copies.
    fn begin(&self, bytes: u32) -> Result<Tap, CliError> {
        let socket = self.node.socket()?;
        let request = AdminRequest::Tap { topic: self.topic.clone(), side: self.side.map(Into::into), bytes };
        let no_node = |error: std::io::Error| ask::no_node(&socket, &error, BEGIN_MAX);
        let mut stream = ask::connect(&socket, BEGIN_MAX)?;
        stream.set_read_timeout(Some(BEGIN_MAX)).map_err(no_node)?;
        stream.write_all(request.to_line().as_bytes()).map_err(no_node)?;
        let mut line = Vec::new();
        // A refusal has no end of line.
        while line.len() < FIRST_LINE_BYTES_MAX && line.last() != Some(&b'\n') {
            let mut byte = [0];
            if stream.read(&mut byte).map_err(no_node)? == 0 {
                break;
            }
            line.extend(byte);
        }
        let shown = answer(&socket, &String::from_utf8_lossy(&line))?;
        Ok(Tap { socket, stream, shown })
    }
}

impl Tap {
    /// Returns the next message and its copied bytes. Returns `None` at the end of the stream, or after `patience`
    /// without a message.
    fn next(&mut self, patience: Option<Duration>) -> Result<Option<(TapHead, Vec<u8>)>, CliError> {
        let broken =
            |socket: &Path, error: &std::io::Error| ask::no_node(socket, error, patience.unwrap_or_default());
        self.stream.set_read_timeout(patience).map_err(|e| broken(&self.socket, &e))?;
        let mut head = [0; TapHead::BYTES];
        match self.stream.read_exact(&mut head) {
            Ok(()) => {}
            Err(error) => {
                use std::io::ErrorKind::{TimedOut, UnexpectedEof, WouldBlock};
                return match error.kind() {
                    UnexpectedEof | WouldBlock | TimedOut => Ok(None),
                    _ => Err(broken(&self.socket, &error).into()),
                };
            }
        }
        let head = TapHead::from_bytes(&head);
        if head.carried > MESSAGE_BYTES_MAX {
            return Err(DiagnosisError::NotAStatus {
                path: self.socket.clone(),
                reason: format!("a message of {} bytes", head.carried),
            }
            .into());
        }
        let mut payload = vec![0; head.carried as usize];
        self.stream.set_read_timeout(Some(BEGIN_MAX)).map_err(|e| broken(&self.socket, &e))?;
        self.stream.read_exact(&mut payload).map_err(|e| broken(&self.socket, &e))?;
        Ok(Some((head, payload)))
    }
}

/// Splits the arguments into a type and a message; either may be left out. A single argument is a type if it looks like
/// one.
pub(crate) fn type_and_message<'a>(
    first: Option<&'a str>,
    second: Option<&'a str>,
) -> (Option<&'a str>, Option<&'a str>) {
    let is_type = |text: &str| {
        text.contains('/') && text.bytes().all(|b| b.is_ascii_alphanumeric() || b"_/".contains(&b))
    };
    match (first, second) {
        (Some(only), None) if !is_type(only) => (None, Some(only)),
        both => both,
    }
}

#[cfg(test)]
mod tests {
    use super::type_and_message;

    #[test]
    fn single_argument_is_type_or_message_by_its_form() {
        for name in ["std_msgs/String", "std_msgs/msg/String"] {
            assert_eq!(type_and_message(Some(name), None), (Some(name), None));
            assert_eq!(type_and_message(Some(name), Some("{}")), (Some(name), Some("{}")));
        }
        for message in ["data: a/b", "{}", "hello", "{a: b/c}"] {
            assert_eq!(type_and_message(Some(message), None), (None, Some(message)));
        }
    }
}
