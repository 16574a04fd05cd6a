//! Asks the nodes of this user over their status sockets.

use std::io::{Read, Write};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::time::{Duration, Instant};

use serde::Deserialize;
use sgc_node::admin::AdminRequest;
use sgc_node::config::Config;
use sgc_node::graph::Graph;
use sgc_node::{NodeError, SocketError};
use sgc_wire::Name;

use crate::error::DiagnosisError;

/// Longest time a node may take to answer.
pub const ANSWER_MAX: Duration = Duration::from_secs(5);
/// Largest answer that is read.
const STATUS_BYTES_MAX: usize = 64 * 1024 * 1024;
/// Bytes that are read at a time.
const READ_BYTES: usize = 64 * 1024;

/// Asks the node at a socket for its graph. `name` adds what a router knows of this name.
pub fn graph(socket: &Path, name: Option<Name>) -> Result<Graph, DiagnosisError> {
    let text = ask(socket, &AdminRequest::Graph(name), ANSWER_MAX)?;
    answer(socket, &text)
}

#[derive(Debug, Deserialize)]
enum Answer<T> {
    #[serde(rename = "ok")]
    Done(T),
    #[serde(rename = "error")]
    Refused(String),
}

/// Parses a node's answer.
pub fn answer<T: serde::de::DeserializeOwned>(socket: &Path, text: &str) -> Result<T, DiagnosisError> {
    match serde_json::from_str(text) {
        Ok(Answer::Done(what)) => Ok(what),
        Ok(Answer::Refused(reason)) => Err(DiagnosisError::NotSeen { reason }),
        Err(_) => Err(DiagnosisError::NotAStatus {
            path: socket.to_owned(),
            reason: match text.trim() {
                "" => "it gave no answer: the node is starting or ending; ask again",
                _ => "it does not know what it was asked: it is of an earlier version; restart it",
            }
            .to_owned(),
        }),
    }
}

/// Returns the name of the node that has this configuration.
pub fn node_name(config: &Config) -> Result<String, NodeError> {
    match &config.node_name {
        Some(name) => Ok(name.to_string()),
        None => Ok(sgc_node::load_identity(&config.identity)?.node_name().to_string()),
    }
}

/// Explains why no node answers at this socket.
pub fn no_node(socket: &Path, error: &std::io::Error, patience: Duration) -> DiagnosisError {
    DiagnosisError::NoNode {
        path: socket.to_owned(),
        reason: match error.kind() {
            std::io::ErrorKind::NotFound => "there is no such socket".to_owned(),
            std::io::ErrorKind::ConnectionRefused => "its socket is left over".to_owned(),
            std::io::ErrorKind::WouldBlock => format!("it did not answer within {} s", patience.as_secs()),
            _ => error.to_string(),
        },
    }
}

/// Connects to the node at a status socket, if it is this user's or root's.
pub fn connect(socket: &Path, patience: Duration) -> Result<UnixStream, DiagnosisError> {
    sgc_node::admin::connect(socket).map_err(|error| match error {
        SocketError::Io(error) => no_node(socket, &error, patience),
        untrusted => DiagnosisError::NoNode { path: socket.to_owned(), reason: untrusted.to_string() },
    })
}

/// Asks a node and returns its raw answer, which has to be whole within `patience`.
pub fn ask(socket: &Path, request: &AdminRequest, patience: Duration) -> Result<String, DiagnosisError> {
    let no_node = |error: std::io::Error| no_node(socket, &error, patience);
    let mut stream = connect(socket, patience)?;
    // `None` waits for ever.
    let until = Instant::now().checked_add(patience);
    stream.set_write_timeout(Some(patience)).map_err(no_node)?;
    // A node of an earlier version answers without reading.
    let _ = stream.write_all(request.to_line().as_bytes());
    let mut answer = Vec::new();
    let mut buffer = vec![0; READ_BYTES];
    while answer.len() < STATUS_BYTES_MAX {
        let left = until.map(|until| until.saturating_duration_since(Instant::now()));
        if left.is_some_and(|left| left.is_zero()) {
            return Err(no_node(std::io::ErrorKind::WouldBlock.into()));
        }
        stream.set_read_timeout(left).map_err(no_node)?;
        match stream.read(&mut buffer) {
            Ok(0) => break,
            Ok(read) => answer.extend(buffer.iter().take(read)),
            Err(error) if error.kind() == std::io::ErrorKind::Interrupted => {}
            Err(error) => return Err(no_node(error)),
        }
    }
    String::from_utf8(answer).map_err(|_| no_node(std::io::ErrorKind::InvalidData.into()))
}
