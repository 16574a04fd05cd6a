//! DDS Security of a local network: an enclave of a SROS2 keystore, and programs that are protected against this one.
//!
//! Looks at the files of the enclave before Cyclone does, and says of Cyclone's refusals which file is meant and what to do. Reads neither
//! keys nor certificates: Cyclone's plugins do, with OpenSSL, by the names of the files.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::fs;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use cyclors::DDS_RETCODE_NOT_ALLOWED_BY_SECURITY;
use sgc_ros::Guid;

use crate::entity::reason;
use crate::qos::NativeQos;

/// Bound on the enclaves that an error names.
const NAMED_MAX: usize = 8;

/// Bound on the directories of a keystore that are looked at.
const DIRECTORIES_MAX: usize = 256;

/// Bound on the length of an enclave's name, bytes (rmw: `RMW_NAMESPACE_MAX_LENGTH`).
const NAME_BYTES_MAX: usize = 245;

/// Bits of a file's mode for others than its owner.
const MODE_OF_OTHERS: u32 = 0o077;

/// Files of an enclave, and the properties of a participant that name them (DDS Security 1.1, 9.3.1 and 9.4.1).
const FILES: [(&str, &str); 6] = [
    ("identity_ca.cert.pem", "dds.sec.auth.identity_ca"),
    ("cert.pem", "dds.sec.auth.identity_certificate"),
    (KEY, "dds.sec.auth.private_key"),
    ("permissions_ca.cert.pem", "dds.sec.access.permissions_ca"),
    ("governance.p7s", "dds.sec.access.governance"),
    ("permissions.p7s", "dds.sec.access.permissions"),
];

const KEY: &str = "key.pem";

/// The file that an enclave may have, with its property of Cyclone's own: certificates that were revoked.
const REVOKED: (&str, &str) = ("crl.pem", "org.eclipse.cyclonedds.sec.auth.crl");

/// The plugins that Cyclone has built in, by the names of the libraries that it would load.
const PLUGINS: [(&str, &str); 9] = [
    ("dds.sec.auth.library.path", "dds_security_auth"),
    ("dds.sec.auth.library.init", "init_authentication"),
    ("dds.sec.auth.library.finalize", "finalize_authentication"),
    ("dds.sec.crypto.library.path", "dds_security_crypto"),
    ("dds.sec.crypto.library.init", "init_crypto"),
    ("dds.sec.crypto.library.finalize", "finalize_crypto"),
    ("dds.sec.access.library.path", "dds_security_ac"),
    ("dds.sec.access.library.init", "init_access_control"),
    ("dds.sec.access.library.finalize", "finalize_access_control"),
];

/// An enclave of a keystore, as `ros2 security create_enclave` makes it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Security {
    /// The directory that `ROS_SECURITY_KEYSTORE` names.
    pub keystore: PathBuf,
    /// The enclave's name, such as `/sgc`: see [`is_enclave`].
    pub enclave: String,
}

/// The reason why an enclave cannot be used.
#[derive(Debug)]
pub enum SecurityError {
    /// This build has no plugins.
    NotBuilt,
    /// The name is none.
    Name,
    /// The keystore is not there, or cannot be read.
    Keystore {
        /// Its directory of enclaves.
        directory: PathBuf,
        /// The system's reason.
        reason: std::io::Error,
    },
    /// The keystore has no such enclave.
    Missing {
        /// The directory in which it would be.
        directory: PathBuf,
        /// Some that the keystore has.
        known: Vec<String>,
    },
    /// A file of the enclave is not there, or cannot be read.
    File {
        /// The file.
        file: PathBuf,
        /// The system's reason.
        reason: std::io::Error,
    },
    /// A directory's name cannot stand in a property.
    NotText {
        /// The directory.
        directory: PathBuf,
    },
    /// Cyclone's plugins refuse the enclave.
    Refused {
        /// The directory of the enclave.
        directory: PathBuf,
        /// The plugins' reason.
        said: String,
    },
    /// This process is in the domain already.
    NotFirst,
}

impl fmt::Display for SecurityError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NotBuilt => f.write_str("this build has no DDS Security: build sgc with `--features sros2`"),
            Self::Name => f.write_str("an enclave's name is `/`, or like `/arm/sgc`: letters, digits and `_`"),
            Self::Keystore { directory, reason } => write!(
                f,
                "{}: {reason}; `security_root` (ROS_SECURITY_KEYSTORE) is the directory that `ros2 security create_keystore` made",
                directory.display()
            ),
            Self::Missing { directory, known } => {
                write!(f, "{} is not there; ", directory.display())?;
                match known.as_slice() {
                    [] => f.write_str("the keystore has no enclaves")?,
                    known => write!(f, "the keystore has {}", known.join(", "))?,
                }
                f.write_str("; `ros2 security create_enclave` makes one")
            }
            Self::File { file, reason } => write!(
                f,
                "{}: {reason}; the user that runs sgc reads it, and `ros2 security create_enclave` makes it",
                file.display()
            ),
            Self::NotText { directory } => write!(f, "{:?} is not UTF-8", directory.display()),
            Self::Refused { directory, said } => {
                write!(f, "{} is refused: {}", directory.display(), said.trim())?;
                fix(said).map_or(Ok(()), |fix| write!(f, "; {fix}"))
            }
            Self::NotFirst => f.write_str(
                "this process is in the domain already, and DDS Security admits one of its participants alone: let a node of its own \
                 have the gateway",
            ),
        }
    }
}

