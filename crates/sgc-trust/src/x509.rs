//! The few fields of certificates and revocation lists that `webpki` checks but does not hand out, and our extension,
//! which `rcgen` does not write.
//!
//! This module verifies nothing. Its input was parsed by `webpki`, or is about to be verified; anything unexpected is
//! `None`.

use std::net::IpAddr;
use std::sync::Arc;

use sgc_wire::UnixMillis;

const INTEGER: u8 = 0x02;
const BOOLEAN: u8 = 0x01;
const BIT_STRING: u8 = 0x03;
const OCTET_STRING: u8 = 0x04;
const OBJECT_ID: u8 = 0x06;
const UTC_TIME: u8 = 0x17;
const GENERALIZED_TIME: u8 = 0x18;
const SEQUENCE: u8 = 0x30;
const SET: u8 = 0x31;
const VERSION: u8 = 0xa0;
const CERT_EXTENSIONS: u8 = 0xa3;
const CRL_EXTENSIONS: u8 = 0xa0;
/// Kinds of subject alternative names (RFC 5280, 4.2.1.6).
const DNS_NAME: u8 = 0x82;
const IP_ADDRESS: u8 = 0x87;

const SUBJECT_KEY_ID: &[u8] = &[0x55, 0x1d, 0x0e];
const BASIC_CONSTRAINTS: &[u8] = &[0x55, 0x1d, 0x13];
const ALTERNATIVE_NAMES: &[u8] = &[0x55, 0x1d, 0x11];
const KEY_USAGE: &[u8] = &[0x55, 0x1d, 0x0f];
const CRL_NUMBER: &[u8] = &[0x55, 0x1d, 0x14];
const DISTRIBUTION_POINT: &[u8] = &[0x55, 0x1d, 0x1c];
/// The extension by which a fleet's revocation list revokes nodes, 2.25.119781345836387798361097549824228883350: no
/// registry gave the number, it is a random UUID (ITU-T X.667).
const REVOKED_NODES: &[u8] = &[
    0x69, 0x81, 0xb4, 0x9d, 0x86, 0x93, 0xcf, 0xb3, 0xca, 0xbd, 0xc5, 0x9e, 0x84, 0xb0, 0xfe, 0x9a, 0x96,
    0xd1, 0xf7, 0x16,
];
/// Bit 6 of a key usage: the key may sign revocation lists (RFC 5280, 4.2.1.3).
const CRL_SIGN: u8 = 0x02;
/// Bit 5: the key may sign certificates.
const KEY_CERT_SIGN: u8 = 0x04;

/// The serial number by which a certificate is revoked; big-endian, without leading zeros.
pub(crate) type Serial = Arc<[u8]>;

/// Beginning and end of a certificate's validity, both inclusive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Validity {
    pub(crate) not_before: UnixMillis,
    pub(crate) not_after: UnixMillis,
}

impl Validity {
    /// Reads a DER certificate (RFC 5280, 4.1.2.5).
    pub(crate) fn from_certificate(certificate: &[u8]) -> Option<Self> {
        let mut certificate = Der(certificate).enter(SEQUENCE)?;
        let mut tbs = certificate.enter(SEQUENCE)?;
        if tbs.peek()? == VERSION {
            tbs.enter(VERSION)?;
        }
        tbs.enter(INTEGER)?; // serial
        tbs.enter(SEQUENCE)?; // signature algorithm
        tbs.enter(SEQUENCE)?; // issuer
        let mut validity = tbs.enter(SEQUENCE)?;
        Some(Self { not_before: validity.time()?, not_after: validity.time()? })
    }

    /// Returns the time in which both are valid; that may be never.
    pub(crate) fn overlap(self, other: Self) -> Self {
        let not_before = self.not_before.max(other.not_before);
        Self { not_before, not_after: self.not_after.min(other.not_after) }
    }

    /// Returns `true` at that time; the last second counts as a whole, as in path validation.
    pub(crate) fn contains(&self, now: UnixMillis) -> bool {
        now >= self.not_before && now.secs() <= self.not_after.secs()
    }
}

