//! Direct links: which networks allow them, how soon they come, and what a change of the path costs.

use std::thread::sleep;
use std::time::{Duration, Instant};

use sgc_testkit::FakeDomain;

use crate::flow::{Flow, LATE};
use crate::lab::{Carrier, Lab, Nat, RANGES, schemes};
use crate::node::Node;
use crate::support::{eventually, say};
use crate::{CALM, Pair, cable, can_run, is_long, shared_turn, turn};

/// Number of tries in the long run for each pair of networks, unless `SGC_DIRECT_TRIES` has another.
const TRIES_LONG: u32 = 200;
/// Time between two of them: a node takes four attempts of a peer in ten seconds.
const TRY_EVERY: Duration = Duration::from_millis(2700);
/// Most pairs of networks that are tried at one time. In the long run, they mostly wait.
const CELLS_AT_ONCE: usize = 6;
const CELLS_AT_ONCE_LONG: usize = 32;
/// Time in which a first attempt succeeds, from the start of the node on.
const FIRST_ATTEMPT: Duration = Duration::from_secs(2);

pub(crate) fn direct_links(node: &Node) -> usize {
    let status = node.status();
    let links = status["links"].as_array().cloned().unwrap();
    links.iter().filter(|link| link["direct"] == true).count()
}

/// Returns why a node has no direct link to its only peer.
pub(crate) fn why_not(node: &Node) -> Option<String> {
    Some(node.status()["not_direct"][0]["why"].as_str()?.to_owned())
}

/// Ends the flows. Returns what was wrong with them.
pub(crate) fn judge(pair: &Pair) -> Vec<String> {
    pair.flows.iter().for_each(|flow| flow.end());
    let mut wrong = Vec::new();
    for flow in &pair.flows {
        if flow.topic.reliable {
            eventually("the last message", || flow.has_heard(flow.said()));
        }
        let verdict = flow.judge(Instant::now());
        let lost = if flow.topic.reliable { verdict.lost } else { 0 };
        if lost + verdict.doubled + verdict.late > 0 {
            let (name, doubled, late) = (flow.topic.name, verdict.doubled, verdict.late);
            wrong.push(format!("{name}: {lost} lost, {doubled} doubled, {late} late"));
        }
    }
    wrong
}

/// A pair of networks, and whether theory allows a direct path between them.
struct Cell {
    name: String,
    lab: Lab,
    /// The URL by which the robot dials the router.
    router: String,
    is_feasible: bool,
}

impl Cell {
    fn new(name: String, lab: Lab, is_feasible: bool) -> Self {
        let router = lab.url("quic");
        Self { name, lab, router, is_feasible }
    }

    /// A robot and a desk behind one NAT each.
    fn behind((near, near_nat): (&str, Nat), (far, far_nat): (&str, Nat)) -> Self {
        let lab = Lab::new(cable(), near_nat);
        lab.set_far_nat(far_nat);
        // A symmetric NAT has another port for each address, and these admit the known one alone.
        let strict = ["firewall", "port restricted", "symmetric"];
        let is_hopeless = |one: &str, other: &str| one == "symmetric" && strict.contains(&other);
        Self::new(format!("{near} to {far}"), lab, !is_hopeless(near, far) && !is_hopeless(far, near))
    }

    /// The robot behind the NATs of a home and of a carrier.
    fn behind_carrier(far: (&str, Nat)) -> Self {
        let mut lab = Lab::new(cable(), Nat::PortRestricted);
        lab.add_carrier(Carrier::PortRestricted);
        lab.set_far_nat(far.1);
        Self::new(format!("carrier over home to {}", far.0), lab, true)
    }

    /// The robot and the desk behind NATs of homes, and those behind one NAT of a carrier.
    fn at_one_carrier(does_hairpin: bool) -> Self {
        let mut lab = Lab::new(cable(), Nat::PortRestricted);
        lab.add_carrier(if does_hairpin { Carrier::Hairpin } else { Carrier::NoHairpin });
        lab.join_desk_to_carrier();
        let name = if does_hairpin { "one carrier, hairpin" } else { "one carrier, no hairpin" };
        Self::new(name.to_owned(), lab, does_hairpin)
    }

