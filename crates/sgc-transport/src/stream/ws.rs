//! A stream of bytes inside of WebSocket (RFC 6455): the upgrade of HTTP/1.1, then binary messages whose borders mean
//! nothing.
//!
//! It authenticates nobody: the end of the TLS around it, a web proxy for instance, reads and writes as it likes, and
//! finds the nodes' own TLS within. No extensions, no subprotocols, no cookies, and no more of HTTP than the upgrade
//! takes.

use std::fmt;
use std::io;
use std::pin::Pin;
use std::task::{Context, Poll, ready};

use aws_lc_rs::{digest, rand};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use bytes::{Buf as _, BufMut as _, BytesMut};
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _, ReadBuf};

use super::wire::Wire;

/// Longest head of a request or an answer, bytes.
pub(super) const HTTP_HEAD_BYTES_MAX: usize = 8 << 10;
/// Longest frame that is accepted, bytes; its content is passed on as it comes.
pub(super) const WS_FRAME_BYTES_MAX: u64 = 1 << 20;
/// Longest frame that is sent, bytes: it holds up answers to pings.
const WS_FRAME_BYTES: usize = 64 << 10;
/// Longest payload of a control frame (RFC 6455, 5.5).
const WS_CONTROL_BYTES_MAX: u64 = 125;
const WS_HEAD_BYTES_MAX: usize = 14;
const READ_BYTES: usize = 16 << 10;

const CONTINUATION: u8 = 0;
const BINARY: u8 = 2;
const CLOSE: u8 = 8;
const PING: u8 = 9;
const PONG: u8 = 10;

