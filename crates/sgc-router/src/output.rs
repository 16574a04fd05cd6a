//! Work for the driver, and the queue in which it waits.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Instant;

use sgc_trust::TrustAnchors;
use sgc_wire::{Control, Name};

use crate::drops::RouterDrop;
use crate::fib::FibEntry;
use crate::link_id::LinkId;
use crate::store::StoreOp;

/// Work for the driver.
#[derive(Clone, Debug)]
pub enum Output {
    /// Send a frame over a link; over [`LinkId::LOCAL`], hand it to the endpoint.
    Send {
        /// The link.
        link: LinkId,
        /// The frame.
        frame: Control,
    },
    /// The forwarding of a name changed; `None` ends it.
    Forward {
        /// The name.
        name: Name,
        /// The new entry.
        entry: Option<FibEntry>,
    },
    /// Close a link; the driver then reports it down.
    Close {
        /// The link.
        link: LinkId,
        /// The reason.
        reason: LinkClose,
    },
    /// The trust anchors changed, because a newer revocation list came. The driver stores them, and passes them to
    /// everything else that verifies certificates.
    Trust(Arc<TrustAnchors>),
    /// Call [`Router::handle_flushed`](crate::Router::handle_flushed) once the link has taken all earlier frames; the
    /// router has more for it than a queue can hold.
    Flush {
        /// The link.
        link: LinkId,
    },
    /// Carry out an operation of the store, and report its result by
    /// [`Router::handle_store`](crate::Router::handle_store).
    Store(StoreOp),
    /// A frame or body was dropped: count it and, where it matters, log it.
    Dropped(RouterDrop),
    /// Nothing more to do until this time, or until something happens.
    Timeout(Option<Instant>),
}

/// The reason why a link is closed.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, thiserror::Error)]
pub enum LinkClose {
    /// Another run of the node has the place of this one.
    #[error("the node's identity is in use at another place")]
    Superseded {
        /// The link of the other run, if it is here; otherwise the other run is linked to another router.
        by: Option<LinkId>,
        /// Whether the closed run is known to live, because it came back after it was superseded once. The process of a
        /// run that just greeted anew is usually gone.
        alive: bool,
    },
    /// A frame came before the greeting, or a second greeting.
    #[error("the peer did not greet as the protocol says")]
    Greeting,
    /// The peer said goodbye.
    #[error("the peer closed in good order")]
    Goodbye,
    /// The link leads to this very node.
    #[error("the link leads to this node itself")]
    Loop,
    /// The node's certificate was revoked, or its CA is no longer trusted.
    #[error("the peer's certificate is revoked")]
    Revoked,
    /// The node's certificate has expired.
    #[error("the peer's certificate has expired")]
    Expired,
    /// The node has too many links.
    #[error("the peer has too many links")]
    TooMany,
    /// The peer sent too many bodies that do not verify.
    #[error("the peer keeps sending bodies that do not verify")]
    Forgeries,
}

/// The outputs that the driver has not taken yet.
#[derive(Debug, Default)]
pub(crate) struct Outputs {
    queue: VecDeque<Output>,
}

impl Outputs {
    /// Returns the next output.
    pub(crate) fn pop(&mut self) -> Option<Output> {
        self.queue.pop_front()
    }

    /// Returns `true` if the driver took everything.
    pub(crate) fn is_empty(&self) -> bool {
        self.queue.is_empty()
    }

    /// Adds an output.
    pub(crate) fn push(&mut self, output: Output) {
        self.queue.push_back(output);
    }
}
