//! [`CycloneReader`]: a raw reader that passes serialised samples to a handler.

use std::collections::HashSet;
use std::sync::Arc;

use bytes::Bytes;
use cyclors::{dds_entity_t, dds_instance_handle_t, ddsi_serdata};
use sgc_ros::{DiscoveryEvent, EndpointSpec, Guid, KeyHash, Sample, SampleHandler, SampleKind};
use sgc_wire::History;

use crate::arrivals::{Arrival, FromSerdata, LivelinessChange, WriterState};
use crate::intake::{Intake, Receiver};
use crate::known_writers::KnownWriters;
use crate::matched::MatchedEndpoint;
use crate::participant::Participant;
use crate::payload::HEADER_BYTES;
use crate::sample::SampleRef;

/// Most writers of one reader that are remembered as lapsed.
const LAPSED_MAX: usize = 1024;

/// Most writers of one reader whose depths are reported.
const DEPTHS_MAX: usize = 1024;

/// Most writers of one reader whose first samples are reported.
const HEARD_MAX: usize = 1024;

/// A raw reader. Dropping it waits for a handler at work, and deletes the entities.
#[derive(Debug)]
pub struct CycloneReader(Intake<Samples>);

impl CycloneReader {
    pub(crate) fn new(
        participant: &Arc<Participant>,
        spec: &EndpointSpec,
        handler: SampleHandler,
    ) -> Result<Self, String> {
        let mut intake = Intake::new(participant, spec, participant.topic(spec)?, "")?;
        let samples = Samples {
            ignores_tagged: participant.ignores_tagged(),
            newest_only: spec.qos.history == History::KeepLast(1),
            writers: KnownWriters::default(),
            lapsed: HashSet::new(),
            heard: HashSet::new(),
            depths: spec.qos.is_transient_local().then(HashSet::new),
            participant: Arc::clone(participant),
            held: None,
            handler,
        };
        intake.start(samples)?;
        Ok(Self(intake))
    }

    /// Returns the GUID of the reader, as others discover it.
    pub fn guid(&self) -> Guid {
        self.0.guid()
    }
}

/// The content of a sample.
struct Content {
    kind: SampleKind,
    key_hash: Option<KeyHash>,
    payload: Bytes,
    /// The number of messages that its writer keeps, if known.
    kept: Option<u64>,
}

impl FromSerdata for Content {
    unsafe fn from_raw(sample: *mut ddsi_serdata) -> Option<Self> {
        // SAFETY: a reference to a sample of this crate's type, by contract and by the topic of this module's readers.
        let sample = unsafe { SampleRef::from_raw(sample) };
        let (key_hash, kept) = sample.origin().map_or((None, None), |origin| (origin.key_hash, origin.kept));
        let content = Self { kind: sample.kind(), key_hash, payload: sample.into_payload(), kept };
        if content.payload.len() < HEADER_BYTES {
            tracing::debug!(
                bytes = content.payload.len(),
                "a sample without encapsulation header is dropped"
            );
            return None;
        }
        Some(content)
    }

    fn bytes(&self) -> usize {
        self.payload.len()
    }
}

/// The receiver that passes samples to the handler.
struct Samples {
    ignores_tagged: bool,
    /// `true` if only the newest sample counts.
    newest_only: bool,
    writers: KnownWriters,
    /// Writers whose lease expired.
    lapsed: HashSet<dds_instance_handle_t>,
    /// Writers that were heard.
    heard: HashSet<dds_instance_handle_t>,
    /// Writers whose depth was reported; `None` if late joiners get nothing.
    depths: Option<HashSet<dds_instance_handle_t>>,
    participant: Arc<Participant>,
    /// A sample that is held until it is known whether another follows, because the handler must learn which sample
    /// is the last one.
    held: Option<Sample>,
    handler: SampleHandler,
}

impl Samples {
    /// Returns `true` for a sample of another proxy on this network, which came through SGC already. Sharing it again
    /// would make it circulate.
    fn is_ignored(&self, writer: Option<MatchedEndpoint>) -> bool {
        self.ignores_tagged && writer.is_some_and(|w| w.tagged)
    }

    /// Returns the depth of a writer's history if it is new.
    fn new_depth(&self, arrival: &Arrival<Content>) -> Option<u32> {
        let told = self.depths.as_ref()?;
        let depth =
            arrival.sample.kept.filter(|_| !told.contains(&arrival.writer) && told.len() < DEPTHS_MAX)?;
        Some(u32::try_from(depth).unwrap_or(u32::MAX))
    }

