//! Proven addresses of one association's peer: logic without IO.
//!
//! A datagram proves its sender but not its origin, because everybody can write any source address. So a listener asks
//! the peer of an association to repeat a token that it sends to the new address, inside of the association (RFC 9000,
//! 8.2), and sends nothing else there before. The present address of another association changes hands only if its
//! owner does not repeat a token that is sent to it. [`super::mux`] keeps the owners of addresses.

use std::net::{IpAddr, SocketAddr};
use std::time::{Duration, Instant};

use super::front::Token;

/// Most addresses of one association: the present one, and those that the peer may just have left.
pub(super) const ROUTES_MAX: usize = 3;
/// Time until a token is sent again; it doubles.
const PROBE_INTERVAL: Duration = Duration::from_millis(200);
/// Most times that a token is sent. The last one has as long again.
const PROBES_MAX: u32 = 4;
/// Longest time that the owner of an address may take to repeat a token.
const CONTEST_PATIENCE: Duration = Duration::from_secs(2);

/// A token in flight to an address.
#[derive(Clone, Copy, Debug)]
struct Probe {
    address: SocketAddr,
    /// The local address that sends it.
    src_ip: Option<IpAddr>,
    token: Token,
    sent: u32,
    next: Instant,
    /// Time from which it no longer counts.
    end: Instant,
}

impl Probe {
    fn new(
        address: SocketAddr,
        src_ip: Option<IpAddr>,
        token: Token,
        now: Instant,
        patience: Duration,
    ) -> Self {
        Self { address, src_ip, token, sent: 0, next: now, end: now + patience }
    }

    fn patience() -> Duration {
        PROBE_INTERVAL * ((1 << PROBES_MAX) - 1)
    }

    /// Returns the token, if it is due now.
    fn poll(&mut self, now: Instant) -> Option<Sending> {
        if now < self.next || self.sent == PROBES_MAX {
            return None;
        }
        self.next = now + PROBE_INTERVAL * (1 << self.sent);
        self.sent += 1;
        Some(Sending { address: self.address, src_ip: self.src_ip, token: self.token })
    }

    fn due(&self) -> Instant {
        if self.sent == PROBES_MAX { self.end } else { self.next.min(self.end) }
    }
}

/// A token to send.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Sending {
    pub(super) address: SocketAddr,
    pub(super) src_ip: Option<IpAddr>,
    pub(super) token: Token,
}

/// An address that the peer did not prove to be its own any more, and the association that claims it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Loss {
    pub(super) address: SocketAddr,
    pub(super) claimant: u64,
}

/// The addresses of one association's peer.
#[derive(Debug)]
pub(super) struct Paths {
    /// The present address first.
    addresses: Vec<SocketAddr>,
    /// Set if another association has the present address now.
    is_displaced: bool,
    /// The address that the peer may have moved to.
    moving: Option<Probe>,
    /// The address that another association claims, and that association's number.
    contest: Option<(Probe, u64)>,
}

impl Paths {
    pub(super) fn new(address: SocketAddr) -> Self {
        Self { addresses: vec![address], is_displaced: false, moving: None, contest: None }
    }

    /// Returns the present address of the peer.
    pub(super) fn present(&self) -> SocketAddr {
        self.addresses[0]
    }

    /// Returns the present address of the peer and its earlier ones.
    pub(super) fn all(&self) -> &[SocketAddr] {
        &self.addresses
    }

    /// Returns the destination of a datagram that is meant for this address of the peer.
    pub(super) fn forward(&self, address: SocketAddr) -> SocketAddr {
        if self.is_displaced || !self.addresses.contains(&address) { address } else { self.present() }
    }

    /// Notes that something authentic came from this address. Returns whether it is the present one; otherwise its
    /// proof begins.
    pub(super) fn heard(
        &mut self,
        address: SocketAddr,
        src_ip: Option<IpAddr>,
        token: impl FnOnce() -> Token,
        now: Instant,
    ) -> bool {
        if address == self.present() && !self.is_displaced {
            return true;
        }
        if self.moving.is_none_or(|probe| probe.address != address) {
            self.moving = Some(Probe::new(address, src_ip, token(), now, Probe::patience()));
        }
        false
    }

