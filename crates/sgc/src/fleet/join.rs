//! `sgc join`: makes this machine a node of the fleet that invited it.
//!
//! A node with the certificate of the invitation runs in this process for as long as it takes to ask the authority. So
//! routers are found and dialled as they will be by the node itself.

use std::io::{IsTerminal as _, Read as _};
use std::os::unix::fs::{MetadataExt as _, PermissionsExt as _, chown};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use clap::Args;
use sgc_diagnosis::{DiagnosisError, ask};
use sgc_node::config::{ArgsConfig, Config, load_args};
use sgc_node::graph::Graph;
use sgc_node::{NodeError, RunOptions};
use sgc_process::{ProcessError, system_rng, unix_now};
use sgc_trust::{INVITATION_TEXT_BYTES_MAX, Identity, Invitation, KeyRequest, Membership};
use tokio::sync::oneshot;
use zeroize::Zeroizing;

use super::remote::Remote;
use super::{millis, parse_span};
use crate::environment::environment;
use crate::error::CliError;
use crate::files::{self, Existing};
use crate::output;

/// Time for which a router is looked for.
const WAIT_DEFAULT: Duration = Duration::from_secs(60);
/// Time between two looks at the links of the node in this process.
const LOOK_EVERY: Duration = Duration::from_millis(200);
/// Time by which working threads may delay the end of the process.
const RUNTIME_GRACE: Duration = Duration::from_secs(1);
/// Places of a service's files, as the package has them.
const SERVICE_STATE: &str = "/var/lib/sgc";
const SERVICE_CONFIG: &str = "/etc/sgc";

/// Make this machine a node of a fleet, with a code of `sgc fleet invite`.
///
/// The private key is made here and does not leave the machine. The command writes the node's identity, and a
/// configuration to begin with unless there is one.
#[derive(Debug, Args)]
pub(crate) struct JoinArgs {
    /// The code; without it, it is read from standard input, so that it stays out of the history of the shell
    code: Option<String>,
    /// Directory for the two files
    #[arg(long, value_name = "DIR", default_value = ".", conflicts_with = "service")]
    dir: PathBuf,
    /// Put the files where the service sgc@NAME looks for them
    #[arg(long, value_name = "NAME")]
    service: Option<String>,
    /// Router to use in place of those that the code names; may be repeated
    #[arg(long, value_name = "URL")]
    router: Vec<String>,
    /// How long to look for a router, such as 10min [default: 60s]
    #[arg(long, value_name = "TIME", value_parser = parse_span)]
    wait: Option<Duration>,
    /// Replace an existing identity
    #[arg(long)]
    force: bool,
}

/// Places of the files.
struct Places {
    identity: PathBuf,
    config: PathBuf,
    service: Option<String>,
}

/// Runs `sgc join`.
pub(crate) fn join(args: JoinArgs) -> Result<(), CliError> {
    let code = match args.code {
        Some(code) => Zeroizing::new(code),
        None => read_code()?,
    };
    let invitation = Invitation::parse(&code).map_err(CliError::Invitation)?;
    check_time(&invitation)?;
    let places = places(&invitation, &args.dir, args.service)?;
    let existing = match args.force {
        true => Existing::Replace,
        false => Existing::Keep("; --force replaces it"),
    };
    // Before the invitation is used up.
    if let Existing::Keep(hint) = existing
        && files::exists(&places.identity)
    {
        return Err(ProcessError::Exists { path: places.identity, hint }.into());
    }
    let routers = match args.router.is_empty() {
        true => invitation.routers.clone(),
        false => args.router,
    };
    let key = KeyRequest::generate(None, &mut system_rng()?).map_err(CliError::Making)?;
    let member = ask_authority(&invitation, &routers, key.csr(), args.wait.unwrap_or(WAIT_DEFAULT))?;
    let is_router = member.is_router();
    let identity = Identity::join(member, key.key(), &mut system_rng()?)
        .map_err(|source| CliError::Identity { path: places.identity.clone(), source })?;
    files::write_secret(&places.identity, &identity.to_text(), existing)?;
    if places.service.is_some() {
        give_to_service(&places.identity)?;
    }
    let is_new = !files::exists(&places.config);
    if is_new {
        let text = config_text(&identity, &places, &routers, is_router);
        files::write_public(&places.config, text.as_bytes())?;
    }
    output::line(joined_text(&identity, &places, is_new))
}

