//! The part of the graph that a client sees: channels, services and the connection graph.

use std::collections::BTreeMap;

use sgc_websocket::Message as Frame;

use crate::access::Right;
use crate::definitions::Types;
use crate::error::GatewayError;
use crate::graph::{Graph, is_hidden};
use crate::session::action_of;

use super::{CDR, Connection, Level};
use crate::foxglove::connections::Connections;
use crate::foxglove::listing::Offer;
use crate::foxglove::protocol::{Channel, Half, ServerMessage, Service};

/// The encoding of definitions.
const SCHEMA_ENCODING: &str = "ros2msg";
/// Most topics, and most services, that are announced at once.
const TOLD_AT_ONCE: usize = 32;

/// The definitions of a service's request and response.
struct Halves {
    request: String,
    response: String,
}

type Descriptions<T> = Vec<(String, Offer, Result<T, GatewayError>)>;

impl Connection<'_> {
    fn is_shown(&self, name: &str) -> bool {
        self.options.shows_hidden || !is_hidden(name)
    }

    /// Sends the whole connection graph, and its changes from now on.
    pub(super) fn begin_connections(&mut self) {
        self.connections = Some(Connections::default());
        self.tell_connections(&self.session.graph());
    }

    fn tell_connections(&mut self, graph: &Graph) {
        let shows_hidden = self.options.shows_hidden;
        let Some(connections) = &mut self.connections else { return };
        if let Some(update) = connections.update(graph, |name| shows_hidden || !is_hidden(name)) {
            self.outbox.answer(Frame::text(update));
        }
    }

    /// Returns the topics and services that the client may use.
    fn offers(&self, graph: &Graph) -> (BTreeMap<String, Offer>, BTreeMap<String, Offer>) {
        let may = |right, name: &str| self.session.check(right, name).is_ok();
        let mut topics = BTreeMap::new();
        for (name, info) in graph.topics.iter().filter(|(name, _)| self.is_shown(name)) {
            // The gateway's own readers exist only for subscribers and do not make a topic.
            let is_there = !info.publishers.is_empty() || info.subscribers.iter().any(|end| !end.is_own);
            if let Some(type_name) = info.type_name().filter(|_| is_there && may(Right::Subscribe, name)) {
                let hash = info.type_hash(type_name).map(str::to_owned);
                topics.insert(name.clone(), Offer { type_name: type_name.to_owned(), hash });
            }
        }
        let mut services = BTreeMap::new();
        for (name, info) in graph.services.iter().filter(|(name, _)| self.is_shown(name)) {
            if !info.servers.is_empty() && may(Right::Call, action_of(name)) {
                services.insert(name.clone(), Offer { type_name: info.type_name.clone(), hash: None });
            }
        }
        (topics, services)
    }

    /// Sends a part of the graph's changes. Returns `false` while there are more.
    pub(super) async fn tell_graph(&mut self) -> bool {
        let graph = self.session.graph();
        self.tell_connections(&graph);
        let (topics, services) = self.offers(&graph);
        let gone = self.channels.retain(&topics);
        let heard = self.heard.iter().filter(|(_, heard)| gone.contains(&heard.channel));
        let heard: Vec<u32> = heard.map(|(id, _)| *id).collect();
        heard.into_iter().for_each(|id| self.unsubscribe(id));
        if !gone.is_empty() {
            self.tell(&ServerMessage::Unadvertise { channel_ids: &gone });
        }
        let gone = self.services.retain(&services);
        if !gone.is_empty() {
            self.tell(&ServerMessage::UnadvertiseServices { service_ids: &gone });
        }
        let topics = self.channels.untold(&topics, self.attempt, TOLD_AT_ONCE);
        let services = self.services.untold(&services, self.attempt, TOLD_AT_ONCE);
        let is_all = topics.len() < TOLD_AT_ONCE && services.len() < TOLD_AT_ONCE;
        if topics.is_empty() && services.is_empty() && !self.is_first {
            return is_all;
        }
        let hub = self.session.hub();
        let described = hub.shared.network.run(move |network| {
            let topics = topics.into_iter().map(|(name, offer)| {
                let schema = schema(&network.types, &offer.type_name, offer.hash.as_deref());
                (name, offer, schema)
            });
            let services = services.into_iter().map(|(name, offer)| {
                let half = |half: &str| schema(&network.types, &format!("{}_{half}", offer.type_name), None);
                let schemas =
                    half("Request").and_then(|request| Ok(Halves { request, response: half("Response")? }));
                (name, offer, schemas)
            });
            Ok((topics.collect::<Vec<_>>(), services.collect::<Vec<_>>()))
        });
        let Ok((topics, services)) = described.await else { return true };
        self.tell_topics(topics);
        self.tell_services(services);
        is_all
    }

    fn tell_topics(&mut self, topics: Descriptions<String>) {
        let (mut channels, mut replaced) = (Vec::new(), Vec::new());
        for (topic, offer, schema) in topics {
            let schema_name = offer.type_name.clone();
            let channel = |id, topic, schema_name, schema| Channel {
                id,
                topic,
                encoding: CDR,
                schema_name,
                schema,
                schema_encoding: SCHEMA_ENCODING,
            };
            match schema {
                Ok(schema) => {
                    let (id, old) = self.channels.tell(&topic, offer);
                    replaced.extend(old);
                    self.known(&schema_name);
                    channels.push(channel(id, topic, schema_name, schema));
                }
                Err(error) => {
                    // The topic is shown, and a status says why it cannot be subscribed to.
                    let id = self.channels.tell_unknown(&topic, offer, self.attempt, true);
                    self.unknown(&schema_name, &error);
                    channels.extend(id.map(|id| channel(id, topic, schema_name, String::new())));
                }
            }
        }
        if !replaced.is_empty() {
            self.tell(&ServerMessage::Unadvertise { channel_ids: &replaced });
        }
        if !channels.is_empty() || self.is_first {
            self.is_first = false;
            self.tell(&ServerMessage::Advertise { channels: &channels });
        }
    }

    fn tell_services(&mut self, services: Descriptions<Halves>) {
        let mut told = Vec::new();
        for (name, offer, schemas) in services {
            let type_name = offer.type_name.clone();
            match schemas {
                Ok(Halves { request, response }) => {
                    let half = |half: &str, schema| Half {
                        encoding: CDR,
                        schema_name: format!("{type_name}_{half}"),
                        schema_encoding: SCHEMA_ENCODING,
                        schema,
                    };
                    let (request, response) = (half("Request", request), half("Response", response));
                    let (id, _) = self.services.tell(&name, offer);
                    self.known(&type_name);
                    told.push(Service { id, name, type_name, request, response });
                }
                Err(error) => {
                    self.services.tell_unknown(&name, offer, self.attempt, false);
                    self.unknown(&type_name, &error);
                }
            }
        }
        if !told.is_empty() {
            self.tell(&ServerMessage::AdvertiseServices { services: &told });
        }
    }

    fn unknown(&mut self, type_name: &str, error: &GatewayError) {
        let message = format!("{type_name} cannot be shown: {error}");
        self.status(Level::Warning, &message, Some(definition_id(type_name)));
    }

    fn known(&mut self, type_name: &str) {
        if !self.channels.is_unknown(type_name) && !self.services.is_unknown(type_name) {
            self.remove_status(&definition_id(type_name));
        }
    }
}

/// Returns the definition of a message type as text. May read files.
fn schema(types: &Types, type_name: &str, hash: Option<&str>) -> Result<String, GatewayError> {
    Ok(types.layout(type_name, hash)?.to_ros2msg())
}

fn definition_id(type_name: &str) -> String {
    format!("definition:{type_name}")
}
