//! [`Refusal`]: why a client does not get what it asks for, beyond what the gateway refuses to any.

use crate::error::GatewayError;

/// Why a client does not get what it asks for.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub(super) enum Refusal {
    /// A number that no channel has, or none any more.
    #[error("there is no channel {0}")]
    Channel(u32),
    /// A number that no service has, or none any more.
    #[error("there is no service {0}")]
    Service(u32),
    /// A number of a channel that the client has not advertised.
    #[error("channel {0} is not advertised by this client")]
    NotAdvertised(u32),
    /// A number of a channel that it has.
    #[error("channel {0} is advertised by this client already")]
    AdvertisedTwice(u32),
    /// A number of a subscription that it has.
    #[error("subscription {0} is in use already")]
    SubscriptionTwice(u32),
    /// An encoding of another system.
    #[error("{0:?} is no encoding of this server: it takes \"cdr\" and \"json\"")]
    Encoding(String),
    /// No serialised message.
    #[error("{0} bytes are no serialised message: it begins with a header of four")]
    NotSerialised(usize),
    /// An answer of a node that is no JSON.
    #[error("a text among its parameters is not UTF-8")]
    Text,
    /// What the gateway refuses.
    #[error(transparent)]
    Gateway(#[from] GatewayError),
}
