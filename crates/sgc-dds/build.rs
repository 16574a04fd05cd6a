//! Links OpenSSL statically for the feature `sros2`.
//!
//! `cyclors` asks the linker for any `ssl` and `crypto`, and the linker prefers shared libraries. The directory named
//! here holds only the static ones, and the linker searches named directories before the system's.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::{env, fs};

const LIBRARIES: [&str; 2] = ["libssl.a", "libcrypto.a"];

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-env-changed=OPENSSL_LIB_DIR");
    if env::var_os("CARGO_FEATURE_SROS2").is_none() {
        return Ok(());
    }
    let out = PathBuf::from(env::var_os("OUT_DIR").ok_or("no OUT_DIR")?);
    for name in LIBRARIES {
        let library = find(name)?;
        fs::copy(&library, out.join(name)).map_err(|e| format!("{}: {e}", library.display()))?;
    }
    println!("cargo::rustc-link-search=native={}", out.display());
    Ok(())
}

/// Finds a static library in `OPENSSL_LIB_DIR`, or where the C compiler finds it.
fn find(name: &str) -> Result<PathBuf, Box<dyn Error>> {
    if let Some(directory) = env::var_os("OPENSSL_LIB_DIR") {
        return Ok(Path::new(&directory).join(name));
    }
    let compiler = env::var_os("CC").unwrap_or_else(|| "cc".into());
    let output = Command::new(compiler).arg(format!("-print-file-name={name}")).output()?;
    let path = PathBuf::from(String::from_utf8(output.stdout)?.trim());
    // The compiler answers with the bare name if there is no such library.
    if path.is_absolute() {
        Ok(path)
    } else {
        Err(format!(
            "{name} is missing: the feature `sros2` needs OpenSSL's static libraries (Debian: libssl-dev)"
        )
        .into())
    }
}
