//! Tasks of a link: they accept, and pass on received frames and packets. `renewal.rs` replaces links that were
//! dialled.
//!
//! Control frames go to the control task. The task that reads a packet passes it straight to the data path.

use std::sync::Arc;
use std::time::Duration;

use sgc_router::LinkId;
use sgc_session::Activity;
use sgc_transport::{AnyLink, CloseReason, CredentialStore, Link, LinkError, Listener};
use sgc_wire::{Control, Decode, DecodeError, Encode};
use tokio::runtime::Handle;
use tokio::sync::{mpsc, oneshot, watch};
use tokio::time::{Instant, timeout, timeout_at};
use tracing::{debug, info, warn};

use crate::control::event::{CoreEvent, LinkPlace};
use crate::control::peers::control_queue::{ControlQueue, InboxShare, Outgoing};
use crate::control::peers::refusal_log::RefusalLog;
use crate::data::labels::{LabelBook, Progress};
use crate::discovery::Claims;
use crate::link::control_tx::ControlTx;
use crate::link::in_use::place_in_use;
use crate::link::inflow::Inflow;
use crate::link::lanes::{Dial, LaneAdmission, Lanes};
use crate::state::audit::{Audit, AuditEvent, AuditRecord};

/// Time for a replacement link to settle before the old one goes.
const SETTLE_MAX: Duration = Duration::from_secs(5);
/// Silence of control frames after which both sides have said everything: at least this long, and at least this many
/// round trips.
const QUIET_MIN: Duration = Duration::from_millis(100);
const QUIET_RTTS: u32 = 4;
/// Time for the peer to answer a goodbye.
const GOODBYE_MAX: Duration = Duration::from_secs(1);

/// Checks and registers incoming links.
pub(crate) struct Admission {
    pub(crate) core: mpsc::Sender<CoreEvent>,
    pub(crate) credentials: CredentialStore,
    pub(crate) claims: Claims,
    pub(crate) audit: Audit,
    pub(crate) lanes: LaneAdmission,
}

/// Accepts links until the node ends.
pub(crate) async fn keep_accepting(
    mut listener: Listener,
    admission: Admission,
    mut stop: oneshot::Receiver<()>,
) {
    let Admission { core, credentials, claims, audit, lanes } = admission;
    let mut refusals = RefusalLog::default();
    loop {
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            () = refusals.is_due() => {
                refusals.summarise();
                continue;
            }
            _ = &mut stop => None,
        };
        match accepted {
            Some(Ok(link)) if link.lane().is_some() => {
                if let Some(token) = link.lane() {
                    lanes.enter(token, link);
                }
            }
            Some(Ok(link)) => {
                let (core, credentials, claims) = (core.clone(), credentials.clone(), claims.clone());
                let lanes = lanes.clone();
                tokio::spawn(async move {
                    let _arrival = claims.note_arrival(link.peer().node_id);
                    let remote = link.remote();
                    let served = ReportedLink::start(link.clone(), None, lanes, &core).await;
                    // The credentials may have changed since the handshake. From here on the control task knows the
                    // link and cuts it itself.
                    if !credentials.admits(link.peer()) {
                        link.close(CloseReason::not_admitted());
                    }
                    let end = served.end(&core).await;
                    info!(%remote, "link ended: {end}");
                });
            }
            Some(Err(refused)) => {
                refusals.note(&refused);
                let record = AuditRecord::new(AuditEvent::LinkRefused).remote(refused.remote);
                audit.write(record.reason(&refused.reason));
            }
            None => return listener.close(CloseReason::Goodbye).await,
        }
    }
}

/// The place of a link, until it has come. If this is dropped before, and the control task has given the place, the link
/// ends: nobody else would report that.
struct AwaitedPlace {
    place: oneshot::Receiver<Option<LinkPlace>>,
    link: AnyLink,
    core: mpsc::Sender<CoreEvent>,
}

impl Drop for AwaitedPlace {
    fn drop(&mut self) {
        self.place.close();
        let (Ok(Some(place)), Ok(runtime)) = (self.place.try_recv(), Handle::try_current()) else { return };
        self.link.close(CloseReason::Goodbye);
        let core = self.core.clone();
        let down = CoreEvent::LinkDown { id: place.id, in_use: None, end: None };
        runtime.spawn(async move { core.send(down).await });
    }
}

/// A link that was reported to the control task.
pub(super) struct ReportedLink {
    pub(super) link: AnyLink,
    /// Number of the link; `None` if the node is stopping.
    id: Option<LinkId>,
    /// Number of control frames received.
    heard: watch::Receiver<u64>,
    lanes: Arc<Lanes>,
}

