//! Pushes of metrics by OTLP (`otlp` in `[metrics]`), as a collector gets them.

#![allow(clippy::unwrap_used)]

mod support;

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::fs;
use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::thread;
use std::time::{Duration, Instant};

use serde_json::Value;
use sgc_config::{MetricsConfig, OtlpConfig};
use sgc_wire::Qos;
use support::*;

/// An interval after which no test waits.
const NEVER: Duration = Duration::from_secs(3600);
/// An answer that takes everything.
const TAKEN: &str = "HTTP/1.1 200 OK\r\ncontent-length: 0\r\n\r\n";

/// A collector that gives one answer to all, and does not look at the metrics.
struct Collector {
    at: SocketAddr,
    /// The head of each request, and when it came.
    requests: Receiver<(Instant, String)>,
}

impl Collector {
    fn new(answer: impl Fn(usize) -> String + Send + 'static) -> Self {
        Self::at(TcpListener::bind("127.0.0.1:0").unwrap(), answer)
    }

    /// `answer` gets the number of the request. An empty answer keeps the connection open.
    fn at(listener: TcpListener, answer: impl Fn(usize) -> String + Send + 'static) -> Self {
        let at = listener.local_addr().unwrap();
        let (send, requests) = channel();
        thread::spawn(move || {
            let mut open = Vec::new();
            for (n, stream) in listener.incoming().enumerate() {
                let mut stream = stream.unwrap();
                // A node that ends or is told to push elsewhere leaves.
                let Some(head) = read_request(&mut stream) else { continue };
                if send.send((Instant::now(), head)).is_err() {
                    return;
                }
                let answer = answer(n);
                let _ = stream.write_all(answer.as_bytes());
                if answer.is_empty() {
                    open.push(stream);
                }
            }
        });
        Self { at, requests }
    }

    fn next(&self) -> (Instant, String) {
        self.requests.recv_timeout(PATIENCE).expect("a request")
    }
}

/// Reads a request. Returns its head in small letters.
fn read_request(stream: &mut TcpStream) -> Option<String> {
    let (mut head, mut byte) = (Vec::new(), [0]);
    while !head.ends_with(b"\r\n\r\n") {
        stream.read_exact(&mut byte).ok()?;
        head.push(byte[0]);
    }
    let head = String::from_utf8(head).unwrap().to_ascii_lowercase();
    let length = head.split("content-length: ").nth(1).unwrap().lines().next().unwrap();
    let mut body = vec![0; length.parse().unwrap()];
    stream.read_exact(&mut body).ok()?;
    assert!(!body.is_empty());
    Some(head)
}

fn pushes_to(at: SocketAddr, interval: Duration) -> Option<MetricsConfig> {
    let otlp = OtlpConfig { interval, ..OtlpConfig::new(format!("http://{at}").parse().unwrap()) };
    Some(MetricsConfig { listen: ([127, 0, 0, 1], 0).into(), otlp: Some(otlp) })
}

/// Returns the reason of the alert; empty if there is none.
fn fault(node: &Node) -> String {
    let status = node.status();
    let alerts = status["alerts"].as_array().unwrap();
    let alert = alerts.iter().find(|alert| alert["kind"] == "metrics_not_pushed");
    alert.map(|alert| alert["reason"].as_str().unwrap().to_owned()).unwrap_or_default()
}

#[test]
fn collector_that_comes_late_gets_the_metrics() {
    let trio = Trio::new();
    let free = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let cloud = trio.cloud_with(|config| config.metrics = pushes_to(free, NEVER));
    wait("an alert", || fault(&cloud).contains("no connection"));
    let status = cloud.status()["otlp"].clone();
    assert_eq!(status["to"], format!("http://{free}/v1/metrics"));
    assert!(status["failed"]["unreachable"].as_u64() >= Some(1), "{status}");
    assert_eq!(status["accepted_ago_s"], Value::Null);
    let collector = Collector::at(TcpListener::bind(free).unwrap(), |_| TAKEN.to_owned());
    let (_, head) = collector.next();
    assert!(head.starts_with("post /v1/metrics http/1.1\r\n"), "{head}");
    assert!(head.contains("content-type: application/x-protobuf\r\n"), "{head}");
    wait("the alert is gone", || fault(&cloud).is_empty());
    let status = cloud.status()["otlp"].clone();
    assert_eq!((&status["accepted"], &status["fault"]), (&Value::from(1), &Value::Null));
    assert!(status["accepted_ago_s"].is_u64(), "{status}");
}

