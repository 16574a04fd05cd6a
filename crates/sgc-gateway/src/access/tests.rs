use std::net::SocketAddr;

use rand_chacha::ChaCha20Rng;
use rand_chacha::rand_core::SeedableRng as _;
use sgc_trust::{EnrollRequest, Fleet, Identity};

use super::*;

const NOW: UnixMillis = UnixMillis(1_795_000_000_000);
const HOUR: u64 = 3_600_000;

struct Cast {
    rng: ChaCha20Rng,
    fleet: Fleet,
    gateway: Identity,
    desk: Identity,
}

fn cast() -> Cast {
    let mut rng = ChaCha20Rng::seed_from_u64(8);
    let mut fleet = Fleet::create("lab".parse().unwrap(), NOW, &mut rng).unwrap();
    let gateway = fleet.enroll(&EnrollRequest::new("arm-1".parse().unwrap(), NOW), &mut rng).unwrap();
    let desk = fleet.enroll(&EnrollRequest::new("desk".parse().unwrap(), NOW), &mut rng).unwrap();
    Cast { rng, fleet, gateway, desk }
}

fn later(ms: u64) -> UnixMillis {
    UnixMillis(NOW.0 + ms)
}

fn subscribe(pattern: &str) -> Scope {
    Scope { subscribe: vec![pattern.to_owned()], ..Scope::default() }
}

impl Cast {
    fn rules(&self) -> AccessRules {
        let gateway = Some(self.gateway.as_peer().clone());
        AccessRules { gateway, anchors: Some(self.gateway.anchors().clone()), ..AccessRules::default() }
    }

    /// Returns rules under which the desk may receive `pattern`.
    fn listing_desk(&self, pattern: &str) -> AccessRules {
        let who = Grantees { nodes: [self.desk.node_id()].into(), ..Grantees::default() };
        let clients = vec![ClientRule { who, scope: subscribe(pattern) }];
        let names = [(self.desk.node_id(), "desk".to_owned())].into();
        AccessRules { clients, names, ..self.rules() }
    }

    fn grant(&self) -> AccessGrant {
        AccessGrant {
            id: TokenId([7; 16]),
            gateway: self.gateway.node_id(),
            label: "dashboard".into(),
            scope: subscribe("/odom"),
            issued: NOW,
            expires: later(HOUR),
        }
    }

    fn token(&self) -> AccessToken {
        self.grant().sign(&self.gateway).unwrap()
    }
}

/// A TLS connection from `peer`.
fn from(peer: &str) -> AdmissionRequest<'static> {
    let peer: SocketAddr = peer.parse().unwrap();
    AdmissionRequest { peer, encrypted: true, origin: None, token: None, certificate: None, now: NOW }
}

const HERE: &str = "127.0.0.1:50000";
const ELSEWHERE: &str = "10.0.0.9:50000";

#[test]
fn programs_of_this_host_may_do_everything_and_others_nothing() {
    let access = Access::default();
    for peer in [HERE, "[::1]:1", "[::ffff:127.0.0.1]:1", "127.9.9.9:1"] {
        let client = access.admit(&from(peer)).unwrap();
        assert_eq!((client.how, client.expires, client.token), (AdmittedBy::Anonymous, None, None));
        assert!(client.may(Right::Serve, "/anything"));
    }
    for peer in [ELSEWHERE, "[::ffff:10.0.0.9]:1", "[fe80::1]:1", "0.0.0.0:1"] {
        let refused = access.admit(&from(peer)).unwrap_err();
        assert!(matches!(refused, Denial::NoCredentials { .. }), "{peer}: {refused}");
    }
}

#[test]
fn user_decides_who_is_admitted_without_proof() {
    let access = |anonymous| Access::new(AccessRules { anonymous, ..AccessRules::default() });
    for peer in [HERE, ELSEWHERE] {
        assert!(access(Anonymous::All).admit(&from(peer)).is_ok());
        assert!(access(Anonymous::None).admit(&from(peer)).is_err());
    }
}

#[test]
fn pages_of_elsewhere_are_kept_out_unless_they_are_listed() {
    let origins = vec!["https://app.example.org".parse().unwrap()];
    let some = Access::new(AccessRules { origins, ..AccessRules::default() });
    let all = Access::new(AccessRules { anonymous: Anonymous::All, ..AccessRules::default() });
    let admits =
        |access: &Access, origin| access.admit(&AdmissionRequest { origin: Some(origin), ..from(HERE) });
    for origin in ["http://localhost:3000", "http://127.0.0.1", "https://[::1]:8443"] {
        assert!(admits(&some, origin).is_ok(), "{origin}");
        assert!(admits(&all, origin).is_ok(), "{origin}");
    }
    for origin in ["https://evil.example", "null", "file://", "", "http://localhost.evil.example"] {
        let refused = Denial::Origin { origin: origin.to_owned() };
        assert_eq!(admits(&some, origin).unwrap_err(), refused);
        assert_eq!(admits(&all, origin).unwrap_err(), refused);
    }
    assert!(admits(&some, "https://app.example.org").is_ok());
    assert!(admits(&all, "https://app.example.org").is_err());
}

