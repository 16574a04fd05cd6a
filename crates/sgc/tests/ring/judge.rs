//! The judgement of a run: of what came, of the nodes and of their logs.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use serde_json::Value;

use crate::graph::NODES;
use crate::ledger::Row;
use crate::run::{Event, Run};

/// Best effort: how much must come at least, and how much may be lost with no fault near (to a busy processor).
const SHARE_MIN: f64 = 0.5;
const UNEXPLAINED_MAX: f64 = 0.02;
/// How long after the mending of a fault it explains a loss.
const EXPLAINS: Duration = Duration::from_secs(15);
/// Events that are no further apart than this count as one moment: what is under way still arrives.
const TOGETHER: Duration = Duration::from_millis(100);
/// How much more memory a router may have in the end.
const GROWTH_KB_MAX: u64 = 64 * 1024;
/// Counters of what an honest peer never causes (`docs/spec/routing.md`). `wrong_way` is also a control frame that
/// crossed another; the log tells the two apart.
const SUSPICIOUS: [&str; 7] =
    ["not_verified", "not_owner", "hop_limit", "limit", "crl", "not_router", "malformed_control"];
/// Texts that no log may contain.
const UNSPEAKABLE: [&str; 4] =
    ["panicked", " ERROR ", "dropped an invalid packet of a peer", "control frame refused; counted"];

impl Run {
    pub(crate) fn judge(&mut self, report: &mut Vec<String>) {
        let mut problems = Vec::new();
        for listener in &self.listeners {
            let talker = self.talkers.iter().find(|t| t.topic.name == listener.topic.name).unwrap();
            let (name, last) = (listener.name(), talker.last().unwrap());
            let row = Row::from_numbers(listener.got.iter().map(|(_, seq)| *seq));
            let sent = last + 1 - row.first;
            let share = row.received as f64 / sent as f64;
            report.push(format!(
                "{name:14} {:5} of {sent:5} ({:.1} %), {} lost in {} gaps, {} doubled, {} late, {} altered",
                row.received,
                100.0 * share,
                row.lost(),
                row.gaps.len(),
                row.doubled.len(),
                row.late.len(),
                listener.altered
            ));
            if !row.doubled.is_empty() || !row.late.is_empty() || listener.altered > 0 {
                problems.push(format!(
                    "{name}: doubled {} {:?}, late {} {:?}, altered {}",
                    row.doubled.len(),
                    shown(&row.doubled),
                    row.late.len(),
                    shown(&row.late),
                    listener.altered
                ));
            }
            if listener.topic.reliable {
                if !row.gaps.is_empty() {
                    problems.push(format!(
                        "{name}: lost {}, in {} gaps: {:?}",
                        row.lost(),
                        row.gaps.len(),
                        shown(&row.gaps)
                    ));
                }
                continue;
            }
            if share < SHARE_MIN {
                problems.push(format!("{name}: only {:.1} % came", 100.0 * share));
            }
            let unexplained: Vec<_> = talker
                .sent
                .iter()
                .filter(|(_, seq)| row.gaps.iter().any(|(from, to)| (*from..=*to).contains(seq)))
                .filter(|(at, _)| !self.events.iter().any(|event| explains(event, *at)))
                .map(|(_, seq)| *seq)
                .collect();
            if unexplained.len() as f64 > sent as f64 * UNEXPLAINED_MAX {
                problems.push(format!(
                    "{name}: {} lost with no fault near: {:?}",
                    unexplained.len(),
                    shown(&unexplained)
                ));
            }
        }
        self.problems.extend(problems);
    }

    /// By kind of event: the longest time for which `/state` stood still at a receiver, of those that began from it
    /// to the next event. Events at one moment share what they caused.
    pub(crate) fn outages(&self, report: &mut Vec<String>, calm_since: Instant, ended: Instant) {
        let mut kinds = BTreeMap::<&str, Vec<Duration>>::new();
        let starts = [("nothing", calm_since)].into_iter();
        let starts: Vec<_> = starts.chain(self.events.iter().map(|e| (e.kind.as_str(), e.at))).collect();
        for (kind, at) in &starts {
            let next = starts.iter().map(|(_, next)| *next).find(|next| *next > *at + TOGETHER);
            let (from, to) = (*at - TOGETHER, next.unwrap_or(ended) - TOGETHER);
            for listener in self.listeners.iter().filter(|l| l.topic.name == "/state") {
                kinds.entry(kind).or_default().extend(listener.outage(from, to));
            }
        }
        report.push("longest pause of /state after each, ms: median, longest".to_owned());
        for (kind, mut pauses) in kinds {
            pauses.sort();
            let (n, ms) = (pauses.len(), |pause: Option<&Duration>| pause.map_or(0, Duration::as_millis));
            let (median, longest) = (ms(pauses.get(n / 2)), ms(pauses.last()));
            report.push(format!("  {kind:28} {median:6} {longest:6}   of {n}"));
        }
    }

