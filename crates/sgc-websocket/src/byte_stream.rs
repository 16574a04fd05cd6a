//! [`ByteStream`]: a stream of bytes in binary messages whose borders mean nothing.

use std::io;
use std::pin::Pin;
use std::task::{Context, Poll, ready};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use bytes::{Buf as _, BytesMut};
#[cfg(test)]
use tokio::io::AsyncReadExt as _;
use tokio::io::{AsyncRead, AsyncWrite, AsyncWriteExt as _, ReadBuf};

use crate::frame::{
    BINARY, CLOSE, CONTINUATION, Frame, FrameError, PING, PONG, TEXT, WS_FRAME_BYTES_MAX, fill, put_frame,
};
use crate::upgrade::{Fields, HTTP_HEAD_BYTES_MAX, Request, UpgradeError, accept_key, read_head, refuse};

/// Longest frame that is sent, bytes: it holds up answers to pings.
const WS_FRAME_BYTES: usize = 64 << 10;
const READ_BYTES: usize = 16 << 10;

/// Requests the upgrade.
///
/// # Errors
/// The listener refused or speaks no WebSocket, or the connection failed.
pub async fn dial<S>(mut wire: S, host: &str, path: &str) -> Result<ByteStream<S>, UpgradeError>
where
    S: AsyncRead + AsyncWrite + Unpin,
{
    let mut nonce = [0; 16];
    fill(&mut nonce);
    let key = BASE64.encode(nonce);
    let request = format!(
        "GET {path} HTTP/1.1\r\nHost: {host}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\
         Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n\r\n"
    );
    wire.write_all(request.as_bytes()).await?;
    wire.flush().await?;
    let (head, rest) = read_head(&mut wire, HTTP_HEAD_BYTES_MAX)
        .await?
        .ok_or(UpgradeError::Answer("no web server is there"))?;
    let status =
        head.split("\r\n").next().and_then(|line| line.strip_prefix("HTTP/1.1 ")?.get(..3)?.parse().ok());
    match status {
        None => return Err(UpgradeError::Answer("no web server is there")),
        Some(101) => {}
        Some(status) => return Err(UpgradeError::Status(status)),
    }
    let fields = Fields(&head);
    let is_upgraded = fields.has_token("upgrade", "websocket") && fields.has_token("connection", "upgrade");
    if !is_upgraded || fields.get("sec-websocket-accept") != Some(accept_key(&key).as_str()) {
        return Err(UpgradeError::Answer("the web server there does not speak WebSocket"));
    }
    Ok(ByteStream::new(wire, rest, true))
}

/// Awaits the request for an upgrade at this path, and answers it. Any other request gets an error response.
///
/// # Errors
/// The request is another one, or the connection failed. Returns the stream, too, for its end.
pub async fn accept<S>(mut wire: S, path: &str) -> Result<ByteStream<S>, (UpgradeError, S)>
where
    S: AsyncRead + AsyncWrite + Unpin,
{
    match upgrade(&mut wire, path).await {
        Ok(rest) => Ok(ByteStream::new(wire, rest, false)),
        Err(error) => Err((error, wire)),
    }
}

async fn upgrade<S>(wire: &mut S, path: &str) -> Result<BytesMut, UpgradeError>
where
    S: AsyncRead + AsyncWrite + Unpin,
{
    let request = Request::read(wire, HTTP_HEAD_BYTES_MAX).await?;
    if request.target() != Some(path) {
        let target: String = request.path().chars().filter(|c| !c.is_control()).take(80).collect();
        let what = format!("it asks for {target:?}, and only {path} is here");
        return refuse(wire, "404 Not Found", what).await;
    }
    request.accept(wire, None).await
}

/// A stream of bytes in binary messages.
#[derive(Debug)]
pub struct ByteStream<S> {
    wire: S,
    /// Dialers mask their frames, listeners do not.
    is_dialer: bool,
    input: BytesMut,
    expect: Expect,
    output: BytesMut,
    /// The content of the last ping that is not answered.
    ping: Option<BytesMut>,
    has_closed: bool,
}

#[derive(Debug)]
enum Expect {
    Head,
    Payload(Frame),
    Ended,
}

impl<S: AsyncRead + AsyncWrite + Unpin> ByteStream<S> {
    fn new(wire: S, input: BytesMut, is_dialer: bool) -> Self {
        Self {
            wire,
            is_dialer,
            input,
            expect: Expect::Head,
            output: BytesMut::new(),
            ping: None,
            has_closed: false,
        }
    }

