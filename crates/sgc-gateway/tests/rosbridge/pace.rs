//! The pace at which clients read their subscriptions, and the fate of unread messages. Time is virtual where it
//! matters.

use std::time::Duration;

use serde_json::{Value as Json, json};
use sgc_gateway::SessionLimits;
use sgc_gateway::rosbridge::{ROSBRIDGE_SILENCE_MAX, RosbridgeError, RosbridgeOptions};
use sgc_ros::{RosWriter as _, SampleKind};
use sgc_testkit::FakeWriter;
use sgc_wire::Qos;
use tokio::time::Instant;

use crate::client::{Client, bounded, client, pipe};
use crate::support::{STRING, Site, string};

const PIPE_BYTES: usize = 1 << 20;

fn write(talker: &FakeWriter, text: &str) {
    talker.write(SampleKind::Write, 1, string(text)).unwrap();
}

fn subscribe(id: &str, throttle_ms: u32, queue_length: u32) -> Json {
    json!({"op": "subscribe", "id": id, "topic": "/fast", "type": STRING, "throttle_rate": throttle_ms,
        "queue_length": queue_length})
}

/// Returns the next messages, with the milliseconds until each came.
async fn come<S>(browser: &mut Client<S>, count: usize) -> Vec<(String, u128)>
where
    S: tokio::io::AsyncRead + tokio::io::AsyncWrite + Unpin,
{
    let begun = Instant::now();
    let mut all = Vec::new();
    for _ in 0..count {
        let text = browser.next().await["msg"]["data"].as_str().unwrap().to_owned();
        all.push((text, begun.elapsed().as_millis() / 10 * 10));
    }
    all
}

fn at(all: &[(&str, u128)]) -> Vec<(String, u128)> {
    all.iter().map(|(text, ms)| ((*text).to_owned(), *ms)).collect()
}

#[tokio::test]
async fn a_rate_without_a_queue_gives_the_latest_once_its_time_has_come() {
    let site = Site::new().await;
    let talker = site.writer("/fast", Qos::default());
    tokio::time::pause();
    let mut browser = pipe(site.session("slow"), RosbridgeOptions::default(), PIPE_BYTES).await;
    browser.send(subscribe("s", 100, 0)).await;
    browser.settle().await;
    write(&talker, "a");
    assert_eq!(come(&mut browser, 1).await, at(&[("a", 0)]));
    for text in ["b", "c", "d"] {
        write(&talker, text);
    }
    assert_eq!(come(&mut browser, 1).await, at(&[("d", 100)]));
}

#[tokio::test]
async fn a_rate_with_a_queue_spreads_messages_and_drops_the_oldest() {
    let site = Site::new().await;
    let talker = site.writer("/fast", Qos::default());
    tokio::time::pause();
    let mut browser = pipe(site.session("slow"), RosbridgeOptions::default(), PIPE_BYTES).await;
    browser.send(subscribe("s", 100, 3)).await;
    browser.settle().await;
    write(&talker, "a");
    assert_eq!(come(&mut browser, 1).await, at(&[("a", 0)]));
    for text in ["b", "c", "d", "e"] {
        write(&talker, text);
    }
    assert_eq!(come(&mut browser, 3).await, at(&[("c", 100), ("d", 200), ("e", 300)]));
}

