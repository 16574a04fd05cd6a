//! One association: DTLS with one peer, the verdict on its certificate, and the few messages before QUIC.
//!
//! Callers give it records and the time, and take its output from the [`Sink`]. It knows no socket and no other
//! association; [`super::mux`] decides which datagrams belong to it. Nothing that a peer sends is handed on before its
//! certificate was verified.

use std::sync::{Arc, LazyLock};
use std::time::{Duration, Instant};

use dimpl::crypto::{CryptoProvider, aws_lc_rs};
use dimpl::{
    CertificateError, Config, Dtls, Error, Output, ProtocolVersion, SecurityError, UnexpectedMessageError,
};
use rustls::AlertDescription;
use rustls_pki_types::{CertificateDer, UnixTime};
use sgc_trust::{CertError, VerifiedPeer};
use sgc_wire::CERT_BYTES_MAX;

use super::front::{self, Echo, RecordMessage, Token};
use super::keys::{Keys, SigningKeyLease};
use crate::credentials::CredentialStore;
use crate::error::{LinkError, PeerRefusal, Refusal};
use crate::options::LinkOptions;
use crate::tls;

/// Longest datagram of a handshake, bytes: it fits a path of 1280 with everything in front.
const FLIGHT_BYTES_MAX: usize = 1150;
/// First wait for an answer to a flight; it doubles.
const FLIGHT_RTO: Duration = Duration::from_millis(400);
const FLIGHT_RETRIES: usize = 8;
/// dimpl's own limit; ours comes first.
const DIMPL_TIMEOUT: Duration = Duration::from_secs(120);
/// First interval of a dialer's questions for its id; it doubles.
const ASK_INTERVAL: Duration = Duration::from_millis(200);
/// Time that a refused dialer may take to send its own refusal: the first of the two is reported.
const WORD_PATIENCE: Duration = Duration::from_secs(1);
/// Interval of setting the clock of DTLS where no timer is due.
const CLOCK_INTERVAL: Duration = Duration::from_millis(20);
/// Number of copies of a refusal, which is not acknowledged.
const REFUSAL_COPIES: usize = 2;
/// Longest datagram for dimpl, bytes. A node's own flights have at most [`FLIGHT_BYTES_MAX`], and a sealed packet of
/// QUIC is shorter than 1500.
const DATAGRAM_BYTES_MAX: usize = 2048;
/// Most datagrams of incomplete messages that dimpl keeps.
const QUEUE_RX_DATAGRAMS: usize = 30;
/// Most datagrams of a flight of ours. A dialer repeats a peer's cookie, which fills any number of them with a record
/// each.
const QUEUE_TX_DATAGRAMS: usize = 10;
/// Most records of a flight of ours: one more, and dimpl panics (`dtls13/engine.rs`, `flight_saved_records`).
const FLIGHT_RECORDS_MAX: usize = 12;
/// Length of the buffer that dimpl writes into, bytes. dimpl panics unless it holds the peer's certificate, which may
/// be as long as everything that dimpl keeps.
const OUTPUT_BYTES: usize = QUEUE_RX_DATAGRAMS * DATAGRAM_BYTES_MAX;

/// A record takes at most this much of a datagram for its headers and its tag, bytes: 13, 12, 8 and 16 in DTLS 1.2.
const RECORD_OVERHEAD_BYTES: usize = 49;
/// The messages of a flight besides the certificate, bytes: hellos, requests, a signature and a MAC.
const FLIGHT_REST_BYTES: usize = 1024;
const FLIGHT_DATAGRAMS: usize =
    (CERT_BYTES_MAX + FLIGHT_REST_BYTES).div_ceil(FLIGHT_BYTES_MAX - RECORD_OVERHEAD_BYTES);
// A flight has at most six messages, and every further datagram begins with the rest of one.
const _: () = assert!(FLIGHT_DATAGRAMS + 5 <= FLIGHT_RECORDS_MAX && FLIGHT_DATAGRAMS <= QUEUE_TX_DATAGRAMS);
const _: () = assert!(QUEUE_TX_DATAGRAMS + 1 < FLIGHT_RECORDS_MAX);
/// `protocol_version`: wrong version of the protocol inside.
const ALERT_VERSION: u8 = 70;
/// `handshake_failure`: also the answer of listeners without DTLS 1.3.
const ALERT_HANDSHAKE_FAILURE: u8 = 40;

