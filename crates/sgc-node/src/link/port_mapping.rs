//! The task of port mappings: asks the gateway to map the UDP port from which QUIC links are dialled.
//!
//! [`sgc_session::PortMapper`] decides when and by which protocol; the control task decides whether
//! ([`MappingWish`]). This module finds the gateway and sends the requests.

use std::collections::BTreeSet;
use std::fs::File;
use std::future::pending;
use std::io::{self, Read as _};
use std::net::{IpAddr, Ipv4Addr, SocketAddr, SocketAddrV4};
use std::num::NonZeroU16;
use std::pin::Pin;
use std::time::{Duration, Instant};

use crab_nat::{InternetProtocol, PortMappingOptions, PortMappingType, TimeoutConfig, natpmp, pcp};
use rand_chacha::ChaCha20Rng;
use sgc_session::{
    GrantedMapping, MAPPING_LIFETIME, MapperOutput, MappingFailure, MappingProtocol, MappingTarget,
    PortMapper,
};
use tokio::sync::{mpsc, watch};
use tokio::time::{sleep_until, timeout};
use tracing::{debug, info};

use crate::control::event::CoreEvent;
use crate::link::mapping_report::{MappingOff, MappingReport, MappingWish};
use crate::link::roaming::{Network, source_towards};
use crate::link::upnp::{self, Igd};

/// Longest time for a request by one protocol.
const REQUEST_MAX: Duration = Duration::from_secs(10);
/// Time for the removal of a mapping when the node ends.
pub(crate) const REMOVAL_MAX: Duration = Duration::from_secs(1);
/// Waits for an answer by UDP: 250, 500 and 1000 ms.
const UDP_WAITS: TimeoutConfig =
    TimeoutConfig { initial_timeout: Duration::from_millis(250), max_retries: 2, max_retry_timeout: None };
/// The routing table of the namespace of this thread (`proc_pid_net(5)`).
const ROUTES: &str = "/proc/thread-self/net/route";
/// Most bytes of it that are looked at.
const ROUTES_BYTES_MAX: u64 = 1 << 20;
/// Flags of a usable route by a gateway (`RTF_UP`, `RTF_GATEWAY`).
const ROUTE_FLAGS: u32 = 0x1 | 0x2;

/// The answer to a request, and the device of UPnP that gave it.
type Job =
    Pin<Box<dyn Future<Output = (Option<Igd>, Option<Result<GrantedMapping, MappingFailure>>)> + Send>>;

/// Keeps the port mapped as the control task wishes, until that ends. Then the mapping is removed.
pub(crate) async fn serve(
    mut wishes: watch::Receiver<MappingWish>,
    mut network: Network,
    core: mpsc::Sender<CoreEvent>,
    rng: ChaCha20Rng,
) {
    let mut task = MappingTask { mapper: PortMapper::new(rng), job: None, igd: None };
    let mut seen = BTreeSet::new();
    let mut reported = None;
    loop {
        let wish = wishes.borrow_and_update().clone();
        let target = target(&wish);
        task.mapper.set_target(target.ok());
        if let MappingWish::For { seen: now_seen, .. } = wish
            && now_seen != seen
        {
            seen = now_seen;
            task.mapper.network_changed(Instant::now());
        }
        task.go_on();
        let report = task.report(target);
        if reported.as_ref() != Some(&report) {
            reported = Some(report.clone());
            if core.send(CoreEvent::PortMapping(report)).await.is_err() {
                break;
            }
        }
        let deadline = task.mapper.deadline();
        tokio::select! {
            changed = wishes.changed() => if changed.is_err() { break },
            () = network.changed() => task.mapper.network_changed(Instant::now()),
            () = task.answered() => {}
            () = until(deadline) => {}
        }
    }
    task.mapper.set_target(None);
    while task.go_on() {
        task.answered().await;
    }
}

async fn until(deadline: Option<Instant>) {
    match deadline {
        Some(at) => sleep_until(at.into()).await,
        None => pending().await,
    }
}

