//! `sgc status`: asks a running node for its status and prints it.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use clap::Args;
use sgc_diagnosis::ask::{ANSWER_MAX, ask};
use sgc_diagnosis::status::parse;
use sgc_node::admin::AdminRequest;
use sgc_node::usual_sockets;

use crate::error::CliError;
use crate::node::NodeArgs;
use crate::output;

/// Show the status of a running node: links, shares and uses, names, drops.
#[derive(Debug, Args)]
pub(crate) struct StatusArgs {
    #[command(flatten)]
    node: NodeArgs,
    /// Print the node's JSON document unchanged
    #[arg(long)]
    json: bool,
}

/// Runs `sgc status`.
pub(crate) fn status(args: &StatusArgs) -> Result<(), CliError> {
    let socket = args.node.socket()?;
    let text = ask(&socket, &AdminRequest::Status, ANSWER_MAX)?;
    let status = parse(&socket, &text)?;
    if args.json {
        return output::line(text.trim_end());
    }
    for line in status.lines() {
        line.print()?;
    }
    Ok(())
}

/// Pushes a revocation list to every node that this user runs here. Returns the names of those that took it, and their
/// lists. Nodes of other fleets do not take it.
pub(crate) fn push_crl_local(list: &[u8]) -> (Vec<String>, Vec<bytes::Bytes>) {
    let request = AdminRequest::Crl(list.to_vec());
    let mut heard = Vec::new();
    let mut took = |socket: &std::path::PathBuf| {
        let answer = ask(socket, &request, ANSWER_MAX).ok()?;
        let answer: serde_json::Value = serde_json::from_str(&answer).ok()?;
        // A node of an earlier version does not report its lists.
        let lists = answer.get("ok")?.get("lists").and_then(serde_json::Value::as_array);
        let lists = lists.into_iter().flatten().filter_map(serde_json::Value::as_str);
        heard.extend(lists.filter_map(|text| STANDARD.decode(text).ok()).map(bytes::Bytes::from));
        Some(socket.file_stem()?.to_string_lossy().into_owned())
    };
    let names = usual_sockets().iter().filter_map(&mut took).collect();
    (names, heard)
}
