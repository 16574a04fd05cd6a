//! The environment variables with which ROS 2 chooses its network.
//!
//! Takes a lookup function and reads no environment itself. What the values do is in [`crate::config`].

use crate::config::{self, DOMAIN_MAX, DiscoveryRange, PEER_BYTES_MAX, PEERS_MAX};

/// What the environment says about the ROS network.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RosEnv {
    /// `ROS_DOMAIN_ID`, 0 if unset.
    pub domain: u32,
    /// `ROS_AUTOMATIC_DISCOVERY_RANGE`, `SUBNET` if unset; `LOCALHOST` if `ROS_LOCALHOST_ONLY` is 1.
    pub discovery: DiscoveryRange,
    /// `ROS_STATIC_PEERS`; none if `ROS_LOCALHOST_ONLY` is 1.
    pub static_peers: Vec<String>,
    /// `CYCLONEDDS_URI`, untouched.
    pub cyclonedds_uri: Option<String>,
}

/// An environment variable with a value that ROS 2 gives no meaning.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{variable}={value:?}: {expected}")]
pub struct EnvError {
    /// Which variable.
    pub variable: &'static str,
    /// The whole value, or the part that is wrong.
    pub value: String,
    /// What would be right.
    pub expected: &'static str,
}

const DOMAIN_ID: &str = "ROS_DOMAIN_ID";
const LOCALHOST_ONLY: &str = "ROS_LOCALHOST_ONLY";
const DISCOVERY_RANGE: &str = "ROS_AUTOMATIC_DISCOVERY_RANGE";
const STATIC_PEERS: &str = "ROS_STATIC_PEERS";
const CYCLONEDDS_URI: &str = "CYCLONEDDS_URI";

/// Reads ROS's variables as rcl does; an empty value is an unset one.
///
/// `ROS_LOCALHOST_ONLY=1` prevails: the range is then `LOCALHOST` and there are no static peers,
/// whatever the newer variables say (`rcl_init`); `0` says nothing. Where rcl warns about a value and
/// falls back, this refuses: a proxy on the wrong network is worse than one that does not start.
///
/// # Errors
/// The first variable with a value that has no meaning.
pub fn from_env_vars(lookup: impl Fn(&str) -> Option<String>) -> Result<RosEnv, EnvError> {
    let value = |variable: &str| lookup(variable).filter(|v| !v.is_empty());

    let domain = value(DOMAIN_ID).map_or(Ok(0), |v| domain_id(&v))?;
    let localhost_only = match value(LOCALHOST_ONLY) {
        None => false,
        Some(v) if v == "0" => false,
        Some(v) if v == "1" => true,
        Some(value) => {
            return Err(EnvError { variable: LOCALHOST_ONLY, value, expected: "0 or 1 is expected" });
        }
    };
    let range = value(DISCOVERY_RANGE).map_or(Ok(DiscoveryRange::Subnet), discovery_range)?;
    let peers = value(STATIC_PEERS).map_or(Ok(Vec::new()), |v| static_peers(&v))?;

    let (discovery, static_peers) =
        if localhost_only { (DiscoveryRange::LocalHost, Vec::new()) } else { (range, peers) };
    Ok(RosEnv { domain, discovery, static_peers, cyclonedds_uri: value(CYCLONEDDS_URI) })
}

fn domain_id(value: &str) -> Result<u32, EnvError> {
    value.trim().parse().ok().filter(|id| *id <= DOMAIN_MAX).ok_or_else(|| EnvError {
        variable: DOMAIN_ID,
        value: value.to_owned(),
        expected: "a number from 0 to 232 is expected",
    })
}

fn discovery_range(value: String) -> Result<DiscoveryRange, EnvError> {
    match value.as_str() {
        "OFF" => Ok(DiscoveryRange::Off),
        "LOCALHOST" => Ok(DiscoveryRange::LocalHost),
        "SUBNET" => Ok(DiscoveryRange::Subnet),
        "SYSTEM_DEFAULT" => Ok(DiscoveryRange::SystemDefault),
        _ => Err(EnvError {
            variable: DISCOVERY_RANGE,
            value,
            expected: "OFF, LOCALHOST, SUBNET or SYSTEM_DEFAULT is expected",
        }),
    }
}

