//! `sgc demo`: two ROS 2 networks that cannot see each other, joined by a robot node, a router and an operator node,
//! with talkers and listeners that count every message.
//!
//! All of it is real: the nodes are `sgc run` with configurations as a user writes them, in processes of their own,
//! and the talkers and listeners are DDS participants that know nothing of `sgc`. Nothing leaves this host.

pub(crate) mod domains;
mod messages;
mod peer;
pub(crate) mod processes;
mod protocol;
mod report;
mod screen;
mod stage;
mod topics;
mod tracker;

use std::future::Future;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use clap::Args;
use tokio::time::{Instant, MissedTickBehavior, interval_at, sleep_until, timeout};

pub(crate) use peer::{PeerArgs, peer};

use self::domains::HeldDomain;
use self::processes::{ChildEvent, Processes, Who, last_lines};
use self::protocol::{PeerCommand, PeerEvent};
use self::report::{Flow, Report};
use self::screen::Screen;
use self::stage::{CLOUD, Stage};
use self::topics::{Role, Topic};
use crate::error::{CliError, EXIT_FAILURE};
use crate::run::{EndSignals, ReadyLine};
use crate::{output, status};

/// Longest demo: a week, so that [`tracker::SEQ_MAX`] is out of reach.
const SECONDS_MAX: i64 = 7 * 86_400;
/// How long a node may take to start.
const READY_MAX: Duration = Duration::from_secs(30);
/// How long the first messages may take to come through.
const PATH_MAX: Duration = Duration::from_secs(60);
/// How long the last messages may be under way.
const DRAIN_MAX: Duration = Duration::from_secs(5);
/// How long processes may take to end.
const END_MAX: Duration = Duration::from_secs(6);

const ROUTER: Who = Who(CLOUD);
const PEERS: [Who; 2] = [Who("robot-peer"), Who("operator-peer")];

/// See it work: two ROS 2 networks on this machine that cannot see each other, joined by three sgc processes.
///
/// It needs no ROS 2 and no configuration, and leaves nothing behind. A text, an image of 1 MB and a velocity command
/// cross over at 10, 10 and 50 Hz; every message is numbered and checked. Exit code 0 means that all of them arrived, once
/// each and unaltered.
#[derive(Debug, Args)]
pub(crate) struct DemoArgs {
    /// How long to count messages
    #[arg(long, value_name = "N", default_value_t = 10,
          value_parser = clap::value_parser!(u32).range(1..=SECONDS_MAX))]
    seconds: u32,
    /// Print one JSON document at the end, and nothing else
    #[arg(long)]
    json: bool,
    /// Keep configurations, identities and logs in this directory, which must be new or empty
    #[arg(long, value_name = "DIR")]
    keep: Option<PathBuf>,
}

/// Runs `sgc demo`.
pub(crate) fn demo(args: DemoArgs) -> Result<ExitCode, CliError> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(|source| CliError::System { what: "cannot start a runtime", source })?;
    let result = runtime.block_on(stage_and_perform(&args));
    let report = match &result {
        Ok(report) => report,
        Err(error) => &Report::failed(error.to_string()),
    };
    if args.json {
        let text = serde_json::to_string(report)
            .map_err(|e| CliError::System { what: "cannot print the report", source: e.into() })?;
        output::line(text)?;
    }
    result.map(|report| if report.is_ok() { ExitCode::SUCCESS } else { ExitCode::from(EXIT_FAILURE) })
}

async fn stage_and_perform(args: &DemoArgs) -> Result<Report, CliError> {
    let interruption = Interruption { signals: Some(EndSignals::new()?) };
    let screen = Screen::new(args.json);
    let mut demo = Demo::new(args, interruption, screen)?;
    let result = demo.perform(Duration::from_secs(args.seconds.into())).await;
    demo.take_down().await;
    result
}

/// A signal of the user's, once; the next ends the process at once.
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

/// How waiting for something ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Waited {
    Happened,
    Interrupted,
    InVain,
}

