//! DDS Security of a local network: an enclave of a SROS2 keystore.
//!
//! This module checks the files of the enclave before Cyclone does, and explains Cyclone's refusals by the file and
//! the fix. Cyclone's plugins read the files themselves, by their names.

#[cfg(feature = "sros2")]
mod credentials;

use std::fmt;
use std::fs;
use std::io::Read as _;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};

use cyclors::DDS_RETCODE_NOT_ALLOWED_BY_SECURITY;
use sgc_ros::{ENCLAVE_BYTES_MAX, is_enclave};

use crate::entity::reason;
use crate::qos::NativeQos;

/// Most enclaves that an error names.
const NAMED_MAX: usize = 8;

/// Most directories of a keystore that are searched.
const DIRECTORIES_MAX: usize = 256;

/// The bits of a file's mode for users other than its owner.
const MODE_OF_OTHERS: u32 = 0o077;

/// Longest file of an enclave, in bytes.
const FILE_BYTES_MAX: u64 = 1 << 20;

const IDENTITY_CA: &str = "identity_ca.cert.pem";
const CERTIFICATE: &str = "cert.pem";
const KEY: &str = "key.pem";
const PERMISSIONS_CA: &str = "permissions_ca.cert.pem";
const GOVERNANCE: &str = "governance.p7s";
const PERMISSIONS: &str = "permissions.p7s";

/// The files of an enclave, and the participant properties that name them (DDS Security 1.1, 9.3.1 and 9.4.1).
const FILES: [(&str, &str); 6] = [
    (IDENTITY_CA, "dds.sec.auth.identity_ca"),
    (CERTIFICATE, "dds.sec.auth.identity_certificate"),
    (KEY, "dds.sec.auth.private_key"),
    (PERMISSIONS_CA, "dds.sec.access.permissions_ca"),
    (GOVERNANCE, "dds.sec.access.governance"),
    (PERMISSIONS, "dds.sec.access.permissions"),
];

/// An optional file of an enclave, the list of revoked certificates, and Cyclone's property for it.
const REVOKED: (&str, &str) = ("crl.pem", "org.eclipse.cyclonedds.sec.auth.crl");

/// Cyclone's built-in plugins, by the names of the libraries that it would load.
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

/// An enclave of a keystore, as created by `ros2 security create_enclave`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Security {
    /// The directory that `ROS_SECURITY_KEYSTORE` names.
    pub keystore: PathBuf,
    /// The enclave's name, such as `/sgc`: see [`sgc_ros::is_enclave`].
    pub enclave: String,
}

/// The reason why an enclave cannot be used.
#[derive(Debug)]
pub enum SecurityError {
    /// This build has no plugins.
    NotBuilt,
    /// The name is invalid.
    Name,
    /// The keystore is missing or unreadable.
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
        /// Some enclaves that the keystore has.
        known: Vec<String>,
    },
    /// A file of the enclave is missing or unreadable.
    File {
        /// The file.
        file: PathBuf,
        /// The system's reason.
        reason: std::io::Error,
    },
    /// The name of a directory is not valid text for a property.
    NotText {
        /// The directory.
        directory: PathBuf,
    },
    /// A file of the enclave has the wrong content.
    Unreadable {
        /// The file.
        file: PathBuf,
        /// The required content.
        kind: &'static str,
    },
    /// The private key does not belong to the certificate.
    KeyMismatch {
        /// The file of the key.
        key: PathBuf,
        /// The file of the certificate.
        certificate: PathBuf,
    },
    /// A certificate or the permissions have expired.
    Ended {
        /// The file.
        file: PathBuf,
        /// The end, as written in the file.
        at: String,
    },
    /// A certificate or the permissions are not valid yet.
    NotBegun {
        /// The file.
        file: PathBuf,
        /// The beginning, as written in the file.
        at: String,
    },
    /// Another CA signed the certificate.
    ForeignCertificate {
        /// The file of the certificate.
        certificate: PathBuf,
        /// The file of the CA.
        ca: PathBuf,
        /// OpenSSL's reason.
        reason: String,
    },
    /// Another CA signed governance or permissions, or they were changed since.
    ForeignDocument {
        /// The file of governance or permissions.
        document: PathBuf,
        /// The file of the CA.
        ca: PathBuf,
    },
    /// The permissions are for other enclaves.
    OtherSubject {
        /// The file of the permissions.
        permissions: PathBuf,
        /// Some subjects of the permissions.
        granted: Vec<String>,
        /// The file of the certificate.
        certificate: PathBuf,
        /// The certificate's subject, if it can be written.
        subject: Option<String>,
    },
    /// Cyclone's plugins refuse the enclave.
    Refused {
        /// The directory of the enclave.
        directory: PathBuf,
        /// The plugins' reason.
        said: String,
    },
    /// This Cyclone DDS differs from the expected one and does not accept a second participant of this process.
    NotFirst,
}