/// Returns algorithm identifier (without its outer tag) and bare key of a DER SubjectPublicKeyInfo.
pub(crate) fn split_spki(spki: &[u8]) -> Option<(&[u8], &[u8])> {
    let mut spki = Der(spki).enter(SEQUENCE)?;
    let algorithm = spki.enter(SEQUENCE)?.0;
    match spki.enter(BIT_STRING)?.0.split_first()? {
        (0, key) => Some((algorithm, key)),
        _ => None,
    }
}

/// Returns the serial number of a DER certificate, without leading zeros.
pub fn serial_of(certificate: &[u8]) -> Option<&[u8]> {
    let mut tbs = Der(certificate).enter(SEQUENCE)?.enter(SEQUENCE)?;
    if tbs.peek()? == VERSION {
        tbs.skip()?;
    }
    tbs.enter(INTEGER).map(|serial| without_zeros(serial.0))
}

/// The fields of a CA's certificate that certificates and lists need.
pub(crate) struct CaFields<'a> {
    /// Its components in order: type, tag of the value, value.
    pub(crate) name: Vec<(Vec<u64>, u8, &'a [u8])>,
    pub(crate) key_id: Option<&'a [u8]>,
    /// Whether its basic constraints mark it as a CA.
    pub(crate) is_ca: bool,
    /// `true` unless its key usage leaves out the signing of certificates.
    pub(crate) may_sign_certificates: bool,
}

impl<'a> CaFields<'a> {
    pub(crate) fn from_certificate(certificate: &'a [u8]) -> Option<Self> {
        let mut tbs = Der(certificate).enter(SEQUENCE)?.enter(SEQUENCE)?;
        if tbs.peek()? == VERSION {
            tbs.skip()?;
        }
        for tag in [INTEGER, SEQUENCE, SEQUENCE, SEQUENCE] {
            tbs.enter(tag)?; // serial, signature algorithm, issuer, validity
        }
        let mut components = tbs.enter(SEQUENCE)?;
        let mut name = Vec::new();
        while components.peek().is_some() {
            let mut set = components.enter(SET)?;
            while set.peek().is_some() {
                let mut component = set.enter(SEQUENCE)?;
                let id = object_id(component.enter(OBJECT_ID)?.0)?;
                let tag = component.peek()?;
                name.push((id, tag, component.enter(tag)?.0));
            }
        }
        let extensions = extensions_of(certificate)?;
        let find = |id| extensions.map_or(Some(None), |e| e.find_extension(id));
        let key_id = match find(SUBJECT_KEY_ID)? {
            None => None,
            Some(content) => Some(Der(content).enter(OCTET_STRING)?.0),
        };
        let is_ca = match find(BASIC_CONSTRAINTS)? {
            None => false,
            Some(content) => {
                let mut constraints = Der(content).enter(SEQUENCE)?;
                constraints.peek() == Some(BOOLEAN) && constraints.enter(BOOLEAN)?.0 != [0]
            }
        };
        let usage = key_usage(certificate)?;
        let may_sign_certificates = usage.is_none_or(|bits| bits & KEY_CERT_SIGN != 0);
        Some(Self { name, key_id, is_ca, may_sign_certificates })
    }
}

/// The fields of a DER CertificationRequest (PKCS #10, RFC 2986): its key and its signature.
pub(crate) struct RequestFields<'a> {
    /// The signed bytes: the whole first element.
    pub(crate) info: &'a [u8],
    /// The outer algorithm identifier without its tag.
    pub(crate) algorithm: &'a [u8],
    pub(crate) signature: &'a [u8],
    /// Algorithm identifier without its tag, and bare key.
    pub(crate) key: (&'a [u8], &'a [u8]),
}

impl<'a> RequestFields<'a> {
    pub(crate) fn from_request(request: &'a [u8]) -> Option<Self> {
        let mut whole = Der(request);
        let mut request = whole.enter(SEQUENCE)?;
        let from = request.0;
        let mut fields = request.enter(SEQUENCE)?;
        let info = from.get(..from.len() - request.0.len())?;
        let algorithm = request.enter(SEQUENCE)?.0;
        let (0, signature) = request.enter(BIT_STRING)?.0.split_first()? else { return None };
        fields.enter(INTEGER)?; // version
        fields.enter(SEQUENCE)?; // subject
        let from = fields.0;
        fields.enter(SEQUENCE)?;
        let key = split_spki(from.get(..from.len() - fields.0.len())?)?;
        (whole.0.is_empty() && request.0.is_empty()).then_some(Self { info, algorithm, signature, key })
    }
}

