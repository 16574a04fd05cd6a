//! Timing of the searches on a paused clock. The tests replace dialling and DNS.

#![allow(clippy::unwrap_used)]

use std::collections::{BTreeMap, BTreeSet};
use std::future::Future;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use rand_core::SeedableRng as _;
use sgc_config::RouterUrl;
use sgc_transport::{DialError, LinkError, LinkUrl};
use sgc_wire::NodeId;
use tokio::sync::mpsc;
use tokio::task::JoinHandle;
use tokio::time::{Instant, sleep, timeout};

use super::dns::DnsError;
use super::local::Sighting;
use super::srv_answer::{SrvAnswer, SrvTarget, TTL_MIN};
use super::*;

const SECOND: Duration = Duration::from_secs(1);

/// Behaviour of a host that is dialled.
#[derive(Clone, Copy, Debug)]
enum Host {
    Dead,
    /// A link comes up and lasts this long.
    Up(Duration),
    /// Another link to the router exists for this long.
    Reached(Duration),
}

/// Simulated hosts, and the times at which they were dialled.
#[derive(Clone)]
struct World {
    start: Instant,
    hosts: Arc<Mutex<BTreeMap<String, Host>>>,
    dialled: Arc<Mutex<Vec<(Duration, String)>>>,
    up: Arc<Mutex<BTreeSet<String>>>,
    /// Parallel dials: the maximum, and the current number.
    dials: Arc<Mutex<(usize, usize)>>,
    answer: Arc<Mutex<Result<SrvAnswer, DnsError>>>,
    asked: Arc<Mutex<Vec<Duration>>>,
    network: (Arc<watch::Sender<u64>>, Network),
}

impl World {
    fn new() -> Self {
        let (tell, network) = Network::channel();
        Self {
            start: Instant::now(),
            hosts: Arc::default(),
            dialled: Arc::default(),
            up: Arc::default(),
            dials: Arc::default(),
            answer: Arc::new(Mutex::new(Err(DnsError::NoRecord { name: "x".into() }))),
            asked: Arc::default(),
            network: (Arc::new(tell), network),
        }
    }

    fn set(&self, host: &str, is: Host) {
        self.hosts.lock().unwrap().insert(host.into(), is);
    }

    fn answers(&self, ttl: Duration, targets: &[(u16, &str)]) {
        let target = |(priority, host): &(u16, &str)| SrvTarget {
            priority: *priority,
            weight: 0,
            host: (*host).into(),
            port: 7447,
        };
        *self.answer.lock().unwrap() = Ok(SrvAnswer { targets: targets.iter().map(target).collect(), ttl });
    }

    fn dialled(&self) -> Vec<(Duration, String)> {
        self.dialled.lock().unwrap().clone()
    }

    fn hosts_dialled(&self) -> String {
        self.dialled().into_iter().map(|(_, host)| host).collect()
    }

    fn asked(&self) -> Vec<Duration> {
        self.asked.lock().unwrap().clone()
    }

    fn up(&self) -> Vec<String> {
        self.up.lock().unwrap().iter().cloned().collect()
    }

    fn keep_one(&self) -> (JoinHandle<()>, Board) {
        let RouterUrl::Srv(domain) = "srv://lab.example".parse().unwrap() else { panic!() };
        let board = Board::default();
        let row = board.row("srv://lab.example", "srv");
        let rng = ChaCha20Rng::seed_from_u64(1);
        (tokio::spawn(srv::keep_one_of(domain, self.clone(), self.clone(), row, rng)), board)
    }
}

impl KeepLink for World {
    async fn keep_link(
        &self,
        mut target: watch::Receiver<DialTarget>,
        request: &LinkRequest,
        _line: &StatusRow,
    ) -> Outcome {
        let url = target.borrow_and_update().url.clone();
        let mut host = url.host.clone();
        self.dialled.lock().unwrap().push((self.start.elapsed(), host.clone()));
        {
            let (most, now) = &mut *self.dials.lock().unwrap();
            *now += 1;
            *most = (*most).max(*now);
        }
        sleep(Duration::from_millis(1)).await;
        self.dials.lock().unwrap().1 -= 1;
        let is = self.hosts.lock().unwrap().get(&host).copied().unwrap_or(Host::Dead);
        match is {
            Host::Dead => Outcome::Failed(DialError::NoAddress(url).into()),
            Host::Reached(_) => Outcome::Failed(Failure::Reached(NodeId([1; 32]))),
            Host::Up(time) => {
                let place = request.places.as_ref().map(|places| places.clone().try_acquire_owned());
                if let Some(Err(_)) = place {
                    return Outcome::Failed(Failure::Enough);
                }
                self.up.lock().unwrap().insert(host.clone());
                let end = sleep(time);
                tokio::pin!(end);
                loop {
                    tokio::select! {
                        () = &mut end => break,
                        Ok(()) = target.changed() => {
                            self.up.lock().unwrap().remove(&host);
                            host = target.borrow_and_update().url.host.clone();
                            self.up.lock().unwrap().insert(host.clone());
                        }
                    }
                }
                self.up.lock().unwrap().remove(&host);
                Outcome::Ended { remote: ([127, 0, 0, 1], 1).into(), end: LinkError::PeerRestarted }
            }
        }
    }

