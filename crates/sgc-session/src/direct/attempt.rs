//! One attempt to find a path to a peer.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use aws_lc_rs::hmac;
use is::stun::{StunMessage, StunPacket, TransId};
use is::{Candidate, IceAgent, IceAgentEvent, IceCreds, IceError, Protocol, Sha1HmacProvider};
use rand_chacha::ChaCha20Rng;
use sgc_wire::{CandidateKind, PATH_CANDIDATES_MAX, PATH_OFFER_BYTES, PathCandidate, PathOffer, SecretBytes};

use super::addresses::{LocalAddress, is_checkable};
use super::{DIRECT_ATTEMPT_MAX, NoDirectPath, draw};

/// Time between two checks, and before the first repetition of one.
const CHECK_PACE: Duration = Duration::from_millis(20);
const CHECK_AGAIN_AFTER: Duration = Duration::from_millis(100);
/// Longest time between two checks of one pair.
const CHECK_EVERY_MAX: Duration = Duration::from_millis(500);
/// Most pairs of addresses that are checked.
const PAIRS_MAX: usize = 64;
/// Most addresses from which checks of the peer are taken: with its password, it can have them come from anywhere.
const SOURCES_MAX: usize = 32;
/// Time for a better pair to answer, after one did.
const SETTLE: Duration = Duration::from_millis(60);
/// Most checks whose answers are taken: more than an attempt sends.
const CHECKS_MAX: usize = 1024;
/// An address with a shorter round trip is taken instead of the agent's choice if that one's is longer by a quarter and
/// by this.
const CLEARLY_LONGER: Duration = Duration::from_millis(1);

/// HMAC-SHA1 for the agent, as RFC 8489 demands.
#[derive(Debug)]
struct Mac;

impl Sha1HmacProvider for Mac {
    fn sha1_hmac(&self, key: &[u8], payloads: &[&[u8]]) -> [u8; 20] {
        let mut context = hmac::Context::with_key(&hmac::Key::new(hmac::HMAC_SHA1_FOR_LEGACY_USE_ONLY, key));
        payloads.iter().for_each(|part| context.update(part));
        let mut out = [0; 20];
        out.copy_from_slice(context.sign().as_ref());
        out
    }
}

/// An attempt under way.
pub(super) struct Attempt {
    number: u64,
    user: [u8; 4],
    password: SecretBytes,
    candidates: Vec<PathCandidate>,
    agent: IceAgent,
    /// The peer's attempt, once it is known, and whether its offer was taken.
    peer: Option<u64>,
    has_offer: bool,
    is_controlling: bool,
    until: Instant,
    /// Bytes that may still be sent to addresses that have not answered.
    allowance: usize,
    /// Checks under way, with their destinations and times.
    checks: BTreeMap<TransId, (SocketAddr, Instant)>,
    /// Addresses at which a check was received, and so are of the peer, with the shortest round trip.
    answered: BTreeMap<SocketAddr, Duration>,
    /// Addresses from which authentic checks came. Their senders may have forged them.
    sources: BTreeSet<SocketAddr>,
    /// The address of the peer that the agent prefers, and the time from which an address is dialled.
    nominated: Option<(SocketAddr, Instant)>,
    dialled: Option<SocketAddr>,
    admitted: BTreeSet<SocketAddr>,
}

/// Results of an attempt since the last look.
#[derive(Debug, Default)]
pub(super) struct Progress {
    pub(super) sent: Vec<(SocketAddr, SocketAddr, Vec<u8>)>,
    pub(super) admitted: Vec<SocketAddr>,
    pub(super) dialled: Option<SocketAddr>,
}

impl Attempt {
    pub(super) fn new(
        now: Instant,
        is_controlling: bool,
        local: &[LocalAddress],
        rng: &mut ChaCha20Rng,
    ) -> Self {
        let (user, password) = (draw(rng), SecretBytes::new(draw(rng)));
        let mut agent = IceAgent::with_hmac(credentials(user, &password), &Mac);
        agent.set_controlling(is_controlling);
        agent.set_control_tie_breaker(u64::from_be_bytes(draw(rng)));
        agent.set_max_candidate_pairs(PAIRS_MAX);
        agent.set_timing_advance(CHECK_PACE);
        agent.set_initial_stun_rto(CHECK_AGAIN_AFTER);
        agent.set_max_stun_rto(CHECK_EVERY_MAX);
        let mut candidates = Vec::new();
        for local in local {
            if let Ok(candidate) = candidate(local.kind, local.address, local.base) {
                agent.add_local_candidate(candidate);
                candidates.push(PathCandidate { kind: local.kind, place: local.address.into() });
            }
        }
        candidates.truncate(PATH_CANDIDATES_MAX);
        agent.handle_timeout(now);
        Self {
            number: u64::from_be_bytes(draw(rng)),
            user,
            password,
            candidates,
            agent,
            peer: None,
            has_offer: false,
            is_controlling,
            until: now + DIRECT_ATTEMPT_MAX,
            allowance: 0,
            checks: BTreeMap::new(),
            answered: BTreeMap::new(),
            sources: BTreeSet::new(),
            nominated: None,
            dialled: None,
            admitted: BTreeSet::new(),
        }
    }

