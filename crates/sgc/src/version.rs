//! The version of the program.

use std::sync::OnceLock;

/// The commit of the program and the day of that commit, if they were known when it was built.
#[derive(Clone, Copy, Debug, Default)]
pub struct Build {
    /// The abbreviated hash of the commit.
    pub commit: Option<&'static str>,
    /// The day as YYYY-MM-DD.
    pub date: Option<&'static str>,
}

static VERSION: OnceLock<String> = OnceLock::new();

/// Sets the build of this process. Only the first call counts.
pub(crate) fn set(build: Build) {
    let _ = VERSION.set(text(build));
}

/// Returns the version with the commit and its day, as far as they are known.
pub(crate) fn version() -> &'static str {
    VERSION.get_or_init(|| text(Build::default()))
}

fn text(Build { commit, date }: Build) -> String {
    let number = env!("CARGO_PKG_VERSION");
    let known: Vec<_> = [commit, date].into_iter().flatten().filter(|part| !part.is_empty()).collect();
    if known.is_empty() { number.to_owned() } else { format!("{number} ({})", known.join(", ")) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn version_names_the_commit_if_it_is_known() {
        let number = env!("CARGO_PKG_VERSION");
        assert_eq!(text(Build::default()), number);
        assert_eq!(text(Build { commit: Some(""), date: Some("") }), number);
        let build = Build { commit: Some("0123abcd"), date: Some("2026-11-27") };
        assert_eq!(text(build), format!("{number} (0123abcd, 2026-11-27)"));
    }
}
