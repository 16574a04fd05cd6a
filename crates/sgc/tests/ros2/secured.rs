//! A local network that DDS Security (SROS2) protects, with a keystore as SROS2 lays it out: everything is encrypted,
//! and permissions name each topic.
//!
//! The programs are Fast DDS of Debian, with the properties that rmw_fastrtps sets. The wheels of ROS 2 are built
//! without security.

#![cfg_attr(
    not(feature = "sros2"),
    allow(dead_code, unused_imports, reason = "a build without security has one test")
)]

use std::path::PathBuf;
use std::process::Command;
use std::time::{Duration, Instant};

use rustix::process::Signal;

use crate::EXCLUSIVE;
use crate::lab::{Lab, Site, share, uses};
use crate::support::{self, Peer, eventually, say};

/// The enclave of `sgc`. Of two participants the one with the lower id proposes how keys are agreed on, and Cyclone DDS
/// does not read the proposal of this Fast DDS. The ids are hashes of the names, and this one is below that of
/// `/talker`, `/listener` and most others.
const ENCLAVE: &str = "/bridge";

/// The topic in each direction, and that of the ROS graph.
const TOPICS: [&str; 3] = ["rt/out", "rt/in", "ros_discovery_info"];

/// Most programs that are started until one is matched, and the wait for each.
#[cfg(feature = "sros2")]
const PROGRAMS_MAX: usize = 4;
#[cfg(feature = "sros2")]
const MATCHED_MAX: Duration = Duration::from_secs(15);

/// A keystore in a lab's directory.
struct Keystore(PathBuf);

impl Keystore {
    fn new(lab: &Lab) -> Self {
        let keystore = Self(lab.dir().join("keystore"));
        for enclave in ["/talker", "/listener", ENCLAVE] {
            keystore.add(enclave, &TOPICS, "1");
        }
        keystore
    }

    /// Makes an enclave that may use these topics, with a certificate of so many days.
    fn add(&self, enclave: &str, topics: &[&str], days: &str) {
        self.add_with(enclave, topics, &[("VALID", days)]);
    }

    /// Makes an enclave with these variables of `keystore.sh`.
    fn add_with(&self, enclave: &str, topics: &[&str], variables: &[(&str, &str)]) {
        let mut command = Command::new(support::repository("tests/peers/keystore.sh"));
        command.arg(&self.0).arg(enclave).args(topics).envs(variables.iter().copied());
        let made = command.output().unwrap();
        assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    }

    fn directory(&self, enclave: &str) -> PathBuf {
        self.0.join("enclaves").join(&enclave[1..])
    }

    /// Gives an enclave a file of another one.
    fn take(&self, enclave: &str, file: &str, of: &Self, other: &str) {
        std::fs::copy(of.directory(other).join(file), self.directory(enclave).join(file)).unwrap();
    }
}

/// Makes the robot's node one of an enclave.
fn join(lab: &Lab, enclave: &str) {
    let keys = format!("static_peers = []\nenclave = \"{enclave}\"\nsecurity_root = \"keystore\"");
    lab.reconfigure(Site::Robot, "static_peers = []", &keys);
}

/// Starts a program of an enclave beside the robot's node.
fn secured(lab: &Lab, keystore: &Keystore, enclave: &str, role: &str, args: &[&str]) -> Peer {
    let directory = keystore.directory(enclave);
    lab.peer(Site::Robot, "fastdds", role, &[&["--enclave", directory.to_str().unwrap()], args].concat())
}

/// Starts a program of an enclave beside the robot's node until one is matched. On a busy machine, a handshake of Fast DDS
/// and Cyclone DDS may fail, and none follows with the same program: in 3 of 10 runs beside four busy loops.
#[cfg(feature = "sros2")]
fn secured_and_matched(lab: &Lab, keystore: &Keystore, enclave: &str, role: &str, args: &[&str]) -> Peer {
    for attempt in 0..PROGRAMS_MAX {
        let peer = secured(lab, keystore, enclave, role, args);
        let until = Instant::now() + MATCHED_MAX;
        while let Ok((_, event)) = peer.events.recv_timeout(until.saturating_duration_since(Instant::now())) {
            if event["event"] == "matched" && event["count"].as_u64() >= Some(1) {
                if attempt > 0 {
                    say(&format!("{attempt} programs of {enclave} were not let in"));
                }
                return peer;
            }
        }
    }
    panic!("no program of {enclave} is matched");
}

