//! Checks the files that a configuration names: each exists, is readable, and has the content that its key takes.
//!
//! The checks keep nothing; the node reads the files again when it starts.

use std::fs;
use std::io::{self, Read};
use std::path::Path;

use rustls_pki_types::PrivateKeyDer;
use rustls_pki_types::pem::PemObject as _;
use sgc_config::{FileChecks, IdentityFile, Mistake};
use sgc_store::StoreUser;
use sgc_trust::{ShareToken, TOKEN_TEXT_BYTES_MAX};

use crate::control::fleet::partners;
use crate::metrics::headers;
use crate::state;

/// Largest file of certificates or of a key for TLS, bytes.
pub(crate) const PEM_BYTES_MAX: u64 = 256 * 1024;

/// Largest file of a password, bytes: more than any password has.
const PASSWORD_FILE_BYTES_MAX: u64 = 4096;

/// Largest session configuration of Zenoh, bytes: 20 times that of rmw_zenoh.
const ZENOH_CONFIG_BYTES_MAX: u64 = 1024 * 1024;

/// The checks of [`super::load`].
pub(super) const FILES: FileChecks = FileChecks {
    identity: check_identity,
    ca: check_ca,
    token: check_token,
    fleet: check_fleet,
    chain: check_chain,
    private_key: check_private_key,
    roots: check_roots,
    headers: check_headers,
    password: check_password,
    zenoh: check_zenoh,
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

fn check_chain(key: &'static str, path: &Path) -> Result<(), Mistake> {
    check_certificates(key, path, "a file of certificates in PEM, the server's own first")
}

fn check_roots(key: &'static str, path: &Path) -> Result<(), Mistake> {
    check_certificates(key, path, "a file of CA certificates in PEM")
}

fn check_headers(key: &'static str, path: &Path) -> Result<(), Mistake> {
    private(key, path, "the collector's token")?;
    let reason = match headers::read(path) {
        Ok(_) => return Ok(()),
        Err(error) => error.to_string(),
    };
    Err(Mistake::OtlpHeaders { key, path: path.to_owned(), reason })
}

fn check_certificates(key: &'static str, path: &Path, expected: &'static str) -> Result<(), Mistake> {
    let read = fs::File::open(path).and_then(|file| {
        let mut pem = Vec::new();
        file.take(PEM_BYTES_MAX).read_to_end(&mut pem).map(|_| pem)
    });
    let reason = match read.map(|pem| partners::chain(&pem)) {
        Ok(Ok(chain)) if !chain.is_empty() => return Ok(()),
        Ok(Ok(_)) => "no certificate is in it".to_owned(),
        Ok(Err(error)) => error.to_string(),
        Err(error) => error.to_string(),
    };
    Err(Mistake::File { key, path: path.to_owned(), reason, expected })
}

fn check_private_key(key: &'static str, path: &Path) -> Result<(), Mistake> {
    private(key, path, "the private key")?;
    let read = fs::File::open(path).and_then(|file| {
        let mut pem = zeroize::Zeroizing::new(Vec::with_capacity(PEM_BYTES_MAX as usize));
        file.take(PEM_BYTES_MAX).read_to_end(&mut pem).map(|_| pem)
    });
    let reason = match read {
        Ok(pem) if PrivateKeyDer::from_pem_slice(&pem).is_ok() => return Ok(()),
        Ok(_) => "no private key is in it".to_owned(),
        Err(error) => error.to_string(),
    };
    let expected = "the private key of the certificate in PEM, without a password";
    Err(Mistake::File { key, path: path.to_owned(), reason, expected })
}

fn check_password(key: &'static str, path: &Path) -> Result<(), Mistake> {
    private(key, path, "the password")?;
    let read = fs::File::open(path).and_then(|file| {
        let mut password = Vec::new();
        file.take(PASSWORD_FILE_BYTES_MAX).read_to_end(&mut password).map(|_| password)
    });
    let reason = match read.map(StoreUser::read_password) {
        Ok(Ok(_)) => return Ok(()),
        Ok(Err(error)) => error.to_string(),
        Err(error) => error.to_string(),
    };
    let expected = "a file with nothing but the password of the store's user";
    Err(Mistake::File { key, path: path.to_owned(), reason, expected })
}

fn check_zenoh(key: &'static str, path: &Path) -> Result<(), Mistake> {
    let read = fs::File::open(path).and_then(|file| {
        let mut text = String::new();
        file.take(ZENOH_CONFIG_BYTES_MAX + 1).read_to_string(&mut text).map(|_| text)
    });
    let reason = match read {
        Ok(text) if text.len() as u64 > ZENOH_CONFIG_BYTES_MAX => {
            format!("it has more than {ZENOH_CONFIG_BYTES_MAX} bytes")
        }
        Ok(text) if text.trim().is_empty() => "it is empty".to_owned(),
        Ok(_) => return Ok(()),
        Err(error) => error.to_string(),
    };
    let expected = "a session configuration of Zenoh, such as rmw_zenoh's, that this user may read";
    Err(Mistake::File { key, path: path.to_owned(), reason, expected })
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
    fs::File::open(path)
        .map(drop)
        .map_err(|error| unreadable(format!("{error}{}", state::owner_hint(path, &error))))
}
