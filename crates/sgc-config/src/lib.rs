//! Configuration: turns the user's input into a valid, resolved [`Config`] before any socket is bound.
//!
//! Two sources, a TOML file (`file`) and the command line (`args`), become a draft. One set of rules (`resolve`,
//! `names`, `ros_env`) turns the draft into a [`Config`], or reports all mistakes as [`ConfigErrors`]. The reference
//! for users is `docs/reference/configuration.md`.
//!
//! This crate is pure: it reads no clock, file or environment. Variables come through [`Environment`]. The caller reads
//! the file, and looks at the files that it names through [`FileChecks`].
#![forbid(unsafe_code)]

mod args;
mod config;
mod draft;
mod error;
mod file;
mod gateway;
mod metrics;
mod names;
mod recipient;
mod resolve;
mod ros_env;
mod router_url;
mod schema;
mod units;
mod zenoh;

use std::path::Path;

pub use args::ArgsConfig;
pub use config::{
    AuditConfig, AuditRoom, AuthorityConfig, Config, DEAD_MAN_MAX, DEAD_MAN_MIN, DeadManConfig,
    DiscoveryRange, KEEP_ALIVE_MAX, KEEP_ALIVE_MIN, PEER_RATE_MAX, PEER_RATE_MIN, PartnerConfig, RosConfig,
    RotationConfig, SecurityConfig, ShareConfig, ShareMetadata, StopSource, StoreSettings, TokenConfig,
    TokenSource, TransportConfig, UseConfig,
};
pub use error::{ConfigError, ConfigErrors, Mistake, Origin, TopicRule, ZenohOverrideFault};
pub use gateway::{
    GATEWAY_CLIENTS_MAX, GATEWAY_NAMES_MAX, GatewayClientConfig, GatewayConfig, GatewayScheme, GatewayTls,
    GatewayUrl, GatewayUrlError, ORIGINS_MAX,
};
pub use metrics::{MetricsConfig, OtlpConfig, OtlpUrl, OtlpUrlError};
pub use names::{FRAME_PREFIX_BYTES_MAX, PEER_BYTES_MAX, TYPE_BYTES_MAX};
pub use recipient::Recipient;
pub use resolve::{
    ACCEPT_MAX, DEFINITIONS_MAX, EXCEPT_MAX, FileChecks, IdentityFile, LISTEN_MAX, PARTNERS_MAX,
    RECIPIENTS_MAX, ROUTERS_MAX, SHARES_MAX, SOCKET_PATH_BYTES_MAX, SUITES, TRUST_MAX, USES_MAX,
};
pub use ros_env::{DOMAIN_ID_MAX, Environment, STATIC_PEERS_MAX};
pub use router_url::{RouterUrl, RouterUrlError, SRV_SERVICE, SrvDomain, WAYS_MAX};
pub use schema::{Table, nearest};
pub use sgc_ros::{Interface, Naming, QosOverride, Rename, Resume, Shaping, TOPIC_BYTES_MAX};
pub use units::{parse_duration, parse_rate};
pub use zenoh::{
    Middleware, RouterCheck, ZENOH_OVERRIDE_KEY_BYTES_MAX, ZENOH_OVERRIDE_VALUE_BYTES_MAX,
    ZENOH_OVERRIDES_MAX, ZENOH_ROUTER_BYTES_MAX, ZENOH_ROUTER_DEFAULT, ZenohConfig,
};

impl Config {
    /// Resolves the command line without reading any file. The ROS environment applies as with a file.
    pub fn from_args(args: &ArgsConfig, env: Environment<'_>) -> Result<Self, ConfigErrors> {
        Self::from_args_checked(args, env, None)
    }

    /// Resolves the command line as [`Config::from_args`] does, and applies `checks` to the files that it names.
    pub fn from_args_checked(
        args: &ArgsConfig,
        env: Environment<'_>,
        checks: Option<&FileChecks>,
    ) -> Result<Self, ConfigErrors> {
        let (draft, errors) = args::read(args);
        resolve::resolve(&draft, errors, Path::new(""), env, checks).map_err(ConfigErrors::new)
    }
}

/// Checks a message type from outside of a configuration. Returns it as `pkg/msg/Name`.
pub fn message_type(value: &str) -> Result<String, Mistake> {
    names::message_type("--type", value)
}

/// Resolves the text of a configuration without reading any file. Errors call it `file_name`.
pub fn parse(
    text: &str,
    file_name: &str,
    base_dir: &Path,
    env: Environment<'_>,
) -> Result<Config, ConfigErrors> {
    parse_checked(text, file_name, base_dir, env, None)
}

/// Resolves the text of a configuration as [`parse`] does, and applies `checks` to the files that it names.
pub fn parse_checked(
    text: &str,
    file_name: &str,
    base_dir: &Path,
    env: Environment<'_>,
    checks: Option<&FileChecks>,
) -> Result<Config, ConfigErrors> {
    match file::read(text, file_name) {
        (Some(draft), errors) => {
            resolve::resolve(&draft, errors, base_dir, env, checks).map_err(ConfigErrors::new)
        }
        (None, errors) => Err(ConfigErrors::new(errors)),
    }
}
