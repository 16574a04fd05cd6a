//! [`DirectLinks`]: the direct links of this node, and what is needed to find them.
//!
//! [`DirectPaths`] and [`DirectLinkTable`] decide. This part has the sockets, and the addresses of this host.

use std::collections::BTreeSet;
use std::net::{IpAddr, SocketAddr};
use std::num::NonZeroU16;
use std::time::Instant;

use rand_chacha::ChaCha20Rng;
use sgc_router::{DirectReach, LinkId, Router};
use sgc_session::{DirectLinkTable, DirectOutput, DirectPaths, LocalAddress};
use sgc_transport::{CheckDatagram, DirectHandle};
use sgc_trust::{Grantees, VerifiedPeer};
use sgc_wire::{NodeId, PathOffer, RefuseReason};
use tokio::sync::{mpsc, watch};
use tracing::debug;

use crate::admin::not_direct::NotDirectReason;
use crate::drops::NodeDrop;
use crate::link::direct_address::{DirectDial, HostAddress};
use crate::link::mapping_report::{MappingOff, MappingReport, MappingWish};
use crate::link::roaming::source_towards;

/// The sockets of direct links, and the task that dials.
pub(crate) struct DirectEnds {
    pub(crate) handle: DirectHandle,
    pub(crate) dials: mpsc::Sender<DirectDial>,
    /// Whether a port is to be mapped. The mapping ends with the sender.
    pub(crate) mapping: watch::Sender<MappingWish>,
}

/// The direct links of this node.
pub(crate) struct DirectLinks {
    /// `None` at a node that only routes.
    ends: Option<DirectEnds>,
    paths: DirectPaths,
    permitted: Grantees,
    links: DirectLinkTable<LinkId>,
    host: Vec<HostAddress>,
    reflexive: BTreeSet<SocketAddr>,
    /// The last IPv4 addresses that routers saw. They stay while no router is linked.
    seen_v4: BTreeSet<SocketAddr>,
    /// The configuration permits a port mapping.
    maps_port: bool,
    mapping: MappingReport,
}

impl DirectLinks {
    pub(crate) fn new(own: NodeId, ends: Option<DirectEnds>, permitted: Grantees, rng: ChaCha20Rng) -> Self {
        Self {
            ends,
            paths: DirectPaths::new(own, rng),
            permitted,
            links: DirectLinkTable::default(),
            host: Vec::new(),
            reflexive: BTreeSet::new(),
            seen_v4: BTreeSet::new(),
            maps_port: false,
            mapping: MappingReport::off(MappingOff::NoDirectLinks),
        }
    }

    /// Returns `true` if this node has direct links with somebody.
    pub(crate) fn is_offered(&self) -> bool {
        self.ends.is_some() && !self.permitted.is_empty()
    }

    /// Sets the peers that may have direct links. Returns the links that are to be closed.
    pub(crate) fn set_permitted(
        &mut self,
        permitted: Grantees,
        peer_of: impl Fn(LinkId) -> Option<VerifiedPeer>,
    ) -> Vec<LinkId> {
        self.permitted = permitted;
        self.wish_mapping();
        let is_gone = |link: &LinkId| peer_of(*link).is_some_and(|peer| self.permitted.find(&peer).is_none());
        self.links.iter().filter(is_gone).collect()
    }

    /// Sets whether the configuration permits a port mapping.
    pub(crate) fn set_port_mapping(&mut self, maps_port: bool) {
        self.maps_port = maps_port;
        self.wish_mapping();
    }

    /// Sets the state of the port mapping.
    pub(crate) fn set_mapping(&mut self, now: Instant, report: MappingReport) {
        let external = |report: &MappingReport| report.mapping.map(|(mapping, _)| mapping.external);
        let is_same = external(&self.mapping) == external(&report);
        self.mapping = report;
        if !is_same {
            self.addresses_changed(now);
        }
    }

    /// Returns the state of the port mapping.
    pub(crate) fn mapping(&self) -> &MappingReport {
        &self.mapping
    }

    /// Tells the task of port mappings whether one is wanted.
    fn wish_mapping(&self) {
        let Some(ends) = &self.ends else { return };
        let wish = if !self.is_offered() {
            MappingWish::Off(MappingOff::NoDirectLinks)
        } else if !self.maps_port {
            MappingWish::Off(MappingOff::Configured)
        } else {
            let port = ends.handle.ports().0.and_then(NonZeroU16::new);
            mapping_wish(port, &self.host, &self.seen_v4)
        };
        ends.mapping.send_if_modified(|known| {
            let is_new = *known != wish;
            *known = wish;
            is_new
        });
    }

