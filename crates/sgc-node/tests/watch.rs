//! A watched configuration: the running node follows each change of its file, and mistakes change nothing.

#![allow(clippy::unwrap_used)]

mod support;

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use sgc_node::config::{Config, parse};
use sgc_trust::pem_text;
use support::*;

struct WatchBench {
    node: Node,
    _trio: Trio,
    dir: tempfile::TempDir,
    audit: PathBuf,
}

/// Starts a node whose configuration is this file of the directory.
fn start(dir: tempfile::TempDir, file: &Path) -> WatchBench {
    let audit = dir.path().join("audit");
    let trio = Trio::new();
    let read = {
        let (file, base) = (file.to_owned(), trio.config());
        let (home, audit) = (dir.path().to_owned(), audit.clone());
        move || {
            let text = fs::read_to_string(&file).unwrap_or_default();
            let read = parse(&text, "node.toml", &home, &|_| None)?;
            let mut config = Config { shares: read.shares, partners: read.partners, ..base.clone() };
            config.watch = read.watch;
            config.audit.file = Some(audit.clone());
            Ok(config)
        }
    };
    let (identity, domain) = (identity("robot", false), trio.robot_net.clone());
    let node = Node::start_watched(Arc::new(read), file, identity, &domain);
    WatchBench { node, _trio: trio, dir, audit }
}

fn text(topics: &[&str]) -> String {
    let share = |topic: &&str| format!("[[share]]\ntopic = '{topic}'\nto = ['desk']\nsuite = 'group'\n");
    let shares: String = topics.iter().map(share).collect();
    format!("identity = 'x'\n[node]\nrouters = ['quic://127.0.0.1:1']\n{shares}")
}

impl WatchBench {
    fn shares(&self, topics: &[&str]) {
        wait(&format!("{topics:?}"), || {
            let status = self.node.status();
            let routes = status["routes"].as_array().unwrap();
            let found: Vec<_> = routes.iter().map(|route| route["topic"].as_str().unwrap()).collect();
            found == topics
        });
    }

    /// Returns the number of reloads with this outcome.
    fn reloads(&self, outcome: &str) -> usize {
        let log = fs::read_to_string(&self.audit).unwrap_or_default();
        log.lines().filter(|line| line.contains("\"reload\"") && line.contains(outcome)).count()
    }
}

#[test]
fn however_a_file_changes_the_node_follows() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("node.toml");
    fs::write(&file, text(&["/a"])).unwrap();
    let watched = start(dir, &file);
    watched.shares(&["/a"]);
    // The file is overwritten.
    fs::write(&file, text(&["/a", "/b"])).unwrap();
    watched.shares(&["/a", "/b"]);
    // Another file replaces it, as most editors do.
    let other = watched.dir.path().join(".node.toml.swp");
    fs::write(&other, text(&["/b"])).unwrap();
    fs::rename(&other, &file).unwrap();
    watched.shares(&["/b"]);
    // The file is missing for a while.
    fs::remove_file(&file).unwrap();
    fs::write(&other, text(&["/c"])).unwrap();
    watched.shares(&["/b"]);
    fs::rename(&other, &file).unwrap();
    watched.shares(&["/c"]);
    // A symbolic link gets another target, and the target changes.
    for (n, topic) in ["/d", "/e"].into_iter().enumerate() {
        let there = watched.dir.path().join(format!("there{n}"));
        fs::create_dir(&there).unwrap();
        fs::write(there.join("real.toml"), text(&[topic])).unwrap();
        std::os::unix::fs::symlink(there.join("real.toml"), &other).unwrap();
        fs::rename(&other, &file).unwrap();
        watched.shares(&[topic]);
    }
    fs::write(watched.dir.path().join("there1/real.toml"), text(&["/f"])).unwrap();
    watched.shares(&["/f"]);
}

#[test]
fn a_broken_file_changes_nothing_and_is_said() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("node.toml");
    fs::write(&file, text(&["/a"])).unwrap();
    let watched = start(dir, &file);
    watched.shares(&["/a"]);
    for broken in ["[[share", "[[share]]\ntopic = 'a'\nto = ['desk']\n"] {
        let before = watched.reloads("refused");
        fs::write(&file, text(&["/b"]) + broken).unwrap();
        wait("the refusal", || watched.reloads("refused") > before);
        watched.shares(&["/a"]);
    }
    fs::write(&file, text(&["/b"])).unwrap();
    watched.shares(&["/b"]);
}

#[test]
fn files_named_in_the_configuration_are_watched_and_others_are_not() {
    let dir = tempfile::tempdir().unwrap();
    let (file, ca) = (dir.path().join("node.toml"), dir.path().join("acme-ca.pem"));
    let certificate = |fleet: &str| {
        let fleet = sgc_trust::Fleet::create(
            fleet.parse().unwrap(),
            unix_now(),
            &mut rand_core::TryRngCore::unwrap_err(rand_core::OsRng),
        );
        pem_text("CERTIFICATE", fleet.unwrap().ca_certificate())
    };
    fs::write(&ca, certificate("acme")).unwrap();
    fs::write(&file, text(&["/a"])).unwrap();
    let watched = start(dir, &file);
    watched.shares(&["/a"]);
    // A partner that a reload adds brings a file to watch.
    let partner = "[[partner]]\nname = 'acme'\nca = 'acme-ca.pem'\n";
    fs::write(&file, text(&["/a"]) + partner).unwrap();
    let links = "nodes of another CA may link";
    wait("the partner", || watched.reloads(links) == 1);
    // The files are compared again after a change. Other files of the directory do not matter.
    wait("another look", || watched.reloads("nothing changed") == 1);
    fs::write(watched.dir.path().join("beside"), "anything").unwrap();
    fs::write(&ca, certificate("other")).unwrap();
    wait("the other CA", || watched.reloads(links) == 2);
    assert_eq!((watched.reloads(""), watched.reloads("nothing changed")), (3, 1));
}

#[test]
fn watching_can_be_switched_off() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("node.toml");
    let unwatched = |topics: &[&str]| text(topics).replace("[node]", "[node]\nwatch = false");
    fs::write(&file, unwatched(&["/a"])).unwrap();
    let watched = start(dir, &file);
    watched.shares(&["/a"]);
    fs::write(&file, unwatched(&["/b"])).unwrap();
    watched.node.reload(|_| {});
    watched.shares(&["/b"]);
    // The log shows the reload a little after it takes effect.
    wait("the log", || watched.reloads("") > 0);
    assert_eq!(watched.reloads(""), 1);
}
