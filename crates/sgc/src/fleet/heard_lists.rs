//! Revocation lists of other copies of a fleet: takes them in, and tells the user that this copy is behind.

use std::path::Path;

use bytes::Bytes;
use sgc_node::LockedFleet;
use sgc_trust::CrlReport;
use sgc_wire::UnixMillis;

use crate::error::CliError;
use crate::output;

/// Takes over the revocations of the lists that nodes have in force and reports them. Returns `true` if the fleet
/// changed.
pub(super) fn take_heard(file: &mut LockedFleet, heard: &[Bytes], now: UnixMillis) -> Result<bool, CliError> {
    let mut anchors = file.fleet.anchors().clone();
    for list in heard {
        // Lists of partners' CAs are among them.
        if let Ok(Some(more)) = anchors.with_crl(list, now) {
            anchors = more;
        }
    }
    let absorbed = file.fleet.absorb(&anchors, now).map_err(|source| file.error(source))?;
    say_behind(file.path(), "a revocation list that nodes have", &absorbed);
    Ok(absorbed != CrlReport::default())
}

pub(super) fn say_behind(fleet: &Path, list: &str, absorbed: &CrlReport) {
    let fleet = fleet.display();
    let revoked = match &absorbed.revoked[..] {
        [] if !absorbed.is_behind => return,
        [] => String::new(),
        nodes => format!(" It revokes {}, which {fleet} did not know and knows now.", nodes.join(", ")),
    };
    output::diagnostic(&format!(
        "Note: another copy of {fleet} made {list}, so this copy is not the newest.{revoked} Nodes that the other copy \
         enrolled or renewed may be missing here, and one that it enrolled again cannot be revoked here. Bring the \
         other copy here and run: sgc fleet merge OTHER.fleet"
    ));
}
