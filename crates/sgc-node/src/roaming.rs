//! What changes of the network are to a node: it hears of them from the kernel instead of waiting for a time-out.
//!
//! It says that something changed and what follows for a link; links are made and moved elsewhere. Messages of the kernel
//! are not read: that there was one is enough, since what counts is asked for, the address that the route to a peer begins with.

use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};
use std::os::unix::net::UnixDatagram as StdSocket;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::time::Duration;

use rustix::io::Errno;
use rustix::net::netlink::SocketAddrNetlink;
use rustix::net::{AddressFamily, SocketFlags, SocketType, bind, socket_with};
use tokio::net::UnixDatagram;
use tokio::sync::watch;
use tokio::time::{Instant, timeout_at};
use tracing::{info, warn};

/// Changes come in bursts: how long it has to be quiet before one counts as over, and how long it may take.
const QUIET: Duration = Duration::from_millis(50);
const BURST_MAX: Duration = Duration::from_millis(250);
/// Messages read before others get their turn.
const MESSAGES_MAX: usize = 64;
const MESSAGE_BYTES_MAX: usize = 8192;

/// What the kernel is asked to tell of (`RTMGRP_*` in rtnetlink(7)): links, addresses and routes of both families.
const GROUPS: u32 = 0x1 | 0x10 | 0x40 | 0x100 | 0x400;

/// The network as it changes.
#[derive(Clone, Debug)]
pub(crate) struct Network {
    changes: watch::Receiver<u64>,
    /// The change after which sockets were renewed last.
    renewed: Arc<AtomicU64>,
}

impl Network {
    /// Hears of changes for as long as the runtime lives. Where the kernel does not tell, that is said, and nothing changes.
    pub(crate) fn watch() -> Self {
        let (tell, network) = Self::channel();
        match open() {
            Ok(socket) => {
                tokio::spawn(hear(socket, tell));
            }
            Err(error) => {
                warn!(%error, "the kernel does not tell of changes of the network; links move when they fall silent");
            }
        }
        network
    }

    /// With whom to tell of changes.
    pub(crate) fn channel() -> (watch::Sender<u64>, Self) {
        let (tell, changes) = watch::channel(0);
        (tell, Self { changes, renewed: Arc::default() })
    }

    /// Waits for a change, for ever if there can be none any more. Dropping the future loses nothing.
    pub(crate) async fn changed(&mut self) {
        if self.changes.changed().await.is_err() {
            std::future::pending().await
        }
    }

    /// Another that hears of what changes from here on.
    pub(crate) fn onward(&self) -> Self {
        let mut later = self.clone();
        later.changes.mark_unchanged();
        later
    }

    /// True for the first who asks after a change: sockets are shared, so one of those who use them renews them.
    pub(crate) fn is_first(&self) -> bool {
        let change = *self.changes.borrow();
        self.renewed.fetch_max(change, Relaxed) < change
    }
}

/// What a change comes to for a link that this node dialled.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Move {
    /// It can stay as it is, or there is no way at present.
    Stay,
    /// Its socket is to be another, by which it goes on.
    Rebind,
    /// It is bound to an address that leads there no more: another link has to take over.
    Redial,
}

/// Where a link begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Origin {
    /// The source address towards the peer when there last was one.
    source: Option<IpAddr>,
    /// Whether there is a route to it now.
    is_there: bool,
}

impl Origin {
    /// That of a link to this peer, which is up.
    pub(crate) fn from_remote(remote: SocketAddr) -> Self {
        let source = source_towards(remote);
        Self { source, is_there: source.is_some() }
    }

    /// The network has changed: what the source address is now, and what follows.
    pub(crate) fn moves(&mut self, source: Option<IpAddr>, over_udp: bool) -> Move {
        let came_back = !std::mem::replace(&mut self.is_there, source.is_some());
        let before = self.source;
        self.source = source.or(before);
        match source {
            None => Move::Stay,
            Some(_) if source == before && !came_back => Move::Stay,
            Some(_) if over_udp => Move::Rebind,
            Some(_) => Move::Redial,
        }
    }
}

/// The address that packets to this one leave with; nothing is sent. `None` if no way leads there.
pub(crate) fn source_towards(remote: SocketAddr) -> Option<IpAddr> {
    let any: IpAddr =
        if remote.is_ipv4() { Ipv4Addr::UNSPECIFIED.into() } else { Ipv6Addr::UNSPECIFIED.into() };
    let socket = UdpSocket::bind((any, 0)).ok()?;
    socket.connect(remote).ok()?;
    Some(socket.local_addr().ok()?.ip())
}

