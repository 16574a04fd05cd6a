//! Configurations that name a protocol or a transport that this build lacks. `make minimal` runs this file in builds
//! without features.

use std::path::Path;

use sgc_gateway::Protocol;
use sgc_node::config::{GatewayUrlError, Mistake, parse};
use sgc_transport::UrlError;

/// Returns the mistakes in a configuration.
fn mistakes(text: &str) -> Vec<Mistake> {
    let text = format!("identity = 'x'\nnode.routers = ['quic://r:7447']\n{text}");
    match parse(&text, "node.toml", Path::new("/etc/sgc"), &|_| None) {
        Ok(_) => Vec::new(),
        Err(errors) => errors.iter().map(|error| (*error.mistake).clone()).collect(),
    }
}

/// Checks that only builds with a feature accept a configuration, and that the refusal of others names the feature.
fn check(text: &str, feature: &str, is_built: bool, is_expected: impl Fn(&Mistake) -> bool) {
    match mistakes(text).as_slice() {
        [] => assert!(is_built, "accepted without {feature}: {text}"),
        [mistake] => {
            assert!(!is_built && is_expected(mistake), "{text}: {mistake}");
            assert!(mistake.to_string().contains(&format!("--features {feature}`")), "{mistake}");
        }
        more => panic!("{text}: {more:?}"),
    }
}

#[test]
fn gateway_address_of_a_missing_protocol_is_refused() {
    let absent = |wanted| {
        move |mistake: &Mistake| {
            matches!(mistake, Mistake::GatewayUrl { fault: GatewayUrlError::NotBuilt(absent), .. }
                if absent.protocol == wanted)
        }
    };
    let has_websocket = cfg!(any(feature = "rosbridge", feature = "foxglove"));
    for scheme in ["ws", "wss"] {
        let text = format!("gateway.listen = ['{scheme}://127.0.0.1']");
        check(&text, "rosbridge,foxglove", has_websocket, absent(Protocol::WebSocket));
    }
    for scheme in ["grpc", "grpcs"] {
        let text = format!("gateway.listen = ['{scheme}://127.0.0.1']");
        check(&text, "grpc", cfg!(feature = "grpc"), absent(Protocol::Grpc));
    }
}

#[test]
fn gateway_without_addresses_is_refused_if_every_protocol_is_missing() {
    let has_any = cfg!(any(feature = "rosbridge", feature = "foxglove", feature = "grpc"));
    check("[gateway]", "rosbridge,foxglove,grpc", has_any, |mistake| {
        matches!(mistake, Mistake::GatewayNotBuilt)
    });
}

#[test]
fn collectors_of_metrics_are_refused_without_pushes() {
    check("metrics.otlp = 'http://a:4318'", "otlp", cfg!(feature = "otlp"), |mistake| {
        matches!(mistake, Mistake::OtlpNotBuilt { key: "otlp" })
    });
}

#[test]
fn dtls_addresses_are_refused_without_dtls() {
    let is_absent =
        |mistake: &Mistake| matches!(mistake, Mistake::Url { fault: UrlError::NotBuilt { .. }, .. });
    check("router.listen = ['dtls://[::]:7447']", "dtls", cfg!(feature = "dtls"), is_absent);
    let routers = "identity = 'x'\nnode.routers = ['quic://r:7447,dtls://r:7447']\n";
    let parsed = parse(routers, "node.toml", Path::new("/etc/sgc"), &|_| None);
    assert_eq!(parsed.is_ok(), cfg!(feature = "dtls"), "{parsed:?}");
}
