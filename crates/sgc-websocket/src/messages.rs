//! [`WebSocket`]: messages of text and bytes, with pings and the closing handshake (RFC 6455, 5.4, 5.5 and 7).

use std::fmt;
use std::future::poll_fn;
use std::io;
use std::ops::Deref;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};

use bytes::{Buf as _, Bytes, BytesMut};
use futures_util::{Sink, Stream};
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _};

use crate::frame::{
    BINARY, CLOSE, CONTINUATION, Frame, FrameError, PING, PONG, TEXT, WS_CONTROL_BYTES_MAX, put_frame,
};
use crate::upgrade::{Request, UpgradeError};

/// Bytes that wait before they are written.
const WRITE_BYTES: usize = 128 << 10;
/// Bytes that are read at a time.
const READ_BYTES: usize = 64 << 10;

/// Most bytes of a peer that are discarded after a close, as many as the gateway's longest message has.
pub const WS_DISCARD_BYTES_MAX: usize = 64 << 20;

/// A text, cheap to clone.
#[derive(Clone, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Text(Arc<String>);

impl From<String> for Text {
    fn from(text: String) -> Self {
        Self(Arc::new(text))
    }
}

impl From<&str> for Text {
    fn from(text: &str) -> Self {
        text.to_owned().into()
    }
}

impl Deref for Text {
    type Target = str;

    fn deref(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for Text {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self)
    }
}

/// The reason of a close (RFC 6455, 7.4).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CloseFrame {
    /// The code.
    pub code: u16,
    /// The text, at most 123 bytes.
    pub reason: String,
}

/// A message.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Message {
    /// A text.
    Text(Text),
    /// Bytes.
    Binary(Bytes),
    /// A ping of at most 125 bytes. It is answered by itself.
    Ping(Bytes),
    /// The answer to a ping.
    Pong(Bytes),
    /// The end. It is answered by itself.
    Close(Option<CloseFrame>),
}

impl Message {
    /// Returns a text.
    pub fn text(text: impl Into<Text>) -> Self {
        Self::Text(text.into())
    }

    /// Returns the length of the payload in bytes.
    pub fn payload_bytes(&self) -> usize {
        match self {
            Self::Text(text) => text.len(),
            Self::Binary(bytes) | Self::Ping(bytes) | Self::Pong(bytes) => bytes.len(),
            Self::Close(frame) => frame.as_ref().map_or(0, |frame| 2 + frame.reason.len()),
        }
    }
}

/// The reason why a WebSocket failed.
#[derive(Debug, thiserror::Error)]
pub enum WebSocketError {
    /// This side has closed the WebSocket, or the peer has.
    #[error("the WebSocket is closed")]
    Closed,
    /// The connection ended without the closing handshake.
    #[error("the connection ended without the closing handshake")]
    Cut,
    /// The peer sends a message that is too long.
    #[error("a message of more than {max} bytes")]
    TooLong {
        /// The longest accepted message in bytes.
        max: usize,
    },
    /// The peer breaks the protocol.
    #[error("not WebSocket: {0}")]
    Protocol(&'static str),
    /// A text is not UTF-8.
    #[error("a text that is not UTF-8")]
    NotText,
    /// The connection failed.
    #[error(transparent)]
    Io(#[from] io::Error),
}

impl WebSocketError {
    /// Returns the close code that tells the peer of its breach (RFC 6455, 7.4.1), or `None` if there was no breach.
    pub fn close_code(&self) -> Option<u16> {
        match self {
            Self::Protocol(_) => Some(PROTOCOL),
            Self::NotText => Some(NOT_TEXT),
            Self::TooLong { .. } => Some(TOO_LONG),
            Self::Closed | Self::Cut | Self::Io(_) => None,
        }
    }
}

/// Close codes of breaches (RFC 6455, 7.4.1).
const PROTOCOL: u16 = 1002;
const NOT_TEXT: u16 = 1007;
const TOO_LONG: u16 = 1009;

/// The state of the closing handshake.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    Open,
    /// This side has sent a close and awaits the peer's.
    Closing,
    /// The peer has closed. The answer may wait to be written.
    Closed,
}

/// The listener's end of a WebSocket.
#[derive(Debug)]
pub struct WebSocket<S> {
    stream: S,
    message_bytes_max: usize,
    state: State,
    /// `true` once nothing is read any more. A peer that broke a rule can still be told why.
    has_ended: bool,
    input: BytesMut,
    /// The frame whose payload is being read.
    frame: Option<Frame>,
    /// The opcode and content of the message whose frames are being read.
    message: Option<(u8, Vec<u8>)>,
    /// The payload of the control frame that is being read.
    control: Vec<u8>,
    /// The answer to a ping or a close that is not in `output` yet. The last ping is answered for all before it.
    answer: Option<(u8, Vec<u8>)>,
    output: BytesMut,
}

impl<S: AsyncRead + AsyncWrite + Unpin> WebSocket<S> {
    /// Returns the listener's end of a WebSocket that was upgraded before. `input` is the bytes that came behind the
    /// request. Messages of more than `message_bytes_max` bytes are refused by the heads of their frames.
    pub fn new(stream: S, input: BytesMut, message_bytes_max: usize) -> Self {
        Self {
            stream,
            message_bytes_max,
            state: State::Open,
            has_ended: false,
            input,
            frame: None,
            message: None,
            control: Vec::new(),
            answer: None,
            output: BytesMut::new(),
        }
    }

