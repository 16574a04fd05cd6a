//! The demo's files: a new fleet, an identity and a configuration for each of three nodes, and their logs.
//!
//! The configurations are as a user would write them and use no key that only the demo has.

use std::fs;
use std::io;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};

use sgc_node::config::{QosOverride, SOCKET_PATH_BYTES_MAX, Shaping, ShareConfig, ShareMetadata};
use sgc_process::ProcessError;
use sgc_process::files::{self, Existing};
use sgc_trust::{EnrollRequest, Fleet, Identity, NodeName, Suite};
use sgc_wire::{Class, Name};
use tempfile::TempDir;

use crate::error::DemoError;
use crate::topics::{Role, Topic};

/// The node that only routes.
pub(crate) const CLOUD: &str = "cloud";
const FLEET: &str = "demo";

/// The directory of one demo, with its fleet and identities.
#[derive(Debug)]
pub(crate) struct Stage {
    dir: PathBuf,
    /// Removed with the stage, unless the user keeps it.
    temporary: Option<TempDir>,
    fleet: Fleet,
    robot: Identity,
}

impl Stage {
    /// Makes the directory and the identities. A directory that the user wants to keep must be new or empty.
    pub(crate) fn set(keep: Option<&Path>) -> Result<Self, DemoError> {
        let (dir, temporary) = match keep {
            Some(dir) => {
                make_empty_dir(dir)?;
                (dir.to_owned(), None)
            }
            None => {
                let temporary = tempfile::Builder::new()
                    .prefix("sgc-demo-")
                    .tempdir()
                    .map_err(|source| ProcessError::Write { path: std::env::temp_dir(), source })?;
                (temporary.path().to_owned(), Some(temporary))
            }
        };
        let failed = |source| DemoError::Fleet { path: dir.join(FLEET), source };
        let name = FLEET.parse().map_err(DemoError::Label)?;
        let fleet =
            Fleet::create(name, sgc_process::unix_now(), &mut sgc_process::system_rng()?).map_err(failed)?;
        let robot = enroll(&fleet, Role::Robot.name(), false)?;
        let stage = Self { dir, temporary, fleet, robot };
        if stage.is_kept() {
            stage.write_secret(&format!("{FLEET}.fleet"), &stage.fleet.to_text())?;
        }
        stage.write_secret(&identity_file(Role::Robot.name()), &stage.robot.to_text())?;
        let operator = enroll(&stage.fleet, Role::Operator.name(), false)?;
        stage.write_secret(&identity_file(Role::Operator.name()), &operator.to_text())?;
        stage.write_secret(&identity_file(CLOUD), &enroll(&stage.fleet, CLOUD, true)?.to_text())?;
        let longest = stage.socket(Role::Operator.name());
        if longest.as_os_str().len() > SOCKET_PATH_BYTES_MAX {
            let reason = format!(
                "the path {} is too long: a Unix socket in it has at most {SOCKET_PATH_BYTES_MAX} bytes",
                stage.dir.display()
            );
            return Err(DemoError::Failed { reason, facts: Vec::new() });
        }
        Ok(stage)
    }

    /// Writes the router's configuration; to listen at port 0 is to let the system choose.
    pub(crate) fn write_cloud(&self, listen: &str) -> Result<PathBuf, DemoError> {
        let text = format!(
            "# The router: it passes packets on and can read none of them.\n\
             identity = \"{CLOUD}.identity\"\n\n\
             [node]\nname = \"{CLOUD}\"\nstate = \"{CLOUD}.state\"\n\n\
             [router]\nlisten = [\"{listen}\"]\n\n\
             [admin]\nsocket = \"{CLOUD}.sock\"\n"
        );
        self.write(CLOUD, &text)
    }

    /// Writes the configuration of one end.
    pub(crate) fn write_end(&self, role: Role, domain: u32, router: &str) -> Result<PathBuf, DemoError> {
        let (node, far) = (role.name(), role.other().name());
        let mut text = format!(
            "identity = \"{node}.identity\"\n\n\
             [node]\nname = \"{node}\"\nstate = \"{node}.state\"\nrouters = [\"{router}\"]\n\n\
             [ros]\ndomain_id = {domain}\ndiscovery_range = \"localhost\"\nstatic_peers = []\n\n\
             [admin]\nsocket = \"{node}.sock\"\n"
        );
        for topic in Topic::owned_by(role) {
            text += &format!(
                "\n[[share]]\ntopic = \"{}\"\nto = [\"{far}\"]\npriority = \"{}\"\n",
                topic.ros_name(),
                topic.priority()
            );
        }
        for topic in Topic::owned_by(role.other()) {
            text += &format!("\n[[use]]\nfrom = \"{far}\"\ntopic = \"{}\"\n", topic.ros_name());
        }
        self.write(node, &text)
    }