    /// Both behind symmetric NATs, with IPv6 beside it or, at the robot, in its place. `None` where there is no IPv6.
    fn with_ipv6(has_v4: bool) -> Option<Self> {
        let mut lab = Lab::new(cable(), Nat::RandomPort(RANGES[0]));
        if !lab.add_ipv6() {
            say("NO IPV6: direct links over it are not tested");
            return None;
        }
        if has_v4 {
            return Some(Self::new("symmetric, and IPv6".to_owned(), lab, true));
        }
        lab.robot.ip(&["address", "flush", "dev", "eth0", "scope", "global"]).unwrap();
        lab.robot.ip(&["-6", "address", "add", "2001:db8:1::2/64", "dev", "eth0", "nodad"]).unwrap();
        lab.robot.ip(&["-6", "route", "replace", "default", "via", "2001:db8:1::1"]).unwrap();
        lab.desk.ip(&["-6", "address", "flush", "dev", "eth0"]).unwrap();
        let router = lab.url_v6();
        Some(Self { router, ..Self::new("IPv6 to IPv4".to_owned(), lab, false) })
    }

    /// Lets a robot and a desk in these networks exchange data. In the long run, restarts the desk again and again: its
    /// first attempt has to succeed nearly always.
    fn run(&self) {
        let Self { name, lab, router, is_feasible } = self;
        let _cloud = Node::start(&lab.cloud, &lab.router_config(), lab.enroll("cloud", true), None);
        let mut pair = Pair::start(lab, "quic", &[router]);
        pair.wait_for("never begins", |_| 1);
        let begun = Instant::now();
        if *is_feasible {
            eventually(&format!("a direct link, {name}"), || direct_links(&pair.robot) > 0);
            let after = begun.elapsed();
            eventually("also at the other end", || direct_links(&pair.desk) > 0);
            say(&format!("  {name:<36} {:>9}", after.as_millis()));
        } else {
            let given_up = |why: String| !why.contains("is being looked for") && !why.contains("yet");
            eventually("it is given up", || why_not(&pair.desk).is_some_and(given_up));
            let why = why_not(&pair.desk).unwrap();
            let theory =
                if name.starts_with("IPv6") { "the two nodes have no address" } else { "no packet passes" };
            assert!(why.starts_with(theory), "{name}: {why}");
            assert_eq!(direct_links(&pair.robot), 0, "{name}");
            say(&format!("  {name:<36}   relayed"));
        }
        pair.wait_for("does not go on", |flow| flow.said() + 1);
        sleep(CALM);
        let wrong = judge(&pair);
        assert!(wrong.is_empty(), "{name}: {wrong:?}");
        if *is_feasible && is_long() {
            try_often(lab, &mut pair, name);
        }
    }
}

/// Restarts the desk again and again.
fn try_often(lab: &Lab, pair: &mut Pair, name: &str) {
    let tries = std::env::var("SGC_DIRECT_TRIES").map_or(TRIES_LONG, |tries| tries.parse().unwrap());
    let mut soon = 0;
    for _ in 0..tries {
        sleep(TRY_EVERY);
        pair.restart_desk(lab);
        let begun = Instant::now();
        eventually(&format!("a direct link, {name}"), || direct_links(&pair.desk) > 0);
        soon += u32::from(begun.elapsed() < FIRST_ATTEMPT);
    }
    say(&format!("  {name}: {soon} of {tries} at the first attempt"));
    assert!(soon * 100 >= 95 * tries, "{name}: {soon} of {tries}");
}

/// All pairs of networks in the long run, and some in the short one. `sgc-session` has all of them on a virtual clock.
#[test]
fn nodes_behind_nats_get_a_direct_link_as_theory_says() {
    if !can_run() {
        return;
    }
    let _turn = turn();
    let nats = [
        ("public", Nat::Public),
        ("firewall", Nat::Firewall),
        ("full cone", Nat::FullCone),
        ("address restricted", Nat::AddressRestricted),
        ("port restricted", Nat::PortRestricted),
        ("symmetric", Nat::RandomPort(RANGES[0])),
    ];
    let short = [(0, 5), (1, 3), (4, 4), (2, 5), (4, 5)];
    let all = (0..nats.len()).flat_map(|near| (near..nats.len()).map(move |far| (near, far)));
    let pairs: Vec<_> = if is_long() { all.collect() } else { short.to_vec() };
    let mut cells: Vec<_> = pairs.iter().map(|(near, far)| Cell::behind(nats[*near], nats[*far])).collect();
    cells.extend(
        nats[2..5].iter().rev().take(if is_long() { 3 } else { 1 }).map(|far| Cell::behind_carrier(*far)),
    );
    cells.extend([true, false].map(Cell::at_one_carrier));
    cells.extend([true, false].into_iter().filter_map(Cell::with_ipv6));
    say("\nDirect links\n  robot to desk                        after, ms");
    let at_once = if is_long() { CELLS_AT_ONCE_LONG } else { CELLS_AT_ONCE };
    for cells in cells.chunks(at_once) {
        std::thread::scope(|scope| cells.iter().for_each(|cell| drop(scope.spawn(|| cell.run()))));
    }
}

