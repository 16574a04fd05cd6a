//! `sgc demo`: joins two separate ROS 2 networks by a robot node, a router and an operator node. Talkers and listeners
//! count every message.
//!
//! The nodes are `sgc run` processes with configurations as a user writes them. The talkers and listeners are DDS
//! participants that do not know `sgc`. No packet leaves this host.
//!
//! `sgc` parses the arguments and runs each peer in a process of its own, by its hidden command `demo-peer`.

mod error;
mod messages;
mod peer;
mod processes;
mod protocol;
mod report;
mod screen;
mod stage;
mod topics;
mod tracker;

use std::future::Future;
use std::path::PathBuf;
use std::time::Duration;

use sgc_diagnosis::status;
use sgc_process::children::{ReadyLine, last_lines};
use sgc_process::domains::{self, DomainLock};
use sgc_process::{EndSignals, ProcessError, output};
use tokio::time::{Instant, MissedTickBehavior, interval_at, sleep_until, timeout};

pub use error::DemoError;
pub use peer::peer;
pub use topics::Role;

use self::processes::{ChildEvent, ProcessName, Processes};
use self::protocol::{PeerCommand, PeerEvent};
use self::report::{Flow, Report};
use self::screen::Screen;
use self::stage::{CLOUD, Stage};
use self::topics::Topic;

/// Longest demo: one week, so that `tracker::SEQ_MAX` is out of reach.
pub const SECONDS_MAX: u32 = 7 * 86_400;
/// Longest time a node may take to start.
const READY_MAX: Duration = Duration::from_secs(30);
/// Longest time until the first messages arrive.
const PATH_MAX: Duration = Duration::from_secs(60);
/// Longest time the last messages may be in flight.
const DRAIN_MAX: Duration = Duration::from_secs(5);
/// Longest time processes may take to end.
const END_MAX: Duration = Duration::from_secs(6);

const ROUTER: ProcessName = ProcessName(CLOUD);
const PEERS: [ProcessName; 2] = [ProcessName("robot-peer"), ProcessName("operator-peer")];

/// How a demo runs.
#[derive(Clone, Debug)]
pub struct DemoOptions {
    /// How long to count messages, in seconds: 1 to [`SECONDS_MAX`].
    pub seconds: u32,
    /// Print one JSON document at the end and nothing else.
    pub json: bool,
    /// Directory in which to keep configurations, identities and logs.
    pub keep: Option<PathBuf>,
}

/// Runs the demo and prints its course. Returns `true` if each message arrived once and unaltered.
pub fn demo(options: &DemoOptions) -> Result<bool, DemoError> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(|source| ProcessError::System { what: "cannot start a runtime", source })?;
    let result = runtime.block_on(stage_and_perform(options));
    let report = match &result {
        Ok(report) => report,
        Err(error) => &Report::failed(error.to_string()),
    };
    if options.json {
        let text = serde_json::to_string(report)
            .map_err(|e| ProcessError::System { what: "cannot print the report", source: e.into() })?;
        output::line(text)?;
    }
    result.map(|report| report.is_ok())
}

async fn stage_and_perform(options: &DemoOptions) -> Result<Report, DemoError> {
    let interruption = Interruption { signals: Some(EndSignals::new()?) };
    let screen = Screen::new(options.json);
    let mut demo = Demo::new(options, interruption, screen)?;
    let result = demo.perform(Duration::from_secs(options.seconds.into())).await;
    demo.take_down().await;
    result
}

/// The user's first signal. A second one ends the process at once.
struct Interruption {
    signals: Option<EndSignals>,
}

impl Interruption {
    async fn wait(&mut self) {
        match &mut self.signals {
            Some(signals) => signals.next().await,
            None => std::future::pending().await,
        }
        if let Some(signals) = self.signals.take() {
            signals.end_at_once();
        }
    }
}

/// How a wait ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum WaitOutcome {
    Happened,
    Interrupted,
    InVain,
}

/// A running demo.
struct Demo {
    stage: Stage,
    domains: [DomainLock; 2],
    processes: Processes,
    interruption: Interruption,
    screen: Screen,
    /// The addresses of the nodes that are up.
    ready: Vec<(ProcessName, Vec<String>)>,
    flows: Vec<Flow>,
}

