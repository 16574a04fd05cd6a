//! `sgc run` at both places, as users have it: a configuration and an identity each.

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};

use super::rmw_zenoh::start_router;
use super::{Dds, Running, System, Topic};
use crate::compare::lab::{Lab, Side};
use crate::compare::networks::ZENOH_OVERRIDES;
use crate::compare::program::Program;
use crate::fleet::BenchFleet;

const SCHEMES: [&str; 4] = ["quic", "dtls", "tls", "tcp"];
const SUITES: [&str; 3] = ["group", "standard", "paper"];
const PORT: u16 = 7447;

/// Two nodes, and perhaps routers.
pub(crate) struct Sgc {
    program: PathBuf,
    scheme: &'static str,
    suite: &'static str,
    /// Processes between the two proxies, at the right place. Without one the right proxy listens.
    routers: usize,
    /// Topics whose `priority` is not the default one.
    priorities: &'static [(&'static str, &'static str)],
    /// The middleware of the left and of the right place, and the load program for Zenoh, if that is what is compared.
    middleware: Option<([Middleware; 2], PathBuf)>,
}

/// The middleware of a place's programs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Middleware {
    Dds,
    /// rmw_zenoh, with a router of its own.
    Zenoh,
}

impl Middleware {
    fn name(self) -> &'static str {
        match self {
            Self::Dds => "dds",
            Self::Zenoh => "zenoh",
        }
    }
}

/// Every transport with each of three suites, and the default transport with the default suite, and with a router
/// between.
pub(crate) fn all(program: &Path) -> Result<Vec<Sgc>> {
    let one = |scheme, suite, routers| Sgc::new(program, scheme, suite, routers);
    let pairs = SCHEMES.iter().flat_map(|scheme| SUITES.iter().map(move |suite| (scheme, suite)));
    let without = pairs.map(|(scheme, suite)| one(scheme, suite, 0));
    let more = [("pairwise", 0), ("group", 1), ("standard", 1)];
    without.chain(more.map(|(suite, routers)| one("quic", suite, routers))).collect()
}

impl Sgc {
    /// With so many routers in a row, each in a process of its own.
    pub(crate) fn new(
        program: &Path,
        scheme: &'static str,
        suite: &'static str,
        routers: usize,
    ) -> Result<Self> {
        let program = program.canonicalize();
        let program = program.with_context(|| "the program that is measured: is it built?")?;
        Ok(Self { program, scheme, suite, routers, priorities: &[], middleware: None })
    }

    /// Between places with these middlewares; named after them.
    pub(crate) fn between(self, middleware: [Middleware; 2], zenoh_load: &Path) -> Self {
        Self { middleware: Some((middleware, zenoh_load.to_owned())), ..self }
    }

    /// Returns the network of a place, and starts what that needs.
    fn network(&self, lab: &Lab, side: Side, running: &mut Running) -> Result<Dds> {
        let Some((_, load)) = self.middleware.as_ref().filter(|_| self.is_on_zenoh(side)) else {
            return Ok(lab.networks.local(side));
        };
        let load = load.canonicalize().with_context(|| format!("{}: is it built?", load.display()))?;
        running.processes.push((side, start_router(lab, side, &load, "")?));
        Ok(Dds::zenoh(load))
    }

    fn is_on_zenoh(&self, side: Side) -> bool {
        self.middleware.as_ref().is_some_and(|(both, _)| both[side as usize] == Middleware::Zenoh)
    }

    /// With priorities for some topics, instead of the default one.
    pub(crate) fn with_priorities(self, priorities: &'static [(&'static str, &'static str)]) -> Self {
        Self { priorities, ..self }
    }

    fn start_node(&self, lab: &Lab, side: Side, node: &str, dir: &Path, text: &str) -> Result<Program> {
        let config = dir.join(format!("{node}.toml"));
        let text = format!(
            "identity = \"{node}.identity\"\n[admin]\nsocket = \"{node}.sock\"\n\
             [audit]\noff = true\n{text}"
        );
        fs::write(&config, text)?;
        let mut command = lab.command(side, &self.program);
        command.args(["run", "--print-ready", "--until-stdin-closes", "--log", "warn", "--config"]);
        // Variables of a user's shell must not affect the measurement.
        for variable in
            ["CYCLONEDDS_URI", "ROS_LOCALHOST_ONLY", "ROS_STATIC_PEERS", "SGC_LOG", ZENOH_OVERRIDES]
        {
            command.env_remove(variable);
        }
        let mut program = Program::start(
            node,
            {
                command.arg(&config);
                command
            },
            dir,
        )?;
        program.soon("ready")?;
        Ok(program)
    }

    fn url(&self, host: impl std::fmt::Display, number: usize) -> String {
        format!("\"{}://{host}:{}\"", self.scheme, PORT as usize + number)
    }
}

