//! What the types of shared and used interfaces look like: found in files here, or told by the owners of what is used; and
//! told to those who ask.
//!
//! Files are read, and descriptions judged, one after the other where that may take its time. What is known goes into the
//! store, which others in this process look into, and to the ends of the interface that convert by it.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;

use sgc_cdr::{DescriptionError, TypeError, TypeName};
use sgc_endpoint::{CompressionError, PackedType, unpack_type};
use sgc_ros::RosNetwork;
use sgc_types::{Definitions, Described, NotBelieved, StoreFull, TypeStore};
use sgc_wire::{DescribedType, Metadata, Name, NodeId};
use tracing::{debug, warn};

use super::{Core, CoreEvent, now};
use crate::conversion::KnownType;

/// Bytes of descriptions that wait to be judged: what several owners may tell at once.
const TOLD_BYTES_MAX: usize = 4 << 20;

/// The types of the interfaces that this node shares and uses.
pub(super) struct Types {
    store: Arc<TypeStore>,
    definitions: Arc<Definitions>,
    needs: BTreeMap<Name, Need>,
    /// At most one for each need, and for each answer that an owner owes.
    jobs: VecDeque<Job>,
    is_busy: bool,
}

/// The type of an interface.
struct Need {
    type_name: TypeName,
    /// As it is announced.
    type_hash: Option<String>,
    /// Whose it is, if it is another's.
    owner: Option<NodeId>,
    state: NeedState,
}

enum NeedState {
    /// It is looked for.
    Looking,
    /// Its owner is asked.
    Asked,
    /// It is known.
    Known(Arc<Described>),
    /// It is not, and nobody is asked for it.
    Unknown,
}

/// What takes its time.
struct Job {
    name: Name,
    type_name: TypeName,
    type_hash: Option<String>,
    /// What an owner told; without it, files are looked into.
    told: Option<DescribedType>,
}

/// A type that became known, and as it is told to others.
struct Found {
    described: KnownOrNew,
    packed: Option<PackedType>,
}

/// A type that is in the store already, or one that is not.
type KnownOrNew = Result<Arc<Described>, Described>;

/// What became of looking for a type.
pub(crate) struct TypeOutcome {
    name: Name,
    type_hash: Option<String>,
    was_told: bool,
    found: Result<Found, TypeMiss>,
}

