//! The description of the node that would run with a configuration, and warnings about it.
//!
//! It cannot know whether the named routers exist. It knows
//! nodes and groups if the fleet file is at hand.

use std::path::Path;

use sgc_gateway::Anonymous;
use sgc_node::alerts::{Alert, clock_alert};
use sgc_node::config::{
    Config, DeadManConfig, DiscoveryRange, GatewayConfig, Interface, Naming, Rename, Resume, RouterUrl,
    ShareConfig, StopSource, TokenSource, ZenohConfig,
};
use sgc_node::discovery_server;
use sgc_node::read_stop;
use sgc_process::files;
use sgc_process::unix_now;
use sgc_trust::{Fleet, Identity};
use sgc_types::Definitions;
use sgc_wire::PayloadForm;

use crate::error::DiagnosisError;
use crate::names;

/// The extension of fleet files.
pub const FLEET_EXTENSION: &str = "fleet";

/// The heading of a warning.
pub const WARNING: &str = "warning";

/// Returns rows that describe the node, and warnings. `file` is the configuration. Without `fleet`, the fleet file is
/// looked for.
pub fn summary(
    config: &Config,
    identity: &Identity,
    file: &Path,
    fleet: Option<&Path>,
    environment: &dyn Fn(&str) -> Option<String>,
) -> Result<Vec<Vec<String>>, DiagnosisError> {
    let mut rows = Vec::new();
    let mut row = |kind: &str, text: String| rows.push(vec![kind.to_owned(), text]);
    row("node", format!("{} of fleet {}", identity.node_name(), identity.fleet_name()));
    row("identity", format!("{}, holds until {}", config.identity.display(), identity.not_after()));
    for url in &config.routers {
        match url {
            RouterUrl::At(url) => row("dials", url.to_string()),
            RouterUrl::Ways(ways) => row(
                "dials",
                format!(
                    "{}: the first that works",
                    ways.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ")
                ),
            ),
            RouterUrl::Srv(domain) => {
                let query = domain.query();
                row(
                    "finds",
                    format!("{url}, one of those that {} names in DNS", query.trim_end_matches('.')),
                );
            }
            RouterUrl::Mdns(None) => {
                row("finds", format!("{url}, routers of the local network that are trusted"))
            }
            RouterUrl::Mdns(Some(node)) => row("finds", format!("{url}, router {node} on the local network")),
        }
    }
    if let Some(server) = &config.resolver {
        row("", format!("looked up at {server}"));
    }
    for addr in &config.listen {
        row("listens", addr.to_string());
    }
    if config.announce {
        row("", "announced on the local network by mDNS".to_owned());
    }
    for path in &config.accept {
        row("accepts", format!("nodes of the CAs in {} only", path.display()));
    }
    match &config.ros {
        Some(ros) => {
            let range = match ros.discovery {
                DiscoveryRange::Off => "nobody is discovered",
                DiscoveryRange::Localhost => "this host",
                DiscoveryRange::Subnet => "the local subnet",
                DiscoveryRange::SystemDefault => "as the middleware is configured",
            };
            let peers = match &ros.static_peers[..] {
                [] => String::new(),
                peers => format!(", and {}", peers.join(", ")),
            };
            let (domain, middleware) = (ros.domain_id, ros.middleware);
            if middleware.has_dds() {
                row("ROS 2", format!("domain {domain}, {range}{peers}"));
            }
            if middleware.has_zenoh() {
                let kind = if middleware.has_dds() { "" } else { "ROS 2" };
                row(kind, format!("domain {domain} of rmw_zenoh, {}", zenoh_router(&ros.zenoh)));
            }
        }
        None => row("ROS 2", format!("none: {} only", role_without_ros(config))),
    }
    for share in &config.shares {
        let to: Vec<_> = share.to.iter().map(ToString::to_string).collect();
        let to = if to == ["*"] { "everyone in the fleet".to_owned() } else { to.join(", ") };
        let (what, type_name) = (called(share.interface, &share.topic), type_of(share.type_name.as_deref()));
        row("shares", format!("{what}{type_name}{} with {to}", renamed(&share.naming, "as")));
        if !share.publish.is_empty() {
            let publish: Vec<_> = share.publish.iter().map(ToString::to_string).collect();
            row("", format!("published on by {} besides", publish.join(", ")));
        }
        share.dead_man.iter().flat_map(dead_man_rows).for_each(|(kind, text)| row(kind, text));
        if share.shaping.form == PayloadForm::Json {
            row("", json(config, share.type_name.as_deref()));
        }
        if let Some(name) = name_of(config, identity, share)? {
            row("", format!("named {name}"));
        }
    }
    for one in &config.uses {
        let (what, type_name) = (called(one.interface, &one.topic), type_of(one.type_name.as_deref()));
        row("uses", format!("{what}{type_name} from {}{}", one.from, renamed(&one.naming, "here as")));
        if one.shaping.form == PayloadForm::Json {
            row("", json(config, one.type_name.as_deref()));
        }
        one.dead_man.iter().flat_map(dead_man_rows).for_each(|(kind, text)| row(kind, text));
    }
    for token in &config.tokens {
        match &token.source {
            TokenSource::File(path) => row("uses", format!("by token, {}", path.display())),
            TokenSource::Text(token) => {
                row("uses", format!("{} from {}, by token", token.metadata.ros_name, token.owner_name));
            }
        }
        token.dead_man.iter().flat_map(dead_man_rows).for_each(|(kind, text)| row(kind, text));
    }
    for partner in &config.partners {
        let nodes = match partner.nodes.len() {
            0 => "all of its nodes".to_owned(),
            n => format!("{n} of its nodes"),
        };
        row("partner", format!("{}, {nodes}, CA in {}", partner.name, partner.ca.display()));
    }
    if let Some(gateway) = &config.gateway {
        rows.extend(gateway_rows(gateway));
    }
    if let Some(metrics) = &config.metrics {
        rows.push(vec!["metrics".to_owned(), format!("http://{}/metrics", metrics.listen)]);
        rows.extend(metrics.otlp.iter().map(|otlp| {
            let every = otlp.interval.as_secs();
            vec!["metrics".to_owned(), format!("pushed to {} every {every} s", otlp.url)]
        }));
        rows.extend(metrics.warnings().into_iter().map(|warning| vec![WARNING.to_owned(), warning]));
    }
    rows.extend(
        sgc_node::expiry_warning(identity, unix_now()).map(|warning| vec![WARNING.to_owned(), warning]),
    );
    if let Some(alert) = clock_alert(identity, unix_now()) {
        rows.push(vec![WARNING.to_owned(), format!("{alert}. The node starts and waits: {}", alert.fix())]);
    }
    if let Some(security) = config.ros.as_ref().and_then(|ros| ros.security.as_ref()) {
        let enclave = sgc_node::enclave_of(security);
        rows.push(vec![
            "enclave".to_owned(),
            format!("{} in {}", enclave.enclave, enclave.keystore.display()),
        ]);
        let unusable = enclave.check().err().map(|error| {
            let goes_without = !security.enforced && error.is_absence();
            let result = if goes_without { "goes without DDS Security" } else { "does not start like that" };
            format!("{error}; the node {result}")
        });
        let exposed = enclave.exposed_key().map(|key| {
            format!("{}: others can read it, and it is a private key: chmod 600 it", key.display())
        });
        rows.extend(unusable.or(exposed).map(|text| vec![WARNING.to_owned(), text]));
    }
    if let Some(ros) = config.ros.as_ref().filter(|ros| ros.middleware.has_dds()) {
        let reaches_out = ros.discovery == DiscoveryRange::Subnet && ros.cyclonedds_uri.is_none();
        let alone = reaches_out && !sgc_dds::has_outward_address();
        let alone = alone.then_some(Alert::LocalNetworkAlone);
        rows.extend(alone.map(|alert| vec![WARNING.to_owned(), format!("{alert}: {}", alert.fix())]));
        for alert in discovery_server::alerts(environment) {
            rows.push(vec![WARNING.to_owned(), format!("{alert}: {}", alert.fix())]);
        }
    }
    let fleet = match fleet {
        Some(path) => Some(fleet_of(identity, path)?),
        None => find_fleet(config, identity, file),
    };
    for unknown in fleet.iter().flat_map(|fleet| sgc_node::unknown_members(config, fleet)) {
        rows.push(vec![WARNING.to_owned(), unknown.to_string()]);
    }
    let state = sgc_node::state_dir(config, identity.node_name().as_str());
    if let Some(Err(error)) = state.as_deref().map(sgc_node::check_state_dir) {
        rows.push(vec![WARNING.to_owned(), format!("{error}; the node does not start like that")]);
    } else if let Some(error) = state.as_deref().and_then(sgc_node::storage_fault) {
        let alert = Alert::StateNotKept { reason: error.to_string() };
        rows.push(vec![WARNING.to_owned(), format!("{alert}: {}", alert.fix())]);
    }
    Ok(rows)
}

