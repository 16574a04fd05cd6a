//! Reports over the wire: what an observer asks a node of its fleet, and the answer.
//!
//! The answer is a document in JSON, so that nodes of different versions understand each other's. Here it is bytes,
//! compressed or not.

use bytes::Bytes;

use crate::codec::{Decode, DecodeError, Encode, Reader, Writer};
use crate::message::PayloadEncoding;

/// Longest report, bytes, before it is compressed.
pub const REPORT_BYTES_MAX: usize = 1024 * 1024;
/// Longest report as it travels, bytes. Sealed, it fits [`SEALED_BYTES_MAX`](crate::SEALED_BYTES_MAX).
pub const REPORT_PACKED_BYTES_MAX: usize = 512 * 1024;
/// Longest name of an interface in a question, bytes. A ROS 2 name with its prefix has at most 255 in DDS.
pub const REPORT_INTERFACE_BYTES_MAX: usize = 255;

/// A question at the name of a node's reports.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum ReportQuestion {
    /// How the node is doing.
    Node,
    /// Everything that explains whether this topic, service or action flows; by its name at that node.
    Interface(String),
    /// Nothing but an answer, so that its round trip can be measured.
    Ping,
}

/// The answer to a [`ReportQuestion`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Report {
    /// Compression of the document: none, or Zstandard.
    pub encoding: PayloadEncoding,
    /// The document, JSON.
    pub document: Bytes,
}

impl Encode for ReportQuestion {
    fn encode(&self, w: &mut Writer) {
        match self {
            Self::Node => w.u8(0),
            Self::Interface(name) => {
                w.u8(1);
                w.str(name);
            }
            Self::Ping => w.u8(2),
        }
    }
}

impl Decode for ReportQuestion {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        match r.u8()? {
            0 => Ok(Self::Node),
            1 => Ok(Self::Interface(r.str("interface", REPORT_INTERFACE_BYTES_MAX)?)),
            2 => Ok(Self::Ping),
            v => Err(DecodeError::value("question for a report", v.into())),
        }
    }
}

impl Encode for Report {
    fn encode(&self, w: &mut Writer) {
        w.u8(self.encoding as u8);
        w.bytes(&self.document);
    }
}

impl Decode for Report {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        let encoding = match r.u8()? {
            0 => PayloadEncoding::Plain,
            1 => PayloadEncoding::Zstd,
            v => return Err(DecodeError::value("encoding of a report", v.into())),
        };
        Ok(Self {
            encoding,
            document: r.bytes("report", REPORT_PACKED_BYTES_MAX).map(Bytes::copy_from_slice)?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::catalogue::GrantContent;
    use crate::control::{ASK_BYTES_MAX, SEALED_BYTES_MAX};

    /// The bytes are normative.
    #[test]
    fn questions_and_reports_have_these_bytes() {
        for (question, bytes) in [
            (ReportQuestion::Node, &[0][..]),
            (ReportQuestion::Interface("/a".into()), &[1, 0, 0, 0, 2, b'/', b'a']),
            (ReportQuestion::Ping, &[2]),
        ] {
            assert_eq!(question.to_vec(), bytes);
            assert_eq!(ReportQuestion::from_slice(bytes), Ok(question));
        }
        let report = Report { encoding: PayloadEncoding::Zstd, document: Bytes::from_static(b"xy") };
        assert_eq!(report.to_vec(), [1, 0, 0, 0, 2, b'x', b'y']);
        assert_eq!(Report::from_slice(&report.to_vec()), Ok(report));
    }

    #[test]
    fn longer_and_unknown_ones_are_refused() {
        let question = |bytes| ReportQuestion::Interface("a".repeat(bytes)).to_vec();
        let longest = question(REPORT_INTERFACE_BYTES_MAX);
        assert!(longest.len() <= ASK_BYTES_MAX && ReportQuestion::from_slice(&longest).is_ok());
        let longer = ReportQuestion::from_slice(&question(REPORT_INTERFACE_BYTES_MAX + 1));
        assert!(matches!(longer, Err(DecodeError::TooLong { .. })), "{longer:?}");
        assert!(ReportQuestion::from_slice(&[3]).is_err() && ReportQuestion::from_slice(&[0, 0]).is_err());
        assert!(Report::from_slice(&[2, 0, 0, 0, 0]).is_err());
        let report = |bytes| Report { encoding: PayloadEncoding::Plain, document: vec![0; bytes].into() };
        let longest = GrantContent::Report(report(REPORT_PACKED_BYTES_MAX)).to_vec();
        assert!(longest.len() < SEALED_BYTES_MAX && GrantContent::from_slice(&longest).is_ok());
        let longer = Report::from_slice(&report(REPORT_PACKED_BYTES_MAX + 1).to_vec());
        assert!(matches!(longer, Err(DecodeError::TooLong { .. })), "{longer:?}");
    }
}
