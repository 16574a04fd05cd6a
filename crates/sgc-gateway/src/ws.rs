//! The upgrade to WebSocket (RFC 6455), which reads origin, credentials and subprotocol, and its end, which tells the
//! client the reason.

use std::sync::Arc;
use std::time::Duration;

use sgc_websocket::{CloseFrame, Request, WebSocket};
use tokio::io::{AsyncRead, AsyncWrite};

use crate::access::Client;
use crate::admission::{Admission, Arrival};
use crate::inflow::Inflow;

/// Longest message of a client, in bytes. An image of 13 MB in base64 fits three times.
pub(crate) const MESSAGE_BYTES_MAX: usize = 64 << 20;
/// Longest head of a request, in bytes. A token takes at most half.
const HEAD_BYTES_MAX: usize = 64 << 10;
/// URL parameters that may hold a token, for programs that cannot send headers.
const TOKEN_PARAMETERS: [&str; 2] = ["token", "access_token"];

/// Time in which a close is written and a client that sends on is heard.
const FINISH_MAX: Duration = Duration::from_secs(2);

/// The WebSocket subprotocols that clients may ask for.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Subprotocols {
    /// The subprotocols, the preferred one first.
    pub(crate) known: &'static [&'static str],
    /// Refuses clients that ask for none of them.
    pub(crate) is_needed: bool,
}

/// An upgraded connection.
#[derive(Debug)]
pub(crate) struct Upgrade<S> {
    pub(crate) socket: WebSocket<S>,
    pub(crate) client: Client,
    /// The negotiated subprotocol.
    pub(crate) subprotocol: Option<&'static str>,
}

/// The reason why a connection is not upgraded.
#[derive(Debug, thiserror::Error)]
pub(crate) enum UpgradeError {
    /// The client is not admitted; the refusal has been counted.
    #[error("not admitted")]
    NotAdmitted,
    /// The request is not an upgrade, or the connection ended.
    #[error("no WebSocket: {0}")]
    Socket(#[from] sgc_websocket::UpgradeError),
}

/// Upgrades a connection if its client is admitted.
pub(crate) async fn upgrade<S: AsyncRead + AsyncWrite + Unpin>(
    mut stream: S,
    arrival: &Arrival,
    admission: &Arc<Admission>,
    subprotocols: Subprotocols,
) -> Result<Upgrade<S>, UpgradeError> {
    let request = Request::read(&mut stream, HEAD_BYTES_MAX).await?;
    request.check_upgrade(&mut stream).await?;
    let bearer = request.fields("authorization").next().and_then(|value| {
        let (scheme, token) = value.split_once(' ')?;
        scheme.eq_ignore_ascii_case("bearer").then(|| token.trim().to_owned())
    });
    let query = request.target().and_then(|target| Some(target.split_once('?')?.1));
    let token = bearer.or_else(|| query.and_then(token_in));
    // An origin that is not text matches no listed origin.
    let origin = request.fields("origin").next();
    let client = match admission.admit(arrival, origin, token.as_deref()) {
        Ok(client) => client,
        Err(denied) => {
            // The refusal stands, whether it reaches the client or not.
            let text = format!("{}\n", denied.client_message());
            let _ = Request::refuse(&mut stream, "401 Unauthorized", &text).await;
            return Err(UpgradeError::NotAdmitted);
        }
    };
    let offered: Vec<&str> =
        request.fields("sec-websocket-protocol").flat_map(|list| list.split(',')).map(str::trim).collect();
    let subprotocol = subprotocols.known.iter().copied().find(|known| offered.contains(known));
    if subprotocols.is_needed && subprotocol.is_none() {
        let why = format!("this gateway takes the subprotocols {}", subprotocols.known.join(", "));
        let _ = Request::refuse(&mut stream, "400 Bad Request", &format!("{why}\n")).await;
        return Err(sgc_websocket::UpgradeError::Request(why).into());
    }
    let input = request.accept(&mut stream, subprotocol).await?;
    let socket = WebSocket::new(stream, input, MESSAGE_BYTES_MAX);
    Ok(Upgrade { socket, client, subprotocol })
}

/// Ends a WebSocket so that the client gets the reason, or the answer to its own close, in [`FINISH_MAX`]. `inflow`
/// counts the bytes of the stream.
pub(crate) async fn finish<S>(socket: WebSocket<S>, inflow: &Inflow, close: Option<(u16, &str)>)
where
    S: AsyncRead + AsyncWrite + Unpin,
{
    inflow.discard();
    let close = close.map(|(code, why)| CloseFrame { code, reason: close_reason(why).to_owned() });
    // The session has ended, whether the client hears of it or not.
    let _ = tokio::time::timeout(FINISH_MAX, socket.finish(close)).await;
}

/// Cuts a reason to the 123 bytes that a close frame has room for (RFC 6455, 5.5).
fn close_reason(why: &str) -> &str {
    let mut end = why.len().min(123);
    while !why.is_char_boundary(end) {
        end -= 1;
    }
    &why[..end]
}

fn token_in(query: &str) -> Option<String> {
    query.split('&').find_map(|pair| {
        let (key, value) = pair.split_once('=')?;
        TOKEN_PARAMETERS.contains(&key).then(|| percent_decoded(value))
    })
}

/// Decodes percent escapes (RFC 3986, 2.1). Invalid escapes stay as they are.
fn percent_decoded(text: &str) -> String {
    let mut out = Vec::with_capacity(text.len());
    let mut rest = text.as_bytes();
    while let Some((byte, after)) = rest.split_first() {
        let escaped = (*byte == b'%').then(|| after.get(..2)).flatten();
        let decoded = escaped.and_then(|hex| u8::from_str_radix(std::str::from_utf8(hex).ok()?, 16).ok());
        out.push(decoded.unwrap_or(*byte));
        rest = if decoded.is_some() { &after[2..] } else { after };
    }
    String::from_utf8_lossy(&out).into_owned()
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _, duplex};

    use super::*;
    use crate::access::Access;

    #[tokio::test]
    async fn refused_client_is_told_and_counted_once() {
        let admission = Admission::new(Access::default(), 1);
        let peer = "192.0.2.1:1000".parse().unwrap();
        let arrival = Arrival { peer, is_encrypted: false, certificate: None };
        let subprotocols = Subprotocols { known: &[], is_needed: false };
        let ask = async |text: &str| {
            let (near, mut far) = duplex(4096);
            far.write_all(text.as_bytes()).await.unwrap();
            let refused = upgrade(near, &arrival, &admission, subprotocols).await.unwrap_err();
            let mut told = String::new();
            far.read_to_string(&mut told).await.unwrap();
            (refused, told)
        };
        let upgrade = "GET / HTTP/1.1\r\nHost: arm-1\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
            Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n";
        let (refused, told) = ask(upgrade).await;
        assert!(matches!(refused, UpgradeError::NotAdmitted), "{refused}");
        assert!(told.starts_with("HTTP/1.1 401") && told.contains("not admitted: "), "{told}");
        assert_eq!(admission.refused(), [("not admitted".to_owned(), 1)].into());
        let (refused, _) = ask("SSH-2.0-x\r\n\r\n").await;
        assert!(matches!(refused, UpgradeError::Socket(_)), "{refused}");
    }

    #[test]
    fn a_token_may_stand_in_the_url() {
        assert_eq!(token_in("a=b&token=sgc-access-1%3Aab_-").as_deref(), Some("sgc-access-1:ab_-"));
        assert_eq!(token_in("access_token=x%2"), Some("x%2".to_owned()));
        assert_eq!(token_in("tokens=x"), None);
    }
}
