//! Received packets: the task that reads a packet passes it to the data path.

use std::sync::Arc;

use sgc_router::LinkId;
use sgc_session::Activity;
use sgc_transport::{AnyLink, FlowEnd, FlowError, FlowRx, Link, ReceivedDatagram};
use sgc_wire::{DecodeError, Name, Packet};
use tracing::{debug, warn};

use crate::control::peers::peer_rate::PeerRate;
use crate::data::dataplane::DataPlane;
use crate::data::stats::{CountDrops, DataDrop};

/// Passes received packets to the data path, within the peer's rate.
#[derive(Clone)]
pub(crate) struct Inflow {
    link: AnyLink,
    /// The only accepted name, if the packets come over a lane.
    only: Option<Name>,
    id: LinkId,
    data: Arc<DataPlane>,
    rate: Arc<PeerRate>,
    activity: Arc<Activity>,
}

/// Decision about a packet.
enum PacketAdmission {
    /// The packet is forwarded.
    Granted,
    /// The packet is dropped, and so is the rest of its message.
    OverRate,
    /// The link ended meanwhile.
    LinkEnded,
}

impl Inflow {
    /// Creates the inflow of a link.
    pub(crate) fn new(link: &AnyLink, id: LinkId, data: Arc<DataPlane>, activity: Arc<Activity>) -> Self {
        let rate = data.rates().for_peer(link.peer().node_id);
        Self { link: link.clone(), only: None, id, data, rate, activity }
    }

    /// Returns an inflow for a lane of the link.
    pub(crate) fn by_lane(&self, lane: AnyLink, name: Name) -> Self {
        Self { link: lane, only: Some(name), ..self.clone() }
    }

    /// Starts the receiving tasks.
    pub(crate) fn spawn(self) {
        tokio::spawn(self.clone().accept_flows());
        tokio::spawn(self.read_datagrams());
    }

    /// Returns `true` if a packet may come here, and counts it as a drop otherwise.
    fn belongs(&self, packet: &Packet) -> bool {
        let belongs = self.only.is_none_or(|only| only == packet.header.name);
        if !belongs {
            self.data.drop_packet(self.id, packet, DataDrop::WrongWay);
        }
        belongs
    }

    /// Decides about a packet. A message that cannot wait is judged at its beginning; once it is under way it is slowed
    /// like a reliable one.
    async fn admit(&self, packet: &Packet) -> PacketAdmission {
        self.activity.note();
        let rate = &self.rate;
        let bytes = packet.encoded_bytes();
        if !packet.header.reliable && packet.header.index == 0 {
            return if rate.take_now(bytes) { PacketAdmission::Granted } else { PacketAdmission::OverRate };
        }
        let wait = rate.take_later(bytes);
        if wait.is_zero() {
            return PacketAdmission::Granted;
        }
        tokio::select! {
            () = tokio::time::sleep(wait) => PacketAdmission::Granted,
            _ = self.link.closed() => PacketAdmission::LinkEnded,
        }
    }

    async fn accept_flows(self) {
        while let Ok(flow) = self.link.accept_flow().await {
            tokio::spawn(self.clone().read_flow(flow));
        }
    }

    async fn read_flow(self, mut flow: FlowRx) {
        let (id, data, remote) = (self.id, &self.data, self.link.remote());
        loop {
            match flow.recv().await {
                Ok(Some(packet)) if !self.belongs(&packet) => return flow.stop(FlowEnd::Unwanted),
                Ok(Some(packet)) => match self.admit(&packet).await {
                    // A single packet on an idle flow is forwarded right here, since the tasks that it wakes have no
                    // other work.
                    PacketAdmission::Granted if flow.is_at_rest() && packet.header.fragments() == 1 => {
                        sgc_executor::poll_at_hand(data.forward(id, packet)).await;
                    }
                    PacketAdmission::Granted => data.forward(id, packet).await,
                    PacketAdmission::OverRate if packet.header.fragments() == 1 => {}
                    PacketAdmission::OverRate => return flow.stop(FlowEnd::Stale),
                    PacketAdmission::LinkEnded => return,
                },
                Ok(None) => return,
                Err(FlowError::Link(_) | FlowError::Ended(_)) => return,
                Err(error) => {
                    // A truncated flow is a sign of a lost link; any other error is the peer's mistake.
                    let reason = match &error {
                        FlowError::Truncated => None,
                        FlowError::Packet(error) => Some(malformed(error)),
                        _ => Some(DataDrop::Malformed),
                    };
                    if reason.is_some_and(|reason| data.drops().count_from(reason, id)) {
                        warn!(link = id.0, %remote, %error, "a peer sends malformed flows; counted from here on");
                    }
                    debug!(link = id.0, %remote, %error, "flow ended early");
                    return;
                }
            }
        }
    }

    async fn read_datagrams(self) {
        let (id, data) = (self.id, &self.data);
        while let Ok(received) = self.link.recv_datagram().await {
            match received {
                // A datagram is never delayed, whatever its header says, since it would delay those behind it.
                ReceivedDatagram::Packet(packet) if !self.belongs(&packet) => {}
                ReceivedDatagram::Packet(packet) => {
                    self.activity.note();
                    if self.rate.take_now(packet.encoded_bytes()) {
                        data.forward(id, packet).await;
                    }
                }
                ReceivedDatagram::Malformed(error) => {
                    debug!(link = id.0, %error, "malformed datagram");
                    if data.drops().count_from(malformed(&error), id) {
                        warn!(link = id.0, %error, "a peer sends malformed datagrams; counted from here on");
                    }
                }
            }
        }
    }
}

fn malformed(error: &DecodeError) -> DataDrop {
    match error {
        DecodeError::UnknownLabel { .. } => DataDrop::UnknownLabel,
        _ => DataDrop::Malformed,
    }
}
