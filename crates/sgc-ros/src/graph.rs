//! The ROS graph: nodes and their endpoints.
//!
//! Every ROS 2 participant announces its nodes on the topic `ros_discovery_info`
//! (`rmw_dds_common/msg/ParticipantEntitiesInfo`). This module has the codec of that message, and [`GraphView`],
//! which tracks the nodes of all participants. The network reads and writes the topic.

use std::collections::BTreeMap;

use bytes::Bytes;
use sgc_wire::{Durability, History, Qos, RosNode};

use crate::network::{DiscoveryEvent, EndpointSpec, GraphNode, Guid};

/// The DDS topic on which participants announce their nodes.
pub const GRAPH_TOPIC: &str = "ros_discovery_info";
/// The DDS type of the topic.
const GRAPH_TYPE: &str = "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_";
/// Longest message that is decoded, in bytes.
pub const GRAPH_MESSAGE_BYTES_MAX: usize = 4 << 20;
/// Most nodes of one participant.
pub const NODES_PER_PARTICIPANT_MAX: usize = 4096;
/// Most participants that are tracked.
pub const PARTICIPANTS_MAX: usize = 4096;
/// Most endpoints of one participant that belong to a node.
const GIDS_PER_PARTICIPANT_MAX: usize = 65_536;

/// The length of endpoint ids in the messages of a ROS 2 distribution (`rmw_dds_common/msg/Gid`). The message does
/// not contain it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub enum GidBytes {
    /// Newer distributions, such as Jazzy: the GUID.
    #[default]
    Sixteen,
    /// Older distributions, such as Humble: the GUID and eight zeros.
    TwentyFour,
}

impl GidBytes {
    /// Returns the number of bytes.
    pub fn count(self) -> usize {
        match self {
            Self::Sixteen => 16,
            Self::TwentyFour => 24,
        }
    }
}

/// The reason why a message about the graph is rejected.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum GraphError {
    /// The message is not of that type, with ids of either length.
    #[error("no message of nodes and endpoints")]
    Malformed,
    /// The message can be decoded with ids of both lengths.
    #[error("a message that can be read with ids of 16 and of 24 bytes")]
    Ambiguous,
    /// The message describes another participant than its writer's.
    #[error("a message about another participant than its writer's")]
    Foreign,
    /// There are too many participants.
    #[error("more than {PARTICIPANTS_MAX} participants")]
    TooMany,
}

/// A participant's announcement of its nodes, without the enclave.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ParticipantNodes {
    /// The participant.
    pub participant: Guid,
    /// The length of ids in the message.
    pub gid_bytes: GidBytes,
    /// The nodes; those with invalid names are left out.
    pub nodes: Vec<GraphNode>,
}

/// Returns the spec of the topic's writer as in rmw (`rmw_cyclonedds_cpp`, `rmw_fastrtps_shared_cpp`:
/// `init_context`).
pub fn graph_writer() -> EndpointSpec {
    EndpointSpec {
        topic: GRAPH_TOPIC.into(),
        type_name: GRAPH_TYPE.into(),
        keyless: true,
        asks_key_hash: false,
        type_hash: None,
        qos: Qos { durability: Durability::TransientLocal, history: History::KeepLast(1), ..Qos::default() },
    }
}

/// Returns the spec of the topic's reader as in rmw.
pub fn graph_reader() -> EndpointSpec {
    let spec = graph_writer();
    EndpointSpec { qos: Qos { history: History::KeepAll, ..spec.qos }, ..spec }
}

/// Encodes the announcement of a participant's nodes as CDR with its encapsulation header. Nodes and endpoints beyond
/// the bounds of the decoder are left out.
pub fn encode_nodes(participant: &Guid, nodes: &[GraphNode], gid_bytes: GidBytes) -> Bytes {
    let mut w = CdrWriter { out: vec![0, 1, 0, 0] };
    w.gid(participant, gid_bytes);
    let nodes = &nodes[..nodes.len().min(NODES_PER_PARTICIPANT_MAX)];
    w.u32(nodes.len());
    let mut room = GIDS_PER_PARTICIPANT_MAX;
    for node in nodes {
        w.string(node.node.namespace());
        w.string(node.node.name());
        for gids in [&node.readers, &node.writers] {
            let gids = &gids[..gids.len().min(room)];
            room -= gids.len();
            w.u32(gids.len());
            gids.iter().for_each(|gid| w.gid(gid, gid_bytes));
        }
    }
    w.out.into()
}

/// Decodes an announcement. Both lengths of ids are tried, and exactly one of them must fit.
pub fn decode_nodes(payload: &[u8]) -> Result<ParticipantNodes, GraphError> {
    let found = [GidBytes::Sixteen, GidBytes::TwentyFour].map(|gid_bytes| decode_with(payload, gid_bytes));
    match found {
        [Some(info), None] | [None, Some(info)] => Ok(info),
        [None, None] => Err(GraphError::Malformed),
        [Some(_), Some(_)] => Err(GraphError::Ambiguous),
    }
}

