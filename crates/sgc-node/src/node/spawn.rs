//! Starts the tasks of a node.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use rand_chacha::ChaCha20Rng;
use rand_core::SeedableRng as _;
use sgc_config::Config;
use sgc_ros::RosNetwork;
use sgc_transport::{Dialer, DirectSockets, ListenAddr, Listener};
use sgc_trust::Identity;
use tokio::sync::{Mutex, Notify, mpsc, oneshot};
use tokio::task::JoinHandle;
use tokio::time::MissedTickBehavior;
use tracing::info;

use crate::admin::{self, Desk};
use crate::control::event::CoreEvent;
use crate::control::settings::file_watch::FileWatch;
use crate::control::settings::reload::{Reloader, Running};
use crate::discovery::{Claims, Dns, LinkKeeper, Searches, WantedRouters, WorkingUrls};
use crate::gateway::Gateway;
use crate::link::direct;
use crate::link::lanes::LaneAdmission;
use crate::link::links::{Admission, keep_accepting};
use crate::link::port_mapping;
use crate::link::roaming::Network;
use crate::link::store;
use crate::local::dds_discovery::discover;
use crate::local::network_slot::NetworkSlot;
use crate::local::reopening;
use crate::node::build::BuiltNode;
use crate::node::error::NodeError;
use crate::node::identity::wanted_nearby;
use crate::node::local::join_late;
use crate::node::options::{RunOptions, Watchdog, admin_socket_path};
use crate::node::random::system_rng;
use crate::state::audit::{Audit, AuditEvent, AuditRecord, AuditWriter};
use crate::state::run_lock::RunLock;

/// A running node: the handles by which it is ended.
pub(super) struct RunningNode<N: RosNetwork> {
    pub(super) core: JoinHandle<()>,
    pub(super) events: mpsc::Sender<CoreEvent>,
    /// Tasks that end with the node.
    pub(super) tasks: Vec<JoinHandle<()>>,
    /// The task of the port mapping, which removes it after the control task ended.
    pub(super) mapping: Option<JoinHandle<()>>,
    /// Tasks that accept links, each with the sender that stops it.
    pub(super) accepting: Vec<(JoinHandle<()>, oneshot::Sender<()>)>,
    /// The task of the status socket.
    pub(super) socket: JoinHandle<()>,
    pub(super) reloader: Arc<Reloader>,
    pub(super) dialer: Arc<Dialer>,
    pub(super) lane_dialer: Arc<Dialer>,
    pub(super) gateway: Arc<Gateway>,
    pub(super) network: NetworkSlot<N>,
    pub(super) audit: Audit,
    pub(super) audit_writer: AuditWriter,
    /// Ends when every thread and blocking task that uses this runtime has ended.
    pub(super) all_ended: mpsc::Receiver<()>,
    pub(super) run_lock: RunLock,
}

