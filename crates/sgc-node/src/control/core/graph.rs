//! Builds the graph document and opens taps for the status socket.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;

use sgc_ros::{
    Direction, DiscoveredEndpoint, EndpointKind, EndpointSpec, OwnerState, RosNetwork, Sample, SampleHandler,
    ShareView, UseView, dds_topic, dds_type, matches, reader_for, ros_topic, ros_type, weakest,
};
use sgc_trust::{Grantees, Policy};
use sgc_wire::{CatalogueEntry, Kind, Name, PayloadForm, Role};
use tokio::sync::oneshot;

use super::Core;
use crate::admin::graph::{
    Endpoint, GRAPH_ENDPOINTS_MAX, Graph, Link, NameLine, Offer, Search, Share, ShareRoute, Side,
    UnheardMember, Use, UseRoute,
};
use crate::admin::not_direct::NOT_DIRECT_MAX;
use crate::admin::route_words::owner_state;
use crate::data::dead_man::ResumeError;
use crate::data::tap::{Tap, TapError, TapMessage, TapQueue, TapRequest, Taps};

impl<N: RosNetwork> Core<N> {
    pub(super) fn graph(&self, asked: Option<Name>) -> Graph {
        let mut graph = Graph {
            node: self.certificates.identity().node_name().to_string(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            has_ros: self.routes.is_some(),
            drops: self.all_drops(),
            refused: self.all_refused(),
            alerts: self.alerts(),
            calls: self.lost_calls(),
            ..Graph::default()
        };
        let links = self.links.iter().map(|(id, entry)| {
            let peer = entry.peer().node_id;
            let (_, silent) = self.router.link_cost(id).unwrap_or_default();
            Link {
                id: id.0,
                peer: peer.to_string(),
                name: self.names.get(&peer),
                remote: entry.remote().to_string(),
                rtt_us: entry.stats().rtt.as_micros().try_into().unwrap_or(u64::MAX),
                silent,
                is_direct: self.direct.is_direct(id),
            }
        });
        graph.links = links.collect();
        graph.not_direct = self.not_direct().take(NOT_DIRECT_MAX).collect();
        let searches = self.board.snapshot().into_iter();
        graph.routers = searches
            .map(|s| Search { router: s.router, state: s.state.to_string(), last_failure: s.last_failure })
            .collect();
        let mut names: BTreeSet<Name> = self.forwards.names().chain(&asked).copied().collect();
        self.add_routes(&mut graph, &mut names);
        graph.names = names.into_iter().map(|name| (name.to_string(), self.name_line(&name))).collect();
        graph
    }

    fn add_routes(&self, graph: &mut Graph, names: &mut BTreeSet<Name>) {
        let Some(routes) = &self.routes else { return };
        let known = routes.local_endpoints().count();
        graph.endpoints_left_out = known.saturating_sub(GRAPH_ENDPOINTS_MAX);
        let endpoint = |e: &DiscoveredEndpoint| Endpoint {
            topic: ros_topic(&e.topic).unwrap_or(&e.topic).to_owned(),
            is_ros_topic: ros_topic(&e.topic).is_some(),
            type_name: ros_type(&e.type_name),
            type_hash: e.type_hash.clone(),
            writes: e.kind == EndpointKind::Writer,
            guid: format!("{:?}", e.guid),
            node: routes
                .node_of(&e.guid)
                .map(|node| format!("{}/{}", node.namespace().trim_end_matches('/'), node.name())),
            qos: (&e.qos).into(),
            shared_by: ros_topic(&e.topic)
                .and_then(|topic| routes.shared_by(Kind::Topic, topic, &ros_type(&e.type_name)))
                .map(usize::from),
        };
        graph.endpoints = routes.local_endpoints().take(GRAPH_ENDPOINTS_MAX).map(endpoint).collect();
        graph.problems = self.problems();
        for view in routes.share_views() {
            graph.shares.push(self.share_line(view, names));
        }
        let mut owners = BTreeMap::new();
        for view in routes.use_views() {
            owners.insert(view.owner, view.owner_name.to_owned());
            graph.uses.push(self.use_line(view, names));
        }
        let offer = |offer: sgc_ros::OfferView<'_>| Offer {
            owner_id: offer.owner.to_string(),
            owner: owners.get(&offer.owner).cloned(),
            kind: offer.entry.metadata.kind.into(),
            topic: offer.entry.metadata.ros_name.clone(),
            type_name: offer.entry.metadata.type_name.clone(),
            type_hash: offer.entry.type_hash.clone(),
            qos: (&offer.entry.qos).into(),
            name: offer.name.to_string(),
            subscribe: offer.entry.subscribe || is_called(offer.entry),
            publish: offer.entry.publish && !is_called(offer.entry),
            is_used: offer.is_used,
        };
        graph.offers = routes.offers().map(offer).collect();
    }

