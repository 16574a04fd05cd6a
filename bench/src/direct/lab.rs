//! Two sites behind a NAT each, and a cloud between them with the router or relay. Knows no system.
//!
//! ```text
//! left ─ eth0 ─ lan ─ near NAT ─ wan ═ near ─ cloud ─ far ═ wan ─ far NAT ─ lan ─ eth0 ─ right
//! 10.1.0.2            10.10.1.2               10.10.0.1           10.10.2.2           10.2.0.2
//! ```
//!
//! Each double line delays every packet. A packet of one site to the other passes both delays, whether the cloud only
//! forwards it or its router does.

use std::fs;
use std::net::Ipv4Addr;
use std::path::PathBuf;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use anyhow::{Context, Result};
use sgc_testkit::netsim::{Namespace, Profile, TunEnd, TunLink, TunOptions};
use tempfile::TempDir;

use crate::compare::{Dds, Program, Side};

/// The address of the router or relay.
pub(super) const ROUTER: Ipv4Addr = Ipv4Addr::new(10, 10, 0, 1);
/// The TCP port of the right site that is forwarded to its host, for the plain connection.
pub(super) const FORWARDED: u16 = 7000;
/// The addresses of the hosts.
const INSIDE: [Ipv4Addr; 2] = [Ipv4Addr::new(10, 1, 0, 2), Ipv4Addr::new(10, 2, 0, 2)];
/// The addresses of the NATs, as the world sees them.
const OUTSIDE: [Ipv4Addr; 2] = [Ipv4Addr::new(10, 10, 1, 2), Ipv4Addr::new(10, 10, 2, 2)];

static LABS: AtomicU32 = AtomicU32::new(0);

/// The network. Programs in it have to end before it is dropped.
pub(super) struct Lab {
    /// Dropped first, because their devices are in the namespaces.
    _paths: [TunLink; 2],
    sites: [Arc<Namespace>; 2],
    cloud: Arc<Namespace>,
    _nats: [Namespace; 2],
    dir: TempDir,
    load: PathBuf,
    started: AtomicU32,
}

impl Lab {
    /// Makes it with this delay between each NAT and the cloud. Needs root.
    pub(super) fn new(delay: Duration, load: PathBuf) -> Result<Self> {
        let number = LABS.fetch_add(1, Ordering::SeqCst);
        let make = |place: &str| {
            let name = format!("sgcdirect-{}-{number}-{place}", std::process::id());
            Namespace::create(name).with_context(|| format!("the namespace of {place}"))
        };
        let sites = [Arc::new(make("left")?), Arc::new(make("right")?)];
        let nats = [make("near")?, make("far")?];
        let cloud = Arc::new(make("cloud")?);
        let dir = tempfile::tempdir()?;
        cloud.ip(&["address", "add", &format!("{ROUTER}/32"), "dev", "lo"])?;
        let paths = [
            join(&nats[0], "10.10.1.2/24", &cloud, ("near", "10.10.1.1/24"), delay)?,
            join(&nats[1], "10.10.2.2/24", &cloud, ("far", "10.10.2.1/24"), delay)?,
        ];
        for side in Side::BOTH {
            let (site, nat, at) = (&sites[side as usize], &nats[side as usize], 1 + side as usize);
            let addresses = [format!("10.{at}.0.2/24"), format!("10.{at}.0.1/24")];
            site.veth(("eth0", &[&addresses[0]]), nat, ("lan", &[&addresses[1]]))?;
            site.ip(&["route", "add", "default", "via", &format!("10.{at}.0.1")])?;
            // So that programs and nodes of a site find each other as on any host.
            site.ip(&["link", "set", "lo", "multicast", "on"])?;
            nat.ip(&["route", "add", "default", "via", &format!("10.10.{at}.1")])?;
            forward(nat)?;
            load_rules(nat, &dir, &nat_rules(side))?;
        }
        forward(&cloud)?;
        load_rules(&cloud, &dir, COUNTS)?;
        let started = AtomicU32::new(0);
        Ok(Self { _paths: paths, sites, cloud, _nats: nats, dir, load, started })
    }

    /// The host of a site.
    pub(super) fn site(&self, side: Side) -> &Arc<Namespace> {
        &self.sites[side as usize]
    }

