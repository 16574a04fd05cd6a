//! The tasks around a link: dialling and accepting, and moving what comes in to where it belongs.
//!
//! Control frames go to the control task; packets go straight to the data path, on the task that read them.

use std::sync::Arc;
use std::time::Duration;

use rand_core::{OsRng, TryRngCore};
use sgc_router::LinkId;
use sgc_transport::{AnyLink, CloseReason, Dialer, FlowError, Link, LinkError, LinkUrl, Listener};
use sgc_wire::{Control, Decode, Encode};
use tokio::sync::{mpsc, oneshot};
use tracing::{debug, info, warn};

use crate::core::CoreEvent;
use crate::dataplane::DataPlane;
use crate::stats::DataDrop;

/// Control frames that may wait for one link. A peer that takes so long is not one to keep in step with.
const CONTROL_FRAMES_MAX: usize = 8192;
const BACKOFF_MIN: Duration = Duration::from_millis(250);
const BACKOFF_MAX: Duration = Duration::from_secs(10);

/// Sends frames of the control task over a link, in order.
pub(crate) struct ControlTx {
    frames: mpsc::Sender<Control>,
}

impl ControlTx {
    /// Queues a frame; false if the peer is too far behind.
    pub(crate) fn send(&self, frame: Control) -> bool {
        self.frames.try_send(frame).is_ok()
    }
}

/// Keeps a link to one router: dials, and dials again with patience and jitter whenever the link ends.
pub(crate) async fn keep_dialled(url: LinkUrl, dialer: Arc<Dialer>, core: mpsc::Sender<CoreEvent>) {
    let mut failures = 0u32;
    loop {
        match dialer.dial(&url).await {
            Ok(link) => {
                failures = 0;
                let end = serve(link, Some(url.to_string()), &core).await;
                info!(%url, "link ended: {end}");
            }
            Err(error) => {
                // The first failure is news, the tenth is not.
                if failures == 0 {
                    warn!("cannot connect: {error}; trying again until it works");
                } else {
                    debug!("cannot connect: {error}");
                }
                failures = failures.saturating_add(1);
            }
        }
        if core.is_closed() {
            return;
        }
        let wait = (BACKOFF_MIN * 2u32.saturating_pow(failures.saturating_sub(1).min(10))).min(BACKOFF_MAX);
        let jitter = f64::from(OsRng.try_next_u32().unwrap_or(0) % 1000) / 1000.0;
        tokio::time::sleep(wait.mul_f64(0.5 + jitter / 2.0)).await;
    }
}

/// Accepts links until the node ends.
pub(crate) async fn keep_accepting(
    mut listener: Listener,
    core: mpsc::Sender<CoreEvent>,
    mut stop: oneshot::Receiver<()>,
) {
    loop {
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            _ = &mut stop => None,
        };
        match accepted {
            Some(Ok(link)) => {
                let core = core.clone();
                tokio::spawn(async move {
                    let remote = link.remote();
                    let end = serve(link, None, &core).await;
                    info!(%remote, "link ended: {end}");
                });
            }
            Some(Err(refused)) => warn!("{refused}"),
            None => return listener.close(CloseReason::Goodbye).await,
        }
    }
}

/// Reports a link to the control task and waits for its end.
async fn serve(link: AnyLink, url: Option<String>, core: &mpsc::Sender<CoreEvent>) -> LinkError {
    let (frames, outgoing) = mpsc::channel(CONTROL_FRAMES_MAX);
    let (reply, id) = oneshot::channel();
    let up = CoreEvent::LinkUp { link: link.clone(), url, control: ControlTx { frames }, reply };
    let id = match (core.send(up).await, id.await) {
        (Ok(()), Ok(Some((id, data)))) => {
            info!(link = id.0, remote = %link.remote(), peer = %link.peer().node_id.short(), "link is up");
            spawn_tasks(&link, id, data, outgoing, core);
            Some(id)
        }
        _ => {
            link.close(CloseReason::Goodbye);
            None
        }
    };
    let end = link.closed().await;
    if let Some(id) = id {
        let _ = core.send(CoreEvent::LinkDown { id }).await;
    }
    end
}

fn spawn_tasks(
    link: &AnyLink,
    id: LinkId,
    data: Arc<DataPlane>,
    outgoing: mpsc::Receiver<Control>,
    core: &mpsc::Sender<CoreEvent>,
) {
    tokio::spawn(send_control(link.clone(), outgoing));
    tokio::spawn(receive_control(link.clone(), id, core.clone()));
    tokio::spawn(receive_flows(link.clone(), id, data.clone()));
    tokio::spawn(receive_datagrams(link.clone(), id, data));
}

async fn send_control(link: AnyLink, mut outgoing: mpsc::Receiver<Control>) {
    while let Some(frame) = outgoing.recv().await {
        if let Err(error) = link.send_control(frame.to_bytes()).await {
            debug!(%error, "control frame not sent");
            return;
        }
    }
}

async fn receive_control(link: AnyLink, id: LinkId, core: mpsc::Sender<CoreEvent>) {
    while let Ok(bytes) = link.recv_control().await {
        match Control::from_slice(&bytes) {
            Ok(frame) => {
                if core.send(CoreEvent::Frame { link: id, frame }).await.is_err() {
                    return;
                }
            }
            Err(error) => {
                warn!(link = id.0, remote = %link.remote(), %error, "malformed control frame; the link is closed");
                let _ = core.send(CoreEvent::Malformed { link: id }).await;
                return link.close(CloseReason::Protocol(error.to_string()));
            }
        }
    }
}

async fn receive_flows(link: AnyLink, id: LinkId, data: Arc<DataPlane>) {
    while let Ok(mut flow) = link.accept_flow().await {
        let (data, remote) = (data.clone(), link.remote());
        tokio::spawn(async move {
            loop {
                match flow.recv().await {
                    Ok(Some(packet)) => data.forward(id, packet).await,
                    Ok(None) => return,
                    Err(FlowError::Link(_) | FlowError::Ended(_)) => return,
                    Err(error) => {
                        // Cut short is what a lost link looks like; anything else is the peer's doing.
                        let broken = !matches!(error, FlowError::Truncated);
                        if broken && data.drops().count_from(DataDrop::Malformed.key(), id) {
                            warn!(link = id.0, %remote, %error, "a peer sends malformed flows; counted from here on");
                        }
                        debug!(link = id.0, %remote, %error, "flow ended early");
                        return;
                    }
                }
            }
        });
    }
}

async fn receive_datagrams(link: AnyLink, id: LinkId, data: Arc<DataPlane>) {
    while let Ok(received) = link.recv_datagram().await {
        match received {
            Ok(packet) => data.forward(id, packet).await,
            Err(error) => {
                debug!(link = id.0, %error, "malformed datagram");
                if data.drops().count_from(DataDrop::Malformed.key(), id) {
                    warn!(link = id.0, %error, "a peer sends malformed datagrams; counted from here on");
                }
            }
        }
    }
}