impl Sgc {
    /// Several nodes at the right place, each with a local network of its own and a link to the node at the left, which
    /// shares the topic with all of them. Also how users join those networks.
    pub(crate) fn start_fan(&self, lab: &Lab, topic: &str, nodes: u32) -> Result<(Running, Vec<Dds>)> {
        let dir = lab.new_dir("fan")?;
        let fleet = BenchFleet::new()?;
        let mut running = Running { processes: Vec::new(), dds: Side::BOTH.map(|_| Dds::loopback()) };
        let mut networks = Vec::new();
        let listen = self.url("0.0.0.0", 0);
        let dials = self.url(lab.address(Side::Left), 0);
        fleet.write(&dir, "left", false)?;
        let text = format!(
            "[node]\nstate = \"left.state\"\n[router]\nlisten = [{listen}]\n{}\
             [[share]]\ntopic = \"{topic}\"\nto = [\"*\"]\nsuite = \"{}\"\n",
            ros(&Dds::loopback()),
            self.suite
        );
        running.processes.push((Side::Left, self.start_node(lab, Side::Left, "left", &dir, &text)?));
        for domain in 0..nodes {
            let dds = Dds { domain, ..Dds::loopback() };
            let node = format!("right-{domain}");
            fleet.write(&dir, &node, false)?;
            let text = format!(
                "[node]\nstate = \"{node}.state\"\nrouters = [{dials}]\n{}\
                 [[use]]\nfrom = \"left\"\ntopic = \"{topic}\"\n",
                ros(&dds)
            );
            running.processes.push((Side::Right, self.start_node(lab, Side::Right, &node, &dir, &text)?));
            networks.push(dds);
        }
        Ok((running, networks))
    }
}

/// The local network of a place.
fn ros(dds: &Dds) -> String {
    let range = if dds.uri.is_some() { "localhost" } else { "subnet" };
    format!("[ros]\ndomain_id = {}\ndiscovery_range = \"{range}\"\nstatic_peers = []\n", dds.domain)
}

impl System for Sgc {
    fn name(&self) -> String {
        if let Some(([left, right], _)) = &self.middleware {
            return format!("sgc-{}-{}", left.name(), right.name());
        }
        let router = match self.routers {
            0 => String::new(),
            1 => "-router".into(),
            many => format!("-{many}-routers"),
        };
        format!("sgc-{}-{}{router}", self.scheme, self.suite)
    }

    fn start(&self, lab: &Lab, topics: &[Topic]) -> Result<Running> {
        let dir = lab.new_dir(&self.name())?;
        let fleet = BenchFleet::new()?;
        let dds = Side::BOTH.map(|side| lab.networks.local(side));
        let mut running = Running { processes: Vec::new(), dds };
        for side in Side::BOTH {
            running.dds[side as usize] = self.network(lab, side, &mut running)?;
        }
        // Numbered from the right; each dials the one before.
        for number in 0..self.routers {
            let node = format!("router-{number}");
            fleet.write(&dir, &node, true)?;
            let listen = self.url("0.0.0.0", number);
            let dials = match number.checked_sub(1) {
                Some(before) => self.url("127.0.0.1", before),
                None => String::new(),
            };
            let text = format!(
                "[node]\nstate = \"{node}.state\"\nrouters = [{dials}]\n[router]\nlisten = [{listen}]\n"
            );
            let program = self.start_node(lab, Side::Right, &node, &dir, &text)?;
            running.processes.push((Side::Right, program));
        }
        for side in [Side::Right, Side::Left] {
            let node = side.name();
            let listens = side == Side::Right && self.routers == 0;
            fleet.write(&dir, node, false)?;
            let dials = match (side, self.routers) {
                (Side::Right, 0) => String::new(),
                (Side::Right, _) => self.url("127.0.0.1", 0),
                (Side::Left, routers) => self.url(lab.address(Side::Right), routers.saturating_sub(1)),
            };
            let mut text = format!("[node]\nstate = \"{node}.state\"\nrouters = [{dials}]\n");
            text += &match self.is_on_zenoh(side) {
                true => "[ros]\nmiddleware = \"zenoh\"\ndomain_id = 0\n".to_owned(),
                false => ros(&running.dds[side as usize]),
            };
            if listens {
                writeln!(text, "[router]\nlisten = [{}]", self.url("0.0.0.0", 0))?;
            }
            for topic in topics {
                let (name, other) = (topic.name, side.other().name());
                if topic.towards == side {
                    writeln!(text, "[[use]]\nfrom = \"{other}\"\ntopic = \"{name}\"")?;
                } else {
                    let suite = self.suite;
                    writeln!(text, "[[share]]\ntopic = \"{name}\"\nto = [\"{other}\"]\nsuite = \"{suite}\"")?;
                    if let Some((_, priority)) = self.priorities.iter().find(|(topic, _)| *topic == name) {
                        writeln!(text, "priority = \"{priority}\"")?;
                    }
                }
            }
            let program = self.start_node(lab, side, node, &dir, &text)?;
            running.processes.push((side, program));
        }
        Ok(running)
    }
}
