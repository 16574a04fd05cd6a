//! The task of direct links: dials the addresses that the control task found, and passes on checks and the addresses of
//! this host.

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::sync::Arc;

use if_addrs::{IfAddr, Interface};
use sgc_session::is_checkable;
use sgc_transport::{CheckDatagram, LinkUrl, Scheme};
use tokio::sync::{mpsc, watch};
use tracing::{debug, warn};

use crate::control::event::CoreEvent;
use crate::discovery::{Board, Claims, DialTarget, KeepLink as _, LinkKeeper, LinkRequest, Outcome};
use crate::link::direct_address::{DirectDial, HostAddress};

/// Most addresses of this host that are looked at.
const HOST_ADDRESSES_MAX: usize = 16;

/// Serves the direct links until the node ends.
pub(crate) async fn serve(
    keeper: LinkKeeper,
    mut checks: mpsc::Receiver<CheckDatagram>,
    mut dials: mpsc::Receiver<DirectDial>,
) {
    let core = keeper.core.clone();
    let mut network = keeper.network.onward();
    // Their links are in the status like those that peers dialled. No user named a router for them.
    let board = Board::default();
    let _ = core.send(CoreEvent::HostAddresses(host_addresses())).await;
    loop {
        let event = tokio::select! {
            Some(check) = checks.recv() => CoreEvent::Check(check),
            Some(dial) = dials.recv() => {
                tokio::spawn(keep(keeper.clone(), board.clone(), dial));
                continue;
            }
            () = network.changed() => CoreEvent::HostAddresses(host_addresses()),
            else => return,
        };
        if core.send(event).await.is_err() {
            return;
        }
    }
}

/// Dials a peer, and keeps the link until it ends.
async fn keep(keeper: LinkKeeper, board: Board, DirectDial { peer, to }: DirectDial) {
    let (host, port) = (to.ip().to_string(), to.port());
    let url = LinkUrl { scheme: Scheme::Quic, host, port, path: None, cost_ms: None };
    let row = board.row(&url, "direct");
    let target = DialTarget { addresses: vec![to], ..DialTarget::from(url) };
    let (_fixed, target) = watch::channel(target);
    // A link to an earlier run of the peer may still be there. The router machine ends it, so it must not keep this one out.
    let keeper = LinkKeeper { claims: Claims::default(), ..keeper };
    let request = LinkRequest { nodes: Some(Arc::new([peer].into())), ..LinkRequest::default() };
    if let Outcome::Failed(why) = keeper.keep_link(target, &request, &row).await {
        debug!(peer = %peer.short(), %to, "no direct link: {why}");
        let _ = keeper.core.send(CoreEvent::NotDialled(peer)).await;
    }
}

/// Returns the addresses of this host at which others may reach it, those of IPv4 first.
fn host_addresses() -> Vec<HostAddress> {
    let found = if_addrs::get_if_addrs().unwrap_or_else(|error| {
        warn!(%error, "the addresses of this host cannot be read; direct links to it are found by its routers alone");
        Vec::new()
    });
    let address = |interface: &Interface| HostAddress {
        ip: interface.ip(),
        prefix: match &interface.addr {
            IfAddr::V4(v4) => v4.prefixlen,
            IfAddr::V6(v6) => v6.prefixlen,
        },
    };
    let usable = found.iter().map(address).filter(|host| is_checkable(&SocketAddr::new(host.ip, 1)));
    usable.collect::<BTreeSet<_>>().into_iter().take(HOST_ADDRESSES_MAX).collect()
}