/// Runs the robot's node, which is expected to end at once, and returns its errors.
fn refusal(lab: &Lab) -> String {
    // A node that starts nevertheless ends with its empty standard input.
    let args = ["run", "-c", "robot.toml", "--until-stdin-closes"];
    let output = lab.sgc(Some(Site::Robot), &args).output().unwrap();
    assert!(!output.status.success(), "{output:?}");
    String::from_utf8(output.stderr).unwrap()
}

/// Returns the output of `sgc check` about the robot's node.
fn check(lab: &Lab) -> String {
    let output = lab.sgc(None, &["check", "-c", "robot.toml"]).output().unwrap();
    String::from_utf8(output.stdout).unwrap()
}

/// Returns a lab with a topic in each direction, before its nodes are started. It is alone, because handshakes fail on a
/// busy machine.
fn lab() -> Lab {
    let robot = share("topic", "/out", "desk") + &uses("topic", "/in", "desk");
    let desk = share("topic", "/in", "robot") + &uses("topic", "/out", "robot");
    Lab::silent(EXCLUSIVE, [robot, desk])
}

#[cfg(not(feature = "sros2"))]
#[test]
fn build_without_security_says_so() {
    let lab = lab();
    let _keystore = Keystore::new(&lab);
    join(&lab, ENCLAVE);
    let said = "this build has no DDS Security: build sgc with `--features sros2`";
    assert!(refusal(&lab).contains(said), "{}", refusal(&lab));
    assert!(check(&lab).contains(said), "{}", check(&lab));
}

#[cfg(feature = "sros2")]
#[test]
fn secured_programs_talk_to_far_unsecured_ones() {
    let mut lab = lab();
    let keystore = Keystore::new(&lab);
    join(&lab, ENCLAVE);
    lab.start_all();
    // Images of many fragments.
    for (topic, to_desk) in [("/out", true), ("/in", false)] {
        let listen = ["--topic", topic, "--type", "image", "--size", "100000", "--count", "5"];
        let talk = ["--topic", topic, "--type", "image", "--size", "100000", "--wait-go"];
        let at_desk = |role: &str, args: &[&str]| lab.peer(Site::Desk, "fastdds", role, args);
        let (mut listener, mut talker) = if to_desk {
            let mut listener = at_desk("sub", &listen);
            let talker = secured_and_matched(&lab, &keystore, "/talker", "pub", &talk);
            listener.wait_matched(topic);
            (listener, talker)
        } else {
            let mut talker = at_desk("pub", &talk);
            let listener = secured_and_matched(&lab, &keystore, "/listener", "sub", &listen);
            talker.wait_matched(topic);
            (listener, talker)
        };
        talker.go();
        let summary = listener.summary();
        assert_eq!((summary["received"].as_u64(), summary["lost"].as_u64()), (Some(5), Some(0)), "{summary}");
    }
    // Lines about programs that were not let in say nothing of the others.
    let log = lab.log(Site::Robot);
    assert!(log.lines().all(|line| !line.contains("DDS Security") || line.contains("do not admit")), "{log}");
}

