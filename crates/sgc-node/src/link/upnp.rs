//! The client of UPnP-IGD: finds the gateway's device and asks it for port mappings.
//!
//! The crate `igd-next` makes and reads the messages of the control protocol. Discovery and HTTP are here, because both
//! have to be bounded: whoever is on the local network can answer a search. Only answers of the gateway count, all
//! requests go to its address, answers are short and simple, and none has a document type, whose entities could fill the
//! memory.

use std::collections::HashMap;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, SocketAddrV4};
use std::num::NonZeroU16;
use std::time::Duration;

use bytes::Bytes;
use http::header::{CONNECTION, CONTENT_TYPE, HOST};
use http::{Method, Request, Uri};
use http_body_util::{BodyExt as _, Full, Limited};
use hyper::client::conn::http1;
use hyper_util::rt::TokioIo;
use igd_next::aio::{Gateway, Provider};
use igd_next::{AddAnyPortError, AddPortError, GetExternalIpError, PortMappingProtocol, RequestError};
use sgc_session::{GrantedMapping, MAPPING_LIFETIME, MappingFailure, MappingProtocol, MappingTarget};
use tokio::net::{TcpStream, UdpSocket};
use tokio::time::{Instant, timeout_at};
use tracing::debug;
use xml::reader::{EventReader, ParserConfig2, XmlEvent};

/// The address of the Simple Service Discovery Protocol.
const SSDP: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(239, 255, 255, 250), 1900);
/// Searched types. Devices of later versions answer to the first version.
const SEARCHED: [&str; 3] = [
    "urn:schemas-upnp-org:device:InternetGatewayDevice:1",
    "urn:schemas-upnp-org:service:WANIPConnection:1",
    "urn:schemas-upnp-org:service:WANPPPConnection:1",
];
/// Times of the searches. Devices answer within the second that a search grants them.
const SEARCHES: usize = 2;
const SEARCH_WAIT: Duration = Duration::from_millis(1250);
/// Most answers that one search looks at.
const ANSWERS_MAX: usize = 256;
/// Services that map ports, the best first.
const SERVICES: [&str; 3] = [
    "urn:schemas-upnp-org:service:WANIPConnection:2",
    "urn:schemas-upnp-org:service:WANIPConnection:1",
    "urn:schemas-upnp-org:service:WANPPPConnection:1",
];
/// Most bytes of an answer by HTTP.
const HTTP_BYTES_MAX: usize = 64 << 10;
/// Most bytes of the heads of such an answer.
const HEAD_BYTES_MAX: usize = 16 << 10;
/// Most elements within each other. The parser of `igd-next` descends by recursion, and would overflow the stack.
const NESTING_MAX: usize = 32;
/// Most bytes of a name or an attribute in XML, and most attributes of an element.
const XML_WORD_BYTES_MAX: usize = 512;
const ATTRIBUTES_MAX: usize = 32;
/// Most bytes of the namespaces of all elements. The parser of `igd-next` keeps, for each element, a copy of each that is
/// declared around it: 64 KiB of text can become some GB.
const NAMESPACE_BYTES_MAX: usize = 4 << 20;
/// Bytes of memory for a namespace, beyond its prefix and its name.
const NAMESPACE_BYTES: usize = 128;
/// The description of mappings, which users of the gateway see.
const DESCRIPTION: &str = "SGC direct links";

/// The control point of a gateway: its service, and where that takes requests.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Igd {
    control: SocketAddrV4,
    path: String,
    service: String,
}

impl Igd {
    /// Searches the gateway's device.
    async fn find(target: &MappingTarget) -> Result<Self, MappingFailure> {
        let (description, url) = search(target).await?;
        let authority = description.to_string();
        let head = Request::builder().method(Method::GET).uri(&url).header(HOST, authority);
        let text = exchange(description, head, String::new()).await?;
        Self::described(&text, description, &url).ok_or(MappingFailure::Unsupported)
    }

