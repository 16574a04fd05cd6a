//! `sgc run` and `sgc router`: start a node from arguments and end it cleanly on a signal.
//!
//! `sgc_node::run` is the node. This file owns its surroundings: the log, the signals, and the standard input that a
//! parent may hold open.

use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use clap::{Args, Subcommand};
use sgc_node::config::{self, ArgsConfig};
use sgc_node::{ConfigSource, RunOptions};
use sgc_process::children::ReadyLine;
use sgc_process::{EndSignals, ProcessError, listen, stdin_closed};
use tokio::signal::unix::{Signal, SignalKind};
use tokio::sync::{mpsc, oneshot};
use tokio::time::Instant;

use crate::environment::environment;
use crate::error::CliError;
use crate::log::{LogFormat, start_log};
use crate::store::{self, StoreArgs};
use crate::{descriptors, files, heap, output, supervisor, version};

/// Time after which a node uses no more of what only its start needs. Threads of the start end within it.
const START_MAX: Duration = Duration::from_secs(10);
/// Time between two times at which a node gives back pages of its program. What it needs when peers come and go, it
/// needs seldom.
const PAGES_EVERY: Duration = Duration::from_secs(600);
/// Time by which working threads may delay the end of the process.
const RUNTIME_GRACE: Duration = Duration::from_secs(1);

/// Run a node from a configuration file or from arguments alone.
///
/// A node with shares or uses joins the local ROS 2 network that ROS_DOMAIN_ID and ROS_AUTOMATIC_DISCOVERY_RANGE
/// select. A node that listens is a router; a node can be both. SIGINT and SIGTERM end the node cleanly, and a second
/// signal ends it at once. On SIGHUP it reads its configuration again.
#[derive(Debug, Args)]
pub(crate) struct RunArgs {
    /// Configuration file; without it and without arguments that describe a node, the only *.toml of this directory
    #[arg(short, long, value_name = "FILE",
          conflicts_with_all = ["identity", "router", "share", "to", "uses", "listen", "announce", "gateway"])]
    config: Option<PathBuf>,
    /// Identity file, as `sgc fleet enroll` writes it
    #[arg(long, value_name = "FILE")]
    identity: Option<PathBuf>,
    /// Router to connect to: its address (quic://router.lab.example:7447), a domain with DNS SRV records
    /// (srv://lab.example), or any router on the local network (mdns://); may be repeated, or several separated by
    /// commas
    #[arg(long, value_name = "URL", value_delimiter = ',')]
    router: Vec<String>,
    /// Topic to share, as /TOPIC or /TOPIC=NODE,group:GROUP; the prefix service:, action: or parameters: shares that
    /// kind instead; may be repeated
    #[arg(long, value_name = "[KIND:]/NAME")]
    share: Vec<String>,
    /// Node or group that may subscribe to shared topics and call shared services: NODE, group:GROUP, or '*' for every
    /// member of the fleet, which is the default; may be repeated
    #[arg(long, value_name = "WHO")]
    to: Vec<String>,
    /// Topic of another node to use here; the prefix service:, action: or parameters: uses that kind instead, as in
    /// NODE:service:/NAME; may be repeated
    #[arg(long = "use", value_name = "NODE:[KIND:]/NAME")]
    uses: Vec<String>,
    /// Address on which to listen as a router, such as quic://0.0.0.0:7447; may be repeated, or several separated by commas
    #[arg(long, value_name = "ADDRESS", value_delimiter = ',')]
    listen: Vec<String>,
    /// Announce this router on the local network by mDNS
    #[arg(long, requires = "listen")]
    announce: bool,
    /// Serve programs of this host that have no ROS: rosbridge protocol on port 9090, Foxglove on 8765, gRPC on 50051
    #[arg(long)]
    gateway: bool,
    #[command(flatten)]
    process: ProcessArgs,
}