/// One demo.
struct Demo {
    stage: Stage,
    domains: [HeldDomain; 2],
    processes: Processes,
    interruption: Interruption,
    screen: Screen,
    /// Addresses of the nodes that are up.
    ready: Vec<(Who, Vec<String>)>,
    flows: Vec<Flow>,
}

impl Demo {
    fn new(args: &DemoArgs, interruption: Interruption, screen: Screen) -> Result<Self, CliError> {
        let stage = Stage::set(args.keep.as_deref())?;
        let domains = domains::hold_two(std::process::id()).ok_or_else(|| CliError::Demo {
            reason: "no two free ROS domains: other ROS 2 programs or demos run here".into(),
            facts: Vec::new(),
        })?;
        let flows = Topic::ALL
            .into_iter()
            .map(|topic| Ok(Flow::new(topic, stage.name_of(topic)?)))
            .collect::<Result<_, CliError>>()?;
        let processes = Processes::new();
        Ok(Self { stage, domains, processes, interruption, screen, ready: Vec::new(), flows })
    }

    async fn perform(&mut self, duration: Duration) -> Result<Report, CliError> {
        self.screen.introduce(self.domain(Role::Robot), self.domain(Role::Operator))?;
        let begun = Instant::now();
        self.start_all().await?;
        match self.wait_for(PATH_MAX, |demo| demo.flows.iter().all(Flow::is_up)).await? {
            Waited::Happened => {}
            waited => return Err(self.no_path(waited).await),
        }
        self.check_names().await?;
        self.screen.say(&format!("The path is up after {:.1} s.\n", begun.elapsed().as_secs_f64()))?;

        let elapsed = self.measure(duration).await?;
        self.tell_peers(PeerCommand::Stop).await?;
        // Whatever this ends by: what is missing then is lost.
        self.wait_for(DRAIN_MAX, |demo| demo.flows.iter().all(Flow::is_complete)).await?;
        for flow in &mut self.flows {
            flow.stopped = true;
        }
        self.screen.sum_up(elapsed, &self.flows)?;
        Ok(Report::new(elapsed.as_secs_f64(), &self.flows))
    }

    /// Starts the router, and once its address is known everything else.
    async fn start_all(&mut self) -> Result<(), CliError> {
        let config = self.stage.write_cloud("quic://127.0.0.1:0")?;
        self.start_node(ROUTER, &config.display().to_string())?;
        self.wait_ready(&[ROUTER]).await?;
        let router = self.ready.first().and_then(|(_, addresses)| addresses.first()).cloned();
        let router = router.ok_or_else(|| CliError::Demo {
            reason: "the router listens nowhere".into(),
            facts: last_lines(&self.stage.log(CLOUD)),
        })?;
        if self.stage.is_kept() {
            // So that `sgc run -c` with the files that are kept works as it did here.
            self.stage.write_cloud(&router)?;
        }
        for (role, peer) in Role::ALL.into_iter().zip(PEERS) {
            let domain = self.domain(role);
            let config = self.stage.write_end(role, domain, &router)?;
            self.start_node(Who(role.name()), &config.display().to_string())?;
            let domain = domain.to_string();
            let args = ["demo-peer", "--role", role.name(), "--domain", &domain];
            self.processes.start(peer, &args, &self.stage.log(peer.0))?;
        }
        self.wait_ready(&Role::ALL.map(|role| Who(role.name()))).await?;
        self.stage.forget_secrets()
    }

    fn start_node(&mut self, who: Who, config: &str) -> Result<(), CliError> {
        let args = ["run", "-c", config, "--until-stdin-closes", "--print-ready"];
        self.processes.start(who, &args, &self.stage.log(who.0))
    }

    async fn wait_ready(&mut self, nodes: &[Who]) -> Result<(), CliError> {
        let is_ready = |demo: &Self, node: &Who| demo.ready.iter().any(|(who, _)| who == node);
        match self.wait_for(READY_MAX, |demo| nodes.iter().all(|node| is_ready(demo, node))).await? {
            Waited::Happened => Ok(()),
            Waited::Interrupted => Err(interrupted()),
            Waited::InVain => {
                let late: Vec<_> = nodes.iter().filter(|node| !is_ready(self, node)).map(|w| w.0).collect();
                let facts = late.iter().flat_map(|node| last_lines(&self.stage.log(node))).collect();
                let reason = format!("not up after {} s: {}", READY_MAX.as_secs(), late.join(", "));
                Err(CliError::Demo { reason, facts })
            }
        }
    }