    async fn released(&self, _: &NodeId) {
        let hosts = self.hosts.lock().unwrap().clone();
        let reached = hosts.values().find_map(|host| match host {
            Host::Reached(time) => Some(*time),
            _ => None,
        });
        if let Some(time) = reached {
            sleep(time).await;
        }
    }

    fn network(&self) -> Network {
        self.network.1.onward()
    }

    fn is_over(&self) -> bool {
        false
    }
}

impl Names for World {
    async fn routers(&self, _: &sgc_config::SrvDomain) -> Result<SrvAnswer, DnsError> {
        self.asked.lock().unwrap().push(self.start.elapsed());
        self.answer.lock().unwrap().clone()
    }

    async fn addresses(&self, _: &str, port: u16) -> Result<Vec<SocketAddr>, DnsError> {
        Ok(vec![([127, 0, 0, 1], port).into()])
    }
}

fn at(host: &str) -> LinkUrl {
    format!("quic://{host}").parse().unwrap()
}

fn no_answer() -> DnsError {
    DnsError::NoAnswer { name: "x".into(), reason: "no answer".into() }
}

async fn runs_for(time: Duration, task: impl Future<Output = ()>) {
    assert!(timeout(time, task).await.is_err(), "it ended");
}

#[tokio::test(start_paused = true)]
async fn a_dead_router_is_dialled_with_growing_patience_and_never_given_up() {
    let world = World::new();
    let board = Board::default();
    let row = board.row("quic://a", "static");
    let keep = keep_at(at("a"), world.clone(), row, ChaCha20Rng::seed_from_u64(1));
    runs_for(200 * SECOND, keep).await;
    let dialled = world.dialled();
    let waits: Vec<_> = dialled.windows(2).map(|two| (two[1].0 - two[0].0).as_millis()).collect();
    for (n, wait) in waits.iter().enumerate() {
        let most = (250u128 << n.min(10)).min(10_000);
        // An attempt takes a millisecond, which is also the clock's resolution.
        assert!((most / 2..=most + 2).contains(wait), "{n}: {waits:?}");
    }
    assert!(waits.len() >= 20 && waits.iter().collect::<BTreeSet<_>>().len() > 10, "{waits:?}");
}

#[tokio::test(start_paused = true)]
async fn failed_target_is_retried_soon_after_a_network_change() {
    let world = World::new();
    let row = Board::default().row("quic://a", "static");
    let task = tokio::spawn(keep_at(at("a"), world.clone(), row, ChaCha20Rng::seed_from_u64(1)));
    sleep(100 * SECOND).await;
    world.set("a", Host::Up(3600 * SECOND));
    let changed = world.start.elapsed();
    world.network.0.send_modify(|change| *change += 1);
    sleep(SECOND).await;
    let last = world.dialled().last().unwrap().0;
    assert!(last >= changed && last - changed < SECOND / 2 && world.up() == ["a"], "{last:?} {changed:?}");
    task.abort();
    // The network changes all the time.
    let world = World::new();
    let row = Board::default().row("quic://a", "static");
    let task = tokio::spawn(keep_at(at("a"), world.clone(), row, ChaCha20Rng::seed_from_u64(1)));
    for _ in 0..10_000 {
        sleep(SECOND / 1000).await;
        world.network.0.send_modify(|change| *change += 1);
    }
    assert!((30..=81).contains(&world.dialled().len()), "{}", world.dialled().len());
    task.abort();
}

#[tokio::test(start_paused = true)]
async fn a_set_is_tried_anew_on_another_network() {
    let world = World::new();
    *world.answer.lock().unwrap() = Err(no_answer());
    let (task, _board) = world.keep_one();
    sleep(100 * SECOND).await;
    world.answers(3600 * SECOND, &[(10, "a")]);
    world.set("a", Host::Up(3600 * SECOND));
    let changed = world.start.elapsed();
    world.network.0.send_modify(|change| *change += 1);
    sleep(SECOND).await;
    assert!(world.asked().last().unwrap() >= &changed, "{:?}", world.asked());
    assert_eq!(world.up(), ["a"]);
    task.abort();
}