impl Demo {
    fn new(options: &DemoOptions, interruption: Interruption, screen: Screen) -> Result<Self, DemoError> {
        let stage = Stage::set(options.keep.as_deref())?;
        let domains = domains::lock_two(std::process::id()).ok_or_else(|| DemoError::Failed {
            reason: "no two free ROS domains: other ROS 2 programs or demos run here".into(),
            facts: Vec::new(),
        })?;
        let flows = Topic::ALL
            .into_iter()
            .map(|topic| Ok(Flow::new(topic, stage.name_of(topic)?)))
            .collect::<Result<_, DemoError>>()?;
        let processes = Processes::new();
        Ok(Self { stage, domains, processes, interruption, screen, ready: Vec::new(), flows })
    }

    async fn perform(&mut self, duration: Duration) -> Result<Report, DemoError> {
        self.screen.introduce(self.domain(Role::Robot), self.domain(Role::Operator))?;
        let begun = Instant::now();
        self.start_all().await?;
        match self.wait_for(PATH_MAX, |demo| demo.flows.iter().all(Flow::is_up)).await? {
            WaitOutcome::Happened => {}
            waited => return Err(self.no_path(waited).await),
        }
        self.check_names().await?;
        self.screen.say(&format!("The path is up after {:.1} s.\n", begun.elapsed().as_secs_f64()))?;

        let elapsed = self.measure(duration).await?;
        self.tell_peers(PeerCommand::Stop).await?;
        // However this wait ends, messages that are still missing count as lost.
        self.wait_for(DRAIN_MAX, |demo| demo.flows.iter().all(Flow::is_complete)).await?;
        for flow in &mut self.flows {
            flow.stopped = true;
        }
        self.screen.sum_up(elapsed, &self.flows)?;
        Ok(Report::new(elapsed.as_secs_f64(), &self.flows))
    }

    /// Starts the router, and everything else once the router's address is known.
    async fn start_all(&mut self) -> Result<(), DemoError> {
        let config = self.stage.write_cloud("quic://127.0.0.1:0")?;
        self.start_node(ROUTER, &config.display().to_string())?;
        self.wait_ready(&[ROUTER]).await?;
        let router = self.ready.first().and_then(|(_, addresses)| addresses.first()).cloned();
        let router = router.ok_or_else(|| DemoError::Failed {
            reason: "the router listens nowhere".into(),
            facts: last_lines(&self.stage.log(CLOUD)),
        })?;
        if self.stage.is_kept() {
            // The kept files name the bound address, so that `sgc run -c` works with them.
            self.stage.write_cloud(&router)?;
        }
        for (role, peer) in Role::ALL.into_iter().zip(PEERS) {
            let domain = self.domain(role);
            let config = self.stage.write_end(role, domain, &router)?;
            self.start_node(ProcessName(role.name()), &config.display().to_string())?;
            let domain = domain.to_string();
            let args = ["demo-peer", "--role", role.name(), "--domain", &domain];
            self.processes.start(peer, &args, &self.stage.log(peer.0))?;
        }
        self.wait_ready(&Role::ALL.map(|role| ProcessName(role.name()))).await?;
        self.stage.forget_secrets()
    }

    fn start_node(&mut self, who: ProcessName, config: &str) -> Result<(), DemoError> {
        let args = ["run", "-c", config, "--until-stdin-closes", "--print-ready"];
        Ok(self.processes.start(who, &args, &self.stage.log(who.0))?)
    }

    async fn wait_ready(&mut self, nodes: &[ProcessName]) -> Result<(), DemoError> {
        let is_ready = |demo: &Self, node: &ProcessName| demo.ready.iter().any(|(who, _)| who == node);
        match self.wait_for(READY_MAX, |demo| nodes.iter().all(|node| is_ready(demo, node))).await? {
            WaitOutcome::Happened => Ok(()),
            WaitOutcome::Interrupted => Err(interrupted()),
            WaitOutcome::InVain => {
                let late: Vec<_> = nodes.iter().filter(|node| !is_ready(self, node)).map(|w| w.0).collect();
                let facts = late.iter().flat_map(|node| last_lines(&self.stage.log(node))).collect();
                let reason = format!("not up after {} s: {}", READY_MAX.as_secs(), late.join(", "));
                Err(DemoError::Failed { reason, facts })
            }
        }
    }

