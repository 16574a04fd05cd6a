//! Reports as they travel: packed, because they are long and repetitive.

use bytes::Bytes;
use sgc_wire::{REPORT_BYTES_MAX, REPORT_PACKED_BYTES_MAX, Report};

use crate::compression::{CompressionError, pack, unpack};

/// Packs a document. Returns `None` if it is too long for a report, before or after.
pub fn pack_report(document: &Bytes) -> Option<Report> {
    if document.len() > REPORT_BYTES_MAX {
        return None;
    }
    let (encoding, document) = pack(document);
    (document.len() <= REPORT_PACKED_BYTES_MAX).then_some(Report { encoding, document })
}

/// Unpacks a received report. It takes no more memory than a report may have.
pub fn unpack_report(report: &Report) -> Result<Bytes, CompressionError> {
    unpack(report.encoding, &report.document, REPORT_BYTES_MAX)
}

#[cfg(test)]
mod tests {
    use sgc_wire::PayloadEncoding;

    use super::*;
    use crate::compression::Compressor;

    #[test]
    fn a_report_comes_back_and_a_bomb_is_refused_by_what_it_claims() {
        for document in [Bytes::from_static(b"{}"), vec![7; REPORT_BYTES_MAX].into()] {
            let packed = pack_report(&document).expect("within the bound");
            assert!(packed.document.len() <= document.len());
            assert_eq!(unpack_report(&packed), Ok(document));
        }
        assert_eq!(pack_report(&vec![0; REPORT_BYTES_MAX + 1].into()), None);
        // It does not shrink.
        let mut state = 1_u32;
        let noise = std::iter::repeat_with(|| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 24) as u8
        });
        assert_eq!(pack_report(&noise.take(REPORT_PACKED_BYTES_MAX + 1).collect()), None);
        let bomb =
            Compressor::default().compress(PayloadEncoding::Zstd, &vec![0; 8 << 20]).expect("zeros shrink");
        let bomb = Report { encoding: PayloadEncoding::Zstd, document: bomb };
        assert_eq!(unpack_report(&bomb), Err(CompressionError::TooLong(8 << 20)));
    }
}