static CONFIG: LazyLock<Arc<Config>> = LazyLock::new(|| {
    let provider = CryptoProvider { key_provider: &Keys, ..aws_lc_rs::default_provider() };
    let config = Config::builder()
        .mtu(FLIGHT_BYTES_MAX)
        .flight_start_rto(FLIGHT_RTO)
        .flight_retries(FLIGHT_RETRIES)
        .handshake_timeout(DIMPL_TIMEOUT)
        .max_queue_rx(QUEUE_RX_DATAGRAMS)
        .max_queue_tx(QUEUE_TX_DATAGRAMS)
        .with_crypto_provider(provider)
        .build()
        .expect("dimpl accepts its own cipher suites and these numbers");
    Arc::new(config)
});

/// Output of associations: packets for the wire, and plaintext for QUIC, each in one piece of memory.
#[derive(Debug, Default)]
pub(super) struct Sink {
    pub(super) packets: Vec<u8>,
    pub(super) packet_lens: Vec<usize>,
    pub(super) data: Vec<u8>,
    pub(super) data_lens: Vec<usize>,
    /// The token that a dialer has repeated.
    pub(super) proof: Option<Token>,
    /// The buffer that dimpl writes into, [`OUTPUT_BYTES`] long after its first use.
    output: Vec<u8>,
}

impl Sink {
    fn packet(&mut self, prefix: &[u8], record: &[u8]) {
        self.packets.extend_from_slice(prefix);
        self.packets.extend_from_slice(record);
        self.packet_lens.push(prefix.len() + record.len());
    }

    fn plaintext(&mut self, data: &[u8]) {
        self.data.extend_from_slice(data);
        self.data_lens.push(data.len());
    }

    pub(super) fn clear(&mut self) {
        self.packets.clear();
        self.packet_lens.clear();
        self.data.clear();
        self.data_lens.clear();
        self.proof = None;
    }
}

/// Parameters of a new association.
pub(super) struct Setup<'a> {
    pub(super) credentials: &'a CredentialStore,
    pub(super) options: &'a LinkOptions,
    pub(super) is_dialer: bool,
    /// The beginning of the dialer's random, as far as a listener has it.
    pub(super) echo: Option<Echo>,
    /// The id that the peer has to put in front of its records, and the token of its reset.
    pub(super) id: u64,
    pub(super) reset: Token,
}

/// The reason why an association ended.
#[derive(Clone, Debug)]
pub(super) enum End {
    /// This node refuses the peer's certificate.
    Refused(CertError),
    /// The peer refuses our certificate.
    ByPeer(PeerRefusal),
    /// The peer speaks DTLS and no known protocol inside of it.
    NotOurs,
    TimedOut,
    /// The peer has forgotten this association.
    Restarted,
    /// The peer's handshake is longer than the limit.
    TooLong,
    /// The peer has no DTLS 1.3, and this node does not dial with 1.2.
    OldVersion,
    /// The peer said goodbye.
    Goodbye,
    /// The association is no longer needed here.
    Released,
    /// DTLS failed.
    Broken(String),
}

impl End {
    /// Returns the error for the dialer.
    pub(super) fn to_dialer(&self, after: Duration) -> LinkError {
        match self {
            Self::Refused(why) => LinkError::RefusedHere(why.clone()),
            Self::ByPeer(why) => LinkError::RefusedByPeer(why.clone()),
            Self::NotOurs => LinkError::RefusedByPeer(PeerRefusal::Version),
            Self::TimedOut => LinkError::HandshakeTimedOut { after },
            Self::Restarted => LinkError::PeerRestarted,
            Self::TooLong => LinkError::HandshakeTooLong,
            Self::OldVersion => LinkError::DtlsVersion,
            Self::Goodbye | Self::Released => LinkError::RefusedByPeer(PeerRefusal::GaveUp),
            Self::Broken(text) => LinkError::Transport(format!("DTLS: {text}")),
        }
    }

    /// Returns the refusal for the listener.
    pub(super) fn to_listener(&self, after: Duration) -> Refusal {
        match self {
            Self::Refused(why) => Refusal::Certificate(why.clone()),
            Self::ByPeer(why) => Refusal::ByPeer(why.clone()),
            Self::TimedOut | Self::NotOurs | Self::OldVersion => Refusal::TimedOut { after },
            Self::TooLong => Refusal::HandshakeTooLong,
            Self::Goodbye | Self::Released | Self::Restarted => Refusal::ByPeer(PeerRefusal::GaveUp),
            Self::Broken(text) => Refusal::Transport(format!("DTLS: {text}")),
        }
    }
}

