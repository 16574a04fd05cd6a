//! Two TUN devices in two namespaces, and a bad path between them. It affects all programs there, kernel TCP included.

use std::io;
use std::os::fd::AsFd;
use std::time::Duration;

use bytes::Bytes;
use rustix::event::{PollFd, PollFlags};
use tun_rs::{DeviceBuilder, SyncDevice};

use super::channel::{Channel, Counters, Profile};
use super::namespace::{Namespace, NetsimError, configure, ip, within};
use super::pump::{BATCH_MAX, Direction, Ports, Pump, controls};

/// Packets that the kernel holds for us, so that none is lost before it is in the channel, where it is counted.
const DEVICE_QUEUE_PACKETS: u32 = 20_000;
/// The longest IP packet.
const PACKET_BYTES_MAX: usize = 65_535;

/// One end of a [`TunLink`].
#[derive(Clone, Debug, Default)]
pub struct TunEnd {
    /// The namespace, by name or path; `None` is the caller's.
    pub namespace: Option<String>,
    /// Name of the device there, at most 15 characters.
    pub interface: String,
    /// Its addresses with their prefixes: `10.1.0.1/24`, `fd01::1/64`.
    pub addresses: Vec<String>,
    /// Further routes through it: prefixes, or `default`.
    pub routes: Vec<String>,
}

/// How a [`TunLink`] is made.
#[derive(Clone, Debug)]
pub struct TunOptions {
    /// Longest IP packet, in bytes.
    pub mtu: u16,
    /// The profiles of the directions: from the first end, and from the second.
    pub profiles: [Profile; 2],
    /// Seed of loss, jitter and the other draws.
    pub seed: u64,
}

impl Default for TunOptions {
    fn default() -> Self {
        Self { mtu: 1500, profiles: [Profile::default(); 2], seed: 1 }
    }
}

/// A path between two namespaces. Dropping it removes the devices.
pub struct TunLink {
    pump: Pump<Bytes>,
}

controls!(TunLink);

impl TunLink {
    /// Makes the devices and starts the path.
    pub fn start(ends: [TunEnd; 2], options: &TunOptions) -> Result<Self, NetsimError> {
        let [first, second] = &ends;
        let devices = [device(first, options.mtu)?, device(second, options.mtu)?];
        let ports = Tuns { devices, buffer: vec![0; PACKET_BYTES_MAX] };
        let pump = Pump::start(ports, options.profiles, options.seed).map_err(NetsimError::Thread)?;
        Ok(Self { pump })
    }
}

/// Checks that namespaces and TUN devices can be made here. The error gives the reason.
pub fn on_host() -> Result<(), NetsimError> {
    let name = format!("netsim-{}-{:?}", std::process::id(), std::thread::current().id());
    let name: String = name.chars().filter(|c| c.is_ascii_alphanumeric() || *c == '-').collect();
    let namespace = Namespace::create(name)?;
    namespace.within(|| open("netsim0").map(drop))?
}

fn device(end: &TunEnd, mtu: u16) -> Result<SyncDevice, NetsimError> {
    let namespace = end.namespace.as_deref();
    let device = within(namespace, || {
        let device = open(&end.interface)?;
        let (mtu, queue) = (mtu.to_string(), DEVICE_QUEUE_PACKETS.to_string());
        ip(&["link", "set", &end.interface, "mtu", &mtu, "txqueuelen", &queue])?;
        Ok::<_, NetsimError>(device)
    })??;
    configure(namespace, &end.interface, &end.addresses, &end.routes)?;
    Ok(device)
}

/// Opens a device in the namespace of the calling thread.
fn open(interface: &str) -> Result<SyncDevice, NetsimError> {
    let make = || {
        let device = DeviceBuilder::new().name(interface).enable(false).build_sync()?;
        device.set_nonblocking(true)?;
        Ok(device)
    };
    make().map_err(|error: io::Error| NetsimError::Tun(interface.to_owned(), error))
}

struct Tuns {
    devices: [SyncDevice; 2],
    buffer: Vec<u8>,
}

impl Ports for Tuns {
    type Packet = Bytes;

    fn receive(&mut self, channels: &mut [Channel<Bytes>; 2], now: Duration) {
        for (device, channel) in self.devices.iter().zip(channels) {
            for _ in 0..BATCH_MAX {
                // No packet is there, or the device is down for a while.
                let Ok(bytes) = device.recv(&mut self.buffer) else { break };
                channel.push(now, bytes, Bytes::copy_from_slice(&self.buffer[..bytes]));
            }
        }
    }

    fn deliver(&mut self, direction: Direction, packet: Bytes) {
        let device = match direction {
            Direction::Forth => &self.devices[1],
            Direction::Back => &self.devices[0],
        };
        // If the device is down or out of memory, the packet is lost, as on any wire.
        let _ = device.send(&packet);
    }

    fn watch(&self) -> Vec<PollFd<'_>> {
        self.devices.iter().map(|d| PollFd::from_borrowed_fd(d.as_fd(), PollFlags::IN)).collect()
    }
}
