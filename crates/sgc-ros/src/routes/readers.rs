//! Readers of local topics.

use sgc_wire::Name;

use super::command::Command;
use crate::network::{EndpointSpec, Guid};

/// Returns `true` if the reader of a topic asks writers for key hashes. It must not if a writer would then not match.
pub(super) fn asks_key_hash<'a>(keyless: bool, mut writers: impl Iterator<Item = &'a Guid>) -> bool {
    !keyless && !writers.any(Guid::is_of_cyclone)
}

/// Replaces the reader of a name by a wanted one, unless it serves as that. Returns the commands for it.
pub(super) fn replace_reader(
    name: Name,
    open: &mut Option<EndpointSpec>,
    wanted: Option<EndpointSpec>,
) -> Vec<Command> {
    if same_reader(open.as_ref(), wanted.as_ref()) {
        return Vec::new();
    }
    let closes = open.is_some().then_some(Command::CloseReader { name });
    let opens = wanted.clone().map(|spec| Command::OpenReader { name, spec });
    *open = wanted;
    closes.into_iter().chain(opens).collect()
}

/// Returns `true` if two readers differ at most in depth, for which a reader is not recreated.
fn same_reader(a: Option<&EndpointSpec>, b: Option<&EndpointSpec>) -> bool {
    let key = |s: &EndpointSpec| {
        (
            (s.qos.reliability, s.qos.durability, s.qos.partitions.clone()),
            (s.keyless, s.asks_key_hash, s.type_name.clone()),
        )
    };
    a.map(key) == b.map(key)
}
