//! The definition of a message (the ROS 2 design article "Interface definition using .msg / .srv / .action files").

use std::fmt;
use std::str::FromStr;

/// Member of a message that has none, because IDL knows no empty structure.
pub const DUMMY_MEMBER: &str = "structure_needs_at_least_one_member";
/// Longest name of a type, bytes.
const TYPE_NAME_BYTES_MAX: usize = 255;

/// Name of a type: `std_msgs/msg/String`, `std_srvs/srv/SetBool_Request`.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TypeName {
    package: String,
    kind: &'static str,
    name: String,
}

/// A text that is no name of a type.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} is not a ROS type: \"std_msgs/msg/String\" is one")]
pub struct TypeNameError(String);

impl TypeName {
    /// Returns the name of a type; `None` if a part of it is not an identifier or `kind` is none of `msg`, `srv`,
    /// `action`.
    pub fn new(package: &str, kind: &str, name: &str) -> Option<Self> {
        let kind = ["msg", "srv", "action"].into_iter().find(|k| *k == kind)?;
        let fits = package.len() + name.len() < TYPE_NAME_BYTES_MAX - 8;
        (fits && is_identifier(package) && is_identifier(name)).then(|| Self {
            package: package.to_owned(),
            kind,
            name: name.to_owned(),
        })
    }

    /// Returns the package.
    pub fn package(&self) -> &str {
        &self.package
    }

    /// Returns `"msg"`, `"srv"` or `"action"`.
    pub fn kind(&self) -> &'static str {
        self.kind
    }

    /// Returns the name within the package.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the name of the file that defines it, without its extension: that of `SetBool_Request` is `SetBool`.
    pub fn file_stem(&self) -> &str {
        let suffixes: &[&str] = match self.kind {
            "srv" => &["_Request", "_Response", "_Event"],
            "action" => &[
                "_SendGoal_Request",
                "_SendGoal_Response",
                "_SendGoal_Event",
                "_SendGoal",
                "_GetResult_Request",
                "_GetResult_Response",
                "_GetResult_Event",
                "_GetResult",
                "_FeedbackMessage",
                "_Goal",
                "_Result",
                "_Feedback",
            ],
            _ => &[],
        };
        suffixes.iter().find_map(|suffix| self.name.strip_suffix(suffix)).unwrap_or(&self.name)
    }
}

/// The messages of a service.
impl TypeName {
    /// Returns the request: `std_srvs/srv/SetBool_Request` of `std_srvs/srv/SetBool`.
    pub fn request(&self) -> Self {
        self.with("_Request")
    }

    /// Returns the response.
    pub fn response(&self) -> Self {
        self.with("_Response")
    }

    /// Returns the event message of both, for introspection (REP 2012).
    pub(crate) fn event(&self) -> Self {
        self.with("_Event")
    }

    /// Returns the service of this message, if it is a service's.
    pub fn service(&self) -> Option<Self> {
        let suffixes = ["_Request", "_Response", "_Event"].iter();
        let name = suffixes.filter(|_| self.kind != "msg").find_map(|s| self.name.strip_suffix(s))?;
        Some(Self { name: name.to_owned(), ..self.clone() })
    }

    fn with(&self, suffix: &str) -> Self {
        Self { name: format!("{}{suffix}", self.name), ..self.clone() }
    }
}

impl FromStr for TypeName {
    type Err = TypeNameError;

    fn from_str(text: &str) -> Result<Self, TypeNameError> {
        let shown = || TypeNameError(text.chars().take(TYPE_NAME_BYTES_MAX).collect());
        let mut parts = text.split('/');
        match (parts.next(), parts.next(), parts.next(), parts.next()) {
            (Some(package), Some(kind), Some(name), None) => Self::new(package, kind, name).ok_or_else(shown),
            // As the tools of ROS 2 accept it.
            (Some(package), Some(name), None, None) => Self::new(package, "msg", name).ok_or_else(shown),
            _ => Err(shown()),
        }
    }
}

