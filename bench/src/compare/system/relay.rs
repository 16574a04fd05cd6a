//! Two programs that do no more than carry messages from one DDS network to the other over TCP: about the least that
//! short messages can take where a program at each place joins the networks. No user would want one.

use anyhow::{Result, ensure};
use sgc_dds::config::{FRAGMENT_BYTES, HEARTBEAT_MS, MESSAGE_BYTES_MAX, RECEIVE_BUFFER_BYTES};

use super::{Dds, Networks, Running, System, Topic};
use crate::compare::lab::{Lab, Side};

const PORT: u16 = 7447;

/// A relay at each place; the right one listens. For one topic each way.
pub(crate) struct Relay {
    /// Many messages at a time, by a thread of its own, which suits rates; otherwise each at once, which suits round
    /// trips.
    gathers: bool,
}

/// Both kinds.
pub(crate) fn all() -> [Relay; 2] {
    [false, true].map(|gathers| Relay { gathers })
}

impl System for Relay {
    fn name(&self) -> String {
        if self.gathers { "relay-gathers" } else { "relay" }.into()
    }

    fn start(&self, lab: &Lab, topics: &[Topic]) -> Result<Running> {
        let dds = Side::BOTH.map(|side| lab.networks.local(side));
        let mut running = Running { processes: Vec::new(), dds };
        let address = format!("{}:{PORT}", lab.address(Side::Right));
        for (side, way, begun) in [(Side::Right, "--listen", "listening"), (Side::Left, "--connect", "up")] {
            let mut args = vec!["relay", way, &address];
            for (what, towards) in [("--take", side.other()), ("--give", side)] {
                let mut its = topics.iter().filter(|topic| topic.towards == towards);
                args.extend(its.next().iter().flat_map(|topic| [what, topic.name]));
                ensure!(its.next().is_none(), "a relay carries one topic each way");
            }
            if self.gathers {
                args.push("--gathers");
            }
            if lab.networks == Networks::Stock {
                args.push("--ros2");
            }
            let mut program = lab.load_in(&own_dds(lab.networks, side), side, &args)?;
            program.soon(begun)?;
            running.processes.push((side, program));
        }
        // It goes on once the other end is there.
        running.processes[0].1.soon("up")?;
        Ok(running)
    }
}

/// Its own Cyclone is set as that of `sgc` is, so that what differs is what they do.
fn own_dds(networks: Networks, side: Side) -> Dds {
    let mut dds = networks.local(side);
    let general = format!(
        "<MaxMessageSize>{MESSAGE_BYTES_MAX}B</MaxMessageSize><FragmentSize>{FRAGMENT_BYTES}B</FragmentSize></General>\
         <Internal><HeartbeatInterval>{HEARTBEAT_MS} ms</HeartbeatInterval>\
         <SocketReceiveBufferSize min=\"default\" max=\"{RECEIVE_BUFFER_BYTES}B\"/></Internal>"
    );
    let plain = "<CycloneDDS><Domain Id=\"any\"><General></General></Domain></CycloneDDS>";
    let uri = dds.uri.take().unwrap_or_else(|| plain.to_owned());
    dds.uri = Some(uri.replace("</General>", &general));
    dds
}