    /// Describes a share, and adds the names of its routes to `names`.
    fn share_line(&self, view: ShareView<'_>, names: &mut BTreeSet<Name>) -> Share {
        let is_service = view.metadata.kind == Kind::Service;
        let mut share = Share {
            kind: view.metadata.kind.into(),
            topic: view.metadata.ros_name.clone(),
            wanted_type: Some(view.metadata.type_name.clone()).filter(|t| !t.is_empty()),
            // Callers of a service publish under its name. Users do not call that publishing.
            to: count(if is_service { &view.policy.publish } else { &view.policy.subscribe }),
            publish: if is_service { [0; 3] } else { count(&view.policy.publish) },
            unheard: self.unheard(view.policy),
            routes: Vec::new(),
        };
        for route in view.routes {
            names.insert(route.name);
            let granted: BTreeSet<_> = self
                .endpoint
                .granted(&route.name)
                .into_iter()
                .map(|(_, peer)| self.names.called(&peer))
                .collect();
            let role = if is_service { Role::Publish } else { Role::Subscribe };
            let mut consumer_hashes = BTreeMap::<_, BTreeSet<_>>::new();
            for (peer, hash) in self.consumers.hashes(route.name, role) {
                consumer_hashes.entry(self.names.called(&peer)).or_default().insert(hash.to_owned());
            }
            let refused = self.refused.for_name(&route.name);
            let sink = self.sinks.get(&route.name);
            let wished = self.shares.get(&route.name).map(|share| share.wished()).unwrap_or_default();
            share.routes.push(ShareRoute {
                topic: route.local_name,
                shared_as: Some(route.shared_as),
                type_name: route.type_name,
                name: route.name.to_string(),
                writers: route.writers,
                is_read: route.is_read,
                is_written: route.is_written,
                qos: route.qos.as_ref().map(Into::into),
                granted: granted.into_iter().collect(),
                consumer_hashes,
                refused: refused.map(|(peer, why)| (self.names.called(peer), why.clone())).collect(),
                messages: self.shares.get(&route.name).map_or(0, |share| share.published()),
                written: sink.map_or(0, |sink| sink.delivered()),
                matched: sink.map_or(0, |sink| sink.matched()),
                wished_interval_us: wished
                    .interval
                    .map(|time| u64::try_from(time.as_micros()).unwrap_or(u64::MAX)),
                wished_bits_per_s: wished.bits_per_s,
                dead_man: sink.and_then(|sink| sink.dead_man()),
                is_json: route.form == PayloadForm::Json,
                lacks_definition: self.lacks_definition(&route.name, route.form),
            });
        }
        share
    }

