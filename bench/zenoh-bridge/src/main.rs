//! Hosts the ROS 2 plugin of Zenoh in a Zenoh runtime, as `zenoh-bridge-ros2dds` does, so that the benchmarks can run
//! it from crates.io without a release of that program.
//!
//! It adds nothing: no watchdog, no REST, no ROS arguments. Other settings come with `--config`, in the form
//! that the bridge's own users write: <https://github.com/eclipse-zenoh/zenoh-plugin-ros2dds>.

use std::error::Error;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::Parser;
use zenoh::config::Config;
use zenoh::internal::plugins::PluginsManager;
use zenoh::internal::runtime::RuntimeBuilder;
use zenoh_plugin_ros2dds::ROS2Plugin;

/// The name under which the plugin is started and configured.
const PLUGIN: &str = "ros2dds";

/// The arguments.
#[derive(Parser)]
#[command(about = "The Zenoh bridge for ROS 2, for the benchmarks of SGC")]
struct Args {
    /// Endpoint to listen on: `tcp/ADDRESS:PORT`, `tls/ADDRESS:PORT`.
    #[arg(long, value_name = "ENDPOINT")]
    listen: Vec<String>,
    /// Endpoint of the other bridge. Connecting is repeated until it is there.
    #[arg(long, value_name = "ENDPOINT")]
    connect: Vec<String>,
    /// The DDS domain; without it what the configuration or `ROS_DOMAIN_ID` says, or 0.
    #[arg(long)]
    domain: Option<u32>,
    /// A Zenoh configuration, a `.json5` or `.json` file; the other options come on top of it.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
}

#[tokio::main]
async fn main() -> ExitCode {
    zenoh::init_log_from_env_or("warn");
    match run(Args::parse()).await {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("zenoh-bridge: {error}");
            ExitCode::FAILURE
        }
    }
}

/// Runs the bridge until it is interrupted or asked to end. Says `"started"`, as JSON, when it is up.
async fn run(args: Args) -> Result<(), Box<dyn Error + Send + Sync>> {
    let mut plugins = PluginsManager::static_plugins_only();
    plugins.declare_static_plugin::<ROS2Plugin, &str>(PLUGIN, true);
    let mut runtime = RuntimeBuilder::new(configuration(&args)?).plugins_manager(plugins).build().await?;
    let mut terminate = tokio::signal::unix::signal(tokio::signal::unix::SignalKind::terminate())?;
    runtime.start().await?;
    println!("\"started\"");
    tokio::select! {
        ended = tokio::signal::ctrl_c() => ended?,
        _ = terminate.recv() => {}
    }
    Ok(())
}

/// The configuration of the runtime: the file's, or the default one of a router, as the bridge's own program has it.
fn configuration(args: &Args) -> Result<Config, Box<dyn Error + Send + Sync>> {
    let mut config = match &args.config {
        Some(file) => Config::from_file(file)?,
        None => Config::default(),
    };
    let mut set = |key: &str, value: serde_json::Value| {
        config.insert_json5(key, &value.to_string()).map_err(|why| format!("{key} = {value}: {why}"))
    };
    set("mode", "router".into())?;
    // The plugin's caches for late joiners need times, and it is started by the runtime.
    set("timestamping/enabled", true.into())?;
    set("adminspace/enabled", true.into())?;
    set("plugins_loading/enabled", true.into())?;
    if !args.listen.is_empty() {
        set("listen/endpoints", args.listen.clone().into())?;
    }
    if !args.connect.is_empty() {
        set("connect/endpoints", args.connect.clone().into())?;
    }
    if let Some(domain) = args.domain {
        set(&format!("plugins/{PLUGIN}/domain"), domain.into())?;
    }
    if config.get_json(&format!("plugins/{PLUGIN}")).is_err() {
        config.insert_json5(&format!("plugins/{PLUGIN}"), "{}").map_err(|why| why.to_string())?;
    }
    Ok(config)
}