    /// Awaits the request for an upgrade at any path, and answers it.
    ///
    /// # Errors
    /// The request is another one, or the connection failed.
    pub async fn accept(mut stream: S, message_bytes_max: usize) -> Result<Self, UpgradeError> {
        let request = Request::read(&mut stream, crate::HTTP_HEAD_BYTES_MAX).await?;
        let input = request.accept(&mut stream, None).await?;
        Ok(Self::new(stream, input, message_bytes_max))
    }

    /// Ends the WebSocket so that the peer gets the reason (RFC 6455, 7.1.1). Writes the waiting output and the close,
    /// or the answer to the peer's close, ends the writing side, and discards what the peer still sends: a stream that
    /// is dropped with unread bytes may be reset, and a reset discards the reason. At most [`WS_DISCARD_BYTES_MAX`]
    /// bytes are discarded. The caller bounds the time.
    ///
    /// # Errors
    /// The connection failed.
    pub async fn finish(mut self, close: Option<CloseFrame>) -> Result<(), WebSocketError> {
        if self.state == State::Open {
            Pin::new(&mut self).start_send(Message::Close(close))?;
        }
        poll_fn(|cx| self.poll_output(cx)).await?;
        self.stream.shutdown().await?;
        // A close is the last that a peer sends.
        if self.state == State::Closed { Ok(()) } else { self.discard().await }
    }

    /// Discards bytes until the peer ends its side.
    async fn discard(&mut self) -> Result<(), WebSocketError> {
        (self.message, self.control) = (None, Vec::new());
        let mut left = WS_DISCARD_BYTES_MAX;
        loop {
            self.input.clear();
            match poll_fn(|cx| self.poll_input(cx)).await? {
                0 => return Ok(()),
                bytes if bytes >= left => return Ok(()),
                bytes => left -= bytes,
            }
        }
    }

