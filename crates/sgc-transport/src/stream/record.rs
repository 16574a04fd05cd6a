//! Records that everyone can read and nobody can alter, for `tcp://` (`docs/spec/wire.md`, stream links).
//!
//! The stream behind the handshake is cut into records with a tag each. Keys come from the TLS connection before it,
//! one for each direction, and the number of the record is its nonce: so a record that is altered, left out, repeated,
//! moved or sent back ends the link, and none of it is handed on. Records hide nothing; the source seals payloads.

use std::io::{self, IoSlice};
use std::pin::Pin;
use std::task::{Context, Poll, ready};

use aws_lc_rs::aead::{
    AES_128_GCM, AES_256_GCM, Aad, Algorithm, CHACHA20_POLY1305, LessSafeKey, Nonce, UnboundKey,
};
use rustls::{CipherSuite, ConnectionCommon};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};

use super::wire::Wire;

/// Bytes in front of a record: its length.
const HEAD_BYTES: usize = 2;
/// Longest content of a record, bytes.
pub(super) const RECORD_BYTES_MAX: usize = 16 << 10;
const TAG_BYTES: usize = 16;
/// Most records under one key. It keeps the security loss of GMAC negligible; a link ends before.
const RECORDS_MAX: u64 = 1 << 40;
/// Bytes that wait to be written before more is taken.
const PENDING_BYTES: usize = 64 << 10;
/// Bytes read at once, at least.
const READ_BYTES: usize = 32 << 10;
/// Label of the exported keys (RFC 8446, 7.5); the context names the end that seals with them.
const EXPORTER: &[u8] = b"EXPORTER-SGC-tcp-records";
const FROM_DIALER: &[u8] = b"dialer";
const FROM_LISTENER: &[u8] = b"listener";

/// The reason why a stream of records ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub(super) enum RecordError {
    /// Wrong tag, or an invalid length.
    #[error("a record does not verify")]
    Altered,
    /// The key was used as often as it may be.
    #[error("the keys are used up")]
    UsedUp,
    /// TLS gave no keys.
    #[error("TLS exports no keys")]
    NoKeys,
}

impl From<RecordError> for io::Error {
    fn from(error: RecordError) -> Self {
        Self::new(io::ErrorKind::InvalidData, error)
    }
}

/// The keys of both directions.
pub(super) struct Keys {
    tx: Key,
    rx: Key,
}

impl Keys {
    /// Takes them from a TLS connection whose handshake is over.
    pub(super) fn export<D>(
        tls: &ConnectionCommon<D>,
        suite: Option<CipherSuite>,
        is_dialer: bool,
    ) -> Result<Self, RecordError> {
        let algorithm = match suite {
            Some(CipherSuite::TLS13_CHACHA20_POLY1305_SHA256) => &CHACHA20_POLY1305,
            Some(CipherSuite::TLS13_AES_128_GCM_SHA256) => &AES_128_GCM,
            Some(CipherSuite::TLS13_AES_256_GCM_SHA384) => &AES_256_GCM,
            _ => return Err(RecordError::NoKeys),
        };
        let key = |context: &[u8]| {
            let bytes = vec![0; algorithm.key_len()];
            let bytes = tls.export_keying_material(bytes, EXPORTER, Some(context));
            Key::new(algorithm, &bytes.map_err(|_| RecordError::NoKeys)?)
        };
        let (dialer, listener) = (key(FROM_DIALER)?, key(FROM_LISTENER)?);
        Ok(if is_dialer { Self { tx: dialer, rx: listener } } else { Self { tx: listener, rx: dialer } })
    }
}

/// The key of one direction, and the number of its records.
struct Key {
    key: LessSafeKey,
    records: u64,
}

impl Key {
    fn new(algorithm: &'static Algorithm, bytes: &[u8]) -> Result<Self, RecordError> {
        let key = UnboundKey::new(algorithm, bytes).map_err(|_| RecordError::NoKeys)?;
        Ok(Self { key: LessSafeKey::new(key), records: 0 })
    }