fn object_id(content: &[u8]) -> Option<Vec<u64>> {
    let mut arcs = Vec::new();
    let mut arc = 0_u64;
    for byte in content {
        arc = arc.checked_mul(128)?.checked_add(u64::from(byte & 0x7f))?;
        if byte & 0x80 == 0 {
            if arcs.is_empty() {
                let first = (arc / 40).min(2);
                arcs.push(first);
                arc -= 40 * first;
            }
            arcs.push(arc);
            arc = 0;
        }
    }
    (!arcs.is_empty() && arc == 0).then_some(arcs)
}

/// Returns `true` unless a DER certificate has a key usage that leaves out the signing of revocation lists.
pub(crate) fn may_sign_lists(certificate: &[u8]) -> Option<bool> {
    Some(key_usage(certificate)?.is_none_or(|bits| bits & CRL_SIGN != 0))
}

/// Returns `true` if the key usage of a DER certificate names the signing of certificates.
pub(crate) fn names_certificate_signing(certificate: &[u8]) -> Option<bool> {
    Some(key_usage(certificate)?.is_some_and(|bits| bits & KEY_CERT_SIGN != 0))
}

/// Returns the path length limit of a DER certificate, if its basic constraints have one.
pub(crate) fn path_length(certificate: &[u8]) -> Option<Option<usize>> {
    let Some(extensions) = extensions_of(certificate)? else { return Some(None) };
    let Some(content) = extensions.find_extension(BASIC_CONSTRAINTS)? else { return Some(None) };
    let mut constraints = Der(content).enter(SEQUENCE)?;
    if constraints.peek() == Some(BOOLEAN) {
        constraints.skip()?;
    }
    if constraints.peek().is_none() {
        return Some(None);
    }
    // A longer number is no limit that a chain could reach.
    match constraints.enter(INTEGER)?.0 {
        [length] if *length < 0x80 => Some(Some(usize::from(*length))),
        [first, ..] if *first < 0x80 => Some(None),
        _ => None,
    }
}

/// A subject alternative name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum AlternativeName<'a> {
    Dns(&'a str),
    Ip(IpAddr),
    /// A name of another kind.
    Other,
}

/// Returns the subject alternative names of a DER certificate; an empty list if it has none.
pub(crate) fn alternative_names(certificate: &[u8]) -> Option<Vec<AlternativeName<'_>>> {
    let Some(extensions) = extensions_of(certificate)? else { return Some(Vec::new()) };
    let Some(content) = extensions.find_extension(ALTERNATIVE_NAMES)? else { return Some(Vec::new()) };
    let mut names = Der(content).enter(SEQUENCE)?;
    let mut all = Vec::new();
    while let Some(tag) = names.peek() {
        let value = names.enter(tag)?.0;
        all.push(match tag {
            DNS_NAME => AlternativeName::Dns(std::str::from_utf8(value).ok()?),
            IP_ADDRESS => AlternativeName::Ip(ip_address(value)?),
            _ => AlternativeName::Other,
        });
    }
    Some(all)
}

fn ip_address(octets: &[u8]) -> Option<IpAddr> {
    let v4 = <[u8; 4]>::try_from(octets).map(IpAddr::from);
    v4.or_else(|_| <[u8; 16]>::try_from(octets).map(IpAddr::from)).ok()
}

/// Returns the first byte of its key usage, if it has one.
fn key_usage(certificate: &[u8]) -> Option<Option<u8>> {
    let Some(extensions) = extensions_of(certificate)? else { return Some(None) };
    match extensions.find_extension(KEY_USAGE)? {
        None => Some(None),
        Some(usage) => {
            let (_unused_bits, bits) = Der(usage).enter(BIT_STRING)?.0.split_first()?;
            Some(Some(bits.first().copied().unwrap_or(0)))
        }
    }
}

fn extensions_of(certificate: &[u8]) -> Option<Option<Der<'_>>> {
    let mut tbs = Der(certificate).enter(SEQUENCE)?.enter(SEQUENCE)?;
    while tbs.peek().is_some_and(|tag| tag != CERT_EXTENSIONS) {
        tbs.skip()?;
    }
    match tbs.peek() {
        None => Some(None),
        Some(_) => Some(Some(tbs.enter(CERT_EXTENSIONS)?.enter(SEQUENCE)?)),
    }
}

