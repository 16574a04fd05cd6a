//! Clients of a hub on a network in memory, beside ordinary programs.
#![allow(clippy::unwrap_used)]

mod support;

use std::sync::Arc;
use std::time::Duration;

use sgc_gateway::{Advertise, Content, Form, GatewayError, Scope, Subscribe};
use sgc_ros::{RosNetwork, RosWriter, SampleKind};
use sgc_wire::{Durability, History, Qos, Reliability};

use support::{STRING, Site, eventually, string};

fn hear(topic: &str) -> Subscribe {
    Subscribe { topic: topic.into(), depth: 10, ..Subscribe::default() }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_programs_publish_is_heard_in_each_form_and_read_once_for_all() {
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
async fn who_subscribes_takes_each_publisher_as_it_is_whenever_it_comes() {
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
    // One that weakens what is offered has the reader made anew: nothing comes twice.
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
async fn who_is_waited_for_shares_a_reader_with_nobody() {
    let site = Site::new().await;
    let _talker = site.writer("/odom", Qos::default());
    site.knows("/odom").await;
    let session = site.session("recorder");
    let _waiting = session.subscribe(Subscribe { waits: true, ..hear("/odom") }).await.unwrap();
    let _others = [
        site.session("one").subscribe(hear("/odom")).await.unwrap(),
        site.session("two").subscribe(hear("/odom")).await.unwrap(),
    ];
    assert_eq!(site.hub.readers(), 2);
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
async fn what_the_scope_does_not_have_is_refused_and_not_seen() {
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
