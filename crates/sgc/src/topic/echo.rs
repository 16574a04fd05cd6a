//! `sgc topic echo`: shows messages as `ros2 topic echo` does.

use std::fmt::Write as _;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use clap::Args;
use sgc_cdr::{Layout, TypeName, YamlStyle};
use sgc_types::{Definitions, ResolvedType};

use super::{Tap, TapArgs};
use crate::error::{CliError, EXIT_FAILURE};
use crate::output;
use crate::span::parse_span;

/// Bytes in a line of `--raw`.
const RAW_LINE_BYTES: usize = 32;

/// Show messages of a topic, decoded
///
/// The command looks for definitions in `--msg-dir`, then in AMENT_PREFIX_PATH. It has the common interfaces of ROS 2
/// built in. If a definition is missing or differs, the node has it from the publishing side. Showing messages never
/// slows the topic down: messages that are not shown in time are skipped and counted.
#[derive(Debug, Args)]
pub(crate) struct EchoArgs {
    #[command(flatten)]
    tap: TapArgs,
    /// Print each message as a line of JSON
    #[arg(long, conflicts_with = "raw")]
    json: bool,
    /// End after the first message
    #[arg(short = '1', long, conflicts_with = "count")]
    once: bool,
    /// End after N messages
    #[arg(short = 'n', long, value_name = "N")]
    count: Option<u64>,
    /// Show only this member, such as `pose.position.x` or `transforms[0].header`
    #[arg(long, value_name = "PATH", conflicts_with = "raw")]
    field: Option<String>,
    /// Show the serialised bytes
    #[arg(long)]
    raw: bool,
    /// Show all elements of long sequences and texts, not only the first 128
    #[arg(long)]
    full_length: bool,
    /// Directory with packages that define messages: DIR/PACKAGE/msg/NAME.msg
    #[arg(long, value_name = "DIR")]
    msg_dir: Vec<PathBuf>,
    /// Fail if no message comes for this time
    #[arg(long, value_name = "TIME", value_parser = parse_span)]
    timeout: Option<Duration>,
}

pub(super) fn echo(args: &EchoArgs) -> Result<ExitCode, CliError> {
    let mut tap = args.tap.begin(u32::MAX)?;
    let layout = if args.raw { None } else { Some(layout(&tap, &args.msg_dir)?) };
    let most = if args.once { Some(1) } else { args.count };
    let patience = args.timeout;
    let (mut shown, mut dropped) = (0, 0);
    while most.is_none_or(|most| shown < most) {
        let begun = Instant::now();
        let Some((head, payload)) = tap.next(patience)? else {
            let nothing = match patience {
                Some(patience) if begun.elapsed() >= patience => {
                    format!("nothing came for {} s", patience.as_secs())
                }
                _ => "the node stopped, or has the topic no more".to_owned(),
            };
            output::diagnostic(&format!("sgc: {}: {nothing}", args.tap.topic));
            return Ok(ExitCode::from(EXIT_FAILURE));
        };
        if head.dropped > dropped {
            output::diagnostic(&format!(
                "sgc: {} messages left out: they came too fast",
                head.dropped - dropped
            ));
            dropped = head.dropped;
        }
        shown += 1;
        if head.kind != 0 {
            let end = if head.kind == 1 { "disposed of" } else { "unregistered" };
            output::diagnostic(&format!("sgc: an instance was {end}"));
            continue;
        }
        match &layout {
            None => output::raw(&hex(&payload))?,
            Some(layout) => show(args, layout, payload)?,
        }
    }
    Ok(ExitCode::SUCCESS)
}

fn show(args: &EchoArgs, layout: &Layout, payload: Vec<u8>) -> Result<(), CliError> {
    let value = match layout.decode(&payload.into()) {
        Ok(value) => value,
        Err(why) => {
            output::diagnostic(&format!("sgc: a message is not what its type says: {why}"));
            return Ok(());
        }
    };
    let value = match &args.field {
        None => value,
        Some(path) => match value.at(path) {
            Some(value) => value,
            None => return Err(CliError::NoSuchField { path: path.clone() }),
        },
    };
    if args.json {
        return output::line(value.to_json());
    }
    let style = if args.full_length { YamlStyle { elements: None } } else { YamlStyle::default() };
    output::raw(&value.to_yaml(style))?;
    output::line("---")
}

