//! Detects Fast DDS's Discovery Server, which this node cannot join: participants that use one are invisible to all
//! others.
//!
//! It looks for `ROS_DISCOVERY_SERVER` in this process's environment and, where Linux permits, in those of processes on
//! the same network. It reports findings and decides nothing.

use std::collections::BTreeSet;
use std::fs;
use std::io::Read as _;
use std::path::Path;
use std::time::Duration;

use sgc_config::Environment;
use tracing::warn;

use crate::control::faults::alerts::Alert;

const VARIABLE: &str = "ROS_DISCOVERY_SERVER";
/// Most processes that are examined.
const PROCESSES_MAX: usize = 4096;
/// Most bytes that are read of one environment.
const ENVIRONMENT_BYTES_MAX: u64 = 64 << 10;
/// Most servers that are reported.
const FOUND_MAX: usize = 8;
/// Most characters of a server that are reported.
const SERVER_CHARS_MAX: usize = 200;
/// Interval of looks.
const LOOK_EVERY: Duration = Duration::from_secs(10);

/// Returns an alert for each Discovery Server that this environment or a program on the same network names.
pub fn alerts(env: Environment<'_>) -> Vec<Alert> {
    let own = env(VARIABLE).filter(|server| !server.is_empty());
    let own = own.map(|server| Alert::DiscoveryServer { server: shortened(&server), program: None });
    own.into_iter().chain(from_programs(Path::new("/proc"))).collect()
}

/// Looks periodically and logs news. Ends with the runtime.
pub(crate) async fn watch() {
    let mut known = BTreeSet::new();
    loop {
        let found = tokio::task::spawn_blocking(|| alerts(&|name| std::env::var(name).ok())).await;
        for alert in found.unwrap_or_default() {
            if let Alert::DiscoveryServer { server, program } = &alert
                && known.len() < FOUND_MAX
                && known.insert((server.clone(), program.is_some()))
            {
                warn!("{alert}; {}", alert.fix());
            }
        }
        tokio::time::sleep(LOOK_EVERY).await;
    }
}

/// Returns one alert for each server, with the first program that names it.
fn from_programs(proc: &Path) -> Vec<Alert> {
    let network = fs::read_link(proc.join("self/ns/net")).ok();
    let Ok(processes) = fs::read_dir(proc) else { return Vec::new() };
    let own = std::process::id();
    let mut found: Vec<(String, String)> = Vec::new();
    let numbers = processes.flatten().filter_map(|entry| entry.file_name().to_str()?.parse::<u32>().ok());
    for number in numbers.filter(|number| *number != own).take(PROCESSES_MAX) {
        let process = proc.join(number.to_string());
        let Some(server) = read(&process.join("environ")).and_then(|environment| server_in(&environment))
        else {
            continue;
        };
        let is_here = fs::read_link(process.join("ns/net")).ok() == network;
        if is_here && found.len() < FOUND_MAX && found.iter().all(|(known, _)| *known != server) {
            let name = read(&process.join("comm")).unwrap_or_default();
            let name = String::from_utf8_lossy(&name);
            found.push((server, format!("{} (process {number})", name.trim_end())));
        }
    }
    let alert = |(server, program)| Alert::DiscoveryServer { server, program: Some(program) };
    found.into_iter().map(alert).collect()
}

fn read(file: &Path) -> Option<Vec<u8>> {
    let mut text = Vec::new();
    fs::File::open(file).ok()?.take(ENVIRONMENT_BYTES_MAX).read_to_end(&mut text).ok()?;
    Some(text)
}

/// Returns the server that an environment names, from the text of Linux's `/proc/PID/environ`.
fn server_in(environment: &[u8]) -> Option<String> {
    environment.split(|byte| *byte == 0).find_map(|variable| {
        let value = variable.strip_prefix(VARIABLE.as_bytes())?.strip_prefix(b"=")?;
        // Fast DDS treats an empty variable as unset.
        (!value.is_empty()).then(|| shortened(&String::from_utf8_lossy(value)))
    })
}

fn shortened(server: &str) -> String {
    server.chars().take(SERVER_CHARS_MAX).collect()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    #[test]
    fn the_variable_is_found_in_an_environment() {
        let found = |text: &[u8]| server_in(text);
        assert_eq!(
            found(b"HOME=/\0ROS_DISCOVERY_SERVER=10.0.0.1:11811\0A=b\0").as_deref(),
            Some("10.0.0.1:11811")
        );
        assert_eq!(found(b"ROS_DISCOVERY_SERVER=\0"), None);
        assert_eq!(found(b"MY_ROS_DISCOVERY_SERVER=a\0ROS_DISCOVERY_SERVERS=b"), None);
        let long = [&b"ROS_DISCOVERY_SERVER="[..], &[b'1'; 9_000]].concat();
        assert_eq!(found(&long).unwrap().len(), SERVER_CHARS_MAX);
    }

    #[test]
    fn the_own_environment_is_named_without_a_program() {
        let found = alerts(&|name| (name == VARIABLE).then(|| "10.0.0.1".to_owned()));
        assert_eq!(found[0], Alert::DiscoveryServer { server: "10.0.0.1".into(), program: None });
        assert!(
            !alerts(&|_| Some(String::new()))
                .iter()
                .any(|alert| matches!(alert, Alert::DiscoveryServer { program: None, .. }))
        );
    }
}
