//! Admission and rights of clients.

use std::sync::Arc;
use std::time::Duration;

use serde_json::{Value as Json, json};
use sgc_gateway::rosbridge::{ROSBRIDGE_ADMISSION_MAX, RosbridgeError, RosbridgeOptions};
use sgc_gateway::{ActionEvent, Client as Who, Content, Scope, SessionLimits};
use sgc_ros::{RosWriter as _, SampleKind};
use sgc_wire::Qos;

use crate::client::{PATIENCE, bounded, client_with, connect, pipe};
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
    // roslibpy has only the fields of `rosauth`; other clients use the plain field.
    for auth in [json!({"op": "auth", "token": "right"}), json!({"op": "auth", "mac": "right", "client": ""})]
    {
        let mut browser = connect(site.session("nobody"), options()).await;
        let told = browser.told(json!({"op": "subscribe", "id": 1, "topic": "/odom"})).await;
        assert_eq!(told, r#"subscribe: say who you are first: {"op":"auth","token":"…"}"#);
        assert_eq!(browser.told(json!({"op": "auth"})).await, r#"auth: "token" is missing"#);
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
async fn new_credential_keeps_permitted_subscriptions() {
    let site = Site::new().await;
    let options = RosbridgeOptions { is_token_needed: false, ..options() };
    let mut browser = connect(site.session("desk"), options).await;
    browser.subscribe("/odom").await;
    browser.subscribe("/secret").await;
    browser.send(json!({"op": "advertise", "topic": "/odom", "type": STRING})).await;
    browser.send(json!({"op": "advertise_service", "service": "/s", "type": "std_srvs/Empty"})).await;
    browser.settle().await;
    browser.send(json!({"op": "auth", "token": "right"})).await;
    for ended in ["subscribe to /secret", "publish /odom", "serve /s"] {
        let told = format!("auth: partner may not {ended}: its scope does not have it");
        assert_eq!(browser.status().await.0, told);
    }
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

/// Returns options by which any token permits calls of `/allowed`.
fn becomes_partner() -> RosbridgeOptions {
    RosbridgeOptions {
        authenticate: Some(Arc::new(|_: &str| {
            let scope = Scope { call: vec!["/allowed".into()], ..Scope::default() };
            Ok(Who::own("partner").with_scope(scope))
        })),
        ..RosbridgeOptions::default()
    }
}

fn call(id: &str, service: &str) -> Json {
    json!({"op": "call_service", "id": id, "service": service})
}

async fn within<T>(work: impl Future<Output = T>) -> T {
    tokio::time::timeout(PATIENCE, work).await.expect("it should have come by now")
}

#[tokio::test]
async fn new_credential_ends_calls_and_counts_what_stays() {
    let site = Site::new().await;
    let program = site.session("program");
    let mut silent = program.serve("/silent", Some("std_srvs/srv/SetBool")).await.unwrap();
    let mut allowed = program.serve("/allowed", Some("std_srvs/srv/SetBool")).await.unwrap();
    let limits = SessionLimits { calls_max: 2, ..SessionLimits::default() };
    let mut browser = connect(bounded(&site, limits), becomes_partner()).await;
    browser.send(call("1", "/silent")).await;
    browser.send(call("2", "/allowed")).await;
    within(silent.next()).await.unwrap();
    let asked = within(allowed.next()).await.unwrap();
    browser.send(json!({"op": "auth", "token": "x"})).await;
    let told = "partner may not call /silent: its scope does not have it";
    let ended =
        json!({"op": "service_response", "id": "1", "service": "/silent", "values": told, "result": false});
    assert_eq!(browser.next().await, ended);
    // There is room for one of two calls.
    browser.send(call("3", "/allowed")).await;
    within(allowed.next()).await.unwrap();
    browser.send(call("4", "/allowed")).await;
    let refused = browser.next().await;
    assert_eq!(refused["values"], "call_service: 2 calls and goals under way at most for a client");
    browser.status().await;
    allowed.replier().reply(asked.id, &Content::json(r#"{"success": true}"#)).await.unwrap();
    let answer = browser.next().await;
    assert_eq!((&answer["id"], &answer["result"]), (&json!("2"), &json!(true)));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn new_credential_cancels_goals() {
    let site = Site::new().await;
    let of = "example_interfaces/action/Fibonacci";
    let mut action = site.session("program").serve_action("/fib", Some(of)).await.unwrap();
    let mut browser = connect(site.session("browser"), becomes_partner()).await;
    let goal = json!({"op": "send_action_goal", "id": "g", "action": "/fib", "action_type": of, "args": {"order": 3}});
    browser.send(goal).await;
    let Some(ActionEvent::Goal { id, .. }) = within(action.next()).await else { panic!("a goal was sent") };
    action.replier().answer(&id, true).await.unwrap();
    browser.send(json!({"op": "auth", "token": "x"})).await;
    let told = "partner may not call /fib: its scope does not have it";
    let ended = json!({"op": "action_result", "id": "g", "action": "/fib", "values": told, "status": 0, "result": false});
    assert_eq!(browser.next().await, ended);
    assert_eq!(within(action.next()).await, Some(ActionEvent::Cancel { id }));
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
async fn client_that_does_not_authenticate_is_disconnected() {
    let site = Site::new().await;
    tokio::time::pause();
    let mut browser = pipe(site.session("nobody"), options(), 4096).await;
    let begun = tokio::time::Instant::now();
    assert_eq!(browser.closed().await.0, 1008);
    assert!(begun.elapsed() >= ROSBRIDGE_ADMISSION_MAX && begun.elapsed() < Duration::from_secs(15));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn interfaces_outside_the_scope_are_refused_and_invisible() {
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
    for auth in
        [json!({"op": "auth", "token": "x"}), json!({"op": "auth"}), json!({"op": "auth", "token": 1})]
    {
        assert_eq!(browser.told(auth).await, "auth: this gateway takes no tokens here");
    }
}
