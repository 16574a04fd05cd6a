//! `middleware`, `[ros.zenoh]` and the variables of rmw_zenoh. Most tests need the feature `zenoh`.

use std::collections::BTreeMap;
use std::path::Path;

use sgc_config::{Config, ConfigErrors, Middleware, RosConfig, ZenohConfig, parse};

/// The least that every node needs: three lines, of which the last is the header of the table.
const NODE: &str = "identity = 'x'\nnode.routers = ['quic://r:7447']\n[ros]\n";

fn parse_with(ros: &str, vars: &[(&str, &str)]) -> Result<Config, ConfigErrors> {
    let vars: BTreeMap<&str, &str> = vars.iter().copied().collect();
    let env = |name: &str| vars.get(name).map(|value| (*value).to_owned());
    parse(&format!("{NODE}{ros}"), "node.toml", Path::new("/etc/sgc"), &env)
}

/// Resolves keys of `[ros]`.
fn ros(keys: &str, vars: &[(&str, &str)]) -> RosConfig {
    let config = parse_with(keys, vars).unwrap_or_else(|errors| panic!("{keys} {vars:?}\n{errors}"));
    config.ros.expect("the file has [ros]")
}

/// Returns all messages about keys of `[ros]`. The first key is in line 4.
fn said(keys: &str, vars: &[(&str, &str)]) -> Vec<String> {
    match parse_with(keys, vars) {
        Ok(config) => panic!("accepted:\n{keys} {vars:?}\n{config:?}"),
        Err(errors) => errors.iter().map(ToString::to_string).collect(),
    }
}

const UNUSED: &str = "[ros.zenoh] is for a network of rmw_zenoh, and the node joins none: set middleware = \"zenoh\" or \
     \"both\" in [ros], or take the table out";

#[test]
fn network_is_one_of_dds_by_default() {
    for keys in ["", "middleware = 'dds'"] {
        let ros = ros(keys, &[]);
        assert_eq!((ros.middleware, ros.zenoh), (Middleware::Dds, ZenohConfig::default()), "{keys}");
    }
    let known = "It takes \"dds\", \"zenoh\", \"both\"";
    assert_eq!(
        said("middleware = 'zeno'", &[]),
        [format!("node.toml:4: `middleware` is \"zeno\"; did you mean \"zenoh\"? {known}")]
    );
    assert_eq!(
        said("middleware = true", &[]),
        ["node.toml:4: `middleware` is a boolean (true); it takes a string, \"dds\", \"zenoh\" or \"both\""]
    );
}

#[test]
fn table_of_zenoh_needs_the_middleware() {
    assert_eq!(said("[ros.zenoh]\nrouter = 'tcp/a:1'", &[]), [format!("node.toml:4: {UNUSED}")]);
    assert_eq!(said("middleware = 'dds'\n[ros.zenoh]", &[]), [format!("node.toml:5: {UNUSED}")]);
    // A middleware that is not understood may be meant to be Zenoh.
    let with_mistake = said("middleware = 'zeno'\nstatic_peers = []\n[ros.zenoh]\nrouter = 'tcp/a:1'", &[]);
    assert_eq!(with_mistake.len(), 1, "{with_mistake:?}");
    assert!(with_mistake[0].starts_with("node.toml:4: `middleware` is \"zeno\""));
}

#[test]
fn keys_of_the_table_are_known() {
    assert_eq!(
        said("[ros.zenoh]\nruoter = 'tcp/a:1'", &[])[1],
        "node.toml:5: [ros.zenoh] has no key `ruoter`; did you mean `router`?"
    );
    assert_eq!(
        said("zenoh = 5", &[]),
        ["node.toml:4: `ros.zenoh` is an integer (5) but may occur only once; write [ros.zenoh]"]
    );
    assert_eq!(said("[zenoh]", &[]), ["node.toml:4: the top level has no key `zenoh`; it belongs in [ros]"]);
    assert_eq!(
        said("[transport]\nrouter = 'a'", &[]),
        ["node.toml:5: [transport] has no key `router`; it has `congestion`, `offload`, `mtu_discovery`, \
             `bulk_lanes`, `dtls_1_2`, `dscp`, `lane_dscp`"]
    );
}

#[test]
fn variables_of_zenoh_are_not_read_without_such_a_network() {
    let vars = [
        ("ZENOH_SESSION_CONFIG_URI", "http://a"),
        ("ZENOH_CONFIG_OVERRIDE", "nonsense"),
        ("ZENOH_ROUTER_CHECK_ATTEMPTS", "nonsense"),
    ];
    assert_eq!(ros("", &vars).zenoh, ZenohConfig::default());
}

