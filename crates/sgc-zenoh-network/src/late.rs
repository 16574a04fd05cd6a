//! [`Late`]: an endpoint that opens once its key is known, and opens again if the key was not that of the programs here.
//!
//! A key contains the hash of a type, which some endpoints of DDS do not announce, or announce in another form. The hash
//! that a program of this network uses for the same name and type is taken then.

use std::sync::{Arc, Mutex};

use sgc_sync::lock;
use sgc_zenoh::TopicInfo;

use crate::participant::{Entered, Key, Participant, Waits};

/// Most times that an endpoint opens with another key, so that two programs that follow each other come to an end.
const CHANGES_MAX: u32 = 8;

/// The parts of an endpoint on the network.
pub(crate) trait Opened: Send + Sync + 'static {
    /// Does what waited until the endpoint was open. May block.
    fn settle(&self) {}
}

/// An endpoint that is only shown.
impl Opened for Entered {}

/// An endpoint that may not be open yet.
pub(crate) struct Late<T> {
    /// Locked while the endpoint opens, before the graph.
    state: Mutex<State>,
    /// Locked for a moment only, also with the graph. So the last owner of an open endpoint, which ends its token, is never
    /// found under this lock.
    opened: Mutex<Option<Arc<T>>>,
    open: Opening<T>,
}

struct State {
    key: Key,
    changes: u32,
}

/// Opens an endpoint with its topic.
type Opening<T> = Box<dyn Fn(&Arc<Participant>, &TopicInfo) -> Result<T, String> + Send + Sync>;

impl<T: Opened> Late<T> {
    /// Opens an endpoint, at once if its key is known.
    pub(crate) fn new(
        participant: &Arc<Participant>,
        key: Key,
        open: impl Fn(&Arc<Participant>, &TopicInfo) -> Result<T, String> + Send + Sync + 'static,
    ) -> Result<Arc<Self>, String> {
        let opened = match &key {
            Key::Known(topic) | Key::Announced(topic) => Some(Arc::new(open(participant, topic)?)),
            Key::OfOthers(named) => {
                tracing::debug!(
                    name = named.name(),
                    type_name = named.type_name(),
                    "the hash of the type is not known: waiting for a program of the Zenoh network that has it"
                );
                None
            }
        };
        let waits = !matches!(key, Key::Known(_));
        let (state, opened) = (Mutex::new(State { key, changes: 0 }), Mutex::new(opened));
        let late = Arc::new(Self { state, opened, open: Box::new(open) });
        if waits {
            participant.wait_for_key(Arc::downgrade(&late) as _);
        }
        Ok(late)
    }

    /// Returns the endpoint if it is open. Not to be called with the graph locked: the caller may become the last owner.
    pub(crate) fn get(&self) -> Option<Arc<T>> {
        lock(&self.opened).clone()
    }

    /// The same, but does something else before the endpoint can open.
    pub(crate) fn get_or(&self, otherwise: impl FnOnce()) -> Option<Arc<T>> {
        let opened = lock(&self.opened);
        if opened.is_none() {
            otherwise();
        }
        opened.clone()
    }

    /// Looks at the endpoint if it is open.
    pub(crate) fn look<R>(&self, look: impl FnOnce(&T) -> R) -> Option<R> {
        lock(&self.opened).as_deref().map(look)
    }
}

impl<T: Opened> Waits for Late<T> {
    fn try_open(&self, participant: &Arc<Participant>) -> bool {
        let mut state = lock(&self.state);
        let topic = match &state.key {
            Key::Known(_) => return true,
            Key::Announced(topic) => match participant.as_programs_have(topic) {
                Some(other) if other != *topic => other,
                _ => return false,
            },
            Key::OfOthers(named) => match participant.as_others_have(named) {
                Some(topic) => topic,
                None => return false,
            },
        };
        // The endpoint has one number, so its token ends before it gets another one.
        let before = lock(&self.opened).take();
        drop(before);
        match (self.open)(participant, &topic) {
            Ok(opened) => {
                let opened = Arc::new(opened);
                *lock(&self.opened) = Some(Arc::clone(&opened));
                opened.settle();
                participant.wake();
            }
            Err(error) => tracing::error!(%error, "an endpoint of the Zenoh network does not open"),
        }
        // The hash may have been that of another proxy, which may be the hash of a message.
        state.changes += 1;
        let is_guess = state.changes < CHANGES_MAX;
        state.key = if is_guess { Key::Announced(topic) } else { Key::Known(topic) };
        !is_guess
    }
}

impl<T> std::fmt::Debug for Late<T> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Late").field("is_open", &lock(&self.opened).is_some()).finish_non_exhaustive()
    }
}
