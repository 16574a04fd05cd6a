//! A robot and a desk behind a NAT each, and a router with a public address between them; every one a network
//! namespace. A carrier with a NAT of its own may stand before the NATs. All of it goes with the lab.
//!
//! ```text
//! robot ─ eth0 ──── lan ─ near ─ wan ──── cloud ──── wan ─ far ─ lan ──── eth0 ─ desk
//!       ─ lte ───── lte ─┘                10.10.0.1
//! ```

use std::fs;
use std::io::Write as _;
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Once};
use std::time::{SystemTime, UNIX_EPOCH};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use rand_core::{OsRng, TryRngCore as _};
use sgc_testkit::netsim::{Namespace, TunEnd, TunLink, TunOptions};
use sgc_transport::LinkUrl;
use sgc_trust::{EnrollRequest, Fleet, Identity};
use sgc_wire::UnixMillis;
use tempfile::TempDir;

use crate::support::say;

/// All transports. Those that this build lacks are reported and skipped.
const SCHEMES: [&str; 7] = ["quic", "dtls", "udp", "tls", "tcp", "ws", "wss"];
const PORT: u16 = 7447;
const ROUTER: &str = "10.10.0.1";
const ROUTER_V6: &str = "2001:db8:10::1";

static LABS: AtomicU32 = AtomicU32::new(0);

/// Transports of this build.
pub(crate) fn schemes() -> Vec<&'static str> {
    let is_known = |scheme: &str| format!("{scheme}://router").parse::<LinkUrl>().is_ok();
    let (known, unknown): (Vec<_>, Vec<_>) = SCHEMES.into_iter().partition(|scheme| is_known(scheme));
    if !unknown.is_empty() {
        static SAID: Once = Once::new();
        SAID.call_once(|| say(&format!("NOT IN THIS BUILD, so not tested: {}", unknown.join(", "))));
    }
    known
}

/// The port mapping of a NAT.
#[derive(Clone, Copy)]
pub(crate) enum Nat {
    /// Keeps ports and admits any sender to them.
    FullCone,
    /// Keeps ports and admits the addresses of contacted senders.
    AddressRestricted,
    /// Draws each port at random from this range and admits only contacted senders.
    RandomPort(&'static str),
    /// Keeps ports and admits only contacted senders.
    PortRestricted,
    /// No NAT, and a firewall that admits only contacted senders.
    Firewall,
    /// No NAT and no firewall.
    Public,
}

/// The NAT of a carrier.
#[derive(Clone, Copy)]
pub(crate) enum Carrier {
    /// Keeps ports and admits only contacted senders.
    PortRestricted,
    /// Keeps ports and admits any sender to them from outside.
    NoHairpin,
    /// Keeps ports and admits any sender to them, also from inside.
    Hairpin,
}

/// Ranges for a NAT that forgets.
pub(crate) const RANGES: [&str; 2] = ["20000-29999", "30000-39999"];

/// The network between the robot and its NAT.
pub(crate) enum Lan {
    Cable,
    Path(TunOptions),
}

pub(crate) struct Lab {
    number: u32,
    dir: TempDir,
    fleet: Fleet,
    path: Option<TunLink>,
    has_ipv6: bool,
    carrier: Option<Arc<Namespace>>,
    pub(crate) robot: Arc<Namespace>,
    pub(crate) near: Arc<Namespace>,
    pub(crate) cloud: Arc<Namespace>,
    pub(crate) far: Arc<Namespace>,
    pub(crate) desk: Arc<Namespace>,
}

impl Lab {
    pub(crate) fn new(lan: Lan, nat: Nat) -> Self {
        let number = LABS.fetch_add(1, Ordering::SeqCst);
        let make = |place: &str| place_of(number, place);
        let mut lab = Self {
            number,
            dir: tempfile::tempdir().unwrap(),
            fleet: Fleet::create("lab".parse().unwrap(), unix_now(), &mut OsRng.unwrap_err()).unwrap(),
            path: None,
            has_ipv6: false,
            carrier: None,
            robot: make("robot"),
            near: make("near"),
            cloud: make("cloud"),
            far: make("far"),
            desk: make("desk"),
        };
        lab.path = lab.join_robot(lan);
        lab.desk.veth(("eth0", &["10.2.0.2/24"]), &lab.far, ("lan", &["10.2.0.1/24"])).unwrap();
        lab.near.veth(("wan", &["10.10.1.2/24"]), &lab.cloud, ("near", &["10.10.1.1/24"])).unwrap();
        lab.far.veth(("wan", &["10.10.2.2/24"]), &lab.cloud, ("far", &["10.10.2.1/24"])).unwrap();
        lab.cloud.ip(&["address", "add", &format!("{ROUTER}/32"), "dev", "lo"]).unwrap();
        lab.robot.ip(&["route", "add", "default", "via", "10.1.0.1"]).unwrap();
        lab.desk.ip(&["route", "add", "default", "via", "10.2.0.1"]).unwrap();
        lab.near.ip(&["route", "add", "default", "via", "10.10.1.1"]).unwrap();
        lab.far.ip(&["route", "add", "default", "via", "10.10.2.1"]).unwrap();
        lab.cloud.within(forward).unwrap();
        for site in [&lab.near, &lab.far] {
            site.within(|| {
                forward();
                // Packets with a foreign source address are dropped, as providers do.
                fs::write("/proc/sys/net/ipv4/conf/all/rp_filter", "1").unwrap();
            })
            .unwrap();
        }
        lab.robot
            .within(|| {
                // ARP requests use the address of their interface. Otherwise a packet with the old address asks in its
                // name, gets no answer, and all packets wait a second.
                fs::write("/proc/sys/net/ipv4/conf/all/arp_announce", "2").unwrap();
            })
            .unwrap();
        lab.set_nat(&lab.near, nat, "10.1.0.2");
        lab.set_nat(&lab.far, nat, "10.2.0.2");
        lab
    }

