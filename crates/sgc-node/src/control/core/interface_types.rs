//! [`InterfaceTypes`]: searches for the types of shared and used interfaces, in local files or at the owners of used
//! interfaces, and answers nodes that ask.
//!
//! Jobs read files and verify descriptions one after the other on a blocking thread. Known types go into the store,
//! which the whole process shares, and to the ends of the interface that convert messages.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::Instant;

use sgc_cdr::{DescriptionError, TypeError, TypeName};
use sgc_endpoint::{CompressionError, PackedType, unpack_type};
use sgc_ros::RosNetwork;
use sgc_types::{
    Definitions, ResolveError, ResolvedType, StoreFull, TYPES_BYTES_MAX, TYPES_MAX,
    TYPES_PER_OWNER_BYTES_MAX, TYPES_PER_OWNER_MAX, TypeStore,
};
use sgc_wire::{CatalogueEntry, DescribedType, Metadata, Name, NodeId};
use tracing::{debug, warn};

use super::Core;
use crate::clock::now;
use crate::control::event::CoreEvent;
use crate::data::conversion::KnownType;
use crate::local::type_questions::TypeQuestions;

/// Types that are tried again when room returns.
const RETRIES_MAX: usize = 16;

/// The types of the interfaces that this node shares and uses.
pub(super) struct InterfaceTypes {
    store: Arc<TypeStore>,
    definitions: Arc<Definitions>,
    needs: BTreeMap<Name, Need>,
    /// Pending jobs, at most one for each need.
    jobs: VecDeque<Job>,
    is_busy: bool,
    questions: TypeQuestions,
    /// Needs without room, in the order in which they are tried again.
    no_room: VecDeque<Name>,
}

/// Search for the type of one interface.
struct Need {
    type_name: TypeName,
    /// Announced type hash.
    type_hash: Option<String>,
    /// Owner, if it is another node.
    owner: Option<NodeId>,
    state: NeedState,
}

enum NeedState {
    /// A job searches local files.
    Looking,
    /// The owner is asked.
    Asked,
    /// The owner's description is being verified.
    Told,
    /// The type is known.
    Known(Arc<ResolvedType>),
    /// The store has no room for the type.
    NoRoom {
        /// Whether the owner's own limit is reached.
        of_owner: bool,
    },
    /// The owner's description does not match its hash.
    Refused,
    /// The type is unknown, and no owner is asked for it.
    Unknown,
}

impl Need {
    fn known(&self) -> Option<&Arc<ResolvedType>> {
        match &self.state {
            NeedState::Known(described) => Some(described),
            _ => None,
        }
    }
}

/// A job for the blocking thread.
struct Job {
    name: Name,
    type_name: TypeName,
    type_hash: Option<String>,
    owner: Option<NodeId>,
    /// Description from an owner; without it, the job searches files.
    told: Option<DescribedType>,
}

/// A known type, with its packed description for other nodes.
struct TypeEntry {
    described: StoredOrNewType,
    packed: Option<PackedType>,
}

/// A type from the store (`Ok`), or one that is not stored yet (`Err`).
type StoredOrNewType = Result<Arc<ResolvedType>, ResolvedType>;

/// Result of a job.
pub(crate) struct TypeOutcome {
    of: TypeQuery,
    found: Result<TypeEntry, TypeMiss>,
}

/// The subject of a job.
struct TypeQuery {
    name: Name,
    type_name: TypeName,
    type_hash: Option<String>,
    owner: Option<NodeId>,
    /// Size of the owner's description, if there was one.
    told_bytes: Option<usize>,
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
    /// Returns a short, stable name for counters; `None` if it is no fault.
    fn key(&self) -> Option<&'static str> {
        match self {
            Self::Definition(_) => None,
            Self::Description(_) => Some("type_not_described"),
            Self::Differs { .. } => Some("type_differs"),
            Self::Packed(_) | Self::ResolveError(_) => Some("type_refused"),
            Self::Full(_) | Self::OwnerFull { .. } => Some("types_full"),
            Self::Failed => Some("type_failed"),
        }
    }

    /// Returns the state of the need after this result.
    fn state(&self, asks: bool) -> NeedState {
        match self {
            Self::Full(_) => NeedState::NoRoom { of_owner: false },
            Self::OwnerFull { .. } => NeedState::NoRoom { of_owner: true },
            _ if asks => NeedState::Asked,
            Self::Packed(_) | Self::ResolveError(_) => NeedState::Refused,
            _ => NeedState::Unknown,
        }
    }
}

