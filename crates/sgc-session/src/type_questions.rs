//! [`TypeQuestions`]: decides which owner is asked for which types, and when. Each owner has one question at a time,
//! with as many names as one question holds.
//!
//! A pure machine. `sgc-node` sends questions and verifies answers. This machine counts the running
//! searches of an owner, so that their results are gathered into one question, and gives each missing type its turn.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use sgc_wire::{Name, NodeId, SEALED_BYTES_MAX, TYPES_PER_QUESTION_MAX};

/// Time for a question that brings nothing new while other names wait. It doubles after each round without an answer.
const TURN_MIN: Duration = Duration::from_secs(1);
/// Upper bound of that time.
const TURN_MAX: Duration = Duration::from_secs(60);
/// Most bytes of unverified descriptions, of all owners together.
const TOLD_BYTES_MAX: usize = 4 << 20;
/// Most bytes of unverified descriptions of one owner: those of one answer.
const TOLD_BYTES_PER_OWNER_MAX: usize = SEALED_BYTES_MAX;

/// The questions to all owners.
#[derive(Debug, Default)]
pub struct TypeQuestions {
    owners: BTreeMap<NodeId, Owner>,
    told_bytes: usize,
    /// Owners whose descriptions had no room.
    held_up: BTreeSet<NodeId>,
}

#[derive(Debug, Default)]
struct Owner {
    /// Missing types, each with the number of the last question that asked for it; 0 for none.
    lacking: BTreeMap<Name, u64>,
    /// Names in the open question.
    asked: BTreeSet<Name>,
    questions: u64,
    /// Number of its types that are searched in files or verified.
    under_way: usize,
    told_bytes: usize,
    /// Whether the open question was answered, possibly with nothing.
    is_answered: bool,
    /// Whether the answer brought a type, so that a new question may bring more.
    may_tell_more: bool,
    /// Number of questions since an answer brought a type.
    in_vain: usize,
    /// Time at which other names have their turn.
    next_turn: Option<Instant>,
}

impl TypeQuestions {
    /// Notes that a search or verification for this owner begins.
    pub fn begins(&mut self, owner: NodeId) {
        self.owners.entry(owner).or_default().under_way += 1;
    }

    /// Notes that it ends. `told_bytes` is the size of a received description.
    pub fn ends(&mut self, owner: &NodeId, told_bytes: usize) {
        self.told_bytes = self.told_bytes.saturating_sub(told_bytes);
        if let Some(of) = self.owners.get_mut(owner) {
            of.under_way = of.under_way.saturating_sub(1);
            of.told_bytes = of.told_bytes.saturating_sub(told_bytes);
        }
    }

    /// Adds a type to ask the owner for.
    pub fn lacks(&mut self, owner: NodeId, name: Name) {
        self.owners.entry(owner).or_default().lacking.entry(name).or_default();
    }

    /// Removes a type, because it is known or no longer wanted.
    pub fn settled(&mut self, owner: &NodeId, name: &Name) {
        if let Some(of) = self.owners.get_mut(owner) {
            of.lacking.remove(name);
        }
    }

    /// Notes that the owner answered the open question.
    pub fn answered(&mut self, owner: &NodeId) {
        if let Some(of) = self.owners.get_mut(owner) {
            of.is_answered = true;
        }
    }

    /// Reserves room to verify a description. Returns `false` if there is none; the type is then asked for again.
    pub fn takes_told(&mut self, owner: &NodeId, bytes: usize) -> bool {
        let Some(of) = self.owners.get_mut(owner) else { return false };
        if of.told_bytes + bytes > TOLD_BYTES_PER_OWNER_MAX || self.told_bytes + bytes > TOLD_BYTES_MAX {
            self.held_up.insert(*owner);
            return false;
        }
        of.told_bytes += bytes;
        self.told_bytes += bytes;
        of.under_way += 1;
        (of.may_tell_more, of.in_vain) = (true, 0);
        true
    }

    /// Removes and returns the owners to ask again, because there is room now.
    pub fn have_room(&mut self) -> BTreeSet<NodeId> {
        if self.held_up.is_empty() || self.told_bytes > TOLD_BYTES_MAX / 2 {
            return BTreeSet::new();
        }
        let held_up = std::mem::take(&mut self.held_up);
        for owner in &held_up {
            if let Some(of) = self.owners.get_mut(owner) {
                of.may_tell_more = true;
            }
        }
        held_up
    }

    /// Returns the owners to be asked for other types now.
    pub fn due(&self, now: Instant) -> Vec<NodeId> {
        let is_due = |of: &Owner| of.turn().is_some_and(|at| at <= now);
        self.owners.iter().filter(|(_, of)| is_due(of)).map(|(owner, _)| *owner).collect()
    }