/// Starts the tasks of a node, and sends its listen addresses to `options.ready`.
pub(super) async fn spawn<N: RosNetwork>(
    node: BuiltNode<N>,
    options: RunOptions,
    file_watch: Option<FileWatch>,
) -> Result<RunningNode<N>, NodeError> {
    let BuiltNode { config, identity, rules, audit, network, gateway, channels, sockets, board, .. } = node;
    let (events, mut rng) = (channels.events, node.rng);
    let mapping_rng = ChaCha20Rng::from_rng(&mut rng);
    let core = tokio::spawn(node.core.run(channels.inbox, channels.requested));
    if let Some(network) = network.get() {
        let events = events.clone();
        let discover = move || discover(&*network, events);
        tokio::task::spawn_blocking(discover).await.map_err(|_| NodeError::Panicked)??;
    }
    let listening: Vec<_> = sockets.listeners.iter().map(|l| l.local().clone()).collect();
    let description = description(&config, &identity, &listening, options.file.as_deref());
    let nearby = wanted_nearby(&config.routers, &identity)?;
    let announced = if config.announce { listening.clone() } else { Vec::new() };
    let keeper = LinkKeeper {
        me: identity.node_id(),
        dialer: sockets.dialer.clone(),
        lane_dialer: sockets.lane_dialer.clone(),
        dns: Dns::new(config.resolver),
        core: events.clone(),
        redial: channels.on_redial,
        claims: Claims::default(),
        network: Network::watch(),
        urls: WorkingUrls::open(node.state.as_deref()),
    };
    let searches = Searches::new(keeper.clone(), board, options.mdns_port, announced, rng);
    searches.search(WantedRouters {
        configured: config.routers.clone(),
        of_tokens: rules.routers.clone(),
        nearby,
    });
    let lanes = LaneAdmission::new(node.names.clone());
    let admission = || Admission {
        core: events.clone(),
        credentials: sockets.credentials.clone(),
        claims: keeper.claims.clone(),
        audit: audit.clone(),
        lanes: lanes.clone(),
    };
    let accepting = sockets.listeners.into_iter().map(|listener| accept(listener, admission())).collect();
    let mut accepting: Vec<_> = accepting;
    let mut tasks = Vec::new();
    let mut mapping = None;
    if let Some(DirectSockets { listeners, checks, .. }) = sockets.direct {
        accepting.extend(listeners.into_iter().map(|listener| begin_accepting(listener, admission())));
        tasks.push(tokio::spawn(direct::serve(keeper.clone(), checks, channels.direct_dials)));
        let (network, core) = (keeper.network.onward(), events.clone());
        let keep_mapped = port_mapping::serve(channels.mapping_wishes, network, core, mapping_rng);
        mapping = Some(tokio::spawn(keep_mapped));
    }
    if let Some((config, operations)) = channels.store {
        tasks.push(tokio::spawn(store::serve(config, operations, events.clone())));
    }
    let node_name = identity.node_name().to_string();
    let socket = admin_socket_path(&config, &node_name);
    tasks.push(tokio::spawn(reopening::watch(
        keeper.network.clone(),
        network.clone(),
        gateway.clone(),
        events.clone(),
    )));
    let metrics = node.metrics;
    tasks.push(tokio::spawn(metrics.clone().run(
        events.clone(),
        gateway.clone(),
        identity.clone(),
        system_rng()?,
    )));
    let reloader = Arc::new(Reloader {
        source: options.source,
        join: node.open.map(|open| join_late(open, network.clone(), events.clone(), gateway.clone())),
        searches,
        identity,
        credentials: sockets.credentials,
        state: node.state,
        audit: audit.clone(),
        names: node.names,
        events: events.clone(),
        has_ros: AtomicBool::new(network.get().is_some()),
        gateway: gateway.clone(),
        metrics: metrics.clone(),
        running: Mutex::new(Running { config, rules, suites: node.suites }),
        changed: Notify::new(),
    });
    tasks.extend(reload_tasks(&reloader, options.reload, file_watch));
    let (renewer, changes) = (reloader.clone(), keeper.network.onward());
    tasks.push(tokio::spawn(async move { renewer.watch_gateway_certificate(changes).await }));
    tasks.extend(options.watchdog.map(|watchdog| tokio::spawn(keep_fed(watchdog, events.clone()))));
    let desk = Desk {
        events: events.clone(),
        reloader: reloader.clone(),
        gateway: gateway.clone(),
        metrics,
        audit: audit.clone(),
        node: node_name,
    };
    let socket = admin::begin(socket, desk);
    let program = options.program.unwrap_or_else(|| concat!("sgc ", env!("CARGO_PKG_VERSION")).to_owned());
    info!("{program}: {description}");
    audit.write(AuditRecord::new(AuditEvent::Started).by(program));
    if let Some(ready) = options.ready {
        let _ = ready.send(listening);
    }
    Ok(RunningNode {
        core,
        events,
        tasks,
        mapping,
        accepting,
        socket,
        reloader,
        dialer: sockets.dialer,
        lane_dialer: sockets.lane_dialer,
        gateway,
        network,
        audit,
        audit_writer: node.audit_writer,
        all_ended: channels.all_ended,
        run_lock: node.run_lock,
    })
}

