//! Types over the wire, and messages that travel as JSON, across whole nodes of which only one has the definitions.

#![allow(clippy::unwrap_used)]

mod support;

use std::fs;
use std::sync::Arc;

use bytes::Bytes;
use sgc_cdr::{Layout, TypeName};
use sgc_node::admin::AdminRequest;
use sgc_node::config::{Config, Interface, Recipient, RosConfig, Shaping};
use sgc_ros::{EndpointSpec, RosNetwork, RosServer, ServiceSpec, dds_type};
use sgc_types::Definitions;
use sgc_wire::{PayloadEncoding, PayloadForm, Qos};
use support::*;

const THING: &str = "mine/msg/Thing";
const TEXT: &str = r#"{"label":"a \"thing\"","position":{"x":0.1,"y":-2.5,"z":"NaN"},"raw":"AAEC","count":9007199254740993}"#;

/// A directory with a definition that only one node has.
struct Package(tempfile::TempDir);

impl Package {
    fn new() -> Self {
        let dir = tempfile::tempdir().unwrap();
        for (path, text) in [
            ("mine/msg/Thing.msg", "string label\ngeometry_msgs/Point position\nuint8[] raw\nint64 count"),
            ("mine/srv/Ask.srv", "Thing about\n---\nThing[] answers"),
        ] {
            let path = dir.path().join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text.replace("Thing ", "mine/Thing ").replace("Thing[]", "mine/Thing[]"))
                .unwrap();
        }
        Self(dir)
    }

    fn layout(&self, type_name: &str) -> Layout {
        let definitions = Definitions::new(&[self.0.path().to_owned()], None);
        definitions.layout(&type_name.parse().unwrap()).unwrap()
    }

    /// Returns a message as a local publisher writes it.
    fn thing(&self, json: &str) -> Bytes {
        let layout = self.layout(THING);
        layout.encode(&layout.from_json(json.as_bytes()).unwrap()).unwrap().into()
    }

    /// Makes the definition available to a node.
    fn is_at(&self, config: &mut Config) {
        config.ros = Some(RosConfig { definitions: vec![self.0.path().to_owned()], ..RosConfig::default() });
    }
}

/// Starts a robot that shares `/thing`.
fn robot(trio: &Trio, package: Option<&Package>, change: impl FnOnce(&mut Config)) -> Node {
    start(trio, "robot", |config| {
        config.shares = vec![shared_topic("/thing")];
        if let Some(package) = package {
            package.is_at(config);
        }
        change(config);
    })
}

/// Starts a desk that uses `/thing`.
fn desk(trio: &Trio, package: Option<&Package>, change: impl FnOnce(&mut Config)) -> Node {
    start(trio, "desk", |config| {
        config.uses = vec![used_topic("/thing")];
        if let Some(package) = package {
            package.is_at(config);
        }
        change(config);
    })
}

fn start(trio: &Trio, name: &str, change: impl FnOnce(&mut Config)) -> Node {
    let mut config = trio.config();
    change(&mut config);
    let net = if name == "robot" { &trio.robot_net } else { &trio.desk_net };
    Node::start(config, identity(name, false), Some(net))
}

fn thing_spec(qos: Qos, type_hash: Option<String>) -> EndpointSpec {
    EndpointSpec { type_name: dds_type(THING), type_hash, ..spec("/thing", qos) }
}

fn json() -> Shaping {
    Shaping { form: PayloadForm::Json, ..Shaping::default() }
}

fn name(text: &str) -> TypeName {
    text.parse().unwrap()
}

#[test]
fn a_user_without_definitions_is_told_what_a_type_looks_like() {
    let package = Package::new();
    let hash = package.layout(THING).type_hash();
    // Older distributions announce no hash. The owner's hash counts then.
    for announced in [Some(hash.clone()), None] {
        let trio = Trio::new();
        let (_cloud, _robot) = (trio.cloud(), robot(&trio, Some(&package), |_| {}));
        let desk = desk(&trio, None, |_| {});
        let _talker = Talker::with_spec(&trio.robot_net, &thing_spec(Qos::default(), announced.clone()));
        wait("the type", || desk.types.layout(&name(THING), Some(&hash)).is_some());
        let layout = desk.types.layout(&name(THING), None).unwrap();
        assert_eq!(layout.decode(&package.thing(TEXT)).unwrap().to_json(), TEXT);
        // A tap of the topic gets the description, too.
        let tap = AdminRequest::Tap { topic: "/thing".into(), side: None, bytes: 64 };
        let first = desk.begin(&tap);
        assert_eq!(first["ok"]["described"]["type_hash"], *hash, "{first}");
        assert_eq!(first["ok"]["type_hash"].as_str(), announced.as_deref(), "{first}");
        assert!(first["ok"]["described"]["description"].as_str().is_some_and(|text| text.len() > 100));
        assert_eq!(desk.drops("type_refused"), 0);
    }
}

