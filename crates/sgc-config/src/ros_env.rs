//! Resolves `[ros]` and the ROS 2 environment variables into the settings of the local ROS 2 network.
//!
//! The variables have their meaning in `rcl`, with one difference: a value that `rcl` replaces with a warning is an
//! error here. A key of the file overrides its variable, which is then not read.

use crate::config::{DiscoveryRange, RosConfig};
use crate::draft::{RosDraft, WithOrigin};
use crate::error::{ConfigError, Mistake, Origin};
use crate::names;
use crate::schema::nearest;
use crate::zenoh::Middleware;

/// Looks up an environment variable. It is `&|name| std::env::var(name).ok()` outside of tests.
pub type Environment<'e> = &'e dyn Fn(&str) -> Option<String>;

/// The greatest domain id for which DDS's formula gives valid ports (RTPS 2.5, 9.6.2.3).
pub const DOMAIN_ID_MAX: u32 = 232;
/// Most peers that are contacted without discovery.
pub const STATIC_PEERS_MAX: usize = 64;

const DOMAIN_ID: &str = "ROS_DOMAIN_ID";
const LOCALHOST_ONLY: &str = "ROS_LOCALHOST_ONLY";
const DISCOVERY_RANGE: &str = "ROS_AUTOMATIC_DISCOVERY_RANGE";
const STATIC_PEERS: &str = "ROS_STATIC_PEERS";
pub(crate) const SECURITY_ENABLE: &str = "ROS_SECURITY_ENABLE";
pub(crate) const SECURITY_STRATEGY: &str = "ROS_SECURITY_STRATEGY";
pub(crate) const SECURITY_KEYSTORE: &str = "ROS_SECURITY_KEYSTORE";
pub(crate) const SECURITY_ENCLAVE_OVERRIDE: &str = "ROS_SECURITY_ENCLAVE_OVERRIDE";
const CYCLONEDDS_URI: &str = "CYCLONEDDS_URI";

const RANGES: [(&str, &str, DiscoveryRange); 4] = [
    ("off", "OFF", DiscoveryRange::Off),
    ("localhost", "LOCALHOST", DiscoveryRange::Localhost),
    ("subnet", "SUBNET", DiscoveryRange::Subnet),
    ("system_default", "SYSTEM_DEFAULT", DiscoveryRange::SystemDefault),
];
const RANGES_IN_FILE: [&str; 4] = [RANGES[0].0, RANGES[1].0, RANGES[2].0, RANGES[3].0];
const RANGES_IN_ENVIRONMENT: [&str; 4] = [RANGES[0].1, RANGES[1].1, RANGES[2].1, RANGES[3].1];

/// Resolves the settings. Mistakes are added to `errors` and leave defaults. Without a DDS network, the keys and the
/// variables of its discovery are not read. An unknown middleware, which has an error, may be either.
pub(crate) fn resolve(
    ros: &RosDraft,
    middleware: Option<Middleware>,
    env: Environment<'_>,
    errors: &mut Vec<ConfigError>,
) -> RosConfig {
    let domain_id_max = if middleware.is_some_and(Middleware::has_dds) { DOMAIN_ID_MAX } else { u32::MAX };
    let domain_id = match &ros.domain_id {
        Some(id) => keep(file_domain_id(id, domain_id_max), errors),
        None => keep(env_domain_id(env, domain_id_max), errors),
    };
    let resolved = RosConfig {
        middleware: middleware.unwrap_or_default(),
        domain_id: domain_id.unwrap_or(0),
        graph: ros.graph.as_ref().is_none_or(|graph| graph.value),
        // Directories of relative paths are unknown here, so the caller adds what has paths.
        ..RosConfig::default()
    };
    if !middleware.is_none_or(Middleware::has_dds) {
        return resolved;
    }
    let range = match file_range(ros) {
        Some(range) => keep(range, errors),
        None => keep(env_range(env, ros.localhost_only.is_none()), errors),
    };
    // After a mistake the widest range is assumed, so that the mistake causes no others.
    let range = range.unwrap_or(Range { value: DiscoveryRange::Subnet, set_by: None, only_localhost: false });
    let static_peers = match &ros.static_peers {
        Some(peers) => file_peers(peers, &range, errors),
        None if range.only_localhost || !range.value.asks_peers() => Vec::new(),
        None => keep(env_peers(env), errors).unwrap_or_default(),
    };
    RosConfig {
        discovery: range.value,
        static_peers,
        cyclonedds_uri: variable(env, CYCLONEDDS_URI),
        ..resolved
    }
}

