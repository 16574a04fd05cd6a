//! Routers with TLS and access control, and routers that are missing.

use std::fs;
use std::path::Path;

use rcgen::{BasicConstraints, CertificateParams, IsCa, Issuer, KeyPair};
use rustix::process::Signal;

use crate::faults::{heard_now, misses_router};
use crate::lab::{Site, robot_to_desk};
use crate::networks::Middleware::Zenoh;
use crate::networks::Networks;
use crate::support::{Peer, eventually};

const ADDRESS: &str = "tls/127.0.0.1:7447";
/// Denies one topic to all.
const ACCESS: &str = r#"{
  enabled: true, default_permission: "allow",
  rules: [{
    id: "secret", permission: "deny", flows: ["ingress", "egress"], messages: ["put", "declare_subscriber"],
    key_exprs: ["0/secret/**"],
  }],
  subjects: [{ id: "all" }],
  policies: [{ rules: ["secret"], subjects: ["all"] }],
}"#;

/// Writes the certificate of an authority, and certificates that it issued, to `NAME.pem`, and their keys to `NAME.key`.
fn issue_certificates(dir: &Path, authority: &str, names: &[&str]) {
    let write = |name: &str, kind: &str, text: &str| {
        fs::write(dir.join(format!("{name}.{kind}")), text).unwrap();
    };
    let mut params = CertificateParams::default();
    params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    let key = KeyPair::generate().unwrap();
    write(authority, "pem", &params.self_signed(&key).unwrap().pem());
    let issuer = Issuer::from_params(&params, &key);
    for name in names {
        let own = KeyPair::generate().unwrap();
        let leaf = CertificateParams::new(["127.0.0.1".to_owned()]).unwrap();
        write(name, "pem", &leaf.signed_by(&own, &issuer).unwrap().pem());
        write(name, "key", &own.serialize_pem());
    }
}

/// Returns the path of a file of the lab.
fn file(networks: &Networks, name: &str) -> String {
    networks.dir().join(name).to_str().unwrap().to_owned()
}

/// Returns the options of the peer for a certificate of the authority `ca`.
fn certificate(networks: &Networks, name: &str) -> Vec<String> {
    let [ca, cert, key] =
        ["ca.pem", &format!("{name}.pem"), &format!("{name}.key")].map(|name| file(networks, name));
    ["--ca", &ca, "--cert", &cert, "--key", &key].map(str::to_owned).to_vec()
}

/// Starts a role of the peer as a client of the router, with a certificate.
fn program(networks: &Networks, site: Site, role: &str, args: &[&str]) -> Peer {
    let certificate = certificate(networks, "program");
    let common = ["--mode", "client", "--connect", ADDRESS, "--bytes", "100"];
    let certificate = certificate.iter().map(String::as_str);
    networks.zenoh(
        site,
        role,
        &common.into_iter().chain(certificate).chain(args.iter().copied()).collect::<Vec<_>>(),
    )
}

/// Writes a session configuration of Zenoh with a certificate, and returns its path.
fn session(networks: &Networks, name: &str) -> String {
    let [ca, cert, key] =
        ["ca.pem", &format!("{name}.pem"), &format!("{name}.key")].map(|name| file(networks, name));
    let tls = format!(
        "root_ca_certificate: \"{ca}\", enable_mtls: true, connect_certificate: \"{cert}\", connect_private_key: \"{key}\""
    );
    let text = format!(
        "{{ mode: \"client\", connect: {{ endpoints: [\"{ADDRESS}\"] }}, scouting: {{ multicast: {{ enabled: false }} }}, \
         transport: {{ link: {{ tls: {{ {tls} }} }} }} }}"
    );
    let path = file(networks, &format!("{name}.json5"));
    fs::write(&path, text).unwrap();
    path
}

