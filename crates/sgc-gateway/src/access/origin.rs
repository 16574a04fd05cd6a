//! The origin of a page in a browser: the `Origin` header, which browsers send and programs do not.
//!
//! A page from anywhere may open a WebSocket to any address that its browser reaches, this host included (cross-site
//! WebSocket hijacking). The `Origin` header, which a page cannot change, prevents that.

use std::fmt;
use std::net::{Ipv4Addr, Ipv6Addr};
use std::str::FromStr;

/// Longest origin, in bytes.
pub const ORIGIN_BYTES_MAX: usize = 300;

const FILE: &str = "file://";

/// An origin such as `https://app.example.org`, or `file://` for pages from files. It is in lower case and leaves out
/// the default port of its scheme (RFC 6454, 6.1).
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PageOrigin(Box<str>);

impl PageOrigin {
    /// Returns `true` for a page that the host of the browser serves to itself.
    pub fn is_loopback(&self) -> bool {
        let Some((scheme, authority)) = self.0.split_once("://") else { return false };
        let host = host_and_port(authority).map(|(host, _)| host);
        matches!(scheme, "http" | "https") && host.is_some_and(is_loopback)
    }
}

impl FromStr for PageOrigin {
    type Err = PageOriginError;

    fn from_str(text: &str) -> Result<Self, PageOriginError> {
        if text.len() > ORIGIN_BYTES_MAX {
            return Err(PageOriginError::TooLong { bytes: text.len() });
        }
        let text = text.to_ascii_lowercase();
        if text == "null" {
            return Err(PageOriginError::Null);
        }
        if text == FILE {
            return Ok(Self(FILE.into()));
        }
        let (scheme, authority) = text.split_once("://").ok_or(PageOriginError::Malformed)?;
        let is_scheme = scheme.starts_with(|c: char| c.is_ascii_lowercase())
            && scheme.bytes().all(|b| b.is_ascii_alphanumeric() || matches!(b, b'+' | b'-' | b'.'));
        if let Some((bare, _)) = authority.split_once(['/', '?', '#']) {
            return Err(PageOriginError::Path { right: format!("{scheme}://{bare}") });
        }
        let (host, port) =
            host_and_port(authority).filter(|_| is_scheme).ok_or(PageOriginError::Malformed)?;
        let port = port.filter(|port| !matches!((scheme, *port), ("http", 80) | ("https", 443)));
        Ok(Self(match port {
            Some(port) => format!("{scheme}://{host}:{port}").into(),
            None => format!("{scheme}://{host}").into(),
        }))
    }
}

/// Splits an authority into host and port, if both are valid. An IPv6 address keeps its brackets.
fn host_and_port(authority: &str) -> Option<(&str, Option<u16>)> {
    let end = if authority.starts_with('[') { authority.find(']')? + 1 } else { 0 };
    let (host, port) = match authority[end..].find(':') {
        Some(colon) => {
            let digits = &authority[end + colon + 1..];
            let is_number = !digits.is_empty() && digits.bytes().all(|b| b.is_ascii_digit());
            (&authority[..end + colon], Some(digits.parse().ok().filter(|_| is_number)?))
        }
        None => (authority, None),
    };
    let is_host = match host.strip_prefix('[').and_then(|h| h.strip_suffix(']')) {
        Some(address) => address.parse::<Ipv6Addr>().is_ok(),
        None => {
            !host.is_empty()
                && host.bytes().all(|b| b.is_ascii_alphanumeric() || matches!(b, b'.' | b'-' | b'_'))
        }
    };
    is_host.then_some((host, port))
}

fn is_loopback(host: &str) -> bool {
    let v6 = host.strip_prefix('[').and_then(|h| h.strip_suffix(']'));
    host == "localhost"
        || host.parse().is_ok_and(|address: Ipv4Addr| address.is_loopback())
        || v6.and_then(|v6| v6.parse().ok()).is_some_and(|address: Ipv6Addr| address.is_loopback())
}

impl fmt::Display for PageOrigin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl fmt::Debug for PageOrigin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:?}", self.0)
    }
}

/// The reason why a text is not an origin.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PageOriginError {
    /// The text is too long.
    #[error("it has {bytes} bytes, at most {ORIGIN_BYTES_MAX} are allowed")]
    TooLong {
        /// The length in bytes.
        bytes: usize,
    },
    /// The origin `null`, which every page can make its browser send.
    #[error("\"null\" is what pages of anywhere can be made to say: name where the page is from")]
    Null,
    /// The text continues after the host or port.
    #[error("an origin ends with its host or port: \"{right}\"")]
    Path {
        /// The part that is an origin.
        right: String,
    },
    /// The text has another form.
    #[error(
        "it is no origin of pages: write \"https://dashboard.example.org\", with :PORT behind it if there is one"
    )]
    Malformed,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pages_that_a_host_serves_to_itself_are_known() {
        for (text, local) in [
            ("http://localhost", true),
            ("https://LocalHost:8443", true),
            ("http://127.0.0.1:5173", true),
            ("http://127.8.9.10", true),
            ("http://[::1]:80", true),
            ("http://localhost.evil.example", false),
            ("http://127.0.0.1.evil.example", false),
            ("http://[::2]", false),
            ("http://10.0.0.1", false),
            ("ftp://localhost", false),
            ("file://", false),
            ("https://app.foxglove.dev", false),
        ] {
            let origin: PageOrigin = text.parse().unwrap();
            assert_eq!(origin.is_loopback(), local, "{text}");
        }
    }

    #[test]
    fn origins_are_normalised() {
        for (text, shown) in [
            ("HTTPS://App.Example.org:443", "https://app.example.org"),
            ("http://robot.local:80", "http://robot.local"),
            ("http://robot.local:443", "http://robot.local:443"),
            ("http://[FE80::1]:9000", "http://[fe80::1]:9000"),
            ("vscode-webview://abc", "vscode-webview://abc"),
            ("file://", "file://"),
        ] {
            assert_eq!(text.parse::<PageOrigin>().unwrap().to_string(), shown);
        }
    }

    #[test]
    fn invalid_origins_are_explained() {
        let refused = |text: &str| text.parse::<PageOrigin>().unwrap_err();
        assert_eq!(refused("null"), PageOriginError::Null);
        let right = "https://a.example".to_owned();
        assert_eq!(refused("https://a.example/"), PageOriginError::Path { right });
        assert_eq!(refused(&"a".repeat(301)), PageOriginError::TooLong { bytes: 301 });
        for text in [
            "",
            "*",
            "localhost",
            "http://",
            "http://a@b",
            "http://localhost:",
            "http://a:99999",
            "http://a:+1",
            "http://[::1",
            "http://[x]",
            "http://\u{fc}",
            "http://a b",
            "1://a",
            "://a",
            "http://a:1:2",
        ] {
            assert_eq!(refused(text), PageOriginError::Malformed, "{text}");
        }
    }
}
