//! Hostile clients: conversations of the rosbridge and Foxglove protocols, mutated with fixed seeds. A short run of
//! the fuzz target `gateway`.
#![allow(clippy::unwrap_used)]

mod support;

use std::future::Future;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use bytes::BytesMut;
use futures_util::{SinkExt as _, StreamExt as _};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{RngCore as _, SeedableRng as _};
use sgc_gateway::rosbridge::RosbridgeOptions;
use sgc_gateway::{Content, Session, foxglove, rosbridge};
use sgc_ros::{RosWriter as _, SampleKind};
use sgc_websocket::WebSocket;
use sgc_wire::Qos;
use tokio::io::DuplexStream;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::protocol::Role;

use support::{Site, eventually, string};

const CONVERSATIONS: usize = 400;
const MESSAGES: u32 = 12;
const PATIENCE: Duration = Duration::from_secs(20);
const PIPE_BYTES: usize = 1 << 20;

/// Valid messages of a rosbridge client.
const OPS: &[&str] = &[
    r#"{"op":"subscribe","id":"s1","topic":"/chatter","type":"std_msgs/String","throttle_rate":10,"queue_length":5}"#,
    r#"{"op":"subscribe","topic":"/chatter","compression":"cbor-raw","fragment_size":20}"#,
    r#"{"op":"unsubscribe","id":"s1","topic":"/chatter"}"#,
    r#"{"op":"advertise","id":"a1","topic":"/cmd","type":"geometry_msgs/msg/Twist","qos":{"depth":3,"durability":"transient_local"}}"#,
    r#"{"op":"publish","topic":"/cmd","msg":{"linear":{"x":1.5},"angular":{"z":-2}}}"#,
    r#"{"op":"publish","topic":"/img","type":"sensor_msgs/Image","msg":{"header":{"stamp":{"secs":1,"nsecs":2}},"data":"AAEC"}}"#,
    r#"{"op":"unadvertise","id":"a1","topic":"/cmd"}"#,
    r#"{"op":"call_service","id":"c1","service":"/rosapi/topics","args":{}}"#,
    r#"{"op":"call_service","id":"c2","service":"/switch","type":"std_srvs/SetBool","args":[true],"timeout":0.01}"#,
    r#"{"op":"advertise_service","service":"/switch","type":"std_srvs/srv/SetBool"}"#,
    r#"{"op":"service_response","id":"service_request:/switch:1","service":"/switch","values":{"success":true},"result":true}"#,
    r#"{"op":"unadvertise_service","service":"/switch"}"#,
    r#"{"op":"advertise_action","action":"/dock","type":"example_interfaces/action/Fibonacci"}"#,
    r#"{"op":"send_action_goal","id":"g1","action":"/dock","action_type":"example_interfaces/action/Fibonacci","args":{"order":3},"feedback":true}"#,
    r#"{"op":"action_feedback","id":"g1","action":"/dock","values":{"sequence":[1,2]}}"#,
    r#"{"op":"action_result","id":"g1","action":"/dock","values":{"sequence":[1,2]},"status":4,"result":true}"#,
    r#"{"op":"cancel_action_goal","id":"g1","action":"/dock"}"#,
    r#"{"op":"fragment","id":"f1","num":0,"total":2,"data":"{\"op\":\"set_"}"#,
    r#"{"op":"fragment","id":"f1","num":1,"total":2,"data":"level\",\"level\":\"info\"}"}"#,
    r#"{"op":"set_level","level":"warning"}"#,
    r#"{"op":"call_service","service":"/rosapi/message_details","args":{"type":"geometry_msgs/msg/Twist"}}"#,
    r#"{"op":"call_service","service":"/rosapi/get_param","args":{"name":"/n:p","default":"1"}}"#,
];

/// Valid messages of a Foxglove client. Binary ones begin with an opcode.
const COMMANDS: &[&str] = &[
    r#"{"op":"subscribe","subscriptions":[{"id":1,"channelId":1},{"id":2,"channelId":2}]}"#,
    r#"{"op":"unsubscribe","subscriptionIds":[1]}"#,
    r#"{"op":"advertise","channels":[{"id":7,"topic":"/cmd","encoding":"json","schemaName":"geometry_msgs/msg/Twist"}]}"#,
    r#"{"op":"advertise","channels":[{"id":8,"topic":"/raw","encoding":"cdr","schemaName":"std_msgs/msg/String"}]}"#,
    r#"{"op":"unadvertise","channelIds":[7]}"#,
    r#"{"op":"getParameters","parameterNames":["/talker.rate"],"id":"p"}"#,
    r#"{"op":"setParameters","parameters":[{"name":"/talker.rate","value":[1,2.5],"type":"float64_array"}],"id":"q"}"#,
    r#"{"op":"subscribeParameterUpdates","parameterNames":["/talker.rate"]}"#,
    r#"{"op":"unsubscribeParameterUpdates","parameterNames":["/talker.rate"]}"#,
    r#"{"op":"subscribeConnectionGraph"}"#,
    "\u{1}\u{7}\0\0\0{\"linear\":{\"x\":1}}",
    "\u{1}\u{8}\0\0\0\0\u{1}\0\0\u{3}\0\0\0hi\0",
    "\u{2}\u{1}\0\0\0\u{9}\0\0\0\u{4}\0\0\0json{\"data\":true}",
];

