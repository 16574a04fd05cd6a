//! [`CycloneClient`] and [`CycloneServer`]: services for programs of any vendor.
//!
//! A service is two topics. The place of the request id in a message depends on the vendor ([`Mapping`]). With
//! Cyclone, each body is preceded by 16 bytes in the byte order of the payload: 8 bytes with the client's id, and the
//! number of its request (`cdds_request_header_t` of rmw_cyclonedds_cpp). With others, a request has its sequence
//! number, and names the client's reader in its inline QoS or else is known by its writer; a reply repeats both
//! there. A server answers each client in the client's way, and a client calls servers in theirs, so vendors that do
//! not understand each other on one network do so through SGC.
//!
//! Services are volatile, so messages written before the other side is matched are lost. Both sides wait for the
//! match, on Cyclone's conditions.

use std::collections::BTreeSet;
use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicI64, AtomicU32, Ordering::Relaxed};
use std::time::{Duration, Instant};

use bytes::{BufMut, Bytes, BytesMut};
use cyclors::{dds_get_instance_handle, dds_instance_handle_t, dds_set_status_mask, dds_take_status};
use sgc_ros::{
    Guid, RequestHandler, RequestId, RosClient, RosError, RosServer, SentRequest, ServiceSpec, UnhandledCall,
};

use crate::entity::check;
use crate::identity::{Mapping, NUMBER_UNKNOWN, SampleIdentity};
use crate::matched::{self, MatchedEndpoint};
use crate::participant::Participant;
use crate::payload::{Frame, HEADER_BYTES, PREFIX_BYTES, is_little_endian};
use crate::rpc::{HandleMessages, Message, RpcReader, RpcWriter};
use crate::wait::{READERS_MATCHED, WRITERS_MATCHED, wait_for_status};

/// Longest wait of a request for a server, and of a reply for its client, in milliseconds.
const MATCH_WAIT_MAX_MS: u64 = 1000;

/// Bytes of a client's id in the header; the rest of [`RequestId::client`] is zero.
const ID_BYTES: usize = 8;

/// A client. Dropping it waits for a handler of a reply at work.
#[derive(Debug)]
pub struct CycloneClient {
    ends: Ends<Replies>,
    id: u64,
    mixed: AtomicBool,
    /// The number of the last request in Cyclone's mapping.
    last_in_body: Arc<AtomicI64>,
}

/// A server. Dropping it waits for a handler of a request at work.
#[derive(Debug)]
pub struct CycloneServer {
    ends: Ends<Requests>,
}

/// The receiver of replies for a client's handler.
struct Replies {
    /// The GUIDs of the client's reader and writer.
    reading: [u8; 16],
    writing: [u8; 16],
    /// The client's id in Cyclone's mapping, and the number of its last request there.
    id: u64,
    last_in_body: Arc<AtomicI64>,
    handler: RequestHandler,
}

impl HandleMessages for Replies {
    fn handle(&mut self, message: Message) {
        let Some((client, number, payload)) = reply_of(message) else {
            return self.handler.unhandled(UnhandledCall::Unreadable, 1);
        };
        // Replies to all clients are on one topic.
        let is_ours = if client == self.writing {
            // A server that was matched just after a request in the other mapping may answer a request that was never
            // sent.
            number > self.last_in_body.load(Relaxed)
        } else {
            client == self.reading || client == id_bytes(self.id)
        };
        if is_ours {
            self.handler.handle(RequestId { client: id_bytes(self.id), number, asker: None }, payload);
        }
    }

    fn overrun(&mut self, messages: u64) {
        self.handler.unhandled(UnhandledCall::Overrun, messages);
    }
}

/// The receiver of requests for a server's handler.
struct Requests {
    handler: RequestHandler,
}

impl HandleMessages for Requests {
    fn handle(&mut self, message: Message) {
        let asker = Some(message.writer);
        match request_of(message) {
            Some((client, number, payload)) => {
                self.handler.handle(RequestId { client, number, asker }, payload)
            }
            None => self.handler.unhandled(UnhandledCall::Unreadable, 1),
        }
    }

    fn overrun(&mut self, messages: u64) {
        self.handler.unhandled(UnhandledCall::Overrun, messages);
    }
}

impl CycloneClient {
    pub(crate) fn new(
        participant: &Arc<Participant>,
        spec: &ServiceSpec,
        handler: RequestHandler,
    ) -> Result<Self, String> {
        let user_data = pair_mark("clientid", participant);
        let writer = RpcWriter::new(participant, &spec.request, &user_data)?;
        let mut id: dds_instance_handle_t = 0;
        // SAFETY: the handle is checked by Cyclone, and `id` is a valid place for the result.
        check(unsafe { dds_get_instance_handle(writer.entity().handle(), &mut id) })?;
        let mut reader = RpcReader::new(participant, &spec.reply, &user_data)?;
        let (reading, writing) = (reader.guid().0, writer.entity().guid()?.0);
        let last_in_body = Arc::new(AtomicI64::new(0));
        reader.start(Replies { reading, writing, id, last_in_body: Arc::clone(&last_in_body), handler })?;
        let (ends, mixed) = (Ends::new(participant, reader, writer)?, AtomicBool::new(false));
        Ok(Self { ends, id, mixed, last_in_body })
    }

