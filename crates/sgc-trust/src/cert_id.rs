//! Names of CAs and certificates: by the hash of a key, and by a serial number.

use std::fmt;
use std::sync::Arc;

use aws_lc_rs::digest;
use sgc_wire::Pseudonym;

use crate::x509::without_zeros;

/// A CA, by the SHA-256 of its public key (SubjectPublicKeyInfo, DER): renewing its certificate changes nothing.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct CaFingerprint(pub [u8; 32]);

impl fmt::Display for CaFingerprint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for CaFingerprint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("CaFingerprint(")?;
        self.0.iter().take(4).try_for_each(|byte| write!(f, "{byte:02x}"))?;
        f.write_str(")")
    }
}

/// One certificate in revocation lists: its CA and the serial number that the CA gave it.
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct CertId {
    /// The CA that made it: an intermediate one, if there is one.
    pub ca: CaFingerprint,
    /// The serial number, big-endian, without leading zeros (RFC 5280, 4.1.2.2).
    pub serial: Arc<[u8]>,
    /// Node and incarnation, for a node's certificate.
    pub node: Option<NodeIncarnation>,
}

/// A node between two re-enrolments: all of its certificates are revoked together.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct NodeIncarnation {
    /// The node.
    pub pseudonym: Pseudonym,
    /// Grows when the node is enrolled again after a revocation, and not when it is renewed.
    pub incarnation: u32,
}

impl CertId {
    pub(crate) fn new(ca: CaFingerprint, serial: &[u8]) -> Self {
        Self { ca, serial: without_zeros(serial).into(), node: None }
    }
}

impl fmt::Debug for CertId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "CertId({:?}, ", self.ca)?;
        self.serial.iter().take(4).try_for_each(|byte| write!(f, "{byte:02x}"))?;
        f.write_str(")")
    }
}

pub(crate) fn sha256(parts: &[&[u8]]) -> [u8; 32] {
    let mut context = digest::Context::new(&digest::SHA256);
    parts.iter().for_each(|part| context.update(part));
    let mut out = [0; 32];
    out.copy_from_slice(context.finish().as_ref());
    out
}
