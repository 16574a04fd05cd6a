//! [`FakeClock`]: a clock of some programs that differs from the host's, and can be set while they run, by libfaketime.

use std::fs;
use std::path::{Path, PathBuf};

/// A file with the offset of a clock, which programs look at once a second.
pub(crate) struct FakeClock(PathBuf);

impl FakeClock {
    /// Makes a clock with this offset, `"+90"` seconds or `"-3d"` for example. Its file is in `dir`.
    pub(crate) fn new(dir: &Path, offset: &str) -> Self {
        let clock = Self(dir.join("clock"));
        clock.set(offset);
        clock
    }

    /// Sets the clock, as a whole: programs read it all the time.
    pub(crate) fn set(&self, offset: &str) {
        let new = self.0.with_extension("new");
        fs::write(&new, offset).unwrap();
        fs::rename(new, &self.0).unwrap();
    }

    /// Returns the variables of a program that has this clock.
    pub(crate) fn environment(&self) -> [(&'static str, String); 4] {
        let text = |path: &Path| path.to_str().unwrap().to_owned();
        [
            ("LD_PRELOAD", text(&library())),
            ("FAKETIME_TIMESTAMP_FILE", text(&self.0)),
            ("FAKETIME_CACHE_DURATION", "1".to_owned()),
            ("FAKETIME_DONT_FAKE_MONOTONIC", "1".to_owned()),
        ]
    }
}

/// Returns the library of Debian's package `libfaketime`.
fn library() -> PathBuf {
    let places = fs::read_dir("/usr/lib").unwrap().flatten();
    let mut found = places.map(|place| place.path().join("faketime/libfaketimeMT.so.1"));
    found.find(|library| library.exists()).expect("libfaketime is missing: run `make deps-test`")
}
