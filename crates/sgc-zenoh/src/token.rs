//! Liveliness tokens: the keys that programs declare for their nodes and endpoints, and by which others learn of them.
//!
//! Sources: rmw_zenoh `liveliness_utils.cpp`@3411fdec, `Entity::Entity` and `Entity::make`. The chunk of backends was
//! added for Lyrical by rmw_zenoh's pull request 930; its form is known from hiroz 0.2.1 (`src/buffer_group.rs`).

use std::str::Split;

use sgc_ros::TOPIC_BYTES_MAX;
use sgc_wire::{Qos, RosNode, TYPE_HASH_BYTES_MAX};

use crate::error::{CodecError, Field};
use crate::id::ZenohId;
use crate::qos::{decode_qos, encode_qos};
use crate::text::{SLASH, check_chunk, check_key, demangle, mangle, number};
use crate::topic::{TYPE_BYTES_MAX, TopicInfo};

/// Longest text of backends, bytes.
pub const BACKENDS_BYTES_MAX: usize = 1024;
/// The backends of an endpoint that knows buffers in ordinary memory only.
pub const BACKENDS_CPU: &str = "backends:cpu:";
/// Longest token, bytes: its texts at their longest, and 512 for prefix, kind, numbers, QoS and separators.
pub const TOKEN_BYTES_MAX: usize = RosNode::ENCLAVE_BYTES_MAX
    + 2 * RosNode::NAME_BYTES_MAX
    + TOPIC_BYTES_MAX
    + TYPE_BYTES_MAX
    + TYPE_HASH_BYTES_MAX
    + BACKENDS_BYTES_MAX
    + 512;

/// The first chunk. No wildcard matches it, because it begins with `@`.
const PREFIX: &str = "@ros2_lv";
/// The kind of a token of a node.
const NODE: &str = "NN";
/// The beginning of the chunk of backends.
const BACKENDS: &str = "backends:";
/// Fewest chunks of a token of a node, and of an endpoint.
const NODE_CHUNKS: usize = 9;
const ENDPOINT_CHUNKS: usize = 13;

/// The kind of an endpoint. An action is three services and two topics.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum EntityKind {
    /// A publisher.
    Publisher,
    /// A subscription.
    Subscription,
    /// A server of a service.
    Server,
    /// A client of a service.
    Client,
}

impl EntityKind {
    pub(crate) const ALL: [Self; 4] = [Self::Publisher, Self::Subscription, Self::Server, Self::Client];

    /// Returns the kind as tokens have it.
    fn code(self) -> &'static str {
        match self {
            Self::Publisher => "MP",
            Self::Subscription => "MS",
            Self::Server => "SS",
            Self::Client => "SC",
        }
    }
}

/// A node of a program, or one endpoint of a node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Token {
    /// The ROS domain.
    pub domain: u32,
    /// The session of the program.
    pub session: ZenohId,
    /// The number of the node in its session. Nodes and endpoints share one count, which starts at 0.
    pub node_id: u64,
    /// The node; `None` if ROS accepts no such name. Then the endpoint is one of no known node. A token of a node has it.
    pub node: Option<RosNode>,
    /// The endpoint; `None` if the token stands for the node itself.
    pub endpoint: Option<TokenEndpoint>,
}

/// An endpoint, as its token describes it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TokenEndpoint {
    /// Its kind.
    pub kind: EntityKind,
    /// Its number in its session.
    pub id: u64,
    /// Its topic or service.
    pub topic: TopicInfo,
    /// Its QoS. Partitions and data representations are the default ones.
    pub qos: Qos,
    /// The buffer backends that it knows, beginning with `backends:`, at most [`BACKENDS_BYTES_MAX`] bytes. Only endpoints
    /// of ROS 2 Lyrical and later have any, and only for some types. SGC does not look into it.
    pub backends: Option<String>,
}

impl Token {
    /// Returns the key expression that all tokens of a ROS domain match.
    pub fn all_of(domain: u32) -> String {
        format!("{PREFIX}/{domain}/**")
    }