    pub(super) fn number(&self) -> u64 {
        self.number
    }

    /// Returns this node's addresses for the peer.
    pub(super) fn offer(&self) -> PathOffer {
        let (password, candidates) = (self.password.clone(), self.candidates.clone());
        PathOffer { attempt: self.number, user: self.user, password, candidates }
    }

    /// Returns `true` if the attempt is with this one of the peer, or with none yet.
    pub(super) fn is_with(&mut self, peer: u64) -> bool {
        *self.peer.get_or_insert(peer) == peer
    }

    /// Takes the peer's addresses, once. Returns `false` if they are of another attempt of the peer.
    pub(super) fn take_offer(&mut self, now: Instant, offer: &PathOffer, refused: &mut u64) -> bool {
        if !self.is_with(offer.attempt) {
            return false;
        }
        if std::mem::replace(&mut self.has_offer, true) {
            return true;
        }
        self.allowance = PATH_OFFER_BYTES;
        self.agent.set_remote_credentials(credentials(offer.user, &offer.password));
        for PathCandidate { kind, place } in &offer.candidates {
            let address = SocketAddr::from(*place);
            match candidate(*kind, address, address) {
                Ok(candidate) if is_checkable(&address) => self.agent.add_remote_candidate(candidate),
                _ => *refused += 1,
            }
        }
        self.agent.handle_timeout(now);
        true
    }

    /// Returns `true` if an address of the peer and one of this node are both of IPv4, or both of IPv6. A peer without
    /// addresses may still send checks.
    pub(super) fn shares_family(&self, offer: &PathOffer) -> bool {
        let has = |candidates: &[PathCandidate], is_v4| {
            candidates.iter().any(|candidate| SocketAddr::from(candidate.place).is_ipv4() == is_v4)
        };
        let shares =
            [true, false].iter().any(|is_v4| has(&self.candidates, *is_v4) && has(&offer.candidates, *is_v4));
        shares || offer.candidates.is_empty()
    }

    /// Returns `true` if a check is of this attempt.
    pub(super) fn accepts(&self, message: &StunMessage<'_>) -> bool {
        self.agent.accepts_message(message)
    }

    pub(super) fn receive(
        &mut self,
        now: Instant,
        to: SocketAddr,
        from: SocketAddr,
        (message, bytes): (StunMessage<'_>, usize),
    ) {
        if self.sources.len() >= SOURCES_MAX && !self.sources.contains(&from) {
            return;
        }
        // Only the receiver of a check knows its transaction. An answer may be sent in the name of any address, so it shows
        // that the peer is at the destination of the check. The agent keeps each address that an answer names, so it gets one
        // answer to each check.
        let answers =
            message.is_successful_binding_response().then(|| self.checks.remove(&message.trans_id()));
        if answers == Some(None) {
            return;
        }
        let packet = StunPacket { proto: Protocol::Udp, source: from, destination: to, message };
        if !self.agent.handle_packet(now, packet) {
            return;
        }
        self.sources.insert(from);
        // A check may cause as many bytes as it has. Only an address that answers is known to be of the peer.
        self.allowance = self.allowance.saturating_add(bytes);
        if let Some((checked, sent)) = answers.flatten() {
            let round_trip = now.saturating_duration_since(sent);
            let shortest = self.answered.entry(checked).or_insert(round_trip);
            *shortest = round_trip.min(*shortest);
        }
    }

    /// Returns `true` if a link at this address comes of this attempt.
    pub(super) fn expects(&self, address: SocketAddr) -> bool {
        self.dialled == Some(address) || self.admitted.contains(&address)
    }

    /// Lets the agent go on. `withheld` counts checks for which the offer does not pay.
    pub(super) fn advance(&mut self, now: Instant, withheld: &mut u64) -> Progress {
        let mut progress = Progress::default();
        // The agent has one thing to do at a time.
        for _ in 0..PAIRS_MAX {
            if self.agent.poll_timeout().is_none_or(|at| at > now) {
                break;
            }
            self.agent.handle_timeout(now);
        }
        while let Some(transmit) = self.agent.poll_transmit() {
            let (from, to) = (transmit.source, transmit.destination);
            let datagram = Vec::from(transmit.contents);
            if !self.answered.contains_key(&to) {
                let Some(left) = self.allowance.checked_sub(datagram.len()) else {
                    *withheld += 1;
                    continue;
                };
                self.allowance = left;
            }
            let check = StunMessage::parse(&datagram).ok().filter(StunMessage::is_binding_request);
            if let Some(check) = check.filter(|_| self.checks.len() < CHECKS_MAX) {
                self.checks.insert(check.trans_id(), (to, now));
            }
            progress.sent.push((from, to, datagram));
        }
        while let Some(event) = self.agent.poll_event() {
            match event {
                IceAgentEvent::NominatedSend { destination, .. } => {
                    let from = self.nominated.map_or(now + SETTLE, |(_, from)| from);
                    self.nominated = Some((destination, from));
                }
                // Only the peer has the password, so its link may come from there.
                IceAgentEvent::DiscoveredRecv { source, .. }
                    if !self.is_controlling && self.admitted.insert(source) =>
                {
                    progress.admitted.push(source);
                }
                _ => {}
            }
        }
        let nominated = self.nominated.filter(|(_, from)| self.is_controlling && *from <= now);
        if let Some((address, _)) = nominated.filter(|_| self.dialled.is_none()) {
            let address = self.quickest(address);
            self.dialled = Some(address);
            progress.dialled = Some(address);
        }
        progress
    }

    /// Returns the address with the shortest round trip, or the agent's choice if that is about as quick.
    fn quickest(&self, nominated: SocketAddr) -> SocketAddr {
        let shortest = self.answered.iter().min_by_key(|(_, round_trip)| **round_trip);
        let Some((address, round_trip)) = shortest else { return nominated };
        let limit = *round_trip + (*round_trip / 4).max(CLEARLY_LONGER);
        match self.answered.get(&nominated) {
            Some(of_nominated) if *of_nominated <= limit => nominated,
            _ => *address,
        }
    }

    /// Returns why the attempt failed, if it did.
    pub(super) fn over(&self, now: Instant) -> Option<NoDirectPath> {
        let why = || match (self.has_offer, self.sources.is_empty()) {
            (false, _) => NoDirectPath::Unanswered,
            (true, true) => NoDirectPath::Blocked,
            (true, false) => NoDirectPath::NoLink,
        };
        (self.until <= now).then(why)
    }

    pub(super) fn deadline(&mut self) -> Instant {
        let dial = self.nominated.filter(|_| self.is_controlling && self.dialled.is_none());
        let times = [self.agent.poll_timeout(), dial.map(|(_, from)| from)];
        times.into_iter().flatten().fold(self.until, Instant::min)
    }
}

impl fmt::Debug for Attempt {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { number, peer, has_offer, allowance, nominated, .. } = self;
        f.debug_struct("Attempt")
            .field("number", number)
            .field("peer", peer)
            .field("has_offer", has_offer)
            .field("allowance", allowance)
            .field("nominated", nominated)
            .finish_non_exhaustive()
    }
}