/// Stage of an association, in order.
#[derive(Clone, Debug)]
pub(super) enum Stage {
    Handshake,
    /// The dialer's certificate is refused; its judgement of ours is awaited.
    Refusing {
        why: CertError,
        until: Instant,
    },
    /// The dialer asks for its id.
    Asking {
        peer: Box<VerifiedPeer>,
        next: Instant,
        interval: Duration,
    },
    /// The peer's identity is proven.
    Up {
        peer: Box<VerifiedPeer>,
        since: Instant,
    },
    Ended(End),
}

/// DTLS with one peer.
pub(super) struct Association {
    dtls: Dtls,
    _key: SigningKeyLease,
    credentials: CredentialStore,
    is_dialer: bool,
    /// The dialer accepts a listener without DTLS 1.3.
    takes_dtls12: bool,
    /// A listener without DTLS 1.3 has answered.
    has_met_dtls12: bool,
    handshake_timeout: Duration,
    idle_timeout: Duration,
    id: u64,
    reset: Token,
    /// Bytes in front of every record that is sent.
    prefix: Vec<u8>,
    started: Instant,
    clock: Instant,
    due: Instant,
    /// Time of the last authentic input.
    heard: Instant,
    has_data: bool,
    /// A link uses the association.
    is_claimed: bool,
    stage: Stage,
    certificate: Option<CertificateDer<'static>>,
    /// The listener's identity by its certificate: a dialer judges it before it shows its own.
    listener: Option<Box<VerifiedPeer>>,
    /// The beginning of the random of the dialer's hello.
    echo: Option<Echo>,
    /// A dialer's first flight, in case it has to be repeated with a ticket.
    first_flight: Vec<Vec<u8>>,
}

impl Association {
    /// Creates an association. Returns `None` if DTLS cannot use the key of the identity.
    pub(super) fn new(setup: &Setup<'_>, now: Instant) -> Option<Self> {
        let key = SigningKeyLease::new(setup.credentials.identity().certified_key())?;
        let takes_dtls12 = setup.options.dtls12;
        // A listener tells the version from the hello. A dialer that has asked for both may be talked out of 1.3 by
        // anyone on the way, and in 1.2 certificates travel in the clear.
        let mut dtls = if setup.is_dialer && !takes_dtls12 {
            Dtls::new_13(Arc::clone(&CONFIG), key.certificate(), now)
        } else {
            Dtls::new_auto(Arc::clone(&CONFIG), key.certificate(), now)
        };
        if setup.is_dialer {
            dtls.set_active(true);
        }
        Some(Self {
            dtls,
            _key: key,
            credentials: setup.credentials.clone(),
            is_dialer: setup.is_dialer,
            takes_dtls12,
            has_met_dtls12: false,
            handshake_timeout: setup.options.handshake_timeout,
            idle_timeout: setup.options.idle_timeout,
            id: setup.id,
            reset: setup.reset,
            prefix: Vec::new(),
            started: now,
            clock: now,
            due: now,
            heard: now,
            has_data: false,
            is_claimed: false,
            stage: Stage::Handshake,
            certificate: None,
            listener: None,
            echo: setup.echo,
            first_flight: Vec::new(),
        })
    }

    /// Sends the first flight.
    pub(super) fn start(&mut self, now: Instant, sink: &mut Sink) {
        let result = self.dtls.handle_timeout(now);
        self.check(result);
        let from = sink.packet_lens.len();
        let mut at: usize = sink.packet_lens.iter().sum();
        self.drain(now, sink);
        for len in &sink.packet_lens[from..] {
            self.first_flight.push(sink.packets[at..at + len].to_vec());
            at += len;
        }
        self.echo = self.first_flight.first().and_then(|hello| front::client_hello(hello));
    }

    /// Takes one datagram's records. Returns `true` if something in it was authentic and new.
    pub(super) fn receive(&mut self, records: &[u8], now: Instant, sink: &mut Sink) -> bool {
        if self.is_ended() || (!self.takes_plaintext() && front::has_plaintext(records)) {
            return false;
        }
        if records.len() > DATAGRAM_BYTES_MAX {
            if matches!(self.stage, Stage::Handshake) {
                self.end(End::TooLong);
            }
            return false;
        }
        if self.is_dialer && !self.takes_dtls12 && matches!(self.stage, Stage::Handshake) {
            self.has_met_dtls12 |= front::is_without_dtls13(records);
        }
        if matches!(self.stage, Stage::Handshake)
            || now.saturating_duration_since(self.clock) >= CLOCK_INTERVAL
        {
            self.clock = now;
            let result = self.dtls.handle_timeout(now);
            self.check(result);
        }
        // After an error dimpl may panic, so only its pending output is taken.
        if !self.is_ended() {
            match self.dtls.handle_packet(records) {
                // Anybody could have sent that.
                Err(Error::UnexpectedMessage(UnexpectedMessageError::UnrecognizedAutoServerResponse)) => {}
                result => self.check(result),
            }
        }
        self.drain(now, sink)
    }

