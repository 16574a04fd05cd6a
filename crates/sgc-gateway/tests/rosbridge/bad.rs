//! Invalid input: each error is explained, and other clients are not affected.

use futures_util::SinkExt as _;
use serde_json::json;
use sgc_gateway::SessionLimits;
use sgc_gateway::rosbridge::{RosbridgeError, RosbridgeOptions};
use sgc_wire::Qos;
use tokio::io::AsyncWriteExt as _;
use tokio_tungstenite::tungstenite::Message;

use crate::client::{bounded, client, connect, pipe};
use crate::support::{STRING, Site, string};
use sgc_ros::{RosWriter as _, SampleKind};

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn invalid_op_is_reported_and_the_connection_continues() {
    let site = Site::new().await;
    let mut browser = client(&site).await;
    for (text, told) in [
        ("{", "not JSON: EOF while parsing an object at line 1 column 1"),
        ("nonsense", "not JSON: expected ident at line 1 column 2"),
        ("", "not JSON: EOF while parsing a value at line 1 column 0"),
        ("[1,2]", "not an object with a member \"op\""),
        ("{}", "not an object with a member \"op\""),
        (r#"{"op":7}"#, "not an object with a member \"op\""),
        (r#"{"op":"dance"}"#, r#"there is no op "dance""#),
    ] {
        browser.send_text(text.to_owned()).await;
        assert_eq!(browser.status().await.0, told, "{text}");
    }
    browser.socket.send(Message::Binary(vec![0xff, 0xfe].into())).await.unwrap();
    assert!(browser.status().await.0.starts_with("not JSON"));
    // JSON as bytes is accepted.
    let bytes = json!({"op": "set_level", "level": "none"}).to_string().into_bytes();
    browser.socket.send(Message::Binary(bytes.into())).await.unwrap();
    browser.send(json!({"op": "dance"})).await;
    browser.settle().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn members_of_the_wrong_kind_are_named() {
    let site = Site::new().await;
    let mut browser = client(&site).await;
    for (op, told) in [
        (json!({"op": "subscribe"}), r#"subscribe: "topic" is missing"#),
        (json!({"op": "subscribe", "topic": 3}), r#"subscribe: "topic" is no text: 3"#),
        (
            json!({"op": "subscribe", "topic": "/a", "type": STRING, "throttle_rate": "fast"}),
            r#"subscribe: "throttle_rate" is no number of 0 or more: "fast""#,
        ),
        (
            json!({"op": "subscribe", "topic": "/a", "type": STRING, "queue_length": -1}),
            r#"subscribe: "queue_length" is no number of 0 or more: -1"#,
        ),
        (
            json!({"op": "subscribe", "topic": "/a", "type": STRING, "fragment_size": 0}),
            r#"subscribe: "fragment_size" is 1 or more"#,
        ),
        (
            json!({"op": "subscribe", "topic": "/a", "type": STRING, "compression": "zip"}),
            r#"subscribe: compression is "none", "cbor" or "cbor-raw""#,
        ),
        (
            json!({"op": "subscribe", "topic": "no name", "type": STRING}),
            "subscribe: \"no name\" is no name of a \
            topic, service or action: write an absolute one, such as /arm/state",
        ),
        (
            json!({"op": "subscribe", "topic": "/a", "type": "Text"}),
            "subscribe: \"Text\" is no type of a topic: \
            write one such as std_msgs/msg/String",
        ),
        (json!({"op": "publish", "topic": "/a"}), r#"publish: "msg" is missing"#),
        (json!({"op": "publish", "topic": "/a", "msg": [1]}), r#"publish: "msg" is no object: [1]"#),
        (
            json!({"op": "advertise", "topic": "/a", "type": STRING, "latch": "yes"}),
            r#"advertise: "latch" is no bool: "yes""#,
        ),
        (json!({"op": "call_service"}), r#"call_service: "service" is missing"#),
        (
            json!({"op": "call_service", "service": "/a", "timeout": "soon"}),
            r#"call_service: "timeout" is no number of seconds: "soon""#,
        ),
        (json!({"op": "advertise_service", "service": "/a"}), r#"advertise_service: "type" is missing"#),
        (
            json!({"op": "service_response", "service": "/a"}),
            "service_response: /a is not served by this client",
        ),
        (json!({"op": "action_result", "action": "/a"}), "action_result: /a is not served by this client"),
        (json!({"op": "set_level", "level": "loud"}), "set_level: \"level\" is none, error, warning or info"),
    ] {
        assert_eq!(browser.told(op.clone()).await, told, "{op}");
    }
    browser.send(json!({"op": "publish", "id": {"a": 1}, "topic": "/a"})).await;
    assert_eq!(browser.status().await.0, r#"publish: "id" is no text or integer: {"a":1}"#);
    let told = browser.told(json!({"op": "subscribe", "topic": "/a".repeat(1000)})).await;
    assert_eq!(told, r#"subscribe: "topic" is longer than 1024 bytes"#);
    // The definition of this type is unknown.
    let told = browser.told(json!({"op": "advertise", "topic": "/a", "type": "nobody/Knows"})).await;
    assert!(told.starts_with("advertise: no definition: no definition of nobody/msg/Knows"), "{told}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn invalid_calls_and_goals_are_answered_with_their_id() {
    let site = Site::new().await;
    let mut browser = client(&site).await;
    for (op, told, answer) in [
        (
            json!({"op": "call_service", "id": "c", "service": "/a", "timeout": "soon"}),
            r#"call_service: "timeout" is no number of seconds: "soon""#,
            json!({"op": "service_response", "id": "c", "service": "/a", "result": false}),
        ),
        (
            json!({"op": "call_service", "id": 7, "service": 3}),
            r#"call_service: "service" is no text: 3"#,
            json!({"op": "service_response", "id": 7, "service": "", "result": false}),
        ),
        (
            json!({"op": "send_action_goal", "id": "g", "action": "/a", "feedback": "much"}),
            r#"send_action_goal: "feedback" is no bool: "much""#,
            json!({"op": "action_result", "id": "g", "action": "/a", "status": 0, "result": false}),
        ),
    ] {
        let mut wanted = answer;
        wanted["values"] = json!(told);
        browser.send(op.clone()).await;
        assert_eq!(browser.next().await, wanted, "{op}");
        assert_eq!(browser.status().await, (told.to_owned(), op["id"].clone()));
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn error_in_an_assembled_message_has_its_id_or_that_of_its_fragments() {
    let site = Site::new().await;
    let mut browser = client(&site).await;
    for (inner, told, id) in [
        (json!({"op": "subscribe"}), r#"subscribe: "topic" is missing"#, json!("f")),
        (json!({"op": "subscribe", "id": 3}), r#"subscribe: "topic" is missing"#, json!(3)),
        (
            json!({"op": "unsubscribe", "topic": "/a"}),
            "unsubscribe: /a is not subscribed to by this client",
            json!("f"),
        ),
        (json!({"op": "dance", "id": 3}), r#"there is no op "dance""#, json!(3)),
        (json!({"op": "status", "id": 1.5}), r#"status: "id" is no text or integer: 1.5"#, json!("f")),
        (json!([]), "not an object with a member \"op\"", json!("f")),
    ] {
        let data = inner.to_string();
        browser.send(json!({"op": "fragment", "id": "f", "num": 0, "total": 1, "data": data})).await;
        assert_eq!(browser.status().await, (told.to_owned(), id), "{inner}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn messages_that_are_not_of_their_type_are_refused_with_the_path() {
    let site = Site::new().await;
    let (texts, _reader) = site.reader("/a");
    let mut browser = client(&site).await;
    browser.send(json!({"op": "advertise", "topic": "/twist", "type": "geometry_msgs/Twist"})).await;
    browser.send(json!({"op": "advertise", "topic": "/a", "type": STRING})).await;
    let publish = |topic: &str, msg| json!({"op": "publish", "topic": topic, "msg": msg});
    let told = browser.told(publish("/twist", json!({"linear": {"x": "far"}}))).await;
    let wanted = "publish: /twist: not a message of that type: linear.x: \"far\", not float64";
    assert_eq!(told, wanted);
    let deep = format!(
        r#"{{"op":"publish","topic":"/a","msg":{{"data":{}{}}}}}"#,
        "[".repeat(200_000),
        "]".repeat(200_000)
    );
    browser.send_text(deep).await;
    assert!(browser.status().await.0.starts_with("publish: /a: not a message of that type: data:"));
    browser.send(publish("/a", json!({"data": "fine"}))).await;
    assert_eq!(texts.recv_timeout(std::time::Duration::from_secs(5)).unwrap(), string("fine"));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_frame_of_a_gigabyte_is_refused_by_its_head() {
    let site = Site::new().await;
    let talker = site.writer("/chatter", Qos::default());
    let (mut bad, mut good) = (client(&site).await, client(&site).await);
    good.subscribe("/chatter").await;
    // The head: FIN and text, masked, 127; the length and the mask follow.
    let mut head = vec![0x81, 0xff];
    head.extend((1_u64 << 30).to_be_bytes());
    head.extend([0; 4]);
    bad.socket.get_mut().write_all(&head).await.unwrap();
    assert_eq!(bad.closed().await, (1009, "messages of 67108864 bytes at most".into()));
    drop(bad.socket);
    assert!(matches!(bad.served.await.unwrap(), Err(RosbridgeError::TooLong { .. })));
    talker.write(SampleKind::Write, 1, string("still here")).unwrap();
    assert_eq!(good.next().await["msg"]["data"], "still here");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_message_is_as_long_as_it_may_be_in_one_frame_or_in_pieces() {
    let site = Site::new().await;
    let options = RosbridgeOptions { message_bytes_max: 2000, ..RosbridgeOptions::default() };
    let mut browser = connect(site.session("long"), options).await;
    for (num, data) in ["x".repeat(1500), "x".repeat(1000)].into_iter().enumerate() {
        browser.send(json!({"op": "fragment", "id": "f", "num": num, "total": 3, "data": data})).await;
    }
    assert_eq!(browser.status().await, ("fragment: the pieces are more than 2000 bytes".into(), json!("f")));
    for (piece, told) in [
        (json!({"op": "fragment", "num": 0, "total": 1, "data": ""}), r#"fragment: "id" is missing"#),
        (
            json!({"op": "fragment", "id": 1, "num": 3, "total": 2, "data": ""}),
            "fragment: piece 3 of 2: they count from 0",
        ),
        (
            json!({"op": "fragment", "id": 1, "num": 0, "total": 1e9, "data": ""}),
            "fragment: a message of 1000000000 pieces: 1 to 65536",
        ),
        (
            json!({"op": "fragment", "id": 1, "num": 0, "total": 1, "data": "{"}),
            "not JSON: EOF while parsing an object at line 1 column 1",
        ),
        (
            json!({"op": "fragment", "id": 1, "num": 0, "total": 1, "data": r#"{"op":"fragment","id":1}"#}),
            "fragment: a message in pieces is no piece itself",
        ),
    ] {
        assert_eq!(browser.told(piece).await, told);
    }
    browser.send(json!({"op": "publish", "topic": "/a", "msg": {"data": "x".repeat(2000)}})).await;
    assert_eq!(browser.closed().await.0, 1009);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_flood_of_wrong_ops_ends_the_connection() {
    let site = Site::new().await;
    let mut browser = client(&site).await;
    for _ in 0..2000 {
        if browser.socket.feed(Message::text("{}")).await.is_err() {
            break;
        }
    }
    let _ = browser.socket.flush().await;
    assert_eq!(browser.closed().await, (1008, "too many errors".into()));
    drop(browser.socket);
    assert!(matches!(browser.served.await.unwrap(), Err(RosbridgeError::TooManyErrors)));
}

#[tokio::test]
async fn a_frame_that_never_ends_is_not_waited_for() {
    let site = Site::new().await;
    tokio::time::pause();
    let mut browser = pipe(site.session("loris"), RosbridgeOptions::default(), 1 << 16).await;
    // A text of 100 bytes arrives at one byte a minute.
    browser.socket.get_mut().write_all(&[0x81, 0x80 | 100, 0, 0, 0, 0]).await.unwrap();
    let drip = async {
        loop {
            let _ = browser.socket.get_mut().write_all(b"x").await;
            tokio::time::sleep(std::time::Duration::from_secs(30)).await;
        }
    };
    tokio::select! {
        ended = browser.served => assert!(matches!(ended.unwrap(), Err(RosbridgeError::Silent(_)))),
        () = drip => {}
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_client_has_no_more_than_it_may() {
    let site = Site::new().await;
    let limits = SessionLimits {
        subscriptions_max: 2,
        publications_max: 1,
        servings_max: 1,
        calls_max: 2,
        ..SessionLimits::default()
    };
    let mut browser = connect(bounded(&site, limits), RosbridgeOptions::default()).await;
    // Several subscriptions to one topic count separately.
    for (id, topic) in [(1, "/a"), (2, "/a")] {
        browser.send(json!({"op": "subscribe", "id": id, "topic": topic, "type": STRING})).await;
    }
    let told = browser.told(json!({"op": "subscribe", "id": 3, "topic": "/a", "type": STRING})).await;
    assert_eq!(told, "subscribe: 2 subscriptions at most for a client");
    browser.send(json!({"op": "advertise", "topic": "/a", "type": STRING})).await;
    let told = browser.told(json!({"op": "advertise", "topic": "/b", "type": STRING})).await;
    assert_eq!(told, "advertise: 1 topics that are published at most for a client");
    // The same id may be advertised any number of times, but only as many ids as topics may be published.
    browser.send(json!({"op": "advertise", "topic": "/a", "type": STRING})).await;
    let told = browser.told(json!({"op": "advertise", "id": 2, "topic": "/a", "type": STRING})).await;
    assert_eq!(told, "advertise: 1 advertisements of a topic at most for a client");
    browser.send(json!({"op": "advertise_service", "service": "/a", "type": "std_srvs/Empty"})).await;
    let told =
        browser.told(json!({"op": "advertise_service", "service": "/b", "type": "std_srvs/Empty"})).await;
    assert_eq!(told, "advertise_service: 1 services and actions that are served at most for a client");
    let _silent = site.session("silent").serve("/silent", Some("std_srvs/Empty")).await.unwrap();
    for _ in 0..2 {
        browser.send(json!({"op": "call_service", "service": "/silent"})).await;
    }
    let told = browser.told(json!({"op": "call_service", "service": "/silent"})).await;
    assert_eq!(told, "call_service: 2 calls and goals under way at most for a client");
    // A client that waits for an answer by its id gets one.
    for (op, member, answer) in
        [("call_service", "service", "service_response"), ("send_action_goal", "action", "action_result")]
    {
        browser.send(json!({"op": op, "id": "c", member: "/silent"})).await;
        let answered = browser.next().await;
        let why = format!("{op}: 2 calls and goals under way at most for a client");
        assert_eq!((&answered["op"], &answered["id"]), (&json!(answer), &json!("c")));
        assert_eq!((&answered["values"], &answered["result"]), (&json!(why), &json!(false)));
        assert_eq!(browser.status().await, (why, json!("c")));
    }
}