impl fmt::Display for TypeName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}/{}", self.package, self.kind, self.name)
    }
}

pub(crate) fn is_identifier(text: &str) -> bool {
    let mut bytes = text.bytes();
    bytes.next().is_some_and(|b| b.is_ascii_alphabetic())
        && bytes.all(|b| b.is_ascii_alphanumeric() || b == b'_')
}

/// A type of fixed size.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Primitive {
    /// `bool`.
    Bool,
    /// `byte`, an octet.
    Byte,
    /// `float32`.
    Float32,
    /// `float64`.
    Float64,
    /// `int8`.
    Int8,
    /// `int16`.
    Int16,
    /// `int32`.
    Int32,
    /// `int64`.
    Int64,
    /// `uint8`, and `char`, which ROS 2 takes for the same.
    Uint8,
    /// `uint16`.
    Uint16,
    /// `uint32`.
    Uint32,
    /// `uint64`.
    Uint64,
}

impl Primitive {
    /// Returns its serialised size, which is also its alignment in version 1.
    pub fn bytes(self) -> usize {
        match self {
            Self::Bool | Self::Byte | Self::Int8 | Self::Uint8 => 1,
            Self::Int16 | Self::Uint16 => 2,
            Self::Float32 | Self::Int32 | Self::Uint32 => 4,
            Self::Float64 | Self::Int64 | Self::Uint64 => 8,
        }
    }

    /// Returns the spelling in definitions: `float64`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Bool => "bool",
            Self::Byte => "byte",
            Self::Float32 => "float32",
            Self::Float64 => "float64",
            Self::Int8 => "int8",
            Self::Int16 => "int16",
            Self::Int32 => "int32",
            Self::Int64 => "int64",
            Self::Uint8 => "uint8",
            Self::Uint16 => "uint16",
            Self::Uint32 => "uint32",
            Self::Uint64 => "uint64",
        }
    }

    pub(crate) fn parse(text: &str) -> Option<Self> {
        Some(match text {
            "bool" => Self::Bool,
            "byte" => Self::Byte,
            "char" | "uint8" => Self::Uint8,
            "float32" => Self::Float32,
            "float64" => Self::Float64,
            "int8" => Self::Int8,
            "int16" => Self::Int16,
            "int32" => Self::Int32,
            "int64" => Self::Int64,
            "uint16" => Self::Uint16,
            "uint32" => Self::Uint32,
            "uint64" => Self::Uint64,
            _ => return None,
        })
    }
}

/// Type of one element of a member.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Base {
    /// A type of fixed size.
    Primitive(Primitive),
    /// Text in UTF-8.
    String {
        /// Most bytes.
        bound: Option<u32>,
    },
    /// Text in UTF-16.
    WString {
        /// Most units.
        bound: Option<u32>,
    },
    /// Another message.
    Message(TypeName),
}

/// Number of elements of a member.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Shape {
    /// One.
    One,
    /// A fixed number.
    Array(u32),
    /// Any number, up to a bound if there is one.
    Sequence {
        /// The bound.
        bound: Option<u32>,
    },
}

/// Type of a member.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FieldType {
    /// Type of one element.
    pub base: Base,
    /// Number of elements.
    pub shape: Shape,
}

/// A member of a message.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Field {
    /// Its name.
    pub name: String,
    /// Its type.
    pub field_type: FieldType,
    /// Its default, as the definition spells it.
    pub default: Option<String>,
}

/// A constant.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Constant {
    /// Its name.
    pub name: String,
    /// Its type: a primitive or a string.
    pub base: Base,
    /// Its value, as the definition spells it.
    pub value: String,
}

/// A message.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Definition {
    /// Its name.
    pub name: TypeName,
    /// Its members in order, at least one: see [`DUMMY_MEMBER`].
    pub fields: Vec<Field>,
    /// Its constants in order.
    pub constants: Vec<Constant>,
}
