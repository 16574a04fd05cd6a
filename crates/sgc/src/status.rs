//! `sgc status`: asks a running node for its status and prints it.
//!
//! `sgc-node` makes the document. This file reads the fields that it needs and ignores unknown ones, so it understands older
//! and newer nodes.

use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::time::Duration;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use clap::Args;
use serde::Deserialize;
use sgc_node::SocketError;
use sgc_node::admin::AdminRequest;
use sgc_node::alerts::Alert;
use sgc_node::config::{self, Config};

use crate::error::CliError;
use crate::topic::NodeArgs;
use crate::why::refusals;
use crate::{files, output, run};

/// Longest time a node may take to answer.
const ANSWER_MAX: Duration = Duration::from_secs(5);
/// Largest answer that is read.
const STATUS_BYTES_MAX: u64 = 64 * 1024 * 1024;
const SOCKET_EXTENSION: &str = "sock";

/// Show the status of a running node: links, shares and uses, names, drops.
#[derive(Debug, Args)]
pub(crate) struct StatusArgs {
    #[command(flatten)]
    node: NodeArgs,
    /// Print the node's JSON document unchanged
    #[arg(long)]
    json: bool,
}

/// A node's status.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub(crate) struct Status {
    node: String,
    version: String,
    uptime_s: u64,
    pub(crate) links: Vec<Link>,
    pub(crate) routers: Vec<Router>,
    pub(crate) routes: Vec<Route>,
    pub(crate) alerts: Vec<Alert>,
    problems: Vec<String>,
    names: Vec<NameTraffic>,
    pub(crate) drops: BTreeMap<String, u64>,
    pub(crate) refused: BTreeMap<String, u64>,
    local_network_reopened: u64,
    router: RouterSize,
    gateway: Option<Gateway>,
}

/// A node's answer that reports an error.
#[derive(Debug, Deserialize)]
struct ErrorAnswer {
    error: String,
}

/// The gateway of a node.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct Gateway {
    listen: Vec<String>,
    clients: Vec<GatewayClient>,
    refused: BTreeMap<String, u64>,
    readers: usize,
}

/// A client of a gateway.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct GatewayClient {
    name: String,
    protocol: String,
    address: String,
    /// Time of the connection, in milliseconds since the Unix epoch.
    since: u64,
}

/// A link of a node.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub(crate) struct Link {
    pub(crate) peer: String,
    pub(crate) remote: String,
    url: Option<String>,
    pub(crate) rtt_us: u64,
    cost: u32,
    pub(crate) silent: bool,
    sent_bytes: u64,
    received_bytes: u64,
    peer_slowed: u64,
    peer_dropped: u64,
}

/// A router that a node dials or searches.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub(crate) struct Router {
    pub(crate) router: String,
    found_by: String,
    at: Option<String>,
    state: String,
    why_not_first: Option<String>,
    pub(crate) failures: u32,
    pub(crate) last_failure: Option<String>,
    again_in_s: Option<u64>,
}