    pub(crate) fn look_at_nodes(&mut self, before: &[Option<u64>], report: &mut Vec<String>) {
        NODES.into_iter().for_each(|node| self.count_drops(node));
        let mut memory = Vec::new();
        for (node, before) in NODES.into_iter().zip(before) {
            let (before, after) = (before.unwrap_or(0), self.lab.resident(node).unwrap_or(0));
            memory.push(format!("{node:?} {before} → {after}"));
            if node.is_router() && after > before + GROWTH_KB_MAX {
                self.trouble(format!("{node:?} had {before} kB, and has {after} kB"));
            }
            for (path, count) in recovered(&self.lab.status(node), String::new()) {
                report.push(format!("{node:?}: {path} = {count}"));
            }
            let log = self.lab.log(node);
            for word in UNSPEAKABLE {
                let lines: Vec<_> = log.lines().filter(|line| line.contains(word)).collect();
                if let Some(line) = lines.first() {
                    self.trouble(format!("{node:?} logged {} times such as: {line}", lines.len()));
                }
            }
        }
        report.push(format!("resident memory, kB: {}", memory.join(", ")));
        let plain: Vec<_> = self.drops.iter().filter(|((_, key), _)| !key.contains(" from ")).collect();
        let texts: Vec<_> =
            plain.iter().map(|((node, key), count)| format!("{node:?} {key} {count}")).collect();
        report.push(format!("dropped: {}", texts.join(", ")));
        let suspicious: Vec<_> = plain
            .into_iter()
            .filter(|((_, key), count)| SUSPICIOUS.contains(&key.as_str()) && **count > 0)
            .map(|((node, key), count)| format!("{node:?} counted {count} of {key}"))
            .collect();
        self.problems.extend(suspicious);
    }

    /// Every event with its time and what came next after it, and when writers came and went.
    pub(crate) fn trace(&self) -> String {
        let mut text = String::new();
        for event in &self.events {
            let at = event.at.saturating_duration_since(self.begun).as_secs_f64();
            text += &format!("{at:7.2} {}", event.what);
            for listener in &self.listeners {
                let next = listener.got.get(listener.got.partition_point(|(got, _)| *got <= event.at));
                let seq = next.map_or("-".to_owned(), |(got, seq)| {
                    format!("{seq}+{}ms", (*got - event.at).as_millis())
                });
                text += &format!("  {} {seq}", listener.name());
            }
            text.push('\n');
        }
        for listener in &self.listeners {
            for (at, count) in &listener.matched {
                let at = at.saturating_duration_since(self.begun).as_secs_f64();
                text += &format!("{at:7.2} {}: {count} writers\n", listener.name());
            }
        }
        for heard in self.new_topics.iter().flat_map(|topics| &topics.heard) {
            let since = heard.since.saturating_duration_since(self.begun).as_secs_f64();
            text += &format!(
                "{since:7.2} {} at {:?} took {} ms\n",
                heard.topic,
                heard.at,
                heard.took.as_millis()
            );
        }
        text
    }

    /// The times until the messages of topics that nobody had used before came.
    pub(crate) fn first_uses(&self, report: &mut Vec<String>) {
        let Some(topics) = &self.new_topics else { return };
        let mut took: Vec<_> = topics.heard.iter().map(|heard| heard.took.as_millis()).collect();
        took.sort_unstable();
        let (n, ms) = (took.len(), |time: Option<&u128>| time.copied().unwrap_or(0));
        let (median, longest) = (ms(took.get(n / 2)), ms(took.last()));
        report
            .push(format!("from the start of a new topic to its messages, ms: {median} {longest}   of {n}"));
    }
}

/// Limits a list to a readable length.
fn shown<T>(all: &[T]) -> &[T] {
    &all[..all.len().min(20)]
}

fn explains(event: &Event, at: Instant) -> bool {
    let from = event.at - Duration::from_secs(1);
    event.loses && from <= at && event.mended.is_none_or(|mended| at <= mended + EXPLAINS)
}

/// Every number in a status document whose key speaks of recovery.
fn recovered(value: &Value, path: String) -> Vec<(String, u64)> {
    match value {
        Value::Object(fields) => {
            fields.iter().flat_map(|(key, value)| recovered(value, format!("{path}.{key}"))).collect()
        }
        Value::Array(values) => values
            .iter()
            .enumerate()
            .flat_map(|(i, value)| {
                let name = value["topic"].as_str().map_or(i.to_string(), str::to_owned);
                recovered(value, format!("{path}[{name}]"))
            })
            .collect(),
        Value::Number(number) if path.rsplit('.').next().is_some_and(|key| key.contains("recover")) => {
            number.as_u64().map(|n| (path, n)).into_iter().collect()
        }
        _ => Vec::new(),
    }
}
