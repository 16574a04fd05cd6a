//! DDS over WireGuard: a tunnel between the two places, and Cyclone with unicast peers in it.
//!
//! The tunnel is `wireguard-go`, which needs no kernel module; its keys are made for the run. The right place has the
//! known address, as a server does; the left one dials, and may move.

use std::fs;
use std::io::Write as _;
use std::net::{IpAddr, Ipv4Addr};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};

use super::{Dds, Running, System, Topic};
use crate::compare::lab::{Lab, Side};
use crate::compare::program::Program;

/// The addresses in the tunnel.
const ADDRESSES: [Ipv4Addr; 2] = [Ipv4Addr::new(10, 99, 0, 1), Ipv4Addr::new(10, 99, 0, 2)];
const BITS_PREFIX: u8 = 24;
const PORT: u16 = 51820;
/// MTU that WireGuard's own tool sets on a path of 1500 bytes.
const MTU: u16 = 1420;
/// Keep-alive interval in seconds that its manual recommends behind a NAT.
const KEEP_ALIVE_SECONDS: u16 = 25;
/// Directory in which `wireguard-go` opens a socket for its tool, named by the interface. All namespaces share it.
const SOCKETS: &str = "/var/run/wireguard";
const PATIENCE: Duration = Duration::from_secs(10);
const LOOK_EVERY: Duration = Duration::from_millis(10);

static TUNNELS: AtomicU32 = AtomicU32::new(0);

/// DDS over WireGuard.
pub(crate) struct WireGuard;

impl System for WireGuard {
    fn name(&self) -> String {
        "wireguard".into()
    }

    fn start(&self, lab: &Lab, _: &[Topic]) -> Result<Running> {
        let dir = lab.new_dir("wireguard")?;
        let keys = [Keys::make(&dir, Side::Left)?, Keys::make(&dir, Side::Right)?];
        let dds = Side::BOTH.map(|side| Dds::between(address(side), address(side.other())));
        let mut running = Running { processes: Vec::new(), dds };
        let number = TUNNELS.fetch_add(1, Ordering::Relaxed);
        for side in [Side::Right, Side::Left] {
            // Names of interfaces have at most 15 bytes.
            let interface = format!("wg{}-{number}{}", std::process::id(), &side.name()[..1]);
            let mut command = lab.command(side, "wireguard-go");
            command.args(["--foreground", &interface]).env("LOG_LEVEL", "error");
            let program = Program::start_daemon("wireguard-go", command, &lab.new_dir(side.name())?);
            running.processes.push((side, program.context("wireguard-go")?));
            until_exists(&Path::new(SOCKETS).join(format!("{interface}.sock")))?;
            set_up(lab, side, &interface, &keys)?;
        }
        Ok(running)
    }
}

fn address(side: Side) -> IpAddr {
    ADDRESSES[side as usize].into()
}

/// Keys, the other end, addresses.
fn set_up(lab: &Lab, side: Side, interface: &str, keys: &[Keys; 2]) -> Result<()> {
    let [mine, others] = [side, side.other()].map(|side| &keys[side as usize]);
    let port = PORT.to_string();
    let mut wg = lab.command(side, "wg");
    wg.args(["set", interface, "listen-port", &port, "private-key"]).arg(&mine.private_file);
    wg.args(["peer", &others.public, "allowed-ips", &format!("{}/32", address(side.other()))]);
    if side == Side::Left {
        wg.args(["endpoint", &format!("{}:{PORT}", lab.address(Side::Right))]);
        wg.args(["persistent-keepalive", &KEEP_ALIVE_SECONDS.to_string()]);
    }
    output(wg, "")?;
    let place = lab.place(side);
    place.ip(&["address", "add", &format!("{}/{BITS_PREFIX}", address(side)), "dev", interface])?;
    place.ip(&["link", "set", interface, "mtu", &MTU.to_string(), "up"])?;
    Ok(())
}

/// The keys of one end.
struct Keys {
    private_file: PathBuf,
    public: String,
}

impl Keys {
    fn make(dir: &Path, side: Side) -> Result<Self> {
        let wg = |what| {
            let mut command = Command::new("wg");
            command.arg(what);
            command
        };
        let private = output(wg("genkey"), "")?;
        let public = output(wg("pubkey"), &private)?;
        let private_file = dir.join(format!("{}.key", side.name()));
        fs::write(&private_file, private)?;
        Ok(Self { private_file, public })
    }
}

/// Returns the output of a tool for this short input.
fn output(mut command: Command, input: &str) -> Result<String> {
    let name = format!("{command:?}");
    command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().with_context(|| name.clone())?;
    child.stdin.take().context("no standard input")?.write_all(input.as_bytes())?;
    let output = child.wait_with_output().with_context(|| name.clone())?;
    ensure!(output.status.success(), "{name}: {}", String::from_utf8_lossy(&output.stderr).trim());
    Ok(String::from_utf8(output.stdout)?.trim().to_owned())
}

fn until_exists(path: &Path) -> Result<()> {
    let deadline = Instant::now() + PATIENCE;
    while !path.exists() {
        if Instant::now() > deadline {
            bail!("wireguard-go does not open {}; is there a /dev/net/tun?", path.display());
        }
        std::thread::sleep(LOOK_EVERY);
    }
    Ok(())
}
