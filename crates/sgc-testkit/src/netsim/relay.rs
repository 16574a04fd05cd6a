//! A bad path between two addresses that needs no root: for datagrams, or for the bytes of TCP connections.
//!
//! [`UdpRelay`] is also a NAT: its clients appear at a port that [`UdpRelay::rebind`] changes. [`TcpRelay`] ends
//! TCP on both of its sides, so it has rate, delay and a queue that pushes back, but neither loss nor reordering, and
//! connecting takes no time; what TCP itself does on a bad path shows on a [`super::TunLink`] only.

use std::collections::VecDeque;
use std::io::{self, Read, Write};
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, Shutdown, SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::os::fd::AsFd;
use std::time::Duration;

use bytes::Bytes;
use rustix::event::{PollFd, PollFlags};

use super::channel::{Channel, Counters, Loss, Profile, Reorder};
use super::namespace::NetsimError;
use super::pump::{BATCH_MAX, Direction, Ports, Pump, controls};

/// Most peers that a relay serves at once. Further peers get no answer.
const PEERS_MAX: usize = 256;
const DATAGRAM_BYTES_MAX: usize = 65_535;
/// Bytes of a connection that pass a channel as one packet: an Ethernet segment.
const PIECE_BYTES: usize = 1448;
/// Most bytes of a connection that wait for a slow receiver.
const UNREAD_BYTES_MAX: usize = 1 << 20;
const CONNECT_TIMEOUT: Duration = Duration::from_secs(2);

/// A relay that sends datagrams to `local` on to another address, and answers back.
pub struct UdpRelay {
    pump: Pump<Datagram>,
    local: SocketAddr,
}

controls!(UdpRelay);

impl UdpRelay {
    /// Starts the relay. Port 0 lets the system choose.
    pub fn start(
        listen: SocketAddr,
        to: SocketAddr,
        profiles: [Profile; 2],
        seed: u64,
    ) -> Result<Self, NetsimError> {
        let failed = |error| NetsimError::Socket(format!("listening at udp {listen}"), error);
        let outer = UdpSocket::bind(listen).map_err(failed)?;
        outer.set_nonblocking(true).map_err(failed)?;
        let local = outer.local_addr().map_err(failed)?;
        let ports = Datagrams { outer, to, peers: Vec::new(), buffer: vec![0; DATAGRAM_BYTES_MAX] };
        Ok(Self { pump: Pump::start(ports, profiles, seed).map_err(NetsimError::Thread)?, local })
    }

    /// Returns the address on which it listens.
    pub fn local(&self) -> SocketAddr {
        self.local
    }

    /// Moves its clients to other ports and closes the old ones, like a NAT that loses its state.
    pub fn rebind(&self) {
        self.pump.rebind();
    }
}

/// The number of the peer, and the content.
type Datagram = (usize, Bytes);

struct Datagrams {
    outer: UdpSocket,
    to: SocketAddr,
    /// The clients, each with its socket on the far side.
    peers: Vec<(SocketAddr, UdpSocket)>,
    buffer: Vec<u8>,
}

impl Datagrams {
    fn peer(&mut self, from: SocketAddr) -> Option<usize> {
        let known = self.peers.iter().position(|(peer, _)| *peer == from);
        known.or_else(|| {
            let socket = (self.peers.len() < PEERS_MAX).then(|| far_socket(self.to).ok())??;
            self.peers.push((from, socket));
            Some(self.peers.len() - 1)
        })
    }
}

fn far_socket(to: SocketAddr) -> io::Result<UdpSocket> {
    let any: IpAddr = if to.is_ipv4() { Ipv4Addr::UNSPECIFIED.into() } else { Ipv6Addr::UNSPECIFIED.into() };
    let socket = UdpSocket::bind((any, 0))?;
    socket.connect(to)?;
    socket.set_nonblocking(true)?;
    Ok(socket)
}

impl Ports for Datagrams {
    type Packet = Datagram;