#[test]
fn busy_collector_is_asked_again_when_it_says() {
    let trio = Trio::new();
    let busy = "HTTP/1.1 503 Busy\r\nretry-after: 2\r\ncontent-length: 0\r\n\r\n";
    let answer = move |n| if n == 0 { busy } else { TAKEN }.to_owned();
    let collector = Collector::new(answer);
    let cloud = trio.cloud_with(|config| config.metrics = pushes_to(collector.at, NEVER));
    let (first, _) = collector.next();
    let (second, _) = collector.next();
    let waited = second - first;
    assert!(waited >= Duration::from_secs(2), "{waited:?}");
    wait("it is taken", || cloud.status()["otlp"]["accepted"] == 1);
    assert_eq!(cloud.status()["otlp"]["failed"]["busy"], 1);
    assert_eq!(fault(&cloud), "");
}

#[test]
fn refusal_is_shown_with_its_reason_until_a_push_is_taken() {
    let trio = Trio::new();
    let collector = Collector::new(|n| match n {
        0 => "HTTP/1.1 400 Bad\r\ncontent-type: text/plain\r\ncontent-length: 8\r\n\r\nno tenan".to_owned(),
        1 => "HTTP/1.1 302 Found\r\nlocation: http://a.example/\r\ncontent-length: 0\r\n\r\n".to_owned(),
        _ => TAKEN.to_owned(),
    });
    let cloud = trio.cloud_with(|config| config.metrics = pushes_to(collector.at, Duration::from_secs(3)));
    wait("it is refused", || fault(&cloud) == "it refuses (status 400): no tenan");
    wait("it is redirected", || fault(&cloud).starts_with("it redirects (status 302) to http://a.example/"));
    wait("it is taken", || fault(&cloud).is_empty());
    let failed = cloud.status()["otlp"]["failed"].clone();
    assert_eq!((&failed["refused"], &failed["redirected"]), (&Value::from(1), &Value::from(1)), "{failed}");
}

#[test]
fn collector_that_hangs_holds_up_neither_the_node_nor_a_reload() {
    let trio = Trio::new();
    let hanging = Collector::new(|_| String::new());
    let cloud = trio.cloud_with(|config| config.metrics = pushes_to(hanging.at, Duration::from_secs(1)));
    let (asked, _) = hanging.next();
    let other = Collector::new(|_| TAKEN.to_owned());
    let report = cloud.reload(|config| config.metrics = pushes_to(other.at, NEVER));
    assert!(
        report.to_string().contains(&format!("metrics are to be pushed to http://{}", other.at)),
        "{report}"
    );
    let (taken, _) = other.next();
    // The one that hangs is given up after 10 s only, and gets no second request meanwhile.
    assert!(taken - asked < Duration::from_secs(8), "{:?}", taken - asked);
    assert!(hanging.requests.try_recv().is_err());
    let report = cloud.reload(|config| config.metrics = None);
    assert!(report.to_string().contains("metrics are not pushed any more"), "{report}");
    wait("nothing is pushed", || cloud.status()["otlp"].is_null());
}