    /// Notes that the peer repeated this token. Returns the address that this proves, if that is news.
    pub(super) fn proved(&mut self, token: &Token) -> Option<SocketAddr> {
        self.contest = self.contest.take().filter(|(probe, _)| probe.token != *token);
        let proved = self.moving.take_if(|probe| probe.token == *token)?;
        Some(proved.address)
    }

    /// Notes that another association claims an address of this one: the peer has to prove it again.
    pub(super) fn contested(
        &mut self,
        address: SocketAddr,
        src_ip: Option<IpAddr>,
        claimant: u64,
        token: impl FnOnce() -> Token,
        now: Instant,
    ) {
        if self.contest.is_none() {
            let probe = Probe::new(address, src_ip, token(), now, CONTEST_PATIENCE);
            self.contest = Some((probe, claimant));
        }
    }

    /// Leaves the address to another association; the peer may prove it again when it is heard from there.
    pub(super) fn refused(&mut self, address: SocketAddr) {
        self.is_displaced |= address == self.present();
    }

    /// Makes the address the present one. Returns the address that the peer is no longer reached at.
    pub(super) fn moved_to(&mut self, address: SocketAddr) -> Option<SocketAddr> {
        self.is_displaced = false;
        self.addresses.retain(|known| *known != address);
        self.addresses.insert(0, address);
        if self.addresses.len() > ROUTES_MAX { self.addresses.pop() } else { None }
    }

    /// Returns the next token to be sent.
    pub(super) fn poll(&mut self, now: Instant) -> Option<Sending> {
        let contest = self.contest.as_mut().and_then(|(probe, _)| probe.poll(now));
        contest.or_else(|| self.moving.as_mut().and_then(|probe| probe.poll(now)))
    }

    /// Gives up proofs that took too long. Returns the address that the peer lost.
    pub(super) fn expire(&mut self, now: Instant) -> Option<Loss> {
        self.moving = self.moving.filter(|probe| now < probe.end);
        let (probe, claimant) = self.contest.take_if(|(probe, _)| now >= probe.end)?;
        self.refused(probe.address);
        let present = self.present();
        self.addresses.retain(|known| *known == present || *known != probe.address);
        Some(Loss { address: probe.address, claimant })
    }

