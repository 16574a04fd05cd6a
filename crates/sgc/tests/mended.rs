//! Faults around a node that an operator mends while the node runs: a wrong clock, a certificate that has ended, a name
//! of the router that DNS does not know yet, a disk that is full or read-only. The log, `sgc status`, `sgc why` and `sgc check` name cause and remedy, and
//! the same process goes on once it is mended.

#![allow(clippy::unwrap_used)]

#[path = "../../sgc-node/tests/support/dns.rs"]
mod dns;
mod support;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use dns::DnsServer;
use serde_json::Value;
use sgc_testkit::netsim::Namespace;
use support::fake_clock::FakeClock;
use support::{Running, eventually, own_network, say_log};
use tempfile::TempDir;

/// ROS domain where the network is shared with other programs.
const DOMAIN: &str = "95";
const PORT: u16 = 7447;
const NO_TOPIC: &str = "no publisher of /chatter";

/// A topic that the desk shares, and one that it uses of a node that is not there.
const SHARED: &str = "/chatter";
const USED: &str = "/far";

/// A router and a desk in a network of their own.
struct Place {
    dir: TempDir,
    network: Option<Namespace>,
    /// The desk's clock, if it has one of its own.
    clock: Option<FakeClock>,
}

impl Place {
    fn new(test: &str) -> Self {
        let network = own_network(format!("sgcmend-{}-{test}", std::process::id()));
        Self { dir: tempfile::tempdir().unwrap(), network, clock: None }
    }

    /// Makes the fleet.
    fn enroll(&self) {
        for args in ["fleet create lab", "fleet enroll cloud --role router", "fleet enroll desk"] {
            let output = self.by_clock(&args.split(' ').collect::<Vec<_>>()).output().unwrap();
            assert!(output.status.success(), "{args}: {output:?}");
        }
    }

