//! The store of names: its files, and its operations between the control task and the servers.

use std::io;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};

use sgc_config::StoreSettings;
use sgc_router::StoreOp;
use sgc_store::{StoreConfig, StoreConfigError, StoreTls, StoreTlsError, StoreUser, StoreUserError};
use tokio::sync::mpsc;

use crate::control::event::CoreEvent;

/// Operations that wait for the task of the store: more than a router has under way at one time.
pub(crate) const OPERATIONS_MAX: usize = 2048;
/// News of the store that waits for the control task.
const NEWS_MAX: usize = 256;
/// Most bytes of a file for the store.
const FILE_BYTES_MAX: u64 = 1 << 20;

/// The reason why the settings of a store cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum StoreSettingsError {
    /// A file cannot be read.
    #[error("`{key}` {}: {source}", path.display())]
    File {
        /// The key.
        key: &'static str,
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        source: io::Error,
    },
    /// Others can read a secret.
    #[error("`{key}` {}: others can read it (mode {mode:o}): chmod 600 it", path.display())]
    Exposed {
        /// The key.
        key: &'static str,
        /// The file.
        path: PathBuf,
        /// Its mode.
        mode: u32,
    },
    /// The user or password is wrong.
    #[error("`store_user`: {0}")]
    User(#[from] StoreUserError),
    /// The certificates are wrong.
    #[error(transparent)]
    Tls(#[from] StoreTlsError),
    /// The settings do not fit together.
    #[error("`store`: {0}")]
    Parts(#[from] StoreConfigError),
}

/// Reads the files that the settings name. Blocks.
pub fn load_store(settings: &StoreSettings) -> Result<StoreConfig, StoreSettingsError> {
    let user = match &settings.user {
        Some((name, file)) => Some(StoreUser::new(name, read_secret("store_password_file", file)?)?),
        None => None,
    };
    let tls = if settings.servers.iter().any(|server| server.is_encrypted()) {
        let ca = settings.ca.as_ref().map(|ca| read("store_ca", ca)).transpose()?;
        let own = match &settings.certificate {
            Some((chain, key)) => Some((read("store_certificate", chain)?, read_secret("store_key", key)?)),
            None => None,
        };
        let own = own.as_ref().map(|(chain, key)| (chain.as_slice(), key.as_slice()));
        Some(StoreTls::new(ca.as_deref(), own)?)
    } else {
        None
    };
    Ok(StoreConfig::new(settings.servers.clone(), settings.prefix.clone(), user, tls)?)
}

fn read(key: &'static str, path: &Path) -> Result<Vec<u8>, StoreSettingsError> {
    let bytes = std::fs::metadata(path).and_then(|meta| match meta.len() {
        0..=FILE_BYTES_MAX => std::fs::read(path),
        _ => Err(io::ErrorKind::FileTooLarge.into()),
    });
    bytes.map_err(|source| StoreSettingsError::File { key, path: path.to_owned(), source })
}

fn read_secret(key: &'static str, path: &Path) -> Result<Vec<u8>, StoreSettingsError> {
    let bytes = read(key, path)?;
    let mode = std::fs::metadata(path).map_or(0, |meta| meta.permissions().mode() & 0o777);
    if mode & 0o077 != 0 {
        return Err(StoreSettingsError::Exposed { key, path: path.to_owned(), mode });
    }
    Ok(bytes)
}

/// Carries out the operations of the control task until it ends.
pub(crate) async fn serve(
    config: StoreConfig,
    operations: mpsc::Receiver<StoreOp>,
    core: mpsc::Sender<CoreEvent>,
) {
    let (events, mut news) = mpsc::channel(NEWS_MAX);
    let tell = async {
        while let Some(event) = news.recv().await {
            if core.send(CoreEvent::Store(event)).await.is_err() {
                return;
            }
        }
    };
    tokio::select! {
        () = sgc_store::run(config, operations, events) => {}
        () = tell => {}
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    fn settings(server: &str, user: Option<(String, PathBuf)>) -> StoreSettings {
        StoreSettings {
            servers: vec![server.parse().unwrap()],
            prefix: Default::default(),
            user,
            ca: None,
            certificate: None,
        }
    }

    #[test]
    fn password_that_others_can_read_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("store.password");
        fs::write(&file, "secret\n").unwrap();
        let settings = settings("valkey://store.example", Some(("router".to_owned(), file.clone())));
        fs::set_permissions(&file, fs::Permissions::from_mode(0o640)).unwrap();
        let refused = load_store(&settings).unwrap_err();
        assert!(matches!(refused, StoreSettingsError::Exposed { mode: 0o640, .. }), "{refused}");
        fs::set_permissions(&file, fs::Permissions::from_mode(0o600)).unwrap();
        load_store(&settings).unwrap();
    }

    #[test]
    fn missing_file_is_named() {
        let settings = settings("valkey://store.example", Some(("router".to_owned(), "/nowhere".into())));
        let text = load_store(&settings).unwrap_err().to_string();
        assert!(text.starts_with("`store_password_file` /nowhere: "), "{text}");
    }

    #[test]
    fn file_without_certificates_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("ca.pem");
        fs::write(&file, "nothing").unwrap();
        let settings = StoreSettings { ca: Some(file), ..settings("valkeys://store.example", None) };
        assert!(matches!(load_store(&settings), Err(StoreSettingsError::Tls(StoreTlsError::NoCa))));
    }
}
