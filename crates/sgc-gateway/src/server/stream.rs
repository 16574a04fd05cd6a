//! [`ByteStream`]: a connection, with TLS or without.

use tokio::io::{AsyncRead, AsyncWrite};

/// Any stream of bytes.
pub(super) trait ByteStream: AsyncRead + AsyncWrite + Send + Unpin {}

impl<S: AsyncRead + AsyncWrite + Send + Unpin> ByteStream for S {}
