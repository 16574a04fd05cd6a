//! Errors of a value that is to become a message, whether it comes as [`Value`](crate::Value), JSON or CBOR.

use crate::definition::Shape;
use crate::path;

/// Most values in one message; an array or a sequence of primitives is one.
pub const VALUES_MAX: usize = 4 << 20;
/// Most bytes that texts and elements of primitives take in one message: as many as a node carries in one.
pub const CONTENT_BYTES_MAX: usize = 64 << 20;
/// Most characters of foreign text that are shown.
const SHOWN_MAX: usize = 80;

/// A value that does not fit its type.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{}{problem}", shown(.path))]
pub struct ValueError {
    /// The path of the member that it is in, `pose.position.x`; empty for the message itself.
    pub path: String,
    /// The problem.
    pub problem: ValueProblem,
}

/// A problem with a value.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ValueProblem {
    /// Text that is no base64.
    #[error("the text is not base64")]
    Base64,
    /// More elements, bytes of a string or units of a wide one than its bound.
    #[error("{found} elements, and at most {bound} are allowed")]
    Bound {
        /// Their number.
        found: usize,
        /// The bound.
        bound: usize,
    },
    /// An array of another size.
    #[error("{found} elements, not {expected}")]
    Count {
        /// Number of elements found.
        found: usize,
        /// Number of elements of the array.
        expected: usize,
    },
    /// A member is missing, and the default of its definition cannot be read.
    #[error("it is left out, and its default cannot be read")]
    Default,
    /// A value of another kind than the type.
    #[error("{found}, not {expected}")]
    Kind {
        /// The value.
        found: String,
        /// The expected kind.
        expected: &'static str,
    },
    /// A number that the type does not have.
    #[error("{found} is not within the range of {expected}")]
    Range {
        /// The number.
        found: String,
        /// The type.
        expected: &'static str,
    },
    /// No JSON, or no CBOR, or another kind of value than the type.
    #[error("{0}")]
    Syntax(String),
    /// Half of a surrogate pair in a `string` that stands for no byte.
    #[error("the text has half of a surrogate pair in it")]
    Surrogate,
    /// Too much text, or too many elements.
    #[error("it takes more than {CONTENT_BYTES_MAX} bytes")]
    TooLarge,
    /// Too many values.
    #[error("it has more than {VALUES_MAX} values")]
    TooManyValues,
    /// A member twice.
    #[error("{0:?} is there twice")]
    Twice(String),
    /// A member that the type does not have.
    #[error("there is no member {0:?}")]
    Unknown(String),
}

fn shown(path: &str) -> String {
    if path.is_empty() { String::new() } else { format!("{path}: ") }
}

/// Returns the beginning of a foreign text.
pub(crate) fn short(text: &str) -> String {
    text.chars().take(SHOWN_MAX).collect()
}

impl From<ValueProblem> for ValueError {
    fn from(problem: ValueProblem) -> Self {
        Self { path: String::new(), problem }
    }
}

impl ValueError {
    pub(crate) fn under(mut self, member: &str) -> Self {
        path::under(&mut self.path, member);
        self
    }

    pub(crate) fn at(mut self, index: usize) -> Self {
        path::at(&mut self.path, index);
        self
    }
}

/// The remaining size of a message. Missing members count: a few bytes may stand for a large message.
#[derive(Debug)]
pub(crate) struct Budget {
    values: usize,
    bytes: usize,
}

impl Default for Budget {
    fn default() -> Self {
        Self { values: VALUES_MAX, bytes: CONTENT_BYTES_MAX }
    }
}

impl Budget {
    /// Takes one value.
    pub(crate) fn value(&mut self) -> Result<(), ValueProblem> {
        self.values = self.values.checked_sub(1).ok_or(ValueProblem::TooManyValues)?;
        Ok(())
    }

    /// Takes this many bytes.
    pub(crate) fn bytes(&mut self, bytes: usize) -> Result<(), ValueProblem> {
        self.bytes = self.bytes.checked_sub(bytes).ok_or(ValueProblem::TooLarge)?;
        Ok(())
    }
}

/// Checks that an array or a sequence has a permitted number of elements.
pub(crate) fn fits(shape: Shape, found: usize) -> Result<(), ValueProblem> {
    match shape {
        Shape::Array(expected) if found != expected as usize => {
            Err(ValueProblem::Count { found, expected: expected as usize })
        }
        Shape::Sequence { bound } => fits_bound(bound, found),
        _ => Ok(()),
    }
}

/// Checks that it may have one more element.
pub(crate) fn fits_one_more(shape: Shape, found: usize) -> Result<(), ValueProblem> {
    let most = match shape {
        Shape::One => return Ok(()),
        Shape::Array(count) => Some(count),
        Shape::Sequence { bound } => bound,
    };
    match (shape, fits_bound(most, found + 1)) {
        (Shape::Array(count), Err(_)) => {
            Err(ValueProblem::Count { found: found + 1, expected: count as usize })
        }
        (_, result) => result,
    }
}

/// Checks a bound.
pub(crate) fn fits_bound(bound: Option<u32>, found: usize) -> Result<(), ValueProblem> {
    let bound = bound.unwrap_or(u32::MAX) as usize;
    if found > bound { Err(ValueProblem::Bound { found, bound }) } else { Ok(()) }
}
