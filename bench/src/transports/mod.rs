//! Links by every transport, beside plain TCP and TLS 1.3 as rustls does it: throughput, round trips, CPU time, memory,
//! and a message of 13 MB over a path that loses packets.
//!
//! The near end is in this process and the far end in one of its own, so that their CPU time and memory can be told
//! apart. All ways stay up and take turns. No node and no routing is in it: [`crate::forward`] has those.

mod links;
mod raw;
pub(crate) mod router;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use clap::Args;
use serde::{Deserialize, Serialize};
use sgc_testkit::netsim::{Loss, Namespace, Profile, on_host};

use crate::RunArgs;
use crate::process::{Server, own_cpu_seconds, own_resident_bytes};
use crate::report::{Report, Spread, Table, digits, median};
use crate::uplink::{self, FAR, Uplink};

const SIZES: [usize; 5] = [100, 1_000, 64_000, 1_000_000, 13_000_000];
/// The message of the part with losses.
const LARGE: usize = 13_000_000;
const LOSSES: [f64; 4] = [0.0, 0.01, 0.05, 0.10];
/// A transfer that takes longer counts as one that never ends.
const NEVER: Duration = Duration::from_secs(30);
/// Links by which memory is told, and those that are there before.
const MEMORY_LINKS: usize = 100;
const MEMORY_LINKS_BEFORE: usize = 10;
const PORT: u16 = 7447;

/// The far end of a way.
#[derive(Args)]
pub(crate) struct ServeArgs {
    /// A scheme, or one of [`RAW`]
    kind: String,
    /// Address to listen on
    listen: String,
    /// Directory of the credentials
    dir: PathBuf,
}

/// The arguments of the process whose memory is measured.
#[derive(Args)]
pub(crate) struct MemoryArgs {
    /// A scheme, or one of [`RAW`]
    kind: String,
    /// Number of links
    links: usize,
    /// Directory of the credentials
    dir: PathBuf,
}

/// Ways without links.
const RAW: [&str; 2] = [raw::TCP, raw::TLS];

/// One connection to a far end.
trait Wire {
    /// Sends so many messages of this size, one behind the other; returns when the far end says that it has the last.
    fn send(&mut self, bytes: usize, messages: u64) -> Result<()>;
}

/// The address at which the ends meet, and the directory of their credentials.
struct Place<'a> {
    dir: &'a Path,
    /// The namespaces of the near and the far end; none is this one.
    homes: Option<(&'a Arc<Namespace>, &'a Arc<Namespace>)>,
}

impl Place<'_> {
    /// A far end.
    fn serve(&self, kind: &str) -> Result<Server> {
        let program = std::env::current_exe()?;
        let (mut command, listen) = match self.homes {
            Some((_, far)) => (far.command(program), format!("{FAR}:{PORT}")),
            None => (std::process::Command::new(program), "127.0.0.1:0".to_owned()),
        };
        Server::start(command.arg("serve-links").arg(kind).arg(listen).arg(self.dir))
            .with_context(|| format!("the far end of {kind}"))
    }

    /// Something that connects to it.
    fn caller(&self, kind: &str, server: &Server) -> Result<Box<dyn Caller>> {
        let near = self.homes.map(|(near, _)| Arc::clone(near));
        Ok(if RAW.contains(&kind) {
            Box::new(raw::RawCaller::new(kind, &server.greeting, self.dir, near)?)
        } else {
            Box::new(links::LinkCaller::new(&server.greeting, self.dir, near)?)
        })
    }
}

/// Makes connections to one far end.
trait Caller {
    fn call(&self) -> Result<Box<dyn Wire>>;
}

/// The figures of one protocol at one size.
#[derive(Serialize)]
struct SizeFigures {
    transport: String,
    bytes: usize,
    mbyte_per_second: f64,
    /// CPU time, seconds for 1e9 bytes of messages.
    near_cpu_s_per_gb: f64,
    far_cpu_s_per_gb: f64,
    /// From the beginning of a message until the far end's answer to it, microseconds.
    round_trip_us: Spread,
}

