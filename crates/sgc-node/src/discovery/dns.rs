//! DNS: addresses of hosts, and the SRV records of a domain (RFC 2782).
//!
//! Answers of DNS are not authenticated. They are bounded here, and each router still has to prove its certificate.

use std::future::Future;
use std::net::SocketAddr;
use std::time::Duration;

use hickory_resolver::TokioResolver;
use hickory_resolver::config::{NameServerConfig, ResolverConfig};
use hickory_resolver::net::runtime::TokioRuntimeProvider;
use hickory_resolver::net::{DnsError as NoAnswer, NetError};
use hickory_resolver::proto::rr::RData;
use sgc_config::SrvDomain;
use tokio::time::timeout;

use super::srv_answer::{SrvAnswer, SrvTarget, TARGETS_MAX, TTL_MAX, TTL_MIN};

/// Most addresses that are taken of one host.
const ADDRESSES_MAX: usize = 8;
/// Time for a server to answer, and the number of attempts.
const QUERY_TIMEOUT: Duration = Duration::from_secs(2);
const QUERY_ATTEMPTS: usize = 2;
/// Time for a whole look-up, including all servers and attempts.
const LOOKUP_MAX: Duration = Duration::from_secs(10);
const REASON_CHARS_MAX: usize = 200;

/// The questions that DNS answers. Tests implement it without DNS.
pub(crate) trait Names: Clone + Send + Sync + 'static {
    /// Returns the routers of a domain.
    fn routers(&self, domain: &SrvDomain) -> impl Future<Output = Result<SrvAnswer, DnsError>> + Send;
    /// Returns the addresses of a host.
    fn addresses(
        &self,
        host: &str,
        port: u16,
    ) -> impl Future<Output = Result<Vec<SocketAddr>, DnsError>> + Send;
}

/// Reasons why DNS yields no router.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum DnsError {
    /// The system's configuration cannot be read.
    #[error(
        "the system's DNS servers are not known ({0}): look at /etc/resolv.conf, or name one with `resolver` in [node]"
    )]
    System(String),
    /// No server answered without an error.
    #[error("{name} cannot be looked up: {reason}")]
    NoAnswer {
        /// The name in question.
        name: String,
        /// The error instead of an answer.
        reason: String,
    },
    /// The record does not exist.
    #[error(
        "DNS has no record {name}: the keeper of the domain has to add SRV records that name its routers"
    )]
    NoRecord {
        /// The name in question.
        name: String,
    },
    /// The domain declares that it has no routers.
    #[error("{name} says that this domain offers no routers (its target is \".\")")]
    NotOffered {
        /// The name in question.
        name: String,
    },
    /// None of the records is usable.
    #[error("the SRV records of {name} name no host and port that can be dialled")]
    Useless {
        /// The name in question.
        name: String,
    },
    /// The host has no address.
    #[error("{host} has no address in DNS")]
    NoAddress {
        /// The host.
        host: String,
    },
}

impl DnsError {
    /// Returns `true` if DNS answered authoritatively, in contrast to a failed look-up.
    pub(crate) fn is_final(&self) -> bool {
        !matches!(self, Self::System(_) | Self::NoAnswer { .. })
    }
}

/// Client of the system's DNS servers, or of a configured one.
#[derive(Clone, Debug, Default)]
pub(crate) struct Dns {
    server: Option<SocketAddr>,
}

impl Dns {
    /// Creates a client of this server, or of the system's servers.
    pub(crate) fn new(server: Option<SocketAddr>) -> Self {
        Self { server }
    }

    /// Returns `true` if the user configured a server.
    pub(crate) fn is_chosen(&self) -> bool {
        self.server.is_some()
    }

