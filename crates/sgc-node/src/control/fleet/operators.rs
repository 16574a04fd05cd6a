//! Operations that a fleet's authority carries out: for operators list, revoke, enrol, renew and invite, and for
//! holders of invitations redeem.
//!
//! A request is a join, so its author is known by its certificate. A router could repeat it, so each operation names a
//! challenge that this run of the authority gave the same node, and is carried out once. A repeated request gets the
//! first answer, sealed to the key of the new request.

use std::collections::{BTreeMap, VecDeque};
use std::path::Path;
use std::time::{Duration, Instant};

use bytes::Bytes;
use rand_core::{OsRng, RngCore, TryRngCore as _};
use sgc_trust::{
    EnrollRequest, Fleet, FleetError, Grantees, Kem, Membership, NodeName, RosterNode, VerifiedPeer, name_of,
    operations_blind, seal_grant,
};
use sgc_wire::{
    Challenge, Decode as _, Encode as _, GrantContent, NodeId, Operation, OperationAnswer, OperationRefusal,
    OperationRequest, REDEEM_SINK, REFUSAL_DETAIL_BYTES_MAX, ROSTER_ROWS_MAX, ROW_CERTIFICATES_MAX,
    RosterPage, RosterRow, RowCertificate, SecretText, SinkId, UnixMillis,
};
use tracing::error;

use crate::control::fleet::holders::{Attempts, HOLDER_CHALLENGES_MAX, HOLDERS_EXECUTED_MAX};
use crate::state::fleet_file::{FleetFileError, LockedFleet, read_fleet};

/// Most operations that wait for the fleet file.
pub(crate) const OPERATIONS_WAITING_MAX: usize = 16;
/// Most valid challenges of one operator. A further one replaces the oldest.
const CHALLENGES_PER_NODE_MAX: usize = 4;
/// Most valid challenges.
const CHALLENGES_MAX: usize = 256;
/// Validity of a challenge.
const CHALLENGE_TIME: Duration = Duration::from_secs(60);
/// Most operations of operators whose answers are remembered: as many as may be under way and wait together. None under
/// way is forgotten.
const EXECUTED_MAX: usize = 2 * OPERATIONS_WAITING_MAX;
/// Most bytes of the rows in one page of a roster.
const PAGE_BYTES_MAX: usize = 512 * 1024;

/// Next step for a request.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum RequestStep {
    /// Send this answer.
    Answer(OperationAnswer),
    /// Send the answer that the same request got before.
    Again(OperationAnswer),
    /// Queue this job. Its answer follows.
    Job(OperationJob),
    /// The operation is under way. Its answer goes to the sink that asked last.
    UnderWay,
    /// The node is no operator, or as the holder of an invitation may not ask for this.
    NotPermitted,
}

/// An operation to be carried out.
#[derive(Debug)]
pub(crate) struct OperationJob {
    challenge: Challenge,
    peer: VerifiedPeer,
    operation: Operation,
}

impl PartialEq for OperationJob {
    fn eq(&self, other: &Self) -> bool {
        let key = |job: &Self| (job.challenge, job.peer.node_id);
        key(self) == key(other) && self.operation == other.operation
    }
}

impl Eq for OperationJob {}

/// The outcome of an operation.
pub(crate) struct OperationOutcome {
    challenge: Challenge,
    pub(crate) node: NodeId,
    /// The operation in words, for the audit log.
    pub(crate) said: String,
    pub(crate) answer: OperationAnswer,
    /// The resulting revocation list, DER.
    pub(crate) list: Option<Vec<u8>>,
    /// The node that joined.
    pub(crate) joined: Option<NodeId>,
}

/// Operators of a fleet, with their challenges and operations.
#[derive(Debug)]
pub(crate) struct Operators {
    permitted: Grantees,
    /// Challenges, the oldest first.
    challenges: VecDeque<ChallengeRecord>,
    /// Operations, the oldest first.
    executed: VecDeque<ExecutionRecord>,
    /// Requests of holders of invitations.
    attempts: Attempts,
}