fn decode_with(payload: &[u8], gid_bytes: GidBytes) -> Option<ParticipantNodes> {
    let (header, body) = payload.split_at_checked(4).filter(|_| payload.len() <= GRAPH_MESSAGE_BYTES_MAX)?;
    // CDR and plain CDR2 differ only in the alignment of 8-byte values (DDS-XTypes 1.3, 7.4.3.4), which do not occur
    // here.
    let big_endian = match header[..2] {
        [0, 0 | 6] => true,
        [0, 1 | 7] => false,
        _ => return None,
    };
    let mut r = CdrReader { body, at: 0, big_endian };
    let participant = r.gid(gid_bytes)?;
    let mut nodes = Vec::new();
    let mut room = GIDS_PER_PARTICIPANT_MAX;
    for _ in 0..r.count(NODES_PER_PARTICIPANT_MAX)? {
        let (namespace, name) = (r.string()?, r.string()?);
        let mut gids = || {
            let count = r.count(room)?;
            room -= count;
            (0..count).map(|_| r.gid(gid_bytes)).collect::<Option<Vec<_>>>()
        };
        let (mut readers, mut writers) = (gids()?, gids()?);
        // A participant may announce only its own endpoints.
        let is_own = |gid: &Guid| gid.prefix() == participant.prefix();
        readers.retain(is_own);
        writers.retain(is_own);
        let node = RosNode::new(namespace, name, None);
        nodes.extend(node.map(|node| GraphNode { node, readers, writers }));
    }
    r.is_at_end().then_some(ParticipantNodes { participant, gid_bytes, nodes })
}

struct CdrWriter {
    out: Vec<u8>,
}

impl CdrWriter {
    fn gid(&mut self, gid: &Guid, gid_bytes: GidBytes) {
        self.out.extend(gid.0);
        self.out.resize(self.out.len() + gid_bytes.count() - gid.0.len(), 0);
    }

    /// Counts here are bounded far below 4 GiB.
    fn u32(&mut self, n: usize) {
        // The header has four bytes, so counting it does not change the alignment.
        self.out.resize(self.out.len().next_multiple_of(4), 0);
        self.out.extend((n as u32).to_le_bytes());
    }

    fn string(&mut self, text: &str) {
        self.u32(text.len() + 1);
        self.out.extend(text.as_bytes());
        self.out.push(0);
    }
}

struct CdrReader<'a> {
    body: &'a [u8],
    at: usize,
    big_endian: bool,
}

impl<'a> CdrReader<'a> {
    fn take(&mut self, n: usize) -> Option<&'a [u8]> {
        let taken = self.body.get(self.at..)?.get(..n)?;
        self.at += n;
        Some(taken)
    }

    fn gid(&mut self, gid_bytes: GidBytes) -> Option<Guid> {
        let (guid, _) = self.take(gid_bytes.count())?.split_first_chunk::<16>()?;
        Some(Guid(*guid))
    }

    fn u32(&mut self) -> Option<usize> {
        self.at = self.at.next_multiple_of(4);
        let bytes = self.take(4)?.try_into().ok()?;
        let value = if self.big_endian { u32::from_be_bytes(bytes) } else { u32::from_le_bytes(bytes) };
        usize::try_from(value).ok()
    }

    fn count(&mut self, max: usize) -> Option<usize> {
        self.u32().filter(|n| *n <= max)
    }

    fn string(&mut self) -> Option<&'a str> {
        let bytes = self.count(RosNode::NAME_BYTES_MAX + 1)?;
        let text = self.take(bytes)?;
        std::str::from_utf8(text.strip_suffix(&[0])?).ok()
    }

    /// Returns `true` if only padding is left.
    fn is_at_end(&self) -> bool {
        self.body.len() - self.at < 4
    }
}

/// The nodes of a network's participants.
///
/// A participant's nodes are reported while the participant exists.
#[derive(Debug, Default)]
pub struct GraphView {
    participants: BTreeMap<[u8; 12], Participant>,
}

#[derive(Debug, Default)]
struct Participant {
    guid: Option<Guid>,
    enclave: Option<String>,
    said: Option<ParticipantNodes>,
    told: Vec<GraphNode>,
}

impl GraphView {
    /// Handles a new participant of an enclave.
    pub fn participant_there(&mut self, guid: Guid, enclave: Option<&str>) -> Option<DiscoveryEvent> {
        let participant = self.participant(&guid)?;
        participant.guid = Some(guid);
        participant.enclave = enclave.filter(|e| e.len() <= RosNode::ENCLAVE_BYTES_MAX).map(str::to_owned);
        participant.tell()
    }