    /// Creates a resolver for one look-up. It is not reused, because the servers change when a robot changes networks.
    /// Callers cache answers.
    fn resolver(&self) -> Result<TokioResolver, DnsError> {
        let system = |error: NetError| DnsError::System(printable(&error));
        let mut builder = match self.server {
            None => TokioResolver::builder_tokio().map_err(system)?,
            Some(server) => {
                let mut config = NameServerConfig::udp_and_tcp(server.ip());
                config.connections.iter_mut().for_each(|c| c.port = server.port());
                let config = ResolverConfig::from_parts(None, Vec::new(), vec![config]);
                TokioResolver::builder_with_config(config, TokioRuntimeProvider::default())
            }
        };
        let options = builder.options_mut();
        (options.timeout, options.attempts) = (QUERY_TIMEOUT, QUERY_ATTEMPTS);
        builder.build().map_err(system)
    }

    async fn bounded<T>(
        name: &str,
        lookup: impl Future<Output = Result<T, NetError>>,
        none: impl FnOnce() -> DnsError,
    ) -> Result<T, DnsError> {
        match timeout(LOOKUP_MAX, lookup).await {
            Ok(Ok(found)) => Ok(found),
            Ok(Err(NetError::Dns(NoAnswer::NoRecordsFound(_)))) => Err(none()),
            Ok(Err(error)) => Err(DnsError::NoAnswer { name: shown(name), reason: printable(&error) }),
            Err(_) => {
                let reason = format!("no answer within {} s", LOOKUP_MAX.as_secs());
                Err(DnsError::NoAnswer { name: shown(name), reason })
            }
        }
    }
}

impl Names for Dns {
    async fn routers(&self, domain: &SrvDomain) -> Result<SrvAnswer, DnsError> {
        let query = domain.query();
        let resolver = self.resolver()?;
        let none = || DnsError::NoRecord { name: shown(&query) };
        let lookup = Self::bounded(&query, resolver.srv_lookup(query.as_str()), none).await?;
        let mut ttl = TTL_MAX;
        let mut targets = Vec::new();
        let mut is_offered = true;
        for record in lookup.answers() {
            let RData::SRV(srv) = &record.data else { continue };
            ttl = ttl.min(Duration::from_secs(record.ttl.into()));
            if srv.target.is_root() {
                is_offered = false;
                continue;
            }
            let host = srv.target.to_ascii();
            let host = host.strip_suffix('.').unwrap_or(&host).to_owned();
            let target = SrvTarget { priority: srv.priority, weight: srv.weight, host, port: srv.port };
            if target.is_usable() && !targets.contains(&target) {
                targets.push(target);
            }
        }
        // Keep the targets with the best priority.
        targets.sort_by_key(|target| target.priority);
        targets.truncate(TARGETS_MAX);
        match (targets.is_empty(), is_offered) {
            (false, _) => Ok(SrvAnswer { targets, ttl: ttl.max(TTL_MIN) }),
            (true, false) => Err(DnsError::NotOffered { name: shown(&query) }),
            (true, true) => Err(DnsError::Useless { name: shown(&query) }),
        }
    }

    async fn addresses(&self, host: &str, port: u16) -> Result<Vec<SocketAddr>, DnsError> {
        let resolver = self.resolver()?;
        let none = || DnsError::NoAddress { host: host.to_owned() };
        // A trailing dot disables the search list, which is meant for typed names.
        let absolute =
            if host.parse::<std::net::IpAddr>().is_ok() { host.to_owned() } else { format!("{host}.") };
        let found = Self::bounded(&absolute, resolver.lookup_ip(absolute.as_str()), none).await?;
        let mut addresses: Vec<SocketAddr> = Vec::new();
        for address in found.iter().map(|ip| SocketAddr::new(ip, port)) {
            if addresses.len() < ADDRESSES_MAX && !addresses.contains(&address) {
                addresses.push(address);
            }
        }
        if addresses.is_empty() { Err(none()) } else { Ok(addresses) }
    }
}

/// Formats a name for people.
fn shown(query: &str) -> String {
    query.strip_suffix('.').unwrap_or(query).to_owned()
}

/// Formats an error of the library for a log. The error may quote text from the network.
fn printable(error: &NetError) -> String {
    error.to_string().chars().filter(|c| !c.is_control()).take(REASON_CHARS_MAX).collect()
}
