//! What the demo carries: three topics between two roles, as a table.
//!
//! What the messages contain is in `messages`.

use std::time::Duration;

use serde::{Deserialize, Serialize};
use sgc_ros::{EndpointSpec, dds_topic, dds_type};
use sgc_wire::{History, Qos};

/// Depth of the listeners' history: more than arrives while one message is checked.
const LISTENER_DEPTH: u32 = 1000;

/// The two ends of the demo: each a ROS 2 network with an `sgc` node and a talker and listener.
#[derive(
    Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, clap::ValueEnum,
)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Role {
    /// Owns the camera and the chatter.
    Robot,
    /// Owns the commands.
    Operator,
}

impl Role {
    /// Both.
    pub(crate) const ALL: [Self; 2] = [Self::Robot, Self::Operator];

    /// Also the name of its node.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Robot => "robot",
            Self::Operator => "operator",
        }
    }

    /// The far end.
    pub(crate) fn other(self) -> Self {
        match self {
            Self::Robot => Self::Operator,
            Self::Operator => Self::Robot,
        }
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
    /// All, in the order in which they are shown.
    pub(crate) const ALL: [Self; 3] = [Self::Chatter, Self::Image, Self::CmdVel];

    /// Those that a role owns and publishes.
    pub(crate) fn of(owner: Role) -> impl Iterator<Item = Self> {
        Self::ALL.into_iter().filter(move |topic| topic.owner() == owner)
    }

    /// Its ROS name.
    pub(crate) fn ros_name(self) -> &'static str {
        match self {
            Self::Chatter => "/chatter",
            Self::Image => "/camera/image",
            Self::CmdVel => "/cmd_vel",
        }
    }

    /// Its ROS type.
    pub(crate) fn type_name(self) -> &'static str {
        match self {
            Self::Chatter => "std_msgs/msg/String",
            Self::Image => "sensor_msgs/msg/Image",
            Self::CmdVel => "geometry_msgs/msg/Twist",
        }
    }

    /// Who owns and publishes it.
    pub(crate) fn owner(self) -> Role {
        match self {
            Self::Chatter | Self::Image => Role::Robot,
            Self::CmdVel => Role::Operator,
        }
    }

    /// `priority` of its share.
    pub(crate) fn priority(self) -> &'static str {
        match self {
            Self::Chatter => "default",
            Self::Image => "bulk",
            Self::CmdVel => "realtime",
        }
    }

    /// Time between two messages.
    pub(crate) fn period(self) -> Duration {
        match self {
            Self::Chatter | Self::Image => Duration::from_millis(100),
            Self::CmdVel => Duration::from_millis(20),
        }
    }

    /// Its publisher on the local network, with ROS's default QoS: reliable, volatile, the last 10.
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

    /// Its subscriber on the local network.
    pub(crate) fn reader(self) -> EndpointSpec {
        let qos = Qos { history: History::KeepLast(LISTENER_DEPTH), ..Qos::default() };
        EndpointSpec { qos, ..self.writer() }
    }
}
