//! Bounded reading of small text files, such as those of `/proc`.

use std::fs::File;
use std::io::Read as _;

/// Most bytes that are read of a file.
const FILE_BYTES_MAX: u64 = 1 << 20;

/// Returns the text of a file, up to a bound. Returns `None` if the file cannot be read or is not UTF-8.
pub(crate) fn read_file(name: &str) -> Option<String> {
    let mut text = String::new();
    let file = File::open(name).ok()?;
    file.take(FILE_BYTES_MAX).read_to_string(&mut text).ok()?;
    Some(text)
}
