//! Finds definitions of messages: in named directories, in `AMENT_PREFIX_PATH`, and among the shipped ones.
//!
//! `sgc-cdr` parses them. Nothing is kept: a type is looked up once, and then described.

use std::ffi::OsStr;
use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};

use sgc_cdr::{DEFINITION_BYTES_MAX, Layout, Library, TypeError, TypeName};

/// Variable in which a sourced ROS 2 environment names its installations.
const AMENT_PREFIX_PATH: &str = "AMENT_PREFIX_PATH";
/// Most directories that are searched.
const DIRS_MAX: usize = 1024;

/// Finds definitions, and lays types out.
#[derive(Clone, Debug, Default)]
pub struct Definitions {
    /// Directories with packages in them.
    dirs: Vec<PathBuf>,
}

impl Definitions {
    /// Searches `named` first, then the installations in the environment of the process.
    pub fn from_env(named: &[PathBuf]) -> Self {
        Self::new(named, std::env::var_os(AMENT_PREFIX_PATH).as_deref())
    }

    /// Searches `named` first, then the installations of `ament`, in the form of `AMENT_PREFIX_PATH`.
    pub fn new(named: &[PathBuf], ament: Option<&OsStr>) -> Self {
        let prefixes =
            ament.into_iter().flat_map(std::env::split_paths).filter(|prefix| prefix.is_absolute());
        let named = named.iter().flat_map(|dir| [dir.clone(), dir.join("share")]);
        Self { dirs: named.chain(prefixes.map(|prefix| prefix.join("share"))).take(DIRS_MAX).collect() }
    }

    /// Returns the layout of a type's messages, or of a service. Reads files.
    pub fn layout(&self, name: &TypeName) -> Result<Layout, TypeError> {
        Library::empty().layout(name, &mut |file| self.text(file))
    }

    /// Returns the text of the file that defines a type, except for shipped ones; for a message of a service that of
    /// the service: `file` is named as in [`sgc_cdr::LookUp`]. Reads files.
    pub fn text(&self, file: &TypeName) -> Option<String> {
        let (package, kind) = (file.package(), file.kind());
        // Packages install both; the first has more in it.
        let files =
            [kind, "idl"].map(|extension| Path::new(kind).join(format!("{}.{extension}", file.name())));
        self.dirs.iter().find_map(|dir| {
            // A directory may itself be that of a package.
            let own = dir.file_name().filter(|own| *own == package).map(|_| dir.clone());
            let places = [Some(dir.join(package)), own].into_iter().flatten();
            places
                .flat_map(|place| files.iter().map(move |rest| place.join(rest)))
                .find_map(|path| read(&path))
        })
    }
}

fn read(path: &Path) -> Option<String> {
    let mut text = String::new();
    let limit = DEFINITION_BYTES_MAX as u64 + 1;
    File::open(path).ok()?.take(limit).read_to_string(&mut text).ok()?;
    Some(text)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    fn write(dir: &Path, path: &str, text: &str) {
        let path = dir.join(path);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    }

    #[test]
    fn named_folders_come_before_the_environment_and_shipped_types() {
        let dir = tempfile::tempdir().unwrap();
        write(dir.path(), "ament/share/mine/msg/A.msg", "int8 from_ament");
        write(dir.path(), "ament/share/mine/srv/S.srv", "int8 a\n---\nint8 b");
        write(dir.path(), "ws/mine/msg/A.msg", "int8 named\nstd_msgs/Header header");
        let ament = dir.path().join("ament").into_os_string();
        let members = |named: &[PathBuf], name: &str| {
            let layout = Definitions::new(named, Some(&ament)).layout(&name.parse().unwrap()).unwrap();
            format!("{layout:?}")
        };
        let (none, ws) = (vec![], vec![dir.path().join("ws")]);
        assert!(members(&none, "mine/msg/A").contains("from_ament"));
        assert!(members(&ws, "mine/msg/A").contains("named"));
        assert!(members(&[dir.path().join("ws/mine")], "mine/msg/A").contains("named"));
        assert!(members(&none, "mine/srv/S_Response").contains("\"b\""));
        assert!(members(&none, "mine/srv/S").contains("request_message"));
        assert!(Definitions::new(&none, None).layout(&"mine/msg/A".parse().unwrap()).is_err());
    }

    #[test]
    fn idl_serves_where_there_is_no_other_file() {
        let dir = tempfile::tempdir().unwrap();
        let idl =
            |member: &str| format!("module mine {{ module msg {{ struct A {{ octet {member}; }}; }}; }};");
        write(dir.path(), "mine/msg/A.idl", &idl("from_idl"));
        let members = || {
            let definitions = Definitions::new(&[dir.path().to_owned()], None);
            format!("{:?}", definitions.layout(&"mine/msg/A".parse().unwrap()).unwrap())
        };
        assert!(members().contains("from_idl"));
        write(dir.path(), "mine/msg/A.msg", "int8 from_msg");
        assert!(members().contains("from_msg"));
    }
}
