//! Zenoh: a session in router mode, which is what `zenohd` is without its plugins, and two clients. TCP in the clear.

use std::sync::Arc;

use anyhow::{Result, anyhow};
use bytes::Bytes;
use zenoh::qos::CongestionControl;
use zenoh::{Config, Session, Wait};

use super::{Arrivals, Sender, Way};
use crate::process::{Server, until_stdin_closes};

const NAME: &str = super::ZENOH;
const KEY: &str = "bench/load";

/// Through the router.
pub(super) fn routed() -> Result<Way> {
    let router = Server::own("serve-zenoh")?;
    let receiver = open("client", None, Some(&router.greeting))?;
    let sender = open("client", None, Some(&router.greeting))?;
    Ok(Way { router: Some(router), ..between(NAME, sender, receiver)? })
}

/// Two peers with a link between them.
pub(super) fn direct() -> Result<Way> {
    let address = free_address()?;
    let receiver = open("peer", Some(&address), None)?;
    let sender = open("peer", None, Some(&address))?;
    between("zenoh, direct", sender, receiver)
}

/// The router.
pub(crate) fn serve() -> Result<()> {
    let address = free_address()?;
    let session = open("router", Some(&address), None)?;
    println!("{address}");
    until_stdin_closes();
    session.close().wait().map_err(failure)
}

fn between(name: &'static str, sender: Session, receiver: Session) -> Result<Way> {
    let arrivals = Arc::<Arrivals>::default();
    let heard = arrivals.clone();
    let subscriber = receiver
        .declare_subscriber(KEY)
        .callback(move |sample| heard.take(&sample.payload().to_bytes()))
        .wait()
        .map_err(failure)?;
    // Waits instead of dropping, as the other ways do.
    let publisher = sender.declare_publisher(KEY).congestion_control(CongestionControl::Block);
    let publisher = Box::new(ZenohSender(publisher.wait().map_err(failure)?));
    Ok(Way {
        name,
        sender: publisher,
        arrivals,
        router: None,
        _rest: Box::new((subscriber, sender, receiver)),
    })
}

struct ZenohSender(zenoh::pubsub::Publisher<'static>);

impl Sender for ZenohSender {
    fn send(&mut self, payloads: &[Bytes]) -> Result<()> {
        payloads.iter().try_for_each(|p| self.0.put(p.clone()).wait().map_err(failure))
    }
}

/// A session that knows nobody but whom it is told of.
fn open(mode: &str, listen: Option<&str>, connect: Option<&str>) -> Result<Session> {
    let list = |address: Option<&str>| serde_json::to_string(&Vec::from_iter(address));
    let mut config = Config::default();
    for (key, value) in [
        ("mode", format!("{mode:?}")),
        ("listen/endpoints", list(listen)?),
        ("connect/endpoints", list(connect)?),
        ("scouting/multicast/enabled", "false".into()),
        ("scouting/gossip/enabled", "false".into()),
    ] {
        config.insert_json5(key, &value).map_err(failure)?;
    }
    zenoh::open(config).wait().map_err(failure)
}

fn free_address() -> Result<String> {
    let listener = std::net::TcpListener::bind("127.0.0.1:0")?;
    Ok(format!("tcp/{}", listener.local_addr()?))
}

/// Its errors do not convert into ours.
fn failure(error: zenoh::Error) -> anyhow::Error {
    anyhow!("zenoh: {error}")
}
