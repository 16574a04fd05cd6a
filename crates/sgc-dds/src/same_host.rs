//! Reachability of programs on this host when its addresses change.
//!
//! A participant announces the addresses that its host had when it started, and Cyclone sends from sockets that are
//! bound to such an address. Once the address is gone, neither works, although no program moved; Fast DDS keeps to
//! the addresses that it received first. This module therefore replaces the function by which Cyclone sends a packet:
//! - Participants are announced to programs on this host at 127.0.0.1 alone, and to others at the host's other
//!   address alone. Each gets one address, because Fast DDS sends each message to all. A multicast announcement is sent
//!   twice: to other hosts without a copy for this one, and to this host with a hop limit of zero.
//! - When the source or destination address of a packet is gone, and the receiver is on this host, the packet goes to
//!   127.0.0.1. A former address of this host may belong to another host by now, so its packets go there as well.
//!
//! All other packets go as Cyclone sends them, those of a long message in bursts (`bursts.rs`). This needs `struct
//! ddsi_tran_conn` and `struct ddsi_tran_write_msgfrags` of the Cyclone that `cyclors` =0.4.0 builds (`CYCLORS` in
//! `sample.rs`). A connection that does not refer to its domain, or whose socket is not bound to an address of this
//! host, is left alone.

use std::ffi::{c_int, c_void};
use std::net::{IpAddr, Ipv4Addr, SocketAddr, UdpSocket};
use std::os::fd::BorrowedFd;
use std::ptr;
use std::sync::atomic::{AtomicPtr, Ordering};
use std::sync::{Arc, RwLock};

use cyclors::{
    DDS_BUILTIN_TOPIC_DCPSPARTICIPANT, dds_create_reader, dds_domain_set_deafmute, dds_entity_t,
    dds_get_entity_sertype, dds_return_t, ddsi_domaingv, ddsi_locator, ddsi_tran_conn, ddsi_xlocator,
};
use rustix::net::sockopt;
use sgc_sync::{read_lock, write_lock};

use crate::announcement::{self, HEAD_BYTES};
use crate::bursts;
use crate::config::local_addresses;
use crate::entity::{Entity, INFINITE, check};
use crate::files::read_file;
use crate::host_addresses;

/// `DDSI_LOCATOR_KIND_UDPv4`.
const UDP_V4: i32 = 1;
/// `DDSI_TRAN_CONN`.
const CONNECTION: u32 = 1;
/// Most addresses of this host for which Cyclone may have a socket.
const ADDRESSES_MAX: usize = 64;
/// The port with which Cyclone is asked for a socket. Any would do; this one is discard's (RFC 863). No packet is
/// sent.
const ANY_PORT: u32 = 9;
/// Most pieces of a packet, `IOV_MAX`.
const PIECES_MAX: usize = 1024;

type Write =
    unsafe extern "C" fn(*const Connection, *const ddsi_locator, *const Fragments, u32, *mut usize) -> c_int;

/// The beginning of `struct ddsi_tran_conn`.
#[repr(C)]
struct Connection {
    port: u32,
    kind: u32,
    is_multicast: bool,
    domain: *const ddsi_domaingv,
    handle: Option<unsafe extern "C" fn(*const Connection) -> c_int>,
    read: *const c_void,
    write: AtomicPtr<c_void>,
}

/// `ddsrt_iovec_t`.
#[repr(C)]
struct Piece {
    start: *const u8,
    bytes: usize,
}

/// `struct ddsi_tran_write_msgfrags`; more pieces follow.
#[repr(C)]
struct Fragments {
    count: usize,
    reserved: Piece,
    first: [Piece; 0],
}

/// `struct ddsi_locators_one` and `ddsi_locators_t`.
#[repr(C)]
struct AnnouncedAddress {
    next: *mut AnnouncedAddress,
    address: ddsi_locator,
}

#[repr(C)]
struct AnnouncedAddresses {
    count: u32,
    first: *mut AnnouncedAddress,
    last: *mut AnnouncedAddress,
}

/// `struct ddsi_network_packet_info`.
#[repr(C)]
struct PacketInfo {
    source: ddsi_locator,
    destination: ddsi_locator,
    interface: u32,
}

