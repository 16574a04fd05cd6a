//! `sgc topic`: what is on the local network and on the far side of it, without a ROS 2 installation.
//!
//! The node that runs here says what there is and shows copies of messages; this makes tables, YAML and figures of it.

mod echo;
mod info;
mod list;
mod publish;
mod rates;

use std::io::{Read as _, Write as _};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use clap::{Args, Subcommand, ValueEnum};
use serde::Deserialize;
use sgc_cdr::DESCRIPTION_BYTES_MAX;
use sgc_node::admin::{AdminRequest, TapHead};
use sgc_node::graph::{Graph, Side};

use crate::error::CliError;
use crate::status;

/// How long a node may take to answer.
const ANSWER_MAX: Duration = Duration::from_secs(5);
/// How long making a local reader may take.
const BEGIN_MAX: Duration = Duration::from_secs(30);
/// Longest first line of what a tap says: a description in base64 fits.
const FIRST_LINE_BYTES_MAX: usize = 4096 + DESCRIPTION_BYTES_MAX * 4 / 3;
/// The largest message that is read: what a node carries is smaller.
const MESSAGE_BYTES_MAX: u32 = 256 << 20;

/// List topics here and on the far side, show their messages and how often they come, publish; no ROS 2 installation is needed
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
}

/// Which node is asked.
#[derive(Debug, Args)]
pub(crate) struct NodeArgs {
    /// The node's configuration; without it, the one node that this user runs here
    #[arg(short, long, value_name = "FILE", conflicts_with_all = ["socket", "node"])]
    config: Option<PathBuf>,
    /// The node's name, if its socket is in the usual place
    #[arg(long, value_name = "NAME", conflicts_with = "socket")]
    node: Option<String>,
    /// The node's status socket
    #[arg(long, value_name = "PATH")]
    socket: Option<PathBuf>,
}

/// Which messages of a topic are looked at.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub(crate) enum SideArg {
    /// What is published on the local network
    Local,
    /// What comes from the far side and is given to the local network
    Far,
    /// What goes from here to the far side
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

/// A topic that is looked at.
#[derive(Debug, Args)]
struct TapArgs {
    /// The topic, as it is called on this node's local network
    topic: String,
    /// Which of its messages; without it, those from the far side if the topic is used here, else the local ones
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
    }
}

impl NodeArgs {
    /// The node at this socket.
    pub(crate) fn at(socket: &Path) -> Self {
        Self { config: None, node: None, socket: Some(socket.to_owned()) }
    }

    /// Where the node is asked.
    pub(crate) fn socket(&self) -> Result<PathBuf, CliError> {
        let named = self.node.as_deref().map(sgc_node::default_socket_path);
        status::socket(self.config.as_deref(), named.as_deref().or(self.socket.as_deref()))
    }

    /// What there is.
    pub(crate) fn graph(&self, name: Option<sgc_wire::Name>) -> Result<Graph, CliError> {
        let socket = self.socket()?;
        let text = status::ask(&socket, &AdminRequest::Graph(name), ANSWER_MAX)?;
        answer(&socket, &text)
    }
}

#[derive(Debug, Deserialize)]
enum Answer<T> {
    #[serde(rename = "ok")]
    Done(T),
    #[serde(rename = "error")]
    Refused(String),
}

/// What a node answered.
pub(crate) fn answer<T: serde::de::DeserializeOwned>(socket: &Path, text: &str) -> Result<T, CliError> {
    match serde_json::from_str(text) {
        Ok(Answer::Done(what)) => Ok(what),
        Ok(Answer::Refused(reason)) => Err(CliError::NotSeen { reason }),
        Err(_) => Err(CliError::NotAStatus {
            path: socket.to_owned(),
            reason: "it does not know what it was asked: it is of an earlier version; restart it".to_owned(),
        }),
    }
}

/// What a node says of a topic before it shows it.
#[derive(Debug, Deserialize)]
struct Shown {
    #[serde(rename = "type")]
    type_name: String,
    type_hash: Option<String>,
    described: Option<Told>,
}

/// What a node knows of a type.
#[derive(Debug, Deserialize)]
struct Told {
    type_hash: String,
    /// In base64.
    description: String,
}

/// A topic that is shown.
#[derive(Debug)]
struct Tap {
    socket: PathBuf,
    stream: UnixStream,
    shown: Shown,
}

impl TapArgs {
    /// Begins to look; at most so many bytes of each message.
    fn begin(&self, bytes: u32) -> Result<Tap, CliError> {
        let socket = self.node.socket()?;
        let request = AdminRequest::Tap { topic: self.topic.clone(), side: self.side.map(Into::into), bytes };
        let no_node = |error: std::io::Error| status::no_node(&socket, &error, BEGIN_MAX);
        let mut stream = status::connect(&socket, BEGIN_MAX)?;
        stream.set_read_timeout(Some(BEGIN_MAX)).map_err(no_node)?;
        stream.write_all(request.to_line().as_bytes()).map_err(no_node)?;
        let mut line = Vec::new();
        // What refuses has no end of line.
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
    /// The next message, and what is carried of it; `None` once there is no more, or after `patience` without any.
    fn next(&mut self, patience: Option<Duration>) -> Result<Option<(TapHead, Vec<u8>)>, CliError> {
        let broken = |socket: &Path, error: &std::io::Error| {
            status::no_node(socket, error, patience.unwrap_or_default())
        };
        self.stream.set_read_timeout(patience).map_err(|e| broken(&self.socket, &e))?;
        let mut head = [0; TapHead::BYTES];
        match self.stream.read_exact(&mut head) {
            Ok(()) => {}
            Err(error) => {
                use std::io::ErrorKind::{TimedOut, UnexpectedEof, WouldBlock};
                return match error.kind() {
                    UnexpectedEof | WouldBlock | TimedOut => Ok(None),
                    _ => Err(broken(&self.socket, &error)),
                };
            }
        }
        let head = TapHead::from_bytes(&head);
        if head.carried > MESSAGE_BYTES_MAX {
            return Err(CliError::NotAStatus {
                path: self.socket.clone(),
                reason: format!("a message of {} bytes", head.carried),
            });
        }
        let mut payload = vec![0; head.carried as usize];
        self.stream.set_read_timeout(Some(BEGIN_MAX)).map_err(|e| broken(&self.socket, &e))?;
        self.stream.read_exact(&mut payload).map_err(|e| broken(&self.socket, &e))?;
        Ok(Some((head, payload)))
    }
}

/// A type and a message, either of which may have been left out: what is alone is a type if it looks like one.
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
    fn a_type_is_told_from_a_message() {
        for name in ["std_msgs/String", "std_msgs/msg/String"] {
            assert_eq!(type_and_message(Some(name), None), (Some(name), None));
            assert_eq!(type_and_message(Some(name), Some("{}")), (Some(name), Some("{}")));
        }
        for message in ["data: a/b", "{}", "hello", "{a: b/c}"] {
            assert_eq!(type_and_message(Some(message), None), (None, Some(message)));
        }
    }
}