/// The fields of a DER CertificateList (RFC 5280, 5.1) that decide about it.
pub(crate) struct ListFields<'a> {
    /// The signed bytes: the whole first element.
    pub(crate) tbs: &'a [u8],
    /// The outer algorithm identifier without its tag.
    pub(crate) algorithm: &'a [u8],
    pub(crate) signature: &'a [u8],
    /// The issuer's name without its outer tag.
    pub(crate) issuer: &'a [u8],
    /// Big-endian, without leading zeros; absent in lists of another profile.
    pub(crate) number: Option<&'a [u8]>,
    /// Whether it has an issuing distribution point: it may cover only some certificates.
    pub(crate) is_scoped: bool,
    /// The value of the extension that revokes nodes. Only a fleet's list has it.
    pub(crate) revoked_nodes: Option<&'a [u8]>,
}

impl<'a> ListFields<'a> {
    pub(crate) fn from_list(list: &'a [u8]) -> Option<Self> {
        let mut list = Der(list).enter(SEQUENCE)?;
        let from = list.0;
        let mut fields = list.enter(SEQUENCE)?;
        let tbs = from.get(..from.len() - list.0.len())?;
        let algorithm = list.enter(SEQUENCE)?.0;
        let (0, signature) = list.enter(BIT_STRING)?.0.split_first()? else { return None };
        fields.enter(INTEGER)?; // version
        fields.enter(SEQUENCE)?; // signature algorithm
        let issuer = fields.enter(SEQUENCE)?.0;
        fields.time()?; // this update
        while fields.peek().is_some_and(|tag| tag != CRL_EXTENSIONS) {
            fields.skip()?; // next update, revoked certificates
        }
        let (mut number, mut is_scoped, mut revoked_nodes) = (None, false, None);
        if fields.peek().is_some() {
            let extensions = fields.enter(CRL_EXTENSIONS)?.enter(SEQUENCE)?;
            is_scoped = extensions.find_extension(DISTRIBUTION_POINT)?.is_some();
            if let Some(content) = extensions.find_extension(CRL_NUMBER)? {
                number = Some(without_zeros(Der(content).enter(INTEGER)?.0));
            }
            revoked_nodes = extensions.find_extension(REVOKED_NODES)?;
        }
        Some(Self { tbs, algorithm, signature, issuer, number, is_scoped, revoked_nodes })
    }

    /// Returns the signed part of `list` with this value of the extension that revokes nodes behind its other
    /// extensions. `list` has extensions and not this one.
    pub(crate) fn tbs_with_revoked_nodes(list: &[u8], value: &[u8]) -> Option<Vec<u8>> {
        let mut fields = Der(list).enter(SEQUENCE)?.enter(SEQUENCE)?;
        let from = fields.0;
        while fields.peek()? != CRL_EXTENSIONS {
            fields.skip()?;
        }
        let before = from.get(..from.len() - fields.0.len())?;
        let known = fields.enter(CRL_EXTENSIONS)?.enter(SEQUENCE)?.0;
        let extension =
            element(SEQUENCE, &[&element(OBJECT_ID, &[REVOKED_NODES]), &element(OCTET_STRING, &[value])]);
        let extensions = element(CRL_EXTENSIONS, &[&element(SEQUENCE, &[known, &extension])]);
        Some(element(SEQUENCE, &[before, &extensions]))
    }

    /// Returns the list with this signed part, with the algorithm of its original.
    pub(crate) fn signed(tbs: &[u8], algorithm: &[u8], signature: &[u8]) -> Vec<u8> {
        element(SEQUENCE, &[tbs, &element(SEQUENCE, &[algorithm]), &element(BIT_STRING, &[&[0], signature])])
    }
}

/// One node in the extension that revokes nodes.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct RevokedNodeFields {
    pub(crate) pseudonym: [u8; 32],
    pub(crate) incarnation: u32,
    pub(crate) revoked_secs: u64,
}