impl SecurityError {
    /// Returns `true` if there is no enclave, as opposed to an enclave with a mistake. Without one, rcl continues
    /// without security unless `ROS_SECURITY_STRATEGY` is `Enforce`.
    pub fn is_absence(&self) -> bool {
        matches!(self, Self::NotBuilt | Self::Keystore { .. } | Self::Missing { .. } | Self::File { .. })
    }
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
            Self::Unreadable { file, kind } => write!(
                f,
                "{} is not {kind}; `ros2 security create_enclave` makes one where none is",
                file.display()
            ),
            Self::KeyMismatch { key, certificate } => write!(
                f,
                "{} is not the private key of {}; put back the key that the certificate was made for, or remove both and let \
                 `ros2 security create_enclave` make them anew",
                key.display(),
                certificate.display()
            ),
            Self::Ended { file, at } => {
                write!(f, "{} ended at {at}; {}", file.display(), renewal(file))
            }
            Self::NotBegun { file, at } => {
                write!(f, "{} begins at {at}; set the clock, or {}", file.display(), renewal(file))
            }
            Self::ForeignCertificate { certificate, ca, reason } => write!(
                f,
                "{} was not signed by the CA in {} ({reason}); take both from one keystore, or {}",
                certificate.display(),
                ca.display(),
                renewal(certificate)
            ),
            Self::ForeignDocument { document, ca } => write!(
                f,
                "{} was not signed by the CA in {}, or was changed since; take both from one keystore, or {}",
                document.display(),
                ca.display(),
                renewal(document)
            ),
            Self::OtherSubject { permissions, granted, certificate, subject } => {
                let granted = if granted.is_empty() { "others".to_owned() } else { granted.join(", ") };
                let subject = subject.as_deref().map_or(String::new(), |subject| format!(" {subject}"));
                write!(
                    f,
                    "{} grants to {granted}, and not to the subject{subject} of {}; take both from one enclave, or {}",
                    permissions.display(),
                    certificate.display(),
                    renewal(permissions)
                )
            }
            Self::Refused { directory, said } => {
                write!(f, "{} is refused: {}", directory.display(), said.trim())?;
                fix(said).map_or(Ok(()), |fix| write!(f, "; {fix}"))
            }
            Self::NotFirst => f.write_str(
                "this process is in the domain already, and this Cyclone DDS secures one of its participants alone: let a node of its own \
                 have the gateway",
            ),
        }
    }
}

impl std::error::Error for SecurityError {}

/// Returns the way to recreate a file.
fn renewal(file: &Path) -> &'static str {
    match file.file_name().and_then(|name| name.to_str()) {
        Some(PERMISSIONS) => "let `ros2 security create_permission` sign permissions again",
        Some(GOVERNANCE) => "sign governance.xml again with the key of that CA",
        Some(IDENTITY_CA) => "make the keystore again: what its CA signed has ended with it",
        _ => "remove cert.pem and let `ros2 security create_enclave` make it anew",
    }
}

/// Returns the fix where the plugins' words leave it open. The words are those of `dds_security_api_err.h`.
fn fix(said: &str) -> Option<&'static str> {
    const FIXES: [(&str, &str); 3] = [
        ("Can not parse governance", "Cyclone DDS reads governance.p7s strictly, with domains up to 230"),
        ("Can not parse permissions", "Cyclone DDS reads permissions.p7s strictly, with domains up to 230"),
        ("Could not find domain", "let governance.p7s and permissions.p7s name this ROS domain"),
    ];
    FIXES.iter().find(|(words, _)| said.contains(words)).map(|(_, fix)| *fix)
}

/// Reads a file of an enclave.
fn read_bounded(file: &Path) -> Result<Vec<u8>, SecurityError> {
    let mut bytes = Vec::new();
    let read = fs::File::open(file).and_then(|file| file.take(FILE_BYTES_MAX).read_to_end(&mut bytes));
    match read {
        Ok(_) => Ok(bytes),
        Err(reason) => Err(SecurityError::File { file: file.to_owned(), reason }),
    }
}

