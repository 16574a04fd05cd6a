//! A bad network on the command line: `docs/how-to/netsim.md`.
#![allow(clippy::print_stdout, clippy::print_stderr, reason = "it is a program")]

use std::io::BufRead as _;
use std::net::SocketAddr;
use std::process::ExitCode;
use std::time::Duration;

use clap::{Args, Parser, Subcommand};
use sgc_testkit::netsim::{
    Counters, Direction, Loss, NetsimError, Profile, QueueLimit, Reorder, TcpRelay, TunEnd, TunLink,
    TunOptions, UdpRelay, parse_duration, parse_percent, parse_queue, parse_rate,
};
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::mpsc;

/// Default time for which a reordered packet is held back.
const HELD_BACK: Duration = Duration::from_millis(5);
const STATS_INTERVAL: Duration = Duration::from_secs(1);
/// Most commands in the queue.
const COMMANDS_MAX: usize = 16;

/// A bad network between real processes: rate, queue, delay, jitter, loss, reordering.
///
/// While it runs it reads commands from standard input: `cut`, `restore`, `rebind` (udp), `stats`, and `forth`, `back`
/// or `both` with options such as `both --rate 1mbit --loss 5%`, which replace all earlier options.
#[derive(Parser)]
#[command(name = "netsim")]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Join two network namespaces, for IP packets of all kinds; needs root.
    Tun(TunArgs),
    /// Relay datagrams from one address to another.
    Udp(RelayArgs),
    /// Relay TCP connections from one address to another: rate, delay and queue, but no loss.
    Tcp(RelayArgs),
}

#[derive(Args)]
struct TunArgs {
    /// Two namespaces, by name or path; `self` is this one
    #[arg(long, num_args = 2, value_names = ["FIRST", "SECOND"], required = true)]
    between: Vec<String>,
    /// Names of the devices
    #[arg(long, num_args = 2, value_names = ["FIRST", "SECOND"], default_values = ["netsim0", "netsim1"])]
    interfaces: Vec<String>,
    /// Address of the first end, with its prefix; may be repeated
    #[arg(long, value_name = "ADDRESS/BITS", default_value = "10.200.0.1/24")]
    first: Vec<String>,
    /// Address of the second end, with its prefix; may be repeated
    #[arg(long, value_name = "ADDRESS/BITS", default_value = "10.200.0.2/24")]
    second: Vec<String>,
    /// Further route of the first end through the path, such as `default`; may be repeated
    #[arg(long, value_name = "PREFIX")]
    first_routes: Vec<String>,
    /// Further route of the second end through the path; may be repeated
    #[arg(long, value_name = "PREFIX")]
    second_routes: Vec<String>,
    /// Longest IP packet in bytes
    #[arg(long, default_value_t = 1500, value_parser = clap::value_parser!(u16).range(68..))]
    mtu: u16,
    #[command(flatten)]
    path: PathArgs,
}

#[derive(Args)]
struct RelayArgs {
    /// Address to listen on
    #[arg(long, value_name = "ADDRESS:PORT")]
    listen: SocketAddr,
    /// Address to send to
    #[arg(long, value_name = "ADDRESS:PORT")]
    to: SocketAddr,
    #[command(flatten)]
    path: PathArgs,
}

#[derive(Args)]
struct PathArgs {
    #[command(flatten)]
    both: ProfileArgs,
    /// Options for the way back only, as one argument: --back "--rate 20mbit --delay 40ms"
    #[arg(long, value_name = "OPTIONS", allow_hyphen_values = true)]
    back: Option<String>,
    /// Seed of loss, jitter and the other draws
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Print the counters each second
    #[arg(long)]
    stats: bool,
}

