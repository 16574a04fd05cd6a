//! Keys of topics and services.
//!
//! Source: rmw_zenoh `liveliness_utils.cpp`@3411fdec, `strip_slashes` and `TopicInfo::TopicInfo`.

use sgc_ros::{ServiceTopic, TOPIC_BYTES_MAX, dds_topic, dds_type, is_topic_name, ros_topic, ros_type};
use sgc_wire::{METADATA_FIELD_BYTES_MAX, TYPE_HASH_BYTES_MAX};

use crate::error::{CodecError, Field};
use crate::text::{SLASH, check_chunk, check_key, check_unmangled, number};

/// Longest DDS name of a type, bytes.
pub const TYPE_BYTES_MAX: usize = METADATA_FIELD_BYTES_MAX;
/// Longest key, bytes: the domain in ten digits, name, type and hash.
pub const KEY_BYTES_MAX: usize = 10 + TOPIC_BYTES_MAX + 1 + TYPE_BYTES_MAX + 1 + TYPE_HASH_BYTES_MAX;

/// Fewest chunks of a key: domain, name, type, hash.
const CHUNKS_MIN: usize = 4;

/// A topic or service: name, type and type hash, which together with the domain are its key.
///
/// Publishers and subscribers, clients and servers hear each other if their keys are equal, and otherwise not. QoS
/// decides nothing.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TopicInfo {
    name: String,
    type_name: String,
    type_hash: String,
}

impl TopicInfo {
    /// Returns the topic or service of this name, DDS type (`std_msgs::msg::dds_::String_`; of a service, the type
    /// without the half, `a::srv::dds_::B_`) and type hash (of a service, that of the service as a whole). Any text is
    /// taken that makes a key without wildcards, so that programs with unusual names can be described. Names that have
    /// the same key are equal: the slash in front of a name is added if it is missing, one behind it is removed.
    ///
    /// # Errors
    /// [`CodecError::TooLong`], [`CodecError::Empty`], [`CodecError::Reserved`].
    pub fn new(name: &str, type_name: &str, type_hash: &str) -> Result<Self, CodecError> {
        let stripped = name.strip_prefix(SLASH).unwrap_or(name);
        let stripped = stripped.strip_suffix(SLASH).unwrap_or(stripped);
        check_key(Field::Name, stripped, TOPIC_BYTES_MAX - 1)?;
        check_chunk(Field::Type, type_name, TYPE_BYTES_MAX)?;
        check_chunk(Field::TypeHash, type_hash, TYPE_HASH_BYTES_MAX)?;
        check_unmangled(Field::Name, stripped)?;
        check_unmangled(Field::Type, type_name)?;
        check_unmangled(Field::TypeHash, type_hash)?;
        Ok(Self {
            name: format!("{SLASH}{stripped}"),
            type_name: type_name.to_owned(),
            type_hash: type_hash.to_owned(),
        })
    }

    /// Returns the topic or service of a DDS endpoint, by its topic, type and type hash. Of a service, either half may be
    /// given. The hash must then be that of the service as a whole, which
    /// [`ServiceSpec`](sgc_ros::ServiceSpec) holds in its request. Endpoints of Fast DDS announce the hashes of the two
    /// messages instead, from which that of the service does not follow.
    ///
    /// # Errors
    /// [`CodecError::NoTypeHash`] without a hash, [`CodecError::RosName`] if ROS accepts no such name or the topic
    /// carries neither topics nor services, and those of [`Self::new`] for type and hash.
    pub fn from_dds(topic: &str, dds_type_name: &str, type_hash: Option<&str>) -> Result<Self, CodecError> {
        let no_name = CodecError::RosName { field: Field::Name };
        let (name, type_name) = match ServiceTopic::parse(topic, dds_type_name) {
            Some((_, service, type_name)) => (service, dds_type(&type_name)),
            None => (ros_topic(topic).ok_or(no_name)?, dds_type_name.to_owned()),
        };
        if !is_topic_name(name) {
            return Err(no_name);
        }
        Self::new(name, &type_name, type_hash.ok_or(CodecError::NoTypeHash)?)
    }

    /// Returns the least topic of this name and type in the order of topics.
    pub(crate) fn least(name: &str, type_name: &str) -> Self {
        Self { name: name.to_owned(), type_name: type_name.to_owned(), type_hash: String::new() }
    }

    /// Returns the name, with a slash in front: `/chatter`.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the DDS name of the type, of a service without the half.
    pub fn type_name(&self) -> &str {
        &self.type_name
    }

    /// Returns the hash of the type: `RIHS01_` and 64 digits, or `TypeHashNotSupported` in ROS 2 Humble.
    pub fn type_hash(&self) -> &str {
        &self.type_hash
    }

    /// Returns the key in a ROS domain.
    pub fn key(&self, domain: u32) -> String {
        let Self { name, type_name, type_hash } = self;
        format!("{domain}{name}/{type_name}/{type_hash}")
    }