    /// Describes a use, and adds the names of its routes to `names`.
    fn use_line(&self, view: UseView<'_>, names: &mut BTreeSet<Name>) -> Use {
        let publishes = view.direction == Direction::Publish && view.kind == Kind::Topic;
        let (name, refused) = view.token.map_or((None, None), |(name, refused)| {
            names.insert(name);
            (Some(name.to_string()), refused.map(|by| by.to_string()))
        });
        let owner_refusal = match &view.owner_state {
            Some(OwnerState::Refuses(by)) => Some(by),
            _ => None,
        };
        // A later incarnation of the owner would grant something.
        let is_granted = view.routes.iter().any(|route| route.is_granted);
        let is_owner_revoked = !is_granted && self.certificates.anchors().is_node_revoked(&view.owner);
        let mut used = Use {
            kind: view.kind.into(),
            publishes,
            topic: view.topic.to_owned(),
            local_topic: view.local_topic,
            wanted_type: view.wanted_type.map(str::to_owned),
            owner_id: view.owner.to_string(),
            owner: view.owner_name.to_owned(),
            owner_meant: self.members.owner_meant(view.owner_name).map(str::to_owned),
            owner_refusal: owner_refusal.map(|by| by.to_string()),
            owner_state: view.owner_state.map(owner_state),
            is_owner_revoked,
            follow: self.endpoint.follow_status(&view.owner).map(|status| (&status).into()),
            has_catalogue: view.has_catalogue,
            is_token: name.is_some(),
            name,
            refused,
            routes: Vec::new(),
        };
        for route in view.routes {
            names.insert(route.name);
            let published = self.shares.get(&route.name).map(|share| share.published());
            let sink = self.sinks.get(&route.name);
            let age = sink.and_then(|sink| sink.last_age());
            used.routes.push(UseRoute {
                topic: route.local_name,
                type_name: route.entry.metadata.type_name.clone(),
                type_hash: route.entry.type_hash.clone(),
                name: route.name.to_string(),
                qos: (&route.entry.qos).into(),
                is_granted: route.is_granted,
                refused: route.refused.map(|by| by.to_string()),
                join: self.endpoint.join_status(&route.name).map(|status| (&status).into()),
                writers: route.writers,
                matched: sink.map_or(0, |sink| sink.matched()),
                publishers: route.publishers,
                is_read: route.is_read,
                lacks_definition: self.lacks_definition(&route.name, route.form),
                messages: published.or(sink.map(|sink| sink.delivered())).unwrap_or(0),
                last_s: sink.and_then(|sink| sink.since_last()).map(|since| since.as_secs()),
                age_us: age.map(|age| age.age_us),
                age_error_us: age.and_then(|age| age.error_us),
                dead_man: sink.and_then(|sink| sink.dead_man()),
            });
        }
        used
    }

    /// Returns the members of a policy that were not heard.
    fn unheard(&self, policy: &Policy) -> Vec<UnheardMember> {
        let mut all = self.members.unheard(&policy.subscribe);
        for name in self.members.unheard(&policy.publish) {
            if !all.contains(&name) {
                all.push(name);
            }
        }
        all.into_iter().map(|name| UnheardMember { name: name.written, meant: name.meant }).collect()
    }

    /// Returns `true` if an interface's messages are converted to or from JSON and their type is unknown here.
    fn lacks_definition(&self, name: &Name, form: PayloadForm) -> bool {
        let writes = form == PayloadForm::Json && self.shares.get(name).is_some_and(|s| s.lacks_definition());
        writes || self.sinks.get(name).is_some_and(|sink| sink.lacks_definition())
    }

