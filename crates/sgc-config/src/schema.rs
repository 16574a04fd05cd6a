//! Tables and keys of a configuration, planned keys, and suggestions for misspelt ones.
//!
//! A key is defined here only; `docs/reference/configuration.md` is tested against this table. `resolve` checks the
//! values.

/// A table of the file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Table {
    /// Keys before the first header.
    Top,
    /// `[node]`
    Node,
    /// `[ros]`
    Ros,
    /// `[ros.zenoh]`
    RosZenoh,
    /// `[share.deadman]`
    ShareDeadMan,
    /// `[use.deadman]`
    UseDeadMan,
    /// `[[share]]`
    Share,
    /// `[[use]]`
    Use,
    /// `[router]`
    Router,
    /// `[transport]`
    Transport,
    /// `[admin]`
    Admin,
    /// `[authority]`
    Authority,
    /// `[rotation]`
    Rotation,
    /// `[audit]`
    Audit,
    /// `[[partner]]`
    Partner,
    /// `[metrics]`
    Metrics,
    /// `[gateway]`
    Gateway,
    /// `[[gateway.client]]`
    GatewayClient,
}

impl Table {
    /// All tables, in the order of the reference.
    pub const ALL: [Self; 18] = [
        Self::Top,
        Self::Node,
        Self::Ros,
        Self::RosZenoh,
        Self::ShareDeadMan,
        Self::UseDeadMan,
        Self::Share,
        Self::Use,
        Self::Partner,
        Self::Gateway,
        Self::GatewayClient,
        Self::Router,
        Self::Transport,
        Self::Authority,
        Self::Rotation,
        Self::Audit,
        Self::Metrics,
        Self::Admin,
    ];

    /// Returns the table's header, brackets included.
    pub fn header(self) -> &'static str {
        match self {
            Self::Top => "the top level",
            Self::Node => "[node]",
            Self::Ros => "[ros]",
            Self::RosZenoh => "[ros.zenoh]",
            Self::ShareDeadMan => "[share.deadman]",
            Self::UseDeadMan => "[use.deadman]",
            Self::Share => "[[share]]",
            Self::Use => "[[use]]",
            Self::Router => "[router]",
            Self::Transport => "[transport]",
            Self::Admin => "[admin]",
            Self::Authority => "[authority]",
            Self::Rotation => "[rotation]",
            Self::Audit => "[audit]",
            Self::Partner => "[[partner]]",
            Self::Metrics => "[metrics]",
            Self::Gateway => "[gateway]",
            Self::GatewayClient => "[[gateway.client]]",
        }
    }

    /// Returns the supported keys.
    pub fn keys(self) -> &'static [&'static str] {
        match self {
            Self::Top => &[
                "identity",
                "node",
                "ros",
                "share",
                "use",
                "partner",
                "gateway",
                "router",
                "transport",
                "authority",
                "rotation",
                "audit",
                "metrics",
                "admin",
            ],
            Self::Node => &[
                "name",
                "routers",
                "resolver",
                "keep_alive",
                "direct",
                "port_mapping",
                "identity",
                "state",
                "trust",
                "watch",
            ],
            Self::Ros => &[
                "middleware",
                "domain_id",
                "discovery_range",
                "localhost_only",
                "static_peers",
                "graph",
                "definitions",
                "enclave",
                "security_root",
                "zenoh",
            ],
            Self::RosZenoh => &["router", "config"],
            Self::ShareDeadMan | Self::UseDeadMan => &["after", "publish", "repeat", "resume"],
            Self::Share => &[
                "topic",
                "service",
                "action",
                "parameters",
                "except",
                "as",
                "namespace",
                "to",
                "publish",
                "type",
                "priority",
                "max_rate",
                "max_bandwidth",
                "max_age",
                "compress",
                "encoding",
                "reliability",
                "durability",
                "history",
                "depth",
                "deadline",
                "lifespan",
                "deadman",
                "link",
                "suite",
                "description",
                "author",
                "maintainer",
                "interface",
                "unique",
                "node",
            ],
            Self::Use => &[
                "from",
                "topic",
                "service",
                "action",
                "parameters",
                "except",
                "as",
                "namespace",
                "frame_prefix",
                "type",
                "publish",
                "priority",
                "max_rate",
                "max_bandwidth",
                "max_age",
                "compress",
                "encoding",
                "reliability",
                "durability",
                "history",
                "depth",
                "deadline",
                "lifespan",
                "token",
                "deadman",
                "link",
            ],
            Self::Router => &[
                "listen",
                "peer_rate",
                "mapping",
                "store",
                "store_prefix",
                "store_user",
                "store_password_file",
                "store_ca",
                "store_certificate",
                "store_key",
                "announce",
                "accept",
            ],
            Self::Transport => {
                &["congestion", "offload", "mtu_discovery", "bulk_lanes", "dtls_1_2", "dscp", "lane_dscp"]
            }
            Self::Admin => &["socket", "observers"],
            Self::Authority => &["fleet", "operators"],
            Self::Rotation => &["every", "messages"],
            Self::Audit => &["file", "max_bytes", "files", "off"],
            Self::Metrics => &["listen", "otlp", "otlp_interval", "otlp_headers_file", "otlp_ca"],
            Self::Partner => &["name", "ca", "node"],
            Self::Gateway => &[
                "listen",
                "certificate",
                "key",
                "names",
                "anonymous",
                "origins",
                "plain",
                "clients_max",
                "client_bytes_max",
                "client",
            ],
            Self::GatewayClient => &["who", "subscribe", "publish", "call", "serve"],
        }
    }

    /// Returns the keys of the design that are not implemented yet.
    pub fn planned_keys(self) -> &'static [&'static str] {
        match self {
            Self::Top => &["profile"],
            Self::Ros
            | Self::RosZenoh
            | Self::ShareDeadMan
            | Self::UseDeadMan
            | Self::Node
            | Self::Router
            | Self::Transport
            | Self::Admin
            | Self::Authority
            | Self::Rotation
            | Self::Audit
            | Self::Metrics
            | Self::Partner
            | Self::Gateway
            | Self::GatewayClient => &[],
            Self::Share | Self::Use => &[],
        }
    }

    /// Returns the tables that have `key`, with the key. Tables within tables do not count: a `router` in `[node]` is
    /// no misplaced `[router]`. Nor do the keys of `[ros.zenoh]` and of dead-man switches, whose words are too common.
    pub(crate) fn homes(key: &str) -> Option<(&'static str, Vec<&'static str>)> {
        let has = |table: &&Self| {
            let counts = match table {
                Self::Top => key == "identity",
                Self::RosZenoh | Self::ShareDeadMan | Self::UseDeadMan => false,
                _ => true,
            };
            counts && table.keys().contains(&key)
        };
        let homes: Vec<Self> = Self::ALL.iter().filter(has).copied().collect();
        let known = homes.first()?.keys().iter().find(|known| **known == key)?;
        Some((known, homes.into_iter().map(Self::header).collect()))
    }
}