    fn join_robot(&self, lan: Lan) -> Option<TunLink> {
        let Lan::Path(options) = lan else {
            self.robot.veth(("eth0", &["10.1.0.2/24"]), &self.near, ("lan", &["10.1.0.1/24"])).unwrap();
            return None;
        };
        let end = |namespace: &Namespace, interface: &str, address: &str| TunEnd {
            namespace: Some(namespace.name().to_owned()),
            interface: interface.into(),
            addresses: vec![address.into()],
            routes: Vec::new(),
        };
        let ends = [end(&self.robot, "eth0", "10.1.0.2/24"), end(&self.near, "lan", "10.1.0.1/24")];
        Some(TunLink::start(ends, &options).unwrap())
    }

    /// Puts a carrier with a NAT between the robot's NAT and the internet.
    pub(crate) fn add_carrier(&mut self, carrier: Carrier) {
        let place = place_of(self.number, "carrier");
        self.near.ip(&["link", "del", "wan"]).unwrap();
        place.veth(("wan", &["10.10.1.2/24"]), &self.cloud, ("near", &["10.10.1.1/24"])).unwrap();
        place.ip(&["route", "add", "default", "via", "10.10.1.1"]).unwrap();
        place.within(forward).unwrap();
        self.near.veth(("wan", &["100.64.0.2/24"]), &place, ("lan0", &["100.64.0.1/24"])).unwrap();
        self.near.ip(&["route", "add", "default", "via", "100.64.0.1"]).unwrap();
        // Ports are mapped back as they were mapped, for any sender.
        let back = |from| {
            format!(
                "table ip carrier {{\n\
                 map back {{ type inet_service : ipv4_addr . inet_service; flags dynamic; size 65535; }}\n\
                 chain out {{ type nat hook postrouting priority 100; \
                 oifname \"wan\" ip protocol udp update @back {{ udp sport : ip saddr . udp sport }}; \
                 oifname \"wan\" masquerade; \
                 iifname \"lan*\" oifname \"lan*\" snat to 10.10.1.2; }}\n\
                 chain in {{ type nat hook prerouting priority -100; \
                 {from} ip daddr 10.10.1.2 ip protocol udp dnat ip to udp dport map @back; }}\n}}\n"
            )
        };
        let rules = match carrier {
            Carrier::PortRestricted => {
                "table ip carrier {\nchain out { type nat hook postrouting priority 100; oifname \"wan\" masquerade; }\n\
                 chain own { type filter hook input priority 0; iifname \"wan\" ct state new drop; }\n}\n"
                    .to_owned()
            }
            Carrier::NoHairpin => back("iifname \"wan\""),
            Carrier::Hairpin => back(""),
        };
        self.load_rules(&place, "nat", &rules);
        self.carrier = Some(place);
    }

