//! [`Shares`]: this node's ends of the names on which it publishes, and the checks for silence and long epochs.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use sgc_wire::Name;
use tokio::sync::{Notify, mpsc};

use crate::data::dataplane::DataPlane;
use crate::data::sending::share::LocalShare;

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
    epoch_messages_max: u64,
    /// Notified when a source reaches that number.
    epoch_over: Arc<Notify>,
}

impl Shares {
    /// Creates the part without shares. `alive` is held by every blocking task of a share, and an epoch ends after
    /// `epoch_messages_max` messages of one source.
    pub(crate) fn new(data: Arc<DataPlane>, alive: mpsc::Sender<()>, epoch_messages_max: u64) -> Self {
        let (shares, epoch_over) = (HashMap::new(), Arc::default());
        Self { shares, silence_due: None, data, alive, epoch_messages_max, epoch_over }
    }

    /// Adds a share without sources.
    pub(crate) fn add(&mut self, name: Name) -> Arc<LocalShare> {
        let (data, alive) = (self.data.clone(), self.alive.clone());
        let over = self.epoch_over.clone();
        let share = Arc::new(LocalShare::new(name, data, alive, self.epoch_messages_max, over));
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
            let looks = self.shares.values().map(|share| share.look_for_silence(now));
            // `fold` looks at all of them, where `any` would stop at the first.
            let busy = looks.fold(false, |any, busy| any | busy);
            self.silence_due = busy.then(|| now + SILENCE_LOOK);
        }
    }

    /// Returns the time of the next check for silence.
    pub(crate) fn deadline(&self) -> Option<Instant> {
        self.silence_due
    }
}