#[test]
fn a_page_of_another_hosts_localhost_is_no_page_of_this_host() {
    let cast = cast();
    let origins = vec!["http://localhost:5173".parse().unwrap()];
    let all = AccessRules { anonymous: Anonymous::All, ..cast.listing_desk("/odom") };
    let listed = Access::new(AccessRules { origins, ..all.clone() });
    let all = Access::new(all);
    for certificate in [None, Some(cast.desk.as_peer())] {
        for origin in ["http://localhost", "http://127.0.0.1:3000", "https://[::1]", "http://localhost:5173"]
        {
            let page = |peer| AdmissionRequest { origin: Some(origin), certificate, ..from(peer) };
            let refused = Denial::Origin { origin: origin.to_owned() };
            for peer in [ELSEWHERE, "[2001:db8::7]:1", "[::ffff:10.0.0.9]:1"] {
                assert_eq!(all.admit(&page(peer)).unwrap_err(), refused, "{origin} of {peer}");
            }
            for peer in [HERE, "[::1]:1", "[::ffff:127.0.0.1]:1"] {
                let client = all.admit(&page(peer)).unwrap();
                assert_eq!(all.still_admits(&client, NOW), Ok(()), "{origin} of {peer}");
            }
        }
        // Such an entry admits pages that a visitor's own host serves.
        let page = AdmissionRequest { origin: Some("http://localhost:5173"), certificate, ..from(ELSEWHERE) };
        assert!(listed.admit(&page).is_ok());
    }
}

#[test]
fn a_token_gives_its_scope_and_no_more() {
    let cast = cast();
    let access = Access::new(cast.rules());
    let text = cast.token().to_text();
    for peer in [HERE, ELSEWHERE] {
        // A token admits any page, because only its holder knows it.
        let admission =
            AdmissionRequest { token: Some(&text), origin: Some("https://any.example"), ..from(peer) };
        let client = access.admit(&admission).unwrap();
        assert_eq!((&*client.name, client.expires), ("dashboard", Some(later(HOUR))));
        assert_eq!(client.token, Some(TokenId([7; 16])));
        assert!(client.may(Right::Subscribe, "/odom"));
        assert!(!client.may(Right::Publish, "/odom"));
        assert!(!client.may(Right::Subscribe, "/camera"));
    }
}

#[test]
fn a_token_is_not_taken_where_others_can_read_it() {
    let cast = cast();
    let text = cast.token().to_text();
    let plain = AdmissionRequest { token: Some(&text), encrypted: false, ..from(ELSEWHERE) };
    let access = Access::new(cast.rules());
    assert_eq!(access.admit(&plain).unwrap_err(), Denial::PlainToken);
    let here = AdmissionRequest { peer: from(HERE).peer, ..plain };
    assert!(access.admit(&here).is_ok());
    let careless = Access::new(AccessRules { plain: true, ..cast.rules() });
    let client = careless.admit(&plain).unwrap();
    assert_eq!(careless.still_admits(&client, NOW), Ok(()));
    assert_eq!(access.still_admits(&client, NOW), Err(Denial::PlainToken));
}