/// Returns some subjects in signed permissions.
fn subjects(permissions: &str) -> Vec<String> {
    let named = permissions.split("<subject_name>").skip(1);
    let named = named.filter_map(|rest| Some(rest.split_once("</subject_name>")?.0.trim()));
    let plain = named.filter(|name| name.len() <= ENCLAVE_BYTES_MAX && !name.contains(char::is_control));
    plain.map(str::to_owned).take(NAMED_MAX).collect()
}

impl Security {
    /// Checks everything that Cyclone reads.
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
            read_bounded(&directory.join(name))?;
        }
        #[cfg(feature = "sros2")]
        credentials::check(&directory)?;
        Ok(())
    }

    /// Returns the private key's file if users other than its owner may read it.
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

    /// Makes a participant join with this enclave.
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

    /// Returns the error for a reason of Cyclone's plugins, which alone read the permissions:
    /// `validate_subject_name_in_permissions` in `access_control.c`.
    pub(crate) fn refused(&self, said: String) -> SecurityError {
        let directory = self.directory();
        let (permissions, certificate) = (self.permissions(), directory.join(CERTIFICATE));
        if let Some(at) = between(&said, "validity period expired for ", "(expired: ") {
            return SecurityError::Ended { file: permissions, at };
        }
        if let Some(at) = between(&said, "validity period has not started yet for ", "(start: ") {
            return SecurityError::NotBegun { file: permissions, at };
        }
        if said.contains("Subject name is invalid") {
            let text = read_bounded(&permissions).unwrap_or_default();
            let granted = subjects(&String::from_utf8_lossy(&text));
            #[cfg(feature = "sros2")]
            let subject = credentials::subject(&certificate);
            #[cfg(not(feature = "sros2"))]
            let subject = None;
            return SecurityError::OtherSubject { permissions, granted, certificate, subject };
        }
        SecurityError::Refused { directory, said }
    }

    /// Adds the file that forbids an endpoint to Cyclone's reason, if DDS Security forbids it.
    pub(crate) fn explain(&self, topic: &str, said: String) -> String {
        if !Self::forbids(&said) {
            return said;
        }
        format!("{said}: {} does not grant {topic} to enclave {}", self.permissions().display(), self.enclave)
    }

    /// Returns `true` if Cyclone refuses an endpoint because DDS Security forbids it.
    pub(crate) fn forbids(said: &str) -> bool {
        said.starts_with(&reason(DDS_RETCODE_NOT_ALLOWED_BY_SECURITY))
    }

    /// Returns the file of the permissions.
    pub(crate) fn permissions(&self) -> PathBuf {
        self.directory().join(PERMISSIONS)
    }
}

/// Returns the text in the parentheses that begin with `open`, after `words`.
fn between(said: &str, words: &str, open: &str) -> Option<String> {
    let (_, rest) = said.split_once(words)?.1.split_once(open)?;
    Some(rest.split_once(')')?.0.to_owned())
}

/// Returns the names of some enclaves below a directory, sorted.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn refusals_of_the_plugins_are_told_with_the_file_and_what_to_do() {
        let security = Security { keystore: "/k".into(), enclave: "/sgc".to_owned() };
        let refused = |said: &str| security.refused(said.to_owned());
        let ended = refused("Permissions validity period expired for CN=/sgc (expired: 2021-01-01T00:00:00)")
            .to_string();
        let expected = "/k/enclaves/sgc/permissions.p7s ended at 2021-01-01T00:00:00; let `ros2 security create_permission`";
        assert!(ended.starts_with(expected), "{ended}");
        let early = refused(
            "Permissions validity period has not started yet for CN=/sgc (start: 2099-01-01T00:00:00)",
        );
        assert!(
            matches!(&early, SecurityError::NotBegun { at, .. } if at == "2099-01-01T00:00:00"),
            "{early}"
        );
        assert!(matches!(refused("Subject name is invalid"), SecurityError::OtherSubject { .. }));
        assert!(
            refused("Could not find domain 7 in governance").to_string().contains("; let governance.p7s")
        );
        let unknown = refused("Undefined Error Message").to_string();
        assert_eq!(unknown, "/k/enclaves/sgc is refused: Undefined Error Message");
    }

    #[test]
    fn subjects_are_read_from_signed_permissions() {
        let text = "MIME\n<grant><subject_name>CN=/a</subject_name></grant><subject_name> CN=/b </subject_name><subject_name>";
        assert_eq!(subjects(text), ["CN=/a", "CN=/b"]);
        assert_eq!(subjects(&"<subject_name>x</subject_name>".repeat(NAMED_MAX + 1)).len(), NAMED_MAX);
    }
}
