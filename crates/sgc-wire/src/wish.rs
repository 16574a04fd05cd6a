//! Wishes: the most that a node wants of a topic, as it tells the topic's owner.

use std::time::Duration;

use crate::codec::{Decode, DecodeError, Encode, Reader, Writer};
use crate::ids::Name;

/// Most wishes in one answer.
pub const WISHES_MAX: usize = 512;

/// A wish for less of a topic. Its owner may fulfil it, and need not.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Wish {
    /// The topic.
    pub interface: Name,
    /// Least time between two messages.
    pub interval: Option<Duration>,
    /// Most bits of payload a second.
    pub bits_per_s: Option<u64>,
}

impl Encode for Wish {
    fn encode(&self, w: &mut Writer) {
        self.interface.encode(w);
        let micros = |interval: Duration| u64::try_from(interval.as_micros()).unwrap_or(u64::MAX);
        w.u64(self.interval.map_or(0, micros));
        w.u64(self.bits_per_s.unwrap_or(0));
    }
}

impl Decode for Wish {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        let (interface, micros, bits) = (Name::decode(r)?, r.u64()?, r.u64()?);
        let interval = (micros > 0).then(|| Duration::from_micros(micros));
        Ok(Self { interface, interval, bits_per_s: (bits > 0).then_some(bits) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::catalogue::GrantContent;
    use crate::control::SEALED_BYTES_MAX;

    const SLOW: Wish = Wish {
        interface: Name([7; 32]),
        interval: Some(Duration::from_millis(200)),
        bits_per_s: Some(1_000_000),
    };

    /// The bytes are normative.
    #[test]
    fn wishes_have_these_bytes() {
        let bytes = [&[7; 32][..], &200_000_u64.to_be_bytes(), &1_000_000_u64.to_be_bytes()].concat();
        assert_eq!((SLOW.to_vec(), Wish::from_slice(&bytes)), (bytes.clone(), Ok(SLOW)));
        let none = Wish { interval: None, bits_per_s: None, ..SLOW };
        assert_eq!(Wish::from_slice(&none.to_vec()), Ok(none));
        let content = GrantContent::Wishes(vec![SLOW]);
        assert_eq!(content.to_vec(), [&[9, 0, 0, 0, 1][..], &bytes].concat());
        assert_eq!(GrantContent::from_slice(&content.to_vec()), Ok(content));
    }

    #[test]
    fn the_longest_answer_has_room_and_a_longer_one_is_refused() {
        let longest = vec![SLOW; WISHES_MAX + 1];
        let fits = GrantContent::Wishes(longest[1..].to_vec()).to_vec();
        assert!(fits.len() < SEALED_BYTES_MAX && GrantContent::from_slice(&fits).is_ok());
        let refused = GrantContent::from_slice(&GrantContent::Wishes(longest).to_vec());
        assert!(matches!(refused, Err(DecodeError::TooLong { field: "wishes", .. })), "{refused:?}");
    }
}
