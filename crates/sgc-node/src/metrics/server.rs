//! The HTTP server of metrics.
//!
//! Prometheus scrapes `/metrics`. `/healthz` tells whether the control task answers, and `/readyz` whether the node can
//! carry something. Neither needs a token, so the server tells nothing else and listens on loopback unless told
//! otherwise. `sgc-http` keeps pages of other sites and idle clients out.

use std::fmt;
use std::sync::Arc;

use sgc_http::http::{Request, StatusCode};
use sgc_http::{Answer, TEXT, response};
use tokio::net::TcpListener;

use super::series;
use super::source::Source;

const START_PAGE: &str = "sgc: /metrics for Prometheus, /healthz, /readyz\n";

/// Serves connections until it is dropped.
pub(super) async fn serve(listener: TcpListener, source: Arc<Source>) {
    let answer = move |request: Request<()>| {
        let source = source.clone();
        async move { answer(&request, &source).await }
    };
    sgc_http::serve(listener, answer).await;
}

/// Answers a request.
async fn answer(request: &Request<()>, source: &Source) -> Answer {
    match request.uri().path() {
        "/" => response(StatusCode::OK, TEXT, START_PAGE),
        "/metrics" => metrics(source).await,
        "/healthz" => match source.snapshot().await {
            Some(_) => response(StatusCode::OK, TEXT, "ok\n"),
            None => unanswered(),
        },
        "/readyz" => match source.snapshot().await.map(|snapshot| snapshot.sample.readings.obstacles()) {
            Some(obstacles) if obstacles.is_empty() => response(StatusCode::OK, TEXT, "ready\n"),
            Some(obstacles) => response(StatusCode::SERVICE_UNAVAILABLE, TEXT, obstacles.join("\n") + "\n"),
            None => unanswered(),
        },
        _ => response(StatusCode::NOT_FOUND, TEXT, START_PAGE),
    }
}

async fn metrics(source: &Source) -> Answer {
    let Some(snapshot) = source.snapshot().await else { return unanswered() };
    match snapshot.text() {
        Ok(text) => response(StatusCode::OK, series::CONTENT_TYPE, text),
        Err(fmt::Error) => {
            response(StatusCode::INTERNAL_SERVER_ERROR, TEXT, "the metrics cannot be written\n")
        }
    }
}

fn unanswered() -> Answer {
    response(StatusCode::SERVICE_UNAVAILABLE, TEXT, "the control task does not answer\n")
}