#[derive(Debug)]
struct ChallengeRecord {
    challenge: Challenge,
    node: NodeId,
    /// Whether the node holds an invitation.
    is_holder: bool,
    until: Instant,
}

#[derive(Debug)]
struct ExecutionRecord {
    challenge: Challenge,
    node: NodeId,
    /// Whether the node holds an invitation.
    is_holder: bool,
    operation: Operation,
    /// The sink that asked last.
    sink: SinkId,
    /// The answer; `None` while the operation is under way.
    answer: Option<OperationAnswer>,
}

impl Operators {
    /// Creates the state of an authority with these operators.
    pub(crate) fn new(permitted: Grantees) -> Self {
        let (challenges, executed) = (VecDeque::new(), VecDeque::new());
        Self { permitted, challenges, executed, attempts: Attempts::default() }
    }

    /// Replaces the operators.
    pub(crate) fn set_permitted(&mut self, permitted: Grantees) {
        self.permitted = permitted;
    }

    /// Judges a request.
    pub(crate) fn ask(
        &mut self,
        now: Instant,
        peer: &VerifiedPeer,
        sink: SinkId,
        request: &Bytes,
        rng: &mut impl RngCore,
    ) -> RequestStep {
        if peer.invitation.is_none() && self.permitted.find(peer).is_none() {
            return RequestStep::NotPermitted;
        }
        self.challenges.retain(|issued| now < issued.until);
        match OperationRequest::from_slice(request) {
            Ok(OperationRequest::Challenge) => RequestStep::Answer(self.challenge(now, peer, rng)),
            Ok(OperationRequest::Execute { challenge, operation }) => {
                // The holder of an invitation may redeem it, and do nothing else; and nobody else may.
                if matches!(operation, Operation::Redeem { .. }) != peer.invitation.is_some() {
                    return RequestStep::NotPermitted;
                }
                self.execute(peer, sink, challenge, operation)
            }
            Err(why) => RequestStep::Answer(refused(OperationRefusal::Malformed, why)),
        }
    }

    fn challenge(&mut self, now: Instant, peer: &VerifiedPeer, rng: &mut impl RngCore) -> OperationAnswer {
        let (node, is_holder) = (peer.node_id, peer.invitation.is_some());
        let is_own = |issued: &ChallengeRecord| issued.node == node;
        let has_all =
            self.challenges.iter().filter(|issued| is_own(issued)).count() >= CHALLENGES_PER_NODE_MAX;
        let holders = self.challenges.iter().filter(|issued| issued.is_holder).count();
        let oldest = match (has_all, is_holder) {
            (true, _) => self.challenges.iter().position(is_own),
            (false, true) if holders >= HOLDER_CHALLENGES_MAX => {
                self.challenges.iter().position(|issued| issued.is_holder)
            }
            (false, _) => None,
        };
        if let Some(oldest) = oldest {
            self.challenges.remove(oldest);
        }
        if !is_holder && self.challenges.len().saturating_sub(holders) >= CHALLENGES_MAX {
            return refused(OperationRefusal::Busy, "");
        }
        let mut challenge = Challenge([0; 16]);
        rng.fill_bytes(&mut challenge.0);
        self.challenges.push_back(ChallengeRecord {
            challenge,
            node,
            is_holder,
            until: now + CHALLENGE_TIME,
        });
        OperationAnswer::Challenge(challenge)
    }

