//! [`OpError`]: the reason why a message or its op is refused, in words for the client's user.

use std::borrow::Cow;

use super::name::OpName;
use crate::error::GatewayError;

/// Longest name of a topic, type or other item, in bytes, because errors echo names.
pub(super) const NAME_BYTES_MAX: usize = 1024;
/// Most members of an op; a valid op has at most a dozen.
pub(super) const MEMBERS_MAX: usize = 64;

/// The reason why a message is refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub(crate) enum OpError {
    #[error("not JSON: {0}")]
    NotJson(String),
    #[error("not an object with a member \"op\"")]
    NoOp,
    #[error("an object with more than {MEMBERS_MAX} members")]
    TooManyMembers,
    #[error("there is no op {0:?}")]
    UnknownOp(String),
    #[error("{op}: {why}")]
    Refused { op: OpName, why: Refusal },
}

/// The reason why an op is refused, without the name of the op.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub(crate) enum Refusal {
    #[error("{0:?} is missing")]
    Missing(&'static str),
    #[error("{member:?} is no {expected}: {found}")]
    Kind { member: &'static str, expected: &'static str, found: String },
    #[error("{0:?} is longer than {NAME_BYTES_MAX} bytes")]
    TooLong(&'static str),
    #[error("{0}")]
    Gateway(Box<GatewayError>),
    /// A message of a topic is not published.
    #[error("{topic}: {error}")]
    Unpublished { topic: String, error: Box<GatewayError> },
    /// The op breaks a rule of the protocol.
    #[error("{0}")]
    Rule(Cow<'static, str>),
}

impl Refusal {
    pub(crate) fn rule(why: impl Into<Cow<'static, str>>) -> Self {
        Self::Rule(why.into())
    }

    /// Returns the refusal of a fragment within fragments.
    pub(crate) fn nested_fragment() -> Self {
        Self::rule("a message in pieces is no piece itself")
    }
}

impl From<GatewayError> for Refusal {
    fn from(error: GatewayError) -> Self {
        Self::Gateway(Box::new(error))
    }
}
