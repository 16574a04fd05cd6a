//! The sending side of a topic: the path of a message from the local network to the links.
//!
//! A sample of a local reader ([`intake`]) passes the stages of a [`share`] in this order. Each owns its state.
//!
//! 1. [`shape`] limits rate, bandwidth and age.
//! 2. [`hold`] keeps samples whose source or type is unknown, and the order of all.
//! 3. [`encode`] converts and compresses the payload.
//! 4. [`seal`] has the sample's source ([`source_map`]) number and seal the message.
//! 5. [`emit`] hands the packets to the data plane.
//!
//! The other files assert the liveliness of publishers and answer sinks that ask for messages again.

pub(crate) mod assertions;
mod emit;
mod encode;
#[cfg(test)]
pub(crate) mod fixtures;
mod hold;
pub(crate) mod intake;
pub(crate) mod manual_lease;
pub(crate) mod message_keys;
pub(crate) mod replays;
mod seal;
mod shape;
pub(crate) mod share;
mod silence;
pub(crate) mod source_map;
#[cfg(test)]
mod tests;
