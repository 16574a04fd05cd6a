//! [`OwnTokens`]: the liveliness tokens of this program's nodes and endpoints.
//!
//! A token names the node of its endpoint, so an endpoint that moves to another node gets another token, and with it
//! another id. The new token is declared before the old one ends, so that nobody misses the endpoint meanwhile.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex};

use sgc_ros::{EndpointKind, GraphNode, Guid};
use sgc_sync::lock;
use sgc_wire::RosNode;
use sgc_zenoh::{EndpointRef, Gid, Token, TokenEndpoint, ZenohId, unassigned_node};
use zenoh::liveliness::LivelinessToken;
use zenoh::{Session, Wait as _};

/// A node, and its place among announced nodes of the same name: nodes of two robots may have one name.
type NodeKey = (RosNode, usize);

/// The tokens of this program.
#[derive(Debug)]
pub(crate) struct OwnTokens {
    session: Session,
    domain: u32,
    id: ZenohId,
    /// The number of the next node or endpoint.
    next: u64,
    /// The number of the node of endpoints without one, and the node.
    unassigned: (u64, RosNode),
    nodes: BTreeMap<NodeKey, AnnouncedNode>,
    /// The nodes of endpoints, present or future.
    assigned: BTreeMap<Guid, NodeKey>,
    endpoints: BTreeMap<u64, OwnEndpoint>,
}

#[derive(Debug)]
struct AnnouncedNode {
    id: u64,
    token: Option<LivelinessToken>,
}

#[derive(Debug)]
struct OwnEndpoint {
    endpoint: TokenEndpoint,
    node: Option<NodeKey>,
    gid: Arc<Mutex<Gid>>,
    _token: LivelinessToken,
}

impl OwnTokens {
    pub(crate) fn new(session: Session, domain: u32, id: ZenohId) -> Self {
        Self {
            session,
            domain,
            id,
            next: 1,
            unassigned: (0, unassigned_node()),
            nodes: BTreeMap::new(),
            assigned: BTreeMap::new(),
            endpoints: BTreeMap::new(),
        }
    }

    /// Returns a number that no other node or endpoint of the session gets.
    pub(crate) fn number(&mut self) -> u64 {
        self.next += 1;
        self.next - 1
    }

    /// Declares the token of an endpoint with a number from [`Self::number`]. Returns the place where its current id is.
    pub(crate) fn add(&mut self, endpoint: TokenEndpoint) -> Result<Arc<Mutex<Gid>>, String> {
        let node = self.node_of(endpoint.id);
        let (token, gid) = self.declare(node.as_ref(), &endpoint)?;
        let gid = Arc::new(Mutex::new(gid));
        let own = OwnEndpoint { node, gid: Arc::clone(&gid), _token: token, endpoint };
        self.endpoints.insert(own.endpoint.id, own);
        Ok(gid)
    }

    /// Returns the node to which an endpoint is assigned.
    fn node_of(&self, id: u64) -> Option<NodeKey> {
        let at = EndpointRef { session: self.id, id };
        let guids = [EndpointKind::Reader, EndpointKind::Writer].map(|kind| at.guid(kind));
        guids.iter().find_map(|guid| self.assigned.get(guid)).cloned()
    }

    /// Ends the token of an endpoint, with the place that [`Self::add`] returned. An endpoint that opened again has another.
    pub(crate) fn remove(&mut self, at: EndpointRef, gid: &Arc<Mutex<Gid>>) {
        if self.endpoints.get(&at.id).is_some_and(|own| Arc::ptr_eq(&own.gid, gid)) {
            self.endpoints.remove(&at.id);
        }
    }

    /// Assigns endpoints to nodes, and declares those nodes and no others.
    pub(crate) fn announce(&mut self, nodes: &[GraphNode]) -> Result<(), String> {
        let mut wanted = BTreeSet::<NodeKey>::new();
        let mut assigned = BTreeMap::new();
        for GraphNode { node, readers, writers } in nodes {
            let place = wanted.range((node.clone(), 0)..).take_while(|(of, _)| of == node).count();
            let key = (node.clone(), place);
            wanted.insert(key.clone());
            assigned.extend(readers.iter().chain(writers).map(|guid| (*guid, key.clone())));
        }
        self.assigned = assigned;
        for key in &wanted {
            if !self.nodes.contains_key(key) {
                let id = self.number();
                self.nodes.insert(key.clone(), AnnouncedNode { id, token: None });
            }
        }
        self.move_endpoints()?;
        self.nodes.retain(|key, _| wanted.contains(key));
        for (key, announced) in &mut self.nodes {
            if announced.token.is_none() {
                let token = Token {
                    domain: self.domain,
                    session: self.id,
                    node_id: announced.id,
                    node: Some(key.0.clone()),
                    endpoint: None,
                };
                announced.token = Some(declare(&self.session, &token)?.0);
            }
        }
        Ok(())
    }

    /// Declares the tokens of endpoints anew that belong to another node than before.
    fn move_endpoints(&mut self) -> Result<(), String> {
        let moved: Vec<_> = self
            .endpoints
            .iter()
            .map(|(id, endpoint)| (*id, endpoint, self.node_of(*id)))
            .filter(|(_, endpoint, node)| endpoint.node != *node)
            .map(|(id, endpoint, node)| (id, endpoint.endpoint.clone(), node))
            .collect();
        for (id, endpoint, node) in moved {
            let (token, gid) = self.declare(node.as_ref(), &endpoint)?;
            if let Some(own) = self.endpoints.get_mut(&id) {
                *lock(&own.gid) = gid;
                own.node = node;
                own._token = token;
            }
        }
        Ok(())
    }

    fn declare(
        &self,
        node: Option<&NodeKey>,
        endpoint: &TokenEndpoint,
    ) -> Result<(LivelinessToken, Gid), String> {
        let announced = node.and_then(|key| Some((self.nodes.get(key)?.id, key.0.clone())));
        let (node_id, node) = announced.unwrap_or_else(|| self.unassigned.clone());
        let endpoint = Some(endpoint.clone());
        let token = Token { domain: self.domain, session: self.id, node_id, node: Some(node), endpoint };
        declare(&self.session, &token)
    }
}

/// Declares a token. Returns the id that an endpoint with this token has.
fn declare(session: &Session, token: &Token) -> Result<(LivelinessToken, Gid), String> {
    let text = token.encode().map_err(|error| error.to_string())?;
    let gid = Gid::of_token(&text);
    let token = session.liveliness().declare_token(text).wait().map_err(|error| error.to_string())?;
    Ok((token, gid))
}
