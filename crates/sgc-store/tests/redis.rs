//! The driver on real servers: `redis-server` of Debian, alone and as a cluster of six, in network namespaces.
//!
//! Debian 12 has no Valkey. Where the distribution has it, `SGC_REDIS_SERVER=valkey-server` runs the same tests on it.

#![allow(missing_docs, clippy::unwrap_used)]

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use bytes::Bytes;
use rcgen::{BasicConstraints, CertificateParams, DnType, IsCa, Issuer, KeyPair};
use sgc_router::{
    BatchTag, StoreAction, StoreEvent, StoreFailure, StoreKey, StoreOp, StoreOpId, StoreReply, WriteIf,
};
use sgc_store::{
    Severity, StoreConfig, StoreFinding, StorePrefix, StoreServer, StoreTls, StoreUser, check, run,
};
use sgc_testkit::netsim::Namespace;
use sgc_testkit::redis::{Redis, RedisOptions, RedisTls, is_redis_installed};
use sgc_wire::{Name, NodeId};
use tempfile::TempDir;
use tokio::sync::mpsc;
use tokio::time::timeout;

const HOSTS: [&str; 6] = ["10.77.0.1", "10.77.0.2", "10.77.0.3", "10.77.0.4", "10.77.0.5", "10.77.0.6"];
/// Longest wait for an event.
const WAIT_MAX: Duration = Duration::from_secs(15);

static LABS: AtomicU32 = AtomicU32::new(0);

/// Servers, and the network of a router.
struct Lab {
    redis: Redis,
    router: Arc<Namespace>,
    _folder: TempDir,
}

impl Lab {
    fn new(make: impl FnOnce(Arc<Namespace>, &Path, RedisOptions) -> Redis) -> Self {
        assert!(is_redis_installed(), "no redis-server: scripts/install-deps.sh test");
        let number = LABS.fetch_add(1, Ordering::SeqCst);
        let name = |place| format!("sgcst-{}-{number}-{place}", std::process::id());
        let store = Arc::new(Namespace::create(name("store")).unwrap());
        let router = Arc::new(Namespace::create(name("router")).unwrap());
        let addresses: Vec<String> = HOSTS.iter().map(|host| format!("{host}/24")).collect();
        let addresses: Vec<&str> = addresses.iter().map(String::as_str).collect();
        store.veth(("eth0", &addresses), &router, ("eth0", &["10.77.0.100/24"])).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let options = RedisOptions {
            program: std::env::var("SGC_REDIS_SERVER").unwrap_or_else(|_| "redis-server".into()),
            ..RedisOptions::default()
        };
        let redis = make(store, folder.path(), options);
        Self { redis, router, _folder: folder }
    }

    fn cluster() -> Self {
        Self::new(|namespace, folder, options| Redis::cluster(namespace, folder, &HOSTS, options))
    }

    fn single() -> Self {
        Self::new(|namespace, folder, options| Redis::single(namespace, folder, HOSTS[0], options))
    }

    fn config(&self) -> StoreConfig {
        config(&self.redis.urls()[..1], None)
    }

    /// Runs a client in the network of the router.
    fn client<T: Send>(&mut self, scene: impl AsyncFnOnce(&mut Client, &mut Redis) -> T + Send) -> T {
        let config = self.config();
        self.client_with(config, scene)
    }

    fn client_with<T: Send>(
        &mut self,
        config: StoreConfig,
        scene: impl AsyncFnOnce(&mut Client, &mut Redis) -> T + Send,
    ) -> T {
        let redis = &mut self.redis;
        self.router
            .within(|| {
                // The driver runs while the scene waits for programs.
                let namespace = self.router.clone();
                let runtime = tokio::runtime::Builder::new_multi_thread()
                    .worker_threads(1)
                    .on_thread_start(move || namespace.enter().unwrap())
                    .enable_all()
                    .build()
                    .unwrap();
                runtime.block_on(async {
                    let mut client = Client::start(config);
                    let result = scene(&mut client, redis).await;
                    client.end().await;
                    result
                })
            })
            .unwrap()
    }
}

