//! Tests of a hub's clients on a network in memory, beside ordinary programs.
#![allow(clippy::unwrap_used)]

mod support;

use std::sync::Arc;
use std::time::Duration;

use sgc_gateway::{Advertise, Client, Content, Form, GatewayError, Scope, Session, SessionLimits, Subscribe};
use sgc_ros::{RosNetwork, RosWriter, SampleKind};
use sgc_wire::{Durability, History, Qos, Reliability};

use support::{STRING, Site, eventually, string};

fn hear(topic: &str) -> Subscribe {
    Subscribe { topic: topic.into(), depth: 10, ..Subscribe::default() }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn messages_of_programs_arrive_in_each_form_and_are_read_once() {
    let site = Site::new().await;
    let talker = site.writer("/chatter", Qos::default());
    let (one, other) = (site.session("one"), site.session("other"));
    site.knows("/chatter").await;
    let mut first = one.subscribe(hear("/chatter")).await.unwrap();
    let mut second = other.subscribe(hear("/chatter")).await.unwrap();
    assert_eq!(site.hub.readers(), 1);
    talker.write(SampleKind::Write, 5, string("hello")).unwrap();
    for heard in [&mut first, &mut second] {
        let delivery = heard.next().await.unwrap();
        assert_eq!(delivery.message.payload, string("hello"));
        assert_eq!(heard.write(&delivery.message, Form::Json).unwrap(), r#"{"data":"hello"}"#);
        assert_eq!((delivery.message.source_timestamp_ns, delivery.dropped), (5, 0));
    }
    drop((first, second));
    eventually(|| site.hub.readers() == 0).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn subscription_adapts_to_each_publisher() {
    let site = Site::new().await;
    let session = site.session("desk");
    let wanted = Subscribe { type_name: Some(STRING.into()), ..hear("/late") };
    let mut heard = session.subscribe(wanted).await.unwrap();
    let lossy = Qos { reliability: Reliability::BestEffort, ..Qos::default() };
    for (qos, text) in [(Qos::default(), "reliable"), (lossy, "best effort")] {
        let talker = site.writer("/late", qos);
        eventually(|| talker.matched_readers() == 1).await;
        talker.write(SampleKind::Write, 1, string(text)).unwrap();
        assert_eq!(heard.next().await.unwrap().message.payload, string(text));
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn latched_messages_are_for_who_comes_later_too() {
    let site = Site::new().await;
    let latched =
        Qos { durability: Durability::TransientLocal, history: History::KeepLast(1), ..Qos::default() };
    let map = site.writer("/map", latched.clone());
    map.write(SampleKind::Write, 1, string("map")).unwrap();
    site.knows("/map").await;
    for name in ["first", "second", "third"] {
        let mut heard = site.session(name).subscribe(hear("/map")).await.unwrap();
        assert_eq!(heard.next().await.unwrap().message.payload, string("map"), "{name}");
    }
    // A publisher that weakens the combined offer makes the reader be recreated, and no message comes twice.
    let mut heard = site.session("fourth").subscribe(hear("/map")).await.unwrap();
    assert_eq!(heard.next().await.unwrap().message.payload, string("map"));
    let other = site.writer("/map", Qos { history: History::KeepLast(7), ..latched });
    eventually(|| other.matched_readers() == 1).await;
    other.write(SampleKind::Write, 2, string("other")).unwrap();
    assert_eq!(heard.next().await.unwrap().message.payload, string("other"));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn clients_publish_for_programs_and_for_each_other() {
    let site = Site::new().await;
    let (texts, _reader) = site.reader("/cmd");
    let session = site.session("joystick");
    let wanted =
        Advertise { topic: "/cmd".into(), type_name: Some("std_msgs/String".into()), qos: Qos::default() };
    let publication = session.advertise(wanted).await.unwrap();
    let mut echo = session.subscribe(hear("/cmd")).await.unwrap();
    publication.publish(&Content::json(r#"{"data":"left"}"#)).await.unwrap();
    assert_eq!(texts.recv_timeout(Duration::from_secs(5)).unwrap(), string("left"));
    assert_eq!(echo.next().await.unwrap().message.payload, string("left"));
    let refused = publication.publish(&Content::json(r#"{"date":"left"}"#)).await.unwrap_err();
    assert!(matches!(refused, GatewayError::Value(_)), "{refused}");
    let graph = session.graph();
    assert_eq!(graph.topics["/cmd"].publishers[0].node.as_deref(), Some("/sgc_gateway"));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn queued_publications_keep_their_order_and_report_each_loss() {
    let site = Site::new().await;
    let (texts, _reader) = site.reader("/log");
    let session = site.session("logger");
    let text = |number: u32| Content::cdr(string(&number.to_string()));
    let keep_all = Qos { history: History::KeepAll, ..Qos::default() };
    for qos in [keep_all, Qos { history: History::KeepLast(10), ..Qos::default() }] {
        let may_wait = qos.history == History::KeepAll;
        let wanted = Advertise { topic: "/log".into(), type_name: Some(STRING.into()), qos };
        let publication = session.advertise(wanted).await.unwrap();
        site.domain.refuse_write("rt/log", string("7"));
        let mut lost = 0;
        for number in 0..200 {
            lost += u32::from(publication.publish_ahead(&text(number)).await.is_err());
        }
        while let Err(why) = publication.flush().await {
            assert!(matches!(why, GatewayError::Ros(_)), "{why}");
            lost += 1;
        }
        assert!(!publication.has_ahead());
        assert_eq!((lost, publication.published()), (1, 199), "{may_wait}");
        // A long message keeps its place behind earlier ones.
        let long = string(&"x".repeat(100 << 10));
        publication.publish_ahead(&text(200)).await.unwrap();
        publication.publish_ahead(&Content::cdr(long.clone())).await.unwrap();
        publication.publish_ahead(&text(201)).await.unwrap();
        // Dropping the publication sends its queued messages.
        drop(publication);
        let heard = || texts.recv_timeout(Duration::from_secs(5)).unwrap();
        for number in (0..200).filter(|number| *number != 7) {
            assert_eq!(heard(), string(&number.to_string()), "{may_wait}");
        }
        assert_eq!((heard(), heard(), heard()), (string("200"), long, string("201")), "{may_wait}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn services_are_called_and_served() {
    let site = Site::new().await;
    let (server, caller) = (site.session("server"), site.session("caller"));
    let mut serving = server.serve("/switch", Some("std_srvs/srv/SetBool")).await.unwrap();
    let replier = serving.replier();
    tokio::spawn(async move {
        while let Some(request) = serving.next().await {
            assert_eq!(serving.write(&request, Form::Json).unwrap(), r#"{"data":true}"#);
            let reply = Content::json(r#"{"success":true,"message":"on"}"#);
            replier.reply(request.id, &reply).await.unwrap();
        }
    });
    let request = Content::json(r#"{"data":true}"#);
    let caller = Arc::new(caller);
    let calls = (0..8).map(|_| {
        let (caller, request) = (caller.clone(), request.clone());
        tokio::spawn(async move {
            caller.call("/switch", None, &request, Form::Json, Duration::from_secs(10)).await.unwrap()
        })
    });
    for call in calls.collect::<Vec<_>>() {
        assert_eq!(call.await.unwrap(), r#"{"success":true,"message":"on"}"#);
    }
    let nobody = caller.call("/none", Some("std_srvs/SetBool"), &request, Form::Json, Duration::from_secs(1));
    assert_eq!(nobody.await, Err(GatewayError::NoServer { name: "/none".into() }));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_slow_client_loses_the_oldest_and_is_told_how_many() {
    let site = Site::new().await;
    let talker = site.writer("/fast", Qos::default());
    site.knows("/fast").await;
    let mut slow = site.session("slow").subscribe(Subscribe { depth: 2, ..hear("/fast") }).await.unwrap();
    for text in ["a", "b", "c", "d"] {
        talker.write(SampleKind::Write, 1, string(text)).unwrap();
    }
    let first = slow.next().await.unwrap();
    assert_eq!((first.message.payload.clone(), first.dropped), (string("c"), 2));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn waiting_subscriber_has_its_own_reader_that_keeps_all() {
    let site = Site::new().await;
    let _talker = site.writer("/odom", Qos { history: History::KeepLast(5), ..Qos::default() });
    site.knows("/odom").await;
    let session = site.session("recorder");
    let _waiting = session.subscribe(Subscribe { waits: true, ..hear("/odom") }).await.unwrap();
    let _others = [
        site.session("one").subscribe(hear("/odom")).await.unwrap(),
        site.session("two").subscribe(hear("/odom")).await.unwrap(),
    ];
    assert_eq!(site.hub.readers(), 2);
    let graph = site.hub.graph();
    let readers = graph.topics["/odom"].subscribers.iter();
    let keep_all = readers.filter(|reader| reader.qos.history == History::KeepAll).count();
    assert_eq!(keep_all, 1);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn latched_messages_survive_a_clock_that_is_set_back() {
    let site = Site::new().await;
    let latched =
        Qos { durability: Durability::TransientLocal, history: History::KeepLast(1), ..Qos::default() };
    let map = site.writer("/map", latched);
    site.knows("/map").await;
    let mut heard = site.session("desk").subscribe(hear("/map")).await.unwrap();
    for (stamp, text) in [(9, "first"), (3, "second"), (3, "third")] {
        map.write(SampleKind::Write, stamp, string(text)).unwrap();
        assert_eq!(heard.next().await.unwrap().message.payload, string(text));
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn interfaces_outside_the_scope_are_refused_and_invisible() {
    let site = Site::new().await;
    let _talkers = [site.writer("/odom", Qos::default()), site.writer("/secret", Qos::default())];
    site.knows("/secret").await;
    let scope = Scope { subscribe: vec!["/odom".into()], ..Scope::default() };
    let session = site.session_with("partner", scope);
    assert!(session.subscribe(hear("/odom")).await.is_ok());
    let refused = session.subscribe(hear("/secret")).await.unwrap_err();
    assert!(matches!(refused, GatewayError::Denied { .. }), "{refused}");
    let wanted = Advertise { topic: "/odom".into(), ..Advertise::default() };
    assert!(matches!(session.advertise(wanted).await, Err(GatewayError::Denied { .. })));
    let topics: Vec<_> = session.graph().topics.into_keys().collect();
    assert_eq!(topics, ["/odom"]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn types_that_do_not_agree_are_named() {
    let site = Site::new().await;
    let _talker = site.writer("/chatter", Qos::default());
    site.knows("/chatter").await;
    let session = site.session("desk");
    let wrong = Subscribe { type_name: Some("std_msgs/Bool".into()), ..hear("/chatter") };
    let refused = session.subscribe(wrong).await.unwrap_err().to_string();
    assert_eq!(refused, "/chatter is of type std_msgs/msg/String, not std_msgs/msg/Bool");
    assert!(matches!(session.subscribe(hear("/none")).await, Err(GatewayError::TypeUnknown { .. })));
    assert!(matches!(session.subscribe(hear("none")).await, Err(GatewayError::Name { .. })));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_gateway_that_stops_ends_its_subscriptions_and_leaves_nothing_behind() {
    let site = Site::new().await;
    let talker = site.writer("/chatter", Qos::default());
    site.knows("/chatter").await;
    let mut heard = site.session("desk").subscribe(hear("/chatter")).await.unwrap();
    site.hub.stop().await;
    assert!(heard.next().await.is_none());
    assert_eq!(talker.matched_readers(), 0);
    let _ = site.ros.announce(&[]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn subscriptions_that_are_waited_for_are_few_and_what_ends_makes_room() {
    let site = Site::new().await;
    let client = site.session("client");
    let limits = SessionLimits { waits_max: 2, ..SessionLimits::default() };
    let session = Session::new(&site.hub, client.client().clone(), limits);
    let wanted = |waits| Subscribe {
        topic: "/chatter".into(),
        type_name: Some(STRING.into()),
        waits,
        ..Subscribe::default()
    };
    let first = session.subscribe(wanted(true)).await.unwrap();
    let _second = session.subscribe(wanted(true)).await.unwrap();
    let refused = session.subscribe(wanted(true)).await.err();
    let told = GatewayError::TooMany { what: "subscriptions that are waited for", max: 2 };
    assert_eq!(refused, Some(told));
    let _other = session.subscribe(wanted(false)).await.unwrap();
    // The new client is the same program and shares its bounds.
    let again = session.again(Client::own("again")).unwrap();
    assert!(again.subscribe(wanted(true)).await.is_err());
    drop(first);
    let _third = again.subscribe(wanted(true)).await.unwrap();
}