    /// Returns the service of a description at this place of the gateway.
    fn described(text: &str, at: SocketAddrV4, path: &str) -> Option<Self> {
        let Description { base, services } = Description::read(text)?;
        let base = base.unwrap_or_else(|| format!("http://{at}{path}"));
        let wanted = SERVICES.into_iter().find_map(|wanted| services.iter().find(|(kind, _)| kind == wanted));
        let (service, url) = wanted?;
        let (control, path) = place_of(&joined(&base, url), *at.ip())?;
        Some(Self { control, path, service: service.clone() })
    }

    /// Asks for a mapping.
    async fn map(
        &self,
        target: MappingTarget,
        renews: Option<GrantedMapping>,
    ) -> Result<GrantedMapping, MappingFailure> {
        use AddPortError as E;
        let gateway = self.gateway();
        let local = SocketAddr::new(target.host.into(), target.port.get());
        let lifetime = MAPPING_LIFETIME.as_secs().try_into().unwrap_or(u32::MAX);
        let ip = gateway.get_external_ip().await.map_err(|error| no_address(&error))?;
        let IpAddr::V4(ip) = ip else { return Err(MappingFailure::NoExternalAddress) };
        // Some gateways map a port to the same number only.
        let wanted = renews.map_or(target.port.get(), |mapping| mapping.external.port());
        let udp = PortMappingProtocol::UDP;
        let port = match gateway.add_port(udp, wanted, local, lifetime, DESCRIPTION).await {
            Ok(()) => wanted,
            Err(E::PortInUse) => {
                let added = gateway.add_any_port(udp, local, lifetime, DESCRIPTION).await;
                added.map_err(|error| no_port(&error))?
            }
            Err(E::OnlyPermanentLeasesSupported) => return Err(MappingFailure::PermanentOnly),
            Err(E::ActionNotAuthorized) => return Err(MappingFailure::NotPermitted),
            Err(E::SamePortValuesRequired) => return Err(MappingFailure::NoRoom),
            Err(E::RequestError(error)) => return Err(failed(&error)),
            Err(E::InternalPortZeroInvalid | E::ExternalPortZeroInvalid | E::DescriptionTooLong) => {
                return Err(MappingFailure::Unsupported);
            }
        };
        Ok(GrantedMapping {
            protocol: MappingProtocol::UpnpIgd,
            target,
            external: SocketAddrV4::new(ip, port),
            lifetime: MAPPING_LIFETIME,
            nonce: [0; 3],
        })
    }

    fn gateway(&self) -> Gateway<BoundedHttp> {
        let arguments = |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect();
        let actions = [
            (
                "AddPortMapping",
                arguments(&[
                    "NewRemoteHost",
                    "NewExternalPort",
                    "NewProtocol",
                    "NewInternalPort",
                    "NewInternalClient",
                    "NewEnabled",
                    "NewPortMappingDescription",
                    "NewLeaseDuration",
                ]),
            ),
            ("DeletePortMapping", arguments(&["NewRemoteHost", "NewExternalPort", "NewProtocol"])),
        ];
        Gateway {
            addr: self.control.into(),
            root_url: String::new(),
            control_url: self.path.clone(),
            control_schema_url: String::new(),
            control_schema: actions
                .into_iter()
                .map(|(name, names)| (name.to_owned(), names))
                .collect::<HashMap<_, _>>(),
            service_type: self.service.clone(),
            provider: BoundedHttp,
        }
    }
}

/// Asks for a mapping. `known` is the device that was found before, and is set to the one that answered.
pub(super) async fn ask(
    target: MappingTarget,
    renews: Option<GrantedMapping>,
    known: &mut Option<Igd>,
) -> Result<GrantedMapping, MappingFailure> {
    let before = known.take().filter(|igd| igd.control.ip() == &target.gateway);
    if let Some(igd) = before
        && let Ok(mapping) = igd.map(target, renews).await
    {
        *known = Some(igd);
        return Ok(mapping);
    }
    // A device that restarted may take requests elsewhere.
    let igd = Igd::find(&target).await?;
    let mapping = igd.map(target, renews).await?;
    *known = Some(igd);
    Ok(mapping)
}

/// Removes a mapping.
pub(super) async fn remove(mapping: &GrantedMapping, known: Option<&Igd>) {
    let igd = match known {
        Some(igd) if igd.control.ip() == &mapping.target.gateway => igd.clone(),
        _ => match Igd::find(&mapping.target).await {
            Ok(igd) => igd,
            Err(error) => return debug!(%error, "the device that mapped the port is not found again"),
        },
    };
    let external = mapping.external.port();
    if igd.gateway().remove_port(PortMappingProtocol::UDP, external).await.is_err() {
        debug!(external, "the mapping is not removed");
    }
}