/// The reason why HTTP did not become WebSocket.
#[derive(Debug)]
pub(super) enum UpgradeError {
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

/// Requests the upgrade.
pub(super) async fn dial(mut wire: Wire, host: &str, path: &str) -> Result<WsStream, UpgradeError> {
    let mut nonce = [0; 16];
    fill(&mut nonce);
    let key = BASE64.encode(nonce);
    let request = format!(
        "GET {path} HTTP/1.1\r\nHost: {host}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\
         Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n\r\n"
    );
    wire.write_all(request.as_bytes()).await?;
    wire.flush().await?;
    let (head, rest) = read_head(&mut wire).await?.ok_or(UpgradeError::Answer("no web server is there"))?;
    let mut lines = head.split("\r\n");
    let status = lines.next().and_then(|line| line.strip_prefix("HTTP/1.1 ")?.get(..3)?.parse().ok());
    match status {
        None => return Err(UpgradeError::Answer("no web server is there")),
        Some(101) => {}
        Some(status) => return Err(UpgradeError::Status(status)),
    }
    let fields = Fields(lines.collect());
    let is_upgraded = fields.has_token("upgrade", "websocket") && fields.has_token("connection", "upgrade");
    if !is_upgraded || fields.get("sec-websocket-accept") != Some(accept_key(&key).as_str()) {
        return Err(UpgradeError::Answer("the web server there does not speak WebSocket"));
    }
    Ok(WsStream::new(wire, rest, true))
}

/// Awaits the request for an upgrade at this path, and answers it. Any other request gets an error response.
pub(super) async fn accept(mut wire: Wire, path: &str) -> Result<WsStream, (UpgradeError, Wire)> {
    match upgrade(&mut wire, path).await {
        Ok(rest) => Ok(WsStream::new(wire, rest, false)),
        Err(error) => Err((error, wire)),
    }
}

async fn upgrade(wire: &mut Wire, path: &str) -> Result<BytesMut, UpgradeError> {
    let refuse = async |wire: &mut Wire, status: &str, what: String| {
        let answer = format!("HTTP/1.1 {status}\r\nContent-Length: 0\r\nConnection: close\r\n\r\n");
        wire.write_all(answer.as_bytes()).await?;
        wire.flush().await?;
        Err(UpgradeError::Request(what))
    };
    let Some((head, rest)) = read_head(wire).await? else {
        return refuse(wire, "400 Bad Request", "what it says is not HTTP".into()).await;
    };
    let mut lines = head.split("\r\n");
    let mut request = lines.next().unwrap_or_default().split(' ');
    let (method, target, version) = (request.next(), request.next(), request.next());
    if version != Some("HTTP/1.1") {
        return refuse(wire, "400 Bad Request", "what it says is not HTTP/1.1".into()).await;
    }
    if method != Some("GET") || target != Some(path) {
        let target: String =
            target.unwrap_or_default().chars().filter(|c| !c.is_control()).take(80).collect();
        return refuse(wire, "404 Not Found", format!("it asks for {target:?}, and only {path} is here"))
            .await;
    }
    let fields = Fields(lines.collect());
    let key = fields.get("sec-websocket-key").filter(|key| BASE64.decode(key).is_ok_and(|k| k.len() == 16));
    let is_upgrade = fields.has_token("upgrade", "websocket") && fields.has_token("connection", "upgrade");
    let Some(key) = key.filter(|_| is_upgrade && fields.get("sec-websocket-version") == Some("13")) else {
        let status = "426 Upgrade Required\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13";
        return refuse(wire, status, "it does not ask for WebSocket".into()).await;
    };
    let answer = format!(
        "HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\
         Sec-WebSocket-Accept: {}\r\n\r\n",
        accept_key(key)
    );
    wire.write_all(answer.as_bytes()).await?;
    wire.flush().await?;
    Ok(rest)
}

/// Reads up to the empty line. Returns the head and the bytes behind it; nothing if the head is too long or no text.
async fn read_head(wire: &mut Wire) -> io::Result<Option<(String, BytesMut)>> {
    const END: &[u8] = b"\r\n\r\n";
    let mut bytes = BytesMut::with_capacity(1024);
    loop {
        if let Some(at) = bytes.windows(END.len()).position(|w| w == END) {
            let head = bytes.split_to(at);
            bytes.advance(END.len());
            return Ok(String::from_utf8(head.to_vec()).ok().map(|head| (head, bytes)));
        }
        // A peer that speaks another protocol, TLS for instance, sends no head; it is not waited for.
        if bytes.len() >= HTTP_HEAD_BYTES_MAX || bytes.first().is_some_and(|b| !b.is_ascii_uppercase()) {
            return Ok(None);
        }
        bytes.reserve(512);
        if wire.read_buf(&mut bytes).await? == 0 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
    }
}

struct Fields<'a>(Vec<&'a str>);

impl<'a> Fields<'a> {
    fn get(&self, name: &str) -> Option<&'a str> {
        let pairs = self.0.iter().filter_map(|line| line.split_once(':'));
        pairs.filter(|(found, _)| found.eq_ignore_ascii_case(name)).map(|(_, value)| value.trim()).next()
    }

    fn has_token(&self, name: &str, token: &str) -> bool {
        self.get(name).is_some_and(|v| v.split(',').any(|t| t.trim().eq_ignore_ascii_case(token)))
    }
}

fn accept_key(key: &str) -> String {
    let text = [key, "258EAFA5-E914-47DA-95CA-C5AB0DC85B11"].concat();
    BASE64.encode(digest::digest(&digest::SHA1_FOR_LEGACY_USE_ONLY, text.as_bytes()))
}

fn fill(bytes: &mut [u8]) {
    rand::fill(bytes).expect("the system has random numbers, or TLS had not started either");
}

/// A stream of bytes in binary messages.
pub(super) struct WsStream {
    wire: Wire,
    /// Dialers mask their frames, listeners do not (RFC 6455, 5.3).
    is_dialer: bool,
    input: BytesMut,
    expect: Expect,
    output: BytesMut,
    has_closed: bool,
}

enum Expect {
    Head,
    Payload(Frame),
    Ended,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Frame {
    opcode: u8,
    left: u64,
    mask: [u8; 4],
}

impl WsStream {
    fn new(wire: Wire, input: BytesMut, is_dialer: bool) -> Self {
        Self { wire, is_dialer, input, expect: Expect::Head, output: BytesMut::new(), has_closed: false }
    }

