//! Services and actions, in both directions.

use std::time::Duration;

use serde_json::{Value as Json, json};
use sgc_gateway::rosbridge::RosbridgeOptions;
use sgc_gateway::{Content, Form, SessionLimits};

use crate::client::{Client, PATIENCE, bounded, client, pipe};
use crate::support::{Site, eventually};

const SET_BOOL: &str = "std_srvs/srv/SetBool";
const FIBONACCI: &str = "example_interfaces/action/Fibonacci";

/// Serves a service by a program without this protocol.
async fn serve_switch(site: &Site) {
    let mut serving = site.session("program").serve("/switch", Some(SET_BOOL)).await.unwrap();
    tokio::spawn(async move {
        while let Some(request) = serving.next().await {
            let asked = serving.write(&request, Form::Json).unwrap();
            let reply = json!({"success": true, "message": String::from_utf8(asked.to_vec()).unwrap()});
            serving.replier().reply(request.id, &Content::json(reply.to_string())).await.unwrap();
        }
    });
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn services_of_the_network_are_called() {
    let site = Site::new().await;
    serve_switch(&site).await;
    let mut browser = client(&site).await;
    for (args, heard) in
        [(json!({"data": true}), true), (json!([true]), true), (json!([]), false), (json!(null), false)]
    {
        let (values, is_done) = browser.call("/switch", args).await;
        let message = json!({ "data": heard }).to_string();
        assert_eq!((values, is_done), (json!({"success": true, "message": message}), true));
    }
    // A call without an id gets an answer without one.
    browser.send(json!({"op": "call_service", "service": "/switch"})).await;
    let answer = browser.next().await;
    assert!(answer["op"] == "service_response" && answer.get("id").is_none(), "{answer}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn answers_come_in_pieces_or_as_cbor_if_that_is_asked_for() {
    let site = Site::new().await;
    serve_switch(&site).await;
    let mut browser = client(&site).await;
    let call = json!({"op": "call_service", "id": 7, "service": "/switch", "compression": "cbor"});
    browser.send(call).await;
    let answer = browser.next_binary().await;
    let mut wanted = b"\xa5\x62op\x70service_response\x62id\x07\x67service\x67/switch\x66values".to_vec();
    wanted.extend(b"\xa2\x67success\xf5\x67message\x6e{\"data\":false}\x66result\xf5");
    assert_eq!(answer, wanted);
    browser.send(json!({"op": "call_service", "service": "/switch", "fragment_size": 20})).await;
    let piece = browser.next().await;
    assert_eq!((&piece["op"], &piece["num"]), (&json!("fragment"), &json!(0)));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn calls_that_fail_say_why() {
    let site = Site::new().await;
    serve_switch(&site).await;
    let mut browser = client(&site).await;
    let wrong = browser.call("/switch", json!({"date": true})).await;
    let told = "not a message of that type: there is no member \"date\"";
    assert_eq!(wrong, (json!(told), false));
    let nobody = browser.call("/nobody", json!({})).await;
    assert_eq!(
        nobody,
        (json!("the type of /nobody is not known, since nobody has it yet; give its type"), false)
    );
    // The next service does not answer.
    let _silent = site.session("silent").serve("/silent", Some(SET_BOOL)).await.unwrap();
    browser.send(json!({"op": "call_service", "id": "c", "service": "/silent", "timeout": 0.05})).await;
    let answer = browser.next().await;
    assert_eq!(answer["values"], "no answer of /silent within 50 ms");
    assert_eq!((&answer["result"], &answer["id"]), (&json!(false), &json!("c")));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_client_serves_a_service() {
    let site = Site::new().await;
    let mut server = client(&site).await;
    let advertise = json!({"op": "advertise_service", "type": "std_srvs/SetBool", "service": "/switch"});
    server.send(advertise.clone()).await;
    server.settle().await;
    let mut caller = client(&site).await;
    caller.send(json!({"op": "call_service", "id": "c", "service": "/switch", "args": {"data": true}})).await;
    let call = server.next().await;
    assert_eq!((&call["op"], &call["service"]), (&json!("call_service"), &json!("/switch")));
    assert_eq!(call["args"], json!({"data": true}));
    let id = call["id"].clone();
    let response = |id: &Json, values: Json, result: bool| json!({"op": "service_response", "id": id, "service": "/switch", "values": values, "result": result});
    // After an error the client may answer again.
    server.send(response(&id, json!({"success": 3}), true)).await;
    let told = server.status().await.0;
    assert_eq!(told, "service_response: not a message of that type: success: 3, not bool");
    server.send(response(&id, json!({"success": true, "message": "on"}), true)).await;
    assert_eq!(caller.next().await["values"], json!({"success": true, "message": "on"}));
    // An answered request no longer waits.
    server.send(response(&id, json!({}), true)).await;
    let told = server.status().await;
    let waits = "service_response: /switch: no request waits under that id";
    assert_eq!(told, (waits.to_owned(), id));
    // A second advertisement replaces the first.
    server.send(advertise).await;
    server.settle().await;
    eventually(|| site.hub.graph().services["/switch"].servers.len() == 1).await;
    server.send(json!({"op": "unadvertise_service", "service": "/switch"})).await;
    server.settle().await;
    eventually(|| site.hub.graph().services.get("/switch").is_none_or(|info| info.servers.is_empty())).await;
    let told = server.told(json!({"op": "unadvertise_service", "service": "/switch"})).await;
    assert_eq!(told, "unadvertise_service: /switch is not served by this client");
}

async fn serve_fibonacci(site: &Site) -> Client {
    let mut server = client(site).await;
    let advertise =
        json!({"op": "advertise_action", "type": "example_interfaces/Fibonacci", "action": "/fib"});
    server.send(advertise).await;
    server.settle().await;
    server
}

fn goal(id: &str, order: i32) -> Json {
    json!({"op": "send_action_goal", "id": id, "action": "/fib", "action_type": FIBONACCI,
        "args": {"order": order}, "feedback": true})
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_goal_is_passed_on_told_of_and_done() {
    let site = Site::new().await;
    let mut server = serve_fibonacci(&site).await;
    let mut client = client(&site).await;
    client.send(goal("g1", 3)).await;
    let asked = server.next().await;
    assert_eq!((&asked["op"], &asked["action"]), (&json!("send_action_goal"), &json!("/fib")));
    assert_eq!((&asked["args"], &asked["action_type"]), (&json!({"order": 3}), &json!(FIBONACCI)));
    let id = &asked["id"];
    let feedback =
        json!({"op": "action_feedback", "id": id, "action": "/fib", "values": {"sequence": [0, 1]}});
    server.send(feedback).await;
    let told = client.next().await;
    let wanted =
        json!({"op": "action_feedback", "id": "g1", "action": "/fib", "values": {"sequence": [0, 1]}});
    assert_eq!(told, wanted);
    server.send(json!({"op": "action_status", "id": id, "action": "/fib", "status": 2})).await;
    let result = json!({"op": "action_result", "id": id, "action": "/fib", "status": 4, "result": true,
        "values": {"sequence": [0, 1, 1, 2]}});
    server.send(result.clone()).await;
    let told = client.next().await;
    let wanted = json!({"op": "action_result", "id": "g1", "action": "/fib", "status": 4, "result": true,
        "values": {"sequence": [0, 1, 1, 2]}});
    assert_eq!(told, wanted);
    assert_eq!(server.told(result).await, "action_result: no goal of that id is under way");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn goal_with_the_id_of_another_is_refused_without_a_result() {
    let site = Site::new().await;
    let mut server = serve_fibonacci(&site).await;
    let mut client = client(&site).await;
    client.send(goal("g", 3)).await;
    server.next().await;
    assert_eq!(client.told(goal("g", 4)).await, "send_action_goal: a goal of that id is under way");
    let invalid = json!({"op": "send_action_goal", "id": "g", "action": "/fib", "feedback": "much"});
    assert!(client.told(invalid).await.starts_with("send_action_goal: "));
    client.settle().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn goals_are_canceled_aborted_and_given_up_with_their_server() {
    let site = Site::new().await;
    let mut server = serve_fibonacci(&site).await;
    let mut client = client(&site).await;
    client.send(goal("canceled", 10)).await;
    let asked = server.next().await;
    client.send(json!({"op": "cancel_action_goal", "id": "canceled", "action": "/fib"})).await;
    let cancel = server.next().await;
    assert_eq!((&cancel["op"], &cancel["id"]), (&json!("cancel_action_goal"), &asked["id"]));
    let result = |asked: &Json, status: i32, result: bool| {
        json!({"op": "action_result", "id": asked["id"], "action": "/fib", "status": status, "result": result,
            "values": {"sequence": [7]}})
    };
    server.send(result(&asked, 5, true)).await;
    let told = client.next().await;
    assert_eq!((&told["status"], &told["result"]), (&json!(5), &json!(true)), "{told}");
    client.send(goal("aborted", 1)).await;
    let asked = server.next().await;
    server.send(result(&asked, 6, false)).await;
    assert_eq!(client.next().await["status"], 6);
    client.send(goal("left", 2)).await;
    server.next().await;
    drop(server);
    // The goal is aborted, or its server is gone before it could report that.
    let told = client.next().await;
    assert!(told["status"] == 6 || told["result"] == false, "{told}");
    let told = client.told(json!({"op": "cancel_action_goal", "id": "none", "action": "/fib"})).await;
    assert_eq!(told, "cancel_action_goal: no goal of that id is under way");
    // No client serves the action now.
    eventually(|| site.hub.graph().actions.get("/fib").is_none_or(|info| info.servers.is_empty())).await;
    client.send(goal("late", 2)).await;
    let told = client.next().await;
    assert_eq!((&told["op"], &told["result"]), (&json!("action_result"), &json!(false)));
    assert!(told["values"].as_str().unwrap().starts_with("nobody serves"), "{told}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_call_that_is_not_answered_holds_nobody_up() {
    let site = Site::new().await;
    serve_switch(&site).await;
    let _silent = site.session("silent").serve("/silent", Some(SET_BOOL)).await.unwrap();
    let mut browser = client(&site).await;
    browser.send(json!({"op": "call_service", "id": "never", "service": "/silent"})).await;
    let answered = tokio::time::timeout(Duration::from_secs(10), browser.call("/switch", json!({})));
    assert!(answered.await.unwrap().1);
}

#[tokio::test]
async fn long_answers_that_are_not_read_are_bounded_in_bytes_and_the_rest_are_refused() {
    const LONG: usize = 300 << 10;
    let site = Site::new().await;
    let mut serving = site.session("program").serve("/long", Some(SET_BOOL)).await.unwrap();
    let (all_answered, answered) = tokio::sync::oneshot::channel();
    tokio::spawn(async move {
        let mut requests = Vec::new();
        while requests.len() < 20 {
            requests.push(serving.next().await.unwrap().id);
        }
        let reply = Content::json(json!({"message": "x".repeat(LONG)}).to_string());
        for id in requests {
            serving.replier().reply(id, &reply).await.unwrap();
        }
        all_answered.send(()).unwrap();
        std::future::pending::<()>().await;
    });
    let limits = SessionLimits { waiting_bytes_max: 1 << 20, ..SessionLimits::default() };
    let mut browser = pipe(bounded(&site, limits), RosbridgeOptions::default(), 64 << 10).await;
    for id in 0..20 {
        browser.send(json!({"op": "call_service", "id": id, "service": "/long"})).await;
    }
    tokio::time::timeout(PATIENCE, answered).await.unwrap().unwrap();
    // The client reads only when all others wait for it, because only then the paused clock advances.
    tokio::time::pause();
    tokio::time::sleep(Duration::from_millis(1)).await;
    let (mut whole, mut refused) = (0, 0);
    for _ in 0..20 {
        let answer = browser.next().await;
        match answer["result"].as_bool().unwrap() {
            true => whole += 1,
            false => {
                let told = "1048576 bytes of replies that it does not read at most for a client";
                assert_eq!(answer["values"], told);
                refused += 1;
            }
        }
    }
    assert!(whole >= 6 && refused > 0, "{whole} came, {refused} were refused");
}