impl InterfaceTypes {
    pub(super) fn new(store: Arc<TypeStore>, definitions: Definitions) -> Self {
        Self {
            store,
            definitions: Arc::new(definitions),
            needs: BTreeMap::new(),
            jobs: VecDeque::new(),
            is_busy: false,
            questions: TypeQuestions::default(),
            no_room: VecDeque::new(),
        }
    }

    /// Returns the type of an interface, or else the stored type with this name and hash.
    pub(super) fn described(
        &self,
        name: Option<&Name>,
        type_name: &str,
        type_hash: Option<&str>,
    ) -> Option<Arc<ResolvedType>> {
        if let Some(described) = name.and_then(|name| self.needs.get(name)?.known()) {
            return Some(described.clone());
        }
        self.store.described(&type_name.parse().ok()?, type_hash)
    }

    /// Returns the time at which an owner is to be asked for further types.
    pub(super) fn deadline(&self) -> Option<Instant> {
        self.questions.deadline()
    }

    /// Returns the problems to report. `called` returns the name of an owner.
    pub(super) fn problems(&self, called: impl Fn(&NodeId) -> String) -> Vec<String> {
        let count = |of: fn(&NeedState) -> bool| {
            let mut all = self.needs.values().filter(|need| of(&need.state)).peekable();
            let first = all.peek().map(|need| {
                let whose = need.owner.map(|owner| format!(" of {}", called(&owner))).unwrap_or_default();
                format!("{}{whose}", need.type_name)
            });
            first.map(|first| (all.count(), first))
        };
        let full = count(|state| matches!(state, NeedState::NoRoom { of_owner: false })).map(|(n, first)| {
            format!(
                "{n} interfaces have types for which there is no room, {first} for one: this node keeps {TYPES_MAX} \
                 types, and {TYPES_BYTES_MAX} bytes that describe them. It looks again when others are not used any more"
            )
        });
        let of_owner = count(|state| matches!(state, NeedState::NoRoom { of_owner: true })).map(|(n, first)| {
            format!(
                "{n} interfaces have types for which there is no room, {first} for one: of one node this one keeps \
                 {TYPES_PER_OWNER_MAX} types, and {TYPES_PER_OWNER_BYTES_MAX} bytes that describe them. It asks again when \
                 others are not used any more"
            )
        });
        let refused = count(|state| matches!(state, NeedState::Refused)).map(|(n, first)| {
            format!(
                "what {n} interfaces look like was told and is refused, {first} for one: the description is not what its \
                 hash says. Have the node that told it run with the definitions that its publishers are built from"
            )
        });
        full.into_iter().chain(of_owner).chain(refused).collect()
    }
}

/// Storing of types.
impl InterfaceTypes {
    /// Stores a type, charged to `owner` if the interface belongs to another node. Unused types make room.
    fn keep(
        &self,
        described: StoredOrNewType,
        owner: Option<&NodeId>,
    ) -> Result<Arc<ResolvedType>, TypeMiss> {
        let new = match described {
            Ok(known) => return Ok(known),
            Err(new) => new,
        };
        if let Some(known) = self.store.described(new.name(), Some(new.type_hash())) {
            return Ok(known);
        }
        if let Some(owner) = owner {
            let of_owner = self.needs.values().filter(|need| need.owner.as_ref() == Some(owner));
            let known = of_owner.filter_map(Need::known);
            let known: BTreeMap<_, _> =
                known.map(|known| ((known.name(), known.type_hash()), known.description().len())).collect();
            let (types, bytes) = (known.len(), known.values().sum::<usize>());
            if types >= TYPES_PER_OWNER_MAX || bytes + new.description().len() > TYPES_PER_OWNER_BYTES_MAX {
                return Err(TypeMiss::OwnerFull { types, bytes });
            }
        }
        if !self.store.has_room_for(&new) {
            let known = self.needs.values().filter_map(Need::known);
            let known: BTreeSet<_> = known.map(|known| (known.name(), known.type_hash())).collect();
            self.store.retain(|type_name, type_hash| known.contains(&(type_name, type_hash)));
        }
        Ok(self.store.insert(new)?)
    }

