//! `sgc dashboard`: the arguments of the page that `sgc-dashboard` serves.

use std::net::SocketAddr;
use std::path::PathBuf;

use clap::Args;
use sgc_dashboard::{DASHBOARD_PORT, DashboardOptions};

use crate::error::CliError;
use crate::node::NodeArgs;
use crate::{fleet, output};

/// Show the fleet in a browser, live.
///
/// The command prints the URL of a page and serves it until Ctrl-C. Your node that runs here asks the others over the mesh.
/// They answer observers: enroll your node with `--group observers`. The page is on loopback, and only who has its URL sees
/// anything.
#[derive(Debug, Args)]
pub(crate) struct DashboardArgs {
    /// Address of the page, on loopback; port 0 lets the system choose
    #[arg(long, value_name = "ADDRESS", default_value_t = SocketAddr::from(([127, 0, 0, 1], DASHBOARD_PORT)))]
    listen: SocketAddr,
    /// Fleet file with the members; without it, the fleet's authority is asked
    #[arg(long, value_name = "FILE")]
    fleet: Option<PathBuf>,
    #[command(flatten)]
    node: NodeArgs,
}

/// Runs `sgc dashboard`.
pub(crate) fn dashboard(args: &DashboardArgs) -> Result<(), CliError> {
    let members = args.fleet.as_deref().map(fleet::members_of_file).transpose()?;
    let options =
        DashboardOptions { members, listen: args.listen, ..DashboardOptions::new(args.node.socket()?) };
    match sgc_dashboard::run(options, |url| {
        // Without a reader the URL is lost, and the page serves nobody.
        let _ = output::line(url);
    })? {}
}
