//! Keeps the keys in this process's memory out of core files and from other processes of the same user.

use crate::output;

/// The variable that allows core dumps and debuggers, if it is set and not empty.
const ALLOW_VARIABLE: &str = "SGC_ALLOW_CORE_DUMPS";

/// Forbids core dumps and tracing from now on, unless the user allows them by argument or variable. Child processes
/// decide for themselves. A refusal of the system is only reported.
pub(crate) fn close(allow: bool) {
    if allow || std::env::var_os(ALLOW_VARIABLE).is_some_and(|value| !value.is_empty()) {
        return;
    }
    if let Err(error) = forbid() {
        output::diagnostic(&format!("sgc: the keys in memory may end up in a core file: {error}"));
    }
}

/// Makes the process not dumpable. Its files in `/proc` then belong to root, but the process can still read its own.
#[cfg(target_os = "linux")]
fn forbid() -> rustix::io::Result<()> {
    use rustix::process::{DumpableBehavior, Resource, Rlimit, getrlimit, set_dumpable_behavior, setrlimit};
    let maximum = getrlimit(Resource::Core).maximum;
    setrlimit(Resource::Core, Rlimit { current: Some(0), maximum })?;
    set_dumpable_behavior(DumpableBehavior::NotDumpable)
}

#[cfg(not(target_os = "linux"))]
fn forbid() -> rustix::io::Result<()> {
    use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
    let maximum = getrlimit(Resource::Core).maximum;
    setrlimit(Resource::Core, Rlimit { current: Some(0), maximum })
}
