//! WebSocket (RFC 6455), for links and for the gateway.
//!
//! [`ByteStream`] carries one stream of bytes in binary messages whose borders mean nothing. `WebSocket`, with the
//! feature `messages`, carries text and binary messages. Both upgrade from HTTP/1.1 by [`Request`] and share the
//! frames.
//!
//! There are no extensions, and so no compression, no cookies, and no more of HTTP than the upgrade takes. WebSocket
//! authenticates nobody, and this crate decides about nobody: its callers do.
#![forbid(unsafe_code)]

mod byte_stream;
mod frame;
#[cfg(feature = "messages")]
mod messages;
mod upgrade;

pub use byte_stream::{ByteStream, accept, dial};
pub use frame::WS_FRAME_BYTES_MAX;
#[cfg(feature = "messages")]
pub use messages::{CloseFrame, Message, Text, WS_DISCARD_BYTES_MAX, WebSocket, WebSocketError};
pub use upgrade::{HTTP_HEAD_BYTES_MAX, Request, UpgradeError};
