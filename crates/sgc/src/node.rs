//! The running node of a command: named by its configuration, its name or its socket, or the only one of this user and
//! of the services that this user may ask.

use std::path::{Path, PathBuf};

use clap::Args;
use sgc_diagnosis::ask;
use sgc_node::config::{self, Config};
use sgc_node::graph::Graph;

use crate::environment::environment;
use crate::error::CliError;

/// The node to ask.
#[derive(Debug, Args)]
pub(crate) struct NodeArgs {
    /// Configuration of the node; without it, the only node of this user or of a service here
    #[arg(short, long, value_name = "FILE", conflicts_with_all = ["socket", "running_node"])]
    config: Option<PathBuf>,
    /// Name of the node, if its socket is in the usual place
    // Commands that ask this node about another one have a positional of the id `node`.
    #[arg(id = "running_node", long = "node", value_name = "NAME", conflicts_with = "socket")]
    node: Option<String>,
    /// Status socket of the node
    #[arg(long, value_name = "PATH")]
    socket: Option<PathBuf>,
}

impl NodeArgs {
    /// Returns `true` if the arguments name a node.
    pub(crate) fn is_given(&self) -> bool {
        self.config.is_some() || self.node.is_some() || self.socket.is_some()
    }

    /// Returns the node's status socket.
    pub(crate) fn socket(&self) -> Result<PathBuf, CliError> {
        if let Some(socket) = &self.socket {
            return Ok(socket.clone());
        }
        if let Some(node) = &self.node {
            return found(node);
        }
        let Some(path) = &self.config else { return only_socket() };
        let config = config::load(path, &environment)
            .map_err(|errors| CliError::Config { what: path.display().to_string(), errors })?;
        match config.admin_socket {
            Some(socket) => Ok(socket),
            None => found(&ask::node_name(&config)?),
        }
    }

    /// Returns the node's graph.
    pub(crate) fn graph(&self, name: Option<sgc_wire::Name>) -> Result<Graph, CliError> {
        Ok(ask::graph(&self.socket()?, name)?)
    }
}

/// Returns the socket of the node with a configuration and this name, whether it runs or not.
pub(crate) fn socket_of(config: &Config, node: &str) -> PathBuf {
    config.admin_socket.clone().unwrap_or_else(|| sgc_node::find_socket(node))
}

/// Returns the usual socket of a node.
fn found(node: &str) -> Result<PathBuf, CliError> {
    let socket = sgc_node::find_socket(node);
    if !socket.exists() && sgc_node::has_hidden_services() {
        return Err(CliError::ServicesOfOthers { node: Some(node.to_owned()) });
    }
    Ok(socket)
}

/// Returns the socket of the only node that this user runs with a default socket, or that is a service of this host.
fn only_socket() -> Result<PathBuf, CliError> {
    let mut found = sgc_node::usual_sockets();
    match found.len() {
        0 if sgc_node::has_hidden_services() => Err(CliError::ServicesOfOthers { node: None }),
        0 => {
            let usual = sgc_node::default_socket_path("node");
            Err(CliError::NoNodeHere { dir: usual.parent().unwrap_or(Path::new("/")).to_owned() })
        }
        1 => Ok(found.swap_remove(0)),
        _ => {
            let name = |socket: &PathBuf| Some(socket.file_stem()?.to_string_lossy().into_owned());
            Err(CliError::SeveralNodes { nodes: found.iter().filter_map(name).collect() })
        }
    }
}