    /// Returns the next message whose bytes are here, if any.
    fn take_message(&mut self) -> Result<Option<Message>, WebSocketError> {
        loop {
            let Some(frame) = &mut self.frame else {
                let max = u64::try_from(self.message_bytes_max).unwrap_or(u64::MAX);
                let read = Frame::read(&self.input, true, max.max(WS_CONTROL_BYTES_MAX));
                let read = read.map_err(|error| match error {
                    FrameError::TooLong => WebSocketError::TooLong { max: self.message_bytes_max },
                    error => WebSocketError::Protocol(error.as_str()),
                })?;
                let Some((frame, used)) = read else { return Ok(None) };
                self.input.advance(used);
                self.begin(frame)?;
                continue;
            };
            let n = self.input.len().min(usize::try_from(frame.left).unwrap_or(usize::MAX));
            let is_control = frame.opcode >= CLOSE;
            let payload = match &mut self.message {
                Some((_, payload)) if !is_control => payload,
                _ => &mut self.control,
            };
            let start = payload.len();
            payload.extend_from_slice(&self.input[..n]);
            frame.unmask(&mut payload[start..]);
            self.input.advance(n);
            if frame.left > 0 {
                return Ok(None);
            }
            let Frame { opcode, is_final, .. } = *frame;
            self.frame = None;
            if is_control {
                let payload = std::mem::take(&mut self.control);
                return self.control_message(opcode, payload).map(Some);
            }
            if is_final && let Some((opcode, payload)) = self.message.take() {
                return Ok(Some(match opcode {
                    TEXT => {
                        Message::Text(String::from_utf8(payload).map_err(|_| WebSocketError::NotText)?.into())
                    }
                    _ => Message::Binary(payload.into()),
                }));
            }
        }
    }

    /// Begins a frame. Its message exists from the first frame on.
    fn begin(&mut self, frame: Frame) -> Result<(), WebSocketError> {
        let before = self.message.as_ref().map_or(0, |(_, content)| content.len());
        let whole = usize::try_from(frame.left).ok().and_then(|left| left.checked_add(before));
        match (frame.opcode, &self.message) {
            (CLOSE | PING | PONG, _) => {}
            (CONTINUATION, None) => return Err(WebSocketError::Protocol("a piece of no message")),
            (TEXT | BINARY, Some(_)) => {
                return Err(WebSocketError::Protocol("a message within another one"));
            }
            _ if whole.is_none_or(|bytes| bytes > self.message_bytes_max) => {
                return Err(WebSocketError::TooLong { max: self.message_bytes_max });
            }
            (opcode, None) => self.message = Some((opcode, Vec::new())),
            (_, Some(_)) => {}
        }
        self.frame = Some(frame);
        Ok(())
    }

    fn control_message(&mut self, opcode: u8, payload: Vec<u8>) -> Result<Message, WebSocketError> {
        match opcode {
            PING => {
                if self.state == State::Open {
                    self.answer = Some((PONG, payload.clone()));
                }
                Ok(Message::Ping(payload.into()))
            }
            PONG => Ok(Message::Pong(payload.into())),
            _ => {
                let frame = close_frame(&payload)?;
                if self.state == State::Open {
                    let code = frame.as_ref().map(|frame| answered_code(frame.code).to_be_bytes());
                    self.answer = Some((CLOSE, code.map(Vec::from).unwrap_or_default()));
                }
                self.state = State::Closed;
                Ok(Message::Close(frame))
            }
        }
    }

    /// Writes what waits, as far as the stream takes it.
    fn poll_output(&mut self, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        loop {
            while !self.output.is_empty() {
                match ready!(Pin::new(&mut self.stream).poll_write(cx, &self.output))? {
                    0 => return Poll::Ready(Err(io::ErrorKind::WriteZero.into())),
                    n => self.output.advance(n),
                }
            }
            // Room for a long message is not kept.
            if self.output.capacity() > 2 * WRITE_BYTES {
                self.output = BytesMut::new();
            }
            // Answers wait until the output is empty, so that a peer that does not read takes no more memory by pings.
            let Some((opcode, payload)) = self.answer.take() else { return Poll::Ready(Ok(())) };
            put_frame(&mut self.output, false, opcode, &payload);
        }
    }

    /// Writes an answer as far as the stream takes it. The next read or write continues.
    fn try_answer(&mut self, cx: &mut Context<'_>) -> io::Result<()> {
        if self.answer.is_some() && self.poll_output(cx)?.is_ready() {
            let _ = Pin::new(&mut self.stream).poll_flush(cx)?;
        }
        Ok(())
    }

