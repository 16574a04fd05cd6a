//! Tests of a fleet's upkeep with the real binary: requests, renewal, revocation, existing CAs.

#![allow(clippy::unwrap_used)]

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::{Command, Output, Stdio};

use rcgen::{BasicConstraints, CertificateParams, DnType, IsCa, Issuer, KeyPair};
use rustls_pki_types::CertificateDer;
use sgc_testkit::unused_port;
use sgc_trust::{CertError, Fleet, Identity, TrustAnchors, requested_key_hash};
use sgc_wire::UnixMillis;
use tempfile::TempDir;

/// A directory in which `sgc` runs, without the user's environment.
struct Place {
    dir: TempDir,
}

impl Place {
    fn new() -> Self {
        Self { dir: tempfile::tempdir().unwrap() }
    }

    /// Returns a place with the fleet `lab`.
    fn with_fleet() -> Self {
        let place = Self::new();
        place.good(&["fleet", "create", "lab"]);
        place
    }

    fn path(&self, file: &str) -> std::path::PathBuf {
        self.dir.path().join(file)
    }

    fn command(&self, args: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_sgc"));
        command.args(args).current_dir(self.dir.path()).env_clear().stdin(Stdio::null());
        command
    }

    fn run(&self, args: &[&str]) -> Output {
        self.command(args).output().unwrap()
    }

    fn good(&self, args: &[&str]) -> String {
        let ran = self.run(args);
        assert!(ran.status.success(), "{args:?}: {}", String::from_utf8_lossy(&ran.stderr));
        assert!(ran.stderr.is_empty(), "{args:?}: {}", String::from_utf8_lossy(&ran.stderr));
        String::from_utf8(ran.stdout).unwrap()
    }

    /// Returns the line with which a wrong request must fail.
    fn bad(&self, args: &[&str]) -> String {
        let ran = self.run(args);
        let said = String::from_utf8(ran.stderr).unwrap();
        assert_eq!((ran.status.code(), ran.stdout.as_slice()), (Some(2), &b""[..]), "{args:?}: {said}");
        assert_eq!(said.lines().count(), 1, "{said}");
        said
    }

    fn read(&self, file: &str) -> String {
        fs::read_to_string(self.path(file)).unwrap()
    }

    fn write(&self, file: &str, text: &str, mode: u32) {
        fs::write(self.path(file), text).unwrap();
        self.set_mode(file, mode);
    }

    fn mode(&self, file: &str) -> u32 {
        fs::metadata(self.path(file)).unwrap().permissions().mode() & 0o7777
    }

    fn set_mode(&self, file: &str, mode: u32) {
        fs::set_permissions(self.path(file), fs::Permissions::from_mode(mode)).unwrap();
    }

    fn bring(&self, file: &str, to: &Place) {
        fs::copy(self.path(file), to.path(file)).unwrap();
    }

    fn fleet(&self) -> Fleet {
        Fleet::parse(&self.read("lab.fleet")).unwrap()
    }

    fn identity(&self, file: &str) -> Identity {
        Identity::parse(&self.read(file)).unwrap()
    }

    fn anchors_with_list(&self) -> TrustAnchors {
        let list = fs::read(self.path("lab.crl")).unwrap();
        self.fleet().anchors().with_crl(&list, now()).unwrap().unwrap()
    }

    fn files(&self) -> Vec<String> {
        let entries = fs::read_dir(self.dir.path()).unwrap();
        let mut names: Vec<_> = entries.map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }
}

fn now() -> UnixMillis {
    let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap();
    UnixMillis(since.as_millis() as u64)
}

fn pem(label: &str, der: &[u8]) -> String {
    use base64::Engine as _;
    let text = base64::engine::general_purpose::STANDARD.encode(der);
    format!("-----BEGIN {label}-----\n{text}\n-----END {label}-----\n")
}

#[test]
fn a_key_stays_on_its_machine() {
    let (keeper, robot) = (Place::with_fleet(), Place::new());
    let said = robot.good(&["fleet", "request", "arm-1"]);
    assert!(said.contains("sgc fleet enroll arm-1 --csr arm-1.csr"), "{said}");
    assert_eq!((robot.mode("arm-1.key"), robot.mode("arm-1.csr")), (0o600, 0o644));
    let key = robot.read("arm-1.key");
    assert!(robot.bad(&["fleet", "request", "arm-1"]).contains("a key is never overwritten"));
    assert_eq!(robot.read("arm-1.key"), key);

    robot.bring("arm-1.csr", &keeper);
    let said = keeper.good(&["fleet", "enroll", "arm-1", "--group", "arms", "--csr", "arm-1.csr", "-o", "a"]);
    assert!(said.contains("sgc fleet accept a"), "{said}");
    assert_eq!(keeper.mode("a"), 0o600);
    let secret_line = key.lines().find(|l| l.len() == 64).unwrap();
    for file in ["arm-1.csr", "a", "lab.fleet"] {
        assert!(!keeper.read(file).contains(secret_line), "{file} has the key");
    }

    keeper.bring("a", &robot);
    robot.set_mode("a", 0o644);
    assert!(
        robot.bad(&["fleet", "accept", "a"]).contains("lets others at secrets of the fleet: chmod 600 a")
    );
    robot.set_mode("a", 0o600);
    let said = robot.good(&["fleet", "accept", "a"]);
    assert!(said.starts_with("arm-1.identity: node arm-1 of fleet lab, holds until "), "{said}");
    assert_eq!(robot.mode("arm-1.identity"), 0o600);
    let identity = robot.identity("arm-1.identity");
    let peer = keeper.fleet().anchors().verify(identity.chain(), now()).unwrap();
    assert!(peer.is_in(&keeper.fleet().secret().group_tag("arms")));
    assert!(
        robot.bad(&["fleet", "accept", "a"]).contains("arm-1.identity exists already; --force replaces it")
    );

    // Renewal works the same way.
    keeper.good(&["fleet", "renew", "arm-1", "--csr", "arm-1.csr", "-o", "b", "--valid", "100d"]);
    keeper.bring("b", &robot);
    robot.good(&["fleet", "accept", "b", "--force"]);
    let renewed = robot.identity("arm-1.identity");
    assert_eq!((renewed.node_id(), renewed.groups()), (identity.node_id(), identity.groups()));
    assert!(renewed.not_after() > identity.not_after());

    // The answer is of no use with another key.
    let other = Place::new();
    other.good(&["fleet", "request", "arm-1"]);
    keeper.bring("a", &other);
    assert!(other.bad(&["fleet", "accept", "a"]).contains("do not belong together"));
    assert!(
        keeper.bad(&["fleet", "enroll", "x", "--csr", "a"]).contains("holds no request for a certificate")
    );
}

