//! The least that a router between two relays can do: forward the bytes of one TCP connection, both ways.

use std::io::{Read as _, Write as _};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};

use anyhow::{Context, Result};
use clap::Args;

use crate::report::{Event, say};

/// Bytes per read.
const READ_BYTES: usize = 256 << 10;

/// The arguments of a forwarder.
#[derive(Args)]
pub(crate) struct ForwarderArgs {
    /// Address on which to wait for one end
    #[arg(long, value_name = "ADDRESS")]
    listen: SocketAddr,
    /// Address of the other end
    #[arg(long, value_name = "ADDRESS")]
    connect: SocketAddr,
}

/// Forwards one connection until it ends, or standard input does.
pub(crate) fn forward(args: &ForwarderArgs) -> Result<()> {
    let listener = TcpListener::bind(args.listen).with_context(|| args.listen.to_string())?;
    say(&Event::Listening)?;
    std::thread::spawn(|| {
        let _ = std::io::copy(&mut std::io::stdin(), &mut std::io::sink());
        // The other threads wait for the network, and end with the process.
        std::process::exit(0);
    });
    let (near, _) = listener.accept()?;
    let far = TcpStream::connect(args.connect).with_context(|| args.connect.to_string())?;
    for stream in [&near, &far] {
        stream.set_nodelay(true)?;
    }
    let (from_far, to_near) = (far.try_clone()?, near.try_clone()?);
    let back = std::thread::spawn(move || carry(from_far, to_near));
    carry(near, far)?;
    back.join().expect("a thread that does not panic")
}

/// Passes on all bytes that come, each read in one write.
fn carry(mut from: TcpStream, mut to: TcpStream) -> Result<()> {
    let mut buffer = vec![0; READ_BYTES];
    loop {
        let read = from.read(&mut buffer)?;
        if read == 0 {
            to.shutdown(Shutdown::Write)?;
            return Ok(());
        }
        to.write_all(&buffer[..read])?;
    }
}
