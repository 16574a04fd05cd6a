//! The errors of a measurement.

use sgc_diagnosis::DiagnosisError;
use sgc_node::NodeError;
use sgc_node::config::ConfigErrors;
use sgc_process::ProcessError;

/// An error that ends a measurement.
#[derive(Debug, thiserror::Error)]
pub enum MeasureError {
    /// A measurement between two machines cannot begin or continue.
    #[error("bench: {reason}")]
    Failed {
        /// The cause, with the culprit and the remedy.
        reason: String,
        /// Further facts, printed below the error.
        facts: Vec<String>,
    },
    /// A request that cannot be right.
    #[error("{reason}")]
    Cannot {
        /// The cause, with the remedy.
        reason: String,
    },
    /// Mistakes in the arguments, by the rules of a configuration.
    #[error("{}", errors.iter().map(|e| e.mistake.to_string()).collect::<Vec<_>>().join("; "))]
    Arguments {
        /// The mistakes.
        errors: ConfigErrors,
    },
    /// A configuration whose identity cannot be used.
    #[error("{what}: {source}")]
    CheckIdentity {
        /// The identity file.
        what: String,
        /// The cause.
        source: NodeError,
    },
    /// An identity that cannot be loaded.
    #[error(transparent)]
    Node(#[from] NodeError),
    /// A node that cannot be asked.
    #[error(transparent)]
    Diagnosis(#[from] DiagnosisError),
    /// A process or a file.
    #[error(transparent)]
    Process(#[from] ProcessError),
}

/// Returns an error with this reason, in one line.
pub(crate) fn failed(reason: impl Into<String>) -> MeasureError {
    MeasureError::Failed { reason: reason.into(), facts: Vec::new() }
}
