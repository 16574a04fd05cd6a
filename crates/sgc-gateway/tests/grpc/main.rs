//! Tests of gRPC clients on a network in memory, over TCP with one connection each, by `gateway.proto`.
#![allow(clippy::unwrap_used)]

mod gateway;
mod programs;
#[path = "../support/mod.rs"]
mod support;

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use bytes::Bytes;
use sgc_gateway::grpc::GrpcOptions;
use sgc_gateway::grpc::proto::publish_request::Publisher;
use sgc_gateway::grpc::proto::subscribe_response::{Kind as Heard, Message};
use sgc_gateway::grpc::proto::*;
use sgc_gateway::{Anonymous, Content, ListenAt, Protocol, Scope, Server, ServerOptions, SessionLimits};
use sgc_ros::{GraphNode, RosNetwork as _, RosWriter, SampleKind};
use sgc_wire::{History, Qos as RosQos, RosNode, UnixMillis};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Request, Streaming};

use gateway::{Client, Gateway, client, now};
use support::{STRING, eventually, string};

const PATIENCE: Duration = Duration::from_secs(20);

fn hear(topic: &str) -> SubscribeRequest {
    SubscribeRequest { topic: topic.into(), ..SubscribeRequest::default() }
}

async fn within<T>(work: impl Future<Output = T>) -> T {
    tokio::time::timeout(PATIENCE, work).await.expect("it should have come by now")
}

/// Subscribes, and waits for the confirmation.
async fn subscribe(client: &mut Client, request: SubscribeRequest) -> Streaming<SubscribeResponse> {
    let mut heard = within(client.subscribe(request)).await.unwrap().into_inner();
    let first = within(heard.message()).await.unwrap().unwrap();
    assert!(matches!(first.kind, Some(Heard::Subscribed(_))), "{first:?}");
    heard
}

async fn next(heard: &mut Streaming<SubscribeResponse>) -> Message {
    let response = within(heard.message()).await.unwrap().expect("the stream goes on");
    match response.kind {
        Some(Heard::Message(message)) => message,
        other => panic!("{other:?}"),
    }
}

/// Returns the code with which a stream ends.
async fn end<T: std::fmt::Debug>(heard: &mut Streaming<T>) -> Option<Code> {
    loop {
        match within(heard.message()).await {
            Ok(Some(_)) => {}
            Ok(None) => return None,
            Err(status) => return Some(status.code()),
        }
    }
}

