//! Share tokens: the bytes of the specification, and the errors of texts that are no token.

#![allow(clippy::unwrap_used)]

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use rand_chacha::ChaCha20Rng;
use rand_core::{RngCore as _, SeedableRng as _};
use rustls_pki_types::CertificateDer;
use sgc_trust::{ShareToken, TOKEN_PREFIX, TOKEN_TEXT_BYTES_MAX, TokenError, TopicSecret};
use sgc_wire::{Kind, METADATA_FIELD_BYTES_MAX, Metadata, NodeId, UnixMillis};

/// `openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -days 36500 …`, DER.
fn ca() -> CertificateDer<'static> {
    let base64 = concat!(
        "MIIBfzCCASWgAwIBAgIUI28IXvyZ7Gj2zMB3KCGFm5tjGvEwCgYIKoZIzj0EAwIwDDEKMAgGA1UEAwwBdjAgFw0yNj",
        "ExMjExNTA4MDJaGA8yMTI2MTAyODE1MDgwMlowDDEKMAgGA1UEAwwBdjBZMBMGByqGSM49AgEGCCqGSM49AwEHA0IA",
        "BHyMue33KfolwjYak54PA5JUnpz0lLOM3LBdhx5b8W2KeR7N3B0W2RBRL3Hthbdjx4H8Zyw8QuhvIAON6trqQfGjYz",
        "BhMB0GA1UdDgQWBBSZ/J0SKxg30CLP/9a99SAj6z+/RjAfBgNVHSMEGDAWgBSZ/J0SKxg30CLP/9a99SAj6z+/RjAP",
        "BgNVHRMBAf8EBTADAQH/MA4GA1UdDwEB/wQEAwICBDAKBggqhkjOPQQDAgNIADBFAiB66uLPBO+Muy/x07lck4JHO/",
        "NV8yJgloy4Hc4owYIyIgIhAMREfJaNdITzjq9bkR5nzPdhYceuL7MCLyDUdUH0Z3UA",
    );
    CertificateDer::from(STANDARD.decode(base64).unwrap())
}

fn token() -> ShareToken {
    ShareToken {
        owner: NodeId([0x22; 32]),
        owner_name: "arm-1".parse().unwrap(),
        ca: ca(),
        metadata: Metadata::topic("arm-1", "/handoff/pose", "geometry_msgs/msg/PoseStamped"),
        secret: TopicSecret::from_bytes([0x33; 32]),
        routers: vec!["quic://router.lab.example:7447".into(), "quic://10.0.0.1:7447".into()],
        expires: UnixMillis(1_800_000_000_000),
    }
}

/// Computed with Python's library: `scripts/token-vector.py` prints these, given the CA above in base64.
#[test]
fn golden_vector() {
    let text = concat!(
        "sgc-token-1:ASIiIiIiIiIiIiIiIiIiIiIiIiIiIiIiIiIiIiIiIiIiAAAABWFybS0xAAABgzCCAX8wggEloAMCAQ",
        "ICFCNvCF78mexo9szAdyghhZubYxrxMAoGCCqGSM49BAMCMAwxCjAIBgNVBAMMAXYwIBcNMjYxMTIxMTUwODAyWhgP",
        "MjEyNjEwMjgxNTA4MDJaMAwxCjAIBgNVBAMMAXYwWTATBgcqhkjOPQIBBggqhkjOPQMBBwNCAAR8jLnt9yn6JcI2Gp",
        "OeDwOSVJ6c9JSzjNywXYceW_FtinkezdwdFtkQUS9x7YW3Y8eB_GcsPELobyADjera6kHxo2MwYTAdBgNVHQ4EFgQU",
        "mfydEisYN9Aiz__WvfUgI-s_v0YwHwYDVR0jBBgwFoAUmfydEisYN9Aiz__WvfUgI-s_v0YwDwYDVR0TAQH_BAUwAw",
        "EB_zAOBgNVHQ8BAf8EBAMCAgQwCgYIKoZIzj0EAwIDSAAwRQIgeurizwTvjLsv8dO5XJOCRzvzVfMiYJaMuB3OKMGC",
        "MiICIQDERHyWjXSE846vW5EeZ8z3YWHHri-zAi8g1HVB9Gd1AAEBAAAABWFybS0xAAAADS9oYW5kb2ZmL3Bvc2UAAA",
        "AdZ2VvbWV0cnlfbXNncy9tc2cvUG9zZVN0YW1wZWQAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAzMzMzMzMzMzMzMzMz",
        "MzMzMzMzMzMzMzMzMzMzMzMzMwAAAAIAAAAecXVpYzovL3JvdXRlci5sYWIuZXhhbXBsZTo3NDQ3AAAAFHF1aWM6Ly",
        "8xMC4wLjAuMTo3NDQ3AAABoxhcUADW006f",
    );
    assert_eq!(token().to_text().as_str(), text);
    assert_eq!(ShareToken::parse(text), Ok(token()));
    assert_eq!(
        token().name().to_string(),
        "8e66434525d513ef91b457ce84313cc8c0d70d24cfc1657effd7024f67ab5781"
    );
}