#[test]
fn token_is_read_anew_for_each_push_and_only_from_a_private_file() {
    let trio = Trio::new();
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("collector.headers");
    let write = |token: &str, mode| {
        let new = dir.path().join("new");
        fs::write(&new, format!("Authorization: Bearer {token}\n")).unwrap();
        fs::set_permissions(&new, fs::Permissions::from_mode(mode)).unwrap();
        fs::rename(&new, &path).unwrap();
    };
    write("first", 0o600);
    let collector = Collector::new(|_| TAKEN.to_owned());
    let cloud = trio.cloud_with(|config| {
        config.metrics = pushes_to(collector.at, Duration::from_secs(1));
        let otlp = config.metrics.as_mut().and_then(|metrics| metrics.otlp.as_mut()).unwrap();
        otlp.headers_file = Some(path.clone());
    });
    assert!(collector.next().1.contains("authorization: bearer first\r\n"));
    write("second", 0o600);
    wait("the new token is sent", || collector.next().1.contains("authorization: bearer second\r\n"));
    write("third", 0o644);
    wait("it is refused", || fault(&cloud).contains("others than its owner have access to it (mode 0644)"));
    assert!(!cloud.status().to_string().contains("third"));
    while let Ok((_, head)) = collector.requests.try_recv() {
        assert!(!head.contains("third"), "{head}");
    }
    write("fourth", 0o600);
    wait("the new token is sent", || collector.next().1.contains("authorization: bearer fourth\r\n"));
}

/// A collector in Python, with the messages that OpenTelemetry publishes.
struct Python {
    child: Child,
    at: SocketAddr,
    requests: Receiver<Value>,
}

impl Python {
    fn new() -> Self {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        let mut child = Command::new(root.join(".venv/bin/python"))
            .args(["-B".as_ref(), root.join("tests/peers/py/otlp_collector.py").as_os_str()])
            .stdout(Stdio::piped())
            .spawn()
            .expect("`make peers` installs Python");
        let mut lines = BufReader::new(child.stdout.take().unwrap()).lines().map(Result::unwrap);
        let port: u16 = lines.next().unwrap().parse().unwrap();
        let (send, requests) = channel();
        thread::spawn(move || {
            for line in lines {
                let _ = send.send(serde_json::from_str(&line).unwrap());
            }
        });
        Self { child, at: ([127, 0, 0, 1], port).into(), requests }
    }
}

