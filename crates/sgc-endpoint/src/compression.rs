//! Compression of payloads before sealing, and decompression after opening.
//!
//! Both ends keep their algorithm's memory from message to message. The driver decides which payloads to compress, and
//! counts. A payload that does not shrink is sent unchanged, so each message names its encoding.

use bytes::{BufMut, Bytes, BytesMut};
use lz4_flex::block::CompressTable;
use sgc_wire::{MESSAGE_BYTES_MAX, PayloadEncoding};

/// Shorter payloads are not tried: there is little to gain.
pub const COMPRESS_BYTES_MIN: usize = 256;
/// The level of Zstandard: the fastest of its regular ones, because a message waits for its compression.
const ZSTD_LEVEL: i32 = 1;
/// Bytes of the length before compressed data.
const LENGTH_BYTES: usize = 4;
/// Most bytes that one byte of LZ4 stands for.
const LZ4_RATIO_MAX: usize = 255;

/// The reason why a payload was not decompressed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CompressionError {
    /// The payload claims to be longer than any message.
    #[error("a compressed payload that claims {0} bytes")]
    TooLong(u32),
    /// Malformed data, or another length than claimed.
    #[error("a compressed payload that is malformed, or not of the length that it claims")]
    Malformed,
    /// The algorithm has no memory.
    #[error("no memory to decompress with")]
    Memory,
}

/// Compresses payloads.
#[derive(Default)]
pub struct Compressor {
    zstd: Option<zstd::bulk::Compressor<'static>>,
    lz4: Option<CompressTable>,
    scratch: Vec<u8>,
}

impl Compressor {
    /// Returns the payload in this encoding, if that is shorter by more than an eighth: less is not worth the other
    /// end's time.
    pub fn compress(&mut self, encoding: PayloadEncoding, payload: &[u8]) -> Option<Bytes> {
        if !(COMPRESS_BYTES_MIN..=MESSAGE_BYTES_MAX as usize).contains(&payload.len()) {
            return None;
        }
        let most = payload.len() - payload.len() / 8 - LENGTH_BYTES;
        let bytes = match encoding {
            PayloadEncoding::Plain => return None,
            PayloadEncoding::Zstd => {
                if self.zstd.is_none() {
                    self.zstd = zstd::bulk::Compressor::new(ZSTD_LEVEL).ok();
                }
                self.scratch.clear();
                self.scratch.reserve_exact(most);
                // Output that does not fit its room is an error: the payload does not shrink.
                let bytes = self.zstd.as_mut()?.compress_to_buffer(payload, &mut self.scratch).ok()?;
                Some(bytes).filter(|bytes| *bytes <= most)?
            }
            PayloadEncoding::Lz4 => {
                self.scratch.resize(lz4_flex::block::get_maximum_output_size(payload.len()), 0);
                let table = self.lz4.get_or_insert_default();
                let bytes =
                    lz4_flex::block::compress_into_with_table(payload, &mut self.scratch, table).ok()?;
                Some(bytes).filter(|bytes| *bytes <= most)?
            }
        };
        let mut out = BytesMut::with_capacity(LENGTH_BYTES + bytes);
        out.put_u32(payload.len() as u32);
        out.put_slice(&self.scratch[..bytes]);
        Some(out.freeze())
    }
}

/// Decompresses payloads.
#[derive(Default)]
pub struct Decompressor {
    zstd: Option<zstd::bulk::Decompressor<'static>>,
}

impl Decompressor {
    /// Returns the length of the original payload as the payload claims it. A malformed payload has its own length.
    pub fn original_bytes(encoding: PayloadEncoding, payload: &[u8]) -> usize {
        match payload.first_chunk::<LENGTH_BYTES>() {
            Some(length) if encoding != PayloadEncoding::Plain => u32::from_be_bytes(*length) as usize,
            _ => payload.len(),
        }
    }

    /// Returns the original payload. It takes the claimed memory and no more, which is at most that of a message.
    pub fn decompress(
        &mut self,
        encoding: PayloadEncoding,
        payload: Bytes,
    ) -> Result<Bytes, CompressionError> {
        if encoding == PayloadEncoding::Plain {
            return Ok(payload);
        }
        let (length, packed) =
            payload.split_first_chunk::<LENGTH_BYTES>().ok_or(CompressionError::Malformed)?;
        let claimed = u32::from_be_bytes(*length);
        if claimed > MESSAGE_BYTES_MAX {
            return Err(CompressionError::TooLong(claimed));
        }
        let bytes = claimed as usize;
        let mut out = Vec::new();
        let found = match encoding {
            PayloadEncoding::Plain => return Ok(payload),
            PayloadEncoding::Zstd => {
                if self.zstd.is_none() {
                    self.zstd = zstd::bulk::Decompressor::new().ok();
                }
                let zstd = self.zstd.as_mut().ok_or(CompressionError::Memory)?;
                out.try_reserve_exact(bytes).map_err(|_| CompressionError::Memory)?;
                zstd.decompress_to_buffer(packed, &mut out).map_err(|_| CompressionError::Malformed)?
            }
            PayloadEncoding::Lz4 => {
                if bytes > packed.len().saturating_mul(LZ4_RATIO_MAX) {
                    return Err(CompressionError::Malformed);
                }
                out.try_reserve_exact(bytes).map_err(|_| CompressionError::Memory)?;
                out.resize(bytes, 0);
                lz4_flex::block::decompress_into(packed, &mut out).map_err(|_| CompressionError::Malformed)?
            }
        };
        // An empty payload is never compressed.
        if found != bytes || bytes == 0 {
            return Err(CompressionError::Malformed);
        }
        Ok(out.into())
    }
}