/// The machine, and the work that it wants done.
struct MappingTask {
    mapper: PortMapper,
    job: Option<Job>,
    /// The device that answered last.
    igd: Option<Igd>,
}

impl MappingTask {
    /// Begins the work that is due. Returns `true` if there is some.
    fn go_on(&mut self) -> bool {
        let now = Instant::now();
        self.mapper.handle_timeout(now);
        if self.job.is_none() {
            self.job = self.mapper.poll(now).map(|output| {
                let job: Job = Box::pin(carry_out(output, self.igd.take()));
                job
            });
        }
        self.job.is_some()
    }

    /// Waits for the end of the work, for ever if there is none. Dropping the future stops nothing.
    async fn answered(&mut self) {
        let Some(job) = &mut self.job else { return pending().await };
        let (igd, answer) = job.await;
        (self.job, self.igd) = (None, igd);
        if let Some(answer) = answer {
            let before = self.mapper.mapping().map(|(mapping, _)| mapping.external);
            self.mapper.answered(Instant::now(), answer);
            if let Some((mapping, _)) = self.mapper.mapping()
                && before != Some(mapping.external)
            {
                let GrantedMapping { protocol, external, target, .. } = mapping;
                info!("the gateway {} maps port {} as {external} ({protocol})", target.gateway, target.port);
            }
        }
    }

    fn report(&self, target: Result<MappingTarget, MappingOff>) -> MappingReport {
        MappingReport {
            off: target.err(),
            gateway: target.ok().map(|target| target.gateway),
            mapping: self.mapper.mapping(),
            is_looking: self.mapper.is_looking(),
            failures: self.mapper.failures().clone(),
        }
    }
}

/// Returns the port that is to be mapped, and the gateway.
fn target(wish: &MappingWish) -> Result<MappingTarget, MappingOff> {
    let port = match wish {
        MappingWish::Off(why) => return Err(*why),
        MappingWish::For { port, .. } => *port,
    };
    let gateway = default_gateway().unwrap_or_else(|error| {
        debug!(%error, "the routes of this host cannot be read");
        None
    });
    let gateway = gateway.ok_or(MappingOff::NoGateway)?;
    match source_towards(SocketAddr::new(gateway.into(), crab_nat::GATEWAY_PORT)) {
        Some(IpAddr::V4(host)) => Ok(MappingTarget { gateway, host, port }),
        _ => Err(MappingOff::NoGateway),
    }
}

/// Returns the gateway of the default route.
fn default_gateway() -> io::Result<Option<Ipv4Addr>> {
    let mut table = String::new();
    File::open(ROUTES)?.take(ROUTES_BYTES_MAX).read_to_string(&mut table)?;
    Ok(gateway_in(&table))
}

/// Returns the gateway of the default route with the least metric.
fn gateway_in(table: &str) -> Option<Ipv4Addr> {
    let route = |line: &str| {
        let mut fields = line.split_whitespace().skip(1);
        let mut hex = || u32::from_str_radix(fields.next()?, 16).ok();
        let (destination, gateway, flags) = (hex()?, hex()?, hex()?);
        let metric: u32 = fields.nth(2)?.parse().ok()?;
        let mask = u32::from_str_radix(fields.next()?, 16).ok()?;
        let is_default = destination == 0 && mask == 0 && flags & ROUTE_FLAGS == ROUTE_FLAGS;
        // The kernel prints addresses as numbers of this machine.
        is_default.then(|| (metric, Ipv4Addr::from(gateway.to_ne_bytes())))
    };
    table.lines().skip(1).filter_map(route).min_by_key(|(metric, _)| *metric).map(|(_, gateway)| gateway)
}

