//! Memory of a node for received bytes that nobody has read yet.
//!
//! A hostile peer fills its window. So windows shrink with the number of links: each link gets its part of one budget
//! when it begins, and keeps it. The transport decides the use of a window.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// Default budget of a node's links, bytes: the n-th link gets an n-th.
pub const RECEIVE_BUDGET_BYTES: u64 = 128 << 20;
/// Smallest window of a link, bytes: 160 Mbit/s at a round trip of 50 ms.
pub const RECEIVE_WINDOW_BYTES_MIN: u32 = 1 << 20;

/// The budget of the receive windows of one node. Clones share it, so clone one [`crate::LinkOptions`] for all
/// listeners and dialers of the node.
///
/// The n-th concurrent link gets at most an n-th of the budget, and no less than [`RECEIVE_WINDOW_BYTES_MIN`]. Links
/// that end leave their place to others. So the windows of n links are always less than the budget · (1 + ln n) + n · 1
/// MiB together.
#[derive(Clone, Debug)]
pub struct ReceiveBudget {
    shared: Arc<BudgetState>,
}

#[derive(Debug)]
struct BudgetState {
    budget_bytes: u64,
    links: AtomicU64,
    granted_bytes: AtomicU64,
}

impl Default for ReceiveBudget {
    fn default() -> Self {
        Self::new(RECEIVE_BUDGET_BYTES)
    }
}

impl ReceiveBudget {
    /// Creates a budget of this size.
    pub fn new(budget_bytes: u64) -> Self {
        let (links, granted_bytes) = (AtomicU64::new(0), AtomicU64::new(0));
        Self { shared: Arc::new(BudgetState { budget_bytes, links, granted_bytes }) }
    }

    /// Returns the bytes that all links together may have received and not read now.
    pub fn granted_bytes(&self) -> u64 {
        self.shared.granted_bytes.load(Relaxed)
    }

    /// Grants a link its window, of at most `max` bytes.
    pub(crate) fn lease(&self, max: u32) -> WindowLease {
        let count = self.shared.links.fetch_add(1, Relaxed) + 1;
        let part = u32::try_from(self.shared.budget_bytes / count).unwrap_or(u32::MAX);
        let bytes = part.max(RECEIVE_WINDOW_BYTES_MIN).min(max);
        self.shared.granted_bytes.fetch_add(bytes.into(), Relaxed);
        WindowLease { budget: self.clone(), bytes }
    }
}

/// The window of one link, for as long as the link is there.
#[derive(Debug)]
pub(crate) struct WindowLease {
    budget: ReceiveBudget,
    bytes: u32,
}

impl WindowLease {
    /// Returns the bytes of all flows together that the peer may have sent and we not read.
    pub(crate) fn link_bytes(&self) -> u32 {
        self.bytes
    }

    /// Returns the bytes of one flow, at most `max`: a flow that nobody reads takes half, so others continue.
    pub(crate) fn flow_bytes(&self, max: u32) -> u32 {
        max.min(self.bytes / 2).max(1)
    }
}

impl Drop for WindowLease {
    fn drop(&mut self) {
        self.budget.shared.links.fetch_sub(1, Relaxed);
        self.budget.shared.granted_bytes.fetch_sub(self.bytes.into(), Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use rand_chacha::ChaCha20Rng;
    use rand_core::{RngCore as _, SeedableRng as _};

    use super::*;

    const MAX: u32 = 32 << 20;

    #[test]
    fn few_links_have_the_whole_window_and_many_share() {
        let budget = ReceiveBudget::default();
        let leases: Vec<_> = (0..256).map(|_| budget.lease(MAX)).collect();
        let mib = |n: usize| leases[n - 1].link_bytes() >> 20;
        assert_eq!([mib(1), mib(2), mib(4), mib(16), mib(128), mib(256)], [32, 32, 32, 8, 1, 1]);
        assert_eq!(leases[0].flow_bytes(16 << 20), 16 << 20);
        assert_eq!(leases[255].flow_bytes(32 << 20), RECEIVE_WINDOW_BYTES_MIN / 2);
        let sum: u64 = leases.iter().map(|lease| u64::from(lease.link_bytes())).sum();
        assert_eq!(budget.granted_bytes(), sum);
        assert!(sum < 700 << 20, "{sum} bytes for 256 links");
        drop(leases);
        assert_eq!((budget.granted_bytes(), budget.lease(MAX).link_bytes()), (0, MAX));
    }

    #[test]
    fn the_sum_of_windows_stays_bounded() {
        let mut rng = ChaCha20Rng::seed_from_u64(1);
        let budget = ReceiveBudget::default();
        let mut leases = Vec::new();
        for step in 0..20_000_u32 {
            // Links come in herds and end in any order.
            if leases.is_empty() || rng.next_u32() % 1000 < 400 + 200 * (step / 1000 % 2) {
                leases.push(budget.lease(MAX));
            } else {
                leases.swap_remove(rng.next_u32() as usize % leases.len());
            }
            let n = leases.len() as f64;
            let bound = RECEIVE_BUDGET_BYTES as f64 * (1.0 + n.max(1.0).ln())
                + n * f64::from(RECEIVE_WINDOW_BYTES_MIN);
            assert!(budget.granted_bytes() as f64 <= bound, "{} bytes for {n} links", budget.granted_bytes());
        }
    }
}