#[test]
fn nodes_with_certificates_join_and_access_control_limits_their_topics() {
    const MESSAGES: u64 = 20;
    let tables = robot_to_desk("topic", ["/secret", "/open"]);
    let Some(mut networks) = Networks::silent([Zenoh, Zenoh], tables) else { return };
    issue_certificates(networks.dir(), "ca", &["router", "robot", "desk", "program"]);
    issue_certificates(networks.dir(), "other", &["stranger"]);
    let access = file(&networks, "access.json5");
    fs::write(&access, ACCESS).unwrap();
    let certificate = certificate(&networks, "router");
    let with_tls =
        ["--listen", ADDRESS, "--mutual"].into_iter().chain(certificate.iter().map(String::as_str));
    let with_tls: Vec<_> = with_tls.collect();
    let _routers = [
        networks.router(Site::Robot, &[&with_tls[..], &["--access-control", &access]].concat()),
        networks.router(Site::Desk, &with_tls),
    ];
    networks.start(Site::Cloud);
    let of_robot = session(&networks, "robot");
    let zenoh = format!("middleware = \"zenoh\"\nzenoh = {{ config = \"{of_robot}\" }}\n");
    networks.reconfigure(Site::Robot, "middleware = \"zenoh\"\n", &zenoh);
    networks.start(Site::Robot);

    // A node whose certificate another authority issued. With a router in its configuration it waits.
    let of_desk = ["stranger", "desk"].map(|name| session(&networks, name));
    let waits = format!("middleware = \"zenoh\"\nzenoh = {{ router = \"{ADDRESS}\" }}\n");
    networks.reconfigure(Site::Desk, "middleware = \"zenoh\"\n", &waits);
    networks.start_within(Site::Desk, &[("ZENOH_SESSION_CONFIG_URI", &of_desk[0])]);
    eventually("the router does not admit it", || misses_router(&networks, Site::Desk));
    networks.end(Site::Desk, Signal::TERM);
    networks.reconfigure(Site::Desk, &waits, "middleware = \"zenoh\"\n");
    networks.start_within(Site::Desk, &[("ZENOH_SESSION_CONFIG_URI", &of_desk[1])]);

    let hear = |topic| {
        let mut listener = program(&networks, Site::Desk, "sub", &["--topic", topic, "--verbose"]);
        listener.wait_matched("a match at the subscriber");
        listener
    };
    let count = MESSAGES.to_string();
    let mut talkers = ["/secret", "/open"].map(|topic| {
        let pace = ["--topic", topic, "--rate", "50", "--count", &count, "--wait-go", "--hold", "1"];
        let mut talker = program(&networks, Site::Robot, "pub", &pace);
        talker.wait_matched("a match at the publisher");
        talker
    });
    let [mut secret, mut open] = ["/secret", "/open"].map(hear);
    // The denied messages are sent first.
    for talker in &mut talkers {
        talker.go();
        talker.wait("all messages", |event| event["event"] == "all_sent");
    }
    open.wait("the last message", |e| e["event"] == "received" && e["seq"] == MESSAGES - 1);
    open.end();
    secret.end();
    let [open, secret] = [open.summary(), secret.summary()];
    assert_eq!([&open["received"], &secret["received"]], [MESSAGES, 0], "{open} {secret}");
    for site in [Site::Robot, Site::Desk] {
        assert!(!misses_router(&networks, site), "{}", networks.status(site));
    }
}

#[test]
fn missing_router_is_named_by_status_and_why_until_it_is_there() {
    let tables = robot_to_desk("topic", ["/load"]);
    let Some(mut networks) = Networks::silent([Zenoh, Zenoh], tables) else { return };
    networks.start_router(Site::Desk);
    networks.start_all();
    eventually("the router is missed", || misses_router(&networks, Site::Robot));
    let missing = "the Zenoh router tcp/localhost:7447 of the local ROS 2 network is not connected";
    for asked in [&["status"][..], &["why", "/load"]] {
        let said = networks.asked(Site::Robot, asked);
        assert!(said.replace('\n', " ").contains(missing), "{asked:?}: {said}");
    }
    assert!(!misses_router(&networks, Site::Desk), "{}", networks.status(Site::Desk));
    networks.start_router(Site::Robot);
    eventually("the router is there", || !misses_router(&networks, Site::Robot));
    let _talker =
        networks.load_on(Site::Robot, "pub", "talker", &["--topic", "/load", "--wait-matched", "0"]);
    heard_now(&mut crate::faults::hear(&networks));
}
