//! One signature for up to 64 packets of a source: a Merkle tree over them (RFC 6962, 2.1), whose root is signed.
//!
//! Each packet carries its audit path, its place and the signature behind its tag, so it verifies without the others. A
//! receiver checks a signature once per batch and remembers the hashes of its tree: a later packet costs little more
//! than its own hash. [`crate::SourceKey`] seals the packets.

use std::collections::VecDeque;

use aws_lc_rs::digest;
use bytes::BufMut;
use sgc_wire::PacketHeader;

use crate::message_key::VerifyKey;
use crate::receiver::{FORM_SIGNATURE, form_bytes};
use crate::{MessageKey, OpenError, Suite, TAG_BYTES, opened_bytes};

/// Most packets under one signature.
pub const BATCH_PACKETS_MAX: usize = 64;

/// Batches of one source that a receiver remembers: those that may arrive interleaved.
const BATCHES_KNOWN_MAX: usize = 4;

/// Bytes of a hash.
const HASH_BYTES: usize = 32;
/// Bytes of a packet's place in its batch: `u16` index and `u16` count.
const PLACE_BYTES: usize = 4;
/// Nodes of a tree of 64 leaves; smaller trees have fewer, with nodes on two levels counted twice.
const NODES_MAX: usize = 127;
/// A node and its sibling on each of 7 levels.
const WALK_NODES_MAX: usize = 14;

type Hash = [u8; HASH_BYTES];

/// Collects the packets of a batch at their source.
#[derive(Debug, Default)]
pub struct Batch {
    leaves: Vec<Hash>,
    /// A used batch, whose memory serves the next.
    spare: SignedBatch,
}

/// A batch with its signature.
#[derive(Debug, Default)]
pub struct SignedBatch {
    count: usize,
    /// All levels, leaves first.
    nodes: Vec<Hash>,
    signature: Vec<u8>,
}

impl Batch {
    /// Adds a packet: its header, and its sealed bytes (ciphertext and tag).
    pub fn push(&mut self, header: &PacketHeader, sealed: &[u8]) {
        debug_assert!(!self.is_full());
        self.leaves.push(leaf(header, sealed));
    }

    /// Signs the collected packets, and begins anew. There must be at least one.
    pub fn sign(&mut self, key: &MessageKey) -> SignedBatch {
        let SignedBatch { mut nodes, mut signature, .. } = std::mem::take(&mut self.spare);
        let count = self.leaves.len();
        nodes.clear();
        nodes.reserve(2 * count + 6);
        nodes.append(&mut self.leaves);
        let (mut start, mut width) = (0, count);
        while width > 1 {
            for i in (start..start + width).step_by(2) {
                let parent = match nodes.get(i + 1).filter(|_| i + 1 < start + width) {
                    Some(right) => node(&nodes[i], right),
                    None => nodes[i],
                };
                nodes.push(parent);
            }
            (start, width) = (start + width, width.div_ceil(2));
        }
        key.sign(&signed_bytes(count as u16, &nodes[start]), &mut signature);
        SignedBatch { count, nodes, signature }
    }

    /// Takes back a used batch, so that signing the next takes no memory.
    pub fn reuse(&mut self, over: SignedBatch) {
        self.spare = over;
    }

    /// Returns the number of collected packets.
    pub fn len(&self) -> usize {
        self.leaves.len()
    }

    /// Returns `true` if there are no packets.
    pub fn is_empty(&self) -> bool {
        self.leaves.is_empty()
    }

    /// Returns `true` if no packet fits any more.
    pub fn is_full(&self) -> bool {
        self.len() >= BATCH_PACKETS_MAX
    }
}

impl SignedBatch {
    /// Appends the trailer of the packet that was added as number `index`.
    pub fn put_trailer(&self, suite: Suite, index: usize, out: &mut impl BufMut) {
        if suite.is_pairwise() {
            out.put_u8(FORM_SIGNATURE);
        }
        for (level, sibling) in siblings(index, self.count) {
            out.put_slice(&self.nodes[position(self.count, level, sibling)]);
        }
        out.put_u16(index as u16);
        out.put_u16(self.count as u16);
        out.put_slice(&self.signature);
    }
}

/// Returns the longest trailer with a signature of a suite's packets, bytes.
pub fn trailer_bytes_max(suite: Suite) -> usize {
    match suite.scheme().signature_bytes() {
        0 => 0,
        signature => form_bytes(suite) + 6 * HASH_BYTES + PLACE_BYTES + signature,
    }
}

