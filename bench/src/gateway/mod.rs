//! `gateway`: programs without ROS beside a DDS program, through one `sgc run` with `[gateway]`: round trips and
//! messages as fast as they go, by each protocol and encoding.
//!
//! [`scene`] starts the measured node, [`client`] is the program without ROS, [`measure`] times it, [`goals`] and
//! [`figures`] hold the results.

mod client;
mod figures;
mod goals;
mod measure;
mod scene;

use std::fs;
use std::iter;
use std::path::PathBuf;

use anyhow::{Context, Result};
use clap::Args;

use crate::report::Report;
use client::Way;
use figures::{Figure, tables};
use measure::{Plan, down, round_trip, up};
use scene::Scene;

/// Bytes of a message's content, as in `compare`: CDR's own 8 are not counted.
const SIZES: [usize; 4] = [16, 1000, 8 << 10, 1 << 20];
/// Size of messages at which the paper measured rosbridge.
const REFERENCE_BYTES: usize = 1000;
/// Number of measurements of each.
const ROUNDS: usize = 3;

/// The arguments of `gateway`.
#[derive(Args, Clone, Debug)]
pub(crate) struct GatewayArgs {
    /// The program that is measured
    #[arg(long, value_name = "FILE", default_value = "target/release/sgc")]
    sgc: PathBuf,
    /// The program that talks and listens; without it the `load` beside this one
    #[arg(long, value_name = "FILE")]
    load: Option<PathBuf>,
    /// Directory for the results
    #[arg(long, value_name = "DIR", default_value = concat!(env!("CARGO_MANIFEST_DIR"), "/results"))]
    out: PathBuf,
    /// These ways alone: rosbridge-json, rosbridge-cbor-raw, grpc-cdr, grpc-json
    #[arg(long, value_name = "WAY,…", value_delimiter = ',')]
    ways: Vec<String>,
    /// These sizes alone, bytes
    #[arg(long, value_name = "N,…", value_delimiter = ',', default_values_t = SIZES)]
    sizes: Vec<usize>,
    /// A short run that shows that all parts work; its figures mean little
    #[arg(long)]
    quick: bool,
}

/// Measures, prints, and writes `gateway.json` and `gateway.md` unless the run is a short one.
pub(crate) fn run(args: &GatewayArgs) -> Result<()> {
    let load = match &args.load {
        Some(load) => load.clone(),
        None => std::env::current_exe()?.with_file_name("load"),
    };
    let load = load.canonicalize().with_context(|| format!("{}: is it built?", load.display()))?;
    let scene = Scene::start(&args.sgc, &load)?;
    // One thread, as most such programs have.
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let wanted = |way: &Way| args.ways.is_empty() || args.ways.iter().any(|name| name == way.name());
    let mut figures: Vec<Figure> = Vec::new();
    for round in 0..if args.quick { 1 } else { ROUNDS } {
        for way in Way::ALL.into_iter().filter(wanted) {
            for &size in args.sizes.iter().filter(|&&size| way.has(size)) {
                let plan = Plan::for_size(size, args.quick);
                progress(&format!("round {round}: {}, {size} B", way.name()));
                let measured = runtime.block_on(async {
                    Ok::<_, anyhow::Error>((
                        round_trip(&scene, way, size, &plan).await.context("round trips")?,
                        down(&scene, way, size, &plan).await.context("to the client")?,
                        up(&scene, way, size, &plan).await.context("from the client")?,
                    ))
                });
                let measured = measured.with_context(|| format!("{}, {size} B", way.name()))?;
                Figure::add(&mut figures, way, size, measured);
            }
        }
    }
    let tables = iter::once(goals::table(&figures)).chain(tables(&figures)).collect();
    let report = Report::new(&figures, tables)?;
    report.print();
    if args.quick {
        return Ok(());
    }
    report.write(&args.out, "gateway")?;
    let path = args.out.join("gateway.md");
    fs::write(&path, format!("# Programs without ROS\n\n{}", report.markdown()))
        .with_context(|| path.display().to_string())
}

fn progress(what: &str) {
    eprintln!("{what}");
}