/// A robot and a desk with a direct link, and their router.
fn direct_pair(lab: &Lab) -> (Node, Pair) {
    direct_pair_by(lab, "quic")
}

/// The same, with links to the router by this transport alone.
fn direct_pair_by(lab: &Lab, scheme: &'static str) -> (Node, Pair) {
    let cloud = Node::start(&lab.cloud, &lab.router_config(), lab.enroll("cloud", true), None);
    let pair = Pair::start(lab, scheme, &[&lab.url(scheme)]);
    pair.wait_for("never begins", |_| 1);
    for node in [&pair.robot, &pair.desk] {
        eventually("a direct link", || direct_links(node) == 1);
    }
    // The branches move to it.
    eventually("data on the direct link", || carried(&pair.robot, true) > 20_000);
    (cloud, pair)
}

/// Returns the bytes that a node sent over its direct links, or over the others.
fn carried(node: &Node, is_direct: bool) -> u64 {
    let links = node.status()["links"].as_array().cloned().unwrap();
    let of_kind = links.iter().filter(|link| link["direct"] == is_direct);
    of_kind.filter_map(|link| link["sent_bytes"].as_u64()).sum()
}

#[test]
fn router_carries_keep_alives_alone_and_takes_over_when_the_direct_path_dies() {
    if !can_run() {
        return;
    }
    let _turn = shared_turn();
    let lab = Lab::new(cable(), Nat::PortRestricted);
    let (_cloud, pair) = direct_pair(&lab);
    sleep(CALM);
    let before = (carried(&pair.robot, true), carried(&pair.robot, false));
    sleep(2 * CALM);
    let after = (carried(&pair.robot, true), carried(&pair.robot, false));
    let (direct, relayed) = (after.0 - before.0, after.1 - before.1);
    assert!(direct > 5 * relayed, "{direct} bytes directly, {relayed} over the router");
    for round in 0..if is_long() { 5 } else { 1 } {
        let begun = Instant::now();
        lab.cut_between_sites();
        pair.wait_for("does not go on over the router", |flow| flow.said() + 1);
        sleep(CALM);
        let outage = pair.flows.iter().map(|flow| flow.judge(begun).outage).max().unwrap();
        eventually("it is said", || why_not(&pair.desk).is_some());
        lab.join_sites();
        let back = Instant::now();
        eventually("a direct link again", || direct_links(&pair.robot) == 1 && direct_links(&pair.desk) == 1);
        let (outage, back) = (outage.as_millis(), back.elapsed().as_millis());
        say(&format!(
            "\nThe direct path dies, round {round}: {outage} ms without data, direct again after {back} ms"
        ));
        pair.wait_for("does not go on", |flow| flow.said() + 1);
    }
    let wrong = judge(&pair);
    assert!(wrong.is_empty(), "{wrong:?}");
}

#[test]
fn nodes_with_a_direct_link_need_no_router() {
    if !can_run() {
        return;
    }
    let _turn = shared_turn();
    let lab = Lab::new(cable(), Nat::Public);
    let (cloud, pair) = direct_pair(&lab);
    drop(cloud);
    pair.wait_for("does not go on without the router", |flow| flow.said() + 1);
    // A topic that nobody published while there was a router.
    let late = Flow::start(LATE, &pair.near, &pair.far);
    eventually("a new topic", || late.has_heard(10));
    let _cloud = Node::start(&lab.cloud, &lab.router_config(), lab.enroll("cloud", true), None);
    for node in [&pair.robot, &pair.desk] {
        eventually("both have the router again", || node.status()["links"].as_array().unwrap().len() == 2);
    }
    pair.wait_for("does not go on", |flow| flow.said() + 1);
    let wrong = judge(&pair);
    assert!(wrong.is_empty(), "{wrong:?}");
}