#[derive(Deserialize, Serialize)]
struct MemoryFigures {
    transport: String,
    near_kb_per_link: f64,
    far_kb_per_link: f64,
}

#[derive(Serialize)]
struct LossFigures {
    transport: String,
    loss_percent: f64,
    /// Duration of each transfer in milliseconds; `None` if it took longer than half a minute.
    transfers_ms: Vec<Option<f64>>,
    median_ms: Option<f64>,
}

#[derive(Serialize)]
struct Figures {
    sizes: Vec<SizeFigures>,
    memory: Vec<MemoryFigures>,
    losses: Vec<LossFigures>,
}

/// Measures everything.
pub(crate) fn run(args: &RunArgs) -> Result<Report> {
    let dir = tempfile::tempdir()?;
    links::write_credentials(dir.path())?;
    raw::write_credentials(dir.path())?;
    let mut kinds: Vec<String> = RAW.iter().map(|kind| (*kind).to_owned()).collect();
    kinds.extend(uplink::known(&args.schemes));
    let place = Place { dir: dir.path(), homes: None };
    let sizes = measure_sizes(&place, &kinds, args.quick)?;
    let links = if args.quick { 10 } else { MEMORY_LINKS };
    let memory = kinds.iter().map(|kind| memory_of(kind, dir.path(), links)).collect::<Result<_>>()?;
    let losses = match on_host() {
        Ok(()) => measure_losses(dir.path(), &kinds, args.quick)?,
        Err(why) => {
            eprintln!("no path with losses: {why}");
            Vec::new()
        }
    };
    let figures = Figures { sizes, memory, losses };
    let tables = vec![size_table(&figures), memory_table(&figures), loss_table(&figures, &kinds)];
    Report::new(&figures, tables)
}

struct Way {
    kind: String,
    server: Server,
    wire: Box<dyn Wire>,
    /// Keeps the link's sockets open.
    _caller: Box<dyn Caller>,
}

fn measure_sizes(place: &Place<'_>, kinds: &[String], quick: bool) -> Result<Vec<SizeFigures>> {
    let (rounds, time) =
        if quick { (1, Duration::from_millis(100)) } else { (3, Duration::from_millis(1000)) };
    let mut ways = Vec::new();
    for kind in kinds {
        let server = place.serve(kind)?;
        let caller = place.caller(kind, &server)?;
        let wire = caller.call().with_context(|| kind.clone())?;
        ways.push(Way { kind: kind.clone(), server, wire, _caller: caller });
    }
    let mut figures = Vec::new();
    for bytes in SIZES {
        let trips = if quick { 5 } else { (20_000_000 / bytes).clamp(10, 500) };
        let mut measured: Vec<_> = ways.iter().map(|_| (Vec::new(), Vec::new())).collect();
        for round in 0..rounds {
            for turn in 0..ways.len() {
                // Whoever follows may find the machine in another state: they change places.
                let at = (round + turn) % ways.len();
                let way = &mut ways[at];
                let what = || format!("{}, {bytes} bytes", way.kind);
                let rush = rush(&mut *way.wire, &way.server, bytes, time).with_context(what)?;
                measured[at].0.push(rush);
                for _ in 0..trips {
                    let begun = Instant::now();
                    way.wire.send(bytes, 1)?;
                    measured[at].1.push(begun.elapsed().as_secs_f64() * 1e6);
                }
            }
        }
        for (way, (rushes, trips)) in ways.iter().zip(measured) {
            figures.push(SizeFigures {
                transport: way.kind.clone(),
                bytes,
                mbyte_per_second: median(rushes.iter().map(|r| r.bytes_per_second / 1e6)),
                near_cpu_s_per_gb: median(rushes.iter().map(|r| r.near_cpu_s_per_gb)),
                far_cpu_s_per_gb: median(rushes.iter().map(|r| r.far_cpu_s_per_gb)),
                round_trip_us: Spread::from_samples(trips),
            });
        }
    }
    Ok(figures)
}

