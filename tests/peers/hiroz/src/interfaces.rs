//! The ROS 2 interfaces of this peer. hiroz computes the hashes of messages from their fields. Those of services and
//! actions are those of `../../zenoh/interfaces.py`.

use hiroz::action::ZAction;
use hiroz::entity::{TypeHash, TypeInfo};
use hiroz::msg::{SerdeCdrSerdes, ZMessage, ZService};
use hiroz::{MessageTypeInfo, ServiceTypeInfo};
use serde::{Deserialize, Serialize};

/// `std_msgs/msg/String` with the content that all peers send.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, MessageTypeInfo)]
#[ros_msg(type_name = "std_msgs/msg/String")]
pub struct Text {
    pub data: String,
}

#[derive(Debug, Clone, Default, Serialize, Deserialize, MessageTypeInfo)]
#[ros_msg(type_name = "example_interfaces/srv/AddTwoInts_Request")]
pub struct AddRequest {
    pub a: i64,
    pub b: i64,
}

#[derive(Debug, Clone, Default, Serialize, Deserialize, MessageTypeInfo)]
#[ros_msg(type_name = "example_interfaces/srv/AddTwoInts_Response")]
pub struct AddReply {
    pub sum: i64,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Goal {
    pub order: i32,
}

/// The result and the feedback of the action.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Numbers {
    pub sequence: Vec<i32>,
}

impl ZMessage for Text {
    type Serdes = SerdeCdrSerdes<Self>;
}

impl ZMessage for AddRequest {
    type Serdes = SerdeCdrSerdes<Self>;
}

impl ZMessage for AddReply {
    type Serdes = SerdeCdrSerdes<Self>;
}

impl ZMessage for Goal {
    type Serdes = SerdeCdrSerdes<Self>;
}

impl ZMessage for Numbers {
    type Serdes = SerdeCdrSerdes<Self>;
}

pub struct AddTwoInts;

impl ZService for AddTwoInts {
    type Request = AddRequest;
    type Response = AddReply;
}

impl ServiceTypeInfo for AddTwoInts {
    fn service_type_info() -> TypeInfo {
        info(
            "example_interfaces::srv::dds_::AddTwoInts_",
            "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a",
        )
    }
}

/// `example_interfaces/action/Fibonacci`.
pub struct Fibonacci;

impl ZAction for Fibonacci {
    type Goal = Goal;
    type Result = Numbers;
    type Feedback = Numbers;

    fn name() -> &'static str {
        "example_interfaces/action/Fibonacci"
    }

    fn send_goal_type_info() -> TypeInfo {
        info(
            "example_interfaces::action::dds_::Fibonacci_SendGoal_",
            "RIHS01_d1a57fb2a4afe8c21e34fb10db206f16ce6729b28531141472df92277c55b557",
        )
    }

    fn get_result_type_info() -> TypeInfo {
        info(
            "example_interfaces::action::dds_::Fibonacci_GetResult_",
            "RIHS01_1b0de0d5d29dc955d92f546706568428632771db13ec84c15ec1c1a59f424a57",
        )
    }

    fn cancel_goal_type_info() -> TypeInfo {
        info(
            "action_msgs::srv::dds_::CancelGoal_",
            "RIHS01_573d8b0a534451d7bc2ac8c5ffde8ac14b8593b7001175d0cd6516dcbeb8689a",
        )
    }

    fn feedback_type_info() -> TypeInfo {
        info(
            "example_interfaces::action::dds_::Fibonacci_FeedbackMessage_",
            "RIHS01_c1de71afd52e49a89c53d8262366884185bc0a02f78ce051c4e46b0a7fe59bb2",
        )
    }

    fn status_type_info() -> TypeInfo {
        info(
            "action_msgs::msg::dds_::GoalStatusArray_",
            "RIHS01_6c1684b00f177d37438febe6e709fc4e2b0d4248dca4854946f9ed8b30cda83e",
        )
    }
}

fn info(name: &str, hash: &str) -> TypeInfo {
    TypeInfo::new(name, TypeHash::from_rihs_string(hash).expect("a hash"))
}