/// Describes a node in a line, for the log.
fn description(
    config: &Config,
    identity: &Identity,
    listening: &[ListenAddr],
    file: Option<&Path>,
) -> String {
    let mut parts = vec![format!("node {} of fleet {}", identity.node_name(), identity.fleet_name())];
    if let Some(ros) = &config.ros {
        parts.push(format!("proxy of ROS domain {}", ros.domain_id));
    }
    if !listening.is_empty() {
        let addresses: Vec<_> = listening.iter().map(ToString::to_string).collect();
        parts.push(format!("router at {}", addresses.join(" and ")));
    }
    parts.push(match file {
        Some(file) => format!("configured by {}", file.display()),
        None => "configured by arguments".to_owned(),
    });
    parts.join(", ")
}

/// Feeds a watchdog as long as the control task answers.
async fn keep_fed(watchdog: Watchdog, events: mpsc::Sender<CoreEvent>) {
    let mut ticks = tokio::time::interval(watchdog.every);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        ticks.tick().await;
        let (reply, answered) = oneshot::channel();
        if events.send(CoreEvent::Ping(reply)).await.is_err() || answered.await.is_err() {
            return;
        }
        (watchdog.feed)();
    }
}

fn accept(listener: Listener, admission: Admission) -> (JoinHandle<()>, oneshot::Sender<()>) {
    info!("listening on {}", listener.local());
    begin_accepting(listener, admission)
}

fn begin_accepting(listener: Listener, admission: Admission) -> (JoinHandle<()>, oneshot::Sender<()>) {
    let (stop, stopped) = oneshot::channel();
    (tokio::spawn(keep_accepting(listener, admission, stopped)), stop)
}

/// Starts the tasks that reload the configuration: when a token expires, when `asked` says so, when a file changes.
fn reload_tasks(
    reloader: &Arc<Reloader>,
    asked: Option<mpsc::Receiver<()>>,
    file_watch: Option<FileWatch>,
) -> Vec<JoinHandle<()>> {
    let expiring = reloader.clone();
    let mut tasks = vec![tokio::spawn(async move { expiring.watch_expiry().await })];
    if let Some(mut asked) = asked {
        let reloader = reloader.clone();
        tasks.push(tokio::spawn(async move {
            while asked.recv().await.is_some() {
                // The log has the error; nobody waits for the result.
                let _ = reloader.reload("SIGHUP").await;
            }
        }));
    }
    tasks.extend(file_watch.map(|watch| tokio::spawn(watch.run(reloader.clone()))));
    tasks
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use std::sync::atomic::AtomicU32;
    use std::sync::atomic::Ordering::Relaxed;
    use std::time::Duration;

    use super::*;

    #[tokio::test(start_paused = true)]
    async fn watchdog_is_fed_only_while_the_control_task_answers() {
        let fed = Arc::<AtomicU32>::default();
        let count = fed.clone();
        let every = Duration::from_secs(15);
        let feed = Box::new(move || {
            count.fetch_add(1, Relaxed);
        });
        let (events, mut inbox) = mpsc::channel(1);
        let task = tokio::spawn(keep_fed(Watchdog { every, feed }, events));
        let mut asked = async || match inbox.recv().await.unwrap() {
            CoreEvent::Ping(reply) => reply,
            _ => panic!("no ping"),
        };
        for before in 0..3 {
            let reply = asked().await;
            assert_eq!(fed.load(Relaxed), before);
            reply.send(()).unwrap();
        }
        // It hangs.
        let reply = asked().await;
        tokio::time::sleep(10 * every).await;
        assert_eq!(fed.load(Relaxed), 3);
        // It goes on.
        reply.send(()).unwrap();
        let reply = asked().await;
        assert_eq!(fed.load(Relaxed), 4);
        // It ends.
        drop(reply);
        task.await.unwrap();
    }
}