#[cfg(not(feature = "zenoh"))]
#[test]
fn build_without_zenoh_refuses_its_networks() {
    for word in ["zenoh", "both"] {
        assert_eq!(
            said(&format!("middleware = '{word}'\n[ros.zenoh]\nrouter = 'tcp/a:1'"), &[]),
            [format!(
                "node.toml:4: `middleware` is \"{word}\", and this sgc is built without Zenoh: build it with `cargo build \
                 --release -p sgc --features zenoh`, or leave it out"
            )]
        );
    }
}

#[cfg(feature = "zenoh")]
mod built {
    use std::path::PathBuf;
    use std::time::Duration;

    use sgc_config::{
        DiscoveryRange, RouterCheck, ZENOH_OVERRIDE_KEY_BYTES_MAX, ZENOH_OVERRIDE_VALUE_BYTES_MAX,
        ZENOH_OVERRIDES_MAX, ZENOH_ROUTER_BYTES_MAX, ZENOH_ROUTER_DEFAULT,
    };

    use super::*;

    const ZENOH: &str = "middleware = 'zenoh'\n";
    const BOTH: &str = "middleware = 'both'\n";
    const URI: &str = "ZENOH_SESSION_CONFIG_URI";
    const OVERRIDE: &str = "ZENOH_CONFIG_OVERRIDE";
    const ATTEMPTS: &str = "ZENOH_ROUTER_CHECK_ATTEMPTS";

    fn zenoh(keys: &str, vars: &[(&str, &str)]) -> ZenohConfig {
        ros(&format!("{ZENOH}{keys}"), vars).zenoh
    }

    /// Returns the only message about an environment.
    fn said_of(name: &str, value: &str) -> String {
        let said = said(ZENOH, &[(name, value)]);
        assert_eq!(said.len(), 1, "{said:?}");
        said.concat()
    }

    #[test]
    fn network_may_be_one_of_zenoh_or_one_of_each() {
        for (keys, middleware) in [(ZENOH, Middleware::Zenoh), (BOTH, Middleware::Both)] {
            let ros = ros(keys, &[]);
            assert_eq!(ros.middleware, middleware);
            assert_eq!(ros.zenoh, ZenohConfig::default());
            assert_eq!(ros.zenoh.router_address(), Some(ZENOH_ROUTER_DEFAULT));
            assert_eq!(ros.zenoh.router_check, RouterCheck::After(Duration::from_secs(1)));
        }
    }

    #[test]
    fn both_networks_have_their_settings() {
        let keys = format!("{BOTH}domain_id = 7\nstatic_peers = ['a']\n[ros.zenoh]\nrouter = 'tcp/b:1'");
        let ros = ros(&keys, &[("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST"), ("CYCLONEDDS_URI", "<A/>")]);
        assert_eq!((ros.domain_id, ros.discovery), (7, DiscoveryRange::Localhost));
        assert_eq!(ros.static_peers, ["a"]);
        assert_eq!(ros.cyclonedds_uri.as_deref(), Some("<A/>"));
        assert_eq!(ros.zenoh.router.as_deref(), Some("tcp/b:1"));
    }

    #[test]
    fn router_is_an_endpoint_of_zenoh() {
        for router in [
            "tcp/localhost:7447",
            "tcp/10.0.0.5:1",
            "tcp/[::1]:65535",
            "tls/router.lab.example:7447",
            "unixsock-stream//run/zenoh router.sock",
            "tcp/a:1?prio=6-7;rel=0",
            "tcp/a:1#iface=eth0",
            "tls/a:1?rel=1#bind=192.168.0.1:0;verify_name_on_connect=false",
        ] {
            let found = zenoh(&format!("[ros.zenoh]\nrouter = '{router}'"), &[]).router;
            assert_eq!(found.as_deref(), Some(router));
        }
        for router in [
            "",
            "localhost:7447",
            "tcp/localhost",
            "tcp/:7447",
            "tcp/a:0",
            "tcp/a:65536",
            "tcp/::1:7447",
            "tcp/[a]:1",
            "tcp/a b:1",
            "tcp/a/b:1",
            "tcp://localhost:7447",
            "udp/localhost:7447",
            "quic/localhost:7447",
            "unixsock-stream/",
            "tcp/a:1?",
            "tcp/a:1#",
            "tcp/a:1#=b",
            "tcp?a:1/b",
            "tcp/a:1#a=1?b=2",
        ] {
            let said = said(&format!("{ZENOH}[ros.zenoh]\nrouter = '{router}'"), &[]);
            let shown = router.split_once('#').map_or(router.to_owned(), |(shown, _)| format!("{shown}#..."));
            assert_eq!(
                said,
                [format!(
                    "node.toml:6: `router` is {shown:?}; a router of Zenoh is tcp/HOST:PORT, tls/HOST:PORT or \
                     unixsock-stream/PATH: \"tcp/localhost:7447\", for example"
                )]
            );
        }
        let long =
            |bytes: usize| format!("[ros.zenoh]\nrouter = 'unixsock-stream/{}'", "x".repeat(bytes - 16));
        assert!(zenoh(&long(ZENOH_ROUTER_BYTES_MAX), &[]).router.is_some());
        assert_eq!(
            said(&format!("{ZENOH}{}", long(ZENOH_ROUTER_BYTES_MAX + 1)), &[]),
            ["node.toml:6: `router` has 1025 bytes; it has at most 1024"]
        );
    }