fn config(urls: &[String], user: Option<StoreUser>) -> StoreConfig {
    let servers = urls.iter().map(|url| StoreServer::parse(url).unwrap()).collect();
    StoreConfig::new(servers, StorePrefix::new("fleet-a").unwrap(), user, None).unwrap()
}

/// The driver, with the events that it has sent.
struct Client {
    ops: Option<mpsc::Sender<StoreOp>>,
    events: mpsc::Receiver<StoreEvent>,
    task: tokio::task::JoinHandle<()>,
    next: u64,
    /// Events that nobody has waited for yet.
    seen: Vec<StoreEvent>,
}

impl Client {
    fn start(config: StoreConfig) -> Self {
        let (ops, ops_receiver) = mpsc::channel(1024);
        let (events_sender, events) = mpsc::channel(1024);
        let task = tokio::spawn(run(config, ops_receiver, events_sender));
        Self { ops: Some(ops), events, task, next: 0, seen: Vec::new() }
    }

    /// Ends the driver, which must end by itself and not panic.
    async fn end(&mut self) {
        self.ops = None;
        timeout(WAIT_MAX, &mut self.task).await.expect("the driver ends").expect("the driver does not panic");
    }

    /// Waits for an event, also among those seen before, and removes it.
    async fn wait(&mut self, what: &str, mut is_it: impl FnMut(&StoreEvent) -> bool) -> StoreEvent {
        if let Some(at) = self.seen.iter().position(&mut is_it) {
            return self.seen.remove(at);
        }
        let found = timeout(WAIT_MAX, async {
            loop {
                let event = self.events.recv().await.expect("the driver runs");
                if is_it(&event) {
                    return event;
                }
                self.seen.push(event);
            }
        });
        found.await.unwrap_or_else(|_| panic!("not within {WAIT_MAX:?}: {what}"))
    }

    async fn up(&mut self) {
        self.wait("the store is up", |event| *event == StoreEvent::Up).await;
    }

    async fn down(&mut self) {
        self.wait("the store is down", |event| *event == StoreEvent::Down).await;
    }

    async fn changed(&mut self, key: StoreKey) {
        self.wait("a key changed", |event| *event == StoreEvent::Changed(key)).await;
    }

    async fn begin(&mut self, key: StoreKey, action: StoreAction) -> StoreOpId {
        let id = StoreOpId(self.next);
        self.next += 1;
        self.ops.as_ref().unwrap().send(StoreOp { id, key, action }).await.unwrap();
        id
    }

    async fn result(&mut self, id: StoreOpId) -> Result<StoreReply, StoreFailure> {
        let is_it = |event: &StoreEvent| matches!(event, StoreEvent::Reply { id: of, .. } if *of == id);
        match self.wait("an operation ends", is_it).await {
            StoreEvent::Reply { result, .. } => result,
            _ => unreachable!(),
        }
    }

    async fn try_op(&mut self, key: StoreKey, action: StoreAction) -> Result<StoreReply, StoreFailure> {
        let id = self.begin(key, action).await;
        self.result(id).await
    }

    async fn op(&mut self, key: StoreKey, action: StoreAction) -> StoreReply {
        self.try_op(key, action).await.unwrap()
    }