    /// Returns the key to declare.
    ///
    /// # Errors
    /// [`CodecError::RosName`] without a node, those of [`encode_qos`], and [`CodecError::Unknown`],
    /// [`CodecError::TooLong`], [`CodecError::Empty`] or [`CodecError::Reserved`] for the backends.
    pub fn encode(&self) -> Result<String, CodecError> {
        let Self { domain, session, node_id, node, endpoint } = self;
        let node = node.as_ref().ok_or(CodecError::RosName { field: Field::NodeName })?;
        let (id, kind) = endpoint.as_ref().map_or((*node_id, NODE), |e| (e.id, e.kind.code()));
        let (enclave, namespace) = (mangle(node.enclave().unwrap_or("/")), mangle(node.namespace()));
        let name = node.name();
        let mut token =
            format!("{PREFIX}/{domain}/{session}/{node_id}/{id}/{kind}/{enclave}/{namespace}/{name}");
        if let Some(TokenEndpoint { topic, qos, backends, .. }) = endpoint {
            backends.as_deref().map_or(Ok(()), check_backends)?;
            let (name, qos) = (mangle(topic.name()), encode_qos(qos)?);
            let chunks = [&name, topic.type_name(), topic.type_hash(), &qos];
            for chunk in chunks.into_iter().chain(backends.as_deref()) {
                token.push(SLASH);
                token.push_str(chunk);
            }
        }
        Ok(token)
    }

    /// Reads the key of a token.
    ///
    /// Chunks behind those of the kind are skipped, as rmw_zenoh does, except backends of an endpoint. The texts follow
    /// rules of Zenoh, not those of ROS, but a node has a name that ROS accepts, or none.
    ///
    /// # Errors
    /// [`CodecError::TooLong`], [`CodecError::Empty`], [`CodecError::Reserved`], [`CodecError::NoToken`],
    /// [`CodecError::Chunks`], [`CodecError::Number`], [`CodecError::ZenohId`], [`CodecError::Unknown`] for kind and
    /// policies, [`CodecError::RosName`] for a token of a node.
    pub fn decode(token: &str) -> Result<Self, CodecError> {
        check_key(Field::Token, token, TOKEN_BYTES_MAX)?;
        let mut chunks = Chunks { token, rest: token.split(SLASH), chunks_min: NODE_CHUNKS };
        if chunks.next()? != PREFIX {
            return Err(CodecError::NoToken);
        }
        let domain = number(Field::Domain, chunks.next()?)?;
        let session = chunks.next()?.parse()?;
        let node_id = number(Field::NodeId, chunks.next()?)?;
        let id = number(Field::EndpointId, chunks.next()?)?;
        let code = chunks.next()?;
        let kind = EntityKind::ALL.into_iter().find(|kind| kind.code() == code);
        if kind.is_none() && code != NODE {
            return Err(CodecError::Unknown { field: Field::Kind });
        }
        let enclave = demangle(chunks.next()?);
        let namespace = demangle(chunks.next()?);
        let node = RosNode::new(&namespace, &demangle(chunks.next()?), Some(&enclave));
        let Some(kind) = kind else {
            node.as_ref().ok_or(CodecError::RosName { field: Field::NodeName })?;
            return Ok(Self { domain, session, node_id, node, endpoint: None });
        };
        chunks.chunks_min = ENDPOINT_CHUNKS;
        let (name, type_name, type_hash) = (chunks.next()?, chunks.next()?, chunks.next()?);
        let topic = TopicInfo::new(&demangle(name), &demangle(type_name), &demangle(type_hash))?;
        let qos = decode_qos(chunks.next()?)?;
        let backends = chunks.rest.next().filter(|chunk| chunk.starts_with(BACKENDS));
        backends.map_or(Ok(()), check_backends)?;
        let endpoint = TokenEndpoint { kind, id, topic, qos, backends: backends.map(str::to_owned) };
        Ok(Self { domain, session, node_id, node, endpoint: Some(endpoint) })
    }
}

/// Checks a chunk of backends.
fn check_backends(text: &str) -> Result<(), CodecError> {
    check_chunk(Field::Backends, text, BACKENDS_BYTES_MAX)?;
    if text.starts_with(BACKENDS) { Ok(()) } else { Err(CodecError::Unknown { field: Field::Backends }) }
}

/// The chunks of a token that are not read yet.
struct Chunks<'a> {
    token: &'a str,
    rest: Split<'a, char>,
    /// The number that the token needs, as far as its kind is known.
    chunks_min: usize,
}

impl<'a> Chunks<'a> {
    /// Returns the next chunk, without which the token has too few.
    fn next(&mut self) -> Result<&'a str, CodecError> {
        self.rest.next().ok_or_else(|| CodecError::Chunks {
            field: Field::Token,
            found: self.token.split(SLASH).count(),
            chunks_min: self.chunks_min,
        })
    }
}

#[cfg(test)]
mod tests {
    use sgc_testkit::Dice;
    use sgc_wire::{Durability, History};

