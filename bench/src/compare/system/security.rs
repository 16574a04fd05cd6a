//! One DDS network over the path, secured by DDS itself, as SROS2 sets it up: authentication, access control,
//! encryption.
//!
//! The keystore is made for the run: one CA for identities and permissions, an enclave for each place, and documents
//! with what SROS2 writes into them by default. Programs are a build of `load` whose Cyclone has the plug-ins.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result, ensure};

use super::{Dds, Running, System, Topic};
use crate::compare::lab::{Lab, Side};

/// Longer than any run, days.
const VALID_DAYS: &str = "2";

/// Cyclone with DDS Security.
pub(crate) struct DdsSecurity {
    /// The build of `load` with the plug-ins.
    load: PathBuf,
}

impl DdsSecurity {
    /// With this build of `load`; whether it is there shows when it starts.
    pub(crate) fn new(load: &Path) -> Self {
        Self { load: load.to_owned() }
    }
}

impl System for DdsSecurity {
    fn name(&self) -> String {
        "dds-security".into()
    }

    fn start(&self, lab: &Lab, _: &[Topic]) -> Result<Running> {
        let load = self.load.canonicalize();
        let load = load.with_context(|| format!("{}: is it built?", self.load.display()))?;
        let keystore = Keystore::make(lab.new_dir("keystore")?)?;
        let dds = Side::BOTH.map(|side| {
            let mut dds = Dds::between(lab.address(side), lab.address(side.other()));
            let security = format!("{}</Domain>", keystore.config(side));
            dds.uri = dds.uri.map(|uri| uri.replace("</Domain>", &security));
            dds.load = Some(load.clone());
            dds
        });
        Ok(Running { processes: Vec::new(), dds })
    }
}

/// Files that say who may what.
struct Keystore {
    dir: PathBuf,
}

impl Keystore {
    fn make(dir: PathBuf) -> Result<Self> {
        let keystore = Self { dir };
        const KEY: [&str; 5] = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"];
        keystore.openssl(
            &[
                &["req", "-x509", "-subj", "/CN=ca", "-keyout", "ca.key", "-out", "ca.pem"],
                &KEY[..],
                &["-days", VALID_DAYS],
            ]
            .concat(),
        )?;
        keystore.sign("governance", &governance())?;
        for side in Side::BOTH {
            let name = side.name();
            let file = |ending: &str| format!("{name}.{ending}");
            let (key, request, certificate) = (file("key"), file("csr"), file("pem"));
            let subject = format!("/CN={name}");
            keystore.openssl(
                &[&["req", "-subj", &subject, "-keyout", &key, "-out", &request], &KEY[..]].concat(),
            )?;
            let issuer = ["-CA", "ca.pem", "-CAkey", "ca.key", "-CAcreateserial", "-days", VALID_DAYS];
            keystore
                .openssl(&[&["x509", "-req", "-in", &request, "-out", &certificate], &issuer[..]].concat())?;
            keystore.sign(name, &permissions(name))?;
        }
        Ok(keystore)
    }

    /// Writes a document as `NAME.p7s`, signed by the CA.
    fn sign(&self, name: &str, text: &str) -> Result<()> {
        let (document, signed) = (format!("{name}.xml"), format!("{name}.p7s"));
        fs::write(self.dir.join(&document), text)?;
        let signer = ["-signer", "ca.pem", "-inkey", "ca.key"];
        self.openssl(&[&["smime", "-sign", "-text", "-in", &document, "-out", &signed], &signer[..]].concat())
    }

    fn openssl(&self, args: &[&str]) -> Result<()> {
        let output = Command::new("openssl").args(args).current_dir(&self.dir).output().context("openssl")?;
        ensure!(
            output.status.success(),
            "openssl {}: {}",
            args.first().copied().unwrap_or_default(),
            String::from_utf8_lossy(&output.stderr).trim()
        );
        Ok(())
    }

    /// The section of Cyclone's configuration, for programs at a place. A static Cyclone finds its plug-ins by name.
    fn config(&self, side: Side) -> String {
        let file = |name: &str| format!("file:{}", self.dir.join(name).display());
        let plugin = |name: &str, function: &str| {
            format!(
                "<Library path=\"dds_security_{name}\" initFunction=\"init_{function}\" \
                 finalizeFunction=\"finalize_{function}\"/>"
            )
        };
        let (name, ca) = (side.name(), file("ca.pem"));
        format!(
            "<Security><Authentication>{}<IdentityCA>{ca}</IdentityCA>\
             <IdentityCertificate>{}</IdentityCertificate><PrivateKey>{}</PrivateKey></Authentication>\
             <Cryptographic>{}</Cryptographic>\
             <AccessControl>{}<PermissionsCA>{ca}</PermissionsCA><Governance>{}</Governance>\
             <Permissions>{}</Permissions></AccessControl></Security>",
            plugin("auth", "authentication"),
            file(&format!("{name}.pem")),
            file(&format!("{name}.key")),
            plugin("crypto", "crypto"),
            plugin("ac", "access_control"),
            file("governance.p7s"),
            file(&format!("{name}.p7s")),
        )
    }
}

/// Returns SROS2's default governance: no participant without identity, all encrypted, packets signed.
fn governance() -> String {
    let rules = "<allow_unauthenticated_participants>false</allow_unauthenticated_participants>\
         <enable_join_access_control>true</enable_join_access_control>\
         <discovery_protection_kind>ENCRYPT</discovery_protection_kind>\
         <liveliness_protection_kind>ENCRYPT</liveliness_protection_kind>\
         <rtps_protection_kind>SIGN</rtps_protection_kind>";
    let topics = "<topic_expression>*</topic_expression>\
         <enable_discovery_protection>true</enable_discovery_protection>\
         <enable_liveliness_protection>true</enable_liveliness_protection>\
         <enable_read_access_control>true</enable_read_access_control>\
         <enable_write_access_control>true</enable_write_access_control>\
         <metadata_protection_kind>ENCRYPT</metadata_protection_kind>\
         <data_protection_kind>ENCRYPT</data_protection_kind>";
    document(
        "governance",
        &format!(
            "<domain_access_rules><domain_rule><domains><id>0</id></domains>{rules}\
             <topic_access_rules><topic_rule>{topics}</topic_rule></topic_access_rules>\
             </domain_rule></domain_access_rules>"
        ),
    )
}

/// An enclave that may publish and subscribe everything.
fn permissions(name: &str) -> String {
    let all = "<topics><topic>*</topic></topics>";
    document(
        "permissions",
        &format!(
            "<permissions><grant name=\"{name}\"><subject_name>CN={name}</subject_name>\
             <validity><not_before>2020-01-01T00:00:00</not_before><not_after>2049-12-31T00:00:00</not_after></validity>\
             <allow_rule><domains><id>0</id></domains><publish>{all}</publish><subscribe>{all}</subscribe></allow_rule>\
             <default>DENY</default></grant></permissions>"
        ),
    )
}

fn document(kind: &str, content: &str) -> String {
    format!(
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n\
         <dds xmlns:xsi=\"http://www.w3.org/2001/XMLSchema-instance\" \
         xsi:noNamespaceSchemaLocation=\"http://www.omg.org/spec/DDS-SECURITY/20170901/omg_shared_ca_{kind}.xsd\">\
         {content}</dds>\n"
    )
}
