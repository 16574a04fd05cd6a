//! Roles `serve` and `call`, with `example_interfaces/srv/AddTwoInts`.

use std::time::Duration;

use hiroz::entity::EndpointKind;
use hiroz::{Builder as _, Result};
use serde_json::json;
use tokio::time::{Instant, sleep};

use crate::interfaces::{AddReply, AddRequest, AddTwoInts};
use crate::options::{Call, Service};
use crate::{INCOMPLETE, OK, Run, emit, open};

const POLL: Duration = Duration::from_millis(10);

pub async fn serve(options: &Service, mut run: Run) -> Result<u8> {
    let (_context, node) = open(&options.session, &run).await?;
    let mut server = node.create_service::<AddTwoInts>(&options.name).build()?;
    emit("ready", json!({}));
    let mut served = 0;
    while let Some(request) = run.within(server.async_take_request()).await {
        let request = match request {
            Ok(request) => request,
            Err(error) => {
                emit("unreadable", json!({ "error": error.to_string() }));
                continue;
            }
        };
        let AddRequest { a, b } = *request.message();
        emit("request", json!({ "a": a, "b": b }));
        served += 1;
        request.reply(&AddReply { sum: a + b }).await?;
    }
    emit("summary", json!({ "role": "serve", "served": served }));
    Ok(OK)
}

/// Calls one after the other.
pub async fn call(options: &Call, mut run: Run) -> Result<u8> {
    let Service { session, name } = &options.service;
    let (context, node) = open(session, &run).await?;
    let client = node.create_client::<AddTwoInts>(name).build()?;
    emit("ready", json!({}));
    let found = run
        .within(async {
            while context.graph().get_entities_by_service(EndpointKind::Service, name).is_empty() {
                sleep(POLL).await;
            }
        })
        .await;
    let (mut called, mut answered, mut wrong) = (0, 0, 0);
    let mut took_us = Vec::new();
    if found.is_some() {
        emit("service", json!({ "there": true }));
        while called < options.count {
            called += 1;
            let begun = Instant::now();
            let request = AddRequest { a: options.base, b: called as i64 };
            let Some(Ok(reply)) = run.within(client.call(&request)).await else { break };
            took_us.push(begun.elapsed().as_micros() as u64);
            let right = reply.sum == request.a + request.b;
            answered += 1;
            wrong += u64::from(!right);
            emit("answer", json!({ "n": called, "right": right }));
        }
    }
    took_us.sort_unstable();
    emit(
        "summary",
        json!({ "role": "call", "called": called, "answered": answered, "wrong": wrong, "open": called - answered,
                "others": 0, "p50_us": took_us.get(took_us.len() / 2) }),
    );
    Ok(if answered >= options.count && wrong == 0 { OK } else { INCOMPLETE })
}
