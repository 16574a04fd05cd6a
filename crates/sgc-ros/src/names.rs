//! ROS 2 names and types as DDS spells them (the ROS 2 design article "Topic and Service name mapping to DDS").

/// Prefix of DDS topics that carry ROS topics.
const TOPIC_PREFIX: &str = "rt";

/// The DDS topic of an absolute ROS topic: `/chatter` → `rt/chatter`.
pub fn dds_topic(ros_topic: &str) -> String {
    format!("{TOPIC_PREFIX}{ros_topic}")
}

/// The ROS topic of a DDS topic; `None` if it carries no ROS topic.
pub fn ros_topic(dds_topic: &str) -> Option<&str> {
    dds_topic.strip_prefix(TOPIC_PREFIX).filter(|t| t.starts_with('/'))
}

/// The DDS type of a ROS type: `std_msgs/msg/String` → `std_msgs::msg::dds_::String_`. A type outside ROS
/// naming is the same on both sides.
pub fn dds_type(ros_type: &str) -> String {
    match ros_type.split('/').collect::<Vec<_>>()[..] {
        [package, kind @ ("msg" | "srv" | "action"), name] if !name.is_empty() && !package.is_empty() => {
            format!("{package}::{kind}::dds_::{name}_")
        }
        _ => ros_type.to_owned(),
    }
}

/// The ROS type of a DDS type, the reverse of [`dds_type`].
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
