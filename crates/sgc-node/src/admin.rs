//! The status socket: how users and programs ask a running node something.
//!
//! One question a connection. Who asks nothing gets the status, as one JSON document; this is what the first version
//! did. Otherwise one line, `sgc/1 WORD [ARGUMENT]`, is answered with `{"ok": …}` or `{"error": "…"}`, except for
//! `status`, whose answer is the document itself. What is asked is carried out elsewhere.

use std::fs;
use std::io;
use std::os::unix::fs::{DirBuilderExt, PermissionsExt};
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use sgc_wire::CRL_BYTES_MAX;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{UnixListener, UnixStream};
use tokio::sync::{Semaphore, mpsc, oneshot};
use tracing::debug;

use crate::core::CoreEvent;
use crate::reload::Reloader;

/// What a line of a question begins with; the number is the version of the protocol.
pub const ADMIN_PREFIX: &str = "sgc/1 ";
/// Longest question, bytes: a revocation list in base64 fits.
pub const ADMIN_LINE_BYTES_MAX: usize = CRL_BYTES_MAX * 4 / 3 + 64;

/// Questions that are answered at one time; who comes later waits.
const CONNECTIONS_MAX: usize = 16;
/// How long a question is waited for before its absence counts as one for the status.
const SILENCE: Duration = Duration::from_millis(250);
/// How long a question that was begun may take, and how long its answer may be in being read.
const TRANSFER_MAX: Duration = Duration::from_secs(5);

/// What can be asked.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum AdminRequest {
    /// How things are.
    Status,
    /// Read the configuration again.
    Reload,
    /// Take this revocation list, DER.
    Crl(Vec<u8>),
}

impl AdminRequest {
    /// Reads a line, without its end.
    pub fn parse(line: &[u8]) -> Result<Self, AdminError> {
        let text = std::str::from_utf8(line).map_err(|_| AdminError::NotText)?;
        let text = text.trim_end_matches(['\r', '\n']);
        let Some(question) = text.strip_prefix(ADMIN_PREFIX) else {
            // The bare words are for people with a terminal.
            return match text {
                "" | "status" => Ok(Self::Status),
                _ => Err(AdminError::Version),
            };
        };
        match question.split_once(' ').unwrap_or((question, "")) {
            ("status", "") => Ok(Self::Status),
            ("reload", "") => Ok(Self::Reload),
            ("crl", list) => match STANDARD.decode(list) {
                Ok(list) if !list.is_empty() && list.len() <= CRL_BYTES_MAX => Ok(Self::Crl(list)),
                _ => Err(AdminError::Argument { word: "crl" }),
            },
            (word, _) => Err(AdminError::Unknown { word: word.chars().take(32).collect() }),
        }
    }

    /// The line to send, with its end.
    pub fn to_line(&self) -> String {
        match self {
            Self::Status => format!("{ADMIN_PREFIX}status\n"),
            Self::Reload => format!("{ADMIN_PREFIX}reload\n"),
            Self::Crl(list) => format!("{ADMIN_PREFIX}crl {}\n", STANDARD.encode(list)),
        }
    }
}

/// Why a question is none.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum AdminError {
    /// Not UTF-8.
    #[error("the question is not text")]
    NotText,
    /// Too long.
    #[error("the question has more than {ADMIN_LINE_BYTES_MAX} bytes")]
    TooLong,
    /// Begun and not ended.
    #[error("the question was not ended with a new line in time")]
    Unfinished,
    /// Another version.
    #[error("the question does not begin with {ADMIN_PREFIX:?}: this node speaks version 1")]
    Version,
    /// An argument that is none.
    #[error("{word:?} lacks a usable argument")]
    Argument {
        /// What was asked.
        word: &'static str,
    },
    /// A word that is not known.
    #[error("{word:?} is nothing that this node can be asked: status, reload and crl are")]
    Unknown {
        /// The word.
        word: String,
    },
}

/// Binds the socket for this user alone. One that a dead node left is replaced, a live one is not.
pub(crate) fn bind_socket(path: &Path) -> io::Result<UnixListener> {
    if let Some(directory) = path.parent() {
        fs::DirBuilder::new().recursive(true).mode(0o700).create(directory)?;
    }
    if std::os::unix::net::UnixStream::connect(path).is_ok() {
        return Err(io::Error::new(io::ErrorKind::AddrInUse, "another node answers there"));
    }
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
        _ => {}
    }
    let listener = UnixListener::bind(path)?;
    fs::set_permissions(path, fs::Permissions::from_mode(0o600))?;
    Ok(listener)
}

/// Answers until the node ends.
pub(crate) async fn serve(listener: UnixListener, events: mpsc::Sender<CoreEvent>, reloader: Arc<Reloader>) {
    let places = Arc::new(Semaphore::new(CONNECTIONS_MAX));
    while let Ok(place) = places.clone().acquire_owned().await {
        let Ok((stream, _)) = listener.accept().await else { return };
        if events.is_closed() {
            return;
        }
        let (events, reloader) = (events.clone(), reloader.clone());
        tokio::spawn(async move {
            if is_ours(&stream) {
                answer(stream, &events, &reloader).await;
            }
            drop(place);
        });
    }
}

