//! The result of each topic: the document of `--json`, and the verdict that decides the exit code.

use serde::Serialize;
use sgc_wire::Name;

use crate::protocol::PeerEvent;
use crate::topics::Topic;
use crate::tracker::Counts;

/// The progress of one topic, by the last reports of its peers.
#[derive(Debug)]
pub(crate) struct Flow {
    pub(crate) topic: Topic,
    pub(crate) name: Name,
    /// The talker has a subscriber on its own network: the owner's node.
    pub(crate) matched: bool,
    /// The listener has received a message.
    pub(crate) arrived: bool,
    /// Messages sent, by the last report.
    pub(crate) sent: u64,
    /// `sent` is final.
    pub(crate) stopped: bool,
    /// The listener's counts.
    pub(crate) counts: Counts,
}

impl Flow {
    /// Returns a flow without any progress.
    pub(crate) fn new(topic: Topic, name: Name) -> Self {
        Self {
            topic,
            name,
            matched: false,
            arrived: false,
            sent: 0,
            stopped: false,
            counts: Counts::default(),
        }
    }

    /// Handles an event of the talker or listener.
    pub(crate) fn handle(&mut self, event: &PeerEvent) {
        match event {
            PeerEvent::Matched { readers, .. } => self.matched = *readers > 0,
            PeerEvent::Arrived { .. } => self.arrived = true,
            PeerEvent::Sending { sent, .. } => self.sent = *sent,
            PeerEvent::Sent { total, .. } => (self.sent, self.stopped) = (*total, true),
            PeerEvent::Receiving { counts, .. } => self.counts = counts.clone(),
            PeerEvent::Failed { .. } => {}
        }
    }

    /// Returns `true` once a message has arrived.
    pub(crate) fn is_up(&self) -> bool {
        self.matched && self.arrived
    }

    /// Returns `true` once all numbered messages and a later one have arrived, so that none is in flight.
    pub(crate) fn is_complete(&self) -> bool {
        self.stopped && self.counts.ended && self.counts.received >= self.sent
    }

    /// Returns the number of missing messages: of all sent ones at the end, of those overtaken by a later one before.
    pub(crate) fn lost(&self) -> u64 {
        if self.stopped { self.sent.saturating_sub(self.counts.received) } else { self.counts.missing }
    }

    /// Returns the fault of the flow, if it has one.
    pub(crate) fn fault(&self) -> Option<String> {
        let Counts { received, duplicated, corrupt, damage, .. } = &self.counts;
        let mut faults = Vec::new();
        if *received == 0 {
            faults.push(format!("nothing was received of {} messages", self.sent));
        } else if self.lost() > 0 {
            faults.push(format!("{} of {} messages lost", self.lost(), self.sent));
        }
        if *duplicated > 0 {
            faults.push(format!("{duplicated} duplicated"));
        }
        if *corrupt > 0 {
            let damage = damage.as_deref().unwrap_or("unknown");
            faults.push(format!("{corrupt} altered (the first: {damage})"));
        }
        (!faults.is_empty()).then(|| format!("{}: {}", self.topic.ros_name(), faults.join(", ")))
    }
}

/// The document of `--json`.
#[derive(Debug, Serialize)]
pub(crate) struct Report {
    /// Duration of the count.
    seconds: f64,
    topics: Vec<TopicReport>,
    /// Messages were sent, and each was received once and unaltered.
    ok: bool,
    /// The reason why nothing could be measured.
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<String>,
}

#[derive(Debug, Serialize)]
struct TopicReport {
    topic: &'static str,
    #[serde(rename = "type")]
    type_name: &'static str,
    name: String,
    sent: u64,
    received: u64,
    lost: u64,
    duplicated: u64,
    corrupt: u64,
    latency_us: LatencyReport,
}

#[derive(Debug, Serialize)]
struct LatencyReport {
    p50: u64,
    p99: u64,
}

impl Report {
    /// Returns the report of a demo that ran.
    pub(crate) fn new(seconds: f64, flows: &[Flow]) -> Self {
        Self {
            seconds: (seconds * 1000.0).round() / 1000.0,
            topics: flows.iter().map(TopicReport::new).collect(),
            ok: flows.iter().all(|flow| flow.fault().is_none()),
            error: None,
        }
    }

    /// Returns the report of a demo that failed.
    pub(crate) fn failed(error: String) -> Self {
        Self { seconds: 0.0, topics: Vec::new(), ok: false, error: Some(error) }
    }

    /// Returns the verdict.
    pub(crate) fn is_ok(&self) -> bool {
        self.ok
    }
}

impl TopicReport {
    fn new(flow: &Flow) -> Self {
        Self {
            topic: flow.topic.ros_name(),
            type_name: flow.topic.type_name(),
            name: flow.name.to_string(),
            sent: flow.sent,
            received: flow.counts.received,
            lost: flow.lost(),
            duplicated: flow.counts.duplicated,
            corrupt: flow.counts.corrupt,
            latency_us: LatencyReport { p50: flow.counts.p50_us, p99: flow.counts.p99_us },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flow(sent: u64, counts: Counts) -> Flow {
        let flow = Flow::new(Topic::Chatter, Name([0xab; 32]));
        Flow { matched: true, arrived: true, sent, stopped: true, counts, ..flow }
    }

    #[test]
    fn json_report_has_documented_shape() {
        let counts = Counts { received: 99, p50_us: 1200, p99_us: 3400, ended: true, ..Counts::default() };
        let report = Report::new(10.000_04, &[flow(100, counts)]);
        let name = "ab".repeat(32);
        assert_eq!(
            serde_json::to_string(&report).unwrap(),
            format!(
                r#"{{"seconds":10.0,"topics":[{{"topic":"/chatter","type":"std_msgs/msg/String","name":"{name}","sent":100,"received":99,"lost":1,"duplicated":0,"corrupt":0,"latency_us":{{"p50":1200,"p99":3400}}}}],"ok":false}}"#
            )
        );
    }

    #[test]
    fn loss_repetition_and_damage_are_faults() {
        let good = Counts { received: 5, ended: true, ..Counts::default() };
        assert_eq!(flow(5, good.clone()).fault(), None);
        for (sent, counts, fault) in [
            (6, good.clone(), "/chatter: 1 of 6 messages lost"),
            (0, Counts::default(), "/chatter: nothing was received of 0 messages"),
            (5, Counts { duplicated: 2, ..good.clone() }, "/chatter: 2 duplicated"),
            (
                6,
                Counts { corrupt: 1, damage: Some("bad".into()), ..good },
                "/chatter: 1 of 6 messages lost, 1 altered (the first: bad)",
            ),
        ] {
            assert_eq!(flow(sent, counts).fault().as_deref(), Some(fault));
        }
    }
}
