//! [`ClientMessage`]: a client's message, parsed once into an [`Op`] with typed members.
//!
//! Contents whose form only a ROS type decides (`msg`, `args`, `values`) stay JSON text. Nothing is executed here, and
//! no state is known: `connection` does that.

mod error;
mod members;
mod name;
mod qos;
#[cfg(test)]
mod tests;
mod text;

use std::borrow::Cow;
use std::num::NonZeroUsize;
use std::time::Duration;

use sgc_wire::Qos;

use super::envelope::Compression;
use super::outbox::Level;
use super::topics::SubscriptionRequest;
use crate::action::GoalStatus;
pub(super) use error::{OpError, Refusal};
use members::Members;
pub(super) use name::{OpId, OpName};
use qos::QosMember;
pub(super) use text::{short, told};

/// The place of a message, which decides what ops it may have.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum MessagePlace {
    /// It comes from a client that is not admitted, and may only be `auth`.
    BeforeAdmission,
    /// It comes by itself.
    Whole,
    /// It was assembled from fragments, and may be no fragment.
    Assembled,
}

impl MessagePlace {
    fn check(self, name: &OpName) -> Result<(), Refusal> {
        match (self, name) {
            (Self::BeforeAdmission, OpName::Auth) => Ok(()),
            (Self::BeforeAdmission, _) => {
                Err(Refusal::rule(r#"say who you are first: {"op":"auth","token":"…"}"#))
            }
            (Self::Assembled, OpName::Fragment) => Err(Refusal::nested_fragment()),
            (Self::Whole | Self::Assembled, _) => Ok(()),
        }
    }
}

/// A client's message whose op and id could be read.
#[derive(Debug)]
pub(super) struct ClientMessage<'a> {
    pub(super) name: OpName,
    pub(super) id: Option<OpId>,
    pub(super) op: Result<Op<'a>, InvalidOp<'a>>,
}

/// An op that cannot be executed.
#[derive(Debug, PartialEq)]
pub(super) struct InvalidOp<'a> {
    pub(super) error: OpError,
    pub(super) reply: Option<AwaitedReply<'a>>,
}