    /// Retries the needs that lack room, after an interface dropped this type.
    fn room_returns(&mut self, gone: &ResolvedType, owner: Option<NodeId>) {
        let is_it =
            |known: &Arc<ResolvedType>| (known.name(), known.type_hash()) == (gone.name(), gone.type_hash());
        if self.no_room.is_empty() || self.needs.values().filter_map(Need::known).any(is_it) {
            return;
        }
        let mut retried = 0;
        for _ in 0..self.no_room.len() {
            let Some(name) = self.no_room.pop_front() else { break };
            let state = self.needs.get(&name).map(|need| (&need.state, need.owner));
            let may = match state {
                Some((NeedState::NoRoom { of_owner: true }, whose)) => whose == owner,
                Some((NeedState::NoRoom { of_owner: false }, _)) => true,
                // This need has found room, or has ended.
                _ => continue,
            };
            if may && retried < RETRIES_MAX {
                retried += 1;
                self.look_for(name);
            } else {
                self.no_room.push_back(name);
            }
        }
    }

    /// Starts the search for the type of a need.
    fn look_for(&mut self, name: Name) {
        let Some(need) = self.needs.get_mut(&name) else { return };
        need.state = NeedState::Looking;
        let Need { type_name, type_hash, owner, .. } = need;
        let (type_name, type_hash, owner) = (type_name.clone(), type_hash.clone(), *owner);
        if let Some(owner) = owner {
            self.questions.begins(owner);
        }
        self.jobs.push_back(Job { name, type_name, type_hash, owner, told: None });
    }

    /// Returns the interfaces for which the owner now lists another type.
    fn listed_otherwise<'a>(
        &self,
        owner: &NodeId,
        listed: impl Fn(&Name) -> Option<&'a CatalogueEntry>,
    ) -> Vec<Name> {
        let differs = |(name, need): &(&Name, &Need)| {
            need.owner.as_ref() == Some(owner)
                && listed(name).is_some_and(|entry| {
                    need.type_hash != entry.type_hash
                        || need.type_name.to_string() != entry.metadata.type_name
                })
        };
        self.needs.iter().filter(differs).map(|(name, _)| *name).collect()
    }

    /// Removes a need. Returns its owner.
    fn forget(&mut self, name: &Name) -> Option<NodeId> {
        let need = self.needs.remove(name)?;
        if let Some(owner) = &need.owner {
            self.questions.settled(owner, name);
        }
        self.jobs.retain(|job| {
            if job.name != *name {
                return true;
            }
            if let Some(owner) = &job.owner {
                self.questions.ends(owner, job.told_bytes().unwrap_or_default());
            }
            false
        });
        if let NeedState::NoRoom { .. } = need.state {
            self.no_room.retain(|other| other != name);
        }
        if let Some(gone) = need.known() {
            self.room_returns(gone, need.owner);
        }
        need.owner
    }

    /// Returns `true` if types of this node's own interfaces are still being searched.
    fn has_own_jobs(&self) -> bool {
        self.jobs.iter().any(|job| job.owner.is_none())
    }

    /// Ends a job. Returns whether its need still waits for it.
    fn ends(&mut self, of: &TypeQuery) -> bool {
        if let Some(owner) = &of.owner {
            self.questions.ends(owner, of.told_bytes.unwrap_or_default());
        }
        let Some(need) = self.needs.get(&of.name) else { return false };
        let is_it =
            (&need.type_name, &need.type_hash, need.owner) == (&of.type_name, &of.type_hash, of.owner);
        let awaited = match need.state {
            NeedState::Looking => of.told_bytes.is_none(),
            NeedState::Told => of.told_bytes.is_some(),
            _ => false,
        };
        is_it && awaited
    }
}

impl Job {
    fn told_bytes(&self) -> Option<usize> {
        Some(self.told.as_ref()?.description.len())
    }

