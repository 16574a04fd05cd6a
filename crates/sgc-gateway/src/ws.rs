//! The upgrade to WebSocket (RFC 6455): who asks, with what credentials, and for which protocol.

use std::sync::Arc;

use http::StatusCode;
use http::header::{AUTHORIZATION, ORIGIN, SEC_WEBSOCKET_PROTOCOL};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::handshake::server::{ErrorResponse, Request, Response};
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;

use crate::access::Client;
use crate::door::{Arrival, Door};

/// Longest message that a client may send, bytes: an image of 13 MB in base64 fits twice over.
pub(crate) const MESSAGE_BYTES_MAX: usize = 64 << 20;
/// Parameters of a URL that may hold a token, for programs that cannot send headers.
const TOKEN_PARAMETERS: [&str; 2] = ["token", "access_token"];

/// What a client asked for.
#[derive(Debug)]
pub(crate) struct Upgraded<S> {
    pub(crate) socket: WebSocketStream<S>,
    pub(crate) client: Client,
    /// The subprotocol that was chosen.
    pub(crate) subprotocol: Option<&'static str>,
}

/// Upgrades a connection, if its client is admitted; `known` are subprotocols, the best first.
pub(crate) async fn upgrade<S: AsyncRead + AsyncWrite + Unpin>(
    stream: S,
    arrival: &Arrival,
    door: &Arc<Door>,
    known: &[&'static str],
) -> Result<Upgraded<S>, tokio_tungstenite::tungstenite::Error> {
    let mut found = None;
    // The size of what it returns is the library's choice.
    #[allow(clippy::result_large_err)]
    let decide = |request: &Request, mut response: Response| -> Result<Response, ErrorResponse> {
        let header = |name| request.headers().get(name).and_then(|value| value.to_str().ok());
        let bearer = header(AUTHORIZATION).and_then(|value| {
            let (scheme, token) = value.split_once(' ')?;
            scheme.eq_ignore_ascii_case("bearer").then(|| token.trim().to_owned())
        });
        let token = bearer.or_else(|| request.uri().query().and_then(token_in));
        // What is no text is no page that is known.
        let origin = request.headers().get(ORIGIN).map(|value| value.to_str().unwrap_or("?"));
        let client = door
            .admit(arrival, origin, token.as_deref())
            .map_err(|denied| refusal(StatusCode::UNAUTHORIZED, denied.told()))?;
        let offered: Vec<&str> = request
            .headers()
            .get_all(SEC_WEBSOCKET_PROTOCOL)
            .iter()
            .filter_map(|value| value.to_str().ok())
            .flat_map(|list| list.split(','))
            .map(str::trim)
            .collect();
        let chosen = known.iter().copied().find(|known| offered.contains(known));
        if let Some(chosen) = chosen {
            response.headers_mut().insert(SEC_WEBSOCKET_PROTOCOL, http::HeaderValue::from_static(chosen));
        }
        found = Some((client, chosen));
        Ok(response)
    };
    let mut config = WebSocketConfig::default();
    config.max_message_size = Some(MESSAGE_BYTES_MAX);
    config.max_frame_size = Some(MESSAGE_BYTES_MAX);
    let socket = tokio_tungstenite::accept_hdr_async_with_config(stream, decide, Some(config)).await?;
    let Some((client, subprotocol)) = found else {
        return Err(tokio_tungstenite::tungstenite::Error::ConnectionClosed);
    };
    Ok(Upgraded { socket, client, subprotocol })
}

fn refusal(status: StatusCode, why: &str) -> ErrorResponse {
    let mut response = ErrorResponse::new(Some(format!("{why}\n")));
    *response.status_mut() = status;
    response
}

fn token_in(query: &str) -> Option<String> {
    query.split('&').find_map(|pair| {
        let (key, value) = pair.split_once('=')?;
        TOKEN_PARAMETERS.contains(&key).then(|| percent_decoded(value))
    })
}

/// Text of a URL (RFC 3986, 2.1); what is no escape stays as it is.
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
    use super::*;

    #[test]
    fn a_token_may_stand_in_the_url() {
        assert_eq!(token_in("a=b&token=sgc-access-1%3Aab_-").as_deref(), Some("sgc-access-1:ab_-"));
        assert_eq!(token_in("access_token=x%2"), Some("x%2".to_owned()));
        assert_eq!(token_in("tokens=x"), None);
    }
}