    /// Returns `true` if a peer may have a direct link.
    pub(crate) fn may_meet(&self, peer: &VerifiedPeer) -> bool {
        self.is_offered() && self.permitted.find(peer).is_some()
    }

    /// Sets the addresses of this host.
    pub(crate) fn set_host(&mut self, now: Instant, host: Vec<HostAddress>) {
        self.host = host;
        self.addresses_changed(now);
    }

    /// Sets the addresses from which routers see this node come. Without routers, those known last stay: a NAT keeps the
    /// mapping as long as the socket is used.
    pub(crate) fn set_reflexive(&mut self, now: Instant, reflexive: impl Iterator<Item = SocketAddr>) {
        let reflexive: BTreeSet<_> = reflexive.collect();
        if self.reflexive != reflexive && !reflexive.is_empty() {
            self.reflexive = reflexive;
            let seen_v4: BTreeSet<_> = self.reflexive.iter().filter(|seen| seen.is_ipv4()).copied().collect();
            if !seen_v4.is_empty() {
                self.seen_v4 = seen_v4;
            }
            self.addresses_changed(now);
        }
    }

    fn addresses_changed(&mut self, now: Instant) {
        let Some(ends) = &self.ends else { return };
        let mapped = self
            .mapping
            .mapping
            .map(|(mapping, _)| (SocketAddr::V4(mapping.external), IpAddr::V4(mapping.target.host)));
        let local = local_addresses(&self.host, mapped, &self.reflexive, ends.handle.ports());
        self.wish_mapping();
        debug!(?local, "addresses for direct links");
        self.paths.set_local(now, local);
    }

