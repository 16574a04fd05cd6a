//! Text files of several named blocks, as in RFC 7468: lines outside of blocks are comments for people.
//!
//! [`crate::Identity`] and [`crate::Fleet`] give the blocks their meaning. Errors never repeat the content of a block,
//! because it may be a key.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use zeroize::Zeroizing;

/// Longest identity file that is read, bytes.
pub(crate) const FILE_BYTES_MAX: usize = 256 * 1024;
/// Longest fleet file that is read, bytes: it has room for thousands of nodes.
pub const FLEET_FILE_BYTES_MAX: usize = 16 * 1024 * 1024;
/// Most blocks of one file.
const BLOCKS_MAX: usize = 64;
const LINE_CHARS: usize = 64;

/// The reason why a text is not a sequence of blocks.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PemError {
    /// The file is too long to be one of ours.
    #[error("the file has {bytes} bytes, at most {max} are read")]
    TooLong {
        /// Its length.
        bytes: usize,
        /// The limit.
        max: usize,
    },
    /// Too many blocks.
    #[error("the file has more than {BLOCKS_MAX} blocks")]
    TooManyBlocks,
    /// A block that is not closed.
    #[error("block \"{label}\" that begins on line {line} has no end")]
    Unterminated {
        /// Its label.
        label: String,
        /// The line of its beginning, from 1.
        line: usize,
    },
    /// An end without its beginning, or a beginning inside of a block.
    #[error("line {line} is out of place: a block has to begin and end with the same label")]
    Misplaced {
        /// The line, from 1.
        line: usize,
    },
    /// The content is not base64.
    #[error("block \"{label}\" that begins on line {line} is not base64")]
    NotBase64 {
        /// Its label.
        label: String,
        /// The line of its beginning, from 1.
        line: usize,
    },
}

/// Returns the contents of the blocks of a file that have one of these labels, in their order; others are skipped.
pub fn pem_contents(text: &str, labels: &[&str]) -> Result<Vec<Zeroizing<Vec<u8>>>, PemError> {
    let blocks = parse(text, FILE_BYTES_MAX)?;
    let wanted = blocks.into_iter().filter(|b| labels.contains(&b.label.as_str()));
    Ok(wanted.map(|b| b.content).collect())
}

/// One block, decoded.
pub(crate) struct Block {
    pub(crate) label: String,
    pub(crate) content: Zeroizing<Vec<u8>>,
}

/// Reads all blocks of `text`, which has at most `max` bytes.
pub(crate) fn parse(text: &str, max: usize) -> Result<Vec<Block>, PemError> {
    if text.len() > max {
        return Err(PemError::TooLong { bytes: text.len(), max });
    }
    let mut blocks = Vec::new();
    let mut open: Option<(String, usize, Zeroizing<String>)> = None;
    for (index, raw) in text.lines().enumerate() {
        let line = index + 1;
        let content = raw.trim();
        let begin = marker(content, "-----BEGIN ");
        let end = marker(content, "-----END ");
        open = match (open, begin, end) {
            (None, Some(label), _) if blocks.len() < BLOCKS_MAX => {
                // Capacity up front: a growing string leaves copies of a key behind.
                Some((label.to_owned(), line, Zeroizing::new(String::with_capacity(text.len()))))
            }
            (None, Some(_), _) => return Err(PemError::TooManyBlocks),
            (None, None, Some(_)) | (Some(_), Some(_), _) => return Err(PemError::Misplaced { line }),
            (None, None, None) => None,
            (Some((label, begin, base64)), None, Some(end)) if end == label => {
                let content = STANDARD
                    .decode(base64.as_bytes())
                    .map_err(|_| PemError::NotBase64 { label: label.clone(), line: begin })?;
                blocks.push(Block { label, content: Zeroizing::new(content) });
                None
            }
            (Some(_), None, Some(_)) => return Err(PemError::Misplaced { line }),
            (Some((label, begin, mut base64)), None, None) => {
                base64.push_str(content);
                Some((label, begin, base64))
            }
        };
    }
    match open {
        Some((label, line, _)) => Err(PemError::Unterminated { label, line }),
        None => Ok(blocks),
    }
}

/// Returns the blocks as text, one behind the other.
pub(crate) fn write(comment: &str, blocks: &[(&str, &[u8])]) -> Zeroizing<String> {
    let estimate = |(label, content): &(&str, &[u8])| 64 + 2 * label.len() + content.len() * 3 / 2;
    let mut out =
        Zeroizing::new(String::with_capacity(comment.len() + blocks.iter().map(estimate).sum::<usize>()));
    out.push_str(comment);
    for (label, content) in blocks {
        let base64 = Zeroizing::new(STANDARD.encode(content));
        out.push_str(&format!("-----BEGIN {label}-----\n"));
        let mut rest = base64.as_str();
        while !rest.is_empty() {
            let (line, tail) = rest.split_at(rest.len().min(LINE_CHARS));
            out.push_str(line);
            out.push('\n');
            rest = tail;
        }
        out.push_str(&format!("-----END {label}-----\n"));
    }
    out
}

/// Returns one block as text; for content that is no secret.
pub fn pem_text(label: &str, content: &[u8]) -> String {
    write("", &[(label, content)]).to_string()
}

fn marker<'a>(line: &'a str, prefix: &str) -> Option<&'a str> {
    line.strip_prefix(prefix)?.strip_suffix("-----")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_round_trip_between_comments() {
        let long = vec![7; 200];
        let text = write("# hello\n", &[("A B", &long), ("C", &[])]);
        assert!(text.lines().all(|l| l.len() <= LINE_CHARS));
        let blocks = parse(&format!("{}trailing words\n", text.as_str()), FILE_BYTES_MAX).unwrap();
        let got: Vec<_> = blocks.iter().map(|b| (b.label.as_str(), b.content.as_slice())).collect();
        assert_eq!(got, [("A B", long.as_slice()), ("C", &[])]);
    }

    #[test]
    fn broken_files_name_the_line() {
        let refused = |text: &str| parse(text, FILE_BYTES_MAX).err().unwrap();
        assert_eq!(
            refused("x\n-----BEGIN A-----\nAAAA\n"),
            PemError::Unterminated { label: "A".into(), line: 2 }
        );
        assert_eq!(refused("-----END A-----"), PemError::Misplaced { line: 1 });
        assert_eq!(refused("-----BEGIN A-----\n-----END B-----"), PemError::Misplaced { line: 2 });
        assert_eq!(refused("-----BEGIN A-----\n-----BEGIN A-----"), PemError::Misplaced { line: 2 });
        assert!(matches!(
            refused("-----BEGIN A-----\n!!!\n-----END A-----"),
            PemError::NotBase64 { line: 1, .. }
        ));
        assert!(matches!(refused(&"x".repeat(FILE_BYTES_MAX + 1)), PemError::TooLong { .. }));
        assert_eq!(refused(&"-----BEGIN A-----\n-----END A-----\n".repeat(65)), PemError::TooManyBlocks);
    }
}
