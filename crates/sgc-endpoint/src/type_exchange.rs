//! Types over the wire: an owner describes the types of its interfaces, once, to nodes that ask and may have them.
//!
//! An owner is asked at a name of its own; it answers for a type once it knows that type. Descriptions are packed bytes
//! here: the reader checks that a description matches its type.

use std::collections::BTreeSet;

use bytes::Bytes;
use sgc_trust::{name_of, types_blind};
use sgc_wire::{
    Blind, Decode, DescribedType, Encode, GrantContent, Name, NodeId, Now, PayloadEncoding, RefuseReason,
    Request, Role, SEALED_BYTES_MAX, SinkId, TYPE_DESCRIPTION_BYTES_MAX, TYPE_HASH_BYTES_MAX,
    TYPES_PER_QUESTION_MAX, TypeQuestion,
};

use crate::Endpoint;
use crate::compression::{CompressionError, Compressor, Decompressor};
use crate::joins::JoinKind;
use crate::owner::{OLDER_REQUEST, is_older, place};
use crate::shares::GrantedSink;

/// Bytes of the length before a compressed description.
const LENGTH_BYTES: usize = 4;
/// Room for descriptions in one answer, bytes.
const ANSWER_BYTES_MAX: usize = SEALED_BYTES_MAX - 1024;

/// The description of a type as it travels.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PackedType {
    /// `RIHS01_…` hash of the described type.
    type_hash: String,
    encoding: PayloadEncoding,
    bytes: Bytes,
}

impl PackedType {
    /// Packs a description. Returns `None` if it, or the hash, is too long.
    pub fn new(type_hash: &str, description: &Bytes) -> Option<Self> {
        if description.len() > TYPE_DESCRIPTION_BYTES_MAX || type_hash.len() > TYPE_HASH_BYTES_MAX {
            return None;
        }
        let packed = Compressor::default().compress(PayloadEncoding::Zstd, description);
        let (encoding, bytes) = match packed {
            Some(packed) => (PayloadEncoding::Zstd, packed),
            None => (PayloadEncoding::Plain, description.clone()),
        };
        Some(Self { type_hash: type_hash.to_owned(), encoding, bytes })
    }

    fn describe(&self, name: Name) -> DescribedType {
        let (encoding, description) = (self.encoding, self.bytes.clone());
        DescribedType { name, type_hash: self.type_hash.clone(), encoding, description }
    }
}

/// Unpacks a received description. It takes no more memory than a description may have.
pub fn unpack_type(described: &DescribedType) -> Result<Bytes, CompressionError> {
    let packed = described.description.clone();
    if described.encoding != PayloadEncoding::Plain {
        let length = packed.first_chunk::<LENGTH_BYTES>().ok_or(CompressionError::Malformed)?;
        let claimed = u32::from_be_bytes(*length);
        if claimed as usize > TYPE_DESCRIPTION_BYTES_MAX {
            return Err(CompressionError::TooLong(claimed));
        }
    }
    Decompressor::default().decompress(described.encoding, packed)
}

/// A node that asked for types.
#[derive(Debug)]
pub(crate) struct TypeAsker {
    asker: GrantedSink,
    /// Types that it was not told yet.
    names: BTreeSet<Name>,
}

/// Returns the name at which an owner is asked for its types.
pub(crate) fn types_name(owner: &NodeId) -> (Name, Blind) {
    let blind = types_blind(owner);
    (name_of(owner, &blind), blind)
}

/// The owner's part.
impl Endpoint {
    /// Sets the description of a share's type. [`Endpoint::tell_types`] tells the askers, so that descriptions that
    /// become known at about one time travel together.
    pub fn describe(&mut self, now: Now, name: &Name, described: PackedType) {
        self.now = now;
        let Some(share) = self.shares.shares.get_mut(name) else { return };
        share.described = Some(described);
        if !std::mem::replace(&mut self.describes, true) {
            self.withdrawn.remove(&self.types_name.1);
            self.unadvertised.insert(self.types_name.1);
        }
        self.untold.insert(*name);
    }

    /// Tells the askers the types described since the last call.
    pub fn tell_types(&mut self, now: Now) {
        self.now = now;
        let untold = std::mem::take(&mut self.untold);
        let waiting = self.questions.iter().filter(|(_, asked)| !asked.names.is_disjoint(&untold));
        for sink in waiting.map(|(sink, _)| *sink).collect::<Vec<_>>() {
            self.answer_types(sink, false);
        }
    }

    pub(crate) fn is_types(&self, name: &Name) -> bool {
        self.types_name.0 == *name
    }

    /// Takes a question: every node that may know the owner may ask, and gets the types that it may have.
    pub(crate) fn handle_type_question(&mut self, name: Name, sink: SinkId, asker: GrantedSink) {
        let Request::Ask { what } = &asker.request else {
            return self.refuse(name, sink, 1, RefuseReason::RoleNotOffered);
        };
        let Ok(question) = TypeQuestion::from_slice(what) else {
            return self.refuse(name, sink, 1, RefuseReason::NotVerified);
        };
        let serial = match self.questions.get(&sink).map(|known| &known.asker) {
            Some(known) if is_older(&asker, known) => return self.unexpected(OLDER_REQUEST),
            Some(known) if known.peer.node_id == asker.peer.node_id => known.serial,
            Some(_) => return self.refuse(name, sink, 1, RefuseReason::Limit),
            None => {
                let askers = self.questions.iter().map(|(sink, asked)| (sink, &asked.asker));
                match place(askers, &asker, &self.config.limits) {
                    Ok(None) => {}
                    Ok(Some(oldest)) => self.end_question(oldest, RefuseReason::Limit),
                    Err(reason) => return self.refuse(name, sink, 1, reason),
                }
                0
            }
        };
        let names = question.names.into_iter().collect();
        self.questions.insert(sink, TypeAsker { asker: GrantedSink { serial, ..asker }, names });
        self.answer_types(sink, true);
    }

