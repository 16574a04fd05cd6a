//! The configuration of a DDS domain: [`DdsConfig`], and its translation into Cyclone's XML.
//!
//! The module is pure: it reads no environment and no file. The node reads ROS's variables, and
//! [`crate::CycloneNetwork`] hands the XML to Cyclone.

use std::fmt::Write as _;
use std::net::{IpAddr, Ipv4Addr};

use sgc_ros::RosError;

use crate::payload::PAYLOAD_BYTES_MAX;
use crate::security::Security;
use crate::user_data;

/// The range of discovery without static peers: `ROS_AUTOMATIC_DISCOVERY_RANGE`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum DiscoveryRange {
    /// No discovery, not even on this host. Static peers are ignored.
    Off,
    /// This host only, over the loopback interface. Static peers add their hosts, as in ROS 2.
    LocalHost,
    /// Programs that multicast on the default interface reaches, and the static peers.
    #[default]
    Subnet,
    /// Cyclone's own defaults and `CYCLONEDDS_URI` only. Static peers are ignored.
    SystemDefault,
}

/// The configuration of a DDS domain and of this participant in it.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct DdsConfig {
    /// ROS domain id, at most [`DOMAIN_MAX`].
    pub domain: u32,
    /// The range of discovery.
    pub discovery: DiscoveryRange,
    /// Host names or IP addresses, optionally with `:port`, that are asked for participants by unicast. At most
    /// [`PEERS_MAX`].
    pub static_peers: Vec<String>,
    /// Name of the SGC node. It goes as `sgc=<tag>;` into the USER_DATA of every endpoint created here, and discovery
    /// does not report endpoints that carry any such tag. `None` makes a plain DDS participant that marks nothing and
    /// sees every other one.
    pub tag: Option<String>,
    /// `true` if ROS 2 nodes are reported and announced. Every rmw then sees a ROS 2 participant.
    pub graph: bool,
    /// The user's `CYCLONEDDS_URI`: XML fragments or `file://` names, separated by commas. It comes after the
    /// configuration made here, so its settings win, as in rmw_cyclonedds; lists (peers) add up. A `<Domain Id="7">`
    /// in it applies to the first network that this process opens on domain 7. If it selects network interfaces,
    /// [`DiscoveryRange::LocalHost`] selects none.
    pub cyclonedds_uri: Option<String>,
    /// The enclave with which the participant joins a network that DDS Security protects.
    pub security: Option<Security>,
}

/// Largest ROS domain id: above, the RTPS port numbers (RTPS 2.5, 9.6.2.3) pass 65535.
pub const DOMAIN_MAX: u32 = 232;

/// Most static peers.
pub const PEERS_MAX: usize = 64;

/// Longest static peer, in bytes (rmw: `RMW_DISCOVERY_OPTIONS_STATIC_PEERS_MAX_LENGTH` − 1).
pub const PEER_BYTES_MAX: usize = 255;

/// Bytes of payload in one RTPS fragment. With Cyclone's default of 1344, 13 MB is ten thousand packets,
/// and a Fast DDS reader with stock socket buffers never completes it.
pub const FRAGMENT_BYTES: u32 = 14_000;

/// Bytes of one RTPS message: a fragment and its headers. A larger one would only group fragments, which makes bursts
/// beyond stock socket buffers.
pub const MESSAGE_BYTES_MAX: u32 = 14_720;

/// Milliseconds from a write to the heartbeat that asks for acknowledgement, short for the same reason. Also the least
/// time between two such heartbeats; Cyclone's default of 20 ms would delay the first.
pub const HEARTBEAT_MS: u32 = 5;

/// Milliseconds after which a reader asks again for a missing message without a heartbeat. A Fast DDS writer ignores
/// a request for a message that it is about to send, and sends its next heartbeat after three seconds, which is also
/// Cyclone's default.
pub const ASK_AGAIN_MS: u32 = 500;

