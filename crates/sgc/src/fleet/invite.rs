//! `sgc fleet invite`: makes a code with which a machine becomes a node by itself.

use std::collections::BTreeSet;
use std::time::Duration;

use clap::Args;
use serde::Serialize;
use sgc_node::config::RouterUrl;
use sgc_process::system_rng;
use sgc_trust::{INVITATION_ROUTERS_MAX, Invitation, LEAF_VALIDITY_DEFAULT};
use sgc_wire::Operation;

use super::role::AdmitArgs;
use crate::error::CliError;
use crate::node::NodeArgs;
use crate::output;
use crate::span::{millis, parse_span};

const WITHIN_DEFAULT: Duration = Duration::from_secs(15 * 60);

/// Print a code with which a machine becomes a node of the fleet: `sgc join CODE` there.
///
/// The machine makes its key itself and asks the fleet's authority, which has to run. The code is good once, and for a
/// short time. It is a secret: whoever uses it first is the node.
#[derive(Debug, Args)]
pub(super) struct InviteArgs {
    #[command(flatten)]
    admit: AdmitArgs,
    /// Invite a revoked node again
    #[arg(long)]
    again: bool,
    /// How long the node's certificate is valid, such as 90d or 12h [default: 90d]
    #[arg(long, value_name = "TIME", value_parser = parse_span)]
    valid: Option<Duration>,
    /// Time within which the machine has to join, such as 1h, at most 7d [default: 15min]
    #[arg(long, value_name = "TIME", value_parser = parse_span)]
    within: Option<Duration>,
    /// Router through which the machine reaches the authority: quic://HOST:PORT, srv://DOMAIN or mdns://; may be
    /// repeated [default: those of your node that runs here]
    #[arg(long, value_name = "URL")]
    via: Vec<String>,
    /// Print the code, its end and what it names as JSON
    #[arg(long)]
    json: bool,
}

/// An invitation as `--json` shows it.
#[derive(Serialize)]
struct InvitationJson<'a> {
    node: &'a str,
    fleet: &'a str,
    authority: &'a str,
    routers: &'a [String],
    /// The end of the code.
    expires: String,
    code: &'a str,
}

pub(super) fn invite(args: &InviteArgs) -> Result<(), CliError> {
    let request = args.admit.request(args.again, args.valid.unwrap_or(LEAF_VALIDITY_DEFAULT))?;
    let within = args.within.unwrap_or(WITHIN_DEFAULT);
    let routers = routers(args)?;
    let place = &args.admit.place;
    let invitation = match place.authority()? {
        Some(remote) => remote.invite(Operation::Invite {
            node: request.node.to_string(),
            groups: request.groups.iter().map(ToString::to_string).collect(),
            router: request.router,
            may_route: request.may_route,
            again: request.again,
            valid_ms: millis(request.valid),
            within_ms: millis(within),
            routers,
        })?,
        None => {
            let mut file = place.which.open()?;
            let made = file.fleet.invite(&request, within, routers, &mut system_rng()?);
            let made = made.map_err(|e| file.error(e))?;
            file.save()?;
            made
        }
    };
    output::diagnostic(&invited_text(&invitation)?);
    let (_, until) = invitation.validity().map_err(CliError::Invitation)?;
    let code = invitation.to_text();
    let json = InvitationJson {
        node: invitation.node.as_str(),
        fleet: invitation.fleet.as_str(),
        authority: invitation.authority.as_str(),
        routers: &invitation.routers,
        expires: until.to_string(),
        code: code.as_str(),
    };
    output::result(args.json, &json, code.as_str())
}

/// Returns the routers that the code names: as asked, or those of the node that runs here.
fn routers(args: &InviteArgs) -> Result<Vec<String>, CliError> {
    let cannot = |reason: String| CliError::Cannot { reason };
    let given = !args.via.is_empty();
    let found = match given {
        true => args.via.clone(),
        false => routers_here(&args.admit.place.node)?,
    };
    if found.is_empty() {
        return Err(cannot(
            "your node here has no routers: name one through which the machine reaches the authority, as in --via \
             quic://router.example:7447"
                .to_owned(),
        ));
    }
    if found.len() > INVITATION_ROUTERS_MAX {
        return Err(cannot(format!(
            "a code names at most {INVITATION_ROUTERS_MAX} routers; choose with --via"
        )));
    }
    for url in &found {
        url.parse::<RouterUrl>().map_err(|fault| cannot(format!("--via {url}: {fault}")))?;
    }
    Ok(found)
}

/// Returns the routers of the node that runs here, as its user wrote them.
fn routers_here(node: &NodeArgs) -> Result<Vec<String>, CliError> {
    let asked = || -> Result<Vec<String>, CliError> {
        let graph = node.graph(None)?;
        let mut seen = BTreeSet::new();
        let routers = graph.routers.into_iter().map(|router| router.router);
        Ok(routers.filter(|url| seen.insert(url.clone())).collect())
    };
    asked().map_err(|why| {
        let why = match why {
            CliError::SeveralNodes { nodes } => {
                format!("several nodes run here, choose one with --node: {}", nodes.join(", "))
            }
            why => why.to_string(),
        };
        CliError::Cannot {
            reason: format!(
                "name a router through which the machine reaches the authority, as in --via \
                 quic://router.example:7447 (a node here would know one, but {why})"
            ),
        }
    })
}

fn invited_text(invitation: &Invitation) -> Result<String, CliError> {
    let (_, until) = invitation.validity().map_err(CliError::Invitation)?;
    let Invitation { node, fleet, authority, routers, .. } = invitation;
    Ok(format!(
        "Invitation of {node} to fleet {fleet}, good once and until {until}. {authority} answers it, through {}.\n\
         It is a secret. On the machine that is to be {node}:\n  sgc join CODE\n",
        routers.join(", ")
    ))
}