    /// Repeats an operation until it succeeds. Returns the time that it took.
    async fn until_done(&mut self, key: StoreKey, action: &StoreAction) -> Duration {
        let begin = Instant::now();
        while self.try_op(key, action.clone()).await.is_err() {
            assert!(begin.elapsed() < WAIT_MAX, "no operation succeeds");
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
        begin.elapsed()
    }

    async fn value(&mut self, key: StoreKey) -> Option<Bytes> {
        match self.op(key, StoreAction::Read).await {
            StoreReply::Value(value) => value,
            other => panic!("{other:?}"),
        }
    }
}

fn name(number: u32) -> StoreKey {
    let mut id = [0xf0; 32];
    // Spread over the slots.
    id[..4].copy_from_slice(&number.wrapping_mul(0x9e37_79b9).to_be_bytes());
    StoreKey::Name(Name(id))
}

fn write(value: impl Into<Bytes>, condition: WriteIf) -> StoreAction {
    StoreAction::Write { value: value.into(), lifetime: None, condition }
}

const fn written(existed: bool) -> StoreReply {
    StoreReply::Written { existed }
}

/// Carries out each operation with each of its results.
async fn all_operations(client: &mut Client) {
    client.up().await;
    // Keys of all kinds, in slots of all primaries.
    let owner = NodeId([7; 32]);
    let keys = (0..20)
        .map(name)
        .chain([StoreKey::Batch { owner, tag: BatchTag([b'\n'; 12]) }, StoreKey::Node(owner)]);
    for key in keys {
        assert_eq!(client.value(key).await, None);
        assert_eq!(client.op(key, write("one", WriteIf::Absent)).await, written(false));
        assert_eq!(client.op(key, write("two", WriteIf::Absent)).await, written(true));
        assert_eq!(client.value(key).await, Some("one".into()));
        assert_eq!(client.op(key, write("three", WriteIf::Always)).await, written(true));
        // Longer values take another command.
        let long = Bytes::from(vec![b'\r'; 20_000]);
        assert_eq!(client.op(key, write(long.clone(), WriteIf::Always)).await, written(true));
        assert_eq!(client.value(key).await, Some(long.clone()));
        assert_eq!(client.op(key, StoreAction::Remove { value: "other".into() }).await, StoreReply::Removed);
        assert_eq!(client.value(key).await, Some(long.clone()));
        assert_eq!(client.op(key, StoreAction::Remove { value: long.clone() }).await, StoreReply::Removed);
        assert_eq!(client.value(key).await, None);
        assert_eq!(client.op(key, write(long, WriteIf::Always)).await, written(false));
    }
    // Values end by themselves, and their end is reported.
    for (number, value, condition) in [
        (97, Bytes::from_static(b"short"), WriteIf::Absent),
        (98, Bytes::from_static(b"short"), WriteIf::Always),
        (99, Bytes::from(vec![1; 1000]), WriteIf::Always),
    ] {
        let key = name(number);
        let lifetime = Some(Duration::from_millis(100));
        assert_eq!(client.op(key, StoreAction::Write { value, lifetime, condition }).await, written(false));
        assert!(client.value(key).await.is_some());
        client.changed(key).await;
        assert_eq!(client.value(key).await, None);
    }
}

#[test]
fn single_server_carries_out_all_operations() {
    Lab::single().client(async |client, _| all_operations(client).await);
}

#[test]
fn cluster_carries_out_all_operations() {
    Lab::cluster().client(async |client, redis| {
        all_operations(client).await;
        let sizes = (0..3).map(|index| redis.cli(index, &["DBSIZE"]).trim().parse::<u32>().unwrap());
        assert!(sizes.clone().all(|size| size > 0), "each primary has keys");
    });
}

/// Two clients: the first reads, the second writes.
#[test]
fn changes_by_others_are_reported_once_for_each_read() {
    let mut lab = Lab::cluster();
    let config = lab.config();
    lab.client(async |reader, _| {
        let mut writer = Client::start(config);
        reader.up().await;
        writer.up().await;
        let keys: Vec<StoreKey> = (0..50).map(name).collect();
        for round in 0..3 {
            for key in &keys {
                reader.value(*key).await;
            }
            for key in &keys {
                writer.op(*key, write(format!("{round}"), WriteIf::Always)).await;
            }
            for key in &keys {
                reader.changed(*key).await;
            }
        }
        // Nobody has read these since.
        for key in &keys {
            writer.op(*key, write("unread", WriteIf::Always)).await;
        }
        reader.value(keys[0]).await;
        assert_eq!(reader.seen, []);
        assert_eq!(writer.seen, [], "own writes of keys that were not read");
        writer.end().await;
    });
}

#[test]
fn flushed_server_is_up_again() {
    let mut lab = Lab::single();
    lab.client(async |client, redis| {
        client.up().await;
        client.value(name(1)).await;
        redis.cli(0, &["FLUSHALL"]);
        client.up().await;
    });
}

/// Returns a name in a slot of a server.
fn name_of(redis: &Redis, seen_by: usize, server: usize) -> StoreKey {
    let key = (0..).map(name).find(|key| redis.owner(seen_by, usize::from(slot_of(*key))) == Some(server));
    key.unwrap()
}

fn slot_of(key: StoreKey) -> u16 {
    let bytes = match &key {
        StoreKey::Name(name) => [b"fleet-a:n:".as_slice(), &name.0].concat(),
        StoreKey::Batch { owner, tag } => [b"fleet-a:b:".as_slice(), &owner.0, &tag.0].concat(),
        StoreKey::Node(node) => [b"fleet-a:l:".as_slice(), &node.0].concat(),
    };
    slot(&bytes)
}

/// CRC-16/XMODEM modulo 16384.
fn slot(key: &[u8]) -> u16 {
    let step = |crc: u16, byte: &u8| {
        (0..8).fold(crc ^ (u16::from(*byte) << 8), |crc, _| (crc << 1) ^ ((crc >> 15) * 0x1021))
    };
    key.iter().fold(0, step) % 16_384
}

#[test]
fn replica_takes_over_from_a_killed_primary() {
    let mut lab = Lab::cluster();
    lab.client(async |client, redis| {
        client.up().await;
        let (lost, other) = (name_of(redis, 0, 0), name_of(redis, 0, 1));
        assert_eq!(client.op(lost, write("kept", WriteIf::Always)).await, written(false));
        assert_eq!(client.value(lost).await, Some("kept".into()));
        // The replica has it.
        redis.until("the replica has the key", |redis| redis.cli(3, &["DBSIZE"]).trim() == "1");
        client.seen.clear();
        redis.kill(0);
        client.down().await;
        assert_eq!(client.value(other).await, None, "the other servers answer");
        let took = client.until_done(lost, &write("new", WriteIf::Always)).await;
        // Everything that was tracked may have changed unnoticed.
        client.up().await;
        assert_eq!(client.value(lost).await, Some("new".into()));
        println!("operations succeed {took:?} after the failure was noticed");
        // The former primary comes back as a replica, which changes nothing.
        redis.restart(0);
        redis.until_complete();
        for key in [lost, other] {
            client.value(key).await;
        }
    });
}

#[test]
fn slots_move_while_keys_are_read_and_written() {
    let mut lab = Lab::cluster();
    lab.client(async |client, redis| {
        client.up().await;
        let present = name_of(redis, 1, 0);
        assert_eq!(client.op(present, write("before", WriteIf::Always)).await, written(false));
        client.value(present).await;
        client.seen.clear();
        let slot = slot_of(present);
        // A key of the slot that is written while it moves. `Batch` keys have room to look for one.
        let absent = (0_u64..).map(|tag| {
            let mut bytes = [0; 12];
            bytes[..8].copy_from_slice(&tag.to_be_bytes());
            StoreKey::Batch { owner: NodeId([1; 32]), tag: BatchTag(bytes) }
        });
        let absent = absent.into_iter().find(|key| slot_of(*key) == slot).unwrap();
        let steps: [&dyn Fn(&Redis); 3] =
            [&|redis| redis.begin_move(slot, 0, 1), &|redis| redis.move_keys(slot, 0, 1), &|redis| {
                redis.end_move(slot, 0, 1)
            }];
        for (step, carry_out) in steps.into_iter().enumerate() {
            // These are under way while the step is.
            let mut reads = Vec::new();
            for _ in 0..100 {
                reads.push(client.begin(present, StoreAction::Read).await);
            }
            carry_out(redis);
            for read in reads {
                assert_eq!(client.result(read).await, Ok(StoreReply::Value(Some("before".into()))), "{step}");
            }
            let existed = step > 0;
            assert_eq!(client.op(absent, write(format!("{step}"), WriteIf::Always)).await, written(existed));
            assert_eq!(client.value(absent).await, Some(format!("{step}").into()));
        }
        // The key may have changed at the new server while the old one had it for tracking.
        client.up().await;
        assert_eq!(client.value(present).await, Some("before".into()));
        assert_eq!(redis.owner(2, usize::from(slot)), Some(1));
    });
}

#[test]
fn primary_that_is_cut_off_is_replaced() {
    let mut lab = Lab::cluster();
    lab.client(async |client, redis| {
        client.up().await;
        let lost = name_of(redis, 0, 0);
        client.op(lost, write("kept", WriteIf::Always)).await;
        redis.until("the replica has the key", |redis| redis.cli(3, &["DBSIZE"]).trim() == "1");
        client.seen.clear();
        redis.cut(0);
        // Each operation ends in time, whatever its end.
        let begin = Instant::now();
        let _ = client.try_op(lost, StoreAction::Read).await;
        assert!(begin.elapsed() < Duration::from_millis(2500), "{:?}", begin.elapsed());
        client.down().await;
        let took = client.until_done(lost, &StoreAction::Read).await;
        println!("operations succeed {took:?} after the failure was noticed");
        client.up().await;
        assert_eq!(client.value(lost).await, Some("kept".into()));
        assert_eq!(client.op(lost, write("new", WriteIf::Always)).await, written(true));
        // The old primary returns and has the slots of nobody.
        redis.mend();
        redis.until_complete();
        assert_eq!(client.value(lost).await, Some("new".into()));
    });
}

#[test]
fn restarted_cluster_is_down_and_up_again() {
    let mut lab = Lab::cluster();
    lab.client(async |client, redis| {
        client.up().await;
        client.value(name(1)).await;
        client.seen.clear();
        (0..HOSTS.len()).for_each(|index| redis.kill(index));
        client.down().await;
        // Without any server, operations fail and do not wait for one.
        let begin = Instant::now();
        while begin.elapsed() < Duration::from_secs(2) {
            assert_eq!(client.try_op(name(1), StoreAction::Read).await, Err(StoreFailure::Unreachable));
        }
        let begin = Instant::now();
        assert_eq!(client.try_op(name(1), StoreAction::Read).await, Err(StoreFailure::Unreachable));
        assert!(begin.elapsed() < Duration::from_millis(500), "{:?}", begin.elapsed());
        assert!(!client.seen.contains(&StoreEvent::Up));
        (0..HOSTS.len()).for_each(|index| redis.restart(index));
        client.up().await;
        client.until_done(name(1), &write("again", WriteIf::Always)).await;
        assert_eq!(client.value(name(1)).await, Some("again".into()));
    });
}

const PASSWORD: &str = "correct-horse";

fn router_user(password: &str) -> StoreUser {
    StoreUser::new("router", password.as_bytes().to_vec()).unwrap()
}

#[test]
fn check_of_a_store_that_fits_finds_nothing_to_mend() {
    for mut lab in [Lab::single(), Lab::cluster()] {
        let config = lab.config();
        let report = lab.client(async |_, _| check(config.clone()).await);
        assert_eq!(report.severity(), Severity::Fits, "{report:#?}");
        assert!(matches!(report.findings.last(), Some(StoreFinding::Works { .. })), "{report:#?}");
    }
}

#[test]
fn check_of_a_store_that_is_gone_or_evicts_says_so() {
    let mut lab = Lab::single();
    let config = lab.config();
    lab.client(async |_, redis| {
        redis.cli(0, &["CONFIG", "SET", "maxmemory", "100mb"]);
        redis.cli(0, &["CONFIG", "SET", "maxmemory-policy", "allkeys-lru"]);
        let report = check(config.clone()).await;
        let is_error = |finding: &StoreFinding| finding.severity() == Severity::Error;
        let errors: Vec<_> = report.findings.iter().filter(|finding| is_error(finding)).collect();
        assert!(matches!(errors[..], [StoreFinding::Eviction { .. }]), "{report:#?}");
        redis.kill(0);
        let report = check(config.clone()).await;
        assert!(
            matches!(report.findings[..], [StoreFinding::ServerFails { is_refused: false, .. }]),
            "{report:#?}"
        );
    });
}

/// The fix of a refusal is a command with the least rights: with it, everything works.
#[test]
fn user_with_the_rights_that_a_check_names_can_do_everything_that_a_router_does() {
    let mut lab = Lab::cluster();
    let url = lab.redis.urls()[..1].to_vec();
    lab.client(async |_, redis| {
        let on_all = |redis: &mut Redis, command: &[&str]| {
            (0..HOSTS.len()).for_each(|index| assert_eq!(redis.cli(index, command).trim(), "OK"));
        };
        let wrong = check(config(&url, Some(router_user("wrong")))).await;
        assert!(
            matches!(wrong.findings[..], [StoreFinding::ServerFails { is_refused: true, .. }]),
            "{wrong:#?}"
        );
        let password = format!(">{PASSWORD}");
        on_all(redis, &["ACL", "SETUSER", "router", "on", &password, "+@connection", "+cluster"]);
        let of_user = config(&url, Some(router_user(PASSWORD)));
        let refused = check(of_user.clone()).await;
        let Some(finding @ StoreFinding::Refused { rights, .. }) = refused.findings.last() else {
            panic!("{refused:#?}");
        };
        assert!(finding.fix().is_some_and(|fix| fix.contains(rights)));
        let rights: Vec<_> = rights.split(' ').collect();
        on_all(redis, &rights);
        let report = check(of_user.clone()).await;
        assert!(matches!(report.findings.last(), Some(StoreFinding::Works { .. })), "{report:#?}");
        assert_eq!(report.severity(), Severity::Warning, "INFO and CONFIG are refused: {report:#?}");
        let mut client = Client::start(of_user);
        all_operations(&mut client).await;
        client.end().await;
        // Another fleet's keys are out of reach.
        let other = StoreConfig::new(
            vec![StoreServer::parse(&url[0]).unwrap()],
            StorePrefix::new("fleet-b").unwrap(),
            Some(router_user(PASSWORD)),
            None,
        );
        let mut client = Client::start(other.unwrap());
        client.up().await;
        assert_eq!(client.try_op(name(1), StoreAction::Read).await, Err(StoreFailure::Refused));
        client.end().await;
    });
}

/// A server of the test that answers the greeting, and then anything else with these bytes.
async fn lie(listener: tokio::net::TcpListener, bytes: &'static [u8]) {
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
    loop {
        let Ok((mut stream, _)) = listener.accept().await else { return };
        tokio::spawn(async move {
            let mut buffer = [0; 4096];
            let mut answers = 0;
            while let Ok(1..) = stream.read(&mut buffer).await {
                let answer: &[u8] = if answers < 2 { b"+OK\r\n" } else { bytes };
                answers += 1;
                if stream.write_all(answer).await.is_err() {
                    return;
                }
            }
        });
    }
}

#[test]
fn server_that_lies_costs_failed_operations_and_nothing_else() {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap();
    let answers: [&'static [u8]; 8] = [
        b"*-5\r\n",
        b"$99999999999\r\n",
        b"*1000000000\r\n",
        b"%1000000000\r\n",
        b">2\r\n$10\r\ninvalidate\r\n*1\r\n$3\r\nabc\r\n",
        b"$-1\r\n$-1\r\n$-1\r\n",
        b"-MOVED 99999 :0\r\n",
        b"\x00\xff\xfe\r\n",
    ];
    runtime.block_on(async {
        for answer in answers {
            let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
            let url = format!("valkey://{}", listener.local_addr().unwrap());
            let server = tokio::spawn(lie(listener, answer));
            let mut client = Client::start(config(&[url], None));
            let begin = Instant::now();
            let result = client.try_op(name(1), StoreAction::Read).await;
            assert!(!matches!(result, Ok(StoreReply::Value(Some(_)))), "{answer:?}: {result:?}");
            assert!(begin.elapsed() < Duration::from_secs(5), "{answer:?}: {:?}", begin.elapsed());
            client.end().await;
            server.abort();
        }
    });
}

/// The certificates of a test: a CA, one for all servers, and one for the router.
struct Certificates {
    ca: String,
    servers: [String; 2],
    router: [String; 2],
}

impl Certificates {
    fn new() -> Self {
        let ca_key = KeyPair::generate().unwrap();
        let mut params = CertificateParams::new(Vec::new()).unwrap();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        // OpenSSL takes a certificate whose issuer has its own name for one that signs itself.
        params.distinguished_name.push(DnType::CommonName, "CA of a store");
        let ca = params.self_signed(&ca_key).unwrap().pem();
        let issuer = Issuer::new(params, ca_key);
        let leaf = |names: &[&str]| {
            let key = KeyPair::generate().unwrap();
            let names = names.iter().map(|name| (*name).to_owned()).collect::<Vec<_>>();
            let certificate = CertificateParams::new(names).unwrap().signed_by(&key, &issuer).unwrap();
            [certificate.pem(), key.serialize_pem()]
        };
        Self { servers: leaf(&HOSTS), router: leaf(&["router"]), ca }
    }

