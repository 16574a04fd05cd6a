//! WireGuard between the sites without a relay: each end knows the address of the other's NAT, and keeps its own open.

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use anyhow::Result;

use super::dds::Programs;
use super::lab::Lab;
use super::pair::{Pair, Plan, Start, ms};
use super::sockets::Sockets;
use crate::compare::wireguard::{Keys, PORT, address, start as start_end};
use crate::compare::{Dds, Program, Side};

/// The interval at which each end keeps its NAT open.
const KEEP_ALIVE_SECONDS: u16 = 5;
/// Time between the starts of the ends. Two ends that start within the delay of the path send their first handshakes
/// across each other. Each then takes the other's and gives up its own, and `wireguard-go` of Debian 12 tries again in
/// step with the other end, at times for more than a minute.
const APART: Duration = Duration::from_secs(1);

/// Fields go in this order.
struct WireGuard {
    pair: Box<dyn Pair>,
    _ends: [Program; 2],
}

/// Starts the end of the right site, and then that of the left one. Messages are those of plain sockets in the tunnel,
/// or those of DDS.
pub(super) fn start(lab: &Lab, has_dds: bool) -> Result<(Box<dyn Pair>, Start)> {
    let dir = lab.new_dir("wireguard")?;
    let keys = [Keys::make(&dir, Side::Left)?, Keys::make(&dir, Side::Right)?];
    let end = |side: Side| {
        let other = SocketAddr::new(Lab::outside(side.other()).into(), PORT);
        let dir = lab.new_dir(side.name())?;
        start_end(lab.site(side), &dir, side, &keys, Some((other, KEEP_ALIVE_SECONDS)))
    };
    let right = end(Side::Right)?;
    std::thread::sleep(APART);
    let begun = Instant::now();
    let left = end(Side::Left)?;
    let both_up = begun.elapsed();
    let (sockets, known) = Sockets::in_tunnel(lab, Side::BOTH.map(address))?;
    let first = ms(both_up + known);
    // All that passes is direct.
    let mut start =
        Start { first_ms: Some(first), direct_ms: Some(first), known_to_direct_ms: Some(ms(known)) };
    let mut pair: Box<dyn Pair> = Box::new(sockets);
    if has_dds {
        let dds = Side::BOTH.map(|side| Dds::between(address(side), address(side.other())));
        let mut programs = Programs::start(lab, &dds)?;
        programs.wait_for_first()?;
        pair = Box::new(programs);
        // The programs start after the tunnel, so their first message says nothing of it.
        start = Start::default();
    }
    Ok((Box::new(WireGuard { pair, _ends: [left, right] }), start))
}

impl Pair for WireGuard {
    fn round_trips(&mut self, size: usize, plan: &Plan) -> Result<Vec<f64>> {
        self.pair.round_trips(size, plan)
    }

    fn throughput(&mut self, plan: &Plan) -> Result<f64> {
        self.pair.throughput(plan)
    }
}