#[cfg(feature = "sros2")]
#[test]
fn programs_that_keep_a_node_out_are_named() {
    let mut lab = lab();
    let keystore = Keystore::new(&lab);
    keystore.add("/sgc", &TOPICS, "1");
    lab.start_all();
    let before = lab.why(Site::Robot, "/out");
    assert!(!before.contains("SROS2"), "{before}");
    let listen = ["--topic", "/out", "--verbose"];
    let mut listener = lab.peer(Site::Desk, "fastdds", "sub", &listen);
    let _talker = secured(&lab, &keystore, "/talker", "pub", &["--topic", "/out"]);
    let said = "a program of enclave /talker announces itself to sgc, but none of its topics: DDS Security (SROS2) protects it";
    eventually("sgc why names the enclave", || lab.why(Site::Robot, "/out").contains(said));
    eventually("the log names the enclave", || lab.log(Site::Robot).contains(said));

    // An enclave whose id lets Fast DDS propose.
    lab.end(Site::Robot, Signal::TERM);
    join(&lab, "/sgc");
    lab.start(Site::Robot);
    let said = "a program that DDS Security protects is not let in: Begin handshake reply failed";
    eventually("the log says why", || lab.log(Site::Robot).contains(said));
    assert!(lab.log(Site::Robot).contains("preferred_key_agreement to ECDH"), "{}", lab.log(Site::Robot));
    let said = "a program of enclave /talker and this node do not admit each other";
    eventually("sgc why names the enclave that is refused", || lab.why(Site::Robot, "/out").contains(said));

    lab.end(Site::Robot, Signal::TERM);
    lab.reconfigure(Site::Robot, "\"/sgc\"", "\"/bridge\"");
    lab.start(Site::Robot);
    listener.wait("a message", |event| event["event"] == "received");
}

#[cfg(feature = "sros2")]
#[test]
fn programs_without_security_are_named_beside_a_secured_node() {
    let mut lab = lab();
    let _keystore = Keystore::new(&lab);
    join(&lab, ENCLAVE);
    lab.start_all();
    let _talker = lab.peer(Site::Robot, "cyclone", "pub", &["--topic", "/out", "--node", "/talker"]);
    let said = "1 program has no DDS Security (SROS2) on the local network";
    eventually("sgc why names it", || lab.why(Site::Robot, "/out").contains(said));
    eventually("the log names it", || lab.log(Site::Robot).contains(said));
}

#[cfg(feature = "sros2")]
#[test]
fn enclaves_that_cannot_be_used_are_refused_with_the_file() {
    let mut lab = lab();
    let keystore = Keystore::new(&lab);
    let foreign = Keystore(lab.dir().join("foreign"));
    foreign.add("/foreign", &TOPICS, "1");
    keystore.add("/cert_ended", &TOPICS, "-1");
    keystore.add_with("/permissions_ended", &TOPICS, &[("UNTIL", "2021-01-01T00:00:00")]);
    keystore.add("/without_graph", &["rt/out"], "1");
    for enclave in ["/without_key", "/other_key", "/text", "/other_ca", "/other_signer", "/other_governance"]
    {
        keystore.add(enclave, &TOPICS, "1");
    }
    keystore.add("/other_permissions", &TOPICS, "1");
    std::fs::remove_file(keystore.directory("/without_key").join("key.pem")).unwrap();
    std::fs::write(keystore.directory("/text").join("key.pem"), "no key").unwrap();
    keystore.take("/other_key", "key.pem", &keystore, "/talker");
    keystore.take("/other_ca", "identity_ca.cert.pem", &foreign, "/foreign");
    keystore.take("/other_signer", "permissions_ca.cert.pem", &foreign, "/foreign");
    keystore.take("/other_governance", "governance.p7s", &foreign, "/foreign");
    keystore.take("/other_permissions", "permissions.p7s", &keystore, "/talker");
    let mut enclave = ENCLAVE.to_owned();
    join(&lab, &enclave);
    // Cyclone DDS alone reads permissions, which `sgc check` does without.
    for (wrong, said, at_check) in [
        ("/absent", "enclaves/absent is not there; the keystore has /bridge, /cert_ended, /listener", true),
        ("/without_key", "without_key/key.pem: No such file or directory", true),
        ("/text", "text/key.pem is not a private key in PEM without a password", true),
        ("/other_key", "other_key/key.pem is not the private key of", true),
        ("/other_key", "other_key/cert.pem; put back the key", true),
        ("/cert_ended", "cert_ended/cert.pem ended at", true),
        ("/other_ca", "other_ca/cert.pem was not signed by the CA in", true),
        ("/other_ca", "other_ca/identity_ca.cert.pem (", true),
        ("/other_signer", "other_signer/permissions.p7s was not signed by the CA in", true),
        ("/other_governance", "other_governance/governance.p7s was not signed by the CA in", true),
        (
            "/other_permissions",
            "permissions.p7s grants to CN=/talker, and not to the subject CN=/other_perm",
            false,
        ),
        ("/permissions_ended", "permissions_ended/permissions.p7s ended at 2021-01-01T00:00:00", false),
        (
            "/without_graph",
            "without_graph/permissions.p7s does not grant ros_discovery_info to enclave /without_graph",
            false,
        ),
    ] {
        if wrong != enclave {
            lab.reconfigure(Site::Robot, &format!("\"{enclave}\""), &format!("\"{wrong}\""));
            wrong.clone_into(&mut enclave);
        }
        let refused = refusal(&lab);
        assert!(refused.contains(said), "{wrong}: {refused}");
        assert_eq!(check(&lab).contains(said), at_check, "{wrong}: {}", check(&lab));
    }

    // The graph's topic is not needed without a graph, and the other one is not granted.
    lab.reconfigure(Site::Robot, "static_peers = []", "static_peers = []\ngraph = false");
    lab.start_all();
    let _talker = lab.peer(Site::Desk, "fastdds", "pub", &["--topic", "/in"]);
    let said = "without_graph/permissions.p7s does not grant rt/in to enclave /without_graph";
    eventually("the log names the topic", || lab.log(Site::Robot).contains(said));
}