type Visit = unsafe extern "C" fn(*const ddsi_xlocator, *mut c_void);

unsafe extern "C" {
    fn ddsi_addrset_from_locatorlists(
        gv: *const ddsi_domaingv,
        unicast: *const AnnouncedAddresses,
        multicast: *const AnnouncedAddresses,
        packet: *const PacketInfo,
        allow_source: bool,
        inherited: *const c_void,
    ) -> *mut c_void;
    fn ddsi_addrset_forall(addresses: *mut c_void, visit: Visit, argument: *mut c_void);
    fn ddsi_unref_addrset(addresses: *mut c_void);
}

/// Cyclone's own send function, which all its UDP connections share.
static CYCLONES: AtomicPtr<c_void> = AtomicPtr::new(ptr::null_mut());
/// The sockets beside each connection that sends by this module, by the connection's address.
static BESIDE: RwLock<Vec<(usize, Arc<Beside>)>> = RwLock::new(Vec::new());

/// The sockets beside a connection.
struct Beside {
    /// The address that the connection is bound to.
    address: Ipv4Addr,
    /// The socket bound to 127.0.0.1.
    loopback: UdpSocket,
    /// The sockets for multicasts, unless the address is that of the loopback interface.
    multicast: Option<Multicast>,
}

struct Multicast {
    to_others: UdpSocket,
    to_this_host: UdpSocket,
}

/// A domain that sends by this module, until dropped.
#[derive(Debug)]
pub(crate) struct SameHost {
    connections: Vec<usize>,
    /// The addresses besides loopback that the domain sends from.
    outward: Vec<Ipv4Addr>,
}

impl Drop for SameHost {
    fn drop(&mut self) {
        let mut beside = write_lock(&BESIDE);
        beside.retain(|(connection, _)| !self.connections.contains(connection));
    }
}

/// A domain that neither receives nor sends, until dropped.
#[derive(Debug)]
pub(crate) struct Silence {
    domain: dds_entity_t,
}

impl Silence {
    /// # Errors
    /// Cyclone refuses.
    pub(crate) fn begin(domain: &Entity) -> Result<Self, String> {
        let silence = Self { domain: domain.handle() };
        check(silence.set(true))?;
        Ok(silence)
    }

    fn set(&self, is_silent: bool) -> dds_return_t {
        // SAFETY: takes numbers only; the handle is checked by Cyclone.
        unsafe { dds_domain_set_deafmute(self.domain, is_silent, is_silent, INFINITE) }
    }
}

impl Drop for Silence {
    fn drop(&mut self) {
        // This fails only for a domain that is gone.
        self.set(false);
    }
}

impl SameHost {
    /// Makes the domain of a participant send by this module. Other participants should discover it only afterwards:
    /// see [`Silence`].
    ///
    /// # Errors
    /// Cyclone differs from the one that this module knows, or does not use UDP over IPv4.
    pub(crate) fn install(participant: &Entity) -> Result<Self, String> {
        host_addresses::follow();
        install(inside(participant)?)
    }

    /// Returns the addresses besides loopback from which the domain speaks to other hosts.
    pub(crate) fn outward(&self) -> &[Ipv4Addr] {
        &self.outward
    }
}

/// Returns the inside of a participant's domain.
fn inside(participant: &Entity) -> Result<*const ddsi_domaingv, String> {
    // SAFETY: the topic is a constant of Cyclone's; null means its own QoS and no listener.
    let reader = Entity::new(unsafe {
        dds_create_reader(participant.handle(), DDS_BUILTIN_TOPIC_DCPSPARTICIPANT, ptr::null(), ptr::null())
    })?;
    let mut sertype = ptr::null();
    // SAFETY: the handle is checked by Cyclone, and `sertype` is a valid place for the result.
    check(unsafe { dds_get_entity_sertype(reader.handle(), &mut sertype) })?;
    // SAFETY: the type of a reader lives as long as the reader; its domain was set when it was registered.
    let domain = unsafe { (*sertype).gv.v } as *const ddsi_domaingv;
    if domain.is_null() { Err("the domain of a type is not known".into()) } else { Ok(domain) }
}