    /// Lets the talkers number their messages for a time, or until the user interrupts. Returns the elapsed time.
    async fn measure(&mut self, duration: Duration) -> Result<Duration, DemoError> {
        self.tell_peers(PeerCommand::Go).await?;
        let begun = Instant::now();
        let period = self.screen.period();
        let mut ticks = interval_at(begun + period, period);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
        loop {
            tokio::select! {
                event = self.processes.next() => self.handle(event)?,
                _ = ticks.tick() => self.screen.show(begun.elapsed(), &self.flows)?,
                () = self.interruption.wait() => break,
                () = sleep_until(begun + duration) => break,
            }
        }
        Ok(begun.elapsed())
    }

    async fn tell_peers(&mut self, command: PeerCommand) -> Result<(), DemoError> {
        for peer in PEERS {
            self.processes.tell(peer, &command).await?;
        }
        Ok(())
    }

    /// Handles events until `done`, for at most `limit`.
    async fn wait_for(
        &mut self,
        limit: Duration,
        done: impl Fn(&Self) -> bool,
    ) -> Result<WaitOutcome, DemoError> {
        let deadline = Instant::now() + limit;
        while !done(self) {
            tokio::select! {
                event = self.processes.next() => self.handle(event)?,
                () = self.interruption.wait() => return Ok(WaitOutcome::Interrupted),
                () = sleep_until(deadline) => return Ok(WaitOutcome::InVain),
            }
        }
        Ok(WaitOutcome::Happened)
    }

    fn handle(&mut self, event: ChildEvent) -> Result<(), DemoError> {
        match event {
            ChildEvent::Line(who, line) if PEERS.contains(&who) => {
                let event = serde_json::from_str(&line).map_err(|_| strange(who, &line))?;
                self.handle_peer(who, event)
            }
            ChildEvent::Line(who, line) => {
                let ready: ReadyLine = serde_json::from_str(&line).map_err(|_| strange(who, &line))?;
                self.ready.push((who, ready.ready));
                Ok(())
            }
            ChildEvent::Ended(who, status) => {
                let how = status.map_or_else(|error| error.to_string(), |status| status.to_string());
                let facts = last_lines(&self.stage.log(who.0));
                Err(DemoError::Failed { reason: format!("{} ended too early: {how}", who.0), facts })
            }
        }
    }

    fn handle_peer(&mut self, who: ProcessName, event: PeerEvent) -> Result<(), DemoError> {
        let topic = match &event {
            PeerEvent::Matched { topic, .. }
            | PeerEvent::Arrived { topic }
            | PeerEvent::Sending { topic, .. }
            | PeerEvent::Sent { topic, .. }
            | PeerEvent::Receiving { topic, .. } => *topic,
            PeerEvent::Failed { reason } => {
                let facts = last_lines(&self.stage.log(who.0));
                return Err(DemoError::Failed { reason: format!("{}: {reason}", who.0), facts });
            }
        };
        for flow in self.flows.iter_mut().filter(|flow| flow.topic == topic) {
            flow.handle(&event);
        }
        Ok(())
    }

    /// Checks that the nodes use the names that the demo shows.
    async fn check_names(&self) -> Result<(), DemoError> {
        for role in Role::ALL {
            let Ok(status) = self.status_of(role.name()).await else { continue };
            for route in status.routes {
                let flow = self.flows.iter().find(|flow| flow.topic.ros_name() == route.topic);
                let (Some(flow), Some(used)) = (flow, route.name) else { continue };
                if used != flow.name.to_string() {
                    let reason =
                        format!("{} is named {} here, but {used} at {}", route.topic, flow.name, role.name());
                    return Err(DemoError::Failed { reason, facts: Vec::new() });
                }
            }
        }
        Ok(())
    }

