//! Zenoh bridges at both places, joined over TCP or TLS, as users of ROS 2 join networks today.
//!
//! The right bridge listens, the left one connects, as a robot's does. Configurations are the bridge's defaults, but
//! for scouting, which both places do without as they know each other, and for what [`Zenoh::tuned`] says.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, DnType, IsCa, KeyPair, SanType};
use serde_json::{Value, json};

use super::{Running, System, Topic};
use crate::compare::lab::{Lab, Side};
use crate::compare::program::Program;

const PORT: u16 = 7447;

/// Two bridges.
pub(crate) struct Zenoh {
    program: PathBuf,
    over: Over,
    /// Settings of the bridge for topics and path, and their name.
    tuning: Option<Value>,
}

/// The transport of Zenoh's protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Over {
    Tcp,
    /// Both ends show a certificate.
    Tls,
}

/// In the clear and over TLS. `program` is the bridge of `bench/zenoh-bridge`; whether it is there shows when it
/// starts.
pub(crate) fn all(program: &Path) -> [Zenoh; 2] {
    [Over::Tcp, Over::Tls].map(|over| Zenoh { program: program.to_owned(), over, tuning: None })
}

impl Zenoh {
    /// Over TCP, with a configuration on top of the defaults; `-tuned` in its name.
    pub(crate) fn tuned(program: &Path, tuning: Value) -> Self {
        Self { program: program.to_owned(), over: Over::Tcp, tuning: Some(tuning) }
    }

    fn config(&self, lab: &Lab, dir: &Path) -> Result<Value> {
        let mut config = json!({
            "scouting": { "multicast": { "enabled": false } },
            "plugins": { "ros2dds": {} },
        });
        if self.over == Over::Tls {
            merge(&mut config, &json!({ "transport": { "link": { "tls": certificates(lab, dir)? } } }));
        }
        if let Some(tuning) = &self.tuning {
            merge(&mut config, tuning);
        }
        Ok(config)
    }
}

impl System for Zenoh {
    fn name(&self) -> String {
        let over = match self.over {
            Over::Tcp => "tcp",
            Over::Tls => "tls",
        };
        format!("zenoh-{over}{}", if self.tuning.is_some() { "-tuned" } else { "" })
    }

    fn start(&self, lab: &Lab, _: &[Topic]) -> Result<Running> {
        let program = self.program.canonicalize();
        let program = program.with_context(|| format!("{}: is it built?", self.program.display()))?;
        let dir = lab.new_dir(&self.name())?;
        let config = dir.join("bridge.json5");
        fs::write(&config, self.config(lab, &dir)?.to_string())?;
        let scheme = if self.over == Over::Tls { "tls" } else { "tcp" };
        let dds = Side::BOTH.map(|side| lab.networks.local(side));
        let mut running = Running { processes: Vec::new(), dds };
        for side in [Side::Right, Side::Left] {
            let mut command = lab.command(side, &program);
            match side {
                Side::Right => command.arg("--listen").arg(format!("{scheme}/0.0.0.0:{PORT}")),
                Side::Left => {
                    command.arg("--connect").arg(format!("{scheme}/{}:{PORT}", lab.address(Side::Right)))
                }
            };
            command.arg("--config").arg(&config);
            let dds = &running.dds[side as usize];
            dds.configure(&mut command);
            command.args(["--domain", &dds.domain.to_string()]);
            // The ids in `ros_discovery_info` have 16 bytes from Iron on, as those of the programs here.
            command.env("ROS_DISTRO", "jazzy");
            for variable in
                ["ROS_LOCALHOST_ONLY", "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_STATIC_PEERS", "RUST_LOG"]
            {
                command.env_remove(variable);
            }
            let name = format!("bridge-{}", side.name());
            // It ends by signals, and does not look at its standard input.
            let mut program = Program::start_daemon(&name, command, &dir)?;
            program.soon("started")?;
            running.processes.push((side, program));
        }
        Ok(running)
    }
}

/// Adds the members of an object to another; of the same name, objects are merged and others replaced.
fn merge(into: &mut Value, from: &Value) {
    match (into, from) {
        (Value::Object(into), Value::Object(from)) => {
            for (name, value) in from {
                merge(into.entry(name.as_str()).or_insert(Value::Null), value);
            }
        }
        (into, from) => *into = from.clone(),
    }
}

/// A CA and a certificate for both bridges, in files, as the section `transport/link/tls` names them.
fn certificates(lab: &Lab, dir: &Path) -> Result<Value> {
    let mut params = CertificateParams::default();
    params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    params.distinguished_name.push(DnType::CommonName, "sgc-bench");
    let ca = CertifiedIssuer::self_signed(params, KeyPair::generate()?)?;
    let mut params = CertificateParams::default();
    params.subject_alt_names = Side::BOTH.map(|side| SanType::IpAddress(lab.address(side))).into();
    let key = KeyPair::generate()?;
    let certificate = params.signed_by(&key, &ca)?;
    let write = |name: &str, text: String| {
        let path = dir.join(name);
        fs::write(&path, text).with_context(|| path.display().to_string())?;
        Ok::<_, anyhow::Error>(path)
    };
    let (ca, certificate) = (write("ca.pem", ca.pem())?, write("bridge.pem", certificate.pem())?);
    let key = write("bridge.key", key.serialize_pem())?;
    Ok(json!({
        "root_ca_certificate": ca,
        "listen_certificate": certificate, "listen_private_key": key,
        "enable_mtls": true,
        "connect_certificate": certificate, "connect_private_key": key,
        "verify_name_on_connect": true,
    }))
}
