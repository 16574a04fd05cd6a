//! `sgc join`: makes this machine a node of the fleet that invited it.
//!
//! A node with the certificate of the invitation runs in this process for as long as it takes to ask the authority. So
//! routers are found and dialled as they will be by the node itself.

use std::convert::Infallible;
use std::fmt;
use std::io::{BufRead as _, IsTerminal as _, Read as _};
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::time::{Duration, Instant};

use bytes::Bytes;
use clap::Args;
use serde::Serialize;
use sgc_diagnosis::{DiagnosisError, ask};
use sgc_node::config::{ArgsConfig, Config, load_args};
use sgc_node::graph::Graph;
use sgc_node::{NodeError, RunOptions};
use sgc_process::{EndSignals, ProcessError, system_rng, unix_now};
use sgc_trust::{
    INVITATION_TEXT_BYTES_MAX, Identity, Invitation, Kem, KeyRequest, Membership, NodeName, ReplyKey,
    name_of, operations_blind,
};
use sgc_wire::{GrantContent, Operation, OperationAnswer, OperationRefusal, REDEEM_SINK};
use tokio::runtime::Runtime;
use tokio::sync::oneshot;
use zeroize::Zeroizing;

use super::remote::Remote;
use crate::environment::environment;
use crate::error::CliError;
use crate::files::{self, Existing, PUBLIC_MODE, PendingFile, SECRET_MODE};
use crate::name::toml_string;
use crate::output;
use crate::span::{millis, parse_span};

/// Time for which a router is looked for.
const WAIT_DEFAULT: Duration = Duration::from_secs(60);
/// Time between two looks at the links of the node in this process.
const LOOK_EVERY: Duration = Duration::from_millis(200);
/// Time between two requests to an authority that is busy.
const BUSY_EVERY: Duration = Duration::from_secs(1);
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
    /// The code; without it, it is read from standard input. Then it is in no history of the shell, and other users do
    /// not see it among the processes
    code: Option<Code>,
    /// Directory for the two files
    #[arg(long, value_name = "DIR", default_value = ".", conflicts_with = "service")]
    dir: PathBuf,
    /// Put the files where the service sgc@NAME looks for them
    #[arg(long, value_name = "NAME")]
    service: Option<String>,
    /// Router to use in place of those that the code names; may be repeated, or several separated by commas
    #[arg(long, value_name = "URL", value_delimiter = ',')]
    router: Vec<String>,
    /// Longest time to look for a router, such as 10min [default: 60s]
    #[arg(long, value_name = "TIME", value_parser = parse_span)]
    timeout: Option<Duration>,
    /// Replace an existing identity
    #[arg(long)]
    force: bool,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

/// The node that this machine became, as `--json` shows it.
#[derive(Serialize)]
struct JoinedJson<'a> {
    node: &'a str,
    fleet: &'a str,
    /// The end of the certificate.
    expires: String,
    identity_file: String,
    config_file: String,
    /// Whether the configuration was made; an existing one stays as it is.
    config_is_new: bool,
    /// The service to start, `sgc@NAME`.
    service: Option<String>,
}

/// A code as the user gave it. Debug shows nothing.
#[derive(Clone)]
struct Code(Zeroizing<String>);

impl fmt::Debug for Code {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Code(..)")
    }
}

impl FromStr for Code {
    type Err = Infallible;

    fn from_str(text: &str) -> Result<Self, Infallible> {
        Ok(Self(Zeroizing::new(text.to_owned())))
    }
}

/// Places of the files.
struct Places {
    identity: PathBuf,
    config: PathBuf,
    service: Option<NodeName>,
}