    /// Returns the mapping that servers with these readers expect. Every reader of requests counts, even if it cannot
    /// answer yet, because only one mapping can be used and a reader of the other one would read an id as part of the
    /// request. In a mix it is that of the others, which Cyclone's servers skip.
    fn mapping_for(&self, readers: &BTreeSet<Guid>) -> Mapping {
        let inline = readers.iter().filter(|r| Mapping::for_vendor(r.vendor()) == Mapping::InlineQos).count();
        let is_mixed = inline > 0 && inline < readers.len();
        if self.mixed.swap(is_mixed, Relaxed) != is_mixed && is_mixed {
            tracing::warn!(
                "a service has servers of Cyclone DDS and of others here: only the others are called"
            );
        }
        if inline > 0 { Mapping::InlineQos } else { Mapping::Body }
    }
}

impl RosClient for CycloneClient {
    fn send(&self, payload: Bytes) -> Result<SentRequest, RosError> {
        self.ends.wait(|| self.matched_servers() > 0)?;
        // A reader that is matched after the request was written does not get it.
        let readers = self.ends.readers();
        let number = match self.mapping_for(&readers) {
            Mapping::Body => self.ends.writer.write(None, |number| {
                self.last_in_body.store(number, Relaxed);
                Frame::with_prefix(&payload, |little| prefix(self.id, number, little))
            })?,
            // As in rmw_fastrtps, the request names the reader for the reply, and its number is that of the message.
            Mapping::InlineQos => {
                let related = SampleIdentity { guid: self.ends.reader.guid(), number: NUMBER_UNKNOWN };
                self.ends.writer.write(Some(related), |_| Frame::new(&payload))?
            }
        };
        let id = RequestId { client: id_bytes(self.id), number, asker: None };
        Ok(SentRequest { id, servers: &self.servers() & &readers })
    }

    fn servers(&self) -> BTreeSet<Guid> {
        let writers = prefixes(self.ends.writers());
        self.ends.readers().into_iter().filter(|reader| writers.contains(&reader.prefix())).collect()
    }

    fn guids(&self) -> [Guid; 2] {
        self.ends.guids
    }
}

impl CycloneServer {
    pub(crate) fn new(
        participant: &Arc<Participant>,
        spec: &ServiceSpec,
        handler: RequestHandler,
    ) -> Result<Self, String> {
        let user_data = pair_mark("serviceid", participant);
        // The writer is created first, because clients may call as soon as they see the server's reader.
        let writer = RpcWriter::new(participant, &spec.reply, &user_data)?;
        let mut reader = RpcReader::new(participant, &spec.request, &user_data)?;
        reader.start(Requests { handler })?;
        Ok(Self { ends: Ends::new(participant, reader, writer)? })
    }
}

impl RosServer for CycloneServer {
    fn reply(&self, request: &RequestId, payload: Bytes) -> Result<(), RosError> {
        let number = request.number;
        let (related, frame) = match cyclone_id(&request.client) {
            Some(id) => (None, Frame::with_prefix(&payload, |little| prefix(id, number, little))?),
            None => (Some(SampleIdentity { guid: Guid(request.client), number }), Frame::new(&payload)?),
        };
        self.ends.wait(|| {
            let readers = prefixes(self.ends.readers());
            request.asker.map_or(!readers.is_empty(), |asker| readers.contains(&asker.prefix()))
        })?;
        self.ends.writer.write(related, |_| Ok(frame)).map(drop)
    }

    fn guids(&self) -> [Guid; 2] {
        self.ends.guids
    }
}

/// Both endpoints of a client or a server.
struct Ends<H: HandleMessages> {
    reader: RpcReader<H>,
    writer: RpcWriter,
    /// The GUIDs of reader and writer.
    guids: [Guid; 2],
    participant: Arc<Participant>,
}

impl<H: HandleMessages> fmt::Debug for Ends<H> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Ends").field("guids", &self.guids).finish_non_exhaustive()
    }
}

impl<H: HandleMessages> Ends<H> {
    fn new(participant: &Arc<Participant>, reader: RpcReader<H>, writer: RpcWriter) -> Result<Self, String> {
        // SAFETY: takes numbers only; the handles are checked by Cyclone.
        check(unsafe { dds_set_status_mask(writer.entity().handle(), READERS_MATCHED) })?;
        // SAFETY: as above.
        check(unsafe { dds_set_status_mask(reader.handle(), WRITERS_MATCHED) })?;
        let guids = [reader.guid(), writer.entity().guid()?];
        Ok(Self { reader, writer, guids, participant: Arc::clone(participant) })
    }