    /// Reads more bytes. Returns their number.
    fn poll_input(&mut self, cx: &mut Context<'_>) -> Poll<io::Result<usize>> {
        // A long message takes as much room as has come, not as much as its head announces.
        self.input.reserve(READ_BYTES);
        let read = std::pin::pin!(self.stream.read_buf(&mut self.input));
        read.poll(cx)
    }

    fn poll_message(&mut self, cx: &mut Context<'_>) -> Poll<Result<Message, WebSocketError>> {
        loop {
            if self.state == State::Closed {
                ready!(self.poll_output(cx))?;
                ready!(Pin::new(&mut self.stream).poll_flush(cx))?;
                return Poll::Ready(Err(WebSocketError::Closed));
            }
            if let Some(message) = self.take_message()? {
                self.try_answer(cx)?;
                return Poll::Ready(Ok(message));
            }
            self.try_answer(cx)?;
            if ready!(self.poll_input(cx))? == 0 {
                return Poll::Ready(Err(WebSocketError::Cut));
            }
        }
    }
}

impl<S: AsyncRead + AsyncWrite + Unpin> Stream for WebSocket<S> {
    type Item = Result<Message, WebSocketError>;

    fn poll_next(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        let this = self.get_mut();
        if this.has_ended {
            return Poll::Ready(None);
        }
        let message = ready!(this.poll_message(cx));
        this.has_ended = message.is_err();
        Poll::Ready(match message {
            Err(WebSocketError::Closed) => None,
            message => Some(message),
        })
    }
}

impl<S: AsyncRead + AsyncWrite + Unpin> Sink<Message> for WebSocket<S> {
    type Error = WebSocketError;