    /// Reads the key of a topic or service into domain and the rest.
    ///
    /// # Errors
    /// [`CodecError::TooLong`], [`CodecError::Chunks`], [`CodecError::Number`] for the domain, and those of
    /// [`Self::new`].
    pub fn parse(key: &str) -> Result<(u32, Self), CodecError> {
        if key.len() > KEY_BYTES_MAX {
            let (bytes, bytes_max) = (key.len(), KEY_BYTES_MAX);
            return Err(CodecError::TooLong { field: Field::Key, bytes, bytes_max });
        }
        let chunks = || {
            let (rest, type_hash) = key.rsplit_once(SLASH)?;
            let (rest, type_name) = rest.rsplit_once(SLASH)?;
            let (domain, name) = rest.split_once(SLASH)?;
            Some((domain, name, type_name, type_hash))
        };
        let (domain, name, type_name, type_hash) = chunks().ok_or_else(|| CodecError::Chunks {
            field: Field::Key,
            found: key.split(SLASH).count(),
            chunks_min: CHUNKS_MIN,
        })?;
        // Of a name alone, a slash at an end is not part of the key. Here it is an empty chunk.
        if name.starts_with(SLASH) || name.ends_with(SLASH) {
            return Err(CodecError::Empty { field: Field::Name });
        }
        Ok((number(Field::Domain, domain)?, Self::new(name, type_name, type_hash)?))
    }

    /// Returns topic and type of a DDS endpoint of this topic.
    pub fn dds_topic(&self) -> (String, String) {
        (dds_topic(&self.name), self.type_name.clone())
    }

    /// Returns topic and type of a DDS endpoint of one half of this service.
    pub fn dds_service(&self, half: ServiceTopic) -> (String, String) {
        (half.dds_topic(&self.name), half.dds_type(&ros_type(&self.type_name)))
    }
}

#[cfg(test)]
mod tests {
    use sgc_testkit::Dice;

    use super::*;

    const STRING: &str = "std_msgs::msg::dds_::String_";
    const HASH: &str = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18";

    /// Keys of rmw_zenoh's `design.md`@99a6a2bd.
    #[test]
    fn keys_are_those_of_rmw_zenoh() {
        for (key, domain, name, type_name) in [
            (format!("0/chatter/{STRING}/{HASH}"), 0, "/chatter", STRING),
            (format!("0/robot1/chatter/{STRING}/{HASH}"), 0, "/robot1/chatter", STRING),
            (
                format!("2/add_two_ints/example_interfaces::srv::dds_::AddTwoInts_/{HASH}"),
                2,
                "/add_two_ints",
                "example_interfaces::srv::dds_::AddTwoInts_",
            ),
        ] {
            let topic = TopicInfo::new(name, type_name, HASH).unwrap();
            assert_eq!(topic.key(domain), key);
            assert_eq!(TopicInfo::parse(&key), Ok((domain, topic)));
        }
        let humble = TopicInfo::new("/a", STRING, "TypeHashNotSupported").unwrap();
        assert_eq!(humble.key(7), format!("7/a/{STRING}/TypeHashNotSupported"));
    }

    #[test]
    fn topics_and_both_halves_of_services_have_keys() {
        let topic = TopicInfo::from_dds("rt/a/b", STRING, Some(HASH)).unwrap();
        assert_eq!((topic.name(), topic.type_name(), topic.type_hash()), ("/a/b", STRING, HASH));
        assert_eq!(topic.dds_topic(), ("rt/a/b".into(), STRING.into()));
        let goal = TopicInfo::new("/go/_action/send_goal", "a::action::dds_::B_SendGoal_", HASH).unwrap();
        for (half, topic, type_name) in [
            (ServiceTopic::Request, "rq/go/_action/send_goalRequest", "a::action::dds_::B_SendGoal_Request_"),
            (ServiceTopic::Reply, "rr/go/_action/send_goalReply", "a::action::dds_::B_SendGoal_Response_"),
        ] {
            assert_eq!(TopicInfo::from_dds(topic, type_name, Some(HASH)).as_ref(), Ok(&goal));
            assert_eq!(goal.dds_service(half), (topic.into(), type_name.into()));
        }
    }

    #[test]
    fn endpoints_outside_of_ros_or_without_a_hash_have_none() {
        assert_eq!(TopicInfo::from_dds("rt/a", STRING, None), Err(CodecError::NoTypeHash));
        for topic in ["ros_discovery_info", "rt/", "rt/a//b", "rt/a*", "rt/a b", "rt/1", "rq/aRequest"] {
            let refusal = Err(CodecError::RosName { field: Field::Name });
            assert_eq!(TopicInfo::from_dds(topic, STRING, Some(HASH)), refusal, "{topic}");
        }
    }

    #[test]
    fn names_with_one_key_are_equal() {
        let topic = TopicInfo::new("/a/b", STRING, HASH).unwrap();
        for name in ["a/b", "a/b/", "/a/b/"] {
            assert_eq!(TopicInfo::new(name, STRING, HASH).as_ref(), Ok(&topic), "{name}");
        }
    }

