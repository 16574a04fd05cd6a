//! [`Refusal`]: the reasons specific to this protocol for which a request is refused.

use crate::error::GatewayError;

/// Most refusals of one command that are listed individually.
const SHOWN_MAX: usize = 16;
/// Longest echoed name of an encoding, in characters.
const ENCODING_MAX: usize = 64;

/// The refusals of one command, which may hold any number of requests.
#[derive(Debug, Default)]
pub(super) struct Refusals {
    pub(super) shown: Vec<Refusal>,
    /// The number of refusals that are not listed.
    pub(super) more: usize,
}

impl Refusals {
    /// Records a result if it is a refusal.
    pub(super) fn note(&mut self, done: Result<(), Refusal>) {
        match done {
            Ok(()) => {}
            Err(refusal) if self.shown.len() < SHOWN_MAX => self.shown.push(refusal),
            Err(_) => self.more += 1,
        }
    }
}

/// The reason why a request is refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub(super) enum Refusal {
    /// No channel has this number.
    #[error("there is no channel {0}")]
    Channel(u32),
    /// No service has this number.
    #[error("there is no service {0}")]
    Service(u32),
    /// The client has not advertised a channel with this number.
    #[error("channel {0} is not advertised by this client")]
    NotAdvertised(u32),
    /// The client has already advertised a channel with this number.
    #[error("channel {0} is advertised by this client already")]
    AdvertisedTwice(u32),
    /// The client has already a subscription with this number.
    #[error("subscription {0} is in use already")]
    SubscriptionTwice(u32),
    /// The encoding is not supported.
    #[error("{0:?} is no encoding of this server: it takes \"cdr\" and \"json\"")]
    Encoding(String),
    /// The payload is not a serialised message.
    #[error("{0} bytes are no serialised message: it begins with a header of four")]
    NotSerialised(usize),
    /// The answer of a node contains a string that is not UTF-8.
    #[error("a text among its parameters is not UTF-8")]
    Text,
    /// The gateway refuses the request.
    #[error(transparent)]
    Gateway(#[from] GatewayError),
}

impl Refusal {
    /// Creates a refusal for an encoding and cuts its name.
    pub(super) fn encoding(name: &str) -> Self {
        Self::Encoding(name.chars().take(ENCODING_MAX).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn refusals_beyond_those_shown_are_counted() {
        let mut refused = Refusals::default();
        for id in 0..100 {
            refused.note(Err(Refusal::Channel(id)));
            refused.note(Ok(()));
        }
        assert_eq!((refused.shown.len(), refused.more), (SHOWN_MAX, 100 - SHOWN_MAX));
        assert_eq!(Refusal::encoding(&"x".repeat(1000)), Refusal::Encoding("x".repeat(ENCODING_MAX)));
    }
}