    /// Handles the end of a participant and its nodes.
    pub fn participant_gone(&mut self, guid: &Guid) -> Option<DiscoveryEvent> {
        let gone = self.participants.remove(&guid.prefix())?;
        let participant = gone.guid.filter(|_| !gone.told.is_empty())?;
        Some(DiscoveryEvent::Nodes { participant, nodes: Vec::new() })
    }

    /// Handles a participant's announcement, written by `writer`.
    pub fn handle_message(
        &mut self,
        writer: Option<Guid>,
        payload: &[u8],
    ) -> Result<Option<DiscoveryEvent>, GraphError> {
        let said = decode_nodes(payload)?;
        if writer.is_some_and(|writer| writer.prefix() != said.participant.prefix()) {
            return Err(GraphError::Foreign);
        }
        let guid = said.participant;
        let participant = self.participant(&guid).ok_or(GraphError::TooMany)?;
        participant.said = Some(said);
        Ok(participant.tell())
    }

    /// Returns the length of ids in the announcements of most participants.
    pub fn gid_bytes(&self) -> GidBytes {
        let all = self.participants.values().filter(|p| p.guid.is_some());
        let (mut short, mut long) = (0, 0);
        for said in all.filter_map(|p| p.said.as_ref()) {
            *(if said.gid_bytes == GidBytes::Sixteen { &mut short } else { &mut long }) += 1;
        }
        if long > short { GidBytes::TwentyFour } else { GidBytes::Sixteen }
    }

    fn participant(&mut self, guid: &Guid) -> Option<&mut Participant> {
        let prefix = guid.prefix();
        if self.participants.len() >= PARTICIPANTS_MAX && !self.participants.contains_key(&prefix) {
            // An announcement without its participant came early or late, and gives way.
            let absent = self.participants.iter().find(|(_, p)| p.guid.is_none()).map(|(prefix, _)| *prefix);
            self.participants.remove(&absent?);
        }
        Some(self.participants.entry(prefix).or_default())
    }
}

