//! Operators' mistakes over real links: one identity in two processes, and wrong clocks.

#![allow(clippy::unwrap_used)]

#[path = "support/lab.rs"]
mod lab;
mod support;

use std::fs;
use std::sync::Arc;
use std::time::{Duration, Instant};

use lab::*;
use sgc_node::config::Config;
use sgc_transport::{Dialer, Link as _, LinkOptions, TransportMetrics};
use sgc_trust::EnrollRequest;
use sgc_wire::{Control, Decode as _, Encode as _, Hello, UnixMillis};
use support::*;

const HOUR_MS: u64 = 3_600_000;

/// Returns the alerts of this kind that a node shows.
fn alerts(node: &Node, kind: &str) -> Vec<serde_json::Value> {
    let status = node.status();
    let all = status["alerts"].as_array().unwrap();
    all.iter().filter(|alert| alert["kind"] == kind).cloned().collect()
}

fn number(payload: &[u8]) -> u64 {
    std::str::from_utf8(payload).unwrap().parse().unwrap()
}

fn links(node: &Node) -> usize {
    node.status()["links"].as_array().unwrap().len()
}

/// Starts a second process of a node, as on another machine of the same local network.
fn twin(lab: &Lab, node: &str, change: impl FnOnce(&mut Config)) -> Node {
    let identity = lab.path(&format!("{node}-twin.identity"));
    fs::copy(lab.config(node).identity, &identity).unwrap();
    let mut config = Config {
        identity,
        state: Some(lab.state(&format!("{node}-twin"))),
        admin_socket: Some(lab.path(&format!("{node}-twin.sock"))),
        ..lab.config(node)
    };
    change(&mut config);
    Node::start(config, lab.identity(node), Some(&lab.net(node)))
}

#[test]
fn identity_in_two_processes_is_reported_and_delivers_once() {
    let lab = Lab::new(&["robot", "desk"]);
    let cloud = lab.cloud();
    let _robot = lab.start("robot", |c| c.shares = vec![share("/chatter", &["desk"])]);
    let desk = lab.start("desk", |c| c.uses = vec![uses("/chatter")]);
    let talker = lab.talker("robot", "/chatter");
    let listener = lab.listener("desk", "/chatter");
    talker.wait_for_readers(1);
    warm_up(&talker, &[&listener]);
    let stream = Stream::start(talker);
    stream.more(200);

    let second = twin(&lab, "desk", |c| c.uses = vec![uses("/chatter")]);
    wait("the first says that it is displaced", || !alerts(&desk, "displaced").is_empty());
    wait("the router says that there are two", || !alerts(&cloud, "peer_identity_in_use").is_empty());
    wait("the second says that the first is kept out", || !alerts(&second, "identity_in_use").is_empty());
    assert!(cloud.drops("identity_in_use") > 0);
    for (node, kind) in [(&desk, "displaced"), (&second, "identity_in_use")] {
        let alert = &alerts(node, kind)[0];
        assert_eq!(alert["node"], "desk");
        assert!(alert["place"].as_str().unwrap().starts_with("127.0.0.1:"), "{alert}");
    }
    let router = desk.status()["routers"][0].clone();
    assert_eq!(router["state"], "standing back", "{router}");
    assert!(router["last_failure"].as_str().unwrap().contains("in use at another place"), "{router}");
    let mut heard_all = heard(&listener);
    stream.more(3000);
    assert_eq!((links(&desk), links(&second)), (0, 1));
    let id = lab.id("desk").to_string();
    let linked =
        lab.audit("cloud").iter().filter(|r| r.event == "link_up" && r.peer.as_ref() == Some(&id)).count();
    assert!(linked <= 6, "{linked} links: the patience of the displaced grows");

    second.stop();
    wait("the first has its link back", || links(&desk) == 1);
    let of_second = heard(&listener);
    assert!(of_second.len() > 2000, "the second gave {} messages", of_second.len());
    heard_all.extend(of_second);
    let deadline = Instant::now() + PATIENCE;
    let mut since_back = Vec::new();
    while since_back.len() < 500 {
        assert!(Instant::now() < deadline, "the topic is not back: {}", desk.route_state());
        since_back.push(number(&listener.samples.recv_timeout(PATIENCE).unwrap()));
    }
    let (_talker, last) = stream.end();
    while since_back.last() != Some(&last) {
        since_back.push(number(&listener.samples.recv_timeout(PATIENCE).unwrap()));
    }
    heard_all.extend(since_back);
    assert!(heard_all.windows(2).all(|two| two[0] < two[1]), "twice or out of order");
}

