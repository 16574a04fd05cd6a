//! Routers that keep names in a store: a `redis-server` of the test's own, which is killed and returns empty.

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
    let [mut shares, mut uses] =
        ["direct = \"never\"\n[ros]\ndomain_id = 0\n", "direct = \"never\"\n"].map(str::to_owned);
    for topic in crate::TOPICS {
        shares += &format!("[[share]]\ntopic = \"{}\"\nto = [\"desk\"]\n", topic.name);
        uses += &format!("[[use]]\nfrom = \"robot\"\ntopic = \"{}\"\n", topic.name);
    }
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