fn install(domain: *const ddsi_domaingv) -> Result<SameHost, String> {
    let here = local_addresses(&read_file("/proc/net/fib_trie").unwrap_or_default(), ADDRESSES_MAX);
    let mut same_host = SameHost { connections: Vec::new(), outward: Vec::new() };
    for address in std::iter::once(Ipv4Addr::LOCALHOST).chain(here) {
        let Some(connection) = connection_for(domain, address) else { continue };
        if !same_host.connections.contains(&(connection as usize)) {
            // SAFETY: a connection of the domain, which lives as long; its beginning says whether it is as expected.
            let bound = take_over(domain, unsafe { &*connection })?;
            same_host.connections.push(connection as usize);
            same_host.outward.extend((!bound.is_loopback()).then_some(bound));
        }
    }
    if same_host.connections.is_empty() {
        return Err("the domain does not use UDP over IPv4".into());
    }
    Ok(same_host)
}

/// Makes a connection send by [`write`], and returns the address that it is bound to.
fn take_over(domain: *const ddsi_domaingv, connection: &Connection) -> Result<Ipv4Addr, String> {
    let handle = connection.handle.filter(|_| {
        ptr::eq(connection.domain, domain) && connection.kind == CONNECTION && !connection.is_multicast
    });
    let Some(handle) = handle else { return Err("a connection is not as expected".into()) };
    // SAFETY: Cyclone's own function, called with what it is for.
    let number = unsafe { handle(connection) };
    if number < 0 {
        return Err("a connection has no socket".into());
    }
    // SAFETY: open until Cyclone closes it with the domain.
    let socket = unsafe { BorrowedFd::borrow_raw(number) };
    let bound = rustix::net::getsockname(socket).ok().and_then(|name| SocketAddr::try_from(name).ok());
    let address = match bound.map(|bound| bound.ip()) {
        Some(IpAddr::V4(address)) if host_addresses::is_here(address) => address,
        _ => return Err("a socket is not bound to an address of this host".into()),
    };
    let beside = Beside::new(address, socket).map_err(|error| error.to_string())?;
    let found = connection.write.load(Ordering::Acquire);
    let ours = write as Write as *mut c_void;
    if found != ours {
        let known = CYCLONES.compare_exchange(ptr::null_mut(), found, Ordering::AcqRel, Ordering::Acquire);
        if found.is_null() || known.is_err_and(|known| known != found) {
            return Err("connections send in different ways".into());
        }
    }
    let mut all = write_lock(&BESIDE);
    all.push((ptr::from_ref(connection) as usize, Arc::new(beside)));
    connection.write.store(ours, Ordering::Release);
    Ok(address)
}

impl Beside {
    fn new(address: Ipv4Addr, cyclones: BorrowedFd<'_>) -> std::io::Result<Self> {
        let multicast = |is_to_this_host: bool| {
            let socket = UdpSocket::bind((address, 0))?;
            sockopt::set_ip_multicast_if(&socket, &address)?;
            let hops = if is_to_this_host { 0 } else { sockopt::ip_multicast_ttl(cyclones)? };
            sockopt::set_ip_multicast_ttl(&socket, hops)?;
            sockopt::set_ip_multicast_loop(&socket, is_to_this_host)?;
            Ok::<_, std::io::Error>(socket)
        };
        let sockets = || {
            Ok::<_, std::io::Error>(Multicast {
                to_others: multicast(false)?,
                to_this_host: multicast(true)?,
            })
        };
        Ok(Self {
            address,
            loopback: UdpSocket::bind((Ipv4Addr::LOCALHOST, 0))?,
            multicast: if address.is_loopback() { None } else { Some(sockets()?) },
        })
    }

    /// Returns `true` if a packet to an address of this host must take another way than Cyclone's.
    fn is_cut_off_from(&self, to: Ipv4Addr) -> bool {
        host_addresses::any_gone()
            && host_addresses::is_known(to)
            && !(host_addresses::is_here(self.address) && host_addresses::is_here(to))
    }