    /// Explains why no message arrived, as far as the nodes know.
    async fn no_path(&self, waited: WaitOutcome) -> DemoError {
        if waited == WaitOutcome::Interrupted {
            return interrupted();
        }
        let missing: Vec<_> = self.flows.iter().filter(|f| !f.is_up()).map(|f| f.topic.ros_name()).collect();
        let mut facts = Vec::new();
        for flow in self.flows.iter().filter(|flow| !flow.is_up()) {
            let matched = if flow.matched { "sees" } else { "does not see" };
            let (topic, owner) = (flow.topic.ros_name(), flow.topic.owner().name());
            facts.push(format!("{topic}: the talker {matched} node {owner} on its network"));
        }
        for node in [Role::Robot.name(), CLOUD, Role::Operator.name()] {
            match self.status_of(node).await {
                Ok(status) => facts.extend(node_facts(node, &status)),
                Err(error) => facts.push(format!("{node}: {error}")),
            }
        }
        let kept = if self.stage.is_kept() {
            format!("the logs are in {}", self.stage.dir().display())
        } else {
            "--keep DIR keeps the logs".to_owned()
        };
        facts.push(kept);
        let reason = format!("nothing came through in {} s: {}", PATH_MAX.as_secs(), missing.join(", "));
        DemoError::Failed { reason, facts }
    }

    fn status_of(&self, node: &str) -> impl Future<Output = Result<status::Status, DemoError>> + use<> {
        let socket = self.stage.socket(node);
        async move {
            match tokio::task::spawn_blocking(move || status::query(&socket)).await {
                Ok(status) => Ok(status?),
                Err(error) => {
                    let source = std::io::Error::other(error);
                    Err(ProcessError::System { what: "cannot ask a node", source }.into())
                }
            }
        }
    }

    /// Ends all processes: peers before nodes, so that each can leave the network cleanly.
    async fn take_down(&mut self) {
        let mut failures = Vec::new();
        let [robot, operator] = Role::ALL.map(|role| ProcessName(role.name()));
        for group in [&PEERS[..], &[robot, operator], &[ROUTER]] {
            // Processes that do not end in time are killed below.
            let _ = timeout(END_MAX, self.processes.end(group, &mut failures)).await;
        }
        self.processes.kill().await;
        for (who, how) in failures {
            output::diagnostic(&format!("sgc: demo: {} ended badly: {how}", who.0));
            for line in last_lines(&self.stage.log(who.0)) {
                output::diagnostic(&format!("  {line}"));
            }
        }
        if self.stage.is_kept() {
            output::diagnostic(&format!(
                "Configurations, identities and logs are in {}.",
                self.stage.dir().display()
            ));
        }
    }

    fn domain(&self, role: Role) -> u32 {
        let [robot, operator] = &self.domains;
        match role {
            Role::Robot => robot.id(),
            Role::Operator => operator.id(),
        }
    }
}

fn node_facts(node: &str, status: &status::Status) -> Vec<String> {
    let links: Vec<_> = status.links.iter().map(|link| link.remote.as_str()).collect();
    let links =
        if links.is_empty() { "no links".to_owned() } else { format!("links to {}", links.join(", ")) };
    let mut facts = vec![format!("{node}: {links}")];
    for route in &status.routes {
        facts.push(format!("{node}: {} {}: {}", route.direction, route.topic, route.state));
    }
    for (what, counts) in [("dropped", &status.drops), ("refused", &status.refused)] {
        let counts: Vec<_> = counts.iter().map(|(key, n)| format!("{key} {n}")).collect();
        if !counts.is_empty() {
            facts.push(format!("{node}: {what}: {}", counts.join(", ")));
        }
    }
    facts
}

fn interrupted() -> DemoError {
    DemoError::Failed { reason: "interrupted before anything was counted".into(), facts: Vec::new() }
}

fn strange(who: ProcessName, line: &str) -> DemoError {
    const SHOWN: usize = 200;
    let line: String = line.chars().take(SHOWN).collect();
    DemoError::Failed {
        reason: format!("{} printed what was not expected: {line}", who.0),
        facts: Vec::new(),
    }
}