/// The mode of the socket says so already, unless somebody changed it.
fn is_ours(stream: &UnixStream) -> bool {
    let own = rustix::process::geteuid().as_raw();
    stream.peer_cred().is_ok_and(|peer| peer.uid() == own || peer.uid() == 0)
}

async fn answer(mut stream: UnixStream, events: &mpsc::Sender<CoreEvent>, reloader: &Reloader) {
    let request = read_line(&mut stream).await.and_then(|line| AdminRequest::parse(&line));
    let text = match request {
        Ok(AdminRequest::Status) => match status(events).await {
            Some(text) => text,
            None => return,
        },
        Ok(request) => envelope(carry_out(request, events, reloader).await),
        Err(error) => envelope(Err(error.to_string())),
    };
    let write = async {
        stream.write_all(text.as_bytes()).await?;
        stream.shutdown().await
    };
    if !matches!(tokio::time::timeout(TRANSFER_MAX, write).await, Ok(Ok(()))) {
        debug!("who asked at the status socket did not read the answer");
    }
}

async fn read_line(stream: &mut UnixStream) -> Result<Vec<u8>, AdminError> {
    let mut line = Vec::new();
    let deadline = tokio::time::Instant::now() + TRANSFER_MAX;
    loop {
        let mut buffer = [0; 4096];
        let wait = if line.is_empty() { tokio::time::Instant::now() + SILENCE } else { deadline };
        let read = match tokio::time::timeout_at(wait, stream.read(&mut buffer)).await {
            Ok(Ok(n)) => n,
            Err(_) if line.is_empty() => return Ok(line),
            Ok(Err(_)) | Err(_) => return Err(AdminError::Unfinished),
        };
        let new = buffer.get(..read).unwrap_or_default();
        if let Some(end) = new.iter().position(|byte| *byte == b'\n') {
            line.extend(new.iter().take(end));
            return Ok(line);
        }
        line.extend(new);
        if line.len() > ADMIN_LINE_BYTES_MAX {
            return Err(AdminError::TooLong);
        }
        if read == 0 {
            return Ok(line);
        }
    }
}

async fn status(events: &mpsc::Sender<CoreEvent>) -> Option<String> {
    let (reply, status) = oneshot::channel();
    events.send(CoreEvent::Status(reply)).await.ok()?;
    serde_json::to_string(&status.await.ok()?).ok()
}

/// Gives JSON, or what went wrong.
async fn carry_out(
    request: AdminRequest,
    events: &mpsc::Sender<CoreEvent>,
    reloader: &Reloader,
) -> Result<String, String> {
    let stopping = || "the node is stopping".to_owned();
    match request {
        AdminRequest::Status => status(events).await.ok_or_else(stopping),
        AdminRequest::Reload => {
            let report = reloader.reload("sgc reload").await?;
            serde_json::to_string(&report).map_err(|error| error.to_string())
        }
        AdminRequest::Crl(der) => {
            let (reply, done) = oneshot::channel();
            events.send(CoreEvent::Crl { der: der.into(), reply }).await.map_err(|_| stopping())?;
            let is_news = done.await.map_err(|_| stopping())?.map_err(|error| error.to_string())?;
            Ok(serde_json::json!({ "news": is_news }).to_string())
        }
    }
}

fn envelope(result: Result<String, String>) -> String {
    match result {
        Ok(json) => format!("{{\"ok\":{json}}}"),
        Err(error) => serde_json::json!({ "error": error }).to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn questions_round_trip() {
        for request in [AdminRequest::Status, AdminRequest::Reload, AdminRequest::Crl(vec![0x30, 0, 255])] {
            let line = request.to_line();
            assert!(line.ends_with('\n') && line.len() <= ADMIN_LINE_BYTES_MAX);
            assert_eq!(AdminRequest::parse(line.as_bytes()), Ok(request));
        }
        assert!(AdminRequest::Crl(vec![1; CRL_BYTES_MAX]).to_line().len() <= ADMIN_LINE_BYTES_MAX);
        assert_eq!(AdminRequest::parse(b""), Ok(AdminRequest::Status));
        assert_eq!(AdminRequest::parse(b"status\r\n"), Ok(AdminRequest::Status));
    }

    #[test]
    fn what_is_no_question_is_told_why() {
        for (line, error) in [
            (&b"reload"[..], AdminError::Version),
            (b"sgc/2 reload", AdminError::Version),
            (b"\xff", AdminError::NotText),
            (b"sgc/1 crl", AdminError::Argument { word: "crl" }),
            (b"sgc/1 crl !", AdminError::Argument { word: "crl" }),
            (b"sgc/1 stop", AdminError::Unknown { word: "stop".into() }),
            (b"sgc/1 reload now", AdminError::Unknown { word: "reload".into() }),
        ] {
            assert_eq!(AdminRequest::parse(line), Err(error), "{}", line.escape_ascii());
        }
    }
}
