//! All DDS endpoints of a network, as somebody sees them who takes part in it.

use serde_json::Value;

use crate::lab::{Lab, Site};
use crate::python;
use crate::support::Peer;

/// A program that looks.
pub(crate) struct Observer(Peer);

impl Observer {
    pub(crate) fn start(lab: &Lab, site: Site) -> Self {
        let mut peer = python(lab, site, "observe.py", &[]);
        peer.wait("the observer", |e| e["event"] == "ready");
        Self(peer)
    }

    /// Kind and topic of each, in order; what belongs to every DDS network left out.
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