    /// Returns the next nonce: each number once.
    fn nonce(&mut self) -> Result<Nonce, RecordError> {
        if self.records >= RECORDS_MAX {
            return Err(RecordError::UsedUp);
        }
        let mut nonce = [0; 12];
        nonce[4..].copy_from_slice(&self.records.to_be_bytes());
        self.records += 1;
        Ok(Nonce::assume_unique_for_key(nonce))
    }

    /// Returns the tag of a record, its length included.
    fn tag(&mut self, record: &[u8]) -> Result<[u8; TAG_BYTES], RecordError> {
        let nonce = self.nonce()?;
        let tag = self.key.seal_in_place_separate_tag(nonce, Aad::from(record), &mut []);
        let tag = tag.map_err(|_| RecordError::UsedUp)?;
        tag.as_ref().try_into().map_err(|_| RecordError::UsedUp)
    }

    fn verify(&mut self, record: &[u8], tag: &[u8]) -> Result<(), RecordError> {
        let nonce = self.nonce()?;
        let mut tag: [u8; TAG_BYTES] = tag.try_into().map_err(|_| RecordError::Altered)?;
        let opened = self.key.open_in_place(nonce, Aad::from(record), &mut tag);
        opened.map(drop).map_err(|_| RecordError::Altered)
    }
}

/// A stream of bytes as records on another.
pub(super) struct RecordStream {
    wire: Wire,
    keys: Keys,
    /// Records to write, and the bytes of them that are written.
    out: Vec<u8>,
    written: usize,
    /// Received bytes: verified content to hand out, then an incomplete record, up to `filled`.
    input: Box<[u8]>,
    filled: usize,
    /// Beginning and end of the verified content that is left.
    ready: (usize, usize),
    /// Beginning of the next record.
    next: usize,
    /// Nothing is handed on after an error.
    failure: Option<RecordError>,
}

impl RecordStream {
    pub(super) fn new(wire: Wire, keys: Keys) -> Self {
        Self {
            wire,
            keys,
            out: Vec::new(),
            written: 0,
            input: vec![0; HEAD_BYTES + RECORD_BYTES_MAX + TAG_BYTES + READ_BYTES].into_boxed_slice(),
            filled: 0,
            ready: (0, 0),
            next: 0,
            failure: None,
        }
    }

    /// Verifies the next record. Returns `false` if it is not complete.
    fn take_record(&mut self) -> Result<bool, RecordError> {
        let Some(rest) = self.input.get(self.next..self.filled) else { return Ok(false) };
        let Some((head, _)) = rest.split_at_checked(HEAD_BYTES) else { return Ok(false) };
        let length = usize::from(u16::from_be_bytes([head[0], head[1]]));
        // Judged before anything waits for the announced bytes.
        if length == 0 || length > RECORD_BYTES_MAX {
            return Err(RecordError::Altered);
        }
        let Some((record, rest)) = rest.split_at_checked(HEAD_BYTES + length) else { return Ok(false) };
        let Some((tag, _)) = rest.split_at_checked(TAG_BYTES) else { return Ok(false) };
        self.keys.rx.verify(record, tag)?;
        let start = self.next + HEAD_BYTES;
        self.ready = (start, start + length);
        self.next = start + length + TAG_BYTES;
        Ok(true)
    }

    /// Writes waiting records.
    fn poll_out(&mut self, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        while let Some(rest) = self.out.get(self.written..).filter(|rest| !rest.is_empty()) {
            let n = ready!(Pin::new(&mut self.wire).poll_write(cx, rest))?;
            if n == 0 {
                return Poll::Ready(Err(io::ErrorKind::WriteZero.into()));
            }
            self.written += n;
        }
        self.out.clear();
        self.written = 0;
        Poll::Ready(Ok(()))
    }