    /// Returns the time at which [`Self::poll`] and [`Self::expire`] have something to do.
    pub(super) fn due(&self) -> Option<Instant> {
        let contest = self.contest.as_ref().map(|(probe, _)| probe.due());
        let moving = self.moving.as_ref().map(Probe::due);
        contest.into_iter().chain(moving).min()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn address(port: u16) -> SocketAddr {
        ([127, 0, 0, 1], port).into()
    }

    fn tokens(paths: &mut Paths, from: Instant, until: Instant) -> Vec<(Duration, Token)> {
        let (mut now, mut tokens) = (from, Vec::new());
        while now <= until {
            while let Some(sending) = paths.poll(now) {
                tokens.push((now - from, sending.token));
            }
            now += Duration::from_millis(10);
        }
        tokens
    }

    #[test]
    fn new_address_counts_once_it_is_proved() {
        let (start, mut paths) = (Instant::now(), Paths::new(address(1)));
        assert!(paths.heard(address(1), None, || [1; 16], start));
        assert_eq!(paths.poll(start), None);
        assert!(!paths.heard(address(2), None, || [2; 16], start));
        let sending = paths.poll(start).unwrap();
        assert_eq!((sending.address, sending.token), (address(2), [2; 16]));
        // A second datagram from there does not make another token.
        assert!(!paths.heard(address(2), None, || [3; 16], start));
        assert_eq!(paths.poll(start), None);
        assert_eq!(paths.proved(&[3; 16]), None);
        assert_eq!(paths.present(), address(1));
        assert_eq!(paths.proved(&[2; 16]), Some(address(2)));
        assert_eq!(paths.proved(&[2; 16]), None, "a token counts once");
        assert_eq!(paths.moved_to(address(2)), None);
        assert!(paths.heard(address(2), None, || [4; 16], start));
        assert_eq!(paths.forward(address(1)), address(2));
        assert_eq!(paths.forward(address(9)), address(9));
        // The same holds for an earlier address.
        assert!(!paths.heard(address(1), None, || [5; 16], start));
    }

    #[test]
    fn token_is_sent_a_few_times_and_then_given_up() {
        let (start, mut paths) = (Instant::now(), Paths::new(address(1)));
        paths.heard(address(2), None, || [2; 16], start);
        let sent = tokens(&mut paths, start, start + Duration::from_secs(10));
        let at: Vec<u128> = sent.iter().map(|(after, _)| after.as_millis()).collect();
        assert_eq!(at, [0, 200, 600, 1400]);
        assert!(paths.due().is_some());
        assert_eq!(paths.expire(start + Probe::patience()), None);
        assert_eq!(paths.due(), None);
        assert_eq!(paths.proved(&[2; 16]), None);
    }

    #[test]
    fn few_addresses_are_kept() {
        let mut paths = Paths::new(address(1));
        let left: Vec<_> = (2..7).map(|port| paths.moved_to(address(port))).collect();
        let expected = [None, None, Some(address(1)), Some(address(2)), Some(address(3))];
        assert_eq!(left, expected);
        assert_eq!(paths.all(), [address(6), address(5), address(4)]);
    }

    #[test]
    fn owner_that_answers_keeps_its_address() {
        let (start, mut paths) = (Instant::now(), Paths::new(address(1)));
        paths.contested(address(1), None, 7, || [1; 16], start);
        // A second claim waits for the first to be settled.
        paths.contested(address(1), None, 8, || [2; 16], start);
        assert_eq!(paths.poll(start).unwrap().token, [1; 16]);
        assert_eq!(paths.proved(&[1; 16]), None);
        assert_eq!(paths.expire(start + CONTEST_PATIENCE), None);
        assert!(paths.heard(address(1), None, || [3; 16], start));
    }

    #[test]
    fn owner_that_is_silent_loses_its_address_and_may_prove_it_again() {
        let (start, mut paths) = (Instant::now(), Paths::new(address(1)));
        paths.contested(address(1), None, 7, || [1; 16], start);
        assert_eq!(paths.expire(start + CONTEST_PATIENCE - Duration::from_millis(1)), None);
        let loss = paths.expire(start + CONTEST_PATIENCE);
        assert_eq!(loss, Some(Loss { address: address(1), claimant: 7 }));
        assert!(!paths.heard(address(1), None, || [2; 16], start + CONTEST_PATIENCE));
        assert_eq!(paths.proved(&[2; 16]), Some(address(1)));
        paths.moved_to(address(1));
        assert!(paths.heard(address(1), None, || [3; 16], start + CONTEST_PATIENCE));
    }

    #[test]
    fn claim_that_was_refused_is_made_again() {
        let (start, mut paths) = (Instant::now(), Paths::new(address(1)));
        // A handshake proves the address.
        paths.refused(address(1));
        assert!(!paths.heard(address(1), None, || [1; 16], start));
        assert_eq!(paths.proved(&[1; 16]), Some(address(1)));
        paths.refused(address(1));
        assert!(!paths.heard(address(1), None, || [2; 16], start));
        assert_eq!(paths.proved(&[2; 16]), Some(address(1)));
        paths.moved_to(address(1));
        // A token proves the address.
        assert!(!paths.heard(address(2), None, || [3; 16], start));
        assert_eq!(paths.proved(&[3; 16]), Some(address(2)));
        paths.refused(address(2));
        assert!(paths.heard(address(1), None, || [4; 16], start));
        assert!(!paths.heard(address(2), None, || [5; 16], start));
        assert_eq!(paths.poll(start).unwrap().token, [5; 16]);
    }

    #[test]
    fn address_that_was_left_is_lost_without_harm() {
        let (start, mut paths) = (Instant::now(), Paths::new(address(1)));
        paths.moved_to(address(2));
        paths.contested(address(1), None, 7, || [1; 16], start);
        assert!(paths.expire(start + CONTEST_PATIENCE).is_some());
        assert_eq!(paths.all(), [address(2)]);
        assert!(paths.heard(address(2), None, || [2; 16], start));
    }
}
