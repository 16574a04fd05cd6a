//! `sgc audit`: shows whom a node of this machine granted, refused and cut off.
//!
//! It reads the log that the node writes and its rotated files; the node need not run. Parts of a log come from other
//! machines, so control characters never reach the terminal.

use std::path::PathBuf;
use std::time::Duration;

use clap::Args;
use sgc_node::audit::{self, AuditEvent, AuditRecord};
use sgc_node::config::{self, Config};
use sgc_process::output::is_harmful;
use sgc_process::{ProcessError, unix_now};

use crate::environment::environment;
use crate::error::CliError;
use crate::output;
use crate::span::parse_span;

const FILE_NAME: &str = "audit.jsonl";

/// Show the audit log of a node: grants, refusals, revocations, links, reloads and access tokens.
#[derive(Debug, Args)]
pub(crate) struct AuditArgs {
    /// The node's configuration; without it, the one node that has a log in the usual place
    #[arg(short, long, value_name = "FILE", conflicts_with_all = ["node", "file"])]
    config: Option<PathBuf>,
    /// The node's name, if its log is in the usual place
    #[arg(long, value_name = "NAME", conflicts_with = "file")]
    node: Option<String>,
    /// Audit log file
    #[arg(long, value_name = "FILE")]
    file: Option<PathBuf>,
    /// Show only records of this topic
    #[arg(long, value_name = "/TOPIC")]
    topic: Option<String>,
    /// Show only records about this peer, by its name in the node's configuration or the first digits of its node id
    #[arg(long, value_name = "PEER")]
    about: Option<String>,
    /// Show only this event, such as refused; may be repeated
    #[arg(long = "event", value_name = "EVENT", value_parser = event)]
    events: Vec<String>,
    /// Show only records of the last TIME, such as 90s, 15min, 1h or 7d
    #[arg(long, value_name = "TIME", value_parser = parse_span)]
    since: Option<Duration>,
    /// Print the lines of JSON as they are in the log
    #[arg(long)]
    json: bool,
}

/// Runs `sgc audit`.
pub(crate) fn audit(args: &AuditArgs) -> Result<(), CliError> {
    let path = path(args)?;
    let from = args
        .since
        .map_or(0, |since| unix_now().0.saturating_sub(u64::try_from(since.as_millis()).unwrap_or(u64::MAX)));
    let mut found = Vec::new();
    let unread = audit::read(&path, |record| {
        if record.unix_ms >= from && args.wants(&record) {
            found.push(record);
        }
    });
    let unread = unread.map_err(|error| CliError::NoAudit {
        path: path.clone(),
        reason: match error.kind() {
            std::io::ErrorKind::NotFound => "there is no such file".to_owned(),
            _ => error.to_string(),
        },
    })?;
    if args.json {
        for record in &found {
            let line = serde_json::to_string(record).map_err(|error| ProcessError::Output(error.into()))?;
            output::line(harmless(&line))?;
        }
    } else if found.is_empty() {
        output::line("nothing found")?;
    } else {
        let head = ["time", "event", "topic", "peer", "why"].map(str::to_owned).to_vec();
        let rows: Vec<_> = std::iter::once(head).chain(found.iter().map(row)).collect();
        for line in output::columns(&rows) {
            output::line(line)?;
        }
    }
    if !unread.files.is_empty() {
        let files: Vec<_> = unread.files.iter().map(|file| file.display().to_string()).collect();
        output::diagnostic(&format!(
            "sgc: not read, unpack them and name each with --file: {}",
            files.join(", ")
        ));
    }
    if unread.lines > 0 {
        let lines = match unread.lines {
            1 => "1 line is".to_owned(),
            malformed => format!("{malformed} lines are"),
        };
        output::diagnostic(&format!(
            "sgc: {}: {lines} not readable, as a killed node leaves it",
            path.display()
        ));
    }
    Ok(())
}