    /// Removes the secrets from disk unless they are kept. Running nodes have read them already.
    pub(crate) fn forget_secrets(&self) -> Result<(), DemoError> {
        if self.is_kept() {
            return Ok(());
        }
        for node in [CLOUD, Role::Robot.name(), Role::Operator.name()] {
            let path = self.dir.join(identity_file(node));
            fs::remove_file(&path).map_err(|source| ProcessError::Write { path, source })?;
        }
        Ok(())
    }

    /// Derives the name of a topic as its owner does.
    pub(crate) fn name_of(&self, topic: Topic) -> Result<Name, DemoError> {
        let owner: NodeName = topic.owner().name().parse()?;
        let share = ShareConfig {
            dead_man: None,
            interface: Default::default(),
            topic: topic.ros_name().to_owned(),
            naming: Default::default(),
            type_name: Some(topic.type_name().to_owned()),
            to: Vec::new(),
            publish: Vec::new(),
            priority: Class::default(),
            shaping: Shaping::default(),
            qos: QosOverride::default(),
            dedicated: false,
            suite: Suite::Group,
            metadata: ShareMetadata::default(),
        };
        Ok(sgc_diagnosis::names::name_of(&self.robot, &self.dir, &owner, &share)?)
    }

    /// Returns the path of a node's status socket.
    pub(crate) fn socket(&self, node: &str) -> PathBuf {
        self.dir.join(format!("{node}.sock"))
    }

    /// Returns the path of a process's log.
    pub(crate) fn log(&self, process: &str) -> PathBuf {
        self.dir.join(format!("{process}.log"))
    }

    /// Returns the directory.
    pub(crate) fn dir(&self) -> &Path {
        &self.dir
    }

    /// Returns `true` if the user asked to keep the files.
    pub(crate) fn is_kept(&self) -> bool {
        self.temporary.is_none()
    }

    fn write(&self, node: &str, text: &str) -> Result<PathBuf, DemoError> {
        let path = self.dir.join(format!("{node}.toml"));
        fs::write(&path, text).map_err(|source| ProcessError::Write { path: path.clone(), source })?;
        Ok(path)
    }

    fn write_secret(&self, file: &str, text: &str) -> Result<(), ProcessError> {
        files::write_secret(&self.dir.join(file), text, Existing::Keep(""))
    }
}

fn identity_file(node: &str) -> String {
    format!("{node}.identity")
}

fn enroll(fleet: &Fleet, node: &str, router: bool) -> Result<Identity, DemoError> {
    let request = EnrollRequest { router, ..EnrollRequest::new(node.parse()?, sgc_process::unix_now()) };
    fleet
        .issue(&request, &mut sgc_process::system_rng()?)
        .map_err(|source| DemoError::Fleet { path: FLEET.into(), source })
}

fn make_empty_dir(dir: &Path) -> Result<(), ProcessError> {
    let failed = |source| ProcessError::Write { path: dir.to_owned(), source };
    match fs::read_dir(dir) {
        Ok(mut entries) => match entries.next() {
            None => Ok(()),
            Some(_) => Err(ProcessError::Exists {
                path: dir.to_owned(),
                hint: " and is not empty; name another directory for --keep",
            }),
        },
        Err(error) if error.kind() == io::ErrorKind::NotFound => {
            fs::DirBuilder::new().recursive(true).mode(0o700).create(dir).map_err(failed)
        }
        Err(error) => Err(failed(error)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn configurations_are_valid_and_match_topic_table() {
        let stage = Stage::set(None).unwrap();
        let environment = |_: &str| None;
        let cloud = stage.write_cloud("quic://127.0.0.1:0").unwrap();
        let cloud = sgc_node::config::load(&cloud, &environment).unwrap();
        assert!(cloud.is_pure_router());
        sgc_node::check_identity(&cloud).unwrap();
        for role in Role::ALL {
            let path = stage.write_end(role, 42, "quic://127.0.0.1:4000").unwrap();
            let config = sgc_node::config::load(&path, &environment).unwrap();
            sgc_node::check_identity(&config).unwrap();
            assert_eq!(config.admin_socket, Some(stage.socket(role.name())));
            assert_eq!(config.shares.len(), Topic::owned_by(role).count());
            assert_eq!(config.uses.len(), Topic::owned_by(role.other()).count());
        }
        stage.forget_secrets().unwrap();
        assert!(files::with_extension(stage.dir(), "identity").unwrap().is_empty());
    }

    #[test]
    fn directory_is_removed_with_stage_unless_kept() {
        let stage = Stage::set(None).unwrap();
        let dir = stage.dir().to_owned();
        assert!(dir.join("robot.identity").is_file());
        drop(stage);
        assert!(!dir.exists());

        let parent = tempfile::tempdir().unwrap();
        let dir = parent.path().join("kept");
        drop(Stage::set(Some(&dir)).unwrap());
        assert!(dir.join("demo.fleet").is_file());
        assert!(matches!(Stage::set(Some(&dir)), Err(DemoError::Process(ProcessError::Exists { .. }))));
    }
}