#[test]
fn tap_of_used_topic_that_nobody_publishes_does_not_call_it_unused() {
    let trio = Trio::new();
    let desk = desk(&trio, None, |_| {});
    let refused = |topic: &str| {
        let tap = AdminRequest::Tap { topic: topic.into(), side: None, bytes: 64 };
        desk.begin(&tap)["error"].as_str().unwrap_or_default().to_owned()
    };
    wait("the rule", || refused("/thing").contains("the [[use]] of it has brought nothing yet"));
    assert!(refused("/other").contains("this node does not use it"));
}

#[test]
fn a_definition_that_is_another_than_the_announced_one_is_not_told() {
    let package = Package::new();
    let trio = Trio::new();
    let (_cloud, robot) = (trio.cloud(), robot(&trio, Some(&package), |_| {}));
    let desk = desk(&trio, None, |_| {});
    let other = format!("RIHS01_{}", "0".repeat(64));
    let talker = Talker::with_spec(&trio.robot_net, &thing_spec(Qos::default(), Some(other)));
    let listener = Listener::with_spec(&trio.desk_net, &thing_spec(Qos::default(), None));
    wait("the count", || robot.drops("type_differs") == 1);
    // Messages are forwarded regardless.
    listener.hears_at_last(|_| talker.say(package.thing(TEXT)));
    assert!(desk.types.layout(&name(THING), None).is_none());
    let tap = AdminRequest::Tap { topic: "/thing".into(), side: None, bytes: 64 };
    assert!(desk.begin(&tap)["ok"]["described"].is_null());
}

