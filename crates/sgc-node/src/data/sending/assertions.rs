//! Liveliness assertions of publishers without messages (manual by topic), which other networks see as if they happened
//! there.
//!
//! The local network returns the time of a publisher's last assertion ([`RosNetwork::renewed_ago`]) but no event. So a
//! task asks a few times per lease and publishes news as a mark ([`sgc_endpoint::Source::assert_publisher`]). On the
//! other network the mark asserts the writer, whose lease expires without it.

use std::sync::Weak;
use std::time::Instant;

use sgc_ros::{Guid, RosNetwork};

use crate::data::sending::share::LocalShare;
use crate::local::network_slot::NetworkSlot;

/// Publishes assertions of a share's publishers, while there are any that may assert manually.
pub(crate) async fn watch<N: RosNetwork>(share: Weak<LocalShare>, network: NetworkSlot<N>) {
    loop {
        let wait = {
            let Some(share) = share.upgrade() else { return };
            let network = network.get();
            let renewed_ago = |writer: &Guid| network.as_ref()?.renewed_ago(writer);
            let Some(wait) = share.look_for_assertions(Instant::now(), renewed_ago) else { return };
            wait
        };
        tokio::time::sleep(wait).await;
    }
}
