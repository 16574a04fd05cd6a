//! Direct links: questions for addresses, checks, and the peers with which data is exchanged.

use std::collections::BTreeSet;
use std::time::Instant;

use bytes::Bytes;
use sgc_endpoint::RefusedBy;
use sgc_ros::{RosNetwork, Routes};
use sgc_router::LinkId;
use sgc_session::DirectOutput;
use sgc_transport::{CheckDatagram, CloseReason};
use sgc_trust::{Grantees, VerifiedPeer};
use sgc_wire::{NodeId, PathOffer, RefuseReason, SinkId};

use super::Core;
use crate::admin::not_direct::{NotDirectPeer, NotDirectReason};
use crate::clock::now;
use crate::drops::NodeDrop;
use crate::link::direct_address::HostAddress;
use crate::link::mapping_report::MappingReport;

impl<N: RosNetwork> Core<N> {
    /// Sets the peers that may have direct links, and whether a port may be mapped for them.
    pub(super) fn set_direct(&mut self, permitted: Grantees, maps_port: bool) {
        let links = &self.links;
        let peer_of = |link| links.get(link).map(|entry| entry.peer().clone());
        for link in self.direct.set_permitted(permitted, peer_of) {
            self.close_not_permitted(link);
        }
        self.direct.set_port_mapping(maps_port);
        self.endpoint.offer_paths(now(), self.direct.is_offered());
    }

    /// Closes a direct link that is not permitted any more.
    pub(super) fn close_not_permitted(&mut self, link: LinkId) {
        let because = "`direct` permits no direct link with the peer any more";
        self.links.close(link, because.to_owned(), CloseReason::Goodbye);
    }

    /// Answers a peer that asks for the addresses of this node.
    pub(super) fn path_asked(&mut self, sink: SinkId, peer: &VerifiedPeer, question: &Bytes) {
        let answer = self.direct.answer(Instant::now(), peer, question);
        if matches!(answer, Err(RefuseReason::NotPermitted)) {
            self.control_drops.count_from(NodeDrop::DirectNotPermitted, peer.node_id);
        }
        self.endpoint.answer_path(now(), sink, answer);
    }

    pub(super) fn path_offered(&mut self, peer: NodeId, offer: &PathOffer) {
        self.direct.offered(Instant::now(), peer, offer);
    }

    pub(super) fn path_refused(&mut self, peer: NodeId, by: RefusedBy) {
        let is_for_good = by == RefusedBy::Owner(RefuseReason::NotPermitted);
        self.direct.refused(Instant::now(), peer, is_for_good);
    }

    pub(super) fn check_arrived(&mut self, check: &CheckDatagram) {
        self.direct.received(Instant::now(), check);
    }

    pub(super) fn host_addresses(&mut self, addresses: Vec<HostAddress>) {
        self.direct.set_host(Instant::now(), addresses);
    }

    pub(super) fn port_mapped(&mut self, report: MappingReport) {
        self.direct.set_mapping(Instant::now(), report);
    }

    /// Passes on the addresses from which routers see this node come.
    pub(super) fn reflexive_changed(&mut self) {
        let direct = &self.direct;
        // Other sockets have other mappings.
        let seen =
            self.links.iter().filter(|(id, entry)| entry.uses_direct_socket() && !direct.is_direct(*id));
        let seen: Vec<_> = seen.filter_map(|(_, entry)| entry.observed()).collect();
        self.direct.set_reflexive(Instant::now(), seen.into_iter());
    }

    /// Looks with whom data is exchanged, and closes direct links that nothing uses.
    pub(super) fn look_at_direct(&mut self, at: Instant) {
        // A link that the user configured is as direct as one can be.
        let (links, direct) = (&self.links, &self.direct);
        let configured = links.iter().filter(|(id, _)| !direct.is_direct(*id));
        let reached: BTreeSet<_> = configured.map(|(_, entry)| entry.peer().node_id).collect();
        let owners = self.endpoint.data_owners().filter(|owner| !reached.contains(&owner.node_id));
        self.direct.want(at, owners);
        for link in self.direct.unused(at, &self.router) {
            self.links.close(link, "nothing uses the direct link".to_owned(), CloseReason::Goodbye);
        }
    }

    /// Returns the peers with which data is exchanged over routers, and why, in the order of their ids.
    pub(super) fn not_direct(&self) -> impl Iterator<Item = NotDirectPeer> {
        let own = self.certificates.identity().node_id();
        let reached: BTreeSet<_> = self.links.iter().map(|(_, entry)| entry.peer().node_id).collect();
        let names = self.routes.iter().flat_map(Routes::status).filter_map(|route| route.name);
        let users = names.flat_map(|name| self.endpoint.granted(&name)).map(|(_, user)| user);
        let owners = self.endpoint.data_owners().map(|owner| owner.node_id);
        let peers: BTreeSet<_> = owners.chain(users).collect();
        peers.into_iter().filter(move |peer| *peer != own && !reached.contains(peer)).map(|peer| {
            let (name, reason) = (self.names.called(&peer), self.why_not_direct(&peer));
            NotDirectPeer { peer: peer.to_string(), name, reason }
        })
    }

    /// Returns why there is no direct link to a peer.
    pub(super) fn why_not_direct(&self, peer: &NodeId) -> NotDirectReason {
        let owner = self.endpoint.data_owners().find(|owner| owner.node_id == *peer);
        self.direct.why_not(peer, owner)
    }

    /// Carries out what the search for direct paths wants. Returns `true` if there was something.
    pub(super) fn drain_direct(&mut self) -> bool {
        let mut progressed = false;
        if std::mem::take(&mut self.is_newly_granted) {
            self.look_at_direct(Instant::now());
            self.look_at_clocks(Instant::now());
        }
        while let Some(output) = self.direct.poll() {
            progressed = true;
            match output {
                DirectOutput::Ask { peer, question } => self.endpoint.ask_path(now(), peer, &question),
                DirectOutput::Leave { peer } => self.endpoint.leave_path(now(), &peer),
                // The sockets took the others.
                DirectOutput::Send { .. }
                | DirectOutput::Admit { .. }
                | DirectOutput::Shut { .. }
                | DirectOutput::Dial { .. } => {}
            }
        }
        progressed
    }
}