/// Reads the code from standard input.
fn read_code() -> Result<Zeroizing<String>, CliError> {
    let stdin = std::io::stdin();
    let unreadable =
        |source| CliError::from(ProcessError::Read { path: PathBuf::from("standard input"), source });
    let mut code = Zeroizing::new(String::with_capacity(INVITATION_TEXT_BYTES_MAX));
    if stdin.is_terminal() {
        output::diagnostic("Code of `sgc fleet invite`:");
        stdin.read_line(&mut code).map_err(unreadable)?;
    } else {
        stdin.take(INVITATION_TEXT_BYTES_MAX as u64).read_to_string(&mut code).map_err(unreadable)?;
    }
    Ok(code)
}

/// Fails if the code is over, or if the clock here says so.
fn check_time(invitation: &Invitation) -> Result<(), CliError> {
    let (from, until) = invitation.validity().map_err(CliError::Invitation)?;
    let now = unix_now();
    if now > until {
        return Err(cannot(format!(
            "the code ended at {until}, and the clock here says {now}: ask for another one"
        )));
    }
    if now < from {
        return Err(cannot(format!(
            "the clock here is behind: it says {now}, and the code was made after {from}"
        )));
    }
    Ok(())
}

fn places(invitation: &Invitation, dir: &Path, service: Option<String>) -> Result<Places, CliError> {
    let node = &invitation.node;
    let Some(service) = service else {
        let place = |name: String| if dir == Path::new(".") { PathBuf::from(name) } else { dir.join(name) };
        let (identity, config) = (place(format!("{node}.identity")), place(format!("{node}.toml")));
        return Ok(Places { identity, config, service: None });
    };
    let (state, configs) = (Path::new(SERVICE_STATE), Path::new(SERVICE_CONFIG));
    if !state.is_dir() || !configs.is_dir() {
        return Err(cannot(format!(
            "--service needs the package's directories {SERVICE_STATE} and {SERVICE_CONFIG}: install sgc as a service \
             first"
        )));
    }
    let identity = state.join(format!("{service}.identity"));
    let config = configs.join(format!("{service}.toml"));
    Ok(Places { identity, config, service: Some(service) })
}

/// Gives a file of root to the user of its directory, as which the service runs.
fn give_to_service(path: &Path) -> Result<(), CliError> {
    let failed = |source| ProcessError::Write { path: path.to_owned(), source };
    let dir = std::fs::metadata(SERVICE_STATE).map_err(failed)?;
    chown(path, Some(dir.uid()), Some(dir.gid())).map_err(failed)?;
    Ok(())
}

/// Runs a node with the certificate of the invitation until the authority has answered.
fn ask_authority(
    invitation: &Invitation,
    routers: &[String],
    csr: &[u8],
    wait: Duration,
) -> Result<Membership, CliError> {
    let private = std::fs::Permissions::from_mode(0o700);
    let dir = tempfile::Builder::new().prefix("sgc-join-").permissions(private).tempdir();
    let dir = dir.map_err(|source| ProcessError::System { what: "cannot make a directory", source })?;
    let identity = dir.path().join("invitation.identity");
    let guest = invitation.identity(&mut system_rng()?).map_err(CliError::Invitation)?;
    files::write_secret(&identity, &guest.to_text(), Existing::Replace)?;
    let arguments =
        ArgsConfig { identity: Some(identity), routers: routers.to_vec(), ..ArgsConfig::default() };
    let config = load_args(&arguments, &environment)
        .map_err(|errors| CliError::Config { what: "the code".to_owned(), errors })?;
    let socket = dir.path().join("node.sock");
    let config = Config { admin_socket: Some(socket.clone()), state: Some(dir.path().to_owned()), ..config };
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .map_err(|source| ProcessError::System { what: "cannot start threads", source })?;
    let (ready, when_ready) = oneshot::channel();
    let (stop, stopped) = oneshot::channel::<()>();
    let options = RunOptions { ready: Some(ready), ..RunOptions::default() };
    let node = runtime.spawn(sgc_node::run(config, options, async move { drop(stopped.await) }));
    let answer = match runtime.block_on(when_ready) {
        Ok(_) => {
            let remote = Remote::new(invitation.authority.clone(), socket.clone());
            wait_for_link(&socket, routers, wait).and_then(|()| remote.redeem(csr))
        }
        // The node ended, which says why.
        Err(_) => Err(failed("the node that asks the authority did not start".to_owned())),
    };
    drop(stop);
    let ended = runtime.block_on(node);
    runtime.shutdown_timeout(RUNTIME_GRACE);
    match ended {
        Ok(Err(error)) => Err(CliError::Node(error)),
        Err(_) => Err(CliError::Node(NodeError::Panicked)),
        Ok(Ok(())) => answer,
    }
}