// The texts of these errors hold whole answers of the gateway, so they are not shown.

fn no_address(error: &GetExternalIpError) -> MappingFailure {
    match error {
        GetExternalIpError::ActionNotAuthorized => MappingFailure::NotPermitted,
        GetExternalIpError::RequestError(error) => match failed(error) {
            // A gateway without an address on the outside says nothing that could be read.
            MappingFailure::Malformed => MappingFailure::NoExternalAddress,
            other => other,
        },
    }
}

fn no_port(error: &AddAnyPortError) -> MappingFailure {
    match error {
        AddAnyPortError::ActionNotAuthorized => MappingFailure::NotPermitted,
        AddAnyPortError::NoPortsAvailable | AddAnyPortError::ExternalPortInUse => MappingFailure::NoRoom,
        AddAnyPortError::OnlyPermanentLeasesSupported => MappingFailure::PermanentOnly,
        AddAnyPortError::InternalPortZeroInvalid | AddAnyPortError::DescriptionTooLong => {
            MappingFailure::Unsupported
        }
        AddAnyPortError::RequestError(error) => failed(error),
    }
}

fn failed(error: &RequestError) -> MappingFailure {
    match error {
        RequestError::IoError(_) => MappingFailure::NoAnswer,
        // 606: not authorized; 718: conflict; 728: no ports available.
        RequestError::ErrorCode(606, _) => MappingFailure::NotPermitted,
        RequestError::ErrorCode(718 | 728, _) => MappingFailure::NoRoom,
        RequestError::ErrorCode(..) | RequestError::UnsupportedAction(_) => MappingFailure::Unsupported,
        _ => MappingFailure::Malformed,
    }
}

/// Searches the gateway's device. Returns the place of its description.
async fn search(target: &MappingTarget) -> Result<(SocketAddrV4, String), MappingFailure> {
    let socket = UdpSocket::bind((target.host, 0)).await.map_err(|_| MappingFailure::NotSent)?;
    let (mut sent, mut looked_at, mut datagram) = (false, 0, [0; 1500]);
    for _ in 0..SEARCHES {
        // Some devices answer only one of the two kinds.
        for to in [SSDP, SocketAddrV4::new(target.gateway, SSDP.port())] {
            for kind in SEARCHED {
                let request = format!(
                    "M-SEARCH * HTTP/1.1\r\nHOST: {to}\r\nMAN: \"ssdp:discover\"\r\nMX: 1\r\nST: {kind}\r\n\r\n"
                );
                sent |= socket.send_to(request.as_bytes(), to).await.is_ok();
            }
        }
        if !sent {
            return Err(MappingFailure::NotSent);
        }
        let end = Instant::now() + SEARCH_WAIT;
        while let Ok(received) = timeout_at(end, socket.recv_from(&mut datagram)).await {
            looked_at += 1;
            if looked_at > ANSWERS_MAX {
                return Err(MappingFailure::Malformed);
            }
            // An error is of an earlier datagram: the gateway has no such port.
            let Ok((len, from)) = received else { continue };
            let text = std::str::from_utf8(&datagram[..len]).ok().filter(|_| from.ip() == target.gateway);
            if let Some(place) = text.and_then(|text| located(text, target.gateway)) {
                return Ok(place);
            }
        }
    }
    Err(MappingFailure::NoAnswer)
}

/// Returns the place that an answer to a search names, if it is at the gateway.
fn located(answer: &str, gateway: Ipv4Addr) -> Option<(SocketAddrV4, String)> {
    let headers = answer.lines().filter_map(|line| line.split_once(':'));
    let mut locations = headers.filter(|(name, _)| name.trim().eq_ignore_ascii_case("location"));
    place_of(locations.next()?.1.trim(), gateway)
}

