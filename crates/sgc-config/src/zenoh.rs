//! The table `[ros.zenoh]`: the local network of rmw_zenoh.

use std::path::PathBuf;
use std::time::Duration;

/// The router of a node that names none, as in rmw_zenoh's own session configuration.
pub const ZENOH_ROUTER_DEFAULT: &str = "tcp/localhost:7447";
/// Most bytes of a router's endpoint.
pub const ZENOH_ROUTER_BYTES_MAX: usize = 1024;
/// Most settings that `ZENOH_CONFIG_OVERRIDE` has.
pub const ZENOH_OVERRIDES_MAX: usize = 64;
/// Most bytes of the key of one such setting.
pub const ZENOH_OVERRIDE_KEY_BYTES_MAX: usize = 256;
/// Most bytes of the value of one such setting.
pub const ZENOH_OVERRIDE_VALUE_BYTES_MAX: usize = 16 * 1024;

/// The middleware of the local ROS 2 network.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Middleware {
    /// A DDS network: `rmw_fastrtps_cpp`, `rmw_cyclonedds_cpp` and the like.
    #[default]
    Dds,
    /// A network of `rmw_zenoh_cpp`.
    Zenoh,
    /// One network of each kind.
    Both,
}

impl Middleware {
    /// Returns `true` if the node joins a DDS network.
    pub fn has_dds(self) -> bool {
        matches!(self, Self::Dds | Self::Both)
    }

    /// Returns `true` if the node joins a network of rmw_zenoh.
    pub fn has_zenoh(self) -> bool {
        matches!(self, Self::Zenoh | Self::Both)
    }
}

/// The session of a network of rmw_zenoh. Its settings are, each before the next: rmw_zenoh's own defaults or, instead
/// of them, `config`; then `overrides`; then `router`.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ZenohConfig {
    /// The router's endpoint, `PROTOCOL/ADDRESS[?METADATA][#CONFIG]`. `None` leaves it to `overrides` and `config`, and
    /// is [`ZENOH_ROUTER_DEFAULT`] without both.
    pub router: Option<String>,
    /// A session configuration of Zenoh in a format that the file's extension names, such as JSON5.
    pub config: Option<PathBuf>,
    /// Settings of `ZENOH_CONFIG_OVERRIDE` in their order: keys such as `connect/endpoints`, and JSON5. At most
    /// [`ZENOH_OVERRIDES_MAX`].
    pub overrides: Vec<(String, String)>,
    /// Whether a missing router is reported.
    pub router_check: RouterCheck,
}

impl ZenohConfig {
    /// Returns the router's endpoint without its part behind `#`, which may be a private key. Returns `None` if
    /// `config` or `overrides` may name another router.
    pub fn router_address(&self) -> Option<&str> {
        let names_router = |key: &str| key == "connect" || key.starts_with("connect/endpoints");
        let is_elsewhere = self.config.is_some() || self.overrides.iter().any(|(key, _)| names_router(key));
        let usual = (!is_elsewhere).then_some(ZENOH_ROUTER_DEFAULT);
        let router = self.router.as_deref().or(usual)?;
        router.split('#').next()
    }
}

/// The report that no router is connected (`ZENOH_ROUTER_CHECK_ATTEMPTS`).
///
/// Programs of rmw_zenoh wait for a router while they start. A proxy does not: it connects whenever the router is
/// there, so only the report is left of the variable.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RouterCheck {
    /// No report, for networks without a router: a negative number of attempts.
    Off,
    /// One report if no router is connected within this time, at most [`RouterCheck::AFTER_MAX`]: as many seconds as
    /// attempts.
    After(Duration),
    /// Reports until a router is connected: 0 attempts, with which programs of rmw_zenoh wait without end.
    Repeated,
}

impl RouterCheck {
    /// The longest time before the one report. Larger numbers of attempts count as this time.
    pub const AFTER_MAX: Duration = Duration::from_secs(86_400);
}

impl Default for RouterCheck {
    /// Returns the check without the variable, which is that of one attempt.
    fn default() -> Self {
        Self::After(Duration::from_secs(1))
    }
}
