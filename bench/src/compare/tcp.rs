//! Plain kernel TCP over the path: what any system is to be measured by where the path is what limits. No DDS, no
//! encryption; a length in front of each message, and the message sent back once it is there as a whole.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::time::{Duration, Instant};

use anyhow::{Result, ensure};

use super::lab::{Lab, Side};
use super::sample::{Plan, Sample};

/// As figures call it.
pub(crate) const NAME: &str = "tcp";
/// Longest message that the far end takes, bytes.
const MESSAGE_BYTES_MAX: u64 = 64 << 20;

/// One connection.
pub(crate) struct Tcp {
    near: TcpStream,
}

impl Tcp {
    /// From the left place to the right one, where what comes is sent back until this is dropped.
    pub(crate) fn connect(lab: &Lab) -> Result<Self> {
        let address = SocketAddr::new(lab.address(Side::Right), 0);
        let listener = lab.place(Side::Right).within(|| TcpListener::bind(address))??;
        let address = listener.local_addr()?;
        let near = lab.place(Side::Left).within(|| TcpStream::connect(address))??;
        near.set_nodelay(true)?;
        std::thread::spawn(move || {
            // It is the near end that says what went wrong.
            let _ = echo(&listener);
        });
        Ok(Self { near })
    }

    /// Round trips of a size.
    pub(crate) fn measure(&mut self, size: usize, plan: &Plan) -> Result<Sample> {
        self.near.set_read_timeout(Some(plan.patience))?;
        self.near.set_write_timeout(Some(plan.patience))?;
        let message = vec![0x5a; size];
        let mut answer = vec![0; size];
        for _ in 0..plan.warm_up {
            round_trip(&mut self.near, &message, &mut answer)?;
        }
        let mut sample = Sample { patience: plan.patience, ..Sample::default() };
        let begun = Instant::now();
        while sample.round_trips_us.len() < plan.count && begun.elapsed().as_secs_f64() < plan.seconds {
            let took = round_trip(&mut self.near, &message, &mut answer)?;
            sample.round_trips_us.push(took.as_secs_f64() * 1e6);
        }
        Ok(sample)
    }
}

fn round_trip(stream: &mut TcpStream, message: &[u8], answer: &mut [u8]) -> Result<Duration> {
    let begun = Instant::now();
    stream.write_all(&(message.len() as u64).to_le_bytes())?;
    stream.write_all(message)?;
    let mut length = [0; 8];
    stream.read_exact(&mut length)?;
    ensure!(u64::from_le_bytes(length) == message.len() as u64, "an answer of another length");
    stream.read_exact(answer)?;
    Ok(begun.elapsed())
}

fn echo(listener: &TcpListener) -> Result<()> {
    let (mut stream, _) = listener.accept()?;
    stream.set_nodelay(true)?;
    let mut length = [0; 8];
    let mut message = Vec::new();
    while stream.read_exact(&mut length).is_ok() {
        let bytes = u64::from_le_bytes(length);
        ensure!(bytes <= MESSAGE_BYTES_MAX, "a message of {bytes} bytes");
        message.resize(usize::try_from(bytes)?, 0);
        stream.read_exact(&mut message)?;
        stream.write_all(&length)?;
        stream.write_all(&message)?;
    }
    Ok(())
}