/// Requested socket receive buffer in bytes. The kernel's limit is accepted silently.
pub const RECEIVE_BUFFER_BYTES: u32 = 8 << 20;

/// Most addresses of this host that are asked for participants. Each costs a hundred packets in 30 s.
pub const HOST_ADDRESSES_MAX: usize = 8;

/// Most interfaces that lead to static peers. Cyclone accepts four, one of which is the loopback interface.
const OUTWARD_MAX: usize = 3;

/// Number of participants of one host that unicast discovery reaches.
const PARTICIPANT_INDEX_MAX: u32 = 99;

impl DdsConfig {
    /// Checks every field.
    ///
    /// # Errors
    /// [`RosError::Domain`] with the first mistake.
    pub fn validate(&self) -> Result<(), RosError> {
        let refuse = |reason: String| Err(RosError::Domain { domain: self.domain, reason });
        if self.domain > DOMAIN_MAX {
            return refuse(format!("the domain id must be at most {DOMAIN_MAX}"));
        }
        if self.static_peers.len() > PEERS_MAX {
            return refuse(format!("{} static peers, at most {PEERS_MAX}", self.static_peers.len()));
        }
        if let Some(peer) = self.static_peers.iter().find(|p| !is_peer(p)) {
            return refuse(format!("static peer {peer:?} is neither a host name nor an IP address"));
        }
        if let Some(tag) = self.tag.as_deref().filter(|t| !user_data::is_value(t)) {
            return refuse(format!("tag {tag:?} must be 1 to 128 printable characters without ';' and '='"));
        }
        Ok(())
    }
}

/// The properties of one Cyclone domain object among those of this process.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Instance {
    /// Process id.
    pub process: u32,
    /// Number of the network within the process.
    pub number: u32,
    /// `true` if Cyclone's own domain id must differ from the ROS domain, because this process has joined that domain
    /// already. The ROS domain then goes into `ExternalDomainId`.
    pub aliased: bool,
    /// `true` if the user's `CYCLONEDDS_URI` selects network interfaces.
    pub interfaces_chosen: bool,
    /// This host's addresses other than loopback; see [`local_addresses`].
    pub host_addresses: Vec<Ipv4Addr>,
    /// The addresses of this host from which static peers are reached.
    pub towards_peers: Vec<Ipv4Addr>,
}

/// Returns `true` if a peer is valid in Cyclone's XML and names a host: letters, digits and `.-_:[]%`.
pub fn is_peer(peer: &str) -> bool {
    !peer.is_empty()
        && peer.len() <= PEER_BYTES_MAX
        && peer.bytes().all(|b| b.is_ascii_alphanumeric() || b".-_:[]%".contains(&b))
}

/// Returns `true` if the peer is this host by loopback: `localhost`, `127.0.0.0/8`, `::1`, with any port.
fn is_loopback(peer: &str) -> bool {
    let host = match peer.rsplit_once(':') {
        Some((host, port)) if !host.contains(':') && port.bytes().all(|b| b.is_ascii_digit()) => host,
        _ => peer,
    };
    let host = host.trim_start_matches('[').trim_end_matches(']');
    host.eq_ignore_ascii_case("localhost") || host.parse::<IpAddr>().is_ok_and(|ip| ip.is_loopback())
}

/// Returns the largest participant index whose ports (7400 + 250 d + 11 + 2 i) still fit, at most
/// [`PARTICIPANT_INDEX_MAX`].
fn participant_index_max(domain: u32) -> u32 {
    let first = 7400 + 250 * domain.min(DOMAIN_MAX) + 11;
    ((u32::from(u16::MAX) - first) / 2).min(PARTICIPANT_INDEX_MAX)
}