fn keep<T>(result: Result<T, ConfigError>, errors: &mut Vec<ConfigError>) -> Option<T> {
    result.map_err(|error| errors.push(error)).ok()
}

pub(crate) fn variable(env: Environment<'_>, name: &str) -> Option<String> {
    // ROS 2 treats an empty variable as unset.
    env(name).filter(|value| !value.is_empty())
}

fn environment_error(mistake: Mistake) -> ConfigError {
    ConfigError::new(Origin::Environment, mistake)
}

fn file_domain_id(id: &WithOrigin<i64>, max: u32) -> Result<u32, ConfigError> {
    match u32::try_from(id.value) {
        Ok(value) if value <= max => Ok(value),
        _ => Err(id.error(Mistake::DomainId { key: id.key, value: id.value.to_string(), max })),
    }
}

fn env_domain_id(env: Environment<'_>, max: u32) -> Result<u32, ConfigError> {
    let Some(value) = variable(env, DOMAIN_ID) else { return Ok(0) };
    match c_number(value.trim()) {
        Some(id) if id <= max => Ok(id),
        _ => Err(environment_error(Mistake::DomainId { key: DOMAIN_ID, value: format!("{value:?}"), max })),
    }
}

/// Parses a number as C's `strtoul` does with base 0, since `rcl` uses it: `0x10` and `020` are 16.
fn c_number(text: &str) -> Option<u32> {
    let text = text.strip_prefix('+').unwrap_or(text);
    let (digits, radix) = if let Some(hex) = text.strip_prefix("0x").or_else(|| text.strip_prefix("0X")) {
        (hex, 16)
    } else if text.len() > 1 && text.starts_with('0') {
        (text, 8)
    } else {
        (text, 10)
    };
    if digits.starts_with(['+', '-']) { None } else { u32::from_str_radix(digits, radix).ok() }
}

