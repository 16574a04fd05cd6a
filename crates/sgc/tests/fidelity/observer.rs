//! Lists all DDS endpoints of a network, as a participant of it sees them.

use serde_json::Value;

use crate::lab::{Lab, Site};
use crate::python;
use crate::support::Peer;

/// A program that observes the network.
pub(crate) struct Observer(Peer);

impl Observer {
    pub(crate) fn start(lab: &Lab, site: Site) -> Self {
        let mut peer = python(lab, site, "observe.py", &[]);
        peer.wait("the observer", |e| e["event"] == "ready");
        Self(peer)
    }

    /// Returns kind and topic of each endpoint, sorted, without those of DDS itself.
    pub(crate) fn endpoints(&mut self) -> Vec<String> {
        self.0.go();
        let seen = self.0.wait("the endpoints", |e| e["event"] == "endpoints");
        let all = seen["endpoints"].as_array().unwrap();
        let text = |e: &Value| format!("{} {}", e["kind"].as_str().unwrap(), e["topic"].as_str().unwrap());
        let mut list: Vec<_> = all.iter().map(text).filter(|t| !t.contains("ros_discovery_info")).collect();
        list.sort();
        list
    }
}
