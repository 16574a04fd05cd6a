//! [`OpName`]: the name of an op; [`OpId`]: the id that a client gives to one.

use std::fmt;
use std::sync::Arc;

use super::text::{clip, short};

/// Longest echoed name of an op, in bytes.
const OP_BYTES_MAX: usize = 64;

/// The name of an op.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum OpName {
    ActionFeedback,
    ActionResult,
    ActionStatus,
    Advertise,
    AdvertiseAction,
    AdvertiseService,
    Auth,
    CallService,
    CancelActionGoal,
    Fragment,
    Png,
    Publish,
    SendActionGoal,
    ServiceResponse,
    SetLevel,
    Status,
    Subscribe,
    Unadvertise,
    UnadvertiseAction,
    UnadvertiseService,
    Unsubscribe,
    /// The beginning of a name that no op has.
    Unknown(String),
}

impl OpName {
    pub(super) fn new(text: &str) -> Self {
        match text {
            "action_feedback" => Self::ActionFeedback,
            "action_result" => Self::ActionResult,
            "action_status" => Self::ActionStatus,
            "advertise" => Self::Advertise,
            "advertise_action" => Self::AdvertiseAction,
            "advertise_service" => Self::AdvertiseService,
            "auth" => Self::Auth,
            "call_service" => Self::CallService,
            "cancel_action_goal" => Self::CancelActionGoal,
            "fragment" => Self::Fragment,
            "png" => Self::Png,
            "publish" => Self::Publish,
            "send_action_goal" => Self::SendActionGoal,
            "service_response" => Self::ServiceResponse,
            "set_level" => Self::SetLevel,
            "status" => Self::Status,
            "subscribe" => Self::Subscribe,
            "unadvertise" => Self::Unadvertise,
            "unadvertise_action" => Self::UnadvertiseAction,
            "unadvertise_service" => Self::UnadvertiseService,
            "unsubscribe" => Self::Unsubscribe,
            unknown => Self::Unknown(short(unknown)),
        }
    }

    fn text(&self) -> &str {
        match self {
            Self::ActionFeedback => "action_feedback",
            Self::ActionResult => "action_result",
            Self::ActionStatus => "action_status",
            Self::Advertise => "advertise",
            Self::AdvertiseAction => "advertise_action",
            Self::AdvertiseService => "advertise_service",
            Self::Auth => "auth",
            Self::CallService => "call_service",
            Self::CancelActionGoal => "cancel_action_goal",
            Self::Fragment => "fragment",
            Self::Png => "png",
            Self::Publish => "publish",
            Self::SendActionGoal => "send_action_goal",
            Self::ServiceResponse => "service_response",
            Self::SetLevel => "set_level",
            Self::Status => "status",
            Self::Subscribe => "subscribe",
            Self::Unadvertise => "unadvertise",
            Self::UnadvertiseAction => "unadvertise_action",
            Self::UnadvertiseService => "unadvertise_service",
            Self::Unsubscribe => "unsubscribe",
            Self::Unknown(text) => text,
        }
    }
}

impl fmt::Display for OpName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&clip(self.text(), OP_BYTES_MAX))
    }
}

/// The id of an op, which its answers repeat.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum OpId {
    Number(i64),
    Text(Arc<str>),
}

impl fmt::Display for OpId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Number(number) => number.fmt(f),
            Self::Text(text) => text.fmt(f),
        }
    }
}
