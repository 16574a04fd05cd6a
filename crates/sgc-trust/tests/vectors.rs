//! Golden vectors of sealing and signing in every suite, of grants, and of a fleet's revocation list.
//! `scripts/trust-vectors.py` made them with another implementation, and checks the same file.

use rand_chacha::ChaCha20Rng;
use rand_core::SeedableRng as _;
use rustls_pki_types::CertificateDer;
use sgc_trust::{
    Batch, BatchVerifier, CertError, Fleet, GrantError, Kem, MacKey, MessageKey, OpenError, ReceiverSecret,
    ReplyKey, Revocation, SourceKey, Suite, TAG_BYTES, has_macs, opened_bytes, put_macs, seal_grant,
    sealed_bytes,
};
use sgc_wire::{
    Decode, Encode, GrantContent, MESSAGE_HEAD_BYTES, MessageHead, MessageKind, Name, NodeId, PacketHeader,
    Pseudonym, SecretBytes, SinkId, SourceAnnounce, SourceId, TopicGrant, UnixMillis,
};

const NAME: Name = Name([0xaa; 32]);
const SOURCE: SourceId = SourceId([0xbb; 16]);
const SINK: SinkId = SinkId([0xcc; 16]);

struct Vector {
    suite: Suite,
    /// The key as PKCS #8, and its announced form.
    key: Option<(Vec<u8>, Vec<u8>)>,
    headers: Vec<PacketHeader>,
    payloads: Vec<Vec<u8>>,
}

fn vectors() -> Vec<Vector> {
    let all: serde_json::Value =
        serde_json::from_str(include_str!("vectors/sealing.json")).expect("the file is JSON");
    let list = |v: &serde_json::Value| v.as_array().expect("a list").iter().map(hex).collect::<Vec<_>>();
    let vector = |v: &serde_json::Value| Vector {
        suite: v["suite"].as_str().expect("a name").parse().expect("a suite"),
        key: v["key"].as_str().map(|kind| {
            let key = &all["keys"][kind];
            (hex(&key["pkcs8"]), hex(&key["public"]))
        }),
        headers: list(&v["headers"]).iter().map(|h| PacketHeader::from_slice(h).expect("a header")).collect(),
        payloads: list(&v["payloads"]),
    };
    let vectors: Vec<_> = all["suites"].as_array().expect("a list").iter().map(vector).collect();
    assert_eq!(vectors.iter().map(|v| v.suite).collect::<Vec<_>>(), Suite::ALL);
    vectors
}

fn hex(text: &serde_json::Value) -> Vec<u8> {
    let digits = text.as_str().expect("text");
    let byte = |n| u8::from_str_radix(&digits[n..n + 2], 16).expect("hexadecimal digits");
    (0..digits.len()).step_by(2).map(byte).collect()
}

fn key(suite: Suite, header: &PacketHeader) -> SourceKey {
    let key = SecretBytes::new(std::array::from_fn(|i| i as u8));
    let grant =
        TopicGrant { epoch: 7, suite: suite.id(), key, receiver: None, sources: Vec::new(), entry: None };
    let key = match header.to {
        Some(sink) => SourceKey::derive_addressed(&grant, &NAME, &SOURCE, &sink),
        None => SourceKey::derive(&grant, &NAME, &SOURCE),
    };
    key.expect("all suites are in every build")
}

/// Returns the fragment and the message head of a vector.
fn plain(header: &PacketHeader) -> (Vec<u8>, MessageHead) {
    let start = usize::from(header.index) * usize::from(header.grid);
    let byte = |i: usize| ((i as u64 * 7 + header.seq) % 251) as u8;
    let fragment = (start..start + header.fragment_bytes()).map(byte).collect();
    let head = match header.to {
        Some(_) => MessageHead::new(MessageKind::Synced, 0),
        None => MessageHead::new(MessageKind::Write, 1_795_391_999_000_000_000),
    };
    (fragment, head)
}

/// Returns the packets of a vector as this build makes them.
fn payloads(vector: &Vector) -> Vec<Vec<u8>> {
    let (mut batch, mut out) = (Batch::default(), Vec::new());
    for header in &vector.headers {
        let (fragment, head) = plain(header);
        let mut sealed = vec![0; sealed_bytes(header)];
        key(vector.suite, header).seal(header, &head, &fragment, &mut sealed);
        batch.push(header, &sealed);
        out.push(sealed);
    }
    if let Some((pkcs8, public)) = &vector.key {
        let key = MessageKey::from_pkcs8(vector.suite, pkcs8).expect("a key of the suite");
        assert_eq!(key.public(), public);
        let signed = batch.sign(&key);
        out.iter_mut().enumerate().for_each(|(n, payload)| signed.put_trailer(vector.suite, n, payload));
    }
    out
}