/// Returns address and path of a URL, if it is at the gateway and its port is known.
fn place_of(url: &str, gateway: Ipv4Addr) -> Option<(SocketAddrV4, String)> {
    let uri: Uri = url.parse().ok()?;
    let authority = uri.authority().filter(|authority| !authority.as_str().contains('@'))?;
    if uri.scheme_str() != Some("http") || authority.host().parse() != Ok(gateway) {
        return None;
    }
    let port = NonZeroU16::new(authority.port_u16().unwrap_or(80))?;
    let path = uri.path_and_query().map_or("/", |path| path.as_str());
    // `igd-next` takes what follows for another host.
    if path.starts_with("//") || path.starts_with("/\\") {
        return None;
    }
    Some((SocketAddrV4::new(gateway, port.get()), path.to_owned()))
}

/// Resolves a reference of a description (RFC 3986, 5.2): a URL, a path, or the end of the base's path.
fn joined(base: &str, reference: &str) -> String {
    if reference.starts_with("http://") {
        return reference.to_owned();
    }
    let rest = base.strip_prefix("http://").unwrap_or_default();
    let (authority, path) = rest.split_at(rest.find('/').unwrap_or(rest.len()));
    let folder = match path.rfind('/') {
        _ if reference.starts_with('/') => "",
        Some(end) => &path[..=end],
        None => "/",
    };
    format!("http://{authority}{folder}{reference}")
}

/// The parts of a device's description that matter here.
#[derive(Debug, Default)]
struct Description {
    base: Option<String>,
    /// Type and control URL of each service.
    services: Vec<(String, String)>,
}

impl Description {
    fn read(text: &str) -> Option<Self> {
        let mut found = Self::default();
        let (mut kind, mut control, mut content) = (None, None, String::new());
        for event in EventReader::new(text.as_bytes()) {
            match event.ok()? {
                XmlEvent::StartElement { .. } => content.clear(),
                XmlEvent::Characters(more) | XmlEvent::CData(more) => content += &more,
                XmlEvent::EndElement { name } => {
                    let text = || Some(content.trim().to_owned());
                    match name.local_name.as_str() {
                        "URLBase" => found.base = text().filter(|base| !base.is_empty()),
                        "serviceType" => kind = text(),
                        "controlURL" => control = text(),
                        "service" => found.services.extend(kind.take().zip(control.take())),
                        _ => {}
                    }
                    content.clear();
                }
                _ => {}
            }
        }
        Some(found)
    }
}

/// HTTP to the gateway, for `igd-next`.
#[derive(Clone, Debug)]
struct BoundedHttp;

impl Provider for BoundedHttp {
    async fn send_async(url: &str, action: &str, body: &str) -> Result<String, RequestError> {
        let uri: Uri = url.parse().map_err(http::Error::from)?;
        let to = uri.authority().and_then(|authority| authority.as_str().parse().ok());
        let to: SocketAddrV4 = to.ok_or_else(|| RequestError::InvalidResponse(String::new()))?;
        let path = uri.path_and_query().map_or("/", |path| path.as_str());
        let head = Request::builder().method(Method::POST).uri(path).header(HOST, to.to_string());
        let head = head.header("SOAPAction", action).header(CONTENT_TYPE, "text/xml; charset=\"utf-8\"");
        exchange(to, head, body.to_owned()).await.map_err(|failure| match failure {
            MappingFailure::NoAnswer => RequestError::IoError(std::io::ErrorKind::ConnectionRefused.into()),
            _ => RequestError::InvalidResponse(String::new()),
        })
    }
}

/// Sends a request, and returns the body of the answer. Redirections are not followed. The caller bounds the time.
async fn exchange(
    to: SocketAddrV4,
    head: http::request::Builder,
    body: String,
) -> Result<String, MappingFailure> {
    let request = head.header(CONNECTION, "close").body(Full::new(Bytes::from(body)));
    let request = request.map_err(|_| MappingFailure::Malformed)?;
    let stream = TcpStream::connect(to).await.map_err(|_| MappingFailure::NoAnswer)?;
    let handshake = http1::Builder::new().max_buf_size(HEAD_BYTES_MAX).handshake(TokioIo::new(stream));
    let (mut sender, connection) = handshake.await.map_err(|_| MappingFailure::NoAnswer)?;
    let answer = async move {
        let answer = sender.send_request(request).await.map_err(|_| MappingFailure::Malformed)?;
        let body = Limited::new(answer.into_body(), HTTP_BYTES_MAX).collect().await;
        Ok(body.map_err(|_| MappingFailure::Malformed)?.to_bytes())
    };
    let (_, answer) = tokio::join!(connection, answer);
    let text = String::from_utf8(answer?.into()).map_err(|_| MappingFailure::Malformed)?;
    // In UTF-16, which a parser may take, it would have zeros.
    if text.contains("<!DOCTYPE") || text.contains('\0') || !is_simple(&text) {
        return Err(MappingFailure::Malformed);
    }
    Ok(text)
}

