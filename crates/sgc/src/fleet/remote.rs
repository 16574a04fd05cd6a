//! `--at AUTHORITY`: fleet operations that the authority carries out. A node of this user requests them over the mesh
//! as an operator.

use std::path::{Path, PathBuf};
use std::time::Duration;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use clap::Args;
use serde::Deserialize;
use sgc_diagnosis::fleet::Members;
use sgc_diagnosis::{DiagnosisError, ask};
use sgc_node::admin::AdminRequest;
use sgc_trust::{Invitation, Membership, NodeName};
use sgc_wire::{
    CSR_BYTES_MAX, Decode as _, Operation, OperationAnswer, OperationRefusal, REVOKED_AT_ONCE_MAX, RosterPage,
};
use zeroize::Zeroizing;

use super::WhichFleet;
use crate::error::CliError;
use crate::node::NodeArgs;

/// Longest wait for the node's answer. The node gives up earlier.
const ANSWER_MAX: Duration = Duration::from_secs(40);

/// The place of the fleet: a file here, or the authority.
#[derive(Debug, Args)]
pub(super) struct FleetPlace {
    #[command(flatten)]
    pub(super) which: WhichFleet,
    /// Let the fleet's authority do it, over the mesh: the name of its node. Your node that runs here sends the
    /// request, and -c, --node or --socket choose it if there are several; the authority's configuration has to list
    /// it in `operators`
    #[arg(long, value_name = "AUTHORITY", conflicts_with = "fleet")]
    at: Option<String>,
    #[command(flatten)]
    pub(super) node: NodeArgs,
}

impl FleetPlace {
    /// Returns the authority, if `--at` names one. Without it, a command works on a fleet file and asks no node, so
    /// arguments that name a node are refused.
    pub(super) fn remote(&self) -> Result<Option<Remote>, CliError> {
        if self.at.is_none() && self.node.is_given() {
            return Err(CliError::Cannot {
                reason: "-c, --node and --socket name the node that sends a request: add --at AUTHORITY"
                    .to_owned(),
            });
        }
        self.authority()
    }

    /// Returns the authority, if `--at` names one. The command may also ask the node for something else.
    pub(super) fn authority(&self) -> Result<Option<Remote>, CliError> {
        let Some(at) = &self.at else { return Ok(None) };
        Ok(Some(Remote { at: at.parse()?, socket: self.node.socket()? }))
    }
}

/// An authority, and the socket of the node that asks it.
pub(super) struct Remote {
    at: NodeName,
    socket: PathBuf,
}

/// Has the fleet's authority revoke a node, as `sgc fleet revoke NODE --at AUTHORITY` does. The node at this socket asks.
/// Returns the number of the new revocation list.
pub(crate) fn revoke_by_authority(socket: &Path, node: &str) -> Result<u64, CliError> {
    let node: NodeName = node.parse()?;
    let authority = Members::of_authority(socket)?.authority.unwrap_or_default().node;
    Remote::new(authority.parse()?, socket.to_owned()).revoke(&[node])
}

/// A node's answer.
#[derive(Deserialize)]
enum Answer {
    #[serde(rename = "ok")]
    Done { answer: String },
    #[serde(rename = "error")]
    Refused(String),
}

impl Remote {
    /// Returns the authority of that name, and the node with this socket to ask it.
    pub(super) fn new(at: NodeName, socket: PathBuf) -> Self {
        Self { at, socket }
    }

    /// Returns the authority's name.
    pub(super) fn at(&self) -> &NodeName {
        &self.at
    }

    /// Returns the whole roster.
    pub(super) fn list(&self) -> Result<RosterPage, CliError> {
        let mut all: Option<RosterPage> = None;
        loop {
            let after = all.as_ref().and_then(|page| page.nodes.last()).map(|node| node.name.clone());
            let OperationAnswer::Roster(mut page) = self.ask(Operation::List { after })? else {
                return Err(self.surprised());
            };
            let before = all.take().map(|page| page.nodes).unwrap_or_default();
            let is_last = !page.more || page.nodes.is_empty();
            page.nodes.splice(0..0, before);
            if is_last {
                return Ok(page);
            }
            all = Some(page);
        }
    }