/// Returns the candidate that `word` was probably meant to be: at most one edit per three characters away, or
/// containing the word. Case is ignored.
pub fn nearest<'c>(word: &str, candidates: &[&'c str]) -> Option<&'c str> {
    const PART_CHARS_MIN: usize = 4;
    let word = word.to_lowercase();
    let chars = word.chars().count();
    let edits_max = (chars / 3).clamp(1, 3);
    let close = candidates
        .iter()
        .map(|candidate| (edits(&word, &candidate.to_lowercase()), *candidate))
        .filter(|(edits, candidate)| *edits <= edits_max && *edits < candidate.len())
        .min_by_key(|(edits, _)| *edits)
        .map(|(_, candidate)| candidate);
    let has_part =
        |candidate: &&&str| chars >= PART_CHARS_MIN && candidate.to_lowercase().contains(word.as_str());
    close.or_else(|| candidates.iter().find(has_part).copied())
}

/// Returns the number of insertions, deletions, substitutions and swaps of neighbours that turn `a` into `b` (optimal
/// string alignment). Long words are not compared, to bound the cost.
fn edits(a: &str, b: &str) -> usize {
    const WORD_CHARS_MAX: usize = 64;
    let (a, b): (Vec<char>, Vec<char>) = (a.chars().collect(), b.chars().collect());
    if a.len().max(b.len()) > WORD_CHARS_MAX {
        return usize::MAX;
    }
    let mut rows = vec![vec![0; b.len() + 1]; a.len() + 1];
    for i in 0..=a.len() {
        for j in 0..=b.len() {
            rows[i][j] = if i == 0 || j == 0 {
                i + j
            } else {
                let substitute = rows[i - 1][j - 1] + usize::from(a[i - 1] != b[j - 1]);
                let best = substitute.min(rows[i - 1][j] + 1).min(rows[i][j - 1] + 1);
                let swapped = i > 1 && j > 1 && a[i - 1] == b[j - 2] && a[i - 2] == b[j - 1];
                if swapped { best.min(rows[i - 2][j - 2] + 1) } else { best }
            };
        }
    }
    rows[a.len()][b.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn edits_counts_each_kind_once() {
        for (a, b, expected) in [
            ("topic", "topic", 0),
            ("tpoic", "topic", 1),
            ("topc", "topic", 1),
            ("topicc", "topic", 1),
            ("tobic", "topic", 1),
            ("", "to", 2),
            ("listen", "use", 4),
        ] {
            assert_eq!(edits(a, b), expected, "{a} {b}");
        }
    }

    #[test]
    fn only_a_likely_word_is_suggested() {
        let keys = Table::Share.keys();
        assert_eq!(nearest("tpoic", keys), Some("topic"));
        assert_eq!(nearest("Topics", keys), Some("topic"));
        assert_eq!(nearest("maintaner", keys), Some("maintainer"));
        assert_eq!(nearest("name", keys), Some("namespace"));
        assert_eq!(nearest("colour", keys), None);
        assert_eq!(nearest("domain", Table::Ros.keys()), Some("domain_id"));
        assert_eq!(nearest("localhost", &["OFF", "LOCALHOST"]), Some("LOCALHOST"));
        assert_eq!(nearest("x", keys), None);
        assert_eq!(nearest(&"x".repeat(1000), keys), None);
    }

    #[test]
    fn no_key_is_both_here_and_planned() {
        for table in Table::ALL {
            for key in table.planned_keys() {
                assert!(!table.keys().contains(key), "{} {key}", table.header());
            }
        }
    }
}
