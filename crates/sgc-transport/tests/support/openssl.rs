//! The program `openssl`, DTLS that is not ours, and identities in the form that it reads.

use std::process::Stdio;

use sgc_trust::Identity;
use tokio::process::{Child, Command};

/// Starts the program; it ends with the test.
pub(crate) fn openssl(what: &str, args: &[&str]) -> Child {
    Command::new("openssl")
        .arg(what)
        .args(args)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .kill_on_drop(true)
        .spawn()
        .expect("these tests need the program `openssl`")
}

/// Returns a block of an identity's file with its first and last line.
pub(crate) fn pem(identity: &Identity, label: &str) -> String {
    let text = identity.to_text();
    let (begin, end) = (format!("-----BEGIN {label}-----"), format!("-----END {label}-----\n"));
    let start = text.find(&begin).unwrap();
    let stop = text[start..].find(&end).unwrap() + start + end.len();
    text[start..stop].to_owned()
}
