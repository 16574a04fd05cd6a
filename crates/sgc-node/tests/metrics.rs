//! The server of metrics and health (`[metrics]`), as a scraper meets it.

#![allow(clippy::unwrap_used)]

mod support;

use std::cell::Cell;
use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::time::{Duration, Instant};

use sgc_config::MetricsConfig;
use sgc_wire::Qos;
use support::*;

/// An answer over HTTP/1.1.
struct Answer {
    status: u16,
    head: String,
    body: String,
}

fn exchange(at: SocketAddr, request: &str) -> Answer {
    let mut stream = TcpStream::connect(at).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    stream.write_all(request.as_bytes()).unwrap();
    let mut text = String::new();
    stream.read_to_string(&mut text).unwrap();
    let (head, body) = text.split_once("\r\n\r\n").unwrap();
    let status = head.split(' ').nth(1).unwrap().parse().unwrap();
    Answer { status, head: head.to_ascii_lowercase(), body: body.to_owned() }
}

fn ask(at: SocketAddr, method: &str, path: &str, host: &str) -> Answer {
    exchange(at, &format!("{method} {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n"))
}

fn get(at: SocketAddr, path: &str) -> Answer {
    ask(at, "GET", path, &at.to_string())
}

/// Returns all values by series, which are different.
fn scrape(at: SocketAddr) -> BTreeMap<String, f64> {
    let answer = get(at, "/metrics");
    assert_eq!(answer.status, 200, "{}", answer.body);
    assert!(answer.head.contains("content-type: text/plain; version=0.0.4"), "{}", answer.head);
    let mut series = BTreeMap::new();
    for line in answer.body.lines().filter(|line| !line.starts_with('#')) {
        let (name, value) = line.rsplit_once(' ').unwrap();
        assert!(series.insert(name.to_owned(), value.parse().unwrap()).is_none(), "twice: {name}");
    }
    series
}

fn served_at(node: &Node) -> SocketAddr {
    let found = Cell::new(None);
    wait("metrics are served", || {
        let status = node.status();
        let address = |url: &str| url.strip_prefix("http://")?.strip_suffix("/metrics")?.parse().ok();
        found.set(status["metrics"].as_str().and_then(address));
        found.get().is_some()
    });
    found.get().unwrap()
}

fn anywhere() -> Option<MetricsConfig> {
    Some(MetricsConfig { listen: ([127, 0, 0, 1], 0).into(), ..MetricsConfig::default() })
}