    /// Sends a packet that Cyclone would not deliver. Returns `None` if Cyclone would.
    fn send(&self, to: Ipv4Addr, port: u16, packet: &Packet<'_>) -> Option<std::io::Result<()>> {
        let is_cut_off = self.is_cut_off_from(to);
        let is_announcement = packet.is_announcement();
        let sent = |socket: &UdpSocket, to, bytes: &[u8]| socket.send_to(bytes, (to, port)).map(drop);
        let sent_around = |here: &[u8], elsewhere: &[u8]| {
            if let Some(multicast) = self.multicast.as_ref().filter(|_| host_addresses::is_here(self.address))
            {
                // No program needs to have the address.
                let _ = sent(&multicast.to_others, to, elsewhere);
            }
            sent(&self.loopback, Ipv4Addr::LOCALHOST, here)
        };
        if !is_announcement {
            let whole = is_cut_off.then(|| packet.bytes())?;
            return Some(sent_around(&whole, &whole));
        }
        let [mut for_this_host, mut for_others] = [packet.bytes(), packet.bytes()];
        announcement::replace(&mut for_this_host, |_| Ipv4Addr::LOCALHOST);
        announcement::replace(&mut for_others, |a| if a.is_loopback() { self.address } else { a });
        match &self.multicast {
            Some(multicast) if to.is_multicast() => {
                if !host_addresses::is_here(self.address) {
                    return None;
                }
                // If either fails, Cyclone sends to both or reports the error.
                let here = sent(&multicast.to_this_host, to, &for_this_host);
                Some(sent(&multicast.to_others, to, &for_others).and(here))
            }
            Some(multicast) if !host_addresses::is_known(to) => {
                Some(sent(&multicast.to_others, to, &for_others))
            }
            _ if is_cut_off => Some(sent_around(&for_this_host, &for_others)),
            Some(multicast) => Some(sent(&multicast.to_others, to, &for_this_host)),
            None => Some(sent(&self.loopback, to, &for_this_host)),
        }
    }
}

/// A packet of Cyclone.
struct Packet<'a> {
    pieces: &'a [Piece],
}

impl Packet<'_> {
    fn parts(&self) -> impl Iterator<Item = &[u8]> {
        let whole = self.pieces.iter().filter(|piece| !piece.start.is_null());
        // SAFETY: Cyclone passes pieces of so many bytes, for the duration of the call.
        whole.map(|piece| unsafe { std::slice::from_raw_parts(piece.start, piece.bytes) })
    }

    fn is_announcement(&self) -> bool {
        let mut head = [0; HEAD_BYTES];
        let mut filled = 0;
        for part in self.parts() {
            let more = part.len().min(HEAD_BYTES - filled);
            head[filled..filled + more].copy_from_slice(&part[..more]);
            filled += more;
            if filled == HEAD_BYTES {
                break;
            }
        }
        announcement::is_announcement(&head[..filled])
    }

    fn length(&self) -> usize {
        self.parts().map(<[u8]>::len).sum()
    }

    fn bytes(&self) -> Vec<u8> {
        self.parts().flatten().copied().collect()
    }
}

/// Sends a packet in place of Cyclone's `ddsi_udp_conn_write`.
unsafe extern "C" fn write(
    connection: *const Connection,
    to: *const ddsi_locator,
    fragments: *const Fragments,
    flags: u32,
    written: *mut usize,
) -> c_int {
    // SAFETY: Cyclone passes a valid address, and a packet of so many pieces.
    let sent = unsafe {
        let count = (*fragments).count;
        let pieces = (&raw const (*fragments).first).cast::<Piece>();
        if count > PIECES_MAX {
            None
        } else {
            let packet = Packet { pieces: std::slice::from_raw_parts(pieces, count) };
            if bursts::is_bursting() {
                bursts::before_packet(((*to).address, (*to).port), packet.length());
            }
            otherwise(connection as usize, &*to, &packet).map(|sent| (sent, packet.length()))
        }
    };
    if let Some((Ok(()), bytes)) = sent {
        // SAFETY: null or a valid place for the number.
        if let Some(written) = unsafe { written.as_mut() } {
            *written = bytes;
        }
        return 0;
    }
    // If the other way failed, Cyclone tries, and reports the error.
    // SAFETY: the function was there before this one, which is in its place since `take_over` kept it.
    unsafe {
        let cyclones: Write = std::mem::transmute(CYCLONES.load(Ordering::Acquire));
        cyclones(connection, to, fragments, flags, written)
    }
}

