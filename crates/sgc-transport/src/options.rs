//! Settings of links. Every number is a bound; none can be infinite.

use std::fmt;
use std::time::Duration;

use crate::budget::ReceiveBudget;
use crate::congestion::Congestion;

/// Whether QUIC links have bulk lanes, and which socket of a listener takes them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum BulkLanes {
    /// Links have none.
    #[default]
    Off,
    /// A QUIC listener opens the TCP port of its number for them. It does without them if the port is taken.
    Own,
    /// A TLS listener at the TCP port of the same number takes them. Dialers make no difference.
    ByTlsListener,
}

/// Settings of the links of one listener or dialer. The defaults suit all.
#[derive(Clone)]
pub struct LinkOptions {
    /// Time in which a peer has to connect and prove its identity.
    pub handshake_timeout: Duration,
    /// Time for looking up a host name.
    pub resolve_timeout: Duration,
    /// Interval of packets on an idle link, so that NATs keep it and its end is noticed.
    pub keep_alive: Duration,
    /// Time without input after which a link counts as lost.
    pub idle_timeout: Duration,
    /// Most bytes that the peer may have sent before they are read here, all flows of a link together. Where there are
    /// many links the window is smaller, by [`Self::receive_budget`].
    pub receive_window_bytes: u32,
    /// Most bytes of one flow that the peer may have sent before they are read here; at most half of the link's.
    pub flow_window_bytes: u32,
    /// The budget for the windows of all links. Clones of these settings share it.
    pub receive_budget: ReceiveBudget,
    /// Most bytes that may be sent and not acknowledged, all flows of a link together.
    pub send_window_bytes: u32,
    /// Most flows that the peer may have open at once.
    pub flows_max: u32,
    /// Most bytes of datagrams that wait to be sent. It is small, because newer data can no longer replace waiting
    /// datagrams.
    pub datagram_send_bytes: usize,
    /// Most bytes of datagrams that wait to be read; the oldest go first.
    pub datagram_receive_bytes: usize,
    /// Most handshakes that a listener works on at once.
    pub handshakes_max: usize,
    /// Most handshakes from one IPv4 address or one IPv6 network of 64 bits ([`sgc_trust::AddressPrefix`]).
    pub handshakes_per_address_max: usize,
    /// Number of handshakes from which on a peer first has to prove that it receives at its address (QUIC Retry; a
    /// ticket, over DTLS).
    pub handshakes_unvalidated_max: usize,
    /// Whether keys have to withstand quantum computers (X25519MLKEM768). `true`: nothing else is offered or accepted,
    /// so nobody can talk the two ends out of it. `false`: X25519 is preferred, and a peer that requires the other gets
    /// it. An identity of a fleet that requires it requires it here too.
    pub post_quantum: bool,
    /// Whether UDP uses segmentation and receive offloads, where the system has them. Without them datagrams are sent
    /// and received one by one, for faulty drivers. ECN, the choice of the source address on hosts with several, and
    /// MTU discovery are then off, too. A link with a [`Self::dscp`] has none of these either.
    pub offload: bool,
    /// Whether links over UDP look for the longest packet that the path carries; otherwise they stay at 1200 bytes.
    /// Packets inside of DTLS are at most 1340 bytes long.
    pub mtu_discovery: bool,
    /// Whether to speak DTLS 1.2 with listeners that have no 1.3. Anyone on the way can then make a dialer fall back to
    /// it, and sees the certificates of both ends.
    pub dtls12: bool,
    /// The code point of differentiated services (RFC 2474), 0 to 63, on everything that a link sends.
    pub dscp: Option<u8>,
    /// Whether QUIC links may have bulk lanes: TLS connections for large topics (`docs/spec/wire.md`, lanes).
    pub bulk_lanes: BulkLanes,
    /// The congestion controller.
    pub congestion: Congestion,
}

impl Default for LinkOptions {
    fn default() -> Self {
        Self {
            handshake_timeout: Duration::from_secs(5),
            resolve_timeout: Duration::from_secs(5),
            keep_alive: Duration::from_secs(1),
            idle_timeout: Duration::from_secs(10),
            receive_window_bytes: 32 << 20,
            flow_window_bytes: 16 << 20,
            receive_budget: ReceiveBudget::default(),
            send_window_bytes: 32 << 20,
            flows_max: 4096,
            datagram_send_bytes: 64 << 10,
            datagram_receive_bytes: 1 << 20,
            handshakes_max: 256,
            handshakes_per_address_max: 64,
            handshakes_unvalidated_max: 32,
            post_quantum: false,
            offload: true,
            mtu_discovery: true,
            dtls12: false,
            dscp: None,
            bulk_lanes: BulkLanes::Off,
            congestion: Congestion::Delay,
        }
    }
}

impl fmt::Debug for LinkOptions {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("LinkOptions")
            .field("handshake_timeout", &self.handshake_timeout)
            .field("keep_alive", &self.keep_alive)
            .field("idle_timeout", &self.idle_timeout)
            .field("receive_window_bytes", &self.receive_window_bytes)
            .field("send_window_bytes", &self.send_window_bytes)
            .field("flows_max", &self.flows_max)
            .field("handshakes_max", &self.handshakes_max)
            .field("handshakes_per_address_max", &self.handshakes_per_address_max)
            .field("post_quantum", &self.post_quantum)
            .field("offload", &self.offload)
            .field("mtu_discovery", &self.mtu_discovery)
            .field("dtls12", &self.dtls12)
            .field("dscp", &self.dscp)
            .field("bulk_lanes", &self.bulk_lanes)
            .field("congestion", &self.congestion)
            .finish_non_exhaustive()
    }
}
