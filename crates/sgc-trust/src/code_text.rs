//! Codes that people copy: a prefix with the version, then content and checksum in base64url (RFC 4648, 5).

use aws_lc_rs::digest;
use base64::Engine as _;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use zeroize::Zeroizing;

const CHECKSUM_BYTES: usize = 4;

/// Form of one kind of code.
pub(crate) struct CodeForm {
    /// Beginning of a code of the known version.
    pub(crate) prefix: &'static str,
    /// Beginning of codes of any version.
    pub(crate) any_prefix: &'static str,
    /// Domain of the checksum.
    pub(crate) domain: &'static [u8],
    /// Longest text, bytes.
    pub(crate) bytes_max: usize,
}

/// The reason why a text is no code of a kind.
pub(crate) enum TextFault {
    /// It is longer than a code can be.
    TooLong { bytes: usize },
    /// It has another prefix.
    Prefix,
    /// It is of another version.
    Version,
    /// It has characters that codes do not have.
    NotBase64,
    /// It was cut or mistyped.
    Checksum,
}

impl CodeForm {
    /// Returns the content of a code. White space around the code does not count.
    pub(crate) fn parse(&self, text: &str) -> Result<Zeroizing<Vec<u8>>, TextFault> {
        let text = text.trim();
        if text.len() > self.bytes_max {
            return Err(TextFault::TooLong { bytes: text.len() });
        }
        let Some(base64) = text.strip_prefix(self.prefix) else {
            return Err(match text.starts_with(self.any_prefix) {
                true => TextFault::Version,
                false => TextFault::Prefix,
            });
        };
        let bytes = URL_SAFE_NO_PAD.decode(base64).map(Zeroizing::new);
        let mut bytes = bytes.map_err(|_| TextFault::NotBase64)?;
        let length = bytes.len().checked_sub(CHECKSUM_BYTES).ok_or(TextFault::Checksum)?;
        let (content, found) = bytes.split_at_checked(length).ok_or(TextFault::Checksum)?;
        if found != self.checksum(content) {
            return Err(TextFault::Checksum);
        }
        bytes.truncate(length);
        Ok(bytes)
    }

    /// Returns the code with this content.
    pub(crate) fn to_text(&self, content: &[u8]) -> Zeroizing<String> {
        // Capacity up front: a growing vector leaves copies of secrets behind.
        let mut bytes = Zeroizing::new(Vec::with_capacity(content.len() + CHECKSUM_BYTES));
        bytes.extend_from_slice(content);
        bytes.extend_from_slice(&self.checksum(content));
        let mut text = Zeroizing::new(String::with_capacity(self.prefix.len() + bytes.len().div_ceil(3) * 4));
        text.push_str(self.prefix);
        URL_SAFE_NO_PAD.encode_string(bytes.as_slice(), &mut text);
        text
    }

    /// Returns the checksum that detects a cut or mistyped code. It does not detect a forged one.
    fn checksum(&self, content: &[u8]) -> [u8; CHECKSUM_BYTES] {
        let mut context = digest::Context::new(&digest::SHA256);
        context.update(self.domain);
        context.update(content);
        let mut out = [0; CHECKSUM_BYTES];
        out.iter_mut().zip(context.finish().as_ref()).for_each(|(out, byte)| *out = *byte);
        out
    }
}
