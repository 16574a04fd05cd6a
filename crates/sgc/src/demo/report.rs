//! What came of each topic: the document of `--json`, and the verdict that the exit code follows.

use serde::Serialize;
use sgc_wire::Name;

use super::protocol::PeerEvent;
use super::topics::Topic;
use super::tracker::Counts;

/// One topic on its way, as far as the demo has been told.
#[derive(Debug)]
pub(crate) struct Flow {
    pub(crate) topic: Topic,
    pub(crate) name: Name,
    /// Its talker has a subscriber on its own network: its owner's node.
    pub(crate) matched: bool,
    /// Its listener has received something.
    pub(crate) arrived: bool,
    /// Messages sent, as last told.
    pub(crate) sent: u64,
    /// `sent` is final.
    pub(crate) stopped: bool,
    /// What its listener has.
    pub(crate) counts: Counts,
}

impl Flow {
    /// Nothing has happened yet.
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

    /// Takes in what its talker or listener says.
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

    /// Something has come all the way.
    pub(crate) fn is_up(&self) -> bool {
        self.matched && self.arrived
    }

    /// All that was sent has come, and what followed it as well, so that nothing of it is still under way.
    pub(crate) fn is_complete(&self) -> bool {
        self.stopped && self.counts.ended && self.counts.received >= self.sent
    }

    /// Messages that have not come, of those sent; while it runs, of those that a later one has overtaken.
    pub(crate) fn lost(&self) -> u64 {
        if self.stopped { self.sent.saturating_sub(self.counts.received) } else { self.counts.missing }
    }

    /// What is wrong, if anything is.
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
    /// How long messages were counted.
    seconds: f64,
    topics: Vec<TopicReport>,
    /// Everything that was sent has been received, once and unaltered, and something was.
    ok: bool,
    /// Why nothing could be measured.
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
    /// Of a demo that ran.
    pub(crate) fn new(seconds: f64, flows: &[Flow]) -> Self {
        Self {
            seconds: (seconds * 1000.0).round() / 1000.0,
            topics: flows.iter().map(TopicReport::new).collect(),
            ok: flows.iter().all(|flow| flow.fault().is_none()),
            error: None,
        }
    }

    /// Of one that did not.
    pub(crate) fn failed(error: String) -> Self {
        Self { seconds: 0.0, topics: Vec::new(), ok: false, error: Some(error) }
    }

    /// The verdict.
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
    fn the_document_has_the_shape_of_the_manual() {
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
    fn anything_but_all_of_it_once_and_whole_is_a_fault() {
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