    /// Returns the time of the next such question.
    pub fn deadline(&self) -> Option<Instant> {
        self.owners.values().filter_map(Owner::turn).min()
    }

    /// Returns the names of a new question, which replaces the open one. `None` keeps the open question; no names means
    /// that nothing is missing.
    pub fn next(&mut self, owner: NodeId, now: Instant) -> Option<Vec<Name>> {
        let of = self.owners.get_mut(&owner)?;
        if of.under_way > 0 {
            return None;
        }
        if of.lacking.is_empty() {
            self.held_up.remove(&owner);
            return self.owners.remove(&owner).filter(|of| !of.asked.is_empty()).map(|_| Vec::new());
        }
        of.next(now)
    }
}

impl Owner {
    /// Returns the time at which other names have their turn. There is none while searches run, since they decide what
    /// is missing.
    fn turn(&self) -> Option<Instant> {
        self.next_turn.filter(|_| self.under_way == 0)
    }

    fn next(&mut self, now: Instant) -> Option<Vec<Name>> {
        let waits = self.asked.iter().any(|name| self.lacking.contains_key(name));
        let is_due = !waits || self.is_answered && (self.may_tell_more || self.has_others(now));
        if !is_due {
            return None;
        }
        (self.questions, self.in_vain) = (self.questions + 1, self.in_vain.saturating_add(1));
        let mut names: Vec<_> = self.lacking.iter().map(|(name, asked)| (*asked, *name)).collect();
        // New names come first, then those that were asked for longest ago.
        names.sort_unstable();
        names.truncate(TYPES_PER_QUESTION_MAX);
        let names: Vec<_> = names.into_iter().map(|(_, name)| name).collect();
        for name in &names {
            self.lacking.insert(*name, self.questions);
        }
        self.asked = names.iter().copied().collect();
        (self.is_answered, self.may_tell_more, self.next_turn) = (false, false, None);
        Some(names)
    }

