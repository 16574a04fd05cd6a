//! Whole handshakes with a hostile peer, driven by a script of bytes, for `sgc-fuzz-targets`.
//!
//! One end is an [`Association`]; the other is a bare `dimpl`, whose datagrams are lost, doubled, postponed, altered,
//! cut into other records and pieces, and mixed with records of the script.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use dimpl::crypto::{CryptoProvider, aws_lc_rs};
use dimpl::{Config, Dtls, DtlsCertificate, Output};
use sgc_trust::Identity;

use super::association::{Association, Setup, Sink, Stage};
use super::front;
use super::keys::{Keys, SigningKeyLease};
use crate::credentials::CredentialStore;
use crate::options::LinkOptions;

/// Most steps of a script.
const STEPS_MAX: usize = 96;
/// Most datagrams under way.
const UNDER_WAY_MAX: usize = 128;
/// Most rounds without interference at the end.
const ROUNDS_MAX: usize = 12;
const RECORD_HEAD_BYTES: usize = 13;
const HANDSHAKE_HEAD_BYTES: usize = 12;

/// The ends that meet in a script.
#[derive(Debug)]
pub struct HandshakeExercise {
    credentials: CredentialStore,
    /// The association's own certificate.
    leaf: Vec<u8>,
    member: Arc<Identity>,
}

/// The rest of a script; it reads as 0 once it is over.
struct Script<'a>(&'a [u8]);

impl<'a> Script<'a> {
    fn byte(&mut self) -> u8 {
        let Some((first, rest)) = self.0.split_first() else { return 0 };
        self.0 = rest;
        *first
    }

    fn number(&mut self) -> usize {
        usize::from(u16::from_be_bytes([self.byte(), self.byte()]))
    }

    fn bytes(&mut self) -> &'a [u8] {
        let len = usize::from(self.byte()).min(self.0.len());
        let (taken, rest) = self.0.split_at(len);
        self.0 = rest;
        taken
    }
}

/// The hostile end.
struct Peer {
    dtls: Dtls,
    _key: SigningKeyLease,
    output: Vec<u8>,
    /// dimpl is of no use after an error.
    is_broken: bool,
    sent: VecDeque<Vec<u8>>,
}

impl Peer {
    fn drive(&mut self, now: Instant, datagram: Option<&[u8]>) {
        if !self.is_broken {
            self.is_broken |= self.dtls.handle_timeout(now).is_err();
        }
        if let Some(datagram) = datagram.filter(|_| !self.is_broken) {
            self.is_broken |= self.dtls.handle_packet(datagram).is_err();
        }
        self.collect();
    }

    fn say(&mut self, data: &[u8]) {
        if !self.is_broken {
            self.is_broken |= self.dtls.send_application_data(data).is_err();
            self.collect();
        }
    }

    fn collect(&mut self) {
        loop {
            match self.dtls.poll_output(&mut self.output) {
                Output::Packet(packet) if self.sent.len() < UNDER_WAY_MAX => {
                    self.sent.push_back(packet.to_vec())
                }
                Output::Timeout(_) | Output::BufferTooSmall { .. } => return,
                _ => {}
            }
        }
    }
}

/// An association and its peer.
struct AssociationPair<'a> {
    association: Association,
    is_dialer: bool,
    /// Bytes that only a member may see in the clear.
    secret: &'a [u8],
    is_member: bool,
    peer: Peer,
    sink: Sink,
    to_peer: VecDeque<Vec<u8>>,
    now: Instant,
}

impl HandshakeExercise {
    /// Creates one with the identity of the association, and another member of its fleet.
    pub fn new(ours: Arc<Identity>, member: Arc<Identity>) -> Self {
        let leaf = ours.chain()[0].to_vec();
        Self { credentials: CredentialStore::new(ours), leaf, member }
    }

    /// Plays a script. In every script only a member is believed, and a dialer shows its certificate to no other peer.
    pub fn run(&self, script: &[u8]) {
        let mut script = Script(script);
        let Some(mut meeting) = self.meet(&mut script) else { return };
        let now = meeting.now;
        if meeting.is_dialer {
            meeting.association.start(now, &mut meeting.sink);
        }
        meeting.peer.drive(now, None);
        meeting.settle();
        for _ in 0..STEPS_MAX {
            if script.0.is_empty() {
                break;
            }
            meeting.step(&mut script);
        }
        for _ in 0..ROUNDS_MAX {
            while let Some(datagram) = meeting.peer.sent.pop_front() {
                meeting.deliver(&datagram);
            }
            meeting.wait(Duration::from_millis(500));
        }
    }