#[tokio::test]
async fn faster_of_two_rates_applies_until_it_is_unsubscribed() {
    let site = Site::new().await;
    let talker = site.writer("/fast", Qos::default());
    tokio::time::pause();
    let mut browser = pipe(site.session("slow"), RosbridgeOptions::default(), PIPE_BYTES).await;
    browser.send(subscribe("slow", 1000, 0)).await;
    browser.send(subscribe("fast", 10, 5)).await;
    browser.settle().await;
    for text in ["a", "b", "c"] {
        write(&talker, text);
    }
    assert_eq!(come(&mut browser, 3).await, at(&[("a", 0), ("b", 10), ("c", 20)]));
    browser.send(json!({"op": "unsubscribe", "id": "fast", "topic": "/fast"})).await;
    browser.settle().await;
    for text in ["d", "e"] {
        write(&talker, text);
    }
    // The previous message came a moment ago, so the next one comes after a second.
    assert_eq!(come(&mut browser, 1).await, at(&[("e", 1000)]));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_client_that_does_not_read_is_bounded_and_another_hears_all() {
    const BYTES_MAX: usize = 64 << 10;
    let site = Site::new().await;
    let talker = site.writer("/fast", Qos::default());
    let limits = SessionLimits { waiting_bytes_max: BYTES_MAX, ..SessionLimits::default() };
    let session = bounded(&site, limits);
    let mut stopped = pipe(session.clone(), RosbridgeOptions::default(), 4096).await;
    let mut reading = client(&site).await;
    stopped.send(json!({"op": "set_level", "level": "warning"})).await;
    stopped.subscribe("/fast").await;
    reading.subscribe("/fast").await;
    let mut waiting_bytes_most = 0;
    for number in 0..2000 {
        write(&talker, &format!("{number:01000}"));
        assert_eq!(reading.next().await["msg"]["data"], format!("{number:01000}"));
        waiting_bytes_most = waiting_bytes_most.max(session.waiting_bytes());
    }
    assert!((BYTES_MAX / 2..=BYTES_MAX).contains(&waiting_bytes_most), "{waiting_bytes_most}");
    // The client reads again. It missed old messages, except those in transit, and learns how many.
    let (mut heard, mut missed, mut last) = (0, 0, String::new());
    while last != format!("{:01000}", 1999) || missed == 0 {
        let next = stopped.next().await;
        if next["op"] == "status" {
            assert_eq!(next["level"], "warning", "{next}");
            let told = next["msg"].as_str().unwrap();
            let count = told.strip_prefix("/fast: ").unwrap().split(' ').next().unwrap();
            missed += count.parse::<usize>().unwrap();
            continue;
        }
        last = next["msg"]["data"].as_str().unwrap().to_owned();
        heard += 1;
    }
    assert_eq!(heard + missed, 2000);
    assert_eq!(session.waiting_bytes(), 0);
}

#[tokio::test]
async fn a_client_that_takes_nothing_at_all_is_given_up() {
    let site = Site::new().await;
    let talker = site.writer("/fast", Qos::default());
    tokio::time::pause();
    let mut browser = pipe(site.session("stopped"), RosbridgeOptions::default(), 4096).await;
    browser.subscribe("/fast").await;
    for _ in 0..100 {
        write(&talker, &"x".repeat(1000));
    }
    let begun = Instant::now();
    let ended = browser.served.await.unwrap();
    assert!(matches!(ended, Err(RosbridgeError::Silent(_))), "{ended:?}");
    assert!(begun.elapsed() < 2 * ROSBRIDGE_SILENCE_MAX);
}

#[tokio::test]
async fn a_client_that_answers_no_ping_is_given_up_and_one_that_does_stays() {
    let site = Site::new().await;
    tokio::time::pause();
    let silent = pipe(site.session("silent"), RosbridgeOptions::default(), PIPE_BYTES).await;
    let mut quiet = pipe(site.session("quiet"), RosbridgeOptions::default(), PIPE_BYTES).await;
    // The client reads, so it answers pings, but sends nothing else.
    let heard = tokio::time::timeout(20 * ROSBRIDGE_SILENCE_MAX, quiet.message());
    let begun = Instant::now();
    let ended = async { (silent.served.await.unwrap(), begun.elapsed()) };
    let (heard, (ended, after)) = tokio::join!(heard, ended);
    assert!(heard.is_err(), "{heard:?}");
    assert!(matches!(ended, Err(RosbridgeError::Silent(_))), "{ended:?}");
    let most = ROSBRIDGE_SILENCE_MAX * 3 / 2 + Duration::from_secs(1);
    assert!(after >= ROSBRIDGE_SILENCE_MAX && after <= most, "{after:?}");
    quiet.settle().await;
}
