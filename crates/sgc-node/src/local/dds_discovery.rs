//! DDS discovery of the local network, whose events go to the control task.

use sgc_ros::{RosError, RosNetwork};
use tokio::sync::mpsc;

use crate::control::event::CoreEvent;

/// Starts discovery, whose events go to the control task.
pub(crate) fn discover<N: RosNetwork>(network: &N, events: mpsc::Sender<CoreEvent>) -> Result<(), RosError> {
    network.discover(Box::new(move |event| {
        let _ = events.blocking_send(CoreEvent::Discovery(event));
    }))
}