fn static_peers(value: &str) -> Result<Vec<String>, EnvError> {
    let refuse =
        |value: &str, expected| EnvError { variable: STATIC_PEERS, value: value.to_owned(), expected };
    let peers: Vec<&str> = value.split(';').map(str::trim).filter(|p| !p.is_empty()).collect();
    if peers.len() > PEERS_MAX {
        return Err(refuse(value, "at most 64 peers are expected"));
    }
    for peer in &peers {
        if peer.len() > PEER_BYTES_MAX {
            return Err(refuse(peer, "at most 255 characters are expected in a peer"));
        }
        if !config::is_peer(peer) {
            return Err(refuse(peer, "host names or IP addresses are expected, separated by ';'"));
        }
    }
    Ok(peers.into_iter().map(str::to_owned).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(vars: &[(&str, &str)]) -> Result<RosEnv, EnvError> {
        from_env_vars(|name| vars.iter().find(|(n, _)| *n == name).map(|(_, v)| (*v).to_owned()))
    }

    #[test]
    fn nothing_set_is_domain_zero_on_the_subnet() {
        assert_eq!(parse(&[]).unwrap(), RosEnv::default());
        let empty = [(DOMAIN_ID, ""), (LOCALHOST_ONLY, ""), (DISCOVERY_RANGE, ""), (STATIC_PEERS, "")];
        assert_eq!(parse(&empty).unwrap(), RosEnv::default());
        assert_eq!(RosEnv::default().discovery, DiscoveryRange::Subnet);
    }

    #[test]
    fn each_variable_is_read() {
        let env = parse(&[
            (DOMAIN_ID, "42"),
            (LOCALHOST_ONLY, "0"),
            (DISCOVERY_RANGE, "LOCALHOST"),
            (STATIC_PEERS, "192.168.0.1;remote.com;;"),
            (CYCLONEDDS_URI, "<Tracing/>"),
        ])
        .unwrap();
        assert_eq!(env.domain, 42);
        assert_eq!(env.discovery, DiscoveryRange::LocalHost);
        assert_eq!(env.static_peers, ["192.168.0.1", "remote.com"]);
        assert_eq!(env.cyclonedds_uri.as_deref(), Some("<Tracing/>"));
        for (text, range) in [
            ("OFF", DiscoveryRange::Off),
            ("SUBNET", DiscoveryRange::Subnet),
            ("SYSTEM_DEFAULT", DiscoveryRange::SystemDefault),
        ] {
            assert_eq!(parse(&[(DISCOVERY_RANGE, text)]).unwrap().discovery, range);
        }
    }

    #[test]
    fn localhost_only_prevails_over_range_and_peers() {
        let env =
            parse(&[(LOCALHOST_ONLY, "1"), (DISCOVERY_RANGE, "SUBNET"), (STATIC_PEERS, "a.b")]).unwrap();
        assert_eq!(env.discovery, DiscoveryRange::LocalHost);
        assert!(env.static_peers.is_empty());
    }

    #[test]
    fn mistakes_name_the_variable_the_value_and_what_is_right() {
        for (variable, value, hint) in [
            (DOMAIN_ID, "233", "0 to 232"),
            (DOMAIN_ID, "-1", "0 to 232"),
            (DOMAIN_ID, "lab", "0 to 232"),
            (LOCALHOST_ONLY, "yes", "0 or 1"),
            (DISCOVERY_RANGE, "localhost", "LOCALHOST"),
            (STATIC_PEERS, "two words", "separated by ';'"),
        ] {
            let error = parse(&[(variable, value)]).unwrap_err();
            assert_eq!((error.variable, error.value.as_str()), (variable, value));
            let text = error.to_string();
            assert!(text.contains(variable) && text.contains(value) && text.contains(hint), "{text}");
        }
        let long = "a".repeat(PEER_BYTES_MAX + 1);
        assert_eq!(parse(&[(STATIC_PEERS, &long)]).unwrap_err().value, long);
        let many = "a;".repeat(PEERS_MAX + 1);
        assert!(parse(&[(STATIC_PEERS, &many)]).is_err());
    }
}
