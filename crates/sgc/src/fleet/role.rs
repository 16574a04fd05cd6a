//! `--role` and `--may-route`: what a node may do for others.

use clap::{Args, ValueEnum};

use crate::error::CliError;
use crate::moved::moved;

/// Role of a node in its fleet.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Role {
    /// Shares and uses topics, with the secrets of the fleet
    Member,
    /// Only routes: it gets no secret of the fleet, so that it can read no payload
    Router,
}

#[derive(Debug, Args)]
pub(super) struct RoleArgs {
    /// Role of the node
    #[arg(long, value_enum, value_name = "ROLE", default_value = "member")]
    role: Role,
    /// Let a member also route for others
    #[arg(long)]
    may_route: bool,
    #[arg(long, hide = true)]
    router: bool,
}

/// What a node may do for others.
#[derive(Clone, Copy, Debug)]
pub(super) struct NodeRole {
    pub(super) is_router: bool,
    pub(super) may_route: bool,
}

impl RoleArgs {
    /// Returns the role that the arguments ask for.
    pub(super) fn role(&self) -> Result<NodeRole, CliError> {
        if self.router {
            return Err(moved("--router", "--role router"));
        }
        let is_router = self.role == Role::Router;
        if is_router && self.may_route {
            return Err(CliError::Cannot {
                reason: "a router routes anyway: leave --may-route out".to_owned(),
            });
        }
        Ok(NodeRole { is_router, may_route: self.may_route })
    }
}
