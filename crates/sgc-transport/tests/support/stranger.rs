//! A stranger that speaks DTLS with `dimpl`, as a client and as a listener, with a certificate of any length.
#![allow(dead_code, unreachable_pub, reason = "shared by test programs of which each uses a part")]

use std::collections::HashMap;
use std::net::{SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use dimpl::{Config, Dtls, DtlsCertificate, Output, ProtocolVersion};
use rcgen::{CertificateParams, CustomExtension, KeyPair};

pub const VERSIONS: [ProtocolVersion; 2] = [ProtocolVersion::DTLS1_2, ProtocolVersion::DTLS1_3];

/// A self-signed certificate of about this length, bytes, with its key.
pub struct LongCertificate {
    pub certificate: rcgen::Certificate,
    pub key: KeyPair,
}

impl LongCertificate {
    pub fn new(bytes: usize) -> Self {
        let key = KeyPair::generate().unwrap();
        let mut params = CertificateParams::default();
        let padding = CustomExtension::from_oid_content(&[1, 3, 6, 1, 4, 1, 99_999, 1], vec![0x5a; bytes]);
        params.custom_extensions.push(padding);
        let certificate = params.self_signed(&key).unwrap();
        Self { certificate, key }
    }

    pub fn for_dtls(&self) -> DtlsCertificate {
        DtlsCertificate {
            certificate: self.certificate.der().to_vec(),
            private_key: self.key.serialize_der(),
        }
    }
}

/// A stranger's observations of one handshake.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct HandshakeLog {
    /// The certificate that it was shown, DER.
    pub certificate: Option<Vec<u8>>,
    /// The handshake was finished.
    pub is_connected: bool,
    /// The datagrams that came, in order.
    pub received: Vec<Vec<u8>>,
}

struct End {
    dtls: Dtls,
    buffer: Vec<u8>,
    due: Instant,
    met: HandshakeLog,
}

impl End {
    fn new(
        version: ProtocolVersion,
        certificate: &DtlsCertificate,
        datagram_bytes: usize,
        is_client: bool,
    ) -> Self {
        let config = Config::builder().mtu(datagram_bytes).max_queue_tx(100).max_queue_rx(100);
        let config = Arc::new(config.flight_start_rto(Duration::from_millis(200)).build().unwrap());
        let now = Instant::now();
        let mut dtls = match version {
            ProtocolVersion::DTLS1_2 => Dtls::new_12(config, certificate.clone(), now),
            _ => Dtls::new_13(config, certificate.clone(), now),
        };
        dtls.set_active(is_client);
        Self { dtls, buffer: vec![0; 1 << 18], due: now, met: HandshakeLog::default() }
    }

    fn drive(&mut self, datagram: Option<&[u8]>, mut send: impl FnMut(&[u8])) {
        let now = Instant::now();
        let _ = self.dtls.handle_timeout(now);
        if let Some(datagram) = datagram {
            self.met.received.push(datagram.to_vec());
            let _ = self.dtls.handle_packet(datagram);
        }
        loop {
            match self.dtls.poll_output(&mut self.buffer) {
                Output::Packet(packet) => send(packet),
                Output::PeerCert(leaf) => self.met.certificate = Some(leaf.to_vec()),
                Output::Connected => self.met.is_connected = true,
                Output::Timeout(due) => {
                    self.due = due;
                    return;
                }
                Output::BufferTooSmall { needed } => panic!("{needed} bytes"),
                _ => {}
            }
        }
    }
}

fn wait_on(socket: &UdpSocket, until: Instant) {
    let wait = until
        .saturating_duration_since(Instant::now())
        .clamp(Duration::from_millis(1), Duration::from_millis(20));
    socket.set_read_timeout(Some(wait)).unwrap();
}

/// Shakes hands with a listener for at most this long, in datagrams of at most this length.
pub fn visit(
    listener: SocketAddr,
    version: ProtocolVersion,
    certificate: &DtlsCertificate,
    datagram_bytes: usize,
    patience: Duration,
) -> HandshakeLog {
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    socket.connect(listener).unwrap();
    let mut end = End::new(version, certificate, datagram_bytes, true);
    let (deadline, mut datagram) = (Instant::now() + patience, vec![0; 1 << 16]);
    let mut len = None;
    while Instant::now() < deadline && !end.met.is_connected {
        end.drive(len.map(|len| &datagram[..len]), |packet| {
            let _ = socket.send(packet);
        });
        wait_on(&socket, end.due);
        len = socket.recv(&mut datagram).ok();
    }
    end.met
}

/// A listener without an identity, for as long as it lives.
pub struct FakeListener {
    pub addr: SocketAddr,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<Vec<HandshakeLog>>>,
}

impl FakeListener {
    pub fn start(version: ProtocolVersion, certificate: DtlsCertificate, datagram_bytes: usize) -> Self {
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        let addr = socket.local_addr().unwrap();
        let stop = Arc::new(AtomicBool::new(false));
        let thread = {
            let stop = Arc::clone(&stop);
            std::thread::spawn(move || {
                let (mut ends, mut datagram) = (HashMap::<SocketAddr, End>::new(), vec![0; 1 << 16]);
                while !stop.load(Relaxed) {
                    let due = ends.values().map(|end| end.due).min();
                    wait_on(&socket, due.unwrap_or_else(|| Instant::now() + Duration::from_secs(1)));
                    let came = socket.recv_from(&mut datagram).ok();
                    if let Some((len, from)) = came {
                        let end = ends
                            .entry(from)
                            .or_insert_with(|| End::new(version, &certificate, datagram_bytes, false));
                        end.drive(Some(&datagram[..len]), |packet| {
                            let _ = socket.send_to(packet, from);
                        });
                    }
                    for (to, end) in &mut ends {
                        end.drive(None, |packet| {
                            let _ = socket.send_to(packet, to);
                        });
                    }
                }
                ends.into_values().map(|end| end.met).collect()
            })
        };
        Self { addr, stop, thread: Some(thread) }
    }

    /// Stops it, and returns its observations.
    pub fn stop(mut self) -> Vec<HandshakeLog> {
        self.stop.store(true, Relaxed);
        self.thread.take().unwrap().join().unwrap()
    }
}

impl Drop for FakeListener {
    fn drop(&mut self) {
        self.stop.store(true, Relaxed);
    }
}
