//! [`Feed`]: asks the nodes while somebody looks, and keeps the last document.
//!
//! Nodes that answered are asked every two seconds. Those that did not are asked apart and seldom, since each takes
//! five seconds to say nothing. [`Memory`] knows what was answered, and asks nobody.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Condvar, Mutex};
use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_diagnosis::ask::{answer, ask};
use sgc_diagnosis::fleet::{FleetStatus, Members, ask_nodes};
use sgc_node::admin::{AdminRequest, AuditAnswer, ReportAnswer};
use sgc_process::unix_now;
use sgc_sync::lock;
use sgc_wire::UnixMillis;
use tokio::sync::watch;

use crate::FindMembers;
use crate::view::{AuditView, FleetView, enclosed};

/// Time between two looks at nodes that answer.
const LOOK_EVERY: Duration = Duration::from_secs(2);
/// Time between two looks at nodes that did not answer.
const ABSENT_EVERY: Duration = Duration::from_secs(10);
/// Longest wait for the audit log of the node here.
const AUDIT_MAX: Duration = Duration::from_secs(5);
/// Time after the last request for which nodes are still asked. A page that is looked at asks more often.
const WATCHED_FOR: Duration = Duration::from_secs(15);

/// The newest document about the fleet.
#[derive(Clone, Debug, Default)]
struct Document {
    /// Its number; 0 if there is none yet.
    seq: u64,
    json: Bytes,
    /// Time of the last answer of the node here.
    looked_at: Option<Instant>,
}

/// The source of documents about the fleet.
pub(crate) struct Feed {
    socket: PathBuf,
    find_members: FindMembers,
    memory: Mutex<Memory>,
    /// Time of the last request for a document.
    requested_at: Mutex<Option<Instant>>,
    /// Notified at each request.
    requested: Condvar,
    document: watch::Sender<Document>,
}

impl Feed {
    /// Starts the threads that ask; they end with the process.
    pub(crate) fn start(socket: PathBuf, find_members: FindMembers) -> std::io::Result<Arc<Self>> {
        let feed = Arc::new(Self {
            socket,
            find_members,
            memory: Mutex::default(),
            requested_at: Mutex::default(),
            requested: Condvar::new(),
            document: watch::Sender::default(),
        });
        for (name, look, every) in [
            ("sgc-look", Self::look as fn(&Self), LOOK_EVERY),
            ("sgc-look-absent", Self::look_at_absent, ABSENT_EVERY),
        ] {
            let feed = feed.clone();
            std::thread::Builder::new().name(name.to_owned()).spawn(move || feed.repeat(look, every))?;
        }
        Ok(feed)
    }

    /// Waits for a document after this one, at most this long, and returns the newest with its age, and with whether the
    /// page may revoke nodes.
    pub(crate) async fn next_after(&self, seq: u64, most: Duration, may_operate: bool) -> String {
        // The document at hand is old if nobody has looked for a while.
        let is_old = !self.is_watched();
        self.note_request();
        let mut documents = self.document.subscribe();
        let seq = if is_old { seq.max(documents.borrow().seq) } else { seq };
        let newer = documents.wait_for(|document| document.seq > seq);
        let _ = tokio::time::timeout(most, newer).await;
        self.note_request();
        let document = self.document.borrow();
        enclosed(document.looked_at.map(|at| at.elapsed()), may_operate, &document.json)
    }

    fn note_request(&self) {
        *lock(&self.requested_at) = Some(Instant::now());
        self.requested.notify_all();
    }

    fn is_watched(&self) -> bool {
        lock(&self.requested_at).is_some_and(|at| at.elapsed() < WATCHED_FOR)
    }

    fn repeat(&self, look: fn(&Self), every: Duration) {
        loop {
            let mut requested_at = lock(&self.requested_at);
            while requested_at.is_none_or(|at| at.elapsed() >= WATCHED_FOR) {
                requested_at = match self.requested.wait(requested_at) {
                    Ok(guard) => guard,
                    Err(poisoned) => poisoned.into_inner(),
                };
            }
            drop(requested_at);
            let begun = Instant::now();
            look(self);
            std::thread::sleep(every.saturating_sub(begun.elapsed()));
        }
    }

    /// Asks for the members, then the nodes of which it is not known that they are absent.
    fn look(&self) {
        let members = (self.find_members)(&self.socket);
        let audit = own_audit(&self.socket);
        let mut memory = lock(&self.memory);
        memory.audit = audit;
        let nodes = memory.take_members(members);
        drop(memory);
        self.ask(&nodes);
    }