/// Carries out what the machine wants.
async fn carry_out(
    output: MapperOutput,
    mut igd: Option<Igd>,
) -> (Option<Igd>, Option<Result<GrantedMapping, MappingFailure>>) {
    let work = async {
        match output {
            MapperOutput::Ask { protocol, target, renews } => Some(match protocol {
                MappingProtocol::Pcp => ask_pcp(target, renews).await,
                MappingProtocol::NatPmp => ask_nat_pmp(target, renews).await,
                MappingProtocol::UpnpIgd => upnp::ask(target, renews, &mut igd).await,
            }),
            MapperOutput::Remove(mapping) => {
                remove(&mapping, igd.as_ref()).await;
                None
            }
        }
    };
    let answer = timeout(REQUEST_MAX, work).await;
    if let (MapperOutput::Ask { protocol, target, .. }, Ok(Some(Err(failure)))) = (output, &answer) {
        debug!(%protocol, gateway = %target.gateway, %failure, "no port mapping");
    }
    // The machine waits for the answer to a request, and for none to a removal.
    let asked = matches!(output, MapperOutput::Ask { .. });
    (igd, answer.unwrap_or_else(|_| asked.then_some(Err(MappingFailure::NoAnswer))))
}

fn options(target: &MappingTarget, renews: Option<GrantedMapping>) -> PortMappingOptions {
    let wanted = renews.and_then(|mapping| NonZeroU16::new(mapping.external.port()));
    PortMappingOptions {
        external_port: Some(wanted.unwrap_or(target.port)),
        lifetime_seconds: MAPPING_LIFETIME.as_secs().try_into().ok(),
        timeout_config: Some(UDP_WAITS),
    }
}

async fn ask_pcp(
    target: MappingTarget,
    renews: Option<GrantedMapping>,
) -> Result<GrantedMapping, MappingFailure> {
    let MappingTarget { gateway, host, port } = target;
    let base = pcp::BaseMapRequest::new(gateway.into(), host.into(), InternetProtocol::Udp, port);
    let (nonce, address) = renews.map(|mapping| (mapping.nonce, IpAddr::V4(*mapping.external.ip()))).unzip();
    let mapping = pcp::port_mapping(base, nonce, address, options(&target, renews)).await;
    let mapping = mapping.map_err(|failure| pcp_failure(&failure))?;
    let PortMappingType::Pcp { nonce, external_ip: IpAddr::V4(ip), .. } = mapping.mapping_type() else {
        return Err(MappingFailure::NoExternalAddress);
    };
    let external = SocketAddrV4::new(ip, mapping.external_port().get());
    let lifetime = Duration::from_secs(mapping.lifetime().into());
    Ok(GrantedMapping { protocol: MappingProtocol::Pcp, target, external, lifetime, nonce })
}

async fn ask_nat_pmp(
    target: MappingTarget,
    renews: Option<GrantedMapping>,
) -> Result<GrantedMapping, MappingFailure> {
    let gateway = target.gateway.into();
    let ip = natpmp::external_address(gateway, Some(UDP_WAITS)).await;
    let ip = ip.map_err(|failure| nat_pmp_failure(&failure))?;
    let options = options(&target, renews);
    let mapping = natpmp::port_mapping(gateway, InternetProtocol::Udp, target.port, options).await;
    let mapping = mapping.map_err(|failure| nat_pmp_failure(&failure))?;
    let external = SocketAddrV4::new(ip, mapping.external_port().get());
    let lifetime = Duration::from_secs(mapping.lifetime().into());
    Ok(GrantedMapping { protocol: MappingProtocol::NatPmp, target, external, lifetime, nonce: [0; 3] })
}

async fn remove(mapping: &GrantedMapping, igd: Option<&Igd>) {
    let MappingTarget { gateway, host, port } = mapping.target;
    let udp = InternetProtocol::Udp;
    let failure = match mapping.protocol {
        MappingProtocol::Pcp => {
            let range = pcp::DropMappingRange::Single { protocol: udp, internal_port: port };
            let removed =
                pcp::try_drop_mapping(gateway.into(), host.into(), mapping.nonce, range, Some(UDP_WAITS))
                    .await;
            removed.err().map(|failure| pcp_failure(&failure))
        }
        MappingProtocol::NatPmp => {
            let removed = natpmp::try_drop_mapping(gateway.into(), udp, Some(port), Some(UDP_WAITS)).await;
            removed.err().map(|failure| nat_pmp_failure(&failure))
        }
        MappingProtocol::UpnpIgd => {
            upnp::remove(mapping, igd).await;
            None
        }
    };
    if let Some(failure) = failure {
        debug!(%gateway, %failure, "the mapping is not removed");
    }
}