impl Drop for Python {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Returns the text for Prometheus without comments, by series, and the types by name.
fn scrape(node: &Node) -> (BTreeMap<String, f64>, BTreeMap<String, String>) {
    let url = node.status()["metrics"].as_str().unwrap().to_owned();
    let at: SocketAddr =
        url.strip_prefix("http://").unwrap().strip_suffix("/metrics").unwrap().parse().unwrap();
    let mut stream = TcpStream::connect(at).unwrap();
    stream
        .write_all(format!("GET /metrics HTTP/1.1\r\nHost: {at}\r\nConnection: close\r\n\r\n").as_bytes())
        .unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    let (mut series, mut types) = (BTreeMap::new(), BTreeMap::new());
    for line in answer.split_once("\r\n\r\n").unwrap().1.lines() {
        if let Some(of) = line.strip_prefix("# TYPE ") {
            let (name, kind) = of.rsplit_once(' ').unwrap();
            types.insert(name.to_owned(), kind.to_owned());
        } else if !line.starts_with('#') {
            let (name, value) = line.rsplit_once(' ').unwrap();
            series.insert(name.to_owned(), value.parse().unwrap());
        }
    }
    (series, types)
}

fn value_of(point: &Value) -> f64 {
    point["value"].as_str().unwrap().parse().unwrap()
}

/// Returns the values of a push by series, as Prometheus writes these.
fn series_of(push: &Value) -> BTreeMap<String, f64> {
    let mut series = BTreeMap::new();
    for metric in push["metrics"].as_array().unwrap() {
        for point in metric["points"].as_array().unwrap() {
            let label = |label: &Value| format!("{}={}", label[0].as_str().unwrap(), label[1]);
            let labels: Vec<_> = point["labels"].as_array().unwrap().iter().map(label).collect();
            let name = format!("{}{{{}}}", metric["name"].as_str().unwrap(), labels.join(","));
            assert!(series.insert(name, value_of(point)).is_none());
        }
    }
    series
}

#[test]
#[ignore = "needs Python (`make interop`)"]
fn independent_collector_sees_the_values_of_a_scrape_at_that_moment() {
    let python = Python::new();
    let trio = Trio::new();
    let cloud = trio.cloud();
    let robot = trio.robot(&["/chatter"], "desk");
    let desk = trio.desk(&["/chatter"]);
    let talker = Talker::new(&trio.robot_net, "/chatter", Qos::default());
    let listener = Listener::new(&trio.desk_net, "/chatter", Qos::default());
    listener.hears_at_last(|n| talker.say(format!("{n}")));
    robot.reload(|config| config.metrics = pushes_to(python.at, Duration::from_secs(2)));

    // A scrape within a second of the push is of the same moment.
    const MOMENT: &str = r#"sgc_uptime_seconds{node="robot"}"#;
    let same = RefCell::new(None);
    wait("a push and a scrape of one moment", || {
        let push = python.requests.recv_timeout(PATIENCE).unwrap();
        let (scraped, types) = scrape(&robot);
        let pushed = series_of(&push);
        let is_same =
            pushed[MOMENT] == scraped[MOMENT] && pushed[r#"sgc_links{node="robot",side="dialled"}"#] == 1.0;
        *same.borrow_mut() = is_same.then_some((push, pushed, scraped, types));
        is_same
    });
    let (push, pushed, scraped, types) = same.take().unwrap();
    assert_eq!(pushed, scraped);
    let route =
        r#"sgc_route_messages_total{node="robot",direction="share",interface="/chatter",owner="robot"}"#;
    assert!(pushed[route] >= 1.0, "{pushed:#?}");
    assert!(pushed.contains_key(r#"sgc_otlp_pushes_total{node="robot",result="accepted"}"#));

    let metrics = push["metrics"].as_array().unwrap();
    assert_eq!(metrics.len(), types.len());
    let started = metrics.iter().find(|metric| metric["name"] == "process_start_time_seconds").unwrap();
    let started = value_of(&started["points"][0]);
    for metric in metrics {
        let name = metric["name"].as_str().unwrap();
        let is_counter = types[name] == "counter";
        assert_eq!(metric["kind"], if is_counter { "sum" } else { "gauge" }, "{name}");
        assert!(!metric["help"].as_str().unwrap().contains('`'), "{metric}");
        let has_unit =
            ["_seconds", "_bytes"].iter().any(|end| name.trim_end_matches("_total").ends_with(end));
        assert_eq!(metric["unit"] != "", has_unit, "{metric}");
        for point in metric["points"].as_array().unwrap() {
            let (start, time) = (point["start"].as_u64().unwrap(), point["time"].as_u64().unwrap());
            assert_eq!(time, metrics[0]["points"][0]["time"].as_u64().unwrap(), "all are of one moment");
            assert!(start <= time && (start > 0) == is_counter, "{metric}");
        }
    }
    let bytes = metrics.iter().find(|metric| metric["name"] == "sgc_sent_bytes_total").unwrap();
    let since = bytes["points"][0]["start"].as_u64().unwrap() as f64 / 1e9;
    assert!((since - started).abs() < 0.001, "it counts since {since}, and the node began at {started}");

    assert_eq!((&push["path"], &push["authorization"]), (&Value::from("/v1/metrics"), &Value::Null));
    let version = env!("CARGO_PKG_VERSION");
    assert_eq!(push["user_agent"], format!("sgc/{version}"));
    assert_eq!(push["scope"], serde_json::json!(["sgc", version]));
    let expected = serde_json::json!({
        "service.name": "sgc",
        "service.instance.id": push["resource"]["service.instance.id"],
        "service.version": version,
        "sgc.node.name": "robot",
        "sgc.fleet.name": "lab",
    });
    assert_eq!(push["resource"], expected);
    // The desk has ended, so the router's only link is to the robot.
    drop(desk);
    wait("one link", || cloud.status()["links"].as_array().unwrap().len() == 1);
    assert_eq!(cloud.status()["links"][0]["peer"], expected["service.instance.id"]);
}
