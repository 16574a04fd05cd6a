//! The bare path beside `sgc`: a plain echo over TCP and UDP that shows the cost of the network itself.
//!
//! It is open for the time of one run, to one address, and only for a peer that knows the id of the run, which the
//! other side gets through `sgc`. It echoes or counts bytes up to a bound, and never interprets them.

use std::io::{self, Read, Write};
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, Shutdown, SocketAddr, TcpStream, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use aws_lc_rs::constant_time::verify_slices_are_equal;
use sgc_process::ProcessError;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::runtime::Runtime;
use tokio::sync::Semaphore;
use tokio::time::timeout;

use crate::error::MeasureError;
use crate::words::{RunId, SIZE_MAX};

/// Bytes of the token in front of everything.
const TOKEN_BYTES: usize = 32;
/// Connections at once; the measuring side has one at a time.
const CONNECTIONS_MAX: usize = 4;
/// Most bytes that one connection or the UDP socket takes.
const BYTES_MAX: u64 = 16 << 30;
/// Longest silence of a connection.
const SILENCE_MAX: Duration = Duration::from_secs(10);
/// Longest wait for a connection.
const CONNECT_MAX: Duration = Duration::from_secs(4);
/// Time after which a UDP packet counts as lost.
const PACKET_MAX: Duration = Duration::from_secs(1);
/// Largest content of a UDP packet, which fits the MTU of every path.
pub(crate) const UDP_BYTES_MAX: usize = 1100;
/// Bytes per read.
const PIECE_BYTES: usize = 256 << 10;
/// The first byte of a connection: its purpose.
const ECHO: u8 = 1;
const COUNT: u8 = 2;

/// The answering end. Dropping it closes the ports.
pub(crate) struct Echo {
    runtime: Option<Runtime>,
    moved: Arc<AtomicU64>,
    tcp: u16,
    udp: u16,
}

impl Echo {
    /// Opens both ports for this peer and this run. The system chooses the ports if `port` is 0.
    pub(crate) fn open(peer: IpAddr, run: &RunId, port: u16) -> Result<Self, MeasureError> {
        let failed = |source| ProcessError::System { what: "cannot open the plain echo", source };
        let token = run.token().ok_or_else(|| failed(io::ErrorKind::InvalidInput.into()))?;
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .map_err(failed)?;
        let any = match peer {
            IpAddr::V4(_) => IpAddr::V4(Ipv4Addr::UNSPECIFIED),
            IpAddr::V6(_) => IpAddr::V6(Ipv6Addr::UNSPECIFIED),
        };
        let here = SocketAddr::new(any, port);
        let moved = Arc::<AtomicU64>::default();
        let (tcp, udp) = runtime
            .block_on(async {
                let tcp = tokio::net::TcpListener::bind(here).await?;
                let udp = tokio::net::UdpSocket::bind(here).await?;
                let ports = (tcp.local_addr()?.port(), udp.local_addr()?.port());
                tokio::spawn(serve_tcp(tcp, peer, token, Arc::clone(&moved)));
                tokio::spawn(serve_udp(udp, peer, token, Arc::clone(&moved)));
                io::Result::Ok(ports)
            })
            .map_err(failed)?;
        Ok(Self { runtime: Some(runtime), moved, tcp, udp })
    }

    /// Returns the number of bytes moved so far, which shows whether the echo is in use.
    pub(crate) fn moved(&self) -> u64 {
        self.moved.load(Ordering::Relaxed)
    }

    /// Returns the TCP port and the UDP port.
    pub(crate) fn ports(&self) -> (u16, u16) {
        (self.tcp, self.udp)
    }
}

impl Drop for Echo {
    fn drop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}

fn is_peer(from: SocketAddr, peer: IpAddr) -> bool {
    from.ip().to_canonical() == peer
}

async fn serve_tcp(
    listener: tokio::net::TcpListener,
    peer: IpAddr,
    token: [u8; TOKEN_BYTES],
    moved: Arc<AtomicU64>,
) {
    let places = Arc::new(Semaphore::new(CONNECTIONS_MAX));
    loop {
        let Ok((stream, from)) = listener.accept().await else {
            // The usual cause is a lack of descriptors, which passes.
            tokio::time::sleep(Duration::from_millis(100)).await;
            continue;
        };
        let Ok(place) = Arc::clone(&places).try_acquire_owned() else { continue };
        if is_peer(from, peer) {
            let moved = Arc::clone(&moved);
            tokio::spawn(async move {
                // An error is ignored, because the measuring side sees its own end of the connection.
                let _ = serve(stream, token, &moved).await;
                drop(place);
            });
        }
    }
}