#[tokio::test(start_paused = true)]
async fn nodes_that_lose_one_router_come_back_at_different_moments() {
    let mut second = BTreeSet::new();
    for seed in 0..20 {
        let world = World::new();
        world.set("a", Host::Up(SECOND));
        let row = Board::default().row("quic://a", "static");
        let rng = ChaCha20Rng::seed_from_u64(seed);
        runs_for(2 * SECOND, keep_at(at("a"), world.clone(), row, rng)).await;
        second.insert(world.dialled()[1].0.as_millis());
    }
    assert!(second.len() > 10 && second.iter().all(|at| (1125..=1253).contains(at)), "{second:?}");
}

#[tokio::test(start_paused = true)]
async fn the_best_target_is_linked_and_the_next_when_it_fails() {
    let world = World::new();
    world.answers(60 * SECOND, &[(20, "b"), (10, "a"), (30, "c")]);
    world.set("b", Host::Up(30 * SECOND));
    world.set("c", Host::Up(30 * SECOND));
    let (task, _board) = world.keep_one();
    sleep(SECOND).await;
    assert_eq!((world.hosts_dialled(), world.up()), ("ab".into(), vec!["b".into()]));
    // When that link ends, the search begins with the best again.
    world.set("a", Host::Up(3600 * SECOND));
    sleep(31 * SECOND).await;
    assert_eq!((world.hosts_dialled(), world.up()), ("aba".into(), vec!["a".into()]));
    task.abort();
}

#[tokio::test(start_paused = true)]
async fn a_target_that_flaps_does_not_make_a_dead_one_be_tried_each_time() {
    let world = World::new();
    world.answers(3600 * SECOND, &[(10, "a"), (20, "b")]);
    world.set("b", Host::Up(SECOND / 10));
    let (task, _board) = world.keep_one();
    sleep(60 * SECOND).await;
    let dialled = world.hosts_dialled();
    let (a, b) = (dialled.matches('a').count(), dialled.matches('b').count());
    assert!((10..20).contains(&a) && b > 100, "{a} and {b}");
    task.abort();
}

#[tokio::test(start_paused = true)]
async fn dns_is_asked_when_its_answer_is_over_within_bounds() {
    for (ttl, least, most) in [(10, 6, 7), (60, 2, 2), (3600, 1, 1)] {
        let world = World::new();
        world.answers(ttl * SECOND, &[(10, "a")]);
        world.set("a", Host::Up(7200 * SECOND));
        let (task, _board) = world.keep_one();
        sleep(65 * SECOND).await;
        assert!((least..=most).contains(&world.asked().len()), "{ttl}: {:?}", world.asked());
        assert_eq!(world.hosts_dialled(), "a");
        task.abort();
    }
}

#[tokio::test(start_paused = true)]
async fn dns_is_asked_again_when_all_targets_failed_but_not_more_often_than_it_may() {
    let world = World::new();
    world.answers(3600 * SECOND, &[(10, "a")]);
    let (task, _board) = world.keep_one();
    sleep(5 * SECOND).await;
    assert!(world.dialled().len() > 3 && world.asked().len() == 1, "{:?}", world.asked());
    // The router has moved.
    world.answers(3600 * SECOND, &[(10, "b")]);
    world.set("b", Host::Up(3600 * SECOND));
    sleep(20 * SECOND).await;
    assert_eq!(world.up(), ["b"]);
    let asked = world.asked();
    assert!(asked.windows(2).all(|two| two[1] - two[0] >= TTL_MIN), "{asked:?}");
    task.abort();
}

#[tokio::test(start_paused = true)]
async fn a_link_moves_when_its_router_is_named_no_more() {
    let world = World::new();
    world.answers(10 * SECOND, &[(10, "a"), (20, "b")]);
    world.set("a", Host::Up(3600 * SECOND));
    let (task, _board) = world.keep_one();
    sleep(5 * SECOND).await;
    assert_eq!(world.up(), ["a"]);
    // A better target alone moves no link.
    world.answers(10 * SECOND, &[(5, "c"), (10, "a"), (20, "b")]);
    sleep(20 * SECOND).await;
    assert_eq!(world.up(), ["a"]);
    world.answers(10 * SECOND, &[(20, "b")]);
    sleep(20 * SECOND).await;
    assert_eq!(world.up(), ["b"]);
    task.abort();
}