    fn execute(
        &mut self,
        peer: &VerifiedPeer,
        sink: SinkId,
        challenge: Challenge,
        operation: Operation,
    ) -> RequestStep {
        let node = peer.node_id;
        if let Some(known) = self.executed.iter_mut().find(|e| e.challenge == challenge) {
            if known.node != node || known.operation != operation {
                return RequestStep::Answer(refused(OperationRefusal::Stale, ""));
            }
            known.sink = sink;
            return known.answer.clone().map_or(RequestStep::UnderWay, RequestStep::Again);
        }
        let issued = self.challenges.iter().position(|i| i.challenge == challenge && i.node == node);
        let Some(issued) = issued else {
            return RequestStep::Answer(refused(OperationRefusal::Stale, ""));
        };
        self.challenges.remove(issued);
        let is_holder = peer.invitation.is_some();
        let max = if is_holder { HOLDERS_EXECUTED_MAX } else { EXECUTED_MAX };
        if self.executed.iter().filter(|e| e.is_holder == is_holder).count() >= max {
            let answered = |e: &ExecutionRecord| e.is_holder == is_holder && e.answer.is_some();
            let Some(answered) = self.executed.iter().position(answered) else {
                return RequestStep::Answer(refused(OperationRefusal::Busy, ""));
            };
            self.executed.remove(answered);
        }
        if is_holder && !self.attempts.count(node) {
            let detail = "too many attempts with this code: ask for another one";
            return RequestStep::Answer(refused(OperationRefusal::Fleet, detail));
        }
        let (answer, doing) = (None, operation.clone());
        self.executed.push_back(ExecutionRecord {
            challenge,
            node,
            is_holder,
            operation: doing,
            sink,
            answer,
        });
        RequestStep::Job(OperationJob { challenge, peer: peer.clone(), operation })
    }

    /// Records the outcome of a job. Returns the sink that waits for it.
    pub(crate) fn done(&mut self, done: &OperationOutcome) -> Option<SinkId> {
        let known = self.executed.iter_mut().find(|e| e.challenge == done.challenge)?;
        known.answer = Some(done.answer.clone());
        // A request that found no room costs no attempt.
        if matches!(done.answer, OperationAnswer::Refused { why: OperationRefusal::Busy, .. }) {
            self.attempts.forgive(&known.node);
        }
        Some(known.sink)
    }
}

impl OperationJob {
    /// Returns `true` if the holder of an invitation asks.
    pub(crate) fn is_of_holder(&self) -> bool {
        self.peer.invitation.is_some()
    }

    /// Returns the outcome of an operation that cannot be queued.
    pub(crate) fn busy(self) -> OperationOutcome {
        self.end(Done::new(refused(OperationRefusal::Busy, "")))
    }

    /// Carries the operation out. Blocks on the fleet file. `own` is the authority, `seen` the times at which members
    /// were last present.
    pub(crate) fn carry_out(
        self,
        file: &Path,
        own: &NodeId,
        seen: &BTreeMap<NodeId, UnixMillis>,
        now: UnixMillis,
    ) -> OperationOutcome {
        let done = match &self.operation {
            Operation::List { after } => list(file, after.as_deref(), seen).map(Done::new),
            Operation::Revoke { nodes } => revoke(file, own, nodes, now),
            Operation::Enroll { .. } | Operation::Renew { .. } => {
                certify(file, &self.operation, now).map(Done::new)
            }
            Operation::Redeem { csr, reply_key } => redeem(file, own, &self.peer, (csr, reply_key), now),
            Operation::Invite { .. } => invite(file, &self.operation, now).map(Done::new),
        };
        let done = done.unwrap_or_else(|why| match why {
            // A stranger learns nothing of this machine.
            Failure::File(why) if self.is_of_holder() => {
                error!("cannot redeem an invitation: {why}");
                Done::new(refused(OperationRefusal::File, ""))
            }
            why => Done::new(why.into()),
        });
        self.end(done)
    }

    fn end(self, Done { answer, list, joined }: Done) -> OperationOutcome {
        let Self { challenge, peer, operation } = self;
        let node = peer.node_id;
        let outcome = match &answer {
            OperationAnswer::Refused { why, detail } if detail.is_empty() => format!("refused: {why}"),
            OperationAnswer::Refused { detail, .. } => format!("refused: {detail}"),
            _ => "done".to_owned(),
        };
        let said = match &operation {
            Operation::List { .. } => "list".to_owned(),
            Operation::Revoke { nodes } => format!("revoke {}", nodes.join(" ")),
            Operation::Enroll { node, .. } => format!("enroll {node}"),
            Operation::Renew { node, .. } => format!("renew {node}"),
            Operation::Invite { node, .. } => format!("invite {node}"),
            Operation::Redeem { .. } => match &joined {
                Some((name, _)) => format!("redeem the invitation of {name}"),
                None => "redeem an invitation".to_owned(),
            },
        };
        let joined = joined.map(|(_, id)| id);
        OperationOutcome { challenge, node, said: format!("{said}: {outcome}"), answer, list, joined }
    }
}