    fn poll_ready(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Result<(), WebSocketError>> {
        let this = self.get_mut();
        if this.output.len() >= WRITE_BYTES {
            ready!(this.poll_output(cx))?;
        }
        Poll::Ready(Ok(()))
    }

    fn start_send(self: Pin<&mut Self>, message: Message) -> Result<(), WebSocketError> {
        let this = self.get_mut();
        if this.state != State::Open {
            return Err(WebSocketError::Closed);
        }
        let output = &mut this.output;
        match &message {
            Message::Text(text) => put_frame(output, false, TEXT, text.as_bytes()),
            Message::Binary(bytes) => put_frame(output, false, BINARY, bytes),
            Message::Ping(bytes) => put_frame(output, false, PING, bytes),
            Message::Pong(bytes) => put_frame(output, false, PONG, bytes),
            Message::Close(None) => put_frame(output, false, CLOSE, &[]),
            Message::Close(Some(CloseFrame { code, reason })) => {
                put_frame(output, false, CLOSE, &[&code.to_be_bytes(), reason.as_bytes()].concat());
            }
        }
        if matches!(message, Message::Close(_)) {
            this.state = State::Closing;
        }
        Ok(())
    }

    fn poll_flush(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Result<(), WebSocketError>> {
        let this = self.get_mut();
        ready!(this.poll_output(cx))?;
        Pin::new(&mut this.stream).poll_flush(cx).map_err(WebSocketError::Io)
    }

    fn poll_close(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Result<(), WebSocketError>> {
        if self.state == State::Open {
            self.as_mut().start_send(Message::Close(None))?;
        }
        self.poll_flush(cx)
    }
}

/// Reads the payload of a close.
fn close_frame(payload: &[u8]) -> Result<Option<CloseFrame>, WebSocketError> {
    match payload.split_first_chunk::<2>() {
        None if payload.is_empty() => Ok(None),
        None => Err(WebSocketError::Protocol("a close with half a code")),
        Some((code, reason)) => {
            let reason = std::str::from_utf8(reason).map_err(|_| WebSocketError::NotText)?.to_owned();
            Ok(Some(CloseFrame { code: u16::from_be_bytes(*code), reason }))
        }
    }
}

/// Returns the code that answers a close (RFC 6455, 7.4.2).
fn answered_code(code: u16) -> u16 {
    match code {
        1000..=1003 | 1007..=1014 | 3000..=4999 => code,
        _ => PROTOCOL,
    }
}

#[cfg(test)]
mod tests {
    use futures_util::{FutureExt as _, SinkExt as _, StreamExt as _};
    use tokio::io::{AsyncWriteExt as _, DuplexStream, duplex};

    use super::*;
    use crate::frame::apply;

    const MAX: usize = 1000;

    fn frame(first: u8, payload: &[u8]) -> Vec<u8> {
        let mask = [1, 2, 3, 4];
        let mut masked = payload.to_vec();
        apply(mask, &mut masked);
        let length = payload.len();
        let head = match length {
            0..=125 => vec![first, 0x80 | length as u8],
            _ => [&[first, 0x80 | 126][..], &(length as u16).to_be_bytes()].concat(),
        };
        [&head[..], &mask, &masked].concat()
    }

    /// Returns a WebSocket and its dialer's end, of which the pipe holds `pipe_bytes`.
    fn pair(pipe_bytes: usize) -> (DuplexStream, WebSocket<DuplexStream>) {
        let (near, far) = duplex(pipe_bytes);
        (near, WebSocket::new(far, BytesMut::new(), MAX))
    }

    /// Returns the error of wrong bytes. The peer is told its code.
    async fn error_of(bytes: &[u8]) -> WebSocketError {
        let (mut raw, mut socket) = pair(1 << 16);
        raw.write_all(bytes).await.unwrap();
        let error = socket.next().await.unwrap().unwrap_err();
        assert!(socket.next().await.is_none());
        let code = error.close_code().unwrap();
        let finished = tokio::spawn(socket.finish(Some(CloseFrame { code, reason: "no".into() })));
        let mut told = Vec::new();
        raw.read_to_end(&mut told).await.unwrap();
        assert_eq!(told, [&b"\x88\x04"[..], &code.to_be_bytes(), b"no"].concat());
        drop(raw);
        finished.await.unwrap().unwrap();
        error
    }

    #[tokio::test]
    async fn breaches_have_the_codes_of_the_standard() {
        for (error, code) in [
            (WebSocketError::Protocol("x"), Some(1002)),
            (WebSocketError::NotText, Some(1007)),
            (WebSocketError::TooLong { max: 1 }, Some(1009)),
            (WebSocketError::Cut, None),
            (WebSocketError::Closed, None),
        ] {
            assert_eq!(error.close_code(), code, "{error}");
        }
    }

    #[tokio::test]
    async fn peer_that_sends_on_after_a_close_is_read_within_a_bound() {
        const SENT: usize = 1 << 20;
        let (mut raw, socket) = pair(1 << 10);
        let why = CloseFrame { code: 1008, reason: "no".into() };
        let finished = tokio::spawn(socket.finish(Some(why)));
        raw.write_all(&vec![7; SENT]).await.unwrap();
        let mut told = Vec::new();
        raw.read_to_end(&mut told).await.unwrap();
        assert_eq!(told, b"\x88\x04\x03\xf0no");
        assert!(!finished.is_finished(), "the peer has not ended its side");
        drop(raw);
        finished.await.unwrap().unwrap();
        let (mut raw, socket) = pair(1 << 20);
        let finished = tokio::spawn(socket.finish(None));
        let endless = async { while raw.write_all(&[7; 1 << 16]).await.is_ok() {} };
        endless.await;
        finished.await.unwrap().unwrap();
    }

    #[tokio::test]
    async fn close_is_answered_behind_waiting_output() {
        let (mut raw, mut socket) = pair(16);
        socket.feed(Message::text("x".repeat(100))).await.unwrap();
        assert!(socket.flush().now_or_never().is_none());
        raw.write_all(&frame(0x88, b"\x03\xe8")).await.unwrap();
        assert_eq!(
            socket.next().await.unwrap().unwrap(),
            Message::Close(Some(CloseFrame { code: 1000, reason: String::new() }))
        );
        let finished = tokio::spawn(socket.finish(None));
        let mut told = Vec::new();
        raw.read_to_end(&mut told).await.unwrap();
        assert_eq!(told.split_at(2 + 100).1, b"\x88\x02\x03\xe8");
        // The peer's own end is not waited for.
        finished.await.unwrap().unwrap();
    }

    #[tokio::test]
    async fn messages_in_pieces_are_whole_and_pings_between_them_are_answered() {
        let (mut raw, mut socket) = pair(1 << 16);
        let bytes = [
            frame(0x01, "h\u{e9}".as_bytes()),
            frame(0x89, b"ping"),
            frame(0x00, b""),
            frame(0x80, b"llo"),
            frame(0x82, &[7; 300]),
        ];
        for byte in bytes.concat() {
            raw.write_all(&[byte]).await.unwrap();
        }
        let mut next = async || socket.next().await.unwrap().unwrap();
        assert_eq!(next().await, Message::Ping(Bytes::from_static(b"ping")));
        assert_eq!(next().await, Message::text("h\u{e9}llo"));
        assert_eq!(next().await, Message::Binary(vec![7; 300].into()));
        let mut pong = [0; 6];
        raw.read_exact(&mut pong).await.unwrap();
        assert_eq!(&pong, b"\x8a\x04ping");
    }

    #[tokio::test]
    async fn close_is_answered_with_its_code() {
        for (payload, answer) in [
            (&b""[..], &b"\x88\x00"[..]),
            (b"\x03\xe8bye", b"\x88\x02\x03\xe8"),
            (b"\x03\xed", b"\x88\x02\x03\xea"),
        ] {
            let (mut raw, mut socket) = pair(1 << 16);
            raw.write_all(&frame(0x88, payload)).await.unwrap();
            assert!(matches!(socket.next().await, Some(Ok(Message::Close(_)))));
            assert!(socket.next().await.is_none());
            assert!(matches!(socket.send(Message::text("x")).await, Err(WebSocketError::Closed)));
            drop(socket);
            let mut told = Vec::new();
            raw.read_to_end(&mut told).await.unwrap();
            assert_eq!(told, answer);
        }
    }

    #[tokio::test]
    async fn breaches_and_long_messages_are_errors() {
        for bytes in [
            vec![0x81, 0x01, b'x'],
            frame(0x80, b"x"),
            [frame(0x01, b"x"), frame(0x01, b"x")].concat(),
            frame(0xc1, b"x"),
            frame(0x83, b"x"),
            frame(0x09, b"x"),
            frame(0x88, b"x"),
        ] {
            let error = error_of(&bytes).await;
            assert!(matches!(error, WebSocketError::Protocol(_)), "{bytes:?}: {error}");
        }
        assert!(matches!(error_of(&frame(0x81, &[0xff])).await, WebSocketError::NotText));
        // The head is enough.
        let long = frame(0x81, &[b'x'; MAX + 1]);
        assert!(matches!(error_of(&long[..8]).await, WebSocketError::TooLong { max: MAX }));
        let pieces = [frame(0x01, &[b'x'; MAX]), frame(0x80, b"x")].concat();
        assert!(matches!(error_of(&pieces).await, WebSocketError::TooLong { max: MAX }));
        let (raw, mut socket) = pair(1 << 16);
        drop(raw);
        assert!(matches!(socket.next().await, Some(Err(WebSocketError::Cut))));
    }

    #[tokio::test]
    async fn peer_that_does_not_read_takes_bounded_memory() {
        let (mut raw, mut socket) = pair(1 << 16);
        for _ in 0..1000 {
            raw.write_all(&frame(0x89, &[7; 100])).await.unwrap();
            while socket.next().now_or_never().is_some() {}
        }
        assert!(socket.output.len() <= 2 + 125);
        let content = Bytes::from(vec![0; MAX]);
        let mut fed = 0;
        while socket.feed(Message::Binary(content.clone())).now_or_never().is_some() {
            fed += 1;
            assert!(fed < 1000);
        }
        assert!(socket.output.len() < WRITE_BYTES + MAX + 100);
    }
}
