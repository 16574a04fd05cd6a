//! The `[metrics]` table.

use std::fmt;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

use http::Uri;
use http::uri::Scheme;

/// The port at which exporters for Prometheus usually listen, as the specification of OpenTelemetry has it
/// (`OTEL_EXPORTER_PROMETHEUS_PORT`).
const METRICS_PORT: u16 = 9464;
/// Most bytes of the URL of a collector.
const OTLP_URL_BYTES_MAX: usize = 1024;
/// The path for metrics below the base URL of a collector.
const METRICS_PATH: &str = "/v1/metrics";

/// The metrics and the health of the node: a server, and pushes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MetricsConfig {
    /// The listening address of the HTTP server; port 0 lets the system choose.
    pub listen: SocketAddr,
    /// Pushes to an OpenTelemetry collector.
    pub otlp: Option<OtlpConfig>,
}

/// Pushes of metrics by OTLP over HTTP.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct OtlpConfig {
    /// The collector.
    pub url: OtlpUrl,
    /// The time from one push to the next.
    pub interval: Duration,
    /// A file with headers for each request, such as a token.
    pub headers_file: Option<PathBuf>,
    /// A file with the CAs of the collector, instead of those of the system.
    pub ca: Option<PathBuf>,
}

impl OtlpConfig {
    /// The usual interval, that of OpenTelemetry (`OTEL_METRIC_EXPORT_INTERVAL`).
    pub const INTERVAL: Duration = Duration::from_secs(60);
    /// The shortest interval. The values of a node are a second old at most.
    pub const INTERVAL_MIN: Duration = Duration::from_secs(1);
    /// The longest interval.
    pub const INTERVAL_MAX: Duration = Duration::from_secs(86_400);

    /// Creates pushes at the usual interval.
    pub fn new(url: OtlpUrl) -> Self {
        Self { url, interval: Self::INTERVAL, headers_file: None, ca: None }
    }
}

impl MetricsConfig {
    /// Returns warnings for the operator, one sentence each.
    pub fn warnings(&self) -> Vec<String> {
        let Self { listen, otlp } = self;
        let mut warnings = Vec::new();
        if !listen.ip().to_canonical().is_loopback() {
            warnings.push(format!(
                "metrics: http://{listen} is neither encrypted nor protected: whoever reaches it learns the names of topics, \
                 nodes and routers, and how much flows. Let only the host of Prometheus in, by a firewall"
            ));
        }
        if let Some(OtlpConfig { url, headers_file, .. }) = otlp.as_ref().filter(|otlp| otlp.url.is_open()) {
            let secrets = if headers_file.is_some() { ", and the headers with their token" } else { "" };
            warnings.push(format!(
                "metrics: pushes to {url} are not encrypted: others on the way can read the names of topics, nodes and \
                 routers, and how much flows{secrets}. Use https://"
            ));
        }
        warnings
    }
}

impl Default for MetricsConfig {
    fn default() -> Self {
        Self { listen: (Ipv4Addr::LOCALHOST, METRICS_PORT).into(), otlp: None }
    }
}

/// The URL at which a collector takes metrics by OTLP over HTTP. Its text has the whole path.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct OtlpUrl {
    is_encrypted: bool,
    /// A name or an IP address, without brackets.
    host: String,
    port: u16,
    /// The host, and the port unless it is the scheme's usual one.
    authority: String,
    path: String,
}

/// Reasons why a text is no URL of a collector.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum OtlpUrlError {
    /// It is no URL with a host.
    #[error("it takes the URL of a collector, such as \"http://collector.example:4318\"")]
    NoUrl,
    /// The scheme is another one.
    #[error("it takes http:// or https://, since metrics are pushed by OTLP over HTTP")]
    Scheme,
    /// The port of OTLP over gRPC.
    #[error(
        "4317 is the port of OTLP over gRPC, and this is OTLP over HTTP: collectors usually have it at port 4318"
    )]
    GrpcPort,
    /// A user or a password is in it.
    #[error("it has a user or a password")]
    Credentials,
    /// A query or a fragment is in it.
    #[error("it has a query or a fragment, which OTLP does not know")]
    Query,
    /// The text is too long.
    #[error("it has more than {OTLP_URL_BYTES_MAX} bytes")]
    TooLong,
}

impl OtlpUrl {
    /// Returns `true` if the connection has TLS.
    pub fn is_encrypted(&self) -> bool {
        self.is_encrypted
    }

    /// Returns the host: a name, or an IP address without brackets.
    pub fn host(&self) -> &str {
        &self.host
    }

    /// Returns the port.
    pub fn port(&self) -> u16 {
        self.port
    }

    /// Returns the host and the port as the URL has them.
    pub fn authority(&self) -> &str {
        &self.authority
    }

    /// Returns the path of requests for metrics.
    pub fn path(&self) -> &str {
        &self.path
    }

    /// Returns `true` if others on the way can read everything.
    fn is_open(&self) -> bool {
        let is_loopback = self.host.parse().is_ok_and(|ip: IpAddr| ip.to_canonical().is_loopback());
        !self.is_encrypted && !is_loopback && self.host != "localhost"
    }
}

impl fmt::Display for OtlpUrl {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let scheme = if self.is_encrypted { "https" } else { "http" };
        write!(f, "{scheme}://{}{}", self.authority, self.path)
    }
}