/// The result of a job.
struct Done {
    answer: OperationAnswer,
    /// The resulting revocation list, DER.
    list: Option<Vec<u8>>,
    /// The node that joined.
    joined: Option<(NodeName, NodeId)>,
}

impl Done {
    fn new(answer: OperationAnswer) -> Self {
        Self { answer, list: None, joined: None }
    }
}

/// Reasons why an operation failed.
enum Failure {
    File(FleetFileError),
    Fleet(FleetError),
    Malformed(String),
    OwnRevocation,
}

impl From<FleetFileError> for Failure {
    fn from(why: FleetFileError) -> Self {
        Self::File(why)
    }
}

impl From<FleetError> for Failure {
    fn from(why: FleetError) -> Self {
        Self::Fleet(why)
    }
}

impl From<sgc_trust::LabelError> for Failure {
    fn from(why: sgc_trust::LabelError) -> Self {
        Self::Malformed(why.to_string())
    }
}

impl From<Failure> for OperationAnswer {
    fn from(failure: Failure) -> Self {
        match failure {
            Failure::File(why) => refused(OperationRefusal::File, why),
            Failure::Fleet(why) => refused(OperationRefusal::Fleet, why),
            Failure::Malformed(why) => refused(OperationRefusal::Malformed, why),
            Failure::OwnRevocation => refused(
                OperationRefusal::Fleet,
                "the authority does not revoke itself: nobody would be left to undo it; use its fleet file",
            ),
        }
    }
}

fn refused(why: OperationRefusal, detail: impl ToString) -> OperationAnswer {
    let mut detail = detail.to_string();
    while detail.len() > REFUSAL_DETAIL_BYTES_MAX {
        detail.pop();
    }
    OperationAnswer::Refused { why, detail }
}

fn revoke(file: &Path, own: &NodeId, nodes: &[String], now: UnixMillis) -> Result<Done, Failure> {
    let nodes = nodes.iter().map(|n| n.parse()).collect::<Result<Vec<NodeName>, _>>()?;
    let mut locked = LockedFleet::open(file)?;
    if nodes.iter().any(|node| locked.fleet.node_id_of(node) == *own) {
        return Err(Failure::OwnRevocation);
    }
    locked.fleet.revoke(&nodes, now)?;
    let list = locked.fleet.revocation_list(now)?;
    locked.save()?;
    let answer = OperationAnswer::Revoked { list: locked.fleet.crl_number() };
    Ok(Done { list: Some(list), ..Done::new(answer) })
}

/// Enrols or renews. The file has the certificate before the answer leaves.
fn certify(file: &Path, operation: &Operation, now: UnixMillis) -> Result<OperationAnswer, Failure> {
    let mut rng = OsRng.unwrap_err();
    let mut locked = LockedFleet::open(file)?;
    let member: Membership = match operation {
        Operation::Enroll { node, groups, router, may_route, again, valid_ms, csr } => {
            let groups = groups.iter().map(|g| g.parse()).collect::<Result<_, _>>()?;
            let (router, may_route, again) = (*router, *may_route, *again);
            let valid = Duration::from_millis(*valid_ms);
            let new = EnrollRequest::new(node.parse()?, now);
            let request = EnrollRequest { groups, router, may_route, again, valid, ..new };
            locked.fleet.enroll_csr(csr, &request, &mut rng)?
        }
        Operation::Renew { node, valid_ms, csr } => {
            let valid = Duration::from_millis(*valid_ms);
            locked.fleet.renew_member(csr, &node.parse()?, valid, now, &mut rng)?
        }
        Operation::List { .. }
        | Operation::Revoke { .. }
        | Operation::Redeem { .. }
        | Operation::Invite { .. } => {
            return Err(Failure::Malformed("it makes no certificate".to_owned()));
        }
    };
    locked.save()?;
    Ok(OperationAnswer::Membership(SecretText::new(member.to_text().to_string())))
}