    /// Asks the nodes that gave no report.
    fn look_at_absent(&self) {
        let nodes = lock(&self.memory).absent();
        if !nodes.is_empty() {
            self.ask(&nodes);
        }
    }

    /// Asks nodes, and makes a new document.
    fn ask(&self, nodes: &[String]) {
        let answers = ask_if_any(&self.socket, nodes);
        let mut memory = lock(&self.memory);
        memory.take_answers(Instant::now(), answers);
        let (fleet, error, looked_at) = (memory.fleet(unix_now()), memory.error.clone(), memory.looked_at);
        let audit = AuditView::new(&memory.audit, &fleet);
        drop(memory);
        self.document.send_modify(|document| {
            document.seq += 1;
            let view = FleetView::new(document.seq, error, &fleet, &audit);
            document.json = serde_json::to_vec(&view).unwrap_or_default().into();
            document.looked_at = looked_at;
        });
    }
}

/// Asks the node here for the last records of its audit log.
fn own_audit(socket: &Path) -> Result<AuditAnswer, String> {
    let text = ask(socket, &AdminRequest::Audit, AUDIT_MAX).map_err(|error| error.to_string())?;
    answer(socket, &text).map_err(|error| error.to_string())
}

/// Asks nodes; none if there are none.
fn ask_if_any(socket: &Path, nodes: &[String]) -> Result<Vec<ReportAnswer>, String> {
    match nodes.is_empty() {
        true => Ok(Vec::new()),
        false => ask_nodes(socket, nodes, None).map_err(|error| error.to_string()),
    }
}

/// The members of the fleet, and their last answers.
#[derive(Debug)]
struct Memory {
    members: Members,
    /// The audit log of the node here, or the reason why it is not known.
    audit: Result<AuditAnswer, String>,
    /// The last answer of each member that is not revoked.
    answers: BTreeMap<String, ReportAnswer>,
    /// The reason why the members, or the nodes, are not known now.
    error: Option<String>,
    /// Time of the last answer.
    looked_at: Option<Instant>,
}

impl Default for Memory {
    fn default() -> Self {
        let (members, answers) = (Members::default(), BTreeMap::new());
        Self { members, audit: Ok(AuditAnswer::default()), answers, error: None, looked_at: None }
    }
}

impl Memory {
    /// Takes the members, or the reason why they are not known. Returns the nodes to ask: those of which it is not
    /// known that they are absent, and that have not answered with the members.
    fn take_members(&mut self, members: Result<Members, String>) -> Vec<String> {
        let authority = members.as_ref().ok().and_then(|members| members.authority.clone());
        match members {
            Ok(members) => (self.members, self.error) = (members, None),
            Err(error) => self.error = Some(error),
        }
        let names: BTreeSet<_> = self.names().map(str::to_owned).collect();
        self.answers.retain(|name, _| names.contains(name));
        let answered = authority.as_ref().map(|answer| answer.node.clone());
        self.answers.extend(authority.map(|answer| (answer.node.clone(), answer)));
        let is_asked = |name: &String| self.answers.get(name).is_none_or(|answer| answer.report.is_some());
        names.into_iter().filter(|name| is_asked(name) && Some(name) != answered.as_ref()).collect()
    }

    /// Returns the nodes whose last answer was none.
    fn absent(&self) -> Vec<String> {
        let absent = self.answers.values().filter(|answer| answer.report.is_none());
        absent.map(|answer| answer.node.clone()).collect()
    }

    /// Takes answers, or the reason why the node here gives none.
    fn take_answers(&mut self, now: Instant, answers: Result<Vec<ReportAnswer>, String>) {
        match answers {
            Ok(answers) => {
                if self.error.is_none() || !answers.is_empty() {
                    self.looked_at = Some(now);
                }
                self.answers.extend(answers.into_iter().map(|answer| (answer.node.clone(), answer)));
            }
            Err(error) => self.error = Some(error),
        }
    }

    /// Returns the fleet as it is known.
    fn fleet(&self, now: UnixMillis) -> FleetStatus {
        let answers = self.answers.values().cloned().collect();
        let mut fleet = FleetStatus::new(now, self.members.members.clone(), answers, &[]);
        fleet.members_omitted = self.members.omitted;
        fleet
    }