    use super::*;

    /// Tokens of running rmw_zenoh nodes: its `design.md`@99a6a2bd, its issues 643 and 753, its pull request 266.
    const GOLDEN: [&str; 7] = [
        "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener",
        "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/10/MS/%/%/listener/%chatter/std_msgs::msg::dds_::String_/RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18/::,10:,:,:,,",
        "@ros2_lv/2/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18/::,7:,:,:,,",
        "@ros2_lv/2/f9980ee0495eaafb3e38f0d19e2eae12/0/10/SS/%/%/add_two_ints_server/%add_two_ints/example_interfaces::srv::dds_::AddTwoInts_/RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a/::,10:,:,:,,",
        "@ros2_lv/2/e1dc8d1b45ae8717fce78689cc655685/0/10/SC/%/%/add_two_ints_client/%add_two_ints/example_interfaces::srv::dds_::AddTwoInts_/RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a/::,10:,:,:,,",
        "@ros2_lv/0/999bf91283606d2068c7524e5badfa6c/0/1/MP/%/%robot1/talker/%rosout/rcl_interfaces::msg::dds_::Log_/RIHS01_e28ce254ca8abc06abf92773b74602cdbf116ed34fbaf294fb9f81da9f318eac/:1:,1000:,:10,0:,,",
        "@ros2_lv/0/999bf91283606d2068c7524e5badfa6c/0/8/MP/%/%robot1/talker/%parameter_events/rcl_interfaces::msg::dds_::ParameterEvent_/RIHS01_043e627780fcad87a22d225bc2a037361dba713fca6a6b9f4b869a5aa0393204/::,1000:,:,:,,",
    ];

    #[test]
    fn tokens_of_rmw_zenoh_are_read_and_written_alike() {
        for token in GOLDEN {
            assert_eq!(Token::decode(token).and_then(|read| read.encode()).as_deref(), Ok(token));
        }
    }

    #[test]
    fn tokens_tell_node_and_endpoint() {
        let node = Token::decode(GOLDEN[0]).unwrap();
        assert_eq!((node.domain, node.node_id, &node.endpoint), (2, 0, &None));
        assert_eq!(node.session.to_string(), "aac3178e146ba6f1fc6e6a4085e77f21");
        assert_eq!(node.node.unwrap().to_string(), "/listener");
        let kinds = GOLDEN.map(|token| Token::decode(token).unwrap().endpoint.map(|endpoint| endpoint.kind));
        let [publisher, subscription, server, client] = EntityKind::ALL.map(Some);
        assert_eq!(kinds, [None, subscription, publisher, server, client, publisher, publisher]);

        let rosout = Token::decode(GOLDEN[5]).unwrap();
        assert_eq!(rosout.node, RosNode::new("/robot1", "talker", None));
        let endpoint = rosout.endpoint.unwrap();
        assert_eq!((endpoint.id, endpoint.topic.name(), endpoint.backends), (1, "/rosout", None));
        assert_eq!(endpoint.topic.type_name(), "rcl_interfaces::msg::dds_::Log_");
        let qos = Qos {
            durability: Durability::TransientLocal,
            history: History::KeepLast(1000),
            lifespan_ns: Some(10_000_000_000),
            ..Qos::default()
        };
        assert_eq!(endpoint.qos, qos);
    }

    /// Humble has no type hashes; the prototype of rmw_zenoh wrote defaults; a robot has an enclave.
    #[test]
    fn other_versions_and_enclaves_are_read() {
        let humble = GOLDEN[1].replace(
            "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
            "TypeHashNotSupported",
        );
        let enclave = GOLDEN[1].replacen("/%/%/", "/%arm%1a/%a%b/", 1);
        for token in [&humble, &enclave.replace("1a", "a1")] {
            assert_eq!(Token::decode(token).and_then(|read| read.encode()).as_ref(), Ok(token));
        }
        // An enclave that ROS does not accept is none.
        let node = Token::decode(&enclave).unwrap().node.unwrap();
        assert_eq!((node.enclave(), node.namespace()), (None, "/a/b"));

        let infinite = "9223372036,854775807";
        let whole = format!("1:1:1,42:{infinite}:{infinite}:1,{infinite}");
        let token = Token::decode(&GOLDEN[1].replace("::,10:,:,:,,", &whole)).unwrap();
        let qos = token.endpoint.unwrap().qos;
        let transient_local = Durability::TransientLocal;
        assert_eq!(
            qos,
            Qos { durability: transient_local, history: History::KeepLast(42), ..Qos::default() }
        );
    }

