//! The errors of a demo.

use std::path::PathBuf;

use sgc_diagnosis::DiagnosisError;
use sgc_process::ProcessError;
use sgc_trust::{FleetError, LabelError};

/// An error that ends a demo.
#[derive(Debug, thiserror::Error)]
pub enum DemoError {
    /// The demo cannot go on.
    #[error("demo: {reason}")]
    Failed {
        /// The cause, with the culprit.
        reason: String,
        /// Further facts, printed below the error.
        facts: Vec<String>,
    },
    /// A fleet that cannot be made.
    #[error("{}: {source}", path.display())]
    Fleet {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: FleetError,
    },
    /// A text that is no name of a node or fleet.
    #[error(transparent)]
    Label(#[from] LabelError),
    /// A node that cannot be asked, or a name that cannot be derived.
    #[error(transparent)]
    Diagnosis(#[from] DiagnosisError),
    /// A process or a file.
    #[error(transparent)]
    Process(#[from] ProcessError),
}
