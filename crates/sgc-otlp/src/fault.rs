//! [`Fault`]: reasons why a collector did not take metrics.

use std::time::Duration;

/// Reasons why a push failed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Fault {
    /// The host has no address, or its addresses take no connection.
    #[error("no connection: {reason}")]
    Unreachable {
        /// The reason.
        reason: String,
    },
    /// TLS failed, or its roots cannot be read.
    #[error("TLS: {reason}")]
    Tls {
        /// The reason.
        reason: String,
    },
    /// The connection ended before the answer, or carries no HTTP.
    #[error("no answer: {reason}")]
    Broken {
        /// The reason.
        reason: String,
    },
    /// The answer took too long.
    #[error("no complete answer within {} s", .within.as_secs())]
    TimedOut {
        /// The bound.
        within: Duration,
    },
    /// The collector takes nothing for now.
    #[error("it is busy (status {status}){}", says(.message))]
    Busy {
        /// The status code.
        status: u16,
        /// The collector's explanation.
        message: String,
        /// The wait that it asks for.
        retry_after: Option<Duration>,
    },
    /// The collector refuses the request.
    #[error("it refuses (status {status}){}", says(.message))]
    Refused {
        /// The status code.
        status: u16,
        /// The collector's explanation.
        message: String,
    },
    /// The collector points elsewhere.
    #[error("it redirects (status {status}){}, which is not followed", toward(.location))]
    Redirected {
        /// The status code.
        status: u16,
        /// The other address.
        location: String,
    },
    /// The collector took only a part.
    #[error("it refuses {rejected} values{}", says(.message))]
    Partial {
        /// The number of values that it did not take.
        rejected: u64,
        /// The collector's explanation.
        message: String,
    },
    /// The answer is none of OTLP.
    #[error("its answer is not OTLP: {reason}")]
    NotOtlp {
        /// The reason.
        reason: String,
    },
    /// A file with headers cannot be used.
    #[error("{reason}")]
    Headers {
        /// The reason.
        reason: String,
    },
}

/// Kinds of [`Fault`], which label counters.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum FaultKind {
    /// [`Fault::Unreachable`]
    Unreachable,
    /// [`Fault::Tls`]
    Tls,
    /// [`Fault::Broken`]
    Broken,
    /// [`Fault::TimedOut`]
    TimedOut,
    /// [`Fault::Busy`]
    Busy,
    /// [`Fault::Refused`]
    Refused,
    /// [`Fault::Redirected`]
    Redirected,
    /// [`Fault::Partial`]
    Partial,
    /// [`Fault::NotOtlp`]
    NotOtlp,
    /// [`Fault::Headers`]
    Headers,
}

impl Fault {
    /// Returns the kind.
    pub fn kind(&self) -> FaultKind {
        match self {
            Self::Unreachable { .. } => FaultKind::Unreachable,
            Self::Tls { .. } => FaultKind::Tls,
            Self::Broken { .. } => FaultKind::Broken,
            Self::TimedOut { .. } => FaultKind::TimedOut,
            Self::Busy { .. } => FaultKind::Busy,
            Self::Refused { .. } => FaultKind::Refused,
            Self::Redirected { .. } => FaultKind::Redirected,
            Self::Partial { .. } => FaultKind::Partial,
            Self::NotOtlp { .. } => FaultKind::NotOtlp,
            Self::Headers { .. } => FaultKind::Headers,
        }
    }

    /// Returns `true` if another attempt may succeed before the next values are due.
    pub fn is_passing(&self) -> bool {
        match self.kind() {
            FaultKind::Unreachable
            | FaultKind::Tls
            | FaultKind::Broken
            | FaultKind::TimedOut
            | FaultKind::Busy => true,
            FaultKind::Refused
            | FaultKind::Redirected
            | FaultKind::Partial
            | FaultKind::NotOtlp
            | FaultKind::Headers => false,
        }
    }
}

impl FaultKind {
    /// All kinds.
    pub const ALL: [Self; 10] = [
        Self::Unreachable,
        Self::Tls,
        Self::Broken,
        Self::TimedOut,
        Self::Busy,
        Self::Refused,
        Self::Redirected,
        Self::Partial,
        Self::NotOtlp,
        Self::Headers,
    ];

    /// Returns the label of counters.
    pub fn label(self) -> &'static str {
        match self {
            Self::Unreachable => "unreachable",
            Self::Tls => "tls",
            Self::Broken => "broken",
            Self::TimedOut => "timed_out",
            Self::Busy => "busy",
            Self::Refused => "refused",
            Self::Redirected => "redirected",
            Self::Partial => "partial",
            Self::NotOtlp => "not_otlp",
            Self::Headers => "headers",
        }
    }
}

fn says(message: &str) -> String {
    if message.is_empty() { String::new() } else { format!(": {message}") }
}

fn toward(location: &str) -> String {
    if location.is_empty() { String::new() } else { format!(" to {location}") }
}
