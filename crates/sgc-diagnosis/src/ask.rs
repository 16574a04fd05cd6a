//! Asks the nodes of this user over their status sockets.

use std::io::{Read, Write};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::Deserialize;
use sgc_node::admin::AdminRequest;
use sgc_node::config::Config;
use sgc_node::graph::Graph;
use sgc_node::{NodeError, SocketError};
use sgc_process::files;
use sgc_wire::Name;

use crate::error::DiagnosisError;

/// Longest time a node may take to answer.
pub const ANSWER_MAX: Duration = Duration::from_secs(5);
/// Largest answer that is read.
const STATUS_BYTES_MAX: u64 = 64 * 1024 * 1024;
const SOCKET_EXTENSION: &str = "sock";

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

/// Returns the sockets of this user's nodes in their usual place, whether a node answers there or not.
pub fn usual_sockets() -> Vec<PathBuf> {
    let usual = sgc_node::default_socket_path("node");
    let dir = usual.parent().unwrap_or(Path::new("/"));
    files::with_extension(dir, SOCKET_EXTENSION).unwrap_or_default()
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

/// Asks a node and returns its raw answer.
pub fn ask(socket: &Path, request: &AdminRequest, patience: Duration) -> Result<String, DiagnosisError> {
    let no_node = |error: std::io::Error| no_node(socket, &error, patience);
    let mut stream = connect(socket, patience)?;
    stream.set_read_timeout(Some(patience)).map_err(no_node)?;
    stream.set_write_timeout(Some(patience)).map_err(no_node)?;
    // A node of an earlier version answers without reading.
    let _ = stream.write_all(request.to_line().as_bytes());
    let mut text = String::new();
    stream.take(STATUS_BYTES_MAX).read_to_string(&mut text).map_err(no_node)?;
    Ok(text)
}
