//! `sgc name`: prints the 256-bit name of a topic, by the derivation that the nodes use.
//!
//! The rules of the configuration apply to the arguments, so a share that a configuration cannot have has no name here.

use std::path::{Path, PathBuf};

use clap::Args;
use sgc_diagnosis::names::name_of;
use sgc_node::config::{self, ConfigErrors, ShareConfig};
use sgc_trust::NodeName;

use crate::error::CliError;
use crate::output;

/// Print the 256-bit name of a topic.
///
/// The name follows from the fleet's secret, the owner, and the topic with its type and other metadata. It depends
/// neither on the owner's address nor on its key.
#[derive(Debug, Args)]
pub(crate) struct NameArgs {
    /// Node that shares the topic
    #[arg(long, value_name = "NODE")]
    owner: String,
    /// Full ROS 2 name of the topic, such as /camera/image
    #[arg(long, value_name = "/TOPIC")]
    topic: String,
    /// Type of the topic, such as sensor_msgs/msg/Image
    #[arg(long = "type", value_name = "TYPE")]
    type_name: String,
    /// Identity file of a member of the fleet
    #[arg(long, value_name = "FILE")]
    identity: PathBuf,
    /// `node` of the share: the ROS node that provides it
    #[arg(long, value_name = "TEXT", default_value = "", hide_default_value = true)]
    ros_node: String,
    /// `author` of the share
    #[arg(long, value_name = "TEXT", default_value = "", hide_default_value = true)]
    author: String,
    /// `maintainer` of the share
    #[arg(long, value_name = "TEXT", default_value = "", hide_default_value = true)]
    maintainer: String,
    /// `interface` of the share
    #[arg(long, value_name = "TEXT", default_value = "", hide_default_value = true)]
    interface: String,
    /// `description` of the share
    #[arg(long, value_name = "TEXT", default_value = "", hide_default_value = true)]
    description: String,
    /// `unique` of the share
    #[arg(long, value_name = "TEXT", default_value = "", hide_default_value = true)]
    unique: String,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Runs `sgc name`.
pub(crate) fn name(args: &NameArgs) -> Result<(), CliError> {
    let owner: NodeName = args.owner.parse()?;
    let share = args.share().map_err(|errors| CliError::Arguments { errors })?;
    if args.topic.contains('*') {
        let reason = format!("{} stands for several topics, each of which has a name: give one", args.topic);
        return Err(CliError::Cannot { reason });
    }
    let identity = sgc_node::load_identity(&args.identity)?;
    let name = name_of(&identity, &args.identity, &owner, &share)?;
    if args.json {
        return output::json(&serde_json::json!({ "name": name.to_string() }));
    }
    output::line(name)
}

impl NameArgs {
    /// Parses the arguments as a share of a configuration.
    fn share(&self) -> Result<ShareConfig, ConfigErrors> {
        let fields = [
            ("topic", &self.topic),
            ("type", &self.type_name),
            ("node", &self.ros_node),
            ("author", &self.author),
            ("maintainer", &self.maintainer),
            ("interface", &self.interface),
            ("description", &self.description),
            ("unique", &self.unique),
        ];
        let mut text = String::from(
            "identity = \"-\"\n[node]\nrouters = [\"quic://localhost\"]\n[[share]]\nto = [\"*\"]\n",
        );
        for (key, value) in fields {
            text.push_str(&format!("{key} = {}\n", toml_string(value)));
        }
        let mut config = config::parse(&text, "arguments", Path::new(""), &|_| None)?;
        Ok(config.shares.swap_remove(0))
    }
}

/// Formats a basic string of TOML. Escapes quotes, backslashes and all but printable ASCII.
pub(crate) fn toml_string(text: &str) -> String {
    let mut out = String::from("\"");
    for c in text.chars() {
        match c {
            '"' | '\\' => out.extend(['\\', c]),
            ' '..='~' => out.push(c),
            c => out.push_str(&format!("\\U{:08X}", u32::from(c))),
        }
    }
    out.push('"');
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn args(description: &str) -> NameArgs {
        NameArgs {
            owner: "arm-1".into(),
            topic: "/t".into(),
            type_name: "p::msg::dds_::T_".into(),
            identity: "x".into(),
            ros_node: String::new(),
            author: String::new(),
            maintainer: String::new(),
            interface: String::new(),
            description: description.into(),
            unique: String::new(),
            json: false,
        }
    }

    #[test]
    fn share_keeps_every_text_unchanged() {
        for text in ["", "plain", "\"]\n[ros]", "back\\slash", "tab\tdel\u{7f}nul\0", "ü ☃ 🤖"] {
            assert_eq!(args(text).share().unwrap().metadata.description, text);
        }
    }

    #[test]
    fn dds_spelling_of_type_gives_same_name() {
        assert_eq!(args("").share().unwrap().type_name.as_deref(), Some("p/msg/T"));
    }
}
