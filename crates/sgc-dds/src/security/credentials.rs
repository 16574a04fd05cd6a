//! The contents of an enclave's files: whether they belong together and hold now.
//!
//! Asks what Cyclone's plugins ask, with the same library and the same flags, and one thing that they do not: whether
//! the key is that of the certificate. With another key nobody lets the participant in, and only the others know why.
//! Leaves revoked certificates and the rules of governance and permissions to the plugins.

use std::path::{Path, PathBuf};

use openssl::asn1::Asn1TimeRef;
use openssl::pkcs7::{Pkcs7, Pkcs7Flags};
use openssl::pkey::PKey;
use openssl::stack::Stack;
use openssl::x509::store::X509StoreBuilder;
use openssl::x509::{X509, X509StoreContext};

use super::{
    CERTIFICATE, GOVERNANCE, IDENTITY_CA, KEY, PERMISSIONS, PERMISSIONS_CA, SecurityError, read_bounded,
};

/// `X509_V_ERR_CERT_NOT_YET_VALID` (OpenSSL's `x509_vfy.h`).
const NOT_YET_VALID: i32 = 9;

/// `X509_V_ERR_CERT_HAS_EXPIRED`.
const HAS_EXPIRED: i32 = 10;

/// Checks the files of an enclave against each other and against the clock.
///
/// # Errors
/// The first mistake, with the files that it is about.
pub(super) fn check(directory: &Path) -> Result<(), SecurityError> {
    let [ca_file, certificate_file] = [IDENTITY_CA, CERTIFICATE].map(|name| directory.join(name));
    let (ca, certificate) = (certificate_in(&ca_file)?, certificate_in(&certificate_file)?);
    let key_file = directory.join(KEY);
    // An empty password, as the plugins have where no property names one: otherwise OpenSSL asks for it at the
    // terminal.
    let key = PKey::private_key_from_pem_passphrase(&read_bounded(&key_file)?, b"").map_err(|_| {
        SecurityError::Unreadable { file: key_file.clone(), kind: "a private key in PEM without a password" }
    })?;
    if !certificate.public_key().is_ok_and(|public| public.public_eq(&key)) {
        return Err(SecurityError::KeyMismatch { key: key_file, certificate: certificate_file });
    }
    check_certificate(&certificate, certificate_file, ca, ca_file)?;
    let signer_file = directory.join(PERMISSIONS_CA);
    let signer = certificate_in(&signer_file)?;
    for name in [PERMISSIONS, GOVERNANCE] {
        let document = directory.join(name);
        if !is_signed(&read_bounded(&document)?, &signer) {
            return Err(SecurityError::ForeignDocument { document, ca: signer_file });
        }
    }
    Ok(())
}

fn certificate_in(file: &Path) -> Result<X509, SecurityError> {
    X509::from_pem(&read_bounded(file)?)
        .map_err(|_| SecurityError::Unreadable { file: file.to_owned(), kind: "a certificate in PEM" })
}

/// Checks who signed a certificate, and when it holds; as `verify_certificate` in the plugins' `auth_utils.c`.
fn check_certificate(
    certificate: &X509,
    file: PathBuf,
    ca: X509,
    ca_file: PathBuf,
) -> Result<(), SecurityError> {
    let verify = || {
        let mut store = X509StoreBuilder::new()?;
        store.add_cert(ca.clone())?;
        let (store, chain) = (store.build(), Stack::<X509>::new()?);
        X509StoreContext::new()?.init(&store, certificate, &chain, |context| {
            let holds = context.verify_cert()?;
            Ok((!holds).then(|| (context.error(), context.error_depth())))
        })
    };
    let refused = verify().map_err(|_| SecurityError::Unreadable {
        file: file.clone(),
        kind: "a certificate that OpenSSL can check",
    })?;
    let Some((error, depth)) = refused else { return Ok(()) };
    let at = |time: &Asn1TimeRef| time.to_string();
    let (of, in_file) = if depth == 0 { (certificate, &file) } else { (&ca, &ca_file) };
    Err(match error.as_raw() {
        HAS_EXPIRED => SecurityError::Ended { file: in_file.clone(), at: at(of.not_after()) },
        NOT_YET_VALID => SecurityError::NotBegun { file: in_file.clone(), at: at(of.not_before()) },
        _ => SecurityError::ForeignCertificate {
            certificate: file,
            ca: ca_file,
            reason: error.error_string().to_owned(),
        },
    })
}

/// Returns `true` if this certificate's key signed the document; as `PKCS7_document_verify` in the plugins'
/// `access_control_utils.c`.
fn is_signed(document: &[u8], signer: &X509) -> bool {
    let verify = || {
        let (signed, content) = Pkcs7::from_smime(document)?;
        let mut signers = Stack::<X509>::new()?;
        signers.push(signer.clone())?;
        let store = X509StoreBuilder::new()?.build();
        let flags = Pkcs7Flags::TEXT | Pkcs7Flags::NOVERIFY | Pkcs7Flags::NOINTERN;
        let mut text = Vec::new();
        signed.verify(&signers, &store, content.as_deref(), Some(&mut text), flags)
    };
    let result: Result<(), openssl::error::ErrorStack> = verify();
    result.is_ok()
}

/// Returns the subject of a certificate as permissions write it, such as `CN=/sgc`.
pub(super) fn subject(file: &Path) -> Option<String> {
    let certificate = certificate_in(file).ok()?;
    let entries = certificate.subject_name().entries().map(|entry| {
        let key = entry.object().nid().short_name().ok()?;
        Some(format!("{key}={}", entry.data().to_string().ok()?))
    });
    Some(entries.collect::<Option<Vec<_>>>()?.join(","))
}
