//! Commands and options under the names that they had before: refused with the new one.

use clap::Args;
use clap::error::{ContextKind, ContextValue, ErrorKind};

use crate::error::CliError;

/// Arguments of a command that has another name now.
#[derive(Debug, Args)]
pub(crate) struct MovedArgs {
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, hide = true)]
    _rest: Vec<String>,
}

/// Options that have another name now: the command, the earlier spelling, and the present one.
const MOVED_OPTIONS: [(&str, &str, &str); 13] = [
    ("sgc audit", "--peer", "--about"),
    ("sgc bench run", "--to", "--connect"),
    ("sgc fleet accept", "--node", "--node-name"),
    ("sgc fleet merge", "--router", "--push"),
    ("sgc fleet revoke", "--router", "--push"),
    ("sgc fleet set", "--post-quantum false", "--no-post-quantum"),
    ("sgc fleet set", "--post-quantum true", "--post-quantum"),
    ("sgc join", "--wait", "--timeout"),
    ("sgc name", "--node", "--ros-node"),
    ("sgc policy test", "--publish", "--right publish"),
    ("sgc token share create", "--router", "--via"),
    ("sgc topic pub", "--wait", "--wait-subscribers"),
    ("sgc topic pub", "-w", "--wait-subscribers"),
];

/// Returns the error that names the present option, if clap refused an earlier one of this command.
pub(crate) fn moved_option(error: &clap::Error, called: &str) -> Option<CliError> {
    let refused = match error.kind() {
        ErrorKind::UnknownArgument => ContextKind::InvalidArg,
        // A value that the option had: --post-quantum=true.
        ErrorKind::TooManyValues => ContextKind::InvalidValue,
        _ => return None,
    };
    let Some(ContextValue::String(refused)) = error.get(refused) else { return None };
    let is_refused = |old: &str| old.split(' ').next_back() == Some(refused);
    let (_, old, new) =
        MOVED_OPTIONS.iter().find(|(command, old, _)| *command == called && is_refused(old))?;
    Some(moved(*old, *new))
}

/// Returns the error that names the new command or option.
pub(crate) fn moved(old: impl Into<String>, new: impl Into<String>) -> CliError {
    CliError::Moved { old: old.into(), new: new.into() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn present_options_exist_and_earlier_ones_do_not() {
        for (command, old, new) in MOVED_OPTIONS {
            let mut found = &crate::command_line();
            for name in command.split(' ').skip(1) {
                found = found.find_subcommand(name).expect(command);
            }
            let takes = |option: &str| {
                let name = option.split(' ').next().unwrap_or_default();
                found.get_arguments().any(|arg| {
                    let short = arg.get_short().map(|short| format!("-{short}"));
                    let long = arg.get_long().map(|long| format!("--{long}"));
                    !arg.is_hide_set() && [short, long].iter().flatten().any(|form| form == name)
                })
            };
            assert!(takes(new), "{command} {new}");
            // An option that lost its value keeps its name.
            assert!(!takes(old) || old.contains(' '), "{command} {old}");
        }
    }
}