#[test]
fn the_roster_is_shown() {
    let place = Place::new();
    place.good(&["fleet", "create", "lab", "--authority", "desk", "--post-quantum"]);
    assert!(place.good(&["fleet", "list"]).contains("No nodes yet"));
    place.good(&["fleet", "enroll", "arm-1", "--group", "b", "--group", "a", "--valid", "12h"]);
    place.good(&["fleet", "enroll", "cloud", "--role", "router"]);
    place.good(&["fleet", "enroll", "relay", "--may-route"]);
    place.good(&["fleet", "revoke", "relay"]);
    let shown = place.good(&["fleet", "list"]);
    let lines: Vec<_> = shown.lines().map(|l| l.split_whitespace().collect::<Vec<_>>().join(" ")).collect();
    assert!(lines[0].ends_with(", renewed by desk, post-quantum"), "{shown}");
    assert_eq!(lines[1], "NODE ROLE CERTIFICATE SECRET LAST SEEN GROUPS");
    assert!(lines[2].starts_with("arm-1 member until ") && lines[2].ends_with(" a, b"), "{shown}");
    assert!(lines[3].starts_with("cloud router until "), "{shown}");
    assert!(lines[4].starts_with("relay member, may route revoked 20"), "{shown}");
    let json: serde_json::Value = serde_json::from_str(&place.good(&["fleet", "list", "--json"])).unwrap();
    assert_eq!(
        (&json["fleet"], &json["authority"], &json["post_quantum"]),
        (&"lab".into(), &"desk".into(), &true.into())
    );
    assert_eq!(json["nodes"][0]["name"], "arm-1");
    assert_eq!(json["nodes"][0]["groups"], serde_json::json!(["a", "b"]));
    let arm = place.identity("arm-1.identity");
    assert_eq!(json["nodes"][0]["id"], arm.node_id().to_string());
    assert_eq!(json["nodes"][0]["expires"], arm.not_after().to_string());
    assert!(json["nodes"][0]["revoked"].is_null() && json["nodes"][2]["revoked"].is_string());
    assert_eq!(arm.authority(), Some(place.fleet().node_id_of(&"desk".parse().unwrap())));
    assert!(arm.post_quantum());
    let shown = place.good(&["fleet", "set", "--no-authority", "--no-post-quantum"]);
    assert!(shown.contains("authority none, post-quantum off"), "{shown}");
    assert!(place.identity("cloud.identity").as_peer().may_route && !arm.as_peer().may_route);
}

#[test]
fn a_revoked_node_is_out() {
    let place = Place::with_fleet();
    for node in ["arm-1", "arm-2", "desk"] {
        place.good(&["fleet", "enroll", node]);
    }
    let before = place.read("lab.fleet");
    let said = place.bad(&["fleet", "revoke", "arm-1", "nobody"]);
    assert!(said.contains("the fleet's roster has no node nobody: see `sgc fleet list`"), "{said}");
    assert_eq!(place.read("lab.fleet"), before, "all or none");
    let said = place.good(&["fleet", "revoke", "arm-1", "arm-2"]);
    assert!(said.contains("arm-1: revoked\narm-2: revoked\nlab.crl: revocation list "), "{said}");
    assert_eq!((place.mode("lab.fleet"), place.mode("lab.crl")), (0o600, 0o644));
    let anchors = place.anchors_with_list();
    let judge = |node: &str| anchors.verify(place.identity(&format!("{node}.identity")).chain(), now());
    assert!(matches!(judge("arm-1"), Err(CertError::Revoked { .. })));
    assert!(matches!(judge("arm-2"), Err(CertError::Revoked { .. })));
    assert!(judge("desk").is_ok());
    for command in [&["fleet", "renew", "arm-1"][..], &["fleet", "enroll", "arm-1", "--force"]] {
        let said = place.bad(command);
        assert!(said.contains("`sgc fleet enroll arm-1 --again` makes it a node anew"), "{said}");
    }
    place.good(&["fleet", "enroll", "arm-1", "--again", "--force"]);
    // The list can be written again, with the same content.
    fs::remove_file(place.path("lab.crl")).unwrap();
    place.good(&["fleet", "revoke"]);
    let anchors = place.anchors_with_list();
    assert!(anchors.verify(place.identity("arm-1.identity").chain(), now()).is_ok());
    assert!(anchors.verify(place.identity("arm-2.identity").chain(), now()).is_err());
    assert!(place.files().iter().all(|f| !f.starts_with('.')), "{:?}", place.files());
}

/// Returns two copies of the fleet file, each in a place of its own, with two nodes that both copies know.
fn two_copies() -> (Place, Place) {
    let (new, old) = (Place::with_fleet(), Place::new());
    for node in ["va", "vb"] {
        new.good(&["fleet", "enroll", node]);
    }
    new.bring("lab.fleet", &old);
    (new, old)
}

/// Returns the anchors of a node that got these lists in this order.
fn told(lists: &[&Place]) -> TrustAnchors {
    let anchors = lists[0].fleet().anchors().clone();
    lists.iter().fold(anchors, |anchors, place| {
        let list = fs::read(place.path("lab.crl")).unwrap();
        anchors.with_crl(&list, now()).unwrap().unwrap_or(anchors)
    })
}

fn is_revoked(anchors: &TrustAnchors, place: &Place, node: &str) -> bool {
    let identity = place.identity(&format!("{node}.identity"));
    matches!(anchors.verify(identity.chain(), now()), Err(CertError::Revoked { .. }))
}

#[test]
fn an_old_copy_of_the_file_revokes_what_the_new_one_renewed() {
    let (new, old) = two_copies();
    new.good(&["fleet", "renew", "va"]);
    old.good(&["fleet", "revoke", "va"]);
    let anchors = told(&[&old]);
    assert!(is_revoked(&anchors, &new, "va") && !is_revoked(&anchors, &new, "vb"));
    new.good(&["fleet", "renew", "va"]);
    assert!(is_revoked(&anchors, &new, "va"), "nor does the next renewal help");
}

