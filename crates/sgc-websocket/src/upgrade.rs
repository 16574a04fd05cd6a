//! The upgrade of HTTP/1.1 to WebSocket (RFC 6455, 4).

use std::fmt;
use std::io;

use aws_lc_rs::digest;
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use bytes::{Buf as _, BytesMut};
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _};

/// Longest head of a request or an answer of links, bytes.
pub const HTTP_HEAD_BYTES_MAX: usize = 8 << 10;

/// The reason why HTTP did not become WebSocket.
#[derive(Debug)]
pub enum UpgradeError {
    /// The listener refused, with this status.
    Status(u16),
    /// A request for another page, or no request at all; the dialer was told.
    Request(String),
    /// The response is invalid.
    Answer(&'static str),
    /// The connection failed.
    Io(io::Error),
}

impl From<io::Error> for UpgradeError {
    fn from(error: io::Error) -> Self {
        Self::Io(error)
    }
}

impl fmt::Display for UpgradeError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Status(status) => write!(f, "the web server there says {status}"),
            Self::Request(what) => f.write_str(what),
            Self::Answer(what) => f.write_str(what),
            Self::Io(error) => error.fmt(f),
        }
    }
}

impl std::error::Error for UpgradeError {}

/// A request of HTTP/1.1.
#[derive(Debug)]
pub struct Request {
    head: String,
    /// The bytes behind the head.
    rest: BytesMut,
}

impl Request {
    /// Awaits a request with a head of at most `head_bytes_max` bytes. Anything else gets an error response.
    ///
    /// # Errors
    /// No HTTP/1.1, or the connection failed.
    pub async fn read<S>(stream: &mut S, head_bytes_max: usize) -> Result<Self, UpgradeError>
    where
        S: AsyncRead + AsyncWrite + Unpin,
    {
        let Some((head, rest)) = read_head(stream, head_bytes_max).await? else {
            return refuse(stream, "400 Bad Request", "what it says is not HTTP".into()).await;
        };
        let request = Self { head, rest };
        if request.word(2) != Some("HTTP/1.1") {
            return refuse(stream, "400 Bad Request", "what it says is not HTTP/1.1".into()).await;
        }
        Ok(request)
    }

    /// Returns a word of the first line.
    fn word(&self, at: usize) -> Option<&str> {
        self.head.split("\r\n").next().unwrap_or_default().split(' ').nth(at)
    }

    /// Returns the path and query, whatever the method.
    pub(crate) fn path(&self) -> &str {
        self.word(1).unwrap_or_default()
    }

    /// Returns the path and query of a `GET`.
    pub fn target(&self) -> Option<&str> {
        self.word(1).filter(|_| self.word(0) == Some("GET"))
    }

    /// Returns the values of all fields with this name.
    pub fn fields<'a>(&'a self, name: &'a str) -> impl Iterator<Item = &'a str> {
        Fields(&self.head).all(name)
    }

    /// Returns the key of an upgrade to WebSocket. Requests for anything else get an error response.
    ///
    /// # Errors
    /// The request is no upgrade to this version of WebSocket, or the connection failed.
    async fn key<S>(&self, stream: &mut S) -> Result<&str, UpgradeError>
    where
        S: AsyncRead + AsyncWrite + Unpin,
    {
        let fields = Fields(&self.head);
        let key =
            fields.get("sec-websocket-key").filter(|key| BASE64.decode(key).is_ok_and(|k| k.len() == 16));
        let is_upgrade =
            fields.has_token("upgrade", "websocket") && fields.has_token("connection", "upgrade");
        match key {
            // RFC 6455, 4.2.1.
            Some(key)
                if is_upgrade
                    && self.target().is_some()
                    && fields.get("sec-websocket-version") == Some("13") =>
            {
                Ok(key)
            }
            _ => {
                let status = "426 Upgrade Required\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13";
                refuse(stream, status, "it does not ask for WebSocket".into()).await
            }
        }
    }

    /// Checks that the request is an upgrade to WebSocket. Requests for anything else get an error response.
    ///
    /// # Errors
    /// The request is no upgrade, or the connection failed.
    pub async fn check_upgrade<S>(&self, stream: &mut S) -> Result<(), UpgradeError>
    where
        S: AsyncRead + AsyncWrite + Unpin,
    {
        self.key(stream).await.map(drop)
    }

