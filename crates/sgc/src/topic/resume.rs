//! `sgc topic resume`: lets commands pass a dead-man switch that has stopped the robot.

use std::process::ExitCode;

use clap::Args;
use sgc_diagnosis::ask::{self, ANSWER_MAX, answer};
use sgc_node::admin::AdminRequest;

use crate::error::CliError;
use crate::node::NodeArgs;
use crate::output;

/// Let commands pass a dead-man switch again
///
/// The switch has stopped the robot. The next command that comes in time passes, whether its publisher let go or not. Look
/// at the robot first.
#[derive(Debug, Args)]
pub(crate) struct ResumeArgs {
    /// Topic of commands, by its name on this node's local network
    topic: String,
    #[command(flatten)]
    node: NodeArgs,
}

pub(super) fn resume(args: &ResumeArgs) -> Result<ExitCode, CliError> {
    let socket = args.node.socket()?;
    let text = ask::ask(&socket, &AdminRequest::Resume(args.topic.clone()), ANSWER_MAX)?;
    let (): () = answer(&socket, &text)?;
    output::line(format!("{}: the next command in time passes", args.topic))?;
    Ok(ExitCode::SUCCESS)
}