impl ReportedLink {
    /// Reports the link to the control task and starts to receive.
    pub(super) async fn start(
        link: AnyLink,
        dial: Option<Dial>,
        admission: LaneAdmission,
        core: &mpsc::Sender<CoreEvent>,
    ) -> Self {
        let (frames, outgoing) = ControlQueue::new();
        let (reply, id) = oneshot::channel();
        let (count, heard) = watch::channel(0);
        let progress = Arc::<Progress>::default();
        let activity = Arc::<Activity>::default();
        let url = dial.as_ref().map(|(_, url)| url.to_string());
        let lanes = Lanes::new(link.clone(), frames.clone(), dial, admission);
        let labels = LabelBook::new(progress.clone());
        let (activity_tx, lanes_tx) = (activity.clone(), lanes.clone());
        let control = ControlTx::new(frames.clone(), labels, activity_tx, lanes_tx);
        let up = CoreEvent::LinkUp { link: link.clone(), url, control, reply };
        let mut place = AwaitedPlace { place: id, link: link.clone(), core: core.clone() };
        let id = match (core.send(up).await, (&mut place.place).await) {
            (Ok(()), Ok(Some(LinkPlace { id, data, inbox }))) => {
                let inflow = Inflow::new(&link, id, data, activity);
                let of_lanes = inflow.clone();
                lanes.start(move |lane, name| of_lanes.by_lane(lane, name).spawn());
                let (core, lanes) = (core.clone(), lanes.clone());
                let reader =
                    ControlRx { link: link.clone(), id, frames, progress, lanes, count, core, inbox };
                spawn_tasks(inflow, outgoing, reader);
                Some(id)
            }
            _ => {
                link.close(CloseReason::Goodbye);
                None
            }
        };
        Self { link, id, heard, lanes }
    }

    /// Waits for the end of the link and reports it. Dropping the future is safe: the caller calls it again.
    pub(super) async fn end(&self, core: &mpsc::Sender<CoreEvent>) -> LinkError {
        let end = self.link.closed().await;
        self.lanes.close();
        if let Some(id) = self.id {
            let in_use = place_in_use(&end).map(str::to_owned);
            let _ = core.send(CoreEvent::LinkDown { id, in_use, end: Some(end.to_string()) }).await;
        }
        end
    }

    /// Waits until both sides have sent each other their state. No frame marks that point. Routes follow the greetings,
    /// and their consequences follow the routes, each within a round trip, so a few silent round trips are taken for
    /// it.
    ///
    /// Never returns on a link that has ended. Ends a link on which no frame arrives.
    pub(super) async fn settled(&self) {
        let mut heard = self.heard.clone();
        let deadline = Instant::now() + SETTLE_MAX;
        if timeout_at(deadline, heard.wait_for(|frames| *frames > 0)).await.is_err() {
            self.link.close(CloseReason::Protocol("no control frame came".into()));
        }
        while heard.has_changed().is_ok() {
            let quiet = QUIET_MIN.max(QUIET_RTTS * self.link.stats().rtt);
            heard.mark_unchanged();
            if timeout_at(deadline.min(Instant::now() + quiet), heard.changed()).await.is_err() {
                return;
            }
        }
        std::future::pending().await
    }

    /// Ends bulk lanes, because they do not follow the link to another address.
    pub(super) fn end_bulk_lanes(&self) {
        self.lanes.end_bulk();
    }

    /// Retires the link, because a newer one replaced it.
    pub(super) async fn retire(&self, core: &mpsc::Sender<CoreEvent>) {
        self.say_goodbye(CloseReason::Replaced, core).await;
        info!(remote = %self.link.remote(), "a newer link replaced this one");
    }

    /// Ends the link, because its peer is not wanted any more.
    pub(super) async fn leave(&self, core: &mpsc::Sender<CoreEvent>) {
        self.say_goodbye(CloseReason::Goodbye, core).await;
        info!(remote = %self.link.remote(), "link closed: its router is no longer configured");
    }

    /// Ends the link. The peer closes it in answer to the goodbye, which shows that it has received everything before.
    async fn say_goodbye(&self, reason: CloseReason, core: &mpsc::Sender<CoreEvent>) {
        let goodbye = async {
            let _ = self.link.send_control(Control::Goodbye.to_bytes()).await;
            self.link.closed().await
        };
        let _ = timeout(GOODBYE_MAX, goodbye).await;
        self.link.close(reason);
        self.end(core).await;
    }
}

fn spawn_tasks(inflow: Inflow, outgoing: mpsc::Receiver<Outgoing>, reader: ControlRx) {
    tokio::spawn(send_control(reader.link.clone(), reader.id, outgoing, reader.core.clone()));
    tokio::spawn(reader.run());
    inflow.spawn();
}

