//! [`ServedService`]: a service that a client serves. Requests go to the client as op `call_service`, and answers come back
//! as `service_response`.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use sgc_ros::RequestId;
use sgc_sync::lock;
use tokio::task::JoinHandle;

use super::envelope::Envelope;
use super::op::OpId;
use super::outbox::{Level, Outbox};
use crate::content::Form;
use crate::service::{Replier, Serving};

/// Most unanswered requests. Beyond that the oldest is given up.
const PENDING_MAX: usize = 1024;

/// The forwarded requests by number.
type Pending = BTreeMap<u64, RequestId>;

/// Returns a number that is unique in the process, so that a late answer matches no other request.
pub(super) fn next_number() -> u64 {
    static NEXT: AtomicU64 = AtomicU64::new(0);
    NEXT.fetch_add(1, Ordering::Relaxed)
}

/// A service that a client serves, until dropped.
#[derive(Debug)]
pub(super) struct ServedService {
    replier: Replier,
    pending: Arc<Mutex<Pending>>,
    prefix: Arc<str>,
    task: JoinHandle<()>,
}

impl Drop for ServedService {
    fn drop(&mut self) {
        self.task.abort();
    }
}

impl ServedService {
    pub(super) fn new(serving: Serving, outbox: Outbox) -> Self {
        let replier = serving.replier();
        let pending = Arc::default();
        let prefix: Arc<str> = format!("service_request:{}:", serving.service()).into();
        let task = tokio::spawn(ask(serving, Arc::clone(&pending), Arc::clone(&prefix), outbox));
        Self { replier, pending, prefix, task }
    }

    pub(super) fn replier(&self) -> &Replier {
        &self.replier
    }

    fn number(&self, id: Option<&OpId>) -> Option<u64> {
        let Some(OpId::Text(id)) = id else { return None };
        id.strip_prefix(&*self.prefix)?.parse().ok()
    }

    /// Returns the request that an answer belongs to.
    pub(super) fn request(&self, id: Option<&OpId>) -> Option<RequestId> {
        lock(&self.pending).get(&self.number(id)?).copied()
    }

    /// Removes a request that was answered.
    pub(super) fn answered(&self, id: Option<&OpId>) {
        if let Some(number) = self.number(id) {
            lock(&self.pending).remove(&number);
        }
    }
}

/// Forwards requests as fast as the client reads them.
async fn ask(mut serving: Serving, pending: Arc<Mutex<Pending>>, prefix: Arc<str>, outbox: Outbox) {
    while let Some(request) = serving.next().await {
        let _turn = outbox.turn().await;
        let args = match serving.write(&request, Form::Json) {
            Ok(args) => args,
            Err(error) => {
                outbox.try_status(Level::Error, &format!("{}: {error}", serving.service()), None);
                continue;
            }
        };
        let number = {
            let mut pending = lock(&pending);
            let number = next_number();
            pending.insert(number, request.id);
            if pending.len() > PENDING_MAX {
                pending.pop_first();
            }
            number
        };
        let call = Envelope::json("call_service")
            .text("id", &format!("{prefix}{number}"))
            .text("service", serving.service())
            .content("args", &args);
        if outbox.say(call.finish()).await.is_err() {
            return;
        }
    }
}
