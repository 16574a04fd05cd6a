//! Whole conversations with the acceptor of stream links, in memory, for fuzzing: hostile bytes into the acceptor, a
//! member that sends arbitrary bytes inside of TLS, and an attacker who alters the bytes of two honest ends.

use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use bytes::Bytes;
use sgc_trust::Identity;
use sgc_wire::Class;
use tokio::io::{AsyncRead, AsyncWrite, AsyncWriteExt as _, DuplexStream, ReadBuf};
use tokio::time::timeout;

use super::endpoint::start;
use super::handshake::{self, PreparedSocket};
use super::wire::{Counters, Wire};
use crate::credentials::CredentialStore;
use crate::framing::Greeting;
use crate::link::Link;
use crate::options::LinkOptions;
use crate::url::{DEFAULT_PATH, LinkUrl, Scheme};

/// Longest handshake: bytes altered on the way can leave both ends waiting for each other.
const HANDSHAKE_MAX: Duration = Duration::from_millis(200);
/// Bytes that wait between two ends.
const PIPE_BYTES: usize = 64 << 10;
const MTU_BYTES: u16 = 1448;
/// Longest conversation. Longer is a defect: each of its ends is closed.
const CONVERSATION_MAX: Duration = Duration::from_secs(30);
/// Time that a listener waits for a peer that says nothing more.
const SILENCE: Duration = Duration::from_millis(3);
/// Control frames that each honest end sends.
const FRAMES: u8 = 3;

/// A listener's front door and two members of its fleet.
pub struct DoorExercise {
    listener: CredentialStore,
    member: CredentialStore,
    options: LinkOptions,
}

/// The mode that the first byte of a script chooses.
#[derive(Clone, Copy)]
enum Mode {
    /// The script holds the bytes of a stranger.
    Stranger,
    /// The script holds the bytes of a member inside of its TLS, greeting and frames.
    Member,
    /// The script changes the bytes between two honest ends.
    Between,
}

impl DoorExercise {
    /// Creates one with the identities of both ends.
    pub fn new(listener: Arc<Identity>, member: Arc<Identity>) -> Self {
        let options = LinkOptions { handshake_timeout: CONVERSATION_MAX, ..LinkOptions::default() };
        Self { listener: CredentialStore::new(listener), member: CredentialStore::new(member), options }
    }

    /// Runs one conversation. Panics if it shows a defect.
    pub async fn run(&self, script: &[u8]) {
        let Some((choice, script)) = script.split_first() else { return };
        let scheme = [Scheme::Tls, Scheme::Tcp, Scheme::Ws, Scheme::Wss][usize::from(choice % 4)];
        let mode = [Mode::Stranger, Mode::Member, Mode::Between][usize::from(choice / 4 % 3)];
        let conversation = async {
            match mode {
                Mode::Stranger => self.hear_stranger(scheme, script).await,
                Mode::Member => self.hear_member(scheme, script).await,
                Mode::Between => self.pass_between(scheme, script).await,
            }
        };
        timeout(CONVERSATION_MAX, conversation).await.expect("a conversation that does not end");
    }

    async fn accept(&self, wire: Wire, scheme: Scheme) -> Option<super::StreamLink> {
        let made = handshake::accept_on(prepared(wire), scheme, DEFAULT_PATH, &self.listener, &self.options);
        let made = timeout(HANDSHAKE_MAX, made).await.ok()?.ok()?;
        let (link, _) = start(made, nowhere(), false, &self.options);
        assert_eq!(
            link.peer().node_id,
            self.member.identity().node_id(),
            "a link with somebody who is no member"
        );
        Some(link)
    }

    async fn hear_stranger(&self, scheme: Scheme, script: &[u8]) {
        let (near, far) = tokio::io::duplex(PIPE_BYTES);
        let stranger = say(far, script);
        let (link, ()) = tokio::join!(self.accept(Box::new(near), scheme), stranger);
        assert!(link.is_none(), "a stranger has a link");
    }

    async fn hear_member(&self, scheme: Scheme, script: &[u8]) {
        let (near, far) = tokio::io::duplex(PIPE_BYTES);
        let listener = async {
            if let Some(link) = self.accept(Box::new(near), scheme).await {
                read_all(&link).await;
            }
        };
        let member = async {
            let url = url(scheme);
            let dialled = handshake::dial_on(prepared(Box::new(far)), &url, &self.member, &self.options);
            if let Ok(Ok(secured)) = timeout(HANDSHAKE_MAX, dialled).await {
                say(secured.into_stream(), script).await;
            }
        };
        tokio::join!(listener, member);
    }

    async fn pass_between(&self, scheme: Scheme, script: &[u8]) {
        let (near, far) = tokio::io::duplex(PIPE_BYTES);
        // Odd steps are for one direction, even ones for the other.
        let steps: Vec<Step> = script.chunks_exact(4).map(Step::from_bytes).collect();
        let ours = steps.iter().copied().step_by(2).collect();
        let theirs = steps.iter().copied().skip(1).step_by(2).collect();
        let near = TamperingPipe { pipe: near, steps: ours, at: 0 };
        let far = TamperingPipe { pipe: far, steps: theirs, at: 0 };
        let listener = async {
            if let Some(link) = self.accept(Box::new(near), scheme).await {
                converse(&link).await;
            }
        };
        let dialer = async {
            let url = url(scheme);
            let dialled = handshake::dial_on(prepared(Box::new(far)), &url, &self.member, &self.options);
            let Ok(Ok(secured)) = timeout(HANDSHAKE_MAX, dialled).await else { return };
            let greeted = timeout(HANDSHAKE_MAX, secured.greet(Greeting::default()));
            let Ok(Ok(made)) = greeted.await else { return };
            let (link, _) = start(made, nowhere(), true, &self.options);
            assert_eq!(
                link.peer().node_id,
                self.listener.identity().node_id(),
                "another listener is believed"
            );
            converse(&link).await;
        };
        tokio::join!(listener, dialer);
    }
}

