//! `sgc run` at both sites and a router in the cloud, as users have it: a configuration and an identity each.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Result, ensure};
use serde_json::Value;
use sgc_testkit::netsim::Namespace;

use super::dds::{Programs, TOPICS};
use super::lab::{Lab, ROUTER};
use super::pair::{Pair, Plan, START_MAX, Start, ms};
use crate::compare::{Dds, Program, Side};
use crate::fleet::BenchFleet;
use crate::process::status;

const PORT: u16 = 7447;
/// How often a node is asked for its status while it starts.
const ASK_EVERY: Duration = Duration::from_millis(2);

/// Fields go in this order.
struct Sgc {
    programs: Programs,
    _nodes: Vec<Program>,
    socket: PathBuf,
    is_direct: bool,
}

/// Starts the router and both nodes, that of the left site last.
pub(super) fn start(lab: &Lab, sgc: &Path, is_direct: bool) -> Result<(Box<dyn Pair>, Start)> {
    let (dir, fleet) = (lab.new_dir("sgc")?, BenchFleet::new()?);
    let mut nodes = Vec::new();
    for node in ["router", Side::Right.name(), Side::Left.name()] {
        fleet.write(&dir, node, node == "router")?;
    }
    let router = format!("[router]\nlisten = [\"quic://0.0.0.0:{PORT}\"]\n");
    nodes.push(start_node(
        sgc,
        lab.cloud(),
        "router",
        &dir,
        &format!("[node]\n{}{router}", state("router")),
    )?);
    nodes.push(start_node(sgc, lab.site(Side::Right), "right", &dir, &proxy(Side::Right, is_direct))?);
    let mut programs = Programs::start(lab, &[Dds::loopback(), Dds::loopback()])?;
    let begun = Instant::now();
    nodes.push(start_node(sgc, lab.site(Side::Left), "left", &dir, &proxy(Side::Left, is_direct))?);
    let socket = dir.join("left.sock");
    let waits = std::thread::scope(|scope| {
        let first = scope.spawn(|| programs.wait_for_first().map(|()| ms(begun.elapsed())));
        let direct = if is_direct { watch(&socket, begun).map(Some) } else { Ok(None) };
        let first = first.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
        Ok::<_, anyhow::Error>((first?, direct?))
    });
    let (first_ms, direct) = waits?;
    let start = Start {
        first_ms: Some(first_ms),
        direct_ms: direct.map(|(_, direct)| ms(direct)),
        known_to_direct_ms: direct.map(|(granted, direct)| ms(direct - granted)),
    };
    Ok((Box::new(Sgc { programs, _nodes: nodes, socket, is_direct }), start))
}

/// Waits for the first grant of a node, to it or by it, and for a direct link. Returns when they were seen.
fn watch(socket: &Path, begun: Instant) -> Result<(Duration, Duration)> {
    let mut granted = None;
    loop {
        let status = status(socket)?;
        let now = begun.elapsed();
        if granted.is_none() && has_grant(&status) {
            granted = Some(now);
        }
        if has_direct_link(&status) {
            return Ok((granted.unwrap_or(now), now));
        }
        ensure!(now < START_MAX, "no direct link: {}", status["not_direct"]);
        std::thread::sleep(ASK_EVERY);
    }
}

/// Returns whether the node was granted a topic, or granted one.
fn has_grant(status: &Value) -> bool {
    let states =
        status["routes"].as_array().into_iter().flatten().filter_map(|route| route["state"].as_str());
    let mut states = states.map(|state| {
        state.starts_with("granted")
            || (state.contains("remote subscribers") && !state.contains(" 0 remote subscribers"))
    });
    states.any(|is_granted| is_granted)
}

fn has_direct_link(status: &Value) -> bool {
    status["links"].as_array().into_iter().flatten().any(|link| link["direct"] == true)
}

fn state(node: &str) -> String {
    format!("state = \"{node}.state\"\n")
}

/// The configuration of a site's node. Topics have the default suite.
fn proxy(side: Side, is_direct: bool) -> String {
    let (direct, other) = (if is_direct { "auto" } else { "never" }, side.other().name());
    let mut text = format!(
        "[node]\n{}routers = [\"quic://{ROUTER}:{PORT}\"]\ndirect = \"{direct}\"\n\
         [ros]\ndomain_id = 0\ndiscovery_range = \"localhost\"\nstatic_peers = []\n",
        state(side.name())
    );
    for (topic, towards) in TOPICS {
        text += &if towards == side {
            format!("[[use]]\nfrom = \"{other}\"\ntopic = \"{topic}\"\n")
        } else {
            format!("[[share]]\ntopic = \"{topic}\"\nto = [\"{other}\"]\n")
        };
    }
    text
}

fn start_node(sgc: &Path, place: &Namespace, node: &str, dir: &Path, text: &str) -> Result<Program> {
    let config = dir.join(format!("{node}.toml"));
    let admin =
        format!("identity = \"{node}.identity\"\n[admin]\nsocket = \"{node}.sock\"\n[audit]\noff = true\n");
    fs::write(&config, admin + text)?;
    let mut command: Command = place.command(sgc);
    command.args(["run", "--print-ready", "--until-stdin-closes", "--log", "warn", "--config"]);
    // Variables of a user's shell must not affect the measurement.
    for variable in ["CYCLONEDDS_URI", "ROS_LOCALHOST_ONLY", "ROS_STATIC_PEERS", "SGC_LOG"] {
        command.env_remove(variable);
    }
    command.arg(&config);
    let mut program = Program::start(node, command, dir)?;
    program.soon("ready")?;
    Ok(program)
}

impl Sgc {
    /// Measures, and makes sure that the path was the asked one all the time.
    fn on_its_path<T>(&mut self, measure: impl FnOnce(&mut Programs) -> Result<T>) -> Result<T> {
        let measured = measure(&mut self.programs)?;
        let status = status(&self.socket)?;
        ensure!(has_direct_link(&status) == self.is_direct, "the path changed: {}", status["links"]);
        Ok(measured)
    }
}

impl Pair for Sgc {
    fn round_trips(&mut self, size: usize, plan: &Plan) -> Result<Vec<f64>> {
        self.on_its_path(|programs| programs.round_trips(size, plan))
    }

    fn throughput(&mut self, plan: &Plan) -> Result<f64> {
        self.on_its_path(|programs| programs.throughput(plan))
    }
}
