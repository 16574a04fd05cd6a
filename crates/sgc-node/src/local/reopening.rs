//! Reopens the local network when a change of this host's addresses has cut it off from programs on other hosts.
//!
//! [`Pace`], a pure machine, decides when. [`watch`] looks at the network only after a change of addresses. The control
//! task (`core/reopening.rs`) ends and creates the endpoints.

use std::sync::Arc;
use std::time::{Duration, Instant};

use sgc_ros::{Reach, RosError, RosNetwork};
use tokio::sync::{mpsc, oneshot};
use tracing::{info, warn};

use crate::control::event::CoreEvent;
use crate::gateway::Gateway;
use crate::link::roaming::Network;
use crate::local::dds_discovery::discover;
use crate::local::network_slot::{NetworkSlot, OpenAgain};

/// Interval of looks while the network's reach is in doubt.
const LOOK_EVERY: Duration = Duration::from_secs(1);
/// Least time between two reopenings, and between two failed attempts; doubled after each failure.
const PAUSE_MIN: Duration = Duration::from_secs(30);
const FAILED_PAUSE_MIN: Duration = Duration::from_secs(2);
const FAILED_PAUSE_MAX: Duration = Duration::from_secs(60);
/// Time for readers and writers of the old network to end.
const CLOSE_MAX: Duration = Duration::from_secs(5);

/// Decides when the network may be reopened.
#[derive(Debug, Default)]
struct Pace {
    not_before: Option<Instant>,
    failures: u32,
}

impl Pace {
    fn may_open(&self, now: Instant) -> bool {
        self.not_before.is_none_or(|at| at <= now)
    }

    fn opened(&mut self, now: Instant) {
        *self = Self { not_before: Some(now + PAUSE_MIN), failures: 0 };
    }

    /// Notes a failure. Returns the wait.
    fn failed(&mut self, now: Instant) -> Duration {
        let pause = FAILED_PAUSE_MIN.saturating_mul(1 << self.failures.min(16)).min(FAILED_PAUSE_MAX);
        self.failures += 1;
        self.not_before = Some(now + pause);
        pause
    }
}

/// Watches the network for as long as the node runs.
pub(crate) async fn watch<N: RosNetwork>(
    mut changes: Network,
    network: NetworkSlot<N>,
    gateway: Arc<Gateway>,
    events: mpsc::Sender<CoreEvent>,
) {
    let mut pace = Pace::default();
    loop {
        changes.changed().await;
        loop {
            tokio::time::sleep(LOOK_EVERY).await;
            let (Some(present), Some(open)) = (network.get(), network.again()) else { break };
            let (node_reach, gateway_reach) = (present.reach(), gateway.reach());
            match node_reach.max(gateway_reach) {
                Reach::Whole => break,
                Reach::Doubtful => continue,
                Reach::CutOff if !pace.may_open(Instant::now()) => continue,
                Reach::CutOff => {}
            }
            // A network that cannot be opened is worse than one that does not reach other hosts.
            let probed = Arc::clone(&gateway);
            let gains = tokio::task::spawn_blocking(move || {
                let node = node_reach == Reach::CutOff && present.gains_by_reopening()?;
                let gateway = !node && gateway_reach == Reach::CutOff && probed.gains_by_reopening()?;
                Ok::<_, RosError>((node, gateway))
            });
            match gains.await {
                Ok(Ok((true, _))) => reopen(&network, &open, &gateway, &events, &mut pace).await,
                Ok(Ok((false, true))) => {
                    gateway.close_network(CLOSE_MAX).await;
                    pace.opened(Instant::now());
                    open_gateway(&gateway, &mut pace).await;
                }
                Ok(Ok((false, false))) => {}
                Ok(Err(error)) => {
                    let pause = pace.failed(Instant::now());
                    warn!(
                        %error,
                        "this host's addresses changed, and the local ROS 2 network cannot be opened with the new ones: programs of other \
                         hosts are cut off. Trying again in {} s", pause.as_secs()
                    );
                }
                Err(_) => return,
            }
        }
    }
}