impl AuditArgs {
    fn wants(&self, record: &AuditRecord) -> bool {
        let is_peer = |wanted: &String| {
            let begins = |id: &String| !wanted.is_empty() && id.starts_with(wanted.as_str());
            record.peer_name.as_ref() == Some(wanted) || record.peer.as_ref().is_some_and(begins)
        };
        self.topic.as_ref().is_none_or(|topic| record.topic.as_ref() == Some(topic))
            && self.about.as_ref().is_none_or(is_peer)
            && (self.events.is_empty()
                || self.events.contains(&record.event)
                || record.of.as_ref().is_some_and(|of| self.events.contains(of)))
    }
}

fn path(args: &AuditArgs) -> Result<PathBuf, CliError> {
    let usual = |node: &str| sgc_node::state_dir(&Config::default(), node);
    if let Some(file) = &args.file {
        return Ok(file.clone());
    }
    if let Some(path) = &args.config {
        let config = config::load(path, &environment)
            .map_err(|errors| CliError::Config { what: path.display().to_string(), errors })?;
        let state = sgc_node::state_dir(&config, &sgc_diagnosis::ask::node_name(&config)?);
        let path = audit::audit_path(config.audit.file.as_deref(), state.as_deref());
        return path.filter(|_| !config.audit.off).ok_or_else(|| CliError::Cannot {
            reason: "this node keeps no audit log: [audit] is off, or there is no state directory".to_owned(),
        });
    }
    if let Some(node) = &args.node {
        let dir = usual(node).ok_or(sgc_node::StateError::Nowhere)?;
        return Ok(dir.join(FILE_NAME));
    }
    only_log(&sgc_node::state_bases())
}

fn only_log(dirs: &[PathBuf]) -> Result<PathBuf, CliError> {
    let entries = dirs.iter().filter_map(|dir| std::fs::read_dir(dir).ok()).flatten().flatten();
    let mut found: Vec<_> = entries.map(|e| e.path().join(FILE_NAME)).filter(|path| path.is_file()).collect();
    found.sort();
    found.dedup();
    let reason = match found.len() {
        1 => return Ok(found.swap_remove(0)),
        0 => {
            let dirs: Vec<_> = dirs.iter().map(|dir| dir.display().to_string()).collect();
            format!(
                "no node has a log in {} that you may read; name one with -c or --file, or write `sudo` in front for that \
                 of a service",
                dirs.join(" or ")
            )
        }
        _ => {
            let nodes: Vec<_> = found
                .iter()
                .filter_map(|path| Some(path.parent()?.file_name()?.to_string_lossy().into_owned()))
                .collect();
            format!("which node? Name one with --node: {}", nodes.join(", "))
        }
    };
    Err(CliError::Cannot { reason })
}

fn row(record: &AuditRecord) -> Vec<String> {
    let (subject, peer) = (record.subject().unwrap_or_default(), record.peer_word().unwrap_or_default());
    let cells = [record.time.clone(), record.event.clone(), subject, peer, record.detail()];
    cells.iter().map(|cell| plain(cell)).collect()
}

/// Removes control characters and marks that change the direction of text.
fn plain(text: &str) -> String {
    text.chars().filter(|c| !is_harmful(*c)).collect()
}

/// Escapes the same characters in JSON: programs read the same value, and a terminal sees no command.
fn harmless(json: &str) -> String {
    let escape = |c: char| match is_harmful(c) {
        true => format!("\\u{:04x}", u32::from(c)),
        false => c.to_string(),
    };
    json.chars().map(escape).collect()
}

fn event(text: &str) -> Result<String, String> {
    let known = AuditEvent::ALL.map(AuditEvent::label);
    match known.contains(&text) {
        true => Ok(text.to_owned()),
        false => Err(format!("events are {}", known.join(", "))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_of_other_machines_cannot_steer_terminal() {
        let hostile = "a\u{1b}[2J\u{9b}31m\u{7f}\r\nb\u{202e}c";
        assert_eq!(plain(hostile), "a[2J31mbc");
        let json = serde_json::to_string(&AuditRecord::new(AuditEvent::Refused).reason(hostile)).unwrap();
        let shown = harmless(&json);
        assert!(!shown.chars().any(is_harmful), "{shown}");
        let read: AuditRecord = serde_json::from_str(&shown).unwrap();
        assert_eq!(read.reason.as_deref(), Some(hostile));
    }
}