/// Describes a dead-man switch, and tells if its stop message cannot be read.
fn dead_man_rows(switch: &DeadManConfig) -> Vec<(&'static str, String)> {
    let mut rows = vec![("", dead_man(switch))];
    if let StopSource::File(file) = &switch.stop
        && let Err(error) = read_stop(file)
    {
        rows.push((WARNING, format!("the node will not start: {error}")));
    }
    rows
}

/// Describes a dead-man switch.
fn dead_man(switch: &DeadManConfig) -> String {
    let stop = match &switch.stop {
        StopSource::Zero => "a message of zeros".to_owned(),
        StopSource::Last => "the last command again".to_owned(),
        StopSource::File(file) => format!("the message in {}", file.display()),
    };
    let every = switch.repeat.map_or(String::new(), |repeat| format!(", every {repeat:?}"));
    let end = match switch.resume {
        Resume::Auto => "until somebody lets go and begins again",
        Resume::Manual => "until `sgc topic resume`",
    };
    format!("{:?} without a command: {stop}{every}, {end}", switch.after)
}

/// Reads the fleet file that a user named.
fn fleet_of(identity: &Identity, path: &Path) -> Result<Fleet, DiagnosisError> {
    let fleet = sgc_node::read_fleet(path)?;
    if fleet.anchors().fingerprints().any(|ca| ca == identity.as_peer().ca) {
        return Ok(fleet);
    }
    let (path, node) = (path.to_owned(), identity.node_name().to_string());
    Err(DiagnosisError::OtherFleet { path, node })
}