async fn send_control(
    link: AnyLink,
    id: LinkId,
    mut outgoing: mpsc::Receiver<Outgoing>,
    core: mpsc::Sender<CoreEvent>,
) {
    while let Some(next) = outgoing.recv().await {
        match next {
            Outgoing::Frame(frame) => {
                if let Err(error) = link.send_control(frame.to_bytes()).await {
                    debug!(%error, "control frame not sent");
                    return;
                }
            }
            Outgoing::Flush => {
                if core.send(CoreEvent::Flushed { link: id }).await.is_err() {
                    return;
                }
            }
        }
    }
}

/// Receives control frames. It handles frames about labels, lanes and pulses itself and passes the others to the
/// control task.
struct ControlRx {
    link: AnyLink,
    id: LinkId,
    /// Queue for acknowledgements.
    frames: ControlQueue,
    progress: Arc<Progress>,
    lanes: Arc<Lanes>,
    /// Number of received frames.
    count: watch::Sender<u64>,
    core: mpsc::Sender<CoreEvent>,
    /// Share of the inbox for frames that wait for the control task.
    inbox: InboxShare,
}

impl ControlRx {
    async fn run(self) {
        while let Ok(bytes) = self.link.recv_control().await {
            match self.take(bytes.len(), Control::from_slice(&bytes)).await {
                Ok(true) => self.count.send_modify(|n| *n += 1),
                Ok(false) => return,
                Err(error) => {
                    let (link, remote) = (self.id.0, self.link.remote());
                    warn!(link, %remote, error, "malformed control frame; the link is closed");
                    let _ = self.core.send(CoreEvent::Malformed { link: self.id }).await;
                    return self.link.close(CloseReason::Protocol(error));
                }
            }
        }
    }

    /// Queues an answer. Returns `false` if the peer is too far behind; the link then ends.
    fn answer(&self, frame: Control) -> bool {
        let is_sent = self.frames.push(frame);
        if !is_sent {
            warn!(link = self.id.0, remote = %self.link.remote(), "the peer does not take control frames; the link is closed");
            self.link.close(CloseReason::Overloaded);
        }
        is_sent
    }