    fn meet(&self, script: &mut Script<'_>) -> Option<AssociationPair<'_>> {
        let flags = script.byte();
        let (is_dialer, is_old) = (flags & 1 > 0, flags & 2 > 0);
        let sizes: &[usize] =
            if is_old { &[64, 300, 1150, 2048, 16_000, 60_000] } else { &[800, 1150, 2048, 16_000] };
        let datagram_bytes = sizes[usize::from(script.byte()) % sizes.len()];
        let key = SigningKeyLease::new(self.member.certified_key())?;
        let DtlsCertificate { mut certificate, private_key } = key.certificate();
        // In DTLS 1.3 dimpl cannot send longer ones.
        let longest = if is_old { 60_000 } else { datagram_bytes * 4 };
        match flags >> 2 & 3 {
            0 => {}
            1 => {
                let at = script.number() % certificate.len();
                certificate[at] ^= script.byte().max(1);
            }
            2 => certificate.resize(1 + script.number() % longest, 0x30),
            _ => {
                let made_up = script.bytes();
                certificate = if made_up.is_empty() { vec![0x30] } else { made_up.to_vec() };
            }
        }
        let is_member = *certificate == *self.member.chain()[0];
        let provider = CryptoProvider { key_provider: &Keys, ..aws_lc_rs::default_provider() };
        let config = Config::builder().mtu(datagram_bytes).max_queue_tx(100).max_queue_rx(100);
        let config = Arc::new(config.with_crypto_provider(provider).build().ok()?);
        let certificate = DtlsCertificate { certificate, private_key };
        let now = Instant::now();
        let mut dtls = if is_old {
            Dtls::new_12(config, certificate, now)
        } else {
            Dtls::new_13(config, certificate, now)
        };
        dtls.set_active(!is_dialer);
        let options = LinkOptions { dtls12: flags & 16 > 0, ..LinkOptions::default() };
        let setup = Setup {
            credentials: &self.credentials,
            options: &options,
            is_dialer,
            echo: (!is_dialer).then_some([7; front::ECHO_BYTES]),
            id: 7,
            reset: [8; front::TOKEN_BYTES],
        };
        let association = Association::new(&setup, now)?;
        let (output, sent) = (vec![0; 1 << 17], VecDeque::new());
        let leaf = &self.leaf[..];
        Some(AssociationPair {
            association,
            is_dialer,
            secret: &leaf[leaf.len() / 2..leaf.len() / 2 + 24],
            is_member,
            peer: Peer { dtls, _key: key, output, is_broken: false, sent },
            sink: Sink::default(),
            to_peer: VecDeque::new(),
            now,
        })
    }
}

impl AssociationPair<'_> {
    /// Takes the output of the association and checks its state.
    fn settle(&mut self) {
        let mut at = 0;
        for len in &self.sink.packet_lens {
            let packet = &self.sink.packets[at..at + len];
            at += len;
            if self.is_dialer && !self.is_member {
                let shows = packet.windows(self.secret.len()).any(|bytes| bytes == self.secret);
                assert!(!shows, "a dialer showed its certificate to a stranger");
            }
            if self.to_peer.len() < UNDER_WAY_MAX {
                self.to_peer.push_back(packet.to_vec());
            }
        }
        let is_believed = matches!(self.association.stage(), Stage::Asking { .. } | Stage::Up { .. });
        assert!(self.is_member || (!is_believed && self.sink.data.is_empty()), "a stranger is believed");
        self.sink.clear();
    }

    fn deliver(&mut self, datagram: &[u8]) {
        let (association, sink) = (&mut self.association, &mut self.sink);
        match front::sort(datagram) {
            Some(front::DatagramKind::Plain(records) | front::DatagramKind::Id(_, records)) => {
                association.receive(records, self.now, sink);
            }
            Some(front::DatagramKind::Refusal(alert, echo)) => association.refused_by_peer(alert, &echo),
            Some(front::DatagramKind::Challenge(token, _)) => association.answer_challenge(&token, sink),
            _ => {}
        }
        self.settle();
        self.answer();
    }

    /// Gives the peer the association's output.
    fn answer(&mut self) {
        while let Some(datagram) = self.to_peer.pop_front() {
            if let Some(
                front::DatagramKind::Plain(records)
                | front::DatagramKind::Id(_, records)
                | front::DatagramKind::Ticket(_, records),
            ) = front::sort(&datagram)
            {
                self.peer.drive(self.now, Some(records));
            }
        }
    }

    fn wait(&mut self, time: Duration) {
        self.now += time;
        self.association.tick(self.now, &mut self.sink);
        self.settle();
        self.peer.drive(self.now, None);
        self.answer();
    }