/// A range with its origin.
struct Range {
    value: DiscoveryRange,
    /// Key or variable with its value; `None` for the default.
    set_by: Option<(&'static str, String)>,
    /// Whether the older switch selected it, which also disables static peers.
    only_localhost: bool,
}

fn file_range(ros: &RosDraft) -> Option<Result<Range, ConfigError>> {
    let only_localhost = ros.localhost_only.as_ref().filter(|only| only.value);
    let Some(written) = &ros.discovery_range else {
        return only_localhost.map(|only| {
            let set_by = Some((only.key, "true".to_owned()));
            Ok(Range { value: DiscoveryRange::Localhost, set_by, only_localhost: true })
        });
    };
    let Some((.., value)) = RANGES.iter().find(|(in_file, ..)| *in_file == written.value) else {
        return Some(Err(written.error(Mistake::UnknownWord {
            key: written.key,
            value: written.value.clone(),
            nearest: nearest(&written.value, &RANGES_IN_FILE),
            known: &RANGES_IN_FILE,
        })));
    };
    if let Some(only) = only_localhost.filter(|_| *value != DiscoveryRange::Localhost) {
        return Some(Err(only.error(Mistake::Contradiction {
            key: only.key,
            value: "true",
            other: written.key,
            other_value: format!("{:?}", written.value),
            right: "keep `discovery_range`, which has replaced the other",
        })));
    }
    let set_by = Some((written.key, format!("{:?}", written.value)));
    Some(Ok(Range { value: *value, set_by, only_localhost: only_localhost.is_some() }))
}

fn env_range(env: Environment<'_>, read_switch: bool) -> Result<Range, ConfigError> {
    let switch = variable(env, LOCALHOST_ONLY).filter(|_| read_switch);
    match switch.as_deref() {
        // The variable is deprecated, but if it is on, it overrides the range and the peers.
        Some("1") => {
            let set_by = Some((LOCALHOST_ONLY, "\"1\"".to_owned()));
            return Ok(Range { value: DiscoveryRange::Localhost, set_by, only_localhost: true });
        }
        None | Some("0") => {}
        Some(value) => {
            let value = value.to_owned();
            return Err(environment_error(Mistake::Switch { key: LOCALHOST_ONLY, value }));
        }
    }
    let Some(written) = variable(env, DISCOVERY_RANGE) else {
        return Ok(Range { value: DiscoveryRange::Subnet, set_by: None, only_localhost: false });
    };
    match RANGES.iter().find(|(_, environment_error, _)| *environment_error == written) {
        Some((.., value)) => {
            let set_by = Some((DISCOVERY_RANGE, format!("{written:?}")));
            Ok(Range { value: *value, set_by, only_localhost: false })
        }
        None => Err(environment_error(Mistake::UnknownWord {
            key: DISCOVERY_RANGE,
            nearest: nearest(&written, &RANGES_IN_ENVIRONMENT),
            value: written,
            known: &RANGES_IN_ENVIRONMENT,
        })),
    }
}

fn file_peers(
    peers: &WithOrigin<Vec<WithOrigin<String>>>,
    range: &Range,
    errors: &mut Vec<ConfigError>,
) -> Vec<String> {
    let mut valid: Vec<String> = Vec::new();
    for peer in peers.value.iter().take(STATIC_PEERS_MAX) {
        match names::peer(peer.key, &peer.value) {
            Ok(value) if valid.contains(&value) => {
                errors.push(peer.error(Mistake::Repeated { key: peer.key, value }));
            }
            Ok(value) => valid.push(value),
            Err(mistake) => errors.push(peer.error(mistake)),
        }
    }
    let count = peers.value.len();
    if count > STATIC_PEERS_MAX {
        errors.push(peers.error(Mistake::TooManyEntries { key: peers.key, count, max: STATIC_PEERS_MAX }));
    }
    // ROS 2 ignores the peers in these cases. Peers in the file are meant, so they are an error.
    if let Some((other, other_value)) = &range.set_by
        && (!range.value.asks_peers() || *other == "localhost_only")
        && !peers.value.is_empty()
    {
        errors.push(peers.error(Mistake::Contradiction {
            key: peers.key,
            value: "not empty",
            other,
            other_value: other_value.clone(),
            right: "no peer would be contacted; set `discovery_range` to \"localhost\" or \"subnet\", or take the \
                    peers out",
        }));
    }
    valid
}

fn env_peers(env: Environment<'_>) -> Result<Vec<String>, ConfigError> {
    let Some(written) = variable(env, STATIC_PEERS) else { return Ok(Vec::new()) };
    let mut peers: Vec<String> = Vec::new();
    for peer in written.split(';').map(str::trim).filter(|peer| !peer.is_empty()) {
        let peer = names::peer(STATIC_PEERS, peer).map_err(environment_error)?;
        if !peers.contains(&peer) {
            peers.push(peer);
        }
    }
    if peers.len() > STATIC_PEERS_MAX {
        let (key, count) = (STATIC_PEERS, peers.len());
        return Err(environment_error(Mistake::TooManyEntries { key, count, max: STATIC_PEERS_MAX }));
    }
    Ok(peers)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_read_as_c_reads_them() {
        for (text, expected) in [
            ("0", Some(0)),
            ("42", Some(42)),
            ("+7", Some(7)),
            ("0x2a", Some(42)),
            ("0X2A", Some(42)),
            ("052", Some(42)),
            ("08", None),
            ("0x", None),
            ("", None),
            ("-1", None),
            ("+-1", None),
            ("12a", None),
            ("99999999999", None),
        ] {
            assert_eq!(c_number(text), expected, "{text:?}");
        }
    }
}