#[test]
fn a_token_that_does_not_hold_admits_nobody_not_even_of_this_host() {
    let mut cast = cast();
    let access = Access::new(cast.rules());
    let admit = |text: &str| access.admit(&AdmissionRequest { token: Some(text), ..from(HERE) }).unwrap_err();
    let elsewhere = AccessGrant { gateway: cast.desk.node_id(), ..cast.grant() };
    let other = elsewhere.clone().sign(&cast.desk).unwrap();
    let gateway = cast.desk.node_id();
    assert_eq!(admit(&other.to_text()), Denial::Token(AccessTokenError::Elsewhere { gateway }));
    assert_eq!(
        elsewhere.sign(&cast.gateway).unwrap_err(),
        AccessTokenError::Elsewhere { gateway: cast.desk.node_id() }
    );
    // The same node has a new key, so its former tokens are invalid.
    let renewed =
        cast.fleet.issue(&EnrollRequest::new("arm-1".parse().unwrap(), NOW), &mut cast.rng).unwrap();
    assert_eq!(renewed.node_id(), cast.gateway.node_id());
    let forged = cast.grant().sign(&renewed).unwrap();
    assert_eq!(admit(&forged.to_text()), Denial::Token(AccessTokenError::Signature));
    for (text, fault) in [
        ("", AccessTokenError::Prefix),
        ("sgc-token-1:AAAA", AccessTokenError::Prefix),
        ("sgc-access-2:AAAA", AccessTokenError::Version),
        ("sgc-access-1:!", AccessTokenError::NotBase64),
        (&*"x".repeat(9000), AccessTokenError::TooLong { bytes: 9000 }),
    ] {
        assert_eq!(admit(text), Denial::Token(fault));
    }
    assert_eq!(
        Access::default()
            .admit(&AdmissionRequest { token: Some(&cast.token().to_text()), ..from(HERE) })
            .unwrap_err(),
        Denial::NoTokens
    );
}

#[test]
fn altered_tokens_are_refused() {
    let cast = cast();
    let access = Access::new(cast.rules());
    let text = cast.token().to_text();
    let alphabet = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-_";
    for at in ACCESS_TOKEN_PREFIX.len()..text.len() {
        let mut bytes = text.as_bytes().to_vec();
        let value = alphabet.iter().position(|c| *c == bytes[at]).unwrap();
        bytes[at] = alphabet[(value + 32) % 64];
        let altered = String::from_utf8(bytes).unwrap();
        let refused = access.admit(&AdmissionRequest { token: Some(&altered), ..from(HERE) });
        assert!(refused.is_err(), "character {at}");
        let cut = access.admit(&AdmissionRequest { token: Some(&text[..at]), ..from(HERE) });
        assert!(cut.is_err(), "cut at {at}");
    }
    let spaced = format!("  {}\n", text.as_str());
    assert!(access.admit(&AdmissionRequest { token: Some(&spaced), ..from(HERE) }).is_ok());
}

#[test]
fn a_token_ends_with_its_time_and_when_it_is_revoked() {
    let cast = cast();
    let text = cast.token().to_text();
    let id = TokenId([7; 16]);
    let access = Access::new(cast.rules());
    let at = |now| access.admit(&AdmissionRequest { token: Some(&text), now, ..from(ELSEWHERE) });
    let client = at(later(HOUR)).unwrap();
    let ended = Denial::TokenExpired { id, expires: later(HOUR) };
    assert_eq!(at(later(HOUR + 1)).unwrap_err(), ended);
    assert_eq!(access.still_admits(&client, later(HOUR)), Ok(()));
    assert_eq!(access.still_admits(&client, later(HOUR + 1)), Err(ended));
    let revoked = Access::new(AccessRules { revoked: [id].into(), ..cast.rules() }).after(&access);
    assert_eq!(revoked.still_admits(&client, NOW), Err(Denial::TokenRevoked { id }));
    let refused = revoked.admit(&AdmissionRequest { token: Some(&text), ..from(ELSEWHERE) });
    assert_eq!(refused.unwrap_err(), Denial::TokenRevoked { id });
}

#[test]
fn a_certificate_has_the_rights_of_all_rules_that_name_it() {
    let cast = cast();
    let mut rules = cast.listing_desk("/odom");
    let fleets = [cast.desk.as_peer().ca].into();
    let who = Grantees { fleets, ..Grantees::default() };
    rules.clients.push(ClientRule { who, scope: subscribe("/tf") });
    let access = Access::new(rules);
    let peer = cast.desk.as_peer();
    let client = access.admit(&AdmissionRequest { certificate: Some(peer), ..from(ELSEWHERE) }).unwrap();
    assert_eq!((&*client.name, client.expires), ("desk", Some(peer.not_after)));
    assert_eq!(client.how, AdmittedBy::Certificate(peer.node_id));
    assert_eq!(client.scope.to_string(), "subscribe /odom /tf");
    assert_eq!(access.still_admits(&client, NOW), Ok(()));
}

#[test]
fn a_certificate_that_permits_nothing_is_like_none() {
    let cast = cast();
    let access = Access::new(cast.rules());
    let certificate = Some(cast.desk.as_peer());
    let refused = access.admit(&AdmissionRequest { certificate, ..from(ELSEWHERE) }).unwrap_err();
    assert_eq!(refused, Denial::NotListed { node: cast.desk.node_id() });
    let client = access.admit(&AdmissionRequest { certificate, ..from(HERE) }).unwrap();
    assert_eq!(client.how, AdmittedBy::Anonymous);
}

