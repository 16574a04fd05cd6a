//! Tests of Foxglove's protocol on loopback, beside programs of a network in memory.
#![allow(clippy::unwrap_used)]

mod support;
#[path = "support/viewer.rs"]
mod viewer;

use std::path::Path;
use std::process::Stdio;
use std::sync::Arc;
use std::time::Duration;

use serde_json::{Value, json};
use sgc_gateway::foxglove::{FoxgloveError, Options};
use sgc_gateway::{
    Advertise, Client, Content, Form, Hub, HubOptions, Scope, Session, SessionLimits, ShippedDefinitions,
    Types,
};
use sgc_ros::{EndpointKind, RosNetwork, RosWriter, SampleKind};
use sgc_wire::{Durability, History, Qos};
use tokio::io::{AsyncBufReadExt, BufReader};
use tokio_tungstenite::tungstenite::Message as Frame;

use support::{Site, eventually, spec, string};
use viewer::{Viewer, serve_one};

/// Another program on the network, whose types the gateway knows by itself.
struct Program {
    session: Arc<Session>,
}

impl Program {
    async fn new(site: &Site, node: &str) -> Self {
        let types = Types::new(ShippedDefinitions);
        let options = HubOptions { node: node.to_owned() };
        let hub = Hub::start(Arc::new(site.domain.join(false)), types, options).await.unwrap();
        let client = Client::own(node);
        Self { session: Arc::new(Session::new(&hub, client, SessionLimits::default())) }
    }

    /// Serves a service, with requests and replies in JSON.
    async fn serve(
        &self,
        service: &str,
        type_name: &str,
        mut answer: impl FnMut(Value) -> Value + Send + 'static,
    ) {
        let mut serving = self.session.serve(service, Some(type_name)).await.unwrap();
        let replier = serving.replier();
        tokio::spawn(async move {
            while let Some(request) = serving.next().await {
                let asked = serving.write(&request, Form::Json).unwrap();
                let reply = answer(serde_json::from_slice(&asked).unwrap());
                let _ = replier.reply(request.id, &Content::json(reply.to_string())).await;
            }
        });
    }

    /// Serves the parameters `exposure` and `frame`, and announces changes.
    async fn with_parameters(self, node: &str) -> Self {
        let exposure = Arc::new(std::sync::Mutex::new(json!({"type": 3, "double_value": 0.5})));
        let wanted = Advertise {
            topic: "/parameter_events".into(),
            type_name: Some("rcl_interfaces/msg/ParameterEvent".into()),
            qos: Qos::default(),
        };
        let events = Arc::new(self.session.advertise(wanted).await.unwrap());
        let list = |_| json!({"result": {"names": ["exposure", "frame"]}});
        self.serve(&format!("{node}/list_parameters"), "rcl_interfaces/srv/ListParameters", list).await;
        let values = Arc::clone(&exposure);
        let get = move |asked: Value| {
            let value = |name: &Value| match name.as_str().unwrap() {
                "exposure" => Some(values.lock().unwrap().clone()),
                "frame" => Some(json!({"type": 4, "string_value": "lens"})),
                _ => None,
            };
            // Like ROS 2 nodes, it returns nothing at all if one name is not declared.
            let values: Option<Vec<_>> = asked["names"].as_array().unwrap().iter().map(value).collect();
            json!({"values": values.unwrap_or_default()})
        };
        self.serve(&format!("{node}/get_parameters"), "rcl_interfaces/srv/GetParameters", get).await;
        let name = node.to_owned();
        let set = move |asked: Value| {
            let wanted = asked["parameters"].as_array().unwrap();
            let results = wanted.iter().map(|wanted| {
                if wanted["name"] != "exposure" || wanted["value"]["type"] != 3 {
                    return json!({"successful": false, "reason": "it is fixed"});
                }
                *exposure.lock().unwrap() = wanted["value"].clone();
                json!({"successful": true})
            });
            let results: Vec<_> = results.collect();
            let event = json!({"node": name, "changed_parameters": wanted});
            let events = Arc::clone(&events);
            tokio::spawn(async move { events.publish(&Content::json(event.to_string())).await });
            json!({"results": results})
        };
        self.serve(&format!("{node}/set_parameters"), "rcl_interfaces/srv/SetParameters", set).await;
        self
    }
}

