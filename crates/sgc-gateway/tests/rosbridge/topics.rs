//! Topics: advertise, publish and subscribe, in each form.

use std::time::Duration;

use serde_json::{Value as Json, json};
use sgc_gateway::rosbridge::RosbridgeOptions;
use sgc_ros::{RosWriter as _, SampleKind};
use sgc_wire::{Durability, History, Qos, Reliability};

use crate::client::{client, connect};
use crate::support::{STRING, Site, eventually, string};

const SOON: Duration = Duration::from_secs(5);

fn write(talker: &impl sgc_ros::RosWriter, text: &str) {
    talker.write(SampleKind::Write, 1, string(text)).unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn messages_of_programs_arrive_as_json() {
    let site = Site::new().await;
    let talker = site.writer("/chatter", Qos::default());
    let mut browser = client(&site).await;
    browser.subscribe("/chatter").await;
    write(&talker, "hällo");
    let heard = browser.next().await;
    assert_eq!(heard, json!({"op": "publish", "topic": "/chatter", "msg": {"data": "hällo"}}));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn topics_without_a_type_take_that_of_the_network() {
    let site = Site::new().await;
    let talker = site.writer("/chatter", Qos::default());
    site.knows("/chatter").await;
    let mut browser = client(&site).await;
    browser.send(json!({"op": "subscribe", "topic": "/chatter"})).await;
    browser.settle().await;
    write(&talker, "hello");
    assert_eq!(browser.next().await["msg"]["data"], "hello");
    let told = browser.told(json!({"op": "subscribe", "topic": "/nothing", "id": 3})).await;
    assert_eq!(told, "subscribe: the type of /nothing is not known, since nobody has it yet; give its type");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn cbor_is_the_whole_op_and_cbor_raw_has_the_serialised_message() {
    let site = Site::new().await;
    let talker = site.writer("/chatter", Qos::default());
    let (mut cbor, mut raw) = (client(&site).await, client(&site).await);
    for (browser, compression) in [(&mut cbor, "cbor"), (&mut raw, "cbor-raw")] {
        let subscribe =
            json!({"op": "subscribe", "topic": "/chatter", "type": STRING, "compression": compression});
        browser.send(subscribe).await;
        browser.settle().await;
    }
    write(&talker, "hello");
    let mut wanted = vec![0xa3, 0x62];
    wanted.extend(b"op\x67publish\x65topic\x68/chatter\x63msg");
    let head = wanted.clone();
    wanted.extend(b"\xa1\x64data\x65hello");
    assert_eq!(cbor.next_binary().await, wanted);
    let heard = raw.next_binary().await;
    let rest = heard.strip_prefix(&head[..]).unwrap();
    assert!(rest.starts_with(b"\xa3\x64secs\x1a"), "{rest:?}");
    let at = rest.windows(5).position(|part| part == b"bytes").unwrap();
    let payload = string("hello");
    assert_eq!(rest[at + 5], 0x40 | payload.len() as u8);
    assert_eq!(rest[at + 6..], payload);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn png_is_refused_with_what_to_take_instead() {
    let site = Site::new().await;
    let mut browser = client(&site).await;
    let subscribe =
        json!({"op": "subscribe", "id": "s1", "topic": "/a", "type": STRING, "compression": "png"});
    browser.send(subscribe).await;
    let (told, id) = browser.status().await;
    assert_eq!(told, r#"subscribe: compression "png" is not offered: take "cbor", or "none""#);
    assert_eq!(id, "s1");
    assert!(browser.told(json!({"op": "png", "data": ""})).await.contains("send JSON"));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn messages_of_clients_reach_programs_from_the_first_on() {
    let site = Site::new().await;
    let (texts, _reader) = site.reader("/cmd");
    eventually(|| site.hub.graph().topics.contains_key("/cmd")).await;
    let mut browser = client(&site).await;
    let advertise = json!({"op": "advertise", "id": "advertise:/cmd:1", "topic": "/cmd", "type": "std_msgs/String",
        "latch": false, "queue_size": 100});
    browser.send(advertise).await;
    for text in ["left", "right"] {
        browser.send(json!({"op": "publish", "topic": "/cmd", "msg": {"data": text}, "latch": false})).await;
        assert_eq!(texts.recv_timeout(SOON).unwrap(), string(text));
    }
    // After two advertisements the topic stays until both are unadvertised.
    browser.send(json!({"op": "advertise", "id": 2, "topic": "/cmd", "type": STRING})).await;
    browser.send(json!({"op": "unadvertise", "id": "advertise:/cmd:1", "topic": "/cmd"})).await;
    browser.settle().await;
    assert_eq!(site.hub.graph().topics["/cmd"].publishers.len(), 1);
    browser.send(json!({"op": "unadvertise", "topic": "/cmd"})).await;
    eventually(|| site.hub.graph().topics["/cmd"].publishers.is_empty()).await;
    let told = browser.told(json!({"op": "unadvertise", "topic": "/cmd"})).await;
    assert_eq!(told, "unadvertise: /cmd is not advertised by this client");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn publishing_without_advertising_takes_the_type_that_the_topic_has() {
    let site = Site::new().await;
    let (texts, _reader) = site.reader("/cmd");
    eventually(|| site.hub.graph().topics.contains_key("/cmd")).await;
    let mut browser = client(&site).await;
    browser.send(json!({"op": "publish", "topic": "/cmd", "msg": {"data": "x"}})).await;
    assert_eq!(texts.recv_timeout(SOON).unwrap(), string("x"));
    let told = browser.told(json!({"op": "publish", "topic": "/unknown", "msg": {}})).await;
    assert!(told.starts_with("publish: the type of /unknown is not known"), "{told}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn latched_messages_are_for_who_subscribes_later() {
    let site = Site::new().await;
    let (mut robot, mut page) = (client(&site).await, client(&site).await);
    robot.send(json!({"op": "advertise", "topic": "/map", "type": STRING, "latch": true})).await;
    robot.send(json!({"op": "publish", "topic": "/map", "msg": {"data": "map"}})).await;
    robot.settle().await;
    let qos = site.hub.graph().topics["/map"].publishers[0].qos.clone();
    assert_eq!((qos.durability, qos.history), (Durability::TransientLocal, History::KeepLast(1)));
    // Each part of a page that subscribes gets the message.
    for id in ["one", "two"] {
        page.send(json!({"op": "subscribe", "id": id, "topic": "/map", "type": STRING})).await;
        assert_eq!(page.next().await["msg"]["data"], "map", "{id}");
    }
    robot.send(json!({"op": "publish", "topic": "/map", "msg": {"data": "new"}})).await;
    assert_eq!(page.next().await["msg"]["data"], "new");
    page.settle().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn quality_of_service_is_as_it_is_said() {
    let site = Site::new().await;
    let mut browser = client(&site).await;
    let qos = json!({"reliability": "best_effort", "durability": "transient_local", "depth": 3});
    browser.send(json!({"op": "advertise", "topic": "/a", "type": STRING, "qos": qos})).await;
    browser
        .send(json!({"op": "subscribe", "topic": "/b", "type": STRING, "qos": {"reliability": "reliable"}}))
        .await;
    browser.settle().await;
    let graph = site.hub.graph();
    let offered = &graph.topics["/a"].publishers[0].qos;
    assert_eq!((offered.reliability, offered.history), (Reliability::BestEffort, History::KeepLast(3)));
    assert_eq!(graph.topics["/b"].subscribers[0].qos.reliability, Reliability::Reliable);
    let told =
        browser.told(json!({"op": "advertise", "topic": "/c", "type": STRING, "qos": {"depth": "x"}})).await;
    assert_eq!(told, r#"advertise: "qos": "depth" is no number of 0 or more: "x""#);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn several_subscriptions_of_a_client_are_one() {
    let site = Site::new().await;
    let talker = site.writer("/chatter", Qos::default());
    let mut browser = client(&site).await;
    for id in ["one", "two"] {
        browser.send(json!({"op": "subscribe", "id": id, "topic": "/chatter", "type": STRING})).await;
    }
    browser.settle().await;
    write(&talker, "a");
    assert_eq!(browser.next().await["msg"]["data"], "a");
    browser.send(json!({"op": "unsubscribe", "id": "one", "topic": "/chatter"})).await;
    browser.settle().await;
    write(&talker, "b");
    assert_eq!(browser.next().await["msg"]["data"], "b");
    browser.send(json!({"op": "unsubscribe", "id": "two", "topic": "/chatter"})).await;
    browser.settle().await;
    write(&talker, "c");
    eventually(|| site.hub.readers() == 0).await;
    browser.settle().await;
    let told = browser.told(json!({"op": "unsubscribe", "topic": "/chatter"})).await;
    assert_eq!(told, "unsubscribe: /chatter is not subscribed to by this client");
    // Without an id all subscriptions end.
    for id in [1, 2] {
        browser.send(json!({"op": "subscribe", "id": id, "topic": "/chatter", "type": STRING})).await;
    }
    browser.send(json!({"op": "unsubscribe", "topic": "/chatter"})).await;
    browser.settle().await;
    eventually(|| site.hub.readers() == 0).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn headers_without_a_stamp_get_one_and_times_of_ros_1_are_taken() {
    let site = Site::new().await;
    let mut browser = client(&site).await;
    let point = "geometry_msgs/PointStamped";
    browser.send(json!({"op": "subscribe", "topic": "/points", "type": point})).await;
    browser.send(json!({"op": "advertise", "topic": "/points", "type": point})).await;
    browser.settle().await;
    let mut publish = async |msg: Json| {
        browser.send(json!({"op": "publish", "topic": "/points", "msg": msg})).await;
        browser.next().await["msg"].clone()
    };
    let stamped = publish(json!({"header": {"frame_id": "base"}, "point": {"y": 1}})).await;
    assert!(stamped["header"]["stamp"]["sec"].as_i64().unwrap() > 1_500_000_000, "{stamped}");
    assert_eq!((&stamped["header"]["frame_id"], &stamped["point"]["y"]), (&json!("base"), &json!(1.0)));
    let stamped = publish(json!({"header": {"stamp": {"secs": 5, "nsecs": 7}, "frame_id": ""}})).await;
    assert_eq!(stamped["header"]["stamp"], json!({"sec": 5, "nanosec": 7}));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn bytes_come_as_base64_and_are_taken_as_a_list_too() {
    let site = Site::new().await;
    let mut browser = client(&site).await;
    let image = "sensor_msgs/CompressedImage";
    browser.send(json!({"op": "subscribe", "topic": "/image", "type": image})).await;
    browser.send(json!({"op": "advertise", "topic": "/image", "type": image})).await;
    browser.settle().await;
    for data in [json!([1, 2, 255]), json!("AQL/")] {
        let header = json!({"stamp": {"sec": 1}});
        browser
            .send(json!({"op": "publish", "topic": "/image", "msg": {"header": header, "data": data}}))
            .await;
        assert_eq!(browser.next().await["msg"]["data"], "AQL/");
    }
    let lie = json!({"op": "publish", "id": "p", "topic": "/image", "msg": {"data": "AQL/A"}});
    let told = browser.told(lie).await;
    assert_eq!(told, "publish: /image: not a message of that type: data: the text is not base64");
    // Floats that are not numbers follow docs/spec/json.md.
    browser.send(json!({"op": "subscribe", "topic": "/f", "type": "std_msgs/Float64"})).await;
    browser.send(json!({"op": "advertise", "topic": "/f", "type": "std_msgs/Float64"})).await;
    browser.send(json!({"op": "publish", "topic": "/f", "msg": {"data": null}})).await;
    assert_eq!(browser.next().await["msg"]["data"], "NaN");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn long_messages_go_and_come_in_pieces() {
    let site = Site::new().await;
    let mut browser = client(&site).await;
    let subscribe = json!({"op": "subscribe", "topic": "/long", "type": STRING, "fragment_size": 100, "compression": "none"});
    browser.send(subscribe).await;
    browser.send(json!({"op": "advertise", "topic": "/long", "type": STRING})).await;
    let text = "ä0123456789".repeat(50);
    let whole = json!({"op": "publish", "topic": "/long", "msg": {"data": text}}).to_string();
    let characters: Vec<char> = whole.chars().collect();
    let pieces: Vec<String> = characters.chunks(64).map(|piece| piece.iter().collect()).collect();
    // The fragments may come in any order.
    for (num, data) in pieces.iter().enumerate().rev() {
        let piece = json!({"op": "fragment", "id": "f", "num": num, "total": pieces.len(), "data": data});
        browser.send(piece).await;
    }
    let mut heard = String::new();
    loop {
        let piece = browser.next().await;
        assert_eq!(piece["op"], "fragment");
        let data = piece["data"].as_str().unwrap();
        assert!(data.len() <= 100 && piece["id"].is_string());
        heard.push_str(data);
        if piece["num"].as_u64().unwrap() + 1 == piece["total"].as_u64().unwrap() {
            break;
        }
    }
    assert_eq!(serde_json::from_str::<Json>(&heard).unwrap()["msg"]["data"], text);
    // A short message is not split.
    browser.send(json!({"op": "publish", "topic": "/long", "msg": {"data": "short"}})).await;
    assert_eq!(browser.next().await["msg"]["data"], "short");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_client_that_leaves_leaves_nothing_behind() {
    let site = Site::new().await;
    let talker = site.writer("/chatter", Qos::default());
    let before = site.hub.graph();
    let mut browser = connect(site.session("page"), RosbridgeOptions::default()).await;
    browser.subscribe("/chatter").await;
    browser.send(json!({"op": "advertise", "topic": "/cmd", "type": STRING})).await;
    browser.send(json!({"op": "advertise_service", "service": "/switch", "type": "std_srvs/SetBool"})).await;
    let action = json!({"op": "advertise_action", "action": "/go", "type": "example_interfaces/Fibonacci"});
    browser.send(action).await;
    browser.settle().await;
    let graph = site.hub.graph();
    assert!(graph.services.contains_key("/switch") && graph.actions.contains_key("/go"));
    assert_eq!(talker.matched_readers(), 1);
    drop(browser.socket);
    let _ = browser.served.await.unwrap();
    eventually(|| site.hub.readers() == 0 && site.hub.graph() == before).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn clients_that_come_and_go_leave_nothing_behind() {
    let site = Site::new().await;
    let _talker = site.writer("/chatter", Qos::default());
    site.knows("/chatter").await;
    let before = site.hub.graph();
    for round in 0..100 {
        let mut browser = client(&site).await;
        browser.send(json!({"op": "subscribe", "topic": "/chatter", "type": STRING})).await;
        browser.send(json!({"op": "advertise", "topic": "/cmd", "type": STRING})).await;
        browser.send(json!({"op": "advertise_service", "service": "/s", "type": "std_srvs/Empty"})).await;
        browser.send(json!({"op": "call_service", "service": "/s"})).await;
        if round % 2 == 0 {
            browser.settle_amid().await;
        }
        drop(browser.socket);
        let _ = browser.served.await.unwrap();
    }
    // Only the client of the service remains, kept for other callers.
    let is_clean = || {
        let graph = site.hub.graph();
        graph.topics == before.topics && graph.services.values().all(|info| info.servers.is_empty())
    };
    eventually(|| site.hub.readers() == 0 && is_clean()).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn topics_of_another_type_are_refused_by_name() {
    let site = Site::new().await;
    let _talker = site.writer("/chatter", Qos::default());
    site.knows("/chatter").await;
    let mut browser = client(&site).await;
    let wrong = "std_msgs/Bool";
    let told = browser.told(json!({"op": "advertise", "topic": "/chatter", "type": wrong})).await;
    assert_eq!(told, "advertise: /chatter is of type std_msgs/msg/String, not std_msgs/msg/Bool");
    browser.subscribe("/chatter").await;
    let told = browser.told(json!({"op": "subscribe", "id": 2, "topic": "/chatter", "type": wrong})).await;
    assert_eq!(told, "subscribe: /chatter is of type std_msgs/msg/String, not std_msgs/msg/Bool");
}