    /// The host of the router.
    pub(super) fn cloud(&self) -> &Arc<Namespace> {
        &self.cloud
    }

    /// The address of a site's host, as that host knows it.
    pub(super) fn inside(side: Side) -> Ipv4Addr {
        INSIDE[side as usize]
    }

    /// The address of a site's NAT, as the world sees it.
    pub(super) fn outside(side: Side) -> Ipv4Addr {
        OUTSIDE[side as usize]
    }

    /// A new directory for somebody's files, with a short path.
    pub(super) fn new_dir(&self, name: &str) -> Result<PathBuf> {
        let number = self.started.fetch_add(1, Ordering::Relaxed);
        let dir = self.dir.path().join(format!("{number}-{name}"));
        fs::create_dir(&dir).with_context(|| dir.display().to_string())?;
        Ok(dir)
    }

    /// Starts a load program in a local network of a site.
    pub(super) fn load(&self, dds: &Dds, side: Side, args: &[&str]) -> Result<Program> {
        let mut command: Command = self.site(side).command(&self.load);
        command.args(args).args(["--domain", &dds.domain.to_string()]);
        dds.configure(&mut command);
        let name = format!("load-{}-{}", side.name(), args.first().copied().unwrap_or_default());
        Program::start(&name, command, &self.new_dir(&name)?)
    }

    /// Bytes of IP packets to and from the host of the router so far. Packets that it only forwards are not in it.
    pub(super) fn router_bytes(&self) -> Result<u64> {
        let text = self.cloud.run("nft", &["-j", "list", "counters"])?;
        let listed: serde_json::Value = serde_json::from_str(&text)?;
        let rows = listed["nftables"].as_array().context("no list of counters")?;
        let bytes = rows.iter().find_map(|row| row["counter"]["bytes"].as_u64());
        bytes.context("no counter")
    }
}

/// Counts what the cloud's host itself receives and sends.
const COUNTS: &str = "table ip counts {
    counter router { }
    chain received { type filter hook input priority 0; iifname != \"lo\" counter name router; }
    chain sent { type filter hook output priority 0; oifname != \"lo\" counter name router; }
}";

/// The rules of a port-restricted NAT: it keeps ports and admits only contacted senders. It drops unexpected packets to
/// itself, so that these do not take the port of a later mapping.
fn nat_rules(side: Side) -> String {
    let forwarded = match side {
        Side::Left => String::new(),
        Side::Right => format!(
            "chain forwarded {{ type nat hook prerouting priority -100; \
             iifname \"wan\" tcp dport {FORWARDED} dnat to {}; }}\n",
            Lab::inside(side)
        ),
    };
    format!(
        "table ip nat {{\n\
         chain out {{ type nat hook postrouting priority 100; oifname \"wan\" masquerade; }}\n{forwarded}\
         chain own {{ type filter hook input priority 0; iifname \"wan\" ct state new drop; }}\n}}\n"
    )
}

/// Joins a NAT and the cloud by a path with a delay.
fn join(
    nat: &Namespace,
    address: &str,
    cloud: &Namespace,
    (interface, cloud_address): (&str, &str),
    delay: Duration,
) -> Result<TunLink> {
    let end = |namespace: &Namespace, interface: &str, address: &str| TunEnd {
        namespace: Some(namespace.name().to_owned()),
        interface: interface.to_owned(),
        addresses: vec![address.to_owned()],
        routes: Vec::new(),
    };
    let options =
        TunOptions { profiles: [Profile { delay, ..Profile::default() }; 2], ..TunOptions::default() };
    let ends = [end(nat, "wan", address), end(cloud, interface, cloud_address)];
    TunLink::start(ends, &options).context("the path between a NAT and the cloud")
}

fn forward(namespace: &Namespace) -> Result<()> {
    Ok(namespace.within(|| fs::write("/proc/sys/net/ipv4/ip_forward", "1"))??)
}

fn load_rules(namespace: &Namespace, dir: &TempDir, rules: &str) -> Result<()> {
    let file = dir.path().join(format!("{}.nft", namespace.name()));
    fs::write(&file, rules)?;
    namespace.run("nft", &["-f", &file.display().to_string()])?;
    Ok(())
}