#[test]
fn a_token_at_its_bounds_round_trips() {
    let long = || "x".repeat(METADATA_FIELD_BYTES_MAX);
    let base = token();
    let full = ShareToken {
        owner_name: "a".repeat(64).parse().unwrap(),
        metadata: Metadata {
            kind: Kind::Topic,
            owner: "a".repeat(64),
            ros_name: long(),
            type_name: long(),
            node: long(),
            author: long(),
            maintainer: long(),
            interface: long(),
            description: long(),
            unique: long(),
        },
        routers: vec!["r".repeat(300); 16],
        ..base.clone()
    };
    let text = full.to_text();
    // A CA certificate may have up to 4096 bytes.
    assert!(text.len() + (4096 - ca().len()) * 4 / 3 < TOKEN_TEXT_BYTES_MAX, "{}", text.len());
    assert_eq!(ShareToken::parse(&format!("  {}\n", text.as_str())), Ok(full));
    let none = ShareToken { routers: vec![], expires: UnixMillis(u64::MAX), ..base };
    assert_eq!(ShareToken::parse(&none.to_text()), Ok(none));
}

#[test]
fn whatever_is_changed_or_cut_is_refused() {
    let text = token().to_text();
    for end in 0..text.len() {
        assert!(ShareToken::parse(&text[..end]).is_err(), "cut at {end}");
    }
    let mut rng = ChaCha20Rng::seed_from_u64(7);
    for round in 0..4000 {
        let mut bytes = text.as_bytes().to_vec();
        for _ in 0..=rng.next_u32() % 3 {
            let at = rng.next_u32() as usize % bytes.len();
            match rng.next_u32() % 3 {
                0 => bytes[at] = b' ' + (rng.next_u32() % 95) as u8,
                1 => drop(bytes.remove(at)),
                _ => bytes.insert(at, b"AZaz09-_"[rng.next_u32() as usize % 8]),
            }
        }
        let mutated = String::from_utf8(bytes).unwrap();
        if mutated.trim() != text.as_str() {
            assert!(ShareToken::parse(&mutated).is_err(), "round {round}: {mutated}");
        }
    }
}

/// A checksum is no defence, so each field is checked by itself, too.
#[test]
fn fields_that_cannot_be_are_refused_by_name() {
    let said = |change: fn(&mut ShareToken)| {
        let mut token = token();
        change(&mut token);
        let error = ShareToken::parse(&token.to_text()).unwrap_err();
        assert_eq!(token.check().is_err(), !matches!(error, TokenError::Malformed(_)), "{error}");
        error
    };
    assert_eq!(said(|t| t.metadata.owner = "arm-2".into()), TokenError::Owner);
    assert_eq!(said(|t| t.metadata.type_name.clear()), TokenError::Interface);
    assert_eq!(said(|t| t.metadata.kind = Kind::Catalogue), TokenError::Interface);
    assert!(matches!(said(|t| t.ca = CertificateDer::from(vec![0x30, 0])), TokenError::Ca(_)));
    let crowd = ShareToken { routers: vec!["r".into(); 17], ..token() };
    assert_eq!(crowd.check(), Err(TokenError::Routers));
    assert!(matches!(ShareToken::parse(&crowd.to_text()), Err(TokenError::Malformed(_))));
    for (text, error) in [
        ("", TokenError::Prefix),
        ("-----BEGIN", TokenError::Prefix),
        ("sgc-token-2:AAAA", TokenError::Version),
        ("sgc-token-1:", TokenError::Checksum),
        ("sgc-token-1:AA=A", TokenError::NotBase64),
        ("sgc-token-1:AAAAAAAA", TokenError::Checksum),
    ] {
        assert_eq!(ShareToken::parse(text), Err(error), "{text}");
    }
    let long = format!("{TOKEN_PREFIX}{}", "A".repeat(TOKEN_TEXT_BYTES_MAX));
    assert!(matches!(ShareToken::parse(&long), Err(TokenError::TooLong { .. })));
}

#[test]
fn nothing_secret_is_shown() {
    let token = token();
    let shown = format!("{token:?} {token:#?} {:?}", token.secret);
    assert!(shown.contains("/handoff/pose"), "{shown}");
    for secret in ["51, 51", "33333333", "MzMz", "0x33"] {
        assert!(!shown.contains(secret), "{shown}");
    }
    let other = ShareToken { secret: TopicSecret::from_bytes([0x34; 32]), ..token.clone() };
    assert!(token != other && token.name() != other.name());
}
