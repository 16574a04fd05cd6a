//! The errors that end a command: one variant per cause, with the culprit and the remedy.
//!
//! This module defines exit codes and the form of an error line. Other modules detect the errors.

use std::error::Error;
use std::fmt::Write as _;
use std::io;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::error::ErrorKind;
use sgc_dashboard::DashboardError;
use sgc_demo::DemoError;
use sgc_diagnosis::DiagnosisError;
use sgc_gateway::AccessTokenError;
use sgc_measure::MeasureError;
use sgc_node::config::ConfigErrors;
use sgc_node::partners::PartnerError;
use sgc_node::{
    AccessError, FleetFileError, GatewayCertificateError, GatewayStartError, NodeError, RulesError,
    StateError,
};
use sgc_process::{ProcessError, output};
use sgc_trust::{CrlError, FleetError, IdentityError, InvitationError, LabelError, PemError, TokenError};

use crate::log_filter::LogFilterError;
pub(crate) use sgc_process::EXIT_FAILURE;

/// Exit code for wrong arguments, a wrong configuration or a wrong identity.
pub(crate) const EXIT_USAGE: u8 = 2;

/// An error that ends a command.
#[derive(Debug, thiserror::Error)]
pub(crate) enum CliError {
    /// Mistakes in the configuration. Each is printed on a line of its own.
    #[error("{what}: {}", count(errors))]
    Config {
        /// The configuration file, or the command line.
        what: String,
        /// The mistakes.
        errors: ConfigErrors,
    },
    /// Mistakes in the arguments, by the rules of a configuration.
    #[error("{}", errors.iter().map(|e| e.mistake.to_string()).collect::<Vec<_>>().join("; "))]
    Arguments {
        /// The mistakes.
        errors: ConfigErrors,
    },
    /// A configuration without a store of names.
    #[error(
        "{what}: it names no store: add mapping = \"store\" and store = [\"valkey://HOST:PORT\"] to [router]"
    )]
    NoStore {
        /// The configuration file.
        what: String,
    },
    /// The settings of a store cannot be used.
    #[error(transparent)]
    Store(#[from] sgc_node::StoreSettingsError),
    /// A text that is no name of a node, group or fleet.
    #[error(transparent)]
    Label(#[from] LabelError),
    /// A revocation list could not be pushed to a router.
    #[error("the revocation is in force here, but a router was not told: {0}")]
    Tell(#[from] sgc_node::PushCrlError),
    /// A file without the expected content.
    #[error("{}: it holds no {what}: {hint}", path.display())]
    NotInFile {
        /// The file.
        path: PathBuf,
        /// The missing content.
        what: &'static str,
        /// The remedy.
        hint: &'static str,
    },
    /// A file of blocks that is broken.
    #[error("{}: {source}", path.display())]
    Pem {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: PemError,
    },
    /// Parts of an identity that do not fit together.
    #[error("{}: {source}", path.display())]
    Identity {
        /// The file from which they come.
        path: PathBuf,
        /// The cause.
        source: IdentityError,
    },
    /// A command or option under its earlier name.
    #[error("`{old}` has another name now: {new}")]
    Moved {
        /// The earlier name.
        old: String,
        /// The present name.
        new: String,
    },
    /// A code with which a machine cannot join.
    #[error("the code: {0}")]
    Invitation(#[from] InvitationError),
    /// A fleet file that is broken, or a fleet that cannot enrol.
    #[error("{}: {source}", path.display())]
    Fleet {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: FleetError,
    },
    /// A revocation list that is not valid here.
    #[error("{}: {source}", path.display())]
    List {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: CrlError,
    },
    /// A fleet file that cannot be used.
    #[error(transparent)]
    FleetFile(#[from] FleetFileError),
    /// A certificate that could not be made.
    #[error(transparent)]
    Making(FleetError),
    /// No fleet file was named and none is here.
    #[error("no fleet file here: name one with --fleet FILE, or make a fleet with `sgc fleet create NAME`")]
    NoFleetHere,
    /// No fleet file was named and several are here.
    #[error("which fleet? Name one with --fleet: {}", files.join(", "))]
    SeveralFleets {
        /// Their names.
        files: Vec<String>,
    },
    /// The node refused or failed.
    #[error(transparent)]
    Node(#[from] NodeError),
    /// A configuration whose identity cannot be used.
    #[error("{what}: {source}")]
    CheckIdentity {
        /// The configuration file.
        what: String,
        /// The cause.
        source: NodeError,
    },
    /// A text that is no log filter.
    #[error("{from} is {value:?}: {reason}")]
    LogFilter {
        /// The argument or variable.
        from: &'static str,
        /// Its value.
        value: String,
        /// The fault.
        reason: LogFilterError,
    },
    /// A text that is no form of the log.
    #[error("SGC_LOG_FORMAT is {value:?}: write text or json")]
    LogFormat {
        /// The value.
        value: String,
    },
    /// No status socket was named and none is in the usual place.
    #[error("no node of this user runs here (no socket in {}); name one with -c or --socket", dir.display())]
    NoNodeHere {
        /// The usual place.
        dir: PathBuf,
    },
    /// No node of this user runs here, and services run whose sockets this user may not use.
    #[error(
        "no node{} of yours runs here. There are services that you may not ask: write `sudo` in front, or join their \
         group by `sudo usermod -aG sgc $USER` and log in again",
        node.as_ref().map(|node| format!(" {node:?}")).unwrap_or_default()
    )]
    ServicesOfOthers {
        /// The name of the node, if one was named.
        node: Option<String>,
    },
    /// No status socket was named and several are in the usual place.
    #[error("which node? Name one with --node: {}", nodes.join(", "))]
    SeveralNodes {
        /// Their names, taken from the names of their sockets.
        nodes: Vec<String>,
    },
    /// No configuration was named and none is here.
    #[error("no configuration here (no *.toml): name one with -c FILE")]
    NoConfigHere,
    /// No configuration was named and several are here.
    #[error("which configuration? Name one with -c: {}", files.join(", "))]
    SeveralConfigs {
        /// Their names.
        files: Vec<String>,
    },
    /// Partners, or tokens that were given to them.
    #[error(transparent)]
    Partner(#[from] PartnerError),
    /// Partners, or tokens that the configuration uses.
    #[error(transparent)]
    Rules(#[from] RulesError),
    /// The state directory.
    #[error(transparent)]
    State(#[from] StateError),
    /// Access tokens that were made.
    #[error(transparent)]
    Access(#[from] AccessError),
    /// The certificate of the gateway.
    #[error(transparent)]
    GatewayCertificate(#[from] GatewayCertificateError),
    /// A configuration without a gateway that has a certificate.
    #[error(
        "{}: no gateway listens with TLS here, so there is no certificate: add `listen = [\"wss://0.0.0.0:9443\"]` or a \
         grpcs:// address to [gateway]",
        path.display()
    )]
    NoGatewayTls {
        /// The configuration.
        path: PathBuf,
    },
    /// An access token that cannot be made.
    #[error("such a token cannot be made: {0}")]
    AccessToken(#[from] AccessTokenError),
    /// A text that is no token.
    #[error("the token cannot be used: {0}")]
    Token(#[from] TokenError),
    /// A token was given on the command line.
    #[error(
        "a token on the command line is shown to every user of this host, and the shell remembers it: give it on standard \
         input (`sgc token use -`), or name a file of mode 0600 that holds it; if others use this host, have its owner \
         withdraw it and make another"
    )]
    TokenShown,
    /// A request that cannot be right.
    #[error("{reason}")]
    Cannot {
        /// The cause, with the remedy.
        reason: String,
    },
    /// Members would lose the secret by which they derive names of others.
    #[error(
        "{}: not handed generation {generation} of the secret yet: {}. They would find nothing any more: renew them, or \
         wait until they have asked the authority (`sgc fleet list`); --force retires it all the same",
        path.display(), some(nodes)
    )]
    SecretLacking {
        /// The fleet file.
        path: PathBuf,
        /// The generation.
        generation: u32,
        /// The members.
        nodes: Vec<String>,
    },
    /// A running node refused a request.
    #[error("the node at {} refused, everything there is as it was: {}", path.display(), reason.lines().last().unwrap_or_default())]
    NodeRefused {
        /// Its socket.
        path: PathBuf,
        /// The causes, one per line.
        reason: String,
    },
    /// No definition of a type was found.
    #[error(
        "{type_name} cannot be decoded: {why}; source the workspace that defines it, name a directory with --msg-dir, or use --raw"
    )]
    NoDefinition {
        /// The type.
        type_name: String,
        /// The cause.
        why: String,
    },
    /// A message has no such member.
    #[error("its messages have no member {path:?}")]
    NoSuchField {
        /// The path as given.
        path: String,
    },
    /// A message has no stamp.
    #[error("{topic}: its messages do not begin with a std_msgs/Header, so they say not when they were made")]
    NoHeader {
        /// The topic.
        topic: String,
    },
    /// There is no audit log.
    #[error("cannot read the audit log {}: {reason}", path.display())]
    NoAudit {
        /// The file.
        path: PathBuf,
        /// The system's error.
        reason: String,
    },
    /// The demo cannot go on.
    #[error(transparent)]
    Demo(DemoError),
    /// A measurement between two machines cannot begin or continue.
    #[error(transparent)]
    Bench(MeasureError),
    /// The page of the fleet cannot be served.
    #[error(transparent)]
    Dashboard(#[from] DashboardError),
    /// A node that cannot be asked, or an answer that cannot be used.
    #[error(transparent)]
    Diagnosis(#[from] DiagnosisError),
    /// The process or one of its files.
    #[error(transparent)]
    Process(#[from] ProcessError),
}

impl CliError {
    /// Prints the error and returns the exit code of the process.
    pub(crate) fn report(&self) -> ExitCode {
        match self {
            // The reader closed the pipe, as with `sgc status | head -1`.
            Self::Process(ProcessError::Output(error)) if error.kind() == io::ErrorKind::BrokenPipe => {
                return ExitCode::SUCCESS;
            }
            Self::Config { errors, .. } => {
                for error in errors {
                    output::diagnostic(&error.to_string());
                }
            }
            Self::NodeRefused { reason, .. } => {
                let above = reason.lines().count().saturating_sub(1);
                reason.lines().take(above).for_each(output::diagnostic);
            }
            _ => {}
        }
        output::diagnostic(&format!("sgc: {}", self.line()));
        if let Self::Demo(DemoError::Failed { facts, .. }) | Self::Bench(MeasureError::Failed { facts, .. }) =
            self
        {
            for fact in facts {
                output::diagnostic(&format!("  {fact}"));
            }
        }
        ExitCode::from(self.exit_code())
    }

    /// Returns the error with its sources as a line without control characters.
    pub(crate) fn line(&self) -> String {
        one_line(&chain(self))
    }

    fn exit_code(&self) -> u8 {
        match self {
            Self::Config { .. }
            | Self::NoStore { .. }
            | Self::Store(_)
            | Self::Arguments { .. }
            | Self::Label(_)
            | Self::Process(ProcessError::Exists { .. } | ProcessError::Exposed { .. })
            | Self::NotInFile { .. }
            | Self::Pem { .. }
            | Self::Identity { .. }
            | Self::Invitation(_)
            | Self::Moved { .. }
            | Self::Fleet { .. }
            | Self::FleetFile(FleetFileError::Exposed { .. } | FleetFileError::Content { .. })
            | Self::List { .. }
            | Self::Making(_)
            | Self::NoFleetHere
            | Self::SeveralFleets { .. }
            | Self::SecretLacking { .. }
            | Self::CheckIdentity { .. }
            | Self::Diagnosis(DiagnosisError::RouterCannotName { .. })
            | Self::Dashboard(DashboardError::NotLoopback(_))
            | Self::LogFilter { .. }
            | Self::LogFormat { .. }
            | Self::SeveralNodes { .. }
            | Self::NoConfigHere
            | Self::SeveralConfigs { .. }
            | Self::Partner(_)
            | Self::Rules(_)
            | Self::State(_)
            | Self::Access(_)
            | Self::GatewayCertificate(_)
            | Self::NoGatewayTls { .. }
            | Self::AccessToken(_)
            | Self::Token(_)
            | Self::TokenShown
            | Self::Cannot { .. } => EXIT_USAGE,
            // Something that may go away by itself, for which a supervisor starts the node again.
            Self::Node(
                NodeError::Listen { .. }
                | NodeError::IdentityInUse { .. }
                | NodeError::Ros(_)
                | NodeError::Thread(_)
                | NodeError::Audit { .. }
                | NodeError::State(StateError::Directory { .. })
                | NodeError::Randomness(_),
            ) => EXIT_FAILURE,
            Self::Node(NodeError::IdentityFile { source, .. }) if !is_lacking(source) => EXIT_FAILURE,
            Self::Node(NodeError::Gateway(error)) if is_gateway_io(error) => EXIT_FAILURE,
            Self::Node(_) => EXIT_USAGE,
            Self::Process(_)
            | Self::FleetFile(FleetFileError::Read { .. } | FleetFileError::Write { .. })
            | Self::Diagnosis(_)
            | Self::Dashboard(_)
            | Self::NoNodeHere { .. }
            | Self::ServicesOfOthers { .. }
            | Self::NodeRefused { .. }
            | Self::NoDefinition { .. }
            | Self::NoSuchField { .. }
            | Self::NoHeader { .. }
            | Self::NoAudit { .. }
            | Self::Demo(_)
            | Self::Bench(_)
            | Self::Tell(_) => EXIT_FAILURE,
        }
    }
}

impl From<DemoError> for CliError {
    fn from(error: DemoError) -> Self {
        match error {
            DemoError::Failed { .. } => Self::Demo(error),
            DemoError::Fleet { path, source } => Self::Fleet { path, source },
            DemoError::Label(error) => error.into(),
            DemoError::Diagnosis(error) => error.into(),
            DemoError::Process(error) => error.into(),
        }
    }
}

impl From<MeasureError> for CliError {
    fn from(error: MeasureError) -> Self {
        match error {
            MeasureError::Failed { .. } => Self::Bench(error),
            MeasureError::Cannot { reason } => Self::Cannot { reason },
            MeasureError::Arguments { errors } => Self::Arguments { errors },
            MeasureError::CheckIdentity { what, source } => Self::CheckIdentity { what, source },
            MeasureError::Node(error) => error.into(),
            MeasureError::Diagnosis(error) => error.into(),
            MeasureError::Process(error) => error.into(),
        }
    }
}

/// Prints clap's message about a call of `called`, help included. Returns the exit code of the process.
pub(crate) fn usage(error: &clap::Error, called: &str) -> ExitCode {
    match error.kind() {
        ErrorKind::DisplayHelp | ErrorKind::DisplayVersion => {
            // A failure to print the help cannot be reported to anybody.
            let _ = error.print();
            ExitCode::SUCCESS
        }
        ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand => {
            let _ = error.print();
            ExitCode::from(EXIT_USAGE)
        }
        _ => {
            output::diagnostic(&format!("sgc: {}", usage_line(&error.render().to_string(), called)));
            ExitCode::from(EXIT_USAGE)
        }
    }
}

/// Joins clap's paragraphs to one line: the mistake, the tip, and the command that shows more.
fn usage_line(text: &str, called: &str) -> String {
    let (about, rest) = text.split_once("Usage:").unwrap_or((text, ""));
    let about = about.split("For more information").next().unwrap_or_default();
    let line = about.split_whitespace().collect::<Vec<_>>().join(" ").replace(" tip: ", "; ");
    let line = line.strip_prefix("error: ").unwrap_or(&line);
    let is_command = |word: &&str| word.chars().all(|c| c.is_ascii_lowercase() || c == '-');
    let command: Vec<_> =
        rest.split_whitespace().take_while(is_command).take_while(|word| !word.starts_with('-')).collect();
    // Clap prints no usage for a bad value.
    let command = if command.is_empty() { called.to_owned() } else { command.join(" ") };
    format!("{line}; see `{command} --help`")
}

/// Formats an error and its sources, each once.
pub(crate) fn chain(error: &dyn Error) -> String {
    let mut text = error.to_string();
    let mut next = error.source();
    while let Some(source) = next {
        let said = source.to_string();
        if !text.contains(&said) {
            let _ = write!(text, ": {said}");
        }
        next = source.source();
    }
    text
}

/// Joins lines and removes control characters.
pub(crate) fn one_line(text: &str) -> String {
    output::clean(&text.lines().map(str::trim).collect::<Vec<_>>().join(" "))
}

/// Lists the first few names.
fn some(names: &[String]) -> String {
    const SHOWN_MAX: usize = 10;
    let mut text = names.iter().take(SHOWN_MAX).map(String::as_str).collect::<Vec<_>>().join(", ");
    if names.len() > SHOWN_MAX {
        let _ = write!(text, " and {} more", names.len() - SHOWN_MAX);
    }
    text
}

fn count(errors: &ConfigErrors) -> String {
    match errors.iter().count() {
        1 => "1 mistake".to_owned(),
        n => format!("{n} mistakes"),
    }
}

/// Returns `true` if reading or writing the gateway's certificate failed for a cause that may go away by itself.
fn is_gateway_io(error: &GatewayStartError) -> bool {
    let GatewayStartError::Certificate(GatewayCertificateError::File { source, .. }) = error else {
        return false;
    };
    !is_lacking(source)
}

/// Returns `true` if a file is missing or belongs to somebody else, which another start does not change.
fn is_lacking(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::PermissionDenied)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clap_message_becomes_one_line() {
        let text = "error: unrecognized subcommand 'flet'\n\n  tip: a similar subcommand exists: 'fleet'\n\n\
                    Usage: sgc <COMMAND>\n\nFor more information, try '--help'.\n";
        assert_eq!(
            usage_line(text, "sgc fleet"),
            "unrecognized subcommand 'flet'; a similar subcommand exists: 'fleet'; see `sgc --help`"
        );
        let text = "error: invalid value 'x' for '--count <N>': invalid digit\n\nFor more information, try '--help'.\n";
        assert_eq!(
            usage_line(text, "sgc fleet enroll"),
            "invalid value 'x' for '--count <N>': invalid digit; see `sgc fleet enroll --help`"
        );
        let text = "error: the following required arguments were not provided:\n  --owner <NODE>\n\n\
                    Usage: sgc fleet enroll --owner <NODE>\n\nFor more information, try '--help'.\n";
        let said = "the following required arguments were not provided: --owner <NODE>";
        assert_eq!(usage_line(text, "sgc"), format!("{said}; see `sgc fleet enroll --help`"));
    }

    #[test]
    fn error_chain_names_each_source_once() {
        let inner = || io::Error::other("disk on fire");
        let outer = CliError::from(ProcessError::Read { path: "/x".into(), source: inner() });
        assert_eq!(chain(&outer), "cannot read /x: disk on fire");
    }
}
