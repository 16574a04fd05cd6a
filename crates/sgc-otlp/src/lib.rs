//! Pushes of metrics to an OpenTelemetry collector: OTLP 1.x over HTTP, with binary Protobuf.
//!
//! The rules are those of the [OTLP specification](https://opentelemetry.io/docs/specs/otlp/#otlphttp). [`encode`] turns
//! metrics into a request, [`StartTimes`] knows since when each counter counts, [`Answer::judge`] says how a request
//! ended, and [`PushSchedule`] when the next one is due. These are pure. [`Client`] sends one request. It follows no
//! redirects, and bounds the time and the size of the answer.
//!
//! The crate knows no metric of a node, and keeps no queue: the caller takes new values for each attempt.
#![forbid(unsafe_code)]

mod answer;
mod client;
mod fault;
mod messages;
mod request;
mod schedule;
mod start_times;

pub use answer::{Answer, BODY_BYTES_MAX};
pub use client::{Client, Endpoint, REQUEST_MAX, TrustedRoots};
pub use fault::{Fault, FaultKind};
pub use request::{CONTENT_TYPE, Kind, Metric, Origin, Point, encode};
pub use schedule::{BACKOFF_MAX, BACKOFF_MIN, PushSchedule, RETRY_AFTER_MAX};
pub use start_times::StartTimes;
