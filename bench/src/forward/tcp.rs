//! The floor: a relay that reads messages with their length in front from one TCP connection, and writes them to
//! another. It decides nothing, protects nothing, and has one thread.

use std::io::{BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::Arc;

use anyhow::Result;
use bytes::Bytes;
use tokio::io::{AsyncReadExt, AsyncWriteExt};

use super::{Arrivals, Sender, Way};
use crate::process::{Server, until_stdin_closes};

pub(super) const NAME: &str = "TCP relay";
/// Most bytes per read, as large as zenoh's batches.
const BUFFER_BYTES: usize = 64 << 10;
const LENGTH_BYTES: usize = 4;

/// Through the relay.
pub(super) fn relayed() -> Result<Way> {
    let relay = Server::own("serve-tcp")?;
    let sender = TcpStream::connect(&relay.greeting)?;
    let receiver = TcpStream::connect(&relay.greeting)?;
    Ok(Way { router: Some(relay), ..between(NAME, sender, receiver)? })
}

/// Both ends of one connection.
pub(super) fn direct() -> Result<Way> {
    let listener = TcpListener::bind("127.0.0.1:0")?;
    let sender = TcpStream::connect(listener.local_addr()?)?;
    let (receiver, _) = listener.accept()?;
    between("TCP, direct", sender, receiver)
}

fn between(name: &'static str, sender: TcpStream, receiver: TcpStream) -> Result<Way> {
    sender.set_nodelay(true)?;
    let arrivals = Arc::<Arrivals>::default();
    let heard = arrivals.clone();
    // Ends with the connection.
    std::thread::spawn(move || receive(receiver, &heard));
    let sender = Box::new(TcpSender { stream: sender, buffer: Vec::new() });
    Ok(Way { name, sender, arrivals, router: None, _rest: Box::new(()) })
}

fn receive(stream: TcpStream, arrivals: &Arrivals) -> std::io::Result<()> {
    let mut stream = BufReader::with_capacity(BUFFER_BYTES, stream);
    let (mut length, mut payload) = ([0; LENGTH_BYTES], Vec::new());
    loop {
        stream.read_exact(&mut length)?;
        payload.resize(u32::from_le_bytes(length) as usize, 0);
        stream.read_exact(&mut payload)?;
        arrivals.take(&payload);
    }
}

struct TcpSender {
    stream: TcpStream,
    buffer: Vec<u8>,
}

impl Sender for TcpSender {
    fn send(&mut self, payloads: &[Bytes]) -> Result<()> {
        self.buffer.clear();
        for payload in payloads {
            self.buffer.extend_from_slice(&(payload.len() as u32).to_le_bytes());
            self.buffer.extend_from_slice(payload);
        }
        Ok(self.stream.write_all(&self.buffer)?)
    }
}

/// The relay: the first connection is the sender's, the second the receiver's.
pub(crate) fn serve() -> Result<()> {
    std::thread::spawn(|| {
        until_stdin_closes();
        std::process::exit(0);
    });
    tokio::runtime::Builder::new_current_thread().enable_all().build()?.block_on(relay())
}

async fn relay() -> Result<()> {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await?;
    println!("{}", listener.local_addr()?);
    let (mut from, _) = listener.accept().await?;
    let (mut to, _) = listener.accept().await?;
    to.set_nodelay(true)?;
    let mut buffer = vec![0; BUFFER_BYTES];
    let mut filled = 0;
    loop {
        let read = from.read(&mut buffer[filled..]).await?;
        if read == 0 {
            return Ok(());
        }
        filled += read;
        let whole = whole_messages(&buffer[..filled]);
        to.write_all(&buffer[..whole]).await?;
        buffer.copy_within(whole..filled, 0);
        filled -= whole;
    }
}

/// Returns the number of bytes that form complete messages.
fn whole_messages(bytes: &[u8]) -> usize {
    let mut whole = 0;
    while let Some((length, rest)) = bytes[whole..].split_first_chunk::<LENGTH_BYTES>() {
        let length = u32::from_le_bytes(*length) as usize;
        if rest.len() < length {
            break;
        }
        whole += LENGTH_BYTES + length;
    }
    whole
}