impl RevokedNodeFields {
    /// Longest encoding of one, bytes.
    pub(crate) const BYTES_MAX: usize = 2 + 34 + 7 + 11;

    /// Reads the value of the extension: a sequence of nodes, and nothing else.
    pub(crate) fn all(value: &[u8]) -> Option<Vec<Self>> {
        let mut whole = Der(value);
        let mut entries = whole.enter(SEQUENCE)?;
        let mut all = Vec::new();
        while entries.peek().is_some() {
            let mut entry = entries.enter(SEQUENCE)?;
            let pseudonym = entry.enter(OCTET_STRING)?.0.try_into().ok()?;
            let incarnation = entry.unsigned()?.try_into().ok()?;
            let revoked_secs = entry.unsigned()?;
            all.push(Self { pseudonym, incarnation, revoked_secs });
            entry.0.is_empty().then_some(())?;
        }
        whole.0.is_empty().then_some(all)
    }

    /// Returns the value of the extension for these nodes.
    pub(crate) fn write_all(entries: impl IntoIterator<Item = Self>) -> Vec<u8> {
        let mut content = Vec::new();
        for entry in entries {
            content.extend(element(
                SEQUENCE,
                &[
                    &element(OCTET_STRING, &[&entry.pseudonym]),
                    &unsigned(entry.incarnation.into()),
                    &unsigned(entry.revoked_secs),
                ],
            ));
        }
        element(SEQUENCE, &[&content])
    }
}

/// Returns one DER element with this content.
fn element(tag: u8, content: &[&[u8]]) -> Vec<u8> {
    let length: usize = content.iter().map(|part| part.len()).sum();
    let digits = length.to_be_bytes();
    let digits = without_zeros(&digits);
    let mut out = vec![tag];
    if length < 0x80 {
        out.push(length as u8);
    } else {
        out.push(0x80 | digits.len() as u8);
        out.extend_from_slice(digits);
    }
    content.iter().for_each(|part| out.extend_from_slice(part));
    out
}

/// Returns a DER integer.
fn unsigned(number: u64) -> Vec<u8> {
    let bytes = number.to_be_bytes();
    let bytes = without_zeros(&bytes);
    let sign: &[u8] = if bytes.first().is_none_or(|first| first & 0x80 != 0) { &[0] } else { &[] };
    element(INTEGER, &[sign, bytes])
}

/// Returns an unsigned big-endian number without leading zeros.
pub(crate) fn without_zeros(number: &[u8]) -> &[u8] {
    let zeros = number.iter().take_while(|b| **b == 0).count();
    number.get(zeros..).unwrap_or_default()
}

#[derive(Clone, Copy)]
struct Der<'a>(&'a [u8]);

impl<'a> Der<'a> {
    fn peek(&self) -> Option<u8> {
        self.0.first().copied()
    }

    /// Steps over one element of any kind.
    fn skip(&mut self) -> Option<()> {
        let tag = self.peek()?;
        self.enter(tag).map(drop)
    }