#[test]
fn one_copy_passes_the_uplink_however_many_direct_links_there_are() {
    if !can_run() {
        return;
    }
    let _turn = shared_turn();
    let lab = Lab::new(cable(), Nat::PortRestricted);
    let (_cloud, pair) = direct_pair(&lab);
    let video = pair.flows.iter().find(|flow| !flow.topic.reliable).unwrap();
    // A second desk in the same network, for both topics of the robot.
    let uses = "[[use]]\nfrom = \"robot-quic\"\ntopic = \"/video\"\n";
    let file = lab.write_config("desk-2", &[&lab.url("quic")], uses);
    let domain = FakeDomain::default();
    let second = Node::start(&lab.desk, &file, lab.enroll("desk-2", false), Some(&domain));
    let ears = video.listen(&domain);
    eventually("the second desk hears it", || ears.count() > 0);
    eventually("it has a direct link, too", || direct_links(&second) == 1);
    sleep(2 * CALM);
    let state = pair.flows.iter().find(|flow| flow.topic.reliable).unwrap();
    let before = (carried(&pair.robot, true), carried(&pair.robot, false), ears.count(), state.said());
    sleep(3 * CALM);
    let (direct, relayed) = (carried(&pair.robot, true) - before.0, carried(&pair.robot, false) - before.1);
    let (images, states) = (ears.count() - before.2, state.said() - before.3);
    say(&format!(
        "\nTwo sinks: {relayed} bytes over the router for {images} images, {direct} directly for {states} states"
    ));
    // One copy of 500 bytes goes to the router.
    assert!(images > 10 && relayed > 450 * images && relayed < 1000 * images, "{relayed} bytes for {images}");
    // The other topic, of 64 bytes, goes to the first desk alone, and directly. With the images it would be twice as much.
    assert!(direct < 350 * states, "{direct} bytes for {states}");
    drop(second);
    eventually("the camera goes directly again", || {
        let before = carried(&pair.robot, false);
        sleep(CALM);
        carried(&pair.robot, false) - before < 4_000
    });
    let wrong = judge(&pair);
    assert!(wrong.is_empty(), "{wrong:?}");
}

#[test]
fn node_that_permits_no_direct_link_tells_no_address() {
    if !can_run() {
        return;
    }
    let _turn = shared_turn();
    let lab = Lab::new(cable(), Nat::Public);
    let cloud = Node::start(&lab.cloud, &lab.router_config(), lab.enroll("cloud", true), None);
    let shares = "direct = [\"group:operators\"]\n[ros]\ndomain_id = 0\n\
        [[share]]\ntopic = \"/state\"\nto = [\"desk\"]\n[[share]]\ntopic = \"/video\"\nto = [\"desk\"]\n";
    let uses =
        "[[use]]\nfrom = \"robot\"\ntopic = \"/state\"\n[[use]]\nfrom = \"robot\"\ntopic = \"/video\"\n";
    let pair = Pair::with(&lab, "quic", ["robot", "desk"], [shares, uses], &[&lab.url("quic")]);
    pair.wait_for("never begins", |_| 1);
    eventually("it is refused", || {
        why_not(&pair.desk).is_some_and(|why| why.contains("permits no direct link"))
    });
    assert_eq!(pair.robot.status()["drops"]["direct_not_permitted"], 1);
    assert_eq!((direct_links(&pair.robot), direct_links(&pair.desk)), (0, 0));
    assert!(judge(&pair).is_empty());
    drop(cloud);
}

#[test]
fn node_on_the_same_network_does_not_count_for_the_uplink() {
    if !can_run() {
        return;
    }
    let _turn = shared_turn();
    let lab = Lab::new(cable(), Nat::PortRestricted);
    let (_cloud, pair) = direct_pair(&lab);
    let video = pair.flows.iter().find(|flow| !flow.topic.reliable).unwrap();
    let uses = "[[use]]\nfrom = \"robot-quic\"\ntopic = \"/video\"\n";
    let file = lab.write_config("desk-2", &[&lab.url("quic")], uses);
    let domain = FakeDomain::default();
    let second = Node::start(&lab.robot, &file, lab.enroll("desk-2", false), Some(&domain));
    let ears = video.listen(&domain);
    eventually("the second desk hears it", || ears.count() > 0);
    eventually("it has a direct link, too", || direct_links(&second) == 1);
    sleep(2 * CALM);
    let (before, heard) = (carried(&pair.robot, false), ears.count());
    sleep(3 * CALM);
    let (relayed, images) = (carried(&pair.robot, false) - before, ears.count() - heard);
    assert!(images > 10 && relayed < 250 * images, "{relayed} bytes over the router for {images} images");
    let wrong = judge(&pair);
    assert!(wrong.is_empty(), "{wrong:?}");
}