    #[test]
    fn parts_that_would_make_another_key_are_refused() {
        let reserved = |field, character| Err(CodecError::Reserved { field, character });
        for (name, refusal) in [
            ("", Err(CodecError::Empty { field: Field::Name })),
            ("/", Err(CodecError::Empty { field: Field::Name })),
            ("//a", Err(CodecError::Empty { field: Field::Name })),
            ("/a//b", Err(CodecError::Empty { field: Field::Name })),
            ("/**", reserved(Field::Name, '*')),
            ("/a%b", reserved(Field::Name, '%')),
            ("/a\n", reserved(Field::Name, '\n')),
        ] {
            assert_eq!(TopicInfo::new(name, STRING, HASH), refusal, "{name:?}");
        }
        for (part, character) in [("a/b", '/'), ("a%b", '%'), ("*", '*')] {
            assert_eq!(TopicInfo::new("/a", part, HASH), reserved(Field::Type, character));
            assert_eq!(TopicInfo::new("/a", STRING, part), reserved(Field::TypeHash, character));
        }
        let empty = |field| Err(CodecError::Empty { field });
        assert_eq!(TopicInfo::new("/a", "", HASH), empty(Field::Type));
        assert_eq!(TopicInfo::new("/a", STRING, ""), empty(Field::TypeHash));
    }

    #[test]
    fn lengths_are_bounded() {
        let long = |bytes: usize| "a".repeat(bytes);
        let too_long = |field, bytes_max| Err(CodecError::TooLong { field, bytes: bytes_max + 1, bytes_max });
        let longest =
            TopicInfo::new(&long(TOPIC_BYTES_MAX - 1), &long(TYPE_BYTES_MAX), &long(TYPE_HASH_BYTES_MAX));
        let key = longest.as_ref().unwrap().key(u32::MAX);
        assert_eq!((key.len(), longest), (KEY_BYTES_MAX, TopicInfo::parse(&key).map(|(_, topic)| topic)));
        let name = long(TOPIC_BYTES_MAX);
        assert_eq!(TopicInfo::new(&name, STRING, HASH), too_long(Field::Name, TOPIC_BYTES_MAX - 1));
        let type_name = long(TYPE_BYTES_MAX + 1);
        assert_eq!(TopicInfo::new("/a", &type_name, HASH), too_long(Field::Type, TYPE_BYTES_MAX));
        let hash = long(TYPE_HASH_BYTES_MAX + 1);
        assert_eq!(TopicInfo::new("/a", STRING, &hash), too_long(Field::TypeHash, TYPE_HASH_BYTES_MAX));
        let key = long(KEY_BYTES_MAX + 1);
        let refusal = too_long(Field::Key, KEY_BYTES_MAX);
        assert_eq!(TopicInfo::parse(&key).map(|(_, topic)| topic), refusal);
    }

    #[test]
    fn keys_of_other_programs_are_refused() {
        let chunks = |found| Err(CodecError::Chunks { field: Field::Key, found, chunks_min: CHUNKS_MIN });
        for (key, refusal) in [
            ("", chunks(1)),
            ("0/a/b", chunks(3)),
            ("x/a/b/c", Err(CodecError::Number { field: Field::Domain })),
            ("/a/b/c", Err(CodecError::Number { field: Field::Domain })),
            ("4294967296/a/b/c", Err(CodecError::Number { field: Field::Domain })),
            ("0//b/c", Err(CodecError::Empty { field: Field::Name })),
            ("0//a/b/c", Err(CodecError::Empty { field: Field::Name })),
            ("0/a//b/c", Err(CodecError::Empty { field: Field::Name })),
            ("0/a/b/", Err(CodecError::Empty { field: Field::TypeHash })),
            ("0/*/b/c", Err(CodecError::Reserved { field: Field::Name, character: '*' })),
        ] {
            assert_eq!(TopicInfo::parse(key), refusal, "{key:?}");
        }
    }

    #[test]
    fn random_topics_round_trip() {
        let mut dice = Dice::new(1);
        for _ in 0..1000 {
            let word = |dice: &mut Dice| {
                (0..dice.within(1..=9)).filter_map(|_| dice.pick(&['a', 'Z', '_', ':', '@', 'ä'])).collect()
            };
            let words: Vec<String> = (0..dice.within(1..=4)).map(|_| word(&mut dice)).collect();
            let name = format!("/{}", words.join("/"));
            let topic = TopicInfo::new(&name, &word(&mut dice), &word(&mut dice)).unwrap();
            let domain = dice.number() as u32;
            assert_eq!(TopicInfo::parse(&topic.key(domain)), Ok((domain, topic)));
        }
    }

    #[test]
    fn random_text_is_read_or_refused() {
        let mut dice = Dice::new(2);
        for _ in 0..20_000 {
            let key: String =
                (0..dice.within(0..=16)).filter_map(|_| dice.pick(&['0', 'a', '/', '/', '%', '*'])).collect();
            if let Ok((domain, topic)) = TopicInfo::parse(&key) {
                assert_eq!(TopicInfo::parse(&topic.key(domain)), Ok((domain, topic)), "{key}");
            }
        }
    }
}
