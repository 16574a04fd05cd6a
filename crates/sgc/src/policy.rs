//! `sgc policy`: who may join what, worked out from a configuration without a running node.
//!
//! The answer is that of the policy which the node would build.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::{Args, Subcommand, ValueEnum};
use serde::Serialize;
use sgc_diagnosis::DiagnosisError;
use sgc_node::config::{self, Config};
use sgc_node::partners::Partners;
use sgc_node::policy::{Subject, Verdict, explain};
use sgc_process::unix_now;
use sgc_trust::{GroupName, Identity, NodeName};
use sgc_wire::Role;

use crate::environment::environment;
use crate::error::{CliError, EXIT_FAILURE};
use crate::moved::moved;
use crate::{files, output};

const CERTIFICATE_BYTES_MAX: u64 = 64 * 1024;

/// Test who may join a topic.
#[derive(Debug, Args)]
pub(crate) struct PolicyArgs {
    #[command(subcommand)]
    command: PolicyCommand,
}

#[derive(Debug, Subcommand)]
enum PolicyCommand {
    Test(TestArgs),
}

/// Test whether a node may subscribe to a topic or publish on it, and show why.
///
/// The command reads the configuration; no node has to run. Exit code 0 means yes, 1 means no.
#[derive(Debug, Args)]
#[command(group = clap::ArgGroup::new("who").required(true))]
#[command(
    override_usage = "sgc policy test [OPTIONS] --topic </TOPIC> <NODE|--identity-file <FILE>|--certificate <FILE>>"
)]
struct TestArgs {
    /// Name of a node of this fleet
    #[arg(value_name = "NODE", group = "who")]
    node: Option<String>,
    #[arg(long, value_name = "NODE", hide = true, group = "who")]
    identity: Option<String>,
    /// Group of the node, because a name alone does not tell its groups; may be repeated
    #[arg(long = "group", value_name = "GROUP", requires = "node")]
    groups: Vec<String>,
    /// Identity file of a node
    #[arg(long, value_name = "FILE", group = "who")]
    identity_file: Option<PathBuf>,
    /// Certificate chain of a node of any fleet, PEM, leaf first
    #[arg(long, value_name = "FILE", group = "who")]
    certificate: Option<PathBuf>,
    /// Name of the topic
    #[arg(long, value_name = "/TOPIC")]
    topic: String,
    /// Type of the topic, if rules depend on it
    #[arg(long = "type", value_name = "TYPE")]
    type_name: Option<String>,
    /// Right to test
    #[arg(long, value_enum, value_name = "RIGHT", default_value = "subscribe")]
    right: Right,
    /// Configuration of the owner; without it, the only *.toml of this directory
    #[arg(short, long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Print the answer as JSON
    #[arg(long)]
    json: bool,
}

/// The right that is tested.
#[derive(Clone, Copy, Debug, ValueEnum)]
enum Right {
    Subscribe,
    Publish,
}

#[derive(Debug, Serialize)]
struct Answer {
    permitted: bool,
    who: String,
    node_id: Option<String>,
    topic: String,
    role: &'static str,
    because: String,
}

/// Runs `sgc policy`.
pub(crate) fn policy(args: &PolicyArgs) -> Result<ExitCode, CliError> {
    match &args.command {
        PolicyCommand::Test(args) => test(args),
    }
}

/// Loads a configuration with the identity and the partners that a node with it would have now.
pub(crate) fn load(path: &Path) -> Result<(Config, Identity, Partners), CliError> {
    let what = path.display().to_string();
    let config =
        config::load(path, &environment).map_err(|errors| CliError::Config { what: what.clone(), errors })?;
    let identity =
        sgc_node::check_identity(&config).map_err(|source| CliError::CheckIdentity { what, source })?;
    let state = sgc_node::state_dir(&config, identity.node_name().as_str()).filter(|dir| dir.is_dir());
    let partners = Partners::load(&config, state.as_deref(), unix_now())?;
    Ok((config, identity, partners))
}