/// The properties of a direction.
#[derive(Args, Clone)]
struct ProfileArgs {
    /// Bits per second: 5mbit, 800kbit
    #[arg(long, value_parser = parse_rate)]
    rate: Option<u64>,
    /// Bound of the queue: 200ms (at the rate), 64kb
    #[arg(long, value_parser = parse_queue, default_value = "200ms")]
    queue: QueueLimit,
    /// Delay of packets: 40ms
    #[arg(long, value_parser = parse_duration, default_value = "0ms")]
    delay: Duration,
    /// Variation of the delay, either way: 5ms
    #[arg(long, value_parser = parse_duration, default_value = "0ms")]
    jitter: Duration,
    /// Fraction of packets lost at random: 2%
    #[arg(long, value_parser = parse_percent, conflicts_with = "bursts")]
    loss: Option<f64>,
    /// Loss in bursts, as the probabilities that a burst begins and ends, and the fraction it loses: 0.1%,10%,100%
    #[arg(long, value_parser = parse_bursts)]
    bursts: Option<Loss>,
    /// Fraction of packets that others overtake: 1%
    #[arg(long, value_parser = parse_percent, default_value = "0%")]
    reorder: f64,
    /// Time for which overtaken packets are held back
    #[arg(long, value_parser = parse_duration)]
    reorder_by: Option<Duration>,
    /// Fraction of packets that arrive twice: 1%
    #[arg(long, value_parser = parse_percent, default_value = "0%")]
    duplicate: f64,
    /// Bytes that each packet takes on the wire beyond its own
    #[arg(long, default_value_t = 0)]
    overhead: u32,
}

/// The options of a command on standard input.
#[derive(Parser)]
#[command(no_binary_name = true, disable_help_flag = true)]
struct OptionsOnly {
    #[command(flatten)]
    profile: ProfileArgs,
}

impl ProfileArgs {
    fn profile(&self) -> Profile {
        Profile {
            rate: self.rate,
            queue: self.queue,
            delay: self.delay,
            jitter: self.jitter,
            loss: self.bursts.or(self.loss.map(Loss::Random)).unwrap_or_default(),
            reorder: Reorder { share: self.reorder, by: self.reorder_by.unwrap_or(HELD_BACK) },
            duplicate: self.duplicate,
            overhead_bytes: self.overhead,
        }
    }
}

impl PathArgs {
    fn profiles(&self) -> Result<[Profile; 2], String> {
        let forth = self.both.profile();
        let back = self.back.as_deref().map_or(Ok(forth), parse_profile)?;
        Ok([forth, back])
    }
}

fn parse_bursts(text: &str) -> Result<Loss, String> {
    let shares: Vec<_> =
        text.split(',').map(parse_percent).collect::<Result<_, _>>().map_err(|e| e.to_string())?;
    let [begin, end, in_burst] = shares[..] else { return Err("write BEGIN,END,LOSS: 0.1%,10%,100%".into()) };
    Ok(Loss::Bursts { begin, end, in_burst })
}

fn parse_profile(options: &str) -> Result<Profile, String> {
    let parsed =
        OptionsOnly::try_parse_from(options.split_whitespace()).map_err(|error| error.to_string())?;
    Ok(parsed.profile.profile())
}

/// The running path.
enum Path {
    Tun(TunLink),
    Udp(UdpRelay),
    Tcp(TcpRelay),
}

impl Path {
    fn start(command: &Command) -> Result<Self, Box<dyn std::error::Error>> {
        Ok(match command {
            Command::Tun(args) => {
                let end = |n: usize, addresses: &[String], routes: &[String]| TunEnd {
                    namespace: Some(args.between[n].clone()).filter(|name| name != "self"),
                    interface: args.interfaces[n].clone(),
                    addresses: addresses.to_vec(),
                    routes: routes.to_vec(),
                };
                let ends =
                    [end(0, &args.first, &args.first_routes), end(1, &args.second, &args.second_routes)];
                let options =
                    TunOptions { mtu: args.mtu, profiles: args.path.profiles()?, seed: args.path.seed };
                Self::Tun(TunLink::start(ends, &options)?)
            }
            Command::Udp(args) => {
                let relay = UdpRelay::start(args.listen, args.to, args.path.profiles()?, args.path.seed)?;
                println!("udp {} to {}", relay.local(), args.to);
                Self::Udp(relay)
            }
            Command::Tcp(args) => {
                let relay = TcpRelay::start(args.listen, args.to, args.path.profiles()?, args.path.seed)?;
                println!("tcp {} to {}", relay.local(), args.to);
                Self::Tcp(relay)
            }
        })
    }