struct Rush {
    bytes_per_second: f64,
    near_cpu_s_per_gb: f64,
    far_cpu_s_per_gb: f64,
}

/// As fast as it goes, for about so long.
fn rush(wire: &mut dyn Wire, server: &Server, bytes: usize, time: Duration) -> Result<Rush> {
    // How many that are.
    let mut messages = 1;
    let took = loop {
        let begun = Instant::now();
        wire.send(bytes, messages)?;
        let took = begun.elapsed();
        if took * 10 > time {
            break took;
        }
        messages *= 2;
    };
    let mut messages = ((messages as f64 * time.as_secs_f64() / took.as_secs_f64()) as u64).max(1);
    let cpu = || (own_cpu_seconds(), server.cpu_seconds());
    let (before, took, after) = loop {
        let (before, begun) = (cpu(), Instant::now());
        wire.send(bytes, messages)?;
        let (took, after) = (begun.elapsed(), cpu());
        // The machine may have been busy while it was tried how many those are.
        if took * 2 > time {
            break (before, took, after);
        }
        messages *= 2;
    };
    let gb = (bytes as u64 * messages) as f64 / 1e9;
    Ok(Rush {
        bytes_per_second: gb * 1e9 / took.as_secs_f64(),
        near_cpu_s_per_gb: (after.0 - before.0) / gb,
        far_cpu_s_per_gb: (after.1 - before.1) / gb,
    })
}

/// Asks a process of its own, in which no memory is left over from something else.
fn memory_of(kind: &str, dir: &Path, links: usize) -> Result<MemoryFigures> {
    let mut command = std::process::Command::new(std::env::current_exe()?);
    command.arg("measure-links").arg(kind).arg(links.to_string()).arg(dir);
    let output = command.stderr(std::process::Stdio::inherit()).output()?;
    ensure!(output.status.success(), "memory of {kind}: {}", output.status);
    Ok(serde_json::from_slice(&output.stdout)?)
}

/// Measures the memory at each end of a link that has carried data.
pub(crate) fn measure_memory_here(args: &MemoryArgs) -> Result<()> {
    let MemoryArgs { kind, links, dir } = args;
    let place = Place { dir, homes: None };
    let server = place.serve(kind)?;
    let caller = place.caller(kind, &server)?;
    let call = || {
        let mut wire = caller.call()?;
        wire.send(1000, 1)?;
        Ok::<_, anyhow::Error>(wire)
    };
    let _before: Vec<_> = (0..MEMORY_LINKS_BEFORE).map(|_| call()).collect::<Result<_>>()?;
    let resident = || (own_resident_bytes() as f64, server.resident_bytes() as f64);
    let before = resident();
    let _wires: Vec<_> = (0..*links).map(|_| call()).collect::<Result<_>>()?;
    let after = resident();
    let each = |before: f64, after: f64| (after - before) / *links as f64 / 1e3;
    let figures = MemoryFigures {
        transport: kind.clone(),
        near_kb_per_link: each(before.0, after.0),
        far_kb_per_link: each(before.1, after.1),
    };
    println!("{}", serde_json::to_string(&figures)?);
    Ok(())
}