impl std::error::Error for SecurityError {}

/// Returns what to do where the plugins' words leave it open. The words are those of `dds_security_api_err.h` and `openssl_support.c`.
fn fix(said: &str) -> Option<&'static str> {
    const FIXES: [(&str, &str); 11] = [
        ("certificate has expired", "make the enclave again, or sign its cert.pem again"),
        ("certificate is not yet valid", "compare the clock with the beginning of cert.pem"),
        ("Can not parse governance", "Cyclone DDS reads governance.p7s strictly, with domains up to 230"),
        ("validity period expired", "sign permissions.p7s again with a later `not_after`"),
        ("validity period has not started", "compare the clock with `not_before` in permissions.p7s"),
        ("Could not find domain", "let governance.p7s and permissions.p7s name this ROS domain"),
        (
            "Could not find valid grant",
            "the subject_name of the grant in permissions.p7s must be that of cert.pem",
        ),
        (
            "PKCS7",
            "permissions_ca.cert.pem must belong to the CA that signed governance.p7s and permissions.p7s",
        ),
        ("local issuer certificate", "cert.pem must be signed by the CA in identity_ca.cert.pem"),
        ("certificate signature failure", "cert.pem must be signed by the CA in identity_ca.cert.pem"),
        ("Failed to parse certificate", "cert.pem and key.pem must be PEM, and the key without a password"),
    ];
    FIXES.iter().find(|(words, _)| said.contains(words)).map(|(_, fix)| *fix)
}

/// Returns `true` for names that rcl accepts as an enclave's: `/`, or tokens of letters, digits and `_`, each after a `/`.
pub fn is_enclave(name: &str) -> bool {
    let is_token = |token: &str| {
        !token.is_empty()
            && !token.as_bytes()[0].is_ascii_digit()
            && token.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'_')
    };
    name.len() <= NAME_BYTES_MAX
        && name.strip_prefix('/').is_some_and(|tokens| tokens.is_empty() || tokens.split('/').all(is_token))
}

impl Security {
    /// Looks whether all is there that Cyclone reads.
    ///
    /// # Errors
    /// The first mistake.
    pub fn check(&self) -> Result<(), SecurityError> {
        if !cfg!(feature = "sros2") {
            return Err(SecurityError::NotBuilt);
        }
        if !is_enclave(&self.enclave) {
            return Err(SecurityError::Name);
        }
        let directory = self.directory();
        let root = self.root();
        if let Err(reason) = fs::read_dir(&root) {
            return Err(SecurityError::Keystore { directory: root, reason });
        }
        if !directory.is_dir() {
            return Err(SecurityError::Missing { known: enclaves(&root), directory });
        }
        if directory.to_str().is_none() {
            return Err(SecurityError::NotText { directory });
        }
        for (name, _) in FILES {
            let file = directory.join(name);
            if let Err(reason) = fs::File::open(&file) {
                return Err(SecurityError::File { file, reason });
            }
        }
        Ok(())
    }

    /// Returns the private key's file if others than its owner may read it.
    pub fn exposed_key(&self) -> Option<PathBuf> {
        let file = self.directory().join(KEY);
        let mode = fs::metadata(&file).ok()?.permissions().mode();
        (mode & MODE_OF_OTHERS != 0).then_some(file)
    }

    fn root(&self) -> PathBuf {
        self.keystore.join("enclaves")
    }

    fn directory(&self) -> PathBuf {
        self.root().join(self.enclave.trim_start_matches('/'))
    }

    /// Makes a participant one of this enclave.
    pub(crate) fn apply(&self, qos: &NativeQos) -> Result<(), SecurityError> {
        self.check()?;
        let directory = self.directory();
        let revoked = directory.join(REVOKED.0).exists().then_some(REVOKED);
        let files = FILES.into_iter().chain(revoked).map(|(name, property)| {
            let file = directory.join(name);
            (property, format!("file:{}", file.display()))
        });
        let plugins = PLUGINS.into_iter().map(|(property, value)| (property, value.to_owned()));
        for (property, value) in files.chain(plugins) {
            let not_text = |_| SecurityError::NotText { directory: directory.clone() };
            qos.set_property(property, &value).map_err(not_text)?;
        }
        Ok(())
    }

    /// Returns the error for the reason of Cyclone's plugins.
    pub(crate) fn refused(&self, said: String) -> SecurityError {
        SecurityError::Refused { directory: self.directory(), said }
    }

