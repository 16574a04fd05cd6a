//! Overload over real QUIC: whole nodes with more traffic than limits or links permit.

#![allow(clippy::unwrap_used)]

#[path = "support/lab.rs"]
mod lab;
mod support;

use std::net::UdpSocket;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering::SeqCst};
use std::sync::mpsc::channel;
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use lab::{Lab, Stream};
use sgc_node::config::{Config, QosOverride, Recipient, Shaping, ShareConfig, ShareMetadata, UseConfig};
use sgc_trust::Suite;
use sgc_wire::{Class, History, Qos, Reliability};
use support::*;

/// Returns a reliable QoS that keeps all messages.
fn all() -> Qos {
    Qos { history: History::KeepAll, ..Qos::default() }
}

fn best_effort() -> Qos {
    Qos { reliability: Reliability::BestEffort, ..all() }
}

/// Returns a counter of a node's links to a peer.
fn count_for_peer(node: &Node, peer: &str, what: &str) -> u64 {
    let status = node.status();
    let links = status["links"].as_array().unwrap().iter();
    links.filter(|l| l["peer"] == peer).map(|l| l[what].as_u64().unwrap()).sum()
}

#[test]
fn a_peer_over_its_rate_is_slowed_where_it_can_wait_and_loses_what_cannot() {
    const RATE: u64 = 2_000_000;
    let trio = Trio::new();
    let cloud = trio.cloud_with(|config: &mut Config| config.peer_rate = Some(RATE));
    let _robot = trio.robot(&["/slow", "/fast"], "desk");
    let _desk = trio.desk(&["/slow", "/fast"]);
    let slow = Talker::new(&trio.robot_net, "/slow", all());
    let fast = Talker::new(&trio.robot_net, "/fast", best_effort());
    let hears_slow = Listener::new(&trio.desk_net, "/slow", all());
    let hears_fast = Listener::new(&trio.desk_net, "/fast", best_effort());
    for (talker, listener) in [(&slow, &hears_slow), (&fast, &hears_fast)] {
        talker.wait_for_readers(1);
        listener.hears_at_last(|n| talker.say(format!("warm {n}")));
    }
    let [robots, desks] = ["robot", "desk"].map(|node| identity(node, false).node_id().to_string());
    let over = |peer: &str| {
        (count_for_peer(&cloud, peer, "peer_slowed"), count_for_peer(&cloud, peer, "peer_dropped"))
    };
    assert_eq!((over(&robots), over(&desks)), ((0, 0), (0, 0)));

    // Reliable messages all arrive, in order and at the permitted rate. Half a second's worth may have been saved up.
    let begun = Instant::now();
    let payload = |n: u8| vec![n; 25_000];
    (0..40).for_each(|n| slow.say(payload(n)));
    let mut next = 0;
    while next < 40 {
        let heard = hears_slow.samples.recv_timeout(PATIENCE).expect("all arrive");
        if heard.len() == 25_000 {
            assert_eq!(heard[0], next);
            next += 1;
        }
    }
    let least = Duration::from_millis((1_000_000 - 262_144) * 8000 / RATE);
    assert!(begun.elapsed() >= least, "1 MB in {:?}", begun.elapsed());
    let (slowed, dropped) = over(&robots);
    assert!(slowed > 0 && dropped == 0, "{slowed} slowed, {dropped} dropped");

    // Best-effort messages beyond the rate are dropped, and counted under the peer's name.
    let deadline = Instant::now() + PATIENCE;
    let mut said = 0;
    while over(&robots).1 == 0 {
        assert!(Instant::now() < deadline, "nothing is dropped");
        for _ in 0..100 {
            fast.say(vec![9; 1000]);
            said += 1;
        }
    }
    let dropped = over(&robots).1;
    assert!(hears_fast.drain().len() as u64 + dropped <= said + 100);
    let drops = cloud.status()["drops"].clone();
    assert!(drops["over_rate"].as_u64().unwrap() >= dropped, "{drops}");
    assert!(drops[format!("over_rate from {}", &robots[..8])].as_u64().unwrap() >= dropped, "{drops}");
    assert_eq!(over(&desks), (0, 0));
}

