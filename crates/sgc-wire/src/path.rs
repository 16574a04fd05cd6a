//! Direct paths over the wire: where a node can be reached, for a peer that wants a link without a router.

use crate::codec::{Decode, DecodeError, Encode, Reader, Writer};
use crate::control::Place;
use crate::ids::SecretBytes;

/// Most candidates in an offer.
pub const PATH_CANDIDATES_MAX: usize = 8;
/// Length of every encoded offer, bytes. It is also the most that its receiver sends to addresses that have not answered
/// yet, so nobody multiplies traffic by naming the addresses of others.
pub const PATH_OFFER_BYTES: usize = 2048;

/// Length of an offer without candidates and padding: attempt, user name, password, and the lengths of both.
const FIXED_BYTES: usize = 8 + 4 + 32 + 4 + 4;
/// Length of a candidate: kind and place.
const CANDIDATE_BYTES: usize = 1 + 18;

/// A question at the name of a node's paths.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PathQuestion {
    /// Number of the asking node's attempt, random. Another number means that the node began anew.
    pub attempt: u64,
}

/// The answer to a [`PathQuestion`]: what connectivity checks (RFC 8445) of the answering node need.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PathOffer {
    /// Number of the answering node's attempt.
    pub attempt: u64,
    /// User name of its checks; the `ufrag` is this in hexadecimal digits.
    pub user: [u8; 4],
    /// Password of its checks, in hexadecimal digits.
    pub password: SecretBytes,
    /// Addresses at which it may be reached, at most [`PATH_CANDIDATES_MAX`].
    pub candidates: Vec<PathCandidate>,
}

/// An address at which a node may be reached by UDP.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PathCandidate {
    /// Its origin.
    pub kind: CandidateKind,
    /// The address.
    pub place: Place,
}

/// The origin of a candidate (RFC 8445, 5.1.1).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum CandidateKind {
    /// The address of an interface.
    Host,
    /// The address from which others see the node's packets come.
    ServerReflexive,
}

impl Encode for PathQuestion {
    fn encode(&self, w: &mut Writer) {
        w.u64(self.attempt);
    }
}

impl Decode for PathQuestion {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        Ok(Self { attempt: r.u64()? })
    }
}

impl Encode for PathOffer {
    fn encode(&self, w: &mut Writer) {
        let Self { attempt, user, password, candidates } = self;
        w.u64(*attempt);
        w.raw(user);
        password.encode(w);
        w.list(candidates, |w, candidate| candidate.encode(w));
        w.bytes(&vec![0; padding(candidates.len())]);
    }
}

impl Decode for PathOffer {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        let (attempt, user, password) = (r.u64()?, r.array("user name")?, SecretBytes::decode(r)?);
        let candidates = r.list("path candidates", PATH_CANDIDATES_MAX, PathCandidate::decode)?;
        let padded = r.bytes("padding of an offer", PATH_OFFER_BYTES)?;
        if padded.len() != padding(candidates.len()) || padded.iter().any(|byte| *byte != 0) {
            return Err(DecodeError::value("padding of an offer", padded.len() as u64));
        }
        Ok(Self { attempt, user, password, candidates })
    }
}

impl Encode for PathCandidate {
    fn encode(&self, w: &mut Writer) {
        w.u8(self.kind as u8);
        self.place.encode(w);
    }
}

impl Decode for PathCandidate {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        let kind = match r.u8()? {
            0 => CandidateKind::Host,
            1 => CandidateKind::ServerReflexive,
            v => return Err(DecodeError::value("kind of a candidate", v.into())),
        };
        Ok(Self { kind, place: Place::decode(r)? })
    }
}

/// Returns the number of bytes that fill up an offer with so many candidates.
fn padding(candidates: usize) -> usize {
    PATH_OFFER_BYTES.saturating_sub(FIXED_BYTES + candidates * CANDIDATE_BYTES)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn offer(candidates: usize) -> PathOffer {
        let candidate = |n: usize| PathCandidate {
            kind: if n.is_multiple_of(2) { CandidateKind::Host } else { CandidateKind::ServerReflexive },
            place: Place { ip: [n as u8; 16], port: 7 },
        };
        PathOffer {
            attempt: 0x0102_0304_0506_0708,
            user: [9; 4],
            password: SecretBytes::new([8; 32]),
            candidates: (0..candidates).map(candidate).collect(),
        }
    }

    #[test]
    fn question_and_offer_have_these_bytes() {
        let question = PathQuestion { attempt: 0x0102_0304_0506_0708 };
        assert_eq!(question.to_vec(), [1, 2, 3, 4, 5, 6, 7, 8]);
        assert_eq!(PathQuestion::from_slice(&question.to_vec()), Ok(question));
        let bytes = offer(2).to_vec();
        let mut expected = vec![1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 9];
        expected.extend([8; 32]);
        expected.extend([0, 0, 0, 2, 0]);
        expected.extend([0; 16]);
        expected.extend([0, 7, 1]);
        expected.extend([1; 16]);
        expected.extend([0, 7]);
        expected.extend((2048 - 52 - 38_u32).to_be_bytes());
        assert_eq!(bytes[..expected.len()], expected);
    }

    #[test]
    fn every_offer_is_as_long_as_what_it_may_cause() {
        for candidates in 0..=PATH_CANDIDATES_MAX {
            let bytes = offer(candidates).to_vec();
            assert_eq!(bytes.len(), PATH_OFFER_BYTES);
            assert_eq!(PathOffer::from_slice(&bytes), Ok(offer(candidates)));
        }
        assert!(PathOffer::from_slice(&offer(PATH_CANDIDATES_MAX + 1).to_vec()).is_err());
        let mut filled = offer(1).to_vec();
        *filled.last_mut().expect("it is not empty") = 1;
        assert!(PathOffer::from_slice(&filled).is_err(), "each value has one encoding");
        let mut short = offer(1).to_vec();
        short.truncate(FIXED_BYTES - 4 + CANDIDATE_BYTES);
        short.extend([0; 4]);
        assert!(PathOffer::from_slice(&short).is_err());
    }
}