    #[test]
    fn address_of_the_router_has_no_secrets_and_may_be_elsewhere() {
        let at = |keys: &str, vars: &[(&str, &str)]| zenoh(keys, vars).router_address().map(str::to_owned);
        let router = "[ros.zenoh]\nrouter = 'tls/a:1?rel=1#connect_private_key_base64=AAAA'";
        let address = Some("tls/a:1?rel=1".to_owned());
        let usual = Some(ZENOH_ROUTER_DEFAULT.to_owned());
        assert_eq!(at(router, &[]), address);
        assert_eq!(at(router, &[(URI, "/a.json5"), (OVERRIDE, "connect/endpoints=['tcp/b:1']")]), address);
        assert_eq!(at("", &[(OVERRIDE, "connect/timeout_ms=1")]), usual);
        assert_eq!(at("", &[(URI, "/a.json5")]), None);
        assert_eq!(at("", &[(OVERRIDE, "connect/endpoints=['tcp/b:1']")]), None);
        assert_eq!(at("", &[(OVERRIDE, "connect={endpoints:['tcp/b:1']}")]), None);
    }

    #[test]
    fn session_configuration_is_a_file_or_the_variable() {
        let config = |keys: &str, uri: &str| zenoh(keys, &[(URI, uri)]).config;
        let path = |path: &str| Some(PathBuf::from(path));
        let key = "[ros.zenoh]\nconfig = 'a/session.json5'";
        assert_eq!(config("", ""), None);
        assert_eq!(config(key, ""), path("/etc/sgc/a/session.json5"));
        assert_eq!(config("[ros.zenoh]\nconfig = '/b.yaml'", ""), path("/b.yaml"));
        assert_eq!(config("", "/a b/session.json5"), path("/a b/session.json5"));
        assert_eq!(config("", "session.json"), path("session.json"), "below the working directory");
        assert_eq!(config("", "file:///a/session.yml"), path("/a/session.yml"));
        // The key overrides the variable, which is then not read.
        assert_eq!(config(key, "http://nonsense"), path("/etc/sgc/a/session.json5"));

        let ending = "Zenoh knows the format by the ending: .json5, .json, .yaml or .yml";
        let wrong = "it takes a path, or file:// and an absolute path";
        for (value, expected) in [
            ("http://a/session.json5", wrong),
            ("file://session.json5", wrong),
            ("/session.toml", ending),
            ("/session", ending),
            ("/.json5", ending),
        ] {
            assert_eq!(said_of(URI, value), format!("environment: `{URI}` is {value:?}; {expected}"));
        }
        assert_eq!(
            said(&format!("{ZENOH}[ros.zenoh]\nconfig = 'a.txt'"), &[]),
            [format!("node.toml:6: `config` is \"a.txt\"; {ending}")]
        );
        assert_eq!(
            said(&format!("{ZENOH}[ros.zenoh]\nconfig = ''"), &[]),
            ["node.toml:6: `config` is empty; give it a value, such as \"session.json5\""]
        );
    }