    /// Sets the peers with which data is exchanged.
    pub(crate) fn want<'a>(&mut self, now: Instant, owners: impl Iterator<Item = &'a VerifiedPeer>) {
        let wanted = owners.filter(|peer| self.may_meet(peer)).map(|peer| peer.node_id).collect();
        self.paths.want(now, &wanted);
    }

    /// Answers the question of a peer.
    pub(crate) fn answer(
        &mut self,
        now: Instant,
        peer: &VerifiedPeer,
        question: &[u8],
    ) -> Result<PathOffer, RefuseReason> {
        self.paths.answer(now, peer.node_id, self.may_meet(peer), question)
    }

    pub(crate) fn offered(&mut self, now: Instant, peer: NodeId, offer: &PathOffer) {
        self.paths.offered(now, peer, offer);
    }

    pub(crate) fn refused(&mut self, now: Instant, peer: NodeId, is_for_good: bool) {
        self.paths.refused(now, peer, is_for_good);
    }

    pub(crate) fn not_dialled(&mut self, now: Instant, peer: NodeId) {
        self.paths.not_dialled(now, peer);
    }

    /// Takes a datagram that looks like a check.
    pub(crate) fn received(&mut self, now: Instant, check: &CheckDatagram) {
        let ip = check.to.or_else(|| source_towards(check.from));
        let to = ip.map(|ip| SocketAddr::new(ip, check.port));
        if let Some(to) = to {
            self.paths.received(now, to, check.from, &check.datagram);
        }
    }

    /// Notes a link that is up. Returns where it leads if it is a direct one.
    pub(crate) fn link_up(
        &mut self,
        now: Instant,
        link: LinkId,
        peer: NodeId,
        remote: SocketAddr,
    ) -> Option<DirectReach> {
        self.links.link_up(now, &mut self.paths, link, peer, remote);
        self.reach(link, remote)
    }

    /// Returns where a link to a remote address leads if it is a direct one.
    pub(crate) fn reach(&self, link: LinkId, remote: SocketAddr) -> Option<DirectReach> {
        let is_near = self.host.iter().any(|host| host.is_near(remote.ip()));
        let reach = if is_near { DirectReach::Near } else { DirectReach::Far };
        self.is_direct(link).then_some(reach)
    }

    /// Notes that a link ended.
    pub(crate) fn link_down(&mut self, now: Instant, link: LinkId) {
        self.links.link_down(now, &mut self.paths, link);
    }

    /// Notes whether nothing arrives over a link.
    pub(crate) fn link_looked_at(&mut self, now: Instant, link: LinkId, is_silent: bool) {
        self.links.link_looked_at(now, &mut self.paths, link, is_silent);
    }

    /// Returns `true` for a direct link.
    pub(crate) fn is_direct(&self, link: LinkId) -> bool {
        self.links.is_direct(link)
    }

    /// Returns the direct links that nothing has used for a while.
    pub(crate) fn unused(&mut self, now: Instant, router: &Router) -> Vec<LinkId> {
        let (is_superseded, is_used) = (|link| router.is_superseded(link), |link| router.is_used(link));
        self.links.unused(now, &self.paths, is_superseded, is_used)
    }

    /// Iterates over the direct links to a peer.
    pub(crate) fn links_to(&self, peer: &NodeId) -> impl Iterator<Item = LinkId> {
        self.links.links_to(peer)
    }

    /// Returns why there is no direct link to a peer. `owner` is the peer if this node uses something of it.
    pub(crate) fn why_not(&self, peer: &NodeId, owner: Option<&VerifiedPeer>) -> NotDirectReason {
        if self.ends.is_none() {
            return NotDirectReason::OnlyRoutes;
        }
        if self.permitted.is_empty() {
            return NotDirectReason::Never;
        }
        match (owner, self.paths.why_not(peer)) {
            (Some(owner), _) if !self.may_meet(owner) => NotDirectReason::NotPermitted,
            (_, Some(why)) => why.into(),
            // It is looked at twice a second.
            (Some(_), None) => NotDirectReason::First,
            (None, None) => NotDirectReason::NotWanted,
        }
    }

    /// Iterates over the numbers of checks that were not sent, of refused candidates, and of checks and datagrams for
    /// which there was no room.
    pub(crate) fn refusals(&self) -> impl Iterator<Item = (NodeDrop, u64)> {
        let (withheld, candidates) = self.paths.refusals();
        let handle = self.ends.as_ref().map(|ends| &ends.handle);
        [
            (NodeDrop::CheckWithheld, withheld),
            (NodeDrop::CandidateRefused, candidates),
            (NodeDrop::CheckOverflowed, handle.map_or(0, DirectHandle::overflowed)),
            (NodeDrop::DtlsOverflowed, handle.map_or(0, DirectHandle::dtls_overflowed)),
        ]
        .into_iter()
    }

    pub(crate) fn handle_timeout(&mut self, now: Instant) {
        if self.paths.deadline().is_some_and(|at| at <= now) {
            self.paths.handle_timeout(now);
        }
    }

    pub(crate) fn deadline(&mut self) -> Option<Instant> {
        self.paths.deadline()
    }

    /// Carries out the outputs that concern sockets. Returns the next question, or the end of one.
    pub(crate) fn poll(&mut self) -> Option<DirectOutput> {
        let ends = self.ends.as_ref()?;
        loop {
            let output = self.paths.poll()?;
            ends.handle.take_checks(self.paths.has_attempts());
            match output {
                // Another source than the system's has another mapping than the link would have.
                DirectOutput::Send { from, to, datagram } => {
                    if source_towards(to) == Some(from.ip()) {
                        ends.handle.send(to, &datagram);
                    }
                }
                DirectOutput::Admit { peer, from } => ends.handle.expect(from, peer),
                DirectOutput::Shut { peer } => ends.handle.shut(&peer),
                // A dial for which there is no room is one that failed: the attempt ends by its time.
                DirectOutput::Dial { peer, to } => {
                    let _ = ends.dials.try_send(DirectDial { peer, to });
                }
                output => return Some(output),
            }
        }
    }
}

/// Wants a mapping of the port if a router sees another address than those of this host.
fn mapping_wish(port: Option<NonZeroU16>, host: &[HostAddress], seen: &BTreeSet<SocketAddr>) -> MappingWish {
    let is_own = |seen: &SocketAddr| host.iter().any(|host| host.ip == seen.ip());
    match port {
        Some(port) if !seen.iter().all(is_own) => MappingWish::For { port, seen: seen.clone() },
        _ => MappingWish::Off(MappingOff::NoNat),
    }
}

/// Returns the addresses that peers are told. `ports` are those of the sockets for IPv4 and IPv6.
fn local_addresses(
    host: &[HostAddress],
    mapped: Option<(SocketAddr, IpAddr)>,
    reflexive: &BTreeSet<SocketAddr>,
    ports: (Option<u16>, Option<u16>),
) -> Vec<LocalAddress> {
    let socket = |host: &HostAddress| {
        let port = if host.ip.is_ipv4() { ports.0 } else { ports.1 };
        Some(SocketAddr::new(host.ip, port?))
    };
    let hosts: Vec<_> = host.iter().filter_map(socket).collect();
    sgc_session::local_addresses(&hosts, mapped, reflexive)
}

#[cfg(test)]
mod tests {
    use sgc_session::REFLEXIVE_MAX;

    use super::*;