    /// Seals one packet of QUIC.
    pub(super) fn seal(&mut self, packet: &[u8], now: Instant, sink: &mut Sink) {
        if !matches!(self.stage, Stage::Up { .. }) {
            return;
        }
        let result = self.dtls.send_application_data(packet).map(drop);
        self.check(result);
        self.drain(now, sink);
    }

    /// Sends a token to the peer, which repeats it.
    pub(super) fn probe(&mut self, token: Token, now: Instant, sink: &mut Sink) {
        if matches!(self.stage, Stage::Up { .. }) {
            self.say(RecordMessage::Probe { token });
            self.drain(now, sink);
        }
    }

    /// Runs due timers.
    pub(super) fn tick(&mut self, now: Instant, sink: &mut Sink) {
        if self.is_ended() {
            return;
        }
        if self.due <= now {
            self.clock = now;
            let result = self.dtls.handle_timeout(now);
            self.check(result);
            self.drain(now, sink);
        }
        let is_late = now >= self.started + self.handshake_timeout;
        match &mut self.stage {
            // A forged answer of an old listener changes only this reason.
            Stage::Handshake if is_late && self.has_met_dtls12 => self.end(End::OldVersion),
            Stage::Handshake if is_late => self.end(End::TimedOut),
            Stage::Asking { .. } if is_late => self.end(End::NotOurs),
            Stage::Asking { next, interval, .. } if *next <= now => {
                *interval *= 2;
                *next = now + *interval;
                self.say(RecordMessage::Ask);
                self.drain(now, sink);
            }
            Stage::Refusing { why, until } if *until <= now => {
                let why = why.clone();
                self.end(End::Refused(why));
            }
            Stage::Up { since, .. } if !self.is_dialer => {
                // QUIC has its own time-out, which comes first if there is a handshake of its own.
                let patience = self.handshake_timeout * if self.has_data { 2 } else { 1 };
                if !self.is_claimed && now >= *since + patience {
                    self.close(End::TimedOut, now, sink);
                } else if now >= self.heard + self.idle_timeout * 2 {
                    self.close(End::Released, now, sink);
                }
            }
            _ => {}
        }
    }

    /// Returns the time of the next call of [`Self::tick`].
    pub(super) fn due(&self) -> Instant {
        let own = match &self.stage {
            Stage::Handshake => self.started + self.handshake_timeout,
            Stage::Asking { next, .. } => *next,
            Stage::Refusing { until, .. } => *until,
            Stage::Up { .. } | Stage::Ended(_) => return self.due,
        };
        own.min(self.due)
    }

    /// Answers a listener that wants to see that datagrams arrive here: sends the first ones again, with its ticket in
    /// front of everything until there is an id.
    pub(super) fn answer_challenge(&mut self, token: &Token, sink: &mut Sink) {
        if self.is_dialer && matches!(self.stage, Stage::Handshake) {
            self.prefix = front::ticket_prefix(token);
            for record in &self.first_flight {
                sink.packet(&self.prefix, record);
            }
        }
    }

    /// Returns the beginning of the random of the dialer's hello.
    pub(super) fn echo(&self) -> Option<Echo> {
        self.echo
    }

    /// Notes that the peer refuses our certificate before the handshake is over, if this is the echo of its hello.
    pub(super) fn refused_by_peer(&mut self, alert: u8, echo: &Echo) {
        if matches!(self.stage, Stage::Handshake) && self.echo.as_ref() == Some(echo) {
            self.end(End::ByPeer(PeerRefusal::from_alert(alert)));
        }
    }

    /// Returns whether this token shows that the listener has forgotten the association.
    pub(super) fn is_reset_by(&self, token: &Token) -> bool {
        use ::aws_lc_rs::constant_time::verify_slices_are_equal;
        self.is_dialer
            && matches!(self.stage, Stage::Up { .. })
            && verify_slices_are_equal(&self.reset, token).is_ok()
    }