    /// Moves the desk's NAT behind the same carrier.
    pub(crate) fn join_desk_to_carrier(&self) {
        let carrier = self.carrier.as_ref().unwrap();
        self.far.ip(&["link", "del", "wan"]).unwrap();
        self.far.veth(("wan", &["100.64.1.2/24"]), carrier, ("lan1", &["100.64.1.1/24"])).unwrap();
        self.far.ip(&["route", "add", "default", "via", "100.64.1.1"]).unwrap();
        // The two networks of customers do not reach each other by their own addresses.
        let rules = "table ip apart {\nchain through { type filter hook forward priority 0; \
                     iifname \"lan*\" oifname \"lan*\" ct status dnat accept; iifname \"lan*\" oifname \"lan*\" drop; }\n}\n";
        self.load_rules(carrier, "apart", rules);
    }

    /// Gives all places IPv6 as well, with firewalls at both sites that admit contacted senders. Returns `false` if this
    /// machine has no IPv6.
    pub(crate) fn add_ipv6(&mut self) -> bool {
        self.has_ipv6 = std::path::Path::new("/proc/sys/net/ipv6").exists();
        if !self.has_ipv6 {
            return false;
        }
        let six = |place: &Namespace, args: &str| {
            place.ip(&[&["-6"], &args.split(' ').collect::<Vec<_>>()[..]].concat()).unwrap();
        };
        six(&self.cloud, &format!("address add {ROUTER_V6}/128 dev lo nodad"));
        let sites = [(&self.robot, &self.near, "near", 1), (&self.desk, &self.far, "far", 2)];
        for (host, nat, name, n) in sites {
            six(host, &format!("address add 2001:db8:{n}::2/64 dev eth0 nodad"));
            six(nat, &format!("address add 2001:db8:{n}::1/64 dev lan nodad"));
            six(nat, &format!("address add 2001:db8:a{n}::2/64 dev wan nodad"));
            six(&self.cloud, &format!("address add 2001:db8:a{n}::1/64 dev {name} nodad"));
            six(host, &format!("route add default via 2001:db8:{n}::1"));
            six(nat, &format!("route add default via 2001:db8:a{n}::1"));
            six(&self.cloud, &format!("route add 2001:db8:{n}::/64 via 2001:db8:a{n}::2"));
            let rules = "table ip6 firewall {\nchain through { type filter hook forward priority 0; \
                         iifname \"wan\" meta l4proto udp ct state new drop; }\n}\n";
            self.load_rules(nat, "firewall", rules);
        }
        for place in [&self.near, &self.far, &self.cloud] {
            let forward = || fs::write("/proc/sys/net/ipv6/conf/all/forwarding", "1").unwrap();
            place.within(forward).unwrap();
        }
        true
    }

    /// Adds a second uplink of the robot, like mobile radio. It is up but not the default route.
    pub(crate) fn add_lte(&self) {
        self.robot.veth(("lte", &["10.3.0.2/24"]), &self.near, ("lte", &["10.3.0.1/24"])).unwrap();
    }

    /// Moves the robot's default route.
    pub(crate) fn route_by(&self, gateway: &str) {
        self.robot.ip(&["route", "replace", "default", "via", gateway]).unwrap();
    }

    /// Lays a cable from the robot to the desk, or pulls it.
    pub(crate) fn set_cable(&self, is_laid: bool) {
        if is_laid {
            self.robot.veth(("cable", &["10.9.0.1/24"]), &self.desk, ("cable", &["10.9.0.2/24"])).unwrap();
        } else {
            self.robot.ip(&["link", "del", "cable"]).unwrap();
        }
    }

    /// Gives the desk another address in place of the one that it has.
    pub(crate) fn change_desk(&self, comes: &str, goes: &str) {
        self.desk.ip(&["address", "del", goes, "dev", "eth0"]).unwrap();
        self.desk.ip(&["address", "add", comes, "dev", "eth0"]).unwrap();
        // The route went with the address.
        self.desk.ip(&["route", "replace", "default", "via", "10.2.0.1"]).unwrap();
    }

    /// Replaces the NAT of the desk's network.
    pub(crate) fn set_far_nat(&self, nat: Nat) {
        self.set_nat(&self.far, nat, "10.2.0.2");
    }