    /// Adds to Cyclone's reason for refusing an endpoint which file forbids it, if it is that.
    pub(crate) fn explain(&self, topic: &str, said: String) -> String {
        if !said.starts_with(&reason(DDS_RETCODE_NOT_ALLOWED_BY_SECURITY)) {
            return said;
        }
        let file = self.directory().join("permissions.p7s");
        format!("{said}: {} does not grant {topic} to enclave {}", file.display(), self.enclave)
    }
}

/// The names of some enclaves below a directory, sorted.
fn enclaves(root: &Path) -> Vec<String> {
    let (mut found, mut looked) = (Vec::new(), 0);
    let mut waiting = vec![root.to_owned()];
    while let Some(directory) = waiting.pop() {
        looked += 1;
        if looked > DIRECTORIES_MAX {
            break;
        }
        if directory.join(KEY).exists()
            && let Ok(name) = directory.strip_prefix(root)
        {
            found.push(format!("/{}", name.display()));
        }
        let entries = fs::read_dir(&directory).into_iter().flatten().flatten();
        waiting.extend(entries.map(|entry| entry.path()).filter(|path| path.is_dir()).take(DIRECTORIES_MAX));
    }
    found.sort_unstable();
    found.truncate(NAMED_MAX);
    found
}

/// Bound on silent participants that are remembered.
const SILENT_MAX: usize = 64;

/// Time after which a participant that announces no endpoint counts as silent. Those of ROS 2 announce theirs at once, which takes a
/// second on a busy machine.
const SILENT_AFTER: Duration = Duration::from_secs(10);

/// A participant of ROS 2 that announces itself and has announced no endpoint.
struct Silent {
    enclave: String,
    since: Instant,
}

/// Those of the local networks of this process, by the beginning of their GUID.
static SILENT: Mutex<BTreeMap<[u8; 12], Silent>> = Mutex::new(BTreeMap::new());

/// Returns the enclaves of participants of ROS 2 on the local networks of this process that announce themselves and nothing else: those
/// that DDS Security protects do so towards participants which they do not admit. Sorted, each once.
pub fn silent_enclaves() -> Vec<String> {
    let silent = SILENT.lock().unwrap_or_else(PoisonError::into_inner);
    let silent = silent.values().filter(|silent| silent.since.elapsed() >= SILENT_AFTER);
    let enclaves: BTreeSet<String> = silent.map(|silent| silent.enclave.clone()).collect();
    enclaves.into_iter().collect()
}

/// Remembers a participant that has announced no endpoint yet, if its enclave is one of ROS 2. Logs and alerts show the name.
pub(crate) fn note_silent(participant: &Guid, enclave: &str) {
    let mut silent = SILENT.lock().unwrap_or_else(PoisonError::into_inner);
    if silent.len() < SILENT_MAX && is_enclave(enclave) {
        silent
            .entry(prefix(participant))
            .or_insert_with(|| Silent { enclave: enclave.to_owned(), since: Instant::now() });
    }
}

/// Forgets a participant, which is gone or has announced an endpoint.
pub(crate) fn forget_silent(participant: &Guid) {
    SILENT.lock().unwrap_or_else(PoisonError::into_inner).remove(&prefix(participant));
}

/// The bytes that the GUIDs of a participant and of its endpoints share.
fn prefix(guid: &Guid) -> [u8; 12] {
    let mut prefix = [0; 12];
    prefix.copy_from_slice(&guid.0[..12]);
    prefix
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn enclaves_are_named_as_rcl_names_them() {
        for name in ["/", "/sgc", "/arm_1/sgc"] {
            assert!(is_enclave(name), "{name}");
        }
        for name in ["", "sgc", "/sgc/", "//sgc", "/../private", "/1", "/a-b", "/a b"] {
            assert!(!is_enclave(name), "{name}");
        }
        assert!(!is_enclave(&format!("/{}", "a".repeat(NAME_BYTES_MAX))));
    }

    #[test]
    fn silent_participants_of_hostile_enclaves_are_not_shown() {
        let is_noted = |enclave: &str| {
            let participant = Guid([0xee; 16]);
            note_silent(&participant, enclave);
            SILENT.lock().unwrap().remove(&prefix(&participant)).is_some()
        };
        assert!(is_noted("/arm"));
        for hostile in ["/arm\n2026-01-01T00:00:00Z ERROR all is lost", "/\u{1b}[2J", "arm", ""] {
            assert!(!is_noted(hostile), "{hostile:?}");
        }
    }

    #[test]
    fn refusals_say_what_to_do() {
        assert!(
            fix("Certificate not valid: error: certificate has expired; subject: /CN=a")
                .is_some_and(|fix| fix.contains("cert.pem"))
        );
        assert!(
            fix("Could not find domain 7 in governance").is_some_and(|fix| fix.contains("governance.p7s"))
        );
        assert_eq!(fix("Undefined Error Message"), None);
    }
}
