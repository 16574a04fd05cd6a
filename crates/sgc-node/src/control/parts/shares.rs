//! [`Shares`]: this node's ends of the names on which it publishes, and the checks for silence and long epochs.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::time::{Duration, Instant};

use sgc_wire::Name;
use tokio::sync::{Notify, mpsc};

use crate::data::dataplane::DataPlane;
use crate::data::sending::share::{DueMark, LocalShare};

/// Interval of checks for sources that may have fallen silent.
const SILENCE_LOOK: Duration = Duration::from_secs(1);

/// The names that this node shares, and those of other nodes on which it publishes.
pub(crate) struct Shares {
    shares: HashMap<Name, Arc<LocalShare>>,
    /// Time of the next check for silent sources; `None` until one publishes.
    silence_due: Option<Instant>,
    data: Arc<DataPlane>,
    alive: mpsc::Sender<()>,
    /// Messages of one source under one key.
    epoch_messages_max: Arc<AtomicU64>,
    /// Notified when a source reaches that number.
    epoch_over: Arc<Notify>,
}

impl Shares {
    /// Creates the part without shares. `alive` is held by every blocking task of a share, and an epoch ends after
    /// `epoch_messages_max` messages of one source.
    pub(crate) fn new(data: Arc<DataPlane>, alive: mpsc::Sender<()>, epoch_messages_max: u64) -> Self {
        let (shares, epoch_over) = (HashMap::new(), Arc::default());
        let epoch_messages_max = Arc::new(AtomicU64::new(epoch_messages_max));
        Self { shares, silence_due: None, data, alive, epoch_messages_max, epoch_over }
    }

    /// Sets the number of messages of one source after which an epoch ends.
    pub(crate) fn set_epoch_messages_max(&self, messages: u64) {
        self.epoch_messages_max.store(messages, Relaxed);
    }

    /// Adds a share without sources.
    pub(crate) fn add(&mut self, name: Name) -> Arc<LocalShare> {
        let (data, alive) = (self.data.clone(), self.alive.clone());
        let over = self.epoch_over.clone();
        let share = Arc::new(LocalShare::new(name, data, alive, self.epoch_messages_max.clone(), over));
        self.shares.insert(name, share.clone());
        share
    }

    /// Closes and removes a share.
    pub(crate) fn remove(&mut self, name: &Name) {
        if let Some(share) = self.shares.remove(name) {
            share.close();
        }
    }

    /// Closes all shares. They stay, and send nothing.
    pub(crate) fn close(&self) {
        self.shares.values().for_each(|share| share.close());
    }

    /// Iterates over the names that this node publishes under.
    pub(crate) fn names(&self) -> impl Iterator<Item = Name> {
        self.shares.keys().copied()
    }

    pub(crate) fn get(&self, name: &Name) -> Option<&Arc<LocalShare>> {
        self.shares.get(name)
    }

    /// Returns the notification of an epoch that is over. It also wakes the control task for calls.
    pub(crate) fn epoch_over(&self) -> &Arc<Notify> {
        &self.epoch_over
    }

    /// Returns the names whose sources have sent enough under one key, once for each epoch.
    pub(crate) fn take_epochs_over(&self) -> Vec<Name> {
        self.shares.iter().filter(|(_, share)| share.is_epoch_over()).map(|(name, _)| *name).collect()
    }

    /// Looks for sources that have fallen silent, if that is due.
    pub(crate) fn look_for_silence(&mut self, now: Instant) {
        if self.silence_due.is_none_or(|at| at <= now) {
            let mut due = Vec::new();
            let looks = self.shares.values().map(|share| share.look_for_silence(now, &mut due));
            // `fold` looks at all of them, where `any` would stop at the first.
            let busy = looks.fold(false, |any, busy| any | busy);
            self.silence_due = busy.then(|| now + SILENCE_LOOK);
            DueMark::publish_all(due);
        }
    }

    /// Returns the time of the next check for silence.
    pub(crate) fn deadline(&self) -> Option<Instant> {
        self.silence_due
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::sending::fixtures::{KNOWN, NAME, add_tree, map_of, sample, slot_with_id};

    const OTHER: Name = Name([2; 32]);

    /// Returns shares of two names with a source each, whose epochs have two messages.
    fn shares() -> (Shares, Arc<DataPlane>) {
        let data = Arc::<DataPlane>::default();
        let mut shares = Shares::new(data.clone(), mpsc::channel(1).0, 2);
        for (id, name) in [NAME, OTHER].into_iter().enumerate() {
            shares.add(name).set_map(map_of(slot_with_id(id as u8)));
        }
        (shares, data)
    }

    fn publish(shares: &Shares, name: &Name) {
        shares.get(name).unwrap().publish(sample(KNOWN, false));
    }

    #[tokio::test]
    async fn full_epoch_is_reported_once_and_for_its_name_only() {
        let (shares, _) = shares();
        publish(&shares, &NAME);
        publish(&shares, &OTHER);
        assert_eq!(shares.take_epochs_over(), []);
        publish(&shares, &NAME);
        shares.epoch_over().notified().await;
        assert_eq!(shares.take_epochs_over(), [NAME]);
        assert_eq!(shares.take_epochs_over(), []);
    }

    #[tokio::test]
    async fn all_sources_are_looked_at_once_a_second_until_all_are_silent() {
        let (mut shares, _) = shares();
        let begin = Instant::now();
        let at = |ms| begin + Duration::from_millis(ms);
        shares.look_for_silence(at(0));
        assert_eq!(shares.deadline(), None, "nothing was published");
        publish(&shares, &NAME);
        publish(&shares, &OTHER);
        shares.look_for_silence(at(0));
        assert_eq!(shares.deadline(), Some(at(1000)));
        shares.look_for_silence(at(999));
        assert_eq!(shares.deadline(), Some(at(1000)), "the look is not due");
        shares.look_for_silence(at(1000));
        assert_eq!(shares.deadline(), Some(at(2000)));
        // Each look of a share that has begun goes on, so one share does not hide the other.
        let looks = (2..).map(|s| at(1000 * s)).take_while(|now| {
            shares.look_for_silence(*now);
            shares.deadline().is_some()
        });
        assert!(looks.take(60).count() < 60, "the silence of both is announced");
    }

    #[tokio::test]
    async fn removed_share_is_gone_and_closed_ones_stay() {
        let (mut shares, data) = shares();
        add_tree(&data);
        let removed = shares.get(&NAME).unwrap().clone();
        shares.remove(&NAME);
        shares.remove(&NAME);
        assert!(shares.get(&NAME).is_none() && shares.get(&OTHER).is_some());
        removed.publish(sample(KNOWN, false));
        assert_eq!(removed.published(), 0, "it is closed");
        publish(&shares, &OTHER);
        shares.close();
        publish(&shares, &OTHER);
        assert_eq!(shares.get(&OTHER).unwrap().published(), 1);
    }
}