    /// Makes records of the bytes that fit and returns their number.
    fn queue(&mut self, bufs: &[IoSlice<'_>]) -> Result<usize, RecordError> {
        let mut slices = bufs.iter().map(|buf| &buf[..]).filter(|buf| !buf.is_empty());
        let mut slice = slices.next().unwrap_or_default();
        let mut taken = 0;
        while !slice.is_empty() && self.out.len() < PENDING_BYTES {
            let start = self.out.len();
            self.out.extend_from_slice(&[0; HEAD_BYTES]);
            while !slice.is_empty() {
                let room = RECORD_BYTES_MAX - (self.out.len() - start - HEAD_BYTES);
                let (now, later) = slice.split_at(slice.len().min(room));
                self.out.extend_from_slice(now);
                slice = later;
                if !slice.is_empty() {
                    break;
                }
                slice = slices.next().unwrap_or_default();
            }
            let length = self.out.len() - start - HEAD_BYTES;
            taken += length;
            self.out[start..start + HEAD_BYTES].copy_from_slice(&(length as u16).to_be_bytes());
            let tag = self.keys.tx.tag(&self.out[start..])?;
            self.out.extend_from_slice(&tag);
        }
        Ok(taken)
    }
}

impl AsyncRead for RecordStream {
    fn poll_read(self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let this = self.get_mut();
        if buf.remaining() == 0 {
            return Poll::Ready(Ok(()));
        }
        if let Some(failure) = this.failure {
            return Poll::Ready(Err(failure.into()));
        }
        let mut has_some = false;
        loop {
            let (from, to) = this.ready;
            let n = (to - from).min(buf.remaining());
            if n > 0 {
                buf.put_slice(&this.input[from..from + n]);
                this.ready.0 += n;
                has_some = true;
            }
            if buf.remaining() == 0 {
                return Poll::Ready(Ok(()));
            }
            match this.take_record() {
                Ok(true) => continue,
                Ok(false) => {}
                Err(failure) => {
                    this.failure = Some(failure);
                    // The content before the failure is good.
                    return Poll::Ready(if has_some { Ok(()) } else { Err(failure.into()) });
                }
            }
            if has_some {
                return Poll::Ready(Ok(()));
            }
            // All verified content is handed out: the rest moves to the front.
            this.input.copy_within(this.next..this.filled, 0);
            this.filled -= this.next;
            (this.next, this.ready) = (0, (0, 0));
            // There is room: less than one record is left.
            let mut more = ReadBuf::new(&mut this.input[this.filled..]);
            ready!(Pin::new(&mut this.wire).poll_read(cx, &mut more))?;
            let n = more.filled().len();
            if n == 0 {
                return Poll::Ready(Ok(()));
            }
            this.filled += n;
        }
    }
}

impl AsyncWrite for RecordStream {
    fn poll_write(self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        self.poll_write_vectored(cx, &[IoSlice::new(buf)])
    }