/// Starts a path to a router with this bandwidth towards it, and a buffer for a tenth of a second.
fn narrow(router: u16, bits_per_second: u64) -> u16 {
    let (near, far) = (UdpSocket::bind("127.0.0.1:0").unwrap(), UdpSocket::bind("127.0.0.1:0").unwrap());
    far.connect(("127.0.0.1", router)).unwrap();
    let port = near.local_addr().unwrap().port();
    let (near_too, far_too) = (near.try_clone().unwrap(), far.try_clone().unwrap());
    let (queue, queued) = channel::<Vec<u8>>();
    let waiting = Arc::new(AtomicUsize::new(0));
    let (client, left) = (Arc::new(OnceLock::new()), waiting.clone());
    let client_too = client.clone();
    std::thread::spawn(move || {
        let mut buffer = [0; 65_536];
        while let Ok((n, from)) = near.recv_from(&mut buffer) {
            let _ = client.set(from);
            if waiting.load(SeqCst) as u64 <= bits_per_second / 80 {
                waiting.fetch_add(n, SeqCst);
                let _ = queue.send(buffer[..n].to_vec());
            }
        }
    });
    std::thread::spawn(move || {
        let mut free = Instant::now();
        for datagram in queued {
            free = free.max(Instant::now())
                + Duration::from_nanos(datagram.len() as u64 * 8_000_000_000 / bits_per_second);
            std::thread::sleep(free.saturating_duration_since(Instant::now()));
            left.fetch_sub(datagram.len(), SeqCst);
            let _ = far.send(&datagram);
        }
    });
    std::thread::spawn(move || {
        let mut buffer = [0; 65_536];
        while let Ok(n) = far_too.recv(&mut buffer) {
            let _ = near_too.send_to(&buffer[..n], client_too.get().unwrap());
        }
    });
    port
}

struct Ends<'a>(&'a AtomicBool);

impl Drop for Ends<'_> {
    fn drop(&mut self) {
        self.0.store(true, SeqCst);
    }
}

#[test]
fn commands_overtake_images_on_a_full_link() {
    const IMAGE_BYTES: usize = 1_000_000;
    /// Images on the link that are not delivered when the first command leaves.
    const BACKLOG: u64 = 5;
    let mut trio = Trio::new();
    let _cloud = trio.cloud();
    let desk = trio.desk(&["/image", "/video", "/cmd_vel"]);
    trio.port = narrow(trio.port, 40_000_000);
    let share = |(topic, priority): (&str, Class)| ShareConfig {
        dead_man: None,
        interface: Default::default(),
        topic: topic.into(),
        naming: Default::default(),
        type_name: None,
        to: vec![Recipient::Node("desk".parse().unwrap())],
        publish: vec![],
        priority,
        shaping: Shaping::default(),
        qos: QosOverride::default(),
        dedicated: false,
        suite: Suite::Group,
        metadata: ShareMetadata::default(),
    };
    let shares = [("/image", Class::Bulk), ("/video", Class::Bulk), ("/cmd_vel", Class::Realtime)];
    let config = Config { shares: shares.into_iter().map(share).collect(), ..trio.config() };
    let robot = Node::start(config, identity("robot", false), Some(&trio.robot_net));
    let begin = |topic, qos: fn() -> Qos| {
        let talker = Talker::new(&trio.robot_net, topic, qos());
        let listener = Listener::new(&trio.desk_net, topic, qos());
        talker.wait_for_readers(1);
        listener.hears_at_last(|n| talker.say(format!("warm {n}")));
        (talker, listener)
    };
    let (images, hears_images) = begin("/image", all);
    let (videos, hears_videos) = begin("/video", best_effort);
    let (commands, hears_commands) = begin("/cmd_vel", all);

    let numbered = |n: u64| {
        let mut image = vec![0; IMAGE_BYTES];
        image[..8].copy_from_slice(&n.to_be_bytes());
        image
    };
    let (said, heard) = (AtomicU64::new(0), AtomicU64::new(0));
    let is_over = AtomicBool::new(false);
    let (said, heard, is_over) = (&said, &heard, &is_over);
    std::thread::scope(|scope| {
        // The guard ends the threads on a failure as well, since the scope waits for them.
        let end = Ends(is_over);
        // Reliable images are sent as fast as they are taken.
        scope.spawn(|| {
            while !is_over.load(SeqCst) {
                let n = said.load(SeqCst);
                images.say(numbered(n));
                said.store(n + 1, SeqCst);
            }
        });
        // Best-effort images are sent at four times the link's bandwidth.
        scope.spawn(|| {
            while !is_over.load(SeqCst) {
                videos.say(numbered(0));
                std::thread::sleep(Duration::from_millis(50));
            }
        });
        // Every image arrives, in order.
        scope.spawn(move || {
            while !is_over.load(SeqCst) || heard.load(SeqCst) < said.load(SeqCst) {
                match hears_images.samples.recv_timeout(PATIENCE) {
                    Ok(image) if image.len() == IMAGE_BYTES => {
                        let n = u64::from_be_bytes(image[..8].try_into().unwrap());
                        assert_eq!(n, heard.fetch_add(1, SeqCst));
                    }
                    Ok(_) => {}
                    Err(_) => panic!("{} of {} images", heard.load(SeqCst), said.load(SeqCst)),
                }
            }
        });
        wait("a backlog", || said.load(SeqCst) >= heard.load(SeqCst) + BACKLOG && heard.load(SeqCst) > 0);
        let (mut overtaken, mut waited) = (0, 0);
        const COMMANDS: u64 = 30;
        for n in 0..COMMANDS {
            let (before, given) = (heard.load(SeqCst), said.load(SeqCst));
            commands.say(format!("command {n}"));
            loop {
                let command = hears_commands.samples.recv_timeout(PATIENCE).expect("each command arrives");
                if command == format!("command {n}").as_bytes() {
                    break;
                }
                assert!(n == 0 && command.starts_with(b"warm"), "{command:?} instead of {n}");
            }
            let after = heard.load(SeqCst);
            waited += after - before;
            overtaken += given.saturating_sub(after);
        }
        // Six images' worth of the same class would have to share the link with both kinds of images.
        let before = heard.load(SeqCst);
        const PARTS: usize = 60;
        (0..PARTS).for_each(|_| commands.say(vec![7; 100_000]));
        for _ in 0..PARTS {
            let part = hears_commands.samples.recv_timeout(PATIENCE).expect("each part arrives");
            assert_eq!(part.len(), 100_000);
        }
        let beside = heard.load(SeqCst) - before;
        drop(end);
        assert!(beside <= 2, "{beside} images arrived while 6 MB of realtime messages were under way");
        // The network's own queue drains meanwhile, half an image at most, and the two images under way.
        assert!(waited <= COMMANDS, "{waited} images arrived while {COMMANDS} commands were under way");
        assert!(overtaken >= 2 * COMMANDS, "{COMMANDS} commands overtook {overtaken} images");
    });
    // The newest best-effort images get through beside the reliable ones.
    let videos = hears_videos.drain().iter().filter(|v| v.len() == IMAGE_BYTES).count();
    assert!(videos >= 4, "{videos} videos beside {} images", heard.load(SeqCst));
    drop((robot, desk));
}

