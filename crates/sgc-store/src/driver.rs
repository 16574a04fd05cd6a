//! [`run`]: gives the [`Cluster`] its operations, links and clock.

use std::collections::{BTreeMap, VecDeque};
use std::hash::{BuildHasher as _, RandomState};
use std::time::Instant;

use sgc_router::{StoreEvent, StoreOp};
use tokio::sync::mpsc;
use tokio::task::{AbortHandle, JoinSet};
use tokio::time::sleep_until;
use tracing::{info, warn};

use crate::cluster::{Cluster, LINK_COMMANDS_MAX, LinkEvent, LinkId, Output};
use crate::config::StoreConfig;
use crate::link::{self, Access};

/// Events that wait for the receiver beyond which nothing is read from servers any more.
const EVENTS_MAX: usize = 4096;
/// Frames of servers that wait for the machine. Each can have some MB, from a server that wants to do harm.
const FRAMES_MAX: usize = 16;
/// Operations and frames that are taken at once, before timeouts are looked at.
const BATCH_MAX: usize = 128;

/// A link that is open, or being opened.
struct Link {
    commands: mpsc::Sender<Vec<u8>>,
    task: AbortHandle,
}

/// Carries operations out until `ops` is closed, and reports results and news.
///
/// Each operation gets one [`StoreEvent::Reply`], after two seconds at the latest. At most 1024 are under way: further
/// ones wait in `ops`. A task that both sends to `ops` and receives from `events` must not wait for room in `ops`, or
/// both sides may wait for each other.
///
/// [`StoreEvent::Changed`] follows a [`Read`](sgc_router::StoreAction::Read) once, also if the change was an own write.
/// A result of a write whose connection broke says that the key had no value, since that is not known.
pub async fn run(config: StoreConfig, mut ops: mpsc::Receiver<StoreOp>, events: mpsc::Sender<StoreEvent>) {
    let access = Access { user: config.user.clone(), tls: config.tls.clone() };
    // Spreads reconnections. The seed of the standard library's maps is random enough for that.
    let random = RandomState::new().hash_one(0);
    let mut cluster = Cluster::new(Instant::now(), &config, random);
    let (link_sender, mut link_events) = mpsc::channel(FRAMES_MAX);
    let mut links: BTreeMap<LinkId, Link> = BTreeMap::new();
    // Aborts the links that are left when this function ends.
    let mut tasks = JoinSet::new();
    let mut waiting: VecDeque<StoreEvent> = VecDeque::new();
    loop {
        while let Some(output) = cluster.poll_output() {
            match output {
                Output::Event(event) => waiting.push_back(event),
                Output::Open { link: id, server } => {
                    // Room for each command with an expected reply, so that there always is some.
                    let (commands, receiver) = mpsc::channel(LINK_COMMANDS_MAX + 8);
                    let task =
                        tasks.spawn(link::run(id, server, access.clone(), receiver, link_sender.clone()));
                    links.insert(id, Link { commands, task });
                }
                Output::Close { link } => {
                    if let Some(link) = links.remove(&link) {
                        link.task.abort();
                    }
                }
                Output::Send { link, command } => {
                    if let Some(link) = links.get(&link) {
                        // A link that ended reports that itself.
                        let _ = link.commands.try_send(command);
                    }
                }
                Output::Warn(line) => warn!("{line}"),
                Output::Inform(line) => info!("{line}"),
            }
        }
        while tasks.try_join_next().is_some() {}
        let deadline = cluster.next_timeout(Instant::now());
        let has_room = waiting.len() < EVENTS_MAX;
        tokio::select! {
            biased;
            permit = events.reserve(), if !waiting.is_empty() => {
                let Ok(permit) = permit else { return };
                if let Some(event) = waiting.pop_front() {
                    permit.send(event);
                }
                while let Some(event) = waiting.pop_front() {
                    match events.try_reserve() {
                        Ok(permit) => permit.send(event),
                        Err(_) => {
                            waiting.push_front(event);
                            break;
                        }
                    }
                }
            }
            Some(event) = link_events.recv(), if has_room => {
                let now = Instant::now();
                let further = std::iter::from_fn(|| link_events.try_recv().ok()).take(BATCH_MAX);
                for (link, event) in std::iter::once(event).chain(further) {
                    if matches!(event, LinkEvent::Closed(_)) {
                        links.remove(&link);
                    }
                    cluster.handle_link(now, link, event);
                }
            }
            op = ops.recv(), if has_room && cluster.has_room() => {
                let Some(op) = op else { return };
                let now = Instant::now();
                cluster.handle_op(now, op);
                for _ in 0..BATCH_MAX {
                    if !cluster.has_room() {
                        break;
                    }
                    match ops.try_recv() {
                        Ok(op) => cluster.handle_op(now, op),
                        Err(_) => break,
                    }
                }
            }
            () = sleep_until(deadline.into()) => {}
        }
        let now = Instant::now();
        if deadline <= now {
            cluster.handle_timeout(now);
        }
    }
}