#[test]
fn topics_links_and_drops_are_counted() {
    let trio = Trio::new();
    let cloud = trio.cloud_with(|config| config.metrics = anywhere());
    let robot = trio.robot(&["/chatter"], "desk");
    let desk = trio.desk(&["/chatter"]);
    robot.reload(|config| config.metrics = anywhere());
    desk.reload(|config| config.metrics = anywhere());
    let [cloud, robot, desk] = [&cloud, &robot, &desk].map(served_at);
    let url = format!("quic://127.0.0.1:{}", trio.port);
    let talker = Talker::new(&trio.robot_net, "/chatter", Qos::default());
    let listener = Listener::new(&trio.desk_net, "/chatter", Qos::default());
    listener.hears_at_last(|n| talker.say(format!("{n}")));

    let here = scrape(robot);
    let of = |name: &str| here.get(name).copied();
    assert_eq!(of(r#"sgc_links{node="robot",side="dialled"}"#), Some(1.0), "{here:#?}");
    assert_eq!(of(&format!(r#"sgc_router_linked{{node="robot",router="{url}"}}"#)), Some(1.0));
    assert!(of(&format!(r#"sgc_router_round_trip_seconds{{node="robot",router="{url}"}}"#)) > Some(0.0));
    let route = r#"{node="robot",direction="share",interface="/chatter",owner="robot"}"#;
    assert_eq!(of(&format!("sgc_route_ready{route}")), Some(1.0));
    let published = of(&format!("sgc_route_messages_total{route}")).unwrap();
    assert!(published >= 1.0);
    assert!(of(r#"sgc_sent_bytes_total{node="robot"}"#) > Some(100.0));
    assert!(of(r#"process_resident_memory_bytes{node="robot"}"#) > Some(1e6));

    let there = scrape(desk);
    let route = r#"{node="desk",direction="use",interface="/chatter",owner="robot"}"#;
    assert!(there[&format!("sgc_route_messages_total{route}")] >= 1.0);
    let between = scrape(cloud);
    assert_eq!(between[r#"sgc_links{node="cloud",side="accepted"}"#], 2.0);
    assert!(between[r#"sgc_known_names{node="cloud"}"#] >= 1.0);
    // Nothing names the topic at a router.
    assert!(!between.keys().any(|series| series.contains("/chatter")));
    let ready: Vec<_> = [cloud, robot, desk].map(|at| get(at, "/readyz").status).into();
    assert_eq!(ready, [200, 200, 200]);
}

#[test]
fn node_without_its_router_is_alive_and_not_ready() {
    let trio = Trio::new();
    let cloud = trio.cloud();
    let robot = trio.robot(&["/chatter"], "desk");
    robot.reload(|config| config.metrics = anywhere());
    let at = served_at(&robot);
    wait("it is linked", || get(at, "/readyz").status == 200);
    let before = scrape(at);
    cloud.kill();
    wait("it is not ready", || get(at, "/readyz").status == 503);
    assert_eq!(get(at, "/readyz").body, "no router is linked\n");
    assert_eq!((get(at, "/healthz").status, get(at, "/healthz").body.as_str()), (200, "ok\n"));
    // Bytes over links that have ended count on.
    let after = scrape(at);
    let sent = r#"sgc_sent_bytes_total{node="robot"}"#;
    assert!(after[sent] >= before[sent], "{} < {}", after[sent], before[sent]);
    assert_eq!(after[r#"sgc_links{node="robot",side="dialled"}"#], 0.0);
}

#[test]
fn requests_that_no_scraper_sends_are_refused() {
    let trio = Trio::new();
    let cloud = trio.cloud_with(|config| config.metrics = anywhere());
    let at = served_at(&cloud);
    for (host, status) in [
        ("localhost:1", 200),
        ("LOCALHOST", 200),
        ("127.0.0.1", 200),
        ("[::1]:9464", 200),
        ("evil.example", 421),
        ("127.0.0.1.evil.example:9464", 421),
        ("", 421),
    ] {
        assert_eq!(ask(at, "GET", "/metrics", host).status, status, "{host}");
    }
    let post = ask(at, "POST", "/metrics", "localhost");
    assert!(post.status == 405 && post.head.contains("allow: get, head"), "{}", post.head);
    let head = ask(at, "HEAD", "/metrics", "localhost");
    assert_eq!((head.status, head.body.as_str()), (200, ""));
    assert_eq!(get(at, "/metric").status, 404);
    assert_eq!(exchange(at, "GET / HTTP/1.1\r\nHost: a\r\nbroken\r\n\r\n").status, 400);
    // Each reason has a series before its first event, or its first increase would not be seen.
    assert_eq!(scrape(at)[r#"sgc_drops_total{node="cloud",reason="sink_lost"}"#], 0.0);
    let long = format!("GET / HTTP/1.1\r\nHost: localhost\r\nx: {}\r\n\r\n", "x".repeat(1 << 16));
    assert_eq!(exchange(at, &long).status, 431);
    // Clients that send nothing, or a part of a request, do not keep others out.
    let silent: Vec<_> = (0..64).map(|_| TcpStream::connect(at).unwrap()).collect();
    let slow = silent.iter().filter_map(|mut stream| stream.write_all(b"GET /metrics HTTP/1.1\r\n").ok());
    assert!(slow.count() > 0);
    let begun = Instant::now();
    assert_eq!(get(at, "/metrics").status, 200);
    assert!(begun.elapsed() < Duration::from_secs(8), "it did not wait until one of them was given up");
    drop(silent);
}

#[test]
fn metrics_are_served_once_a_taken_port_is_free() {
    let trio = Trio::new();
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let listen = taken.local_addr().unwrap();
    let cloud =
        trio.cloud_with(|config| config.metrics = Some(MetricsConfig { listen, ..MetricsConfig::default() }));
    let alert = || cloud.status()["alerts"][0].clone();
    wait("an alert", || alert()["kind"] == "metrics_not_served");
    assert_eq!(alert()["at"], listen.to_string());
    assert_eq!(cloud.status()["metrics"], serde_json::Value::Null);
    drop(taken);
    assert_eq!(served_at(&cloud), listen);
    assert_eq!(cloud.status()["alerts"], serde_json::json!([]));
    // A reload moves it, and ends it.
    let report = cloud.reload(|config| config.metrics = anywhere());
    assert!(report.to_string().contains("metrics are to be served"), "{report}");
    wait("it has moved", || served_at(&cloud) != listen);
    let elsewhere = served_at(&cloud);
    assert_eq!(get(elsewhere, "/").status, 200);
    cloud.reload(|config| config.metrics = None);
    wait("it has ended", || cloud.status()["metrics"].is_null());
    wait("nobody listens", || TcpStream::connect_timeout(&elsewhere, Duration::from_secs(1)).is_err());
}
