//! Files of the audit log: appending, rotating and reading.
//!
//! `FILE` is the current file, `FILE.1` the file rotated last, `FILE.2` the one before. Another program, such as
//! logrotate, may rename or truncate the file at any time, so the writer checks before each write.

use std::collections::BTreeSet;
use std::fs;
use std::io::{self, BufRead, BufReader, Read, Seek, SeekFrom, Write};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};

use rustix::fs::OFlags;
use sgc_config::AuditRoom;

use super::record::AuditRecord;

/// Longest line that is read, bytes. Written lines are shorter.
const LINE_BYTES_MAX: u64 = 16 * 1024;
/// Most files that are read, the newest first.
const READ_FILES_MAX: usize = 256;
/// Suffixes of files that a log rotator compressed.
const COMPRESSED: [&str; 5] = [".gz", ".xz", ".zst", ".bz2", ".lz4"];

/// Returns the path of the log that was put aside as the `n`th, from 1, the newest.
pub fn rotated_path(path: &Path, n: u32) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(format!(".{n}"));
    PathBuf::from(name)
}

/// The current log file.
pub(super) struct LogFile {
    path: PathBuf,
    room: AuditRoom,
    file: fs::File,
    bytes: u64,
    /// Whether the last line is unfinished.
    is_torn: bool,
}

impl LogFile {
    /// Opens or creates the file at `path`. A path that is no regular file, such as a symbolic link, is an error.
    pub(super) fn open(path: &Path, room: AuditRoom) -> io::Result<Self> {
        // A symbolic link could redirect the log, and opening a pipe could block.
        let flags = (OFlags::NOFOLLOW | OFlags::NONBLOCK).bits() as i32;
        let mut options = fs::OpenOptions::new();
        let options = options.read(true).append(true).create(true).mode(0o600).custom_flags(flags);
        let mut file = options.open(path)?;
        let metadata = file.metadata()?;
        if !metadata.is_file() {
            return Err(io::Error::other("it is not a file"));
        }
        file.set_permissions(fs::Permissions::from_mode(0o600))?;
        let mut is_torn = false;
        if metadata.len() > 0 {
            file.seek(SeekFrom::End(-1))?;
            let mut last = [0];
            file.read_exact(&mut last)?;
            is_torn = last != *b"\n";
        }
        Ok(Self { path: path.to_owned(), room, file, bytes: metadata.len(), is_torn })
    }

    /// Appends whole lines. Rotates the file first if they do not fit.
    pub(super) fn append(&mut self, lines: &str) -> io::Result<()> {
        self.follow()?;
        if self.bytes > 0 && self.bytes + lines.len() as u64 > self.room.max_bytes {
            self.rotate()?;
        }
        if self.is_torn {
            self.write(b"\n")?;
        }
        self.write(lines.as_bytes())
    }

    /// Syncs the lines to the disk.
    pub(super) fn sync(&self) -> io::Result<()> {
        self.file.sync_data()
    }

    /// Reopens the file if another program renamed, removed or truncated it.
    fn follow(&mut self) -> io::Result<()> {
        let ours = self.file.metadata()?;
        match fs::symlink_metadata(&self.path) {
            Ok(there) if (there.dev(), there.ino()) == (ours.dev(), ours.ino()) => {
                // Commands of a user append to the file as well.
                self.bytes = ours.len();
                Ok(())
            }
            Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
            _ => {
                self.file.sync_data()?;
                *self = Self::open(&self.path, self.room)?;
                Ok(())
            }
        }
    }

    fn rotate(&mut self) -> io::Result<()> {
        self.file.sync_data()?;
        // Earlier runs may have kept more files.
        for n in self.room.files.saturating_add(1).. {
            if fs::remove_file(rotated_path(&self.path, n)).is_err() {
                break;
            }
        }
        for n in (0..self.room.files).rev() {
            let from = if n == 0 { self.path.clone() } else { rotated_path(&self.path, n) };
            match fs::rename(from, rotated_path(&self.path, n + 1)) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                _ => {}
            }
        }
        *self = Self::open(&self.path, self.room)?;
        fs::File::open(directory(&self.path))?.sync_all()
    }

    /// Writes bytes. A failed write may have written a part of them.
    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.is_torn = true;
        self.file.write_all(bytes)?;
        self.bytes += bytes.len() as u64;
        self.is_torn = false;
        Ok(())
    }
}