    fn put_frame(&mut self, opcode: u8, payload: &[u8]) {
        const FINAL: u8 = 0x80;
        const MASKED: u8 = 0x80;
        let mask_bit = if self.is_dialer { MASKED } else { 0 };
        let output = &mut self.output;
        output.reserve(WS_HEAD_BYTES_MAX + payload.len());
        output.put_u8(FINAL | opcode);
        match payload.len() {
            n @ 0..=125 => output.put_u8(mask_bit | n as u8),
            n @ 126..=0xffff => {
                output.put_u8(mask_bit | 126);
                output.put_u16(n as u16);
            }
            n => {
                output.put_u8(mask_bit | 127);
                output.put_u64(n as u64);
            }
        }
        if !self.is_dialer {
            output.extend_from_slice(payload);
            return;
        }
        let mut mask = [0; 4];
        fill(&mut mask);
        output.extend_from_slice(&mask);
        let start = output.len();
        output.extend_from_slice(payload);
        apply(mask, &mut output[start..]);
    }

    fn poll_output(&mut self, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        while !self.output.is_empty() {
            match ready!(Pin::new(&mut self.wire).poll_write(cx, &self.output))? {
                0 => return Poll::Ready(Err(io::ErrorKind::WriteZero.into())),
                n => self.output.advance(n),
            }
        }
        Poll::Ready(Ok(()))
    }

