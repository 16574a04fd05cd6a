//! Chunks of Zenoh keys, and the numbers in them.

use std::str::FromStr;

use crate::error::{CodecError, Field};

/// The separator of chunks.
pub(crate) const SLASH: char = '/';
/// The character that stands for [`SLASH`] within a chunk of a token.
pub(crate) const MANGLED_SLASH: char = '%';

/// Checks that a text is a Zenoh key without wildcards: chunks that are not empty, with none of the characters that Zenoh
/// reserves (zenoh-keyexpr 1.10.2 `src/key_expr/borrowed.rs`), and without control characters. A wildcard in a key that
/// SGC subscribed to would match the data of others.
pub(crate) fn check_key(field: Field, text: &str, bytes_max: usize) -> Result<(), CodecError> {
    if text.len() > bytes_max {
        return Err(CodecError::TooLong { field, bytes: text.len(), bytes_max });
    }
    if text.split(SLASH).any(str::is_empty) {
        return Err(CodecError::Empty { field });
    }
    check_characters(field, text, |c| matches!(c, '*' | '$' | '?' | '#') || c.is_control())
}

/// Checks that a text is one chunk of a key.
pub(crate) fn check_chunk(field: Field, text: &str, bytes_max: usize) -> Result<(), CodecError> {
    check_key(field, text, bytes_max)?;
    check_characters(field, text, |c| c == SLASH)
}

/// Checks that mangling a text can be undone.
pub(crate) fn check_unmangled(field: Field, text: &str) -> Result<(), CodecError> {
    check_characters(field, text, |c| c == MANGLED_SLASH)
}

fn check_characters(field: Field, text: &str, is_reserved: impl Fn(char) -> bool) -> Result<(), CodecError> {
    match text.chars().find(|c| is_reserved(*c)) {
        Some(character) => Err(CodecError::Reserved { field, character }),
        None => Ok(()),
    }
}

/// Returns a text as one chunk of a token.
pub(crate) fn mangle(text: &str) -> String {
    text.replace(SLASH, "%")
}

/// Returns the text that a chunk of a token stands for.
pub(crate) fn demangle(chunk: &str) -> String {
    chunk.replace(MANGLED_SLASH, "/")
}

/// Reads a decimal number without a sign.
pub(crate) fn number<N: FromStr>(field: Field, text: &str) -> Result<N, CodecError> {
    let digits = Some(text).filter(|text| text.bytes().all(|b| b.is_ascii_digit()));
    digits.and_then(|digits| digits.parse().ok()).ok_or(CodecError::Number { field })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_have_neither_wildcards_nor_empty_chunks() {
        for key in ["a", "a/b", "@a/b%c/ä", "a b"] {
            assert_eq!(check_key(Field::Key, key, 16), Ok(()), "{key}");
        }
        for key in ["", "/", "/a", "a/", "a//b"] {
            assert_eq!(check_key(Field::Key, key, 16), Err(CodecError::Empty { field: Field::Key }), "{key}");
        }
        for (key, character) in
            [("a/*", '*'), ("a/**", '*'), ("a$*", '$'), ("a?", '?'), ("#", '#'), ("\u{1b}[2J", '\u{1b}')]
        {
            let refusal = CodecError::Reserved { field: Field::Key, character };
            assert_eq!(check_key(Field::Key, key, 16), Err(refusal), "{key}");
        }
        let too_long = CodecError::TooLong { field: Field::Key, bytes: 3, bytes_max: 2 };
        assert_eq!(check_key(Field::Key, "abc", 2), Err(too_long));
        let reserved = |character| Err(CodecError::Reserved { field: Field::Type, character });
        assert_eq!(check_chunk(Field::Type, "a/b", 16), reserved('/'));
        assert_eq!(check_unmangled(Field::Type, "a%b"), reserved('%'));
        assert_eq!(demangle(&mangle("/a/b")), "/a/b");
    }

    #[test]
    fn numbers_are_digits() {
        assert_eq!(number::<u32>(Field::Depth, "4294967295"), Ok(u32::MAX));
        assert_eq!(number::<u32>(Field::Depth, "007"), Ok(7));
        for text in ["", "+1", "-1", " 1", "1 ", "0x1", "1.0", "٣", "4294967296"] {
            assert_eq!(
                number::<u32>(Field::Depth, text),
                Err(CodecError::Number { field: Field::Depth }),
                "{text:?}"
            );
        }
    }
}