/// Returns `true` for no text, and for well-formed XML that needs little memory.
fn is_simple(text: &str) -> bool {
    let config = ParserConfig2::new()
        .max_name_length(XML_WORD_BYTES_MAX)
        .max_attribute_length(XML_WORD_BYTES_MAX)
        .max_attributes(ATTRIBUTES_MAX);
    let (mut depth, mut left) = (0, NAMESPACE_BYTES_MAX);
    for event in EventReader::new_with_config(text.as_bytes(), config) {
        match event {
            Ok(XmlEvent::StartElement { name, namespace, .. }) => {
                depth += 1;
                let own = name.namespace.map_or(0, |uri| uri.len());
                let around =
                    namespace.0.iter().map(|(prefix, uri)| prefix.len() + uri.len() + NAMESPACE_BYTES);
                match left.checked_sub(own + around.sum::<usize>()) {
                    Some(rest) if depth <= NESTING_MAX => left = rest,
                    _ => return false,
                }
            }
            Ok(XmlEvent::EndElement { .. }) => depth -= 1,
            Ok(_) => {}
            Err(_) => return text.is_empty(),
        }
    }
    true
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    const GATEWAY: Ipv4Addr = Ipv4Addr::new(192, 168, 1, 1);

    #[test]
    fn only_places_at_the_gateway_are_asked() {
        let place = |url: &str| place_of(url, GATEWAY).map(|(at, path)| format!("{at} {path}"));
        assert_eq!(place("http://192.168.1.1:5000/root.xml?a=b").unwrap(), "192.168.1.1:5000 /root.xml?a=b");
        assert_eq!(place("http://192.168.1.1").unwrap(), "192.168.1.1:80 /");
        for other in [
            "http://192.168.1.2:5000/root.xml",
            "http://127.0.0.1:5000/root.xml",
            "http://router.example/root.xml",
            "http://192.168.1.1@203.0.113.9/",
            "http://user@192.168.1.1/",
            "https://192.168.1.1/",
            "http://192.168.1.1:0/",
            "http://192.168.1.1//203.0.113.9/",
            "http://192.168.1.1/\\203.0.113.9/",
            "/root.xml",
            "",
        ] {
            assert_eq!(place(other), None, "{other}");
        }
        let answer = "HTTP/1.1 200 OK\r\nST: x\r\nLocation: http://192.168.1.1:5000/root.xml\r\n\r\n";
        assert_eq!(located(answer, GATEWAY).unwrap().1, "/root.xml");
        assert_eq!(located(answer, Ipv4Addr::new(192, 168, 1, 2)), None);
        assert_eq!(located("HTTP/1.1 200 OK\r\n\r\n", GATEWAY), None);
    }

    fn description(base: &str, services: &[(&str, &str)]) -> String {
        let service = |(kind, url): &(&str, &str)| {
            format!(
                "<service><serviceType>urn:schemas-upnp-org:service:{kind}</serviceType>\
                 <SCPDURL>/scpd.xml</SCPDURL><controlURL>{url}</controlURL></service>"
            )
        };
        let services: String = services.iter().map(service).collect();
        format!(
            "<?xml version=\"1.0\"?><root xmlns=\"urn:schemas-upnp-org:device-1-0\">{base}<device><deviceList>\
             <device><serviceList>{services}</serviceList></device></deviceList></device></root>"
        )
    }

    #[test]
    fn best_service_of_a_description_is_taken() {
        let at = SocketAddrV4::new(GATEWAY, 5000);
        let found = |base: &str, services: &[(&str, &str)]| {
            let igd = Igd::described(&description(base, services), at, "/dir/root.xml")?;
            Some(format!("{} {} {}", igd.control, igd.path, &igd.service[29..]))
        };
        let both =
            [("Layer3Forwarding:1", "/l3"), ("WANPPPConnection:1", "/ppp"), ("WANIPConnection:1", "/ip")];
        assert_eq!(found("", &both).unwrap(), "192.168.1.1:5000 /ip WANIPConnection:1");
        assert_eq!(found("", &both[..2]).unwrap(), "192.168.1.1:5000 /ppp WANPPPConnection:1");
        assert_eq!(found("", &both[..1]), None);
        let ip = |url| [("WANIPConnection:2", url)];
        assert_eq!(found("", &ip("ctl")).unwrap(), "192.168.1.1:5000 /dir/ctl WANIPConnection:2");
        let base = "<URLBase>http://192.168.1.1:80</URLBase>";
        assert_eq!(found(base, &ip("ctl")).unwrap(), "192.168.1.1:80 /ctl WANIPConnection:2");
        assert_eq!(found("", &ip("http://192.168.1.1:99/c")).unwrap(), "192.168.1.1:99 /c WANIPConnection:2");
        // The gateway sends nobody elsewhere.
        assert_eq!(found("", &ip("http://192.168.1.9/c")), None);
        assert_eq!(found("<URLBase>http://10.0.0.1/</URLBase>", &ip("ctl")), None);
        assert_eq!(found("<URLBase>file:///etc</URLBase>", &ip("ctl")), None);
        assert_eq!(found("<unclosed>", &ip("ctl")), None);
    }

    /// A gateway that gives these answers, each to one request, and the last to all further ones.
    async fn answering(answers: &[String]) -> SocketAddrV4 {
        use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
        let listener = tokio::net::TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).await.unwrap();
        let SocketAddr::V4(at) = listener.local_addr().unwrap() else { unreachable!() };
        let answers = answers.to_vec();
        tokio::spawn(async move {
            let last = answers.last().cloned().into_iter().cycle();
            for answer in answers.into_iter().chain(last) {
                let Ok((mut stream, _)) = listener.accept().await else { return };
                let _ = stream.read(&mut [0; 4096]).await;
                let _ = stream.write_all(answer.as_bytes()).await;
            }
        });
        at
    }

    fn response(body: &str) -> String {
        format!("HTTP/1.1 200 OK\r\nContent-Length: {}\r\n\r\n{body}", body.len())
    }

    #[tokio::test]
    async fn answers_of_a_hostile_gateway_are_refused() {
        let ask = async |answer: String| {
            let to = answering(&[answer]).await;
            exchange(to, Request::builder().uri("/").header(HOST, "x"), String::new()).await
        };
        assert_eq!(ask(response("<root/>")).await.unwrap(), "<root/>");
        let long = "x".repeat(HTTP_BYTES_MAX + 1);
        let many = format!("HTTP/1.1 200 OK\r\n{}\r\n", format!("A: {}\r\n", "b".repeat(1000)).repeat(100));
        let entities = "<!DOCTYPE a [<!ENTITY b \"bbbb\">]><a>&b;&b;</a>";
        let utf16: String = entities.chars().flat_map(|c| [c, '\0']).collect();
        let deep = "<a>".repeat(NESTING_MAX + 1);
        let nonsense = "nonsense\r\n\r\n".to_owned();
        // Each element is in all of these namespaces, or in one with a long name.
        let declared: String = (0..20).map(|n| format!(" xmlns:n{n}=\"b\"")).collect();
        let within = |declared: &str| {
            let elements = "<a/>".repeat((HTTP_BYTES_MAX - declared.len() - 7) / 4);
            response(&format!("<a{declared}>{elements}</a>"))
        };
        let (namespaces, name) = (within(&declared), within(&format!(" xmlns=\"{}\"", "b".repeat(500))));
        let attributes: String = (0..=ATTRIBUTES_MAX).map(|n| format!(" a{n}=\"\"")).collect();
        let attributes = response(&format!("<a{attributes}/>"));
        let word = response(&format!("<a b=\"{}\"/>", "b".repeat(2 * XML_WORD_BYTES_MAX)));
        let [entities, utf16, deep] = [entities, &utf16, &deep].map(response);
        for hostile in [
            response(&long),
            many,
            entities,
            utf16,
            deep,
            nonsense,
            namespaces,
            name,
            attributes,
            word,
            response("<a>"),
            response("text"),
        ] {
            assert_eq!(ask(hostile).await, Err(MappingFailure::Malformed));
        }
        let flat = format!("{}{}", "<a>".repeat(NESTING_MAX), "</a>".repeat(NESTING_MAX));
        assert_eq!(ask(response(&flat)).await.unwrap(), flat);
        // A redirection is an answer without a description.
        let elsewhere = "HTTP/1.1 302 Found\r\nLocation: http://127.0.0.1:1/\r\nContent-Length: 0\r\n\r\n";
        assert_eq!(ask(elsewhere.to_owned()).await.unwrap(), "");
    }

    /// Returns an answer of the control protocol.
    fn soap(body: &str) -> String {
        let xmlns = "http://schemas.xmlsoap.org/soap/envelope/";
        response(&format!("<s:Envelope xmlns:s=\"{xmlns}\"><s:Body>{body}</s:Body></s:Envelope>"))
    }

    fn fault(code: u16) -> String {
        let error = format!(
            "<UPnPError><errorCode>{code}</errorCode><errorDescription>no</errorDescription></UPnPError>"
        );
        soap(&format!("<s:Fault><detail>{error}</detail></s:Fault>"))
    }

    #[tokio::test]
    async fn requests_go_to_the_gateway_whatever_path_a_description_names() {
        let address = soap(
            "<u:GetExternalIPAddressResponse xmlns:u=\"x\"><NewExternalIPAddress>203.0.113.9</NewExternalIPAddress>\
             </u:GetExternalIPAddressResponse>",
        );
        let mut asked = 0;
        for path in [
            "/ctl",
            "ctl",
            "/a//b",
            "/..//127.0.0.2:9/",
            "//127.0.0.2:9/",
            "/\\127.0.0.2:9/",
            "/@127.0.0.2:9/",
        ] {
            let at = answering(std::slice::from_ref(&address)).await;
            let text = description("", &[("WANIPConnection:1", path)]);
            let Some(igd) = Igd::described(&text, at, "/root.xml") else { continue };
            assert_eq!(igd.gateway().get_external_ip().await.unwrap().to_string(), "203.0.113.9", "{path}");
            asked += 1;
        }
        assert_eq!(asked, 5);
    }

    #[tokio::test]
    async fn refusals_of_a_device_have_reasons() {
        use MappingFailure as F;
        let address = soap(
            "<u:GetExternalIPAddressResponse xmlns:u=\"x\"><NewExternalIPAddress>203.0.113.9</NewExternalIPAddress>\
             </u:GetExternalIPAddressResponse>",
        );
        let added = soap("<u:AddPortMappingResponse xmlns:u=\"x\"/>");
        let target = MappingTarget {
            gateway: Ipv4Addr::LOCALHOST,
            host: Ipv4Addr::LOCALHOST,
            port: NonZeroU16::new(5000).unwrap(),
        };
        let map = async |answers: &[&String]| {
            let control = answering(&answers.iter().copied().cloned().collect::<Vec<_>>()).await;
            let igd = Igd { control, path: "/ctl".into(), service: SERVICES[1].into() };
            igd.map(target, None).await.map(|mapping| mapping.external.to_string())
        };
        assert_eq!(map(&[&address, &added]).await.unwrap(), "203.0.113.9:5000");
        for (code, why) in
            [(725, F::PermanentOnly), (606, F::NotPermitted), (724, F::NoRoom), (501, F::Unsupported)]
        {
            assert_eq!(map(&[&address, &fault(code)]).await, Err(why), "{code}");
        }
        let taken = map(&[&address, &fault(718), &fault(718), &added]).await.unwrap();
        assert!(taken.starts_with("203.0.113.9:") && !taken.ends_with(":5000"), "{taken}");
        assert_eq!(map(&[&fault(606)]).await, Err(F::NotPermitted));
        assert_eq!(map(&[&response("<root/>")]).await, Err(F::NoExternalAddress));
    }
}
