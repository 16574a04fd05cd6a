//! [`Networks`]: a lab whose robot and desk each have programs on DDS or on Zenoh, with the programs of both by one set of
//! names and options.

use std::ops::{Deref, DerefMut};
use std::process::Command;
use std::time::Instant;

use rustix::process::Signal;
use serde_json::Value;

use crate::PLAN;
use crate::lab::{Lab, Site};
use crate::support::{self, PATIENCE, Peer, say};

/// The sites with programs.
pub(crate) const ENDS: [Site; 2] = [Site::Robot, Site::Desk];
/// The line of a configuration in whose place `middleware` stands.
const DISCOVERY: &str = "discovery_range = \"localhost\"\nstatic_peers = []\n";
/// The router of rmw_zenoh on its host.
pub(crate) const ROUTER: &str = "tcp/127.0.0.1:7447";

/// The nodes of the programs with topics, in the order of their names.
pub(crate) const NODES: [&str; 2] = ["listener", "talker"];

/// The middleware of the programs at a site.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum Middleware {
    /// Fast DDS, with the client library of this distribution.
    Dds(&'static str),
    Zenoh,
}

use Middleware::{Dds, Zenoh};

/// An endpoint of a topic, as a program sees it.
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Debug)]
pub(crate) struct End {
    pub(crate) kind: &'static str,
    /// The name of the node, without its namespace.
    pub(crate) node: String,
    pub(crate) type_name: String,
    pub(crate) type_hash: String,
}

/// A lab, and a router on each Zenoh network.
pub(crate) struct Networks {
    lab: Lab,
    pub(crate) on: [Middleware; 2],
    pub(crate) routers: [Option<Peer>; 2],
}

impl Deref for Networks {
    type Target = Lab;

    fn deref(&self) -> &Lab {
        &self.lab
    }
}

impl DerefMut for Networks {
    fn deref_mut(&mut self) -> &mut Lab {
        &mut self.lab
    }
}

impl Networks {
    /// Starts routers and nodes; those of robot and desk with these tables. Returns `None` if networks are not separate,
    /// because two routers have one port.
    pub(crate) fn start(on: [Middleware; 2], tables: [String; 2]) -> Option<Self> {
        let mut networks = Self::silent(on, tables)?;
        networks.start_routers();
        networks.start_all();
        Some(networks)
    }

    /// The same before routers and nodes are started.
    pub(crate) fn silent(on: [Middleware; 2], tables: [String; 2]) -> Option<Self> {
        let lab = Lab::silent(PLAN, tables);
        if lab.namespace(Site::Robot).is_none() {
            say("two routers of rmw_zenoh need two networks: nothing is shown");
            return None;
        }
        let networks = Self { lab, on, routers: [None, None] };
        for site in ENDS {
            let middleware = match networks.at(site) {
                Dds(_) => "discovery_range = \"subnet\"\n",
                Zenoh => "middleware = \"zenoh\"\n",
            };
            networks.reconfigure(site, DISCOVERY, middleware);
        }
        Some(networks)
    }

    /// Returns the middleware at a site.
    pub(crate) fn at(&self, site: Site) -> Middleware {
        self.on[place(site)]
    }

    /// Starts the router of each Zenoh network.
    pub(crate) fn start_routers(&mut self) {
        let on_zenoh = ENDS.into_iter().filter(|site| self.on[place(*site)] == Zenoh).collect::<Vec<_>>();
        on_zenoh.into_iter().for_each(|site| self.start_router(site));
    }

    /// Starts the router of a site.
    pub(crate) fn start_router(&mut self, site: Site) {
        let listen = ["--listen", ROUTER];
        self.routers[place(site)] = Some(self.router(site, &listen));
    }

    /// Returns a router with these options, which listens.
    pub(crate) fn router(&self, site: Site, args: &[&str]) -> Peer {
        let mut command = self.zenoh_command(site);
        command.arg("router").args(["--timeout", "600"]).args(args);
        let mut router = Peer::start(command);
        router.wait("the router", |event| event["event"] == "ready");
        router
    }

    fn zenoh_command(&self, site: Site) -> Command {
        support::command(self.namespace(site), self.dir(), &Peer::program("zenoh"))
    }

    /// A role of the Zenoh peer at a site.
    pub(crate) fn zenoh(&self, site: Site, role: &str, args: &[&str]) -> Peer {
        self.stock_peer(site, "zenoh", role, &[&["--timeout", PLAN.peer_life], args].concat())
    }

    /// A publisher, or a subscriber, of `std_msgs/msg/UInt8MultiArray` at a site, on its middleware.
    pub(crate) fn load_on(&self, site: Site, role: &str, node: &str, args: &[&str]) -> Peer {
        let life = ["--timeout", PLAN.peer_life];
        match self.at(site) {
            Dds(distribution) => {
                self.load(site, distribution, &[&[role, "--node", node], &life[..], args].concat())
            }
            Zenoh => {
                // The publisher says how long a message is.
                let args: Vec<_> =
                    args.iter().map(|arg| if *arg == "--size" { "--bytes" } else { arg }).collect();
                let bytes = if args.contains(&"--bytes") { &[][..] } else { &["--bytes", "1000"] };
                self.zenoh(site, role, &[&["--node", &format!("/{node}")], bytes, &args[..]].concat())
            }
        }
    }