    fn set(&self, directions: &[Direction], profile: Profile) {
        for direction in directions {
            match self {
                Self::Tun(path) => path.set(*direction, profile),
                Self::Udp(path) => path.set(*direction, profile),
                Self::Tcp(path) => path.set(*direction, profile),
            }
        }
    }

    fn counters(&self, direction: Direction) -> Counters {
        match self {
            Self::Tun(path) => path.counters(direction),
            Self::Udp(path) => path.counters(direction),
            Self::Tcp(path) => path.counters(direction),
        }
    }

    fn print(&self) {
        for (name, direction) in [("forth", Direction::Forth), ("back", Direction::Back)] {
            let c = self.counters(direction);
            println!(
                "{name}: {} packets, {} bytes; passed {}, lost {}, overflowed {}, cut {}, twice {}, held back {}; \
                 queue at most {} bytes, {:.1} ms",
                c.packets,
                c.bytes,
                c.passed,
                c.lost,
                c.overflowed,
                c.cut,
                c.duplicated,
                c.reordered,
                c.queue_bytes_max,
                c.queue_time_max.as_secs_f64() * 1e3
            );
        }
    }

    /// Carries out a command of standard input.
    fn obey(&self, line: &str) -> Result<(), String> {
        let (word, options) = line.trim().split_once(' ').unwrap_or((line.trim(), ""));
        match (word, self) {
            ("", _) => {}
            ("cut", Self::Tun(path)) => path.cut(),
            ("cut", Self::Udp(path)) => path.cut(),
            ("restore", Self::Tun(path)) => path.restore(),
            ("restore", Self::Udp(path)) => path.restore(),
            ("rebind", Self::Udp(path)) => path.rebind(),
            ("stats", _) => self.print(),
            ("forth", _) => self.set(&[Direction::Forth], parse_profile(options)?),
            ("back", _) => self.set(&[Direction::Back], parse_profile(options)?),
            ("both", _) => self.set(&Direction::BOTH, parse_profile(options)?),
            ("cut" | "restore" | "rebind", _) => return Err(format!("{word} is not for this kind of path")),
            _ => {
                return Err(format!(
                    "{word:?} is no command: cut, restore, rebind, stats, forth, back, both"
                ));
            }
        }
        Ok(())
    }
}

fn main() -> ExitCode {
    let cli = Cli::parse();
    let stats = match &cli.command {
        Command::Tun(args) => args.path.stats,
        Command::Udp(args) | Command::Tcp(args) => args.path.stats,
    };
    let run = || {
        let path = Path::start(&cli.command)?;
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        let done = runtime.block_on(serve(&path, stats));
        path.print();
        // The thread that reads standard input may never see its end.
        runtime.shutdown_background();
        done
    };
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("netsim: {error}");
            if let Some(NetsimError::Enter(..) | NetsimError::Tun(..)) = error.downcast_ref() {
                eprintln!("netsim: without root there are `netsim udp` and `netsim tcp`");
            }
            ExitCode::FAILURE
        }
    }
}

/// Serves the path until a signal comes.
async fn serve(path: &Path, stats: bool) -> Result<(), Box<dyn std::error::Error>> {
    let (mut interrupt, mut terminate) = (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?);
    let (sender, mut lines) = mpsc::channel(COMMANDS_MAX);
    std::thread::spawn(move || {
        for line in std::io::stdin().lock().lines().map_while(Result::ok) {
            if sender.blocking_send(line).is_err() {
                break;
            }
        }
    });
    let mut ticks = tokio::time::interval(STATS_INTERVAL);
    ticks.tick().await;
    let mut open = true;
    println!("up");
    loop {
        tokio::select! {
            _ = interrupt.recv() => return Ok(()),
            _ = terminate.recv() => return Ok(()),
            _ = ticks.tick(), if stats => path.print(),
            line = lines.recv(), if open => match line {
                Some(line) => {
                    if let Err(error) = path.obey(&line) {
                        eprintln!("netsim: {error}");
                    }
                }
                None => open = false,
            },
        }
    }
}
