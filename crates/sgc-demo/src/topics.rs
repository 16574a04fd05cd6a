//! The demo's topics: three topics between two roles, as a table.
//!
//! The module `messages` defines their content.

use std::str::FromStr;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use sgc_ros::{EndpointSpec, dds_topic, dds_type};
use sgc_wire::{History, Qos};

/// Depth of the listeners' history: more than arrives while one message is checked.
const LISTENER_DEPTH: u32 = 1000;

/// The two ends of the demo: each a ROS 2 network with an `sgc` node and a talker and listener.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// Owns the camera and the chatter.
    Robot,
    /// Owns the commands.
    Operator,
}

impl Role {
    /// Both roles.
    pub(crate) const ALL: [Self; 2] = [Self::Robot, Self::Operator];

    /// Returns the role's name, which is also that of its node.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Robot => "robot",
            Self::Operator => "operator",
        }
    }

    /// Returns the role of the other end.
    pub(crate) fn other(self) -> Self {
        match self {
            Self::Robot => Self::Operator,
            Self::Operator => Self::Robot,
        }
    }
}

impl FromStr for Role {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Self::ALL.into_iter().find(|role| role.name() == text).ok_or_else(|| format!("{text:?} is no role"))
    }
}

/// A topic of the demo.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Topic {
    /// Text, robot to operator.
    Chatter,
    /// Images of 1 MB, robot to operator.
    Image,
    /// Velocities, operator to robot.
    CmdVel,
}

impl Topic {
    /// All topics, in the order of display.
    pub(crate) const ALL: [Self; 3] = [Self::Chatter, Self::Image, Self::CmdVel];

    /// Returns the topics that a role owns and publishes.
    pub(crate) fn owned_by(owner: Role) -> impl Iterator<Item = Self> {
        Self::ALL.into_iter().filter(move |topic| topic.owner() == owner)
    }

    /// Returns the ROS name.
    pub(crate) fn ros_name(self) -> &'static str {
        match self {
            Self::Chatter => "/chatter",
            Self::Image => "/camera/image",
            Self::CmdVel => "/cmd_vel",
        }
    }

    /// Returns the ROS type.
    pub(crate) fn type_name(self) -> &'static str {
        match self {
            Self::Chatter => "std_msgs/msg/String",
            Self::Image => "sensor_msgs/msg/Image",
            Self::CmdVel => "geometry_msgs/msg/Twist",
        }
    }

    /// Returns the role that owns and publishes the topic.
    pub(crate) fn owner(self) -> Role {
        match self {
            Self::Chatter | Self::Image => Role::Robot,
            Self::CmdVel => Role::Operator,
        }
    }

    /// Returns `priority` of the share.
    pub(crate) fn priority(self) -> &'static str {
        match self {
            Self::Chatter => "default",
            Self::Image => "bulk",
            Self::CmdVel => "realtime",
        }
    }

    /// Returns the time between two messages.
    pub(crate) fn period(self) -> Duration {
        match self {
            Self::Chatter | Self::Image => Duration::from_millis(100),
            Self::CmdVel => Duration::from_millis(20),
        }
    }

    /// Returns the publisher on the local network, with ROS's default QoS: reliable, volatile, depth 10.
    pub(crate) fn writer(self) -> EndpointSpec {
        EndpointSpec {
            topic: dds_topic(self.ros_name()),
            type_name: dds_type(self.type_name()),
            keyless: true,
            asks_key_hash: false,
            type_hash: None,
            qos: Qos::default(),
        }
    }

    /// Returns the subscriber on the local network.
    pub(crate) fn reader(self) -> EndpointSpec {
        let qos = Qos { history: History::KeepLast(LISTENER_DEPTH), ..Qos::default() };
        EndpointSpec { qos, ..self.writer() }
    }
}