fn prepared(wire: Wire) -> PreparedSocket {
    (wire, Arc::<Counters>::default(), MTU_BYTES)
}

fn nowhere() -> std::net::SocketAddr {
    ([127, 0, 0, 1], 0).into()
}

fn url(scheme: Scheme) -> LinkUrl {
    LinkUrl { scheme, host: "localhost".into(), port: 1, path: None, cost_ms: None }
}

/// Sends the whole script, and reads until the other end has enough.
async fn say(mut wire: impl AsyncRead + AsyncWrite + Unpin, script: &[u8]) {
    let said = async {
        wire.write_all(script).await?;
        wire.shutdown().await
    };
    // The other end may have enough before.
    let _ = said.await;
    let _ = timeout(SILENCE, tokio::io::copy(&mut wire, &mut tokio::io::sink())).await;
}

/// Reads everything on a link until it ends or falls silent.
async fn read_all(link: &super::StreamLink) {
    loop {
        let more = async {
            tokio::select! {
                frame = link.recv_control() => frame.is_ok(),
                datagram = link.recv_datagram() => datagram.is_ok(),
                flow = link.accept_flow() => match flow {
                    Ok(mut flow) => {
                        while let Ok(Ok(Some(_))) = timeout(SILENCE, flow.recv()).await {}
                        true
                    }
                    Err(_) => false,
                },
            }
        };
        if !timeout(SILENCE, more).await.unwrap_or(false) {
            return;
        }
    }
}

/// Runs one honest end: sends its frames, and checks that those of the other arrive unaltered and in order.
async fn converse(link: &super::StreamLink) {
    let frame = |number: u8| Bytes::from(vec![number; 100 * usize::from(number) + 1]);
    for number in 0..FRAMES {
        if link.send_control(frame(number)).await.is_err() {
            return;
        }
    }
    if let Ok(flow) = link.open_flow(Class::Default).await {
        let _ = flow.finish().await;
    }
    for number in 0..FRAMES {
        match timeout(SILENCE, link.recv_control()).await {
            Ok(Ok(got)) => assert_eq!(got, frame(number), "what was altered on the way is believed"),
            _ => return,
        }
    }
    read_all(link).await;
}

/// A change of the stream, this many bytes behind the step before.
#[derive(Clone, Copy)]
struct Step {
    after: usize,
    kind: u8,
    value: u8,
}

impl Step {
    fn from_bytes(bytes: &[u8]) -> Self {
        let after = usize::from(u16::from_be_bytes([bytes[0], bytes[1]])) % 4096;
        Self { after, kind: bytes[2] % 5, value: bytes[3] }
    }
}

/// A pipe whose bytes an attacker alters.
struct TamperingPipe {
    pipe: DuplexStream,
    steps: std::collections::VecDeque<Step>,
    /// Bytes since the last step.
    at: usize,
}

impl AsyncRead for TamperingPipe {
    fn poll_read(self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let this = self.get_mut();
        let room = buf.remaining();
        if room == 0 {
            return Poll::Ready(Ok(()));
        }
        // Up to the next step, which then has its first byte to itself.
        let most = this.steps.front().map_or(room, |step| step.after.saturating_sub(this.at).clamp(1, room));
        let is_due = this.steps.front().is_some_and(|step| this.at >= step.after);
        let mut piece = ReadBuf::new(buf.initialize_unfilled_to(most));
        ready!(Pin::new(&mut this.pipe).poll_read(cx, &mut piece))?;
        let mut bytes = piece.filled().to_vec();
        if bytes.is_empty() {
            return Poll::Ready(Ok(()));
        }
        this.at += bytes.len();
        if is_due {
            let step = this.steps.pop_front();
            this.at = 0;
            match step.map_or((0, 0), |step| (step.kind, step.value)) {
                (0, value) => bytes[0] ^= value,
                (1, _) => bytes.clear(),
                (2, value) => bytes.insert(0, value),
                (3, _) => bytes.push(bytes[0]),
                // The end.
                _ => {
                    bytes.clear();
                    this.steps.clear();
                    return Poll::Ready(Ok(()));
                }
            }
        }
        if bytes.is_empty() {
            // An empty read would be the end of the stream, which is not meant.
            cx.waker().wake_by_ref();
            return Poll::Pending;
        }
        bytes.truncate(room);
        buf.put_slice(&bytes);
        Poll::Ready(Ok(()))
    }
}

impl AsyncWrite for TamperingPipe {
    fn poll_write(self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.get_mut().pipe).poll_write(cx, buf)
    }

    fn poll_flush(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.get_mut().pipe).poll_flush(cx)
    }

    fn poll_shutdown(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.get_mut().pipe).poll_shutdown(cx)
    }
}
