//! Routers that keep names in a store: a `redis-server` of the test's own, which is killed and returns empty.

use std::fs;
use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;

use serde_json::Value;
use sgc_testkit::redis::{Redis, RedisOptions, is_redis_installed};

use crate::lab::{Lab, Nat};
use crate::node::Node;
use crate::support::eventually;
use crate::{Pair, cable, can_run, shared_turn};

/// The address of the second router, in the namespace of the first.
const SECOND: &str = "quic://10.10.0.1:7501";

fn store_of(router: &Node) -> Value {
    router.status()["store"].clone()
}

fn alerts(router: &Node) -> Vec<String> {
    let status = router.status();
    let kinds = status["alerts"].as_array().unwrap().iter().map(|alert| alert["kind"].as_str().unwrap());
    kinds.map(str::to_owned).collect()
}

fn keys(redis: &Redis) -> usize {
    redis.cli(0, &["DBSIZE"]).trim().trim_start_matches("(integer) ").parse().unwrap()
}

/// Returns the rest of the configurations of a robot that shares all topics and a desk that uses them.
fn rules(robot: &str, desk: &str) -> (String, String) {
    let [mut shares, mut uses] =
        ["direct = \"never\"\n[ros]\ndomain_id = 0\n", "direct = \"never\"\n"].map(str::to_owned);
    for topic in crate::TOPICS {
        shares += &format!("[[share]]\ntopic = \"{}\"\nto = [\"{desk}\"]\n", topic.name);
        uses += &format!("[[use]]\nfrom = \"{robot}\"\ntopic = \"{}\"\n", topic.name);
    }
    (shares, uses)
}

#[test]
fn names_are_found_in_a_store_and_outlive_it() {
    if !can_run() {
        return;
    }
    assert!(is_redis_installed(), "no redis-server: scripts/install-deps.sh test");
    let _turn = shared_turn();
    let lab = Lab::new(cable(), Nat::Public);
    let options = RedisOptions::default();
    let mut redis = Redis::single(lab.cloud.clone(), &lab.path("redis"), "127.0.0.1", options);
    let router = |name: &str, routers: &[&str], listen: &str| {
        let rest = format!(
            "[router]\nlisten = [\"{listen}\"]\nmapping = \"store\"\nstore = [\"{}\"]\nstore_prefix = \"lab\"\n",
            redis.urls()[0]
        );
        Node::start(&lab.cloud, &lab.write_config(name, routers, &rest), lab.enroll(name, true), None)
    };
    let first = router("cloud", &[], "quic://0.0.0.0:7447");
    let second = router("cloud-2", &["quic://10.10.0.1:7447"], "quic://0.0.0.0:7501");
    let (shares, uses) = rules("robot", "desk");
    let pair = Pair::between(&lab, ["robot", "desk"], [&shares, &uses], [&lab.url("quic"), SECOND]);
    pair.wait_for("never begins", |_| 1);
    let found = store_of(&second);
    assert!(found["found"].as_u64().unwrap() > 0, "{found}");
    assert_eq!((&found["answers"], &found["failures"]), (&true.into(), &0.into()), "{found}");
    let before = keys(&redis);
    assert!(before > 2, "names, batches and link states: {before}");

    redis.kill(0);
    for router in [&first, &second] {
        eventually("the router says that the store is down", || alerts(router) == ["store_down"]);
        assert_eq!(store_of(router)["answers"], false);
    }
    pair.wait_for("does not go on", |flow| flow.said() + 1);
    redis.restart(0);
    for router in [&first, &second] {
        eventually("the store answers again", || store_of(router)["answers"] == true);
        eventually("the alert is over", || alerts(router).is_empty());
    }
    eventually("everything is written again", || keys(&redis) >= before);
    pair.wait_for("does not stay", |flow| flow.said() + 1);
    for flow in &pair.flows {
        flow.end();
    }
}