async fn serve(
    mut stream: tokio::net::TcpStream,
    token: [u8; TOKEN_BYTES],
    moved: &AtomicU64,
) -> io::Result<()> {
    stream.set_nodelay(true)?;
    let mut said = [0; TOKEN_BYTES + 1];
    timeout(SILENCE_MAX, stream.read_exact(&mut said)).await??;
    let (shown, what) = said.split_at(TOKEN_BYTES);
    if verify_slices_are_equal(shown, &token).is_err() {
        return Ok(());
    }
    let mut taken = 0_u64;
    let mut piece = vec![0; PIECE_BYTES];
    if what == [COUNT] {
        while taken < BYTES_MAX {
            match timeout(SILENCE_MAX, stream.read(&mut piece)).await?? {
                0 => break,
                n => taken += n as u64,
            }
            moved.fetch_add(1, Ordering::Relaxed);
        }
        return stream.write_all(&taken.to_le_bytes()).await;
    }
    let mut message = Vec::new();
    while taken < BYTES_MAX {
        let mut length = [0; 4];
        timeout(SILENCE_MAX, stream.read_exact(&mut length)).await??;
        let bytes = u32::from_le_bytes(length) as usize;
        if bytes > SIZE_MAX {
            return Ok(());
        }
        message.clear();
        // Grows with received bytes, not with the announced length.
        while message.len() < bytes {
            let most = PIECE_BYTES.min(bytes - message.len());
            match timeout(SILENCE_MAX, stream.read(&mut piece[..most])).await?? {
                0 => return Ok(()),
                n => message.extend_from_slice(&piece[..n]),
            }
            moved.fetch_add(1, Ordering::Relaxed);
        }
        stream.write_all(&length).await?;
        stream.write_all(&message).await?;
        taken += bytes as u64;
    }
    Ok(())
}

async fn serve_udp(
    socket: tokio::net::UdpSocket,
    peer: IpAddr,
    token: [u8; TOKEN_BYTES],
    moved: Arc<AtomicU64>,
) {
    let (mut packet, mut taken) = ([0; 2048], 0_u64);
    while taken < BYTES_MAX {
        // ICMP errors of earlier answers appear as errors here.
        let Ok((bytes, from)) = socket.recv_from(&mut packet).await else { continue };
        let shown = packet.get(..bytes.min(TOKEN_BYTES)).unwrap_or_default();
        if is_peer(from, peer) && verify_slices_are_equal(shown, &token).is_ok() {
            let _ = socket.send_to(&packet[..bytes], from).await;
            taken += bytes as u64;
            moved.fetch_add(1, Ordering::Relaxed);
        }
    }
}

/// The measuring end of one TCP connection.
pub(crate) struct Tcp {
    stream: TcpStream,
}

impl Tcp {
    /// Connects for round trips.
    pub(crate) fn for_echo(at: SocketAddr, run: &RunId) -> io::Result<Self> {
        Self::connect(at, run, ECHO)
    }

    /// Connects for a counted stream.
    pub(crate) fn for_stream(at: SocketAddr, run: &RunId) -> io::Result<Self> {
        Self::connect(at, run, COUNT)
    }

    fn connect(at: SocketAddr, run: &RunId, what: u8) -> io::Result<Self> {
        let token = run.token().ok_or(io::ErrorKind::InvalidInput)?;
        let mut stream = TcpStream::connect_timeout(&at, CONNECT_MAX)?;
        stream.set_nodelay(true)?;
        stream.set_read_timeout(Some(SILENCE_MAX))?;
        stream.set_write_timeout(Some(SILENCE_MAX))?;
        stream.write_all(&[&token[..], &[what]].concat())?;
        Ok(Self { stream })
    }

    /// Sends one message there and back. Returns the time it took.
    pub(crate) fn round_trip(&mut self, message: &mut [u8]) -> io::Result<Duration> {
        let begun = Instant::now();
        let length = (message.len() as u32).to_le_bytes();
        // One write, so that a small message is one segment.
        self.stream.write_all(&[&length[..], message].concat())?;
        let mut back = [0; 4];
        self.stream.read_exact(&mut back)?;
        self.stream.read_exact(message)?;
        if back == length { Ok(begun.elapsed()) } else { Err(io::ErrorKind::InvalidData.into()) }
    }