/// Cyclone's configuration for a network, the user's `CYCLONEDDS_URI` appended. Key hashes are on because Fast DDS
/// (2.14, 3.2) learns from nothing else which endpoint is gone: without them it keeps every writer and reader that was
/// ever deleted.
///
/// The discovery ranges mean what they mean to rmw_cyclonedds from Iron on: `Off` is a domain tag that nobody else has,
/// `LocalHost` unicast to the participants of this host, `Subnet` multicast plus peers. Three things differ, each to be
/// found by more peers, none to be found from farther away: `LocalHost` binds to the loopback interface (as
/// rmw_cyclonedds did for `ROS_LOCALHOST_ONLY` up to Humble) unless a static peer is on another host, and also uses
/// multicast *on that interface* for participant discovery where it is possible; a hundred participants of a host are
/// asked, not 33; and peers are asked for ever, while Cyclone 11 gives up after 30 s. The host's other addresses are
/// asked as well, from the loopback interface, which no packet leaves: a Cyclone 11 that is bound to such an address
/// ignores participants that speak to it on another. And with static peers on other hosts, `LocalHost` takes the
/// interfaces that lead to them, where Cyclone would take the first that can do multicast. `Subnet` takes the loopback
/// interface as well: nodes that keep to their host are found there.
///
/// # Errors
/// [`RosError::Domain`] if the configuration is invalid.
pub fn cyclone_config(config: &DdsConfig, instance: &Instance) -> Result<String, RosError> {
    config.validate()?;
    let mut general = String::new();
    let mut discovery = String::new();
    let mut peers: Vec<String> = Vec::new();

    if !instance.interfaces_chosen {
        general.push_str(&interfaces(config, instance));
    }
    match config.discovery {
        DiscoveryRange::Off => {
            general.push_str("<AllowMulticast>false</AllowMulticast>");
            let _ = write!(
                discovery,
                "<ParticipantIndex>none</ParticipantIndex><Tag>sgc_off_{}_{}</Tag>",
                instance.process, instance.number
            );
        }
        DiscoveryRange::LocalHost => {
            if is_loopback_only(config) {
                if !instance.interfaces_chosen {
                    general.push_str("<AllowMulticast>spdp</AllowMulticast>");
                }
            } else {
                general.push_str("<AllowMulticast>false</AllowMulticast>");
            }
            let host = std::iter::once(&Ipv4Addr::LOCALHOST).chain(&instance.host_addresses);
            peers.extend(host.map(Ipv4Addr::to_string));
            peers.extend_from_slice(&config.static_peers);
        }
        DiscoveryRange::Subnet => {
            if !instance.interfaces_chosen {
                peers.push(Ipv4Addr::LOCALHOST.to_string());
            }
            peers.extend_from_slice(&config.static_peers);
        }
        DiscoveryRange::SystemDefault => {}
    }
    if matches!(config.discovery, DiscoveryRange::LocalHost | DiscoveryRange::Subnet) {
        let _ = write!(
            discovery,
            "<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>{}</MaxAutoParticipantIndex>",
            participant_index_max(config.domain)
        );
    }
    if !peers.is_empty() {
        discovery.push_str("<Peers>");
        for peer in peers {
            let _ = write!(discovery, "<Peer Address=\"{peer}\" PruneDelay=\"inf\"/>");
        }
        discovery.push_str("</Peers>");
    }
    if instance.aliased {
        let _ = write!(discovery, "<ExternalDomainId>{}</ExternalDomainId>", config.domain);
    }

    let mut xml = format!(
        "<CycloneDDS><Domain Id=\"any\">\
         <General>{general}<MaxMessageSize>{MESSAGE_BYTES_MAX}B</MaxMessageSize>\
         <FragmentSize>{FRAGMENT_BYTES}B</FragmentSize></General>\
         <Discovery>{discovery}</Discovery>\
         <Internal><HeartbeatInterval minsched=\"{HEARTBEAT_MS} ms\">{HEARTBEAT_MS} ms</HeartbeatInterval>\
         <AutoReschedNackDelay>{ASK_AGAIN_MS} ms</AutoReschedNackDelay>\
         <SocketReceiveBufferSize min=\"default\" max=\"{RECEIVE_BUFFER_BYTES}B\"/>\
         <MaxSampleSize>{PAYLOAD_BYTES_MAX}B</MaxSampleSize>\
         <GenerateKeyhash>true</GenerateKeyhash></Internal>\
         </Domain></CycloneDDS>"
    );
    if let Some(uri) = config.cyclonedds_uri.as_deref().map(str::trim).filter(|u| !u.is_empty()) {
        xml.push(',');
        xml.push_str(uri);
    }
    Ok(xml)
}

