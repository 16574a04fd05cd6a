//! Plain sockets: an echo over UDP and a transfer over TCP, between the sites themselves or in a tunnel.

use std::io::{ErrorKind, Read as _, Write as _};
use std::net::{IpAddr, SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use sgc_testkit::netsim::Namespace;

use super::lab::{FORWARDED, Lab};
use super::pair::{Pair, Plan, START_MAX};
use crate::compare::Side;

/// The UDP port at both sites, which the NATs keep.
const PORT: u16 = 5000;
/// How often a site sends until the other answers.
const KNOCK_EVERY: Duration = Duration::from_millis(5);
/// How long a round trip may take.
const LOST_AFTER: Duration = Duration::from_secs(2);
/// How often the answering thread looks whether it has to end.
const LOOK_EVERY: Duration = Duration::from_millis(100);
/// Bytes of a packet that only opens a NAT; no message is so short.
const KNOCK: &[u8] = b"knock";
/// Bytes of a write.
const CHUNK_BYTES: usize = 64 << 10;

/// The sockets of both sites.
pub(super) struct Sockets {
    near: UdpSocket,
    far: SocketAddr,
    listener: TcpListener,
    dials: SocketAddr,
    left: Arc<Namespace>,
    ends: Arc<AtomicBool>,
    answering: Option<JoinHandle<()>>,
}

impl Sockets {
    /// Opens them between the sites themselves. Both send until a packet has passed the NATs both ways.
    pub(super) fn between_sites(lab: &Lab) -> Result<Self> {
        let own = Side::BOTH.map(|side| IpAddr::from(Lab::inside(side)));
        let seen = Side::BOTH.map(|side| IpAddr::from(Lab::outside(side)));
        Ok(Self::open(lab, own, seen)?.0)
    }

    /// Opens them at addresses in a tunnel. Also returns the time until the first echo.
    pub(super) fn in_tunnel(lab: &Lab, addresses: [IpAddr; 2]) -> Result<(Self, Duration)> {
        Self::open(lab, addresses, addresses)
    }

    /// Opens them at these addresses, which the other site sees as others.
    fn open(lab: &Lab, own: [IpAddr; 2], seen: [IpAddr; 2]) -> Result<(Self, Duration)> {
        let bind = |side: Side| {
            let address = SocketAddr::new(own[side as usize], PORT);
            let socket = lab.site(side).within(|| UdpSocket::bind(address))?;
            socket.with_context(|| format!("a socket at {address}"))
        };
        let (near, far_socket) = (bind(Side::Left)?, bind(Side::Right)?);
        let (listens, dials) = (SocketAddr::new(own[1], FORWARDED), SocketAddr::new(seen[1], FORWARDED));
        let listener = lab.site(Side::Right).within(|| TcpListener::bind(listens))??;
        let [back, far] = seen.map(|address| SocketAddr::new(address, PORT));
        let ends = Arc::new(AtomicBool::new(false));
        let answering = {
            let ends = Arc::clone(&ends);
            far_socket.set_read_timeout(Some(LOOK_EVERY))?;
            // Opens the NAT of the right site.
            far_socket.send_to(KNOCK, back)?;
            std::thread::spawn(move || answer(&far_socket, &ends))
        };
        let left = Arc::clone(lab.site(Side::Left));
        let sockets = Self { near, far, listener, dials, left, ends, answering: Some(answering) };
        let took = sockets.knock()?;
        Ok((sockets, took))
    }

    /// Sends until something comes back. Returns how long that took.
    fn knock(&self) -> Result<Duration> {
        let begun = Instant::now();
        self.near.set_read_timeout(Some(KNOCK_EVERY))?;
        let (message, mut back) = ([0x5a; 16], [0; 64]);
        while begun.elapsed() < START_MAX {
            self.near.send_to(&message, self.far)?;
            match self.near.recv_from(&mut back) {
                Ok((length, _)) if back[..length] == message => {
                    let took = begun.elapsed();
                    // Answers to the other ones.
                    self.near.set_read_timeout(Some(LOOK_EVERY))?;
                    while self.near.recv_from(&mut back).is_ok() {}
                    self.near.set_read_timeout(Some(LOST_AFTER))?;
                    return Ok(took);
                }
                Ok(_) => {}
                Err(error) if is_timeout(&error) => {}
                Err(error) => return Err(error.into()),
            }
        }
        bail!("no echo within {START_MAX:?}")
    }
}

impl Pair for Sockets {
    fn round_trips(&mut self, size: usize, plan: &Plan) -> Result<Vec<f64>> {
        let (mut message, mut back) = (vec![0x5a; size], vec![0; size]);
        let (mut begun, mut round_trips_us) = (Instant::now(), Vec::new());
        for number in 0..plan.warm_up + plan.count {
            if number == plan.warm_up {
                begun = Instant::now();
            }
            if number > plan.warm_up && begun.elapsed().as_secs_f64() > plan.seconds {
                break;
            }
            message[..8].copy_from_slice(&(number as u64).to_le_bytes());
            let sent = Instant::now();
            self.near.send_to(&message, self.far)?;
            self.near.recv_from(&mut back).context("an echo is lost")?;
            ensure!(back == message, "another message came back");
            if number >= plan.warm_up {
                round_trips_us.push(sent.elapsed().as_secs_f64() * 1e6);
            }
        }
        Ok(round_trips_us)
    }

    fn throughput(&mut self, plan: &Plan) -> Result<f64> {
        let (listener, dials) = (&self.listener, self.dials);
        let mut stream = self.left.within(|| TcpStream::connect_timeout(&dials, LOST_AFTER))??;
        std::thread::scope(|scope| {
            let receiver = scope.spawn(|| count(listener, plan.flow_warm_up_seconds));
            let (chunk, begun) = (vec![0x5a; CHUNK_BYTES], Instant::now());
            while begun.elapsed().as_secs_f64() < plan.flow_warm_up_seconds + plan.flow_seconds {
                stream.write_all(&chunk)?;
            }
            drop(stream);
            receiver.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
        })
    }
}

impl Drop for Sockets {
    fn drop(&mut self) {
        self.ends.store(true, Ordering::Relaxed);
        let _ = self.answering.take().map(JoinHandle::join);
    }
}

/// Sends back all messages.
fn answer(socket: &UdpSocket, ends: &AtomicBool) {
    let mut message = vec![0; CHUNK_BYTES];
    while !ends.load(Ordering::Relaxed) {
        if let Ok((length, from)) = socket.recv_from(&mut message) {
            // The sender notices losses.
            let _ = socket.send_to(&message[..length], from);
        }
    }
}

/// Takes one connection. Returns the bytes a second after the warm-up.
fn count(listener: &TcpListener, warm_up_seconds: f64) -> Result<f64> {
    let (mut stream, _) = listener.accept()?;
    let (begun, mut chunk) = (Instant::now(), vec![0; CHUNK_BYTES]);
    let (mut bytes, mut counts_from, mut last) = (0_u64, None::<Instant>, begun);
    loop {
        let length = stream.read(&mut chunk)?;
        if length == 0 {
            let from = counts_from.context("the transfer ended within its warm-up")?;
            return Ok(bytes as f64 / (last - from).as_secs_f64());
        }
        last = Instant::now();
        match counts_from {
            Some(_) => bytes += length as u64,
            None if (last - begun).as_secs_f64() >= warm_up_seconds => counts_from = Some(last),
            None => {}
        }
    }
}

fn is_timeout(error: &std::io::Error) -> bool {
    matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut)
}