    /// Returns `true` if names outside of the open question are to be asked for now.
    fn has_others(&mut self, now: Instant) -> bool {
        let mut others = self.lacking.iter().filter(|(name, _)| !self.asked.contains(*name)).peekable();
        if others.peek().is_none() {
            self.next_turn = None;
            return false;
        }
        // A question that holds all names can stay until the owner knows more.
        if self.lacking.len() <= TYPES_PER_QUESTION_MAX || others.any(|(_, asked)| *asked == 0) {
            return true;
        }
        let rounds = self.in_vain / self.lacking.len().div_ceil(TYPES_PER_QUESTION_MAX);
        let turn = TURN_MIN.saturating_mul(2_u32.saturating_pow(rounds.min(16) as u32)).min(TURN_MAX);
        *self.next_turn.get_or_insert(now + turn) <= now
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::disallowed_methods)]

    use super::*;

    const OWNER: NodeId = NodeId([7; 32]);

    fn names(n: usize) -> Vec<Name> {
        (0..n)
            .map(|i| {
                let mut name = [0; 32];
                name[..8].copy_from_slice(&(i as u64).to_be_bytes());
                Name(name)
            })
            .collect()
    }

    /// Searches all names in files and finds none.
    fn lack(questions: &mut TypeQuestions, all: &[Name], now: Instant) -> Vec<Vec<Name>> {
        all.iter().for_each(|_| questions.begins(OWNER));
        let look = |name: &Name| {
            questions.ends(&OWNER, 0);
            questions.lacks(OWNER, *name);
            questions.next(OWNER, now)
        };
        all.iter().filter_map(look).collect()
    }

    #[test]
    fn an_owner_of_many_types_is_asked_a_few_times() {
        let (mut questions, now, all) = (TypeQuestions::default(), Instant::now(), names(1000));
        let mut asked = lack(&mut questions, &all, now);
        assert_eq!(asked.len(), 1, "when all were looked for");
        let mut told = 0;
        while let Some(question) = asked.last().filter(|names| !names.is_empty()).cloned() {
            assert!(question.len() <= TYPES_PER_QUESTION_MAX && asked.len() < 20);
            // One answer has room for half of them.
            questions.answered(&OWNER);
            let half: Vec<_> = question.iter().take(64).collect();
            half.iter().for_each(|_| assert!(questions.takes_told(&OWNER, 1000)));
            for name in half {
                questions.ends(&OWNER, 1000);
                questions.settled(&OWNER, name);
                told += 1;
                asked.extend(questions.next(OWNER, now));
            }
        }
        assert_eq!((told, asked.len()), (1000, 1000_usize.div_ceil(64) + 1));
        assert!(questions.owners.is_empty());
    }

    #[test]
    fn type_unknown_to_one_owner_does_not_block_questions_to_others() {
        let (mut questions, now, all) = (TypeQuestions::default(), Instant::now(), names(400));
        let mut question = lack(&mut questions, &all, now).pop().unwrap();
        let mut asked = BTreeSet::new();
        // The owner knows none of them.
        for _ in 0..3 {
            asked.extend(question);
            questions.answered(&OWNER);
            question = questions.next(OWNER, now).unwrap();
        }
        asked.extend(question.clone());
        assert_eq!(asked.len(), 400);
        questions.answered(&OWNER);
        // Later questions alternate, the other names first.
        assert_eq!((questions.next(OWNER, now), questions.due(now)), (None, vec![]));
        let later = now + 2 * TURN_MIN;
        assert_eq!(questions.deadline(), Some(later));
        assert_eq!(questions.due(later), [OWNER]);
        // While searches run, no turn comes.
        questions.begins(OWNER);
        assert_eq!((questions.due(later), questions.deadline()), (vec![], None));
        questions.ends(&OWNER, 0);
        let others = questions.next(OWNER, later).unwrap();
        assert!(others.len() == TYPES_PER_QUESTION_MAX && others.iter().all(|name| !question.contains(name)));
        assert_eq!(questions.deadline(), None);
        // The intervals grow until an answer brings a type.
        let mut turn = |told: bool| {
            questions.answered(&OWNER);
            if told {
                assert!(questions.takes_told(&OWNER, 1));
                questions.ends(&OWNER, 1);
                assert!(questions.next(OWNER, later).is_some());
                questions.answered(&OWNER);
            }
            assert_eq!(questions.next(OWNER, later), None);
            let at = questions.deadline().unwrap();
            assert!(questions.next(OWNER, at).is_some());
            at - later
        };
        let turns: Vec<_> = (0..40).map(|_| turn(false)).collect();
        assert!(turns.is_sorted() && turns[3] == 4 * TURN_MIN && turns[39] == TURN_MAX, "{turns:?}");
        assert_eq!(turn(true), TURN_MIN);
    }

    #[test]
    fn question_keeps_its_names_until_the_owner_answers() {
        let (mut questions, now, all) = (TypeQuestions::default(), Instant::now(), names(130));
        assert_eq!(lack(&mut questions, &all, now).len(), 1);
        questions.answered(&OWNER);
        let fresh = questions.next(OWNER, now).unwrap();
        assert!(all[TYPES_PER_QUESTION_MAX..].iter().all(|name| fresh.contains(name)));
        questions.answered(&OWNER);
        all[..10].iter().for_each(|name| questions.settled(&OWNER, name));
        assert_eq!(questions.next(OWNER, now).unwrap().len(), 120);
        questions.answered(&OWNER);
        assert_eq!((questions.next(OWNER, now), questions.deadline()), (None, None));
        all.iter().for_each(|name| questions.settled(&OWNER, name));
        assert_eq!(questions.next(OWNER, now), Some(vec![]));
        assert_eq!(questions.next(OWNER, now), None);
    }

    #[test]
    fn concurrent_type_answers_are_bounded_and_asked_for_again() {
        let (mut questions, now) = (TypeQuestions::default(), Instant::now());
        let owners: Vec<_> = (0..20).map(|n| NodeId([n; 32])).collect();
        let half = TOLD_BYTES_PER_OWNER_MAX / 2;
        let name = names(1)[0];
        let mut taken = Vec::new();
        for owner in &owners {
            questions.lacks(*owner, name);
            assert_eq!(questions.next(*owner, now), Some(vec![name]));
            questions.answered(owner);
            taken.extend((0..3).filter(|_| questions.takes_told(owner, half)).map(|_| *owner));
        }
        assert_eq!(taken.len(), TOLD_BYTES_MAX / half, "of each two, while there is room");
        assert!(taken.iter().filter(|owner| **owner == owners[0]).count() == 2);
        assert!(questions.have_room().is_empty());
        taken.iter().for_each(|owner| questions.ends(owner, half));
        assert_eq!(questions.told_bytes, 0);
        let again = questions.have_room();
        assert_eq!(again.len(), owners.len());
        for owner in again {
            assert_eq!(questions.next(owner, now), Some(vec![name]));
        }
        // Descriptions that nobody asked for are refused.
        assert!(!questions.takes_told(&NodeId([99; 32]), 1));
    }
}
