//! Measures the cost of a name at the router: time to publish it, time to subscribe to it, memory.
//!
//! Each size is measured twice: in the routing machine alone, with frames as they come off a link (in a process of its
//! own, so that its memory can be told), and over real links into a router's process. The machine's work is told apart
//! into verifying, which grows with signatures, and all the rest, which could grow with names.

mod frames;
mod machine;
mod socket;

pub(crate) use frames::{BATCH, Member};
pub(crate) use socket::{LinkedOwners, Neighbour};

use std::process::Command;
use std::time::Instant;

use anyhow::{Context, Result, ensure};
use rand_chacha::ChaCha20Rng;
use rand_core::SeedableRng as _;
use serde::{Deserialize, Serialize};
use sgc_router::LinkId;

use crate::RunArgs;
use crate::fleet::{BenchFleet, now};
use crate::process::{memory_kib, own_resident_bytes};
use crate::report::{Report, Spread, Table, digits};
use frames::NAMES_PER_OWNER;
use machine::Machine;

/// More than one takes in memory; what does not fit is left out rather than swapped.
const BYTES_PER_NAME_EXPECTED: u64 = 1000;
/// Nodes that subscribe, in turns.
const JOINERS: usize = 16;
/// One in this many advertisements is verified once more separately, to time that.
const VERIFIED_EVERY: usize = 16;
/// Most names with which real links are measured.
const SOCKET_NAMES_MAX: usize = 1_000_000;

/// The figures of one size in the machine.
#[derive(Serialize, Deserialize)]
struct InMachine {
    names: usize,
    bytes_per_name: f64,
    /// While the router was filled, by advertisements of 256 names: microseconds a name.
    batched_us_per_name: Spread,
    batched_verify_us_per_name: Spread,
    /// One advertisement of one more name, microseconds.
    publish_us: Spread,
    publish_verify_us: Spread,
    /// A request to join and the owner's answer, microseconds.
    subscribe_us: Spread,
    subscribe_verify_us: Spread,
}

/// Measures all sizes.
pub(crate) fn run(args: &RunArgs) -> Result<Report> {
    let samples = if args.quick { 200 } else { 4000 };
    let (mut machines, mut sockets) = (Vec::new(), Vec::new());
    // A quick run is one of the smallest size.
    let smallest = args.names.iter().copied().min().unwrap_or_default();
    for &names in args.names.iter().filter(|n| !args.quick || **n == smallest) {
        let needed_kib = names as u64 * BYTES_PER_NAME_EXPECTED / 1024;
        if needed_kib > memory_kib("MemAvailable") {
            eprintln!("{names} names are left out: they may need {} MiB of memory", needed_kib / 1024);
            continue;
        }
        let arguments = [names.to_string(), samples.to_string()];
        let output = Command::new(std::env::current_exe()?)
            .arg("measure-rib")
            .args(arguments)
            .stderr(std::process::Stdio::inherit())
            .output()?;
        ensure!(output.status.success(), "{names} names: {}", output.status);
        machines.push(serde_json::from_slice::<InMachine>(&output.stdout).context("its figures")?);
        if names <= SOCKET_NAMES_MAX {
            sockets.push(socket::run(&args.sgc, names)?);
        }
    }
    let tables = vec![machine_table(&machines), socket::table(&sockets)];
    Report::new(&serde_json::json!({ "machine": machines, "sockets": sockets }), tables)
}

/// Measures one size and prints the figures, for [`run`].
pub(crate) fn measure_here(names: usize, samples: usize) -> Result<()> {
    println!("{}", serde_json::to_string(&measure(names, samples)?)?);
    Ok(())
}