/// Returns how often the robot's node counted something.
fn counted(lab: &Lab, kind: &str) -> u64 {
    lab.status(Site::Robot)["drops"][kind].as_u64().unwrap_or_default()
}

#[cfg(feature = "sros2")]
#[test]
fn far_subscribers_that_permissions_do_not_show_are_one_line_in_the_log() {
    let mut lab = lab();
    let keystore = Keystore::new(&lab);
    join(&lab, ENCLAVE);
    lab.start_all();
    let _talker = secured(&lab, &keystore, "/talker", "pub", &["--topic", "/out", "--rate", "20"]);
    let listen =
        |node| lab.peer(Site::Desk, "cyclone", "sub", &["--topic", "/out", "--node", node, "--verbose"]);
    for (node, shown) in [("/first", 1), ("/second", 2)] {
        let mut listener = listen(node);
        listener.wait("a message", |event| event["event"] == "received");
        eventually("it is counted", || counted(&lab, "consumers_forbidden") == shown);
    }
    let log = lab.log(Site::Robot);
    let said = "permissions.p7s grants enclave /bridge no partition sgc/shown on rt/out";
    assert_eq!(log.matches(said).count(), 1, "{log}");
    assert!(!log.contains("cyclonedds") && !log.contains("sgc_dds"), "{log}");
}

#[cfg(feature = "sros2")]
#[test]
fn gateway_takes_part_in_a_secured_network() {
    let mut lab = lab();
    let keystore = Keystore::new(&lab);
    join(&lab, ENCLAVE);
    lab.reconfigure(Site::Robot, "[ros]\n", "[gateway]\n[ros]\n");
    lab.start_all();
    let _talker = secured(&lab, &keystore, "/talker", "pub", &["--topic", "/out", "--rate", "20"]);
    let mut listener = secured(&lab, &keystore, "/listener", "sub", &["--topic", "/in", "--verbose"]);
    for (protocol, address) in [("grpc", "grpc://127.0.0.1:50051"), ("rosbridge", "ws://127.0.0.1:9090")] {
        let mut program = lab.python(Site::Robot, "gateway.py", &[protocol, address, "--topic", "/out"]);
        program.wait("a message of a secured publisher", |event| event["event"] == "heard");
        program.end();
    }
    let mut publisher = lab.sgc(Some(Site::Robot), &["topic", "pub", "/in", "std_msgs/String", "data: x"]);
    let published = publisher.args(["--once", "--socket", "robot.sock"]).output().unwrap();
    assert!(published.status.success(), "{published:?}");
    listener.wait("a message of the gateway", |event| event["event"] == "received");
    let log = lab.log(Site::Robot);
    assert!(!log.contains("cyclonedds") && !log.contains("sgc_dds"), "{log}");
}