/// A reply for which a client waits, with or without success.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum AwaitedReply<'a> {
    /// A `service_response` of the service.
    Service(Cow<'a, str>),
    /// An `action_result` of the action.
    Action(Cow<'a, str>),
}

/// An op with its members.
#[derive(Debug, PartialEq)]
pub(super) enum Op<'a> {
    ActionFeedback(ActionFeedback<'a>),
    ActionResult(ActionResult<'a>),
    ActionStatus { action: Cow<'a, str> },
    Advertise(AdvertiseTopic<'a>),
    AdvertiseAction(ServingAdvertisement<'a>),
    AdvertiseService(ServingAdvertisement<'a>),
    Auth { token: Result<Cow<'a, str>, Refusal> },
    CallService(CallService<'a>),
    CancelActionGoal,
    Fragment(Fragment),
    Publish(Publish<'a>),
    SendActionGoal(SendActionGoal<'a>),
    ServiceResponse(ServiceResponse<'a>),
    SetLevel(Level),
    Status,
    Subscribe(SubscribeTopic<'a>),
    Unadvertise { topic: Cow<'a, str> },
    UnadvertiseAction { action: Cow<'a, str> },
    UnadvertiseService { service: Cow<'a, str> },
    Unsubscribe { topic: Cow<'a, str> },
}

/// Feedback on a goal that the client serves.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct ActionFeedback<'a> {
    pub(super) action: Cow<'a, str>,
    /// An object.
    pub(super) values: &'a str,
}

/// The end of a goal that the client serves.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct ActionResult<'a> {
    pub(super) action: Cow<'a, str>,
    /// An end of a goal.
    pub(super) status: GoalStatus,
    /// An object.
    pub(super) values: &'a str,
}

#[derive(Debug, PartialEq)]
pub(super) struct AdvertiseTopic<'a> {
    pub(super) topic: Cow<'a, str>,
    pub(super) type_name: Option<Cow<'a, str>>,
    pub(super) qos: Qos,
}

/// An advertisement of a service or action.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct ServingAdvertisement<'a> {
    /// The service or action.
    pub(super) name: Cow<'a, str>,
    pub(super) type_name: Cow<'a, str>,
}

#[derive(Debug, PartialEq, Eq)]
pub(super) struct CallService<'a> {
    pub(super) service: Cow<'a, str>,
    pub(super) type_name: Option<Cow<'a, str>>,
    pub(super) args: Option<&'a str>,
    pub(super) timeout: Option<Duration>,
    pub(super) fragment_size: Option<NonZeroUsize>,
    /// Not raw.
    pub(super) compression: Compression,
}

/// A fragment of a message.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Fragment {
    /// The id of the message.
    pub(super) id: OpId,
    pub(super) number: usize,
    pub(super) total: usize,
    pub(super) data: String,
}

#[derive(Debug, PartialEq)]
pub(super) struct Publish<'a> {
    pub(super) topic: Cow<'a, str>,
    /// An object.
    pub(super) msg: &'a str,
    /// The advertisement of a topic that the client has not advertised. Its errors do not count for others.
    pub(super) advertisement: Result<ImplicitAdvertisement<'a>, Refusal>,
}

/// The advertisement of a topic by its first message.
#[derive(Debug, PartialEq)]
pub(super) struct ImplicitAdvertisement<'a> {
    pub(super) type_name: Option<Cow<'a, str>>,
    pub(super) qos: Qos,
}

#[derive(Debug, PartialEq, Eq)]
pub(super) struct SendActionGoal<'a> {
    pub(super) action: Cow<'a, str>,
    pub(super) type_name: Option<Cow<'a, str>>,
    pub(super) args: Option<&'a str>,
    pub(super) has_feedback: bool,
    pub(super) fragment_size: Option<NonZeroUsize>,
    /// Not raw.
    pub(super) compression: Compression,
}

/// The answer to a request that the client serves.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct ServiceResponse<'a> {
    pub(super) service: Cow<'a, str>,
    pub(super) outcome: ServiceOutcome<'a>,
}

#[derive(Debug, PartialEq, Eq)]
pub(super) enum ServiceOutcome<'a> {
    /// The reply as an object or a list of its members.
    Reply(Option<&'a str>),
    /// The request failed. The reason is JSON.
    Failure(Option<&'a str>),
}

#[derive(Debug, PartialEq)]
pub(super) struct SubscribeTopic<'a> {
    pub(super) topic: Cow<'a, str>,
    pub(super) type_name: Option<Cow<'a, str>>,
    /// The requested QoS, or `None` to adapt to the publishers.
    pub(super) qos: Option<Qos>,
    pub(super) request: SubscriptionRequest,
}

impl<'a> ClientMessage<'a> {
    /// Parses a message. The values of `msg`, `args` and `values` are valid JSON, and are read no further than whether
    /// they are objects or lists.
    ///
    /// # Errors
    /// The message has no op or no valid id, so that only a status can answer it.
    pub(super) fn parse(text: &'a str, place: MessagePlace) -> Result<Self, OpError> {
        let members = Members::parse(text)?;
        let name = OpName::new(&members.op()?);
        let refused = |why| OpError::Refused { op: name.clone(), why };
        let id = members.id().map_err(refused)?;
        let op = match place.check(&name) {
            Err(why) => Err(InvalidOp { error: refused(why), reply: None }),
            Ok(()) => Op::read(&name, id.as_ref(), &members)
                .map_err(|error| InvalidOp { error, reply: AwaitedReply::read(&name, &members) }),
        };
        Ok(Self { name, id, op })
    }
}

impl<'a> AwaitedReply<'a> {
    /// Returns the reply for which the client waits even if the op is invalid.
    fn read(name: &OpName, members: &Members<'a>) -> Option<Self> {
        let of = |member| members.name(member).ok().flatten().unwrap_or_default();
        match name {
            OpName::CallService => Some(Self::Service(of("service"))),
            OpName::SendActionGoal => Some(Self::Action(of("action"))),
            _ => None,
        }
    }
}

impl<'a> Op<'a> {
    fn read(name: &OpName, id: Option<&OpId>, members: &Members<'a>) -> Result<Self, OpError> {
        let read = match name {
            OpName::ActionFeedback => ActionFeedback::read(members).map(Self::ActionFeedback),
            OpName::ActionResult => ActionResult::read(members).map(Self::ActionResult),
            OpName::ActionStatus => members.needed_name("action").map(|action| Self::ActionStatus { action }),
            OpName::Advertise => AdvertiseTopic::read(members).map(Self::Advertise),
            OpName::AdvertiseAction => {
                ServingAdvertisement::read(members, "action").map(Self::AdvertiseAction)
            }
            OpName::AdvertiseService => {
                ServingAdvertisement::read(members, "service").map(Self::AdvertiseService)
            }
            // Errors of the token count only where tokens are taken.
            OpName::Auth => Ok(Self::Auth { token: token(members) }),
            OpName::CallService => CallService::read(members).map(Self::CallService),
            OpName::CancelActionGoal => Ok(Self::CancelActionGoal),
            OpName::Fragment => Fragment::read(id, members).map(Self::Fragment),
            OpName::Png => Err(Refusal::rule("png is not taken: send JSON")),
            OpName::Publish => Publish::read(members).map(Self::Publish),
            OpName::SendActionGoal => SendActionGoal::read(members).map(Self::SendActionGoal),
            OpName::ServiceResponse => ServiceResponse::read(members).map(Self::ServiceResponse),
            OpName::SetLevel => level(members).map(Self::SetLevel),
            OpName::Status => Ok(Self::Status),
            OpName::Subscribe => SubscribeTopic::read(members).map(Self::Subscribe),
            OpName::Unadvertise => members.needed_name("topic").map(|topic| Self::Unadvertise { topic }),
            OpName::UnadvertiseAction => {
                members.needed_name("action").map(|action| Self::UnadvertiseAction { action })
            }
            OpName::UnadvertiseService => {
                members.needed_name("service").map(|service| Self::UnadvertiseService { service })
            }
            OpName::Unsubscribe => members.needed_name("topic").map(|topic| Self::Unsubscribe { topic }),
            OpName::Unknown(text) => return Err(OpError::UnknownOp(text.clone())),
        };
        read.map_err(|why| OpError::Refused { op: name.clone(), why })
    }
}

impl<'a> ActionFeedback<'a> {
    fn read(members: &Members<'a>) -> Result<Self, Refusal> {
        let action = members.needed_name("action")?;
        Ok(Self { action, values: members.object("values")?.unwrap_or("{}") })
    }
}

impl<'a> ActionResult<'a> {
    fn read(members: &Members<'a>) -> Result<Self, Refusal> {
        let action = members.needed_name("action")?;
        let is_done = members.bool("result")?.unwrap_or(true);
        let status = match (is_done, members.integer("status")?) {
            (true, None) => GoalStatus::Succeeded,
            (_, Some(status)) if GoalStatus::from_number(status).is_end() => GoalStatus::from_number(status),
            (false, _) => GoalStatus::Aborted,
            (true, Some(status)) => {
                return Err(Refusal::rule(format!("status {status} is no end of a goal")));
            }
        };
        // A reason as text is no result.
        let values = members.raw("values").filter(|raw| raw.starts_with('{')).unwrap_or("{}");
        Ok(Self { action, status, values })
    }
}

impl<'a> AdvertiseTopic<'a> {
    fn read(members: &Members<'a>) -> Result<Self, Refusal> {
        let topic = members.needed_name("topic")?;
        let type_name = members.name("type")?;
        let member = qos(members)?;
        let is_latched = members.bool("latch")?.unwrap_or(false);
        let qos = member.offer(is_latched, members.count("queue_size")?);
        Ok(Self { topic, type_name, qos })
    }
}

impl<'a> ServingAdvertisement<'a> {
    fn read(members: &Members<'a>, kind: &'static str) -> Result<Self, Refusal> {
        Ok(Self { name: members.needed_name(kind)?, type_name: members.needed_name("type")? })
    }
}

impl<'a> CallService<'a> {
    fn read(members: &Members<'a>) -> Result<Self, Refusal> {
        Ok(Self {
            service: members.needed_name("service")?,
            type_name: members.name("type")?,
            args: members.raw("args"),
            timeout: members.seconds("timeout")?,
            fragment_size: fragment_size(members)?,
            compression: reply_compression(members)?,
        })
    }
}

impl Fragment {
    fn read(id: Option<&OpId>, members: &Members<'_>) -> Result<Self, Refusal> {
        Ok(Self {
            id: id.cloned().ok_or(Refusal::Missing("id"))?,
            number: members.needed_count("num")?,
            total: members.needed_count("total")?,
            data: members.needed_text("data")?.into_owned(),
        })
    }
}

impl<'a> Publish<'a> {
    fn read(members: &Members<'a>) -> Result<Self, Refusal> {
        Ok(Self {
            topic: members.needed_name("topic")?,
            msg: members.needed_object("msg")?,
            advertisement: ImplicitAdvertisement::read(members),
        })
    }
}

impl<'a> ImplicitAdvertisement<'a> {
    fn read(members: &Members<'a>) -> Result<Self, Refusal> {
        let qos = QosMember::default().offer(members.bool("latch")?.unwrap_or(false), None);
        Ok(Self { type_name: members.name("type")?, qos })
    }
}

impl<'a> SendActionGoal<'a> {
    fn read(members: &Members<'a>) -> Result<Self, Refusal> {
        let action = members.needed_name("action")?;
        let type_name = match members.name("action_type")? {
            Some(name) => Some(name),
            None => members.name("type")?,
        };
        Ok(Self {
            action,
            type_name,
            args: members.raw("args"),
            has_feedback: members.bool("feedback")?.unwrap_or(false),
            fragment_size: fragment_size(members)?,
            compression: reply_compression(members)?,
        })
    }
}

impl<'a> ServiceResponse<'a> {
    fn read(members: &Members<'a>) -> Result<Self, Refusal> {
        let service = members.needed_name("service")?;
        let is_done = members.bool("result")?.unwrap_or(true);
        let values = members.raw("values").filter(|raw| raw.starts_with(['{', '[']));
        let outcome = match is_done || values.is_some() {
            true => ServiceOutcome::Reply(values),
            false => ServiceOutcome::Failure(members.raw("values")),
        };
        Ok(Self { service, outcome })
    }
}

impl<'a> SubscribeTopic<'a> {
    fn read(members: &Members<'a>) -> Result<Self, Refusal> {
        let topic = members.needed_name("topic")?;
        let type_name = members.name("type")?;
        let member = qos(members)?;
        let throttle_ms = members.count("throttle_rate")?.unwrap_or(0);
        let queue_length = members.count("queue_length")?.unwrap_or(0);
        let request = SubscriptionRequest {
            throttle: Duration::from_millis(throttle_ms as u64),
            queue_length: member.depth.map_or(queue_length, |depth| depth as usize),
            fragment_size: fragment_size(members)?,
            compression: compression(members)?,
        };
        Ok(Self { topic, type_name, qos: member.request(), request })
    }
}

/// Reads the token. Some clients know only the fields of ROS 1's `rosauth`, so it may stand in its code field.
fn token<'a>(members: &Members<'a>) -> Result<Cow<'a, str>, Refusal> {
    match members.text("token")? {
        Some(token) => Ok(token),
        None => members.text("mac")?.ok_or(Refusal::Missing("token")),
    }
}

fn level(members: &Members<'_>) -> Result<Level, Refusal> {
    let level = Level::from_name(&members.needed_name("level")?);
    level.ok_or(Refusal::rule("\"level\" is none, error, warning or info"))
}

fn qos(members: &Members<'_>) -> Result<QosMember, Refusal> {
    members.object("qos")?.map_or_else(|| Ok(QosMember::default()), QosMember::read)
}

fn compression(members: &Members<'_>) -> Result<Compression, Refusal> {
    Compression::from_name(&members.name("compression")?.unwrap_or_default()).map_err(Refusal::rule)
}

/// Reads the compression of replies, which have no raw form.
fn reply_compression(members: &Members<'_>) -> Result<Compression, Refusal> {
    Ok(match compression(members)? {
        Compression::None => Compression::None,
        Compression::Cbor | Compression::CborRaw => Compression::Cbor,
    })
}

/// Reads the size of fragments in bytes.
fn fragment_size(members: &Members<'_>) -> Result<Option<NonZeroUsize>, Refusal> {
    let Some(size) = members.count("fragment_size")? else { return Ok(None) };
    NonZeroUsize::new(size).map(Some).ok_or(Refusal::rule("\"fragment_size\" is 1 or more"))
}
