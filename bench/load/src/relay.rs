//! A minimal relay between two DDS networks: it writes each message that it reads to a TCP connection, and publishes
//! each that comes over it.
//!
//! It has no encryption, authentication, names or bounds, and is not for use. It is a reference for systems that do
//! more.

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use clap::Args;

use crate::dds::{Inbox, Message, Network, Quality, Reader, Waiter, Writer};
use crate::node::LONG;
use crate::report::{Event, Next, Orders, say};
use crate::types;

/// Bytes before the content: its length, the message's number, its time.
const HEAD_BYTES: usize = 4 + 8 + 8;
/// Longest message that is copied behind its head, so that one call sends both.
const JOINED_BYTES_MAX: usize = 64 << 10;
/// Bytes per read.
const READ_BYTES: usize = 256 << 10;
/// Longest message that is taken from the connection, bytes.
const MESSAGE_BYTES_MAX: usize = 64 << 20;
/// Longest wait for the other end.
const CONNECT_MAX: Duration = Duration::from_secs(10);
const CONNECT_EVERY: Duration = Duration::from_millis(20);

/// The arguments of a relay.
#[derive(Args)]
#[group(id = "way", required = true, args = ["listen", "connect"])]
pub(crate) struct RelayArgs {
    /// The domain
    #[arg(long, default_value_t = 0)]
    domain: u32,
    /// The topic that is read here and published at the other end, as ROS 2 calls it
    #[arg(long, value_name = "/TOPIC")]
    take: Option<String>,
    /// The topic that is read at the other end and published here
    #[arg(long, value_name = "/TOPIC")]
    give: Option<String>,
    /// Address on which to wait for the other end
    #[arg(long, value_name = "ADDRESS")]
    listen: Option<SocketAddr>,
    /// Address of the other end
    #[arg(long, value_name = "ADDRESS")]
    connect: Option<SocketAddr>,
    /// Send all waiting messages together, on a separate thread, instead of each on DDS's receiving thread
    #[arg(long)]
    gathers: bool,
    /// Carry `std_msgs/msg/UInt8MultiArray`
    #[arg(long)]
    ros2: bool,
}

/// Runs a relay. It takes no orders, and carries every message reliably.
pub(crate) fn relay(args: &RelayArgs) -> Result<()> {
    let stream = connect(args)?;
    stream.set_nodelay(true)?;
    let messages = if args.ros2 { &types::BYTES } else { &types::MESSAGE };
    let network = Network::join_with(args.domain, messages)?;
    let mut waiter = Waiter::new(&network)?;
    let quality = Quality { reliable: true, depth: 0 };
    if let Some(topic) = &args.give {
        let writer = Writer::with_batching(&network, topic, quality)?;
        let mut stream = stream.try_clone()?;
        std::thread::spawn(move || {
            if let Err(error) = publish(&mut stream, &writer) {
                eprintln!("what comes is not published any more: {error:#}");
            }
        });
    }
    let mut sender = Sender { stream, buffer: Vec::new() };
    let mut taken = None;
    let mut _kept = None;
    match &args.take {
        Some(topic) if args.gathers => {
            let reader = Reader::new(&network, topic, quality)?;
            waiter.attach_reader(&reader, 0)?;
            taken = Some((reader, sender));
        }
        Some(topic) => {
            _kept = Some(Reader::with_listener(&network, topic, quality, move |inbox| {
                if let Err(error) = sender.send(inbox) {
                    eprintln!("what is read does not leave: {error:#}");
                }
            })?);
        }
        None => {}
    }
    let orders = Orders::listen(waiter.bell());
    say(&Event::Up)?;
    loop {
        waiter.wait(LONG)?;
        if let Some((reader, sender)) = &mut taken {
            sender.send(reader.inbox())?;
        }
        match orders.next()? {
            Next::Wait => {}
            // The other threads wait for the network, and end with the process.
            Next::End => std::process::exit(0),
            Next::Do(order) => bail!("{order:?} is not for a relay"),
        }
    }
}

/// Connects to the other end. The listening side reports that it listens.
fn connect(args: &RelayArgs) -> Result<TcpStream> {
    if let Some(address) = args.listen {
        let listener = TcpListener::bind(address).with_context(|| address.to_string())?;
        say(&Event::Listening)?;
        return Ok(listener.accept()?.0);
    }
    let address = args.connect.context("neither where to listen nor where to connect")?;
    let begun = Instant::now();
    loop {
        match TcpStream::connect(address) {
            Ok(stream) => return Ok(stream),
            Err(_) if begun.elapsed() < CONNECT_MAX => std::thread::sleep(CONNECT_EVERY),
            Err(error) => return Err(error).with_context(|| address.to_string()),
        }
    }
}

/// From the reader to the connection.
struct Sender {
    stream: TcpStream,
    buffer: Vec<u8>,
}

impl Sender {
    /// Sends the messages of the inbox in as few calls as possible.
    fn send(&mut self, inbox: Inbox) -> Result<()> {
        let Self { stream, buffer } = self;
        inbox.take(|message| {
            buffer.extend_from_slice(&u32::try_from(message.data.len())?.to_le_bytes());
            buffer.extend_from_slice(&message.seq.to_le_bytes());
            buffer.extend_from_slice(&message.stamp_ns.to_le_bytes());
            if message.data.len() <= JOINED_BYTES_MAX {
                buffer.extend_from_slice(message.data);
            }
            if buffer.len() >= JOINED_BYTES_MAX || message.data.len() > JOINED_BYTES_MAX {
                stream.write_all(buffer)?;
                buffer.clear();
            }
            if message.data.len() > JOINED_BYTES_MAX {
                stream.write_all(message.data)?;
            }
            Ok(())
        })?;
        stream.write_all(buffer)?;
        buffer.clear();
        Ok(())
    }
}

/// Publishes messages of the connection. Messages that are there together share packets.
fn publish(stream: &mut TcpStream, writer: &Writer) -> Result<()> {
    let mut reader = BufReader::with_capacity(READ_BYTES, stream);
    let mut long = Vec::new();
    loop {
        let mut head = [0; HEAD_BYTES];
        reader.read_exact(&mut head)?;
        let bytes = u32::from_le_bytes(*head.first_chunk().context("a head")?) as usize;
        let number =
            |at: usize| head[at..at + 8].iter().rev().fold(0, |all, &byte| all << 8 | u64::from(byte));
        let (seq, stamp_ns) = (number(4), number(12));
        ensure!(bytes <= MESSAGE_BYTES_MAX, "a message of {bytes} bytes");
        if reader.buffer().len() >= bytes {
            let data = &reader.buffer()[..bytes];
            until_written(writer, &Message { seq, stamp_ns, data })?;
            reader.consume(bytes);
        } else {
            long.resize(bytes, 0);
            reader.read_exact(&mut long)?;
            until_written(writer, &Message { seq, stamp_ns, data: &long })?;
        }
        if reader.buffer().len() < HEAD_BYTES {
            writer.flush()?;
        }
    }
}

/// Writes a message, waiting for slow readers.
fn until_written(writer: &Writer, message: &Message<'_>) -> Result<()> {
    while !writer.write(message)? {}
    Ok(())
}