/// Waits until the node in this process has a link.
fn wait_for_link(socket: &Path, routers: &[String], wait: Duration) -> Result<(), CliError> {
    let until = Instant::now() + wait;
    loop {
        let graph: Graph = ask::graph(socket, None)?;
        if !graph.links.is_empty() {
            return Ok(());
        }
        if Instant::now() >= until {
            let failure = |router: &str| {
                let search = graph.routers.iter().find(|search| search.router == router);
                let why = search.and_then(|search| search.last_failure.clone());
                format!("{router}: {}", why.unwrap_or_else(|| "no answer".to_owned()))
            };
            let failures: Vec<_> = routers.iter().map(|router| failure(router)).collect();
            return Err(failed(format!(
                "no router within {} s ({}). The code stays good until it is used; --router names another router",
                millis(wait) / 1000,
                failures.join("; ")
            )));
        }
        std::thread::sleep(LOOK_EVERY);
    }
}

fn config_text(identity: &Identity, places: &Places, routers: &[String], is_router: bool) -> String {
    let (node, fleet) = (identity.node_name(), identity.fleet_name());
    let path = match &places.service {
        Some(_) => places.identity.clone(),
        None => places.identity.file_name().map_or_else(|| places.identity.clone(), PathBuf::from),
    };
    let name = places.service.as_ref().map(|service| format!("name = {service:?}\n")).unwrap_or_default();
    let listen = if is_router { "listen = [\"quic://0.0.0.0:7447\"]\n" } else { "" };
    let rules = match is_router {
        true => "",
        false => {
            "\n# Topics of this machine that others may have:\n#[[share]]\n#topic = \"/camera/image\"\n\
             #to = [\"desk\"]      # nodes, \"group:NAME\", or \"*\" for every member of the fleet\n\
             \n# Topics of other nodes to have here:\n#[[use]]\n#from = \"desk\"\n#topic = \"/cmd_vel\"\n"
        }
    };
    format!(
        "# Node {node} of fleet {fleet}. `sgc check` looks for mistakes.\nidentity = {:?}\n\n[node]\n{name}{listen}\
         routers = {routers:?}\n{rules}",
        path.display().to_string()
    )
}

fn joined_text(identity: &Identity, places: &Places, is_new: bool) -> String {
    let (file, config) = (places.identity.display(), places.config.display());
    let (node, fleet, until) = (identity.node_name(), identity.fleet_name(), identity.not_after());
    let kept = if is_new { "to begin with" } else { "kept as it was" };
    let next = match &places.service {
        Some(service) => format!("sudo systemctl enable --now sgc@{service}"),
        None => format!("sgc run -c {config}"),
    };
    format!(
        "{file}: node {node} of fleet {fleet}, holds until {until}\n{config}: its configuration, {kept}\nThen:\n  {next}"
    )
}

fn failed(reason: String) -> CliError {
    DiagnosisError::NotSeen { reason }.into()
}

fn cannot(reason: String) -> CliError {
    CliError::Cannot { reason }
}