    /// Searches the store or files, or verifies the owner's description.
    fn run(self, store: &TypeStore, definitions: &Definitions) -> TypeOutcome {
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
    fn found_by(self, look: impl FnOnce() -> Result<StoredOrNewType, TypeMiss>) -> TypeOutcome {
        let look = || {
            let described = look()?;
            let of: &ResolvedType = match &described {
                Ok(known) => known,
                Err(new) => new,
            };
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
) -> Result<StoredOrNewType, TypeMiss> {
    // A type of this name from another owner may differ, so the hash must match.
    if let Some(known) = type_hash.and_then(|hash| store.described(type_name, Some(hash))) {
        return Ok(Ok(known));
    }
    let described = ResolvedType::from_layout(definitions.layout(type_name)?)?;
    match type_hash {
        Some(announced) if !described.is_announced_as(announced) => Err(TypeMiss::Differs {
            found: described.type_hash().to_owned(),
            announced: announced.to_owned(),
        }),
        _ => Ok(Err(described)),
    }
}

fn read(
    type_name: &TypeName,
    type_hash: Option<&str>,
    told: &DescribedType,
) -> Result<StoredOrNewType, TypeMiss> {
    // Without an announced hash, the owner vouches for its description. The same holds for services, for which only the
    // hashes of messages may be announced.
    let expected = type_hash.filter(|_| type_name.kind() == "msg").unwrap_or(&told.type_hash);
    let described = ResolvedType::read(unpack_type(told)?, type_name, expected)?;
    if let Some(expected) = type_hash.filter(|announced| !described.is_announced_as(announced)) {
        let (found, expected) = (described.type_hash().to_owned(), expected.to_owned());
        return Err(ResolveError::Description(DescriptionError::Hash { found, expected }).into());
    }
    Ok(Err(described))
}

impl<N: RosNetwork> Core<N> {
    /// Starts the search for the type of an interface, of this node or of another.
    pub(super) fn need_type(
        &mut self,
        name: Name,
        metadata: &Metadata,
        type_hash: Option<String>,
        owner: Option<NodeId>,
    ) {
        let type_name = metadata.type_name.parse::<TypeName>();
        let is_same = |need: &Need| {
            need.type_hash == type_hash
                && need.owner == owner
                && type_name.as_ref().is_ok_and(|type_name| need.type_name == *type_name)
        };
        if self.types.needs.get(&name).is_some_and(is_same) {
            return self.apply_type(&name);
        }
        self.forget_type(&name);
        let Ok(type_name) = type_name else {
            // Plain DDS programs use type names that are not of ROS.
            return self.set_type(&name, &KnownType::Lacking);
        };
        self.types.needs.insert(name, Need { type_name, type_hash, owner, state: NeedState::Looking });
        self.types.look_for(name);
        self.apply_type(&name);
        self.next_type_job();
    }

    /// Starts the search for the type of a granted interface of another node.
    pub(super) fn need_type_of_used(&mut self, name: Name) {
        let Some((owner, entry)) = self.routes.as_ref().and_then(|routes| routes.used_entry(&name)) else {
            return;
        };
        let (metadata, type_hash) = (entry.metadata.clone(), entry.type_hash.clone());
        self.need_type(name, &metadata, type_hash, Some(owner));
    }

    /// Handles a changed catalogue, which may list other types.
    pub(super) fn types_listed(&mut self, owner: NodeId) {
        let Some(routes) = &self.routes else { return };
        let listed = |name: &Name| routes.used_entry(name).map(|(_, entry)| entry);
        for name in self.types.listed_otherwise(&owner, listed) {
            self.need_type_of_used(name);
        }
    }

    /// Ends the search, because the interface is gone.
    pub(super) fn forget_type(&mut self, name: &Name) {
        if let Some(owner) = self.types.forget(name) {
            self.ask_types(owner);
        }
        self.next_type_job();
    }

    /// Handles type descriptions from an owner.
    pub(super) fn types_told(&mut self, owner: NodeId, types: Vec<DescribedType>) {
        self.types.questions.answered(&owner);
        for told in types {
            let Some(need) = self.types.needs.get_mut(&told.name) else { continue };
            if need.owner != Some(owner) || !matches!(need.state, NeedState::Asked) {
                continue;
            }
            if !self.types.questions.takes_told(&owner, told.description.len()) {
                self.control_drops.count("types_busy");
                continue;
            }
            need.state = NeedState::Told;
            let (type_name, type_hash) = (need.type_name.clone(), need.type_hash.clone());
            let (name, owner) = (told.name, need.owner);
            self.types.jobs.push_back(Job { name, type_name, type_hash, owner, told: Some(told) });
        }
        self.ask_types(owner);
        self.next_type_job();
    }

    fn next_type_job(&mut self) {
        let Some(events) = self.events.upgrade() else { return };
        if self.types.is_busy {
            return;
        }
        let Some(job) = self.types.jobs.pop_front() else { return };
        self.types.is_busy = true;
        let (store, definitions) = (self.types.store.clone(), self.types.definitions.clone());
        let alive = self.alive.clone();
        tokio::task::spawn_blocking(move || {
            let _alive = alive;
            let _ = events.blocking_send(CoreEvent::TypeLookedFor(job.run(&store, &definitions)));
        });
    }

    /// Handles the result of a job.
    pub(super) fn type_looked_for(&mut self, outcome: TypeOutcome) {
        self.types.is_busy = false;
        let TypeOutcome { of, found } = outcome;
        if self.types.ends(&of) {
            self.settle_need(&of, found);
        }
        match of.owner {
            Some(owner) => self.ask_types(owner),
            // Types that become known together are sent together.
            None if !self.types.has_own_jobs() => self.endpoint.tell_types(now()),
            None => {}
        }
        for owner in self.types.questions.have_room() {
            self.ask_types(owner);
        }
        self.next_type_job();
    }

    fn settle_need(&mut self, of: &TypeQuery, found: Result<TypeEntry, TypeMiss>) {
        let (name, owner, was_told) = (of.name, of.owner, of.told_bytes.is_some());
        let found =
            found.and_then(|found| Ok((self.types.keep(found.described, owner.as_ref())?, found.packed)));
        let state = match found {
            Ok((described, packed)) => {
                debug!(name = %name.short(), type_name = %described.name(), hash = described.type_hash(), "type known");
                if let (None, Some(packed)) = (owner, packed) {
                    self.endpoint.describe(now(), &name, packed);
                }
                NeedState::Known(described)
            }
            Err(why) => {
                debug!(name = %name.short(), %why, "type not known");
                if let Some(key) = why.key()
                    && self.control_drops.count(key)
                    && (was_told || why == TypeMiss::Failed)
                {
                    warn!(%why, "a description of a type is refused; counted from here on");
                }
                why.state(owner.is_some() && !was_told)
            }
        };
        let Some(need) = self.types.needs.get_mut(&name) else { return };
        need.state = state;
        match (&need.state, owner) {
            (NeedState::Asked, Some(owner)) => self.types.questions.lacks(owner, name),
            (_, Some(owner)) => self.types.questions.settled(&owner, &name),
            (_, None) => {}
        }
        if matches!(need.state, NeedState::NoRoom { .. }) {
            self.types.no_room.push_back(name);
        }
        self.apply_type(&name);
    }

    /// Asks for further types, because their turn has come.
    pub(super) fn types_due(&mut self, now: Instant) {
        for owner in self.types.questions.due(now) {
            self.ask_types(owner);
        }
    }

    /// Asks an owner for its unknown types, unless it was asked already.
    fn ask_types(&mut self, owner: NodeId) {
        let now = now();
        if let Some(names) = self.types.questions.next(owner, now.instant) {
            self.endpoint.ask_types(now, owner, names);
        }
    }

    /// Passes the state of a type to both ends of its interface.
    pub(super) fn apply_type(&self, name: &Name) {
        let Some(need) = self.types.needs.get(name) else {
            // The name is not of ROS, so no search starts and no message waits.
            return self.set_type(name, &KnownType::Lacking);
        };
        let known = match &need.state {
            NeedState::Looking => KnownType::Awaited,
            NeedState::Asked | NeedState::Told => KnownType::Asked,
            NeedState::Known(described) => KnownType::Known(described.layout().clone()),
            NeedState::NoRoom { .. } | NeedState::Refused | NeedState::Unknown => KnownType::Lacking,
        };
        self.set_type(name, &known);
    }

    fn set_type(&self, name: &Name, known: &KnownType) {
        if let Some(share) = self.shares.get(name) {
            share.set_type(known.clone());
        }
        if let Some(sink) = self.sinks.get(name) {
            sink.set_type(known.clone(), &self.data);
        }
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;
    use sgc_wire::PayloadEncoding;

    use super::*;

    const TWIST: &str = "geometry_msgs/msg/Twist";

    fn job(type_name: &str, type_hash: Option<&str>, told: Option<DescribedType>) -> Job {
        let type_name = type_name.parse().unwrap();
        let type_hash = type_hash.map(str::to_owned);
        Job { name: Name([1; 32]), type_name, type_hash, owner: None, told }
    }

    fn run(job: Job) -> Result<ResolvedType, TypeMiss> {
        let outcome = job.run(&TypeStore::default(), &Definitions::default());
        outcome.found.map(|found| found.described.expect_err("the store is empty"))
    }

    fn twist() -> ResolvedType {
        run(job(TWIST, None, None)).unwrap()
    }

    fn told(type_hash: &str, encoding: PayloadEncoding, description: &Bytes) -> DescribedType {
        let (type_hash, description) = (type_hash.to_owned(), description.clone());
        DescribedType { name: Name([1; 32]), type_hash, encoding, description }
    }

    #[test]
    fn a_definition_counts_only_if_it_is_the_announced_one() {
        let hash = twist().type_hash().to_owned();
        assert!(run(job(TWIST, Some(&hash), None)).is_ok());
        let differs = run(job(TWIST, Some("RIHS01_00"), None)).unwrap_err();
        assert_eq!(differs.key(), Some("type_differs"), "{differs}");
        let unknown = run(job("p/msg/Nobody", None, None)).unwrap_err();
        assert_eq!(unknown.key(), None, "{unknown}");
        // A service is searched by its own name and by its hash, or by the hash of its request type.
        let service = run(job("std_srvs/srv/SetBool", None, None)).unwrap();
        let request = service.layout().part(&service.name().request()).unwrap().type_hash();
        for hash in [service.type_hash(), &request] {
            assert!(run(job("std_srvs/srv/SetBool", Some(hash), None)).is_ok());
            let told = told(service.type_hash(), PayloadEncoding::Plain, service.description());
            assert!(run(job("std_srvs/srv/SetBool", Some(hash), Some(told))).is_ok());
        }
        let differs = run(job("std_srvs/srv/SetBool", Some(twist().type_hash()), None)).unwrap_err();
        assert_eq!(differs.key(), Some("type_differs"), "{differs}");
        let other = told(service.type_hash(), PayloadEncoding::Plain, service.description());
        let refused = run(job("std_srvs/srv/SetBool", Some(twist().type_hash()), Some(other))).unwrap_err();
        assert_eq!(refused.key(), Some("type_refused"), "{refused}");
    }

    #[test]
    fn received_type_description_is_refused_unless_its_hash_matches() {
        let twist = twist();
        let plain = |hash: &str| told(hash, PayloadEncoding::Plain, twist.description());
        let (hash, other) = (twist.type_hash(), "RIHS01_00");
        for (announced, told) in [(Some(hash), plain(hash)), (Some(hash), plain(other)), (None, plain(hash))]
        {
            assert!(run(job(TWIST, announced, Some(told))).is_ok());
        }
        let lies = [
            // The description has neither the announced hash nor its own claimed one.
            (TWIST, Some(other), plain(hash)),
            (TWIST, None, plain(other)),
            // The description is of another type.
            ("std_msgs/msg/String", Some(hash), plain(hash)),
            ("std_msgs/msg/String", None, plain(hash)),
            // The bytes are no description.
            (TWIST, None, told(hash, PayloadEncoding::Plain, &Bytes::from_static(b"no description"))),
            // The description exceeds the limit, packed or not.
            (TWIST, None, told(hash, PayloadEncoding::Plain, &vec![0; 300 << 10].into())),
            (TWIST, None, told(hash, PayloadEncoding::Zstd, &vec![0xff; 100].into())),
        ];
        for (type_name, announced, told) in lies {
            let refused = run(job(type_name, announced, Some(told))).unwrap_err();
            assert_eq!(refused.key(), Some("type_refused"), "{refused}");
        }
    }

    fn types(types_max: usize) -> InterfaceTypes {
        InterfaceTypes::new(Arc::new(TypeStore::with_limits(types_max, usize::MAX)), Definitions::default())
    }

    /// Adds an interface, whose type is then searched.
    fn need(types: &mut InterfaceTypes, name: u8, type_name: &str, owner: Option<NodeId>) -> Name {
        let (name, type_name) = (Name([name; 32]), type_name.parse().unwrap());
        let state = NeedState::Looking;
        types.needs.insert(name, Need { type_name, type_hash: None, owner, state });
        types.look_for(name);
        name
    }

    /// Runs the next job and applies its result, as the control task does.
    fn step(types: &mut InterfaceTypes) -> Result<Arc<ResolvedType>, TypeMiss> {
        let job = types.jobs.pop_front().expect("something to do");
        let TypeOutcome { of, found } = job.run(&TypeStore::default(), &Definitions::default());
        assert!(types.ends(&of));
        let kept = found.and_then(|found| types.keep(found.described, of.owner.as_ref()));
        let need = types.needs.get_mut(&of.name).unwrap();
        need.state = match &kept {
            Ok(known) => NeedState::Known(known.clone()),
            Err(why) => why.state(false),
        };
        if matches!(need.state, NeedState::NoRoom { .. }) {
            types.no_room.push_back(of.name);
        }
        kept
    }

    #[test]
    fn full_store_drops_unused_types_and_keeps_used_ones() {
        let string = || run(job("std_msgs/msg/String", None, None)).unwrap();
        let mut types = types(1);
        let kept = types.keep(Err(twist()), None).unwrap();
        assert!(types.keep(Err(string()), None).is_ok(), "nobody uses the first");
        assert!(types.store.described(kept.name(), None).is_none());
        need(&mut types, 1, "std_msgs/msg/String", None);
        step(&mut types).unwrap();
        let refused = types.keep(Err(twist()), None).unwrap_err();
        assert_eq!(refused.key(), Some("types_full"), "{refused}");
    }

    #[test]
    fn type_without_room_is_looked_for_again_once_there_is_room() {
        let mut types = types(1);
        let first = need(&mut types, 1, "std_msgs/msg/String", None);
        let same = need(&mut types, 2, "std_msgs/msg/String", None);
        need(&mut types, 3, TWIST, None);
        step(&mut types).unwrap();
        step(&mut types).unwrap();
        assert_eq!(step(&mut types).unwrap_err().key(), Some("types_full"));
        let said = types.problems(|_| unreachable!("it is of this node"));
        assert!(said.len() == 1 && said[0].contains(TWIST) && said[0].contains("1024 types"), "{said:?}");
        types.forget(&first);
        assert!(types.jobs.is_empty(), "another interface has that type");
        types.forget(&same);
        assert!(
            step(&mut types).is_ok()
                && types.no_room.is_empty()
                && types.problems(|_| String::new()).is_empty()
        );
    }

    #[test]
    fn single_owner_does_not_fill_the_type_store() {
        let (mut types, owner, other) = (types(TYPES_MAX), NodeId([1; 32]), NodeId([2; 32]));
        let of = |n: usize| {
            let mut text = |_: &TypeName| Some(format!("int8 a{n}"));
            let mut library = sgc_cdr::Library::empty();
            ResolvedType::from_layout(library.layout(&"p/msg/A".parse().unwrap(), &mut text).unwrap())
                .unwrap()
        };
        let name = |n: usize| Name(std::array::from_fn(|i| n.to_be_bytes()[i % 8]));
        for n in 0..TYPES_PER_OWNER_MAX {
            let known = types.keep(Err(of(n)), Some(&owner)).unwrap();
            let (type_name, state) = (known.name().clone(), NeedState::Known(known));
            let need = Need { type_name, type_hash: None, owner: Some(owner), state };
            types.needs.insert(name(n), need);
        }
        let refused = types.keep(Err(twist()), Some(&owner)).unwrap_err();
        assert_eq!(refused.key(), Some("types_full"), "{refused}");
        assert!(types.keep(Err(of(0)), Some(&owner)).is_ok(), "it has that already");
        let late = need(&mut types, 0xfe, TWIST, Some(owner));
        assert!(step(&mut types).is_err());
        let said = types.problems(|owner| owner.short());
        assert!(said.len() == 1 && said[0].contains("of one node this one keeps 512 types"), "{said:?}");
        assert!(said[0].contains(&owner.short()), "{said:?}");
        assert!(types.keep(Err(twist()), Some(&other)).is_ok() && types.keep(Err(twist()), None).is_ok());
        // The owner has fewer types now.
        types.forget(&name(0));
        assert_eq!(types.jobs.front().map(|job| job.name), Some(late));
    }

    #[test]
    fn a_fault_where_something_is_looked_for_keeps_no_others_waiting() {
        let mut types = types(1);
        let name = need(&mut types, 1, TWIST, Some(NodeId([1; 32])));
        let owner = types.needs[&name].owner;
        types.jobs.pop_front().unwrap();
        let type_name = TWIST.parse().unwrap();
        let of = TypeQuery { name, type_name, type_hash: None, owner, told_bytes: None };
        let TypeOutcome { of, found } = of.found_by(|| panic!("as a fault does"));
        assert!(types.ends(&of));
        let failed = found.map(|_| ()).unwrap_err();
        assert_eq!(
            (failed.key(), matches!(failed.state(true), NeedState::Asked)),
            (Some("type_failed"), true)
        );
    }

    #[test]
    fn unwanted_type_is_neither_looked_for_nor_accepted() {
        let (mut types, owner) = (types(1), NodeId([1; 32]));
        let name = need(&mut types, 1, TWIST, Some(owner));
        let job = types.jobs.pop_front().unwrap();
        // Its owner now lists another type.
        assert_eq!(types.forget(&name), Some(owner));
        need(&mut types, 1, "std_msgs/msg/String", Some(owner));
        let outcome = job.run(&TypeStore::default(), &Definitions::default());
        assert!(!types.ends(&outcome.of));
        types.forget(&name);
        assert!(types.jobs.is_empty());
        types.questions.lacks(owner, name);
        assert!(types.questions.next(owner, Instant::now()).is_some(), "nothing is under way");
    }

    #[test]
    fn changed_listing_of_an_owner_starts_a_new_type_search() {
        let (mut types, owner) = (types(1), NodeId([1; 32]));
        let [same, other_hash, other_type, _] =
            [1, 2, 3, 4].map(|name| need(&mut types, name, TWIST, Some(owner)));
        let of_another = need(&mut types, 5, TWIST, Some(NodeId([2; 32])));
        let entry = |type_name: &str, type_hash: Option<&str>| CatalogueEntry {
            metadata: Metadata::topic("arm", "/a", type_name),
            blind: sgc_wire::Blind([0; 32]),
            subscribe: true,
            publish: false,
            suite: 1,
            keyless: true,
            type_hash: type_hash.map(str::to_owned),
            qos: sgc_wire::Qos::default(),
            class: sgc_wire::Class::Default,
            sources: vec![],
        };
        let string = "std_msgs/msg/String";
        let listed = BTreeMap::from([
            (same, entry(TWIST, None)),
            (other_hash, entry(TWIST, Some("RIHS01_00"))),
            (other_type, entry(string, None)),
            (of_another, entry(string, None)),
        ]);
        let mut otherwise = types.listed_otherwise(&owner, |name| listed.get(name));
        otherwise.sort_unstable();
        assert_eq!(otherwise, [other_hash, other_type]);
    }

    #[test]
    fn descriptions_may_be_as_long_everywhere() {
        assert_eq!(sgc_wire::TYPE_DESCRIPTION_BYTES_MAX, sgc_cdr::DESCRIPTION_BYTES_MAX);
    }
}