/// Sends a packet in another way than Cyclone's, if necessary.
fn otherwise(connection: usize, to: &ddsi_locator, packet: &Packet<'_>) -> Option<std::io::Result<()>> {
    if to.kind != UDP_V4 || !(host_addresses::any_gone() || packet.is_announcement()) {
        return None;
    }
    let [.., a, b, c, d] = to.address;
    let port = u16::try_from(to.port).ok()?;
    let beside = {
        let all = read_lock(&BESIDE);
        all.iter().find(|(of, _)| *of == connection).map(|(_, beside)| Arc::clone(beside))
    };
    beside?.send(Ipv4Addr::new(a, b, c, d), port, packet)
}

/// Returns the connection that Cyclone would use for an address.
fn connection_for(domain: *const ddsi_domaingv, address: Ipv4Addr) -> Option<*const Connection> {
    unsafe extern "C" fn keep(found: *const ddsi_xlocator, connection: *mut c_void) {
        // SAFETY: Cyclone passes a valid address, and what it was given.
        unsafe { *connection.cast::<*mut ddsi_tran_conn>() = (*found).conn }
    }
    let unknown = ddsi_locator { kind: -1, port: 0, address: [0; 16] };
    let mut asked = ddsi_locator { kind: UDP_V4, port: ANY_PORT, address: [0; 16] };
    asked.address[12..].copy_from_slice(&address.octets());
    let mut one = AnnouncedAddress { next: ptr::null_mut(), address: asked };
    let one: *mut AnnouncedAddress = &mut one;
    let unicast = AnnouncedAddresses { count: 1, first: one, last: one };
    let none = AnnouncedAddresses { count: 0, first: ptr::null_mut(), last: ptr::null_mut() };
    let packet = PacketInfo { source: unknown, destination: unknown, interface: 0 };
    let mut connection: *mut ddsi_tran_conn = ptr::null_mut();
    // SAFETY: the domain is valid, the lists are for the duration of the call, null means nothing inherited; the set is
    // this function's until it gives it back.
    unsafe {
        let set = ddsi_addrset_from_locatorlists(domain, &unicast, &none, &packet, false, ptr::null());
        ddsi_addrset_forall(set, keep, (&raw mut connection).cast());
        ddsi_unref_addrset(set);
    }
    (!connection.is_null()).then_some(connection.cast_const().cast())
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    /// Linux treats this address as the host itself, like 127.0.0.1 (ip(7)), and the test may lose it.
    const LOST: Ipv4Addr = Ipv4Addr::UNSPECIFIED;

    fn socket() -> UdpSocket {
        UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap()
    }

    fn port(socket: &UdpSocket) -> u16 {
        socket.local_addr().unwrap().port()
    }

    #[test]
    fn address_that_was_lost_is_reached_here_and_at_its_next_owner() {
        host_addresses::lose(LOST);
        let multicast = Multicast { to_others: socket(), to_this_host: socket() };
        let beside = Beside { address: Ipv4Addr::LOCALHOST, loopback: socket(), multicast: Some(multicast) };
        let receiver = socket();
        receiver.set_read_timeout(Some(Duration::from_secs(5))).unwrap();
        let pieces = [Piece { start: b"data".as_ptr(), bytes: 4 }];
        let sent = beside.send(LOST, port(&receiver), &Packet { pieces: &pieces });
        assert!(matches!(sent, Some(Ok(()))), "{sent:?}");
        let mut from: Vec<_> =
            (0..2).map(|_| receiver.recv_from(&mut [0; 8]).expect("a datagram").1.port()).collect();
        from.sort_unstable();
        let mut expected = [&beside.loopback, &beside.multicast.as_ref().unwrap().to_others].map(port);
        expected.sort_unstable();
        assert_eq!(from, expected);
    }
}