fn measure(names: usize, samples: usize) -> Result<InMachine> {
    let mut rng = ChaCha20Rng::seed_from_u64(1);
    let fleet = BenchFleet::new()?;
    let mut machine = Machine::new(&fleet.issue("router", true)?, now());
    // Somebody to pass advertisements on to.
    let neighbour = fleet.issue("neighbour", true)?;
    machine.attach(neighbour.as_peer(), true)?;
    let attach = |machine: &mut Machine, name: String| -> Result<Member<LinkId>> {
        let identity = fleet.issue(&name, false)?;
        let link = machine.attach(identity.as_peer(), false)?;
        Ok(Member::new(identity, link))
    };
    let mut owners = Vec::new();
    for n in 0..names.div_ceil(NAMES_PER_OWNER) {
        owners.push(attach(&mut machine, format!("owner-{n}"))?);
    }
    let mut joiners = Vec::new();
    for n in 0..JOINERS {
        joiners.push(attach(&mut machine, format!("joiner-{n}"))?);
    }

    let before = own_resident_bytes();
    let begun_with = machine.routed_names();
    let (mut batched, mut verified, mut targets) = (Vec::new(), Vec::new(), Vec::new());
    let per_owner = names.div_ceil(owners.len());
    let mut left = names;
    for (n, owner) in owners.iter_mut().enumerate() {
        let mut own = per_owner.min(left);
        left -= own;
        while own > 0 {
            let frame = owner.advert(own.min(frames::BATCH), machine.unix(), &mut rng);
            own -= frame.names.len();
            if targets.len() * names < samples * (names - left) {
                targets.push((n, frame.names[0]));
            }
            if verified.len() * frames::BATCH * VERIFIED_EVERY < names - left {
                verified.push(machine.verify(&frame.bytes)? / frame.names.len() as f64);
            }
            batched.push(machine.feed(owner.link, &frame.bytes)?.micros() / frame.names.len() as f64);
        }
    }
    ensure!(machine.routed_names() - begun_with == names, "the router does not know all names");
    let bytes = own_resident_bytes().saturating_sub(before);

    let (mut publish, mut publish_verify) = (Vec::new(), Vec::new());
    for n in 0..samples {
        let places = owners.len();
        let owner = &mut owners[n % places];
        let frame = owner.advert(1, machine.unix(), &mut rng);
        publish_verify.push(machine.verify(&frame.bytes)?);
        publish.push(machine.feed(owner.link, &frame.bytes)?.micros());
    }

    let (mut subscribe, mut subscribe_verify) = (Vec::new(), Vec::new());
    for n in 0..samples {
        let (owner, name) = targets[n * 7919 % targets.len()];
        let (owner, joiner) = (&owners[owner], &joiners[n % JOINERS]);
        let (sink, join) = joiner.join(name, machine.unix(), &mut rng);
        let answer = owner.answer(name, sink, &mut rng);
        let verify = machine.verify(&join)? + machine.verify_answer(owner.identity.as_peer(), &answer)?;
        subscribe_verify.push(verify);
        let begun = Instant::now();
        let asked = machine.feed(joiner.link, &join)?;
        let answered = machine.feed(owner.link, &answer)?;
        subscribe.push(begun.elapsed().as_secs_f64() * 1e6);
        ensure!(asked.went_to(owner.link) && answered.went_to(joiner.link), "a subscription goes astray");
    }
    Ok(InMachine {
        names,
        bytes_per_name: bytes as f64 / names as f64,
        batched_us_per_name: Spread::from_samples(batched),
        batched_verify_us_per_name: Spread::from_samples(verified),
        publish_us: Spread::from_samples(publish),
        publish_verify_us: Spread::from_samples(publish_verify),
        subscribe_us: Spread::from_samples(subscribe),
        subscribe_verify_us: Spread::from_samples(subscribe_verify),
    })
}

fn machine_table(all: &[InMachine]) -> Table {
    let row = |f: &InMachine| {
        let rest = |all: &Spread, verify: &Spread| digits((all.p50 - verify.p50).max(0.0));
        vec![
            f.names.to_string(),
            digits(f.bytes_per_name),
            format!("{} / {}", digits(f.batched_us_per_name.p50), digits(f.batched_us_per_name.p99)),
            digits(f.batched_verify_us_per_name.p50),
            format!("{} / {}", digits(f.publish_us.p50), digits(f.publish_us.p99)),
            digits(f.publish_verify_us.p50),
            rest(&f.publish_us, &f.publish_verify_us),
            format!("{} / {}", digits(f.subscribe_us.p50), digits(f.subscribe_us.p99)),
            digits(f.subscribe_verify_us.p50),
            rest(&f.subscribe_us, &f.subscribe_verify_us),
        ]
    };
    Table {
        title: "The routing machine alone, µs".into(),
        columns: vec![
            "names",
            "bytes a name",
            "publish 256 at once, a name: p50 / p99",
            "verifying",
            "publish one: p50 / p99",
            "verifying",
            "the rest",
            "subscribe: p50 / p99",
            "verifying",
            "the rest",
        ],
        rows: all.iter().map(row).collect(),
    }
}