    /// Takes the association for a link. Returns `false` if it has one already.
    pub(super) fn claim(&mut self) -> bool {
        !std::mem::replace(&mut self.is_claimed, true)
    }

    /// Says goodbye.
    pub(super) fn close(&mut self, end: End, now: Instant, sink: &mut Sink) {
        if !self.is_ended() {
            let result = self.dtls.close();
            self.check(result);
            self.drain(now, sink);
            self.end(end);
        }
    }

    /// Ends the association without telling the peer.
    pub(super) fn end(&mut self, end: End) {
        if !self.is_ended() {
            self.stage = Stage::Ended(end);
        }
    }

    pub(super) fn stage(&self) -> &Stage {
        &self.stage
    }

    /// Returns the peer as soon as it is certain.
    pub(super) fn peer(&self) -> Option<&VerifiedPeer> {
        match &self.stage {
            Stage::Up { peer, .. } => Some(peer),
            _ => None,
        }
    }

    /// Returns `true` as long as no link uses it, and the peer has sent nothing that QUIC could answer.
    pub(super) fn is_unused(&self) -> bool {
        !self.is_claimed && !self.has_data
    }

    /// Returns `true` once the peer showed a certificate, which takes a cookie of DTLS: it receives at its address.
    pub(super) fn has_shown(&self) -> bool {
        self.certificate.is_some()
    }

    fn is_ended(&self) -> bool {
        matches!(self.stage, Stage::Ended(_))
    }

    /// Returns whether records that everybody can make may still be needed: during the handshake, and in DTLS 1.2 until
    /// the dialer is known to have the last of our flights.
    fn takes_plaintext(&self) -> bool {
        match self.stage {
            Stage::Handshake => true,
            Stage::Refusing { .. } | Stage::Up { .. } if !self.is_dialer && !self.has_data => {
                self.dtls.protocol_version() == Some(ProtocolVersion::DTLS1_2)
            }
            _ => false,
        }
    }

    fn check(&mut self, result: Result<(), Error>) {
        let Err(error) = result else { return };
        self.end(match error {
            Error::Timeout(_) => End::TimedOut,
            Error::ReceiveQueueFull | Error::TooManyClientHelloFragments
                if matches!(self.stage, Stage::Handshake) =>
            {
                End::TooLong
            }
            Error::SecurityError(SecurityError::FatalAlert {
                description: ALERT_VERSION | ALERT_HANDSHAKE_FAILURE,
            }) if self.is_dialer && !self.takes_dtls12 && matches!(self.stage, Stage::Handshake) => {
                End::OldVersion
            }
            Error::SecurityError(SecurityError::FatalAlert { description }) => {
                End::ByPeer(PeerRefusal::from_alert(description))
            }
            Error::CertificateError(
                CertificateError::NoClientCertificateReceived
                | CertificateError::NoClientCertificateForVerification
                | CertificateError::NoServerCertificateReceived
                | CertificateError::NoServerCertificateForVerification,
            ) => End::Refused(CertError::NoCertificate),
            error => End::Broken(error.to_string()),
        });
    }

    fn say(&mut self, inside: RecordMessage) {
        let result = self.dtls.send_application_data(&inside.to_bytes()).map(drop);
        self.check(result);
    }

    /// Takes everything out of DTLS, also after an error: there may be an alert to send. Returns `true` if something
    /// was new that only the peer can have sent.
    fn drain(&mut self, now: Instant, sink: &mut Sink) -> bool {
        let mut has_heard = false;
        let mut output = std::mem::take(&mut sink.output);
        if output.len() < OUTPUT_BYTES {
            output = vec![0; OUTPUT_BYTES];
        }
        loop {
            match self.dtls.poll_output(&mut output) {
                Output::Packet(record) => sink.packet(&self.prefix, record),
                Output::BufferTooSmall { needed } => {
                    self.end(End::Broken(format!("a record of {needed} bytes")));
                    break;
                }
                Output::Timeout(due) => {
                    self.due = due;
                    break;
                }
                Output::Connected => self.connected(now),
                Output::PeerCert(leaf) => {
                    if let Err(why) = self.take_certificate(leaf) {
                        // In DTLS 1.2 the pending output of dimpl holds our own certificate, and stays there.
                        self.refuse_early(why, sink);
                        break;
                    }
                }
                Output::ApplicationData(data) => {
                    self.heard = now;
                    has_heard = true;
                    if RecordMessage::is_inside(data) {
                        self.heed(RecordMessage::parse(data), now, &mut sink.proof);
                    } else if matches!(self.stage, Stage::Up { .. }) {
                        self.has_data = true;
                        sink.plaintext(data);
                    }
                }
                Output::CloseNotify => self.end(End::Goodbye),
                _ => {}
            }
        }
        sink.output = output;
        has_heard
    }