    /// Reports the depth of a writer's history to discovery if it is new.
    fn tell_depth(&mut self, arrival: &Arrival<Content>, writer: Option<MatchedEndpoint>) {
        if let (Some(depth), Some(MatchedEndpoint { guid, .. })) = (self.new_depth(arrival), writer) {
            self.depths.get_or_insert_default().insert(arrival.writer);
            tracing::debug!(writer = ?guid, depth, "the depth of a publisher's history is known");
            self.participant.tell(DiscoveryEvent::HistoryDepth { guid, depth });
        }
    }

    /// Reports a writer's liveliness to discovery if it changed.
    fn tell_liveliness(&mut self, reader: dds_entity_t, LivelinessChange { writer, now }: LivelinessChange) {
        let (is_news, is_alive) = match now {
            WriterState::Alive => (self.lapsed.remove(&writer), true),
            WriterState::Lapsed => (self.lapsed.len() < LAPSED_MAX && self.lapsed.insert(writer), false),
            // Discovery reports this by itself.
            WriterState::Gone => {
                self.lapsed.remove(&writer);
                self.heard.remove(&writer);
                if let Some(depths) = &mut self.depths {
                    depths.remove(&writer);
                }
                return;
            }
        };
        let known = if is_news { self.writers.find(reader, writer) } else { None };
        if let Some(MatchedEndpoint { guid, .. }) = known.filter(|w| !self.is_ignored(Some(*w))) {
            tracing::debug!(writer = ?guid, is_alive, "the liveliness of a writer changed");
            self.participant.tell(DiscoveryEvent::Liveliness { guid, is_alive });
        }
    }
}

fn sample_of(content: Content, writer: Option<MatchedEndpoint>, source_timestamp_ns: i64) -> Sample {
    let Content { kind, key_hash, payload, .. } = content;
    Sample { kind, writer: writer.map(|w| w.guid), source_timestamp_ns, key_hash, payload, more: false }
}

impl Receiver for Samples {
    type Sample = Content;

    fn receive(&mut self, reader: dds_entity_t, arrival: Arrival<Content>) {
        let writer = self.writers.find(reader, arrival.writer);
        if self.is_ignored(writer) {
            return;
        }
        if let Some(MatchedEndpoint { guid, .. }) = writer
            && self.heard.len() < HEARD_MAX
            && self.heard.insert(arrival.writer)
        {
            // An earlier reader of the topic may have reported that the lease had expired.
            self.participant.tell(DiscoveryEvent::Liveliness { guid, is_alive: true });
        }
        if self.lapsed.contains(&arrival.writer) {
            // Cyclone may report two changes in the wrong order.
            self.tell_liveliness(
                reader,
                LivelinessChange { writer: arrival.writer, now: WriterState::Alive },
            );
        }
        self.tell_depth(&arrival, writer);
        let next = sample_of(arrival.sample, writer, arrival.source_timestamp_ns);
        if self.newest_only {
            // No sample is held, because a handler that blocks would make it old.
            self.handler.handle(next);
        } else if let Some(before) = self.held.replace(next) {
            self.handler.handle(Sample { more: true, ..before });
        }
    }

    fn receive_at_once(&mut self, arrival: Arrival<Content>) -> Option<Arrival<Content>> {
        // Looking up the writer takes the lock under which this is called.
        let writer = self.writers.known(arrival.writer);
        if writer.is_none() || self.lapsed.contains(&arrival.writer) {
            return Some(arrival);
        }
        if self.is_ignored(writer) {
            return None;
        }
        // Reporting may block.
        if self.new_depth(&arrival).is_some() {
            return Some(arrival);
        }
        let Arrival { sample: content, source_timestamp_ns, .. } = arrival;
        let kept = content.kept;
        let refused = self.handler.handle_at_once(sample_of(content, writer, source_timestamp_ns));
        refused.map(|Sample { kind, key_hash, payload, .. }| Arrival {
            sample: Content { kind, key_hash, payload, kept },
            ..arrival
        })
    }

    fn receive_liveliness(&mut self, reader: dds_entity_t, change: LivelinessChange) {
        self.rest();
        self.tell_liveliness(reader, change);
    }

    fn rest(&mut self) {
        if let Some(last) = self.held.take() {
            self.handler.handle(last);
        }
    }

    fn overrun(&mut self, samples: u64) {
        self.handler.overrun(samples);
    }
}
