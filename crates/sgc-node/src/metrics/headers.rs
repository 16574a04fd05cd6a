//! Reads the file with the headers that a collector of metrics wants, such as a token (`otlp_headers_file`).

use std::fs;
use std::io::{self, Read as _};
use std::path::Path;

use sgc_http::http::header::{
    ACCEPT, CONNECTION, CONTENT_ENCODING, CONTENT_LENGTH, CONTENT_TYPE, EXPECT, HOST, TE, TRAILER,
    TRANSFER_ENCODING, UPGRADE, USER_AGENT,
};
use sgc_http::http::{HeaderMap, HeaderName, HeaderValue};
use zeroize::Zeroizing;

use crate::state;

/// Largest file, bytes.
const FILE_BYTES_MAX: usize = 16 << 10;
/// Most headers.
const HEADERS_MAX: usize = 32;
/// Headers that belong to the protocol.
const RESERVED: [HeaderName; 12] = [
    ACCEPT,
    CONNECTION,
    CONTENT_ENCODING,
    CONTENT_LENGTH,
    CONTENT_TYPE,
    EXPECT,
    HOST,
    TE,
    TRAILER,
    TRANSFER_ENCODING,
    UPGRADE,
    USER_AGENT,
];

/// Reasons why a file of headers cannot be used. None names a value, which may be a secret.
#[derive(Debug, thiserror::Error)]
pub(crate) enum HeadersError {
    /// The file cannot be read.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// Others can read the file.
    #[error("others than its owner have access to it (mode {mode:04o}): `chmod 600` it")]
    Exposed {
        /// The permission bits.
        mode: u32,
    },
    /// The file is too large.
    #[error("it has more than {FILE_BYTES_MAX} bytes")]
    TooLarge,
    /// There are too many headers.
    #[error("it has more than {HEADERS_MAX} headers")]
    TooMany,
    /// The file has no header.
    #[error("no header is in it: write one in each line, such as `Authorization: Bearer TOKEN`")]
    Empty,
    /// A line is no header.
    #[error("line {line} is no header: write `NAME: VALUE`")]
    Line {
        /// Counted from 1.
        line: usize,
    },
    /// A header belongs to the protocol.
    #[error("line {line} sets {name}, which belongs to the protocol: take it out")]
    Reserved {
        /// Counted from 1.
        line: usize,
        /// The name.
        name: HeaderName,
    },
}

/// Reads the headers of a file that only its owner may read.
pub(crate) fn read(path: &Path) -> Result<HeaderMap, HeadersError> {
    let file = fs::File::open(path)?;
    if let Some(mode) = state::exposed(&file.metadata()?) {
        return Err(HeadersError::Exposed { mode });
    }
    let mut text = Zeroizing::new(String::with_capacity(FILE_BYTES_MAX + 1));
    file.take(FILE_BYTES_MAX as u64 + 1).read_to_string(&mut text)?;
    if text.len() > FILE_BYTES_MAX {
        return Err(HeadersError::TooLarge);
    }
    parse(&text)
}

/// Parses a header in each line. Lines that are empty or begin with `#` are skipped.
fn parse(text: &str) -> Result<HeaderMap, HeadersError> {
    let mut headers = HeaderMap::new();
    for (at, line) in text.lines().enumerate() {
        let (line, text) = (at + 1, line.trim());
        if text.is_empty() || text.starts_with('#') {
            continue;
        }
        let header = text.split_once(':').and_then(|(name, value)| {
            let name: HeaderName = name.trim_end().parse().ok()?;
            Some((name, HeaderValue::from_str(value.trim()).ok().filter(|value| !value.is_empty())?))
        });
        let (name, mut value) = header.ok_or(HeadersError::Line { line })?;
        if RESERVED.contains(&name) {
            return Err(HeadersError::Reserved { line, name });
        }
        if headers.len() == HEADERS_MAX {
            return Err(HeadersError::TooMany);
        }
        value.set_sensitive(true);
        headers.append(name, value);
    }
    if headers.is_empty() { Err(HeadersError::Empty) } else { Ok(headers) }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use std::os::unix::fs::PermissionsExt as _;

    use super::*;

    #[test]
    fn each_line_is_a_header_whose_value_is_not_printed() {
        let headers = parse("# of the lab\n\nAuthorization: Bearer a:b\r\nX-Scope-OrgID :lab \n").unwrap();
        let values: Vec<_> = headers.iter().map(|(name, value)| (name.as_str(), value.as_bytes())).collect();
        assert_eq!(values, [("authorization", &b"Bearer a:b"[..]), ("x-scope-orgid", b"lab")]);
        assert!(!format!("{headers:?}").contains("Bearer"), "{headers:?}");
    }

    #[test]
    fn lines_that_are_no_headers_are_refused_without_their_content() {
        for (text, said) in [
            ("", "no header is in it"),
            ("# only a comment", "no header is in it"),
            ("a: b\nBearer secret", "line 2 is no header"),
            (": secret", "line 1 is no header"),
            ("a b: secret", "line 1 is no header"),
            ("token:", "line 1 is no header"),
            ("a: secret\u{1}", "line 1 is no header"),
            ("Content-Length: 7", "line 1 sets content-length"),
            ("transfer-encoding: chunked", "line 1 sets transfer-encoding"),
            ("HOST: secret", "line 1 sets host"),
        ] {
            let error = parse(text).unwrap_err().to_string();
            assert!(error.starts_with(said) && !error.contains("secret"), "{text:?}: {error}");
        }
        let many: String = (0..=HEADERS_MAX).map(|n| format!("x-{n}: y\n")).collect();
        assert!(matches!(parse(&many), Err(HeadersError::TooMany)));
    }

    #[test]
    fn file_that_others_can_read_or_that_is_too_large_is_refused() {
        let file = tempfile::NamedTempFile::new().unwrap();
        fs::write(&file, "a: b").unwrap();
        assert_eq!(read(file.path()).unwrap().len(), 1);
        fs::set_permissions(&file, fs::Permissions::from_mode(0o640)).unwrap();
        assert!(matches!(read(file.path()), Err(HeadersError::Exposed { mode: 0o640 })));
        fs::set_permissions(&file, fs::Permissions::from_mode(0o600)).unwrap();
        fs::write(&file, format!("a: {}", "b".repeat(FILE_BYTES_MAX))).unwrap();
        assert!(matches!(read(file.path()), Err(HeadersError::TooLarge)));
        assert!(matches!(read(Path::new("/nonexistent")), Err(HeadersError::Io(_))));
    }
}