/// Runs `sgc join`.
pub(crate) fn join(args: JoinArgs) -> Result<(), CliError> {
    let code = match args.code {
        Some(Code(code)) => code,
        None => read_code()?,
    };
    let invitation = Invitation::parse(&code).map_err(CliError::Invitation)?;
    check_time(&invitation)?;
    let places = places(&invitation, &args.dir, args.service.as_deref())?;
    let existing = match args.force {
        true => Existing::Replace,
        false => Existing::Keep("; --force replaces it"),
    };
    if let Existing::Keep(hint) = existing
        && files::exists(&places.identity)
    {
        return Err(ProcessError::Exists { path: places.identity, hint }.into());
    }
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .map_err(|source| ProcessError::System { what: "cannot start threads", source })?;
    // From here on there are files that a signal must not leave behind.
    let signals = runtime.block_on(async { EndSignals::new() })?;
    // The code is used up once the authority has answered, so both files are begun before.
    let identity_file = PendingFile::begin(&places.identity)?;
    if places.service.is_some() {
        identity_file.give_to_owner_of_directory()?;
    }
    let config_file = match files::exists(&places.config) {
        true => None,
        false => Some(PendingFile::begin(&places.config)?),
    };
    let routers = if args.router.is_empty() { &invitation.routers } else { &args.router };
    let from = if args.router.is_empty() { "the code" } else { "--router" };
    let key = KeyRequest::generate(None, &mut system_rng()?).map_err(CliError::Making)?;
    let wait = args.timeout.unwrap_or(WAIT_DEFAULT);
    let member = ask_authority(&invitation, (routers, from), &key, wait, (runtime, signals))?;
    let is_router = member.is_router();
    let identity = Identity::join(member, key.key(), &mut system_rng()?)
        .map_err(|source| CliError::Identity { path: places.identity.clone(), source })?;
    identity_file.commit(identity.to_text().as_bytes(), SECRET_MODE, existing)?;
    let is_new = config_file.is_some();
    if let Some(file) = config_file {
        let text = config_text(&identity, &places, routers, is_router);
        file.commit(text.as_bytes(), PUBLIC_MODE, Existing::Keep(""))?;
    }
    let json = JoinedJson {
        node: identity.node_name().as_str(),
        fleet: identity.fleet_name().as_str(),
        expires: identity.not_after().to_string(),
        identity_file: places.identity.display().to_string(),
        config_file: places.config.display().to_string(),
        config_is_new: is_new,
        service: places.service.as_ref().map(|service| format!("sgc@{service}")),
    };
    output::result(args.json, &json, joined_text(&identity, &places, is_new))
}