#[test]
fn a_user_of_a_service_is_told_what_is_asked_and_answered() {
    let package = Package::new();
    let trio = Trio::new();
    let on_service = |config: &mut Config| {
        config.shares.iter_mut().for_each(|share| {
            (share.interface, share.topic) = (Interface::Service, "/ask".into());
        });
        config.uses.iter_mut().for_each(|used| {
            (used.interface, used.topic) = (Interface::Service, "/ask".into());
        });
    };
    let (_cloud, _robot) = (trio.cloud(), robot(&trio, Some(&package), on_service));
    let desk = desk(&trio, None, on_service);
    let hash = package.layout("mine/srv/Ask").type_hash();
    let end = |dds_topic: &str, message: &str| EndpointSpec {
        topic: dds_topic.into(),
        type_name: dds_type(&format!("mine/srv/Ask_{message}")),
        type_hash: Some(hash.clone()),
        ..spec("/ask", Qos::default())
    };
    let spec =
        ServiceSpec { request: end("rq/askRequest", "Request"), reply: end("rr/askReply", "Response") };
    let net = trio.robot_net.join(false);
    let server = net.create_server(&spec, Box::new(|_, _| ())).unwrap();
    assert_eq!(server.guids().len(), 2);
    wait("the type", || desk.types.layout(&name("mine/srv/Ask_Response"), Some(&hash)).is_some());
    let request = desk.types.layout(&name("mine/srv/Ask_Request"), None).unwrap();
    let text = format!(r#"{{"about":{TEXT}}}"#);
    assert_eq!(request.from_json(text.as_bytes()).unwrap().to_json(), text);
}

#[test]
fn json_payloads_arrive_as_cdr_also_late_and_compressed() {
    let package = Package::new();
    for compression in [PayloadEncoding::Plain, PayloadEncoding::Zstd] {
        let trio = Trio::new();
        let shaping = Shaping { compression, ..json() };
        let (_cloud, robot) =
            (trio.cloud(), robot(&trio, Some(&package), |config| config.shares[0].shaping = shaping));
        // The message is published before anybody subscribes, and before anybody there knows the type.
        let talker = Talker::with_spec(&trio.robot_net, &thing_spec(latched(), None));
        talker.wait_for_readers(1);
        let long = TEXT.replace("a \\\"thing\\\"", &"label ".repeat(500));
        talker.say(package.thing(&long));
        let desk = desk(&trio, None, |_| {});
        let listener = Listener::with_spec(&trio.desk_net, &thing_spec(latched(), None));
        listener.hears(package.thing(&long));
        talker.say(package.thing(TEXT));
        listener.hears(package.thing(TEXT));
        let compressed = &robot.status()["routes"][0]["compressed"];
        match compression {
            PayloadEncoding::Plain => assert!(compressed.is_null(), "{compressed}"),
            // The JSON is compressed.
            _ => assert_eq!(compressed[0], long.len() + TEXT.len()),
        }
        for node in [&robot, &desk] {
            assert_eq!(["no_definition", "not_converted"].map(|reason| node.drops(reason)), [0, 0]);
            assert_eq!(node.status()["problems"], serde_json::json!([]));
        }
        // Messages leave as CDR as soon as the configuration asks for it.
        robot.reload(|config| config.shares[0].shaping = Shaping::default());
        talker.say(package.thing(&long));
        listener.hears(package.thing(&long));
    }
}

#[test]
fn where_nobody_has_a_definition_nothing_flows_as_json_and_that_is_said() {
    let package = Package::new();
    let trio = Trio::new();
    let (_cloud, robot) = (trio.cloud(), robot(&trio, None, |config| config.shares[0].shaping = json()));
    let _desk = desk(&trio, None, |_| {});
    let talker = Talker::with_spec(&trio.robot_net, &thing_spec(Qos::default(), None));
    let listener = Listener::with_spec(&trio.desk_net, &thing_spec(Qos::default(), None));
    talker.wait_for_readers(1);
    wait("the count", || {
        talker.say(package.thing(TEXT));
        robot.drops("no_definition") > 0
    });
    listener.hears_nothing();
    let problems = robot.status()["problems"].to_string();
    assert!(problems.contains("/thing: its messages travel as JSON, and no definition of mine/msg/Thing"));
    let graph = robot.ask(&AdminRequest::Graph(None))["ok"].clone();
    assert_eq!(graph["shares"][0]["routes"][0]["lacks_definition"], true, "{graph}");
    robot.reload(|config| config.shares[0].shaping = Shaping::default());
    listener.hears_at_last(|_| talker.say(package.thing(TEXT)));
    assert_eq!(robot.status()["problems"], serde_json::json!([]));
}

#[test]
fn messages_that_mismatch_their_type_are_counted_and_the_rest_flows() {
    let package = Package::new();
    let trio = Trio::new();
    let (_cloud, robot) =
        (trio.cloud(), robot(&trio, Some(&package), |config| config.shares[0].shaping = json()));
    let _desk = desk(&trio, None, |_| {});
    let talker = Talker::with_spec(&trio.robot_net, &thing_spec(Qos::default(), None));
    let listener = Listener::with_spec(&trio.desk_net, &thing_spec(Qos::default(), None));
    talker.wait_for_readers(1);
    listener.hears_at_last(|_| talker.say(package.thing(TEXT)));
    listener.drain();
    talker.say(&b"\0\x01\0\0no thing"[..]);
    wait("the count", || robot.drops("not_converted") == 1);
    listener.hears_at_last(|_| talker.say(package.thing(TEXT)));
}

#[test]
fn far_publisher_converts_with_the_owners_description() {
    let package = Arc::new(Package::new());
    let trio = Trio::new();
    let robot = robot(&trio, Some(&package), |config| {
        config.shares[0].publish = vec![Recipient::Node("desk".parse().unwrap())];
        config.shares[0].type_name = Some(THING.into());
    });
    let _cloud = trio.cloud();
    let desk = desk(&trio, None, |config| {
        config.uses[0].publish = true;
        config.uses[0].shaping = json();
    });
    let talker = Talker::with_spec(&trio.desk_net, &thing_spec(Qos::default(), None));
    let listener = Listener::with_spec(&trio.robot_net, &thing_spec(Qos::default(), None));
    wait("the type", || desk.types.layout(&name(THING), None).is_some());
    listener.hears_at_last(|_| talker.say(package.thing(TEXT)));
    for heard in listener.drain() {
        assert_eq!(heard, package.thing(TEXT));
    }
    assert_eq!(robot.drops("no_definition"), 0);
}

#[test]
fn messages_of_an_unknown_type_arrive_once_the_owner_describes_it() {
    let package = Package::new();
    let trio = Trio::new();
    let shared = |config: &mut Config| {
        config.shares[0].publish = vec![Recipient::Node("desk".parse().unwrap())];
        config.shares[0].type_name = Some(THING.into());
    };
    let (_cloud, first) = (trio.cloud(), robot(&trio, None, shared));
    let desk = desk(&trio, None, |config| {
        config.uses[0].publish = true;
        config.uses[0].shaping = json();
    });
    let talker = Talker::with_spec(&trio.desk_net, &thing_spec(Qos::default(), None));
    let listener = Listener::with_spec(&trio.robot_net, &thing_spec(Qos::default(), None));
    talker.wait_for_readers(1);
    talker.say(package.thing(TEXT));
    let lacks = "/thing: its messages travel as JSON, and no definition of mine/msg/Thing";
    wait("what is wrong", || desk.status()["problems"].to_string().contains(lacks));
    // The type may still become known.
    assert_eq!(desk.drops("no_definition"), 0);
    first.kill();
    // The definition is installed.
    let _robot = robot(&trio, Some(&package), shared);
    // Either the last message or a new one arrives.
    listener.hears_at_last(|_| talker.say(package.thing(TEXT)));
    assert_eq!(desk.drops("not_converted"), 0);
    wait("that nothing is wrong", || desk.status()["problems"] == serde_json::json!([]));
}

#[test]
fn a_type_that_is_another_after_its_owner_starts_anew_is_asked_for() {
    let package = Package::new();
    let trio = Trio::new();
    let (_cloud, first) = (trio.cloud(), robot(&trio, Some(&package), |_| {}));
    let desk = desk(&trio, None, |_| {});
    let old = package.layout(THING).type_hash();
    let talker = Talker::with_spec(&trio.robot_net, &thing_spec(Qos::default(), Some(old.clone())));
    wait("the type", || desk.types.layout(&name(THING), Some(&old)).is_some());
    first.kill();
    drop(talker);
    fs::write(package.0.path().join("mine/msg/Thing.msg"), "int64 other").unwrap();
    let new = package.layout(THING).type_hash();
    let _talker = Talker::with_spec(&trio.robot_net, &thing_spec(Qos::default(), Some(new.clone())));
    let _robot = robot(&trio, Some(&package), |_| {});
    wait("the new one", || desk.types.layout(&name(THING), Some(&new)).is_some());
}

#[test]
fn types_that_their_owner_does_not_know_keep_those_that_it_does_from_nobody() {
    let package = Package::new();
    let trio = Trio::new();
    let on_all = |config: &mut Config| {
        config.shares.iter_mut().for_each(|share| share.topic = "/**".into());
        config.uses.iter_mut().for_each(|used| used.topic = "/**".into());
    };
    let known = |n: usize| format!("mine/msg/Known{n}");
    for n in 0..8 {
        let path = package.0.path().join(known(n)).with_extension("msg");
        fs::write(path, format!("int8 a{n}")).unwrap();
    }
    let (_cloud, _robot) = (trio.cloud(), robot(&trio, Some(&package), on_all));
    let types = (0..200).map(|n| format!("mine/msg/Nobody{n}")).chain((0..8).map(known));
    let net = trio.robot_net.join(false);
    let talker = |(n, of): (usize, String)| {
        let type_name = dds_type(&of);
        net.create_writer(&EndpointSpec { type_name, ..spec(&format!("/t{n}"), Qos::default()) }).unwrap()
    };
    let _talkers: Vec<_> = types.enumerate().map(talker).collect();
    let desk = desk(&trio, None, on_all);
    wait("all that are known", || (0..8).all(|n| desk.types.layout(&name(&known(n)), None).is_some()));
}