/// Changes, cuts or repeats bytes, or puts numbers and texts where they are not expected.
fn mutated(rng: &mut ChaCha8Rng, valid: &[u8]) -> Vec<u8> {
    const PIECES: [&[u8]; 9] =
        [b"-1", b"1e999", b"null", b"\"\"", b"[]", b"{}", b"18446744073709551616", b"\\u0000", b"\"/**\""];
    let mut bytes = valid.to_vec();
    for _ in 0..rng.next_u32() % 4 {
        let at = rng.next_u32() as usize % bytes.len().max(1);
        match rng.next_u32() % 6 {
            0 => bytes.truncate(at),
            1 => bytes.extend_from_within(at.min(bytes.len())..),
            2 if !bytes.is_empty() => bytes[at] ^= 1 << (rng.next_u32() % 8),
            _ => {
                let piece = PIECES[rng.next_u32() as usize % PIECES.len()];
                let end = (at + rng.next_u32() as usize % 8).min(bytes.len());
                bytes.splice(at.min(end)..end, piece.iter().copied());
            }
        }
    }
    bytes
}

/// Runs clients with mutated messages and returns the number of panics in the gateway's tasks.
async fn converse<F>(words: &[&str], serve: impl Fn(WebSocket<DuplexStream>, Arc<Session>) -> F) -> usize
where
    F: Future<Output = ()> + Send + 'static,
{
    static PANICS: AtomicUsize = AtomicUsize::new(0);
    let before = PANICS.load(Ordering::SeqCst);
    let usual = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |info| {
        PANICS.fetch_add(1, Ordering::SeqCst);
        usual(info);
    }));
    let site = Site::new().await;
    let talker = site.writer("/chatter", Qos::default());
    let rng = &mut ChaCha8Rng::seed_from_u64(7);
    for conversation in 0..CONVERSATIONS {
        let (here, there) = tokio::io::duplex(PIPE_BYTES);
        let socket = WebSocket::new(there, BytesMut::new(), 64 << 20);
        let served = tokio::spawn(serve(socket, Arc::new(site.session("stranger"))));
        let socket = WebSocketStream::from_raw_socket(here, Role::Client, None).await;
        let (mut say, mut hear) = socket.split();
        let hearing = tokio::spawn(async move { while let Some(Ok(_)) = hear.next().await {} });
        for _ in 0..MESSAGES {
            let words = words[rng.next_u32() as usize % words.len()];
            let message = match String::from_utf8(mutated(rng, words.as_bytes())) {
                Ok(text) if text.starts_with('{') => Message::Text(text.into()),
                Ok(text) => Message::Binary(text.into_bytes().into()),
                Err(bytes) => Message::Binary(bytes.into_bytes().into()),
            };
            if say.send(message).await.is_err() {
                break;
            }
        }
        talker.write(SampleKind::Write, 1, string("hello")).unwrap();
        // Half of the clients close in good order.
        if conversation % 2 == 0 {
            let _ = say.close().await;
        }
        drop(say);
        hearing.abort();
        let _ = hearing.await;
        let ended = tokio::time::timeout(PATIENCE, served).await;
        ended.unwrap_or_else(|_| panic!("conversation {conversation} does not end")).unwrap();
    }
    // Other clients are served as before, and nothing is left behind.
    let session = site.session("friend");
    let wanted = sgc_gateway::Subscribe { topic: "/chatter".into(), depth: 1, ..Default::default() };
    let mut heard = session.subscribe(wanted).await.unwrap();
    talker.write(SampleKind::Write, 2, string("still here")).unwrap();
    while heard.next().await.unwrap().message.payload != Content::cdr(string("still here")).bytes {}
    drop(heard);
    eventually(|| site.hub.readers() == 0).await;
    let own = || site.hub.graph().topics.values().flat_map(|t| &t.publishers).filter(|p| p.is_own).count();
    eventually(|| own() == 0).await;
    let _ = std::panic::take_hook();
    PANICS.load(Ordering::SeqCst) - before
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn conversations_that_go_wrong_harm_nobody() {
    let by_rosbridge = converse(OPS, |socket, session| async move {
        drop(rosbridge::serve(socket, session, RosbridgeOptions::default()).await);
    });
    assert_eq!(by_rosbridge.await, 0, "rosbridge: tasks panicked");
    let by_foxglove = converse(COMMANDS, |socket, session| async move {
        drop(foxglove::serve(socket, session, foxglove::Options::default()).await);
    });
    assert_eq!(by_foxglove.await, 0, "Foxglove: tasks panicked");
}