/// The parts of a log that could not be read.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Unread {
    /// Lines that are no records.
    pub lines: u64,
    /// Compressed files, and files beyond the newest 256.
    pub files: Vec<PathBuf>,
}

/// Reads the log at `path` with all rotated files, and passes each record to `take`, the oldest first. Numbered files
/// (`FILE.2`) and dated ones (`FILE-20261124`) belong to it.
pub fn read(path: &Path, mut take: impl FnMut(AuditRecord)) -> io::Result<Unread> {
    let RotatedFiles { files, mut unread } = RotatedFiles::list(path)?;
    // The newest file is opened first. A file that is rotated meanwhile appears again and is recognised by its inode.
    let (mut opened, mut met) = (Vec::new(), BTreeSet::new());
    for path in std::iter::once(path).chain(files.iter().map(PathBuf::as_path)) {
        if opened.len() == READ_FILES_MAX {
            unread.files.push(path.to_owned());
            continue;
        }
        let file = match fs::File::open(path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => continue,
            file => file?,
        };
        let metadata = file.metadata()?;
        if met.insert((metadata.dev(), metadata.ino())) {
            opened.push(file);
        }
    }
    if opened.is_empty() && unread.files.is_empty() {
        return Err(io::ErrorKind::NotFound.into());
    }
    for file in opened.into_iter().rev() {
        unread.lines += read_file(file, &mut take)?;
    }
    Ok(unread)
}

/// Reads one file. Returns the number of lines that are no records.
fn read_file(file: fs::File, take: &mut impl FnMut(AuditRecord)) -> io::Result<u64> {
    let mut malformed = 0;
    let mut reader = BufReader::new(file);
    let mut line = Vec::new();
    let mut is_tail = false;
    loop {
        line.clear();
        let n = (&mut reader).take(LINE_BYTES_MAX).read_until(b'\n', &mut line)?;
        if n == 0 {
            return Ok(malformed);
        }
        let ends = line.last() == Some(&b'\n');
        // The rest of an overlong line belongs to it.
        if !std::mem::replace(&mut is_tail, !ends) {
            match serde_json::from_slice::<AuditRecord>(&line) {
                Ok(record) if !record.event.is_empty() => take(record),
                _ if line.trim_ascii().is_empty() => {}
                _ => malformed += 1,
            }
        }
    }
}

/// The rotated files of a log.
#[derive(Default)]
struct RotatedFiles {
    /// The files, the newest first.
    files: Vec<PathBuf>,
    unread: Unread,
}

impl RotatedFiles {
    fn list(path: &Path) -> io::Result<Self> {
        let mut rotated = Self::default();
        let entries = match fs::read_dir(directory(path)) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(rotated),
            entries => entries?,
        };
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let (mut numbered, mut dated) = (Vec::new(), Vec::new());
        for entry in entries {
            let entry = entry?;
            let found = entry.file_name().to_string_lossy().into_owned();
            let Some(ending) = found.strip_prefix(&name) else { continue };
            let (plain, is_compressed) = match COMPRESSED.iter().find_map(|c| ending.strip_suffix(c)) {
                Some(plain) => (plain, true),
                None => (ending, false),
            };
            let number =
                plain.strip_prefix('.').filter(|n| !n.starts_with('0')).and_then(|n| n.parse::<u32>().ok());
            let is_date = |date: &&str| {
                date.starts_with(|c: char| c.is_ascii_digit())
                    && date.chars().all(|c| c.is_ascii_digit() || c == '-')
            };
            let date = plain.strip_prefix('-').filter(is_date).map(str::to_owned);
            match (number, date) {
                (None, None) => {}
                _ if is_compressed => rotated.unread.files.push(entry.path()),
                (Some(number), _) => numbered.push((number, entry.path())),
                (None, Some(date)) => dated.push((date, entry.path())),
            }
        }
        numbered.sort();
        dated.sort();
        let dated = dated.into_iter().rev().map(|(_, path)| path);
        rotated.files = numbered.into_iter().map(|(_, path)| path).chain(dated).collect();
        rotated.unread.files.sort();
        Ok(rotated)
    }
}

fn directory(path: &Path) -> &Path {
    path.parent().filter(|dir| !dir.as_os_str().is_empty()).unwrap_or(Path::new("."))
}