#[test]
fn a_page_does_not_connect_by_its_browsers_certificate() {
    let cast = cast();
    let access = Access::new(cast.listing_desk("/odom"));
    let certificate = Some(cast.desk.as_peer());
    let page = AdmissionRequest { certificate, origin: Some("https://evil.example"), ..from(ELSEWHERE) };
    assert_eq!(access.admit(&page).unwrap_err(), Denial::Origin { origin: "https://evil.example".into() });
    assert!(access.admit(&AdmissionRequest { origin: Some("http://localhost"), ..page }).is_err());
    let here = AdmissionRequest { origin: Some("http://localhost"), peer: from(HERE).peer, ..page };
    assert!(access.admit(&here).is_ok());
}

#[test]
fn a_certificate_ends_with_its_time_its_rights_and_when_it_is_revoked() {
    let mut cast = cast();
    let access = Access::new(cast.listing_desk("/odom"));
    let peer = cast.desk.as_peer().clone();
    let admission = AdmissionRequest { certificate: Some(&peer), ..from(ELSEWHERE) };
    let client = access.admit(&admission).unwrap();
    let (node, expires) = (peer.node_id, peer.not_after);
    let over = UnixMillis(expires.0 + 1);
    assert_eq!(access.still_admits(&client, over), Err(Denial::CertificateExpired { node, expires }));
    let narrower = Access::new(cast.listing_desk("/odom2"));
    assert_eq!(narrower.still_admits(&client, NOW), Err(Denial::Changed));
    let none = Access::new(cast.rules());
    assert_eq!(none.still_admits(&client, NOW), Err(Denial::NotListed { node }));
    cast.fleet.revoke(&["desk".parse().unwrap()], NOW).unwrap();
    let crl = cast.fleet.revocation_list(NOW).unwrap();
    let anchors = cast.gateway.anchors().with_crl(&crl, NOW).unwrap().unwrap();
    let access = access.with_anchors(anchors);
    assert_eq!(access.still_admits(&client, NOW), Err(Denial::CertificateRevoked { node }));
    assert_eq!(access.admit(&admission).unwrap_err(), Denial::CertificateRevoked { node });
}

#[test]
fn a_token_beside_a_certificate_decides() {
    let cast = cast();
    let access = Access::new(cast.listing_desk("/**"));
    let text = cast.token().to_text();
    let both =
        AdmissionRequest { certificate: Some(cast.desk.as_peer()), token: Some(&text), ..from(ELSEWHERE) };
    assert_eq!(*access.admit(&both).unwrap().scope, subscribe("/odom"));
    assert!(access.admit(&AdmissionRequest { token: Some("sgc-access-1:"), ..both }).is_err());
}

#[test]
fn anonymous_clients_are_judged_again() {
    let access = Access::default();
    let here = access.admit(&from(HERE)).unwrap();
    let none = Access::new(AccessRules { anonymous: Anonymous::None, ..AccessRules::default() });
    let ip = "127.0.0.1".parse().unwrap();
    assert_eq!(none.still_admits(&here, NOW), Err(Denial::NoCredentials { ip }));
    assert_eq!(none.still_admits(&Client::own("sgc"), NOW), Ok(()));
}

#[test]
fn an_address_whose_tokens_fail_waits_and_a_reload_does_not_forget_it() {
    let cast = cast();
    let access = Access::new(cast.rules());
    let (bad, good) = ("sgc-access-1:AAAA", cast.token().to_text());
    let show =
        |access: &Access, token, peer| access.admit(&AdmissionRequest { token: Some(token), ..from(peer) });
    for _ in 0..10 {
        assert!(matches!(show(&access, bad, ELSEWHERE), Err(Denial::Token(_))));
        assert!(matches!(show(&access, bad, HERE), Err(Denial::Token(_))));
    }
    let reloaded = Access::new(cast.rules()).after(&access);
    for access in [&access, &reloaded] {
        assert!(matches!(show(access, &good, ELSEWHERE), Err(Denial::TooManyAttempts { .. })));
        assert!(show(access, &good, "10.0.0.8:1").is_ok());
        assert!(show(access, &good, HERE).is_ok(), "behind a proxy of this host are many");
    }
    let admission = AdmissionRequest { token: Some(&good), now: later(60_000), ..from(ELSEWHERE) };
    assert!(access.admit(&admission).is_ok());
}