#[tokio::test(start_paused = true)]
async fn last_dns_answer_serves_while_dns_is_silent_until_it_denies() {
    let world = World::new();
    world.answers(10 * SECOND, &[(10, "a")]);
    world.set("a", Host::Up(30 * SECOND));
    let (task, board) = world.keep_one();
    sleep(5 * SECOND).await;
    *world.answer.lock().unwrap() = Err(no_answer());
    sleep(40 * SECOND).await;
    assert_eq!((world.hosts_dialled(), world.up()), ("aa".into(), vec!["a".into()]));
    assert!(board.snapshot()[0].last_failure.as_ref().is_some_and(|why| why.contains("no answer")));
    *world.answer.lock().unwrap() = Err(DnsError::NotOffered { name: "_sgc._udp.lab.example".into() });
    sleep(60 * SECOND).await;
    assert_eq!((world.hosts_dialled(), world.up()), ("aa".into(), vec![]));
    let row = &board.snapshot()[0];
    assert!(row.last_failure.as_ref().is_some_and(|why| why.contains("offers no routers")), "{row:?}");
    // The search goes on asking.
    world.answers(10 * SECOND, &[(10, "a")]);
    sleep(15 * SECOND).await;
    assert_eq!(world.hosts_dialled(), "aaa");
    task.abort();
}

#[tokio::test(start_paused = true)]
async fn a_set_whose_router_has_a_link_already_stands_back_until_that_ends() {
    let world = World::new();
    world.answers(3600 * SECOND, &[(10, "a"), (20, "b")]);
    world.set("a", Host::Reached(100 * SECOND));
    world.set("b", Host::Up(3600 * SECOND));
    let (task, _board) = world.keep_one();
    sleep(90 * SECOND).await;
    assert_eq!((world.hosts_dialled(), world.up()), ("a".into(), vec![]));
    world.set("a", Host::Up(3600 * SECOND));
    sleep(20 * SECOND).await;
    assert_eq!((world.hosts_dialled(), world.up()), ("aa".into(), vec!["a".into()]));
    task.abort();
}

/// Keeps links to the routers that the returned channel announces.
fn keep_announced_links(world: &World) -> (mpsc::Sender<Sighting>, JoinHandle<()>) {
    let (tell, heard) = mpsc::channel(64);
    let (board, keeper) = (Board::default(), world.clone());
    let task = tokio::spawn(async move {
        let row = board.row("mdns://", "mdns");
        let wanted = RouterFilter { written: "mdns://".into(), nodes: None };
        mdns::keep_links(heard, wanted, keeper, &board, &row, ChaCha20Rng::seed_from_u64(1)).await;
    });
    (tell, task)
}

#[tokio::test(start_paused = true)]
async fn many_announcements_lead_to_two_links_and_at_most_four_dials() {
    let world = World::new();
    let (tell, task) = keep_announced_links(&world);
    let ip = |n: u8| format!("10.0.0.{n}");
    for n in 1..=20u8 {
        // Most announcements are false.
        let is = if n % 5 == 0 { Host::Up(60 * SECOND) } else { Host::Dead };
        world.set(&ip(n), is);
        let addresses = vec![SocketAddr::from(([10, 0, 0, n], 7447))];
        tell.send(Sighting::Announced { instance: n.to_string(), addresses }).await.unwrap();
    }
    sleep(20 * SECOND).await;
    assert_eq!(world.up().len(), mdns::LINKS_MAX);
    assert!(world.dials.lock().unwrap().0 <= mdns::DIALS_MAX);
    // While two links are up, no other router is dialled.
    let before = world.dialled().len();
    sleep(10 * SECOND).await;
    assert_eq!(world.dialled().len(), before);
    // A withdrawal ends no link. After the link ends, the router is not dialled again.
    let up = world.up();
    for n in 1..=20u8 {
        tell.send(Sighting::Vanished { instance: n.to_string() }).await.unwrap();
    }
    sleep(SECOND).await;
    assert_eq!(world.up(), up);
    sleep(120 * SECOND).await;
    assert_eq!((world.up(), world.dialled().len()), (vec![], before));
    task.abort();
}

#[tokio::test(start_paused = true)]
async fn a_router_that_is_reached_otherwise_is_dialled_again_when_it_no_longer_is() {
    let world = World::new();
    let (tell, task) = keep_announced_links(&world);
    world.set("10.0.0.1", Host::Reached(50 * SECOND));
    let addresses = vec![SocketAddr::from(([10, 0, 0, 1], 7447))];
    tell.send(Sighting::Announced { instance: "a".into(), addresses }).await.unwrap();
    sleep(40 * SECOND).await;
    assert_eq!(world.dialled().len(), 1);
    world.set("10.0.0.1", Host::Up(3600 * SECOND));
    sleep(20 * SECOND).await;
    assert_eq!((world.dialled().len(), world.up().len()), (2, 1));
    task.abort();
}