    fn write(&self, folder: &Path) -> RedisTls {
        let write = |name: &str, text: &str| {
            let path = folder.join(name);
            std::fs::write(&path, text).unwrap();
            path
        };
        RedisTls {
            ca: write("ca.pem", &self.ca),
            certificate: write("server.pem", &self.servers[0]),
            key: write("server.key", &self.servers[1]),
        }
    }

    fn config(&self, urls: &[String], own: Option<&[String; 2]>) -> StoreConfig {
        let own = own.map(|[certificate, key]| (certificate.as_bytes(), key.as_bytes()));
        let tls = StoreTls::new(Some(self.ca.as_bytes()), own).unwrap();
        let servers = urls.iter().map(|url| StoreServer::parse(url).unwrap()).collect();
        StoreConfig::new(servers, StorePrefix::default(), None, Some(tls)).unwrap()
    }
}

#[test]
fn servers_with_tls_take_the_routers_of_their_ca_and_no_others() {
    let certificates = Certificates::new();
    let mut lab = Lab::new(|namespace, folder, options| {
        let options = RedisOptions { tls: Some(certificates.write(folder)), ..options };
        Redis::cluster(namespace, folder, &HOSTS, options)
    });
    let urls = lab.redis.urls()[..1].to_vec();
    assert!(urls[0].starts_with("valkeys://"), "{urls:?}");
    let good = certificates.config(&urls, Some(&certificates.router));
    lab.client_with(good.clone(), async |client, _| {
        all_operations(client).await;
        let report = check(good.clone()).await;
        assert_eq!(report.severity(), Severity::Fits, "{report:#?}");
        let strangers = Certificates::new();
        let refused = [
            certificates.config(&urls, None),
            certificates.config(&urls, Some(&strangers.router)),
            strangers.config(&urls, Some(&certificates.router)),
        ];
        for config in refused {
            let report = check(config).await;
            assert!(matches!(report.findings[..], [StoreFinding::ServerFails { .. }]), "{report:#?}");
        }
    });
}