#[test]
fn two_copies_of_the_file_do_not_undo_each_others_revocations() {
    let (new, old) = two_copies();
    new.good(&["fleet", "revoke", "vb"]);
    old.good(&["fleet", "revoke", "va"]);
    for order in [[&new, &old], [&old, &new]] {
        let anchors = told(&order);
        assert!(is_revoked(&anchors, &new, "va") && is_revoked(&anchors, &new, "vb"));
    }
}

#[test]
fn copies_of_the_file_are_merged_and_nothing_is_lost() {
    let (new, old) = two_copies();
    new.good(&["fleet", "enroll", "vc", "--group", "arms"]);
    new.good(&["fleet", "revoke", "vb"]);
    new.good(&["fleet", "enroll", "vb", "--again", "--force"]);
    old.good(&["fleet", "revoke", "va"]);
    old.good(&["fleet", "renew", "vb", "-o", "vb.identity"]);
    fs::copy(old.path("lab.fleet"), new.path("old.fleet")).unwrap();
    let said = new.good(&["fleet", "merge", "old.fleet"]);
    assert!(said.starts_with("lab.fleet: took over from old.fleet\n  revoked: va\n"), "{said}");
    assert!(said.contains("changed or renewed: vb\n"), "{said}");
    assert!(said.contains("old.fleet is older or went its own way: put a copy of lab.fleet"), "{said}");
    let fleet = new.fleet();
    let names: Vec<_> = fleet.nodes().map(|n| (n.name.as_str(), n.incarnation)).collect();
    assert_eq!(names, [("va", 0), ("vb", 1), ("vc", 0)]);
    assert!(fleet.revoked_at(fleet.node(&"va".parse().unwrap()).unwrap()).is_some());
    let anchors = told(&[&new]);
    assert!(is_revoked(&anchors, &new, "va") && !is_revoked(&anchors, &new, "vb"));
    assert!(is_revoked(&anchors, &old, "vb"), "it was enrolled again with the other copy");
    // A second merge finds nothing new, because the merged copy has everything of the other.
    let said = new.good(&["fleet", "merge", "old.fleet"]);
    assert!(said.starts_with("lab.fleet: knows everything that old.fleet does\n"), "{said}");
    new.bring("lab.fleet", &old);
    fs::copy(new.path("lab.fleet"), old.path("new.fleet")).unwrap();
    let said = old.good(&["fleet", "merge", "new.fleet"]);
    assert!(said.contains("knows everything") && !said.contains("put a copy"), "{said}");
    // A file of another fleet is no copy.
    let other = Place::with_fleet();
    fs::copy(other.path("lab.fleet"), new.path("other.fleet")).unwrap();
    let said = new.bad(&["fleet", "merge", "other.fleet", "--fleet", "lab.fleet"]);
    assert!(said.contains("only copies of one fleet's file are merged"), "{said}");
}

#[test]
fn an_old_copy_of_the_file_says_so_and_learns_from_the_list() {
    let (new, old) = two_copies();
    new.good(&["fleet", "revoke", "vb"]);
    new.bring("lab.crl", &old);
    let ran = old.run(&["fleet", "list"]);
    let (said, shown) = (String::from_utf8(ran.stderr).unwrap(), String::from_utf8(ran.stdout).unwrap());
    assert!(
        said.contains("another copy of lab.fleet made lab.crl, so this copy is not the newest"),
        "{said}"
    );
    assert!(said.contains("It revokes vb") && said.contains("sgc fleet merge OTHER.fleet"), "{said}");
    assert!(shown.lines().any(|l| l.starts_with("vb ") && l.contains("revoked")), "{shown}");
    // A command that changes the file keeps the new revocations and puts them into its list.
    let ran = old.run(&["fleet", "revoke", "va"]);
    assert!(ran.status.success() && String::from_utf8(ran.stderr).unwrap().contains("not the newest"));
    let anchors = told(&[&old]);
    assert!(is_revoked(&anchors, &new, "va") && is_revoked(&anchors, &new, "vb"));
    old.good(&["fleet", "list"]);
    assert!(old.bad(&["fleet", "renew", "vb"]).contains("was revoked at"));
    // A broken list is reported and prevents nothing.
    let broken = new.run(&["fleet", "list"]);
    assert!(broken.stderr.is_empty());
    fs::write(new.path("lab.crl"), b"no list").unwrap();
    let broken = new.run(&["fleet", "revoke"]);
    let said = String::from_utf8(broken.stderr).unwrap();
    assert!(
        broken.status.success() && said.starts_with("Note: lab.crl: the revocation list cannot be read"),
        "{said}"
    );
    // A merge also takes the list alone.
    fs::copy(old.path("lab.crl"), new.path("old.crl")).unwrap();
    let said = new.good(&["fleet", "merge", "old.crl"]);
    assert!(said.starts_with("lab.fleet: took over from old.crl\n  revoked: va\n"), "{said}");
    assert!(is_revoked(&told(&[&new]), &new, "va"));
}

#[test]
fn a_certificate_that_another_copy_made_is_entered_when_it_is_renewed() {
    let (new, old) = two_copies();
    new.good(&["fleet", "revoke", "va"]);
    new.good(&["fleet", "enroll", "va", "--again", "--force"]);
    new.bring("va.identity", &old);
    let ran = old.run(&["fleet", "renew", "va"]);
    let said = String::from_utf8(ran.stderr).unwrap();
    assert!(
        ran.status.success() && said.contains("another copy of lab.fleet made the certificate"),
        "{said}"
    );
    assert_eq!(old.identity("va.identity").as_peer().incarnation, 1);
    old.good(&["fleet", "revoke", "va"]);
    let anchors = told(&[&old]);
    assert!(is_revoked(&anchors, &old, "va") && is_revoked(&anchors, &new, "va"));
}

