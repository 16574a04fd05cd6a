//! Messages over an `sgc_transport::Link`: one flow, and in it the fragments that a node would make of them.

use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, Result};
use bytes::Bytes;
use sgc_testkit::netsim::Namespace;
use sgc_transport::{AnyLink, Dialer, FlowRx, FlowTx, Link as _, LinkOptions, LinkUrl, Listener};
use sgc_trust::Identity;
use sgc_wire::{Class, HOP_LIMIT, Name, Packet, PacketHeader, SourceId};
use tokio::runtime::Runtime;

use super::{Caller, NEVER, Wire};
use crate::fleet::BenchFleet;
use crate::node::runtime_in;

/// Size of the fragments into which nodes cut messages.
const FRAGMENT_BYTES: usize = 16 * 1024;
/// An epoch that asks for an answer when its message is complete.
const ANSWER: u32 = 1;
const NO_ANSWER: u32 = 0;

/// Identities of both ends.
pub(super) fn write_credentials(dir: &Path) -> Result<()> {
    let fleet = BenchFleet::new()?;
    for (file, node) in [("near.identity", "near"), ("far.identity", "far")] {
        std::fs::write(dir.join(file), fleet.issue(node, node == "far")?.to_text().as_bytes())?;
    }
    Ok(())
}

fn identity(dir: &Path, file: &str) -> Result<Arc<Identity>> {
    Ok(Arc::new(Identity::parse(&std::fs::read_to_string(dir.join(file))?)?))
}

/// Dials one far end.
pub(super) struct LinkCaller {
    runtime: Arc<Runtime>,
    dialer: Arc<Dialer>,
    url: LinkUrl,
}

impl LinkCaller {
    pub(super) fn new(url: &str, dir: &Path, home: Option<Arc<Namespace>>) -> Result<Self> {
        let runtime = match home {
            Some(home) => runtime_in(&home)?,
            None => tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?,
        };
        let dialer = Dialer::new(identity(dir, "near.identity")?, LinkOptions::default(), Arc::default());
        Ok(Self { runtime: Arc::new(runtime), dialer: Arc::new(dialer), url: url.parse()? })
    }
}

impl Caller for LinkCaller {
    fn call(&self) -> Result<Box<dyn Wire>> {
        let (dialer, url) = (Arc::clone(&self.dialer), self.url.clone());
        // A task, and so on a thread of the runtime, which is in the right namespace: sockets are opened here.
        let task = self.runtime.spawn(async move {
            let link = dialer.dial(&url).await?;
            let flow = link.open_flow(Class::Default).await?;
            Ok::<_, anyhow::Error>((link, flow))
        });
        let (link, flow) = self.runtime.block_on(task)??;
        Ok(Box::new(LinkWire { runtime: Arc::clone(&self.runtime), link, flow, answers: None, sent: 0 }))
    }
}

struct LinkWire {
    runtime: Arc<Runtime>,
    link: AnyLink,
    flow: FlowTx,
    /// There since the first answer.
    answers: Option<FlowRx>,
    sent: u64,
}

impl Wire for LinkWire {
    fn send(&mut self, bytes: usize, messages: u64) -> Result<()> {
        let payload = Bytes::from(vec![7; bytes]);
        let Self { runtime, link, flow, answers, sent } = self;
        let work = async {
            for message in 1..=messages {
                *sent += 1;
                let epoch = if message == messages { ANSWER } else { NO_ANSWER };
                for packet in packets(*sent, epoch, &payload)? {
                    flow.send(&packet).await?;
                }
            }
            let answers = match answers {
                Some(answers) => answers,
                none => none.insert(link.accept_flow().await?),
            };
            let answer = answers.recv().await?.context("the far end ends its answers")?;
            anyhow::ensure!(answer.header.seq == *sent, "another message is answered");
            Ok(())
        };
        // Long runs of small messages may take their time; what is bounded is the silence of a single one.
        if messages > 1 {
            return runtime.block_on(work);
        }
        runtime.block_on(async { tokio::time::timeout(NEVER, work).await }).context("it takes too long")?
    }
}

fn packets(seq: u64, epoch: u32, payload: &Bytes) -> Result<Vec<Packet>> {
    let header = PacketHeader {
        reliable: true,
        class: Class::Default,
        hops: HOP_LIMIT,
        suite: 1,
        epoch,
        name: Name([1; 32]),
        source: SourceId([2; 16]),
        seq,
        total: payload.len() as u32,
        index: 0,
        grid: FRAGMENT_BYTES as u16,
        to: None,
    };
    let fragments = payload.len().div_ceil(FRAGMENT_BYTES).max(1);
    let packet = |index: usize| {
        let range = index * FRAGMENT_BYTES..payload.len().min((index + 1) * FRAGMENT_BYTES);
        let header = PacketHeader { index: index as u16, ..header.clone() };
        Ok(Packet::new(header, payload.slice(range).into())?)
    };
    (0..fragments).map(packet).collect()
}

/// The far end: takes flows and answers what asks for it.
pub(super) fn serve(scheme: &str, listen: &str, dir: &Path) -> Result<()> {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
    runtime.block_on(async {
        let address = format!("{scheme}://{listen}").parse()?;
        let identity = identity(dir, "far.identity")?;
        let mut listener = Listener::bind(&address, identity, LinkOptions::default(), Arc::default())?;
        println!("{}", listener.local());
        while let Some(link) = listener.accept().await {
            match link {
                Ok(link) => drop(tokio::spawn(serve_link(link))),
                Err(refused) => eprintln!("{refused}"),
            }
        }
        Ok(())
    })
}

async fn serve_link(link: AnyLink) -> Result<()> {
    loop {
        let flow = link.accept_flow().await?;
        tokio::spawn(serve_flow(link.clone(), flow));
    }
}

async fn serve_flow(link: AnyLink, mut flow: FlowRx) -> Result<()> {
    let mut answers = None;
    while let Some(packet) = flow.recv().await? {
        if !packet.header.is_last() || packet.header.epoch != ANSWER {
            continue;
        }
        let answers = match &mut answers {
            Some(answers) => answers,
            none => none.insert(link.open_flow(Class::Default).await?),
        };
        for answer in packets(packet.header.seq, NO_ANSWER, &Bytes::from_static(b"here"))? {
            answers.send(&answer).await?;
        }
    }
    Ok(())
}