    /// Returns all problems that the user should know.
    pub(super) fn problems(&self) -> Vec<String> {
        let Some(routes) = &self.routes else { return Vec::new() };
        let mut problems: Vec<_> = routes.problems().map(ToString::to_string).collect();
        let of_share = routes.share_views().into_iter().flat_map(|view| view.routes);
        let of_share = of_share.map(|route| (route.local_name, route.type_name, route.name, route.form));
        let of_use = routes.use_views().into_iter().flat_map(|view| view.routes);
        let of_use = of_use.map(|r| (r.local_name, r.entry.metadata.type_name.clone(), r.name, r.form));
        for (topic, type_name, name, form) in of_share.chain(of_use) {
            if self.lacks_definition(&name, form) {
                problems.push(format!(
                    "{topic}: its messages travel as JSON, and no definition of {type_name} is known here; none get \
                     through. Name a directory that has it with `definitions` in [ros]"
                ));
            }
        }
        problems.extend(self.members.misspelt().map(|(written, meant)| {
            format!("a rule names \"{written}\", which nobody here is called; \"{meant}\" is here and may be meant")
        }));
        problems.extend(self.types.problems(|owner| self.names.called(owner)));
        problems
    }

    fn name_line(&self, name: &Name) -> NameLine {
        let mut line = NameLine {
            way: self.router.route(name).map(|(link, cost)| (link.0, cost)),
            ..NameLine::default()
        };
        if let Some((entry, stats)) = self.forwards.get(name) {
            line.has_branch = true;
            line.out = entry.links().iter().map(|link| link.0).collect();
            line.up = entry.trees.iter().map(|tree| tree.up.0).collect();
            line.packets = stats.packets.load(Relaxed);
            line.bytes = stats.bytes.load(Relaxed);
            line.dropped = stats.reasons();
        }
        line
    }

    /// Lets commands pass the dead-man switches of a topic by its name here.
    pub(super) fn resume(&self, topic: &str) -> Result<(), ResumeError> {
        let views = self.routes.iter().flat_map(|routes| routes.use_views());
        let brought = views.filter(|view| view.direction == Direction::Bring).flat_map(|view| view.routes);
        let brought = brought.filter(|route| route.local_name == topic).map(|route| route.name);
        let shares = self.routes.iter().flat_map(|routes| routes.share_views()).flat_map(|view| view.routes);
        let shared = shares.filter(|route| route.local_name == topic).map(|route| route.name);
        let names: Vec<_> = brought.chain(shared).collect();
        let mut resumed = None;
        for sink in names.iter().filter_map(|name| self.sinks.get(name)) {
            resumed = resumed.max(sink.resume_dead_man());
        }
        match resumed {
            None => Err(ResumeError::NoSwitch { topic: topic.to_owned() }),
            Some(false) => Err(ResumeError::NotStopped { topic: topic.to_owned() }),
            Some(true) => Ok(()),
        }
    }

    /// Opens a tap. A topic from the far side is tapped there, since this node's writers are hidden from its own
    /// readers.
    pub(super) fn tap(&mut self, wish: TapRequest, reply: oneshot::Sender<Result<Tap, TapError>>) {
        let TapRequest { topic, side } = wish;
        let Some(routes) = &self.routes else {
            let _ = reply.send(Err(TapError::NoTopic { topic }));
            return;
        };
        let views = routes.use_views();
        let brought = views.iter().filter(|view| view.direction == Direction::Bring).flat_map(|v| &v.routes);
        let brought = brought.filter(|route| route.local_name == topic);
        // Granted routes take precedence.
        let brought = brought.max_by_key(|route| route.is_granted);
        let shares = routes.share_views();
        let shared = shares.iter().flat_map(|view| &view.routes).find(|route| route.local_name == topic);
        let not_there = |why| Err(TapError::NotThere { topic: topic.clone(), why });
        let of = |name, taps: &Taps, side, type_name: &str, type_hash: Option<&String>| match taps.add() {
            Some(queue) => {
                let described = self.types.described(Some(name), type_name, type_hash.map(String::as_str));
                let (type_name, type_hash) = (type_name.to_owned(), type_hash.cloned());
                Ok(Tap { side, type_name, type_hash, described, queue, reader: None })
            }
            None => Err(TapError::TooMany { topic: topic.clone() }),
        };
        let result = match (side, brought) {
            (Some(Side::Far) | None, Some(route)) => match self.sinks.get(&route.name) {
                Some(sink) => {
                    let metadata = &route.entry.metadata;
                    let type_hash = route.entry.type_hash.as_ref();
                    of(&route.name, sink.taps(), Side::Far, &metadata.type_name, type_hash)
                }
                None => not_there("it does not come from another node yet"),
            },
            (Some(Side::Far), None) => match shared.and_then(|r| Some((r, self.sinks.get(&r.name)?))) {
                Some((route, sink)) => of(&route.name, sink.taps(), Side::Far, &route.type_name, None),
                None => not_there("this node does not bring it from another"),
            },
            (Some(Side::Sent), _) => {
                let published = views.iter().filter(|view| view.direction == Direction::Publish);
                let published = published.flat_map(|v| &v.routes).find(|route| route.local_name == topic);
                let published = published.map(|r| (r.name, r.entry.metadata.type_name.as_str()));
                let sent = shared.map(|r| (r.name, r.type_name.as_str())).or(published);
                match sent.and_then(|(name, type_name)| Some((name, self.shares.get(&name)?, type_name))) {
                    Some((name, share, type_name)) => of(&name, share.taps(), Side::Sent, type_name, None),
                    None => not_there("this node does not send it to others"),
                }
            }
            (Some(Side::Local) | None, _) => return self.tap_local(topic, reply),
        };
        let _ = reply.send(result);
    }