    fn poll_write_vectored(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bufs: &[IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let this = self.get_mut();
        ready!(this.poll_out(cx))?;
        let taken = this.queue(bufs)?;
        match this.poll_out(cx) {
            Poll::Ready(Err(error)) => Poll::Ready(Err(error)),
            // Flushing writes the bytes that the stream does not take now.
            Poll::Ready(Ok(())) | Poll::Pending => Poll::Ready(Ok(taken)),
        }
    }

    fn is_write_vectored(&self) -> bool {
        true
    }

    fn poll_flush(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        let this = self.get_mut();
        ready!(this.poll_out(cx))?;
        Pin::new(&mut this.wire).poll_flush(cx)
    }

    fn poll_shutdown(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        let this = self.get_mut();
        ready!(this.poll_out(cx))?;
        Pin::new(&mut this.wire).poll_shutdown(cx)
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};

    use super::*;

    /// Returns the keys of two ends.
    fn keys(algorithm: &'static Algorithm) -> [Keys; 2] {
        let key = |byte: u8| Key::new(algorithm, &vec![byte; algorithm.key_len()]).unwrap();
        [Keys { tx: key(1), rx: key(2) }, Keys { tx: key(2), rx: key(1) }]
    }

    /// Returns the records of these writes.
    async fn records(writes: &[&[u8]]) -> Vec<Vec<u8>> {
        let [near, _] = keys(&AES_128_GCM);
        let (mut far, wire) = tokio::io::duplex(1 << 20);
        let mut tagged = RecordStream::new(Box::new(wire), near);
        let mut all = Vec::new();
        for write in writes {
            tagged.write_all(write).await.unwrap();
            tagged.flush().await.unwrap();
            let mut record = vec![0; HEAD_BYTES + write.len() + TAG_BYTES];
            far.read_exact(&mut record).await.unwrap();
            all.push(record);
        }
        all
    }

    /// Returns the content that the far end hands on of these bytes, and its last result.
    async fn read(bytes: &[u8]) -> (Vec<u8>, io::Result<usize>) {
        let [_, far] = keys(&AES_128_GCM);
        let mut tagged = RecordStream::new(Box::new(io::Cursor::new(bytes.to_vec())), far);
        let mut got = Vec::new();
        let end = tagged.read_to_end(&mut got).await;
        (got, end)
    }

    fn is_altered(end: &io::Result<usize>) -> bool {
        let error = end.as_ref().err().and_then(|e| e.get_ref()).and_then(|e| e.downcast_ref());
        error == Some(&RecordError::Altered)
    }

    #[tokio::test]
    async fn written_bytes_arrive_in_any_division_of_the_stream() {
        for algorithm in [&AES_128_GCM, &AES_256_GCM, &CHACHA20_POLY1305] {
            for size in [1, 7, 1 << 20] {
                let [near, far] = keys(algorithm);
                let (tx, rx) = tokio::io::duplex(size);
                let (mut tx, mut rx) =
                    (RecordStream::new(Box::new(tx), near), RecordStream::new(Box::new(rx), far));
                let text: Vec<u8> = (0..50_000_u32).map(|n| n as u8).collect();
                let sent = text.clone();
                let writer = tokio::spawn(async move {
                    for part in [&sent[..1], &sent[1..20_000], &sent[20_000..]] {
                        tx.write_all(part).await.unwrap();
                    }
                    tx.flush().await.unwrap();
                    // The other direction works, too.
                    let mut answer = [0; 2];
                    tx.read_exact(&mut answer).await.unwrap();
                    assert_eq!(&answer, b"ok");
                });
                let mut got = vec![0; text.len()];
                rx.read_exact(&mut got).await.unwrap();
                assert_eq!(got, text);
                rx.write_all(b"ok").await.unwrap();
                rx.flush().await.unwrap();
                writer.await.unwrap();
            }
        }
    }

    #[tokio::test]
    async fn any_change_ends_the_stream_before_it_is_handed_on() {
        let [first, second, third] =
            <[Vec<u8>; 3]>::try_from(records(&[b"first", b"second", b"third"]).await).unwrap();
        let (got, end) = read(&[&first[..], &second, &third].concat()).await;
        assert_eq!((got.as_slice(), end.unwrap()), (&b"firstsecondthird"[..], 16));
        for at in 0..second.len() {
            for bit in 0..8 {
                let mut altered = second.clone();
                altered[at] ^= 1 << bit;
                let (got, end) = read(&[&first[..], &altered, &third].concat()).await;
                assert_eq!(got, b"first", "byte {at}, bit {bit}");
                // A length that grew makes the end of the stream come first.
                assert!(is_altered(&end) || at < HEAD_BYTES, "byte {at}, bit {bit}: {end:?}");
            }
        }
        for (attack, bytes) in [
            ("leaves one out", [&first[..], &third].concat()),
            ("repeats one", [&first[..], &first].concat()),
            ("puts one elsewhere", [&first[..], &third, &second].concat()),
            ("puts one of its own in", [&first[..], &[0, 3, 12, 0, 0], &[0; TAG_BYTES]].concat()),
            ("goes on in the clear", [&first[..], &[0; 40]].concat()),
        ] {
            let (got, end) = read(&bytes).await;
            assert_eq!(got, b"first", "who {attack}");
            assert!(is_altered(&end), "who {attack}: {end:?}");
        }
        // A record that was sent one way does not verify the other way.
        let [near, _] = keys(&AES_128_GCM);
        let mut tagged = RecordStream::new(Box::new(io::Cursor::new(first)), near);
        assert!(is_altered(&tagged.read_to_end(&mut Vec::new()).await));
    }

    #[test]
    fn a_key_is_not_used_for_ever() {
        let [mut near, _] = keys(&AES_128_GCM);
        near.tx.records = RECORDS_MAX - 1;
        assert!(near.tx.tag(b"last").is_ok());
        assert_eq!(near.tx.tag(b"one more"), Err(RecordError::UsedUp));
    }
}