fn test(args: &TestArgs) -> Result<ExitCode, CliError> {
    if args.identity.is_some() {
        return Err(moved("sgc policy test --identity NODE", "sgc policy test NODE"));
    }
    let path = files::config_here(args.config.as_deref())?;
    let (config, identity, partners) = load(&path)?;
    let (who, subject) = subject(args, &config, &identity, &partners)?;
    let (role, label, word) = match args.right {
        Right::Publish => (Role::Publish, "publish", "publish on"),
        Right::Subscribe => (Role::Subscribe, "subscribe", "subscribe to"),
    };
    let verdict = match &subject {
        Ok(subject) => verdict(args, &config, &identity, &partners, subject, role),
        Err(because) => Verdict { permitted: false, because: because.clone() },
    };
    let answer = Answer {
        permitted: verdict.permitted,
        node_id: subject.ok().map(|subject| subject.node.to_string()),
        topic: args.topic.clone(),
        role: label,
        because: verdict.because,
        who,
    };
    if args.json {
        output::json(&answer)?;
    } else {
        let (yes, not) = if answer.permitted { ("yes", "") } else { ("no", " not") };
        output::line(format!("{yes}: {} may{not} {word} {}: {}", answer.who, answer.topic, answer.because))?;
    }
    Ok(if answer.permitted { ExitCode::SUCCESS } else { ExitCode::from(EXIT_FAILURE) })
}

fn verdict(
    args: &TestArgs,
    config: &Config,
    identity: &Identity,
    partners: &Partners,
    subject: &Subject,
    role: Role,
) -> Verdict {
    let no = |because: String| Verdict { permitted: false, because };
    let Some(share) = config.share_of(&args.topic) else {
        return no(format!("{} does not share it", identity.node_name()));
    };
    match (&share.type_name, &args.type_name) {
        (Some(shared), Some(asked)) if shared != asked => {
            no(format!("{} shares it as {shared}, not as {asked}", identity.node_name()))
        }
        _ => explain(share, identity, partners, subject, role),
    }
}

type SubjectResult = Result<Subject, String>;

/// Returns the node's name for the output, and the subject that its certificate proves or the reason why it proves
/// none.
fn subject(
    args: &TestArgs,
    config: &Config,
    identity: &Identity,
    partners: &Partners,
) -> Result<(String, SubjectResult), CliError> {
    let cannot = |reason: String| CliError::Cannot { reason };
    if let Some(name) = &args.node {
        let name: NodeName = name.parse()?;
        let groups = args.groups.iter().map(|g| g.parse()).collect::<Result<Vec<GroupName>, _>>()?;
        let (Some(secret), Some(node)) = (identity.fleet_secret(), identity.node_id_of(name.as_str())) else {
            return Err(DiagnosisError::RouterCannotName { path: config.identity.clone() }.into());
        };
        let mut groups: Vec<_> = groups.iter().map(|group| secret.group_tag(group.as_str())).collect();
        groups.sort_unstable();
        return Ok((
            name.to_string(),
            Ok(Subject { node, ca: identity.as_peer().ca, groups, may_route: false }),
        ));
    }
    let (who, chain) = match (&args.identity_file, &args.certificate) {
        (Some(path), _) => {
            let other = sgc_node::load_identity(path)?;
            (other.node_name().to_string(), other.chain().to_vec())
        }
        (None, Some(path)) => {
            let pem = files::read_limited(path, CERTIFICATE_BYTES_MAX)?;
            let chain = sgc_node::partners::chain(&pem)
                .map_err(|error| cannot(format!("{}: {error}", path.display())))?;
            (path.display().to_string(), chain)
        }
        (None, None) => return Err(cannot("name a node with --identity".to_owned())),
    };
    let anchors = partners.extend(identity).map_err(|error| cannot(format!("trusted CAs: {error}")))?;
    let believed = anchors.verify(&chain, unix_now());
    let subject = believed.map(|peer| Subject::from(&peer));
    Ok((who, subject.map_err(|error| format!("its certificate is not believed: {error}"))))
}
