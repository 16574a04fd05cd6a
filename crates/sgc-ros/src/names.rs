//! ROS 2 names and types as DDS spells them (ROS 2 design article "Topic and Service name mapping to DDS").

/// The prefix of DDS topics that carry ROS topics.
const TOPIC_PREFIX: &str = "rt";
/// The prefix and suffix of DDS topics for requests of services, and the suffix of their types.
const REQUEST: (&str, &str, &str) = ("rq", "Request", "_Request_");
/// The prefix and suffixes of replies.
const REPLY: (&str, &str, &str) = ("rr", "Reply", "_Response_");

/// The half of a service that a DDS topic carries.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum ServiceTopic {
    /// Requests, from clients to servers.
    Request,
    /// Replies, from servers to clients.
    Reply,
}

impl ServiceTopic {
    const ALL: [Self; 2] = [Self::Request, Self::Reply];

    fn affixes(self) -> (&'static str, &'static str, &'static str) {
        match self {
            Self::Request => REQUEST,
            Self::Reply => REPLY,
        }
    }

    /// Returns the DDS topic of a service: `/add` → `rq/addRequest`.
    pub fn dds_topic(self, service: &str) -> String {
        let (prefix, suffix, _) = self.affixes();
        format!("{prefix}{service}{suffix}")
    }

    /// Returns the DDS type of this half of a service type: `a/srv/B` → `a::srv::dds_::B_Request_`.
    pub fn dds_type(self, ros_type: &str) -> String {
        let (_, _, suffix) = self.affixes();
        let whole = dds_type(ros_type);
        format!("{}{suffix}", whole.strip_suffix('_').unwrap_or(&whole))
    }

    /// Parses a DDS topic and type into half, service and ROS type; `None` if it carries no service.
    pub fn parse<'a>(dds_topic: &'a str, dds_type: &str) -> Option<(Self, &'a str, String)> {
        Self::ALL.into_iter().find_map(|half| {
            let (prefix, suffix, type_suffix) = half.affixes();
            let service = dds_topic.strip_prefix(prefix)?.strip_suffix(suffix)?;
            let of_type = dds_type.strip_suffix(type_suffix)?;
            (service.len() > 1 && service.starts_with('/'))
                .then(|| (half, service, ros_type(&format!("{of_type}_"))))
        })
    }
}

/// Longest ROS topic in bytes: 256 of DDS less a terminator and 8 for the prefixes that rmw adds.
pub const TOPIC_BYTES_MAX: usize = 247;

/// Returns `true` for a fully qualified ROS 2 name (`rmw_validate_full_topic_name`).
pub fn is_topic_name(name: &str) -> bool {
    let is_word = |word: &str| {
        word.starts_with(|c: char| c.is_ascii_alphabetic() || c == '_')
            && word.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'_')
    };
    name.len() <= TOPIC_BYTES_MAX && name.strip_prefix('/').is_some_and(|words| words.split('/').all(is_word))
}

/// Longest name of an enclave, in bytes (rmw: `RMW_NAMESPACE_MAX_LENGTH`).
pub const ENCLAVE_BYTES_MAX: usize = 245;

/// Returns `true` for names that rcl accepts for an enclave: `/`, or tokens of letters, digits and `_`, each after a
/// `/`.
pub fn is_enclave(name: &str) -> bool {
    let is_token = |token: &str| {
        !token.is_empty()
            && !token.as_bytes()[0].is_ascii_digit()
            && token.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'_')
    };
    name.len() <= ENCLAVE_BYTES_MAX
        && name.strip_prefix('/').is_some_and(|tokens| tokens.is_empty() || tokens.split('/').all(is_token))
}

/// Returns the DDS topic of an absolute ROS topic: `/chatter` → `rt/chatter`.
pub fn dds_topic(ros_topic: &str) -> String {
    format!("{TOPIC_PREFIX}{ros_topic}")
}

/// Returns the ROS topic of a DDS topic, or `None` if it carries no ROS topic.
pub fn ros_topic(dds_topic: &str) -> Option<&str> {
    dds_topic.strip_prefix(TOPIC_PREFIX).filter(|t| t.starts_with('/'))
}

