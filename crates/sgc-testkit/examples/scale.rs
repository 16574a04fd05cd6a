//! Measures how the control protocol scales with routers and names: `make scale`.
//!
//! It simulates growing networks of bare routers ([`sgc_testkit::mesh`]) and prints a table for each kind of event.
//! Times in the tables are of the virtual clock; processor times are of this machine. `--full` goes to 1000 routers,
//! 100 000 flooded names and a million queried ones. `--sizes 10,30` and `--only flood`, `query` or `store` select parts; `--csv
//! DIR` also writes the tables there.
#![allow(clippy::print_stdout, reason = "the tables are what it is for")]

use std::path::PathBuf;
use std::time::Duration;

use sgc_router::{LinkId, LinkQuality, MappingKind, Output};
use sgc_testkit::mesh::{BATCH_NAMES, Mesh, Tally};
use sgc_testkit::{CountingAllocator, Member, identity, live_bytes};
use sgc_trust::verify_link_state;
use sgc_wire::{Adjacency, LinkStateBody, Name, NodeId, Now};

/// Batches of an owner in the flood tables.
const FLOOD_BATCHES: usize = 4;
/// Batches of an owner in the query tables.
const QUERY_BATCHES: usize = 16;
/// Queried names per router.
const QUERY_NAMES_PER_ROUTER: usize = 1000;
/// Questions for names of different owners.
const QUESTIONS: usize = 10;
/// Number of timed searches and link states.
const TIMED: u32 = 50;

#[global_allocator]
static COUNTING: CountingAllocator = CountingAllocator;

/// Returns the processor time of this thread.
fn cpu() -> Duration {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    Duration::new(time.tv_sec as u64, time.tv_nsec as u32)
}

/// A table, printed row by row.
struct Table {
    file: &'static str,
    head: &'static [&'static str],
    rows: Vec<Vec<String>>,
}

impl Table {
    fn new(file: &'static str, head: &'static [&'static str]) -> Self {
        Self { file, head, rows: Vec::new() }
    }

    fn row(&mut self, cells: Vec<String>) {
        eprint_row(self.file, &cells);
        self.rows.push(cells);
    }

    fn markdown(&self) -> String {
        let line = |cells: &[String]| format!("| {} |\n", cells.join(" | "));
        let head: Vec<_> = self.head.iter().map(|h| (*h).to_owned()).collect();
        let rule = format!("|{}\n", "---|".repeat(head.len()));
        line(&head) + &rule + &self.rows.iter().map(|r| line(r)).collect::<String>()
    }

    fn csv(&self) -> String {
        let rows: String = self.rows.iter().map(|r| r.join(",") + "\n").collect();
        self.head.join(",") + "\n" + &rows
    }
}

#[allow(clippy::print_stderr, reason = "long runs should show that they live")]
fn eprint_row(file: &str, cells: &[String]) {
    eprintln!("{:6.0} s  {file}: {}", cpu().as_secs_f64(), cells.join(" "));
}

struct Tables {
    cold: Table,
    events: Table,
    flood: Table,
    query: Table,
    store: Table,
    hub: Table,
}

impl Tables {
    fn new() -> Self {
        Self {
            cold: Table::new(
                "cold",
                &[
                    "routers",
                    "links",
                    "hops at most",
                    "ways final after ms",
                    "last frame after ms",
                    "frames a router",
                    "KB a router",
                    "CPU ms a router",
                    "searches a router",
                    "KB held",
                    "a search µs",
                ],
            ),
            events: Table::new(
                "events",
                &[
                    "routers",
                    "event",
                    "ways final after ms",
                    "last frame after ms",
                    "frames",
                    "frames a router",
                    "KB a router",
                    "CPU µs a router",
                    "searches a router",
                ],
            ),
            flood: Table::new(
                "flood",
                &[
                    "routers",
                    "names",
                    "last frame after ms",
                    "frames a batch",
                    "frames a batch and link",
                    "KB a batch and router",
                    "CPU µs a name and router",
                    "KB held",
                    "bytes held a name",
                    "frames: an owner of 1000 roams",
                ],
            ),
            query: Table::new(
                "query",
                &[
                    "routers",
                    "names",
                    "what",
                    "answered after ms",
                    "questions",
                    "adverts",
                    "link states",
                    "other frames",
                    "KB in all",
                    "names held elsewhere",
                    "routers that hold some",
                ],
            ),
            store: Table::new(
                "store",
                &[
                    "routers",
                    "names",
                    "what",
                    "answered after ms",
                    "reads",
                    "writes",
                    "of names",
                    "questions",
                    "other frames",
                ],
            ),
            hub: Table::new("hub", &["proxies", "names that they wait for", "KB held", "a search µs"]),
        }
    }

