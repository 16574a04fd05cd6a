//! The sending side of a topic: the path of a message from the local network to the links.

pub(crate) mod assertions;
mod emit;
mod encode;
#[cfg(test)]
mod fixtures;
pub(crate) mod intake;
pub(crate) mod manual_lease;
pub(crate) mod message_keys;
pub(crate) mod replays;
mod seal;
pub(crate) mod share;
mod silence;
pub(crate) mod source_map;
#[cfg(test)]
mod tests;
