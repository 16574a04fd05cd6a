//! The filter of the log: levels, and levels of single targets.

use tracing_subscriber::EnvFilter;
use tracing_subscriber::filter::LevelFilter;

/// The log targets: the names of the crates that log.
const LOG_TARGETS: [&str; 18] = [
    "sgc",
    "sgc_cdr",
    "sgc_dds",
    "sgc_demo",
    "sgc_endpoint",
    "sgc_gateway",
    "sgc_http",
    "sgc_measure",
    "sgc_node",
    "sgc_ros",
    "sgc_router",
    "sgc_store",
    "sgc_sync",
    "sgc_transport",
    "sgc_trust",
    "sgc_types",
    "sgc_wire",
    "sgc_zenoh_network",
];

/// Reads `LEVEL` and `TARGET=LEVEL`, separated by commas. Refuses a bare word that is no level: the parser would take
/// it for a target and log nothing of all others, so a typing error would silence the log.
pub(crate) fn log_filter(text: &str) -> Result<EnvFilter, LogFilterError> {
    let directives: Vec<_> = text.split(',').map(str::trim).collect();
    for directive in &directives {
        let (target, level) = match directive.split_once('=') {
            Some((target, level)) => (Some(target), level),
            None => (None, *directive),
        };
        if level.is_empty() || level.parse::<LevelFilter>().is_err() {
            return Err(LogFilterError::Level { written: level.to_owned() });
        }
        let Some(target) = target else { continue };
        let is_path = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | ':' | '-');
        let name = target.split("::").next().unwrap_or_default();
        if name.is_empty() || !target.chars().all(is_path) {
            return Err(LogFilterError::Target { written: target.to_owned() });
        }
        if name.starts_with("sgc") && !LOG_TARGETS.contains(&name) {
            return Err(LogFilterError::UnknownTarget { written: name.to_owned() });
        }
    }
    // Strangers can have the ICE agent warn of odd messages, and Zenoh of a router that is not there, which the node itself
    // reports. Whoever names them hears it.
    let quiet = ["is=error", "zenoh=error"];
    EnvFilter::builder()
        .parse(quiet.iter().chain(&directives).copied().collect::<Vec<_>>().join(","))
        .map_err(|error| LogFilterError::Other { reason: error.to_string() })
}

/// The mistake in a log filter.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum LogFilterError {
    /// An unknown level.
    #[error(
        "{written:?} is no level: write off, error, warn, info, debug or trace, or TARGET=LEVEL, such as \
         sgc_node=debug,info"
    )]
    Level {
        /// The text as written.
        written: String,
    },
    /// A target that is no name of a crate or module.
    #[error("{written:?} is no target: write the name of a crate or a module, such as sgc_node=debug,info")]
    Target {
        /// The text as written.
        written: String,
    },
    /// A target that looks like a crate of SGC and is none.
    #[error("{written:?} is no part of SGC: write one of {}", LOG_TARGETS.join(", "))]
    UnknownTarget {
        /// The text as written.
        written: String,
    },
    /// Another mistake that the parser refuses.
    #[error("{reason}; write info, debug or sgc_node=debug,info, for example")]
    Other {
        /// The parser's message.
        reason: String,
    },
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn log_filter_consists_of_levels_and_targets() {
        for right in [
            "info",
            "WARN",
            "off",
            "sgc_node=debug,info",
            "sgc_node::core=trace, quinn=off",
            "sgc=info",
            "sgc_sync=debug",
            "is=trace",
        ] {
            assert!(log_filter(right).is_ok(), "{right}");
        }
        let shown = |text: &str| log_filter(text).map(|filter| filter.to_string());
        assert_eq!(shown("info"), Ok("zenoh=error,is=error,info".to_owned()));
        assert_eq!(shown("is=debug,warn"), Ok("zenoh=error,is=debug,warn".to_owned()));
        let level = |written: &str| LogFilterError::Level { written: written.to_owned() };
        let target = |written: &str| LogFilterError::Target { written: written.to_owned() };
        for (wrong, error) in [
            ("verbose", level("verbose")),
            ("", level("")),
            ("info,", level("")),
            ("sgc_node", level("sgc_node")),
            ("sgc_node=loud", level("loud")),
            ("sgc_node=", level("")),
            ("info=sgc_node", level("sgc_node")),
            ("=info", target("")),
            ("sgc_node[span]=info", target("sgc_node[span]")),
            ("sgc_nod=info", LogFilterError::UnknownTarget { written: "sgc_nod".to_owned() }),
        ] {
            assert_eq!(log_filter(wrong).map(drop), Err(error), "{wrong}");
        }
    }

    #[test]
    fn log_targets_list_every_crate_that_logs() {
        const SILENT: [&str; 11] = [
            "sgc_config",
            "sgc_dashboard",
            "sgc_diagnosis",
            "sgc_executor",
            "sgc_fuzz_targets",
            "sgc_otlp",
            "sgc_process",
            "sgc_session",
            "sgc_testkit",
            "sgc_websocket",
            "sgc_zenoh",
        ];
        let crates = std::fs::read_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/..")).unwrap();
        let names = crates.map(|entry| entry.unwrap().file_name().to_string_lossy().replace('-', "_"));
        let mut names: Vec<_> = names.filter(|name| !SILENT.contains(&&**name)).collect();
        names.sort();
        assert_eq!(names, LOG_TARGETS);
    }
}
