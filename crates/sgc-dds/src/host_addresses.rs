//! The IPv4 addresses of this host: the present ones, and former ones since this process follows them.
//!
//! The kernel reports changes to a thread, which lives as long as the process.

use std::net::Ipv4Addr;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Once, RwLock};
use std::time::{Duration, Instant};
use std::{io, thread};

use rustix::fd::OwnedFd;
use rustix::io::Errno;
use rustix::net::netlink::SocketAddrNetlink;
use rustix::net::{AddressFamily, RecvFlags, SocketFlags, SocketType, bind, recv, socket_with};
use sgc_sync::{read_lock, write_lock};

use crate::config::local_addresses;
use crate::files::read_file;

/// Most present addresses, and most remembered ones. The oldest are forgotten.
const HERE_MAX: usize = 64;
const KNOWN_MAX: usize = 256;
/// Pauses before the addresses are read, because the kernel reports a link before it withdraws its addresses.
const PAUSES: [Duration; 2] = [Duration::from_millis(50), Duration::from_millis(450)];
/// Kernel messages about links and IPv4 addresses (`RTMGRP_LINK` and `RTMGRP_IPV4_IFADDR`, rtnetlink(7)).
const GROUPS: u32 = 0x1 | 0x10;
const MESSAGE_BYTES_MAX: usize = 8192;

static ADDRESSES: RwLock<Addresses> = RwLock::new(Addresses::NONE);
/// `true` once a former address of this host is gone.
static ANY_GONE: AtomicBool = AtomicBool::new(false);
/// `true` once a network is open that reaches other hosts by IPv4.
static REACHES_OUT: AtomicBool = AtomicBool::new(false);

struct Addresses {
    here: Vec<Ipv4Addr>,
    known: Vec<Ipv4Addr>,
    changes: Changes,
}

/// The number of address changes since they are followed, and the time of the last.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Changes {
    pub(crate) number: u64,
    pub(crate) last: Option<Instant>,
}

impl Addresses {
    const NONE: Self =
        Self { here: Vec::new(), known: Vec::new(), changes: Changes { number: 0, last: None } };

    fn update(&mut self, here: Vec<Ipv4Addr>) {
        for address in &here {
            if !self.known.contains(address) {
                self.known.push(*address);
            }
        }
        let forgotten = self.known.len().saturating_sub(KNOWN_MAX);
        self.known.drain(..forgotten);
        self.here = here;
    }

    fn any_gone(&self) -> bool {
        self.known.iter().any(|address| !self.here.contains(address))
    }
}

/// Begins to follow this host's addresses, unless this process does already.
pub(crate) fn follow() {
    static FOLLOWED: Once = Once::new();
    FOLLOWED.call_once(|| {
        let kernel = subscribe();
        refresh(false);
        let started = kernel.and_then(|kernel| {
            thread::Builder::new().name("sgc-dds-host".into()).spawn(move || {
                // A change before the thread began is kept by the kernel.
                let ended = loop {
                    if let Err(error) = wait_for_change(&kernel) {
                        break error;
                    }
                    for pause in PAUSES {
                        thread::sleep(pause);
                        refresh(true);
                    }
                };
                warn_not_followed(&ended);
            })
        });
        if let Err(error) = started {
            warn_not_followed(&error);
        }
    });
}

fn warn_not_followed(error: &io::Error) {
    tracing::warn!(%error, "this host's addresses are not followed: local programs are lost when they change");
}

/// Returns `true` if a former address of this host is gone. Cheap.
pub(crate) fn any_gone() -> bool {
    ANY_GONE.load(Ordering::Relaxed)
}

/// Returns `true` for a present or former address of this host.
pub(crate) fn is_known(address: Ipv4Addr) -> bool {
    address.is_loopback() || read(|addresses| addresses.known.contains(&address))
}

/// Returns `true` for a present address of this host.
pub(crate) fn is_here(address: Ipv4Addr) -> bool {
    address.is_loopback() || read(|addresses| addresses.here.contains(&address))
}

/// Returns `true` if this host has an address besides loopback.
pub(crate) fn has_any() -> bool {
    read(|addresses| !addresses.here.is_empty())
}

