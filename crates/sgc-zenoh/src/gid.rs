//! Ids of endpoints, as messages carry them.

use std::fmt;

use twox_hash::XxHash3_128;

/// The id of an endpoint: the hash of its liveliness token, XXH3-128 with seed 0, the low half first, both halves little
/// endian (rmw_zenoh `liveliness_utils.cpp`@3411fdec, `Entity::Entity`).
///
/// Not every program computes it in this way: rmw_zenoh 0.2.0 for Jazzy drew it at random, and hiroz 0.2.1 takes another
/// hash. So a message whose id belongs to no known token is an ordinary message.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Gid(pub [u8; 16]);

impl Gid {
    /// Returns the id of the endpoint with this token. The token is the text as it was declared: written anew after it was
    /// read, it may be another text and have another id.
    pub fn of_token(token: &str) -> Self {
        Self(XxHash3_128::oneshot(token.as_bytes()).to_le_bytes())
    }
}

/// Writes the digits as rmw_zenoh does, two for each byte (`buffer_endpoint_helpers.hpp`@b84b89ee, `gid_to_hex`).
impl fmt::Display for Gid {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for Gid {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Computed by xxHash 0.8.4 from the token of a publisher.
    #[test]
    fn the_id_is_the_hash_of_the_token() {
        let token = "@ros2_lv/0/5347430000000000000000000000beef/0/10/MP/%/%/talker/%chatter/\
                     std_msgs::msg::dds_::String_/\
                     RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18/:1:,7:,:,:,,";
        assert_eq!(Gid::of_token(token).to_string(), "936d9a80a8f50fa48d7cc63dbf606fb3");
    }

    /// Computed by xxHash 0.8.4. The hash has code of its own for each of these ranges of lengths.
    #[test]
    fn ids_of_all_lengths_are_those_of_xxhash() {
        for (bytes, id) in [
            (0, "7f498d4624c30160d8984701d306aa99"),
            (240, "390a763345d257ea06e2fdda1c726301"),
            (241, "3019ca5a5cefcff60b7bc0a2e4eb7b3e"),
            (1024, "1c7a58a9096b5d4a7542b2cc928c6252"),
            (1025, "eaa18dfbac636ad416dce49e33eb1dc9"),
            (3703, "f422a67fb013387529331d040d0934ee"),
        ] {
            assert_eq!(Gid::of_token(&"a".repeat(bytes)).to_string(), id, "{bytes}");
        }
        let node = "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener";
        assert_eq!(Gid::of_token(node).to_string(), "49877999dacb858702d11ac823785912");
    }
}