    #[test]
    fn overrides_keep_their_order_and_text() {
        let overrides = |value: &str| zenoh("", &[(OVERRIDE, value)]).overrides;
        let pair = |key: &str, value: &str| (key.to_owned(), value.to_owned());
        assert_eq!(overrides(""), []);
        assert_eq!(
            overrides("mode=\"client\";connect/endpoints=[\"tcp/10.0.0.5:7447\", 'tcp/b:1'];"),
            [pair("mode", "\"client\""), pair("connect/endpoints", "[\"tcp/10.0.0.5:7447\", 'tcp/b:1']")]
        );
        assert_eq!(overrides("a=1;; ;a=2"), [pair("a", "1"), pair("a", "2")], "empty settings are skipped");
        assert_eq!(overrides("a={b:'=]\\'}'}"), [pair("a", "{b:'=]\\'}'}")], "the first = ends the key");
    }

    #[test]
    fn malformed_overrides_are_named() {
        let unclosed = |key: &str| {
            format!(
                "gives {key} a value that ends in the middle of a string, an array or an object; each `;` ends a setting, \
                 also in quotes"
            )
        };
        let bad_key =
            |key: &str| format!("has the key {key:?}; a key is like connect/endpoints, without spaces");
        for (value, number, expected) in [
            (
                "a=1;true",
                2,
                "is not KEY=VALUE; `;` separates settings: mode=\"client\";scouting/multicast/enabled=false"
                    .to_owned(),
            ),
            ("=1", 1, bad_key("")),
            ("a=1; b=2", 2, bad_key(" b")),
            (
                "a=1;b= ",
                2,
                "gives b no value; values are JSON5, such as true, or [\"tcp/localhost:7447\"]".to_owned(),
            ),
            ("connect/endpoints=['tcp/a:1#iface=eth0;bind=b:0']", 1, unclosed("connect/endpoints")),
            ("a=[1", 1, unclosed("a")),
            ("a=1]", 1, unclosed("a")),
            ("a='b\\'", 1, unclosed("a")),
        ] {
            assert_eq!(
                said_of(OVERRIDE, value),
                format!("environment: `{OVERRIDE}`: setting {number} {expected}")
            );
        }
        // A message goes to logs, so it has no value.
        assert!(!said_of(OVERRIDE, "password='secret;more'").contains("secret"));
    }

    #[test]
    fn overrides_are_bounded() {
        let overrides = |value: &str| zenoh("", &[(OVERRIDE, value)]).overrides;
        let many = |count: usize| "a=1;".repeat(count);
        assert_eq!(overrides(&many(ZENOH_OVERRIDES_MAX)).len(), ZENOH_OVERRIDES_MAX);
        assert_eq!(
            said_of(OVERRIDE, &many(ZENOH_OVERRIDES_MAX + 1)),
            format!("environment: `{OVERRIDE}` has 65 entries; it may have at most 64")
        );
        let (key_max, value_max) = (ZENOH_OVERRIDE_KEY_BYTES_MAX, ZENOH_OVERRIDE_VALUE_BYTES_MAX);
        let of = |key: usize, value: usize| format!("{}={}", "k".repeat(key), "1".repeat(value));
        assert_eq!(overrides(&of(key_max, value_max)).len(), 1);
        assert_eq!(
            said_of(OVERRIDE, &of(key_max + 1, 1)),
            format!("environment: `{OVERRIDE}`: setting 1 has a key of 257 bytes; a key has at most 256")
        );
        assert_eq!(
            said_of(OVERRIDE, &of(1, value_max + 1)),
            format!(
                "environment: `{OVERRIDE}`: setting 1 gives k a value of 16385 bytes; a value has at most 16384"
            )
        );
    }

    #[test]
    fn attempts_decide_when_a_missing_router_is_reported() {
        let after = |seconds| RouterCheck::After(Duration::from_secs(seconds));
        for (value, expected) in [
            ("", after(1)),
            ("1", after(1)),
            (" +30", after(30)),
            ("0", RouterCheck::Repeated),
            ("-1", RouterCheck::Off),
            ("9223372036854775807", RouterCheck::After(RouterCheck::AFTER_MAX)),
        ] {
            assert_eq!(zenoh("", &[(ATTEMPTS, value)]).router_check, expected, "{value:?}");
        }
        for value in ["never", "1s", "1.5", "9223372036854775808"] {
            assert_eq!(
                said_of(ATTEMPTS, value),
                format!(
                    "environment: `{ATTEMPTS}` is {value:?}; it takes a number: 0, a positive or a negative one"
                )
            );
        }
    }