    /// Waits until a condition holds that depends on matches.
    fn wait(&self, is_so: impl Fn() -> bool) -> Result<(), RosError> {
        if is_so() {
            return Ok(());
        }
        let begin = Instant::now();
        let until = begin + Duration::from_millis(MATCH_WAIT_MAX_MS);
        let handles = [self.writer.entity().handle(), self.reader.handle()];
        loop {
            for (handle, matched) in handles.into_iter().zip([READERS_MATCHED, WRITERS_MATCHED]) {
                let mut status = 0;
                // Later changes wake the wait below.
                // SAFETY: the handle is checked by Cyclone, and `status` is a valid place for the result.
                unsafe { dds_take_status(handle, &mut status, matched) };
            }
            if is_so() {
                return Ok(());
            }
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Err(RosError::NoPeer { waited_ms: begin.elapsed().as_millis() as u64 });
            }
            wait_for_status(&self.participant, &handles, left)
                .map_err(|reason| RosError::Write { reason })?;
        }
    }

    /// Returns the matched readers.
    fn readers(&self) -> BTreeSet<Guid> {
        self.of_programs(matched::readers_of(self.writer.entity().handle()))
    }

    /// Returns the matched writers.
    fn writers(&self) -> BTreeSet<Guid> {
        self.of_programs(matched::writers_of(self.reader.handle()))
    }

    /// Returns the endpoints that are not ignored.
    fn of_programs(&self, endpoints: Vec<MatchedEndpoint>) -> BTreeSet<Guid> {
        let is_ignored = |endpoint: &MatchedEndpoint| endpoint.tagged && self.participant.ignores_tagged();
        endpoints.into_iter().filter(|endpoint| !is_ignored(endpoint)).map(|endpoint| endpoint.guid).collect()
    }
}

/// Returns the part of an endpoint's USER_DATA by which rmw_cyclonedds recognises the two endpoints of one client or
/// server and waits for both.
fn pair_mark(key: &str, participant: &Participant) -> String {
    static NUMBER: AtomicU32 = AtomicU32::new(0);
    let prefix = participant.guid().prefix();
    let number = NUMBER.fetch_add(1, Relaxed).to_be_bytes();
    let hex: Vec<_> = prefix.iter().chain(&number).map(|b| format!("{b:02x}")).collect();
    format!("{key}={};", hex.join("."))
}

/// Returns the participants of endpoints.
fn prefixes(endpoints: BTreeSet<Guid>) -> BTreeSet<[u8; 12]> {
    endpoints.iter().map(Guid::prefix).collect()
}

/// Returns client, number and payload of a request, or `None` if it is too short for its mapping.
fn request_of(message: Message) -> Option<([u8; 16], i64, Bytes)> {
    if message.mapping() == Mapping::Body {
        return split(&message.payload);
    }
    // Fast DDS names the reader for the reply; RustDDS means the writer. An id in the form of Cyclone's is not
    // accepted here.
    let named =
        message.origin.related.map(|related| related.guid).filter(|guid| cyclone_id(&guid.0).is_none());
    Some((named.unwrap_or(message.writer).0, message.origin.number, message.payload))
}

/// Returns client, number and payload of a reply, or `None` if it names no request.
fn reply_of(message: Message) -> Option<([u8; 16], i64, Bytes)> {
    if message.mapping() == Mapping::Body {
        return split(&message.payload);
    }
    let related = message.origin.related?;
    Some((related.guid.0, related.number, message.payload))
}

/// Splits a payload with Cyclone's header, or returns `None` if it is too short.
fn split(payload: &Bytes) -> Option<([u8; 16], i64, Bytes)> {
    let (&header, rest) = payload.split_first_chunk::<HEADER_BYTES>()?;
    let (prefix, body) = rest.split_first_chunk::<PREFIX_BYTES>()?;
    let mut halves = prefix.chunks_exact(ID_BYTES).map(|half| {
        let mut bytes = [0; ID_BYTES];
        bytes.copy_from_slice(half);
        if is_little_endian(header) { u64::from_le_bytes(bytes) } else { u64::from_be_bytes(bytes) }
    });
    let (client, number) = (halves.next()?, halves.next()? as i64);
    let mut payload = BytesMut::with_capacity(HEADER_BYTES + body.len());
    payload.put_slice(&header);
    payload.put_slice(body);
    Some((id_bytes(client), number, payload.freeze()))
}

fn prefix(client: u64, number: i64, little: bool) -> [u8; PREFIX_BYTES] {
    let bytes = |n: u64| if little { n.to_le_bytes() } else { n.to_be_bytes() };
    let mut prefix = [0; PREFIX_BYTES];
    prefix[..ID_BYTES].copy_from_slice(&bytes(client));
    prefix[ID_BYTES..].copy_from_slice(&bytes(number as u64));
    prefix
}

fn id_bytes(client: u64) -> [u8; 16] {
    let mut id = [0; 16];
    id[..ID_BYTES].copy_from_slice(&client.to_be_bytes());
    id
}

/// Returns Cyclone's id of a client, or `None` for a GUID, which never ends with zeros.
fn cyclone_id(client: &[u8; 16]) -> Option<u64> {
    let (id, rest) = client.split_first_chunk::<ID_BYTES>()?;
    (*rest == [0; 16 - ID_BYTES]).then(|| u64::from_be_bytes(*id))
}