/// Returns the layout of the messages of a tap.
pub(super) fn layout(tap: &Tap, dirs: &[PathBuf]) -> Result<Layout, CliError> {
    let type_name = &tap.shown.type_name;
    let unknown = |why: String| CliError::NoDefinition { type_name: type_name.clone(), why };
    let name: TypeName = type_name.parse().map_err(|why| unknown(format!("{why}")))?;
    let found = Definitions::from_env(dirs).layout(&name);
    let announced = tap.shown.type_hash.as_deref();
    let is_theirs = |layout: &Layout| announced.is_none_or(|announced| announced == layout.type_hash());
    let layout = match (found, told(tap, &name)) {
        (Ok(layout), _) if is_theirs(&layout) => layout,
        (_, Some(described)) => Layout::clone(described.layout()),
        (found, None) => found.map_err(|why| unknown(why.to_string()))?,
    };
    let differs = tap.shown.type_hash.as_ref().filter(|_| !is_theirs(&layout));
    if let Some(announced) = differs {
        output::diagnostic(&format!(
            "sgc: the publisher has another definition of {type_name} ({announced}) than was found here ({}); \
             name a directory with its definition with --msg-dir",
            layout.type_hash()
        ));
    }
    Ok(layout)
}

/// Returns the node's description of the type, if it matches the announced hash.
fn told(tap: &Tap, name: &TypeName) -> Option<ResolvedType> {
    let told = tap.shown.described.as_ref()?;
    let description = STANDARD.decode(&told.description).ok()?;
    let expected = tap.shown.type_hash.as_deref().unwrap_or(&told.type_hash);
    ResolvedType::read(description.into(), name, expected).ok()
}

fn hex(payload: &[u8]) -> String {
    let mut out = String::new();
    for line in payload.chunks(RAW_LINE_BYTES) {
        for byte in line {
            let _ = write!(out, "{byte:02x}");
        }
        out.push('\n');
    }
    out.push_str("---\n");
    out
}

#[cfg(test)]
mod tests {
    use std::os::unix::net::UnixStream;

    use sgc_cdr::Library;

    use super::super::{TapType, TypeInfo};
    use super::*;

    /// A type that is installed nowhere.
    fn thing() -> ResolvedType {
        let mut text = |_: &TypeName| Some("int8 a".to_owned());
        let layout = Library::empty().layout(&"mine/msg/Thing".parse().unwrap(), &mut text).unwrap();
        ResolvedType::from_layout(layout).unwrap()
    }

    fn tap(type_name: &str, type_hash: Option<&str>, told: Option<&ResolvedType>) -> Tap {
        let described = told.map(|told| TypeInfo {
            type_hash: told.type_hash().to_owned(),
            description: STANDARD.encode(told.description()),
        });
        let (type_name, type_hash) = (type_name.to_owned(), type_hash.map(str::to_owned));
        let (stream, _) = UnixStream::pair().unwrap();
        Tap { socket: PathBuf::new(), stream, shown: TapType { type_name, type_hash, described } }
    }

    #[test]
    fn missing_definition_is_taken_from_node() {
        let thing = thing();
        for announced in [None, Some(thing.type_hash())] {
            let layout = layout(&tap("mine/msg/Thing", announced, Some(&thing)), &[]).unwrap();
            assert_eq!(layout.type_hash(), thing.type_hash());
        }
        // The description does not count for another hash or another type.
        let other = tap("mine/msg/Thing", Some("RIHS01_00"), Some(&thing));
        assert!(matches!(layout(&other, &[]), Err(CliError::NoDefinition { .. })));
        let other = tap("mine/msg/Other", None, Some(&thing));
        assert!(matches!(layout(&other, &[]), Err(CliError::NoDefinition { .. })));
        assert!(layout(&tap("mine/msg/Thing", None, None), &[]).is_err());
        // Built-in definitions need no description while their hash is the announced one.
        assert!(layout(&tap("std_msgs/msg/String", None, None), &[]).is_ok());
    }
}