    #[test]
    fn backends_are_kept_and_other_chunks_are_skipped() {
        for backends in [BACKENDS_CPU, "backends:", "backends:gpu:a=1;b%c"] {
            let token = format!("{}/{backends}", GOLDEN[1]);
            let read = Token::decode(&token).unwrap();
            assert_eq!(read.endpoint.as_ref().unwrap().backends.as_deref(), Some(backends));
            assert_eq!(read.encode(), Ok(token));
        }
        let read = Token::decode(GOLDEN[1]).unwrap();
        for more in ["x", "x/backends:cpu:", "backend"] {
            assert_eq!(Token::decode(&format!("{}/{more}", GOLDEN[1])).as_ref(), Ok(&read));
        }
        let backends =
            Token::decode(&format!("{}/{BACKENDS_CPU}/x", GOLDEN[1])).unwrap().endpoint.unwrap().backends;
        assert_eq!(backends.as_deref(), Some(BACKENDS_CPU));
        assert_eq!(Token::decode(&format!("{}/x/y", GOLDEN[0])), Token::decode(GOLDEN[0]));
    }

    #[test]
    fn an_endpoint_may_be_of_a_node_without_a_name() {
        for name in ["my-node", "1", "a%b"] {
            let endpoint = Token::decode(&GOLDEN[1].replace("/listener/", &format!("/{name}/"))).unwrap();
            assert_eq!((endpoint.node.as_ref(), endpoint.endpoint.is_some()), (None, true));
            assert_eq!(endpoint.encode(), Err(CodecError::RosName { field: Field::NodeName }));
            let node = GOLDEN[0].replace("/listener", &format!("/{name}"));
            assert_eq!(Token::decode(&node), Err(CodecError::RosName { field: Field::NodeName }));
        }
    }

    #[test]
    fn other_text_is_refused() {
        let chunks = |found, chunks_min| CodecError::Chunks { field: Field::Token, found, chunks_min };
        let reserved = |field, character| CodecError::Reserved { field, character };
        let empty = CodecError::Empty { field: Field::Token };
        let node = |from: &str, to: &str| GOLDEN[0].replacen(from, to, 1);
        let endpoint = |from: &str, to: &str| GOLDEN[1].replacen(from, to, 1);
        for (token, refusal) in [
            (String::new(), empty),
            ("a".to_owned(), CodecError::NoToken),
            (node("@ros2_lv", "@ros2_lw"), CodecError::NoToken),
            ("@ros2_lv/2".to_owned(), chunks(2, NODE_CHUNKS)),
            (node("/listener", ""), chunks(8, NODE_CHUNKS)),
            (endpoint("/::,10:,:,:,,", ""), chunks(12, ENDPOINT_CHUNKS)),
            (endpoint("/::,10:,:,:,,", "/"), empty),
            (node("/%/", "//"), empty),
            (node("/2/", "/x/"), CodecError::Number { field: Field::Domain }),
            (node("/2/", "/4294967296/"), CodecError::Number { field: Field::Domain }),
            (node("aac3", "AAC3"), CodecError::ZenohId),
            (node("/0/0/", "/-1/0/"), CodecError::Number { field: Field::NodeId }),
            (node("/0/0/", "/0/a/"), CodecError::Number { field: Field::EndpointId }),
            (node("/NN/", "/AA/"), CodecError::Unknown { field: Field::Kind }),
            (node("listener", "*"), reserved(Field::Token, '*')),
            (endpoint("%chatter", "**"), reserved(Field::Token, '*')),
            (endpoint("%chatter", "%%chatter"), CodecError::Empty { field: Field::Name }),
            (endpoint("std_msgs", "std%msgs"), reserved(Field::Type, '/')),
            (endpoint("RIHS01", "RI%HS01"), reserved(Field::TypeHash, '/')),
            (endpoint("/::,10", "/9::,10"), CodecError::Unknown { field: Field::Reliability }),
        ] {
            assert_eq!(Token::decode(&token), Err(refusal), "{token}");
        }
    }

