//! Grants, signed bodies, share tokens and requests for certificates, arbitrary and altered: no input panics, and no
//! altered value opens or verifies.
use std::sync::OnceLock;

use bytes::Bytes;
use rand_chacha::ChaCha20Rng;
use rand_core::SeedableRng;
use sgc_trust::{
    EnrollRequest, Fleet, Identity, Kem, ReplyKey, ShareToken, TOKEN_PREFIX, TopicSecret, seal_grant,
    verify_advert, verify_answer, verify_join,
};
use sgc_wire::{
    AdvertBody, Answer, AnswerBody, Blind, Decode, GrantContent, JoinBody, Metadata, Name, Request,
    SecretBytes, SignedBody, SinkId, TopicGrant, UnixMillis,
};

const NOW: UnixMillis = UnixMillis(1_795_000_000_000);
const NAME: Name = Name([1; 32]);
const SINK: SinkId = SinkId([2; 16]);
const SERIAL: u64 = 3;

struct Cast {
    fleet: Fleet,
    arm: Identity,
    /// A key, and a grant sealed to it.
    grants: Vec<(ReplyKey, Bytes, Bytes)>,
    /// An advertisement, a join and an answer of the arm.
    signed: [SignedBody; 3],
    token: ShareToken,
    csr: Vec<u8>,
}

fn content() -> GrantContent {
    let key = SecretBytes::new([9; 32]);
    GrantContent::Topic(TopicGrant {
        epoch: 1,
        suite: 1,
        key,
        receiver: None,
        sources: Vec::new(),
        entry: None,
    })
}

fn cast() -> &'static Cast {
    static CAST: OnceLock<Cast> = OnceLock::new();
    CAST.get_or_init(|| {
        let rng = &mut ChaCha20Rng::seed_from_u64(1);
        let mut fleet = Fleet::create("acme".parse().unwrap(), NOW, rng).unwrap();
        let arm = fleet.enroll(&EnrollRequest::new("arm-1".parse().unwrap(), NOW), rng).unwrap();
        let grants = [Kem::X25519, Kem::XWing].map(|kem| {
            let key = ReplyKey::generate(kem);
            let (enc, sealed) = seal_grant(key.public(), &NAME, &SINK, SERIAL, &content()).unwrap();
            (key, enc, sealed)
        });
        let advert = AdvertBody {
            chain: arm.chain_bytes(),
            seq: 1,
            issued_at: NOW,
            lease_ms: 30_000,
            withdraw: false,
            blinds: vec![Blind([4; 32])],
        };
        let join = JoinBody {
            name: NAME,
            sink: SINK,
            request: Request::Subscribe { describe: false },
            issued_at: NOW,
            chain: arm.chain_bytes(),
            reply_key: grants[0].0.public().clone(),
        };
        let (enc, sealed) = (grants[0].1.clone(), grants[0].2.clone());
        let answer =
            AnswerBody { name: NAME, sink: SINK, serial: SERIAL, answer: Answer::Grant { enc, sealed } };
        let signed = [arm.sign_advert(&advert), arm.sign_join(&join), arm.sign_answer(&answer)];
        let metadata = Metadata::topic("arm-1", "/tf", "tf2_msgs/msg/TFMessage");
        let token = ShareToken {
            owner: arm.node_id(),
            owner_name: "arm-1".parse().unwrap(),
            ca: fleet.ca_certificate().clone(),
            metadata,
            secret: TopicSecret::from_bytes([8; 32]),
            routers: vec!["quic://router:1".into()],
            expires: UnixMillis(NOW.0 + 1_000_000),
        };
        let csr = arm.csr();
        Cast { fleet, arm, grants: grants.into(), signed, token, csr }
    })
}

/// Changes bytes and truncates.
fn alter(good: &[u8], edits: &[u8]) -> Vec<u8> {
    let mut all = good.to_vec();
    for edit in edits.chunks_exact(3) {
        let at = usize::from(u16::from_be_bytes([edit[0], edit[1]])) % all.len().max(1);
        match (edit[2], all.get_mut(at)) {
            (0, _) => all.truncate(at),
            (bits, Some(byte)) => *byte ^= bits,
            _ => {}
        }
    }
    all
}

