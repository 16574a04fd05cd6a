//! The bytes of an access token, as `docs/spec/gateway.md` specifies them and `scripts/access-vectors.py` checks
//! them.
//!
//! The vector was made by `cargo test -p sgc-gateway --test access_token -- --ignored --nocapture | grep '^{' >
//! crates/sgc-gateway/tests/vectors/access.json`.

#![allow(clippy::unwrap_used)]

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use rand_chacha::ChaCha20Rng;
use rand_chacha::rand_core::SeedableRng as _;
use rustls_pki_types::CertificateDer;
use serde_json::{Value, json};
use sgc_gateway::{AccessGrant, AccessToken, Right, Scope, TokenId};
use sgc_trust::{EnrollRequest, Fleet, TrustAnchors};
use sgc_wire::{NodeId, UnixMillis};

const ISSUED: UnixMillis = UnixMillis(1_795_000_000_000);

fn grant(gateway: NodeId) -> AccessGrant {
    let patterns = |of: &[&str]| of.iter().map(|one| (*one).to_owned()).collect();
    AccessGrant {
        id: TokenId(std::array::from_fn(|n| n as u8)),
        gateway,
        label: "Leitstand \u{e4}".into(),
        scope: Scope {
            subscribe: patterns(&["/odom", "/camera/**"]),
            publish: patterns(&["/cmd_vel"]),
            call: patterns(&["/arm/*/plan", "/navigate"]),
            serve: Vec::new(),
        },
        issued: ISSUED,
        expires: UnixMillis(ISSUED.0 + 43_200_000),
    }
}

#[test]
fn golden_vector() {
    let vector: Value = serde_json::from_str(include_str!("vectors/access.json")).unwrap();
    let der = |value: &Value| CertificateDer::from(STANDARD.decode(value.as_str().unwrap()).unwrap());
    let anchors = TrustAnchors::new([der(&vector["ca"])]).unwrap();
    let chain: Vec<_> = vector["chain"].as_array().unwrap().iter().map(der).collect();
    let gateway = anchors.verify(&chain, ISSUED).unwrap();
    let text = vector["token"].as_str().unwrap();
    let token = AccessToken::parse(text).unwrap();
    assert_eq!(token.verify(&gateway), Ok(&grant(gateway.node_id)));
    assert_eq!(token.to_text().as_str(), text);
}

#[test]
#[ignore = "makes the vector anew"]
fn make_the_vector() {
    let rng = &mut ChaCha20Rng::seed_from_u64(1);
    let mut fleet = Fleet::create("vectors".parse().unwrap(), ISSUED, rng).unwrap();
    let identity = fleet.enroll(&EnrollRequest::new("arm-1".parse().unwrap(), ISSUED), rng).unwrap();
    let grant = grant(identity.node_id());
    let token = grant.clone().sign(&identity).unwrap();
    let chain: Vec<_> = identity.chain().iter().map(|one| STANDARD.encode(one)).collect();
    let vector = json!({
        "ca": STANDARD.encode(fleet.ca_certificate()),
        "chain": chain,
        "id": grant.id.to_string(),
        "gateway": grant.gateway.to_string(),
        "label": grant.label,
        "scope": Right::ALL.map(|right| grant.scope.patterns(right).to_vec()),
        "issued": grant.issued.0,
        "expires": grant.expires.0,
        "token": token.to_text().as_str(),
    });
    println!("\n{vector}");
}