    fn all(&self) -> [(&'static str, &Table); 6] {
        [
            ("Cold start", &self.cold),
            ("Changes", &self.events),
            ("`flood`", &self.flood),
            ("`query`", &self.query),
            ("`store`", &self.store),
            ("One router with many proxies", &self.hub),
        ]
    }
}

fn ms(time: Duration) -> String {
    format!("{:.0}", time.as_secs_f64() * 1e3)
}

fn per(n: f64, by: usize) -> String {
    let each = n / by.max(1) as f64;
    if each < 10.0 { format!("{each:.2}") } else { format!("{each:.0}") }
}

fn kb(bytes: u64, by: usize) -> String {
    per(bytes as f64 / 1e3, by)
}

/// Returns the bytes that the recorded router holds by itself.
fn held(mesh: &Mesh) -> i64 {
    let before = live_bytes();
    let router = mesh.recording().replay();
    let held = live_bytes() - before;
    drop(router);
    held
}

/// Lets a network settle from the start. Returns the cost.
fn cold_start(mesh: &mut Mesh) -> Tally {
    let probe = mesh.routers().len() / 2;
    mesh.record(probe);
    mesh.plug_all();
    let tally = mesh.settle();
    mesh.check(8);
    tally
}

fn event(table: &mut Table, mesh: &Mesh, what: &str, tally: &Tally) {
    let n = mesh.routers().len();
    table.row(vec![
        n.to_string(),
        what.to_owned(),
        ms(tally.ways),
        ms(tally.last_frame),
        tally.frames().to_string(),
        per(tally.frames() as f64, n),
        kb(tally.bytes(), n),
        per(tally.cpu.as_secs_f64() * 1e6, n),
        per(tally.searches as f64, n),
    ]);
}

/// Times a router's search for paths: reports a link as dead and as alive again.
fn search_time(mesh: &mut Mesh) -> Duration {
    let at = mesh.routers()[0];
    let mut router = mesh.take_router(at);
    let Now { mut instant, mut unix } = mesh.now();
    let (began, searches) = (cpu(), router.route_stats().searches);
    for n in 0..TIMED {
        instant += Duration::from_millis(200);
        unix.0 += 200;
        let now = Now { instant, unix };
        let quality = LinkQuality { is_silent: n % 2 == 0, ..LinkQuality::default() };
        router.handle_link_quality(now, LinkId(1), quality);
        while !matches!(router.poll_output(), Output::Timeout(_)) {}
        router.handle_timeout(now);
        while !matches!(router.poll_output(), Output::Timeout(_)) {}
    }
    (cpu() - began) / (router.route_stats().searches - searches).max(1) as u32
}

/// Measures cold start, changes, queries and joins.
fn asking(tables: &mut Tables, routers: usize) {
    let mut mesh = Mesh::new(routers as u64, MappingKind::Query, cpu);
    mesh.add_routers(routers);
    let names = routers * QUERY_NAMES_PER_ROUTER;
    let batches = names / BATCH_NAMES;
    // Owners are at routers 1, 5, 9…; the asking proxies are at others.
    let owners: Vec<_> = (0..batches.div_ceil(QUERY_BATCHES))
        .map(|n| mesh.add_proxy(&format!("owner-{n}"), (1 + 4 * n) % routers))
        .collect();
    let (probe_end, home) = (routers / 2, 1);
    let tally = cold_start(&mut mesh);
    let hops = mesh.hops(home);
    let diameter = (0..routers.min(20)).filter_map(|n| mesh.hops(n).into_values().max()).max().unwrap_or(0);
    let edges = mesh.edges();
    let mut cold = vec![
        routers.to_string(),
        edges.to_string(),
        diameter.to_string(),
        ms(tally.ways),
        ms(tally.last_frame),
        per(tally.frames() as f64, routers),
        kb(tally.bytes(), routers),
        per(tally.cpu.as_secs_f64() * 1e3, routers),
        per(tally.searches as f64, routers),
        per(held(&mesh) as f64 / 1e3, 1),
    ];

    let (cable, _) = mesh.spare();
    mesh.unplug(cable);
    let tally = mesh.settle();
    mesh.check(8);
    event(&mut tables.events, &mesh, "a link is cut", &tally);
    mesh.plug(cable);
    let tally = mesh.settle();
    mesh.check(8);
    event(&mut tables.events, &mesh, "it comes back", &tally);

    // Queries while all routers run.
    let mut batch = 0;
    for owner in &owners {
        for n in 0..QUERY_BATCHES.min(batches - batch) {
            mesh.advertise(*owner, n);
            batch += 1;
        }
    }
    let tally = mesh.settle();
    let mut row = |mesh: &Mesh, what: &str, after: Option<Duration>, tally: &Tally| {
        let (mut elsewhere, mut holders) = (0, 0);
        for at in mesh.routers() {
            let attached = owners.iter().enumerate().filter(|(n, _)| (1 + 4 * n) % routers == at).count();
            let own = attached * QUERY_BATCHES * BATCH_NAMES;
            let more = mesh.router(at).stats().routed_names.saturating_sub(own);
            elsewhere += more;
            holders += usize::from(more > 0);
        }
        let kinds = ["query", "advert", "link state"];
        let known: u64 = kinds.iter().map(|k| tally.frames_of_kind(k)).sum();
        tables.query.row(vec![
            routers.to_string(),
            names.to_string(),
            what.to_owned(),
            after.map_or("–".to_owned(), ms),
            tally.frames_of_kind("query").to_string(),
            tally.frames_of_kind("advert").to_string(),
            tally.frames_of_kind("link state").to_string(),
            (tally.frames() - known).to_string(),
            kb(tally.bytes(), 1),
            elsewhere.to_string(),
            holders.to_string(),
        ]);
    };
    row(&mesh, "all are advertised", None, &tally);
    let at_distance = |n: usize| hops.iter().find(|(_, h)| **h == n).map(|(at, _)| *at);
    let farthest = hops.values().max().copied().unwrap_or(0);
    let attach = |mesh: &mut Mesh, name: &str, router: usize| {
        let proxy = mesh.add_proxy(name, router);
        let cable = mesh.cables_of(proxy)[0];
        mesh.plug(cable);
        mesh.settle();
        proxy
    };
    let same = attach(&mut mesh, "same", home);
    let name = mesh.names(owners[0], 0)[0];
    mesh.ask(same, name);
    let tally = mesh.settle();
    row(&mesh, "question at the owner's router", tally.heard, &tally);
    let mut ask = |mesh: &mut Mesh, what: &str, proxy: usize, name: Name| {
        mesh.ask(proxy, name);
        let tally = mesh.settle();
        row(mesh, what, tally.heard, &tally);
    };
    let near = attach(&mut mesh, "near", at_distance(1).expect("it has neighbours"));
    ask(&mut mesh, "one link away", near, name);
    let far = attach(&mut mesh, "far", at_distance(farthest).expect("some are far"));
    let name = mesh.names(owners[0], 1)[0];
    ask(&mut mesh, "as far as can be", far, name);
    let other = mesh.names(owners[0], 1)[1];
    ask(&mut mesh, "again, of the same batch", far, other);
    ask(&mut mesh, "nobody has it", far, Name([7; 32]));
    mesh.forget(far, Name([7; 32]));
    for n in 0..QUESTIONS.min(owners.len() - 1) {
        let name = mesh.names(owners[n + 1], 0)[0];
        mesh.ask(far, name);
    }
    let tally = mesh.settle();
    row(&mesh, "ten names of ten owners at once", tally.heard, &tally);
    let joiner = attach(&mut mesh, "joiner", at_distance(farthest).expect("some are far"));
    let name = mesh.names(owners[owners.len() - 1], 1)[7];
    mesh.subscribe(joiner, name);
    let tally = mesh.settle();
    assert!(tally.granted.is_some(), "not granted");
    row(&mesh, "question and request to join", tally.granted, &tally);
    mesh.forget(joiner, name);
    let name = mesh.names(owners[owners.len() - 1], 1)[8];
    mesh.subscribe(joiner, name);
    let tally = mesh.settle();
    row(&mesh, "request to join, name known", tally.granted, &tally);
    mesh.roam(owners[0], probe_end);
    let tally = mesh.settle();
    row(&mesh, "an owner that was asked for roams", None, &tally);

    let late = mesh.join_router();
    let tally = mesh.settle();
    mesh.check(8);
    event(&mut tables.events, &mesh, "a router joins", &tally);
    mesh.kill(late);
    let tally = mesh.settle();
    mesh.check(8);
    event(&mut tables.events, &mesh, "it is killed", &tally);
    let (_, victim) = mesh.spare();
    mesh.kill(victim);
    let tally = mesh.settle();
    mesh.check(8);
    event(&mut tables.events, &mesh, "another is killed", &tally);
    if routers <= 100 {
        let tally = mesh.pass(Duration::from_secs(100));
        event(&mut tables.events, &mesh, "100 s of nothing", &tally);
    }
    cold.push(per(search_time(&mut mesh).as_secs_f64() * 1e6, 1));
    tables.cold.row(cold);
}

/// Measures look-ups, renewals and roaming with a store that all routers share, 1 ms away.
fn storing(table: &mut Table, routers: usize) {
    let mut mesh = Mesh::new(routers as u64, MappingKind::Store, cpu);
    mesh.add_routers(routers);
    let names = routers * QUERY_NAMES_PER_ROUTER;
    let batches = names / BATCH_NAMES;
    let owners: Vec<_> = (0..batches.div_ceil(QUERY_BATCHES))
        .map(|n| mesh.add_proxy(&format!("owner-{n}"), (1 + 4 * n) % routers))
        .collect();
    mesh.start_store();
    cold_start(&mut mesh);
    let mut before = mesh.store_counts();
    let mut row = |mesh: &Mesh, what: &str, after: Option<Duration>, tally: &Tally| {
        let counts = mesh.store_counts();
        table.row(vec![
            routers.to_string(),
            names.to_string(),
            what.to_owned(),
            after.map_or("–".to_owned(), ms),
            (counts.reads - before.reads).to_string(),
            (counts.writes - before.writes).to_string(),
            (counts.name_writes - before.name_writes).to_string(),
            tally.frames_of_kind("query").to_string(),
            (tally.frames() - tally.frames_of_kind("query")).to_string(),
        ]);
        before = counts;
    };
    let advertise_all = |mesh: &mut Mesh| {
        let mut batch = 0;
        for owner in &owners {
            for n in 0..QUERY_BATCHES.min(batches - batch) {
                mesh.advertise(*owner, n);
                batch += 1;
            }
        }
        mesh.settle()
    };
    let tally = advertise_all(&mut mesh);
    row(&mesh, "all are advertised", None, &tally);
    let tally = advertise_all(&mut mesh);
    row(&mesh, "all are renewed", None, &tally);
    let home = 1;
    let farthest = mesh.hops(home).into_iter().max_by_key(|(_, hops)| *hops).map_or(0, |(at, _)| at);
    let attach = |mesh: &mut Mesh, name: &str| {
        let proxy = mesh.add_proxy(name, farthest);
        let cable = mesh.cables_of(proxy)[0];
        mesh.plug(cable);
        mesh.settle();
        proxy
    };
    let far = attach(&mut mesh, "far");
    row(&mesh, "a proxy is attached", None, &Tally::default());
    let mut ask = |mesh: &mut Mesh, what: &str, name: Name| {
        mesh.ask(far, name);
        let tally = mesh.settle();
        row(mesh, what, tally.heard, &tally);
    };
    let name = mesh.names(owners[0], 1)[0];
    ask(&mut mesh, "a name as far as can be", name);
    let name = mesh.names(owners[0], 1)[1];
    ask(&mut mesh, "another of the same batch", name);
    ask(&mut mesh, "nobody has it", Name([7; 32]));
    mesh.forget(far, Name([7; 32]));
    for n in 0..QUESTIONS.min(owners.len() - 1) {
        let name = mesh.names(owners[n + 1], 0)[0];
        mesh.ask(far, name);
    }
    let tally = mesh.settle();
    row(&mesh, "ten names of ten owners at once", tally.heard, &tally);
    let joiner = attach(&mut mesh, "joiner");
    row(&mesh, "a proxy is attached", None, &Tally::default());
    let name = mesh.names(owners[owners.len() - 1], 1)[7];
    mesh.subscribe(joiner, name);
    let tally = mesh.settle();
    assert!(tally.granted.is_some(), "not granted");
    row(&mesh, "look-up and request to join", tally.granted, &tally);
    mesh.roam(owners[0], routers / 2);
    let tally = mesh.settle();
    row(&mesh, "an owner that was asked for roams", None, &tally);
}

/// Measures names that every router knows.
fn flooding(table: &mut Table, routers: usize, names: &[usize]) {
    let mut mesh = Mesh::new(routers as u64, MappingKind::Flood, cpu);
    mesh.add_routers(routers);
    let most = names.iter().max().expect("some names") / (FLOOD_BATCHES * BATCH_NAMES);
    let owners: Vec<_> =
        (0..most).map(|n| mesh.add_proxy(&format!("owner-{n}"), (1 + 4 * n) % routers)).collect();
    cold_start(&mut mesh);
    let without = held(&mesh);
    let mut known = 0;
    for names in names {
        let upto = names / (FLOOD_BATCHES * BATCH_NAMES);
        let batches = (upto - known) * FLOOD_BATCHES;
        for owner in &owners[known..upto] {
            for n in 0..FLOOD_BATCHES {
                mesh.advertise(*owner, n);
            }
        }
        let frames = mesh.settle();
        known = upto;
        for at in mesh.routers() {
            assert_eq!(mesh.router(at).stats().routed_names, *names, "router {at} does not know all");
        }
        let held = held(&mesh);
        let to = mesh.dice().below(routers);
        mesh.roam(owners[0], to);
        let roam = mesh.settle();
        let name = mesh.names(owners[0], 0)[0];
        for at in mesh.routers() {
            let (_, cost) = mesh.router(at).route(&name).expect("a way");
            let to = if at == to { 0 } else { mesh.router(at).cost_to(&mesh.node(to)).expect("a way") };
            assert_eq!(cost, to + 5000, "router {at} does not go to where the owner is");
        }
        table.row(vec![
            routers.to_string(),
            names.to_string(),
            ms(frames.last_frame),
            per(frames.frames() as f64, batches),
            per(frames.frames_of_kind("advert") as f64, batches * mesh.edges()),
            kb(frames.bytes(), batches * routers),
            per(frames.cpu.as_secs_f64() * 1e6, routers * batches * BATCH_NAMES),
            per(held as f64 / 1e3, 1),
            per((held - without) as f64, *names),
            roam.frames().to_string(),
        ]);
    }
}

/// Measures one router with many proxies, each of which waits for ten names.
fn hub(table: &mut Table, proxies: usize) {
    let mut mesh = Mesh::new(proxies as u64, MappingKind::Query, cpu);
    mesh.add_routers(2);
    let batches = (proxies * 10).div_ceil(BATCH_NAMES);
    let owner = mesh.add_proxy("owner-0", 0);
    let others: Vec<_> = (0..proxies).map(|n| mesh.add_proxy(&format!("proxy-{n}"), 0)).collect();
    mesh.record(0);
    mesh.plug_all();
    mesh.settle();
    let mut names = Vec::new();
    for batch in 0..batches {
        mesh.advertise(owner, batch);
        names.extend(mesh.names(owner, batch));
    }
    mesh.settle();
    for (proxy, names) in others.iter().zip(names.chunks(10)) {
        names.iter().for_each(|name| mesh.ask(*proxy, *name));
    }
    mesh.settle();
    table.row(vec![
        proxies.to_string(),
        names.len().to_string(),
        per(held(&mesh) as f64 / 1e3, 1),
        per(search_time(&mut mesh).as_secs_f64() * 1e6, 1),
    ]);
}

/// Times the verification of a link state.
fn verify_time() -> Duration {
    let node = identity(&Member { router: true, ..Member::new("router-0") });
    let now = Mesh::new(0, MappingKind::Flood, cpu).now();
    let signed = node.sign_link_state(&LinkStateBody {
        chain: node.chain_bytes(),
        seq: 1,
        issued_at: now.unix,
        lease_ms: 1000,
        floor: 0,
        transit: true,
        routers: (0..4).map(|n| Adjacency { node: NodeId([n; 32]), cost: 1000 }).collect(),
        attached: vec![],
    });
    let began = cpu();
    for _ in 0..TIMED {
        verify_link_state(node.anchors(), &signed, now.unix).expect("as it was signed");
    }
    (cpu() - began) / TIMED
}

fn main() {
    let mut args = std::env::args().skip(1);
    let (mut sizes, mut csv, mut full, mut only) = (vec![10, 30, 100, 300], None, false, None);
    while let Some(arg) = args.next() {
        match arg.as_str() {
            "--full" => (full, sizes) = (true, vec![10, 30, 100, 300, 1000]),
            "--sizes" => {
                let list = args.next().unwrap_or_default();
                sizes = list.split(',').map(|n| n.parse().expect("--sizes takes numbers")).collect();
            }
            "--only" => only = args.next(),
            "--csv" => csv = args.next().map(PathBuf::from),
            _ => panic!("--full, --sizes 10,30, --only flood, query or store, or --csv DIR, not {arg}"),
        }
    }
    // Names take some 150 bytes each.
    let names_max = if full { 100_000_000 } else { 10_000_000 };
    let mut tables = Tables::new();
    for routers in sizes {
        let is_wanted = |part: &str| only.as_deref().is_none_or(|only| only == part);
        if is_wanted("query") {
            asking(&mut tables, routers);
        }
        if is_wanted("store") {
            storing(&mut tables.store, routers);
        }
        let names: Vec<_> =
            [1000, 10_000, 100_000].into_iter().filter(|n| n * routers <= names_max).collect();
        if is_wanted("flood") {
            flooding(&mut tables.flood, routers, &names);
        }
    }
    for proxies in [10, 100, 1000] {
        hub(&mut tables.hub, proxies);
    }
    println!("A link state takes {} µs to verify.\n", verify_time().as_micros());
    for (title, table) in tables.all() {
        println!("### {title}\n\n{}", table.markdown());
        if let Some(dir) = &csv {
            std::fs::create_dir_all(dir).expect("--csv names a directory");
            std::fs::write(dir.join(table.file).with_extension("csv"), table.csv())
                .expect("it can be written");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a cell of a table by its row and the name of its column.
    fn cell(table: &Table, row: usize, column: &str) -> f64 {
        let at = table.head.iter().position(|h| *h == column).expect("a column");
        table.rows[row][at].parse().expect("a number")
    }

    #[test]
    fn ten_routers_agree_and_no_frame_is_sent_in_vain() {
        let mut tables = Tables::new();
        asking(&mut tables, 10);
        let edges = cell(&tables.cold, 0, "links");
        assert!(cell(&tables.cold, 0, "ways final after ms") < 1000.0);
        for row in 0..tables.events.rows.len() - 1 {
            // Two or three nodes change their state in at most two steps, and each change crosses each link at most
            // twice.
            assert!(cell(&tables.events, row, "frames") <= 8.0 * 2.0 * edges);
        }
        assert!(cell(&tables.query, 2, "answered after ms") < 100.0);
        storing(&mut tables.store, 10);
        let batches = (10 * QUERY_NAMES_PER_ROUTER / BATCH_NAMES) as f64;
        assert_eq!(cell(&tables.store, 1, "writes"), batches, "a renewal is one write a batch");
        assert_eq!(cell(&tables.store, 3, "questions"), 0.0, "the store has it");
        assert_eq!(cell(&tables.store, 4, "reads"), 0.0, "the batch is at hand");
        flooding(&mut tables.flood, 10, &[1000]);
        assert!(cell(&tables.flood, 0, "frames a batch and link") <= 2.0);
        assert!(cell(&tables.flood, 0, "bytes held a name") < 400.0);
    }
}
