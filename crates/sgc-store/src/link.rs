//! A connection to one server, with tracking of the keys that are read over it.
//!
//! Moves bytes; the [`Cluster`](crate::cluster::Cluster) decides what to send, and when a link has been silent too long.

use std::io;
use std::time::Duration;

use thiserror::Error;
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tokio::sync::mpsc;
use tokio::time::timeout;
use tokio_rustls::TlsConnector;

use crate::cluster::{LinkEvent, LinkId};
use crate::command::message;
use crate::config::{ServerAddress, StoreTls, StoreUser};
use crate::resp::{Decoder, Frame, Limits, RespError, encode};

use rustls_pki_types::ServerName;
use sgc_router::STORE_VALUE_BYTES_MAX;

/// Longest time from the look-up of the host until the server has accepted the user.
pub(crate) const CONNECT_MAX: Duration = Duration::from_secs(2);
/// Most addresses of a host that are tried.
const ADDRESSES_MAX: usize = 4;
/// Bytes that one read asks for, and that one write takes together at least.
const READ_BYTES: usize = 16 << 10;
/// Commands that are written together.
const BATCH_MAX: usize = 64;
/// Most bytes that a frame is counted with: `CLUSTER SLOTS` of some 1500 ranges with two replicas each.
const FRAME_BYTES_MAX: usize = 2 << 20;

pub(crate) const LIMITS: Limits =
    Limits { string_bytes_max: STORE_VALUE_BYTES_MAX, frame_bytes_max: FRAME_BYTES_MAX };

/// The way to a server: user and TLS.
#[derive(Clone, Debug)]
pub(crate) struct Access {
    pub(crate) user: Option<StoreUser>,
    pub(crate) tls: Option<StoreTls>,
}

/// The reason why a link ended, or did not begin.
#[derive(Debug, Error)]
pub(crate) enum LinkError {
    #[error("no connection: {0}")]
    Connect(io::Error),
    #[error("no TLS: {0}")]
    Tls(io::Error),
    #[error("no answer within {} s", CONNECT_MAX.as_secs())]
    Timeout,
    #[error("the server refuses the user: {0}")]
    User(String),
    #[error("the server does not speak RESP3: {0}")]
    Version(String),
    #[error("the server does not track keys: {0}")]
    Tracking(String),
    #[error("the server closed the connection")]
    Closed,
    #[error("the connection broke: {0}")]
    Broken(io::Error),
    #[error(transparent)]
    Protocol(#[from] RespError),
}

trait Stream: AsyncRead + AsyncWrite + Send + Unpin {}
impl<S: AsyncRead + AsyncWrite + Send + Unpin> Stream for S {}

/// A connection whose server has accepted the user.
pub(crate) struct Connection {
    stream: Box<dyn Stream>,
    decoder: Decoder,
}

impl Connection {
    /// Connects, with RESP3 and the user.
    pub(crate) async fn open(server: &ServerAddress, access: &Access) -> Result<Self, LinkError> {
        let tcp = connect(server).await.map_err(LinkError::Connect)?;
        let stream: Box<dyn Stream> = match &access.tls {
            None => Box::new(tcp),
            Some(tls) => {
                let name = ServerName::try_from(server.host.to_string())
                    .map_err(|error| LinkError::Tls(io::Error::other(error)))?;
                let tls =
                    TlsConnector::from(tls.0.clone()).connect(name, tcp).await.map_err(LinkError::Tls)?;
                Box::new(tls)
            }
        };
        let mut connection = Self { stream, decoder: Decoder::new(LIMITS) };
        let mut hello: Vec<&[u8]> = vec![b"HELLO", b"3"];
        if let Some(user) = &access.user {
            hello.extend([b"AUTH".as_slice(), user.name.as_bytes(), &user.password]);
        }
        match connection.call(&hello).await? {
            Frame::Error(text)
                if text.starts_with(b"NOPROTO") || text.starts_with(b"ERR unknown command") =>
            {
                Err(LinkError::Version(message(&text)))
            }
            Frame::Error(text) => Err(LinkError::User(message(&text))),
            _ => Ok(connection),
        }
    }