#[test]
fn robot_whose_udp_is_blocked_stays_with_its_router_and_says_why() {
    if !can_run() {
        return;
    }
    let _turn = shared_turn();
    let lab = Lab::new(cable(), Nat::Public);
    lab.block_udp();
    let _cloud = Node::start(&lab.cloud, &lab.router_config(), lab.enroll("cloud", true), None);
    let pair = Pair::start(&lab, "quic", &[&lab.url("tls")]);
    pair.wait_for("never begins", |_| 1);
    let blocked = |why: String| why.starts_with("no packet passes");
    eventually("it is given up", || why_not(&pair.desk).is_some_and(blocked));
    assert_eq!((direct_links(&pair.robot), direct_links(&pair.desk)), (0, 0));
    let wrong = judge(&pair);
    assert!(wrong.is_empty(), "{wrong:?}");
}

/// Waits until the data goes over a direct link again, after an event, and says how long that took and what it cost.
fn direct_again(pair: &Pair, what: &str, begun: Instant) {
    pair.wait_for("does not go on", |flow| flow.said() + 1);
    eventually("a direct link again", || {
        direct_links(&pair.robot) > 0 && direct_links(&pair.desk) > 0 && carries(&pair.robot)
    });
    let after = begun.elapsed().as_millis();
    sleep(CALM);
    let outage = pair.flows.iter().map(|flow| flow.judge(begun).outage).max().unwrap().as_millis();
    say(&format!("  {what}: {outage} ms without data, direct again after {after} ms"));
}

/// Returns `true` if the data goes over the direct link.
fn carries(node: &Node) -> bool {
    let now = || (carried(node, true), carried(node, false));
    let before = now();
    let since = || {
        let now = now();
        (now.0.saturating_sub(before.0), now.1.saturating_sub(before.1))
    };
    eventually("data", || {
        let (directly, relayed) = since();
        directly + relayed > 6_000
    });
    let (directly, relayed) = since();
    directly > relayed
}

#[test]
fn direct_link_follows_a_robot_and_a_desk_that_move() {
    if !can_run() {
        return;
    }
    let _turn = shared_turn();
    let lab = Lab::new(cable(), Nat::PortRestricted);
    lab.add_lte();
    let (_cloud, pair) = direct_pair(&lab);
    say("\nRoaming with a direct link");
    for _ in 0..if is_long() { 5 } else { 1 } {
        let moves = [("10.3.0.1", "10.2.0.3/24", "10.2.0.2/24"), ("10.1.0.1", "10.2.0.2/24", "10.2.0.3/24")];
        for (gateway, comes, goes) in moves {
            let begun = Instant::now();
            lab.route_by(gateway);
            direct_again(&pair, "the robot moves to another uplink", begun);
            let begun = Instant::now();
            lab.change_desk(comes, goes);
            direct_again(&pair, "the desk gets another address", begun);
        }
        for (gateway, comes, goes) in moves {
            let begun = Instant::now();
            lab.route_by(gateway);
            lab.change_desk(comes, goes);
            direct_again(&pair, "both at once", begun);
        }
    }
    let wrong = judge(&pair);
    assert!(wrong.is_empty(), "{wrong:?}");
}

#[test]
fn direct_link_moves_to_a_cable_and_back() {
    if !can_run() {
        return;
    }
    let _turn = shared_turn();
    let lab = Lab::new(cable(), Nat::PortRestricted);
    let (_cloud, pair) = direct_pair(&lab);
    let over_cable = |node: &Node| {
        let links = node.status()["links"].as_array().cloned().unwrap();
        let remotes = links.iter().filter_map(|link| link["remote"].as_str());
        remotes.filter(|remote| remote.starts_with("10.9.0.")).count()
    };
    say("\nA cable between robot and desk");
    for _ in 0..if is_long() { 5 } else { 1 } {
        let begun = Instant::now();
        lab.set_cable(true);
        eventually("a link over the cable", || over_cable(&pair.robot) == 1 && over_cable(&pair.desk) == 1);
        direct_again(&pair, "laid", begun);
        eventually("the other direct link ends", || direct_links(&pair.robot) == 1);
        assert_eq!(over_cable(&pair.robot), 1);
        let begun = Instant::now();
        lab.set_cable(false);
        direct_again(&pair, "pulled", begun);
        eventually("the link over the cable ends", || over_cable(&pair.robot) == 0);
    }
    let wrong = judge(&pair);
    assert!(wrong.is_empty(), "{wrong:?}");
}