/// Redeems an invitation. The file knows that it was used before the answer leaves. The answer is sealed to the key in
/// the operation: others may hold the same code, and ask again with the same challenge.
fn redeem(
    file: &Path,
    own: &NodeId,
    peer: &VerifiedPeer,
    (csr, reply_key): (&[u8], &[u8]),
    now: UnixMillis,
) -> Result<Done, Failure> {
    let mut locked = LockedFleet::open(file)?;
    if reply_key.len() != Kem::for_fleet(locked.fleet.post_quantum()).reply_key_bytes() {
        return Err(Failure::Malformed("its reply key is not of the kind that the fleet wants".to_owned()));
    }
    let member = locked.fleet.redeem(csr, peer, now, &mut OsRng.unwrap_err())?;
    let joined = (member.node_name().clone(), locked.fleet.node_id_of(member.node_name()));
    let text = SecretText::new(member.to_text().to_string());
    let content = GrantContent::Operation(OperationAnswer::Membership(text));
    let name = name_of(own, &operations_blind(&peer.ca));
    let sealed = seal_grant(reply_key, &name, &REDEEM_SINK, 0, &content);
    let (enc, sealed) = sealed.map_err(|why| Failure::Malformed(why.to_string()))?;
    locked.save()?;
    Ok(Done { joined: Some(joined), ..Done::new(OperationAnswer::Sealed { enc, sealed }) })
}

/// Invites a node. The key in the invitation is of no node, so the authority may make it.
fn invite(file: &Path, operation: &Operation, now: UnixMillis) -> Result<OperationAnswer, Failure> {
    let Operation::Invite { node, groups, router, may_route, again, valid_ms, within_ms, routers } =
        operation
    else {
        return Err(Failure::Malformed("it makes no invitation".to_owned()));
    };
    let groups = groups.iter().map(|g| g.parse()).collect::<Result<_, _>>()?;
    let (router, may_route, again) = (*router, *may_route, *again);
    let (valid, within) = (Duration::from_millis(*valid_ms), Duration::from_millis(*within_ms));
    let new = EnrollRequest::new(node.parse()?, now);
    let request = EnrollRequest { groups, router, may_route, again, valid, ..new };
    let mut locked = LockedFleet::open(file)?;
    let invitation = locked.fleet.invite(&request, within, routers.clone(), &mut OsRng.unwrap_err())?;
    locked.save()?;
    Ok(OperationAnswer::Invitation(SecretText::new(invitation.to_text().to_string())))
}

fn list(
    file: &Path,
    after: Option<&str>,
    seen: &BTreeMap<NodeId, UnixMillis>,
) -> Result<OperationAnswer, Failure> {
    let after = after.map(|a| a.parse::<NodeName>()).transpose()?;
    let fleet = read_fleet(file)?;
    let mut page = roster_head(&fleet);
    let mut bytes = 0;
    let rest = fleet.nodes().filter(|node| after.as_ref().is_none_or(|after| node.name > *after));
    for node in rest {
        let mut row = roster_row(&fleet, node);
        row.seen = row.seen.max(seen.get(&row.id).copied());
        bytes += row.to_vec().len();
        if bytes > PAGE_BYTES_MAX || page.nodes.len() >= ROSTER_ROWS_MAX {
            page.more = true;
            break;
        }
        page.nodes.push(row);
    }
    Ok(OperationAnswer::Roster(page))
}

/// Returns the public part of a fleet's roster, without its nodes.
pub fn roster_head(fleet: &Fleet) -> RosterPage {
    RosterPage {
        fleet: fleet.name().to_string(),
        expires: fleet.not_after(),
        authority: fleet.authority().map(ToString::to_string),
        post_quantum: fleet.post_quantum(),
        has_roster: fleet.has_roster(),
        revocation_list: fleet.crl_number(),
        generations: fleet.generations().iter().map(|g| (g.number, g.created)).collect(),
        nodes: Vec::new(),
        more: false,
    }
}