/// Reads the fleet file if it is at hand: the authority's, or one in this directory, beside the configuration or beside
/// the identity.
fn find_fleet(config: &Config, identity: &Identity, file: &Path) -> Option<Fleet> {
    let dirs = [Some(Path::new("")), file.parent(), config.identity.parent()].into_iter().flatten();
    let dirs = dirs.map(|dir| if dir == Path::new("") { Path::new(".") } else { dir });
    let found = dirs.flat_map(|dir| files::with_extension(dir, FLEET_EXTENSION).unwrap_or_default());
    let authority = config.authority.as_ref().map(|authority| authority.fleet.clone());
    authority.into_iter().chain(found).find_map(|path| fleet_of(identity, &path).ok())
}

/// Returns the rows about the gateway: addresses, permitted clients, and notes for the operator.
fn gateway_rows(gateway: &GatewayConfig) -> Vec<Vec<String>> {
    let mut rows = Vec::new();
    let mut row = |kind: &str, text: String| rows.push(vec![kind.to_owned(), text]);
    let listen: Vec<_> = gateway.listen.iter().map(ToString::to_string).collect();
    row("gateway", listen.join(", "));
    if let Some(tls) = &gateway.tls {
        row("", format!("shows the certificate in {}", tls.certificate.display()));
    } else if gateway.listen.iter().any(|url| url.scheme.is_encrypted()) {
        row("", "shows a certificate that it makes itself: `sgc gateway certificate`".to_owned());
    }
    row(
        "",
        match gateway.anonymous {
            Anonymous::Local => {
                "programs of this host may do everything; others show a token or a certificate"
            }
            Anonymous::None => "programs show a token or a certificate, those of this host too",
            Anonymous::All => "whoever reaches it may do everything",
        }
        .to_owned(),
    );
    if !gateway.origins.is_empty() {
        let origins: Vec<_> = gateway.origins.iter().map(ToString::to_string).collect();
        row("", format!("pages of {} may connect without a token", origins.join(", ")));
    }
    for client in &gateway.clients {
        let who: Vec<_> = client.who.iter().map(ToString::to_string).collect();
        row("", format!("certificates of {}: {}", who.join(", "), client.scope));
    }
    for warning in gateway.warnings().into_iter().chain(sgc_node::gateway_expiry_warning(gateway, unix_now()))
    {
        row(WARNING, warning);
    }
    rows
}

/// Returns the way to the router of a network of rmw_zenoh.
fn zenoh_router(zenoh: &ZenohConfig) -> String {
    let router = zenoh.router_address().map(|router| format!("by the router at {router}"));
    let config = zenoh.config.as_ref().map(|config| format!("configured by {}", config.display()));
    let texts: Vec<String> = router.into_iter().chain(config).collect();
    match &texts[..] {
        // Without both, a setting of the environment has the router.
        [] => "by the router that ZENOH_CONFIG_OVERRIDE names".to_owned(),
        texts => texts.join(", "),
    }
}

