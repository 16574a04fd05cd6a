//! Tests that paths between real sockets have their configured properties. No test asserts an upper bound of time,
//! because the machine may be busy.

#![allow(clippy::unwrap_used)]

use std::io::{Read, Write};
use std::net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::time::{Duration, Instant};

use sgc_testkit::netsim::{
    Direction, Loss, Namespace, NetsimError, Profile, QueueLimit, Reorder, TcpRelay, TunEnd, TunLink,
    TunOptions, UdpRelay, on_host,
};
use sgc_testkit::unused_port;

const PATIENCE: Duration = Duration::from_secs(30);
/// Time without a datagram after which it counts as lost, once the relay has counted all.
const SILENCE: Duration = Duration::from_millis(200);

fn any_port() -> SocketAddr {
    (Ipv4Addr::LOCALHOST, 0).into()
}

fn udp() -> UdpSocket {
    let socket = UdpSocket::bind(any_port()).unwrap();
    socket.set_read_timeout(Some(PATIENCE)).unwrap();
    socket
}

/// A relay, the socket that dials it, and the one behind it.
fn udp_path(profile: Profile) -> (UdpRelay, UdpSocket, UdpSocket) {
    let (client, server) = (udp(), udp());
    let relay = UdpRelay::start(any_port(), server.local_addr().unwrap(), [profile; 2], 3).unwrap();
    client.connect(relay.local()).unwrap();
    (relay, client, server)
}

fn receive(socket: &UdpSocket) -> (Vec<u8>, SocketAddr) {
    let mut buffer = [0; 2048];
    let (bytes, from) = socket.recv_from(&mut buffer).unwrap();
    (buffer[..bytes].to_vec(), from)
}

#[test]
fn datagrams_go_both_ways_and_take_their_time() {
    let delay = Duration::from_millis(30);
    let (relay, client, server) = udp_path(Profile { delay, ..Profile::default() });
    let begun = Instant::now();
    client.send(b"there").unwrap();
    let (said, from) = receive(&server);
    assert_eq!(said, b"there");
    server.send_to(b"and back", from).unwrap();
    assert_eq!(receive(&client).0, b"and back");
    assert!(begun.elapsed() >= 2 * delay);
    assert_eq!(relay.counters(Direction::Forth).passed, 1);
    assert_eq!(relay.counters(Direction::Back).passed, 1);
}

#[test]
fn rebinding_changes_the_port_that_is_seen() {
    let (relay, client, server) = udp_path(Profile::default());
    client.send(b"1").unwrap();
    let before = receive(&server).1;
    relay.rebind();
    // The first datagram may still use the old port.
    let deadline = Instant::now() + PATIENCE;
    let after = loop {
        client.send(b"2").unwrap();
        let from = receive(&server).1;
        if from != before {
            break from;
        }
        assert!(Instant::now() < deadline, "always from {before}");
    };
    server.send_to(b"3", after).unwrap();
    assert_eq!(receive(&client).0, b"3");
}

#[test]
fn a_cut_path_passes_nothing_until_it_is_restored() {
    let (relay, client, server) = udp_path(Profile::default());
    relay.cut();
    client.send(b"lost").unwrap();
    let deadline = Instant::now() + PATIENCE;
    while relay.counters(Direction::Forth).cut == 0 {
        assert!(Instant::now() < deadline, "nothing is dropped");
        std::thread::sleep(Duration::from_millis(1));
    }
    relay.restore();
    client.send(b"kept").unwrap();
    assert_eq!(receive(&server).0, b"kept");
}

#[test]
fn relay_counts_lost_datagrams() {
    let profile = Profile { loss: Loss::Random(0.5), ..Profile::default() };
    let (relay, client, server) = udp_path(profile);
    for _ in 0..200 {
        client.send(b"x").unwrap();
    }
    let deadline = Instant::now() + PATIENCE;
    while relay.counters(Direction::Forth).passed + relay.counters(Direction::Forth).lost < 200 {
        assert!(Instant::now() < deadline, "{:?}", relay.counters(Direction::Forth));
        std::thread::sleep(Duration::from_millis(1));
    }
    server.set_read_timeout(Some(SILENCE)).unwrap();
    let mut buffer = [0; 16];
    let mut arrived = 0;
    while server.recv(&mut buffer).is_ok() {
        arrived += 1;
    }
    let counters = relay.counters(Direction::Forth);
    assert_eq!((counters.packets, counters.passed), (200, arrived));
    assert!((60..140).contains(&counters.lost), "{counters:?}");
}