    /// Consumes input. Returns `true` if `buf` got bytes or the stream is over, `false` if more input is needed.
    fn consume(&mut self, buf: &mut ReadBuf<'_>) -> io::Result<bool> {
        loop {
            match &mut self.expect {
                Expect::Ended => return Ok(true),
                Expect::Head => {
                    let Some((frame, used)) = read_frame(&self.input, !self.is_dialer)? else {
                        return Ok(false);
                    };
                    self.input.advance(used);
                    self.expect = Expect::Payload(frame);
                }
                Expect::Payload(frame) if matches!(frame.opcode, BINARY | CONTINUATION) => {
                    if frame.left == 0 {
                        self.expect = Expect::Head;
                        continue;
                    }
                    let n = self.input.len().min(buf.remaining());
                    let n = n.min(usize::try_from(frame.left).unwrap_or(usize::MAX));
                    if n == 0 {
                        return Ok(buf.remaining() == 0);
                    }
                    let start = buf.filled().len();
                    buf.put_slice(&self.input[..n]);
                    apply(frame.mask, &mut buf.filled_mut()[start..]);
                    self.input.advance(n);
                    frame.mask.rotate_left(n % 4);
                    frame.left -= n as u64;
                    return Ok(true);
                }
                Expect::Payload(frame) => {
                    let length = frame.left as usize;
                    if self.input.len() < length {
                        return Ok(false);
                    }
                    let Frame { opcode, mask, .. } = *frame;
                    let mut payload = self.input.split_to(length);
                    apply(mask, &mut payload);
                    self.expect = if opcode == CLOSE { Expect::Ended } else { Expect::Head };
                    // One answer is enough for all pings that came while it could not be written.
                    if opcode == PING && self.output.is_empty() {
                        self.put_frame(PONG, &payload);
                    }
                }
            }
        }
    }
}

/// Masks, or removes the mask.
fn apply(mask: [u8; 4], bytes: &mut [u8]) {
    let mut words = bytes.chunks_exact_mut(4);
    for word in &mut words {
        for (byte, mask) in word.iter_mut().zip(mask) {
            *byte ^= mask;
        }
    }
    for (byte, mask) in words.into_remainder().iter_mut().zip(mask) {
        *byte ^= mask;
    }
}

/// Reads the head of a frame. Returns it and its length, or nothing while more bytes are needed.
fn read_frame(bytes: &[u8], is_masked: bool) -> io::Result<Option<(Frame, usize)>> {
    let wrong = |what: &str| Err(io::Error::new(io::ErrorKind::InvalidData, format!("WebSocket: {what}")));
    let [first, second, rest @ ..] = bytes else { return Ok(None) };
    let (opcode, is_final) = (first & 0x0f, first & 0x80 != 0);
    if first & 0x70 != 0 || !matches!(opcode, CONTINUATION | BINARY | CLOSE | PING | PONG) {
        return wrong("a frame of an unknown kind");
    }
    if (second & 0x80 != 0) != is_masked {
        return wrong("masked where it must not be, or not where it must");
    }
    let (left, rest) = match second & 0x7f {
        126 => match rest.split_first_chunk::<2>() {
            Some((length, rest)) => (u64::from(u16::from_be_bytes(*length)), rest),
            None => return Ok(None),
        },
        127 => match rest.split_first_chunk::<8>() {
            Some((length, rest)) => (u64::from_be_bytes(*length), rest),
            None => return Ok(None),
        },
        length => (u64::from(length), rest),
    };
    let is_control = opcode >= CLOSE;
    if left > WS_FRAME_BYTES_MAX || (is_control && (left > WS_CONTROL_BYTES_MAX || !is_final)) {
        return wrong("a frame that is too long");
    }
    let (mask, rest) = match rest.split_first_chunk::<4>() {
        _ if !is_masked => ([0; 4], rest),
        Some((mask, rest)) => (*mask, rest),
        None => return Ok(None),
    };
    Ok(Some((Frame { opcode, left, mask }, bytes.len() - rest.len())))
}

impl AsyncRead for WsStream {
    fn poll_read(self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let this = self.get_mut();
        loop {
            if this.consume(buf)? {
                // Answers to pings go out when they can; the writer's next turn takes the rest.
                let _ = this.poll_output(cx)?;
                return Poll::Ready(Ok(()));
            }
            let _ = this.poll_output(cx)?;
            this.input.reserve(READ_BYTES);
            let before = this.input.len();
            this.input.resize(before + READ_BYTES, 0);
            let mut more = ReadBuf::new(&mut this.input[before..]);
            let polled = Pin::new(&mut this.wire).poll_read(cx, &mut more);
            let n = more.filled().len();
            this.input.truncate(before + n);
            ready!(polled)?;
            if n == 0 {
                return Poll::Ready(Err(io::ErrorKind::UnexpectedEof.into()));
            }
        }
    }
}

impl AsyncWrite for WsStream {
    fn poll_write(self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        let this = self.get_mut();
        ready!(this.poll_output(cx))?;
        let n = buf.len().min(WS_FRAME_BYTES);
        if n > 0 {
            this.put_frame(BINARY, &buf[..n]);
            if let Poll::Ready(result) = this.poll_output(cx) {
                result?;
            }
        }
        Poll::Ready(Ok(n))
    }

    fn poll_flush(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        let this = self.get_mut();
        ready!(this.poll_output(cx))?;
        Pin::new(&mut this.wire).poll_flush(cx)
    }

