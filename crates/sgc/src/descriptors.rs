//! The limit of open files. Shells and service managers often give 1024, for the sake of programs that use `select(2)`.

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

/// Raises the soft limit of open files to the hard one.
pub(crate) fn allow_all() {
    let Rlimit { maximum, .. } = getrlimit(Resource::Nofile);
    // Raising within the hard limit is always permitted. If it failed, fewer connections would fit.
    let _ = setrlimit(Resource::Nofile, Rlimit { current: maximum, maximum });
}
