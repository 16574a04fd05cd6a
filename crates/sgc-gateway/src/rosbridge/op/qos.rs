//! [`QosMember`]: QoS as rosbridge clients write it.

use std::collections::BTreeMap;

use serde::Deserialize;
use serde_json::Value as Json;
use sgc_wire::{Durability, History, Qos, Reliability};

use super::error::Refusal;

/// The default depth of a publisher, and the largest one.
const DEPTH_DEFAULT: u32 = 100;
const DEPTH_MAX: u32 = 10_000;
/// Longest member, in bytes, because its values take far more memory than their text.
const BYTES_MAX: usize = 4096;

/// The member `qos`.
#[derive(Debug, Default, PartialEq)]
pub(super) struct QosMember {
    reliability: Option<Reliability>,
    durability: Option<Durability>,
    keeps_all: bool,
    pub(super) depth: Option<u32>,
    deadline_ns: Option<u64>,
    lifespan_ns: Option<u64>,
}

#[derive(Deserialize)]
#[serde(untagged)]
enum Span {
    Seconds(f64),
    Parts { secs: u64, nsecs: u64 },
    Word(String),
}

impl QosMember {
    /// Parses the member. A policy with the value `best_available` counts as
    /// missing.
    pub(super) fn read(raw: &str) -> Result<Self, Refusal> {
        if raw.len() > BYTES_MAX {
            return Err(Refusal::rule(format!("\"qos\" is longer than {BYTES_MAX} bytes")));
        }
        let members: BTreeMap<String, Json> =
            serde_json::from_str(raw).map_err(|_| Refusal::rule("\"qos\" is no object"))?;
        let mut said = Self::default();
        for (name, value) in members {
            let word = value.as_str().map(str::to_ascii_lowercase);
            let is = |known: &str| word.as_deref() == Some(known);
            match name.as_str() {
                _ if is("best_available") => {}
                "reliability" if is("reliable") => said.reliability = Some(Reliability::Reliable),
                "reliability" if is("best_effort") => said.reliability = Some(Reliability::BestEffort),
                "durability" if is("transient_local") => said.durability = Some(Durability::TransientLocal),
                "durability" if is("volatile") => said.durability = Some(Durability::Volatile),
                "history" if is("keep_last") => {}
                "history" if is("keep_all") => said.keeps_all = true,
                "depth" => match value.as_u64().and_then(|depth| u32::try_from(depth).ok()) {
                    Some(depth) => said.depth = Some(depth),
                    None => {
                        let wrong = format!("\"qos\": \"depth\" is no number of 0 or more: {value}");
                        return Err(Refusal::rule(wrong));
                    }
                },
                "deadline" => said.deadline_ns = span(&name, value)?,
                "lifespan" => said.lifespan_ns = span(&name, value)?,
                "reliability" | "durability" | "history" => {
                    return Err(Refusal::rule(format!("\"qos\": {name:?} cannot be {value}")));
                }
                _ => return Err(Refusal::rule(format!("\"qos\" has no member {name:?}"))),
            }
        }
        Ok(said)
    }

    /// Returns the QoS that a publisher offers, reliable by default.
    pub(super) fn offer(&self, is_latched: bool, queue_size: Option<usize>) -> Qos {
        let latched = if is_latched { Durability::TransientLocal } else { Durability::Volatile };
        let said = queue_size.and_then(|size| u32::try_from(size).ok()).filter(|size| *size > 0);
        let default = if is_latched { 1 } else { said.unwrap_or(DEPTH_DEFAULT) };
        Qos {
            reliability: self.reliability.unwrap_or(Reliability::Reliable),
            durability: self.durability.unwrap_or(latched),
            history: self.history(default),
            deadline_ns: self.deadline_ns,
            lifespan_ns: self.lifespan_ns,
            ..Qos::default()
        }
    }

    /// Returns the QoS that a subscriber requests, or `None` if it adapts to the publishers.
    pub(super) fn request(&self) -> Option<Qos> {
        if self.reliability.is_none() && self.durability.is_none() {
            return None;
        }
        Some(Qos {
            reliability: self.reliability.unwrap_or(Reliability::BestEffort),
            durability: self.durability.unwrap_or(Durability::Volatile),
            history: self.history(DEPTH_DEFAULT),
            deadline_ns: self.deadline_ns,
            ..Qos::default()
        })
    }

    fn history(&self, default: u32) -> History {
        match self.keeps_all {
            true => History::KeepAll,
            false => History::KeepLast(
                self.depth.filter(|depth| *depth > 0).unwrap_or(default).clamp(1, DEPTH_MAX),
            ),
        }
    }
}

fn span(name: &str, value: Json) -> Result<Option<u64>, Refusal> {
    let wrong = Refusal::rule(format!("\"qos\": {name:?} is no time: {value}"));
    match serde_json::from_value(value) {
        Ok(Span::Seconds(seconds)) if (0.0..1e9).contains(&seconds) => Ok(Some((seconds * 1e9) as u64)),
        Ok(Span::Parts { secs, nsecs }) => {
            let ns = secs.checked_mul(1_000_000_000).and_then(|ns| ns.checked_add(nsecs));
            ns.map(Some).ok_or(wrong)
        }
        Ok(Span::Word(word)) if word.eq_ignore_ascii_case("infinite") => Ok(None),
        _ => Err(wrong),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn qos_member_decides_offer_and_request() {
        let said = QosMember::read(
            r#"{"reliability":"best_effort","durability":"TRANSIENT_LOCAL","depth":5,"history":"keep_last",
            "deadline":0.5,"lifespan":{"secs":1,"nsecs":2}}"#,
        )
        .unwrap();
        let offer = said.offer(false, Some(100));
        assert_eq!(
            (offer.reliability, offer.durability),
            (Reliability::BestEffort, Durability::TransientLocal)
        );
        assert_eq!((offer.history, offer.deadline_ns), (History::KeepLast(5), Some(500_000_000)));
        assert_eq!(offer.lifespan_ns, Some(1_000_000_002));
        assert_eq!(said.request().unwrap().durability, Durability::TransientLocal);
        let none = QosMember::read(r#"{"reliability":"best_available","deadline":"infinite"}"#).unwrap();
        assert_eq!((none.request(), none.offer(true, Some(7)).history), (None, History::KeepLast(1)));
        assert_eq!(QosMember::default().offer(false, Some(7)).history, History::KeepLast(7));
    }

    #[test]
    fn invalid_qos_is_explained() {
        for (raw, told) in [
            ("3", "\"qos\" is no object"),
            (r#"{"reliability":"often"}"#, r#""qos": "reliability" cannot be "often""#),
            (r#"{"depth":-1}"#, r#""qos": "depth" is no number of 0 or more: -1"#),
            (r#"{"deadline":"soon"}"#, r#""qos": "deadline" is no time: "soon""#),
            (r#"{"colour":"red"}"#, r#""qos" has no member "colour""#),
        ] {
            assert_eq!(QosMember::read(raw).unwrap_err().to_string(), told);
        }
        let long = |spaces| format!(r#"{{"depth":{}1}}"#, " ".repeat(spaces));
        assert!(QosMember::read(&long(4000)).is_ok());
        let told = "\"qos\" is longer than 4096 bytes";
        assert_eq!(QosMember::read(&long(4100)).unwrap_err().to_string(), told);
    }
}