    fn set_nat(&self, site: &Namespace, nat: Nat, inside: &str) {
        // The world has no route to addresses behind a NAT.
        let (network, gateway) = match inside {
            "10.2.0.2" => ("10.2.0.0/24", "10.10.2.2"),
            _ => ("10.1.0.0/24", "10.10.1.2"),
        };
        match nat {
            Nat::Firewall | Nat::Public => {
                self.cloud.ip(&["route", "replace", network, "via", gateway]).unwrap();
            }
            Nat::FullCone | Nat::AddressRestricted | Nat::RandomPort(_) | Nat::PortRestricted => {
                let _ = self.cloud.ip(&["route", "del", network]);
            }
        }
        let rules = match nat {
            Nat::FullCone => format!(
                "chain out {{ type nat hook postrouting priority 100; oifname \"wan\" masquerade; }}\n\
                 chain in {{ type nat hook prerouting priority -100; iifname \"wan\" ip protocol {{ tcp, udp }} dnat to {inside}; }}"
            ),
            Nat::AddressRestricted => format!(
                "set contacted {{ type ipv4_addr; flags dynamic; size 1024; }}\n\
                 chain out {{ type nat hook postrouting priority 100; \
                 oifname \"wan\" update @contacted {{ ip daddr }}; oifname \"wan\" masquerade; }}\n\
                 chain in {{ type nat hook prerouting priority -100; \
                 iifname \"wan\" ip saddr @contacted ip protocol {{ tcp, udp }} dnat to {inside}; }}\n\
                 chain own {{ type filter hook input priority 0; iifname \"wan\" ct state new drop; }}"
            ),
            Nat::RandomPort(range) => format!(
                "chain out {{ type nat hook postrouting priority 100; \
                 oifname \"wan\" ip protocol {{ tcp, udp }} masquerade to :{range} random; }}"
            ),
            // A router of a home drops what nobody asked for, so that it does not take the port of a later mapping.
            Nat::PortRestricted => {
                "chain out { type nat hook postrouting priority 100; oifname \"wan\" masquerade; }\n\
                 chain own { type filter hook input priority 0; iifname \"wan\" ct state new drop; }"
                    .to_owned()
            }
            Nat::Firewall => "chain through { type filter hook forward priority 0; \
                 iifname \"wan\" ct state new drop; }"
                .to_owned(),
            Nat::Public => String::new(),
        };
        self.load_rules(site, "nat", &format!("flush ruleset\ntable ip nat {{\n{rules}\n}}\n"));
    }

    /// Clears the state of the robot's NAT and lets it draw ports from another range.
    pub(crate) fn rebind(&self, range: &'static str) {
        self.set_nat(&self.near, Nat::RandomPort(range), "");
        // Removing an address drops the mappings that masquerade behind it.
        let near = &self.near;
        near.ip(&["address", "del", "10.10.1.2/24", "dev", "wan"]).unwrap();
        near.ip(&["address", "add", "10.10.1.2/24", "dev", "wan"]).unwrap();
        near.ip(&["route", "add", "default", "via", "10.10.1.1"]).unwrap();
    }

    /// Lets only TCP leave the robot's network.
    pub(crate) fn block_udp(&self) {
        let rule = "chain through { type filter hook forward priority 0; ip protocol udp drop; }";
        self.load_rules(&self.near, "block", &format!("table ip block {{\n{rule}\n}}\n"));
    }

    /// Drops what goes from one site to the other. Both still reach the router.
    pub(crate) fn cut_between_sites(&self) {
        let rules = "chain through { type filter hook forward priority 0; drop; }";
        self.load_rules(&self.cloud, "cut", &format!("flush ruleset\ntable ip cut {{\n{rules}\n}}\n"));
    }

    /// Loses so many packets of a hundred that go from one site to the other.
    pub(crate) fn lose_between_sites(&self, percent: u32) {
        let rules = format!(
            "chain through {{ type filter hook forward priority 0; numgen random mod 100 < {percent} drop; }}"
        );
        self.load_rules(&self.cloud, "cut", &format!("flush ruleset\ntable ip cut {{\n{rules}\n}}\n"));
    }

    /// Lets it pass again.
    pub(crate) fn join_sites(&self) {
        self.load_rules(&self.cloud, "cut", "flush ruleset\n");
    }

