//! Table `roaming`: the left place changes its address under a reliable flow, and changes it back.
//!
//! The path is a bare one, so that what is seen is how long a system takes to notice and to act. `at` 0 is the way to
//! the new address, `at` 1 the way back.

use std::thread::sleep;
use std::time::Duration;

use anyhow::{Context, Result};
use serde_json::{Value, json};

use super::lab::{INTERFACE, Lab, PathKind, Side};
use super::system::{System, Topic};
use super::turns::abreast;
use super::{Compare, Figures};

/// Name of the path in figures.
const PATH: &str = "roam";
/// The address that the left place moves to, in the network of the other.
const NEW_ADDRESS: &str = "10.77.0.77";
const BITS_PREFIX: u8 = 24;

const TOPIC: Topic = Topic { name: "/state", towards: Side::Right, reliable: true };
const PER_SECOND: f64 = 50.0;
const BYTES: usize = 700;
/// Flows before the address changes.
const CALM: Duration = Duration::from_secs(2);
/// Duration of the flow after the change. A system that takes longer to come back counts as gone.
const SECONDS_AFTER: f64 = 25.0;
const QUICK_SECONDS_AFTER: f64 = 4.0;
/// Time without a message after which all messages in flight have arrived.
const QUIET_SECONDS: f64 = 5.0;
const CONNECT_MAX: Duration = Duration::from_secs(30);
/// How much longer something may take than it says.
const SPARE: Duration = Duration::from_secs(60);

/// Returns settings for users of the Zenoh bridge: it notices silence earlier than after ten seconds, and reconnects
/// earlier.
fn zenoh_tuning() -> Value {
    json!({
        "transport": { "link": { "tx": { "lease": 2000 } } },
        "connect": { "retry": { "period_init_ms": 100, "period_max_ms": 500 } },
    })
}

/// Measures it: all systems at the same time, since fifty short messages a second are nothing to a machine.
pub(crate) fn run(compare: &Compare, figures: &mut Figures) -> Result<()> {
    let systems = compare.configured(&[], zenoh_tuning())?;
    let names: Vec<_> = systems.iter().map(|system| system.name()).collect();
    compare.note(&format!("roaming: {}", names.join(", ")));
    let measured = abreast(&systems, |system| {
        let mut figures = Figures::default();
        if let Err(error) = measure(compare, &**system, &mut figures) {
            figures.leave_out(&format!("roaming {}", system.name()), format!("{error:#}"));
        }
        figures
    });
    measured.into_iter().for_each(|its| figures.append(its));
    Ok(())
}

fn measure(compare: &Compare, system: &dyn System, figures: &mut Figures) -> Result<()> {
    let lab = Lab::new(PathKind::Bare, compare.load())?;
    let running = system.start(&lab, &[TOPIC])?;
    // All is kept until it is acknowledged, so that nothing is lost before it meets the system.
    let args = ["--topic", TOPIC.name, "--reliable", "--depth", "0"];
    let mut sink = lab.load(&running, TOPIC.towards, &[&["sink"][..], &args].concat())?;
    sink.soon("up")?;
    let mut source = lab.load(&running, TOPIC.towards.other(), &[&["source"][..], &args].concat())?;
    sink.until("connected", CONNECT_MAX)?;
    let seconds = CALM.as_secs_f64() + if compare.is_quick() { QUICK_SECONDS_AFTER } else { SECONDS_AFTER };
    let old = lab.address(Side::Left).to_string();
    for (run, [from, to]) in [(1, [&*old, NEW_ADDRESS]), (2, [NEW_ADDRESS, &*old])] {
        source.order(&json!({ "send": {
            "run": run, "size": BYTES, "count": u32::MAX, "seconds": seconds, "rate": PER_SECOND,
        }}))?;
        sleep(CALM);
        let address = |what, address| {
            let address = format!("{address}/{BITS_PREFIX}");
            lab.place(Side::Left).ip(&["address", what, &address, "dev", INTERFACE])
        };
        address("del", from)?;
        address("add", to)?;
        let sent = source.until("sent", Duration::from_secs_f64(seconds) + SPARE)?;
        let last = sent["count"].as_u64().context("no count of what was sent")?;
        sink.order(&json!({ "count": { "run": run, "last": last, "quiet_seconds": QUIET_SECONDS } }))?;
        let counted = sink.until("counted", SPARE)?;
        let heard = counted["received"][0].as_u64().context("no count of what came")?;
        let ns = |value: &Value, what| value[what].as_u64().context("no time");
        // A flow that never came back was silent until the last message was sent.
        let heard_until = ns(&counted, "ended_ns")?.max(ns(&sent, "begun_ns")?);
        let unheard_us = ns(&sent, "ended_ns")?.saturating_sub(heard_until) as f64 / 1e3;
        let silence_us = counted["silence_us"].as_f64().context("no silence")?.max(unheard_us);
        let mut push = |metric, value| {
            figures.push("roaming", &system.name(), PATH, f64::from(run - 1), metric, value);
        };
        // Between two messages it is always silent.
        push("outage_us", (silence_us - 1e6 / PER_SECOND).max(0.0));
        push("sent", last as f64);
        push("lost", last.saturating_sub(heard) as f64);
        push("came_back", f64::from(u8::from(unheard_us < 1e6)));
    }
    Ok(())
}
