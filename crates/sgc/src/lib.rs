//! `sgc`: the command line of SGC, secure global connectivity for ROS 2.
//!
//! It parses arguments, reads and writes files, prints, and hands everything else to `sgc-node` and
//! `sgc-trust`. It touches no protocol, socket or ROS network, except in `demo` and `bench`, whose programs are
//! plain DDS participants.
//!
//! It is a library so that tests can compare documents with [`command_line`] and [`COUNTERS`]. The program is [`main`].
//!
//! Exit codes: 0 for success, 1 for a failure while running, 2 for arguments or a configuration that cannot be right.
//! An error is one line on standard error that starts with `sgc: `. Mistakes in a configuration are listed above it.
#![deny(unsafe_code)]

mod audit;
mod bench;
mod check;
mod dashboard;
mod demo;
mod descriptors;
mod environment;
mod error;
mod files;
mod fleet;
mod gateway;
mod heap;
mod log;
mod log_filter;
mod memory;
mod moved;
mod name;
mod netcheck;
mod node;
mod output;
mod pages;
mod ping;
mod policy;
mod reload;
mod run;
mod service;
mod span;
mod status;
mod store;
mod supervisor;
mod token;
mod topic;
mod version;
mod why;
mod yaml;

use std::process::ExitCode;

use clap::{CommandFactory as _, Parser, Subcommand};

use crate::error::CliError;
pub use crate::version::Build;
pub use sgc_diagnosis::{COUNTERS, CounterTable, Refusal};

/// Secure global connectivity for ROS 2: share exactly the topics you name with exactly the nodes you trust,
/// between ROS 2 networks anywhere.
#[derive(Debug, Parser)]
#[command(name = "sgc", version = version::version(), max_term_width = 100)]
#[command(after_help = "A first use:
  sgc demo                                  see it work on this machine
  sgc fleet create lab                      make a fleet: lab.fleet
  sgc fleet enroll arm-1                    make a node's identity: arm-1.identity
  sgc run --identity arm-1.identity --router quic://router.lab.example --share /camera/image --to desk

Exit codes:
  0  success
  1  a failure while running, or a fault that the command was asked to find
  2  arguments, a configuration or an identity that cannot be right")]
struct Cli {
    /// Allow core dumps, and debuggers of the same user. Both can read the node's keys from its memory
    /// [env: SGC_ALLOW_CORE_DUMPS]
    #[arg(long, global = true, hide_short_help = true)]
    allow_core_dumps: bool,
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Demo(demo::DemoArgs),
    Bench(bench::BenchArgs),
    Fleet(fleet::FleetArgs),
    Join(fleet::JoinArgs),
    Run(run::RunArgs),
    Router(run::RouterArgs),
    Check(check::CheckArgs),
    Status(status::StatusArgs),
    Netcheck(netcheck::NetcheckArgs),
    Ping(ping::PingArgs),
    Dashboard(dashboard::DashboardArgs),
    Topic(topic::TopicArgs),
    Service(service::ServiceArgs),
    Why(why::WhyArgs),
    Reload(reload::ReloadArgs),
    Audit(audit::AuditArgs),
    Policy(policy::PolicyArgs),
    Token(token::TokenArgs),
    Gateway(gateway::GatewayArgs),
    #[command(hide = true)]
    ShareToken(moved::MovedArgs),
    #[command(hide = true)]
    Use(moved::MovedArgs),
    Name(name::NameArgs),
    Completions(pages::CompletionsArgs),
    #[command(hide = true)]
    Man(pages::ManArgs),
    #[command(hide = true)]
    DemoPeer(demo::PeerArgs),
}

/// Runs the command that the arguments of the process name.
pub fn main(build: Build) -> ExitCode {
    version::set(build);
    let result = match Cli::try_parse() {
        Ok(cli) => {
            memory::close(cli.allow_core_dumps);
            run(cli.command)
        }
        Err(error) => {
            let called = called(std::env::args());
            return match moved::moved_option(&error, &called) {
                Some(error) => error.report(),
                None => error::usage(&error, &called),
            };
        }
    };
    match result {
        Ok(code) => code,
        Err(error) => error.report(),
    }
}

/// Returns the definition of the command line.
pub fn command_line() -> clap::Command {
    Cli::command()
}

/// Returns the command that the arguments name, as far as it exists: `sgc fleet enroll`, for example.
fn called(args: impl Iterator<Item = String>) -> String {
    let mut command = &Cli::command();
    let mut called = command.get_name().to_owned();
    for arg in args.skip(1).filter(|arg| !arg.starts_with('-')) {
        let Some(found) = command.find_subcommand(&arg) else { break };
        command = found;
        called = format!("{called} {}", found.get_name());
    }
    called
}

fn run(command: Command) -> Result<ExitCode, CliError> {
    match command {
        Command::Demo(args) => return demo::demo(args),
        Command::Bench(args) => return bench::bench(args),
        Command::Fleet(args) => return fleet::fleet(args),
        Command::Join(args) => fleet::join(args),
        Command::Run(args) => run::run(args),
        Command::Router(args) => return run::router(args),
        Command::Check(args) => check::check(&args),
        Command::Why(args) => return why::why(&args),
        Command::Topic(args) => return topic::topic(&args),
        Command::Service(args) => return service::service(&args),
        Command::Status(args) => status::status(&args),
        Command::Netcheck(args) => netcheck::netcheck(&args),
        Command::Ping(args) => return ping::ping(&args),
        Command::Dashboard(args) => dashboard::dashboard(&args),
        Command::Reload(args) => return reload::reload(&args),
        Command::Audit(args) => audit::audit(&args),
        Command::Policy(args) => return policy::policy(&args),
        Command::Token(args) => token::token(&args),
        Command::Gateway(args) => gateway::gateway(&args),
        Command::ShareToken(_) => {
            Err(moved::moved("sgc share-token", "sgc token share create, list and revoke"))
        }
        Command::Use(_) => Err(moved::moved("sgc use", "sgc token use")),
        Command::Name(args) => name::name(&args),
        Command::Completions(args) => pages::completions(&args),
        Command::Man(args) => pages::man(&args),
        Command::DemoPeer(args) => demo::peer(args),
    }
    .map(|()| ExitCode::SUCCESS)
}
