//! [`Refusal`]: why a client does not get what it asks for, beyond what the gateway refuses to any.

use crate::error::GatewayError;

/// Things of one command that are said to be refused, each for itself.
const SHOWN_MAX: usize = 16;
/// Longest name of an encoding that is echoed, characters.
const ENCODING_MAX: usize = 64;

/// What was refused of one command, which may have asked for any number of things.
#[derive(Debug, Default)]
pub(super) struct Refusals {
    pub(super) shown: Vec<Refusal>,
    /// Those that are only counted.
    pub(super) more: usize,
}

impl Refusals {
    /// Notes what did not succeed.
    pub(super) fn note(&mut self, done: Result<(), Refusal>) {
        match done {
            Ok(()) => {}
            Err(refusal) if self.shown.len() < SHOWN_MAX => self.shown.push(refusal),
            Err(_) => self.more += 1,
        }
    }
}

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

impl Refusal {
    /// An encoding of another system, whatever its length.
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
