//! Name, groups and role of a node, as the commands that admit nodes take them.

use std::time::Duration;

use clap::{Args, ValueEnum};
use sgc_process::unix_now;
use sgc_trust::EnrollRequest;

use super::remote::FleetPlace;
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

/// Rights of a node to act for others.
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

/// The node that a command admits to a fleet.
#[derive(Debug, Args)]
pub(super) struct AdmitArgs {
    /// Name of the node: a-z, 0-9, '-', '_' and '.'
    node: String,
    #[command(flatten)]
    pub(super) place: FleetPlace,
    /// Group of the node; may be repeated
    #[arg(long = "group", value_name = "GROUP")]
    groups: Vec<String>,
    #[command(flatten)]
    role: RoleArgs,
}

impl AdmitArgs {
    /// Returns the request to admit the node now, with a certificate that is valid for this time. `again` readmits a
    /// revoked node.
    pub(super) fn request(&self, again: bool, valid: Duration) -> Result<EnrollRequest, CliError> {
        let node = self.node.parse()?;
        let groups = self.groups.iter().map(|group| group.parse()).collect::<Result<_, _>>()?;
        let NodeRole { is_router, may_route } = self.role.role()?;
        Ok(EnrollRequest {
            groups,
            router: is_router,
            may_route,
            again,
            valid,
            ..EnrollRequest::new(node, unix_now())
        })
    }
}