#[test]
fn an_owner_sends_no_more_than_its_most_demanding_subscriber_wants() {
    const HOUR: Option<Duration> = Some(Duration::from_secs(3600));
    let lab = Lab::new(&["robot", "desk", "recorder"]);
    let _cloud = lab.cloud();
    let robot = lab.start("robot", |c| c.shares = vec![lab::share("/scan", &["desk", "recorder"])]);
    let uses = |interval| {
        let shaping = Shaping { interval, ..Shaping::default() };
        vec![UseConfig { shaping, ..lab::uses("/scan") }]
    };
    let desk = lab.start("desk", |c| c.uses = uses(HOUR));
    let stream = Stream::start(lab.talker("robot", "/scan"));
    let sent = || robot.status()["routes"][0]["messages"].as_u64().unwrap();
    let sends_nothing = || {
        let (before, said) = (sent(), stream.said());
        wait("more is said", || stream.said() > said + 100);
        sent() == before
    };
    let (desk_hears, recorder_hears) = (lab.listener("desk", "/scan"), lab.listener("recorder", "/scan"));
    desk_hears.samples.recv_timeout(PATIENCE).expect("the first one");
    wait("the robot sends no more than the desk wants", sends_nothing);

    // A subscriber that wants everything gets everything, whatever the other one wants.
    let recorder = lab.start("recorder", |c| c.uses = uses(None));
    let first = recorder_hears.samples.recv_timeout(PATIENCE).expect("everything");
    let first: u64 = std::str::from_utf8(&first).unwrap().parse().unwrap();
    lab::hears_each(&recorder_hears, first + 1, first + 200);
    assert!(desk_hears.drain().len() <= 1, "the desk has its own limit");

    // It goes, or the desk wants more.
    recorder.stop();
    wait("the robot sends no more than the desk wants", sends_nothing);
    desk.reload(|c| c.uses = uses(None));
    let before = sent();
    wait("the robot sends everything", || sent() > before + 200);
    stream.end();
}
