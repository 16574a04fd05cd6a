//! Children of this process that are runs of this same program: their environment, first line and log.

use std::fs;
use std::path::Path;

use serde::{Deserialize, Serialize};

/// Environment variables that would change the network that children join.
pub const ROS_VARIABLES: [&str; 5] = [
    "ROS_DOMAIN_ID",
    "ROS_LOCALHOST_ONLY",
    "ROS_AUTOMATIC_DISCOVERY_RANGE",
    "ROS_STATIC_PEERS",
    "CYCLONEDDS_URI",
];
/// Number of lines at the end of a log that are shown after a failure.
const LOG_LINES_SHOWN: usize = 5;

/// The line that `--print-ready` prints.
#[derive(Debug, Serialize, Deserialize)]
pub struct ReadyLine {
    /// The addresses on which the node listens, as URLs.
    pub ready: Vec<String>,
}

/// Returns the last lines of a log, if it has any.
pub fn last_lines(log: &Path) -> Vec<String> {
    let Ok(bytes) = fs::read(log) else { return Vec::new() };
    let text = String::from_utf8_lossy(&bytes);
    let lines: Vec<&str> = text.lines().filter(|line| !line.trim().is_empty()).collect();
    lines[lines.len().saturating_sub(LOG_LINES_SHOWN)..].iter().map(|line| (*line).to_owned()).collect()
}