    fn receive(&mut self, channels: &mut [Channel<Datagram>; 2], now: Duration) {
        let [forth, back] = channels;
        for _ in 0..BATCH_MAX {
            let Ok((bytes, from)) = self.outer.recv_from(&mut self.buffer) else { break };
            let Some(peer) = self.peer(from) else { continue };
            forth.push(now, bytes, (peer, Bytes::copy_from_slice(&self.buffer[..bytes])));
        }
        for (peer, (_, socket)) in self.peers.iter().enumerate() {
            for _ in 0..BATCH_MAX {
                match socket.recv(&mut self.buffer) {
                    Ok(bytes) => {
                        back.push(now, bytes, (peer, Bytes::copy_from_slice(&self.buffer[..bytes])));
                    }
                    // Nothing listens there, which the system reports once per datagram.
                    Err(error) if error.kind() == io::ErrorKind::ConnectionRefused => {}
                    Err(_) => break,
                }
            }
        }
    }

    fn deliver(&mut self, direction: Direction, (peer, datagram): Datagram) {
        let (from, socket) = &self.peers[peer];
        // A datagram that cannot be sent is lost.
        let _ = match direction {
            Direction::Forth => socket.send(&datagram),
            Direction::Back => self.outer.send_to(&datagram, from),
        };
    }

    fn watch(&self) -> Vec<PollFd<'_>> {
        let sockets = self.peers.iter().map(|(_, socket)| socket).chain([&self.outer]);
        sockets.map(|socket| PollFd::from_borrowed_fd(socket.as_fd(), PollFlags::IN)).collect()
    }

    fn rebind(&mut self) {
        for (_, socket) in &mut self.peers {
            // The new socket is bound before the old one is closed, so that its port differs.
            if let Ok(other) = far_socket(self.to) {
                *socket = other;
            }
        }
    }
}

/// A relay that passes connections to `local` on to another address.
pub struct TcpRelay {
    pump: Pump<Piece>,
    local: SocketAddr,
}

impl TcpRelay {
    /// Starts the relay. Port 0 lets the system choose. Ignores loss, reordering and duplication of the profiles.
    pub fn start(
        listen: SocketAddr,
        to: SocketAddr,
        profiles: [Profile; 2],
        seed: u64,
    ) -> Result<Self, NetsimError> {
        let failed = |error| NetsimError::Socket(format!("listening at tcp {listen}"), error);
        let listener = TcpListener::bind(listen).map_err(failed)?;
        listener.set_nonblocking(true).map_err(failed)?;
        let local = listener.local_addr().map_err(failed)?;
        let ports = Streams { listener, to, streams: Vec::new(), next: 0, buffer: vec![0; PIECE_BYTES] };
        let pump = Pump::start(ports, profiles.map(lossless), seed).map_err(NetsimError::Thread)?;
        Ok(Self { pump, local })
    }

    /// Returns the address on which it listens.
    pub fn local(&self) -> SocketAddr {
        self.local
    }

    /// Changes a direction while the relay runs, without loss, reordering and duplication.
    pub fn set(&self, direction: Direction, profile: Profile) {
        self.pump.set(direction, lossless(profile));
    }

    /// Returns the counters of a direction, whose packets are pieces of connections.
    pub fn counters(&self, direction: Direction) -> Counters {
        self.pump.counters(direction)
    }
}

/// Removes loss, reordering and duplication, which a stream cannot have.
fn lossless(profile: Profile) -> Profile {
    Profile { loss: Loss::None, reorder: Reorder::default(), duplicate: 0.0, ..profile }
}

/// Bytes of a connection. An empty piece is its end in this direction.
type Piece = (u64, Bytes);

struct Streams {
    listener: TcpListener,
    to: SocketAddr,
    streams: Vec<Pair>,
    next: u64,
    buffer: Vec<u8>,
}

struct Pair {
    number: u64,
    /// Both sides, by the direction read from each: the connecting side first.
    sides: [Side; 2],
    /// Number of its pieces in the channels.
    flying: usize,
    is_dead: bool,
}

impl Pair {
    fn is_over(&self) -> bool {
        let has_all = |side: &Side| side.has_ended && side.unread.is_empty();
        self.is_dead || (self.flying == 0 && self.sides.iter().all(has_all))
    }
}