fn publisher(topic: &str, encoding: Encoding) -> PublishRequest {
    let (topic, r#type) = (topic.to_owned(), STRING.to_owned());
    let publisher = Publisher { topic, r#type, encoding: encoding.into(), qos: None };
    PublishRequest { kind: Some(publish_request::Kind::Publisher(publisher)) }
}

fn payload(payload: impl Into<Bytes>) -> PublishRequest {
    PublishRequest { kind: Some(publish_request::Kind::Payload(payload.into())) }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_topic_is_heard_in_each_encoding() {
    let gateway = Gateway::new().await;
    let talker = gateway.site.writer("/chatter", RosQos::default());
    gateway.site.knows("/chatter").await;
    let mut client = gateway.client().await;
    let cbor = b"\xa1\x64data\x65hello";
    let hello = string("hello");
    let forms = [
        (Encoding::Unspecified, &hello[..]),
        (Encoding::Cdr, &hello),
        (Encoding::Json, br#"{"data":"hello"}"#),
        (Encoding::Cbor, cbor),
    ];
    let mut heard = Vec::new();
    for (encoding, _) in forms {
        let request = SubscribeRequest { encoding: encoding.into(), ..hear("/chatter") };
        let mut stream = client.subscribe(request).await.unwrap().into_inner();
        match stream.message().await.unwrap().unwrap().kind {
            Some(Heard::Subscribed(said)) => {
                assert_eq!(said.r#type, STRING);
                assert!(said.type_hash.starts_with("RIHS01_"), "{said:?}");
            }
            other => panic!("{other:?}"),
        }
        heard.push(stream);
    }
    assert_eq!(gateway.site.hub.readers(), 1);
    talker.write(SampleKind::Write, 5, string("hello")).unwrap();
    for (stream, (encoding, expected)) in heard.iter_mut().zip(forms) {
        let message = next(stream).await;
        assert_eq!(message.payload, expected, "{encoding:?}");
        assert_eq!((message.source_time_ns, message.dropped), (5, 0));
        assert!(message.received_time_ns > 0);
    }
    // A malformed message is reported, and the stream continues.
    talker.write(SampleKind::Write, 6, Bytes::from_static(&[0, 1, 0, 0, 9])).unwrap();
    talker.write(SampleKind::Write, 7, string("again")).unwrap();
    let unreadable = within(heard[2].message()).await.unwrap().unwrap();
    assert!(matches!(unreadable.kind, Some(Heard::Unreadable(_))), "{unreadable:?}");
    assert_eq!(next(&mut heard[2]).await.payload, r#"{"data":"again"}"#);

    // A client that leaves leaves nothing behind.
    drop((heard, client));
    eventually(|| gateway.site.hub.readers() == 0).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_client_that_stops_reading_loses_the_oldest_and_holds_up_nobody() {
    // Some 1000 fit into the buffers of the connection.
    const MESSAGES: i64 = 4000;
    let gateway = Gateway::new().await;
    let talker = gateway.site.writer("/fast", RosQos::default());
    gateway.site.knows("/fast").await;
    let mut client = gateway.client().await;
    let slow_request = SubscribeRequest { depth: 5, ..hear("/fast") };
    let mut slow = subscribe(&mut client, slow_request).await;
    // The second subscription is on the same connection and has room for all messages.
    let quick_request = SubscribeRequest { depth: 10_000, ..hear("/fast") };
    let mut quick = subscribe(&mut client, quick_request).await;
    let text = string(&"x".repeat(1000));
    for n in 1..=MESSAGES {
        talker.write(SampleKind::Write, n, text.clone()).unwrap();
    }
    for n in 1..=MESSAGES {
        let message = next(&mut quick).await;
        assert_eq!((message.source_time_ns, message.dropped), (n, 0));
    }
    let mut heard = 0;
    let dropped = loop {
        let message = next(&mut slow).await;
        heard += 1;
        if message.source_time_ns == MESSAGES {
            break message.dropped;
        }
    };
    assert!(dropped > 1000, "{dropped}");
    assert_eq!(heard + dropped, MESSAGES as u64);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn waiting_subscriber_holds_up_the_publisher_and_loses_nothing() {
    const MESSAGES: usize = 500;
    let gateway = Gateway::new().await;
    let keeps = RosQos { history: History::KeepAll, ..RosQos::default() };
    let talker = gateway.site.writer("/log", keeps);
    gateway.site.knows("/log").await;
    let mut client = gateway.client().await;
    let mut heard = subscribe(&mut client, SubscribeRequest { waits: true, ..hear("/log") }).await;
    let written = Arc::new(AtomicUsize::new(0));
    let counted = Arc::clone(&written);
    let writing = std::thread::spawn(move || {
        let text = string(&"x".repeat(10_000));
        for n in 0..MESSAGES {
            talker.write(SampleKind::Write, n as i64, text.clone()).unwrap();
            counted.store(n + 1, Ordering::Relaxed);
        }
    });
    // The publisher stands still, for longer than writing everything would take.
    let mut before = 0;
    eventually(|| {
        let now = written.load(Ordering::Relaxed);
        std::thread::sleep(Duration::from_millis(100));
        std::mem::replace(&mut before, now) == now && now > 0
    })
    .await;
    assert!(before < MESSAGES, "nothing waited");
    for n in 0..MESSAGES {
        let message = next(&mut heard).await;
        assert_eq!((message.source_time_ns, message.dropped), (n as i64, 0));
    }
    writing.join().unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_newest_come_at_the_rate_that_is_wanted() {
    let gateway = Gateway::new().await;
    let talker = gateway.site.writer("/fast", RosQos::default());
    gateway.site.knows("/fast").await;
    let mut client = gateway.client().await;
    let wanted = SubscribeRequest { max_rate_hz: 20.0, depth: 1, ..hear("/fast") };
    let mut heard = subscribe(&mut client, wanted).await;
    talker.write(SampleKind::Write, 1, string("first")).unwrap();
    assert_eq!(next(&mut heard).await.source_time_ns, 1);
    let began = std::time::Instant::now();
    for n in 2..=100 {
        talker.write(SampleKind::Write, n, string("more")).unwrap();
    }
    assert_eq!(next(&mut heard).await.source_time_ns, 100);
    assert!(began.elapsed() > Duration::from_millis(30), "{:?}", began.elapsed());
    for wrong in [-1.0, f64::NAN, f64::INFINITY, 1e-9] {
        let refused = client.subscribe(SubscribeRequest { max_rate_hz: wrong, ..hear("/fast") }).await;
        assert_eq!(refused.unwrap_err().code(), Code::InvalidArgument, "{wrong}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn messages_of_a_client_reach_programs() {
    let gateway = Gateway::new().await;
    let (texts, _reader) = gateway.site.reader("/cmd");
    let mut client = gateway.client().await;
    for (encoding, written) in [
        (Encoding::Json, Bytes::from_static(br#"{"data":"left"}"#)),
        (Encoding::Cbor, Bytes::from_static(b"\xa1\x64data\x64left")),
        (Encoding::Cdr, string("left")),
    ] {
        let requests = vec![publisher("/cmd", encoding), payload(written.clone()), payload(written)];
        let done = within(client.publish(tokio_stream::iter(requests))).await.unwrap();
        assert_eq!(done.into_inner().published, 2);
        for _ in 0..2 {
            assert_eq!(texts.recv_timeout(PATIENCE).unwrap(), string("left"), "{encoding:?}");
        }
    }
    let requests = vec![publisher("/cmd", Encoding::Json), payload(r#"{"date":"left"}"#)];
    let refused = within(client.publish(tokio_stream::iter(requests))).await.unwrap_err();
    assert_eq!(refused.code(), Code::InvalidArgument);
    assert!(
        refused.message().starts_with("message 1 of this stream: not a message of that type"),
        "{refused}"
    );
    for wrong in [vec![], vec![payload("{}")], vec![publisher("/cmd", Encoding::Cdr); 2]] {
        let refused = within(client.publish(tokio_stream::iter(wrong))).await.unwrap_err();
        assert_eq!(refused.code(), Code::InvalidArgument);
    }
    // No publisher is left behind.
    let own = || {
        let graph = gateway.site.hub.graph();
        graph.topics.get("/cmd").map_or(0, |topic| topic.publishers.len())
    };
    eventually(|| own() == 0).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn images_of_13_mb_pass_both_ways() {
    const BYTES: usize = 13 << 20;
    let gateway = Gateway::new().await;
    let mut client = gateway.client().await;
    let (send, requests) = mpsc::channel(1);
    send.send(publisher("/image", Encoding::Cdr)).await.unwrap();
    let publishing = {
        let mut client = client.clone();
        tokio::spawn(async move { client.publish(ReceiverStream::new(requests)).await })
    };
    gateway.site.knows("/image").await;
    let json = SubscribeRequest { encoding: Encoding::Json.into(), ..hear("/image") };
    let (mut cdr, mut json) =
        (subscribe(&mut client, hear("/image")).await, subscribe(&mut client, json).await);
    let image = string(&"x".repeat(BYTES));
    for _ in 0..3 {
        send.send(payload(image.clone())).await.unwrap();
        assert_eq!(next(&mut cdr).await.payload, image);
        assert_eq!(next(&mut json).await.payload.len(), BYTES + r#"{"data":""}"#.len());
    }
    drop(send);
    assert_eq!(within(publishing).await.unwrap().unwrap().into_inner().published, 3);

    // A message beyond the bound is refused, and the connection continues.
    let long = vec![publisher("/image", Encoding::Cdr), payload(vec![0; 65 << 20])];
    let mut unbounded = client.clone().max_encoding_message_size(usize::MAX);
    let refused = within(unbounded.publish(tokio_stream::iter(long))).await.unwrap_err();
    assert_eq!(refused.code(), Code::OutOfRange, "{refused}");
    subscribe(&mut client, SubscribeRequest { r#type: STRING.into(), ..hear("/image") }).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn services_are_called_and_served_over_one_connection() {
    use serve_request::{Kind, Reply, Server};
    use serve_response::Kind as Told;
    let gateway = Gateway::new().await;
    let mut client = gateway.client().await;
    let (say, requests) = mpsc::channel(8);
    let say_kind = |kind| ServeRequest { kind: Some(kind) };
    let server = Server {
        service: "/switch".into(),
        r#type: "std_srvs/SetBool".into(),
        encoding: Encoding::Json.into(),
    };
    say.send(say_kind(Kind::Server(server))).await.unwrap();
    let mut serving = client.serve(ReceiverStream::new(requests)).await.unwrap().into_inner();
    match within(serving.message()).await.unwrap().unwrap().kind {
        Some(Told::Served(served)) => assert_eq!(served.r#type, "std_srvs/srv/SetBool"),
        other => panic!("{other:?}"),
    }
    let call = |data: &str| CallRequest {
        service: "/switch".into(),
        encoding: Encoding::Json.into(),
        payload: format!(r#"{{"data":{data}}}"#).into(),
        ..CallRequest::default()
    };
    let calls: Vec<_> = (0..8)
        .map(|_| {
            let (mut client, call) = (client.clone(), call("true"));
            tokio::spawn(async move { client.call(call).await.unwrap().into_inner().payload })
        })
        .collect();
    let mut ids = Vec::new();
    for _ in 0..8 {
        match within(serving.message()).await.unwrap().unwrap().kind {
            Some(Told::Request(request)) => {
                assert_eq!(request.payload, r#"{"data":true}"#);
                ids.push(request.id);
            }
            other => panic!("{other:?}"),
        }
    }
    // The calls are answered in another order. A reply that cannot be sent is reported, and may be sent again.
    let reply = |id, text: &'static str| say_kind(Kind::Reply(Reply { id, payload: text.into() }));
    for (id, why) in [(ids[7], "not a message of that type"), (99, "call 99 is not open")] {
        say.send(reply(id, r#"{"success":7}"#)).await.unwrap();
        match within(serving.message()).await.unwrap().unwrap().kind {
            Some(Told::Refused(refused)) => assert!(refused.reason.starts_with(why), "{refused:?}"),
            other => panic!("{other:?}"),
        }
    }
    for id in ids.into_iter().rev() {
        say.send(reply(id, r#"{"success":true,"message":"on"}"#)).await.unwrap();
    }
    for call in calls {
        assert_eq!(within(call).await.unwrap(), r#"{"success":true,"message":"on"}"#);
    }
    // A caller without an answer learns which service did not answer.
    let mut late = Request::new(call("false"));
    late.set_timeout(Duration::from_millis(300));
    let refused = within(client.call(late)).await.unwrap_err();
    assert_eq!(refused.code(), Code::DeadlineExceeded, "{refused}");
    assert!(refused.message().starts_with("no answer of /switch"), "{refused}");
    let refused = within(client.call(call("7"))).await.unwrap_err();
    assert_eq!(refused.code(), Code::InvalidArgument);
    drop((say, serving));
    eventually(|| gateway.site.hub.graph().services["/switch"].servers.is_empty()).await;
    let refused =
        within(client.call(CallRequest { r#type: "std_srvs/SetBool".into(), ..call("true") })).await;
    assert_eq!(refused.unwrap_err().code(), Code::Unavailable);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn goals_are_sent_and_served() {
    use serve_action_request as say;
    use serve_action_response::Kind as Told;
    let gateway = Gateway::new().await;
    let mut client = gateway.client().await;
    let (to_gateway, requests) = mpsc::channel(8);
    let request = |kind| ServeActionRequest { kind: Some(kind) };
    let encoding = Encoding::Json.into();
    let r#type = "example_interfaces/action/Fibonacci".to_owned();
    let server = say::Server { action: "/fibonacci".into(), r#type, encoding };
    to_gateway.send(request(say::Kind::Server(server))).await.unwrap();
    let mut serving = client.serve_action(ReceiverStream::new(requests)).await.unwrap().into_inner();
    let first = within(serving.message()).await.unwrap().unwrap();
    assert!(matches!(first.kind, Some(Told::Served(_))), "{first:?}");
    // The server rejects negative orders, completes those below ten, and executes others until they are cancelled.
    tokio::spawn(async move {
        let tell = async |kind| to_gateway.send(request(kind)).await.unwrap();
        while let Ok(Some(told)) = serving.message().await {
            match told.kind.unwrap() {
                Told::Goal(goal) => {
                    let (goal_id, text) = (goal.goal_id, String::from_utf8(goal.payload.into()).unwrap());
                    let is_taken = !text.contains('-');
                    tell(say::Kind::Answer(say::Answer { goal_id: goal_id.clone(), is_taken })).await;
                    if !is_taken {
                        continue;
                    }
                    let payload = r#"{"sequence":[0,1]}"#.into();
                    tell(say::Kind::Feedback(say::Feedback { goal_id: goal_id.clone(), payload })).await;
                    if text == r#"{"order":5}"# {
                        let payload = r#"{"sequence":[0,1,1]}"#.into();
                        tell(say::Kind::Finish(say::Finish { goal_id, status: 0, payload })).await;
                    }
                }
                Told::Cancel(cancel) => {
                    let (goal_id, status) = (cancel.goal_id, GoalStatus::Canceled.into());
                    let payload = r#"{"sequence":[0]}"#.into();
                    tell(say::Kind::Finish(say::Finish { goal_id, status, payload })).await;
                }
                other => panic!("{other:?}"),
            }
        }
    });
    let goal = |order: i32| {
        let payload = format!(r#"{{"order":{order}}}"#).into();
        let goal =
            send_goal_request::Goal { action: "/fibonacci".into(), encoding, payload, ..Default::default() };
        SendGoalRequest { kind: Some(send_goal_request::Kind::Goal(goal)) }
    };
    let cancel = SendGoalRequest { kind: Some(send_goal_request::Kind::Cancel(Default::default())) };
    for (order, status, result) in [
        (5, GoalStatus::Succeeded, r#"{"sequence":[0,1,1]}"#),
        (50, GoalStatus::Canceled, r#"{"sequence":[0]}"#),
    ] {
        let (say, requests) = mpsc::channel(2);
        say.send(goal(order)).await.unwrap();
        let mut sent = within(client.send_goal(ReceiverStream::new(requests))).await.unwrap().into_inner();
        let mut told = Vec::new();
        while let Some(response) = within(sent.message()).await.unwrap() {
            let kind = response.kind.unwrap();
            if order == 50 && matches!(kind, send_goal_response::Kind::Feedback(_)) {
                say.send(cancel.clone()).await.unwrap();
            }
            told.push(kind);
        }
        use send_goal_response::Kind;
        assert!(matches!(&told[0], Kind::Taken(taken) if taken.goal_id.len() == 16), "{told:?}");
        assert!(
            matches!(&told[1], Kind::Feedback(said) if said.payload == r#"{"sequence":[0,1]}"#),
            "{told:?}"
        );
        let last = told.last().unwrap();
        let is_so =
            matches!(last, Kind::Result(said) if said.status == i32::from(status) && said.payload == result);
        assert!(is_so, "{told:?}");
        assert_eq!(told.iter().any(|kind| matches!(kind, Kind::CancelAnswer(_))), order == 50);
    }
    let rejected = within(client.send_goal(tokio_stream::iter([goal(-1)]))).await.unwrap_err();
    assert_eq!(rejected.code(), Code::FailedPrecondition);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_graph_is_listed_and_watched() {
    let gateway = Gateway::new().await;
    let mut client = gateway.client().await;
    let mut watched = client.watch_graph(WatchGraphRequest::default()).await.unwrap().into_inner();
    let first = within(watched.message()).await.unwrap().unwrap();
    assert!(first.changed.unwrap().nodes.iter().any(|node| node.name == "/sgc_gateway"));

    let talker = gateway.site.writer("/chatter", RosQos::default());
    let change = within(watched.message()).await.unwrap().unwrap();
    let topics = change.changed.unwrap().topics;
    assert_eq!((topics[0].name.as_str(), topics[0].r#type.as_str()), ("/chatter", STRING));
    let listed = client.get_graph(GetGraphRequest::default()).await.unwrap().into_inner();
    assert_eq!(listed.gateway_node, "/sgc_gateway");
    assert_eq!(listed.graph.unwrap().topics, topics);
    let qos = topics[0].publishers[0].qos.unwrap();
    assert_eq!((qos.depth, qos.reliability()), (10, qos::Reliability::Reliable));

    drop(talker);
    let change = within(watched.message()).await.unwrap().unwrap();
    assert_eq!(change.gone.unwrap().topics, ["/chatter"]);
    let r#type = "geometry_msgs/msg/Twist".to_owned();
    let twist = client.get_type(GetTypeRequest { r#type }).await.unwrap().into_inner();
    let names: Vec<_> = twist.definitions.iter().map(|definition| definition.r#type.as_str()).collect();
    assert_eq!(names, ["geometry_msgs/msg/Twist", "geometry_msgs/msg/Vector3"]);
    let unknown = client.get_type(GetTypeRequest { r#type: "none/msg/None".into() }).await;
    assert_eq!(unknown.unwrap_err().code(), Code::NotFound);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_token_permits_what_its_scope_has_and_no_more() {
    let gateway = Gateway::new().await;
    gateway.admit(Anonymous::None);
    let talkers = ["/odom", "/secret"].map(|topic| gateway.site.writer(topic, RosQos::default()));
    gateway.site.knows("/secret").await;
    let nodes = ["driver", "spy"].into_iter().zip(&talkers).map(|(name, talker)| {
        let node = RosNode::new("/", name, None).unwrap();
        GraphNode { node, readers: Vec::new(), writers: vec![talker.guid()] }
    });
    gateway.site.ros.announce(&nodes.collect::<Vec<_>>()).unwrap();
    let scope = Scope { subscribe: vec!["/odom".into()], ..Scope::default() };
    let token = gateway.token("partner", scope, UnixMillis(now().0 + 3_600_000));
    let mut partner = gateway.client_with(&token).await;
    subscribe(&mut partner, hear("/odom")).await;
    let graph = partner.get_graph(GetGraphRequest::default()).await.unwrap().into_inner().graph.unwrap();
    assert_eq!(graph.topics.iter().map(|topic| topic.name.as_str()).collect::<Vec<_>>(), ["/odom"]);
    let nodes: Vec<_> = graph.nodes.iter().map(|node| node.name.as_str()).collect();
    assert_eq!(nodes, ["/driver", "/sgc_gateway"]);
    let denied = partner.subscribe(hear("/secret")).await.unwrap_err();
    assert_eq!(denied.code(), Code::PermissionDenied);
    assert_eq!(denied.message(), "partner may not subscribe to /secret: its scope does not have it");
    let requests = [publisher("/odom", Encoding::Json)];
    let denied = within(partner.publish(tokio_stream::iter(requests))).await.unwrap_err();
    assert_eq!(denied.code(), Code::PermissionDenied);

    let tampered = format!("{}x", &token[..token.len() - 1]);
    for other in [None, Some("nonsense"), Some(tampered.as_str())] {
        let mut stranger = client(gateway.endpoint().connect().await.unwrap(), other);
        let refused = stranger.subscribe(hear("/odom")).await.unwrap_err();
        assert_eq!(refused.code(), Code::Unauthenticated, "{refused}");
        assert!(!refused.message().contains("secret") && refused.message().starts_with("not admitted"));
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn streams_end_with_the_token_even_of_a_client_that_does_not_read() {
    let gateway = Gateway::new().await;
    gateway.admit(Anonymous::None);
    let talker = gateway.site.writer("/odom", RosQos::default());
    gateway.site.knows("/odom").await;
    let scope = Scope { subscribe: vec!["/**".into()], publish: vec!["/**".into()], ..Scope::default() };
    let token = gateway.token("partner", scope, UnixMillis(now().0 + 1500));
    let mut partner = gateway.client_with(&token).await;
    let mut heard = subscribe(&mut partner, hear("/odom")).await;
    let mut unread = subscribe(&mut partner, SubscribeRequest { waits: true, ..hear("/odom") }).await;
    let mut watched = partner.watch_graph(WatchGraphRequest::default()).await.unwrap().into_inner();
    let (send, requests) = mpsc::channel(1);
    send.send(publisher("/cmd", Encoding::Json)).await.unwrap();
    let publishing = {
        let mut partner = partner.clone();
        tokio::spawn(async move { partner.publish(ReceiverStream::new(requests)).await })
    };
    // The client's window is full, and the publisher stands still until the stream ends.
    let writing = std::thread::spawn(move || {
        let text = string(&"x".repeat(50_000));
        for n in 0..200 {
            talker.write(SampleKind::Write, n, text.clone()).unwrap();
        }
    });
    assert_eq!(end(&mut heard).await, Some(Code::Unauthenticated));
    assert_eq!(end(&mut watched).await, Some(Code::Unauthenticated));
    assert_eq!(within(publishing).await.unwrap().unwrap_err().code(), Code::Unauthenticated);
    eventually(|| gateway.site.hub.readers() == 0).await;
    writing.join().unwrap();
    assert_eq!(end(&mut unread).await, Some(Code::Unauthenticated));
    let refused = partner.get_graph(GetGraphRequest::default()).await.unwrap_err();
    assert_eq!(
        (refused.code(), refused.message()),
        (Code::Unauthenticated, "not admitted: the token has ended")
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn new_rules_disconnect_clients_they_do_not_admit() {
    let gateway = Gateway::new().await;
    let _talker = gateway.site.writer("/odom", RosQos::default());
    gateway.site.knows("/odom").await;
    let mut client = gateway.client().await;
    let mut heard = subscribe(&mut client, hear("/odom")).await;
    gateway.admit(Anonymous::None);
    assert_eq!(end(&mut heard).await, Some(Code::Unauthenticated));
    gateway.admit(Anonymous::Local);
    subscribe(&mut client, hear("/odom")).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn invalid_requests_are_refused_with_an_explanation() {
    let gateway = Gateway::new().await;
    let _talker = gateway.site.writer("/chatter", RosQos::default());
    gateway.site.knows("/chatter").await;
    let mut client = gateway.client().await;
    let wrong = [
        (
            SubscribeRequest { r#type: "std_msgs/Bool".into(), ..hear("/chatter") },
            Code::InvalidArgument,
            "/chatter is of type std_msgs/msg/String, not std_msgs/msg/Bool",
        ),
        (
            hear("/none"),
            Code::NotFound,
            "the type of /none is not known, since nobody has it yet; give its type",
        ),
        (hear("none"), Code::InvalidArgument, "\"none\" is no name of a topic"),
        (SubscribeRequest { depth: 10_001, ..hear("/chatter") }, Code::InvalidArgument, "a depth of 10001"),
        (SubscribeRequest { encoding: 9, ..hear("/chatter") }, Code::InvalidArgument, "9 is no encoding"),
        (
            SubscribeRequest { r#type: "none/msg/None".into(), ..hear("/new") },
            Code::NotFound,
            "no definition",
        ),
    ];
    for (request, code, words) in wrong {
        let refused = client.subscribe(request).await.unwrap_err();
        assert_eq!(refused.code(), code, "{refused}");
        assert!(refused.message().starts_with(words), "{refused}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_client_has_its_bounds_over_all_its_streams() {
    let session = SessionLimits { subscriptions_max: 2, ..SessionLimits::default() };
    let gateway = Gateway::with(GrpcOptions { session, ..GrpcOptions::default() }).await;
    let _talker = gateway.site.writer("/chatter", RosQos::default());
    gateway.site.knows("/chatter").await;
    let mut client = gateway.client().await;
    let heard =
        [subscribe(&mut client, hear("/chatter")).await, subscribe(&mut client, hear("/chatter")).await];
    let refused = client.subscribe(hear("/chatter")).await.unwrap_err();
    assert_eq!(
        (refused.code(), refused.message()),
        (Code::ResourceExhausted, "2 subscriptions at most for a client")
    );
    // Another client has its own bounds, and an ended subscription makes room.
    subscribe(&mut gateway.client().await, hear("/chatter")).await;
    drop(heard);
    let began = tokio::time::Instant::now();
    while client.subscribe(hear("/chatter")).await.is_err() {
        assert!(began.elapsed() < PATIENCE);
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn long_messages_that_a_client_does_not_read_are_not_written_for_it() {
    let gateway = Gateway::with(GrpcOptions { unread_bytes_max: 20 << 20, ..GrpcOptions::default() }).await;
    let talker = gateway.site.writer("/image", RosQos::default());
    gateway.site.knows("/image").await;
    let mut client = gateway.client().await;
    let wanted = SubscribeRequest { waits: true, depth: 1, ..hear("/image") };
    let unread = subscribe(&mut client, wanted).await;
    let image = string(&"x".repeat(13 << 20));
    // The second write returns once the first message is taken, which fills the stream's window and more than half of
    // the room.
    for n in 1..=2 {
        talker.write(SampleKind::Write, n, image.clone()).unwrap();
    }
    let mut heard = subscribe(&mut client, hear("/image")).await;
    let mut other = subscribe(&mut gateway.client().await, hear("/image")).await;
    talker.write(SampleKind::Write, 3, image.clone()).unwrap();
    // Another client has its own room, and short messages need none.
    assert_eq!(next(&mut other).await.payload, image);
    assert!(client.get_graph(GetGraphRequest::default()).await.is_ok());
    let waited = tokio::time::timeout(Duration::from_millis(300), heard.message()).await;
    assert!(waited.is_err(), "there is room for one alone");
    drop(unread);
    assert_eq!(next(&mut heard).await.payload, image);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn long_requests_that_are_under_way_are_bounded_in_bytes_for_each_client() {
    let options = GrpcOptions { incoming_bytes_max: 2 << 20, ..GrpcOptions::default() };
    let gateway = Gateway::with(options).await;
    let (service, of) = ("/slow", "rcl_interfaces/srv/SetParameters");
    let mut serving = gateway.site.session("program").serve(service, Some(of)).await.unwrap();
    let call = |bytes: usize| CallRequest {
        service: service.into(),
        r#type: of.into(),
        payload: string(&"x".repeat(bytes)),
        ..CallRequest::default()
    };
    let mut client = gateway.client().await;
    let mut first = client.clone();
    let first = tokio::spawn(async move { first.call(call(1500 << 10)).await });
    let asked = within(serving.next()).await.unwrap();
    // The first request is being handled, so no stream has room for another one of that length.
    let told = "2097152 bytes of requests that come or are worked on at most for a client";
    let refused = within(client.call(call(1500 << 10))).await.unwrap_err();
    assert_eq!((refused.code(), refused.message()), (Code::ResourceExhausted, told));
    // There is room for short requests, and for other clients.
    let (mut short, mut other) = (client.clone(), gateway.client().await);
    let all = [
        tokio::spawn(async move { short.call(call(60 << 10)).await }),
        tokio::spawn(async move { other.call(call(1500 << 10)).await }),
    ];
    let mut reply = vec![0, 1, 0, 0];
    reply.extend([0; 4]);
    for asked in [asked, within(serving.next()).await.unwrap(), within(serving.next()).await.unwrap()] {
        serving.replier().reply(asked.id, &Content::cdr(reply.clone())).await.unwrap();
    }
    within(first).await.unwrap().unwrap();
    for answered in all {
        within(answered).await.unwrap().unwrap();
    }
    // An answered request makes room.
    let again = tokio::spawn(async move { client.call(call(1500 << 10)).await });
    let asked = within(serving.next()).await.unwrap();
    serving.replier().reply(asked.id, &Content::cdr(reply)).await.unwrap();
    within(again).await.unwrap().unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_gateway_that_stops_says_so_and_lets_its_connections_end() {
    let gateway = Gateway::new().await;
    let _talker = gateway.site.writer("/chatter", RosQos::default());
    gateway.site.knows("/chatter").await;
    let mut client = gateway.client().await;
    let mut heard = subscribe(&mut client, hear("/chatter")).await;
    gateway.grpc.stop();
    assert_eq!(end(&mut heard).await, Some(Code::Unavailable));
    within(gateway.serving).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn calls_that_are_not_admitted_are_counted_whatever_the_rules_are_later() {
    let gateway = Gateway::new().await;
    let at = ListenAt { protocol: Protocol::Grpc, is_encrypted: false, addr: ([127, 0, 0, 1], 0).into() };
    let options = ServerOptions {
        name: "robot".into(),
        listen: vec![at],
        access: gateway.access_of(Anonymous::None, Vec::new()),
        keys: None,
        clients_max: 8,
        limits: SessionLimits::default(),
    };
    let server = Server::start(gateway.site.hub.clone(), options).await.unwrap();
    let addr = server.local()[0].addr;
    let endpoint = tonic::transport::Endpoint::from_shared(format!("http://{addr}")).unwrap();
    let channel = endpoint.connect().await.unwrap();
    for token in [None, Some("sgc-access-1:AAAA")] {
        let mut client = client(channel.clone(), token);
        let refused = client.get_graph(GetGraphRequest::default());
        assert_eq!(within(refused).await.unwrap_err().code(), Code::Unauthenticated);
    }
    server.reconfigure(gateway.access_of(Anonymous::Local, Vec::new()), None).unwrap();
    within(client(channel, None).get_graph(GetGraphRequest::default())).await.unwrap();
    assert_eq!(server.status().refused, [("not admitted".to_owned(), 2)].into());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn connections_without_a_client_take_no_place_of_clients() {
    let gateway = Gateway::new().await;
    let at = ListenAt { protocol: Protocol::Grpc, is_encrypted: false, addr: ([127, 0, 0, 1], 0).into() };
    let options = ServerOptions {
        name: "robot".into(),
        listen: vec![at],
        access: gateway.access_of(Anonymous::Local, Vec::new()),
        keys: None,
        clients_max: 1,
        limits: SessionLimits::default(),
    };
    let server = Server::start(gateway.site.hub.clone(), options).await.unwrap();
    let addr = server.local()[0].addr;
    let mut idle = Vec::new();
    for _ in 0..8 {
        idle.push(tokio::net::TcpStream::connect(addr).await.unwrap());
    }
    let endpoint = tonic::transport::Endpoint::from_shared(format!("http://{addr}")).unwrap();
    let mut first = client(endpoint.connect().await.unwrap(), None);
    within(first.get_graph(GetGraphRequest::default())).await.unwrap();
    let status = server.status();
    assert_eq!((status.clients.len(), status.clients[0].protocol.as_str()), (1, "grpc"));
    let mut second = client(endpoint.connect().await.unwrap(), None);
    assert!(within(second.get_graph(GetGraphRequest::default())).await.is_err());
    assert_eq!(server.status().refused, [("too many clients".to_owned(), 1)].into());
    // The connection still works.
    within(first.get_graph(GetGraphRequest::default())).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn streams_end_with_a_gateway_that_is_dropped() {
    let Gateway { site, grpc, serving, address, .. } = Gateway::new().await;
    let _talker = site.writer("/chatter", RosQos::default());
    site.knows("/chatter").await;
    let channel = tonic::transport::Endpoint::from_shared(format!("http://{address}")).unwrap();
    let mut client = client(channel.connect().await.unwrap(), None);
    let mut heard = subscribe(&mut client, hear("/chatter")).await;
    serving.abort();
    drop(grpc);
    assert_eq!(end(&mut heard).await, Some(Code::Unavailable));
    drop(heard);
    eventually(|| site.hub.readers() == 0).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn reflection_and_health_answer() {
    use tonic_health::pb::health_client::HealthClient;
    use tonic_health::pb::{HealthCheckRequest, health_check_response::ServingStatus};
    use tonic_reflection::pb::v1::server_reflection_client::ServerReflectionClient;
    use tonic_reflection::pb::v1::server_reflection_request::MessageRequest;
    use tonic_reflection::pb::v1::{ServerReflectionRequest, server_reflection_response::MessageResponse};
    let gateway = Gateway::new().await;
    gateway.admit(Anonymous::None);
    let channel = gateway.endpoint().connect().await.unwrap();
    let service = "sgc.gateway.v1.Gateway".to_owned();
    let mut health = HealthClient::new(channel.clone());
    let mut watched =
        health.watch(HealthCheckRequest { service: service.clone() }).await.unwrap().into_inner();
    let serving = ServingStatus::Serving as i32;
    while within(watched.message()).await.unwrap().unwrap().status != serving {}

    let mut reflection = ServerReflectionClient::new(channel);
    let list = ServerReflectionRequest {
        host: String::new(),
        message_request: Some(MessageRequest::ListServices(String::new())),
    };
    let mut told = reflection.server_reflection_info(tokio_stream::iter([list])).await.unwrap().into_inner();
    match within(told.message()).await.unwrap().unwrap().message_response {
        Some(MessageResponse::ListServicesResponse(list)) => {
            assert!(list.service.iter().any(|known| known.name == service), "{list:?}");
        }
        other => panic!("{other:?}"),
    }
}