#[test]
fn commands_at_once_lose_nothing() {
    let place = Place::with_fleet();
    let nodes: Vec<_> = (0..12).map(|i| format!("arm-{i}")).collect();
    let start = |args: &[&str]| place.command(args).stdout(Stdio::null()).spawn().unwrap();
    let enrolling: Vec<_> = nodes.iter().map(|n| start(&["fleet", "enroll", n])).collect();
    assert!(enrolling.into_iter().all(|mut child| child.wait().unwrap().success()));
    assert_eq!(place.fleet().nodes().len(), nodes.len());
    let (first, rest) = nodes.split_at(6);
    let revoking = first.iter().map(|n| start(&["fleet", "revoke", n]));
    let renewing = rest.iter().map(|n| start(&["fleet", "renew", n]));
    let all: Vec<_> = revoking.chain(renewing).collect();
    assert!(all.into_iter().all(|mut child| child.wait().unwrap().success()));
    let fleet = place.fleet();
    assert_eq!(fleet.nodes().filter(|n| fleet.revoked_at(n).is_some()).count(), first.len());
    assert_eq!(fleet.nodes().map(|n| n.certificates.len()).sum::<usize>(), nodes.len() + rest.len());
    let anchors = place.anchors_with_list();
    let revoked = nodes
        .iter()
        .filter(|n| anchors.is_peer_revoked(place.identity(&format!("{n}.identity")).as_peer()))
        .count();
    assert_eq!(revoked, first.len());
}

#[test]
fn renewal_keeps_key_and_place() {
    let place = Place::with_fleet();
    place.good(&["fleet", "enroll", "arm-1", "--group", "arms", "--valid", "1h"]);
    place.good(&["fleet", "enroll", "desk"]);
    let before = place.identity("arm-1.identity");
    let said = place.good(&["fleet", "rotate-secret"]);
    assert!(said.contains("generation 2 of the naming secret"), "{said}");
    place.good(&["fleet", "renew", "arm-1"]);
    let after = place.identity("arm-1.identity");
    assert_eq!((after.node_id(), after.groups()), (before.node_id(), before.groups()));
    assert!(after.not_after() > before.not_after());
    let generations = |i: &Identity| i.naming_secrets().iter().map(|n| n.generation).collect::<Vec<_>>();
    assert_eq!((generations(&before), generations(&after)), (vec![1], vec![2, 1]));
    let signed = before.sign("x", b"y");
    assert_eq!(after.as_peer().verify_signature("x", b"y", &signed), Ok(()), "the key is the same");
    // New names come from the new secret.
    let name = |identity: &str| {
        let args = ["name", "--owner", "arm-1", "--topic", "/a", "--type", "p/msg/T", "--identity", identity];
        place.good(&args)
    };
    place.write("old.identity", &before.to_text(), 0o600);
    assert_ne!(name("old.identity"), name("arm-1.identity"));

    assert!(place.bad(&["fleet", "retire-secret", "3"]).contains("generation 2 is the newest"));
    let said = place.bad(&["fleet", "retire-secret", "2"]);
    assert!(said.contains("not handed generation 2 of the secret yet: desk. They would find"), "{said}");
    let json: serde_json::Value = serde_json::from_str(&place.good(&["fleet", "list", "--json"])).unwrap();
    let secrets: Vec<_> = json["nodes"]
        .as_array()
        .unwrap()
        .iter()
        .map(|n| (&n["secret_generation"], n["seen"].is_string()))
        .collect();
    assert_eq!(secrets, [(&2.into(), true), (&1.into(), true)]);
    let done = place.good(&["fleet", "retire-secret", "2", "--force"]);
    assert!(done.ends_with("generations in use: 2\n"), "{done}");
    place.good(&["fleet", "renew", "arm-1", "--force"]);
    let forced = place.identity("arm-1.identity");
    assert_eq!(generations(&forced), [2]);
    assert!(
        forced.as_peer().verify_signature("x", b"y", &signed).is_err(),
        "a lost key is replaced by force"
    );
    assert!(place.bad(&["fleet", "renew", "nobody"]).contains("has no node nobody"));
    for (time, said) in
        [("0d", "longer than nothing"), ("5", "a time has a unit"), ("xd", "90d, 12h, 30min or 2s")]
    {
        assert!(place.bad(&["fleet", "renew", "arm-1", "--valid", time]).contains(said));
    }
}

#[test]
fn a_fleet_file_that_was_altered_is_refused() {
    let place = Place::with_fleet();
    place.good(&["fleet", "enroll", "arm-1"]);
    let text = place.read("lab.fleet");
    let marker = "-----BEGIN SGC ROSTER-----\n";
    let at = text.find(marker).unwrap() + marker.len() + 80;
    let mut bytes = text.into_bytes();
    bytes[at] = if bytes[at] == b'A' { b'B' } else { b'A' };
    place.write("lab.fleet", std::str::from_utf8(&bytes).unwrap(), 0o600);
    for command in [&["fleet", "list"][..], &["fleet", "revoke", "arm-1"], &["fleet", "enroll", "x"]] {
        assert!(place.bad(command).contains("SGC ROSTER"));
    }
    place.set_mode("lab.fleet", 0o640);
    for command in [&["fleet", "list"][..], &["fleet", "revoke", "arm-1"], &["fleet", "rotate-secret"]] {
        let said = place.bad(command);
        assert!(
            said.contains("its mode 0640 lets others at the CA's private key: chmod 600 lab.fleet"),
            "{said}"
        );
    }
}

/// Returns a CA as a company may have it already.
fn company_ca(place: &Place) -> (CertificateParams, KeyPair) {
    let mut params = CertificateParams::default();
    params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    params.distinguished_name.push(DnType::CommonName, "Company CA");
    let key = KeyPair::generate_for(&rcgen::PKCS_ECDSA_P384_SHA384).unwrap();
    let certificate = params.self_signed(&key).unwrap();
    place.write("ca.pem", &certificate.pem(), 0o644);
    place.write("ca.key", &key.serialize_pem(), 0o600);
    (params, key)
}

#[test]
fn a_fleet_around_a_ca_that_exists() {
    let place = Place::new();
    company_ca(&place);
    place.good(&["fleet", "import", "lab", "--ca-cert", "ca.pem", "--ca-key", "ca.key"]);
    place.good(&["fleet", "enroll", "arm-1"]);
    place.good(&["fleet", "revoke", "arm-1"]);
    let judged = place.anchors_with_list().verify(place.identity("arm-1.identity").chain(), now());
    assert!(matches!(judged, Err(CertError::Revoked { .. })));
    let import = |cert, key| place.bad(&["fleet", "import", "new", "--ca-cert", cert, "--ca-key", key]);
    place.write("sec1.key", &pem("EC PRIVATE KEY", b"x"), 0o600);
    assert!(import("ca.pem", "sec1.key").contains("`openssl pkcs8 -topk8 -nodes -in FILE` writes one"));
    assert!(import("ca.key", "ca.key").contains("it holds no certificate in PEM"));
    place.set_mode("ca.key", 0o644);
    assert!(import("ca.pem", "ca.key").contains("its mode 0644 lets others at the CA's private key"));
}

