//! Measures the resident memory of a router's process by the number of its idle links, each to a node of its own.

use std::time::{Duration, Instant};

use anyhow::{Result, ensure};
use serde::Serialize;

use crate::RunArgs;
use crate::fleet::BenchFleet;
use crate::process::{PATIENCE, SgcRouter};
use crate::report::{Report, Table, digits};
use crate::rib::LinkedOwners;
use crate::uplink;

const LINKS: usize = 256;
const LINKS_QUICK: usize = 16;
/// Time between the last handshake and the measurement: what handshakes took is given back.
const REST: Duration = Duration::from_secs(5);

#[derive(Serialize)]
struct Figures {
    transport: String,
    links: usize,
    before_bytes: u64,
    after_bytes: u64,
}

/// Measures it.
pub(crate) fn run(args: &RunArgs) -> Result<Report> {
    let links = if args.quick { LINKS_QUICK } else { LINKS };
    let figures: Vec<_> = uplink::known(&args.schemes)
        .iter()
        .map(|scheme| measure(scheme, links, args))
        .collect::<Result<_>>()?;
    let row = |f: &Figures| {
        let each = f.after_bytes.saturating_sub(f.before_bytes) as f64 / f.links as f64;
        let mb = |bytes: u64| digits(bytes as f64 / 1e6);
        vec![f.transport.clone(), mb(f.before_bytes), mb(f.after_bytes), digits(each / 1e3)]
    };
    let table = Table {
        title: format!("Memory of a router with {links} idle links, resident"),
        columns: vec!["transport", "without links, MB", "with them, MB", "a link, kB"],
        rows: figures.iter().map(row).collect(),
    };
    Report::new(&figures, vec![table])
}

fn measure(scheme: &str, links: usize, args: &RunArgs) -> Result<Figures> {
    let (fleet, dir) = (BenchFleet::new()?, tempfile::tempdir()?);
    fleet.write_router(dir.path())?;
    let router = SgcRouter::start_on(scheme, &args.sgc, dir.path())?;
    std::thread::sleep(REST);
    let before_bytes = router.process.resident_bytes();
    let _nodes = LinkedOwners::connect(&router.url, &fleet, 0..links)?;
    let begun = Instant::now();
    while router.links()? < links {
        ensure!(begun.elapsed() < PATIENCE, "{} of {links} links are up", router.links()?);
        std::thread::sleep(Duration::from_millis(50));
    }
    std::thread::sleep(REST);
    ensure!(router.links()? == links, "links ended");
    let after_bytes = router.process.resident_bytes();
    Ok(Figures { transport: scheme.to_owned(), links, before_bytes, after_bytes })
}