fn check_signed(which: usize, signed: &SignedBody) -> bool {
    let cast = cast();
    let anchors = cast.fleet.anchors();
    match which {
        0 => verify_advert(anchors, signed, NOW).is_ok(),
        1 => verify_join(anchors, signed, NOW).is_ok(),
        _ => verify_answer(cast.arm.as_peer(), signed).is_ok(),
    }
}

/// Runs one input of the target.
pub fn run(input: &[u8]) {
    let [which, kind, input @ ..] = input else { return };
    let (cast, kind) = (cast(), usize::from(*kind));
    match which % 8 {
        0 => {
            let (key, ..) = &cast.grants[kind % 2];
            let (enc, sealed) = input.split_at(input.len().min(if kind % 2 == 0 { 32 } else { 1120 }));
            assert!(key.open(&NAME, &SINK, SERIAL, enc, sealed).is_err());
        }
        1 => {
            let (key, enc, sealed) = &cast.grants[kind % 2];
            let all = [&enc[..], &sealed[..]].concat();
            let altered = alter(&all, input);
            let (enc, sealed) = altered.split_at(altered.len().min(enc.len()));
            let opened = key.open(&NAME, &SINK, SERIAL, enc, sealed);
            assert_eq!(opened.is_ok(), altered == all);
        }
        2 => {
            // An arbitrary reply key, and an altered one.
            drop(seal_grant(input, &NAME, &SINK, SERIAL, &content()));
            let altered = alter(cast.grants[kind % 2].0.public(), input);
            drop(seal_grant(&altered, &NAME, &SINK, SERIAL, &content()));
        }
        3 => {
            let (body, signature) = input.split_at(input.len().saturating_sub(70));
            let signed = SignedBody {
                body: Bytes::copy_from_slice(body),
                signature: Bytes::copy_from_slice(signature),
            };
            assert!(!check_signed(kind % 3, &signed));
        }
        4 => {
            let good = &cast.signed[kind % 3];
            let body = Bytes::from(alter(&good.body, input));
            let same = body == good.body;
            let signed = SignedBody { body, signature: good.signature.clone() };
            assert_eq!(check_signed(kind % 3, &signed), same);
            let signature = Bytes::from(alter(&good.signature, input));
            let verified =
                check_signed(kind % 3, &SignedBody { body: good.body.clone(), signature: signature.clone() });
            assert_eq!(verified, signature == good.signature);
        }
        5 => {
            let text = String::from_utf8_lossy(input);
            for text in [text.to_string(), format!("{TOKEN_PREFIX}{text}")] {
                if let Ok(token) = ShareToken::parse(&text) {
                    assert_eq!(*token.to_text(), text.trim());
                }
            }
        }
        6 => {
            let good = cast.token.to_text();
            let altered = alter(good.as_bytes(), input);
            let text = String::from_utf8_lossy(&altered);
            let read = ShareToken::parse(&text);
            assert_eq!(read.is_ok(), text.trim() == *good);
            drop(read.map(|token| (token.name(), token.ca_fingerprint())));
            // A checksum detects damage, not fields that were chosen on purpose.
            let mut made = cast.token.clone();
            if let Ok(metadata) = Metadata::from_slice(input) {
                made.metadata = metadata;
            }
            made.routers = vec![String::from_utf8_lossy(input).into_owned(); kind % 20];
            if kind >= 128 {
                made.ca = input.to_vec().into();
            }
            if made.check().is_ok() {
                assert!(ShareToken::parse(&made.to_text()).is_ok_and(|read| read == made));
            }
            let _ = made.ca_fingerprint();
        }
        _ => {
            let rng = &mut ChaCha20Rng::seed_from_u64(2);
            let mut fleet = Fleet::create("acme".parse().unwrap(), NOW, rng).unwrap();
            let request = EnrollRequest::new("arm-1".parse().unwrap(), NOW);
            let altered = alter(&cast.csr, input);
            assert_eq!(fleet.enroll_csr(&altered, &request, rng).is_ok(), altered == cast.csr);
        }
    }
}
