//! The interfaces that a user can name, and their parts: topics and services, each of which becomes a route.

use sgc_wire::Kind;

/// A kind of interface that is shared or used as one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub enum Interface {
    /// A topic.
    #[default]
    Topic,
    /// A service.
    Service,
    /// An action: three services and two topics (ROS 2 design article "Actions").
    Action,
    /// The parameters of a node: six services (`rcl_interfaces`).
    Parameters,
}

/// One topic or service of an interface.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Part {
    /// Topic or service.
    pub kind: Kind,
    /// The suffix behind the interface's name.
    suffix: &'static str,
    of_type: PartType,
}

/// The type of a part.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum PartType {
    /// The type of the interface with this suffix.
    Own(&'static str),
    /// A fixed type.
    Always(&'static str),
}

const fn part(kind: Kind, suffix: &'static str, of_type: PartType) -> Part {
    Part { kind, suffix, of_type }
}

const TOPIC: [Part; 1] = [part(Kind::Topic, "", PartType::Own(""))];
const SERVICE: [Part; 1] = [part(Kind::Service, "", PartType::Own(""))];
const ACTION: [Part; 5] = [
    part(Kind::Service, "/_action/send_goal", PartType::Own("_SendGoal")),
    part(Kind::Service, "/_action/cancel_goal", PartType::Always("action_msgs/srv/CancelGoal")),
    part(Kind::Service, "/_action/get_result", PartType::Own("_GetResult")),
    part(Kind::Topic, "/_action/feedback", PartType::Own("_FeedbackMessage")),
    part(Kind::Topic, "/_action/status", PartType::Always("action_msgs/msg/GoalStatusArray")),
];
const PARAMETERS: [Part; 6] = [
    part(Kind::Service, "/describe_parameters", PartType::Always("rcl_interfaces/srv/DescribeParameters")),
    part(Kind::Service, "/get_parameter_types", PartType::Always("rcl_interfaces/srv/GetParameterTypes")),
    part(Kind::Service, "/get_parameters", PartType::Always("rcl_interfaces/srv/GetParameters")),
    part(Kind::Service, "/list_parameters", PartType::Always("rcl_interfaces/srv/ListParameters")),
    part(Kind::Service, "/set_parameters", PartType::Always("rcl_interfaces/srv/SetParameters")),
    part(
        Kind::Service,
        "/set_parameters_atomically",
        PartType::Always("rcl_interfaces/srv/SetParametersAtomically"),
    ),
];

impl Interface {
    /// Returns the parts of the interface.
    pub fn parts(self) -> &'static [Part] {
        match self {
            Self::Topic => &TOPIC,
            Self::Service => &SERVICE,
            Self::Action => &ACTION,
            Self::Parameters => &PARAMETERS,
        }
    }

    /// Returns the key of the interface in a configuration.
    pub fn key(self) -> &'static str {
        match self {
            Self::Topic => "topic",
            Self::Service => "service",
            Self::Action => "action",
            Self::Parameters => "parameters",
        }
    }
}

impl Part {
    /// Returns the ROS name of the part, from that of the interface.
    pub fn name(&self, interface: &str) -> String {
        format!("{interface}{}", self.suffix)
    }

    /// Returns the ROS type of the part, from that of the interface; `None` if it depends on an unknown one.
    pub fn type_name(&self, interface: Option<&str>) -> Option<String> {
        match self.of_type {
            PartType::Own(suffix) => interface.map(|of| format!("{of}{suffix}")),
            PartType::Always(name) => Some(name.to_owned()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_action_is_three_services_and_two_topics() {
        let parts = Interface::Action.parts();
        let named = |kind| parts.iter().filter(|p| p.kind == kind).map(|p| p.name("/go")).collect::<Vec<_>>();
        let services = ["/go/_action/send_goal", "/go/_action/cancel_goal", "/go/_action/get_result"];
        assert_eq!(named(Kind::Service), services);
        assert_eq!(named(Kind::Topic), ["/go/_action/feedback", "/go/_action/status"]);
        let types: Vec<_> = parts.iter().map(|p| p.type_name(Some("a/action/B")).unwrap()).collect();
        assert_eq!(
            types,
            [
                "a/action/B_SendGoal",
                "action_msgs/srv/CancelGoal",
                "a/action/B_GetResult",
                "a/action/B_FeedbackMessage",
                "action_msgs/msg/GoalStatusArray"
            ]
        );
        assert_eq!(parts.iter().filter(|p| p.type_name(None).is_none()).count(), 3);
    }

    #[test]
    fn a_topic_and_a_service_are_themselves() {
        for interface in [Interface::Topic, Interface::Service] {
            let [part] = interface.parts() else { panic!("one part") };
            assert_eq!((part.name("/a"), part.type_name(Some("x"))), ("/a".into(), Some("x".into())));
        }
        assert!(Interface::Parameters.parts().iter().all(|p| p.kind == Kind::Service));
    }
}