    /// Sends `piece` again and again for `duration`. Returns the bytes that arrived, and the time from the first byte
    /// until the other end has the last.
    pub(crate) fn stream(mut self, piece: &[u8], duration: Duration) -> io::Result<(u64, Duration)> {
        let (begun, mut sent) = (Instant::now(), 0_u64);
        while begun.elapsed() < duration && sent + (piece.len() as u64) < BYTES_MAX {
            self.stream.write_all(piece)?;
            sent += piece.len() as u64;
        }
        self.stream.shutdown(Shutdown::Write)?;
        let mut counted = [0; 8];
        self.stream.read_exact(&mut counted)?;
        Ok((u64::from_le_bytes(counted), begun.elapsed()))
    }
}

/// The measuring end of UDP.
pub(crate) struct Udp {
    socket: UdpSocket,
    token: [u8; TOKEN_BYTES],
    seq: u64,
}

impl Udp {
    /// Opens a socket to that port.
    pub(crate) fn new(at: SocketAddr, run: &RunId) -> io::Result<Self> {
        let token = run.token().ok_or(io::ErrorKind::InvalidInput)?;
        let any = if at.is_ipv4() { IpAddr::V4(Ipv4Addr::UNSPECIFIED) } else { Ipv6Addr::UNSPECIFIED.into() };
        let socket = UdpSocket::bind((any, 0))?;
        socket.connect(at)?;
        Ok(Self { socket, token, seq: 0 })
    }

    /// Sends one packet there and back. Returns the time it took, or `None` if it was lost.
    pub(crate) fn round_trip(&mut self, bytes: usize) -> io::Result<Option<Duration>> {
        self.seq += 1;
        let mut packet = self.token.to_vec();
        packet.extend(self.seq.to_le_bytes());
        packet.resize(packet.len() + bytes.min(UDP_BYTES_MAX), 0);
        let begun = Instant::now();
        self.socket.send(&packet)?;
        let mut back = [0; 2048];
        loop {
            let left = PACKET_MAX.saturating_sub(begun.elapsed());
            if left.is_zero() {
                return Ok(None);
            }
            self.socket.set_read_timeout(Some(left))?;
            match self.socket.recv(&mut back) {
                Ok(n) if back[..n] == packet[..] => return Ok(Some(begun.elapsed())),
                // A late answer to a packet that counts as lost.
                Ok(_) => {}
                Err(e) if matches!(e.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut) => {}
                // An ICMP answer to an earlier packet: the port is closed.
                Err(error) => return Err(error),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HERE: IpAddr = IpAddr::V4(Ipv4Addr::LOCALHOST);

    fn at(port: u16) -> SocketAddr {
        SocketAddr::new(HERE, port)
    }

    #[test]
    fn echo_returns_or_counts_bytes() {
        let run = RunId::new([7; 16]);
        let echo = Echo::open(HERE, &run, 0).unwrap();
        let (tcp, udp) = echo.ports();
        let mut trips = Tcp::for_echo(at(tcp), &run).unwrap();
        for length in [1, 1000, 1_000_000] {
            let mut message: Vec<_> = (0..length).map(|i| i as u8).collect();
            let sent = message.clone();
            trips.round_trip(&mut message).unwrap();
            assert_eq!(message, sent);
        }
        let stream = Tcp::for_stream(at(tcp), &run).unwrap();
        let (counted, _) = stream.stream(&[7; 1000], Duration::from_millis(50)).unwrap();
        assert!(counted > 0 && counted % 1000 == 0, "{counted}");
        let mut packets = Udp::new(at(udp), &run).unwrap();
        assert!((0..10).any(|_| packets.round_trip(100).unwrap().is_some()));
    }

    #[test]
    fn echo_ignores_wrong_run_and_other_addresses() {
        let (run, other) = (RunId::new([7; 16]), RunId::new([8; 16]));
        let echo = Echo::open(HERE, &run, 0).unwrap();
        let (tcp, udp) = echo.ports();
        let trip = |run: &RunId, port| Tcp::for_echo(at(port), run)?.round_trip(&mut [1, 2, 3]);
        assert!(trip(&other, tcp).is_err());
        assert_eq!(Udp::new(at(udp), &other).unwrap().round_trip(10).unwrap(), None);
        let elsewhere = Echo::open("192.0.2.1".parse().unwrap(), &run, 0).unwrap();
        assert!(trip(&run, elsewhere.ports().0).is_err());
        assert!(trip(&run, tcp).is_ok());
    }

    #[test]
    fn echo_closes_with_its_run() {
        let run = RunId::new([7; 16]);
        let echo = Echo::open(HERE, &run, 0).unwrap();
        let (tcp, _) = echo.ports();
        drop(echo);
        let begun = Instant::now();
        while Tcp::for_echo(at(tcp), &run).and_then(|mut c| c.round_trip(&mut [1])).is_ok() {
            assert!(begun.elapsed() < Duration::from_secs(10), "it is still open");
        }
    }
}
