//! QUIC with packets that everyone can read and nobody can alter, for `udp://`.
//!
//! Handshakes are those of QUIC. Afterwards the keys that would seal a packet only authenticate it: the AEAD gets all
//! of the packet as associated data and nothing to encrypt, which leaves its tag (with AES-GCM this is GMAC, NIST SP
//! 800-38D). Nothing here keeps a payload secret: sources seal the payloads of topics.

use std::any::Any;
use std::sync::Arc;

use bytes::BytesMut;
use quinn::crypto::{
    ClientConfig, CryptoError, ExportKeyingMaterialError, HeaderKey, KeyPair, Keys, PacketKey, ServerConfig,
    Session, UnsupportedVersion,
};
use quinn::{ConnectError, ConnectionId, Side};
use quinn_proto::TransportError;
use quinn_proto::transport_parameters::TransportParameters;

/// The TLS of one side, with packets in the clear after the handshake.
pub(super) struct Clear<C>(pub(super) Arc<C>);

impl<C: ClientConfig + 'static> ClientConfig for Clear<C> {
    fn start_session(
        self: Arc<Self>,
        version: u32,
        server_name: &str,
        params: &TransportParameters,
    ) -> Result<Box<dyn Session>, ConnectError> {
        let inner = Arc::clone(&self.0).start_session(version, server_name, params)?;
        Ok(Box::new(ClearSession { inner, stage: Stage::Handshake }))
    }
}

impl<C: ServerConfig + 'static> ServerConfig for Clear<C> {
    fn initial_keys(&self, version: u32, dst_cid: &ConnectionId) -> Result<Keys, UnsupportedVersion> {
        self.0.initial_keys(version, dst_cid)
    }

    fn retry_tag(&self, version: u32, orig_dst_cid: &ConnectionId, packet: &[u8]) -> [u8; 16] {
        self.0.retry_tag(version, orig_dst_cid, packet)
    }

    fn start_session(self: Arc<Self>, version: u32, params: &TransportParameters) -> Box<dyn Session> {
        let inner = Arc::clone(&self.0).start_session(version, params);
        Box::new(ClearSession { inner, stage: Stage::Handshake })
    }
}

/// The keys that TLS hands out next: first those of the handshake, then those of everything after it.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Stage {
    Handshake,
    OneRtt,
}

struct ClearSession {
    inner: Box<dyn Session>,
    stage: Stage,
}

impl Session for ClearSession {
    fn initial_keys(&self, dst_cid: &ConnectionId, side: Side) -> Keys {
        self.inner.initial_keys(dst_cid, side)
    }

    fn handshake_data(&self) -> Option<Box<dyn Any>> {
        self.inner.handshake_data()
    }

    fn peer_identity(&self) -> Option<Box<dyn Any>> {
        self.inner.peer_identity()
    }

    fn early_crypto(&self) -> Option<(Box<dyn HeaderKey>, Box<dyn PacketKey>)> {
        None
    }

    fn early_data_accepted(&self) -> Option<bool> {
        self.inner.early_data_accepted()
    }

    fn is_handshaking(&self) -> bool {
        self.inner.is_handshaking()
    }

    fn read_handshake(&mut self, buf: &[u8]) -> Result<bool, TransportError> {
        self.inner.read_handshake(buf)
    }

    fn transport_parameters(&self) -> Result<Option<TransportParameters>, TransportError> {
        self.inner.transport_parameters()
    }

    fn write_handshake(&mut self, buf: &mut Vec<u8>) -> Option<Keys> {
        let keys = self.inner.write_handshake(buf)?;
        match self.stage {
            Stage::Handshake => {
                self.stage = Stage::OneRtt;
                Some(keys)
            }
            Stage::OneRtt => Some(Keys { header: keys.header, packet: clear(keys.packet) }),
        }
    }

    fn next_1rtt_keys(&mut self) -> Option<KeyPair<Box<dyn PacketKey>>> {
        self.inner.next_1rtt_keys().map(clear)
    }

    fn is_valid_retry(&self, orig_dst_cid: &ConnectionId, header: &[u8], payload: &[u8]) -> bool {
        self.inner.is_valid_retry(orig_dst_cid, header, payload)
    }

    fn export_keying_material(
        &self,
        output: &mut [u8],
        label: &[u8],
        context: &[u8],
    ) -> Result<(), ExportKeyingMaterialError> {
        self.inner.export_keying_material(output, label, context)
    }
}

fn clear(keys: KeyPair<Box<dyn PacketKey>>) -> KeyPair<Box<dyn PacketKey>> {
    let KeyPair { local, remote } = keys;
    KeyPair { local: Box::new(ClearKey(local)), remote: Box::new(ClearKey(remote)) }
}

/// A key that authenticates and does not encrypt.
struct ClearKey(Box<dyn PacketKey>);

impl PacketKey for ClearKey {
    fn encrypt(&self, packet: u64, buf: &mut [u8], _header_len: usize) {
        // Everything before the tag is "header": authenticated, not encrypted.
        let authenticated = buf.len() - self.0.tag_len();
        self.0.encrypt(packet, buf, authenticated);
    }

    fn decrypt(&self, packet: u64, header: &[u8], payload: &mut BytesMut) -> Result<(), CryptoError> {
        let readable = payload.len().checked_sub(self.0.tag_len()).ok_or(CryptoError)?;
        let mut tag = BytesMut::from(&payload[readable..]);
        let mut authenticated = Vec::with_capacity(header.len() + readable);
        authenticated.extend_from_slice(header);
        authenticated.extend_from_slice(&payload[..readable]);
        self.0.decrypt(packet, &authenticated, &mut tag)?;
        payload.truncate(readable);
        Ok(())
    }

    fn tag_len(&self) -> usize {
        self.0.tag_len()
    }

    fn confidentiality_limit(&self) -> u64 {
        self.0.confidentiality_limit()
    }

    fn integrity_limit(&self) -> u64 {
        self.0.integrity_limit()
    }
}