/// Returns a candidate for the agent. The base of a host's address is the address itself.
fn candidate(kind: CandidateKind, address: SocketAddr, base: SocketAddr) -> Result<Candidate, IceError> {
    match kind {
        CandidateKind::Host => Candidate::host(base, Protocol::Udp),
        CandidateKind::ServerReflexive => Candidate::server_reflexive(address, base, Protocol::Udp),
    }
}

/// Returns the credentials of checks in text, as ICE has them.
fn credentials(user: [u8; 4], password: &SecretBytes) -> IceCreds {
    let hex = |bytes: &[u8]| bytes.iter().map(|byte| format!("{byte:02x}")).collect::<String>();
    IceCreds { ufrag: hex(&user), pass: hex(password.expose()) }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::disallowed_methods)]

    use rand_core::SeedableRng as _;

    use super::*;

    #[test]
    fn agent_keeps_one_address_of_this_node_for_each_check() {
        let now = Instant::now();
        let places = [1, 2].map(|n| SocketAddr::from(([192, 0, 2, n], 5000)));
        let host = |address| LocalAddress { kind: CandidateKind::Host, address, base: address };
        let [mut near, mut far] = [(true, places[0]), (false, places[1])].map(|(is_controlling, address)| {
            let mut rng = ChaCha20Rng::seed_from_u64(is_controlling.into());
            Attempt::new(now, is_controlling, &[host(address)], &mut rng)
        });
        let (mut refused, mut withheld) = (0, 0);
        assert!(far.take_offer(now, &near.offer(), &mut refused));
        assert!(near.take_offer(now, &far.offer(), &mut refused));
        let check = near.advance(now, &mut withheld).sent.remove(0).2;
        let message = StunMessage::parse(&check).unwrap();
        // An answer names the address from which the check seems to come.
        let mut answers = 0;
        for port in 1..=8 {
            let seen = SocketAddr::from(([203, 0, 113, 7], port));
            far.receive(now, places[1], seen, (message, check.len()));
            let sent = far.advance(now, &mut withheld).sent;
            for (_, _, answer) in sent.into_iter().filter(|(_, to, _)| *to == seen) {
                let answer_message = StunMessage::parse(&answer).unwrap();
                if answer_message.is_successful_binding_response() {
                    assert!(near.accepts(&answer_message));
                    near.receive(now, places[0], places[1], (answer_message, answer.len()));
                    answers += 1;
                }
            }
        }
        assert_eq!((answers, near.agent.local_candidates().count()), (8, 2));
        assert!(near.answered.contains_key(&places[1]));
    }
}