#[test]
fn a_process_that_is_started_again_takes_over_at_once() {
    let lab = Lab::new(&["robot", "desk"]);
    let cloud = lab.cloud();
    let desk = lab.start("desk", |_| {});
    wait("a link", || links(&desk) == 1);
    let second = twin(&lab, "desk", |_| {});
    wait("it is displaced", || links(&desk) == 0 && !alerts(&cloud, "peer_identity_in_use").is_empty());
    // It is killed and restarted while the other lives; without that, it would wait for seconds by now.
    desk.kill();
    let begun = Instant::now();
    let desk = lab.start("desk", |_| {});
    wait("it has its link", || links(&desk) == 1);
    assert!(begun.elapsed() < Duration::from_secs(5), "{:?}", begun.elapsed());
    wait("the other is displaced", || !alerts(&second, "displaced").is_empty());
}

#[test]
fn a_node_whose_certificate_has_not_begun_waits_and_says_so() {
    const EARLY: Duration = Duration::from_secs(8);
    let lab = Lab::new(&[]);
    let cloud = lab.cloud();
    // To a clock that is behind, any certificate looks like this one. Fleets start certificates ten minutes early.
    let begins = unix_now().0 + (sgc_trust::CLOCK_SKEW + EARLY).as_millis() as u64;
    let request =
        |request: &mut EnrollRequest| *request = EnrollRequest::new(request.node.clone(), UnixMillis(begins));
    lab.enroll("robot", request);
    sgc_node::check_identity(&lab.config("robot")).unwrap();
    let robot = lab.start("robot", |_| {});
    wait("it says so", || !alerts(&robot, "clock_before_certificate").is_empty());
    wait("the router counts it", || cloud.refused("not_yet_valid") > 0);
    let failure = || robot.status()["routers"][0]["last_failure"].as_str().unwrap_or_default().to_owned();
    wait("it is told by the router", || failure().contains("compare the clocks"));
    wait("it is linked once the clock is there", || links(&robot) == 1);
    assert_eq!(alerts(&robot, "clock_before_certificate"), [] as [serde_json::Value; 0]);
}

#[test]
fn a_clock_two_hours_ahead_is_named_by_the_router_and_told_the_time_there() {
    let lab = Lab::new(&["robot"]);
    let cloud = lab.cloud();
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let _inside = runtime.enter();
    let dialer =
        Dialer::new(lab.identity("robot"), LinkOptions::default(), Arc::new(TransportMetrics::default()));
    let time = UnixMillis(unix_now().0 + 2 * HOUR_MS);
    let link = runtime.block_on(dialer.dial(&lab.url().parse().unwrap())).unwrap();
    let told = runtime.block_on(async {
        let hello = Hello { minor: 0, incarnation: 1, transit: false, yields: false, started: time };
        for frame in [Control::Hello(hello), Control::Clock { time }] {
            link.send_control(frame.to_bytes()).await.unwrap();
        }
        loop {
            if let Ok(Control::Clock { time }) = Control::from_slice(&link.recv_control().await.unwrap()) {
                return time;
            }
        }
    });
    assert!(told.0.abs_diff(unix_now().0) < HOUR_MS);
    wait("the router says whose clock it is", || !alerts(&cloud, "clocks_differ").is_empty());
    let alert = &alerts(&cloud, "clocks_differ")[0];
    let ahead = alert["ahead_ms"].as_i64().unwrap();
    assert!((ahead - 2 * HOUR_MS as i64).abs() < 60_000, "{alert}");
    assert!(
        alert["remote"].as_str().unwrap().starts_with("127.0.0.1:") && alert["peer"].is_string(),
        "{alert}"
    );
    assert_eq!(cloud.drops("clocks_differ"), 1);
    drop(link);
    wait("it is gone with the link", || alerts(&cloud, "clocks_differ").is_empty());
}