#[test]
fn sealed_packets_match_the_vectors() {
    for vector in vectors() {
        assert!(vector.headers.last().is_some_and(|h| h.to == Some(SINK)));
        let random = matches!(vector.suite.name().split('-').next(), Some("paper"));
        for ((header, ours), theirs) in vector.headers.iter().zip(payloads(&vector)).zip(&vector.payloads) {
            // RSASSA-PSS is random: everything but the signature is compared, whose length is that of the modulus.
            let signature = if !random {
                0
            } else if vector.suite.name().contains("3072") {
                384
            } else {
                256
            };
            let fixed = ours.len() - signature;
            assert_eq!(ours.len(), theirs.len(), "{}", vector.suite);
            assert_eq!(ours[..fixed], theirs[..fixed], "{}, packet {}", vector.suite, header.seq);
        }
    }
}

#[test]
fn the_vectors_open_and_verify() {
    for vector in vectors() {
        let mut verifier = vector
            .key
            .as_ref()
            .map(|(_, public)| BatchVerifier::new(vector.suite, public).expect("a key of the suite"));
        for (header, payload) in vector.headers.iter().zip(&vector.payloads) {
            let mut out = vec![0; opened_bytes(header)];
            assert_eq!(key(vector.suite, header).open(header, payload, &mut out), Ok(()));
            let (fragment, head) = plain(header);
            assert_eq!(out[..fragment.len()], fragment);
            if header.index == 0 {
                assert_eq!(MessageHead::from_slice(&out[fragment.len()..]), Ok(head));
            }
            let Some(verifier) = &mut verifier else { continue };
            assert_eq!(verifier.verify(header, payload), Ok(()));
            let other = PacketHeader { seq: header.seq + 1, ..header.clone() };
            assert_eq!(verifier.verify(&other, payload), Err(OpenError::Signature));
            let mut altered = payload.clone();
            altered[header.fragment_bytes() + MESSAGE_HEAD_BYTES + TAG_BYTES - 20] ^= 1;
            assert!(verifier.verify(header, &altered).is_err());
        }
    }
}

/// Not a test: prints the input of `scripts/trust-vectors.py --take`, so that the other implementation verifies these
/// signatures.
#[test]
#[ignore = "prints"]
fn packets_signed_with_rsa() {
    for vector in vectors().iter().filter(|v| v.suite.name().starts_with("paper")) {
        let hex = |p: &Vec<u8>| p.iter().map(|b| format!("{b:02x}")).collect::<String>();
        let payloads: Vec<_> = payloads(vector).iter().map(hex).collect();
        println!("\nvector {} {}", vector.suite, payloads.join(" "));
    }
}

#[test]
fn macs_of_the_vectors_are_made_and_checked() {
    let all: serde_json::Value =
        serde_json::from_str(include_str!("vectors/macs.json")).expect("the file is JSON");
    let list = |v: &serde_json::Value| v.as_array().expect("a list").iter().map(hex).collect::<Vec<_>>();
    let secret = hex(&all["secret"]).try_into().expect("32 bytes");
    let secret = ReceiverSecret::new(SecretBytes::new(secret));
    let nodes = list(&all["nodes"]).into_iter().map(|node| NodeId(node.try_into().expect("32 bytes")));
    let keys: Vec<_> = nodes.map(|node| secret.derive_key(&NAME, &node)).collect();
    assert_eq!(keys.iter().map(Encode::to_vec).collect::<Vec<_>>(), list(&all["keys"]));
    let stranger = secret.derive_key(&NAME, &NodeId([9; 32]));
    for vector in all["suites"].as_array().expect("a list") {
        let suite: Suite = vector["suite"].as_str().expect("a name").parse().expect("a suite");
        for (header, theirs) in list(&vector["headers"]).iter().zip(list(&vector["payloads"])) {
            let header = PacketHeader::from_slice(header).expect("a header");
            let (fragment, head) = plain(&header);
            let mut ours = vec![0; sealed_bytes(&header)];
            key(suite, &header).seal(&header, &head, &fragment, &mut ours);
            let topic_key = SecretBytes::new(std::array::from_fn(|i| i as u8));
            let (epoch, suite_id) = (header.epoch, suite.id());
            let grant = TopicGrant {
                epoch,
                suite: suite_id,
                key: topic_key,
                receiver: None,
                sources: Vec::new(),
                entry: None,
            };
            let mac_key = |receiver| {
                MacKey::derive(receiver, &grant, &NAME, &SOURCE, header.to.as_ref())
                    .expect("a suite of this build")
            };
            let mac_keys: Vec<_> = keys.iter().map(mac_key).collect();
            put_macs(&header, &mut ours, &mac_keys);
            assert_eq!(ours, theirs, "{suite}, packet {}", header.seq);
            assert_eq!(has_macs(&header, &theirs), Ok(true));
            assert!(mac_keys.iter().all(|key| key.check(&header, &theirs) == Ok(())));
            assert_eq!(mac_key(&stranger).check(&header, &theirs), Err(OpenError::NoMac));
        }
    }
    let topic_key = SecretBytes::new(std::array::from_fn(|i| i as u8));
    let receiver = Some(keys[0].clone());
    let content = GrantContent::Topic(TopicGrant {
        epoch: 7,
        suite: Suite::Pairwise.id(),
        key: topic_key,
        receiver,
        sources: Vec::new(),
        entry: None,
    });
    assert_eq!(content.to_vec(), hex(&all["content"]));
    assert_eq!(GrantContent::from_slice(&content.to_vec()), Ok(content));
}