/// Returns `true` if the network should reach other hosts.
pub(crate) fn reaches_out(config: &DdsConfig) -> bool {
    match config.discovery {
        DiscoveryRange::Off => false,
        DiscoveryRange::LocalHost => !is_loopback_only(config),
        DiscoveryRange::Subnet | DiscoveryRange::SystemDefault => true,
    }
}

/// Returns `true` if the network stays on the loopback interface.
fn is_loopback_only(config: &DdsConfig) -> bool {
    config.discovery == DiscoveryRange::LocalHost && config.static_peers.iter().all(|p| is_loopback(p))
}

/// Returns the interfaces to use: those for discovery, and the loopback interface, by which programs on this host
/// stay reachable when its addresses change. The others come first, because the first one asks static peers.
fn interfaces(config: &DdsConfig, instance: &Instance) -> String {
    const LOOPBACK: &str = "<NetworkInterface address=\"127.0.0.1\" presence_required=\"false\"/>";
    let before = "priority=\"3\"";
    let outward: String = match config.discovery {
        DiscoveryRange::Off | DiscoveryRange::SystemDefault => return String::new(),
        DiscoveryRange::LocalHost if is_loopback_only(config) => {
            return "<Interfaces><NetworkInterface address=\"127.0.0.1\"/></Interfaces>".into();
        }
        _ if instance.host_addresses.is_empty() => String::new(),
        DiscoveryRange::LocalHost if !instance.towards_peers.is_empty() => instance
            .towards_peers
            .iter()
            .take(OUTWARD_MAX)
            .map(|address| format!("<NetworkInterface address=\"{address}\" {before}/>"))
            .collect(),
        DiscoveryRange::LocalHost | DiscoveryRange::Subnet => {
            format!("<NetworkInterface autodetermine=\"true\" {before}/>")
        }
    };
    format!("<Interfaces>{outward}{LOOPBACK}</Interfaces>")
}

/// Returns the hosts of the peers that are not this one by loopback, without their ports.
pub fn far_hosts(peers: &[String]) -> impl Iterator<Item = &str> {
    peers.iter().filter(|p| !is_loopback(p)).map(|peer| match peer.rsplit_once(':') {
        Some((host, port)) if !host.contains(':') && port.bytes().all(|b| b.is_ascii_digit()) => host,
        _ => peer.trim_start_matches('[').trim_end_matches(']'),
    })
}

/// Returns this host's IPv4 addresses except loopback, from the text of Linux's `/proc/net/fib_trie`, at most `max`.
pub fn local_addresses(fib_trie: &str, max: usize) -> Vec<Ipv4Addr> {
    let mut found = Vec::new();
    let mut last = None;
    for line in fib_trie.lines().map(str::trim) {
        if let Some(address) = line.strip_prefix("|-- ") {
            last = address.parse::<Ipv4Addr>().ok();
        } else if line == "/32 host LOCAL"
            && let Some(address) = last.take_if(|a| !a.is_loopback())
            && !found.contains(&address)
            && found.len() < max
        {
            found.push(address);
        }
    }
    found
}

