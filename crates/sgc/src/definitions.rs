//! Where definitions of messages are looked for: directories that are named, `AMENT_PREFIX_PATH`, and what ships inside.
//!
//! What they mean is for `sgc-cdr`.

use std::ffi::OsString;
use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};

use sgc_cdr::{DEFINITION_BYTES_MAX, Layout, Library, TypeError, TypeName};

/// What a sourced ROS 2 environment names its installations in.
const AMENT_PREFIX_PATH: &str = "AMENT_PREFIX_PATH";
/// Directories that are looked into.
const DIRS_MAX: usize = 1024;

/// Finds definitions, and lays types out.
#[derive(Debug, Default)]
pub(crate) struct Definitions {
    library: Library,
    /// Those with packages in them.
    dirs: Vec<PathBuf>,
}

impl Definitions {
    /// Looks into `named` first, then where the environment says.
    pub(crate) fn new(named: &[PathBuf]) -> Self {
        Self::with(named, std::env::var_os(AMENT_PREFIX_PATH))
    }

    fn with(named: &[PathBuf], ament: Option<OsString>) -> Self {
        let prefixes = ament.iter().flat_map(std::env::split_paths).filter(|prefix| prefix.is_absolute());
        let named = named.iter().flat_map(|dir| [dir.clone(), dir.join("share")]);
        let dirs = named.chain(prefixes.map(|prefix| prefix.join("share"))).take(DIRS_MAX).collect();
        Self { library: Library::empty(), dirs }
    }

    /// What messages of a type look like.
    pub(crate) fn layout(&mut self, name: &TypeName) -> Result<Layout, TypeError> {
        let Self { library, dirs } = self;
        library.layout(name, &mut |file| find(dirs, file))
    }
}

fn find(dirs: &[PathBuf], file: &TypeName) -> Option<String> {
    let (package, kind) = (file.package(), file.kind());
    let rest = Path::new(kind).join(format!("{}.{kind}", file.name()));
    dirs.iter().find_map(|dir| {
        // A directory may be that of a package itself.
        let own = dir.file_name().filter(|own| *own == package).map(|_| dir.join(&rest));
        [Some(dir.join(package).join(&rest)), own].into_iter().flatten().find_map(|path| read(&path))
    })
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

    #[test]
    fn what_is_named_comes_before_the_environment_and_what_ships() {
        let dir = tempfile::tempdir().unwrap();
        let write = |path: &str, text: &str| {
            let path = dir.path().join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        };
        write("ament/share/mine/msg/A.msg", "int8 from_ament");
        write("ament/share/mine/srv/S.srv", "int8 a\n---\nint8 b");
        write("ws/mine/msg/A.msg", "int8 named\nstd_msgs/Header header");
        let ament = Some(dir.path().join("ament").into_os_string());
        let members = |named: &[PathBuf], name: &str| {
            let layout = Definitions::with(named, ament.clone()).layout(&name.parse().unwrap()).unwrap();
            format!("{layout:?}")
        };
        let (none, ws) = (vec![], vec![dir.path().join("ws")]);
        assert!(members(&none, "mine/msg/A").contains("from_ament"));
        assert!(members(&ws, "mine/msg/A").contains("named"));
        assert!(members(&[dir.path().join("ws/mine")], "mine/msg/A").contains("named"));
        assert!(members(&none, "mine/srv/S_Response").contains("\"b\""));
        assert!(Definitions::with(&none, None).layout(&"mine/msg/A".parse().unwrap()).is_err());
    }
}