#[test]
fn the_grants_of_the_vectors_open() {
    let all: serde_json::Value =
        serde_json::from_str(include_str!("vectors/grants.json")).expect("the file is JSON");
    let serial = all["serial"].as_u64().expect("a number");
    let content = GrantContent::Topic(TopicGrant {
        epoch: 7,
        suite: 3,
        key: SecretBytes::new(std::array::from_fn(|i| i as u8)),
        receiver: None,
        sources: vec![SourceAnnounce {
            source: SOURCE,
            key: vec![0xdd; 32].into(),
            oldest: 5,
            next: 9,
            recover: 3,
        }],
        entry: None,
    });
    assert_eq!(content.to_vec(), hex(&all["content"]));
    for (vector, kem) in all["grants"].as_array().expect("a list").iter().zip([Kem::X25519, Kem::XWing]) {
        let [private, public, enc, sealed] = ["private", "public", "enc", "sealed"].map(|f| hex(&vector[f]));
        let key = ReplyKey::from_private(kem, &private).expect("a key of that kind");
        assert_eq!(key.public()[..], public, "{kem:?}");
        assert_eq!(key.open(&NAME, &SINK, serial, &enc, &sealed), Ok(content.clone()), "{kem:?}");
        assert_eq!(key.open(&NAME, &SINK, serial + 1, &enc, &sealed), Err(GrantError::NotForUs));
        assert_eq!(key.open(&NAME, &SinkId([0; 16]), serial, &enc, &sealed), Err(GrantError::NotForUs));
        // The key opens this side's grants too, and a shorter key is invalid.
        let (enc, sealed) = seal_grant(&public, &NAME, &SINK, 1, &content).expect("a key of that kind");
        assert_eq!(key.open(&NAME, &SINK, 1, &enc, &sealed), Ok(content.clone()));
        assert!(ReplyKey::from_private(kem, &private[1..]).is_none());
    }
}

#[test]
fn the_revocation_list_of_the_vectors_is_made_and_read() {
    let all: serde_json::Value =
        serde_json::from_str(include_str!("vectors/revocation.json")).expect("the file is JSON");
    let millis = |v: &serde_json::Value| UnixMillis(v.as_u64().expect("a number") * 1000);
    let nodes = all["nodes"].as_array().expect("a list").iter().map(|node| {
        let pseudonym = hex(&node["pseudonym"]).try_into().expect("32 bytes");
        let incarnation = node["incarnation"].as_u64().and_then(|n| n.try_into().ok()).expect("32 bits");
        (Pseudonym(pseudonym), Revocation { incarnation, at: millis(&node["revoked_secs"]) })
    });
    let nodes: Vec<_> = nodes.collect();
    let (now, ca) = (millis(&all["now_secs"]), CertificateDer::from(hex(&all["ca"])));
    let rng = &mut ChaCha20Rng::seed_from_u64(1);
    let fleet = Fleet::import("acme".parse().expect("a name"), ca, &hex(&all["ca_key"]), now, rng);
    let fleet = fleet.expect("a CA and its key");
    let number = all["number"].as_u64().expect("a number");
    let list = fleet.revocation_list_of_nodes(&nodes, number, now).expect("a list");
    assert_eq!(list, hex(&all["list"]));
    let anchors = fleet.anchors().with_crl(&list, now).expect("a list of that CA").expect("news");
    let ca = anchors.fingerprints().next().expect("a CA");
    assert_eq!(anchors.revoked_nodes(&ca).collect::<Vec<_>>(), nodes);
    assert_eq!(anchors.fleet_list_number(&ca), Some(number));

    let leaf = [CertificateDer::from(hex(&all["leaf"]))];
    let peer = anchors.verify(&leaf, now).expect("its incarnation before is revoked, not this one");
    assert_eq!(Some(u64::from(peer.incarnation)), all["incarnation"].as_u64());
    let revocation = Revocation { incarnation: peer.incarnation, at: now };
    let list = fleet.revocation_list_of_nodes(&[(peer.pseudonym, revocation)], number + 1, now);
    let anchors = anchors.with_crl(&list.expect("a list"), now).expect("a list").expect("news");
    assert!(matches!(anchors.verify(&leaf, now), Err(CertError::Revoked { at }) if at == now));
}