/// Run a router: it forwards packets and can read none of them. Short for `sgc run` with `--listen` alone.
///
/// With `--peer` it forms a mesh with other routers. With `--accept` it serves only the named fleets.
#[derive(Debug, Args)]
#[command(args_conflicts_with_subcommands = true, subcommand_negates_reqs = true)]
pub(crate) struct RouterArgs {
    #[command(subcommand)]
    command: Option<RouterCommand>,
    /// Identity file, as `sgc fleet enroll --role router` writes it
    #[arg(long, value_name = "FILE", required = true)]
    identity: Option<PathBuf>,
    /// Address to listen on, such as quic://0.0.0.0:7447; may be repeated, or several separated by commas
    #[arg(long, value_name = "ADDRESS", value_delimiter = ',', required = true)]
    listen: Vec<String>,
    /// Other router to connect to, so that both form one mesh: quic://HOST:PORT, srv://DOMAIN or mdns://; may be
    /// repeated
    #[arg(long, value_name = "URL")]
    peer: Vec<String>,
    /// Announce this router on the local network by mDNS
    #[arg(long)]
    announce: bool,
    /// File with CA certificates, PEM: only nodes of these CAs may connect; may be repeated
    #[arg(long, value_name = "FILE")]
    accept: Vec<PathBuf>,
    #[command(flatten)]
    process: ProcessArgs,
}

#[derive(Debug, Subcommand)]
enum RouterCommand {
    Store(StoreArgs),
}

impl RunArgs {
    /// Returns the configuration that `-c` names, or the only one of this directory if the command has no argument
    /// that describes a node. Returns `None` if arguments describe it.
    fn config_file(&self) -> Result<Option<PathBuf>, CliError> {
        let lists = [&self.router, &self.share, &self.to, &self.uses, &self.listen];
        let is_described = self.identity.is_some()
            || self.announce
            || self.gateway
            || lists.iter().any(|values| !values.is_empty());
        match is_described {
            true => Ok(None),
            false => Ok(Some(files::config_here(self.config.as_deref())?)),
        }
    }
}

/// Arguments of a node's process beside its configuration.
#[derive(Debug, Args)]
struct ProcessArgs {
    /// Log level: error, warn, info, debug, trace, or a filter such as sgc_node=debug,info [env: SGC_LOG]
    #[arg(long, value_name = "LEVEL")]
    log: Option<String>,
    /// Form of the log [env: SGC_LOG_FORMAT]
    #[arg(long, value_name = "FORMAT")]
    log_format: Option<LogFormat>,
    /// End when standard input ends, so that a child does not outlive its parent
    #[arg(long, hide = true)]
    until_stdin_closes: bool,
    /// Print a line of JSON with the bound addresses once the node is up
    #[arg(long, hide = true)]
    print_ready: bool,
}

/// Runs `sgc run`.
pub(crate) fn run(args: RunArgs) -> Result<(), CliError> {
    start_log(args.process.log.as_deref(), args.process.log_format)?;
    let config = args.config_file()?;
    let is_open = args.to.is_empty() && args.share.iter().any(|share| !share.contains('='));
    let arguments = ArgsConfig {
        identity: args.identity,
        routers: args.router,
        shares: args.share,
        to: args.to,
        uses: args.uses,
        listen: args.listen,
        announce: args.announce,
        gateway: args.gateway,
        ..ArgsConfig::default()
    };
    let what = config.as_ref().map_or("command line".to_owned(), |path| path.display().to_string());
    let file = config.clone();
    let source: ConfigSource = match config {
        Some(path) => Arc::new(move || config::load(&path, &environment)),
        None => Arc::new(move || config::load_args(&arguments, &environment)),
    };
    if is_open {
        tracing::info!("--share without --to: every member of the fleet may subscribe, and nobody else");
    }
    run_node(source, file, what, &args.process)
}