/// Returns `true` if a `CYCLONEDDS_URI` names network interfaces, in itself or in a file that it refers to. `read`
/// returns the text of a file, or `None`.
pub fn chooses_interfaces(uri: &str, read: impl Fn(&str) -> Option<String>) -> bool {
    let names_them = |text: &str| {
        let text = text.to_ascii_lowercase();
        text.contains("<interfaces") || text.contains("<networkinterfaceaddress")
    };
    names_them(uri)
        || uri
            .split(',')
            .map(str::trim)
            .filter(|part| !part.is_empty() && !part.contains(['<', '>']))
            .filter_map(|part| read(part.strip_prefix("file://").unwrap_or(part)))
            .any(|text| names_them(&text))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plain() -> Instance {
        Instance { process: 41, number: 2, ..Instance::default() }
    }

    fn xml(discovery: DiscoveryRange, peers: &[&str]) -> String {
        let config = DdsConfig {
            discovery,
            static_peers: peers.iter().map(|p| p.to_string()).collect(),
            ..DdsConfig::default()
        };
        cyclone_config(&config, &plain()).unwrap()
    }

    #[test]
    fn subnet_keeps_multicast_and_asks_the_peers_for_ever() {
        let xml = xml(DiscoveryRange::Subnet, &["robot.lab", "10.0.0.7:7410"]);
        assert!(!xml.contains("AllowMulticast"));
        assert!(xml.contains("<Peer Address=\"robot.lab\" PruneDelay=\"inf\"/>"));
        assert!(xml.contains("<Peer Address=\"10.0.0.7:7410\" PruneDelay=\"inf\"/>"));
        assert!(xml.contains("<ParticipantIndex>auto</ParticipantIndex>"));
    }

    #[test]
    fn the_loopback_interface_is_taken_behind_the_others() {
        let outward = "<NetworkInterface autodetermine=\"true\" priority=\"3\"/>";
        let loopback = "<NetworkInterface address=\"127.0.0.1\" presence_required=\"false\"/>";
        let taken = |discovery, peers: &[&str], host_addresses: Vec<Ipv4Addr>| {
            let static_peers = peers.iter().map(|p| p.to_string()).collect();
            let config = DdsConfig { discovery, static_peers, ..DdsConfig::default() };
            let xml = cyclone_config(&config, &Instance { host_addresses, ..plain() }).unwrap();
            xml.contains("<Peer Address=\"127.0.0.1\" PruneDelay=\"inf\"/>")
                && xml.contains(&format!("<Interfaces>{outward}{loopback}</Interfaces>"))
        };
        let address = vec![Ipv4Addr::new(192, 0, 2, 2)];
        assert!(taken(DiscoveryRange::Subnet, &[], address.clone()));
        assert!(taken(DiscoveryRange::LocalHost, &["10.0.0.7"], address.clone()));
        assert!(!taken(DiscoveryRange::SystemDefault, &[], address));
        let xml = xml(DiscoveryRange::Subnet, &[]);
        assert!(
            xml.contains(&format!("<Interfaces>{loopback}</Interfaces>")),
            "a host without another address"
        );
    }

    #[test]
    fn local_host_is_loopback_only() {
        for peers in [&[][..], &["localhost", "127.0.0.2:7412", "::1", "[::1]"]] {
            let xml = xml(DiscoveryRange::LocalHost, peers);
            assert!(xml.contains("<NetworkInterface address=\"127.0.0.1\"/>"), "{xml}");
            assert!(xml.contains("<AllowMulticast>spdp</AllowMulticast>"));
            assert!(xml.contains("<Peer Address=\"127.0.0.1\" PruneDelay=\"inf\"/>"));
        }
    }

    #[test]
    fn the_hosts_other_addresses_are_asked_on_local_host_only() {
        let instance = Instance { host_addresses: vec![Ipv4Addr::new(192, 0, 2, 2)], ..plain() };
        for (discovery, asked) in [(DiscoveryRange::LocalHost, true), (DiscoveryRange::Subnet, false)] {
            let config = DdsConfig { discovery, ..DdsConfig::default() };
            let xml = cyclone_config(&config, &instance).unwrap();
            assert_eq!(xml.contains("<Peer Address=\"192.0.2.2\" PruneDelay=\"inf\"/>"), asked);
        }
    }

    #[test]
    fn addresses_are_those_that_the_kernel_calls_local() {
        let trie = "Main:\n  +-- 0.0.0.0/0 3 0 5\n     |-- 0.0.0.0\n        /0 universe UNICAST\n\
                    |-- 127.0.0.1\n  /32 host LOCAL\n     |-- 192.0.2.0\n        /24 link UNICAST\n\
                    |-- 192.0.2.2\n              /32 host LOCAL\n  |-- 192.0.2.255\n /32 link BROADCAST\n\
                    Local:\n |-- 192.0.2.2\n /32 host LOCAL\n |-- 10.0.0.1\n /32 host LOCAL\n";
        assert_eq!(
            local_addresses(trie, HOST_ADDRESSES_MAX),
            [Ipv4Addr::new(192, 0, 2, 2), Ipv4Addr::new(10, 0, 0, 1)]
        );
        assert!(local_addresses("/32 host LOCAL", HOST_ADDRESSES_MAX).is_empty());
        let many: String = (0..20).map(|i| format!("|-- 10.0.0.{i}\n/32 host LOCAL\n")).collect();
        assert_eq!(local_addresses(&many, HOST_ADDRESSES_MAX).len(), HOST_ADDRESSES_MAX);
    }

    #[test]
    fn a_far_static_peer_lifts_the_loopback_binding_but_not_the_range() {
        let xml = xml(DiscoveryRange::LocalHost, &["10.0.0.7"]);
        assert!(!xml.contains("<NetworkInterface address=\"127.0.0.1\"/>"));
        assert!(xml.contains("<AllowMulticast>false</AllowMulticast>"));
        assert!(xml.contains("Address=\"127.0.0.1\"") && xml.contains("Address=\"10.0.0.7\""));
    }

    #[test]
    fn interfaces_that_lead_to_static_peers_are_taken_unless_the_user_chose() {
        let towards_peers = vec![Ipv4Addr::new(10, 0, 0, 1), Ipv4Addr::new(10, 1, 0, 1)];
        let taken = |discovery, interfaces_chosen| {
            let (towards_peers, host_addresses) = (towards_peers.clone(), towards_peers.clone());
            let instance = Instance { towards_peers, host_addresses, interfaces_chosen, ..plain() };
            let static_peers = vec!["10.0.0.7".to_owned(), "10.1.0.7".to_owned()];
            let config = DdsConfig { discovery, static_peers, ..DdsConfig::default() };
            let xml = cyclone_config(&config, &instance).unwrap();
            ["10.0.0.1", "10.1.0.1"]
                .map(|a| xml.contains(&format!("<NetworkInterface address=\"{a}\" priority=")))
        };
        assert_eq!(taken(DiscoveryRange::LocalHost, false), [true, true]);
        assert_eq!(taken(DiscoveryRange::LocalHost, true), [false, false]);
        assert_eq!(taken(DiscoveryRange::Subnet, false), [false, false]);
    }

    #[test]
    fn off_has_a_tag_of_its_own_and_no_peers() {
        let xml = xml(DiscoveryRange::Off, &["10.0.0.7"]);
        assert!(xml.contains("<Tag>sgc_off_41_2</Tag>"));
        assert!(xml.contains("<AllowMulticast>false</AllowMulticast>"));
        assert!(!xml.contains("Peer"));
    }

    #[test]
    fn system_default_touches_no_discovery_setting() {
        let xml = xml(DiscoveryRange::SystemDefault, &["10.0.0.7"]);
        assert!(xml.contains("<Discovery></Discovery>"));
        assert!(!xml.contains("AllowMulticast") && !xml.contains("Interface"));
        assert!(xml.contains("<FragmentSize>14000B</FragmentSize>"));
    }

    #[test]
    fn every_range_is_tuned_for_large_messages() {
        for range in [DiscoveryRange::Off, DiscoveryRange::LocalHost, DiscoveryRange::Subnet] {
            let xml = xml(range, &[]);
            assert!(xml.contains("<FragmentSize>14000B</FragmentSize>"));
            assert!(xml.contains("<MaxMessageSize>14720B</MaxMessageSize>"));
            assert!(xml.contains("<HeartbeatInterval minsched=\"5 ms\">5 ms</HeartbeatInterval>"));
            assert!(xml.contains("<GenerateKeyhash>true</GenerateKeyhash>"));
            assert!(xml.contains("<AutoReschedNackDelay>500 ms</AutoReschedNackDelay>"));
            assert!(xml.contains("min=\"default\" max=\"8388608B\""));
        }
    }

    #[test]
    fn the_users_configuration_comes_last() {
        let config = DdsConfig { cyclonedds_uri: Some(" file:///etc/c.xml ".into()), ..DdsConfig::default() };
        assert!(cyclone_config(&config, &plain()).unwrap().ends_with("</CycloneDDS>,file:///etc/c.xml"));
        let blank = DdsConfig { cyclonedds_uri: Some("  ".into()), ..DdsConfig::default() };
        assert!(cyclone_config(&blank, &plain()).unwrap().ends_with("</CycloneDDS>"));
    }

    #[test]
    fn interfaces_chosen_by_the_user_replace_ours() {
        let config = DdsConfig { discovery: DiscoveryRange::LocalHost, ..DdsConfig::default() };
        let xml = cyclone_config(&config, &Instance { interfaces_chosen: true, ..plain() }).unwrap();
        assert!(!xml.contains("Interface"));

        let none = |_: &str| None;
        assert!(chooses_interfaces("<General><Interfaces/></General>", none));
        assert!(chooses_interfaces("<networkinterfaceaddress>lo</networkinterfaceaddress>", none));
        assert!(!chooses_interfaces("<General><AllowMulticast>spdp,asm</AllowMulticast></General>", none));
        let file = |name: &str| (name == "/a.xml").then(|| "<Interfaces>".to_owned());
        assert!(chooses_interfaces("<Tracing/>,file:///a.xml", file));
        assert!(!chooses_interfaces("file:///b.xml", file));
    }

    #[test]
    fn a_second_network_on_a_domain_is_aliased() {
        let config = DdsConfig { domain: 7, ..DdsConfig::default() };
        let xml = cyclone_config(&config, &Instance { aliased: true, ..plain() }).unwrap();
        assert!(xml.contains("<ExternalDomainId>7</ExternalDomainId>"));
        assert!(!cyclone_config(&config, &plain()).unwrap().contains("ExternalDomainId"));
    }

    #[test]
    fn ports_of_the_highest_domain_fit() {
        assert_eq!(participant_index_max(0), PARTICIPANT_INDEX_MAX);
        let last = 7400 + 250 * DOMAIN_MAX + 11 + 2 * participant_index_max(DOMAIN_MAX);
        assert!(last <= 65535 && last + 2 > 65535);
    }

    #[test]
    fn mistakes_are_refused_with_the_culprit() {
        let refused = |config: DdsConfig| cyclone_config(&config, &plain()).unwrap_err().to_string();
        assert!(refused(DdsConfig { domain: 233, ..DdsConfig::default() }).contains("at most 232"));
        for peer in ["", "a b", "a\"/><x", "a;b", "a,b"] {
            let config = DdsConfig { static_peers: vec![peer.into()], ..DdsConfig::default() };
            assert!(refused(config).contains("static peer"), "{peer}");
        }
        for tag in ["", "a;b", "a=b", "a\nb"] {
            let config = DdsConfig { tag: Some(tag.into()), ..DdsConfig::default() };
            assert!(refused(config).contains("tag"), "{tag}");
        }
    }
}