    /// Returns the value of one extension, if it is among these.
    fn find_extension(mut self, id: &[u8]) -> Option<Option<&'a [u8]>> {
        while self.peek().is_some() {
            let mut extension = self.enter(SEQUENCE)?;
            let found = extension.enter(OBJECT_ID)?.0;
            if extension.peek()? == BOOLEAN {
                extension.enter(BOOLEAN)?; // critical
            }
            let value = extension.enter(OCTET_STRING)?.0;
            if found == id {
                return Some(Some(value));
            }
        }
        Some(None)
    }

    /// Steps over one element with this tag and returns its content.
    fn enter(&mut self, tag: u8) -> Option<Der<'a>> {
        let (found, rest) = self.0.split_first()?;
        let (first, mut rest) = rest.split_first()?;
        let mut length = usize::from(*first);
        if length & 0x80 != 0 {
            let digits;
            (digits, rest) =
                rest.split_at_checked(length & 0x7f).filter(|(d, _)| (1..=3).contains(&d.len()))?;
            length = digits.iter().fold(0, |n, digit| (n << 8) | usize::from(*digit));
        }
        let (content, rest) = rest.split_at_checked(length).filter(|_| *found == tag)?;
        self.0 = rest;
        Some(Der(content))
    }

    /// Steps over an integer that is not negative, in its shortest form.
    fn unsigned(&mut self) -> Option<u64> {
        let bytes = self.enter(INTEGER)?.0;
        let number = match bytes {
            [0] => &[],
            [0, rest @ ..] if rest.first()? & 0x80 != 0 => rest,
            [first, ..] if first & 0x80 == 0 && *first != 0 => bytes,
            _ => return None,
        };
        (number.len() <= 8).then(|| number.iter().fold(0, |n, byte| (n << 8) | u64::from(*byte)))
    }

    fn time(&mut self) -> Option<UnixMillis> {
        let (text, century) = match self.peek()? {
            UTC_TIME => {
                let text = self.enter(UTC_TIME)?.0;
                (text, Some(if number(text.get(..2)?)? >= 50 { 1900 } else { 2000 }))
            }
            _ => (self.enter(GENERALIZED_TIME)?.0, None),
        };
        let (year, rest) = text.split_at_checked(if century.is_some() { 2 } else { 4 })?;
        let year = number(year)? + century.unwrap_or(0);
        let rest = rest.strip_suffix(b"Z").filter(|r| r.len() == 10)?;
        let mut parts = rest.chunks_exact(2).map(number);
        let mut part = |low: u64, high: u64| parts.next()?.filter(|v| (low..=high).contains(v));
        let (month, day) = (part(1, 12)?, part(1, 31)?);
        let (hour, minute, second) = (part(0, 23)?, part(0, 59)?, part(0, 59)?);
        let days = days_since_1970(year, month, day);
        Some(UnixMillis(days.checked_mul(86_400)?.checked_add(hour * 3600 + minute * 60 + second)? * 1000))
    }
}

fn number(digits: &[u8]) -> Option<u64> {
    digits.iter().try_fold(0, |n, d| d.is_ascii_digit().then(|| n * 10 + u64::from(d - b'0')))
}

/// Returns the days from 1970-01-01 to a Gregorian date; zero for earlier dates, which are valid for all our purposes.
fn days_since_1970(year: u64, month: u64, day: u64) -> u64 {
    const DAYS_BEFORE: [u64; 12] = [0, 31, 59, 90, 120, 151, 181, 212, 243, 273, 304, 334];
    let is_leap = year.is_multiple_of(4) && (!year.is_multiple_of(100) || year.is_multiple_of(400));
    let before = year.saturating_sub(1);
    let leap_days = before / 4 - before / 100 + before / 400;
    let this_year = DAYS_BEFORE[(month as usize - 1) % 12] + day - 1 + u64::from(is_leap && month > 2);
    (year * 365 + leap_days + this_year).saturating_sub(1970 * 365 + 477)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn time(tag: u8, text: &str) -> Option<String> {
        let mut der = vec![tag, text.len() as u8];
        der.extend_from_slice(text.as_bytes());
        Der(&der).time().map(|t| t.to_string())
    }

    #[test]
    fn times_are_read() {
        for (tag, text, expected) in [
            (UTC_TIME, "700101000000Z", "1970-01-01T00:00:00Z"),
            (UTC_TIME, "000229235959Z", "2000-02-29T23:59:59Z"),
            (UTC_TIME, "491231235959Z", "2049-12-31T23:59:59Z"),
            (GENERALIZED_TIME, "20500301120000Z", "2050-03-01T12:00:00Z"),
            (GENERALIZED_TIME, "21000301000000Z", "2100-03-01T00:00:00Z"),
            (GENERALIZED_TIME, "99991231235959Z", "9999-12-31T23:59:59Z"),
        ] {
            assert_eq!(time(tag, text).as_deref(), Some(expected));
        }
        for text in ["20501301120000Z", "20500301120000", "2050030112000Z", "2050x301120000Z", ""] {
            assert_eq!(time(GENERALIZED_TIME, text), None);
        }
    }

    #[test]
    fn broken_lengths_are_none() {
        for der in [&[][..], &[SEQUENCE], &[SEQUENCE, 5, 1], &[SEQUENCE, 0x84, 1, 1, 1, 1], &[SEQUENCE, 0x80]]
        {
            assert!(Der(der).enter(SEQUENCE).is_none());
            assert!(Validity::from_certificate(der).is_none() && split_spki(der).is_none());
        }
    }
}