/// Verifies one source's packets.
pub struct BatchVerifier {
    key: VerifyKey,
    /// Bytes between tag and trailer.
    form_bytes: usize,
    known: VecDeque<KnownBatch>,
    checked: u64,
}

/// A batch whose signature verified, and the nodes of its tree that follow from it. With a node, its sibling, its
/// ancestors and their siblings are known.
struct KnownBatch {
    count: u16,
    signature: Vec<u8>,
    known: u128,
    nodes: Vec<Hash>,
}

/// The nodes hashed from a leaf up to the first known node, or to the root.
struct MerkleWalk {
    found: [(usize, Hash); WALK_NODES_MAX],
    len: usize,
    /// The last computed node: the root, unless a known node was met.
    root: Hash,
}

impl BatchVerifier {
    /// Returns a verifier for sources with this announced key; `None` if it is not a key of that suite.
    pub fn new(suite: Suite, key: &[u8]) -> Option<Self> {
        let form_bytes = form_bytes(suite);
        Some(Self { key: VerifyKey::new(suite, key)?, form_bytes, known: VecDeque::new(), checked: 0 })
    }

    /// Verifies that the source signed this packet. At most one signature is checked, and only success is remembered.
    pub fn verify(&mut self, header: &PacketHeader, payload: &[u8]) -> Result<(), OpenError> {
        let (sealed, trailer) = split(header, payload, self.form_bytes, self.key.signature_bytes())?;
        let Trailer { path, index, count, signature } = trailer;
        let leaf = leaf(header, sealed);
        let known = self.known.iter_mut().find(|b| b.count == count && b.signature == signature);
        if let Some(batch) = known {
            let walk = batch.walk(leaf, index, path)?;
            batch.learn(&walk);
            return Ok(());
        }
        let mut batch = KnownBatch { count, signature: Vec::new(), known: 0, nodes: Vec::new() };
        let walk = batch.walk(leaf, index, path)?;
        self.checked += 1;
        if !self.key.verify(&signed_bytes(count, &walk.root), signature) {
            return Err(OpenError::Signature);
        }
        if count > 1 {
            batch.nodes = vec![[0; HASH_BYTES]; position(count.into(), height(count.into()), 0) + 1];
            batch.signature = signature.to_vec();
            batch.learn(&walk);
            if self.known.len() >= BATCHES_KNOWN_MAX {
                self.known.pop_front();
            }
            self.known.push_back(batch);
        }
        Ok(())
    }

    /// Returns the number of checked signatures, valid or not.
    pub fn signatures_checked(&self) -> u64 {
        self.checked
    }
}

impl KnownBatch {
    /// Hashes upwards from a leaf to the first known node, or to the root. Nodes above a known one must be known too,
    /// and match the path.
    fn walk(&self, leaf: Hash, index: u16, path: &[u8]) -> Result<MerkleWalk, OpenError> {
        let (count, index) = (usize::from(self.count), usize::from(index));
        let mut walk = MerkleWalk { found: [(0, leaf); WALK_NODES_MAX], len: 0, root: leaf };
        let (mut current, mut trusted) = (leaf, false);
        let mut siblings_left = siblings(index, count).zip(path.chunks_exact(HASH_BYTES)).peekable();
        for level in 0..=height(count) {
            let at = position(count, level, index >> level);
            if !trusted {
                match self.node(at) {
                    Some(known) if *known != current => return Err(OpenError::Signature),
                    Some(_) => trusted = true,
                    None => walk.add(at, current),
                }
            }
            if let Some(((_, place), sibling)) = siblings_left.next_if(|((l, _), _)| *l == level) {
                let sibling: Hash = sibling.try_into().map_err(|_| OpenError::Trailer)?;
                let at = position(count, level, place);
                match self.node(at) {
                    Some(known) if *known != sibling => return Err(OpenError::Signature),
                    Some(_) => {}
                    None => walk.add(at, sibling),
                }
                if !trusted {
                    current =
                        if place % 2 == 0 { node(&sibling, &current) } else { node(&current, &sibling) };
                }
            }
        }
        walk.root = current;
        Ok(walk)
    }

    fn node(&self, at: usize) -> Option<&Hash> {
        if self.known & (1 << at) != 0 { self.nodes.get(at) } else { None }
    }

