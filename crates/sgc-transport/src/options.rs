//! What can be set of links. Every number is a bound; none can be infinite.

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use quinn::congestion::ControllerFactory;

/// Settings of the links of one listener or dialer. The default is meant for all.
#[derive(Clone)]
pub struct LinkOptions {
    /// How long a peer may take to connect and prove who it is.
    pub handshake_timeout: Duration,
    /// How long looking up a host name may take.
    pub resolve_timeout: Duration,
    /// How often something is sent on an idle link, so that NATs keep it and its end is noticed.
    pub keep_alive: Duration,
    /// How long nothing may arrive before a link counts as lost.
    pub idle_timeout: Duration,
    /// Most bytes that the peer may have sent and we not read, all flows of a link together.
    pub receive_window_bytes: u32,
    /// The same for one flow.
    pub flow_window_bytes: u32,
    /// Most bytes that we may have sent and the peer not acknowledged, all flows of a link together.
    pub send_window_bytes: u32,
    /// Most flows that the peer may have open at once.
    pub flows_max: u32,
    /// Most bytes of datagrams that wait to be sent: small, since what waits here can no longer be replaced by
    /// something newer.
    pub datagram_send_bytes: usize,
    /// Most bytes of datagrams that wait to be read; the oldest go first.
    pub datagram_receive_bytes: usize,
    /// Most handshakes that a listener works on at once.
    pub handshakes_max: usize,
    /// From how many on a peer first has to prove that it receives at its address (QUIC Retry).
    pub handshakes_unvalidated_max: usize,
    /// Key exchange that also stands against quantum computers (X25519MLKEM768). True: nothing else is offered or
    /// accepted, so no one can talk the two ends out of it. False: X25519 is preferred, and a peer that requires the
    /// other gets it. An identity of a fleet that requires it requires it here too.
    pub post_quantum: bool,
    /// Makes the congestion controllers; `None` is quinn's default.
    pub congestion: Option<Arc<dyn ControllerFactory + Send + Sync + 'static>>,
}

impl Default for LinkOptions {
    fn default() -> Self {
        Self {
            handshake_timeout: Duration::from_secs(5),
            resolve_timeout: Duration::from_secs(5),
            keep_alive: Duration::from_secs(1),
            idle_timeout: Duration::from_secs(10),
            receive_window_bytes: 64 << 20,
            flow_window_bytes: 32 << 20,
            send_window_bytes: 16 << 20,
            flows_max: 4096,
            datagram_send_bytes: 64 << 10,
            datagram_receive_bytes: 1 << 20,
            handshakes_max: 256,
            handshakes_unvalidated_max: 32,
            post_quantum: false,
            congestion: None,
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
            .field("post_quantum", &self.post_quantum)
            .finish_non_exhaustive()
    }
}
