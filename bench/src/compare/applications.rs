//! Table `applications`: those of the paper, as requests and answers of their sizes.
//!
//! What they compute takes no time here: it would be the same in every row, and hide what is compared.

use std::time::Duration;

use anyhow::{Context, Result};
use serde_json::{Value, json};

use super::lab::{Lab, PathKind, Side};
use super::system::{System, Topic};
use super::{Compare, Figures};
use crate::report::Spread;

const REQUEST: &str = "/bench/request";
const ANSWER: &str = "/bench/answer";
/// How long a system may take until the first answer has come.
const CONNECT_MAX: Duration = Duration::from_secs(30);
/// How much longer than it may take is waited for what a program says.
const SPARE: Duration = Duration::from_secs(5);

/// What goes there and what comes back.
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
        for system in compare.systems() {
            let name = system.name();
            if !matches!(kind, PathKind::Bare) && !is_told_apart(&name) {
                continue;
            }
            compare.note(&format!("applications, {}: {name}", kind.name()));
            if let Err(error) = measure(compare, &kind, &**system, figures) {
                figures.leave_out(&format!("applications {name} on {}", kind.name()), format!("{error:#}"));
            }
        }
    }
    Ok(())
}

/// Where the path says how long it takes, suites and a router beside it make no difference: of SGC one row for each
/// transport is enough there.
pub(super) fn is_told_apart(system: &str) -> bool {
    !system.starts_with("sgc-") || system.ends_with("-standard")
}

/// One system, all applications.
fn measure(compare: &Compare, kind: &PathKind, system: &dyn System, figures: &mut Figures) -> Result<()> {
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
    for application in &APPLICATIONS {
        let plan = Plan::of(kind, application, compare.is_quick());
        ask.order(&json!({ "ask": {
            "size": application.request, "answer": application.answer, "rate": application.rate,
            "count": plan.count, "seconds": plan.seconds, "warm_up": plan.warm_up,
            "patience_seconds": plan.patience.as_secs_f64(),
        }}))?;
        let most = plan.patience * (1 + plan.warm_up) + Duration::from_secs_f64(plan.seconds) + SPARE;
        let answered = ask.until("answered", most).with_context(|| application.name)?;
        let is_lost = push(figures, &system.name(), kind.name(), application, &answered)?;
        if is_lost {
            // What was given up still fills the path.
            figures.leave_out(
                &format!("applications {} on {} from {} on", system.name(), kind.name(), application.name),
                format!("no answer within {:?}", plan.patience),
            );
            break;
        }
    }
    Ok(())
}

/// Adds what an application reached. Whether an answer did not come.
fn push(
    figures: &mut Figures,
    system: &str,
    path: &str,
    application: &Application,
    answered: &Value,
) -> Result<bool> {
    let round_trips = answered["round_trips_us"].as_array().context("no round trips")?;
    let round_trips: Vec<_> = round_trips.iter().filter_map(Value::as_f64).collect();
    let lost = answered["lost"].as_u64().context("no count of what was lost")?;
    let moment = |name: &str| answered[name].as_u64().with_context(|| format!("no {name}"));
    let seconds = moment("ended_ns")?.saturating_sub(moment("begun_ns")?) as f64 / 1e9;
    let mut push = |metric: &str, value| {
        figures.push("applications", system, path, 0.0, &format!("{}_{metric}", application.name), value);
    };
    if application.rate.is_some() && seconds > 0.0 {
        push("frames_per_second", round_trips.len() as f64 / seconds);
    }
    if !round_trips.is_empty() {
        let spread = Spread::of(round_trips);
        push("p50_us", spread.p50);
        push("p99_us", spread.p99);
    }
    push("lost", lost as f64);
    Ok(lost > 0)
}

/// How an application is measured.
struct Plan {
    count: usize,
    seconds: f64,
    warm_up: u32,
    patience: Duration,
}

impl Plan {
    fn of(kind: &PathKind, application: &Application, quick: bool) -> Self {
        let is_huge = application.request >= 1 << 20;
        let (count, seconds, warm_up, patience) = match kind {
            PathKind::Bare if is_huge => (40, 3.0, 2, 20),
            PathKind::Bare => (1000, 4.0, 5, 5),
            // It takes 21 s there at least: one is enough.
            PathKind::Paper if is_huge => (1, 1.0, 0, 150),
            _ if is_huge => (3, 1.0, 0, 60),
            _ => (100, 8.0, 1, 30),
        };
        let seconds = if quick { f64::min(seconds, 1.0) } else { seconds };
        let count = if quick { count.min(30) } else { count };
        Self { count, seconds, warm_up, patience: Duration::from_secs(patience) }
    }
}