    /// Handles a frame. Returns `Ok(false)` to stop receiving, and an error for a mistake of the peer.
    async fn take(&self, bytes: usize, frame: Result<Control, DecodeError>) -> Result<bool, String> {
        let frame = frame.map_err(|error| error.to_string())?;
        // The router judges the first frame, which has to be the greeting.
        let is_greeted = *self.count.borrow() > 0;
        match frame {
            Control::Label { label, name } if is_greeted => {
                self.link.define_label(label, name).map_err(|error| error.to_string())?;
                Ok(self.answer(Control::LabelAck { label }))
            }
            Control::Probe { answers: false } if is_greeted => {
                Ok(self.answer(Control::Probe { answers: true }))
            }
            // The receipt itself is the answer.
            Control::Probe { answers: true } if is_greeted => Ok(true),
            Control::LabelAck { label } if is_greeted => match self.progress.acknowledge(label) {
                true => Ok(true),
                false => Err(format!("label {} is acknowledged but was not given", label.index())),
            },
            frame @ (Control::LaneOffer { .. }
            | Control::LaneAnswer { .. }
            | Control::LaneWanted { .. }
            | Control::BulkLaneWanted { .. })
                if is_greeted =>
            {
                self.lanes.handle(&frame).map(|()| true)
            }
            frame => {
                let Some(room) = self.inbox.take(bytes).await else { return Ok(false) };
                Ok(self.core.send(CoreEvent::Frame { link: self.id, frame, room }).await.is_ok())
            }
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use std::future::Future;
    use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

    use rand_chacha::ChaCha20Rng;
    use rand_core::{OsRng, SeedableRng as _, TryRngCore as _};
    use sgc_transport::{CredentialStore, Dialer, LinkOptions, LinkUrl, RefusalKind, TransportMetrics};
    use sgc_trust::{CertId, EnrollRequest, Fleet, Identity};
    use sgc_wire::{Hello, Label, Name, UnixMillis};

    use super::*;
    use crate::clock::now;
    use crate::control::peers::control_queue::{Inbox, LINK_INBOX_BYTES_MAX};
    use crate::discovery::{
        Board, DialTarget, Dns, KeepLink as _, LinkKeeper, LinkRequest, WorkingUrls, keep_at,
    };
    use crate::link::roaming::Network;

    /// Event that the test's control task reports about links.
    #[derive(Debug, PartialEq)]
    enum LinkEvent {
        Up(LinkId, CertId),
        Down(LinkId),
    }

    /// Greets on each link and closes links whose peers say goodbye, as the machines do.
    fn control_task(
        closes: Arc<AtomicBool>,
        mute: Arc<AtomicBool>,
        mut close: mpsc::Receiver<LinkId>,
    ) -> (mpsc::Sender<CoreEvent>, mpsc::Receiver<LinkEvent>) {
        let (events, mut inbox) = mpsc::channel(64);
        let (tell, told) = mpsc::channel(64);
        tokio::spawn(async move {
            let mut links: Vec<(AnyLink, ControlTx)> = Vec::new();
            loop {
                let event = tokio::select! {
                    Some(id) = close.recv() => {
                        links[id.0 as usize - 1].0.close(CloseReason::Goodbye);
                        continue;
                    }
                    event = inbox.recv() => event,
                };
                let Some(event) = event else { return };
                match event {
                    CoreEvent::LinkUp { link, control, reply, .. } => {
                        let id = LinkId(links.len() as u32 + 1);
                        tell.send(LinkEvent::Up(id, link.peer().cert.clone())).await.unwrap();
                        if !mute.load(Relaxed) {
                            let hello = Hello {
                                minor: 0,
                                incarnation: 1,
                                transit: true,
                                yields: false,
                                started: UnixMillis(1),
                            };
                            assert!(control.send(Control::Hello(hello)));
                        }
                        links.push((link, control));
                        let place = LinkPlace { id, data: Arc::default(), inbox: Inbox::default().share() };
                        assert!(reply.send(Some(place)).is_ok());
                    }
                    CoreEvent::LinkDown { id, .. } => tell.send(LinkEvent::Down(id)).await.unwrap(),
                    CoreEvent::Frame { link, frame: Control::Hello(_), .. }
                        if link.0 > 1 && closes.load(Relaxed) =>
                    {
                        links[link.0 as usize - 1].0.close(CloseReason::Overloaded);
                    }
                    CoreEvent::Frame { link, frame: Control::Goodbye, .. } => {
                        links[link.0 as usize - 1].0.close(CloseReason::Goodbye);
                    }
                    _ => {}
                }
            }
        });
        (events, told)
    }

    async fn soon<T>(future: impl Future<Output = T>) -> T {
        timeout(Duration::from_secs(30), future).await.expect("it hangs")
    }

    /// A node that keeps a link to a router. The test plays both control tasks.
    struct Bench {
        board: Board,
        change_network: watch::Sender<u64>,
        fleet: Fleet,
        arm: CredentialStore,
        router: CredentialStore,
        redial: watch::Sender<()>,
        near: mpsc::Receiver<LinkEvent>,
        far: mpsc::Receiver<LinkEvent>,
        doors: Arc<TransportMetrics>,
        /// Whether the router closes all links but the first right after the greeting.
        far_closes: Arc<AtomicBool>,
        /// Whether neither side greets.
        mute: Arc<AtomicBool>,
        close_far: mpsc::Sender<LinkId>,
        far_core: mpsc::Sender<CoreEvent>,
        stops: Vec<oneshot::Sender<()>>,
    }

    fn enroll(fleet: &Fleet, node: &str) -> Arc<Identity> {
        let request = EnrollRequest::new(node.parse().unwrap(), now().unix);
        Arc::new(fleet.issue(&request, &mut OsRng.unwrap_err()).unwrap())
    }

    /// Enrolls a router whose id is less than that of the arm. A number after the name makes it so.
    fn enroll_router(fleet: &Fleet, name: &str) -> Arc<Identity> {
        let mut routers = (0..1000).map(|n| {
            let request = EnrollRequest::new(format!("{name}{n}").parse().unwrap(), now().unix);
            let request = EnrollRequest { router: true, ..request };
            Arc::new(fleet.issue(&request, &mut OsRng.unwrap_err()).unwrap())
        });
        routers.find(|router| router.node_id().0[0] < 0x80).unwrap()
    }

    fn admission(core: &mpsc::Sender<CoreEvent>, credentials: &CredentialStore) -> Admission {
        let (core, credentials) = (core.clone(), credentials.clone());
        Admission {
            core,
            credentials,
            claims: Claims::default(),
            audit: Audit::default(),
            lanes: LaneAdmission::default(),
        }
    }

    impl Bench {
        fn new() -> Self {
            Self::by(Vec::new())
        }

        /// Creates a bench with better URLs than the one that works.
        fn by(mut urls: Vec<LinkUrl>) -> Self {
            let (bench, keeper, url) = Self::without_a_link();
            let row = bench.board.row(&url, "static");
            let rng = ChaCha20Rng::from_rng(&mut OsRng.unwrap_err());
            urls.push(url);
            tokio::spawn(keep_at(DialTarget::by(urls).unwrap(), keeper, row, rng));
            bench
        }

        /// Creates a bench whose node dials nothing, with the node's keeper and the URL of the router.
        fn without_a_link() -> (Self, LinkKeeper, LinkUrl) {
            // The links of the arm give way to those of routers that are announced.
            let (fleet, arm) = loop {
                let fleet =
                    Fleet::create("lab".parse().unwrap(), now().unix, &mut OsRng.unwrap_err()).unwrap();
                let arm = enroll(&fleet, "arm");
                if arm.node_id().0[0] >= 0x80 {
                    break (fleet, CredentialStore::new(arm));
                }
            };
            let router = CredentialStore::new(enroll_router(&fleet, "router"));
            let addr = "quic://127.0.0.1:0".parse().unwrap();
            let options = LinkOptions::default();
            let doors = Arc::<TransportMetrics>::default();
            let listener = Listener::bind(&addr, router.clone(), options.clone(), doors.clone()).unwrap();
            let url: sgc_transport::LinkUrl = listener.local().to_string().parse().unwrap();
            let (far_closes, mute) = (Arc::<AtomicBool>::default(), Arc::<AtomicBool>::default());
            let (close_far, closing) = mpsc::channel(1);
            let (far_core, far) = control_task(far_closes.clone(), mute.clone(), closing);
            let (near_core, near) = control_task(Arc::default(), mute.clone(), mpsc::channel(1).1);
            let (stop, stopped) = oneshot::channel();
            tokio::spawn(keep_accepting(listener, admission(&far_core, &router), stopped));
            let (redial, on_redial) = watch::channel(());
            let dialer = Arc::new(Dialer::new(arm.clone(), options, Arc::default()));
            let me = arm.identity().node_id();
            let (dns, claims) = (Dns::default(), Claims::default());
            let book = WorkingUrls::default();
            let (change_network, network) = Network::channel();
            let keeper = LinkKeeper {
                me,
                lane_dialer: dialer.clone(),
                dialer,
                dns,
                core: near_core,
                redial: on_redial,
                claims,
                network,
                urls: book,
            };
            let bench = Self {
                board: Board::default(),
                change_network,
                fleet,
                arm,
                router,
                redial,
                near,
                far,
                doors,
                far_closes,
                mute,
                close_far,
                far_core,
                stops: vec![stop],
            };
            (bench, keeper, url)
        }

        /// Starts another router of the fleet.
        fn start_router(&mut self) -> (CredentialStore, LinkUrl) {
            let router = CredentialStore::new(enroll_router(&self.fleet, "other"));
            let addr = "quic://127.0.0.1:0".parse().unwrap();
            let listener =
                Listener::bind(&addr, router.clone(), LinkOptions::default(), Arc::default()).unwrap();
            let url = listener.local().to_string().parse().unwrap();
            let (stop, stopped) = oneshot::channel();
            self.stops.push(stop);
            tokio::spawn(keep_accepting(listener, admission(&self.far_core, &router), stopped));
            (router, url)
        }

        /// Keeps a link to this URL that meets the request. The target can be changed.
        fn keep_link(
            &self,
            keeper: LinkKeeper,
            url: LinkUrl,
            request: LinkRequest,
        ) -> watch::Sender<DialTarget> {
            let row = self.board.row(&url, "mdns");
            let (change_target, target) = watch::channel(DialTarget::from(url));
            tokio::spawn(async move { keeper.keep_link(target, &request, &row).await });
            change_target
        }

        fn cert(store: &CredentialStore) -> CertId {
            store.identity().as_peer().cert.clone()
        }

        async fn expect(&mut self, near: LinkEvent, far: LinkEvent) {
            assert_eq!(soon(self.near.recv()).await.unwrap(), near);
            assert_eq!(soon(self.far.recv()).await.unwrap(), far);
        }

        async fn expect_up(&mut self, id: u32) {
            let (near, far) = (Self::cert(&self.router), Self::cert(&self.arm));
            self.expect(LinkEvent::Up(LinkId(id), near), LinkEvent::Up(LinkId(id), far)).await;
        }
    }

    /// Greets as another node, gives `labels` labels, which are acknowledged, and asks for a pulse. Then sends `frame`
    /// and returns how the link ends.
    async fn end_after(labels: u32, frame: Control) -> CloseReason {
        let fleet = Fleet::create("lab".parse().unwrap(), now().unix, &mut OsRng.unwrap_err()).unwrap();
        let addr = "quic://127.0.0.1:0".parse().unwrap();
        let (router, arm) = (CredentialStore::new(enroll(&fleet, "router")), enroll(&fleet, "arm"));
        let options = LinkOptions::default();
        let listener = Listener::bind(&addr, router.clone(), options, Arc::default()).unwrap();
        let url = listener.local().to_string().parse().unwrap();
        let (core, _told) = control_task(Arc::default(), Arc::default(), mpsc::channel(1).1);
        let (_stop, stopped) = oneshot::channel();
        let admission = Admission {
            core,
            credentials: router,
            claims: Claims::default(),
            audit: Audit::default(),
            lanes: LaneAdmission::default(),
        };
        tokio::spawn(keep_accepting(listener, admission, stopped));
        let dialer = Dialer::new(CredentialStore::new(arm), LinkOptions::default(), Arc::default());
        let link = soon(dialer.dial(&url)).await.unwrap();
        let hello = Hello { minor: 0, incarnation: 9, transit: false, yields: false, started: UnixMillis(1) };
        link.send_control(Control::Hello(hello).to_bytes()).await.unwrap();
        let heard = async || Control::from_slice(&soon(link.recv_control()).await.unwrap()).unwrap();
        assert!(matches!(heard().await, Control::Hello(_)));
        for index in 0..labels {
            let label = Label::new(index).unwrap();
            link.send_control(Control::Label { label, name: Name([1; 32]) }.to_bytes()).await.unwrap();
            assert_eq!(heard().await, Control::LabelAck { label });
        }
        // An answer to a pulse has no answer itself.
        for answers in [true, false] {
            link.send_control(Control::Probe { answers }.to_bytes()).await.unwrap();
        }
        assert_eq!(heard().await, Control::Probe { answers: true });
        link.send_control(frame.to_bytes()).await.unwrap();
        match soon(link.closed()).await {
            LinkError::Closed { by_peer: true, reason } => reason,
            end => panic!("{end}"),
        }
    }

    #[tokio::test]
    async fn control_frames_beyond_a_links_share_of_the_inbox_wait_at_that_link() {
        const FRAME_BYTES: usize = 100_000;
        let fleet = Fleet::create("lab".parse().unwrap(), now().unix, &mut OsRng.unwrap_err()).unwrap();
        let addr = "quic://127.0.0.1:0".parse().unwrap();
        let router = CredentialStore::new(enroll(&fleet, "router"));
        let listener = Listener::bind(&addr, router.clone(), LinkOptions::default(), Arc::default()).unwrap();
        let url = listener.local().to_string().parse().unwrap();
        let (core, mut events) = mpsc::channel(4096);
        let (_stop, stopped) = oneshot::channel();
        tokio::spawn(keep_accepting(listener, admission(&core, &router), stopped));
        let inbox = Inbox::default();
        // Frames of a link that wait, since the control task takes none.
        let mut held = Vec::new();
        let mut links = Vec::new();
        for (id, name, count) in [(1, "flooder", 40), (2, "other", 1)] {
            let dialer = Dialer::new(
                CredentialStore::new(enroll(&fleet, name)),
                LinkOptions::default(),
                Arc::default(),
            );
            let link = soon(dialer.dial(&url)).await.unwrap();
            let CoreEvent::LinkUp { reply, .. } = soon(events.recv()).await.unwrap() else { panic!() };
            let place = LinkPlace { id: LinkId(id), data: Arc::default(), inbox: inbox.share() };
            assert!(reply.send(Some(place)).is_ok());
            links.push(link.clone());
            let flood = tokio::spawn(async move {
                for _ in 0..count {
                    let names = vec![Name([1; 32]); FRAME_BYTES / 32];
                    if link.send_control(Control::Interest { names }.to_bytes()).await.is_err() {
                        return;
                    }
                }
            });
            let at_least = if id == 1 { LINK_INBOX_BYTES_MAX / (FRAME_BYTES + 1000) } else { 1 };
            while held.iter().filter(|(link, _)| *link == LinkId(id)).count() < at_least {
                match soon(events.recv()).await.unwrap() {
                    CoreEvent::Frame { link, room, .. } => held.push((link, room)),
                    _ => panic!("only frames come"),
                }
            }
            if id == 2 {
                soon(flood).await.unwrap();
            }
        }
        let of_flooder = held.iter().filter(|(link, _)| *link == LinkId(1)).count();
        assert!(of_flooder * FRAME_BYTES <= LINK_INBOX_BYTES_MAX, "{of_flooder} frames wait");
        // Handled frames make room for waiting ones.
        held.clear();
        let CoreEvent::Frame { link, .. } = soon(events.recv()).await.unwrap() else { panic!() };
        assert_eq!(link, LinkId(1));
    }

    #[tokio::test]
    async fn a_flush_is_told_once_the_link_has_taken_what_was_queued() {
        let fleet = Fleet::create("lab".parse().unwrap(), now().unix, &mut OsRng.unwrap_err()).unwrap();
        let addr = "quic://127.0.0.1:0".parse().unwrap();
        let router = CredentialStore::new(enroll(&fleet, "router"));
        let listener = Listener::bind(&addr, router.clone(), LinkOptions::default(), Arc::default()).unwrap();
        let url = listener.local().to_string().parse().unwrap();
        let (core, mut events) = mpsc::channel(64);
        let (_stop, stopped) = oneshot::channel();
        tokio::spawn(keep_accepting(listener, admission(&core, &router), stopped));
        let dialer =
            Dialer::new(CredentialStore::new(enroll(&fleet, "arm")), LinkOptions::default(), Arc::default());
        let link = soon(dialer.dial(&url)).await.unwrap();
        let CoreEvent::LinkUp { reply, control, .. } = soon(events.recv()).await.unwrap() else { panic!() };
        let place = LinkPlace { id: LinkId(7), data: Arc::default(), inbox: Inbox::default().share() };
        assert!(reply.send(Some(place)).is_ok());
        // This exceeds the packets that may be under way unread.
        let many = 2000;
        for _ in 0..many {
            assert!(control.send(Control::Interest { names: vec![Name([1; 32]); 1000] }));
        }
        assert!(control.flush());
        let unread = timeout(Duration::from_millis(500), events.recv()).await;
        assert!(unread.is_err(), "nothing was read, so the link cannot have taken it all");
        for _ in 0..many {
            soon(link.recv_control()).await.unwrap();
        }
        let event = soon(events.recv()).await.unwrap();
        assert!(matches!(event, CoreEvent::Flushed { link: LinkId(7) }));
    }

    #[tokio::test]
    async fn labels_and_pulses_are_answered_and_who_breaks_their_order_is_cut_off() {
        let label = |index| Control::Label { label: Label::new(index).unwrap(), name: Name([2; 32]) };
        let ack = Control::LabelAck { label: Label::new(0).unwrap() };
        assert_eq!(end_after(3, Control::Goodbye).await, CloseReason::Goodbye);
        for (labels, frame, why) in [
            (1, label(0), "label 0 was given where 1 comes next"),
            (1, label(2), "label 2 was given where 1 comes next"),
            (1, ack, "label 0 is acknowledged but was not given"),
        ] {
            assert_eq!(end_after(labels, frame).await, CloseReason::Protocol(why.into()));
        }
    }

    #[tokio::test]
    async fn a_renewed_certificate_is_shown_on_a_second_link_before_the_first_goes() {
        let mut bench = Bench::new();
        bench.expect_up(1).await;
        for id in 1..4 {
            bench.arm.set_identity(enroll(&bench.fleet, "arm"));
            bench.redial.send_replace(());
            // On both sides the new link comes up before the old one goes down.
            bench.expect_up(id + 1).await;
            bench.expect(LinkEvent::Down(LinkId(id)), LinkEvent::Down(LinkId(id))).await;
        }
    }

    #[tokio::test]
    async fn a_way_that_is_silent_is_passed_over_until_it_works_again() {
        // This socket never answers.
        let mute = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
        let url: LinkUrl = format!("quic://{}", mute.local_addr().unwrap()).parse().unwrap();
        let mut bench = Bench::by(vec![url]);
        bench.expect_up(1).await;
        let passed_over = async {
            while bench.board.snapshot()[0].why_not_first.is_none() {
                tokio::task::yield_now().await;
            }
        };
        soon(passed_over).await;
        let row = &bench.board.snapshot()[0];
        let why = "quic: no answer within 0.7 s; is UDP blocked?";
        assert_eq!((row.why_not_first.as_deref(), row.state), (Some(why), "linked"));
        // The better URL works again, and the network change makes the node try it.
        let addr = format!("quic://{}", mute.local_addr().unwrap()).parse().unwrap();
        drop(mute);
        let listener = Listener::bind(&addr, bench.router.clone(), LinkOptions::default(), Arc::default());
        let (stop, stopped) = oneshot::channel();
        bench.stops.push(stop);
        let admission = admission(&bench.far_core, &bench.router);
        tokio::spawn(keep_accepting(listener.unwrap(), admission, stopped));
        bench.change_network.send_modify(|change| *change += 1);
        bench.expect_up(2).await;
        bench.expect(LinkEvent::Down(LinkId(1)), LinkEvent::Down(LinkId(1))).await;
        let row = &bench.board.snapshot()[0];
        assert_eq!(
            (row.why_not_first.as_deref(), row.at.as_deref()),
            (None, Some(addr.to_string().as_str()))
        );
    }

    #[tokio::test]
    async fn successor_to_a_node_that_is_not_wanted_is_refused() {
        let (mut bench, keeper, url) = Bench::without_a_link();
        let nodes = Some(Arc::new([bench.router.identity().node_id()].into()));
        let request = LinkRequest { hearsay: true, nodes, places: None };
        let change_target = bench.keep_link(keeper, url, request);
        bench.expect_up(1).await;
        let (_other, url) = bench.start_router();
        change_target.send_replace(url.into());
        assert!(matches!(soon(bench.far.recv()).await.unwrap(), LinkEvent::Up(LinkId(2), _)));
        assert_eq!(soon(bench.far.recv()).await.unwrap(), LinkEvent::Down(LinkId(2)));
        assert!(bench.near.is_empty(), "the link in use stays and has no successor");
    }

    #[tokio::test]
    async fn link_gives_way_to_the_router_that_it_leads_to_now() {
        let (mut bench, keeper, url) = Bench::without_a_link();
        let claims = keeper.claims.clone();
        let request = LinkRequest { hearsay: true, ..LinkRequest::default() };
        let change_target = bench.keep_link(keeper, url, request);
        bench.expect_up(1).await;
        let (other, url) = bench.start_router();
        change_target.send_replace(url.into());
        let (near, far) = (Bench::cert(&other), Bench::cert(&bench.arm));
        bench.expect(LinkEvent::Up(LinkId(2), near), LinkEvent::Up(LinkId(2), far)).await;
        bench.expect(LinkEvent::Down(LinkId(1)), LinkEvent::Down(LinkId(1))).await;
        let _former = claims.note_arrival(bench.router.identity().node_id());
        assert!(timeout(Duration::from_millis(200), bench.near.recv()).await.is_err());
        let _present = claims.note_arrival(other.identity().node_id());
        bench.expect(LinkEvent::Down(LinkId(2)), LinkEvent::Down(LinkId(2))).await;
    }

    #[tokio::test]
    async fn the_old_link_stays_if_the_new_one_does_not_last() {
        let mut bench = Bench::new();
        bench.expect_up(1).await;
        bench.far_closes.store(true, Relaxed);
        bench.redial.send_replace(());
        bench.expect_up(2).await;
        bench.expect(LinkEvent::Down(LinkId(2)), LinkEvent::Down(LinkId(2))).await;
        bench.far_closes.store(false, Relaxed);
        // Each failed attempt is followed by another.
        loop {
            let up = soon(bench.near.recv()).await.unwrap();
            let LinkEvent::Up(id, _) = up else { panic!("{up:?}") };
            assert!(matches!(soon(bench.far.recv()).await.unwrap(), LinkEvent::Up(..)));
            let down = soon(bench.near.recv()).await.unwrap();
            soon(bench.far.recv()).await.unwrap();
            if down != LinkEvent::Down(id) {
                assert_eq!(down, LinkEvent::Down(LinkId(1)));
                return;
            }
        }
    }

    #[tokio::test]
    async fn a_link_takes_over_at_once_where_the_old_one_ends_meanwhile() {
        let mut bench = Bench::new();
        bench.expect_up(1).await;
        bench.mute.store(true, Relaxed);
        bench.redial.send_replace(());
        bench.expect_up(2).await;
        // The second link has not settled, since no greeting arrives on it.
        bench.close_far.send(LinkId(1)).await.unwrap();
        bench.expect(LinkEvent::Down(LinkId(1)), LinkEvent::Down(LinkId(1))).await;
        bench.close_far.send(LinkId(2)).await.unwrap();
        bench.expect(LinkEvent::Down(LinkId(2)), LinkEvent::Down(LinkId(2))).await;
        bench.expect_up(3).await;
    }

    #[tokio::test]
    async fn the_old_link_stays_while_the_new_certificate_is_refused() {
        let mut bench = Bench::new();
        bench.expect_up(1).await;
        let refused = enroll(&bench.fleet, "arm");
        let serial = Arc::clone(&refused.as_peer().cert.serial);
        let list = bench.fleet.revocation_list_of(&[(serial, now().unix)], 1, now().unix).unwrap();
        let anchors = bench.router.anchors();
        bench.router.set_anchors(anchors.with_crl(&list, now().unix).unwrap().unwrap());
        bench.arm.set_identity(refused);
        bench.redial.send_replace(());
        let is_refused = async {
            while bench.doors.refused(RefusalKind::Revoked) == 0 {
                tokio::task::yield_now().await;
            }
        };
        soon(is_refused).await;
        assert!(bench.near.is_empty() && bench.far.is_empty());
        // The node tries again by itself.
        bench.router.set_anchors(anchors.as_ref().clone());
        bench.expect_up(2).await;
        bench.expect(LinkEvent::Down(LinkId(1)), LinkEvent::Down(LinkId(1))).await;
    }
}