/// Returns the DDS type of a ROS type: `std_msgs/msg/String` → `std_msgs::msg::dds_::String_`. A type outside ROS
/// naming stays the same.
pub fn dds_type(ros_type: &str) -> String {
    match ros_type.split('/').collect::<Vec<_>>()[..] {
        [package, kind @ ("msg" | "srv" | "action"), name] if !name.is_empty() && !package.is_empty() => {
            format!("{package}::{kind}::dds_::{name}_")
        }
        _ => ros_type.to_owned(),
    }
}

/// Returns the ROS type of a DDS type, the reverse of [`dds_type`].
pub fn ros_type(dds_type: &str) -> String {
    match dds_type.split("::").collect::<Vec<_>>()[..] {
        [package, kind @ ("msg" | "srv" | "action"), "dds_", name] if !package.is_empty() => {
            match name.strip_suffix('_') {
                Some(name) if !name.is_empty() => format!("{package}/{kind}/{name}"),
                _ => dds_type.to_owned(),
            }
        }
        _ => dds_type.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn enclaves_are_named_as_rcl_names_them() {
        for name in ["/", "/sgc", "/arm_1/sgc"] {
            assert!(is_enclave(name), "{name}");
        }
        for name in ["", "sgc", "/sgc/", "//sgc", "/../private", "/1", "/a-b", "/a b"] {
            assert!(!is_enclave(name), "{name}");
        }
        assert!(!is_enclave(&format!("/{}", "a".repeat(ENCLAVE_BYTES_MAX))));
    }

    #[test]
    fn services_are_two_topics() {
        let request = ("rq/ns/addRequest", "a::srv::dds_::B_Request_");
        let reply = ("rr/ns/addReply", "a::srv::dds_::B_Response_");
        for (half, (topic, type_name)) in [(ServiceTopic::Request, request), (ServiceTopic::Reply, reply)] {
            assert_eq!(
                (half.dds_topic("/ns/add"), half.dds_type("a/srv/B")),
                (topic.into(), type_name.into())
            );
            assert_eq!(ServiceTopic::parse(topic, type_name), Some((half, "/ns/add", "a/srv/B".into())));
        }
        let goal =
            ServiceTopic::parse("rq/go/_action/send_goalRequest", "a::action::dds_::B_SendGoal_Request_");
        assert_eq!(
            goal,
            Some((ServiceTopic::Request, "/go/_action/send_goal", "a/action/B_SendGoal".into()))
        );
        for (topic, type_name) in
            [("rt/a", request.1), ("rq/a", request.1), ("rq/Request", request.1), (request.0, reply.1)]
        {
            assert_eq!(ServiceTopic::parse(topic, type_name), None);
        }
    }

    #[test]
    fn only_full_names_are_names() {
        assert!(["/a", "/a/b_1", "/_a"].into_iter().all(is_topic_name));
        let long = "/a".repeat(124);
        for name in ["", "/", "a", "/a/", "//a", "/a//b", "/1", "/a b", "/a/*", "/ä", "~/a", &long] {
            assert!(!is_topic_name(name), "{name}");
        }
    }

    #[test]
    fn names_map_there_and_back() {
        assert_eq!(dds_topic("/a/b"), "rt/a/b");
        assert_eq!(ros_topic("rt/a/b"), Some("/a/b"));
        for other in ["rq/aRequest", "ros_discovery_info", "rtx", "plain", "rt"] {
            assert_eq!(ros_topic(other), None);
        }
        let pairs = [
            ("std_msgs/msg/String", "std_msgs::msg::dds_::String_"),
            ("a/srv/B_Request", "a::srv::dds_::B_Request_"),
            ("HelloWorldData::Msg", "HelloWorldData::Msg"),
            ("a::msg::dds_::_", "a::msg::dds_::_"),
            ("/msg/", "/msg/"),
        ];
        for (ros, dds) in pairs {
            assert_eq!((dds_type(ros).as_str(), ros_type(dds).as_str()), (dds, ros));
        }
    }
}
