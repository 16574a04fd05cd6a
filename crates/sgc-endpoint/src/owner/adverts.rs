//! [`Adverts`]: the advertised names of a node, and the rate of its advertisements.
//!
//! Names that come one by one are collected, because routers take a bounded number of announcements of a node
//! (docs/spec/routing.md) and drop the rest.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use sgc_trust::next_seq;
use sgc_wire::{ADVERT_NAMES_MAX, AdvertBody, Blind, Control};

use crate::context::Context;

/// Advertisements and withdrawals that a node sends at once: a quarter of a router's bound, because a restarted node
/// has the same allowance there.
pub const ADVERTS_BURST: u32 = 64;
/// Interval of later ones: a third of a router's bound, because link states count there, too.
pub const ADVERT_INTERVAL: Duration = Duration::from_millis(100);

/// Advertisements and withdrawals after which all names are advertised together again: routers keep 512 of an owner
/// (docs/spec/routing.md), and each takes memory there for as long as it speaks for one name.
const ADVERTS_APART_MAX: usize = 64;

/// Names to advertise and to withdraw, and the numbers of the advertisements.
#[derive(Debug, Default)]
pub(crate) struct Adverts {
    unadvertised: BTreeSet<Blind>,
    withdrawn: BTreeSet<Blind>,
    seq: u64,
    pace: AdvertPace,
    /// Advertisements and withdrawals since all names were advertised together.
    apart: usize,
    renew_at: Option<Instant>,
}

impl Adverts {
    /// Adds a name.
    pub(crate) fn add(&mut self, blind: Blind) {
        self.withdrawn.remove(&blind);
        self.unadvertised.insert(blind);
    }

    /// Withdraws a name.
    pub(crate) fn withdraw(&mut self, blind: Blind) {
        self.unadvertised.remove(&blind);
        self.withdrawn.insert(blind);
    }

    /// Advertises all names of the node together.
    pub(crate) fn add_all(&mut self, all: impl Iterator<Item = Blind>) {
        self.apart = 0;
        self.unadvertised.extend(all);
    }

    /// Advertises nothing more, and collects no withdrawal.
    pub(crate) fn end(&mut self) {
        self.unadvertised.clear();
        self.pace = AdvertPace::default();
        self.renew_at = None;
    }

    /// Skips to this number, which an earlier run of the node used. Returns `true` if all names have to be advertised
    /// anew, because routers ignore lower numbers.
    pub(crate) fn overtake(&mut self, seq: u64) -> bool {
        let is_ahead = seq > self.seq;
        self.seq = self.seq.max(seq);
        is_ahead
    }

    /// Returns `true` once after each time at which the leases have to be renewed.
    pub(crate) fn take_renewal(&mut self, now: Instant) -> bool {
        self.renew_at.take_if(|at| *at <= now).is_some()
    }

    /// Returns the time at which the leases have to be renewed.
    pub(crate) fn renew_at(&self) -> Option<Instant> {
        self.renew_at
    }

    /// Returns the time at which due advertisements may be sent, if that is later.
    pub(crate) fn deadline(&self) -> Option<Instant> {
        self.pace.opens_at().filter(|_| self.is_due())
    }

    /// Returns `true` if an advertisement has to be sent, and may be.
    pub(crate) fn may_send(&self, now: Instant) -> bool {
        self.is_due() && self.deadline().is_none_or(|at| at <= now)
    }

    /// Returns `true` if so many advertisements were sent that all names have to be advertised together again.
    pub(crate) fn is_scattered(&self) -> bool {
        self.apart >= ADVERTS_APART_MAX
    }

    /// Sends due advertisements and withdrawals, with as many names in one as fit. Returns `true` if names were
    /// advertised.
    pub(crate) fn send(&mut self, cx: &mut Context) -> bool {
        for blinds in chunks(std::mem::take(&mut self.withdrawn)) {
            self.send_one(cx, true, blinds);
        }
        let advertised = chunks(std::mem::take(&mut self.unadvertised));
        let any = !advertised.is_empty();
        for blinds in advertised {
            self.send_one(cx, false, blinds);
        }
        if any {
            self.renew_at.get_or_insert(cx.instant() + cx.limits().lease / 3);
        }
        any
    }

    fn send_one(&mut self, cx: &mut Context, withdraw: bool, blinds: Vec<Blind>) {
        let now = cx.now();
        // The clock keeps sequence numbers growing over restarts.
        self.seq = next_seq(self.seq, now.unix);
        let body = AdvertBody {
            chain: cx.identity().chain_bytes(),
            seq: self.seq,
            issued_at: now.unix,
            lease_ms: cx.limits().lease.as_millis().try_into().unwrap_or(u32::MAX),
            withdraw,
            blinds,
        };
        let signed = cx.identity().sign_advert(&body);
        cx.send(Control::Advert { cost: 0, signed });
        self.pace.sent(now.instant);
        self.apart += 1;
    }

    fn is_due(&self) -> bool {
        !self.withdrawn.is_empty() || !self.unadvertised.is_empty()
    }
}

/// Divides names among advertisements.
fn chunks(blinds: BTreeSet<Blind>) -> Vec<Vec<Blind>> {
    let blinds: Vec<_> = blinds.into_iter().collect();
    blinds.chunks(ADVERT_NAMES_MAX).map(<[_]>::to_vec).collect()
}

/// Time until which the sent advertisements count.
#[derive(Clone, Copy, Debug, Default)]
struct AdvertPace(Option<Instant>);

impl AdvertPace {
    /// Returns the time from which the next may be sent; `None` if none was.
    fn opens_at(self) -> Option<Instant> {
        self.0?.checked_sub(ADVERT_INTERVAL * (ADVERTS_BURST - 1))
    }

    /// Notes a sent advertisement.
    fn sent(&mut self, now: Instant) {
        self.0 = Some(self.0.map_or(now, |until| until.max(now)) + ADVERT_INTERVAL);
    }
}