#[test]
fn a_certificate_of_a_ca_that_keeps_its_key() {
    let place = Place::new();
    let (params, key) = company_ca(&place);
    // A fleet file supplies the secret; its CA is not used.
    place.good(&["fleet", "create", "lab"]);
    let said = place.good(&["fleet", "request", "arm-1", "--secret", "lab.fleet"]);
    assert!(said.contains("sgc fleet accept CERTIFICATE --ca CA --node-name arm-1"), "{said}");
    let sign = |uri: &str, file: &str| {
        // A CA takes the key and the alternative names from a request.
        let mut leaf = CertificateParams::default();
        leaf.subject_alt_names = vec![rcgen::SanType::URI(uri.try_into().unwrap())];
        let node_key = KeyPair::from_pem(&place.read("arm-1.key")).unwrap();
        let made = leaf.signed_by(&node_key, &Issuer::from_params(&params, &key)).unwrap();
        place.write(file, &made.pem(), 0o644);
    };
    let uri = format!("sgc:node:{}", place.fleet().secret().pseudonym("arm-1"));
    let csr = place.read("arm-1.csr");
    let der = sgc_trust::pem_contents(&csr, &["CERTIFICATE REQUEST"]).unwrap();
    assert!(der[0].windows(uri.len()).any(|w| w == uri.as_bytes()), "the request names the node");
    sign(&uri, "arm-1.pem");
    let accept =
        ["fleet", "accept", "arm-1.pem", "--ca", "ca.pem", "--node-name", "arm-1", "--fleet-name", "lab"];
    place.good(&[&accept[..], &["--secret", "lab.fleet"]].concat());
    let identity = place.identity("arm-1.identity");
    assert_eq!(identity.fleet_secret().unwrap().expose(), place.fleet().secret().expose());
    let ca = sgc_trust::pem_contents(&place.read("ca.pem"), &["CERTIFICATE"]).unwrap();
    let anchors = TrustAnchors::new([CertificateDer::from(ca[0].to_vec())]).unwrap();
    assert_eq!(anchors.verify(identity.chain(), now()).unwrap().node_id, identity.node_id());

    sign("https://example.com", "other.pem");
    let mut other = accept.to_vec();
    other[2] = "other.pem";
    let said = place.bad(&other);
    assert!(said.contains("names no SGC node") && said.contains("sgc fleet request"), "{said}");
    assert!(!Path::new(&place.path("other.identity")).exists());
}

impl Place {
    /// Runs `openssl`, which these tests need.
    fn openssl(&self, args: &[&str]) -> String {
        let ran = Command::new("openssl").args(args).current_dir(self.dir.path()).output();
        let ran = ran.expect("these tests need the program `openssl`");
        assert!(ran.status.success(), "{args:?}: {}", String::from_utf8_lossy(&ran.stderr));
        String::from_utf8(ran.stdout).unwrap()
    }

    /// Signs `arm-1.csr` with a CA that `openssl` made.
    fn sign(&self, how: &[&str]) {
        let sign = ["x509", "-req", "-in", "arm-1.csr", "-CA", "ca.pem", "-CAkey", "ca.key", "-days", "90"];
        self.openssl(&[&sign[..], &["-out", "arm-1.pem"], how].concat());
    }
}

/// Follows the recipe of docs/how-to/own-ca.md with the request of a node that asks for too much.
#[test]
fn extensions_that_were_reviewed_make_a_node_and_nothing_more() {
    let place = Place::new();
    place.openssl(&[
        "req",
        "-x509",
        "-newkey",
        "ec",
        "-pkeyopt",
        "ec_paramgen_curve:P-256",
        "-nodes",
        "-keyout",
        "ca.key",
        "-out",
        "ca.pem",
        "-subj",
        "/CN=Company CA",
        "-days",
        "3650",
        "-addext",
        "basicConstraints=critical,CA:TRUE,pathlen:0",
        "-addext",
        "keyUsage=critical,keyCertSign,cRLSign",
    ]);
    place.good(&["fleet", "create", "acme"]);
    place.good(&["fleet", "request", "arm-1"]);
    let said = place.good(&["fleet", "extensions", "arm-1", "--secret", "acme.fleet", "--group", "arms"]);
    assert!(said.contains("-extfile arm-1.ext") && said.contains("--group arms"), "{said}");
    place.sign(&["-extfile", "arm-1.ext"]);
    let accept = [
        "fleet",
        "accept",
        "arm-1.pem",
        "--ca",
        "ca.pem",
        "--node-name",
        "arm-1",
        "--fleet-name",
        "acme",
        "--secret",
        "acme.fleet",
    ];
    let said = place.bad(&accept);
    assert!(said.contains("it has 1 that were not asked for, and lacks 0"), "{said}");
    let said = place.bad(&[&accept[..], &["--group", "legs"]].concat());
    assert!(said.contains("it has 1 that were not asked for, and lacks 1"), "{said}");
    let with_group = [&accept[..], &["--group", "arms"]].concat();
    assert!(
        place.bad(&[&with_group[..], &["--may-route"]].concat()).contains("it lacks the URI sgc:role:router")
    );
    place.good(&with_group);
    let identity = place.identity("arm-1.identity");
    assert!(!identity.as_peer().may_route);

    // The node asks for a role, another group, another name, and to be a CA.
    let secret = Fleet::parse(&place.read("acme.fleet")).unwrap();
    let tag = secret.secret().group_tag("operators");
    let (arm, desk) = (secret.secret().pseudonym("arm-1"), secret.secret().pseudonym("desk"));
    let greedy = |names: &str, ca: &str| {
        place.write(
            "greedy.cnf",
            &format!(
                "[req]\ndistinguished_name=dn\nreq_extensions=ext\nprompt=no\n[dn]\nCN=arm-1\n[ext]\n\
             basicConstraints=critical,CA:{ca}\nsubjectAltName={names}\n"
            ),
            0o644,
        );
        place.openssl(&["req", "-new", "-key", "arm-1.key", "-config", "greedy.cnf", "-out", "arm-1.csr"]);
    };
    let force = [&with_group[..], &["--force"]].concat();
    greedy(&format!("URI:sgc:node:{desk},URI:sgc:group:{tag},URI:sgc:role:router"), "TRUE");
    place.sign(&["-extfile", "arm-1.ext"]);
    place.good(&force);
    let given = place.identity("arm-1.identity");
    assert_eq!((given.node_id(), given.groups()), (identity.node_id(), identity.groups()));
    assert!(!given.as_peer().may_route);

    // An unsafe recipe: the CA signs all that the request asks for.
    place.sign(&["-copy_extensions", "copyall"]);
    let said = place.bad(&force);
    assert!(said.contains("is that of a CA as well") && said.contains("sgc fleet extensions"), "{said}");
    greedy(&format!("URI:sgc:node:{arm},URI:sgc:role:router"), "FALSE");
    place.sign(&["-copy_extensions", "copyall"]);
    let said = place.bad(&[&accept[..], &["--force"]].concat());
    assert!(said.contains("lets the node route for others") && said.contains("was not asked for"), "{said}");
    place.good(&[&accept[..], &["--force", "--may-route"]].concat());
    greedy(&format!("URI:sgc:node:{arm},URI:sgc:incarnation:9"), "FALSE");
    place.sign(&["-copy_extensions", "copyall"]);
    let said = place.bad(&[&accept[..], &["--force"]].concat());
    assert!(said.contains("is of a later incarnation of the node"), "{said}");
}