/// A large message as the first on a new link, over a path that loses packets in both directions.
fn measure_losses(dir: &Path, kinds: &[String], quick: bool) -> Result<Vec<LossFigures>> {
    let rounds = if quick { 1 } else { 5 };
    let mut figures = Vec::new();
    for loss in LOSSES {
        let profile = Profile { loss: Loss::Random(loss), ..Profile::default() };
        let uplink = Uplink::new([profile; 2])?;
        let place = Place { dir, homes: Some((&uplink.near, &uplink.far)) };
        let mut transfers = vec![Vec::new(); kinds.len()];
        for _ in 0..rounds {
            for (kind, transfers) in kinds.iter().zip(&mut transfers) {
                let server = place.serve(kind)?;
                let caller = place.caller(kind, &server)?;
                let mut wire = caller.call().with_context(|| format!("{kind} at {loss} loss"))?;
                let begun = Instant::now();
                let took = wire.send(LARGE, 1).map(|()| begun.elapsed().as_secs_f64() * 1e3);
                if let Err(error) = &took {
                    eprintln!("{kind} at {} % loss: {error:#}", loss * 100.0);
                }
                transfers.push(took.ok());
            }
        }
        for (kind, transfers_ms) in kinds.iter().zip(transfers) {
            let mut sorted: Vec<_> = transfers_ms.iter().map(|ms| ms.unwrap_or(f64::INFINITY)).collect();
            sorted.sort_unstable_by(f64::total_cmp);
            let median_ms = Some(sorted[sorted.len() / 2]).filter(|ms| ms.is_finite());
            figures.push(LossFigures {
                transport: kind.clone(),
                loss_percent: loss * 100.0,
                transfers_ms,
                median_ms,
            });
        }
    }
    Ok(figures)
}

fn size_table(figures: &Figures) -> Table {
    let row = |f: &SizeFigures| {
        vec![
            f.transport.clone(),
            f.bytes.to_string(),
            digits(f.mbyte_per_second),
            digits(f.near_cpu_s_per_gb),
            digits(f.far_cpu_s_per_gb),
            format!("{} / {}", digits(f.round_trip_us.p50), digits(f.round_trip_us.p99)),
        ]
    };
    Table {
        title: "Messages over one link, loopback".into(),
        columns: vec![
            "transport",
            "bytes",
            "MB/s",
            "sender CPU, s/GB",
            "receiver CPU, s/GB",
            "answered after p50 / p99, µs",
        ],
        rows: figures.sizes.iter().map(row).collect(),
    }
}

fn memory_table(figures: &Figures) -> Table {
    let row =
        |f: &MemoryFigures| vec![f.transport.clone(), digits(f.near_kb_per_link), digits(f.far_kb_per_link)];
    Table {
        title: "Memory of an idle link, resident, kB".into(),
        columns: vec!["transport", "who dials", "who listens"],
        rows: figures.memory.iter().map(row).collect(),
    }
}

fn loss_table(figures: &Figures, kinds: &[String]) -> Table {
    let of = |kind: &str, loss: f64| {
        let loss = loss * 100.0;
        let found = figures.losses.iter().find(|f| f.transport == kind && f.loss_percent == loss);
        found.map(|f| f.median_ms)
    };
    let cell = |kind: &String, loss: f64| match (of(kind, loss), of(raw::TCP, loss)) {
        (Some(Some(ms)), Some(Some(tcp))) => format!("{} ({} ×)", digits(ms), digits(ms / tcp)),
        (Some(Some(ms)), _) => digits(ms),
        (Some(None), _) => "never".into(),
        (None, _) => String::new(),
    };
    let row = |kind: &String| {
        let cells = LOSSES.iter().map(|loss| cell(kind, *loss));
        std::iter::once(kind.clone()).chain(cells).collect()
    };
    Table {
        title: "13 MB as the first message of a link, by packets lost, ms (× kernel TCP)".into(),
        columns: vec!["transport", "0 %", "1 %", "5 %", "10 %"],
        rows: kinds.iter().map(row).collect(),
    }
}

/// The far end, until standard input ends.
pub(crate) fn serve(args: &ServeArgs) -> Result<()> {
    std::thread::spawn(|| {
        crate::process::until_stdin_closes();
        std::process::exit(0);
    });
    if RAW.contains(&args.kind.as_str()) {
        raw::serve(&args.kind, &args.listen, &args.dir)?;
    } else {
        links::serve(&args.kind, &args.listen, &args.dir)?;
    }
    bail!("nobody comes any more")
}
