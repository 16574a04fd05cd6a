//! The gateway's answers in place of a `rosapi` node.

use std::sync::{Arc, Mutex, mpsc};
use std::time::Duration;

use serde_json::{Value as Json, json};
use sgc_cdr::{Layout, TypeName};
use sgc_gateway::{FindDefinitions, Hub, HubOptions, Types};
use sgc_ros::{GraphNode, RosNetwork as _, RosWriter as _};
use sgc_wire::{Qos, RosNode};
use tokio::sync::Notify;

use crate::client::{Client, client};
use crate::support::{Site, eventually};

async fn ask(browser: &mut Client, service: &str, args: Json) -> Json {
    let (values, is_done) = browser.call(service, args).await;
    assert!(is_done, "{values}");
    values
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_graph_is_told() {
    let site = Site::new().await;
    let talker = site.writer("/chatter", Qos::default());
    let (_texts, _reader) = site.reader("/chatter");
    let node = RosNode::new("/arm", "talker", None).unwrap();
    let nodes = [GraphNode { node, readers: vec![], writers: vec![talker.guid()] }];
    site.ros.announce(&nodes).unwrap();
    let program = site.session("program");
    let _switch = program.serve("/switch", Some("std_srvs/SetBool")).await.unwrap();
    let _fib = program.serve_action("/fib", Some("example_interfaces/Fibonacci")).await.unwrap();
    eventually(|| {
        let graph = site.hub.graph();
        graph.actions.contains_key("/fib") && graph.nodes.contains_key("/arm/talker")
    })
    .await;
    let mut browser = client(&site).await;
    let own = "/sgc_gateway";
    for (service, args, wanted) in [
        ("/rosapi/topics", json!({}), json!({"topics": ["/chatter"], "types": ["std_msgs/msg/String"]})),
        ("rosapi/topics", json!([]), json!({"topics": ["/chatter"], "types": ["std_msgs/msg/String"]})),
        ("/rosapi/topics_for_type", json!({"type": "std_msgs/String"}), json!({"topics": ["/chatter"]})),
        ("/rosapi/topics_for_type", json!({"type": "std_msgs/msg/Bool"}), json!({"topics": []})),
        ("/rosapi/topic_type", json!({"topic": "/chatter"}), json!({"type": "std_msgs/msg/String"})),
        ("/rosapi/topic_type", json!({"topic": "/none"}), json!({"type": ""})),
        ("/rosapi/services", json!({}), json!({"services": ["/switch"]})),
        ("/rosapi/services_for_type", json!({"type": "std_srvs/SetBool"}), json!({"services": ["/switch"]})),
        ("/rosapi/service_type", json!({"service": "/switch"}), json!({"type": "std_srvs/srv/SetBool"})),
        ("/rosapi/service_providers", json!({"service": "/switch"}), json!({"providers": [own]})),
        ("/rosapi/service_node", json!({"service": "/switch"}), json!({"node": own})),
        ("/rosapi/publishers", json!({"topic": "/chatter"}), json!({"publishers": ["/arm/talker"]})),
        ("/rosapi/subscribers", json!({"topic": "/chatter"}), json!({"subscribers": []})),
        ("/rosapi/nodes", json!({}), json!({"nodes": ["/arm/talker", own]})),
        (
            "/rosapi/node_details",
            json!({"node": "/arm/talker"}),
            json!({"subscribing": [], "publishing": ["/chatter"], "services": []}),
        ),
        (
            "/rosapi/node_details",
            json!({"node": own}),
            json!({"subscribing": [], "publishing": [], "services": ["/switch"]}),
        ),
        ("/rosapi/action_servers", json!({}), json!({"action_servers": ["/fib"]})),
        (
            "/rosapi/action_type",
            json!({"action": "/fib"}),
            json!({"type": "example_interfaces/action/Fibonacci"}),
        ),
        ("/rosapi/get_ros_version", json!({}), json!({"version": 2, "distro": "unknown"})),
    ] {
        assert_eq!(ask(&mut browser, service, args).await, wanted, "{service}");
    }
    let time = ask(&mut browser, "/rosapi/get_time", json!({})).await;
    assert!(time["time"]["sec"].as_u64().unwrap() > 1_500_000_000);
    assert_eq!(time["time"]["secs"], time["time"]["sec"]);
    assert_eq!(time["time"]["nsecs"], time["time"]["nanosec"]);
    let interfaces = ask(&mut browser, "/rosapi/interfaces", json!({})).await;
    assert!(interfaces["interfaces"].as_array().unwrap().contains(&json!("std_srvs/srv/SetBool")));
    let raw = ask(&mut browser, "/rosapi/topics_and_raw_types", json!({})).await;
    assert_eq!(raw["topics"], json!(["/chatter"]));
    assert!(raw["typedefs_full_text"][0].as_str().unwrap().contains("string data"), "{raw}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn types_are_told() {
    let site = Site::new().await;
    let mut browser = client(&site).await;
    let details = ask(&mut browser, "/rosapi/message_details", json!({"type": "geometry_msgs/Twist"})).await;
    let typedefs = details["typedefs"].as_array().unwrap();
    let wanted = json!({"type": "geometry_msgs/Twist", "fieldnames": ["linear", "angular"],
        "fieldtypes": ["geometry_msgs/Vector3", "geometry_msgs/Vector3"], "fieldarraylen": [-1, -1],
        "examples": ["{}", "{}"], "constnames": [], "constvalues": []});
    assert_eq!((typedefs.len(), &typedefs[0]), (2, &wanted));
    assert_eq!(typedefs[1]["fieldtypes"], json!(["double", "double", "double"]));
    for (service, of, name) in [
        ("service_request_details", "std_srvs/SetBool", "std_srvs/SetBool_Request"),
        ("service_response_details", "std_srvs/srv/SetBool", "std_srvs/SetBool_Response"),
        ("action_goal_details", "example_interfaces/Fibonacci", "example_interfaces/Fibonacci_Goal"),
        ("action_result_details", "example_interfaces/Fibonacci", "example_interfaces/Fibonacci_Result"),
        ("action_feedback_details", "example_interfaces/Fibonacci", "example_interfaces/Fibonacci_Feedback"),
    ] {
        let details = ask(&mut browser, &format!("rosapi/{service}"), json!({ "type": of })).await;
        assert_eq!(details["typedefs"][0]["type"], name);
    }
    let (told, is_done) = browser.call("/rosapi/message_details", json!({"type": "nobody/Knows"})).await;
    assert!(!is_done && told.as_str().unwrap().contains("no definition of nobody/msg/Knows"), "{told}");
    let (told, is_done) = browser.call("/rosapi/message_details", json!({"type": 3})).await;
    assert!(!is_done && told.as_str().unwrap().starts_with("the arguments are not right"), "{told}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn unknown_rosapi_services_are_called_on_the_network() {
    let site = Site::new().await;
    let mut browser = client(&site).await;
    let (told, is_done) = browser.call("/rosapi/search_param", json!({})).await;
    assert!(!is_done && told.as_str().unwrap().contains("/rosapi/search_param is not known"), "{told}");
}

/// A source of definitions that signals a request and answers when told.
struct Slow(Mutex<mpsc::Receiver<()>>, Arc<Notify>);

impl FindDefinitions for Slow {
    fn text(&self, file: &TypeName) -> Option<String> {
        let is_it = file.to_string() == "mine/msg/A";
        if !is_it {
            return None;
        }
        self.1.notify_one();
        let told = self.0.lock().unwrap().recv_timeout(Duration::from_secs(10));
        told.ok().map(|()| "int32 a".to_owned())
    }

    fn described(&self, _: &TypeName, _: Option<&str>) -> Option<Arc<Layout>> {
        None
    }
}

/// There is only one thread, so a blocking read would stop the task that makes it continue.
#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn files_that_are_read_hold_up_nobody() {
    let site = Site::new().await;
    let ((told, waits), begun) = (mpsc::channel(), Arc::new(Notify::new()));
    let types = Types::new(Slow(Mutex::new(waits), Arc::clone(&begun)));
    let hub = Hub::start(Arc::new(site.domain.join(false)), types, HubOptions::default()).await.unwrap();
    let (other, mut browser) = (client(&site).await, client(&Site { hub, ..Site::new().await }).await);
    browser.send(json!({"op": "call_service", "id": 1, "service": "/rosapi/message_details", "args": {"type": "mine/A"}})).await;
    let beside = tokio::spawn(async move {
        let mut other = other;
        begun.notified().await;
        other.settle().await;
        told.send(()).unwrap();
        // The file is read once for the type, and once for each type that it contains.
        told.send(()).unwrap();
    });
    let answer = browser.next().await;
    assert_eq!(answer["values"]["typedefs"][0]["fieldnames"], json!(["a"]), "{answer}");
    beside.await.unwrap();
}