/// A process of `sgc run`, killed at the end.
struct Running(std::process::Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

impl Place {
    /// Returns a place with the fleet `lab`: the authority `keeper`, a router, two arms, and a desk in this group.
    fn with_authority(group_of_desk: &str) -> Self {
        let place = Self::new();
        place.good(&["fleet", "create", "lab", "--authority", "keeper"]);
        place.good(&["fleet", "enroll", "cloud", "--role", "router"]);
        place.good(&["fleet", "enroll", "desk", "--group", group_of_desk]);
        for node in ["keeper", "arm-1", "arm-2"] {
            place.good(&["fleet", "enroll", node]);
        }
        place
    }

    /// Runs a node of this directory until it is ready.
    fn start(&self, node: &str, port: u16, more: &str) -> Running {
        use std::io::BufRead as _;
        let text = format!(
            "identity = \"{node}.identity\"\n[node]\nname = \"{node}\"\nstate = \"{node}.state\"\nwatch = false\n{}\
             [admin]\nsocket = \"{node}.sock\"\n{more}",
            if node == "cloud" {
                String::new()
            } else {
                format!("routers = [\"quic://127.0.0.1:{port}\"]\n")
            },
        );
        self.write(&format!("{node}.toml"), &text, 0o644);
        let mut command = self.command(&["run", "-c", &format!("{node}.toml"), "--print-ready"]);
        let mut child = command.stdout(Stdio::piped()).spawn().unwrap();
        let mut line = String::new();
        std::io::BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        assert!(!line.is_empty(), "{node} does not start");
        Running(child)
    }

    fn keeper(&self, port: u16) -> Running {
        let more = "[authority]\nfleet = \"lab.fleet\"\noperators = [\"group:operators\"]\n";
        self.start("keeper", port, more)
    }
}

fn wait(what: &str, is_so: impl Fn() -> bool) {
    let until = std::time::Instant::now() + std::time::Duration::from_secs(60);
    while !is_so() {
        assert!(std::time::Instant::now() < until, "{what}");
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
}

#[test]
fn an_operator_keeps_the_fleet_from_a_machine_without_its_file() {
    let place = Place::with_authority("operators");
    let port = unused_port();
    let _cloud = place.start("cloud", port, &format!("[router]\nlisten = [\"quic://127.0.0.1:{port}\"]\n"));
    let keeper = place.keeper(port);
    let (_desk, _arm) = (place.start("desk", port, ""), place.start("arm-1", port, ""));
    let at = ["--at", "keeper", "-c", "desk.toml"];
    let good = |args: &[&str]| place.good(&[&["fleet"], args, &at].concat());
    let refused = |args: &[&str]| {
        let ran = place.run(&[&["fleet"], args].concat());
        assert_eq!((ran.status.code(), ran.stdout.as_slice()), (Some(1), &b""[..]), "{args:?}");
        String::from_utf8(ran.stderr).unwrap()
    };

    let shown = good(&["list"]);
    assert!(shown.contains("renewed by keeper") && shown.contains("arm-2"), "{shown}");
    let json: serde_json::Value = serde_json::from_str(&good(&["list", "--json"])).unwrap();
    assert_eq!(json["nodes"].as_array().unwrap().len(), 5);

    // With a key of the node's own, and with one made here.
    place.good(&["fleet", "request", "arm-3"]);
    good(&["enroll", "arm-3", "--csr", "arm-3.csr", "--group", "arms"]);
    place.good(&["fleet", "accept", "arm-3.answer"]);
    good(&["enroll", "arm-4"]);
    let (arm_3, arm_4) = (place.identity("arm-3.identity"), place.identity("arm-4.identity"));
    assert_eq!(arm_3.groups(), [place.fleet().secret().group_tag("arms")]);
    assert_eq!(arm_4.node_id(), place.fleet().node_id_of(&"arm-4".parse().unwrap()));
    good(&["renew", "arm-4", "--valid", "100d"]);
    let renewed = place.identity("arm-4.identity");
    assert!(renewed.not_after() > arm_4.not_after());
    let key = |identity: &Identity| requested_key_hash(&identity.csr());
    assert_eq!(key(&renewed), key(&arm_4));

    // Refusals name their cause.
    let said = refused(&["revoke", "arm-2", "--at", "keeper", "--socket", "arm-1.sock"]);
    assert!(said.contains("keeper does not take this node for an operator"), "{said}");
    let said = refused(&["revoke", "arm-2", "--at", "keepr", "--socket", "desk.sock"]);
    assert!(said.contains("no authority keepr is in reach of this node"), "{said}");
    let said = refused(&[&["revoke", "nobody"][..], &at].concat());
    assert!(said.contains("keeper refuses: the fleet's roster has no node nobody"), "{said}");

    // The authority is killed during the operation, while it waits for the lock of the fleet file.
    let held = sgc_node::LockedFleet::open(&place.path("lab.fleet")).unwrap();
    let command =
        place.command(&[&["fleet", "revoke", "arm-2"][..], &at].concat()).stderr(Stdio::piped()).spawn();
    let inode =
        format!(":{} ", std::os::unix::fs::MetadataExt::ino(&fs::metadata(place.path("lab.fleet")).unwrap()));
    let waits = |line: &str| line.contains("->") && line.contains(&inode);
    wait("it waits for the file", || fs::read_to_string("/proc/locks").unwrap().lines().any(waits));
    drop(keeper);
    drop(held);
    let _keeper = place.keeper(port);
    let ran = command.unwrap().wait_with_output().unwrap();
    let said = String::from_utf8(ran.stderr).unwrap();
    assert!(
        said.contains("or was restarted meanwhile") && said.contains("sgc fleet list --at keeper"),
        "{said}"
    );
    let is_revoked = || {
        let json: serde_json::Value = serde_json::from_str(&good(&["list", "--json"])).unwrap();
        json["nodes"].as_array().unwrap().iter().any(|n| n["name"] == "arm-2" && n["revoked"].is_string())
    };
    assert!(!is_revoked());
    assert!(good(&["revoke", "arm-2"]).contains("arm-2: revoked\nRevocation list "));
    assert!(is_revoked());
}

#[test]
fn a_lost_fleet_file_comes_back_from_a_copy() {
    let place = Place::with_fleet();
    place.good(&["fleet", "enroll", "arm-1"]);
    let said = place.good(&["fleet", "backup"]);
    let copy = place.files().into_iter().find(|file| file.ends_with(".fleet-backup")).unwrap();
    assert!(
        copy.starts_with("lab-20") && said.starts_with(&format!("{copy}: fleet lab, 1 nodes,")),
        "{said}"
    );
    assert_eq!(place.mode(&copy), 0o600);
    assert!(place.bad(&["fleet", "backup"]).contains("--force replaces it"));
    // No command takes the copy for the file, and none overwrites the file.
    place.good(&["fleet", "list"]);
    assert!(place.bad(&["fleet", "restore", &copy]).contains("sgc fleet merge COPY"));

    // By way of a program that encrypts it.
    let piped = place.run(&["fleet", "backup", "-"]);
    assert!(piped.status.success());
    let before = place.read("lab.fleet");
    assert_eq!(String::from_utf8(piped.stdout.clone()).unwrap(), before);
    place.good(&["fleet", "enroll", "arm-2"]);
    fs::rename(place.path("lab.fleet"), place.path("lost")).unwrap();
    let mut child = place
        .command(&["fleet", "restore", "-"])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    std::io::Write::write_all(&mut child.stdin.take().unwrap(), &piped.stdout).unwrap();
    let ran = child.wait_with_output().unwrap();
    assert!(ran.status.success() && String::from_utf8(ran.stdout).unwrap().contains("sgc fleet adopt"));
    assert_eq!((place.read("lab.fleet"), place.mode("lab.fleet")), (before, 0o600));
    // As the command says, what was enrolled since is entered again.
    assert!(place.bad(&["fleet", "revoke", "arm-2"]).contains("has no node arm-2"));
    place.good(&["fleet", "adopt", "arm-2", "--certificate", "arm-2.identity"]);
    place.good(&["fleet", "revoke", "arm-2"]);

    place.write("torn.fleet-backup", &place.read(&copy)[..900], 0o600);
    assert!(place.bad(&["fleet", "restore", "torn.fleet-backup", "--fleet", "new.fleet"]).contains("torn"));
    assert!(!place.files().iter().any(|file| file == "new.fleet"));
}

#[test]
fn a_machine_joins_with_a_code_and_the_code_is_good_once() {
    let place = Place::with_authority("operators");
    let port = unused_port();
    let url = format!("quic://127.0.0.1:{port}");
    let _cloud = place.start("cloud", port, &format!("[router]\nlisten = [\"{url}\"]\n"));
    let keeper = place.keeper(port);
    let _desk = place.start("desk", port, "");
    let refused = |args: &[&str], code: i32| {
        let ran = place.run(args);
        assert_eq!((ran.status.code(), ran.stdout.as_slice()), (Some(code), &b""[..]), "{args:?}");
        String::from_utf8(ran.stderr).unwrap()
    };
    // The code alone is on standard output.
    let invite = |args: &[&str]| {
        let ran = place.run(&[&["fleet", "invite"], args].concat());
        assert!(ran.status.success(), "{ran:?}");
        String::from_utf8(ran.stdout).unwrap().trim().to_owned()
    };
    let is_there = |file: &str| place.files().iter().any(|there| there == file);

    // From the file, and by an operator, whose node knows the routers.
    let code = invite(&["arm-7", "--group", "arms", "--valid", "30d", "--via", &url]);
    let by_operator = ["arm-8", "--at", "keeper", "--socket", "desk.sock", "--within", "1h"];
    let other = invite(&by_operator);
    let said = place.good(&["join", &code]);
    assert!(said.contains("node arm-7 of fleet lab") && said.contains("sgc run -c arm-7.toml"), "{said}");
    let arm = place.identity("arm-7.identity");
    assert_eq!(arm.groups(), [place.fleet().secret().group_tag("arms")]);
    assert!(arm.not_after().0 < now().0 + 31 * 86_400_000);
    assert_eq!(place.mode("arm-7.identity"), 0o600);
    assert!(place.good(&["check", "-c", "arm-7.toml"]).contains("no mistakes"));

    // An identity that is there is kept, and the code with it.
    place.write("arm-8.identity", "something else", 0o600);
    assert!(refused(&["join", &other], 2).contains("--force replaces it"));
    let mut command = place.command(&["join", "--force"]);
    let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    std::io::Write::write_all(&mut child.stdin.take().unwrap(), other.as_bytes()).unwrap();
    assert!(child.wait_with_output().unwrap().status.success());
    assert_eq!(place.identity("arm-8.identity").node_name().as_str(), "arm-8");
    assert!(place.read("arm-8.toml").contains(&url));

    // A directory that cannot be written is noticed before the code is used.
    let spare = invite(&["cloud-2", "--role", "router", "--via", &url]);
    assert!(refused(&["join", "--dir", "missing", &spare], 1).contains("missing"));
    assert!(refused(&["join", "--service", "../robot", &spare], 2).contains("'/'"));
    fs::create_dir(place.path("other")).unwrap();
    let joined: serde_json::Value =
        serde_json::from_str(&place.good(&["join", "--dir", "other", "--json", &spare])).unwrap();
    let until = place.identity("other/cloud-2.identity").not_after().to_string();
    let expected = serde_json::json!({
        "node": "cloud-2", "fleet": "lab", "expires": until, "identity_file": "other/cloud-2.identity",
        "config_file": "other/cloud-2.toml", "config_is_new": true, "service": null,
    });
    assert_eq!(joined, expected);
    assert!(place.good(&["check", "-c", "other/cloud-2.toml"]).contains("no mistakes"));
    assert!(place.read("other/cloud-2.toml").contains("[router]\nlisten = "));
    assert_eq!(fs::read_dir(place.path("other")).unwrap().count(), 2, "nothing unfinished is left");

    let said = refused(&["join", "--dir", "other", &code], 1);
    assert!(said.contains("keeper refuses: the invitation of arm-7 was used"), "{said}");
    assert!(said.contains("sgc fleet revoke arm-7") && !is_there("other/arm-7.identity"), "{said}");
    let said = refused(&["join", &code[..code.len() / 2]], 2);
    assert!(said.contains("it was cut or mistyped"), "{said}");
    assert!(!said.contains(&code[20..40]), "an error repeats a secret: {said}");

    // Faults on the way name what to do, and cost no code.
    let late = invite(&["arm-9", "--via", &format!("quic://127.0.0.1:{}", unused_port())]);
    let said = refused(&["join", "--timeout", "1s", &late], 1);
    assert!(said.contains("no router within 1 s") && said.contains("--router names another"), "{said}");
    drop(keeper);
    let said = refused(&["join", "--router", &url, &late], 1);
    assert!(said.contains("no authority keeper is in reach: its node has to run"), "{said}");
    let _keeper = place.keeper(port);
    place.good(&["join", "--router", &url, &late]);
    assert!(is_there("arm-9.identity"));

    // A node is revoked before it came.
    let never = invite(&["arm-10", "--via", &url]);
    place.good(&["fleet", "revoke", "arm-10"]);
    assert!(refused(&["join", &never], 1).contains("node arm-10 was revoked at"));
    let listed = place.good(&["fleet", "list"]);
    assert!(listed.lines().any(|line| line.starts_with("arm-9 ") && line.contains("until")), "{listed}");
    invite(&["arm-12", "--via", &url]);
    let listed = place.good(&["fleet", "list"]);
    assert!(
        listed.lines().any(|line| line.starts_with("arm-12") && line.contains("invited until")),
        "{listed}"
    );
    let over = invite(&["arm-11", "--within", "1s", "--via", &url]);
    std::thread::sleep(std::time::Duration::from_millis(2100));
    assert!(refused(&["join", &over], 2).contains("the code ended at"));
}

#[test]
fn the_ca_is_shown_and_nothing_else() {
    let place = Place::with_fleet();
    let shown = place.good(&["fleet", "ca"]);
    let blocks = sgc_trust::pem_contents(&shown, &["CERTIFICATE"]).unwrap();
    assert_eq!(blocks.len(), 1);
    assert_eq!(blocks[0].as_slice(), place.fleet().ca_certificate().as_ref());
    assert_eq!(shown.matches("-----BEGIN").count(), 1, "{shown}");
}

#[test]
fn an_observer_sees_the_fleet_and_what_is_wrong_with_it() {
    let place = Place::with_authority("observers");
    let port = unused_port();
    let _cloud = place.start("cloud", port, &format!("[router]\nlisten = [\"quic://127.0.0.1:{port}\"]\n"));
    let _keeper = place.keeper(port);
    let (_desk, arm) = (place.start("desk", port, ""), place.start("arm-1", port, ""));
    let by_desk = |args: &[&str]| place.run(&[&["fleet"], args, &["--socket", "desk.sock"]].concat());
    let status = |args: &[&str]| {
        let ran = by_desk(&[&["status"], args].concat());
        let text = String::from_utf8([ran.stdout, ran.stderr].concat()).unwrap();
        (ran.status.code(), text)
    };
    let row = |text: &str, node: &str| {
        text.lines().find(|line| line.split_whitespace().next() == Some(node)).unwrap_or_default().to_owned()
    };
    // Until all are linked, one or the other gives no report.
    wait("both report", || {
        let (_, text) = status(&[]);
        ["cloud", "keeper", "arm-1"].iter().all(|node| row(&text, node).contains("  here"))
    });
    let (code, text) = status(&[]);
    assert_eq!(code, Some(0));
    assert!(text.starts_with("5 nodes, 4 here, 1 without a report; 1 of them needs attention\n"), "{text}");
    assert!(row(&text, "arm-1").contains("cloud "), "its link has the router's name: {text}");
    assert!(row(&text, "cloud").contains("  here") && row(&text, "cloud").contains("keeper "), "{text}");
    let absent = "Needs attention:\n  arm-2: it is not in reach, or gives no reports\n    see that it runs";
    assert!(text.contains(absent), "{text}");

    let (_, json) = status(&["--json", "arm-1"]);
    let json: serde_json::Value = serde_json::from_str(&json).unwrap();
    assert_eq!(json["nodes"].as_array().map(Vec::len), Some(1));
    assert_eq!(json["nodes"][0]["report"]["node"], "arm-1");
    let (_, text) = status(&["arm-1"]);
    assert!(text.contains("\narm-1:\n  Links:\n") && text.contains("cloud  a router"), "{text}");

    // `why` follows a path at another node, which has no ROS 2 network here.
    let why = by_desk(&["why", "arm-1:/camera"]);
    let text = String::from_utf8(why.stdout).unwrap();
    assert_eq!(why.status.code(), Some(1), "{text}");
    assert!(text.starts_with("At arm-1:\n✓ arm-1 runs"), "{text}");
    for (at, says) in [
        ("arm-1", "names no node and topic"),
        ("arm-2:/camera", "arm-2: it is not in reach, or gives no reports; see that it runs"),
    ] {
        let why = by_desk(&["why", at]);
        let text = String::from_utf8(why.stderr).unwrap();
        assert!(why.status.code() == Some(1) && text.contains(says), "{text}");
    }

    // A node that is no observer learns how to become one.
    let ran = place.run(&["fleet", "status", "--socket", "arm-1.sock"]);
    let text = String::from_utf8(ran.stderr).unwrap();
    assert_eq!(ran.status.code(), Some(1));
    assert!(
        text.contains("does not take the node here for an observer (enroll the node here with"),
        "{text}"
    );
    drop(arm);
    wait("its death shows", || row(&status(&[]).1, "arm-1").contains("no report, seen "));
}