    fn step(&mut self, script: &mut Script<'_>) {
        let kind = script.byte();
        match kind % 24 {
            10 => return self.deliver(script.bytes()),
            11 => return self.deliver(&record(script)),
            12 => return self.wait(Duration::from_millis(1 << (script.byte() % 14))),
            13 => {
                let data = script.bytes();
                return self.peer.say(data);
            }
            14 => {
                let data = script.bytes();
                self.association.seal(data, self.now, &mut self.sink);
                self.settle();
                return self.answer();
            }
            15 => return self.deliver(&vec![script.byte(); script.number()]),
            _ => {}
        }
        let Some(mut datagram) = self.peer.sent.pop_front() else { return };
        match kind % 24 {
            1 => {}
            2 => {
                self.deliver(&datagram);
                self.deliver(&datagram);
            }
            3 if !datagram.is_empty() => {
                let at = script.number() % datagram.len();
                datagram[at] ^= script.byte();
                self.deliver(&datagram);
            }
            4 => self.deliver(&datagram[..datagram.len().min(script.number())]),
            5 => self.peer.sent.push_back(datagram),
            6 => {
                for record in records(&datagram) {
                    self.deliver(record);
                }
            }
            7 => {
                let bytes = usize::from(script.byte()).max(1);
                for record in records(&datagram) {
                    for piece in pieces(record, bytes) {
                        self.deliver(&piece);
                    }
                }
            }
            8 => {
                datagram.extend(self.peer.sent.pop_front().unwrap_or_default());
                self.deliver(&datagram);
            }
            9 => {
                // The head of the handshake message: kind, length, number, offset and length of the piece.
                let at = RECORD_HEAD_BYTES + usize::from(script.byte()) % HANDSHAKE_HEAD_BYTES;
                if let Some(byte) = datagram.get_mut(at) {
                    *byte = script.byte();
                }
                self.deliver(&datagram);
            }
            _ => self.deliver(&datagram),
        }
    }
}

/// Returns a record of the script's own.
fn record(script: &mut Script<'_>) -> Vec<u8> {
    let mut record = vec![20 + script.byte() % 7, 0xfe, 0xfd, 0, script.byte() % 3, 0, 0, 0, 0, 0];
    record.push(script.byte());
    let content = script.bytes();
    record.extend((content.len() as u16).to_be_bytes());
    record.extend(content);
    record
}

/// Returns the records of a datagram that have the head of unencrypted ones; the rest in one piece.
fn records(mut datagram: &[u8]) -> Vec<&[u8]> {
    let mut records = Vec::new();
    while !datagram.is_empty() {
        let whole = match datagram {
            [20..=26, _, _, _, _, _, _, _, _, _, _, high, low, ..] => {
                RECORD_HEAD_BYTES + usize::from(u16::from_be_bytes([*high, *low]))
            }
            _ => datagram.len(),
        };
        let (record, rest) = datagram.split_at(whole.min(datagram.len()));
        records.push(record);
        datagram = rest;
    }
    records
}

/// Returns an unencrypted handshake record in pieces of this many bytes; any other unchanged.
fn pieces(record: &[u8], bytes: usize) -> Vec<Vec<u8>> {
    let is_handshake = record.first() == Some(&22) && record.get(3..5) == Some(&[0, 0]);
    let whole = || vec![record.to_vec()];
    let Some((head, rest)) = record.split_at_checked(RECORD_HEAD_BYTES).filter(|_| is_handshake) else {
        return whole();
    };
    let Some((message, body)) = rest.split_at_checked(HANDSHAKE_HEAD_BYTES) else { return whole() };
    let offset = u32::from_be_bytes([0, message[6], message[7], message[8]]);
    let mut pieces = Vec::new();
    for (number, piece) in body.chunks(bytes).take(UNDER_WAY_MAX).enumerate() {
        let mut out = head[..11].to_vec();
        out.extend(((HANDSHAKE_HEAD_BYTES + piece.len()) as u16).to_be_bytes());
        out.extend(&message[..6]);
        out.extend(&offset.wrapping_add((number * bytes) as u32).to_be_bytes()[1..]);
        out.extend(&(piece.len() as u32).to_be_bytes()[1..]);
        out.extend(piece);
        pieces.push(out);
    }
    pieces
}

#[cfg(test)]
mod tests {
    use std::time::SystemTime;

    use rand_chacha::ChaCha20Rng;
    use rand_core::SeedableRng as _;
    use sgc_trust::{EnrollRequest, Fleet};
    use sgc_wire::UnixMillis;

    use super::*;

    fn exercise() -> HandshakeExercise {
        let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap();
        let now = UnixMillis(now.as_millis() as u64);
        let mut rng = ChaCha20Rng::seed_from_u64(1);
        let fleet = Fleet::create("acme".parse().unwrap(), now, &mut rng).unwrap();
        let mut member = |name: &str| {
            let request = EnrollRequest::new(name.parse().unwrap(), now);
            Arc::new(fleet.issue(&request, &mut rng).unwrap())
        };
        HandshakeExercise::new(member("ours"), member("other"))
    }

    /// Every role and version, without interference: a member is believed, so that the scripts get that far.
    #[test]
    fn scripts_reach_established_associations() {
        let exercise = exercise();
        for flags in [0, 1, 2, 3 | 16] {
            let mut meeting = exercise.meet(&mut Script(&[flags, 2])).unwrap();
            if meeting.is_dialer {
                meeting.association.start(meeting.now, &mut meeting.sink);
            }
            meeting.peer.drive(meeting.now, None);
            meeting.settle();
            meeting.answer();
            while let Some(datagram) = meeting.peer.sent.pop_front() {
                meeting.deliver(&datagram);
            }
            let stage = meeting.association.stage();
            assert!(matches!(stage, Stage::Asking { .. } | Stage::Up { .. }), "{flags}: {stage:?}");
        }
    }
}
