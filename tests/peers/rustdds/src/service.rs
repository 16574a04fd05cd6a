//! A client and a server, as `ros2-client` makes them by default (`ServiceMapping::Enhanced`): a request is known by
//! its writer and sequence number, and a reply names both in its related sample identity.

use std::pin::pin;
use std::time::{Duration, Instant};

use futures::executor::block_on;
use futures::future::{Either, select};
use ros2_client::service::{Client, Server};
use ros2_client::{Message, Name, Node, ServiceMapping, ServiceTypeName};
use serde::{Deserialize, Serialize};
use serde_json::json;

use crate::options::{Options, Role};
use crate::{INCOMPLETE, LOOK, WRONG, emit, qos, with_node};

/// `example_interfaces/srv/AddTwoInts`.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Request {
    a: i64,
    b: i64,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Response {
    sum: i64,
}

impl Message for Request {}
impl Message for Response {}

fn ask(seq: u64) -> Request {
    Request { a: seq as i64, b: 1000 - 3 * seq as i64 }
}

fn answer(request: &Request) -> Response {
    Response { sum: request.a + request.b }
}

/// How long a client waits once it is matched, since the server may be so later, and how long a server stays for a
/// client that has not yet taken the last answer.
const SETTLE: Duration = Duration::from_secs(1);

pub fn run(options: &Options) -> Result<u8, String> {
    let deadline = Instant::now() + options.timeout;
    let name = Name::parse(&options.topic).map_err(|e| e.to_string())?;
    let kind = ServiceTypeName::new("example_interfaces", "AddTwoInts");
    let (mapping, qos) = (ServiceMapping::Enhanced, qos(options));
    with_node(options, |mut node| match options.role {
        Role::Client => {
            let client = node.create_client(mapping, &name, &kind, qos.clone(), qos);
            call(options, &node, &client.map_err(|e| e.to_string())?, deadline)
        }
        _ => {
            let server = node.create_server(mapping, &name, &kind, qos.clone(), qos);
            serve(options, &server.map_err(|e| e.to_string())?, deadline)
        }
    })
}

fn call(
    options: &Options,
    node: &Node,
    client: &Client<Request, Response>,
    deadline: Instant,
) -> Result<u8, String> {
    emit("ready", json!({}));
    let (mut sent, mut answered, mut wrong, mut foreign) = (0, 0, 0, 0);
    let mut latency_us = Vec::new();
    if found(client, node, deadline) {
        emit("matched", json!({ "count": 1 }));
        std::thread::sleep(SETTLE);
        while sent < options.count {
            let begun = Instant::now();
            let request = ask(options.start + sent);
            let right = answer(&request);
            let Some(id) = within(deadline, client.async_send_request(request)) else { break };
            let id = id.map_err(|e| e.to_string())?;
            sent += 1;
            let response = loop {
                match within(deadline, client.async_receive_response(id)) {
                    None => break None,
                    Some(Ok(response)) => break Some(response),
                    // A reply that cannot be parsed.
                    Some(Err(_)) => foreign += 1,
                }
            };
            let Some(response) = response else { break };
            answered += 1;
            latency_us.push(begun.elapsed().as_micros() as u64);
            wrong += u64::from(response != right);
            if options.verbose || response != right {
                emit("reply", json!({ "seq": options.start + sent - 1, "ok": response == right }));
            }
            if options.rate > 0.0 {
                let due = begun + Duration::from_secs_f64(1.0 / options.rate);
                std::thread::sleep(due.saturating_duration_since(Instant::now()));
            }
        }
    }
    latency_us.sort_unstable();
    let p50 = latency_us.get(latency_us.len() / 2).copied().unwrap_or(0);
    emit(
        "summary",
        json!({ "role": "client", "sent": sent, "answered": answered, "wrong": wrong,
                "foreign": foreign, "p50_us": p50 }),
    );
    Ok(match (wrong, answered >= options.count) {
        (0, true) => 0,
        (0, false) => INCOMPLETE,
        _ => WRONG,
    })
}

fn serve(options: &Options, server: &Server<Request, Response>, deadline: Instant) -> Result<u8, String> {
    emit("ready", json!({}));
    let mut served = 0;
    while options.count == 0 || served < options.count {
        match within(deadline, server.async_receive_request()) {
            None => break,
            Some(Err(error)) => emit("unreadable", json!({ "error": format!("{error:?}") })),
            Some(Ok((id, request))) => {
                let response = answer(&request);
                block_on(server.async_send_response(id, response)).map_err(|e| e.to_string())?;
                served += 1;
                if options.verbose {
                    emit("served", json!({ "count": served }));
                }
            }
        }
    }
    std::thread::sleep(SETTLE);
    emit("summary", json!({ "role": "server", "served": served, "unmatched": 0 }));
    Ok(if served >= options.count { 0 } else { INCOMPLETE })
}

/// Waits for a server, and returns whether there is one. Asks again and again, because a wait hears of changes alone, and
/// misses those that do not fit into the channel of eight places that it reads.
fn found(client: &Client<Request, Response>, node: &Node, deadline: Instant) -> bool {
    while Instant::now() < deadline {
        if within(deadline.min(Instant::now() + LOOK), client.wait_for_service(node)).is_some() {
            return true;
        }
    }
    false
}

/// Returns the output of a future, or `None` after a deadline.
fn within<T>(deadline: Instant, future: impl Future<Output = T>) -> Option<T> {
    let left = deadline.saturating_duration_since(Instant::now());
    let (sender, timeout) = futures::channel::oneshot::channel::<()>();
    let (cancel, cancelled) = std::sync::mpsc::channel::<()>();
    std::thread::spawn(move || {
        let _ = cancelled.recv_timeout(left);
        let _ = sender.send(());
    });
    let outcome = match block_on(select(pin!(future), timeout)) {
        Either::Left((value, _)) => Some(value),
        Either::Right(_) => None,
    };
    drop(cancel);
    outcome
}
