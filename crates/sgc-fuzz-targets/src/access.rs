//! Access tokens, origins of pages and names: no input panics, parsed values are written back unchanged, and no altered
//! token is valid.
use std::sync::OnceLock;

use rand_chacha::ChaCha20Rng;
use rand_core::SeedableRng;
use sgc_gateway::{
    ACCESS_TOKEN_PREFIX, Access, AccessGrant, AccessRules, AccessToken, AdmissionRequest, PageOrigin, Right,
    Scope, TokenId,
};
use sgc_trust::{EnrollRequest, Fleet, Identity};
use sgc_wire::UnixMillis;

const NOW: UnixMillis = UnixMillis(1_795_000_000_000);

struct Cast {
    gateway: Identity,
    token: String,
}

fn cast() -> &'static Cast {
    static CAST: OnceLock<Cast> = OnceLock::new();
    CAST.get_or_init(|| {
        let rng = &mut ChaCha20Rng::seed_from_u64(1);
        let mut fleet = Fleet::create("acme".parse().unwrap(), NOW, rng).unwrap();
        let gateway = fleet.enroll(&EnrollRequest::new("arm-1".parse().unwrap(), NOW), rng).unwrap();
        let grant = AccessGrant {
            id: TokenId([7; 16]),
            gateway: gateway.node_id(),
            label: "desk".into(),
            scope: Scope { subscribe: vec!["/odom".into(), "/camera/**".into()], ..Scope::default() },
            issued: NOW,
            expires: UnixMillis(NOW.0 + 1000),
        };
        let token = grant.sign(&gateway).unwrap().to_text().to_string();
        Cast { gateway, token }
    })
}

/// Runs one input of the target.
pub fn run(input: &[u8]) {
    let [which, input @ ..] = input else { return };
    let (cast, text) = (cast(), String::from_utf8_lossy(input));
    match which % 4 {
        0 => {
            let text = format!("{ACCESS_TOKEN_PREFIX}{text}");
            if let Ok(token) = AccessToken::parse(&text) {
                assert_eq!(token.to_text().as_str(), text.trim());
                assert!(token.verify(cast.gateway.as_peer()).is_err() || text.trim() == cast.token);
            }
        }
        1 => {
            // Altered within its alphabet, and cut.
            const ALPHABET: &[u8] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-_";
            let mut bytes = cast.token.clone().into_bytes();
            for edit in input.chunks_exact(3) {
                let at = usize::from(u16::from_be_bytes([edit[0], edit[1]])) % bytes.len().max(1);
                match (edit[2], bytes.get_mut(at)) {
                    (0, _) => bytes.truncate(at),
                    (to, Some(byte)) => *byte = ALPHABET[usize::from(to) % 64],
                    _ => {}
                }
            }
            let altered = String::from_utf8(bytes).unwrap();
            let gateway = Some(cast.gateway.as_peer().clone());
            let access = Access::new(AccessRules { gateway, ..AccessRules::default() });
            let peer = "127.0.0.1:1".parse().unwrap();
            let token = Some(altered.as_str());
            let admission =
                AdmissionRequest { peer, encrypted: true, origin: None, token, certificate: None, now: NOW };
            assert_eq!(access.admit(&admission).is_ok(), altered == cast.token);
        }
        2 => {
            if let Ok(origin) = text.parse::<PageOrigin>() {
                assert_eq!(origin.to_string().parse(), Ok(origin.clone()));
            }
        }
        _ => {
            let (pattern, name) = text.split_once(' ').unwrap_or((&text, "/a/b"));
            let scope = Scope { call: vec![pattern.to_owned()], ..Scope::default() };
            let permits = scope.permits(Right::Call, name);
            assert!(!scope.permits(Right::Serve, name));
            assert!(!permits || Scope::everything().permits(Right::Call, name));
        }
    }
}
