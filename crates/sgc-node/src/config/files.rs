//! The files that a configuration names: whether each is there, readable, and what its key takes.
//!
//! They are read to be judged only; the node reads them again when it starts.

use std::fs;
use std::io::{self, Read};
use std::path::Path;

use sgc_trust::{ShareToken, TOKEN_TEXT_BYTES_MAX};

use super::error::Mistake;
use super::resolve::{FileChecks, IdentityFile};
use crate::{partners, state};

/// The checks of [`super::load`].
pub(super) const FILES: FileChecks = FileChecks {
    identity: check_identity,
    ca: check_ca,
    token: check_token,
    fleet: check_fleet,
    directory: check_directory,
};

fn check_ca(key: &'static str, path: &Path) -> Result<(), Mistake> {
    const EXPECTED: &str = "a file of CA certificates in PEM, such as `sgc fleet show --ca` prints";
    partners::read_ca_file(path).map(drop).map_err(|error| Mistake::File {
        key,
        path: path.to_owned(),
        reason: error.to_string(),
        expected: EXPECTED,
    })
}

fn check_token(key: &'static str, path: &Path) -> Result<ShareToken, Mistake> {
    let path = path.to_owned();
    let mut text = zeroize::Zeroizing::new(String::with_capacity(TOKEN_TEXT_BYTES_MAX + 2));
    let limit = TOKEN_TEXT_BYTES_MAX as u64 + 1;
    private(key, &path, "the topic's secret")?;
    let read = fs::File::open(&path).and_then(|file| file.take(limit).read_to_string(&mut text));
    if let Err(error) = read {
        let expected = "a file that holds a token, and that this user may read";
        return Err(Mistake::File { key, path, reason: error.to_string(), expected });
    }
    ShareToken::parse(&text).map_err(|fault| Mistake::Token { key, fault })
}

fn check_fleet(key: &'static str, path: &Path) -> Result<(), Mistake> {
    private(key, path, "the CA's private key")?;
    fs::File::open(path).map(drop).map_err(|error| Mistake::File {
        key,
        path: path.to_owned(),
        reason: error.to_string(),
        expected: "the file that `sgc fleet create` made, and that this user may read",
    })
}

fn check_directory(key: &'static str, path: &Path) -> Result<(), Mistake> {
    fs::read_dir(path).map(drop).map_err(|error| Mistake::File {
        key,
        path: path.to_owned(),
        reason: error.to_string(),
        expected: "a directory with packages of ROS 2, and that this user may read",
    })
}

fn private(key: &'static str, path: &Path, what: &'static str) -> Result<(), Mistake> {
    let metadata = fs::metadata(path).map_err(|error| Mistake::File {
        key,
        path: path.to_owned(),
        reason: match error.kind() {
            io::ErrorKind::NotFound => "no such file".to_owned(),
            _ => error.to_string(),
        },
        expected: "a file that this user may read",
    })?;
    match state::exposed(&metadata) {
        None => Ok(()),
        Some(mode) => Err(Mistake::FileExposed { key, path: path.to_owned(), mode, what }),
    }
}

fn check_identity(file: &IdentityFile<'_>) -> Result<(), Mistake> {
    let (path, key) = (file.path, file.key);
    let unreadable = |reason: String| Mistake::IdentityUnreadable { key, path: path.to_owned(), reason };
    let metadata = fs::metadata(path).map_err(|error| {
        if error.kind() == io::ErrorKind::NotFound {
            let node = file.node_name.map_or("NODE".to_owned(), ToString::to_string);
            Mistake::IdentityMissing { key, implied: file.implied, path: path.to_owned(), node }
        } else {
            unreadable(error.to_string())
        }
    })?;
    if !metadata.is_file() {
        return Err(unreadable("not a file".to_owned()));
    }
    if let Some(mode) = state::exposed(&metadata) {
        return Err(Mistake::IdentityExposed { key, path: path.to_owned(), mode });
    }
    fs::File::open(path).map(drop).map_err(|error| unreadable(error.to_string()))
}