    fn load_rules(&self, site: &Namespace, name: &str, rules: &str) {
        let file = self.path(&format!("{}-{name}.nft", site.name()));
        fs::write(&file, rules).unwrap();
        site.run("nft", &["-f", file.to_str().unwrap()]).unwrap();
    }

    pub(crate) fn path(&self, file: &str) -> PathBuf {
        self.dir.path().join(file)
    }

    pub(crate) fn dir(&self) -> &std::path::Path {
        self.dir.path()
    }

    /// Returns the router's URL for a transport.
    pub(crate) fn url(&self, scheme: &str) -> String {
        format!("{scheme}://{ROUTER}:{}", port(scheme))
    }

    /// Returns the router's URL over IPv6; see [`Lab::add_ipv6`].
    pub(crate) fn url_v6(&self) -> String {
        format!("quic://[{ROUTER_V6}]:{PORT}")
    }

    /// The router's configuration: it listens for every transport of this build.
    pub(crate) fn router_config(&self) -> PathBuf {
        let mut listen: Vec<_> =
            schemes().iter().map(|scheme| format!("\"{scheme}://0.0.0.0:{}\"", port(scheme))).collect();
        if self.has_ipv6 {
            listen.push(format!("\"{}\"", self.url_v6()));
        }
        self.write_config("cloud", &[], &format!("[router]\nlisten = [{}]\n", listen.join(", ")))
    }

    /// A configuration on disk, beside the identity that [`Lab::enroll`] writes.
    pub(crate) fn write_config(&self, node: &str, routers: &[&str], rest: &str) -> PathBuf {
        let routers: Vec<_> = routers.iter().map(|url| format!("\"{url}\"")).collect();
        let text = format!(
            "identity = \"{node}.identity\"\n[admin]\nsocket = \"{node}.sock\"\nobservers = [\"*\"]\n\
             [node]\nstate = \"{node}.state\"\nrouters = [{}]\n{rest}",
            routers.join(", ")
        );
        let path = self.path(&format!("{node}.toml"));
        fs::write(&path, text).unwrap();
        path
    }

    /// An identity of the fleet, also as a file.
    pub(crate) fn enroll(&self, node: &str, router: bool) -> Arc<Identity> {
        self.enroll_in(&self.fleet, node, router)
    }

    /// An identity of another fleet as a file, and the certificates of both fleets' CAs: `lab-ca.pem` and
    /// `FLEET-ca.pem`.
    pub(crate) fn enroll_partner(&self, fleet: &str, node: &str) {
        let other = Fleet::create(fleet.parse().unwrap(), unix_now(), &mut OsRng.unwrap_err()).unwrap();
        self.enroll_in(&other, node, false);
        for (name, fleet) in [("lab", &self.fleet), (fleet, &other)] {
            let base64 = STANDARD.encode(fleet.ca_certificate());
            let pem = format!("-----BEGIN CERTIFICATE-----\n{base64}\n-----END CERTIFICATE-----\n");
            fs::write(self.path(&format!("{name}-ca.pem")), pem).unwrap();
        }
    }

    fn enroll_in(&self, fleet: &Fleet, node: &str, router: bool) -> Arc<Identity> {
        let mut request = EnrollRequest::new(node.parse().unwrap(), unix_now());
        request.router = router;
        let identity = fleet.issue(&request, &mut OsRng.unwrap_err()).unwrap();
        let mut options = fs::OpenOptions::new();
        let file = options.write(true).create(true).truncate(true).mode(0o600);
        let mut file = file.open(self.path(&format!("{node}.identity"))).unwrap();
        file.write_all(identity.to_text().as_bytes()).unwrap();
        Arc::new(identity)
    }
}

/// Creates the namespace of a place in a lab.
fn place_of(number: u32, place: &str) -> Arc<Namespace> {
    Arc::new(Namespace::create(format!("sgctr-{}-{number}-{place}", std::process::id())).unwrap())
}

fn forward() {
    fs::write("/proc/sys/net/ipv4/ip_forward", "1").unwrap();
}

fn port(scheme: &str) -> u16 {
    PORT + SCHEMES.iter().position(|known| *known == scheme).unwrap() as u16
}

fn unix_now() -> UnixMillis {
    UnixMillis(SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_millis() as u64)
}