    /// Creates a local reader that matches every publisher of a topic.
    fn tap_local(&mut self, topic: String, reply: oneshot::Sender<Result<Tap, TapError>>) {
        let (Some(routes), Some(network)) = (&self.routes, self.network.get()) else { return };
        let writers: Vec<_> = routes
            .local_endpoints()
            .filter(|e| e.kind == EndpointKind::Writer && ros_topic(&e.topic) == Some(topic.as_str()))
            .collect();
        // If publishers have several types, the first one counts.
        let Some(first) = writers.first() else {
            let is_used = routes
                .use_views()
                .iter()
                .any(|view| view.direction == Direction::Bring && matches(&view.local_topic, &topic));
            let error = if is_used { TapError::NotBrought { topic } } else { TapError::NoTopic { topic } };
            let _ = reply.send(Err(error));
            return;
        };
        let same: Vec<_> = writers.iter().filter(|w| w.type_name == first.type_name).collect();
        let Some(offer) = weakest(same.iter().map(|w| &w.qos)) else { return };
        let type_name = ros_type(&first.type_name);
        let spec = EndpointSpec {
            topic: dds_topic(&topic),
            type_name: dds_type(&type_name),
            keyless: first.keyless,
            asks_key_hash: false,
            type_hash: first.type_hash.clone(),
            qos: reader_for(&offer, same.len()),
        };
        let described = self.types.described(None, &type_name, first.type_hash.as_deref());
        let alive = self.alive.clone();
        let queue = Arc::new(TapQueue::default());
        self.local_taps.retain(|tap| !tap.is_closed());
        self.local_taps.push(queue.clone());
        tokio::task::spawn_blocking(move || {
            let into = queue.clone();
            let handler: SampleHandler =
                Box::new(move |sample: Sample| into.push(TapMessage::from_sample(&sample)));
            let type_hash = spec.type_hash.clone();
            let tap = network.create_reader(&spec, handler).map(|reader| {
                let reader: Box<dyn std::any::Any + Send> = Box::new((reader, alive));
                Tap { side: Side::Local, type_name, type_hash, described, queue, reader: Some(reader) }
            });
            // The client may have left. The reader then ends on this blocking thread.
            let _ = reply.send(tap.map_err(|why| TapError::Network(why.to_string())));
        });
    }
}

fn is_called(entry: &CatalogueEntry) -> bool {
    entry.metadata.kind == Kind::Service && entry.publish
}

fn count(grantees: &Grantees) -> [usize; 3] {
    [grantees.nodes.len(), grantees.groups.len(), grantees.fleets.len()]
}
