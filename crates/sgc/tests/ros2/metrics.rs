//! Metrics of a node with real ROS 2, as Prometheus itself scrapes them.

use std::fs;
use std::io::Write;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};

use rustix::process::Signal;
use serde_json::Value;

use crate::lab::{Lab, Site, robot_to_desk};
use crate::support::{self, eventually, repository};
use crate::{PAIRS, PLAN};

/// The variables of the dashboard, and values for them.
const VARIABLES: [(&str, &str); 2] = [("$node", ".*"), ("$__rate_interval", "1m")];

fn tool(name: &str) -> PathBuf {
    repository(".peers/prometheus").join(name)
}

/// Prometheus in the desk's network. It ends when this is dropped.
struct Prometheus {
    child: Child,
    url: String,
}

impl Prometheus {
    /// Starts it with a scrape of the desk's node each second, and the alert rules of this repository.
    fn start(lab: &Lab, node: &str) -> Self {
        let config = format!(
            "global: {{scrape_interval: 1s, evaluation_interval: 1s}}\nrule_files: ['{}']\n\
             scrape_configs: [{{job_name: sgc, static_configs: [{{targets: ['{node}']}}]}}]\n",
            repository("dist/prometheus/alerts.yml").display()
        );
        fs::write(lab.dir().join("prometheus.yml"), config).unwrap();
        let at = format!("127.0.0.1:{}", sgc_testkit::unused_port());
        let mut command = support::command(lab.namespace(Site::Desk), lab.dir(), &tool("prometheus"));
        command.args(["--config.file=prometheus.yml", "--storage.tsdb.path=tsdb"]);
        command.arg(format!("--web.listen-address={at}"));
        let log = fs::File::create(lab.dir().join("prometheus.log")).unwrap();
        let child = command.stdout(Stdio::null()).stderr(log).spawn().unwrap();
        Self { child, url: format!("http://{at}") }
    }

    /// Returns the values of an expression, or `None` while Prometheus does not answer.
    fn query(&self, lab: &Lab, expression: &str) -> Option<Vec<f64>> {
        let mut command = promtool(lab);
        let output =
            command.args(["query", "instant", "-o", "json", "--", &self.url, expression]).output().unwrap();
        if !output.status.success() {
            let error = String::from_utf8_lossy(&output.stderr).into_owned();
            assert!(!error.contains("bad_data"), "{expression}: {error}");
            return None;
        }
        let found: Value = serde_json::from_slice(&output.stdout).unwrap();
        let value = |row: &Value| row["value"][1].as_str().unwrap().parse().unwrap();
        Some(found.as_array().unwrap().iter().map(value).collect())
    }
}

impl Drop for Prometheus {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn promtool(lab: &Lab) -> Command {
    support::command(lab.namespace(Site::Desk), lab.dir(), &tool("promtool"))
}

#[test]
fn prometheus_scrapes_the_messages_of_ros_2_and_sees_a_node_die() {
    let [robot, desk] = robot_to_desk("topic", ["/load"]);
    let node = format!("127.0.0.1:{}", sgc_testkit::unused_port());
    let mut lab = Lab::silent(PLAN, [robot, format!("{desk}[metrics]\nlisten = \"{node}\"\n")]);
    for site in [Site::Robot, Site::Desk] {
        lab.reconfigure(site, "discovery_range = \"localhost\"", "discovery_range = \"subnet\"");
    }
    // Without one the node has an alert.
    lab.reconfigure(Site::Desk, "[node]\n", "[node]\nstate = \"desk.state\"\n");
    lab.start_all();
    let prometheus = Prometheus::start(&lab, &node);
    let [talks, listens] = PAIRS[0];
    let common = ["--topic", "/load", "--timeout", PLAN.peer_life];
    let mut listener = lab.load(Site::Desk, listens, &[&["sub"], &common[..]].concat());
    let talk = [&["pub", "--count", "0", "--rate", "50"], &common[..]].concat();
    let _talker = lab.load(Site::Robot, talks, &talk);
    listener.wait_matched("a match at the desk");

    let messages = r#"sgc_route_messages_total{direction="use",interface="/load",owner="robot",node="desk"}"#;
    let first = |values: Option<Vec<f64>>| values.and_then(|values| values.first().copied());
    let is =
        |lab: &Lab, expression: &str, wanted: f64| first(prometheus.query(lab, expression)) == Some(wanted);
    eventually("messages are counted", || first(prometheus.query(&lab, messages)) > Some(100.0));
    for expression in ["up", "sgc_route_ready", "sgc_router_linked"] {
        assert!(is(&lab, expression, 1.0), "{expression}");
    }
    // Prometheus takes up to a second to see that the topic flows.
    eventually("no alert is pending", || prometheus.query(&lab, "ALERTS") == Some(Vec::new()));
    let dashboard: Value =
        serde_json::from_str(&fs::read_to_string(repository("dist/grafana/sgc.json")).unwrap()).unwrap();
    let panels = dashboard["panels"].as_array().unwrap();
    let targets = panels.iter().flat_map(|panel| panel["targets"].as_array().unwrap());
    let expressions: Vec<_> = targets.map(|target| target["expr"].as_str().unwrap()).collect();
    assert!(expressions.len() > 20);
    for expression in expressions {
        let expression =
            VARIABLES.iter().fold(expression.to_owned(), |text, (name, value)| text.replace(name, value));
        assert!(prometheus.query(&lab, &expression).is_some(), "{expression}");
    }

    lab.end(Site::Cloud, Signal::KILL);
    eventually("no router is linked", || is(&lab, "max by (node) (sgc_router_linked)", 0.0));
    eventually("an alert is pending", || {
        prometheus.query(&lab, r#"ALERTS{alertname="SgcNoRouter",alertstate="pending"}"#) == Some(vec![1.0])
    });
    lab.kill(Site::Desk);
    eventually("the node does not answer", || is(&lab, "up", 0.0));
}

#[test]
fn alert_rules_fire_when_they_should_and_metrics_are_named_well() {
    let dir = repository("dist/prometheus");
    let run = |args: &[&str]| {
        let output = Command::new(tool("promtool")).args(args).current_dir(&dir).output().unwrap();
        assert!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
    };
    run(&["check", "rules", "alerts.yml"]);
    run(&["test", "rules", "alerts.test.yml"]);
    // The conventions of Prometheus for names and units.
    let text = sgc_node::METRICS.iter().map(|metric| {
        let kind = if metric.name.ends_with("_total") { "counter" } else { "gauge" };
        format!("# HELP {0} Text.\n# TYPE {0} {kind}\n{0} 1\n", metric.name)
    });
    let mut lint = Command::new(tool("promtool"))
        .args(["check", "metrics"])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    lint.stdin.take().unwrap().write_all(text.collect::<String>().as_bytes()).unwrap();
    let linted = lint.wait_with_output().unwrap();
    assert!(linted.status.success(), "{}", String::from_utf8_lossy(&linted.stderr));
}
