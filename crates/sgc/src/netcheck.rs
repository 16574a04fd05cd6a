//! `sgc netcheck`: shows the network of a running node as its routers see it.

use clap::Args;
use sgc_diagnosis::netcheck::Netcheck;
use sgc_diagnosis::status::query;

use crate::error::CliError;
use crate::node::NodeArgs;
use crate::output;

/// Show the network of a running node as its routers see it: UDP, NAT, port mapping, IPv6
///
/// A router tells each node from which address its packets come. So the command needs no server of its own, and sends
/// nothing. How a NAT maps ports shows once links over UDP to two routers with different addresses are up.
#[derive(Debug, Args)]
pub(crate) struct NetcheckArgs {
    #[command(flatten)]
    node: NodeArgs,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Runs `sgc netcheck`.
pub(crate) fn netcheck(args: &NetcheckArgs) -> Result<(), CliError> {
    let found = Netcheck::of(&query(&args.node.socket()?)?);
    if args.json {
        return output::json(&found);
    }
    for line in found.lines() {
        line.print()?;
    }
    Ok(())
}