    #[test]
    fn keys_of_dds_are_refused_without_such_a_network() {
        let for_dds = |line: usize, key: &str| {
            format!(
                "node.toml:{line}: `{key}` is for DDS, and `middleware` is \"zenoh\": take it out; `router` in [ros.zenoh] \
                 names the router that the node connects to"
            )
        };
        let for_security = |line: usize, key: &str| {
            format!(
                "node.toml:{line}: `{key}` is for DDS Security, and `middleware` is \"zenoh\", so nothing would be \
                 protected: take it out; a session configuration, `config` in [ros.zenoh], protects a network of rmw_zenoh"
            )
        };
        let keys = "discovery_range = 'nonsense'\nlocalhost_only = false\nstatic_peers = []\nenclave = '/a'\n\
            security_root = '/b'";
        assert_eq!(
            said(&format!("{ZENOH}{keys}"), &[]),
            [
                for_dds(5, "discovery_range"),
                for_dds(6, "localhost_only"),
                for_dds(7, "static_peers"),
                for_security(8, "enclave"),
                for_security(9, "security_root"),
            ]
        );
    }

    #[test]
    fn variables_of_dds_are_not_read_without_such_a_network() {
        let vars = [
            ("ROS_LOCALHOST_ONLY", "nonsense"),
            ("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF"),
            ("ROS_STATIC_PEERS", "a b"),
            ("CYCLONEDDS_URI", "<A/>"),
            ("ROS_SECURITY_ENABLE", "true"),
            ("ROS_SECURITY_KEYSTORE", "/keys"),
            ("ROS_DOMAIN_ID", "9"),
        ];
        let expected = RosConfig { middleware: Middleware::Zenoh, domain_id: 9, ..RosConfig::default() };
        assert_eq!(ros(ZENOH, &vars), expected);
    }

    #[test]
    fn domain_of_a_zenoh_network_has_32_bits() {
        assert_eq!(ros(&format!("{ZENOH}domain_id = 4294967295"), &[]).domain_id, u32::MAX);
        assert_eq!(ros(ZENOH, &[("ROS_DOMAIN_ID", "0xffffffff")]).domain_id, u32::MAX);
        let too_large = |key: &str, value: &str, max: u32| {
            format!("`{key}` is {value}; a ROS domain id is a number from 0 to {max}")
        };
        assert_eq!(
            said(&format!("{ZENOH}domain_id = 4294967296"), &[]),
            [format!("node.toml:5: {}", too_large("domain_id", "4294967296", u32::MAX))]
        );
        assert_eq!(
            said(&format!("{BOTH}domain_id = 233"), &[]),
            [format!("node.toml:5: {}", too_large("domain_id", "233", 232))]
        );
        assert_eq!(
            said(BOTH, &[("ROS_DOMAIN_ID", "233")]),
            [format!("environment: {}", too_large("ROS_DOMAIN_ID", "\"233\"", 232))]
        );
    }

    #[test]
    fn enforced_security_needs_a_session_configuration() {
        const ENABLE: (&str, &str) = ("ROS_SECURITY_ENABLE", "true");
        const ENFORCE: (&str, &str) = ("ROS_SECURITY_STRATEGY", "Enforce");
        const KEYSTORE: (&str, &str) = ("ROS_SECURITY_KEYSTORE", "/keys");
        const SESSION: (&str, &str) = (URI, "/session.json5");
        let config = "[ros.zenoh]\nconfig = 'session.json5'";
        let keys = "enclave = '/sgc'\nsecurity_root = '/here'\n";
        for middleware in [ZENOH, BOTH] {
            let unprotected = said(middleware, &[ENABLE, ENFORCE, KEYSTORE]);
            assert_eq!(
                unprotected,
                [
                    "environment: ROS_SECURITY_STRATEGY is \"Enforce\", and nothing protects the network of rmw_zenoh: name \
                     its session configuration in `config` of [ros.zenoh], or in ZENOH_SESSION_CONFIG_URI, or unset \
                     ROS_SECURITY_ENABLE"
                ]
            );
            ros(middleware, &[ENABLE, KEYSTORE]);
            ros(middleware, &[ENFORCE]);
            ros(middleware, &[ENABLE, ENFORCE, KEYSTORE, SESSION]);
            ros(&format!("{middleware}{config}"), &[ENABLE, ENFORCE, KEYSTORE]);
        }
        // The file decides about DDS Security, so the environment says nothing about either network.
        let security = ros(&format!("{BOTH}{keys}"), &[ENABLE, ENFORCE]).security;
        assert_eq!(security.map(|security| security.keystore), Some(PathBuf::from("/here")));
        assert_eq!(ros(&format!("{ZENOH}{config}"), &[ENABLE, ENFORCE, KEYSTORE]).security, None);
    }
}
