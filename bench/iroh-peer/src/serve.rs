//! The end that accepts: each stream says whether its bytes are echoed or counted.

use std::time::{Duration, Instant};

use anyhow::{Result, bail};
use futures_util::StreamExt as _;
use iroh::Endpoint;
use iroh::endpoint::{Connection, Incoming, RecvStream, SendStream};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};

use crate::report::{Event, say};
use crate::{CHUNK_BYTES, EndpointArgs, until_stdin_closes};

/// First byte of a stream that is echoed. The length of a message follows, 4 bytes.
pub(crate) const ECHO: u8 = b'e';
/// First byte of a stream that is counted. The time that does not count follows, 4 bytes of milliseconds. The answer
/// is the number of bytes that count and their nanoseconds, 8 bytes each.
pub(crate) const BULK: u8 = b'b';
/// Most bytes of a message.
const MESSAGE_BYTES_MAX: usize = 1 << 20;

pub(crate) async fn run(args: &EndpointArgs) -> Result<()> {
    let endpoint = args.bind().await?;
    endpoint.online().await;
    say(&Event::Serving(endpoint.id().to_string()))?;
    tokio::select! {
        () = accept_all(&endpoint) => {}
        ended = until_stdin_closes() => ended?,
    }
    endpoint.close().await;
    Ok(())
}

async fn accept_all(endpoint: &Endpoint) {
    while let Some(incoming) = endpoint.accept().await {
        tokio::spawn(async move {
            if let Err(error) = serve(incoming).await {
                eprintln!("a connection ends: {error:#}");
            }
        });
    }
}

async fn serve(incoming: Incoming) -> Result<()> {
    let begun = Instant::now();
    let connection = incoming.accept()?.await?;
    tokio::spawn(say_direct(connection.clone(), begun));
    loop {
        let (send, recv) = connection.accept_bi().await?;
        tokio::spawn(async move {
            if let Err(error) = answer(send, recv).await {
                eprintln!("a stream ends: {error:#}");
            }
        });
    }
}

/// Says when the selected path of a connection is direct.
pub(crate) async fn say_direct(connection: Connection, begun: Instant) -> Result<()> {
    let mut snapshots = connection.paths_stream();
    while let Some(paths) = snapshots.next().await {
        if paths.iter().any(|path| path.is_selected() && path.is_ip()) {
            return say(&Event::Direct { after_ms: begun.elapsed().as_secs_f64() * 1e3 });
        }
    }
    Ok(())
}

async fn answer(mut send: SendStream, mut recv: RecvStream) -> Result<()> {
    let kind = recv.read_u8().await?;
    let number = recv.read_u32().await?;
    match kind {
        ECHO if number as usize <= MESSAGE_BYTES_MAX => {
            let mut message = vec![0; number as usize];
            while recv.read_exact(&mut message).await.is_ok() {
                send.write_all(&message).await?;
            }
        }
        BULK => {
            let (bytes, took) = count(&mut recv, Duration::from_millis(number.into())).await?;
            send.write_u64(bytes).await?;
            send.write_u64(took.as_nanos() as u64).await?;
        }
        _ => bail!("a stream of kind {kind}, {number}"),
    }
    send.finish()?;
    Ok(())
}

/// Counts what comes after the warm-up. Returns the bytes, and the time until the last.
async fn count(recv: &mut RecvStream, warm_up: Duration) -> Result<(u64, Duration)> {
    let begun = Instant::now();
    let (mut bytes, mut counts_from, mut last) = (0, None, begun);
    let mut chunk = vec![0; CHUNK_BYTES];
    while let Some(length) = recv.read(&mut chunk).await? {
        last = Instant::now();
        match counts_from {
            Some(_) => bytes += length as u64,
            None if last - begun >= warm_up => counts_from = Some(last),
            None => {}
        }
    }
    Ok((bytes, counts_from.map_or(Duration::ZERO, |from| last - from)))
}