    /// Turns tracking on: the server reports the next change of each key that is read over this connection.
    pub(crate) async fn track(&mut self) -> Result<(), LinkError> {
        match self.call(&[b"CLIENT", b"TRACKING", b"ON"]).await? {
            Frame::Error(text) => Err(LinkError::Tracking(message(&text))),
            _ => Ok(()),
        }
    }

    /// Sends a command and returns the reply. Pushes before it are dropped.
    pub(crate) async fn call(&mut self, command: &[&[u8]]) -> Result<Frame, LinkError> {
        let mut bytes = Vec::new();
        encode(command, &mut bytes);
        self.stream.write_all(&bytes).await.map_err(LinkError::Broken)?;
        self.stream.flush().await.map_err(LinkError::Broken)?;
        loop {
            match self.next().await? {
                Frame::Push(_) => {}
                reply => return Ok(reply),
            }
        }
    }

    /// Returns the next reply or push.
    pub(crate) async fn next(&mut self) -> Result<Frame, LinkError> {
        next_frame(&mut self.stream, &mut self.decoder).await
    }
}

async fn next_frame<R>(stream: &mut R, decoder: &mut Decoder) -> Result<Frame, LinkError>
where
    R: AsyncRead + Unpin,
{
    loop {
        if let Some(frame) = decoder.next_frame()? {
            return Ok(frame);
        }
        let buffer = decoder.buffer();
        buffer.reserve(READ_BYTES);
        match stream.read_buf(buffer).await {
            Ok(0) => return Err(LinkError::Closed),
            Ok(_) => {}
            Err(error) => return Err(LinkError::Broken(error)),
        }
    }
}

async fn connect(server: &ServerAddress) -> io::Result<TcpStream> {
    let found = tokio::net::lookup_host((&*server.host, server.port)).await?;
    let mut last = io::Error::new(io::ErrorKind::NotFound, "the host has no address");
    for address in found.take(ADDRESSES_MAX) {
        match TcpStream::connect(address).await {
            Ok(stream) => {
                stream.set_nodelay(true)?;
                return Ok(stream);
            }
            Err(error) => last = error,
        }
    }
    Err(last)
}

/// Runs a link until it ends. Its events end with [`LinkEvent::Closed`], unless the task is aborted.
pub(crate) async fn run(
    id: LinkId,
    server: ServerAddress,
    access: Access,
    commands: mpsc::Receiver<Vec<u8>>,
    events: mpsc::Sender<(LinkId, LinkEvent)>,
) {
    let opened = timeout(CONNECT_MAX, async {
        let mut connection = Connection::open(&server, &access).await?;
        connection.track().await?;
        Ok(connection)
    });
    let error = match opened.await {
        Err(_) => LinkError::Timeout,
        Ok(Err(error)) => error,
        Ok(Ok(connection)) => {
            if events.send((id, LinkEvent::Ready)).await.is_err() {
                return;
            }
            let Connection { stream, mut decoder } = connection;
            let (mut reader, writer) = tokio::io::split(stream);
            let read = async {
                loop {
                    let frame = match next_frame(&mut reader, &mut decoder).await {
                        Ok(frame) => frame,
                        Err(error) => return error,
                    };
                    if events.send((id, LinkEvent::Frame(frame))).await.is_err() {
                        return LinkError::Closed;
                    }
                }
            };
            tokio::select! {
                error = read => error,
                written = write(writer, commands) => match written {
                    Err(error) => LinkError::Broken(error),
                    // The driver needs the link no more.
                    Ok(()) => return,
                },
            }
        }
    };
    let _ = events.send((id, LinkEvent::Closed(error.to_string()))).await;
}

/// Writes commands until the driver drops its end.
async fn write<W>(mut writer: W, mut commands: mpsc::Receiver<Vec<u8>>) -> io::Result<()>
where
    W: AsyncWrite + Unpin,
{
    let mut batch = Vec::new();
    let mut bytes = Vec::new();
    while commands.recv_many(&mut batch, BATCH_MAX).await > 0 {
        bytes.clear();
        batch.drain(..).for_each(|command| bytes.extend_from_slice(&command));
        writer.write_all(&bytes).await?;
        writer.flush().await?;
    }
    Ok(())
}