    fn poll_output(&mut self, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        loop {
            while !self.output.is_empty() {
                match ready!(Pin::new(&mut self.wire).poll_write(cx, &self.output))? {
                    0 => return Poll::Ready(Err(io::ErrorKind::WriteZero.into())),
                    n => self.output.advance(n),
                }
            }
            let Some(ping) = self.ping.take().filter(|_| !self.has_closed) else {
                return Poll::Ready(Ok(()));
            };
            put_frame(&mut self.output, self.is_dialer, PONG, &ping);
        }
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
                    frame.unmask(&mut buf.filled_mut()[start..]);
                    self.input.advance(n);
                    return Ok(true);
                }
                Expect::Payload(frame) => {
                    let length = frame.left as usize;
                    if self.input.len() < length {
                        return Ok(false);
                    }
                    let opcode = frame.opcode;
                    let mut payload = self.input.split_to(length);
                    frame.unmask(&mut payload);
                    self.expect = if opcode == CLOSE { Expect::Ended } else { Expect::Head };
                    // The last of several pings is answered, behind what is written (RFC 6455, 5.5.3).
                    if opcode == PING {
                        self.ping = Some(payload);
                    }
                }
            }
        }
    }
}

/// Reads the head of a frame. Returns it and its length, or nothing while more bytes are needed.
fn read_frame(bytes: &[u8], is_masked: bool) -> Result<Option<(Frame, usize)>, FrameError> {
    if bytes.first().is_some_and(|first| first & 0x0f == TEXT) {
        return Err(FrameError::Kind);
    }
    Frame::read(bytes, is_masked, WS_FRAME_BYTES_MAX)
}

impl<S: AsyncRead + AsyncWrite + Unpin> AsyncRead for ByteStream<S> {
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

impl<S: AsyncRead + AsyncWrite + Unpin> AsyncWrite for ByteStream<S> {
    fn poll_write(self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        let this = self.get_mut();
        ready!(this.poll_output(cx))?;
        let n = buf.len().min(WS_FRAME_BYTES);
        if n > 0 {
            put_frame(&mut this.output, this.is_dialer, BINARY, &buf[..n]);
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
            put_frame(&mut this.output, this.is_dialer, CLOSE, &NORMAL);
        }
        ready!(this.poll_output(cx))?;
        Pin::new(&mut this.wire).poll_shutdown(cx)
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::DuplexStream;

    use super::*;
    use crate::frame::apply;

    type Dialled = Result<ByteStream<DuplexStream>, UpgradeError>;
    type Accepted = Result<ByteStream<DuplexStream>, (UpgradeError, DuplexStream)>;

    async fn pair(path: &str) -> (Dialled, Accepted) {
        let (near, far) = tokio::io::duplex(1 << 16);
        tokio::join!(dial(near, "host:80", path), accept(far, "/sgc"))
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

    /// Returns a masked frame of a few bytes.
    fn frame(first: u8, payload: &[u8]) -> Vec<u8> {
        let mask = [1, 2, 3, 4];
        let mut masked = payload.to_vec();
        apply(mask, &mut masked);
        [&[first, 0x80 | payload.len() as u8], &mask[..], &masked].concat()
    }

    #[tokio::test]
    async fn pings_are_answered_while_data_waits_to_be_written() {
        let (mut raw, far) = tokio::io::duplex(1 << 10);
        let (mut reads, mut writes) = tokio::io::split(ByteStream::new(far, BytesMut::new(), false));
        let sent = [7; 4000];
        let writing = async {
            writes.write_all(&sent).await.unwrap();
            writes.flush().await.unwrap();
        };
        let reading = async {
            let mut byte = [0];
            reads.read_exact(&mut byte).await.unwrap();
        };
        let peer = async {
            // Nothing more fits into the pipe when the ping comes.
            tokio::task::yield_now().await;
            raw.write_all(&[frame(0x89, b"first"), frame(0x89, b"ping"), frame(0x82, b"x")].concat())
                .await
                .unwrap();
            let mut got = vec![0; 4 + sent.len() + 6];
            raw.read_exact(&mut got).await.unwrap();
            assert_eq!(&got[4 + sent.len()..], b"\x8a\x04ping");
        };
        tokio::join!(writing, reading, peer);
    }

    #[tokio::test]
    async fn pings_are_answered_between_fragments_of_a_message() {
        let (mut raw, far) = tokio::io::duplex(1 << 16);
        let mut far = ByteStream::new(far, BytesMut::new(), false);
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
            assert!(matches!(accept(far, "/sgc").await, Err((UpgradeError::Request(_), _))));
            let mut said = String::new();
            raw.read_to_string(&mut said).await.unwrap();
            assert!(said.starts_with(answer), "{said}");
        }
    }

    #[test]
    fn text_is_refused() {
        read_frame(&[0x81, 0x80], true).unwrap_err();
        assert!(matches!(read_frame(&[0x82, 0x80, 0, 0, 0, 0], true), Ok(Some(_))));
    }
}