/// Returns the public part of a roster's node.
pub fn roster_row(fleet: &Fleet, node: &RosterNode) -> RosterRow {
    let certificates = node.certificates.iter().take(ROW_CERTIFICATES_MAX);
    let revocation = fleet.revocation_of(&node.name);
    RosterRow {
        name: node.name.to_string(),
        id: fleet.node_id_of(&node.name),
        incarnation: node.incarnation,
        groups: node.groups.iter().map(ToString::to_string).collect(),
        router: node.router,
        may_route: node.may_route,
        expires: node.expires(revocation),
        revoked: fleet.revoked_at(node),
        generation: node.generation,
        seen: node.seen,
        certificates: certificates
            .map(|c| RowCertificate {
                serial: Bytes::copy_from_slice(&c.serial),
                expires: c.not_after,
                incarnation: c.incarnation,
                revoked: c.revoked_at(revocation),
            })
            .collect(),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use std::path::PathBuf;

    use rand_chacha::ChaCha20Rng;
    use rand_core::SeedableRng as _;
    use sgc_trust::Identity;

    use super::*;
    use crate::state;

    const A: SinkId = SinkId([1; 16]);
    const B: SinkId = SinkId([2; 16]);

    struct Bench {
        _dir: tempfile::TempDir,
        file: PathBuf,
        keeper: NodeId,
        desk: Identity,
        guest: Identity,
        operators: Operators,
        rng: ChaCha20Rng,
        now: Instant,
    }

    impl Bench {
        /// Creates a fleet whose operator is the node `desk`.
        fn new() -> Self {
            let dir = tempfile::tempdir().unwrap();
            let file = dir.path().join("lab.fleet");
            let mut rng = ChaCha20Rng::seed_from_u64(1);
            let unix = crate::clock::now().unix;
            let mut fleet = Fleet::create("lab".parse().unwrap(), unix, &mut rng).unwrap();
            let mut enroll = |node: &str| {
                let request = EnrollRequest::new(node.parse().unwrap(), unix);
                fleet.enroll(&request, &mut rng).unwrap()
            };
            let (keeper, desk, guest) = (enroll("keeper").node_id(), enroll("desk"), enroll("guest"));
            state::replace(&file, fleet.to_text().as_bytes()).unwrap();
            let nodes = [desk.node_id()].into();
            let operators = Operators::new(Grantees { nodes, ..Grantees::default() });
            Self { _dir: dir, file, keeper, desk, guest, operators, rng, now: Instant::now() }
        }

        fn ask(&mut self, of_guest: bool, sink: SinkId, request: &OperationRequest) -> RequestStep {
            let peer = if of_guest { self.guest.as_peer() } else { self.desk.as_peer() };
            self.operators.ask(self.now, peer, sink, &request.to_bytes(), &mut self.rng)
        }

        fn challenge(&mut self) -> Challenge {
            match self.ask(false, A, &OperationRequest::Challenge) {
                RequestStep::Answer(OperationAnswer::Challenge(challenge)) => challenge,
                other => panic!("{other:?}"),
            }
        }

        fn carry_out(&mut self, job: OperationJob) -> OperationOutcome {
            let now = crate::clock::now().unix;
            job.carry_out(&self.file, &self.keeper, &BTreeMap::new(), now)
        }

        fn is_revoked(&self, node: &str) -> bool {
            let fleet = read_fleet(&self.file).unwrap();
            let row = roster_row(&fleet, fleet.node(&node.parse().unwrap()).unwrap());
            row.revoked.is_some()
        }
    }

    fn revoke_guest(challenge: Challenge) -> OperationRequest {
        let operation = Operation::Revoke { nodes: vec!["guest".into()] };
        OperationRequest::Execute { challenge, operation }
    }

    fn is_stale(asked: &RequestStep) -> bool {
        let RequestStep::Answer(OperationAnswer::Refused { why, .. }) = asked else { return false };
        *why == OperationRefusal::Stale
    }

    #[test]
    fn a_repeated_request_is_carried_out_once_and_answered_as_before() {
        let mut bench = Bench::new();
        let challenge = bench.challenge();
        let request = revoke_guest(challenge);
        let RequestStep::Job(job) = bench.ask(false, A, &request) else { panic!("it is new") };
        assert_eq!(bench.ask(false, B, &request), RequestStep::UnderWay);
        let done = bench.carry_out(job);
        assert!(done.list.is_some() && bench.is_revoked("guest"));
        assert_eq!(done.said, "revoke guest: done");
        assert_eq!(bench.operators.done(&done), Some(B), "the newer sink is answered");
        for _ in 0..3 {
            assert_eq!(bench.ask(false, A, &request), RequestStep::Again(done.answer.clone()));
        }
        // The challenge is valid for that operation only.
        let operation = Operation::Revoke { nodes: vec!["desk".into()] };
        assert!(is_stale(&bench.ask(false, A, &OperationRequest::Execute { challenge, operation })));
    }

    #[test]
    fn a_challenge_of_another_run_another_node_or_an_earlier_time_is_stale() {
        let mut bench = Bench::new();
        let challenge = bench.challenge();
        assert!(is_stale(&bench.ask(false, A, &revoke_guest(Challenge([9; 16])))));
        // The restarted authority knows no earlier challenges or operations.
        let nodes = [bench.desk.node_id(), bench.guest.node_id()].into();
        let first = std::mem::replace(
            &mut bench.operators,
            Operators::new(Grantees { nodes, ..Grantees::default() }),
        );
        assert!(is_stale(&bench.ask(false, A, &revoke_guest(challenge))));
        let other = bench.challenge();
        assert!(is_stale(&bench.ask(true, A, &revoke_guest(other))), "it was given to another operator");
        bench.operators = first;
        bench.now += CHALLENGE_TIME;
        assert!(is_stale(&bench.ask(false, A, &revoke_guest(challenge))));
        assert!(!bench.is_revoked("guest"));
    }

    #[test]
    fn a_node_that_is_no_operator_is_given_nothing() {
        let mut bench = Bench::new();
        let challenge = bench.challenge();
        for request in [OperationRequest::Challenge, revoke_guest(challenge)] {
            assert_eq!(bench.ask(true, A, &request), RequestStep::NotPermitted);
        }
        assert_eq!(bench.operators.challenges.len(), 1);
        let malformed = bench.operators.ask(
            bench.now,
            bench.desk.as_peer(),
            A,
            &Bytes::from_static(b"\xff"),
            &mut bench.rng,
        );
        let RequestStep::Answer(OperationAnswer::Refused { why, .. }) = malformed else {
            panic!("{malformed:?}")
        };
        assert_eq!(why, OperationRefusal::Malformed);
    }

    #[test]
    fn challenges_and_answers_that_are_remembered_are_bounded() {
        let mut bench = Bench::new();
        let first = bench.challenge();
        for _ in 0..1000 {
            bench.challenge();
        }
        assert_eq!(bench.operators.challenges.len(), CHALLENGES_PER_NODE_MAX);
        assert!(is_stale(&bench.ask(false, A, &revoke_guest(first))));
        let mut jobs = Vec::new();
        for _ in 0..EXECUTED_MAX {
            let challenge = bench.challenge();
            let RequestStep::Job(job) = bench.ask(false, A, &revoke_guest(challenge)) else { panic!("room") };
            jobs.push(job);
        }
        // None under way gives way to another; those that were answered do, the oldest first.
        let challenge = bench.challenge();
        assert!(is_busy(&bench.ask(false, A, &revoke_guest(challenge))));
        let done = jobs.remove(1).busy();
        assert_eq!(bench.operators.done(&done), Some(A));
        for _ in 0..10 {
            let challenge = bench.challenge();
            let RequestStep::Job(job) = bench.ask(false, A, &revoke_guest(challenge)) else { panic!("room") };
            assert_eq!(bench.operators.done(&job.busy()), Some(A));
        }
        for job in jobs {
            assert_eq!(bench.operators.done(&job.busy()), Some(A), "it was not forgotten");
        }
        assert_eq!(bench.operators.executed.len(), EXECUTED_MAX);
    }

    #[test]
    fn holders_of_invitations_take_nothing_that_operators_need() {
        let mut bench = Bench::new();
        let unix = crate::clock::now().unix;
        let mut locked = LockedFleet::open(&bench.file).unwrap();
        locked.fleet.set_authority(Some("keeper".parse().unwrap()), unix).unwrap();
        let mut holder = |n: usize| {
            let request = EnrollRequest::new(format!("arm-{n}").parse().unwrap(), unix);
            let (hour, routers) = (Duration::from_secs(3600), vec!["quic://hub:1".to_owned()]);
            let code = locked.fleet.invite(&request, hour, routers, &mut bench.rng).unwrap();
            code.identity(&mut bench.rng).unwrap().as_peer().clone()
        };
        let holders: Vec<_> = (0..2 * HOLDER_CHALLENGES_MAX).map(&mut holder).collect();
        locked.save().unwrap();
        drop(locked);
        let mut last = Vec::new();
        for peer in &holders {
            let asked = bench.operators.ask(
                bench.now,
                peer,
                A,
                &OperationRequest::Challenge.to_bytes(),
                &mut bench.rng,
            );
            let RequestStep::Answer(OperationAnswer::Challenge(challenge)) = asked else {
                panic!("{asked:?}")
            };
            last.push((peer, challenge));
        }
        assert_eq!(bench.operators.challenges.len(), HOLDER_CHALLENGES_MAX);
        // A holder may redeem and nothing else.
        let (peer, challenge) = *last.last().unwrap();
        let list = OperationRequest::Execute { challenge, operation: Operation::List { after: None } };
        let asked = bench.operators.ask(bench.now, peer, A, &list.to_bytes(), &mut bench.rng);
        assert_eq!(asked, RequestStep::NotPermitted);
        // Operators have all of their challenges.
        for _ in 0..CHALLENGES_PER_NODE_MAX {
            bench.challenge();
        }
        assert_eq!(bench.operators.challenges.len(), HOLDER_CHALLENGES_MAX + CHALLENGES_PER_NODE_MAX);
    }

    fn is_busy(asked: &RequestStep) -> bool {
        let RequestStep::Answer(OperationAnswer::Refused { why, .. }) = asked else { return false };
        *why == OperationRefusal::Busy
    }

    #[test]
    fn refused_operation_is_explained_and_changes_nothing() {
        let mut bench = Bench::new();
        let mut refusal = |operation| {
            let challenge = bench.challenge();
            let asked = bench.ask(false, A, &OperationRequest::Execute { challenge, operation });
            let RequestStep::Job(job) = asked else { panic!("{asked:?}") };
            match bench.carry_out(job).answer {
                OperationAnswer::Refused { why, detail } => (why, detail),
                other => panic!("{other:?}"),
            }
        };
        let (why, detail) = refusal(Operation::Revoke { nodes: vec!["guest".into(), "nobody".into()] });
        assert_eq!(why, OperationRefusal::Fleet);
        assert!(detail.contains("no node nobody"), "{detail}");
        let (why, detail) = refusal(Operation::Revoke { nodes: vec!["keeper".into()] });
        assert_eq!(why, OperationRefusal::Fleet);
        assert!(detail.contains("does not revoke itself"), "{detail}");
        let (why, _) = refusal(Operation::Renew { node: "N O".into(), valid_ms: 1, csr: Bytes::new() });
        assert_eq!(why, OperationRefusal::Malformed);
        let renew =
            Operation::Renew { node: "guest".into(), valid_ms: 60_000, csr: Bytes::from_static(b"x") };
        assert_eq!(refusal(renew).0, OperationRefusal::Fleet);
        assert!(!bench.is_revoked("guest"));
        std::fs::remove_file(&bench.file).unwrap();
        let challenge = bench.challenge();
        let asked = bench.ask(false, A, &revoke_guest(challenge));
        let RequestStep::Job(job) = asked else { panic!("{asked:?}") };
        let answer = bench.carry_out(job).answer;
        assert!(matches!(answer, OperationAnswer::Refused { why: OperationRefusal::File, .. }), "{answer:?}");
    }
}