    fn poll_shutdown(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        const NORMAL: [u8; 2] = 1000u16.to_be_bytes();
        let this = self.get_mut();
        if !std::mem::replace(&mut this.has_closed, true) {
            this.put_frame(CLOSE, &NORMAL);
        }
        ready!(this.poll_output(cx))?;
        Pin::new(&mut this.wire).poll_shutdown(cx)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    async fn pair(path: &str) -> (Result<WsStream, UpgradeError>, Result<WsStream, (UpgradeError, Wire)>) {
        let (near, far) = tokio::io::duplex(1 << 16);
        tokio::join!(dial(Box::new(near), "host:80", path), async { accept(Box::new(far), "/sgc").await })
    }

    #[tokio::test]
    async fn bytes_go_both_ways_whatever_the_messages() {
        let (near, far) = pair("/sgc").await;
        let (mut near, mut far) = (near.unwrap(), far.map_err(|(e, _)| e).unwrap());
        for length in [1, 2, 125, 126, 4096, 60_000] {
            let sent: Vec<u8> = (0..length).map(|i| i as u8).collect();
            for is_near in [true, false] {
                let (from, to) = if is_near { (&mut near, &mut far) } else { (&mut far, &mut near) };
                let mut got = vec![0; length];
                let write = async {
                    from.write_all(&sent).await.unwrap();
                    from.flush().await.unwrap();
                };
                let ((), read) = tokio::join!(write, to.read_exact(&mut got));
                read.unwrap();
                assert_eq!(got, sent, "{length} {is_near}");
            }
        }
    }

    #[tokio::test]
    async fn pings_are_answered_between_fragments_of_a_message() {
        let (mut raw, far) = tokio::io::duplex(1 << 16);
        let mut far = WsStream::new(Box::new(far), BytesMut::new(), false);
        let mask = [1, 2, 3, 4];
        let frame = |first: u8, payload: &[u8]| {
            let mut masked = payload.to_vec();
            apply(mask, &mut masked);
            [&[first, 0x80 | payload.len() as u8], &mask[..], &masked].concat()
        };
        let stream =
            [frame(0x02, b"hel"), frame(0x89, b"ping"), frame(0x00, b""), frame(0x80, b"lo")].concat();
        for byte in stream {
            raw.write_all(&[byte]).await.unwrap();
        }
        let mut got = [0; 5];
        far.read_exact(&mut got).await.unwrap();
        assert_eq!(&got, b"hello");
        far.flush().await.unwrap();
        let mut pong = [0; 6];
        raw.read_exact(&mut pong).await.unwrap();
        assert_eq!(&pong, b"\x8a\x04ping");
        raw.write_all(&frame(0x88, b"")).await.unwrap();
        assert_eq!(far.read(&mut got).await.unwrap(), 0);
    }

    #[tokio::test]
    async fn other_requests_are_answered_and_refused() {
        let (near, far) = pair("/other").await;
        assert!(matches!(near, Err(UpgradeError::Status(404))));
        let Err((UpgradeError::Request(what), _)) = far else { panic!() };
        assert!(what.contains("/other") && what.contains("/sgc"), "{what}");
        let get = "GET /sgc HTTP/1.1\r\nHost: x\r\n\r\n";
        let long = format!("GET /sgc HTTP/1.1\r\nX: {}\r\n\r\n", "x".repeat(HTTP_HEAD_BYTES_MAX));
        for (request, answer) in [
            (get, "HTTP/1.1 426"),
            ("POST /sgc HTTP/1.1\r\n\r\n", "HTTP/1.1 404"),
            ("GET /sgc HTTP/1.0\r\n\r\n", "HTTP/1.1 400"),
            ("\x16\x03\x01\x00\x05hello", "HTTP/1.1 400"),
            (&long, "HTTP/1.1 400"),
            ("\r\n\r\n", "HTTP/1.1 400"),
        ] {
            let (mut raw, far) = tokio::io::duplex(1 << 16);
            raw.write_all(request.as_bytes()).await.unwrap();
            assert!(matches!(accept(Box::new(far), "/sgc").await, Err((UpgradeError::Request(_), _))));
            let mut said = String::new();
            raw.read_to_string(&mut said).await.unwrap();
            assert!(said.starts_with(answer), "{said}");
        }
    }

    #[test]
    fn impossible_frames_are_refused() {
        for bytes in [
            &[0x81, 0x80][..],
            &[0x82, 0x00],
            &[0xc2, 0x80],
            &[0x89, 0xfe, 0, 126],
            &[0x09, 0x80],
            &[0x83, 0x80],
            &[0x82, 0xff, 0, 0, 0, 0, 0, 0x10, 0, 1],
            &[0x82, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff],
        ] {
            read_frame(bytes, true).unwrap_err();
        }
        // RFC 6455, 1.3.
        assert_eq!(accept_key("dGhlIHNhbXBsZSBub25jZQ=="), "s3pPLMBiTxaQ9kYGzzhZRbK+xOo=");
    }
}
