//! The settings of a network of rmw_zenoh: [`ZenohConfig`], and its translation into a configuration of Zenoh.
//!
//! A file of the user replaces rmw_zenoh's own values, as it does there (`ZENOH_SESSION_CONFIG_URI`). Settings that SGC
//! needs come next, then the user's overrides (`ZENOH_CONFIG_OVERRIDE`).

use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde_json::{Value, json};
use sgc_zenoh::ZenohId;

use crate::PAYLOAD_BYTES_MAX;

/// The router of rmw_zenoh on this host.
pub const ROUTER_DEFAULT: &str = "tcp/localhost:7447";

/// Finds the hash of a service as a whole: from its ROS type, `a/srv/B`, and the hash that an endpoint of DDS announced,
/// which may be that of its request or its reply. Returns `None` if the definition is not known.
pub type FindServiceHash = Arc<dyn Fn(&str, &str) -> Option<String> + Send + Sync>;

/// The settings of a network of rmw_zenoh and of this program in it.
#[derive(Clone, Default)]
pub struct ZenohConfig {
    /// ROS domain id.
    pub domain: u32,
    /// A configuration of Zenoh, such as one in JSON5, that takes the place of rmw_zenoh's.
    pub file: Option<PathBuf>,
    /// Settings that come next: path in Zenoh's configuration, and value in JSON5.
    pub overrides: Vec<(String, String)>,
    /// The endpoint of the router, such as [`ROUTER_DEFAULT`]. Without it, that of the overrides, of the file, or the
    /// default one.
    pub router: Option<String>,
    /// `true` if programs find each other without a router, so that a missing one is no fault.
    pub without_router: bool,
    /// `true` for a proxy: its session has SGC's mark, and it ignores other sessions with it. Otherwise the network is that
    /// of an ordinary program.
    pub is_proxy: bool,
    /// `true` if nodes are reported and announced.
    pub graph: bool,
    /// The source of hashes of services that DDS endpoints do not announce.
    pub service_hash: Option<FindServiceHash>,
}

impl std::fmt::Debug for ZenohConfig {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        // The file and the overrides may name secrets.
        f.debug_struct("ZenohConfig")
            .field("domain", &self.domain)
            .field("router", &self.router)
            .finish_non_exhaustive()
    }
}

