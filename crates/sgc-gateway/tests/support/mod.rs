//! A hub on a network in memory, and a program beside it.

#![allow(dead_code, reason = "each test program uses a part")]

use std::sync::{Arc, mpsc};
use std::time::Duration;

use bytes::Bytes;
use sgc_gateway::{Client, Hub, HubOptions, Scope, Session, SessionLimits, ShippedDefinitions, Types};
use sgc_ros::{EndpointSpec, RosNetwork, Sample, dds_topic, dds_type};
use sgc_testkit::{FakeDomain, FakeReader, FakeRos, FakeWriter};
use sgc_wire::Qos;

pub(crate) const STRING: &str = "std_msgs/msg/String";
const PATIENCE: Duration = Duration::from_secs(10);

/// A network with a hub on it.
pub(crate) struct Site {
    pub(crate) hub: Hub,
    /// The participant of another program.
    pub(crate) ros: FakeRos,
    pub(crate) domain: FakeDomain,
}

impl Site {
    pub(crate) async fn new() -> Self {
        Self::with_types(Types::new(ShippedDefinitions)).await
    }

    /// Creates a site whose gateway knows these types.
    pub(crate) async fn with_types(types: Types) -> Self {
        let domain = FakeDomain::default();
        let own = Arc::new(domain.join(false));
        let hub = Hub::start(own, types, HubOptions::default()).await.unwrap();
        Self { hub, ros: domain.join(false), domain }
    }

    pub(crate) fn session(&self, name: &str) -> Session {
        self.session_with(name, Scope::everything())
    }

    pub(crate) fn session_with(&self, name: &str, scope: Scope) -> Session {
        let client = Client::own(name).with_scope(scope);
        Session::new(&self.hub, client, SessionLimits::default())
    }

    /// Creates a program's writer of texts.
    pub(crate) fn writer(&self, topic: &str, qos: Qos) -> FakeWriter {
        self.ros.create_writer(&spec(topic, STRING, qos)).unwrap()
    }

    /// Creates a program's reader of texts.
    pub(crate) fn reader(&self, topic: &str) -> (mpsc::Receiver<Bytes>, FakeReader) {
        let (send, received) = mpsc::channel();
        let handler = Box::new(move |sample: Sample| drop(send.send(sample.payload)));
        let reader = self.ros.create_reader(&spec(topic, STRING, Qos::default()), handler).unwrap();
        (received, reader)
    }

    /// Waits until the hub knows a publisher of the topic.
    pub(crate) async fn knows(&self, topic: &str) {
        eventually(|| self.hub.graph().topics.get(topic).is_some_and(|info| !info.publishers.is_empty()))
            .await;
    }
}

pub(crate) fn spec(topic: &str, type_name: &str, qos: Qos) -> EndpointSpec {
    EndpointSpec {
        topic: dds_topic(topic),
        type_name: dds_type(type_name),
        keyless: true,
        asks_key_hash: false,
        type_hash: None,
        qos,
    }
}

/// Returns a serialised `std_msgs/msg/String`.
pub(crate) fn string(text: &str) -> Bytes {
    let mut payload = vec![0, 1, 0, 0];
    payload.extend((text.len() as u32 + 1).to_le_bytes());
    payload.extend(text.as_bytes());
    payload.push(0);
    payload.into()
}

/// Waits until a condition holds.
pub(crate) async fn eventually(mut is_so: impl FnMut() -> bool) {
    let looked = async {
        while !is_so() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    tokio::time::timeout(PATIENCE, looked).await.expect("it should have become so by now");
}
