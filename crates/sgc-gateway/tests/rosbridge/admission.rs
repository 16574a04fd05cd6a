//! Who a client is, and what it may do.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use serde_json::json;
use sgc_gateway::rosbridge::{ROSBRIDGE_ADMISSION_MAX, RosbridgeError, RosbridgeOptions};
use sgc_gateway::{Client as Who, Scope};
use sgc_ros::{RosWriter as _, SampleKind};
use sgc_wire::Qos;

use crate::client::{client_with, connect, pipe};
use crate::support::{STRING, Site, string};

fn options() -> RosbridgeOptions {
    let only_odom = || Scope { subscribe: vec!["/odom".into()], ..Scope::default() };
    RosbridgeOptions {
        is_token_needed: true,
        authenticate: Some(Arc::new(move |token: &str| match token {
            "right" => Ok(Who::own("partner").with_scope(only_odom())),
            _ => Err("the token is not valid".to_owned()),
        })),
        ..RosbridgeOptions::default()
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nothing_is_taken_before_a_token_is_shown() {
    let site = Site::new().await;
    let talker = site.writer("/odom", Qos::default());
    site.knows("/odom").await;
    // roslibpy has only the words of `rosauth`; anybody else may say it plainly.
    for auth in [json!({"op": "auth", "token": "right"}), json!({"op": "auth", "mac": "right", "client": ""})]
    {
        let mut browser = connect(site.session("nobody"), options()).await;
        let told = browser.told(json!({"op": "subscribe", "id": 1, "topic": "/odom"})).await;
        assert_eq!(told, r#"subscribe: say who you are first: {"op":"auth","token":"…"}"#);
        browser.send(json!({"op": "set_level", "level": "info"})).await;
        browser.status().await;
        browser.send(auth).await;
        browser.subscribe("/odom").await;
        talker.write(SampleKind::Write, 1, string("here")).unwrap();
        assert_eq!(browser.next().await["msg"]["data"], "here");
        let told = browser.told(json!({"op": "advertise", "topic": "/odom", "type": STRING})).await;
        assert_eq!(told, "advertise: partner may not publish /odom: its scope does not have it");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn who_becomes_another_keeps_what_that_one_may_have() {
    let site = Site::new().await;
    let options = RosbridgeOptions { is_token_needed: false, ..options() };
    let mut browser = connect(site.session("desk"), options).await;
    browser.subscribe("/odom").await;
    browser.subscribe("/secret").await;
    browser.send(json!({"op": "advertise", "topic": "/odom", "type": STRING})).await;
    browser.send(json!({"op": "advertise_service", "service": "/s", "type": "std_srvs/Empty"})).await;
    browser.settle().await;
    browser.send(json!({"op": "auth", "token": "right"})).await;
    for (op, told) in [
        (json!({"op": "unsubscribe", "topic": "/secret"}), "/secret is not subscribed to"),
        (json!({"op": "unadvertise", "topic": "/odom"}), "/odom is not advertised"),
        (json!({"op": "unadvertise_service", "service": "/s"}), "/s is not served"),
    ] {
        let (why, op_name) = (browser.told(op.clone()).await, op["op"].as_str().unwrap().to_owned());
        assert_eq!(why, format!("{op_name}: {told} by this client"));
    }
    let talker = site.writer("/odom", Qos::default());
    site.knows("/odom").await;
    talker.write(SampleKind::Write, 1, string("here")).unwrap();
    browser.send(json!({"op": "unsubscribe", "topic": "/odom"})).await;
    browser.settle_amid().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_wrong_token_ends_the_connection() {
    let site = Site::new().await;
    let mut browser = connect(site.session("nobody"), options()).await;
    let told = browser.told(json!({"op": "auth", "token": "wrong", "id": "a"})).await;
    assert_eq!(told, "auth: the token is not valid");
    assert_eq!(browser.closed().await, (1008, "the token is not valid".into()));
    assert!(matches!(browser.served.await.unwrap(), Err(RosbridgeError::NotAdmitted(_))));
}

#[tokio::test]
async fn who_says_nothing_is_not_waited_for() {
    let site = Site::new().await;
    tokio::time::pause();
    let mut browser = pipe(site.session("nobody"), options(), 4096).await;
    let begun = tokio::time::Instant::now();
    assert_eq!(browser.closed().await.0, 1008);
    assert!(begun.elapsed() >= ROSBRIDGE_ADMISSION_MAX && begun.elapsed() < Duration::from_secs(15));
}

#[tokio::test]
async fn who_is_admitted_no_more_is_disconnected() {
    let site = Site::new().await;
    tokio::time::pause();
    let is_admitted = Arc::new(AtomicBool::new(true));
    let still = Arc::clone(&is_admitted);
    let options = RosbridgeOptions {
        still_admits: Some(Arc::new(move |_: &Who| match still.load(Ordering::Relaxed) {
            true => Ok(()),
            false => Err("the token has expired".to_owned()),
        })),
        ..RosbridgeOptions::default()
    };
    let mut browser = pipe(site.session("partner"), options, 4096).await;
    browser.settle().await;
    is_admitted.store(false, Ordering::Relaxed);
    assert_eq!(browser.closed().await, (1008, "the token has expired".into()));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_the_scope_does_not_have_is_refused_and_not_seen() {
    let site = Site::new().await;
    let _talkers = [site.writer("/odom", Qos::default()), site.writer("/secret", Qos::default())];
    site.knows("/secret").await;
    let scope = Scope { subscribe: vec!["/odom".into()], ..Scope::default() };
    let mut browser = client_with(&site, scope).await;
    let told = browser.told(json!({"op": "subscribe", "id": 1, "topic": "/secret"})).await;
    assert_eq!(told, "subscribe: browser may not subscribe to /secret: its scope does not have it");
    for op in [
        json!({"op": "publish", "topic": "/odom", "msg": {}}),
        json!({"op": "advertise_service", "service": "/s", "type": "std_srvs/Empty"}),
        json!({"op": "advertise_action", "action": "/a", "type": "example_interfaces/Fibonacci"}),
    ] {
        let told = browser.told(op).await;
        assert!(told.contains("its scope does not have it"), "{told}");
    }
    let (values, is_done) = browser.call("/s", json!({})).await;
    assert!(!is_done && values.as_str().unwrap().contains("may not call /s"), "{values}");
    let (topics, _) = browser.call("/rosapi/topics", json!({})).await;
    assert_eq!(topics["topics"], json!(["/odom"]));
    let (secret, _) = browser.call("/rosapi/topic_type", json!({"topic": "/secret"})).await;
    assert_eq!(secret, json!({"type": ""}));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn tokens_are_refused_where_none_are_taken() {
    let site = Site::new().await;
    let mut browser = connect(site.session("desk"), RosbridgeOptions::default()).await;
    let told = browser.told(json!({"op": "auth", "token": "x"})).await;
    assert_eq!(told, "auth: this gateway takes no tokens here");
}