/// Values of rmw_zenoh's own session configuration that differ from Zenoh's defaults
/// (`DEFAULT_RMW_ZENOH_SESSION_CONFIG.json5`@076f2e71).
const RMW_VALUES: [(&str, &str); 10] = [
    ("listen/endpoints", r#"["tcp/localhost:0"]"#),
    ("scouting/multicast/enabled", "false"),
    ("scouting/gossip/target", r#"{ router: ["router", "peer"], peer: ["router"] }"#),
    ("scouting/gossip/autoconnect_strategy", r#"{ peer: { to_router: "always", to_peer: "greater-zid" } }"#),
    ("queries_default_timeout", "600000"),
    ("transport/unicast/open_timeout", "60000"),
    ("transport/unicast/accept_timeout", "60000"),
    ("transport/unicast/max_sessions", "10000"),
    ("transport/link/tx/lease", "60000"),
    ("transport/link/tx/queue/congestion_control/block/wait_before_close", "60000000"),
];

/// Values of SGC's own: batches of 64 KB in the queue, and microseconds that a message waits for room in it before it is
/// dropped, and that the rest of a large one waits. rmw_zenoh has 2 batches and waits 1 and 50 ms, which a busy host exceeds,
/// and messages of far programs come in bursts. Only the first message that finds no room waits: Zenoh drops the next ones at
/// once until there is room, so a program that does not read holds up the others once.
const QUEUE_VALUES: [(&str, &str); 3] = [
    ("transport/link/tx/queue/size/data", "16"),
    ("transport/link/tx/queue/congestion_control/drop/wait_before_drop", "20000"),
    ("transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments", "1000000"),
];

/// Parts of Zenoh's configuration with passwords and private keys. Its errors quote the value that they refuse.
const SECRET_PARTS: [&str; 2] = ["transport/auth", "transport/link/tls"];

/// Changes a setting.
///
/// # Errors
/// The path of the setting, with Zenoh's reason unless that might show a secret.
fn set(zenoh: &mut zenoh::Config, path: &str, value: &str) -> Result<(), String> {
    let bare = path.trim_matches('/');
    let is_secret = SECRET_PARTS.iter().any(|part| bare.starts_with(part) || part.starts_with(bare));
    zenoh.insert_json5(path, value).map_err(|error| match is_secret {
        true => format!("{path}: Zenoh refuses the value, which is not shown because it may be secret"),
        false => format!("{path}: {error}"),
    })
}

/// Returns the configuration of a session.
///
/// # Errors
/// The file or the setting that Zenoh refuses, with its reason.
pub(crate) fn zenoh_config(config: &ZenohConfig, id: ZenohId) -> Result<zenoh::Config, String> {
    let mut zenoh = match &config.file {
        Some(file) => {
            File::open(file).map_err(|error| format!("{}: {error}", file.display()))?;
            zenoh::Config::from_file(file).map_err(|error| refused_file(file, &error.to_string()))?
        }
        None => zenoh::Config::default(),
    };
    let mut set = |path: &str, value: &str| set(&mut zenoh, path, value);
    if config.file.is_none() {
        for (path, value) in RMW_VALUES.into_iter().chain(QUEUE_VALUES) {
            set(path, value)?;
        }
        set("connect/endpoints", &json!([ROUTER_DEFAULT]).to_string())?;
    }
    // Time stamps tell who published, and late joiners get history by them.
    set("timestamping/enabled", "true")?;
    // The node starts without a router and finds it later.
    set("connect/timeout_ms", r#"{ router: -1, peer: -1, client: 0 }"#)?;
    set("connect/exit_on_failure", "{ router: false, peer: false, client: true }")?;
    set("transport/link/rx/max_message_size", &RX_BYTES_MAX.to_string())?;
    set("adminspace/enabled", "false")?;
    for (path, value) in &config.overrides {
        set(path, value)?;
    }
    if let Some(router) = &config.router {
        set("connect/endpoints", &json!([router]).to_string())?;
    }
    set("id", &format!("\"{id}\""))?;
    let is_chosen = |wanted: &str| config.overrides.iter().any(|(path, _)| path.trim_matches('/') == wanted);
    if !is_chosen("mode") && (config.file.is_none() || config.router.is_some()) {
        // A router forwards nothing between two peers that do not reach each other, so a peer is right on its host only.
        // A session in mode router that does not listen is like a client, but opens before its router is there.
        let is_far = routers(&zenoh).iter().any(|router| !is_on_this_host(router));
        self::set(&mut zenoh, "mode", if is_far { r#""router""# } else { r#""peer""# })?;
        if is_far {
            // They may have been named for another mode.
            let routers = json!(routers(&zenoh)).to_string();
            self::set(&mut zenoh, "connect/endpoints", &routers)?;
            if !is_chosen("listen/endpoints") {
                self::set(&mut zenoh, "listen/endpoints", "[]")?;
            }
        }
    }
    Ok(zenoh)
}

/// Returns the error of a file. Zenoh's reason for content that it refuses may quote a secret, so only its place is named.
fn refused_file(file: &Path, reason: &str) -> String {
    let file = file.display();
    if ["Unsupported file type", "Empty config file"].iter().any(|start| reason.starts_with(start)) {
        return format!("{file}: {reason}");
    }
    let number = |before: &str| {
        let (_, behind) = reason.split_once(before)?;
        behind.split(|c: char| !c.is_ascii_digit()).next()?.parse::<u32>().ok()
    };
    let line = number("line: ").or_else(|| number("--> "));
    let place = line.map(|line| format!(", line {line}")).unwrap_or_default();
    format!("{file}{place}: this is no configuration of a Zenoh session")
}

/// Returns a text without the configurations of its endpoints, which begin with `#` and may hold a private key.
pub(crate) fn shown(text: &str) -> String {
    let mut parts = text.split('#');
    let mut shown = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        let end = part.find(['"', ',', ']', ')', ' ']).unwrap_or(part.len());
        shown.push_str(&part[end..]);
    }
    shown
}

/// Returns the endpoints to which a session with this configuration connects, in every mode.
pub(crate) fn routers(zenoh: &zenoh::Config) -> Vec<String> {
    // A list of texts, or such a list for each mode.
    fn texts(value: &Value) -> Vec<String> {
        match value {
            Value::String(text) => vec![text.clone()],
            Value::Array(values) => values.iter().flat_map(texts).collect(),
            Value::Object(values) => values.values().flat_map(texts).collect(),
            _ => Vec::new(),
        }
    }
    let json = zenoh.get_json("connect/endpoints").unwrap_or_default();
    serde_json::from_str(&json).map(|value| texts(&value)).unwrap_or_default()
}

/// Longest message that Zenoh puts together, bytes: the longest payload and what is around it.
const RX_BYTES_MAX: usize = PAYLOAD_BYTES_MAX + (64 << 10);

/// Returns `true` if an endpoint of Zenoh is on the loopback interface or a Unix socket.
pub(crate) fn is_on_this_host(endpoint: &str) -> bool {
    let Some((protocol, rest)) = endpoint.split_once('/') else { return false };
    let address = rest.split(['?', '#']).next().unwrap_or_default();
    if protocol.starts_with("unix") {
        return true;
    }
    let host = address.rsplit_once(':').map_or(address, |(host, _)| host);
    let host = host.trim_start_matches('[').trim_end_matches(']');
    host == "localhost" || host.parse::<std::net::IpAddr>().is_ok_and(|address| address.is_loopback())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn id() -> ZenohId {
        ZenohId::of_sgc([1; 10])
    }

    fn text(config: &zenoh::Config, key: &str) -> String {
        config.get_json(key).unwrap()
    }

    #[test]
    fn a_router_on_this_host_is_joined_as_a_peer_and_another_one_not() {
        for (endpoint, is_here) in [
            ("tcp/localhost:7447", true),
            ("tcp/127.0.0.2:7447", true),
            ("tls/[::1]:7447#root_ca_certificate=/a", true),
            ("unixsock-stream//tmp/router.sock", true),
            ("tcp/10.0.0.1:7447", false),
            ("tcp/localhost.example.com:7447", false),
            ("tcp/[fe80::1]:7447", false),
            ("tcp", false),
        ] {
            assert_eq!(is_on_this_host(endpoint), is_here, "{endpoint}");
        }
        for (router, mode) in [("tcp/localhost:7447", "\"peer\""), ("tcp/10.0.0.1:7447", "\"router\"")] {
            let config = ZenohConfig { router: Some(router.into()), ..ZenohConfig::default() };
            let zenoh = zenoh_config(&config, id()).unwrap();
            assert_eq!(text(&zenoh, "mode"), mode);
            assert_eq!(text(&zenoh, "connect/endpoints"), format!("[\"{router}\"]"));
        }
    }

    #[test]
    fn overrides_come_last_but_the_mark_stays() {
        let overrides = [("mode", "\"client\""), ("id", "\"1\""), ("timestamping/enabled", "false")];
        let overrides = overrides.map(|(key, value)| (key.to_owned(), value.to_owned())).to_vec();
        let zenoh = zenoh_config(&ZenohConfig { overrides, ..ZenohConfig::default() }, id()).unwrap();
        assert_eq!(text(&zenoh, "mode"), "\"client\"");
        assert_eq!(text(&zenoh, "id"), format!("\"{}\"", id()));
        assert_eq!(text(&zenoh, "timestamping/enabled"), "false");
        assert_eq!(routers(&zenoh), [ROUTER_DEFAULT]);
        assert_eq!(text(&zenoh, "scouting/multicast/enabled"), "false");
    }

    #[test]
    fn the_mode_follows_the_router_wherever_it_is_named() {
        let overrides =
            vec![("connect/endpoints".to_owned(), "{ peer: [\"tcp/10.0.0.1:7447\"] }".to_owned())];
        let config = ZenohConfig { overrides, ..ZenohConfig::default() };
        let zenoh = zenoh_config(&config, id()).unwrap();
        assert_eq!(
            (routers(&zenoh), text(&zenoh, "mode")),
            (vec!["tcp/10.0.0.1:7447".into()], "\"router\"".into())
        );
        assert_eq!(text(&zenoh, "connect/endpoints"), r#"["tcp/10.0.0.1:7447"]"#, "for this mode, too");
        let config = ZenohConfig { router: Some("tcp/[::1]:1".into()), ..config };
        let zenoh = zenoh_config(&config, id()).unwrap();
        assert_eq!((routers(&zenoh), text(&zenoh, "mode")), (vec!["tcp/[::1]:1".into()], "\"peer\"".into()));
    }

    #[test]
    fn settings_that_zenoh_refuses_are_named_without_secrets() {
        let refused = |path: &str, value: &str| {
            let overrides = vec![(path.to_owned(), value.to_owned())];
            zenoh_config(&ZenohConfig { overrides, ..ZenohConfig::default() }, id()).unwrap_err()
        };
        let why = refused("mode", "1");
        assert!(why.starts_with("mode: ") && !why.contains("secret"), "{why}");
        for (path, value) in [
            ("transport/auth/usrpwd/password", "hunter2"),
            ("/transport/link/tls/connect_private_key_base64", "hunter2"),
            ("transport", "{ auth: { usrpwd: { password: hunter2 } } }"),
        ] {
            let why = refused(path, value);
            assert!(why.starts_with(&format!("{path}: ")) && !why.contains("hunter2"), "{why}");
        }
        let config = ZenohConfig { file: Some("/nowhere.json5".into()), ..ZenohConfig::default() };
        assert!(zenoh_config(&config, id()).unwrap_err().starts_with("/nowhere.json5: "));
        let dir = tempfile::tempdir().unwrap();
        let refused = |name: &str, content: &str| {
            let file = dir.path().join(name);
            std::fs::write(&file, content).unwrap();
            zenoh_config(&ZenohConfig { file: Some(file), ..ZenohConfig::default() }, id()).unwrap_err()
        };
        assert!(refused("session", "{}").contains("must have an extension"));
        for content in ["{\n mode: hunter2 }", "{\n mode: 'hunter2' }"] {
            let why = refused("session.json5", content);
            assert!(why.contains("session.json5, line 2: ") && !why.contains("hunter2"), "{why}");
        }
        assert_eq!(
            shown(r#"no [tls/a:1#key=x;y=z, "tcp/b:2#k=v"] there"#),
            r#"no [tls/a:1, "tcp/b:2"] there"#
        );
        let config = ZenohConfig { router: Some("tcp/a\"b:1".into()), ..ZenohConfig::default() };
        assert_eq!(routers(&zenoh_config(&config, id()).unwrap()), ["tcp/a\"b:1"]);
    }
}