impl FromStr for OtlpUrl {
    type Err = OtlpUrlError;

    fn from_str(text: &str) -> Result<Self, OtlpUrlError> {
        const GRPC_PORT: u16 = 4317;
        if text.len() > OTLP_URL_BYTES_MAX {
            return Err(OtlpUrlError::TooLong);
        }
        // `http` drops fragments without a word.
        if text.contains(['?', '#']) {
            return Err(OtlpUrlError::Query);
        }
        let uri: Uri = text.parse().map_err(|_| OtlpUrlError::NoUrl)?;
        let authority = uri.authority().ok_or(OtlpUrlError::NoUrl)?;
        let is_encrypted = match uri.scheme() {
            Some(scheme) if *scheme == Scheme::HTTP => false,
            Some(scheme) if *scheme == Scheme::HTTPS => true,
            Some(_) => return Err(OtlpUrlError::Scheme),
            None => return Err(OtlpUrlError::NoUrl),
        };
        if authority.as_str().contains('@') {
            return Err(OtlpUrlError::Credentials);
        }
        let host = authority.host().trim_start_matches('[').trim_end_matches(']').to_ascii_lowercase();
        let port = match authority.port_u16() {
            Some(0) => return Err(OtlpUrlError::NoUrl),
            Some(GRPC_PORT) => return Err(OtlpUrlError::GrpcPort),
            Some(port) => port,
            None if authority.as_str().ends_with(']') || !authority.as_str().contains(':') => {
                if is_encrypted { 443 } else { 80 }
            }
            // Such as `host:` and `host:99999`.
            None => return Err(OtlpUrlError::NoUrl),
        };
        if host.is_empty() || authority.host().starts_with('[') != host.contains(':') {
            return Err(OtlpUrlError::NoUrl);
        }
        let base = uri.path().trim_end_matches('/');
        let path =
            if base.ends_with(METRICS_PATH) { base.to_owned() } else { format!("{base}{METRICS_PATH}") };
        Ok(Self { is_encrypted, host, port, authority: authority.as_str().to_ascii_lowercase(), path })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn base_url_gets_the_path_of_metrics() {
        for (text, shown, host, port) in [
            (
                "http://collector.example:4318",
                "http://collector.example:4318/v1/metrics",
                "collector.example",
                4318,
            ),
            ("https://Otlp.Example/", "https://otlp.example/v1/metrics", "otlp.example", 443),
            ("http://10.0.0.1", "http://10.0.0.1/v1/metrics", "10.0.0.1", 80),
            ("http://[::1]:4318", "http://[::1]:4318/v1/metrics", "::1", 4318),
            ("https://[2001:db8::1]", "https://[2001:db8::1]/v1/metrics", "2001:db8::1", 443),
            ("https://a.example/otlp/", "https://a.example/otlp/v1/metrics", "a.example", 443),
            ("https://a.example/otlp/v1/metrics", "https://a.example/otlp/v1/metrics", "a.example", 443),
        ] {
            let url: OtlpUrl = text.parse().unwrap();
            assert_eq!((url.to_string().as_str(), url.host(), url.port()), (shown, host, port), "{text}");
            assert_eq!(url.is_encrypted(), text.starts_with("https"));
        }
    }

    #[test]
    fn other_texts_are_no_collector() {
        for (text, fault) in [
            ("", OtlpUrlError::NoUrl),
            ("collector.example", OtlpUrlError::NoUrl),
            ("collector.example:4318", OtlpUrlError::NoUrl),
            ("/v1/metrics", OtlpUrlError::NoUrl),
            ("http://", OtlpUrlError::NoUrl),
            ("http://:4318", OtlpUrlError::NoUrl),
            ("http://a:0", OtlpUrlError::NoUrl),
            ("http://a:", OtlpUrlError::NoUrl),
            ("http://a:99999", OtlpUrlError::NoUrl),
            ("http://a b", OtlpUrlError::NoUrl),
            ("grpc://a:4318", OtlpUrlError::Scheme),
            ("http://a:4317", OtlpUrlError::GrpcPort),
            ("https://user:password@a", OtlpUrlError::Credentials),
            ("https://token@a", OtlpUrlError::Credentials),
            ("https://a/?key=1", OtlpUrlError::Query),
            ("https://a/#x", OtlpUrlError::Query),
            (&format!("http://a/{}", "x".repeat(OTLP_URL_BYTES_MAX)), OtlpUrlError::TooLong),
        ] {
            assert_eq!(text.parse::<OtlpUrl>(), Err(fault), "{text}");
        }
    }

    #[test]
    fn pushes_in_clear_are_warned_of() {
        let warnings = |url: &str| {
            let otlp = Some(OtlpConfig::new(url.parse().unwrap()));
            MetricsConfig { otlp, ..MetricsConfig::default() }.warnings()
        };
        for url in
            ["https://a.example", "http://localhost:4318", "http://127.0.0.2:4318", "http://[::1]:4318"]
        {
            assert_eq!(warnings(url), Vec::<String>::new(), "{url}");
        }
        assert!(
            warnings("http://a.example:4318")[0]
                .contains("http://a.example:4318/v1/metrics are not encrypted")
        );
    }
}
