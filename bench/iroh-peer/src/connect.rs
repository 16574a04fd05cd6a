//! The end that connects and measures.

use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use clap::Args;
use iroh::endpoint::Connection;
use iroh::{EndpointAddr, EndpointId};
use tokio::io::{AsyncBufReadExt as _, AsyncReadExt as _, AsyncWriteExt as _, BufReader};

use crate::report::{Event, Order, say};
use crate::serve::{BULK, ECHO, say_direct};
use crate::{ALPN, CHUNK_BYTES, EndpointArgs};

/// Bytes of the first message.
const FIRST_BYTES: u32 = 16;

/// The arguments of `connect`.
#[derive(Args)]
pub(crate) struct ConnectArgs {
    #[command(flatten)]
    endpoint: EndpointArgs,
    /// The id of the other end
    #[arg(long, value_name = "ID")]
    peer: EndpointId,
    /// Wait for the relay, and for the own address, before connecting
    #[arg(long)]
    online: bool,
}

pub(crate) async fn run(args: &ConnectArgs) -> Result<()> {
    let endpoint = args.endpoint.bind().await?;
    if args.online {
        endpoint.online().await;
    }
    let begun = Instant::now();
    let peer = EndpointAddr::new(args.peer).with_relay_url(args.endpoint.relay.clone());
    let connection = endpoint.connect(peer, ALPN).await.context("the connection")?;
    tokio::spawn(say_direct(connection.clone(), begun));
    echo(&connection, FIRST_BYTES, 1, Duration::MAX).await?;
    say(&Event::Connected { after_ms: begun.elapsed().as_secs_f64() * 1e3 })?;
    let mut orders = BufReader::new(tokio::io::stdin()).lines();
    while let Some(order) = orders.next_line().await? {
        match serde_json::from_str(&order)
            .with_context(|| format!("an order that cannot be read: {order}"))?
        {
            Order::Measure { size, count, seconds, warm_up } => {
                echo(&connection, size, warm_up, Duration::MAX).await?;
                let seconds = Duration::try_from_secs_f64(seconds)?;
                let round_trips_us = echo(&connection, size, count, seconds).await?;
                say(&Event::Measured { round_trips_us })?;
            }
            Order::Send { seconds, warm_up_seconds } => {
                say(&send(&connection, seconds, warm_up_seconds).await?)?;
            }
        }
    }
    connection.close(0_u8.into(), b"end");
    endpoint.close().await;
    Ok(())
}

/// Sends messages over a new stream, one at a time. Returns the round trips, µs.
async fn echo(connection: &Connection, size: u32, count: usize, most: Duration) -> Result<Vec<f64>> {
    let (mut send, mut recv) = connection.open_bi().await?;
    send.write_u8(ECHO).await?;
    send.write_u32(size).await?;
    let message = vec![0x5a; size as usize];
    let mut back = message.clone();
    let (begun, mut round_trips_us) = (Instant::now(), Vec::new());
    while round_trips_us.len() < count && begun.elapsed() < most {
        let sent = Instant::now();
        send.write_all(&message).await?;
        recv.read_exact(&mut back).await?;
        round_trips_us.push(sent.elapsed().as_secs_f64() * 1e6);
    }
    ensure!(back == message, "another message came back");
    send.finish()?;
    Ok(round_trips_us)
}

/// Sends as fast as it goes.
async fn send(connection: &Connection, seconds: f64, warm_up_seconds: f64) -> Result<Event> {
    let (mut send, mut recv) = connection.open_bi().await?;
    send.write_u8(BULK).await?;
    send.write_u32((warm_up_seconds * 1e3) as u32).await?;
    let chunk = vec![0x5a; CHUNK_BYTES];
    let begun = Instant::now();
    while begun.elapsed().as_secs_f64() < warm_up_seconds + seconds {
        send.write_all(&chunk).await?;
    }
    send.finish()?;
    let bytes = recv.read_u64().await?;
    let seconds = Duration::from_nanos(recv.read_u64().await?).as_secs_f64();
    Ok(Event::Sent { bytes, seconds })
}