fn not_sent(error: &io::Error) -> MappingFailure {
    match error.kind() {
        // The gateway says by ICMP that it has no such port.
        io::ErrorKind::ConnectionRefused => MappingFailure::Unsupported,
        _ => MappingFailure::NotSent,
    }
}

fn pcp_failure(failure: &pcp::Failure) -> MappingFailure {
    use pcp::Failure as F;
    match failure {
        F::Socket(error) => not_sent(error),
        F::Timeout => MappingFailure::NoAnswer,
        F::UnsupportedVersion(_)
        | F::UnsupportedOpcode
        | F::UnsupportedOption
        | F::UnsupportedProtocol
        | F::MalformedRequest
        | F::MalformedOption => MappingFailure::Unsupported,
        F::NotAuthorized(_) | F::AddressMismatch | F::ExcessiveRemotePeers => MappingFailure::NotPermitted,
        F::NoResources(_) | F::UserExceededQuota(_) | F::CannotProvideExternal(_) => MappingFailure::NoRoom,
        F::NetworkFailure(_) => MappingFailure::NoExternalAddress,
        F::Nonce | F::InvalidResponse(_) => MappingFailure::Malformed,
    }
}

fn nat_pmp_failure(failure: &natpmp::Failure) -> MappingFailure {
    use natpmp::Failure as F;
    match failure {
        F::Socket(error) => not_sent(error),
        F::Timeout => MappingFailure::NoAnswer,
        F::UnsupportedVersion(_) | F::UnsupportedOpcode => MappingFailure::Unsupported,
        F::NotAuthorized => MappingFailure::NotPermitted,
        F::OutOfResources => MappingFailure::NoRoom,
        F::NetworkFailure => MappingFailure::NoExternalAddress,
        F::InvalidResponse(_) => MappingFailure::Malformed,
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    #[cfg(target_endian = "little")]
    #[test]
    fn gateway_is_that_of_the_best_default_route() {
        let head = "Iface\tDestination\tGateway \tFlags\tRefCnt\tUse\tMetric\tMask\t\tMTU\tWindow\tIRTT\n";
        let table = |routes: &[&str]| gateway_in(&(head.to_owned() + &routes.join("\n")));
        let wifi = "wlan0\t00000000\t0101A8C0\t0003\t0\t0\t600\t00000000\t0\t0\t0";
        let cable = "eth0\t00000000\t0100000A\t0003\t0\t0\t100\t00000000\t0\t0\t0";
        let network = "eth0\t0000000A\t00000000\t0001\t0\t0\t100\t00FFFFFF\t0\t0\t0";
        let half = "tun0\t00000000\t0100080A\t0003\t0\t0\t0\t00000080\t0\t0\t0";
        let down = "eth1\t00000000\t0100020A\t0002\t0\t0\t0\t00000000\t0\t0\t0";
        let tunnel = "tun1\t00000000\t00000000\t0001\t0\t0\t0\t00000000\t0\t0\t0";
        assert_eq!(table(&[wifi]), Some([192, 168, 1, 1].into()));
        assert_eq!(table(&[wifi, network, half, down, tunnel, cable]), Some([10, 0, 0, 1].into()));
        assert_eq!(table(&[network, half, down, tunnel, "", "nonsense", "a b c d"]), None);
        assert_eq!(gateway_in(""), None);
        // Tests in network namespaces show that the kernel's table is understood.
        assert!(default_gateway().is_ok());
    }
}
