//! Jobs that find types: they search local files, or verify the description of an owner, on a blocking thread.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

use sgc_cdr::{DescriptionError, TypeError, TypeName};
use sgc_endpoint::{CompressionError, PackedType, unpack_type};
use sgc_types::{Definitions, ResolveError, ResolvedType, StoreFull, TypeStore};
use sgc_wire::{DescribedType, Name, NodeId};

use crate::drops::NodeDrop;

/// A job for the blocking thread.
pub(crate) struct Job {
    pub(crate) name: Name,
    pub(crate) type_name: TypeName,
    pub(crate) type_hash: Option<String>,
    pub(crate) owner: Option<NodeId>,
    /// Description from an owner; without it, the job searches files.
    pub(crate) told: Option<DescribedType>,
}

/// A known type, with its packed description for other nodes.
pub(crate) struct TypeEntry {
    pub(crate) described: FoundType,
    pub(crate) packed: Option<PackedType>,
}

/// A type that was found.
pub(crate) enum FoundType {
    /// It is from the store.
    Stored(Arc<ResolvedType>),
    /// It is not stored yet.
    New(ResolvedType),
}

impl FoundType {
    /// Returns the type.
    fn resolved(&self) -> &ResolvedType {
        match self {
            Self::Stored(known) => known,
            Self::New(new) => new,
        }
    }
}

/// Result of a job.
pub(crate) struct TypeOutcome {
    pub(crate) of: TypeQuery,
    pub(crate) found: Result<TypeEntry, TypeMiss>,
}

/// The subject of a job.
pub(crate) struct TypeQuery {
    pub(crate) name: Name,
    pub(crate) type_name: TypeName,
    pub(crate) type_hash: Option<String>,
    pub(crate) owner: Option<NodeId>,
    /// Size of the owner's description, if there was one.
    pub(crate) told_bytes: Option<usize>,
}

/// Reasons why a type is unknown.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum TypeMiss {
    /// No file defines it, or a definition is invalid.
    #[error(transparent)]
    Definition(#[from] TypeError),
    /// The type is too large to be described.
    #[error(transparent)]
    Description(#[from] DescriptionError),
    /// The local definition differs from the announced one.
    #[error("the definition that was found is {found}, what is announced {announced}")]
    Differs {
        /// Hash of the local definition.
        found: String,
        /// Announced hash.
        announced: String,
    },
    /// The owner's description cannot be unpacked.
    #[error("the description cannot be unpacked: {0}")]
    Packed(#[from] CompressionError),
    /// The owner's description does not match its hash.
    #[error(transparent)]
    ResolveError(#[from] ResolveError),
    /// The store is full.
    #[error(transparent)]
    Full(#[from] StoreFull),
    /// The owner's limit is reached.
    #[error(
        "{types} types with {bytes} bytes of descriptions are known of its owner already: it may have no more"
    )]
    OwnerFull {
        /// Number of the owner's types.
        types: usize,
        /// Bytes of their descriptions.
        bytes: usize,
    },
    /// The job panicked.
    #[error("looking for it failed, which is a fault in this program")]
    Failed,
}

impl TypeMiss {
    /// Returns the counter; `None` if it is no fault.
    pub(crate) fn counter(&self) -> Option<NodeDrop> {
        match self {
            Self::Definition(_) => None,
            Self::Description(_) => Some(NodeDrop::TypeNotDescribed),
            Self::Differs { .. } => Some(NodeDrop::TypeDiffers),
            Self::Packed(_) | Self::ResolveError(_) => Some(NodeDrop::TypeRefused),
            Self::Full(_) | Self::OwnerFull { .. } => Some(NodeDrop::TypesFull),
            Self::Failed => Some(NodeDrop::TypeFailed),
        }
    }
}

impl Job {
    /// Returns the size of the owner's description, if there is one.
    pub(crate) fn told_bytes(&self) -> Option<usize> {
        Some(self.told.as_ref()?.description.len())
    }

    /// Searches the store or files, or verifies the owner's description.
    pub(crate) fn run(self, store: &TypeStore, definitions: &Definitions) -> TypeOutcome {
        let told_bytes = self.told_bytes();
        let Self { name, type_name, type_hash, owner, told } = self;
        let of = TypeQuery { name, type_name, type_hash, owner, told_bytes };
        let (type_name, type_hash) = (of.type_name.clone(), of.type_hash.clone());
        of.found_by(move || match told {
            Some(told) => read(&type_name, type_hash.as_deref(), &told),
            None => find(&type_name, type_hash.as_deref(), store, definitions),
        })
    }
}

impl TypeQuery {
    /// Turns the search into a result. A panic yields a result too, since other jobs wait for their turn.
    pub(crate) fn found_by(self, look: impl FnOnce() -> Result<FoundType, TypeMiss>) -> TypeOutcome {
        let look = || {
            let described = look()?;
            let of = described.resolved();
            Ok(TypeEntry { packed: PackedType::new(of.type_hash(), of.description()), described })
        };
        let found = catch_unwind(AssertUnwindSafe(look)).unwrap_or(Err(TypeMiss::Failed));
        TypeOutcome { of: self, found }
    }
}

fn find(
    type_name: &TypeName,
    type_hash: Option<&str>,
    store: &TypeStore,
    definitions: &Definitions,
) -> Result<FoundType, TypeMiss> {
    // A type of this name from another owner may differ, so the hash must match.
    if let Some(known) = type_hash.and_then(|hash| store.described(type_name, Some(hash))) {
        return Ok(FoundType::Stored(known));
    }
    let described = ResolvedType::from_layout(definitions.layout(type_name)?)?;
    match type_hash {
        Some(announced) if !described.is_announced_as(announced) => Err(TypeMiss::Differs {
            found: described.type_hash().to_owned(),
            announced: announced.to_owned(),
        }),
        _ => Ok(FoundType::New(described)),
    }
}

fn read(type_name: &TypeName, type_hash: Option<&str>, told: &DescribedType) -> Result<FoundType, TypeMiss> {
    // Without an announced hash, the owner vouches for its description. The same holds for services, for which only the
    // hashes of messages may be announced.
    let expected = type_hash.filter(|_| type_name.kind() == "msg").unwrap_or(&told.type_hash);
    let described = ResolvedType::read(unpack_type(told)?, type_name, expected)?;
    if let Some(expected) = type_hash.filter(|announced| !described.is_announced_as(announced)) {
        let (found, expected) = (described.type_hash().to_owned(), expected.to_owned());
        return Err(ResolveError::Description(DescriptionError::Hash { found, expected }).into());
    }
    Ok(FoundType::New(described))
}
