//! The command line of `../../README.md`, as far as this peer has it.

use std::time::Duration;

use clap::{Args, Parser, Subcommand};

#[derive(Parser)]
pub struct Options {
    #[command(subcommand)]
    pub role: Role,
}

#[derive(Subcommand)]
pub enum Role {
    #[command(args_override_self = true)]
    Pub(Publish),
    #[command(args_override_self = true)]
    Sub(Subscribe),
    #[command(args_override_self = true)]
    Serve(Service),
    #[command(args_override_self = true)]
    Call(Call),
    #[command(args_override_self = true)]
    ActionServe(Action),
    #[command(args_override_self = true)]
    ActionCall(ActionCall),
}

#[derive(Args)]
pub struct Session {
    /// The router
    #[arg(long, default_value = "tcp/127.0.0.1:7447")]
    pub connect: String,
    #[arg(long, default_value = "peer", value_parser = ["peer", "client"])]
    pub mode: String,
    #[arg(long, default_value_t = 0)]
    pub domain: usize,
    /// Full name of the node
    #[arg(long, default_value = "/hiroz_peer")]
    pub node: String,
    /// Seconds from the start
    #[arg(long, default_value = "60", value_parser = seconds)]
    pub timeout: Duration,
}

#[derive(Args)]
pub struct Topic {
    #[command(flatten)]
    pub session: Session,
    #[arg(long, default_value = "/chatter")]
    pub topic: String,
    #[arg(long, default_value_t = 0)]
    pub count: u64,
    #[arg(long)]
    pub best_effort: bool,
    #[arg(long)]
    pub transient_local: bool,
    /// 0 keeps all
    #[arg(long, default_value_t = 10)]
    pub depth: usize,
    #[arg(long)]
    pub verbose: bool,
}

#[derive(Args)]
pub struct Publish {
    #[command(flatten)]
    pub topic: Topic,
    #[arg(long, default_value_t = 10.0)]
    pub rate: f64,
    #[arg(long, default_value_t = 0)]
    pub size: usize,
    #[arg(long, default_value_t = 0)]
    pub start: u64,
    #[arg(long, default_value_t = 1)]
    pub wait_matched: usize,
    #[arg(long)]
    pub wait_go: bool,
    #[arg(long, default_value = "0", value_parser = seconds)]
    pub hold: Duration,
}

#[derive(Args)]
pub struct Subscribe {
    #[command(flatten)]
    pub topic: Topic,
    #[arg(long, default_value = "0", value_parser = seconds)]
    pub linger: Duration,
}

#[derive(Args)]
pub struct Service {
    #[command(flatten)]
    pub session: Session,
    #[arg(long, default_value = "/add_two_ints")]
    pub name: String,
}

#[derive(Args)]
pub struct Call {
    #[command(flatten)]
    pub service: Service,
    #[arg(long, default_value_t = 1)]
    pub count: u64,
    /// A base to which the number of the call is added
    #[arg(long, default_value_t = 1000)]
    pub base: i64,
}

#[derive(Args)]
pub struct Action {
    #[command(flatten)]
    pub session: Session,
    #[arg(long, default_value = "/fibonacci")]
    pub name: String,
    /// Seconds for a number
    #[arg(long, default_value = "0.05", value_parser = seconds)]
    pub step: Duration,
}

#[derive(Args)]
pub struct ActionCall {
    #[command(flatten)]
    pub action: Action,
    #[arg(long, default_value_t = 5)]
    pub order: i32,
    /// After two numbers
    #[arg(long)]
    pub cancel: bool,
}

fn seconds(text: &str) -> Result<Duration, String> {
    let seconds = text.parse().map_err(|_| format!("no number: {text}"))?;
    Duration::try_from_secs_f64(seconds).map_err(|_| format!("no time: {text}"))
}