#[test]
fn listener_hears_of_refused_tokens_only() {
    let cast = cast();
    let heard: Arc<Mutex<Vec<(String, Denial)>>> = Arc::default();
    let log = Arc::clone(&heard);
    let hears: RefusalListener =
        Arc::new(move |peer, denied| log.lock().unwrap().push((peer.to_string(), denied.clone())));
    let access = Access::new(cast.rules()).with_refusal_listener(hears);
    let revoked = AccessRules { revoked: [cast.grant().id].into(), ..cast.rules() };
    let revoked = Access::new(revoked).after(&access);
    let good = cast.token().to_text();
    let show = |access: &Access, token| access.admit(&AdmissionRequest { token, ..from(HERE) }).is_ok();
    assert!(show(&access, Some(&good)) && show(&access, None));
    assert!(access.admit(&from(ELSEWHERE)).is_err(), "without a token");
    assert!(!show(&access, Some("x")) && !show(&revoked, Some(&good)));
    let wanted = [Denial::Token(AccessTokenError::Prefix), Denial::TokenRevoked { id: cast.grant().id }];
    assert_eq!(*heard.lock().unwrap(), wanted.map(|denied| (HERE.to_owned(), denied)));
}

#[test]
fn log_entries_of_an_address_are_limited() {
    let heard: Arc<Mutex<Vec<String>>> = Arc::default();
    let log = Arc::clone(&heard);
    let access = Access::new(cast().rules())
        .with_refusal_listener(Arc::new(move |peer, _| log.lock().unwrap().push(peer.ip().to_string())));
    // Pages of a browser on this host and clients that show tokens in the clear may try without limit.
    for (peer, encrypted) in [(HERE, true), (ELSEWHERE, true), ("10.0.0.10:1", false)] {
        for _ in 0..1000 {
            let admission = AdmissionRequest { token: Some("sgc-access-1:AAAA"), encrypted, ..from(peer) };
            assert!(access.admit(&admission).is_err());
        }
        let ip = from(peer).peer.ip().to_string();
        assert_eq!(heard.lock().unwrap().iter().filter(|heard| **heard == ip).count(), 10, "{peer}");
    }
    assert_eq!(access.denied(), 3000);
}

#[test]
fn invalid_grants_are_not_signed() {
    let cast = cast();
    let sign = |grant: AccessGrant| grant.sign(&cast.gateway).unwrap_err();
    for label in ["", " a", "a\nb", &"a".repeat(65)] {
        assert_eq!(sign(AccessGrant { label: label.into(), ..cast.grant() }), AccessTokenError::Label);
    }
    let backwards = AccessGrant { expires: UnixMillis(NOW.0 - 1), ..cast.grant() };
    assert_eq!(sign(backwards), AccessTokenError::Time);
    let forever = AccessGrant { expires: later(ACCESS_VALID_MS_MAX + 1), ..cast.grant() };
    assert_eq!(sign(forever), AccessTokenError::Time);
    let nothing = AccessGrant { scope: Scope::default(), ..cast.grant() };
    assert_eq!(sign(nothing), AccessTokenError::Scope(ScopeError::Nothing));
}

#[test]
fn the_largest_token_fits_and_says_what_it_said() {
    let cast = cast();
    let pattern = format!("/{}", "a".repeat(SCOPE_BYTES_MAX / SCOPE_PATTERNS_MAX - 1));
    let quarter = vec![pattern; SCOPE_PATTERNS_MAX / 4];
    let scope =
        Scope { subscribe: quarter.clone(), publish: quarter.clone(), call: quarter.clone(), serve: quarter };
    let grant = AccessGrant { label: "l".repeat(ACCESS_LABEL_BYTES_MAX), scope, ..cast.grant() };
    let text = grant.clone().sign(&cast.gateway).unwrap().to_text();
    // The longest signature must fit, too.
    assert!(text.len() + 512 * 4 / 3 < ACCESS_TOKEN_TEXT_BYTES_MAX, "{}", text.len());
    let read = AccessToken::parse(&text).unwrap();
    assert_eq!(read.verify(cast.gateway.as_peer()), Ok(&grant));
    assert_eq!(read.to_text(), text);
}

#[test]
fn nobody_hears_why_a_token_does_not_hold_and_nothing_shows_it() {
    let cast = cast();
    let node = cast.desk.node_id();
    let client_message = Denial::Token(AccessTokenError::Signature).client_message();
    for fault in [AccessTokenError::Prefix, AccessTokenError::Elsewhere { gateway: node }] {
        assert_eq!(Denial::Token(fault).client_message(), client_message);
    }
    let token = cast.token();
    let text = token.to_text();
    assert!(!format!("{token:?}").contains(&text[text.len() - 40..]));
    assert!(!format!("{token:?}").contains("signature"));
}