/// Notes that a network of this process reaches other hosts by IPv4.
pub(crate) fn note_reaching_out() {
    REACHES_OUT.store(true, Ordering::Relaxed);
}

/// Returns `true` if a network of this process reaches other hosts by IPv4, and this host has no such address besides
/// loopback.
pub fn is_alone() -> bool {
    REACHES_OUT.load(Ordering::Relaxed) && !has_any()
}

/// Returns `true` if this host has an IPv4 address besides loopback now, by which programs of other hosts could be
/// reached.
pub fn has_outward_address() -> bool {
    // An unreadable table does not mean that there is none.
    read_file("/proc/net/fib_trie").is_none_or(|table| !local_addresses(&table, HERE_MAX).is_empty())
}

/// Returns the number of address changes and the time of the last.
pub(crate) fn changes() -> Changes {
    read(|addresses| addresses.changes)
}

fn read<T>(look: impl FnOnce(&Addresses) -> T) -> T {
    look(&read_lock(&ADDRESSES))
}

/// Reads the addresses. A difference counts as a change, except for the first time.
fn refresh(is_change: bool) {
    // An unreadable table does not mean that all addresses are gone.
    let Some(table) = read_file("/proc/net/fib_trie") else { return };
    let here = local_addresses(&table, HERE_MAX);
    let mut addresses = write_lock(&ADDRESSES);
    if addresses.here != here {
        if is_change {
            tracing::info!(now = ?here, before = ?addresses.here, "this host's addresses changed");
            let number = addresses.changes.number + 1;
            addresses.changes = Changes { number, last: Some(Instant::now()) };
        }
        addresses.update(here);
        ANY_GONE.store(addresses.any_gone(), Ordering::Relaxed);
    }
}

/// Makes this host lose an address.
#[cfg(test)]
pub(crate) fn lose(address: Ipv4Addr) {
    let mut addresses = write_lock(&ADDRESSES);
    addresses.known.push(address);
    ANY_GONE.store(true, Ordering::Relaxed);
}

fn subscribe() -> io::Result<OwnedFd> {
    let kernel = socket_with(AddressFamily::NETLINK, SocketType::RAW, SocketFlags::CLOEXEC, None)?;
    bind(&kernel, &SocketAddrNetlink::new(0, GROUPS))?;
    Ok(kernel)
}

fn wait_for_change(kernel: &OwnedFd) -> io::Result<()> {
    let mut message = [0; MESSAGE_BYTES_MAX];
    let mut flags = RecvFlags::empty();
    loop {
        match recv(kernel, &mut message[..], flags) {
            // The kernel ran out of buffer space, which also means that something changed.
            Ok(_) | Err(Errno::NOBUFS) => flags = RecvFlags::DONTWAIT,
            Err(Errno::INTR) => {}
            Err(Errno::AGAIN) => return Ok(()),
            Err(error) => return Err(error.into()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const OLD: Ipv4Addr = Ipv4Addr::new(10, 0, 0, 2);
    const NEW: Ipv4Addr = Ipv4Addr::new(10, 0, 0, 3);

    #[test]
    fn addresses_that_are_gone_stay_known() {
        let mut addresses = Addresses::NONE;
        addresses.update(vec![OLD]);
        assert!(!addresses.any_gone());
        addresses.update(vec![NEW]);
        assert!(addresses.any_gone());
        assert_eq!((&addresses.here[..], &addresses.known[..]), (&[NEW][..], &[OLD, NEW][..]));
        addresses.update(vec![NEW, OLD]);
        assert!(!addresses.any_gone());
    }

    #[test]
    fn known_addresses_are_bounded() {
        let mut addresses = Addresses::NONE;
        for n in 0..1000 {
            addresses.update(vec![Ipv4Addr::from_bits(0x0a00_0000 + n)]);
        }
        assert_eq!(addresses.known.len(), KNOWN_MAX);
        assert!(addresses.known.ends_with(&addresses.here));
    }

    #[test]
    fn loopback_is_always_here() {
        follow();
        assert!(is_here(Ipv4Addr::LOCALHOST) && is_known(Ipv4Addr::LOCALHOST));
        // This address is for documentation (RFC 5737).
        assert!(!is_known(Ipv4Addr::new(192, 0, 2, 77)));
    }
}
