//! A UDP relay between a dialer and a listener: a NAT that forgets, and a network that loses, reorders and alters.
#![allow(dead_code, unreachable_pub, reason = "shared by test programs")]

use std::net::SocketAddr;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex};

use rand_chacha::ChaCha20Rng;
use rand_core::{RngCore as _, SeedableRng as _};
use tokio::net::UdpSocket;
use tokio::sync::Notify;
use tokio::task::JoinSet;

/// Number of datagrams by which a reordered one is late.
const REORDER_DEPTH: usize = 4;

/// The relay's treatment of datagrams from now on; permille.
#[derive(Default)]
pub struct Impairment {
    pub loss: AtomicU32,
    pub reorder: AtomicU32,
    /// Longest datagram that gets through, if not 0.
    pub longest: AtomicU32,
    /// Alters one byte of the next long datagram towards the dialer.
    pub flip: AtomicBool,
    /// Keeps the passing datagrams.
    pub tap: AtomicBool,
    pub seen: Mutex<Vec<Vec<u8>>>,
    pub forwarded: AtomicU64,
    pub flipped: AtomicU64,
}

pub struct Relay {
    pub addr: SocketAddr,
    pub impairment: Arc<Impairment>,
    new_port: Arc<Notify>,
    _tasks: JoinSet<()>,
}

impl Relay {
    /// Starts a relay for one dialer.
    pub async fn start(listener: SocketAddr, seed: u64) -> Self {
        let front = Arc::new(bind().await);
        let addr = front.local_addr().unwrap();
        let impairment = Arc::new(Impairment::default());
        let new_port = Arc::new(Notify::new());
        let mut tasks = JoinSet::new();
        tasks.spawn(run(front, listener, seed, Arc::clone(&impairment), Arc::clone(&new_port)));
        Self { addr, impairment, new_port, _tasks: tasks }
    }

    /// The listener sees another port from now on, and its datagrams to the old one are lost.
    pub fn change_port(&self) {
        self.new_port.notify_one();
    }
}

async fn bind() -> UdpSocket {
    let socket = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    let _ = socket2::SockRef::from(&socket).set_recv_buffer_size(4 << 20);
    let _ = socket2::SockRef::from(&socket).set_send_buffer_size(4 << 20);
    socket
}

async fn run(
    front: Arc<UdpSocket>,
    listener: SocketAddr,
    seed: u64,
    impairment: Arc<Impairment>,
    new_port: Arc<Notify>,
) {
    let mut back = bind().await;
    let mut dialer = None;
    let mut ways = [seed, !seed].map(Direction::new);
    let (mut up, mut down) = (vec![0; 65_536], vec![0; 65_536]);
    loop {
        tokio::select! {
            () = new_port.notified() => back = bind().await,
            Ok((len, from)) = front.recv_from(&mut up) => {
                dialer = Some(from);
                for datagram in ways[0].pass(&up[..len], &impairment, false) {
                    let _ = back.send_to(&datagram, listener).await;
                }
            }
            Ok((len, from)) = back.recv_from(&mut down) => {
                if let (Some(dialer), true) = (dialer, from == listener) {
                    for datagram in ways[1].pass(&down[..len], &impairment, true) {
                        let _ = front.send_to(&datagram, dialer).await;
                    }
                }
            }
        }
    }
}

/// One direction.
struct Direction {
    rng: ChaCha20Rng,
    held: Vec<(usize, Vec<u8>)>,
}

impl Direction {
    fn new(seed: u64) -> Self {
        Self { rng: ChaCha20Rng::seed_from_u64(seed), held: Vec::new() }
    }

    fn pass(&mut self, datagram: &[u8], impairment: &Impairment, may_flip: bool) -> Vec<Vec<u8>> {
        if impairment.tap.load(Relaxed) {
            impairment.seen.lock().unwrap().push(datagram.to_vec());
        }
        let mut out = Vec::new();
        self.held.retain_mut(|(wait, held)| {
            *wait -= 1;
            if *wait == 0 {
                out.push(std::mem::take(held));
            }
            *wait > 0
        });
        let longest = impairment.longest.load(Relaxed) as usize;
        if longest > 0 && datagram.len() > longest {
            return out;
        }
        if self.rng.next_u32() % 1000 < impairment.loss.load(Relaxed) {
            return out;
        }
        let mut datagram = datagram.to_vec();
        if may_flip && datagram.len() > 600 && impairment.flip.swap(false, Relaxed) {
            let at = datagram.len() - 100;
            datagram[at] ^= 1;
            impairment.flipped.fetch_add(1, Relaxed);
        }
        if self.rng.next_u32() % 1000 < impairment.reorder.load(Relaxed) {
            self.held.push((REORDER_DEPTH, datagram));
        } else {
            out.insert(0, datagram);
        }
        impairment.forwarded.fetch_add(out.len() as u64, Relaxed);
        out
    }
}