/// Returns the role of a node that touches no ROS 2 network.
fn role_without_ros(config: &Config) -> &'static str {
    match (&config.authority, config.listen.is_empty()) {
        (Some(_), true) => "the fleet's authority",
        (Some(_), false) => "a router and the fleet's authority",
        (None, _) => "a router",
    }
}

/// Returns the note on sharing as JSON, which needs a definition of the type.
fn json(config: &Config, type_name: Option<&str>) -> String {
    let dirs = config.ros.as_ref().map_or(&[][..], |ros| &ros.definitions);
    let found =
        type_name.and_then(|name| name.parse().ok()).map(|name| Definitions::from_env(dirs).layout(&name));
    match found {
        None => "as JSON, if a definition of its type is known here by then".to_owned(),
        Some(Ok(_)) => "as JSON".to_owned(),
        Some(Err(why)) => format!(
            "as JSON, but nothing can be sent: {why}; name a directory that has it with `definitions` in [ros]"
        ),
    }
}

fn type_of(type_name: Option<&str>) -> String {
    type_name.map(|name| format!(" [{name}]")).unwrap_or_default()
}

/// Returns the name, preceded by its kind if it is no topic.
fn called(interface: Interface, name: &str) -> String {
    match interface {
        Interface::Topic => name.to_owned(),
        other => format!("{} {name}", other.key()),
    }
}

/// Returns the topic's name on the other side, if it differs.
fn renamed(naming: &Naming, word: &str) -> String {
    let except = match &naming.except[..] {
        [] => String::new(),
        except => format!(" except {}", except.join(", ")),
    };
    match &naming.rename {
        Rename::Keep => except,
        Rename::As(other) => format!("{except}, {word} {other}"),
        Rename::Namespace(namespace) => format!("{except}, {word} {namespace}/..."),
    }
}

/// Returns the share's 256-bit name, or `None` if its type has to come from a publisher.
fn name_of(
    config: &Config,
    identity: &Identity,
    share: &ShareConfig,
) -> Result<Option<String>, DiagnosisError> {
    // A share of several interfaces has one name for each.
    let several = share.interface.parts().len() > 1 || share.topic.contains('*');
    if share.type_name.is_none() || several {
        return Ok(None);
    }
    let name = names::name_of(identity, &config.identity, identity.node_name(), share)?;
    Ok(Some(name.to_string()))
}

#[cfg(test)]
mod tests {
    use sgc_node::config::AuthorityConfig;

    use super::*;

    #[test]
    fn authority_that_does_not_listen_is_no_router() {
        let mut config = Config::default();
        assert_eq!(role_without_ros(&config), "a router");
        config.authority = Some(AuthorityConfig::new("lab.fleet".into()));
        assert_eq!(role_without_ros(&config), "the fleet's authority");
        config.listen = vec!["quic://127.0.0.1:0".parse().unwrap()];
        assert_eq!(role_without_ros(&config), "a router and the fleet's authority");
    }

    #[test]
    fn check_reports_the_way_to_a_router_of_zenoh() {
        let mut zenoh = ZenohConfig::default();
        assert_eq!(zenoh_router(&zenoh), "by the router at tcp/localhost:7447");
        zenoh.overrides.push(("connect/endpoints".to_owned(), "[]".to_owned()));
        assert_eq!(zenoh_router(&zenoh), "by the router that ZENOH_CONFIG_OVERRIDE names");
        zenoh.config = Some("/a/session.json5".into());
        assert_eq!(zenoh_router(&zenoh), "configured by /a/session.json5");
        zenoh.router = Some("tls/b:1#connect_private_key=k".to_owned());
        assert_eq!(zenoh_router(&zenoh), "by the router at tls/b:1, configured by /a/session.json5");
    }

    #[test]
    fn check_reports_type_that_cannot_travel_as_json() {
        let said = |type_name| json(&Config::default(), type_name);
        assert_eq!(said(Some("std_msgs/msg/String")), "as JSON");
        assert!(said(None).contains("if a definition of its type is known"));
        let unknown = said(Some("mine/msg/Thing"));
        assert!(unknown.contains("nothing can be sent: no definition of mine/msg/Thing"), "{unknown}");
    }
}
