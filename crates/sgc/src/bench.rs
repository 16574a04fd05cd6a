//! `sgc bench`: the arguments of its two sides. `sgc-measure` runs them.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Args, Subcommand};
use sgc_measure::{AnswerOptions, MeasureOptions, Size};
use sgc_node::config::RouterUrl;
use sgc_transport::ListenAddr;
use sgc_trust::{NodeName, Suite};

use crate::error::CliError;
use crate::moved::moved;
use crate::span::parse_seconds;

/// Longest duration of one measurement.
const SECONDS_MAX: u32 = 60;

/// Measure throughput and latency between two of your machines, through sgc and through the bare network
///
/// Run `sgc bench answer` on one machine and `sgc bench run` on the other. They measure round trips, throughput, loss
/// and CPU with DDS on both ends, then plain TCP and UDP, and DDS without sgc if it can reach the other machine.
#[derive(Debug, Args)]
pub(crate) struct BenchArgs {
    #[command(subcommand)]
    command: BenchCommand,
}

#[derive(Debug, Subcommand)]
enum BenchCommand {
    Answer(AnswerArgs),
    Run(MeasureArgs),
}

/// Answer `sgc bench run` from another machine, until Ctrl-C
///
/// Only members of the fleet may measure. While one does, a TCP and a UDP echo port are open to its address, and a DDS
/// participant looks for its machine.
#[derive(Debug, Args)]
pub(crate) struct AnswerArgs {
    /// Identity file of a node, other than the measuring one's, as `sgc fleet enroll` writes it
    #[arg(long, value_name = "FILE")]
    identity: PathBuf,
    /// Address to listen on, such as quic://0.0.0.0:7448; may be repeated, or several separated by commas
    #[arg(long, value_name = "ADDRESS", value_delimiter = ',', value_parser = listen_addr, required_unless_present = "router")]
    listen: Vec<String>,
    /// Router of yours instead; the other side has to name it too; may be repeated, or several separated by commas
    #[arg(long, value_name = "URL", value_delimiter = ',', value_parser = router_url, conflicts_with = "listen")]
    router: Vec<String>,
    /// TCP and UDP port of the plain echo, for a firewall that has to open it; 0 lets the system choose
    #[arg(long, value_name = "PORT", default_value_t = 0)]
    echo_port: u16,
}

/// Measure between this machine and one where `sgc bench answer` runs
///
/// The command prints a table and an interpretation. It takes about twice --duration for each suite and size. Exit code
/// 0 means that it measured; 1 means that it could not, and it prints the cause.
#[derive(Debug, Args)]
pub(crate) struct MeasureArgs {
    /// Identity file of a node, other than the answering one's, as `sgc fleet enroll` writes it
    #[arg(long, value_name = "FILE")]
    identity: PathBuf,
    /// Name of the answering node
    #[arg(long, value_name = "NODE")]
    with: NodeName,
    /// URL at which it listens, such as quic://desk.example:7448; may be repeated, or several separated by commas
    #[arg(long, value_name = "URL", value_delimiter = ',', value_parser = router_url, required_unless_present = "router")]
    connect: Vec<String>,
    /// Router of yours instead; the other side has to name it too; may be repeated, or several separated by commas
    #[arg(long, value_name = "URL", value_delimiter = ',', value_parser = router_url, conflicts_with = "connect")]
    router: Vec<String>,
    /// Suites to measure, separated by commas
    #[arg(long, value_name = "SUITES", value_delimiter = ',', default_value = "group,pairwise")]
    suites: Vec<Suite>,
    /// Sizes of messages, separated by commas
    #[arg(long, value_name = "SIZES", value_delimiter = ',', default_value = "16,1000,1MB")]
    sizes: Vec<Size>,
    /// Duration of each measurement, at most 60s
    #[arg(long, value_name = "TIME", default_value = "5s",
          value_parser = |text: &str| parse_seconds(text, SECONDS_MAX))]
    duration: u32,
    #[arg(long, value_name = "N", hide = true)]
    seconds: Option<String>,
    /// File for the figures as JSON
    #[arg(long, value_name = "FILE")]
    json_file: Option<PathBuf>,
    /// Print the figures as JSON instead of the table
    #[arg(long)]
    json: bool,
    /// The file of an earlier `--json FILE`.
    #[arg(hide = true)]
    moved_json_file: Option<String>,
    /// File for the tables as Markdown
    #[arg(long, value_name = "FILE")]
    markdown: Option<PathBuf>,
}

/// Runs `sgc bench`.
pub(crate) fn bench(args: BenchArgs) -> Result<ExitCode, CliError> {
    match args.command {
        BenchCommand::Answer(args) => {
            let AnswerArgs { identity, listen, router, echo_port } = args;
            sgc_measure::answer(&AnswerOptions { identity, listen, router, echo_port })?;
        }
        BenchCommand::Run(args) => {
            if let Some(seconds) = args.seconds {
                return Err(moved(format!("--seconds {seconds}"), format!("--duration {seconds}s")));
            }
            match args.moved_json_file {
                Some(file) if args.json => {
                    return Err(moved(format!("--json {file}"), format!("--json-file {file}")));
                }
                Some(other) => {
                    return Err(CliError::Cannot { reason: format!("unexpected argument '{other}'") });
                }
                None => {}
            }
            let options = MeasureOptions {
                identity: args.identity,
                with: args.with,
                connect: args.connect,
                router: args.router,
                suites: args.suites,
                sizes: args.sizes,
                seconds: args.duration,
                json_file: args.json_file,
                prints_json: args.json,
                markdown: args.markdown,
            };
            sgc_measure::measure(&options)?;
        }
    }
    Ok(ExitCode::SUCCESS)
}

/// Checks the URL of a router or of the other side by the rules of a configuration.
fn router_url(text: &str) -> Result<String, String> {
    text.parse::<RouterUrl>().map(|_| text.to_owned()).map_err(|fault| fault.to_string())
}

/// Checks an address to listen on by the same rules.
fn listen_addr(text: &str) -> Result<String, String> {
    text.parse::<ListenAddr>().map(|_| text.to_owned()).map_err(|fault| fault.to_string())
}
