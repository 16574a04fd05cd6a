//! The clocks of the nodes that messages come from: questions for their time, and the bounds for the sinks.

use std::collections::BTreeSet;
use std::time::Instant;

use sgc_ros::RosNetwork;
use sgc_session::ClockOutput;
use sgc_wire::{Name, NodeId, SourceId, UnixMillis};

use super::Core;
use crate::admin::status::ClockLine;
use crate::clock::{now, unix_ns};

impl<N: RosNetwork> Core<N> {
    /// Looks from which nodes messages come.
    pub(super) fn look_at_clocks(&mut self, at: Instant) {
        let own = self.certificates.identity().node_id();
        let mut peers = BTreeSet::new();
        for (name, _) in self.sinks.iter() {
            match self.endpoint.owner_of(name) {
                Some(owner) => drop(peers.insert(owner)),
                None => peers.extend(self.publishing_nodes(name).map(|(_, node)| node)),
            }
        }
        peers.remove(&own);
        self.clocks.want(at, peers);
    }

    /// Takes the time that a node told.
    pub(super) fn time_told(&mut self, peer: NodeId, asked: Instant, time: UnixMillis) {
        self.clocks.told(peer, asked, Instant::now(), time);
        for (name, _) in self.sinks.iter() {
            // Others may publish on our own shares.
            if self.endpoint.owner_of(name).is_none_or(|owner| owner == peer) {
                self.set_clock(name);
            }
        }
    }

    /// Tells the sink of a name the clocks of those that publish to it.
    pub(super) fn set_clock(&self, name: &Name) {
        let Some(sink) = self.sinks.get(name) else { return };
        match self.endpoint.owner_of(name) {
            Some(owner) => sink.clocks().set_owner(self.clocks.bounds(&owner)),
            None => {
                let publishing = self.publishing_nodes(name);
                let known =
                    publishing.filter_map(|(source, node)| Some((source, self.clocks.bounds(&node)?)));
                sink.clocks().set_others(known.collect());
            }
        }
    }

    /// Iterates over the sources of other nodes that publish to a share of this one.
    fn publishing_nodes(&self, name: &Name) -> impl Iterator<Item = (SourceId, NodeId)> {
        let nodes = self.endpoint.granted(name);
        let publishers = self.endpoint.publishers(name).into_iter();
        publishers.filter_map(move |(source, sink)| {
            nodes.iter().find(|(of, _)| *of == sink).map(|(_, node)| (source, *node))
        })
    }

    /// Asks the nodes whose time is due. Returns `true` if there was one.
    pub(super) fn drain_clocks(&mut self) -> bool {
        let mut progressed = false;
        while let Some(output) = self.clocks.poll(Instant::now()) {
            progressed = true;
            match output {
                ClockOutput::Ask(peer) => self.endpoint.ask_clock(now(), peer),
                ClockOutput::Leave(peer) => self.endpoint.leave_clock(now(), &peer),
            }
        }
        progressed
    }

    /// Returns the known clocks, as the status shows them.
    pub(super) fn clock_lines(&self) -> Vec<ClockLine> {
        let (at, own_ns) = (Instant::now(), unix_ns());
        let line = |(peer, bounds): (NodeId, sgc_session::ClockBounds)| {
            let (ahead_ns, error_ns) = bounds.offset(at, own_ns);
            ClockLine {
                peer: peer.to_string(),
                name: self.names.called(&peer),
                ahead_us: ahead_ns / 1000,
                error_us: error_ns / 1000,
                measured_s: at.saturating_duration_since(bounds.measured()).as_secs(),
                steps: bounds.steps(),
            }
        };
        self.clocks.known().map(line).collect()
    }
}