async fn serves(site: &Site, service: &str) {
    eventually(|| site.hub.graph().services.get(service).is_some_and(|info| !info.servers.is_empty())).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn channels_appear_and_vanish_with_the_graph() {
    let site = Site::new().await;
    let talker = site.writer("/chatter", Qos::default());
    let _hidden = site.writer("/_hidden", Qos::default());
    site.knows("/_hidden").await;
    let (mut viewer, info) = Viewer::new(site.session("desk")).await;
    assert_eq!(
        info["capabilities"],
        json!(["connectionGraph", "clientPublish", "services", "parameters", "parametersSubscribe"])
    );
    assert_eq!((&info["supportedEncodings"], &info["name"]), (&json!(["cdr", "json"]), &json!("sgc")));
    let channel = viewer.channel("/chatter").await;
    let expected = json!({
        "id": channel["id"], "topic": "/chatter", "encoding": "cdr", "schemaName": "std_msgs/msg/String",
        "schema": "string data\n", "schemaEncoding": "ros2msg",
    });
    assert_eq!(channel, expected);
    let _later = site.writer("/later", Qos::default());
    viewer.channel("/later").await;
    // The gateway's own reader keeps no channel.
    viewer.subscribe(1, &channel).await;
    eventually(|| talker.matched_readers() == 1).await;
    drop(talker);
    let gone = viewer.text("unadvertise").await;
    assert_eq!(gone["channelIds"], json!([channel["id"]]));
    viewer.forget();
    let _again = site.writer("/chatter", Qos::default());
    assert_ne!(viewer.channel("/chatter").await["id"], channel["id"]);
    viewer.leave().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn messages_come_as_they_are_and_latched_ones_to_who_comes_late() {
    let site = Site::new().await;
    let talker = site.writer("/chatter", Qos::default());
    let latched =
        Qos { durability: Durability::TransientLocal, history: History::KeepLast(1), ..Qos::default() };
    let map = site.writer("/map", latched);
    map.write(SampleKind::Write, 1, string("map")).unwrap();
    let (mut viewer, _) = Viewer::new(site.session("desk")).await;
    let (chatter, map) = (viewer.channel("/chatter").await, viewer.channel("/map").await);
    viewer.subscribe(7, &map).await;
    assert_eq!(viewer.message().await, (7, string("map")));
    viewer.subscribe(8, &chatter).await;
    eventually(|| talker.matched_readers() == 1).await;
    talker.write(SampleKind::Write, 5, string("hello")).unwrap();
    let bytes = viewer.binary_of(1).await;
    let received_ns = u64::from_le_bytes(bytes[4..12].try_into().unwrap());
    assert!((bytes[0], &bytes[12..]) == (8, &string("hello")[..]) && received_ns > 1_600_000_000_000_000_000);
    viewer.say(json!({"op": "unsubscribe", "subscriptionIds": [8]})).await;
    eventually(|| talker.matched_readers() == 0).await;
    // A number may be reused, and another client's numbers are independent.
    let (mut other, _) = Viewer::new(site.session("other")).await;
    let map = other.channel("/map").await;
    other.subscribe(8, &map).await;
    assert_eq!(other.message().await, (8, string("map")));
    viewer.subscribe(8, &chatter).await;
    eventually(|| talker.matched_readers() == 1).await;
    talker.write(SampleKind::Write, 6, string("again")).unwrap();
    assert_eq!(viewer.message().await, (8, string("again")));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn clients_publish_in_json_and_as_it_is() {
    let site = Site::new().await;
    let (texts, _reader) = site.reader("/cmd");
    let (mut viewer, _) = Viewer::new(site.session("desk")).await;
    let channel = |id: u32, encoding: &str| json!({"id": id, "topic": "/cmd", "encoding": encoding, "schemaName": "std_msgs/msg/String"});
    let channels = [channel(1, "json"), channel(2, "cdr"), channel(3, "ros1")];
    viewer.say(json!({"op": "advertise", "channels": channels})).await;
    viewer.status("\"ros1\" is no encoding of this server").await;
    viewer.binary(1, &[1], br#"{"data":"left"}"#).await;
    viewer.binary(1, &[2], &string("right")).await;
    for expected in ["left", "right"] {
        assert_eq!(texts.recv_timeout(Duration::from_secs(5)).unwrap(), string(expected));
    }
    // An error is reported once, until the messages are valid again.
    for _ in 0..3 {
        viewer.binary(1, &[1], br#"{"date":"left"}"#).await;
    }
    let said = viewer.status("not a message of that type").await;
    viewer.binary(1, &[1], br#"{"data":"better"}"#).await;
    let removed = viewer.text("removeStatus").await;
    assert_eq!(removed["statusIds"], json!([said["id"]]));
    assert_eq!(texts.recv_timeout(Duration::from_secs(5)).unwrap(), string("better"));
    viewer.binary(1, &[2], &[0, 1]).await;
    viewer.status("2 bytes are no serialised message").await;
    viewer.binary(1, &[3], &string("nobody's")).await;
    viewer.status("channel 3 is not advertised by this client").await;
    viewer.say(json!({"op": "advertise", "channels": [channel(2, "cdr")]})).await;
    viewer.status("channel 2 is advertised by this client already").await;
    viewer.say(json!({"op": "unadvertise", "channelIds": [1, 2, 3]})).await;
    viewer.status("channel 3 is not advertised").await;
    eventually(|| site.domain.count("rt/cmd", EndpointKind::Writer) == 0).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn services_are_called_in_either_encoding() {
    let site = Site::new().await;
    let program = Program::new(&site, "arm").await;
    let answer = |asked: Value| json!({"success": asked["data"], "message": "so"});
    program.serve("/switch", "std_srvs/srv/SetBool", answer).await;
    let (mut viewer, _) = Viewer::new(site.session("desk")).await;
    let service = viewer.service("/switch").await;
    assert_eq!(service["type"], "std_srvs/srv/SetBool");
    let half = json!({
        "encoding": "cdr", "schemaEncoding": "ros2msg", "schemaName": "std_srvs/srv/SetBool_Response",
        "schema": "bool success\nstring message\n",
    });
    assert_eq!((&service["response"], &service["request"]["schema"]), (&half, &json!("bool data\n")));
    let id = u32::try_from(service["id"].as_u64().unwrap()).unwrap();
    let called = |call: u32, encoding: &str, payload: &[u8]| {
        let mut bytes = vec![2];
        let length = u32::try_from(encoding.len()).unwrap();
        [id, call, length].into_iter().for_each(|number| bytes.extend(number.to_le_bytes()));
        bytes.extend(encoding.as_bytes());
        bytes.extend(payload);
        Frame::Binary(bytes.into())
    };
    viewer.send(called(1, "json", br#"{"data":true}"#)).await;
    let reply = viewer.binary_of(3).await;
    let head: Vec<u8> = [id, 1, 4].into_iter().flat_map(u32::to_le_bytes).collect();
    assert_eq!(reply[..12], head);
    assert_eq!(&reply[12..], br#"json{"success":true,"message":"so"}"#);
    viewer.send(called(2, "cdr", &[0, 1, 0, 0, 1])).await;
    let reply = viewer.binary_of(3).await;
    assert_eq!(&reply[12..], b"cdr\0\x01\0\0\x01\0\0\0\x03\0\0\0so\0");
    for (call, encoding, payload) in
        [(3, "cdr", &b"x"[..]), (4, "xml", b"<a/>"), (5, "json", b"{\"none\":1}")]
    {
        viewer.send(called(call, encoding, payload)).await;
        let failure = viewer.text("serviceCallFailure").await;
        assert_eq!((&failure["callId"], &failure["serviceId"]), (&json!(call), &json!(id)), "{failure}");
    }
    drop(program);
    viewer.binary(2, &[999, 6, 3], b"cdr\0\x01\0\0\x01").await;
    assert_eq!(viewer.text("serviceCallFailure").await["message"], "there is no service 999");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn parameters_are_those_of_nodes() {
    let site = Site::new().await;
    let _camera = Program::new(&site, "camera").await.with_parameters("/camera").await;
    serves(&site, "/camera/set_parameters").await;
    let (mut viewer, _) = Viewer::new(site.session("desk")).await;
    let exposure = |value: f64| json!({"name": "/camera.exposure", "value": value, "type": "float64"});
    let frame = json!({"name": "/camera.frame", "value": "lens"});
    viewer.say(json!({"op": "getParameters", "parameterNames": [], "id": "all"})).await;
    let all = json!({"op": "parameterValues", "parameters": [exposure(0.5), frame], "id": "all"});
    assert_eq!(viewer.text("parameterValues").await, all);
    // A missing parameter is reported as not set.
    let names = ["/camera.exposure", "/camera.none"];
    viewer.say(json!({"op": "getParameters", "parameterNames": names})).await;
    let some = json!({"op": "parameterValues", "parameters": [exposure(0.5), {"name": "/camera.none"}]});
    assert_eq!(viewer.text("parameterValues").await, some);

    viewer.say(json!({"op": "subscribeParameterUpdates", "parameterNames": ["/camera.exposure"]})).await;
    // The values are an integer for a double, as a browser sends it, and one that the node refuses.
    let wanted = json!([{"name": "/camera.exposure", "value": 2}, {"name": "/camera.frame", "value": "x"}]);
    viewer.say(json!({"op": "setParameters", "parameters": wanted, "id": "set"})).await;
    viewer.status("parameters of /camera.frame: it is fixed").await;
    let set = viewer.text_that("parameterValues", |value| value["id"] == "set").await;
    assert_eq!(set["parameters"], json!([exposure(2.0), frame]));
    let event = viewer.text_that("parameterValues", |value| value["id"].is_null()).await;
    assert_eq!(event["parameters"], json!([exposure(2.0)]));

    viewer.say(json!({"op": "getParameters", "parameterNames": ["exposure"], "id": "wrong"})).await;
    viewer.status("is no parameter: write one such as").await;
    let wrong: Vec<_> = (0..100).map(|n| format!("exposure{n}")).collect();
    viewer.say(json!({"op": "getParameters", "parameterNames": wrong, "id": "wrong"})).await;
    viewer.status("\"exposure15\" is no parameter").await;
    viewer.status("84 more of the same question failed").await;
    viewer.say(json!({"op": "unsubscribeParameterUpdates", "parameterNames": []})).await;
    eventually(|| site.hub.readers() == 0).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn connection_graph_is_sent_on_request() {
    let site = Site::new().await;
    let program = Program::new(&site, "arm").await;
    program.serve("/switch", "std_srvs/srv/SetBool", |_| json!({})).await;
    let wanted = Advertise {
        topic: "/odom".into(),
        type_name: Some("std_msgs/String".into()),
        ..Advertise::default()
    };
    let publication = program.session.advertise(wanted).await.unwrap();
    serves(&site, "/switch").await;
    site.knows("/odom").await;
    let node_is_known = || site.hub.graph().topics["/odom"].publishers.iter().any(|end| end.node.is_some());
    eventually(node_is_known).await;
    let (mut viewer, _) = Viewer::new(site.session("desk")).await;
    viewer.say(json!({"op": "subscribeConnectionGraph"})).await;
    let graph = viewer.text("connectionGraphUpdate").await;
    assert_eq!(graph["publishedTopics"], json!([{"name": "/odom", "publisherIds": ["/arm"]}]));
    assert_eq!(graph["advertisedServices"], json!([{"name": "/switch", "providerIds": ["/arm"]}]));
    drop(publication);
    let gone =
        viewer.text_that("connectionGraphUpdate", |update| update["removedTopics"] == json!(["/odom"])).await;
    assert_eq!(gone["advertisedServices"], json!([]));
    viewer.say(json!({"op": "unsubscribeConnectionGraph"})).await;
    viewer.leave().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn interfaces_outside_the_scope_are_invisible() {
    let site = Site::new().await;
    let _talkers = [site.writer("/odom", Qos::default()), site.writer("/secret", Qos::default())];
    let _camera = Program::new(&site, "camera").await.with_parameters("/camera").await;
    site.knows("/secret").await;
    serves(&site, "/camera/get_parameters").await;
    let scope = Scope { subscribe: vec!["/odom".into()], ..Scope::default() };
    let (mut viewer, info) = Viewer::new(site.session_with("partner", scope)).await;
    assert_eq!(info["capabilities"], json!(["connectionGraph"]));
    let told = viewer.text("advertise").await;
    assert_eq!(told["channels"].as_array().unwrap().len(), 1, "{told}");
    assert_eq!(told["channels"][0]["topic"], "/odom");
    viewer.say(json!({"op": "subscribeConnectionGraph"})).await;
    let graph = viewer.text("connectionGraphUpdate").await;
    assert_eq!(graph["publishedTopics"].as_array().unwrap().len(), 1, "{graph}");
    assert_eq!(graph["advertisedServices"], json!([]));
    viewer.say(json!({"op": "getParameters", "parameterNames": ["/camera.frame"], "id": "x"})).await;
    viewer.status("may not call /camera/get_parameters").await;
    assert_eq!(viewer.text("parameterValues").await["parameters"], json!([]));
    viewer.say(json!({"op": "getParameters", "parameterNames": [], "id": "y"})).await;
    assert_eq!(viewer.text("parameterValues").await["parameters"], json!([]));
    let channel = json!({"id": 1, "topic": "/odom", "encoding": "json", "schemaName": "std_msgs/String"});
    viewer.say(json!({"op": "advertise", "channels": [channel]})).await;
    viewer.status("partner may not publish /odom").await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn errors_are_reported_and_the_connection_continues() {
    let site = Site::new().await;
    let talker = site.writer("/chatter", Qos::default());
    let (mut viewer, _) = Viewer::new(site.session("desk")).await;
    let (mut other, _) = Viewer::new(site.session("other")).await;
    let channel = viewer.channel("/chatter").await;
    viewer.subscribe(1, &channel).await;
    let theirs = other.channel("/chatter").await;
    other.subscribe(1, &theirs).await;
    for text in ["{", "[1]", "{}", r#"{"op":"fly"}"#, r#"{"op":"subscribe","subscriptions":3}"#] {
        viewer.send(Frame::text(text)).await;
        assert_eq!(viewer.status("not a message of this protocol").await["level"], 2, "{text}");
    }
    for bytes in [&[][..], &[1, 0], &[2, 0, 0, 0, 0, 0, 0, 0, 0, 255, 255, 255, 255, 1]] {
        viewer.send(Frame::Binary(bytes.to_vec().into())).await;
        viewer.status("which says that there are more").await;
    }
    viewer.binary(9, &[], &[]).await;
    viewer.status("no binary message has opcode 9").await;
    viewer.subscribe(2, &json!({"id": 999})).await;
    viewer.status("there is no channel 999").await;
    viewer.subscribe(1, &channel).await;
    viewer.status("subscription 1 is in use already").await;
    viewer.subscribe(2, &channel).await;
    viewer.status("/chatter is subscribed to by this client already").await;
    viewer.say(json!({"op": "unsubscribe", "subscriptionIds": [77]})).await;
    viewer.say(json!({"op": "fetchAsset", "uri": "package://a/b.dae", "requestId": 5})).await;
    let refusal = viewer.binary_of(4).await;
    assert_eq!(refusal[..5], [5, 0, 0, 0, 1]);
    eventually(|| talker.matched_readers() == 1).await;
    talker.write(SampleKind::Write, 1, string("still there")).unwrap();
    assert_eq!(viewer.message().await, (1, string("still there")));
    assert_eq!(other.message().await, (1, string("still there")));
    // Data that is not WebSocket ends this connection only.
    viewer
        .send(Frame::Frame(tokio_tungstenite::tungstenite::protocol::frame::Frame::message(
            vec![255, 254],
            tokio_tungstenite::tungstenite::protocol::frame::coding::OpCode::Data(
                tokio_tungstenite::tungstenite::protocol::frame::coding::Data::Text,
            ),
            true,
        )))
        .await;
    assert!(matches!(viewer.ended.await.unwrap(), Err(FoxgloveError::Socket(_))));
    talker.write(SampleKind::Write, 2, string("still")).unwrap();
    assert_eq!(other.message().await, (1, string("still")));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn types_that_nobody_knows_are_shown_and_what_to_do_is_said() {
    let site = Site::new().await;
    let _own = site.ros.create_writer(&spec("/own", "mine/msg/Own", Qos::default())).unwrap();
    site.knows("/own").await;
    let (mut viewer, _) = Viewer::new(site.session("desk")).await;
    let channel = viewer.channel("/own").await;
    assert_eq!((&channel["schema"], &channel["schemaName"]), (&json!(""), &json!("mine/msg/Own")));
    let said = viewer.status("mine/msg/Own cannot be shown").await;
    assert!(said["message"].as_str().unwrap().contains("definitions") && said["level"] == 1, "{said}");
    viewer.subscribe(1, &channel).await;
    viewer.status("no definition of mine/msg/Own").await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn client_that_stops_reading_loses_only_its_oldest_messages() {
    const MESSAGES: usize = 600;
    const BYTES: usize = 60_000;
    let site = Site::new().await;
    let talker = site.writer("/fast", Qos::default());
    site.knows("/fast").await;
    let client = Client::own("slow");
    let limits = SessionLimits { waiting_bytes_max: 1 << 20, ..SessionLimits::default() };
    let (mut slow, _) = Viewer::new(Session::new(&site.hub, client, limits)).await;
    let (mut fast, _) = Viewer::new(site.session("fast")).await;
    for viewer in [&mut slow, &mut fast] {
        let channel = viewer.channel("/fast").await;
        viewer.subscribe(1, &channel).await;
        viewer.say(json!({"op": "getParameters", "parameterNames": [], "id": "subscribed"})).await;
        viewer.text("parameterValues").await;
    }
    let text = |number: usize| string(&format!("{number:BYTES$}"));
    for number in 0..MESSAGES {
        talker.write(SampleKind::Write, 1, text(number)).unwrap();
        assert_eq!(fast.message().await, (1, text(number)));
    }
    let mut heard = 0;
    while slow.message().await.1 != text(MESSAGES - 1) {
        heard += 1;
    }
    // The buffers of the kernel, 6 MB at most, arrive as well.
    assert!(heard < MESSAGES / 2, "{heard} of {MESSAGES}");
    let said = slow.status("/fast: messages are left out").await;
    assert_eq!(said["level"], 1);
    let removed = slow.text("removeStatus").await;
    assert_eq!(removed["statusIds"], json!([said["id"]]));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn client_that_does_not_read_is_not_read_from() {
    const ASKED: u32 = 2000;
    const STUCK: Duration = Duration::from_secs(1);
    let site = Site::new().await;
    let (mut viewer, _) = Viewer::new(site.session("desk")).await;
    let uri = "x".repeat(60_000);
    let mut asked = 0;
    // Each answer is as long as its question, so at most 120 MB wait on the way.
    let mut is_stuck = false;
    while asked < ASKED && !is_stuck {
        let question = json!({"op": "fetchAsset", "uri": uri, "requestId": asked}).to_string();
        is_stuck = !viewer.try_send(Frame::text(question), STUCK).await;
        asked += 1;
    }
    assert!(is_stuck, "{asked} questions were read without one answer being taken");
    for request in 0..asked {
        let answer = viewer.binary_of(4).await;
        assert_eq!(answer[..4], request.to_le_bytes());
    }
    viewer.leave().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn answers_to_a_command_are_bounded() {
    let site = Site::new().await;
    let (mut viewer, _) = Viewer::new(site.session("desk")).await;
    let subscriptions: Vec<_> = (0..1000).map(|id| json!({"id": id, "channelId": 9})).collect();
    viewer.say(json!({"op": "subscribe", "subscriptions": subscriptions})).await;
    viewer.status("so were 984 more").await;
    let names: Vec<_> = (0..20_000).map(|n| format!("/n.{n}")).collect();
    viewer.say(json!({"op": "getParameters", "parameterNames": names, "id": "many"})).await;
    viewer.status("parameters in a question").await;
    viewer.leave().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn leaving_client_leaves_nothing_behind() {
    let site = Site::new().await;
    let _talker = site.writer("/chatter", Qos::default());
    let _camera = Program::new(&site, "camera").await.with_parameters("/camera").await;
    let channel = json!({"id": 1, "topic": "/cmd", "encoding": "json", "schemaName": "std_msgs/String"});
    for is_polite in [true, false] {
        let (mut viewer, _) = Viewer::new(site.session("desk")).await;
        let chatter = viewer.channel("/chatter").await;
        viewer.subscribe(1, &chatter).await;
        viewer.say(json!({"op": "advertise", "channels": [channel]})).await;
        viewer.say(json!({"op": "subscribeParameterUpdates", "parameterNames": []})).await;
        eventually(|| site.hub.readers() == 2 && site.domain.count("rt/cmd", EndpointKind::Writer) == 1)
            .await;
        if is_polite {
            viewer.leave().await.unwrap();
        } else {
            drop(viewer);
        }
        eventually(|| site.hub.readers() == 0 && site.domain.count("rt/cmd", EndpointKind::Writer) == 0)
            .await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn silent_client_is_disconnected() {
    let site = Site::new().await;
    let options = Options {
        ping_interval: Duration::from_millis(100),
        silence_max: Duration::from_millis(1500),
        ..Options::default()
    };
    let (viewer, _) = Viewer::with(site.session("gone"), options.clone()).await;
    let (mut there, _) = Viewer::with(site.session("there"), options).await;
    // A client that reads answers pings, if nothing else.
    let reads = async {
        loop {
            there.text_that("never", |_| false).await;
        }
    };
    tokio::select! {
        ended = viewer.ended => {
            let ended = ended.unwrap();
            assert!(matches!(ended, Err(FoxgloveError::Silent { silence_ms }) if silence_ms >= 1500), "{ended:?}");
        }
        () = reads => {}
    }
    assert!(!there.ended.is_finished());
}

/// Runs the real client: npm's `@foxglove/ws-protocol`, with Foxglove's own reader of definitions.
async fn real_client(subprotocol: &str) {
    let site = Site::new().await;
    let program = Program::new(&site, "arm").await;
    program
        .serve("/switch", "std_srvs/srv/SetBool", |asked| json!({"success": asked["data"], "message": "on"}))
        .await;
    let _camera = Program::new(&site, "camera").await.with_parameters("/camera").await;
    let latched =
        Qos { durability: Durability::TransientLocal, history: History::KeepLast(1), ..Qos::default() };
    let pose = Some("geometry_msgs/msg/PoseStamped".to_owned());
    let wanted = Advertise { topic: "/pose".into(), type_name: pose, qos: latched };
    let talker = program.session.advertise(wanted).await.unwrap();
    let message = r#"{"header":{"frame_id":"map"},"pose":{"position":{"y":2.5}}}"#;
    talker.publish(&Content::json(message)).await.unwrap();
    let (texts, _reader) = site.reader("/cmd");
    for service in ["/switch", "/camera/set_parameters"] {
        serves(&site, service).await;
    }
    site.knows("/parameter_events").await;

    let (address, ended) = serve_one(site.session("npm"), Options::default()).await;
    let scripts = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/js"));
    assert!(
        scripts.join("node_modules/ws").exists(),
        "npm's packages are missing: run scripts/build-peers.sh"
    );
    let mut node = tokio::process::Command::new("node")
        .args(["foxglove.js", &format!("ws://{address}/"), subprotocol])
        .current_dir(scripts)
        .stdout(Stdio::piped())
        .kill_on_drop(true)
        .spawn()
        .expect("node, which this test needs: run scripts/install-deps.sh test");
    let mut lines = BufReader::new(node.stdout.take().unwrap()).lines();
    let mut talker = Some(talker);
    while let Some(line) = lines.next_line().await.unwrap() {
        assert_eq!(line, "heard");
        drop(talker.take());
    }
    assert!(node.wait().await.unwrap().success(), "the client found something wrong, see above");
    for expected in ["by json", "by cdr"] {
        assert_eq!(texts.recv_timeout(Duration::from_secs(5)).unwrap(), string(expected));
    }
    ended.await.unwrap().unwrap();
    eventually(|| site.hub.readers() == 0).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs programs that `make peers` builds: `make interop`"]
async fn foxgloves_own_client_finds_all_of_it() {
    real_client("foxglove.websocket.v1").await;
    real_client("foxglove.sdk.v1").await;
}