/// Why a type is not known.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum TypeMiss {
    /// No file defines it, or one does so wrongly.
    #[error(transparent)]
    Definition(#[from] TypeError),
    /// It is too large to be described.
    #[error(transparent)]
    Description(#[from] DescriptionError),
    /// The definition is another than that of whoever uses it.
    #[error("the definition that was found is {found}, what is announced {announced}")]
    Differs {
        /// Hash of what was found.
        found: String,
        /// Hash that is announced.
        announced: String,
    },
    /// What an owner told cannot be unpacked.
    #[error("the description cannot be unpacked: {0}")]
    Packed(#[from] CompressionError),
    /// What an owner told is not what it was asked for.
    #[error(transparent)]
    NotBelieved(#[from] NotBelieved),
    /// There is no room for it.
    #[error(transparent)]
    Full(#[from] StoreFull),
}

impl TypeMiss {
    /// A short, stable name for counters; none for what is no fault.
    fn key(&self) -> Option<&'static str> {
        match self {
            Self::Definition(_) => None,
            Self::Description(_) => Some("type_not_described"),
            Self::Differs { .. } => Some("type_differs"),
            Self::Packed(_) | Self::NotBelieved(_) => Some("type_refused"),
            Self::Full(_) => Some("types_full"),
        }
    }
}

impl Types {
    pub(super) fn new(store: Arc<TypeStore>, definitions: Definitions) -> Self {
        let (needs, jobs) = (BTreeMap::new(), VecDeque::new());
        Self { store, definitions: Arc::new(definitions), needs, jobs, is_busy: false }
    }

    /// The type of an interface, if it is known; without one, that of this name and hash.
    pub(super) fn described(
        &self,
        name: Option<&Name>,
        type_name: &str,
        type_hash: Option<&str>,
    ) -> Option<Arc<Described>> {
        if let Some(Need { state: NeedState::Known(described), .. }) = name.and_then(|n| self.needs.get(n)) {
            return Some(described.clone());
        }
        self.store.described(&type_name.parse().ok()?, type_hash)
    }
}

/// Keeping what is known.
impl Types {
    /// Takes a type into the store; what no interface has any more makes room.
    fn keep(&self, described: KnownOrNew) -> Result<Arc<Described>, StoreFull> {
        let new = match described {
            Ok(known) => return Ok(known),
            Err(new) => new,
        };
        if !self.store.has_room_for(&new) {
            let known = self.needs.values().filter_map(|need| match &need.state {
                NeedState::Known(described) => Some((described.name(), described.type_hash())),
                _ => None,
            });
            let known: BTreeSet<_> = known.collect();
            self.store.retain(|type_name, type_hash| known.contains(&(type_name, type_hash)));
        }
        self.store.insert(new)
    }
}

impl Job {
    /// Looks into the store, into files, or at what was told.
    fn run(self, store: &TypeStore, definitions: &Definitions) -> TypeOutcome {
        let Self { name, type_name, type_hash, told } = self;
        let was_told = told.is_some();
        let found = match told {
            Some(told) => read(&type_name, type_hash.as_deref(), &told),
            None => find(&type_name, type_hash.as_deref(), store, definitions),
        };
        let found = found.map(|described| {
            let of: &Described = match &described {
                Ok(known) => known,
                Err(new) => new,
            };
            let packed = PackedType::new(of.type_hash(), of.description());
            Found { packed, described }
        });
        TypeOutcome { name, type_hash, was_told, found }
    }
}

fn find(
    type_name: &TypeName,
    type_hash: Option<&str>,
    store: &TypeStore,
    definitions: &Definitions,
) -> Result<KnownOrNew, TypeMiss> {
    // What another owner told of a type of this name need not be this one.
    if let Some(known) = type_hash.and_then(|hash| store.described(type_name, Some(hash))) {
        return Ok(Ok(known));
    }
    let described = Described::of(definitions.layout(type_name)?)?;
    match type_hash {
        Some(announced) if described.type_hash() != announced => Err(TypeMiss::Differs {
            found: described.type_hash().to_owned(),
            announced: announced.to_owned(),
        }),
        _ => Ok(Err(described)),
    }
}

fn read(type_name: &TypeName, type_hash: Option<&str>, told: &DescribedType) -> Result<KnownOrNew, TypeMiss> {
    // Where nobody announces a hash, the owner vouches for it.
    let expected = type_hash.unwrap_or(&told.type_hash);
    Ok(Err(Described::read(unpack_type(told)?, type_name, expected)?))
}

impl<N: RosNetwork> Core<N> {
    /// The type of this interface is to be known: one of this node, or one of another's.
    pub(super) fn need_type(
        &mut self,
        name: Name,
        metadata: &Metadata,
        type_hash: Option<String>,
        owner: Option<NodeId>,
    ) {
        let is_same = |need: &Need| need.type_hash == type_hash && need.owner == owner;
        if self.types.needs.get(&name).is_some_and(is_same) {
            return self.apply_type(&name);
        }
        let Ok(type_name) = metadata.type_name.parse::<TypeName>() else {
            // Plain DDS programs may call theirs what they like.
            return self.set_type(&name, &KnownType::Lacking, &KnownType::Lacking);
        };
        let need = Need {
            type_name: type_name.clone(),
            type_hash: type_hash.clone(),
            owner,
            state: NeedState::Looking,
        };
        self.types.needs.insert(name, need);
        self.types.jobs.push_back(Job { name, type_name, type_hash, told: None });
        self.next_type_job();
    }

    /// The type of an interface of another, which granted it, is to be known.
    pub(super) fn need_type_of_used(&mut self, name: Name) {
        let Some((owner, entry)) = self.routes.as_ref().and_then(|routes| routes.used_entry(&name)) else {
            return;
        };
        let (metadata, type_hash) = (entry.metadata.clone(), entry.type_hash.clone());
        self.need_type(name, &metadata, type_hash, Some(owner));
    }

    /// The interface is no more.
    pub(super) fn forget_type(&mut self, name: &Name) {
        if let Some(Need { owner: Some(owner), state: NeedState::Asked, .. }) = self.types.needs.remove(name)
        {
            self.ask_types(owner);
        }
    }

    /// An owner tells what types look like.
    pub(super) fn types_told(&mut self, owner: NodeId, types: Vec<DescribedType>) {
        for told in types {
            let Some(need) = self.types.needs.get(&told.name) else { continue };
            if need.owner != Some(owner) || !matches!(need.state, NeedState::Asked) {
                continue;
            }
            let (type_name, type_hash) = (need.type_name.clone(), need.type_hash.clone());
            let waiting = self.types.jobs.iter().filter_map(|job| job.told.as_ref());
            if waiting.clone().any(|other| other.name == told.name) {
                continue;
            }
            let bytes: usize = waiting.map(|told| told.description.len()).sum();
            if bytes + told.description.len() > TOLD_BYTES_MAX {
                self.control_drops.count("types_full");
                self.settle_need(&told.name, NeedState::Unknown);
                continue;
            }
            self.types.jobs.push_back(Job { name: told.name, type_name, type_hash, told: Some(told) });
        }
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

    /// A type is known, or is not.
    pub(super) fn type_looked_for(&mut self, outcome: TypeOutcome) {
        self.types.is_busy = false;
        let TypeOutcome { name, type_hash, was_told, found } = outcome;
        let wanted = self.types.needs.get(&name).filter(|need| need.type_hash == type_hash);
        let Some(owner) = wanted.map(|need| need.owner) else { return self.next_type_job() };
        let found = found.and_then(|found| Ok((self.types.keep(found.described)?, found.packed)));
        match found {
            Ok((described, packed)) => {
                debug!(name = %name.short(), type_name = %described.name(), hash = described.type_hash(), "type known");
                if let (None, Some(packed)) = (owner, packed) {
                    self.endpoint.describe(now(), &name, packed);
                }
                self.settle_need(&name, NeedState::Known(described));
            }
            Err(why) => {
                debug!(name = %name.short(), %why, "type not known");
                if let Some(key) = why.key()
                    && self.control_drops.count(key)
                    && was_told
                {
                    warn!(%why, "a description of a type is refused; counted from here on");
                }
                let asks = owner.is_some() && !was_told;
                self.settle_need(&name, if asks { NeedState::Asked } else { NeedState::Unknown });
            }
        }
        self.next_type_job();
    }

    fn settle_need(&mut self, name: &Name, state: NeedState) {
        let Some(need) = self.types.needs.get_mut(name) else { return };
        need.state = state;
        let owner = need.owner;
        self.apply_type(name);
        if let Some(owner) = owner {
            self.ask_types(owner);
        }
    }

    /// Asks an owner for all that is not known of its types.
    fn ask_types(&mut self, owner: NodeId) {
        let asked =
            |(_, need): &(&Name, &Need)| need.owner == Some(owner) && matches!(need.state, NeedState::Asked);
        let names = self.types.needs.iter().filter(asked).map(|(name, _)| *name).collect();
        self.endpoint.ask_types(now(), owner, names);
    }

    /// Tells both ends of an interface what is known of its type.
    pub(super) fn apply_type(&self, name: &Name) {
        let Some(need) = self.types.needs.get(name) else { return };
        match &need.state {
            NeedState::Looking => {}
            // What comes from there may wait for the answer; what is published here would wait for it in vain where the
            // owner knows nothing.
            NeedState::Asked => self.set_type(name, &KnownType::Lacking, &KnownType::Awaited),
            NeedState::Known(described) => {
                let known = KnownType::Known(described.layout().clone());
                self.set_type(name, &known, &known);
            }
            NeedState::Unknown => self.set_type(name, &KnownType::Lacking, &KnownType::Lacking),
        }
    }

    fn set_type(&self, name: &Name, at_share: &KnownType, at_sink: &KnownType) {
        if let Some(share) = self.shares.get(name) {
            share.set_type(at_share.clone());
        }
        if let Some(sink) = self.sinks.get(name) {
            sink.types().set(at_sink.clone());
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
        Job { name: Name([1; 32]), type_name, type_hash: type_hash.map(str::to_owned), told }
    }

    fn run(job: Job) -> Result<Described, TypeMiss> {
        let outcome = job.run(&TypeStore::default(), &Definitions::default());
        outcome.found.map(|found| found.described.expect_err("the store is empty"))
    }

    fn twist() -> Described {
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
        // A service is looked for by its own name and hash.
        assert!(run(job("std_srvs/srv/SetBool", None, None)).is_ok());
    }

    #[test]
    fn what_is_told_is_believed_by_its_hash_and_refused_otherwise() {
        let twist = twist();
        let plain = |hash: &str| told(hash, PayloadEncoding::Plain, twist.description());
        let (hash, other) = (twist.type_hash(), "RIHS01_00");
        for (announced, told) in [(Some(hash), plain(hash)), (Some(hash), plain(other)), (None, plain(hash))]
        {
            assert!(run(job(TWIST, announced, Some(told))).is_ok());
        }
        let lies = [
            // It is not of the hash that is announced, nor of the one that it is said to have.
            (TWIST, Some(other), plain(hash)),
            (TWIST, None, plain(other)),
            // It is of another type.
            ("std_msgs/msg/String", Some(hash), plain(hash)),
            ("std_msgs/msg/String", None, plain(hash)),
            // It is none.
            (TWIST, None, told(hash, PayloadEncoding::Plain, &Bytes::from_static(b"no description"))),
            // It is longer than it may be, packed or not.
            (TWIST, None, told(hash, PayloadEncoding::Plain, &vec![0; 300 << 10].into())),
            (TWIST, None, told(hash, PayloadEncoding::Zstd, &vec![0xff; 100].into())),
        ];
        for (type_name, announced, told) in lies {
            let refused = run(job(type_name, announced, Some(told))).unwrap_err();
            assert_eq!(refused.key(), Some("type_refused"), "{refused}");
        }
    }

    #[test]
    fn what_is_in_use_stays_in_a_full_store_and_what_is_not_makes_room() {
        let string = || run(job("std_msgs/msg/String", None, None)).unwrap();
        let mut types = Types::new(Arc::new(TypeStore::with_limits(1, usize::MAX)), Definitions::default());
        let kept = types.keep(Err(twist())).unwrap();
        assert!(types.keep(Err(string())).is_ok(), "nobody uses the first");
        assert!(types.store.described(kept.name(), None).is_none());
        let (type_name, described) = (string().name().clone(), types.keep(Err(string())).unwrap());
        let need = Need { type_name, type_hash: None, owner: None, state: NeedState::Known(described) };
        types.needs.insert(Name([1; 32]), need);
        let refused = TypeMiss::from(types.keep(Err(twist())).unwrap_err());
        assert_eq!(refused.key(), Some("types_full"), "{refused}");
    }

    #[test]
    fn descriptions_may_be_as_long_everywhere() {
        assert_eq!(sgc_wire::TYPE_DESCRIPTION_BYTES_MAX, sgc_cdr::DESCRIPTION_BYTES_MAX);
    }
}
