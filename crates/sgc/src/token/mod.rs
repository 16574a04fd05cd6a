//! `sgc token`: access tokens for programs, and tokens that share a topic with a partner of another fleet.

mod access;
mod share;
mod use_token;

use std::path::{Path, PathBuf};

use clap::{Args, Subcommand};
use sgc_node::config::Config;
use sgc_trust::Identity;

use crate::error::CliError;
use crate::moved::{MovedArgs, moved};
use crate::{files, policy};

/// Make, list and revoke tokens for programs that connect to a node's gateway and for partners of other fleets, and use
/// a partner's token.
#[derive(Debug, Args)]
pub(crate) struct TokenArgs {
    #[command(subcommand)]
    command: TokenCommand,
}

#[derive(Debug, Subcommand)]
enum TokenCommand {
    Access(access::AccessArgs),
    Share(share::ShareArgs),
    Use(use_token::UseArgs),
    #[command(hide = true)]
    Create(MovedArgs),
    #[command(hide = true)]
    List(MovedArgs),
    #[command(hide = true)]
    Revoke(MovedArgs),
}

/// Runs `sgc token`.
pub(crate) fn token(args: &TokenArgs) -> Result<(), CliError> {
    match &args.command {
        TokenCommand::Access(args) => access::access(args),
        TokenCommand::Share(args) => share::share_token(args),
        TokenCommand::Use(args) => use_token::use_token(args),
        TokenCommand::Create(_) => Err(moved("sgc token create", "sgc token access create")),
        TokenCommand::List(_) => Err(moved("sgc token list", "sgc token access list")),
        TokenCommand::Revoke(_) => Err(moved("sgc token revoke", "sgc token access revoke")),
    }
}

/// Returns the configuration of a node, its identity and its state directory, which may not exist yet.
fn open(config: Option<&Path>) -> Result<(Config, Identity, PathBuf), CliError> {
    let path = files::config_here(config)?;
    let (config, identity, _) = policy::load(&path)?;
    let state = sgc_node::state_dir(&config, identity.node_name().as_str());
    Ok((config, identity, state.ok_or(sgc_node::StateError::Nowhere)?))
}