    /// Keeps the peer's certificate. A dialer judges it here: dimpl has checked the listener's signature in DTLS 1.2,
    /// and shows nothing of ours before it has done so in 1.3.
    fn take_certificate(&mut self, leaf: &[u8]) -> Result<(), CertError> {
        if leaf.len() > CERT_BYTES_MAX {
            return Err(CertError::CertificateTooLong { bytes: leaf.len() });
        }
        let leaf = CertificateDer::from(leaf.to_vec());
        if self.is_dialer {
            let chain = std::slice::from_ref(&leaf);
            let peer = tls::judge(&self.credentials, chain, UnixTime::now(), false)?;
            self.listener = Some(Box::new(peer));
        }
        self.certificate = Some(leaf);
        Ok(())
    }

    /// Refuses the peer's certificate in a handshake that is not over, and tells the peer outside of DTLS.
    fn refuse_early(&mut self, why: CertError, sink: &mut Sink) {
        if let Some(echo) = &self.echo {
            let word = front::refusal(tls_alert(&why), echo);
            for _ in 0..REFUSAL_COPIES {
                sink.packet(&[], &word);
            }
        }
        self.end(End::Refused(why));
    }

    /// Judges the peer when the handshake is over, before any of its other input counts.
    fn connected(&mut self, now: Instant) {
        if !matches!(self.stage, Stage::Handshake) {
            return;
        }
        self.first_flight.clear();
        if self.is_dialer {
            let Some(peer) = self.listener.take() else { return self.refuse(CertError::NoCertificate) };
            self.stage = Stage::Asking { peer, next: now + ASK_INTERVAL, interval: ASK_INTERVAL };
            return self.say(RecordMessage::Ask);
        }
        let verdict = match self.certificate.as_slice() {
            [] => Err(CertError::NoCertificate),
            chain => tls::judge(&self.credentials, chain, UnixTime::now(), true),
        };
        self.stage = match verdict {
            Ok(peer) => Stage::Up { peer: Box::new(peer), since: now },
            Err(why) => Stage::Refusing { why, until: now + WORD_PATIENCE },
        };
    }

    /// Tells the peer the reason, and ends.
    fn refuse(&mut self, why: CertError) {
        let alert = tls_alert(&why);
        for _ in 0..REFUSAL_COPIES {
            self.say(RecordMessage::Refused { alert });
        }
        self.end(End::Refused(why));
    }

    /// Takes a message of the peer besides QUIC.
    fn heed(&mut self, inside: RecordMessage, now: Instant, proof: &mut Option<Token>) {
        match (inside, self.is_dialer) {
            (RecordMessage::Ask, false) => match &self.stage {
                Stage::Up { .. } => self.say(RecordMessage::Answer { id: self.id, reset: self.reset }),
                Stage::Refusing { why, .. } => {
                    let why = why.clone();
                    self.refuse(why);
                }
                _ => {}
            },
            (RecordMessage::Answer { id, reset }, true) => {
                if let Stage::Asking { peer, .. } = &self.stage {
                    self.stage = Stage::Up { peer: peer.clone(), since: now };
                    self.prefix = front::id_prefix(id);
                    self.reset = reset;
                }
            }
            (RecordMessage::Refused { alert }, _) => {
                let is_early = matches!(self.stage, Stage::Asking { .. } | Stage::Refusing { .. });
                if is_early || (!self.is_dialer && !self.is_claimed) {
                    self.end(End::ByPeer(PeerRefusal::from_alert(alert)));
                }
            }
            (RecordMessage::Probe { token }, true) => self.say(RecordMessage::Proof { token }),
            (RecordMessage::Proof { token }, false) => *proof = Some(token),
            (RecordMessage::Unknown, false) => self.say(RecordMessage::Refused { alert: ALERT_VERSION }),
            (RecordMessage::Ask | RecordMessage::Proof { .. } | RecordMessage::Unknown, true)
            | (RecordMessage::Answer { .. } | RecordMessage::Probe { .. }, false) => {}
        }
    }
}

/// Returns the alert for a refused certificate of the peer (RFC 8446, 6.2).
fn tls_alert(why: &CertError) -> u8 {
    u8::from(AlertDescription::from(tls::alert(why)))
}