#[test]
fn router_with_a_wrong_password_and_routers_without_the_store_find_names_by_asking() {
    if !can_run() {
        return;
    }
    assert!(is_redis_installed(), "no redis-server: scripts/install-deps.sh test");
    let _turn = shared_turn();
    let lab = Lab::new(cable(), Nat::Public);
    let redis = Redis::single(lab.cloud.clone(), &lab.path("redis"), "127.0.0.1", RedisOptions::default());
    let user = ["ACL", "SETUSER", "router", "on", ">right", "~lab:*", "+@all"];
    assert_eq!(redis.cli(0, &user).trim(), "OK");
    for password in ["right", "wrong"] {
        let file = lab.path(password);
        fs::write(&file, password).unwrap();
        fs::set_permissions(&file, fs::Permissions::from_mode(0o600)).unwrap();
    }
    let store = |password: &str| {
        format!(
            "mapping = \"store\"\nstore = [\"{}\"]\nstore_prefix = \"lab\"\nstore_user = \"router\"\n\
             store_password_file = \"{password}\"\n",
            redis.urls()[0]
        )
    };
    let router = |name: &str, port: u16, mapping: &str| {
        let others: &[&str] = if port == 7447 { &[] } else { &["quic://10.10.0.1:7447"] };
        let rest = format!("[router]\nlisten = [\"quic://0.0.0.0:{port}\"]\n{mapping}");
        let file = lab.write_config(name, others, &rest);
        (Node::start(&lab.cloud, &file, lab.enroll(name, true), None), file)
    };
    let (right, right_file) = router("cloud", 7447, &store("right"));
    let (wrong, wrong_file) = router("cloud-2", 7501, &store("wrong"));
    let _query = router("cloud-3", 7502, "mapping = \"query\"\n");
    let _flood = router("cloud-4", 7503, "mapping = \"flood\"\n");
    eventually("the router with the right password has the store", || store_of(&right)["answers"] == true);

    // Robot and desk at different routers, each way between them.
    let pairs = [(7447, 7501), (7501, 7447), (7447, 7502), (7503, 7447), (7502, 7501)];
    let pairs = pairs.map(|(near, far)| {
        let [robot, desk] = [format!("robot-{near}-{far}"), format!("desk-{near}-{far}")];
        let (shares, uses) = rules(&robot, &desk);
        let [near, far] = [near, far].map(|port: u16| format!("quic://10.10.0.1:{port}"));
        Pair::between(&lab, [&robot, &desk], [&shares, &uses], [&near, &far])
    });
    for pair in &pairs {
        pair.wait_for("never begins", |_| 1);
    }
    assert!(keys(&redis) > 2, "names, batches and link states");

    eventually("the router says that it has no store", || alerts(&wrong) == ["store_down"]);
    assert_eq!(store_of(&wrong)["answers"], false);
    assert_eq!(alerts(&right), [""; 0]);
    let check = |file: &Path| {
        let mut command = lab.cloud.command(env!("CARGO_BIN_EXE_sgc"));
        let output = command.args(["router", "store", "check", "--json", "-c"]).arg(file).output().unwrap();
        let report: Value = serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("{output:?}"));
        (output.status.code(), report)
    };
    let (code, report) = check(&right_file);
    assert_eq!((code, &report["fits"]), (Some(0), &true.into()), "{report}");
    let (code, report) = check(&wrong_file);
    assert_eq!((code, &report["fits"]), (Some(1), &false.into()), "{report}");
    let finding = &report["findings"][0];
    assert_eq!(finding["severity"], "error");
    assert!(finding["fix"].as_str().unwrap().contains("store_password_file"), "{finding}");

    // Names of the robots stay in the store; of the next one, nothing can be written.
    assert_eq!(redis.cli(0, &["ACL", "SETUSER", "router", "-set"]).trim(), "OK");
    let (shares, uses) = rules("robot-late", "desk-late");
    let urls = [7447, 7501].map(|port: u16| format!("quic://10.10.0.1:{port}"));
    let late = Pair::between(&lab, ["robot-late", "desk-late"], [&shares, &uses], [&urls[0], &urls[1]]);
    late.wait_for("never begins", |_| 1);
    eventually("the router says that it is refused", || alerts(&right) == ["store_refuses"]);
    late.flows.iter().for_each(|flow| flow.end());
    for pair in &pairs {
        pair.wait_for("does not stay", |flow| flow.said() + 1);
        pair.flows.iter().for_each(|flow| flow.end());
    }
}