    /// Tells an asker the known types that it was not told yet; with `at_least`, also that there are none. Types
    /// without room in one answer are asked for again.
    fn answer_types(&mut self, sink: SinkId, at_least: bool) {
        let Some(asked) = self.questions.get_mut(&sink) else { return };
        let (mut types, mut bytes) = (Vec::new(), 0);
        for name in &asked.names {
            let Some(share) = self.shares.shares.get(name) else { continue };
            let policy = &share.spec.policy;
            let may = |role| policy.permits(&asked.asker.peer, role).is_ok();
            let Some(described) =
                share.described.as_ref().filter(|_| may(Role::Subscribe) || may(Role::Publish))
            else {
                continue;
            };
            let described = described.describe(*name);
            let more = described.to_vec().len();
            if bytes + more <= ANSWER_BYTES_MAX {
                bytes += more;
                types.push(described);
            }
        }
        if types.is_empty() && !at_least {
            return;
        }
        asked.names.retain(|name| types.iter().all(|told| told.name != *name));
        asked.asker.serial += 1;
        let (serial, reply_key) = (asked.asker.serial, asked.asker.reply_key.clone());
        if !self.grant(self.types_name.0, sink, serial, &reply_key, &GrantContent::Types(types)) {
            self.questions.remove(&sink);
        }
    }

    /// Cuts askers that lost their certificate.
    pub(crate) fn enforce_types(&mut self) {
        let lost = |(sink, asked): (&SinkId, &TypeAsker)| {
            self.standing(&asked.asker.peer).map(|reason| (*sink, reason))
        };
        let lost: Vec<_> = self.questions.iter().filter_map(lost).collect();
        for (sink, reason) in lost {
            self.end_question(sink, reason);
        }
    }

    fn end_question(&mut self, sink: SinkId, reason: RefuseReason) {
        if let Some(asked) = self.questions.remove(&sink) {
            self.refuse(self.types_name.0, sink, asked.asker.serial + 1, reason);
        }
    }

    pub(crate) fn withdraw_types(&mut self) {
        if std::mem::take(&mut self.describes) {
            self.unadvertised.remove(&self.types_name.1);
            self.withdrawn.insert(self.types_name.1);
        }
        self.questions.clear();
        self.untold.clear();
    }
}

/// The asker's part.
impl Endpoint {
    /// Asks an owner for the types of these interfaces, the first [`TYPES_PER_QUESTION_MAX`] of them, until the next
    /// question, or for none. Each question is answered in full, also with types told before. An owner that describes
    /// none, or of a version that cannot, does not advertise the name of the question: then nothing happens.
    pub fn ask_types(&mut self, now: Now, owner: NodeId, mut names: Vec<Name>) {
        self.now = now;
        names.truncate(TYPES_PER_QUESTION_MAX);
        let (name, _) = types_name(&owner);
        self.leave(now, &name);
        if !names.is_empty() {
            self.join(now, name, owner, JoinKind::Types(names));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn described(encoding: PayloadEncoding, description: impl Into<Bytes>) -> DescribedType {
        DescribedType {
            name: Name([1; 32]),
            type_hash: "RIHS01_00".into(),
            encoding,
            description: description.into(),
        }
    }

    #[test]
    fn a_description_comes_back_whether_it_shrinks_or_not() {
        for bytes in [Bytes::from_static(b"short"), vec![7; TYPE_DESCRIPTION_BYTES_MAX].into()] {
            let packed = PackedType::new("RIHS01_00", &bytes).unwrap();
            assert_eq!(unpack_type(&packed.describe(Name([1; 32]))), Ok(bytes));
        }
        let long = Bytes::from(vec![0; TYPE_DESCRIPTION_BYTES_MAX + 1]);
        assert_eq!(PackedType::new("RIHS01_00", &long), None);
        assert_eq!(PackedType::new(&"x".repeat(TYPE_HASH_BYTES_MAX + 1), &Bytes::new()), None);
    }

    #[test]
    fn a_bomb_is_refused_by_what_it_claims() {
        let bomb = Compressor::default().compress(PayloadEncoding::Zstd, &vec![0; 8 << 20]).unwrap();
        let refused = unpack_type(&described(PayloadEncoding::Zstd, bomb.clone()));
        assert_eq!(refused, Err(CompressionError::TooLong(8 << 20)));
        let mut lies = bomb.to_vec();
        lies[..LENGTH_BYTES].copy_from_slice(&1000_u32.to_be_bytes());
        assert_eq!(unpack_type(&described(PayloadEncoding::Zstd, lies)), Err(CompressionError::Malformed));
        let cut = unpack_type(&described(PayloadEncoding::Zstd, &b"abc"[..]));
        assert_eq!(cut, Err(CompressionError::Malformed));
    }
}
