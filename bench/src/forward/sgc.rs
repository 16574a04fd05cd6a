//! SGC: a robot and a desk with local networks in memory, and the router of the program under test.

use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, Result};
use bytes::Bytes;
use sgc_node::config::Config;
use sgc_testkit::FakeDomain;
use sgc_trust::Suite;
use sgc_wire::{History, Qos};

use super::{Arrivals, Sender, Way};
use crate::fleet::BenchFleet;
use crate::node::{Listener, Node, Talker, config, share, usage};
use crate::process::SgcRouter;

const TOPIC: &str = "/load";

/// Through `sgc run` as a router.
pub(super) fn routed(sgc: &Path, suite: Suite) -> Result<Way> {
    let (fleet, dir) = (BenchFleet::new()?, tempfile::tempdir()?);
    fleet.write_router(dir.path())?;
    let router = SgcRouter::start(sgc, dir.path())?;
    let desk = config(dir.path(), "desk", &[&router.url])?;
    let robot = config(dir.path(), "robot", &[&router.url])?;
    let name = match suite {
        Suite::Group => "sgc `group`",
        _ => "sgc `standard`",
    };
    let way = between(name, &fleet, suite, dir, robot, |_| Ok(desk))?;
    Ok(Way { router: Some(router.process), ..way })
}

/// The robot dials the desk.
pub(super) fn direct(suite: Suite) -> Result<Way> {
    let (fleet, dir) = (BenchFleet::new()?, tempfile::tempdir()?);
    let mut desk = config(dir.path(), "desk", &[])?;
    desk.listen = vec![format!("quic://127.0.0.1:{}", free_port()?).parse()?];
    let url = desk.listen[0].to_string();
    let robot = config(dir.path(), "robot", &[&url])?;
    between("sgc, direct", &fleet, suite, dir, robot, |_| Ok(desk))
}

fn free_port() -> Result<u16> {
    Ok(std::net::UdpSocket::bind("127.0.0.1:0")?.local_addr()?.port())
}

fn between(
    name: &'static str,
    fleet: &BenchFleet,
    suite: Suite,
    dir: tempfile::TempDir,
    mut robot: Config,
    desk: impl FnOnce(&Path) -> Result<Config>,
) -> Result<Way> {
    let (near, far) = (FakeDomain::default(), FakeDomain::default());
    let mut desk = desk(dir.path())?;
    desk.uses = vec![usage(TOPIC, "robot")?];
    robot.shares = vec![share(TOPIC, "desk", suite)?];
    let desk = Node::start(desk, fleet.issue("desk", false)?, &far).context("desk")?;
    let robot = Node::start(robot, fleet.issue("robot", false)?, &near).context("robot")?;
    let qos = Qos { history: History::KeepAll, ..Qos::default() };
    let arrivals = Arc::<Arrivals>::default();
    let heard = arrivals.clone();
    let listener = Listener::new(&far, TOPIC, qos.clone(), move |payload| heard.take(payload))?;
    let sender = Box::new(Talker::new(&near, TOPIC, qos)?);
    Ok(Way { name, sender, arrivals, router: None, _rest: Box::new((listener, robot, desk, dir)) })
}

impl Sender for Talker {
    fn send(&mut self, payloads: &[Bytes]) -> Result<()> {
        self.say_all(payloads);
        Ok(())
    }
}