impl Participant {
    /// Reports the nodes if the participant exists and they have changed.
    fn tell(&mut self) -> Option<DiscoveryEvent> {
        let (participant, said) = (self.guid?, self.said.as_ref()?);
        let enclave = self.enclave.as_deref();
        let nodes = said.nodes.iter().filter_map(|n| {
            let node = RosNode::new(n.node.namespace(), n.node.name(), enclave)?;
            Some(GraphNode { node, ..n.clone() })
        });
        let nodes: Vec<_> = nodes.collect();
        if nodes == self.told {
            return None;
        }
        self.told = nodes.clone();
        Some(DiscoveryEvent::Nodes { participant, nodes })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn guid(participant: u8, entity: u8) -> Guid {
        let mut guid = [participant; 16];
        guid[12..].copy_from_slice(&[0, 0, entity, 3]);
        Guid(guid)
    }

    fn node(namespace: &str, name: &str, readers: &[u8], writers: &[u8]) -> GraphNode {
        let gids = |all: &[u8]| all.iter().map(|n| guid(7, *n)).collect();
        let node = RosNode::new(namespace, name, None).unwrap();
        GraphNode { node, readers: gids(readers), writers: gids(writers) }
    }

    fn nodes() -> Vec<GraphNode> {
        vec![node("/robot", "talker", &[1], &[2, 3]), node("/", "x", &[], &[])]
    }

    fn hex(text: &str) -> Vec<u8> {
        let digits: Vec<_> = text.bytes().filter(|b| !b.is_ascii_whitespace()).collect();
        let byte = |pair: &[u8]| u8::from_str_radix(std::str::from_utf8(pair).unwrap(), 16).unwrap();
        digits.chunks(2).map(byte).collect()
    }

    /// Made by `scripts/graph-vectors.py`, with PyPI's `rosbags`, from rmw_dds_common's message definitions.
    const GOLDEN: [(GidBytes, &str); 2] = [
        (GidBytes::Sixteen, include_str!("../tests/vectors/graph-16.hex")),
        (GidBytes::TwentyFour, include_str!("../tests/vectors/graph-24.hex")),
    ];

    #[test]
    fn messages_are_those_of_an_independent_encoder() {
        for (gid_bytes, golden) in GOLDEN {
            let golden = hex(golden);
            assert_eq!(encode_nodes(&guid(7, 0xc1), &nodes(), gid_bytes), golden);
            let expected = ParticipantNodes { participant: guid(7, 0xc1), gid_bytes, nodes: nodes() };
            assert_eq!(decode_nodes(&golden), Ok(expected.clone()));
            assert_eq!(decode_nodes(&[&golden[..], &[0; 3]].concat()), Ok(expected));
            let padded = [&golden[..], &[0; 4]].concat();
            assert_eq!(decode_nodes(&padded), Err(GraphError::Malformed));
        }
    }

    #[test]
    fn the_length_of_ids_is_recognised_whatever_is_listed() {
        for gid_bytes in [GidBytes::Sixteen, GidBytes::TwentyFour] {
            for n in 0..12u8 {
                let ids: Vec<_> = (0..n).collect();
                let name = "n".repeat(1 + usize::from(n));
                let nodes = vec![node("/", &name, &ids[..usize::from(n) / 2], &ids); usize::from(n) % 5];
                let message = encode_nodes(&guid(7, 0), &nodes, gid_bytes);
                let expected = ParticipantNodes { participant: guid(7, 0), gid_bytes, nodes };
                assert_eq!(decode_nodes(&message), Ok(expected));
            }
        }
    }

    #[test]
    fn hostile_messages_are_refused() {
        for (_, golden) in GOLDEN {
            let golden = hex(golden);
            for n in 0..golden.len() - 3 {
                // A message with long ids that is cut behind its first zeros equals an empty one with short ids.
                let read = decode_nodes(&golden[..n]);
                let is_empty = (24..28).contains(&n) && read.as_ref().is_ok_and(|said| said.nodes.is_empty());
                assert!(read.is_err() || is_empty, "{n}");
            }
            for at in 0..golden.len() {
                for value in [0, 1, 0x7f, 0x80, 0xff] {
                    let mut message = golden.clone();
                    message[at] = value;
                    let _ = decode_nodes(&message);
                }
            }
        }
        // Counts beyond the data allocate nothing.
        let mut huge = encode_nodes(&guid(7, 0), &[], GidBytes::Sixteen).to_vec();
        huge[20..24].copy_from_slice(&u32::MAX.to_le_bytes());
        assert_eq!(decode_nodes(&huge), Err(GraphError::Malformed));
        // Endpoints of another participant are not believed.
        let stranger = GraphNode { writers: vec![guid(8, 1)], ..node("/", "a", &[1], &[]) };
        let read = decode_nodes(&encode_nodes(&guid(7, 0), &[stranger], GidBytes::Sixteen)).unwrap();
        assert_eq!(read.nodes, [node("/", "a", &[1], &[])]);
    }

    fn told(event: Option<DiscoveryEvent>) -> Option<Vec<String>> {
        match event? {
            DiscoveryEvent::Nodes { nodes, .. } => Some(nodes.iter().map(|n| n.node.to_string()).collect()),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn nodes_are_told_while_their_participant_is_there() {
        let mut view = GraphView::default();
        let said = |nodes: &[GraphNode]| encode_nodes(&guid(7, 0xc1), nodes, GidBytes::TwentyFour);
        let writer = Some(guid(7, 9));
        assert_eq!(view.handle_message(writer, &said(&nodes())), Ok(None), "not there yet");
        assert_eq!(told(view.participant_there(guid(7, 0xc1), None)).unwrap(), ["/robot/talker", "/x"]);
        assert_eq!(view.participant_there(guid(7, 0xc1), None), None);
        assert_eq!(view.handle_message(writer, &said(&nodes())), Ok(None), "nothing new");
        assert_eq!(view.gid_bytes(), GidBytes::TwentyFour);
        assert_eq!(
            told(view.handle_message(writer, &said(&nodes()[..1])).unwrap()).unwrap(),
            ["/robot/talker"]
        );
        let event = view.participant_there(guid(7, 0xc1), Some("/arm"));
        let Some(DiscoveryEvent::Nodes { nodes: in_enclave, .. }) = event else { panic!("{event:?}") };
        assert_eq!(in_enclave[0].node.enclave(), Some("/arm"));
        assert_eq!(view.handle_message(Some(guid(8, 9)), &said(&[])), Err(GraphError::Foreign));
        assert!(told(view.participant_gone(&guid(7, 0xc1))).unwrap().is_empty());
        // A late announcement does not bring the participant back.
        assert_eq!(view.handle_message(writer, &said(&nodes())), Ok(None));
        assert_eq!(view.gid_bytes(), GidBytes::Sixteen);
        assert_eq!(view.participant_gone(&guid(7, 0xc1)), None);
    }

    #[test]
    fn participants_have_a_bound() {
        let mut view = GraphView::default();
        let of = |n: usize| {
            let mut guid = guid(0, 0xc1);
            guid.0[..8].copy_from_slice(&(n as u64).to_be_bytes());
            guid
        };
        for n in 0..PARTICIPANTS_MAX {
            let message = encode_nodes(&of(n), &[], GidBytes::Sixteen);
            assert_eq!(view.handle_message(None, &message), Ok(None));
        }
        for n in 0..PARTICIPANTS_MAX {
            view.participant_there(of(n + 7), None);
        }
        let message = encode_nodes(&of(1), &[], GidBytes::Sixteen);
        assert_eq!(view.handle_message(None, &message), Err(GraphError::TooMany));
    }
}