    /// Returns the names of the members that are not revoked.
    fn names(&self) -> impl Iterator<Item = &str> {
        let members = self.members.members.iter().filter(|member| member.revoked_ms.is_none());
        members.map(|member| member.name.as_str())
    }
}

#[cfg(test)]
mod tests {
    use sgc_node::admin::report::{NodeReport, ReportMember};

    use super::*;

    const NOW: UnixMillis = UnixMillis(1_795_000_000_000);

    fn answer(node: &str, is_here: bool) -> ReportAnswer {
        let report = is_here.then(NodeReport::default);
        let error = (!is_here).then(|| "not in reach".to_owned());
        ReportAnswer { node: node.into(), report, error, ..ReportAnswer::default() }
    }

    /// Returns members of whom these are revoked, and the answer of the authority `keeper`.
    fn members(revoked: &[&str]) -> Members {
        let member = |name: &str| ReportMember {
            name: name.into(),
            revoked_ms: revoked.contains(&name).then_some(1),
            ..ReportMember::default()
        };
        let members = ["arm", "desk", "keeper"].map(member).into();
        Members { members, omitted: 0, authority: Some(answer("keeper", true)) }
    }

    /// Returns whether each node has a report.
    fn here(memory: &Memory) -> Vec<(String, bool)> {
        memory.fleet(NOW).nodes.into_iter().map(|node| (node.name, node.report.is_some())).collect()
    }

    fn all(arm: bool, desk: bool, keeper: bool) -> Vec<(String, bool)> {
        [("arm", arm), ("desk", desk), ("keeper", keeper)].map(|(name, is)| (name.to_owned(), is)).into()
    }

    #[test]
    fn nodes_that_do_not_answer_are_asked_apart_until_they_do() {
        let (now, mut memory) = (Instant::now(), Memory::default());
        assert_eq!(memory.take_members(Ok(members(&[]))), ["arm", "desk"]);
        memory.take_answers(now, Ok(vec![answer("arm", true), answer("desk", false)]));
        assert_eq!((here(&memory), memory.absent()), (all(true, false, true), vec!["desk".to_owned()]));
        assert_eq!(memory.take_members(Ok(members(&[]))), ["arm"]);
        memory.take_answers(now, Ok(vec![answer("desk", true)]));
        assert_eq!(memory.take_members(Ok(members(&[]))), ["arm", "desk"]);
        assert!(memory.absent().is_empty());
    }

    #[test]
    fn dead_authority_is_asked_like_any_node_and_shows_as_absent() {
        let (now, mut memory) = (Instant::now(), Memory::default());
        memory.take_members(Ok(members(&[])));
        memory.take_answers(now, Ok(vec![answer("arm", true), answer("desk", true)]));
        assert_eq!(memory.take_members(Err("it is not in reach".into())), ["arm", "desk", "keeper"]);
        memory.take_answers(now, Ok(vec![answer("arm", true), answer("keeper", false)]));
        assert_eq!((here(&memory), memory.error.is_some()), (all(true, true, false), true));
        assert_eq!(memory.take_members(Ok(members(&[]))), ["arm", "desk"]);
        assert_eq!((here(&memory), memory.error.clone()), (all(true, true, true), None));
    }

    #[test]
    fn revoked_node_keeps_no_report() {
        let mut memory = Memory::default();
        memory.take_members(Ok(members(&[])));
        memory.take_answers(Instant::now(), Ok(vec![answer("arm", true), answer("desk", true)]));
        assert_eq!(memory.take_members(Ok(members(&["arm"]))), ["desk"]);
        assert_eq!(here(&memory), all(false, true, true));
    }

    #[test]
    fn age_is_that_of_the_last_answer() {
        let (begin, mut memory) = (Instant::now(), Memory::default());
        let later = begin + Duration::from_secs(60);
        memory.take_members(Err("no node runs".into()));
        memory.take_answers(begin, Ok(Vec::new()));
        assert_eq!(memory.looked_at, None, "nothing was asked");
        memory.take_members(Ok(members(&[])));
        memory.take_answers(begin, Ok(vec![answer("arm", true)]));
        memory.take_members(Err("no node runs".into()));
        memory.take_answers(later, Err("no node runs".into()));
        assert_eq!((memory.looked_at, memory.error.as_deref()), (Some(begin), Some("no node runs")));
    }
}
