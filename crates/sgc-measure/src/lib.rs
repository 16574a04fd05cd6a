//! The measuring peers of `sgc bench`: throughput and latency between two machines of one fleet, through `sgc` and
//! through the bare network.
//!
//! One side answers, the other measures. Both run a node with an ordinary identity and a DDS program in a private
//! domain, as `sgc-demo` does. So the measurement covers the whole path: DDS, node, network, node, DDS, and back. The
//! sides talk over topics that `sgc` carries, so they hear no other program. `sgc` parses the arguments.

mod answer;
mod echo;
mod error;
mod event;
mod machine;
mod measure;
mod program;
mod report;
mod side;
mod words;

pub use answer::{AnswerOptions, answer};
pub use error::MeasureError;
pub use measure::{MeasureOptions, measure};
pub use words::Size;
