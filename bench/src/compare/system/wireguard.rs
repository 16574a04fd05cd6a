//! DDS over WireGuard: a tunnel between the two places, and Cyclone with unicast peers in it.
//!
//! The tunnel is `wireguard-go`, which needs no kernel module; its keys are made for the run. The right place has the
//! known address, as a server does; the left one dials, and may move.

use std::fs;
use std::io::Write as _;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use sgc_testkit::netsim::Namespace;

use super::{Dds, Running, System, Topic};
use crate::compare::lab::{Lab, Side};
use crate::compare::program::Program;

/// The addresses in the tunnel.
const ADDRESSES: [Ipv4Addr; 2] = [Ipv4Addr::new(10, 99, 0, 1), Ipv4Addr::new(10, 99, 0, 2)];
const BITS_PREFIX: u8 = 24;
/// The UDP port of both ends.
pub(crate) const PORT: u16 = 51820;
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
        for side in [Side::Right, Side::Left] {
            let dials = SocketAddr::new(lab.address(Side::Right), PORT);
            let endpoint = (side == Side::Left).then_some((dials, KEEP_ALIVE_SECONDS));
            let program = start(lab.place(side), &lab.new_dir(side.name())?, side, &keys, endpoint)?;
            running.processes.push((side, program));
        }
        Ok(running)
    }
}

/// The address of a place in the tunnel.
pub(crate) fn address(side: Side) -> IpAddr {
    ADDRESSES[side as usize].into()
}

/// Starts an end of the tunnel. It sends to `endpoint`, if that is known, and a keep-alive there every so many seconds.
pub(crate) fn start(
    place: &Namespace,
    dir: &Path,
    side: Side,
    keys: &[Keys; 2],
    endpoint: Option<(SocketAddr, u16)>,
) -> Result<Program> {
    // Names of interfaces have at most 15 bytes.
    let number = TUNNELS.fetch_add(1, Ordering::Relaxed);
    let interface = format!("wg{}-{number}", std::process::id());
    let mut command = place.command("wireguard-go");
    command.args(["--foreground", &interface]).env("LOG_LEVEL", "error");
    let program = Program::start_daemon("wireguard-go", command, dir).context("wireguard-go")?;
    until_exists(&Path::new(SOCKETS).join(format!("{interface}.sock")))?;
    let [mine, others] = [side, side.other()].map(|side| &keys[side as usize]);
    let port = PORT.to_string();
    let mut wg = place.command("wg");
    wg.args(["set", &interface, "listen-port", &port, "private-key"]).arg(&mine.private_file);
    wg.args(["peer", &others.public, "allowed-ips", &format!("{}/32", address(side.other()))]);
    if let Some((endpoint, keep_alive_seconds)) = endpoint {
        wg.args(["endpoint", &endpoint.to_string()]);
        wg.args(["persistent-keepalive", &keep_alive_seconds.to_string()]);
    }
    output(wg, "")?;
    place.ip(&["address", "add", &format!("{}/{BITS_PREFIX}", address(side)), "dev", &interface])?;
    place.ip(&["link", "set", &interface, "mtu", &MTU.to_string(), "up"])?;
    Ok(program)
}

/// The keys of one end.
pub(crate) struct Keys {
    private_file: PathBuf,
    public: String,
}

impl Keys {
    /// Makes new ones, with their files in `dir`.
    pub(crate) fn make(dir: &Path, side: Side) -> Result<Self> {
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