    /// Revokes nodes. Returns the number of the new revocation list.
    pub(super) fn revoke(&self, nodes: &[NodeName]) -> Result<u64, CliError> {
        let mut last = 0;
        for nodes in nodes.chunks(REVOKED_AT_ONCE_MAX) {
            let nodes = nodes.iter().map(ToString::to_string).collect();
            let OperationAnswer::Revoked { list } = self.ask(Operation::Revoke { nodes })? else {
                return Err(self.surprised());
            };
            last = list;
        }
        Ok(last)
    }

    /// Enrols or renews a node. Returns its identity without the key.
    pub(super) fn certify(&self, operation: Operation) -> Result<Membership, CliError> {
        if let Operation::Enroll { csr, .. } | Operation::Renew { csr, .. } = &operation
            && csr.len() > CSR_BYTES_MAX
        {
            return Err(self.failed("the request for a certificate is too long"));
        }
        let OperationAnswer::Membership(text) = self.ask(operation)? else { return Err(self.surprised()) };
        Membership::parse(text.expose()).map_err(|why| self.failed(&why.to_string()))
    }

    /// Enters a node in the roster and makes its invitation.
    pub(super) fn invite(&self, operation: Operation) -> Result<Invitation, CliError> {
        let OperationAnswer::Invitation(text) = self.ask(operation)? else { return Err(self.surprised()) };
        Invitation::parse(text.expose()).map_err(|why| self.failed(&why.to_string()))
    }

    /// Has an operation carried out.
    fn ask(&self, operation: Operation) -> Result<OperationAnswer, CliError> {
        self.accepted(self.exchange(operation)?)
    }

    /// Returns the authority's answer to an operation, also if it is a refusal.
    pub(super) fn exchange(&self, operation: Operation) -> Result<OperationAnswer, CliError> {
        let request = AdminRequest::Operate { at: self.at.clone(), operation };
        let text = Zeroizing::new(ask::ask(&self.socket, &request, ANSWER_MAX)?);
        let answer = match serde_json::from_str(&text) {
            Ok(Answer::Done { answer }) => Zeroizing::new(answer),
            Ok(Answer::Refused(reason)) => return Err(DiagnosisError::NotSeen { reason }.into()),
            Err(_) => return Err(self.surprised()),
        };
        let bytes = Zeroizing::new(STANDARD.decode(answer.as_bytes()).map_err(|_| self.surprised())?);
        OperationAnswer::from_slice(&bytes).map_err(|_| self.surprised())
    }

    /// Returns an answer unless it is a refusal.
    pub(super) fn accepted(&self, answer: OperationAnswer) -> Result<OperationAnswer, CliError> {
        match answer {
            OperationAnswer::Refused { why: OperationRefusal::Stale, .. } => {
                let at = self.at.to_string();
                let reason = sgc_node::OperationError::OutcomeUnknown { at }.to_string();
                Err(DiagnosisError::NotSeen { reason }.into())
            }
            OperationAnswer::Refused { why: OperationRefusal::Fleet, detail } => Err(self.failed(&detail)),
            OperationAnswer::Refused { why, detail } if detail.is_empty() => {
                Err(self.failed(&why.to_string()))
            }
            OperationAnswer::Refused { why, detail } => Err(self.failed(&format!("{why}: {detail}"))),
            answer => Ok(answer),
        }
    }

    pub(super) fn failed(&self, why: &str) -> CliError {
        DiagnosisError::NotSeen { reason: format!("{} refuses: {why}", self.at) }.into()
    }

    pub(super) fn surprised(&self) -> CliError {
        let reason = format!("the node here or {} is of another version of sgc", self.at);
        DiagnosisError::NotSeen { reason }.into()
    }
}
