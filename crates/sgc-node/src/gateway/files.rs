//! The number of clients for which the process may have connections.

use rustix::process::{Resource, getrlimit};
use tracing::warn;

/// Files that are left for links, for the local network and for questions of users, or half of all if there are fewer.
const OTHERS: usize = 256;

/// Returns the number of clients that are admitted, at most `wanted`: each has a file. Beyond that, whoever asks the
/// node at its socket would get no answer.
pub(super) fn clients_within_files(wanted: usize) -> usize {
    let files = getrlimit(Resource::Nofile).current.and_then(|files| usize::try_from(files).ok());
    let clients = within(files, wanted);
    if let Some(files) = files.filter(|_| clients < wanted) {
        warn!(
            "the gateway takes {clients} clients at once instead of {wanted}: this process may open {files} files; \
             raise its limit (`LimitNOFILE=` of its service, `ulimit -n`)"
        );
    }
    clients
}

fn within(files: Option<usize>, wanted: usize) -> usize {
    files.map_or(wanted, |files| wanted.min(files - (files / 2).min(OTHERS))).max(1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clients_leave_files_for_the_rest_of_the_node() {
        assert_eq!(within(None, 65_536), 65_536);
        assert_eq!(within(Some(1024), 512), 512);
        assert_eq!(within(Some(1024), 1024), 768);
        assert_eq!(within(Some(64), 512), 32);
        assert_eq!(within(Some(0), 512), 1);
    }
}
