//! Where definitions of messages are looked for: directories that are named, `AMENT_PREFIX_PATH`, and what ships inside.
//!
//! What they mean is for `sgc-cdr`. Nothing is kept: a type is looked for once, and then described.

use std::ffi::OsStr;
use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};

use sgc_cdr::{DEFINITION_BYTES_MAX, Layout, Library, TypeError, TypeName};

/// What a sourced ROS 2 environment names its installations in.
const AMENT_PREFIX_PATH: &str = "AMENT_PREFIX_PATH";
/// Directories that are looked into.
const DIRS_MAX: usize = 1024;

/// Finds definitions, and lays types out.
#[derive(Clone, Debug, Default)]
pub struct Definitions {
    /// Those with packages in them.
    dirs: Vec<PathBuf>,
}

impl Definitions {
    /// Looks into `named` first, then where the environment of the process says.
    pub fn from_env(named: &[PathBuf]) -> Self {
        Self::new(named, std::env::var_os(AMENT_PREFIX_PATH).as_deref())
    }

    /// Looks into `named` first, then into the installations of `ament`, as `AMENT_PREFIX_PATH` has them.
    pub fn new(named: &[PathBuf], ament: Option<&OsStr>) -> Self {
        let prefixes =
            ament.into_iter().flat_map(std::env::split_paths).filter(|prefix| prefix.is_absolute());
        let named = named.iter().flat_map(|dir| [dir.clone(), dir.join("share")]);
        Self { dirs: named.chain(prefixes.map(|prefix| prefix.join("share"))).take(DIRS_MAX).collect() }
    }

    /// What messages of a type look like, or what a service consists of. Reads files.
    pub fn layout(&self, name: &TypeName) -> Result<Layout, TypeError> {
        Library::empty().layout(name, &mut |file| self.text(file))
    }

    /// The text of the file that defines a type, beyond those that ship inside; of a message of a service that of the service:
    /// `file` is named as [`sgc_cdr::LookUp`] has it. Reads files.
    pub fn text(&self, file: &TypeName) -> Option<String> {
        let (package, kind) = (file.package(), file.kind());
        // Packages install both, of which the first says more.
        let files =
            [kind, "idl"].map(|extension| Path::new(kind).join(format!("{}.{extension}", file.name())));
        self.dirs.iter().find_map(|dir| {
            // A directory may be that of a package itself.
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
