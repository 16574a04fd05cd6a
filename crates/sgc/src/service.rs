//! `sgc service`: calls services of the local network and of the far side, without a ROS 2 installation.

use std::process::ExitCode;
use std::time::Duration;

use clap::{Args, Subcommand};
use serde_json::value::RawValue;
use sgc_diagnosis::ask::{answer, ask};
use sgc_node::admin::AdminRequest;
use sgc_node::shell::CallRequest;

use crate::error::CliError;
use crate::node::NodeArgs;
use crate::span::{millis, parse_span};
use crate::{output, yaml};

/// Time that the node may take to answer beyond the call itself.
const ANSWER_MAX: Duration = Duration::from_secs(5);

/// Call services here and on the far side, without a ROS 2 installation
#[derive(Debug, Args)]
pub(crate) struct ServiceArgs {
    #[command(subcommand)]
    command: ServiceCommand,
}

#[derive(Debug, Subcommand)]
enum ServiceCommand {
    Call(CallArgs),
}

/// Call a service with a request in JSON or YAML and print its reply as JSON
///
/// The node that runs here calls the service on its local network. Services that the node uses from the far side are
/// there too.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  sgc service call /add_two_ints example_interfaces/srv/AddTwoInts '{a: 2, b: 3}'
  sgc service call /motors/enable '{data: true}'")]
struct CallArgs {
    /// Name of the service
    service: String,
    /// Type of the service; may be omitted if a server is there
    #[arg(value_name = "TYPE")]
    first: Option<String>,
    /// Request; omitted members have their defaults
    #[arg(value_name = "REQUEST")]
    second: Option<String>,
    /// Longest time to wait for the reply
    #[arg(long, value_name = "TIME", default_value = "10s", value_parser = parse_span)]
    timeout: Duration,
    #[command(flatten)]
    node: NodeArgs,
    /// Print the reply as JSON, which is the default
    #[arg(long)]
    json: bool,
}

/// Runs `sgc service`.
pub(crate) fn service(args: &ServiceArgs) -> Result<ExitCode, CliError> {
    let ServiceCommand::Call(args) = &args.command;
    let (type_name, request) = crate::topic::type_and_message(args.first.as_deref(), args.second.as_deref());
    let request = yaml::json_of(request.unwrap_or_default())
        .map_err(|reason| CliError::Cannot { reason: format!("the request: {reason}") })?;
    let wish = CallRequest {
        service: args.service.clone(),
        type_name: type_name.map(str::to_owned),
        request,
        timeout_ms: millis(args.timeout),
    };
    let socket = args.node.socket()?;
    let patience = args.timeout.saturating_add(ANSWER_MAX);
    let text = ask(&socket, &AdminRequest::Call(wish), patience)?;
    // The reply has one form, with and without --json.
    let reply: Box<RawValue> = answer(&socket, &text)?;
    output::line(reply)?;
    Ok(ExitCode::SUCCESS)
}
