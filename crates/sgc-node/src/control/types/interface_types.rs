//! [`InterfaceTypes`]: the types of shared and used interfaces, known or being searched, in local files or at the owners
//! of used interfaces.
//!
//! Jobs (`type_jobs`) read files and verify descriptions one after the other on a blocking thread. Known types go into
//! the store, which the whole process shares. The control task carries out the rest.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;
use std::time::Instant;

use sgc_cdr::TypeName;
use sgc_endpoint::PackedType;
use sgc_session::TypeQuestions;
use sgc_types::{
    Definitions, ResolvedType, TYPES_BYTES_MAX, TYPES_MAX, TYPES_PER_OWNER_BYTES_MAX, TYPES_PER_OWNER_MAX,
    TypeStore,
};
use sgc_wire::{CatalogueEntry, DescribedType, Name, NodeId};

use crate::control::types::type_jobs::{FoundType, Job, TypeEntry, TypeMiss, TypeOutcome, TypeQuery};
use crate::data::conversion::KnownType;

/// Types that are tried again when room returns.
const RETRIES_MAX: usize = 16;

/// The types of the interfaces that this node shares and uses.
pub(crate) struct InterfaceTypes {
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

/// Returns the state of a need whose type was not found. `asks` is set if its owner can be asked.
fn need_after(why: &TypeMiss, asks: bool) -> NeedState {
    match why {
        TypeMiss::Full(_) => NeedState::NoRoom { of_owner: false },
        TypeMiss::OwnerFull { .. } => NeedState::NoRoom { of_owner: true },
        _ if asks => NeedState::Asked,
        TypeMiss::Packed(_) | TypeMiss::ResolveError(_) => NeedState::Refused,
        _ => NeedState::Unknown,
    }
}

impl InterfaceTypes {
    pub(crate) fn new(store: Arc<TypeStore>, definitions: Definitions) -> Self {
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
    pub(crate) fn described(
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
    pub(crate) fn deadline(&self) -> Option<Instant> {
        self.questions.deadline()
    }

    /// Returns the problems to report. `called` returns the name of an owner.
    pub(crate) fn problems(&self, called: impl Fn(&NodeId) -> String) -> Vec<String> {
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
    fn keep(&self, described: FoundType, owner: Option<&NodeId>) -> Result<Arc<ResolvedType>, TypeMiss> {
        let new = match described {
            FoundType::Stored(known) => return Ok(known),
            FoundType::New(new) => new,
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
    pub(crate) fn listed_otherwise<'a>(
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
    pub(crate) fn forget(&mut self, name: &Name) -> Option<NodeId> {
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
    pub(crate) fn has_own_jobs(&self) -> bool {
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

/// A type whose search has ended.
pub(crate) struct SettledType {
    /// The interface.
    pub(crate) name: Name,
    /// Its owner, if it is another node.
    pub(crate) owner: Option<NodeId>,
    /// Whether the owner described the type.
    pub(crate) was_told: bool,
    /// The type, with its packed description for other nodes.
    pub(crate) found: Result<(Arc<ResolvedType>, Option<PackedType>), TypeMiss>,
}

/// A job, with everything that it reads.
pub(crate) struct ReadyJob {
    job: Job,
    store: Arc<TypeStore>,
    definitions: Arc<Definitions>,
}

impl ReadyJob {
    /// Runs the job. Blocks.
    pub(crate) fn run(self) -> TypeOutcome {
        self.job.run(&self.store, &self.definitions)
    }
}

/// Searches from their beginning to their end.
impl InterfaceTypes {
    /// Returns `true` if this type of an interface is being searched, or its search has ended.
    pub(crate) fn is_needed(
        &self,
        name: &Name,
        type_name: &TypeName,
        type_hash: Option<&str>,
        owner: Option<NodeId>,
    ) -> bool {
        self.needs.get(name).is_some_and(|need| {
            need.type_hash.as_deref() == type_hash && need.owner == owner && need.type_name == *type_name
        })
    }

    /// Starts the search for the type of an interface.
    pub(crate) fn need(
        &mut self,
        name: Name,
        type_name: TypeName,
        type_hash: Option<String>,
        owner: Option<NodeId>,
    ) {
        self.needs.insert(name, Need { type_name, type_hash, owner, state: NeedState::Looking });
        self.look_for(name);
    }

    /// Handles type descriptions from an owner. Returns the number of those without room.
    pub(crate) fn told(&mut self, owner: NodeId, types: Vec<DescribedType>) -> usize {
        self.questions.answered(&owner);
        let mut without_room = 0;
        for told in types {
            let Some(need) = self.needs.get_mut(&told.name) else { continue };
            if need.owner != Some(owner) || !matches!(need.state, NeedState::Asked) {
                continue;
            }
            if !self.questions.takes_told(&owner, told.description.len()) {
                without_room += 1;
                continue;
            }
            need.state = NeedState::Told;
            let (type_name, type_hash) = (need.type_name.clone(), need.type_hash.clone());
            let (name, owner) = (told.name, need.owner);
            self.jobs.push_back(Job { name, type_name, type_hash, owner, told: Some(told) });
        }
        without_room
    }

    /// Returns the next job, unless one is under way.
    pub(crate) fn next_job(&mut self) -> Option<ReadyJob> {
        if self.is_busy {
            return None;
        }
        let job = self.jobs.pop_front()?;
        self.is_busy = true;
        Some(ReadyJob { job, store: self.store.clone(), definitions: self.definitions.clone() })
    }

    /// Handles the result of a job. Returns it if its interface still waits for it.
    pub(crate) fn looked_for(&mut self, outcome: TypeOutcome) -> Option<SettledType> {
        self.is_busy = false;
        let TypeOutcome { of, found } = outcome;
        self.ends(&of).then(|| self.settle(&of, found))
    }

    fn settle(&mut self, of: &TypeQuery, found: Result<TypeEntry, TypeMiss>) -> SettledType {
        let (name, owner, was_told) = (of.name, of.owner, of.told_bytes.is_some());
        let found = found.and_then(|found| Ok((self.keep(found.described, owner.as_ref())?, found.packed)));
        let state = match &found {
            Ok((described, _)) => NeedState::Known(described.clone()),
            Err(why) => need_after(why, owner.is_some() && !was_told),
        };
        match (&state, owner) {
            (NeedState::Asked, Some(owner)) => self.questions.lacks(owner, name),
            (_, Some(owner)) => self.questions.settled(&owner, &name),
            (_, None) => {}
        }
        if matches!(state, NeedState::NoRoom { .. }) {
            self.no_room.push_back(name);
        }
        if let Some(need) = self.needs.get_mut(&name) {
            need.state = state;
        }
        SettledType { name, owner, was_told, found }
    }

    /// Returns the owners that may be asked, because jobs have made room.
    pub(crate) fn have_room(&mut self) -> Vec<NodeId> {
        self.questions.have_room().into_iter().collect()
    }

    /// Returns the owners that may be asked, because their turn has come.
    pub(crate) fn due(&mut self, now: Instant) -> Vec<NodeId> {
        self.questions.due(now)
    }

    /// Returns the names whose types an owner is to be asked for, unless it was asked already.
    pub(crate) fn next_question(&mut self, owner: NodeId, now: Instant) -> Option<Vec<Name>> {
        self.questions.next(owner, now)
    }

    /// Returns the state of an interface's type, as its ends take it.
    pub(crate) fn known(&self, name: &Name) -> KnownType {
        // A name without a need is not of ROS, so no search starts and no message waits.
        let Some(need) = self.needs.get(name) else { return KnownType::Lacking };
        match &need.state {
            NeedState::Looking => KnownType::Awaited,
            NeedState::Asked | NeedState::Told => KnownType::Asked,
            NeedState::Known(described) => KnownType::Known(described.layout().clone()),
            NeedState::NoRoom { .. } | NeedState::Refused | NeedState::Unknown => KnownType::Lacking,
        }
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;
    use sgc_wire::{Metadata, PayloadEncoding};

    use super::*;
    use crate::drops::NodeDrop;

    const TWIST: &str = "geometry_msgs/msg/Twist";

    fn job(type_name: &str, type_hash: Option<&str>, told: Option<DescribedType>) -> Job {
        let type_name = type_name.parse().unwrap();
        let type_hash = type_hash.map(str::to_owned);
        Job { name: Name([1; 32]), type_name, type_hash, owner: None, told }
    }

    fn run(job: Job) -> Result<ResolvedType, TypeMiss> {
        let outcome = job.run(&TypeStore::default(), &Definitions::default());
        outcome.found.map(|found| match found.described {
            FoundType::New(new) => new,
            FoundType::Stored(_) => panic!("the store is empty"),
        })
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
        assert_eq!(differs.counter(), Some(NodeDrop::TypeDiffers), "{differs}");
        let unknown = run(job("p/msg/Nobody", None, None)).unwrap_err();
        assert_eq!(unknown.counter(), None, "{unknown}");
        // A service is searched by its own name and by its hash, or by the hash of its request type.
        let service = run(job("std_srvs/srv/SetBool", None, None)).unwrap();
        let request = service.layout().part(&service.name().request()).unwrap().type_hash();
        for hash in [service.type_hash(), &request] {
            assert!(run(job("std_srvs/srv/SetBool", Some(hash), None)).is_ok());
            let told = told(service.type_hash(), PayloadEncoding::Plain, service.description());
            assert!(run(job("std_srvs/srv/SetBool", Some(hash), Some(told))).is_ok());
        }
        let differs = run(job("std_srvs/srv/SetBool", Some(twist().type_hash()), None)).unwrap_err();
        assert_eq!(differs.counter(), Some(NodeDrop::TypeDiffers), "{differs}");
        let other = told(service.type_hash(), PayloadEncoding::Plain, service.description());
        let refused = run(job("std_srvs/srv/SetBool", Some(twist().type_hash()), Some(other))).unwrap_err();
        assert_eq!(refused.counter(), Some(NodeDrop::TypeRefused), "{refused}");
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
            assert_eq!(refused.counter(), Some(NodeDrop::TypeRefused), "{refused}");
        }
    }

    fn types(types_max: usize) -> InterfaceTypes {
        InterfaceTypes::new(Arc::new(TypeStore::with_limits(types_max, usize::MAX)), Definitions::default())
    }

    /// Adds an interface, whose type is then searched.
    fn need(types: &mut InterfaceTypes, name: u8, type_name: &str, owner: Option<NodeId>) -> Name {
        let (name, type_name) = (Name([name; 32]), type_name.parse().unwrap());
        types.need(name, type_name, None, owner);
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
            Err(why) => need_after(why, false),
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
        let kept = types.keep(FoundType::New(twist()), None).unwrap();
        assert!(types.keep(FoundType::New(string()), None).is_ok(), "nobody uses the first");
        assert!(types.store.described(kept.name(), None).is_none());
        need(&mut types, 1, "std_msgs/msg/String", None);
        step(&mut types).unwrap();
        let refused = types.keep(FoundType::New(twist()), None).unwrap_err();
        assert_eq!(refused.counter(), Some(NodeDrop::TypesFull), "{refused}");
    }

    #[test]
    fn type_without_room_is_looked_for_again_once_there_is_room() {
        let mut types = types(1);
        let first = need(&mut types, 1, "std_msgs/msg/String", None);
        let same = need(&mut types, 2, "std_msgs/msg/String", None);
        need(&mut types, 3, TWIST, None);
        step(&mut types).unwrap();
        step(&mut types).unwrap();
        assert_eq!(step(&mut types).unwrap_err().counter(), Some(NodeDrop::TypesFull));
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
            let known = types.keep(FoundType::New(of(n)), Some(&owner)).unwrap();
            let (type_name, state) = (known.name().clone(), NeedState::Known(known));
            let need = Need { type_name, type_hash: None, owner: Some(owner), state };
            types.needs.insert(name(n), need);
        }
        let refused = types.keep(FoundType::New(twist()), Some(&owner)).unwrap_err();
        assert_eq!(refused.counter(), Some(NodeDrop::TypesFull), "{refused}");
        assert!(types.keep(FoundType::New(of(0)), Some(&owner)).is_ok(), "it has that already");
        let late = need(&mut types, 0xfe, TWIST, Some(owner));
        assert!(step(&mut types).is_err());
        let said = types.problems(|owner| owner.short());
        assert!(said.len() == 1 && said[0].contains("of one node this one keeps 512 types"), "{said:?}");
        assert!(said[0].contains(&owner.short()), "{said:?}");
        assert!(
            types.keep(FoundType::New(twist()), Some(&other)).is_ok()
                && types.keep(FoundType::New(twist()), None).is_ok()
        );
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
            (failed.counter(), matches!(need_after(&failed, true), NeedState::Asked)),
            (Some(NodeDrop::TypeFailed), true)
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
