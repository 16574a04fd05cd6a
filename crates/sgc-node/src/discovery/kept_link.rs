//! Keeps the link of one attempt at a router until it ends.

use sgc_transport::{CloseReason, Link as _};
use sgc_wire::NodeId;
use tokio::sync::watch;

use super::{DialTarget, DialledLink, KeepLink, LinkKeeper, LinkRequest, Outcome, StatusRow};
use crate::link::renewal::{Signals, keep_renewed};
use crate::link::roaming::Network;

impl KeepLink for LinkKeeper {
    async fn keep_link(
        &self,
        mut target: watch::Receiver<DialTarget>,
        request: &LinkRequest,
        row: &StatusRow,
    ) -> Outcome {
        // Subscribe before dialling, since a later subscription could miss a change during this attempt.
        let mut redial = self.redial.clone();
        redial.mark_unchanged();
        let network = self.network.onward();
        let first = target.borrow_and_update().clone();
        row.connecting(&first);
        let DialledLink { link, url, passed } = match self.dial(&first).await {
            Ok(dialled) => dialled,
            Err(why) => return Outcome::Failed(why),
        };
        let (node, remote) = (link.peer().node_id, link.remote());
        let (claim, _place) = match self.enter(&link, request) {
            Ok(entered) => entered,
            Err(why) => {
                link.close(CloseReason::Goodbye);
                return Outcome::Failed(why);
            }
        };
        self.linked(&first, &url, &passed, &node, row);
        let signals = Signals { target, redial, network };
        let end = keep_renewed(link, url, signals, request, self, claim, row).await;
        Outcome::Ended { remote, end }
    }

    async fn released(&self, node: &NodeId) {
        self.claims.released(node).await;
    }

    fn network(&self) -> Network {
        self.network.onward()
    }

    fn is_over(&self) -> bool {
        self.core.is_closed()
    }
}