/// Closes the network and opens it, repeatedly until it is open.
async fn reopen<N: RosNetwork>(
    network: &NetworkSlot<N>,
    open: &OpenAgain<N>,
    gateway: &Gateway,
    events: &mpsc::Sender<CoreEvent>,
    pace: &mut Pace,
) {
    let began = Instant::now();
    let (reply, closed) = oneshot::channel();
    let Some(old) = network.take() else { return };
    if events.send(CoreEvent::CloseNetwork(reply)).await.is_err() || closed.await.is_err() {
        return;
    }
    // The gateway's endpoints end unseen, so that their routes wait for those that follow.
    gateway.close_network(CLOSE_MAX).await;
    let all_ended = tokio::task::spawn_blocking(move || old.close(CLOSE_MAX)).await;
    if !all_ended.unwrap_or(false) {
        warn!(
            "readers or writers of the local ROS 2 network take long to end; it is opened again beside them"
        );
    }
    loop {
        let open = open.clone();
        match tokio::task::spawn_blocking(move || open()).await {
            Ok(Ok(opened)) => {
                network.put(opened.clone());
                pace.opened(Instant::now());
                // The event has to precede discovery events.
                if events.send(CoreEvent::NetworkReopened).await.is_err() {
                    return;
                }
                let events = events.clone();
                let discover = move || discover(&*opened, events);
                if let Ok(Err(error)) = tokio::task::spawn_blocking(discover).await {
                    warn!(%error, "nothing is discovered on the local ROS 2 network: restart the node");
                }
                open_gateway(gateway, pace).await;
                info!(
                    took = ?began.elapsed(),
                    "this host's addresses changed: the local ROS 2 network was opened again, for programs of other hosts"
                );
                return;
            }
            Ok(Err(error)) => {
                let pause = pace.failed(Instant::now());
                let reason = error.to_string();
                warn!(
                    "the local ROS 2 network is closed and cannot be opened again: {reason}. Trying again in {} s",
                    pause.as_secs()
                );
                if events.send(CoreEvent::NetworkStaysClosed(reason)).await.is_err() {
                    return;
                }
                tokio::time::sleep(pause).await;
            }
            Err(_) => return,
        }
    }
}

/// Opens the gateway's part of the network again, repeatedly until it is open.
async fn open_gateway(gateway: &Gateway, pace: &mut Pace) {
    while let Err(error) = gateway.open_network().await {
        let pause = pace.failed(Instant::now());
        warn!(
            "the gateway's part of the local ROS 2 network is closed and cannot be opened again: {error}. Trying again in {} s",
            pause.as_secs()
        );
        tokio::time::sleep(pause).await;
        gateway.close_network(CLOSE_MAX).await;
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use std::sync::Arc;
    use std::sync::atomic::AtomicU32;
    use std::sync::atomic::Ordering::Relaxed;

    use sgc_gateway::ShippedDefinitions;
    use sgc_testkit::{FakeDomain, FakeRos};

    use super::*;

    #[tokio::test(start_paused = true)]
    async fn network_that_is_cut_off_is_closed_and_then_opened_again() {
        let domain = FakeDomain::default();
        let (joins, opened) = (domain.clone(), Arc::new(AtomicU32::new(0)));
        let count = opened.clone();
        let again: OpenAgain<FakeRos> = Arc::new(move || {
            // The first attempt fails.
            match count.fetch_add(1, Relaxed) {
                0 => Err(RosError::Domain { domain: 0, reason: "no interface".into() }),
                _ => Ok(Arc::new(joins.join(true))),
            }
        });
        let slot = NetworkSlot::new(Some(Arc::new(domain.join(true))), Some(again));
        let (tell, changes) = Network::channel();
        let (events, mut inbox) = mpsc::channel(8);
        let watching =
            tokio::spawn(watch(changes, slot.clone(), Gateway::new(None, "arm", ShippedDefinitions), events));
        let change = || tell.send_modify(|change| *change += 1);
        change();
        // The network reaches as far as before.
        tokio::time::sleep(10 * LOOK_EVERY).await;
        assert!(inbox.try_recv().is_err() && slot.get().is_some());
        domain.cut_off();
        change();
        let Some(CoreEvent::CloseNetwork(closed)) = inbox.recv().await else { panic!("it is not closed") };
        assert!(slot.get().is_none());
        assert_eq!(opened.load(Relaxed), 0, "what is on it ends first");
        closed.send(()).unwrap();
        assert!(matches!(inbox.recv().await, Some(CoreEvent::NetworkStaysClosed(_))));
        assert!(matches!(inbox.recv().await, Some(CoreEvent::NetworkReopened)));
        assert!(slot.get().is_some_and(|network| network.reach() == Reach::Whole));
        watching.abort();
    }

    #[test]
    fn openings_are_apart() {
        let (mut pace, now) = (Pace::default(), Instant::now());
        assert!(pace.may_open(now));
        pace.opened(now);
        assert!(!pace.may_open(now + PAUSE_MIN / 2));
        assert!(pace.may_open(now + PAUSE_MIN));
    }

    #[test]
    fn attempts_that_fail_are_ever_farther_apart_up_to_a_bound() {
        let (mut pace, now) = (Pace::default(), Instant::now());
        let pauses: Vec<_> = (0..40).map(|_| pace.failed(now)).collect();
        assert_eq!(pauses[..3], [1, 2, 4].map(|n| n * FAILED_PAUSE_MIN));
        assert_eq!(pauses.last(), Some(&FAILED_PAUSE_MAX));
        assert!(!pace.may_open(now) && pace.may_open(now + FAILED_PAUSE_MAX));
        pace.opened(now);
        assert_eq!(pace.failed(now), FAILED_PAUSE_MIN, "it begins anew");
    }
}
