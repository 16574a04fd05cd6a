//! The secrets that members of a fleet share, without routers: names are derived from them.
//!
//! A node's id follows from the fleet secret alone, for ever; names of interfaces follow from the newest *naming
//! secret*. So a fleet can stop former members from recognising its names, and no node gets another id.

use std::fmt;

use aws_lc_rs::hmac;
use rand_core::CryptoRng;
use sgc_wire::{GroupTag, Pseudonym};
use zeroize::{Zeroize, ZeroizeOnDrop, Zeroizing};

const PSEUDONYM_DOMAIN: &str = "sgc pseudonym v1";
const GROUP_DOMAIN: &str = "sgc group v1";
const PUBLISHER_DOMAIN: &str = "sgc publisher v1";
pub(crate) const SECRET_BLOCK: &str = "SGC FLEET SECRET";
pub(crate) const NAMING_BLOCK: &str = "SGC NAMING SECRET";
pub(crate) const SECRET_BYTES: usize = 32;

/// The secret of a fleet's members, without routers: the root of all its names. Never printed.
#[derive(Clone, Zeroize, ZeroizeOnDrop)]
pub struct FleetSecret([u8; SECRET_BYTES]);

impl FleetSecret {
    /// Takes the bytes of a secret.
    pub fn from_bytes(bytes: [u8; SECRET_BYTES]) -> Self {
        Self(bytes)
    }

    pub(crate) fn generate(rng: &mut impl CryptoRng) -> Self {
        let mut secret = Self([0; SECRET_BYTES]);
        rng.fill_bytes(&mut secret.0);
        secret
    }

    pub(crate) fn read(bytes: &[u8]) -> Option<Self> {
        let mut secret = Self([0; SECRET_BYTES]);
        (bytes.len() == SECRET_BYTES).then(|| secret.0.copy_from_slice(bytes))?;
        Some(secret)
    }

    /// Returns the bytes, for deriving from them. They belong in no log and in no packet.
    pub fn expose(&self) -> &[u8; SECRET_BYTES] {
        &self.0
    }

    /// Returns the pseudonym of the node of this name.
    pub fn pseudonym(&self, node_name: &str) -> Pseudonym {
        Pseudonym(self.tag(PSEUDONYM_DOMAIN, node_name))
    }

    /// Returns the tag of the group of this name.
    pub fn group_tag(&self, group: &str) -> GroupTag {
        GroupTag(self.tag(GROUP_DOMAIN, group))
    }

    /// Returns the beginning of the source ids of a local publisher: the same whenever its node starts, and random to
    /// everyone without the secret. `publisher` identifies it on its network.
    pub fn publisher_tag(&self, publisher: &[u8; 16]) -> [u8; 8] {
        let mut mac = hmac::Context::with_key(&hmac::Key::new(hmac::HMAC_SHA256, &self.0));
        mac.update(PUBLISHER_DOMAIN.as_bytes());
        mac.update(&[0]);
        mac.update(publisher);
        let mut out = [0; 8];
        out.copy_from_slice(&mac.sign().as_ref()[..8]);
        out
    }

    fn tag(&self, domain: &str, name: &str) -> [u8; 32] {
        let mut mac = hmac::Context::with_key(&hmac::Key::new(hmac::HMAC_SHA256, &self.0));
        mac.update(domain.as_bytes());
        mac.update(&[0]);
        mac.update(name.as_bytes());
        let mut out = [0; 32];
        out.copy_from_slice(mac.sign().as_ref());
        out
    }
}

impl fmt::Debug for FleetSecret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("FleetSecret(..)")
    }
}

/// One generation of the secret that names are derived from.
#[derive(Clone, Debug)]
pub struct NamingSecret {
    /// Its number; 1 is the fleet secret itself.
    pub generation: u32,
    /// The secret.
    pub secret: FleetSecret,
}

impl NamingSecret {
    /// The first generation whose secret has a block of its own.
    pub(crate) const STORED_FROM: u32 = 2;

    /// Reads the output of [`NamingSecret::to_block`].
    pub(crate) fn from_block(content: &[u8]) -> Option<Self> {
        let (generation, secret) = content.split_first_chunk()?;
        let generation = u32::from_be_bytes(*generation);
        (generation >= Self::STORED_FROM).then_some(())?;
        Some(Self { generation, secret: FleetSecret::read(secret)? })
    }

    /// Returns `u32 generation ‖ secret`.
    pub(crate) fn to_block(&self) -> Zeroizing<Vec<u8>> {
        let mut block = Zeroizing::new(Vec::with_capacity(4 + SECRET_BYTES));
        block.extend_from_slice(&self.generation.to_be_bytes());
        block.extend_from_slice(self.secret.expose());
        block
    }
}