#[test]
fn data_goes_directly_while_the_router_restarts() {
    if !can_run() {
        return;
    }
    let _turn = shared_turn();
    let lab = Lab::new(cable(), Nat::PortRestricted);
    let (mut cloud, pair) = direct_pair(&lab);
    let begun = Instant::now();
    for _ in 0..if is_long() { 5 } else { 1 } {
        drop(cloud);
        pair.wait_for("does not go on without the router", |flow| flow.said() + 1);
        cloud = Node::start(&lab.cloud, &lab.router_config(), lab.enroll("cloud", true), None);
        for node in [&pair.robot, &pair.desk] {
            eventually("both have the router again", || {
                node.status()["links"].as_array().unwrap().len() == 2
            });
        }
        pair.wait_for("does not go on", |flow| flow.said() + 1);
        sleep(CALM);
    }
    let outage = pair.flows.iter().map(|flow| flow.judge(begun).outage).max().unwrap().as_millis();
    say(&format!("\nThe router restarts while the data goes directly: {outage} ms without data at most"));
    assert!(carries(&pair.robot));
    let wrong = judge(&pair);
    assert!(wrong.is_empty(), "{wrong:?}");
}

/// Returns the addresses from which the router sees a node.
fn observed(node: &Node) -> Vec<String> {
    let links = node.status()["links"].as_array().cloned().unwrap();
    let of_routers = links.iter().filter(|link| link["direct"] == false);
    of_routers.filter_map(|link| Some(link["observed"].as_str()?.to_owned())).collect()
}

#[test]
fn nodes_whose_router_listens_for_dtls_get_a_direct_link_and_keep_it() {
    // `schemes` says why not.
    if !can_run() || !schemes().contains(&"dtls") {
        return;
    }
    let _turn = shared_turn();
    let lab = Lab::new(cable(), Nat::PortRestricted);
    lab.add_lte();
    let (mut cloud, pair) = direct_pair_by(&lab, "dtls");
    say("\nDirect links beside a router link by DTLS");
    for _ in 0..if is_long() { 5 } else { 1 } {
        // The link to the router and the direct one are on one socket, which moves.
        for gateway in ["10.3.0.1", "10.1.0.1"] {
            let before = observed(&pair.robot);
            let begun = Instant::now();
            lab.route_by(gateway);
            eventually("the router sees another address", || {
                let now = observed(&pair.robot);
                !now.is_empty() && now.iter().all(|address| !before.contains(address))
            });
            direct_again(&pair, "the robot moves to another uplink", begun);
        }
        let begun = Instant::now();
        drop(cloud);
        pair.wait_for("does not go on without the router", |flow| flow.said() + 1);
        cloud = Node::start(&lab.cloud, &lab.router_config(), lab.enroll("cloud", true), None);
        for node in [&pair.robot, &pair.desk] {
            eventually("both have the router again", || observed(node).len() == 1);
        }
        direct_again(&pair, "the router restarts", begun);
        // A path that is cut and comes back is found by what the router has told since.
        lab.cut_between_sites();
        pair.wait_for("does not go on over the router", |flow| flow.said() + 1);
        eventually("it is said", || why_not(&pair.desk).is_some());
        let begun = Instant::now();
        lab.join_sites();
        direct_again(&pair, "the path comes back", begun);
    }
    let wrong = judge(&pair);
    assert!(wrong.is_empty(), "{wrong:?}");
}

#[test]
fn data_goes_over_the_router_while_the_direct_path_loses_a_fifth() {
    if !can_run() {
        return;
    }
    let _turn = shared_turn();
    let lab = Lab::new(cable(), Nat::PortRestricted);
    let (_cloud, pair) = direct_pair(&lab);
    let begun = Instant::now();
    lab.lose_between_sites(20);
    eventually("the data goes over the router", || !carries(&pair.robot));
    let left = begun.elapsed().as_millis();
    // It does not come back as long as packets are lost.
    for _ in 0..if is_long() { 60 } else { 3 } {
        sleep(CALM);
        assert!(!carries(&pair.robot));
    }
    assert!(direct_links(&pair.robot) > 0 && direct_links(&pair.desk) > 0);
    lab.join_sites();
    let begun = Instant::now();
    if is_long() {
        eventually("the data goes directly again", || carries(&pair.robot));
    }
    let back = begun.elapsed().as_millis();
    say(&format!(
        "\n20 % loss on the direct path: over the router after {left} ms, direct again {back} ms after it"
    ));
    pair.wait_for("does not go on", |flow| flow.said() + 1);
    let wrong = judge(&pair);
    assert!(wrong.is_empty(), "{wrong:?}");
}