    #[test]
    fn peers_are_told_what_routers_see_and_the_addresses_of_interfaces() {
        let host = ["10.0.0.7", "192.0.2.7", "2001:db8::7"];
        let host = host.map(|ip| HostAddress { ip: ip.parse().unwrap(), prefix: 24 }).to_vec();
        let addresses = |texts: &[&str]| texts.iter().map(|text| text.parse().unwrap()).collect();
        let told = |reflexive: &[&str], ports| {
            let local = local_addresses(&host, None, &addresses(reflexive), ports);
            local.iter().map(|local| (local.address.to_string(), local.base.to_string())).collect::<Vec<_>>()
        };
        let pair = |address: &str, base: &str| (address.to_owned(), base.to_owned());
        let hosts = [
            pair("10.0.0.7:5000", "10.0.0.7:5000"),
            pair("192.0.2.7:5000", "192.0.2.7:5000"),
            pair("[2001:db8::7]:6000", "[2001:db8::7]:6000"),
        ];
        let both = (Some(5000), Some(6000));
        assert_eq!(told(&[], both), hosts);
        // A router on the same network sees the address of the interface.
        assert_eq!(told(&["192.0.2.7:5000"], both), hosts);
        let told_with_nat = told(&["203.0.113.9:40000", "192.0.2.7:5000"], both);
        assert_eq!(told_with_nat[0], pair("203.0.113.9:40000", "10.0.0.7:5000"));
        assert_eq!(told_with_nat[1..], hosts);
        let many = told(&["203.0.113.9:1", "203.0.113.9:2", "203.0.113.9:3", "203.0.113.9:4"], both);
        assert_eq!(many.len(), REFLEXIVE_MAX + hosts.len());
        assert_eq!(
            told(&["203.0.113.9:1"], (None, Some(6000))),
            [pair("[2001:db8::7]:6000", "[2001:db8::7]:6000")]
        );
    }

    #[test]
    fn port_is_mapped_only_if_a_router_sees_a_nat() {
        let host = [HostAddress { ip: "10.0.0.7".parse().unwrap(), prefix: 24 }];
        let wish = |seen: &[&str], port| {
            mapping_wish(
                NonZeroU16::new(port),
                &host,
                &seen.iter().map(|text| text.parse().unwrap()).collect(),
            )
        };
        let off = MappingWish::Off(MappingOff::NoNat);
        assert_eq!(wish(&[], 5000), off);
        assert_eq!(wish(&["10.0.0.7:5000"], 5000), off);
        assert_eq!(wish(&["203.0.113.9:1"], 0), off);
        // A router on the same network and one beyond the NAT.
        assert!(matches!(wish(&["10.0.0.7:5000", "203.0.113.9:1"], 5000), MappingWish::For { .. }));
        assert_ne!(
            wish(&["203.0.113.9:1"], 5000),
            wish(&["203.0.113.9:2"], 5000),
            "the gateway is asked again"
        );
    }

    #[test]
    fn mapped_address_comes_first_and_pushes_none_out() {
        let host = ["10.0.0.7", "192.0.2.7"];
        let host = host.map(|ip| HostAddress { ip: ip.parse().unwrap(), prefix: 24 });
        let told = |mapped: (&str, &str), reflexive: &[&str]| {
            let mapped = (mapped.0.parse().unwrap(), mapped.1.parse().unwrap());
            let reflexive = reflexive.iter().map(|text| text.parse().unwrap()).collect();
            let local = local_addresses(&host, Some(mapped), &reflexive, (Some(5000), None));
            local.iter().map(|local| (local.address.to_string(), local.base.to_string())).collect::<Vec<_>>()
        };
        let seen = ["203.0.113.9:1", "203.0.113.9:2", "203.0.113.9:3", "203.0.113.9:4"];
        let all = told(("203.0.113.9:5000", "192.0.2.7"), &seen);
        assert_eq!(all[0], ("203.0.113.9:5000".to_owned(), "192.0.2.7:5000".to_owned()));
        assert_eq!(all.len(), 1 + REFLEXIVE_MAX + host.len());
        // The NAT gave the node's own packets the same mapping.
        assert_eq!(told(("203.0.113.9:2", "192.0.2.7"), &seen[..3]).len(), 1 + 2 + host.len());
        // Of an interface that is gone, or a gateway that names the host's own address.
        assert_eq!(told(("203.0.113.9:5000", "192.0.2.9"), &[]).len(), host.len());
        assert_eq!(told(("10.0.0.7:5000", "10.0.0.7"), &[]).len(), host.len());
    }
}
