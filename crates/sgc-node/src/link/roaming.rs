//! Changes of the network: a node learns of them from the kernel instead of waiting for a time-out.
//!
//! This module reports changes; [`sgc_session::LinkSupervisor`] decides what they mean for a link. It does not parse
//! the kernel's messages. Their arrival is enough, because only the source address of the route to a peer matters, and
//! that is queried.

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
use tracing::warn;

/// Quiet time after which a burst of changes counts as over, and the longest wait for that.
const QUIET: Duration = Duration::from_millis(50);
const BURST_MAX: Duration = Duration::from_millis(250);
/// Messages read before other tasks get their turn.
const MESSAGES_MAX: usize = 64;
const MESSAGE_BYTES_MAX: usize = 8192;

/// Groups of kernel messages (`RTMGRP_*` in rtnetlink(7)): links, addresses and routes of both families.
const GROUPS: u32 = 0x1 | 0x10 | 0x40 | 0x100 | 0x400;

/// Receiver of network changes.
#[derive(Clone, Debug)]
pub(crate) struct Network {
    changes: watch::Receiver<u64>,
    /// Change after which the sockets were last renewed.
    renewed: Arc<AtomicU64>,
}

impl Network {
    /// Watches the network for as long as the runtime lives. If the kernel does not report changes, that is logged, and
    /// none occur.
    pub(crate) fn watch() -> Self {
        let (tell, network) = Self::channel();
        match open() {
            Ok(socket) => {
                tokio::spawn(hear(socket, tell));
            }
            Err(error) => {
                warn!(%error, "the kernel does not report changes of the network; links move when they fall silent");
            }
        }
        network
    }

    /// Creates a sender of changes and a receiver.
    pub(crate) fn channel() -> (watch::Sender<u64>, Self) {
        let (tell, changes) = watch::channel(0);
        (tell, Self { changes, renewed: Arc::default() })
    }

    /// Waits for a change, for ever if none can come any more. Dropping the future loses no change.
    pub(crate) async fn changed(&mut self) {
        if self.changes.changed().await.is_err() {
            std::future::pending().await
        }
    }

    /// Returns a receiver of the changes from here on.
    pub(crate) fn onward(&self) -> Self {
        let mut later = self.clone();
        later.changes.mark_unchanged();
        later
    }

    /// Returns `true` for the first caller after a change. Sockets are shared, so only one user renews them.
    pub(crate) fn is_first(&self) -> bool {
        let change = *self.changes.borrow();
        self.renewed.fetch_max(change, Relaxed) < change
    }
}

/// Returns the source address of packets to this peer without sending any; `None` if no route exists.
pub(crate) fn source_towards(remote: SocketAddr) -> Option<IpAddr> {
    let any: IpAddr =
        if remote.is_ipv4() { Ipv4Addr::UNSPECIFIED.into() } else { Ipv6Addr::UNSPECIFIED.into() };
    let socket = UdpSocket::bind((any, 0)).ok()?;
    socket.connect(remote).ok()?;
    Some(socket.local_addr().ok()?.ip())
}

/// Opens the socket of kernel messages. `UnixDatagram` reads from any socket that keeps message boundaries.
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
                    warn!(%error, "the kernel no longer reports changes of the network; links move when they fall silent");
                    return;
                }
            },
            () = tell.closed() => return,
        }
    }
}

/// Waits for messages and discards them.
async fn take(socket: &UnixDatagram) -> io::Result<()> {
    let mut message = [0; MESSAGE_BYTES_MAX];
    socket.readable().await?;
    for _ in 0..MESSAGES_MAX {
        match socket.try_recv(&mut message) {
            Ok(_) => {}
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => break,
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            // The kernel's buffer overflowed, which is a change as well.
            Err(error) if Errno::from_io_error(&error) == Some(Errno::NOBUFS) => {}
            Err(error) => return Err(error),
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

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
        // Tests in network namespaces show that changes are reported.
        assert!(open().is_ok());
    }
}