/// The socket of the kernel's messages. That type reads from whatever socket keeps messages apart.
fn open() -> io::Result<UnixDatagram> {
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    let socket = socket_with(AddressFamily::NETLINK, SocketType::RAW, flags, None)?;
    bind(&socket, &SocketAddrNetlink::new(0, GROUPS))?;
    UnixDatagram::from_std(StdSocket::from(socket))
}

async fn hear(socket: UnixDatagram, tell: watch::Sender<u64>) {
    loop {
        let heard = async {
            take(&socket).await?;
            let end = Instant::now() + BURST_MAX;
            while let Ok(more) = timeout_at(end.min(Instant::now() + QUIET), take(&socket)).await {
                more?;
            }
            Ok::<_, io::Error>(())
        };
        tokio::select! {
            heard = heard => match heard {
                Ok(()) => tell.send_modify(|change| *change += 1),
                Err(error) => {
                    warn!(%error, "the kernel tells no more of changes of the network; links move when they fall silent");
                    return;
                }
            },
            () = tell.closed() => return,
        }
    }
}

/// Waits for messages and takes what is there.
async fn take(socket: &UnixDatagram) -> io::Result<()> {
    let mut message = [0; MESSAGE_BYTES_MAX];
    socket.readable().await?;
    for _ in 0..MESSAGES_MAX {
        match socket.try_recv(&mut message) {
            Ok(_) => {}
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => break,
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            // There was more than the kernel had room for, which says as much.
            Err(error) if Errno::from_io_error(&error) == Some(Errno::NOBUFS) => {}
            Err(error) => return Err(error),
        }
    }
    Ok(())
}

/// Says what a change came to.
pub(crate) fn report(remote: SocketAddr, source: Option<IpAddr>, moves: Move) {
    let source = source.map(|source| source.to_string()).unwrap_or_default();
    match moves {
        Move::Stay => {}
        Move::Rebind => info!(%remote, %source, "the network changed; the link goes on from here"),
        Move::Redial => info!(%remote, %source, "the network changed; connecting anew from here"),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    #[test]
    fn a_link_moves_when_its_source_is_another_or_came_back() {
        let (wifi, lte) = (IpAddr::from([192, 168, 0, 7]), IpAddr::from([10, 64, 1, 1]));
        for (over_udp, moved) in [(true, Move::Rebind), (false, Move::Redial)] {
            let mut origin = Origin { source: Some(wifi), is_there: true };
            let mut sees = |source| origin.moves(source, over_udp);
            // Another interface came up.
            assert_eq!(sees(Some(wifi)), Move::Stay);
            assert_eq!(sees(Some(lte)), moved);
            assert_eq!(sees(Some(lte)), Move::Stay);
            // No way at all, and then one.
            assert_eq!(sees(None), Move::Stay);
            assert_eq!(sees(None), Move::Stay);
            assert_eq!(sees(Some(lte)), moved);
            assert_eq!(sees(Some(lte)), Move::Stay);
            assert_eq!(sees(None), Move::Stay);
            assert_eq!(sees(Some(wifi)), moved);
        }
    }

    #[test]
    fn the_source_towards_a_peer_is_known_without_a_packet() {
        let there = UdpSocket::bind("127.0.0.1:0").unwrap();
        there.set_nonblocking(true).unwrap();
        assert_eq!(source_towards(there.local_addr().unwrap()), Some(Ipv4Addr::LOCALHOST.into()));
        assert_eq!(there.recv(&mut [0]).unwrap_err().kind(), io::ErrorKind::WouldBlock);
        assert_eq!(source_towards(SocketAddr::from(([255, 255, 255, 255], 1))), None);
    }

    #[tokio::test]
    async fn single_task_renews_sockets_after_each_change() {
        let (tell, mut network) = Network::channel();
        let mut other = network.clone();
        assert!(!network.is_first());
        for _ in 0..2 {
            tell.send_modify(|change| *change += 1);
            network.changed().await;
            other.changed().await;
            assert!(other.is_first() && !network.is_first() && !other.is_first());
        }
        tell.send_modify(|change| *change += 1);
        let nothing = tokio::time::timeout(Duration::ZERO, other.onward().changed()).await;
        assert!(nothing.is_err());
    }

    #[tokio::test]
    async fn the_kernel_is_asked() {
        // Whether it tells of a change is shown where networks can be made.
        assert!(open().is_ok());
    }
}
