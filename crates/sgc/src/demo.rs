//! `sgc demo`, and the hidden command of its peers. `sgc-demo` runs both.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Args;
use sgc_demo::{DemoOptions, Role, SECONDS_MAX};

use crate::error::{CliError, EXIT_FAILURE};
use crate::log::start_log;
use crate::moved::moved;
use crate::span::parse_seconds;

/// Demonstrate sgc: join two separate ROS 2 networks on this machine by three sgc processes.
///
/// The demo needs no ROS 2 and no configuration, and leaves no files behind. A text, an image of 1 MB and a velocity
/// command cross over at 10, 10 and 50 Hz. Every message is numbered and checked. Exit code 0 means that each message
/// arrived once and unaltered.
#[derive(Debug, Args)]
pub(crate) struct DemoArgs {
    /// How long to count messages
    #[arg(long, value_name = "TIME", default_value = "10s",
          value_parser = |text: &str| parse_seconds(text, SECONDS_MAX))]
    duration: u32,
    #[arg(long, value_name = "N", hide = true)]
    seconds: Option<String>,
    /// Print only one JSON document, at the end
    #[arg(long)]
    json: bool,
    /// Directory in which to keep configurations, identities and logs; must be new or empty
    #[arg(long, value_name = "DIR")]
    keep: Option<PathBuf>,
}

/// A talker and listener of `sgc demo`.
#[derive(Debug, Args)]
pub(crate) struct PeerArgs {
    /// Role of this end
    #[arg(long)]
    role: Role,
    /// ROS domain
    #[arg(long)]
    domain: u32,
}

/// Runs `sgc demo`.
pub(crate) fn demo(args: DemoArgs) -> Result<ExitCode, CliError> {
    let DemoArgs { duration: seconds, seconds: moved_seconds, json, keep } = args;
    if let Some(seconds) = moved_seconds {
        return Err(moved(format!("--seconds {seconds}"), format!("--duration {seconds}s")));
    }
    let is_sound = sgc_demo::demo(&DemoOptions { seconds, json, keep })?;
    Ok(if is_sound { ExitCode::SUCCESS } else { ExitCode::from(EXIT_FAILURE) })
}

/// Runs a peer of the demo until standard input ends.
pub(crate) fn peer(args: PeerArgs) -> Result<(), CliError> {
    start_log(None, None)?;
    Ok(sgc_demo::peer(args.role, args.domain)?)
}