    /// Has the talkers number their messages for a time, or until the user has had enough; says how long it was.
    async fn measure(&mut self, duration: Duration) -> Result<Duration, CliError> {
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

    async fn tell_peers(&mut self, command: PeerCommand) -> Result<(), CliError> {
        for peer in PEERS {
            self.processes.tell(peer, &command).await?;
        }
        Ok(())
    }

    /// Takes in what happens until `done`, for at most `limit`.
    async fn wait_for(&mut self, limit: Duration, done: impl Fn(&Self) -> bool) -> Result<Waited, CliError> {
        let deadline = Instant::now() + limit;
        while !done(self) {
            tokio::select! {
                event = self.processes.next() => self.handle(event)?,
                () = self.interruption.wait() => return Ok(Waited::Interrupted),
                () = sleep_until(deadline) => return Ok(Waited::InVain),
            }
        }
        Ok(Waited::Happened)
    }

    fn handle(&mut self, event: ChildEvent) -> Result<(), CliError> {
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
                Err(CliError::Demo { reason: format!("{} ended too early: {how}", who.0), facts })
            }
        }
    }

    fn handle_peer(&mut self, who: Who, event: PeerEvent) -> Result<(), CliError> {
        let topic = match &event {
            PeerEvent::Matched { topic, .. }
            | PeerEvent::Arrived { topic }
            | PeerEvent::Sending { topic, .. }
            | PeerEvent::Sent { topic, .. }
            | PeerEvent::Receiving { topic, .. } => *topic,
            PeerEvent::Failed { reason } => {
                let facts = last_lines(&self.stage.log(who.0));
                return Err(CliError::Demo { reason: format!("{}: {reason}", who.0), facts });
            }
        };
        for flow in self.flows.iter_mut().filter(|flow| flow.topic == topic) {
            flow.handle(&event);
        }
        Ok(())
    }

    /// The names that are shown are those that the nodes use.
    async fn check_names(&self) -> Result<(), CliError> {
        for role in Role::ALL {
            let Ok(status) = self.status_of(role.name()).await else { continue };
            for route in status.routes {
                let flow = self.flows.iter().find(|flow| flow.topic.ros_name() == route.topic);
                let (Some(flow), Some(used)) = (flow, route.name) else { continue };
                if used != flow.name.to_string() {
                    let reason =
                        format!("{} is named {} here, but {used} at {}", route.topic, flow.name, role.name());
                    return Err(CliError::Demo { reason, facts: Vec::new() });
                }
            }
        }
        Ok(())
    }

    /// Why nothing came through, as far as the nodes can tell.
    async fn no_path(&self, waited: Waited) -> CliError {
        if waited == Waited::Interrupted {
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
        CliError::Demo { reason, facts }
    }

    fn status_of(&self, node: &str) -> impl Future<Output = Result<status::Status, CliError>> + use<> {
        let socket = self.stage.socket(node);
        async move {
            tokio::task::spawn_blocking(move || status::of_node_at(&socket)).await.unwrap_or_else(|error| {
                Err(CliError::System { what: "cannot ask a node", source: std::io::Error::other(error) })
            })
        }
    }

    /// Ends all processes: those that talk before those that carry, so that each can say goodbye.
    async fn take_down(&mut self) {
        let mut failures = Vec::new();
        let [robot, operator] = Role::ALL.map(|role| Who(role.name()));
        for group in [&PEERS[..], &[robot, operator], &[ROUTER]] {
            // Those that do not end in time are killed below.
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

fn interrupted() -> CliError {
    CliError::Demo { reason: "interrupted before anything was counted".into(), facts: Vec::new() }
}

fn strange(who: Who, line: &str) -> CliError {
    const SHOWN: usize = 200;
    let line: String = line.chars().take(SHOWN).collect();
    CliError::Demo { reason: format!("{} printed what was not expected: {line}", who.0), facts: Vec::new() }
}