    fn learn(&mut self, walk: &MerkleWalk) {
        for (at, hash) in &walk.found[..walk.len] {
            if let Some(node) = self.nodes.get_mut(*at) {
                *node = *hash;
                self.known |= 1 << at;
            }
        }
    }
}

impl MerkleWalk {
    fn add(&mut self, at: usize, hash: Hash) {
        self.found[self.len] = (at, hash);
        self.len += 1;
    }
}

/// The bytes behind a packet's tag.
struct Trailer<'a> {
    path: &'a [u8],
    index: u16,
    count: u16,
    signature: &'a [u8],
}

/// Divides a payload into sealed bytes and trailer. Every length must match header, index and count.
fn split<'a>(
    header: &PacketHeader,
    payload: &'a [u8],
    form_bytes: usize,
    signature_bytes: usize,
) -> Result<(&'a [u8], Trailer<'a>), OpenError> {
    let (sealed, trailer) =
        payload.split_at_checked(opened_bytes(header) + TAG_BYTES).ok_or(OpenError::Length)?;
    let (form, trailer) = trailer.split_at_checked(form_bytes).ok_or(OpenError::Length)?;
    if form.iter().any(|byte| *byte != FORM_SIGNATURE) {
        return Err(OpenError::Trailer);
    }
    let path_bytes = trailer.len().checked_sub(PLACE_BYTES + signature_bytes).ok_or(OpenError::Length)?;
    let (path, rest) = trailer.split_at(path_bytes);
    let (place, signature) = rest.split_at(PLACE_BYTES);
    let [i0, i1, c0, c1] = *place else { return Err(OpenError::Length) };
    let (index, count) = (u16::from_be_bytes([i0, i1]), u16::from_be_bytes([c0, c1]));
    let fits = index < count
        && usize::from(count) <= BATCH_PACKETS_MAX
        && path.len() == siblings(index.into(), count.into()).count() * HASH_BYTES;
    if fits { Ok((sealed, Trailer { path, index, count, signature })) } else { Err(OpenError::Trailer) }
}

/// Returns `SHA-256(0x00 ‖ header as authenticated ‖ ciphertext ‖ tag)`.
fn leaf(header: &PacketHeader, sealed: &[u8]) -> Hash {
    let mut context = digest::Context::new(&digest::SHA256);
    context.update(&[0]);
    context.update(header.associated_data().as_ref());
    context.update(sealed);
    hash(&context.finish())
}

/// Returns `SHA-256(0x01 ‖ left ‖ right)`.
fn node(left: &Hash, right: &Hash) -> Hash {
    let mut text = [1; 1 + 2 * HASH_BYTES];
    text[1..=HASH_BYTES].copy_from_slice(left);
    text[1 + HASH_BYTES..].copy_from_slice(right);
    hash(&digest::digest(&digest::SHA256, &text))
}

fn hash(digest: &digest::Digest) -> Hash {
    let mut out = [0; HASH_BYTES];
    out.copy_from_slice(digest.as_ref());
    out
}

/// Returns `"sgc batch v1" ‖ 0x00 ‖ u16 count ‖ root`.
fn signed_bytes(count: u16, root: &Hash) -> [u8; 47] {
    let mut out = [0; 47];
    out[..12].copy_from_slice(b"sgc batch v1");
    out[13..15].copy_from_slice(&count.to_be_bytes());
    out[15..].copy_from_slice(root);
    out
}

/// Returns the number of levels above the leaves.
fn height(count: usize) -> usize {
    count.next_power_of_two().trailing_zeros() as usize
}

/// Returns the index of a node in a list of all levels, leaves first. Below [`NODES_MAX`].
fn position(count: usize, level: usize, index: usize) -> usize {
    let below: usize = (0..level).map(|l| width(count, l)).sum();
    debug_assert!(below + index < NODES_MAX);
    below + index
}

/// Returns the number of nodes on a level. The last node of an odd number has no sibling and stands on the next level
/// too; this gives the trees of RFC 6962, where the left part is the largest power of two.
fn width(count: usize, level: usize) -> usize {
    count.div_ceil(1 << level)
}

/// Iterates over the siblings from a leaf to the root, as level and place on it: the audit path.
fn siblings(index: usize, count: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..height(count)).filter_map(move |level| {
        let place = (index >> level) ^ 1;
        (place < width(count, level)).then_some((level, place))
    })
}
