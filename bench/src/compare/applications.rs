//! Table `applications`: the paper's applications, as requests and answers of their sizes.
//!
//! Their computation takes no time here, because it would be the same in every row and hide the differences.

use std::time::Duration;

use anyhow::{Context, Result};
use serde::Deserialize;
use serde_json::json;

use super::lab::{Lab, PathKind, Side};
use super::plan::Breadth;
use super::program::Program;
use super::system::{Running, System, Topic};
use super::turns::by_stages;
use super::{Compare, Figures, plan};
use crate::report::Spread;

const REQUEST: &str = "/bench/request";
const ANSWER: &str = "/bench/answer";
/// How long a system may take until the first answer has come.
const CONNECT_MAX: Duration = Duration::from_secs(30);
/// How much longer than it may take is waited for what a program says.
const SPARE: Duration = Duration::from_secs(5);

/// Sizes of requests and answers.
struct Application {
    name: &'static str,
    /// Bytes.
    request: usize,
    answer: usize,
    /// Requests a second; a frame that falls due while an answer is awaited is left out.
    rate: Option<f64>,
}

const APPLICATIONS: [Application; 4] = [
    // A pose is a header, a position and an orientation.
    Application { name: "vslam", request: 640 * 480 * 3, answer: 128, rate: Some(30.0) },
    Application { name: "motion", request: 2 << 10, answer: 8 << 10, rate: None },
    Application { name: "grasp-compressed", request: 300_000, answer: 256, rate: None },
    Application { name: "grasp-raw", request: 13 << 20, answer: 256, rate: None },
];

/// Measures it.
pub(crate) fn run(compare: &Compare, figures: &mut Figures) -> Result<()> {
    let kinds = [PathKind::Bare, PathKind::Paper, PathKind::Lossy];
    for kind in kinds.into_iter().filter(|kind| compare.wants_path(kind)) {
        let (breadth, why) = match kind {
            PathKind::Bare => (Breadth::Cross, "what they differ in is in the rows of their own"),
            _ => (Breadth::Transports, "the path says how long it takes there, and hardly the suite"),
        };
        let systems = compare.systems_of(breadth, &format!("applications on {}", kind.name()), why, figures);
        for together in plan::together(&kind, systems, |system| system.name()) {
            let names: Vec<_> = together.iter().map(|system| system.name()).collect();
            compare.note(&format!("applications, {}: {}", kind.name(), names.join(", ")));
            let turns = by_stages(
                &together,
                &APPLICATIONS.each_ref(),
                |system| Turn::start(compare, &kind, system),
                |turn, application| {
                    turn.measure(application, &Plan::for_path(&kind, application, compare.is_quick()))
                },
            );
            for (name, turn) in names.into_iter().zip(turns) {
                for (application, answered) in APPLICATIONS.iter().zip(&turn.stages) {
                    push(figures, &name, &kind, application, answered);
                }
                if let Some(error) = turn.error {
                    figures
                        .leave_out(&format!("applications {name} on {}", kind.name()), format!("{error:#}"));
                }
            }
        }
    }
    Ok(())
}

/// A turn of a system. Fields go in this order.
struct Turn {
    ask: Program,
    _answer: Program,
    _running: Running,
    _lab: Lab,
}

impl Turn {
    fn start(compare: &Compare, kind: &PathKind, system: &dyn System) -> Result<Self> {
        let lab = Lab::new(*kind, compare.load())?;
        let topics = [
            Topic { name: REQUEST, towards: Side::Right, reliable: true },
            Topic { name: ANSWER, towards: Side::Left, reliable: true },
        ];
        let running = system.start(&lab, &topics)?;
        let args = ["--topic", REQUEST, "--back", ANSWER, "--reliable"];
        let mut answer = lab.load(&running, Side::Right, &[&["answer"][..], &args].concat())?;
        answer.soon("up")?;
        let mut ask = lab.load(&running, Side::Left, &[&["ask"][..], &args].concat())?;
        ask.until("connected", CONNECT_MAX)?;
        Ok(Self { ask, _answer: answer, _running: running, _lab: lab })
    }

    /// One application; itself, unless there is no going on.
    fn measure(mut self, application: &Application, plan: &Plan) -> Result<(AskReport, Option<Self>)> {
        self.ask.order(&json!({ "ask": {
            "size": application.request, "answer": application.answer, "rate": application.rate,
            "count": plan.count, "seconds": plan.seconds, "warm_up": plan.warm_up,
            "patience_seconds": plan.patience.as_secs_f64(),
        }}))?;
        let most = plan.patience * (1 + plan.warm_up) + Duration::from_secs_f64(plan.seconds) + SPARE;
        let answered = self.ask.until("answered", most).with_context(|| application.name)?;
        let answered: AskReport = serde_json::from_value(answered).context("what a program was answered")?;
        // Abandoned messages still fill the path.
        let goes_on = answered.lost == 0;
        Ok((answered, goes_on.then_some(self)))
    }
}

/// The asking program's report.
#[derive(Deserialize)]
struct AskReport {
    round_trips_us: Vec<f64>,
    lost: u64,
    begun_ns: u64,
    ended_ns: u64,
}

/// Adds what an application reached.
fn push(
    figures: &mut Figures,
    system: &str,
    kind: &PathKind,
    application: &Application,
    answered: &AskReport,
) {
    let AskReport { round_trips_us, lost, .. } = answered;
    let seconds = answered.ended_ns.saturating_sub(answered.begun_ns) as f64 / 1e9;
    let mut push = |metric: &str, value| {
        let metric = format!("{}_{metric}", application.name);
        figures.push("applications", system, kind.name(), 0.0, &metric, value);
    };
    if application.rate.is_some() && seconds > 0.0 {
        push("frames_per_second", round_trips_us.len() as f64 / seconds);
    }
    if !round_trips_us.is_empty() {
        let spread = Spread::from_samples(round_trips_us.clone());
        push("p50_us", spread.p50);
        push("p99_us", spread.p99);
    }
    push("lost", *lost as f64);
    if *lost > 0 {
        let what = format!("applications {system} on {} after {}", kind.name(), application.name);
        figures.leave_out(&what, "an answer did not come in time");
    }
}

/// How an application is measured.
struct Plan {
    count: usize,
    seconds: f64,
    warm_up: u32,
    patience: Duration,
}

impl Plan {
    fn for_path(kind: &PathKind, application: &Application, quick: bool) -> Self {
        let is_huge = application.request >= 1 << 20;
        let (count, seconds, warm_up, patience) = match kind {
            PathKind::Bare if is_huge => (12, 2.5, 1, 20),
            PathKind::Bare => (1000, 2.5, 5, 5),
            // It takes 22 s at 5 Mbit/s, and TCP where packets are lost twice that: one is enough.
            _ if is_huge => (1, 1.0, 0, 100),
            _ => (100, 5.0, 1, 30),
        };
        let seconds = if quick { f64::min(seconds, 1.0) } else { seconds };
        let count = if quick { count.min(30) } else { count };
        Self { count, seconds, warm_up, patience: Duration::from_secs(patience) }
    }
}