/// A share or use of a node.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub(crate) struct Route {
    pub(crate) direction: String,
    pub(crate) topic: String,
    #[serde(rename = "type")]
    type_name: Option<String>,
    pub(crate) name: Option<String>,
    owner: String,
    pub(crate) state: String,
    messages: u64,
    /// Bytes before and after compression.
    compressed: Option<(u64, u64)>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct NameTraffic {
    name: String,
    packets: u64,
    bytes: u64,
    dropped: u64,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct RouterSize {
    nodes: usize,
    names: u64,
    routed_names: u64,
    branches: u64,
}

/// Runs `sgc status`.
pub(crate) fn status(args: &StatusArgs) -> Result<(), CliError> {
    let socket = args.node.socket()?;
    let text = ask(&socket, &AdminRequest::Status, ANSWER_MAX)?;
    let status = parse(&socket, &text)?;
    if args.json {
        return output::line(text.trim_end());
    }
    for line in status.lines() {
        output::line(line)?;
    }
    Ok(())
}

/// Asks the node at a socket for its status, for programs that show it in another way.
pub(crate) fn query_node(socket: &Path) -> Result<Status, CliError> {
    parse(socket, &ask(socket, &AdminRequest::Status, ANSWER_MAX)?)
}

/// Returns the named socket, the socket of the configuration, or the only socket of this user.
pub(crate) fn socket(config: Option<&Path>, socket: Option<&Path>) -> Result<PathBuf, CliError> {
    if let Some(socket) = socket {
        return Ok(socket.to_owned());
    }
    let Some(path) = config else { return only_socket() };
    let config = config::load(path, &run::environment)
        .map_err(|errors| CliError::Config { what: path.display().to_string(), errors })?;
    Ok(sgc_node::admin_socket_path(&config, &node_name(&config)?))
}

/// Returns the name of the node that has this configuration.
pub(crate) fn node_name(config: &Config) -> Result<String, CliError> {
    match &config.node_name {
        Some(name) => Ok(name.to_string()),
        None => Ok(sgc_node::load_identity(&config.identity)?.node_name().to_string()),
    }
}

/// Returns the sockets of this user's nodes in their usual place, whether a node answers there or not.
pub(crate) fn usual_sockets() -> Vec<PathBuf> {
    let usual = sgc_node::default_socket_path("node");
    let dir = usual.parent().unwrap_or(Path::new("/"));
    files::with_extension(dir, SOCKET_EXTENSION).unwrap_or_default()
}

/// Returns the socket of the only node that this user runs with a default socket.
fn only_socket() -> Result<PathBuf, CliError> {
    let mut found = usual_sockets();
    match found.len() {
        0 => {
            let usual = sgc_node::default_socket_path("node");
            Err(CliError::NoNodeHere { dir: usual.parent().unwrap_or(Path::new("/")).to_owned() })
        }
        1 => Ok(found.swap_remove(0)),
        _ => {
            let name = |socket: &PathBuf| Some(socket.file_stem()?.to_string_lossy().into_owned());
            Err(CliError::SeveralNodes { nodes: found.iter().filter_map(name).collect() })
        }
    }
}

/// Pushes a revocation list to every node that this user runs here. Returns the names of those that took it, and their lists.
/// Nodes of other fleets do not take it.
pub(crate) fn push_crl_local(list: &[u8]) -> (Vec<String>, Vec<bytes::Bytes>) {
    let request = AdminRequest::Crl(list.to_vec());
    let mut heard = Vec::new();
    let mut took = |socket: &PathBuf| {
        let answer = ask(socket, &request, ANSWER_MAX).ok()?;
        let answer: serde_json::Value = serde_json::from_str(&answer).ok()?;
        // A node of an earlier version does not report its lists.
        let lists = answer.get("ok")?.get("lists").and_then(serde_json::Value::as_array);
        let lists = lists.into_iter().flatten().filter_map(serde_json::Value::as_str);
        heard.extend(lists.filter_map(|text| STANDARD.decode(text).ok()).map(bytes::Bytes::from));
        Some(socket.file_stem()?.to_string_lossy().into_owned())
    };
    let names = usual_sockets().iter().filter_map(&mut took).collect();
    (names, heard)
}

/// Explains why no node answers at this socket.
pub(crate) fn no_node(socket: &Path, error: &std::io::Error, patience: Duration) -> CliError {
    CliError::NoNode {
        path: socket.to_owned(),
        reason: match error.kind() {
            std::io::ErrorKind::NotFound => "there is no such socket".to_owned(),
            std::io::ErrorKind::ConnectionRefused => "its socket is left over".to_owned(),
            std::io::ErrorKind::WouldBlock => format!("it did not answer within {} s", patience.as_secs()),
            _ => error.to_string(),
        },
    }
}

/// Connects to the node at a status socket, if it is this user's or root's.
pub(crate) fn connect(socket: &Path, patience: Duration) -> Result<UnixStream, CliError> {
    sgc_node::admin::connect(socket).map_err(|error| match error {
        SocketError::Io(error) => no_node(socket, &error, patience),
        untrusted => CliError::NoNode { path: socket.to_owned(), reason: untrusted.to_string() },
    })
}

/// Asks a node and returns its raw answer.
pub(crate) fn ask(socket: &Path, request: &AdminRequest, patience: Duration) -> Result<String, CliError> {
    let no_node = |error: std::io::Error| no_node(socket, &error, patience);
    let mut stream = connect(socket, patience)?;
    stream.set_read_timeout(Some(patience)).map_err(no_node)?;
    stream.set_write_timeout(Some(patience)).map_err(no_node)?;
    // A node of an earlier version answers without reading.
    let _ = stream.write_all(request.to_line().as_bytes());
    let mut text = String::new();
    stream.take(STATUS_BYTES_MAX).read_to_string(&mut text).map_err(no_node)?;
    Ok(text)
}

fn parse(socket: &Path, text: &str) -> Result<Status, CliError> {
    if let Ok(ErrorAnswer { error }) = serde_json::from_str(text) {
        return Err(CliError::NotSeen { reason: error });
    }
    serde_json::from_str(text)
        .map_err(|e| CliError::NotAStatus { path: socket.to_owned(), reason: e.to_string() })
}

impl Status {
    fn lines(&self) -> Vec<String> {
        let mut lines =
            vec![format!("{}: sgc {}, up for {}", self.node, self.version, duration(self.uptime_s))];
        let mut section = |title: &str, head: &[&str], rows: Vec<Vec<String>>| {
            lines.push(String::new());
            if rows.is_empty() {
                lines.push(format!("{title}: none"));
                return;
            }
            lines.push(format!("{title}:"));
            let head = head.iter().map(|h| (*h).to_owned()).collect();
            let table: Vec<_> = std::iter::once(head).chain(rows).collect();
            lines.extend(output::columns(&table).into_iter().map(|line| format!("  {line}")));
        };
        if !self.alerts.is_empty() {
            let rows = self.alerts.iter().map(|alert| vec![alert.to_string(), alert.fix().to_owned()]);
            section("Needs attention", &["what", "do"], rows.collect());
        }
        section(
            "Links",
            &["peer", "remote", "round trip", "cost", "sent", "received", "dialled"],
            self.links.iter().map(Link::row).collect(),
        );
        let over: Vec<_> = self.links.iter().filter(|l| l.peer_slowed + l.peer_dropped > 0).collect();
        if !over.is_empty() {
            section(
                "Peers that send more than `peer_rate`",
                &["peer", "packets slowed", "dropped"],
                over.iter().map(|l| l.over_row()).collect(),
            );
        }
        section(
            "Routers",
            &["router", "found by", "at", "state", "last failure"],
            self.routers.iter().map(Router::row).collect(),
        );
        let second: Vec<_> = self.routers.iter().filter_map(Router::second_row).collect();
        if !second.is_empty() {
            section("Not by the first way", &["router", "at", "why"], second);
        }
        section(
            "Topics",
            &["", "topic", "type", "owner", "messages", "state"],
            self.routes.iter().map(Route::row).collect(),
        );
        if !self.problems.is_empty() {
            let rows = self.problems.iter().map(|problem| vec![problem.clone()]);
            section("What is wrong", &["problem"], rows.collect());
        }
        section(
            "Names",
            &["name", "packets", "bytes", "dropped"],
            self.names.iter().map(NameTraffic::row).collect(),
        );
        let counts = |counts: &BTreeMap<String, u64>, meaning: fn(&str) -> String| {
            counts.iter().map(|(key, n)| vec![key.clone(), n.to_string(), meaning(key)]).collect()
        };
        let head = ["reason", "count", "meaning"];
        section("Drops", &head, counts(&self.drops, refusals::drop_meaning));
        section("Refused peers", &head, counts(&self.refused, refusals::door_meaning));
        if let Some(gateway) = &self.gateway {
            section(
                "Programs without ROS",
                &["client", "protocol", "address", "since"],
                gateway.clients.iter().map(GatewayClient::row).collect(),
            );
            if !gateway.refused.is_empty() {
                section("Refused there", &head, counts(&gateway.refused, refusals::gateway_meaning));
            }
            lines.push(format!("  at {}; {} topics read", gateway.listen.join(", "), gateway.readers));
        }
        let RouterSize { nodes, names, routed_names, branches } = self.router;
        lines.push(String::new());
        if self.local_network_reopened > 0 {
            let times = self.local_network_reopened;
            lines.push(format!(
                "Local network: opened again after this host's addresses changed, so often: {times}"
            ));
        }
        lines.push(format!(
            "Router: {} and {} known, {routed_names} with a route; branches: {branches}",
            output::several(nodes as u64, "node"),
            output::several(names, "name"),
        ));
        lines
    }
}

impl GatewayClient {
    fn row(&self) -> Vec<String> {
        let since = sgc_wire::UnixMillis(self.since).to_string();
        vec![self.name.clone(), self.protocol.clone(), self.address.clone(), since]
    }
}

impl Link {
    fn row(&self) -> Vec<String> {
        vec![
            self.peer.chars().take(8).collect(),
            self.remote.clone(),
            output::millis(self.rtt_us),
            // The cost that silence adds serves routing and means nothing to a reader.
            if self.silent { "silent".into() } else { output::millis(self.cost.into()) },
            output::bytes(self.sent_bytes),
            output::bytes(self.received_bytes),
            self.url.clone().unwrap_or_default(),
        ]
    }

    fn over_row(&self) -> Vec<String> {
        let peer = self.peer.chars().take(8).collect();
        vec![peer, self.peer_slowed.to_string(), self.peer_dropped.to_string()]
    }
}

impl Router {
    fn row(&self) -> Vec<String> {
        vec![
            self.router.clone(),
            self.found_by.clone(),
            self.at.clone().unwrap_or_default(),
            match self.again_in_s {
                Some(s) => format!("{} in {}", self.state, duration(s)),
                None => self.state.clone(),
            },
            self.last_failure.clone().unwrap_or_default(),
        ]
    }
}

impl Router {
    fn second_row(&self) -> Option<Vec<String>> {
        let why = self.why_not_first.clone()?;
        Some(vec![self.router.clone(), self.at.clone().unwrap_or_default(), why])
    }
}

impl Route {
    fn row(&self) -> Vec<String> {
        vec![
            self.direction.clone(),
            self.topic.clone(),
            self.type_name.clone().unwrap_or_else(|| "?".into()),
            self.owner.clone(),
            self.messages.to_string(),
            match self.compressed {
                Some((before, after)) if before > 0 => {
                    format!("{}, compressed to {:.0} %", self.state, 100.0 * after as f64 / before as f64)
                }
                _ => self.state.clone(),
            },
        ]
    }
}

impl NameTraffic {
    fn row(&self) -> Vec<String> {
        vec![self.name.clone(), self.packets.to_string(), output::bytes(self.bytes), self.dropped.to_string()]
    }
}

fn duration(seconds: u64) -> String {
    match (seconds / 86_400, seconds / 3600 % 24, seconds / 60 % 60, seconds % 60) {
        (0, 0, 0, s) => format!("{s} s"),
        (0, 0, m, s) => format!("{m} min {s} s"),
        (0, h, m, _) => format!("{h} h {m} min"),
        (d, h, _, _) => format!("{d} d {h} h"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn status_is_shown_in_tables() {
        let text = r#"{"node":"arm-1","version":"0.1.0","uptime_s":75,"new":{},
            "links":[{"id":1,"peer":"0123456789abcdef","remote":"127.0.0.1:7447","url":"quic://localhost:7447",
                      "rtt_us":420,"cost":1420,"sent_bytes":1500,"received_bytes":7}],
            "routers":[{"router":"srv://lab.example","found_by":"srv","at":"quic://r1.lab.example:7447",
                        "state":"trying again","failures":2,"last_failure":"no answer","again_in_s":3}],
            "routes":[{"direction":"share","topic":"/chatter","type":null,"name":null,"owner":"arm-1",
                       "state":"waiting for a publisher"}],
            "names":[],"drops":{"hop_limit":3},"refused":{},"router":{"nodes":3,"names":1,"routed_names":0,"branches":2}}"#;
        let lines = parse(Path::new("x"), text).unwrap().lines();
        let expected = [
            "arm-1: sgc 0.1.0, up for 1 min 15 s",
            "",
            "Links:",
            "  peer      remote          round trip  cost     sent    received  dialled",
            "  01234567  127.0.0.1:7447  0.42 ms     1.42 ms  1.5 kB  7 B       quic://localhost:7447",
            "",
            "Routers:",
            "  router             found by  at                          state                last failure",
            "  srv://lab.example  srv       quic://r1.lab.example:7447  trying again in 3 s  no answer",
            "",
            "Topics:",
            "         topic     type  owner  messages  state",
            "  share  /chatter  ?     arm-1  0         waiting for a publisher",
            "",
            "Names: none",
            "",
            "Drops:",
            "  reason     count  meaning",
            "  hop_limit  3      it went in a circle, or over too many routers",
            "",
            "Refused peers: none",
            "",
            "Router: 3 nodes and 1 name known, 0 with a route; branches: 2",
        ];
        assert_eq!(lines, expected);
    }
}