#[test]
fn streams_pass_whole_at_the_rate_and_end() {
    let listener = TcpListener::bind(any_port()).unwrap();
    // 500 kB at 8 Mbit/s are half a second, whatever the queue. Loss is left out.
    let profile = Profile {
        rate: Some(8_000_000),
        queue: QueueLimit::Bytes(20_000),
        loss: Loss::Random(0.5),
        reorder: Reorder { share: 0.5, by: Duration::from_millis(5) },
        ..Profile::default()
    };
    let to = listener.local_addr().unwrap();
    let relay = TcpRelay::start(any_port(), to, [profile; 2], 1).unwrap();
    let sent: Vec<u8> = (0..500_000u32).map(|n| (n % 251) as u8).collect();
    let begun = Instant::now();
    let (there, back) = std::thread::scope(|scope| {
        scope.spawn(|| {
            let (mut stream, _) = listener.accept().unwrap();
            let mut got = Vec::new();
            stream.read_to_end(&mut got).unwrap();
            stream.write_all(&got[..1000]).unwrap();
            drop(stream);
            assert!(got == sent, "{} bytes come out", got.len());
        });
        let mut stream = TcpStream::connect(relay.local()).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        stream.write_all(&sent).unwrap();
        stream.shutdown(std::net::Shutdown::Write).unwrap();
        let mut back = Vec::new();
        stream.read_to_end(&mut back).unwrap();
        (begun.elapsed(), back)
    });
    assert_eq!(back, sent[..1000]);
    assert!(there >= Duration::from_millis(450), "{there:?}");
    let counters = relay.counters(Direction::Forth);
    assert_eq!((counters.bytes, counters.lost, counters.overflowed), (500_000, 0, 0));
}

#[test]
fn a_stream_to_nowhere_is_closed() {
    let nowhere = (Ipv4Addr::LOCALHOST, unused_port()).into();
    let relay = TcpRelay::start(any_port(), nowhere, [Profile::default(); 2], 1).unwrap();
    let mut stream = TcpStream::connect(relay.local()).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    assert!(matches!(stream.read(&mut [0; 1]), Ok(0) | Err(_)));
}

fn name(suffix: &str) -> String {
    format!("sgcsim-{}-{suffix}", std::process::id())
}

fn end(namespace: &Namespace, address: &str) -> TunEnd {
    TunEnd {
        namespace: Some(namespace.name().to_owned()),
        interface: "path0".into(),
        addresses: vec![address.into(), address.replace("10.93.0.", "fd93::").replace("/24", "/64")],
        routes: Vec::new(),
    }
}

/// Tests a path between two namespaces that changes while it runs, in one test because of the cost of namespaces.
#[test]
fn sockets_in_two_namespaces_meet_the_path() {
    if let Err(why) = on_host() {
        let _ = writeln!(
            std::io::stderr(),
            "NO NAMESPACES OR TUN DEVICES ({why}): the path between them is not tested"
        );
        return;
    }
    let (left, right) = (Namespace::create(name("l")).unwrap(), Namespace::create(name("r")).unwrap());
    let delay = Duration::from_millis(20);
    let slow = Profile { delay, ..Profile::default() };
    let options = TunOptions { mtu: 1280, profiles: [slow; 2], seed: 5 };
    let path = TunLink::start([end(&left, "10.93.0.1/24"), end(&right, "10.93.0.2/24")], &options).unwrap();

    for address in ["10.93.0.2:7000", "[fd93::2]:7000"] {
        let address: SocketAddr = address.parse().unwrap();
        let server = right.within(|| UdpSocket::bind(address).unwrap()).unwrap();
        server.set_read_timeout(Some(PATIENCE)).unwrap();
        let client = left.within(|| {
            let client = UdpSocket::bind(if address.is_ipv4() { "0.0.0.0:0" } else { "[::]:0" }).unwrap();
            client.connect(address).unwrap();
            client
        });
        let client = client.unwrap();
        client.set_read_timeout(Some(PATIENCE)).unwrap();
        let begun = Instant::now();
        client.send(b"there").unwrap();
        let (said, from) = receive(&server);
        assert_eq!(said, b"there");
        server.send_to(b"back", from).unwrap();
        assert_eq!(receive(&client).0, b"back");
        assert!(begun.elapsed() >= 2 * delay, "faster than the path");
    }

    // Kernel TCP recovers from loss on the path. Both ends check a megabyte.
    let lossy = Profile { loss: Loss::Random(0.02), ..Profile::default() };
    Direction::BOTH.into_iter().for_each(|direction| path.set(direction, lossy));
    let listener = right.within(|| TcpListener::bind("10.93.0.2:7001").unwrap()).unwrap();
    let sent: Vec<u8> = (0..1_000_000u32).map(|n| (n % 251) as u8).collect();
    std::thread::scope(|scope| {
        let reader = scope.spawn(|| {
            let mut got = Vec::new();
            listener.accept().unwrap().0.read_to_end(&mut got).unwrap();
            got
        });
        let stream = left.within(|| TcpStream::connect("10.93.0.2:7001").unwrap()).unwrap();
        (&stream).write_all(&sent).unwrap();
        drop(stream);
        assert!(reader.join().unwrap() == sent);
    });
    let counters = path.counters(Direction::Forth);
    assert!(counters.lost > 0, "{counters:?}");

    let again = TunLink::start([end(&left, "10.94.0.1/24"), end(&right, "10.94.0.2/24")], &options);
    assert!(matches!(again, Err(NetsimError::Tun(..))), "a device of that name is there");
}

#[test]
fn a_namespace_that_is_not_there_is_named() {
    let ends = ["left", "right"].map(|end| TunEnd {
        namespace: Some(format!("sgcsim-none-{end}")),
        interface: "path0".into(),
        ..TunEnd::default()
    });
    let Err(error) = TunLink::start(ends, &TunOptions::default()) else { panic!("it starts") };
    assert!(matches!(&error, NetsimError::NoNamespace(name) if name == "sgcsim-none-left"), "{error}");
}