/// Reads the code from standard input.
fn read_code() -> Result<Zeroizing<String>, CliError> {
    let stdin = std::io::stdin();
    let unreadable =
        |source| CliError::from(ProcessError::Read { path: PathBuf::from("standard input"), source });
    let mut code = Zeroizing::new(String::with_capacity(INVITATION_TEXT_BYTES_MAX + 1));
    // One more than a code can have, so that a longer text is called too long and not mistyped.
    let mut input = stdin.lock().take(INVITATION_TEXT_BYTES_MAX as u64 + 1);
    if stdin.is_terminal() {
        output::diagnostic("Code of `sgc fleet invite`:");
        input.read_line(&mut code).map_err(unreadable)?;
    } else {
        input.read_to_string(&mut code).map_err(unreadable)?;
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

fn places(invitation: &Invitation, dir: &Path, service: Option<&str>) -> Result<Places, CliError> {
    let node = &invitation.node;
    let Some(service) = service else {
        let place = |name: String| if dir == Path::new(".") { PathBuf::from(name) } else { dir.join(name) };
        let (identity, config) = (place(format!("{node}.identity")), place(format!("{node}.toml")));
        return Ok(Places { identity, config, service: None });
    };
    let service: NodeName = service.parse()?;
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

/// Runs a node with the certificate of the invitation until the authority has answered. `from` names the place where
/// the routers are written.
fn ask_authority(
    invitation: &Invitation,
    (routers, from): (&[String], &str),
    key: &KeyRequest,
    wait: Duration,
    (runtime, mut signals): (Runtime, EndSignals),
) -> Result<Membership, CliError> {
    let private = std::fs::Permissions::from_mode(0o700);
    let dir = tempfile::Builder::new().prefix("sgc-join-").permissions(private).tempdir();
    let dir = dir.map_err(|source| ProcessError::System { what: "cannot make a directory", source })?;
    let holder = invitation.identity(&mut system_rng()?).map_err(CliError::Invitation)?;
    let identity = dir.path().join("invitation.identity");
    files::write_secret(&identity, &holder.to_text(), Existing::Replace)?;
    let arguments =
        ArgsConfig { identity: Some(identity), routers: routers.to_vec(), ..ArgsConfig::default() };
    let config = load_args(&arguments, &environment)
        .map_err(|errors| CliError::Config { what: from.to_owned(), errors })?;
    let socket = dir.path().join("node.sock");
    let config = Config { admin_socket: Some(socket.clone()), state: Some(dir.path().to_owned()), ..config };
    let question = Question::new(invitation, &holder, routers, key, socket);
    let result = runtime.block_on(async {
        let (ready, when_ready) = oneshot::channel();
        let (stop, stopped) = oneshot::channel::<()>();
        let options = RunOptions { ready: Some(ready), ..RunOptions::default() };
        let node = tokio::spawn(sgc_node::run(config, options, async move { drop(stopped.await) }));
        let answer = async {
            if when_ready.await.is_err() {
                return None;
            }
            Some(tokio::task::spawn_blocking(move || question.ask(wait)).await)
        };
        let answer = tokio::select! {
            answer = answer => answer,
            () = signals.next() => {
                return Err(failed("interrupted: the code stays good unless the authority has answered".to_owned()));
            }
        };
        drop(stop);
        match node.await {
            Ok(Err(error)) => Err(CliError::Node(error)),
            Err(_) => Err(CliError::Node(NodeError::Panicked)),
            Ok(Ok(())) => match answer {
                Some(Ok(answer)) => answer,
                Some(Err(_)) | None => Err(CliError::Node(NodeError::Panicked)),
            },
        }
    });
    runtime.shutdown_timeout(RUNTIME_GRACE);
    result
}

/// The question to the authority.
struct Question {
    remote: Remote,
    socket: PathBuf,
    routers: Vec<String>,
    operation: Operation,
    /// Name at which the authority is asked.
    name: sgc_wire::Name,
    reply_key: ReplyKey,
}

impl Question {
    fn new(
        invitation: &Invitation,
        holder: &Identity,
        routers: &[String],
        key: &KeyRequest,
        socket: PathBuf,
    ) -> Self {
        let reply_key = ReplyKey::generate(Kem::for_fleet(invitation.post_quantum));
        let csr = Bytes::copy_from_slice(key.csr());
        Self {
            remote: Remote::new(invitation.authority.clone(), socket.clone()),
            socket,
            routers: routers.to_vec(),
            operation: Operation::Redeem { csr, reply_key: reply_key.public().clone() },
            name: name_of(&invitation.authority_id, &operations_blind(&holder.as_peer().ca)),
            reply_key,
        }
    }

    /// Asks once there is a link.
    fn ask(self, wait: Duration) -> Result<Membership, CliError> {
        // `None` waits for ever.
        let until = Instant::now().checked_add(wait);
        self.wait_for_link(until, wait)?;
        let answer = loop {
            let answer = self.remote.exchange(self.operation.clone())?;
            let is_busy = matches!(answer, OperationAnswer::Refused { why: OperationRefusal::Busy, .. });
            // Others join at the same time.
            if !is_busy || until.is_some_and(|until| Instant::now() >= until) {
                break self.remote.accepted(answer)?;
            }
            std::thread::sleep(BUSY_EVERY);
        };
        let OperationAnswer::Sealed { enc, sealed } = answer else { return Err(self.remote.surprised()) };
        match self.reply_key.open(&self.name, &REDEEM_SINK, 0, &enc, &sealed) {
            Ok(GrantContent::Operation(OperationAnswer::Membership(text))) => {
                Membership::parse(text.expose()).map_err(|why| self.remote.failed(&why.to_string()))
            }
            Ok(_) => Err(self.remote.surprised()),
            Err(why) => Err(self.remote.failed(&why.to_string())),
        }
    }

    /// Waits until the node in this process has a link.
    fn wait_for_link(&self, until: Option<Instant>, wait: Duration) -> Result<(), CliError> {
        loop {
            let graph: Graph = ask::graph(&self.socket, None)?;
            if !graph.links.is_empty() {
                return Ok(());
            }
            if until.is_some_and(|until| Instant::now() >= until) {
                let failure = |router: &String| {
                    let search = graph.routers.iter().find(|search| search.router == *router);
                    let why = search.and_then(|search| search.last_failure.clone());
                    format!("{router}: {}", why.unwrap_or_else(|| "no answer".to_owned()))
                };
                let failures: Vec<_> = self.routers.iter().map(failure).collect();
                return Err(failed(format!(
                    "no router within {} s ({}). The code stays good until it is used; --router names another router",
                    millis(wait) / 1000,
                    failures.join("; ")
                )));
            }
            std::thread::sleep(LOOK_EVERY);
        }
    }
}

fn config_text(identity: &Identity, places: &Places, routers: &[String], is_router: bool) -> String {
    let (node, fleet) = (identity.node_name(), identity.fleet_name());
    // A relative path is one from the directory of the configuration.
    let file = match (&places.service, places.identity.file_name()) {
        (None, Some(name)) => name.to_string_lossy().into_owned(),
        (Some(_), _) | (None, None) => places.identity.display().to_string(),
    };
    let routers: Vec<_> = routers.iter().map(|url| toml_string(url)).collect();
    let rest = match is_router {
        true => "[router]\nlisten = [\"quic://0.0.0.0:7447\"]\n",
        false => {
            "# Topics of this machine that others may have:\n#[[share]]\n#topic = \"/camera/image\"\n\
             #to = [\"desk\"]      # nodes, \"group:NAME\", or \"*\" for every member of the fleet\n\n\
             # Topics of other nodes to have here:\n#[[use]]\n#from = \"desk\"\n#topic = \"/cmd_vel\"\n"
        }
    };
    format!(
        "# Node {node} of fleet {fleet}. `sgc check` looks for mistakes.\nidentity = {}\n\n[node]\nrouters = [{}]\n\n\
         {rest}",
        toml_string(&file),
        routers.join(", ")
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