struct Side {
    stream: TcpStream,
    /// Bytes that are still to be written to it.
    unread: VecDeque<Bytes>,
    unread_bytes: usize,
    /// It has sent its end.
    has_ended: bool,
    /// Nothing is read from it: the channel or the other side is full.
    is_held: bool,
}

impl Side {
    fn new(stream: TcpStream) -> io::Result<Self> {
        stream.set_nonblocking(true)?;
        stream.set_nodelay(true)?;
        Ok(Self { stream, unread: VecDeque::new(), unread_bytes: 0, has_ended: false, is_held: false })
    }

    /// Writes what it takes now.
    fn flush(&mut self) -> io::Result<()> {
        while let Some(front) = self.unread.front_mut() {
            if front.is_empty() {
                self.stream.shutdown(Shutdown::Write)?;
                self.unread.pop_front();
                continue;
            }
            match self.stream.write(front) {
                Ok(written) => {
                    let _ = front.split_to(written);
                    self.unread_bytes -= written;
                    if front.is_empty() {
                        self.unread.pop_front();
                    }
                }
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => break,
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }
}

impl Streams {
    fn accept(&mut self) {
        while let Ok((stream, _)) = self.listener.accept() {
            if self.streams.len() >= PEERS_MAX {
                continue;
            }
            let pair = || {
                let far = TcpStream::connect_timeout(&self.to, CONNECT_TIMEOUT)?;
                Ok::<_, io::Error>([Side::new(stream)?, Side::new(far)?])
            };
            // Nobody there: whoever came finds the connection closed.
            let Ok(sides) = pair() else { continue };
            self.streams.push(Pair { number: self.next, sides, flying: 0, is_dead: false });
            self.next += 1;
        }
    }
}

impl Ports for Streams {
    type Packet = Piece;

    fn receive(&mut self, channels: &mut [Channel<Piece>; 2], now: Duration) {
        self.accept();
        for pair in &mut self.streams {
            for direction in Direction::BOTH {
                let channel = &mut channels[direction as usize];
                let (from, to) = (direction as usize, 1 - direction as usize);
                let is_full = pair.sides[to].unread_bytes >= UNREAD_BYTES_MAX;
                let side = &mut pair.sides[from];
                for _ in 0..BATCH_MAX {
                    side.is_held = is_full || !channel.has_room(PIECE_BYTES);
                    if side.is_held || side.has_ended {
                        break;
                    }
                    match side.stream.read(&mut self.buffer) {
                        Ok(bytes) => {
                            side.has_ended = bytes == 0;
                            let piece = Bytes::copy_from_slice(&self.buffer[..bytes]);
                            pair.flying += usize::from(channel.push(now, bytes, (pair.number, piece)));
                        }
                        Err(error) if error.kind() == io::ErrorKind::WouldBlock => break,
                        Err(_) => {
                            pair.is_dead = true;
                            break;
                        }
                    }
                }
            }
            pair.is_dead |= pair.sides.iter_mut().any(|side| side.flush().is_err());
        }
        self.streams.retain(|pair| !pair.is_over());
    }

    fn deliver(&mut self, direction: Direction, (number, piece): Piece) {
        let Ok(at) = self.streams.binary_search_by_key(&number, |pair| pair.number) else { return };
        let pair = &mut self.streams[at];
        pair.flying -= 1;
        let side = &mut pair.sides[1 - direction as usize];
        side.unread_bytes += piece.len();
        side.unread.push_back(piece);
        pair.is_dead |= side.flush().is_err();
    }

    fn watch(&self) -> Vec<PollFd<'_>> {
        let listener = PollFd::from_borrowed_fd(self.listener.as_fd(), PollFlags::IN);
        let sides = self.streams.iter().flat_map(|pair| &pair.sides);
        let streams = sides.filter_map(|side| {
            let mut flags = PollFlags::empty();
            flags.set(PollFlags::IN, !side.has_ended && !side.is_held);
            flags.set(PollFlags::OUT, !side.unread.is_empty());
            // One that has hung up would wake us without end.
            (!flags.is_empty()).then(|| PollFd::from_borrowed_fd(side.stream.as_fd(), flags))
        });
        streams.chain([listener]).collect()
    }
}
