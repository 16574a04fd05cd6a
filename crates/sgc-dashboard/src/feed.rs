//! [`Feed`]: asks the nodes while somebody looks, and keeps the last document.
//!
//! Nodes that answered are asked every two seconds. Those that did not are asked apart and seldom, since each takes five
//! seconds to say nothing.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_diagnosis::DiagnosisError;
use sgc_diagnosis::fleet::{FleetStatus, Members, ask_nodes};
use sgc_node::admin::ReportAnswer;
use sgc_process::unix_now;
use sgc_sync::lock;
use tokio::sync::watch;

use crate::view::FleetView;

/// Time between two looks at nodes that answer.
const LOOK_EVERY: Duration = Duration::from_secs(2);
/// Time between two looks at nodes that did not answer.
const ABSENT_EVERY: Duration = Duration::from_secs(10);
/// Time after the last request for which nodes are still asked. A page that is open asks more often.
const WATCHED_FOR: Duration = Duration::from_secs(30);
/// Pause of a thread while nobody looks.
const IDLE: Duration = Duration::from_millis(250);

/// The newest document about the fleet.
#[derive(Clone, Debug, Default)]
struct Document {
    seq: u64,
    json: Bytes,
}

/// What is known of the fleet.
#[derive(Debug, Default)]
struct Known {
    members: Members,
    /// The last answer of each node.
    answers: BTreeMap<String, ReportAnswer>,
    error: Option<String>,
}

/// The source of documents about the fleet.
pub(crate) struct Feed {
    socket: PathBuf,
    /// Members that are not asked for.
    fixed: Option<Members>,
    known: Mutex<Known>,
    asked_at: Mutex<Option<Instant>>,
    document: watch::Sender<Document>,
}

impl Feed {
    /// Starts the threads that ask; they end with the process.
    pub(crate) fn start(socket: PathBuf, fixed: Option<Members>) -> std::io::Result<Arc<Self>> {
        let (known, asked_at, document) = (Mutex::default(), Mutex::default(), watch::Sender::default());
        let feed = Arc::new(Self { socket, fixed, known, asked_at, document });
        for (name, look, every) in [
            ("sgc-look", Self::look as fn(&Self), LOOK_EVERY),
            ("sgc-look-absent", Self::look_at_absent, ABSENT_EVERY),
        ] {
            let feed = feed.clone();
            std::thread::Builder::new().name(name.to_owned()).spawn(move || feed.repeat(look, every))?;
        }
        Ok(feed)
    }

    /// Waits for a document after this one, at most this long, and returns the newest.
    pub(crate) async fn next_after(&self, seq: u64, most: Duration) -> Bytes {
        *lock(&self.asked_at) = Some(Instant::now());
        let mut documents = self.document.subscribe();
        let newer = documents.wait_for(|document| document.seq > seq);
        let _ = tokio::time::timeout(most, newer).await;
        *lock(&self.asked_at) = Some(Instant::now());
        self.document.borrow().json.clone()
    }

    fn repeat(&self, look: fn(&Self), every: Duration) {
        let mut next = Instant::now();
        loop {
            let is_watched = lock(&self.asked_at).is_some_and(|at| at.elapsed() < WATCHED_FOR);
            if is_watched && Instant::now() >= next {
                next = Instant::now() + every;
                look(self);
            }
            std::thread::sleep(IDLE);
        }
    }

    /// Asks for the members, then the nodes of which it is not known that they are absent.
    fn look(&self) {
        let members = match &self.fixed {
            Some(fixed) => Ok(fixed.clone()),
            None => Members::of_authority(&self.socket),
        };
        let mut known = lock(&self.known);
        match members {
            Ok(members) => {
                let names: BTreeSet<_> = members.members.iter().map(|member| member.name.clone()).collect();
                known.answers.retain(|name, _| names.contains(name));
                known.answers.extend(members.authority.clone().map(|answer| (answer.node.clone(), answer)));
                (known.members, known.error) = (members, None);
            }
            Err(error) => known.error = Some(error.to_string()),
        }
        let authority = known.members.authority.as_ref().map(|answer| answer.node.clone());
        let nodes = known.nodes(|answer| answer.is_none_or(|answer| answer.report.is_some()));
        drop(known);
        let nodes: Vec<_> = nodes.into_iter().filter(|node| Some(node) != authority.as_ref()).collect();
        self.ask(&nodes);
    }

    /// Asks the nodes that gave no report.
    fn look_at_absent(&self) {
        let nodes = lock(&self.known).nodes(|answer| answer.is_some_and(|answer| answer.report.is_none()));
        if !nodes.is_empty() {
            self.ask(&nodes);
        }
    }

    /// Asks nodes, and makes a new document.
    fn ask(&self, nodes: &[String]) {
        let answers = asked(&self.socket, nodes);
        let mut known = lock(&self.known);
        match answers {
            Ok(answers) => {
                known.answers.extend(answers.into_iter().map(|answer| (answer.node.clone(), answer)));
            }
            Err(error) => known.error = Some(error.to_string()),
        }
        let Members { members, omitted, .. } = known.members.clone();
        let answers = known.answers.values().cloned().collect();
        let mut fleet = FleetStatus::new(unix_now(), members, answers, &[]);
        fleet.members_omitted = omitted;
        let error = known.error.clone();
        drop(known);
        self.document.send_modify(|document| {
            document.seq += 1;
            let view = FleetView::new(document.seq, error, &fleet);
            document.json = serde_json::to_vec(&view).unwrap_or_default().into();
        });
    }
}

impl Known {
    /// Returns the members that are not revoked and whose last answer is wanted.
    fn nodes(&self, is_wanted: impl Fn(Option<&ReportAnswer>) -> bool) -> Vec<String> {
        let members = self.members.members.iter().filter(|member| member.revoked_ms.is_none());
        let names = members.map(|member| &member.name);
        names.filter(|name| is_wanted(self.answers.get(*name))).cloned().collect()
    }
}

/// Asks nodes; none if there are none.
fn asked(socket: &Path, nodes: &[String]) -> Result<Vec<ReportAnswer>, DiagnosisError> {
    if nodes.is_empty() { Ok(Vec::new()) } else { ask_nodes(socket, nodes, None) }
}