/// Packs a document: with Zstandard if it shrinks, or else as it is.
pub(crate) fn pack(document: &Bytes) -> (PayloadEncoding, Bytes) {
    match Compressor::default().compress(PayloadEncoding::Zstd, document) {
        Some(packed) => (PayloadEncoding::Zstd, packed),
        None => (PayloadEncoding::Plain, document.clone()),
    }
}

/// Unpacks a received document, which has at most `most` bytes. It takes no more memory than that.
pub(crate) fn unpack(
    encoding: PayloadEncoding,
    packed: &Bytes,
    most: usize,
) -> Result<Bytes, CompressionError> {
    let claimed = Decompressor::original_bytes(encoding, packed);
    if claimed > most {
        return Err(CompressionError::TooLong(claimed.try_into().unwrap_or(u32::MAX)));
    }
    Decompressor::default().decompress(encoding, packed.clone())
}

#[cfg(test)]
mod tests {
    use super::*;

    const BOTH: [PayloadEncoding; 2] = [PayloadEncoding::Zstd, PayloadEncoding::Lz4];

    fn text(bytes: usize) -> Vec<u8> {
        (0..)
            .flat_map(|n: u32| format!("{{\"joint\": {n}, \"position\": {}}}", n % 7).into_bytes())
            .take(bytes)
            .collect()
    }

    /// Returns bytes that do not shrink.
    fn noise(bytes: usize) -> Vec<u8> {
        let mut state = 1u64;
        let step = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 56) as u8
        };
        std::iter::repeat_with(step).take(bytes).collect()
    }

    #[test]
    fn compressible_payloads_round_trip_and_others_go_unchanged() {
        for encoding in BOTH {
            let (mut compressor, mut decompressor) = (Compressor::default(), Decompressor::default());
            for bytes in [1 << 20, 256, 300, 70_000, 5 << 20, 257] {
                let payload = text(bytes);
                match compressor.compress(encoding, &payload) {
                    Some(packed) => {
                        assert!(packed.len() < payload.len(), "{encoding:?} {bytes}");
                        assert_eq!(decompressor.decompress(encoding, packed), Ok(payload.into()));
                    }
                    None => assert!(bytes <= 300, "{encoding:?} {bytes}"),
                }
                assert_eq!(compressor.compress(encoding, &noise(bytes)), None);
            }
            assert_eq!(compressor.compress(encoding, &text(COMPRESS_BYTES_MIN - 1)), None);
            assert_eq!(compressor.compress(encoding, &vec![0; MESSAGE_BYTES_MAX as usize + 1]), None);
        }
        assert_eq!(Compressor::default().compress(PayloadEncoding::Plain, &text(4096)), None);
        let plain = Bytes::from_static(b"\0\x01\0\0");
        assert_eq!(Decompressor::default().decompress(PayloadEncoding::Plain, plain.clone()), Ok(plain));
    }

    #[test]
    fn a_payload_that_claims_what_it_is_not_is_refused() {
        for encoding in BOTH {
            let payload = vec![7; 1 << 20];
            let packed = Compressor::default().compress(encoding, &payload).unwrap();
            let claims = |length: u32| {
                let claim = [&length.to_be_bytes()[..], &packed[LENGTH_BYTES..]].concat();
                Decompressor::default().decompress(encoding, claim.into())
            };
            assert_eq!(claims(1 << 20), Ok(payload.into()));
            // A bomb: more than it claims, or more than the limit.
            for length in [0, 1, 1000, (1 << 20) - 1, (1 << 20) + 1, MESSAGE_BYTES_MAX] {
                assert_eq!(claims(length), Err(CompressionError::Malformed), "{encoding:?} {length}");
            }
            for length in [MESSAGE_BYTES_MAX + 1, u32::MAX] {
                assert_eq!(claims(length), Err(CompressionError::TooLong(length)));
            }
            for end in 0..packed.len().min(64) {
                let cut = Decompressor::default().decompress(encoding, packed.slice(..end));
                assert_eq!(cut, Err(CompressionError::Malformed), "{encoding:?} {end}");
            }
        }
    }

    #[test]
    fn a_refused_payload_leaves_the_next_one_as_it_was() {
        for encoding in BOTH {
            let (mut compressor, mut decompressor) = (Compressor::default(), Decompressor::default());
            let payload = text(10_000);
            let packed = compressor.compress(encoding, &payload).unwrap();
            for at in 0..packed.len() {
                let mut bent = packed.to_vec();
                bent[at] ^= 0x55;
                // Any result is no longer than the claim.
                let _ = decompressor.decompress(encoding, bent.into());
                let good = decompressor.decompress(encoding, packed.clone());
                assert_eq!(good, Ok(payload.clone().into()), "{encoding:?} {at}");
            }
        }
    }
}
