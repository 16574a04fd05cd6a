//! Two programs that do no more than carry messages from one DDS network to the other over TCP: about the least that
//! short messages can take where a program at each place joins the networks. No user would want one.

use anyhow::{Result, ensure};
use sgc_dds::config::{FRAGMENT_BYTES, HEARTBEAT_MS, MESSAGE_BYTES_MAX, RECEIVE_BUFFER_BYTES};

use super::{Dds, Networks, Running, System, Topic};
use crate::compare::lab::{Lab, Side};

const PORT: u16 = 7447;
const FORWARDER_PORT: u16 = 7448;

/// A relay at each place; the right one listens. For one topic each way.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Relay {
    /// Sends each message at once, which suits round trips.
    Plain,
    /// Sends many messages at a time, from a thread of its own, which suits rates.
    Gathers,
    /// [`Plain`](Self::Plain), with a program between that forwards the bytes of the connection. The difference is the
    /// least that a router costs.
    Forwarder,
}

/// Every kind.
pub(crate) const ALL: [Relay; 3] = [Relay::Plain, Relay::Gathers, Relay::Forwarder];

impl System for Relay {
    fn name(&self) -> String {
        match self {
            Self::Plain => "relay",
            Self::Gathers => "relay-gathers",
            Self::Forwarder => "relay-forwarder",
        }
        .into()
    }

    fn start(&self, lab: &Lab, topics: &[Topic]) -> Result<Running> {
        let dds = Side::BOTH.map(|side| lab.networks.local(side));
        let mut running = Running { processes: Vec::new(), dds };
        let address = format!("{}:{PORT}", lab.address(Side::Right));
        let dials = match self {
            Self::Forwarder => format!("{}:{FORWARDER_PORT}", lab.address(Side::Right)),
            Self::Plain | Self::Gathers => address.clone(),
        };
        for (side, way, at, begun) in
            [(Side::Right, "--listen", &address, "listening"), (Side::Left, "--connect", &dials, "up")]
        {
            if *self == Self::Forwarder && side == Side::Left {
                // At the right place, where the router of `sgc` is.
                let args = ["forwarder", "--listen", &dials, "--connect", &address];
                let mut program = lab.load_alone(Side::Right, &args)?;
                program.soon("listening")?;
                running.processes.push((Side::Right, program));
            }
            let mut args = vec!["relay", way, at];
            for (what, towards) in [("--take", side.other()), ("--give", side)] {
                let mut its = topics.iter().filter(|topic| topic.towards == towards);
                args.extend(its.next().iter().flat_map(|topic| [what, topic.name]));
                ensure!(its.next().is_none(), "a relay carries one topic each way");
            }
            if *self == Self::Gathers {
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