    /// Answers with the upgrade, and returns the bytes behind the request.
    ///
    /// # Errors
    /// The request is no upgrade, or the connection failed.
    pub async fn accept<S>(self, stream: &mut S, subprotocol: Option<&str>) -> Result<BytesMut, UpgradeError>
    where
        S: AsyncRead + AsyncWrite + Unpin,
    {
        let key = self.key(stream).await?;
        let subprotocol =
            subprotocol.map(|name| format!("Sec-WebSocket-Protocol: {name}\r\n")).unwrap_or_default();
        let answer = format!(
            "HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\
             Sec-WebSocket-Accept: {}\r\n{subprotocol}\r\n",
            accept_key(key)
        );
        stream.write_all(answer.as_bytes()).await?;
        stream.flush().await?;
        Ok(self.rest)
    }

    /// Answers with an error status such as `401 Unauthorized` and a text.
    ///
    /// # Errors
    /// The connection failed.
    pub async fn refuse<S>(stream: &mut S, status: &str, text: &str) -> io::Result<()>
    where
        S: AsyncWrite + Unpin,
    {
        let answer =
            format!("HTTP/1.1 {status}\r\nContent-Length: {}\r\nConnection: close\r\n\r\n{text}", text.len());
        stream.write_all(answer.as_bytes()).await?;
        stream.flush().await
    }
}

pub(crate) async fn refuse<S, T>(stream: &mut S, status: &str, what: String) -> Result<T, UpgradeError>
where
    S: AsyncWrite + Unpin,
{
    Request::refuse(stream, status, "").await?;
    Err(UpgradeError::Request(what))
}

/// Reads up to the empty line. Returns the head and the bytes behind it; nothing if the head is too long.
pub(crate) async fn read_head<S>(stream: &mut S, bytes_max: usize) -> io::Result<Option<(String, BytesMut)>>
where
    S: AsyncRead + Unpin,
{
    const END: &[u8] = b"\r\n\r\n";
    let mut bytes = BytesMut::with_capacity(1024);
    let mut searched = 0;
    loop {
        if let Some(at) = bytes[searched..].windows(END.len()).position(|w| w == END) {
            let head = bytes.split_to(searched + at);
            bytes.advance(END.len());
            return Ok(Some((String::from_utf8_lossy(&head).into_owned(), bytes)));
        }
        searched = bytes.len().saturating_sub(END.len() - 1);
        // A peer that speaks another protocol, TLS for instance, sends no head; it is not waited for.
        if bytes.len() >= bytes_max || bytes.first().is_some_and(|b| !b.is_ascii_uppercase()) {
            return Ok(None);
        }
        bytes.reserve(512);
        if stream.read_buf(&mut bytes).await? == 0 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
    }
}

/// The lines behind the first one.
pub(crate) struct Fields<'a>(pub(crate) &'a str);

impl<'a> Fields<'a> {
    fn all<'n>(&self, name: &'n str) -> impl Iterator<Item = &'a str> + use<'a, 'n> {
        let pairs = self.0.split("\r\n").skip(1).filter_map(|line| line.split_once(':'));
        pairs.filter(move |(found, _)| found.eq_ignore_ascii_case(name)).map(|(_, value)| value.trim())
    }

    pub(crate) fn get(&self, name: &str) -> Option<&'a str> {
        self.all(name).next()
    }

    pub(crate) fn has_token(&self, name: &str, token: &str) -> bool {
        self.all(name).flat_map(|v| v.split(',')).any(|t| t.trim().eq_ignore_ascii_case(token))
    }
}

pub(crate) fn accept_key(key: &str) -> String {
    let text = [key, "258EAFA5-E914-47DA-95CA-C5AB0DC85B11"].concat();
    BASE64.encode(digest::digest(&digest::SHA1_FOR_LEGACY_USE_ONLY, text.as_bytes()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn accept_key_is_that_of_the_standard() {
        // RFC 6455, 1.3.
        assert_eq!(accept_key("dGhlIHNhbXBsZSBub25jZQ=="), "s3pPLMBiTxaQ9kYGzzhZRbK+xOo=");
    }

    #[tokio::test]
    async fn fields_are_found_whatever_their_case_and_number() {
        let (mut near, mut far) = tokio::io::duplex(1 << 12);
        let text = "GET /a?b=c HTTP/1.1\r\nX-A: 1\r\nx-a:  2 \r\nX: caf\u{e9}\r\n\r\nrest";
        near.write_all(text.as_bytes()).await.unwrap();
        let request = Request::read(&mut far, HTTP_HEAD_BYTES_MAX).await.unwrap();
        assert_eq!((request.target(), &request.rest[..]), (Some("/a?b=c"), &b"rest"[..]));
        assert_eq!(request.fields("x-A").collect::<Vec<_>>(), ["1", "2"]);
    }
}