/// Runs `sgc router`.
pub(crate) fn router(args: RouterArgs) -> Result<ExitCode, CliError> {
    if let Some(RouterCommand::Store(args)) = &args.command {
        return store::store(args);
    }
    start_log(args.process.log.as_deref(), args.process.log_format)?;
    let arguments = ArgsConfig {
        identity: args.identity,
        peers: args.peer,
        listen: args.listen,
        announce: args.announce,
        accept: args.accept,
        ..ArgsConfig::default()
    };
    let source: ConfigSource = Arc::new(move || config::load_args(&arguments, &environment));
    run_node(source, None, "command line".to_owned(), &args.process)?;
    Ok(ExitCode::SUCCESS)
}

/// Hang-ups of a running node. A hang-up ends the node if its terminal is gone; otherwise it asks for a reload.
struct HangUps {
    signal: Signal,
    /// The node was started from a terminal.
    has_terminal: bool,
}

impl HangUps {
    fn new() -> Result<Self, CliError> {
        Ok(Self { signal: listen(SignalKind::hangup())?, has_terminal: terminal_is_there() })
    }

    /// Passes on each request to reload. Returns when the terminal is gone.
    async fn serve(mut self, wishes: mpsc::Sender<()>) {
        loop {
            if self.signal.recv().await.is_none() {
                return std::future::pending().await;
            }
            if self.has_terminal && !terminal_is_there() {
                return;
            }
            // One waiting request covers later ones.
            let _ = wishes.try_send(());
        }
    }
}

fn terminal_is_there() -> bool {
    std::fs::File::open("/dev/tty").is_ok()
}

fn run_node(
    source: ConfigSource,
    file: Option<PathBuf>,
    what: String,
    process: &ProcessArgs,
) -> Result<(), CliError> {
    let config = source().map_err(|errors| CliError::Config { what, errors })?;
    heap::share_arenas();
    descriptors::allow_all();
    let stdin_closed = process.until_stdin_closes.then(stdin_closed);
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .map_err(|source| ProcessError::System { what: "cannot start threads", source })?;
    let result = runtime.block_on(async {
        let signals = EndSignals::without_hang_up()?;
        let hang_ups = HangUps::new()?;
        let (wishes, reload) = mpsc::channel(1);
        let (ready, when_ready) = oneshot::channel::<Vec<_>>();
        let options = RunOptions {
            ready: Some(ready),
            source: Some(source),
            reload: Some(reload),
            file,
            watchdog: supervisor::watchdog(),
            program: Some(format!("sgc {}", version::version())),
            ..RunOptions::default()
        };
        let prints_ready = process.print_ready;
        tokio::spawn(async move {
            let Ok(addresses) = when_ready.await else { return };
            supervisor::ready();
            tokio::spawn(async {
                let mut times = tokio::time::interval_at(Instant::now() + START_MAX, PAGES_EVERY);
                loop {
                    times.tick().await;
                    let _ = tokio::task::spawn_blocking(heap::drop_program_pages).await;
                }
            });
            if prints_ready {
                let ready = addresses.iter().map(ToString::to_string).collect();
                // A failure to print is ignored: if the parent is gone, standard input ends too.
                let _ = serde_json::to_string(&ReadyLine { ready }).map(output::line);
            }
        });
        sgc_node::run(config, options, shutdown(signals, hang_ups.serve(wishes), stdin_closed))
            .await
            .map_err(CliError::Node)
    });
    runtime.shutdown_timeout(RUNTIME_GRACE);
    result
}

/// Becomes ready at the first signal or at the end of standard input. From then on a signal ends the process at once.
async fn shutdown(
    mut signals: EndSignals,
    terminal_gone: impl Future<Output = ()>,
    stdin_closed: Option<oneshot::Receiver<()>>,
) {
    let orphaned = async {
        match stdin_closed {
            Some(closed) => drop(closed.await),
            None => std::future::pending().await,
        }
    };
    tokio::select! {
        () = signals.next() => {}
        () = orphaned => {}
        () = terminal_gone => {}
    }
    supervisor::stopping();
    signals.end_at_once();
}