    /// Returns the signal that ends a program of a site such that others notice at once: SIGKILL on Zenoh. On DDS others
    /// would wait for the end of its lease, 20 seconds.
    pub(crate) fn sudden_end(&self, site: Site) -> Signal {
        if self.at(site) == Zenoh { Signal::KILL } else { Signal::TERM }
    }

    /// Ends a program of a site by that signal.
    pub(crate) fn end_on(&self, site: Site, mut program: Peer) {
        if self.at(site) != Zenoh {
            program.end();
            program.summary();
        }
    }

    /// Waits until a program at a site sees just these endpoints of a topic, and of the nodes in [`NODES`] just theirs.
    pub(crate) fn assert_ends(&self, site: Site, topic: &str, mut expected: Vec<End>) {
        expected.sort();
        let is_expected = |node: &&str| expected.iter().any(|end| end.node == **node);
        let nodes: Vec<_> = NODES.into_iter().filter(is_expected).map(|node| format!("/{node}")).collect();
        let what = format!("{topic} at the {}, {:?}", site.name(), self.on);
        match self.at(site) {
            Dds(distribution) => {
                let counts = ["publisher", "subscription"]
                    .map(|kind| expected.iter().filter(|end| end.kind == kind).count().to_string());
                let counts = ["--publishers", &counts[0], "--subscribers", &counts[1], "--exactly"];
                let args = [&["--topic", topic, "--timeout", "40"], &counts[..]].concat();
                // The program waits for endpoints. The end of their node may come a moment later.
                let until = Instant::now() + PATIENCE;
                loop {
                    let summary = self.rclpy(site, distribution, "graph.py", &args).summary();
                    assert_eq!(ends_on_dds(&summary), expected, "{what}");
                    let found = nodes_in(&summary);
                    if found == nodes {
                        return;
                    }
                    assert!(Instant::now() < until, "{what}: {found:?} instead of {nodes:?}");
                }
            }
            Zenoh => {
                let graph = self.zenoh(site, "graph", &["--hidden"]);
                let expected = (expected, nodes);
                let mut found = Default::default();
                // An endpoint is shown before its node is known.
                while found != expected {
                    let Ok((_, event)) = graph.events.recv_timeout(PATIENCE) else {
                        panic!("{what}: {found:?} instead of {expected:?}");
                    };
                    if event["event"] == "graph" {
                        found = (ends_on_zenoh(&event, topic), nodes_in(&event));
                    }
                }
            }
        }
    }
}

fn place(site: Site) -> usize {
    ENDS.iter().position(|end| *end == site).unwrap()
}

/// Returns those of the nodes in [`NODES`] that a report names, in its order.
fn nodes_in(report: &Value) -> Vec<String> {
    let all = report["nodes"].as_array().unwrap().iter().map(|node| node.as_str().unwrap());
    all.filter(|node| NODES.contains(&node.trim_start_matches('/'))).map(str::to_owned).collect()
}

/// Returns the endpoints in a summary of `ros2/graph.py`.
fn ends_on_dds(summary: &Value) -> Vec<End> {
    let of = |key: &str, kind| {
        let text = |end: &Value, key: &str| end[key].as_str().unwrap().to_owned();
        let end = |end: &Value| End {
            kind,
            node: text(end, "node"),
            type_name: text(end, "type"),
            type_hash: text(end, "hash"),
        };
        summary[key].as_array().unwrap().iter().map(end).collect::<Vec<_>>()
    };
    sorted([of("publishers", "publisher"), of("subscribers", "subscription")].concat())
}

/// Returns the endpoints of a topic in a report of the role `graph`.
fn ends_on_zenoh(event: &Value, topic: &str) -> Vec<End> {
    let all = event["endpoints"].as_array().into_iter().flatten();
    let text = |end: &Value, key: &str| end[key].as_str().unwrap().to_owned();
    let end = |end: &Value| End {
        kind: if end["kind"] == "publisher" { "publisher" } else { "subscription" },
        node: text(end, "node").rsplit('/').next().unwrap().to_owned(),
        type_name: ros_type(&text(end, "type")),
        type_hash: text(end, "hash"),
    };
    sorted(all.filter(|end| end["topic"] == topic).map(end).collect())
}

fn sorted(mut ends: Vec<End>) -> Vec<End> {
    ends.sort();
    ends
}

/// Returns the ROS name of a type: `a/msg/B` for `a::msg::dds_::B_`.
fn ros_type(dds: &str) -> String {
    dds.replace("::dds_::", "::").trim_end_matches('_').replace("::", "/")
}