    fn file(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    fn set_clock(&mut self, offset: &str) {
        match &self.clock {
            Some(clock) => clock.set(offset),
            None => self.clock = Some(FakeClock::new(self.dir.path(), offset)),
        }
    }

    fn sgc(&self, args: &[&str]) -> Command {
        let mut command = support::sgc(self.network.as_ref(), self.dir.path());
        command.args(args);
        command
    }

    /// The same with the desk's clock.
    fn by_clock(&self, args: &[&str]) -> Command {
        let mut command = self.sgc(args);
        command.envs(self.clock.iter().flat_map(FakeClock::environment));
        command
    }

    fn port(&self) -> u16 {
        if self.network.is_some() { PORT } else { 20_000 + (std::process::id() % 10_000) as u16 }
    }

    fn start_cloud(&self) -> Running {
        let text = format!(
            "identity = \"cloud.identity\"\n[node]\nstate = \"cloud.state\"\n[admin]\nsocket = \"cloud.sock\"\n\
             [router]\nlisten = [\"quic://{}:{}\"]\n",
            if self.network.is_some() { "0.0.0.0" } else { "127.0.0.1" },
            self.port()
        );
        fs::write(self.file("cloud.toml"), text).unwrap();
        Running::start(self.sgc(&["run", "-c", "cloud.toml"]), &self.file("cloud.log"))
    }

    /// Starts the desk with a gateway. `prelude` prepares the disk that only the desk sees.
    fn start_desk_on(&self, prelude: &str, state: &str) -> Running {
        let text = format!(
            "identity = \"desk.identity\"\n[node]\n{state}\nrouters = [\"quic://127.0.0.1:{PORT}\"]\n\
             [admin]\nsocket = \"desk.sock\"\n[gateway]\nlisten = [\"wss://127.0.0.1:9443\"]\n\
             [ros]\ndomain_id = 0\ndiscovery_range = \"localhost\"\nstatic_peers = []\n\
             [[share]]\ntopic = \"{SHARED}\"\nto = [\"*\"]\n"
        );
        fs::write(self.file("desk.toml"), text).unwrap();
        Running::start(self.sgc_on(prelude, &["run", "-c", "desk.toml"]), &self.file("desk.log"))
    }

    /// Returns the command with a disk that only it sees.
    fn sgc_on(&self, prelude: &str, args: &[&str]) -> Command {
        let mut command = support::command(self.network.as_ref(), self.dir.path(), Path::new("sh"));
        command.args(["-c", &format!("{prelude} && exec \"$@\""), "sh", env!("CARGO_BIN_EXE_sgc")]);
        command.args(args).env("SGC_ALLOW_CORE_DUMPS", "1");
        command
    }

    /// Returns the pin that the log of the desk names.
    fn pin(&self) -> String {
        let log = self.log();
        let (_, pin) = log.split_once("a certificate with the pin ").unwrap();
        pin.split(' ').next().unwrap().to_owned()
    }

    fn has_alert(&self, kind: &str) -> bool {
        self.status()["alerts"].as_array().is_some_and(|all| all.iter().any(|alert| alert["kind"] == kind))
    }

    /// Starts the desk, which dials a router at `host`.
    fn start_desk(&self, host: &str, node: &str) -> Running {
        let domain = if self.network.is_some() { "0" } else { DOMAIN };
        let text = format!(
            "identity = \"desk.identity\"\n[node]\nstate = \"desk.state\"\nrouters = [\"quic://{host}:{}\"]\n{node}\n\
             [admin]\nsocket = \"desk.sock\"\n\
             [ros]\ndomain_id = {domain}\ndiscovery_range = \"localhost\"\nstatic_peers = []\n\
             [[share]]\ntopic = \"{SHARED}\"\nto = [\"*\"]\n[[use]]\ntopic = \"{USED}\"\nfrom = \"robot\"\n",
            self.port()
        );
        fs::write(self.file("desk.toml"), text).unwrap();
        Running::start(self.by_clock(&["run", "-c", "desk.toml"]), &self.file("desk.log"))
    }

    fn log(&self) -> String {
        fs::read_to_string(self.file("desk.log")).unwrap_or_default()
    }

    /// The text with which a command answers about the desk, on both outputs.
    fn asked(&self, args: &[&str]) -> String {
        let output = self.by_clock(args).args(["-c", "desk.toml"]).output().unwrap();
        String::from_utf8([output.stdout, output.stderr].concat()).unwrap()
    }

    fn status(&self) -> Value {
        serde_json::from_str(&self.asked(&["status", "--json"])).unwrap_or_default()
    }

    fn is_linked(&self) -> bool {
        self.status()["links"].as_array().is_some_and(|links| links.len() == 1)
    }

    /// Asserts that log, `sgc status` and `sgc why` name the cause, and that the latter names the remedy.
    fn assert_told(&self, topic: &str, cause: &str, remedy: &str) {
        eventually(&format!("the log says {cause}"), || self.log().contains(cause));
        let said = |args: &[&str]| {
            let mut text = String::new();
            eventually(&format!("{args:?} says {cause}"), || {
                text = self.asked(args);
                text.contains(cause)
            });
            text
        };
        said(&["status"]);
        let why = said(&["why", topic]);
        assert!(why.contains(remedy), "{why}");
    }

    /// Asserts that nothing is wrong any more but that nobody publishes.
    fn assert_mended(&self) {
        eventually("the desk is linked", || self.is_linked());
        eventually("nothing else is wrong", || self.asked(&["why", SHARED]).contains(NO_TOPIC));
        assert_eq!(self.status()["alerts"], serde_json::json!([]));
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        if std::thread::panicking() {
            say_log("desk", &self.log());
            say_log("cloud", &fs::read_to_string(self.file("cloud.log")).unwrap_or_default());
        }
    }
}

#[test]
fn node_with_a_clock_days_behind_or_ahead_waits_and_goes_on_once_it_is_set() {
    let mut place = Place::new("clock");
    place.enroll();
    let _cloud = place.start_cloud();
    let set = "set the clock, for instance by NTP (`timedatectl`)";
    for (offset, cause, checked) in [
        ("-5d", "and this node's certificate begins at", "the clock is wrong. The node starts and waits"),
        ("+200d", "and this node's certificate ended at", "enroll again, or set the clock"),
    ] {
        place.set_clock(offset);
        let desk = place.start_desk("127.0.0.1", "");
        place.assert_told(SHARED, cause, set);
        let check = place.asked(&["check"]);
        assert!(check.contains(checked), "{check}");
        assert!(!place.is_linked());
        place.set_clock("+0");
        place.assert_mended();
        // It is wrong while the node runs: the link ends, and the cause is told again.
        if offset == "+200d" {
            place.set_clock(offset);
            eventually("the link ends", || !place.is_linked());
            place.assert_told(SHARED, cause, set);
            place.set_clock("+0");
            place.assert_mended();
        }
        drop(desk);
        fs::remove_file(place.file("desk.log")).unwrap();
    }
}

#[test]
fn clock_that_is_hours_ahead_of_the_router_is_told_and_forgotten_once_it_is_set() {
    let mut place = Place::new("hours");
    place.enroll();
    let _cloud = place.start_cloud();
    place.set_clock("+3h");
    let _desk = place.start_desk("127.0.0.1", "");
    place.assert_told(SHARED, "is 3 h 0 min behind the one here", "set the clock that is wrong");
    place.set_clock("+0");
    place.assert_mended();
}

#[test]
fn node_whose_certificate_has_ended_starts_and_goes_on_once_it_is_renewed() {
    let mut place = Place::new("renewed");
    place.set_clock("-100d");
    place.enroll();
    place.clock = None;
    let good = |args: &[&str]| {
        let output = place.sgc(args).output().unwrap();
        assert!(output.status.success(), "{args:?}: {output:?}");
    };
    good(&["fleet", "renew", "cloud"]);
    let _cloud = place.start_cloud();
    let _desk = place.start_desk("127.0.0.1", "");
    place.assert_told(
        SHARED,
        "and this node's certificate ended at",
        "renew the certificate with `sgc fleet renew`",
    );
    good(&["fleet", "renew", "desk"]);
    place.assert_mended();
}

#[test]
fn node_links_once_dns_knows_its_router() {
    let place = Place::new("dns");
    place.enroll();
    let _cloud = place.start_cloud();
    let start = || DnsServer::start();
    let server = match &place.network {
        Some(network) => network.within(start).unwrap(),
        None => start(),
    };
    let _desk = place.start_desk("router.lab.example", &format!("resolver = \"{}\"", server.addr));
    let remedy = "does `getent hosts NAME` find it on this machine?";
    place.assert_told(USED, "router.lab.example has no address in DNS", remedy);
    server.set_host("router.lab.example.", [127, 0, 0, 1]);
    place.assert_mended();
}

#[test]
fn node_without_a_dns_server_says_that_nobody_answers() {
    let place = Place::new("resolver");
    place.enroll();
    // Nobody listens there.
    let _desk = place.start_desk("router.lab.example", "resolver = \"127.0.0.1:9\"");
    place.assert_told(
        USED,
        "router.lab.example cannot be looked up",
        "look at the network and at the DNS servers",
    );
}

/// A state directory of 64 KiB without free space.
const FULL_DISK: &str = "mkdir -p desk.state && mount -t tmpfs -o size=64k,mode=700 tmpfs desk.state && \
                         { head -c 1M /dev/zero > desk.state/ballast 2> /dev/null || true; }";
/// The state directory of before on a read-only mount.
const READ_ONLY_DISK: &str = "mount --bind desk.state desk.state && mount -o remount,bind,ro desk.state";
const NOT_KEPT: &str = "nothing is kept over a restart";

#[test]
fn node_on_a_full_disk_runs_with_a_gateway_and_keeps_its_state_once_there_is_space() {
    let place = Place::new("full");
    if place.network.is_none() {
        return;
    }
    place.enroll();
    let _cloud = place.start_cloud();
    let desk = place.start_desk_on(FULL_DISK, "state = \"desk.state\"");
    place.assert_told(SHARED, NOT_KEPT, "free space on its disk");
    eventually("the desk is linked", || place.is_linked());
    eventually("the audit log is missed", || place.has_alert("audit_not_written"));
    let lost = |status: &Value| status["drops"]["audit_lost"].as_u64();
    eventually("lost records count", || lost(&place.status()).is_some_and(|lost| lost > 0));
    assert!(!place.pin().is_empty());
    let state = format!("/proc/{}/root{}", desk.pid(), place.file("desk.state").display());
    fs::remove_file(Path::new(&state).join("ballast")).unwrap();
    eventually("the alerts end", || place.status()["alerts"].as_array().is_some_and(Vec::is_empty));
    place.assert_mended();
    let audit = fs::read_to_string(Path::new(&state).join("audit.jsonl")).unwrap();
    assert!(audit.contains("\"audit_lost\""), "{audit}");
}

#[test]
fn node_on_a_read_only_disk_runs_with_the_state_that_it_can_read() {
    let place = Place::new("readonly");
    if place.network.is_none() {
        return;
    }
    place.enroll();
    let _cloud = place.start_cloud();
    let state = "state = \"desk.state\"";
    drop(place.start_desk_on("true", state));
    let pin = place.pin();
    fs::remove_file(place.file("desk.log")).unwrap();
    let _desk = place.start_desk_on(READ_ONLY_DISK, state);
    place.assert_told(SHARED, NOT_KEPT, "mount it to be written");
    eventually("the desk is linked", || place.is_linked());
    assert!(place.has_alert("audit_not_written"));
    assert_eq!(place.pin(), pin);
    let check = place.sgc_on(READ_ONLY_DISK, &["check", "-c", "desk.toml"]).output().unwrap();
    let check = String::from_utf8(check.stdout).unwrap();
    assert!(check.contains(NOT_KEPT), "{check}");
}

#[test]
fn node_of_a_user_without_a_home_says_that_nothing_is_kept() {
    let place = Place::new("homeless");
    if place.network.is_none() {
        return;
    }
    place.enroll();
    let _cloud = place.start_cloud();
    let _desk = place.start_desk_on("true", "");
    place.assert_told(SHARED, NOT_KEPT, "set `state` in [node]");
    assert!(place.has_alert("state_not_kept"));
}

#[test]
fn node_that_starts_before_its_host_has_an_address_links_once_it_has_one() {
    let place = Place::new("boot");
    let Some(network) = &place.network else { return };
    place.enroll();
    let _cloud = place.start_cloud();
    let _desk = place.start_desk("10.77.0.1", "");
    eventually("the desk tries", || place.asked(&["status"]).contains("no answer within"));
    assert!(!place.is_linked());
    network.ip(&["address", "add", "10.77.0.1/24", "dev", "lo"]).unwrap();
    place.assert_mended();
}

#[test]
fn node_takes_all_the_open_files_that_it_may_have() {
    let place = Place::new("files");
    place.enroll();
    let _cloud = place.start_cloud();
    let desk = place.start_desk_on("ulimit -Sn 64", "state = \"desk.state\"");
    let limits = fs::read_to_string(format!("/proc/{}/limits", desk.pid())).unwrap();
    let open_files = limits.lines().find(|line| line.starts_with("Max open files")).unwrap();
    let [soft, hard] = [3, 4].map(|column| open_files.split_whitespace().nth(column));
    assert!(soft == hard && soft != Some("64"), "{open_files}");
    drop(desk);

    // A gateway leaves files for everything else.
    let _desk = place.start_desk_on("ulimit -n 64", "state = \"desk.state\"");
    let said = "the gateway takes 32 clients at once instead of 512: this process may open 64 files";
    eventually("it says how many clients it takes", || place.log().contains(said));
}
