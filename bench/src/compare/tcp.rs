//! Plain kernel TCP over the path: what any system is to be measured by where the path is what limits. No DDS, no encryption;
//! a length in front of each message, and the message sent back once it is there as a whole.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};

use super::lab::{Lab, Side};
use super::round_trip::{Plan, Sample};

/// As figures call it.
pub(crate) const NAME: &str = "tcp";
/// Longest message that the far end takes, bytes.
const MESSAGE_BYTES_MAX: u64 = 64 << 20;

/// Round trips of these sizes over one connection, each handed out as it is measured.
pub(crate) fn measure(
    lab: &Lab,
    plans: &[(usize, Plan)],
    mut handle: impl FnMut(usize, Sample),
) -> Result<()> {
    let address = SocketAddr::new(lab.address(Side::Right), 0);
    let listener = lab.place(Side::Right).within(|| TcpListener::bind(address))??;
    let address = listener.local_addr()?;
    let mut near = lab.place(Side::Left).within(|| TcpStream::connect(address))??;
    let place = Arc::clone(lab.place(Side::Right));
    let far = std::thread::spawn(move || {
        place.enter()?;
        echo(&listener)
    });
    near.set_nodelay(true)?;
    for (size, plan) in plans {
        near.set_read_timeout(Some(plan.patience))?;
        near.set_write_timeout(Some(plan.patience))?;
        let message = vec![0x5a; *size];
        let mut answer = vec![0; *size];
        for _ in 0..plan.warm_up {
            round_trip(&mut near, &message, &mut answer)?;
        }
        let mut sample = Sample::default();
        let begun = Instant::now();
        while sample.round_trips_us.len() < plan.count && begun.elapsed().as_secs_f64() < plan.seconds {
            let took = round_trip(&mut near, &message, &mut answer)?;
            sample.round_trips_us.push(took.as_secs_f64() * 1e6);
        }
        handle(*size, sample);
    }
    drop(near);
    far.join().ok().context("the far end of TCP panicked")?
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
