//! The floor: messages with their length in front over TCP, and over TLS 1.3 as rustls does it. One thread at each end,
//! and nothing else.

use std::io::{BufReader, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Result, ensure};
use rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName};
use rustls::{ClientConfig, ClientConnection, RootCertStore, ServerConfig, ServerConnection, StreamOwned};
use sgc_testkit::netsim::Namespace;

use super::{Caller, NEVER, Wire};

pub(super) const TCP: &str = "raw TCP";
pub(super) const TLS: &str = "raw rustls";
/// Whom the certificate is for.
const HOST: &str = "far.example";
/// Length, and whether an answer is wanted.
const HEAD_BYTES: usize = 5;
/// Bytes per read and write, if so many are there, so that small messages go together.
const BUFFER_BYTES: usize = 64 << 10;

pub(super) fn write_credentials(dir: &Path) -> Result<()> {
    let made = rcgen::generate_simple_self_signed([HOST.to_owned()])?;
    std::fs::write(dir.join("raw.cert"), made.cert.der())?;
    Ok(std::fs::write(dir.join("raw.key"), made.signing_key.serialize_der())?)
}

fn certificate(dir: &Path) -> Result<CertificateDer<'static>> {
    Ok(std::fs::read(dir.join("raw.cert"))?.into())
}

fn provider() -> Arc<rustls::crypto::CryptoProvider> {
    Arc::new(rustls::crypto::aws_lc_rs::default_provider())
}

/// Connects to one far end.
pub(super) struct RawCaller {
    to: SocketAddr,
    home: Option<Arc<Namespace>>,
    /// None is TCP alone.
    tls: Option<Arc<ClientConfig>>,
}

impl RawCaller {
    pub(super) fn new(kind: &str, to: &str, dir: &Path, home: Option<Arc<Namespace>>) -> Result<Self> {
        let mut roots = RootCertStore::empty();
        roots.add(certificate(dir)?)?;
        let tls = ClientConfig::builder_with_provider(provider())
            .with_protocol_versions(&[&rustls::version::TLS13])?
            .with_root_certificates(roots)
            .with_no_client_auth();
        Ok(Self { to: to.parse()?, home, tls: (kind == TLS).then(|| Arc::new(tls)) })
    }
}

impl Caller for RawCaller {
    fn call(&self) -> Result<Box<dyn Wire>> {
        let stream = match &self.home {
            Some(home) => home.within(|| TcpStream::connect(self.to))??,
            None => TcpStream::connect(self.to)?,
        };
        stream.set_nodelay(true)?;
        stream.set_read_timeout(Some(NEVER))?;
        stream.set_write_timeout(Some(NEVER))?;
        let Some(tls) = &self.tls else { return Ok(Box::new(RawWire { stream, buffer: Vec::new() })) };
        let mut connection = ClientConnection::new(Arc::clone(tls), ServerName::try_from(HOST)?)?;
        let mut stream = stream;
        while connection.is_handshaking() {
            connection.complete_io(&mut stream)?;
        }
        Ok(Box::new(RawWire { stream: StreamOwned::new(connection, stream), buffer: Vec::new() }))
    }
}

struct RawWire<S> {
    stream: S,
    /// Messages that go together.
    buffer: Vec<u8>,
}

impl<S: Read + Write> Wire for RawWire<S> {
    fn send(&mut self, bytes: usize, messages: u64) -> Result<()> {
        let payload = vec![7; bytes];
        for message in 1..=messages {
            self.buffer.extend_from_slice(&(bytes as u32).to_le_bytes());
            self.buffer.push(u8::from(message == messages));
            self.buffer.extend_from_slice(&payload);
            if self.buffer.len() >= BUFFER_BYTES || message == messages {
                self.stream.write_all(&self.buffer)?;
                self.stream.flush()?;
                self.buffer.clear();
            }
        }
        Ok(self.stream.read_exact(&mut [0])?)
    }
}

/// The far end, a thread for each connection.
pub(super) fn serve(kind: &str, listen: &str, dir: &Path) -> Result<()> {
    let listener = TcpListener::bind(listen)?;
    let key: PathBuf = dir.join("raw.key");
    let key = PrivateKeyDer::try_from(std::fs::read(key)?).map_err(anyhow::Error::msg)?;
    let tls = ServerConfig::builder_with_provider(provider())
        .with_protocol_versions(&[&rustls::version::TLS13])?
        .with_no_client_auth()
        .with_single_cert(vec![certificate(dir)?], key)?;
    let tls = (kind == TLS).then(|| Arc::new(tls));
    println!("{}", listener.local_addr()?);
    for stream in listener.incoming() {
        let (stream, tls) = (stream?, tls.clone());
        stream.set_nodelay(true)?;
        std::thread::spawn(move || match tls {
            Some(tls) => answer(StreamOwned::new(ServerConnection::new(tls)?, stream)),
            None => answer(stream),
        });
    }
    Ok(())
}

fn answer(stream: impl Read + Write) -> Result<()> {
    let mut stream = BufReader::with_capacity(BUFFER_BYTES, stream);
    let (mut head, mut payload) = ([0; HEAD_BYTES], Vec::new());
    loop {
        stream.read_exact(&mut head)?;
        let [a, b, c, d, wants_answer] = head;
        payload.resize(u32::from_le_bytes([a, b, c, d]) as usize, 0);
        stream.read_exact(&mut payload)?;
        ensure!(wants_answer <= 1, "the stream is out of step");
        if wants_answer == 1 {
            stream.get_mut().write_all(&[1])?;
            stream.get_mut().flush()?;
        }
    }
}
