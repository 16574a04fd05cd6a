//! `sgc dashboard`: the arguments of the page that `sgc-dashboard` serves.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use clap::Args;
use serde::Serialize;
use sgc_dashboard::{DASHBOARD_PORT, DashboardOptions, PageUrls};

use crate::error::CliError;
use crate::node::NodeArgs;
use crate::{fleet, output};

/// Show the fleet in a browser, live.
///
/// The command prints the URL of a page and serves it until Ctrl-C. Your node that runs here asks the others over the
/// mesh. They answer observers: enroll your node with `--group observers`. The page is on loopback and needs the token
/// in its URL. It only shows, unless you start it with --operate.
#[derive(Debug, Args)]
pub(crate) struct DashboardArgs {
    /// Address of the page, on loopback; port 0 lets the system choose
    #[arg(long, value_name = "ADDRESS", default_value_t = SocketAddr::from(([127, 0, 0, 1], DASHBOARD_PORT)))]
    listen: SocketAddr,
    /// Fleet file with the members; without it, the fleet's authority is asked
    #[arg(long, value_name = "FILE")]
    fleet: Option<PathBuf>,
    /// Let the page revoke nodes: whoever has the first of two printed URLs may do it, and with the second only look. The
    /// fleet's authority carries it out if its configuration lists your node in `operators`
    #[arg(long, conflicts_with = "fleet")]
    operate: bool,
    #[command(flatten)]
    node: NodeArgs,
    /// Print the URLs as JSON
    #[arg(long)]
    json: bool,
}

/// The URLs of the page as `--json` shows them.
#[derive(Serialize)]
struct UrlsJson {
    /// The URL with which the page only looks.
    look: String,
    /// The URL with which it also revokes nodes; `None` without `--operate`.
    operate: Option<String>,
}

/// Runs `sgc dashboard`.
pub(crate) fn dashboard(args: &DashboardArgs) -> Result<(), CliError> {
    let mut options = DashboardOptions::new(args.node.socket()?);
    options.listen = args.listen;
    if let Some(file) = args.fleet.clone() {
        fleet::members_of_file(&file)?;
        let find = move |_: &Path| fleet::members_of_file(&file).map_err(|error| error.to_string());
        options.find_members = Box::new(find);
    }
    if args.operate {
        let revoke = |socket: &Path, node: &str| {
            fleet::revoke_by_authority(socket, node).map_err(|error| error.line())
        };
        options.revoke = Some(Box::new(revoke));
    }
    let is_json = args.json;
    match sgc_dashboard::run(options, move |PageUrls { look, operate }| {
        let lines = match operate {
            None => look.clone(),
            Some(operate) => format!("{operate}\nto look only: {look}"),
        };
        let json = UrlsJson { look: look.clone(), operate: operate.clone() };
        // Without a reader the URL is lost, and the page serves nobody.
        let _ = output::result(is_json, &json, lines);
    })? {}
}