    #[test]
    fn lengths_are_bounded() {
        let too_long = |field, bytes, bytes_max| Err(CodecError::TooLong { field, bytes, bytes_max });
        let long = |bytes: usize| "a".repeat(bytes);
        let endpoint = |from: &str, to: &str| Token::decode(&GOLDEN[1].replacen(from, to, 1));
        let bytes = TOPIC_BYTES_MAX;
        assert_eq!(endpoint("%chatter", &long(bytes)), too_long(Field::Name, bytes, bytes - 1));
        let backends = |bytes: usize| format!("{}/{BACKENDS}{}", GOLDEN[1], long(bytes - BACKENDS.len()));
        assert!(Token::decode(&backends(BACKENDS_BYTES_MAX)).is_ok());
        let bytes = BACKENDS_BYTES_MAX + 1;
        assert_eq!(Token::decode(&backends(bytes)), too_long(Field::Backends, bytes, BACKENDS_BYTES_MAX));
        let bytes = TOKEN_BYTES_MAX + 1;
        assert_eq!(Token::decode(&long(bytes)), too_long(Field::Token, bytes, TOKEN_BYTES_MAX));
    }

    #[test]
    fn the_longest_token_is_read() {
        let path = |bytes: usize| format!("/{}", "a".repeat(bytes - 1));
        let (name_bytes, enclave) = (RosNode::NAME_BYTES_MAX, path(RosNode::ENCLAVE_BYTES_MAX));
        let node = RosNode::new(&path(name_bytes), &"a".repeat(name_bytes), Some(&enclave));
        let (type_name, hash) = ("a".repeat(TYPE_BYTES_MAX), "a".repeat(TYPE_HASH_BYTES_MAX));
        let long = Some(9_223_372_035_987_654_321);
        let qos = Qos {
            reliability: sgc_wire::Reliability::BestEffort,
            durability: Durability::TransientLocal,
            history: History::KeepLast(crate::DEPTH_MAX),
            deadline_ns: long,
            lifespan_ns: long,
            liveliness: sgc_wire::Liveliness::ManualByTopic,
            lease_ns: long,
            ..Qos::default()
        };
        let token = Token {
            domain: u32::MAX,
            session: "f".repeat(32).parse().unwrap(),
            node_id: u64::MAX,
            node,
            endpoint: Some(TokenEndpoint {
                kind: EntityKind::Publisher,
                id: u64::MAX,
                topic: TopicInfo::new(&path(TOPIC_BYTES_MAX), &type_name, &hash).unwrap(),
                qos,
                backends: Some(format!("{BACKENDS}{}", "a".repeat(BACKENDS_BYTES_MAX - BACKENDS.len()))),
            }),
        };
        assert!(token.node.is_some());
        assert_eq!(token.encode().and_then(|text| Token::decode(&text)), Ok(token));
    }

    #[test]
    fn backends_that_are_none_are_not_written() {
        let with = |backends: &str| {
            let mut token = Token::decode(GOLDEN[1]).unwrap();
            token.endpoint.as_mut().unwrap().backends = Some(backends.to_owned());
            token.encode()
        };
        assert_eq!(with("cpu"), Err(CodecError::Unknown { field: Field::Backends }));
        assert_eq!(with(""), Err(CodecError::Empty { field: Field::Backends }));
        for (backends, character) in [("backends:/x", '/'), ("backends:*", '*'), ("backends:\0", '\0')] {
            assert_eq!(with(backends), Err(CodecError::Reserved { field: Field::Backends, character }));
        }
        assert!(matches!(
            with(&"backends:".repeat(200)),
            Err(CodecError::TooLong { field: Field::Backends, .. })
        ));
    }

    #[test]
    fn one_expression_matches_the_tokens_of_a_domain() {
        assert_eq!(Token::all_of(42), "@ros2_lv/42/**");
    }

    #[test]
    fn altered_tokens_are_read_or_refused() {
        let mut dice = Dice::new(1);
        let mut read = 0;
        for _ in 0..20_000 {
            let mut token: Vec<char> = dice.pick(&GOLDEN).unwrap().chars().collect();
            for _ in 0..dice.within(1..=4) {
                let at = dice.below(token.len().max(1));
                match dice.below(3) {
                    0 if !token.is_empty() => drop(token.remove(at)),
                    1 => token.insert(at, dice.pick(&['/', '%', ':', ',', '0', '9', 'a', '*', 'ä']).unwrap()),
                    _ => token.truncate(at),
                }
            }
            let token: String = token.into_iter().collect();
            let Ok(value) = Token::decode(&token) else { continue };
            read += 1;
            match value.encode() {
                Ok(text) => assert_eq!(Token::decode(&text), Ok(value), "{token}"),
                Err(refusal) => {
                    assert_eq!((refusal, value.node), (CodecError::RosName { field: Field::NodeName }, None))
                }
            }
        }
        assert!(read > 1000, "{read} tokens were read");
    }
}
