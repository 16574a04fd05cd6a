//! Configurations: their resolved values, and the messages about mistakes.

#![allow(clippy::disallowed_methods)]

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

#[cfg(feature = "otlp")]
use sgc_config::OtlpConfig;
use sgc_config::{
    ArgsConfig, AuditConfig, AuditRoom, Config, ConfigErrors, DeadManConfig, DiscoveryRange,
    GATEWAY_NAMES_MAX, GatewayConfig, Naming, Recipient, Rename, Resume, RotationConfig, SHARES_MAX, SUITES,
    SecurityConfig, Shaping, StopSource, Table, TokenConfig, TokenSource, TransportConfig, parse,
};
use sgc_gateway::{Anonymous, Right};
use sgc_transport::Congestion;
use sgc_trust::Suite;
use sgc_wire::Class;
use sgc_wire::{PayloadEncoding, PayloadForm};

/// The least that every node needs.
const NODE: &str = "identity = 'x'\nnode.routers = ['quic://r:7447']\n";

fn no_env(_: &str) -> Option<String> {
    None
}

fn parse_with(text: &str, vars: &[(&str, &str)]) -> Result<Config, ConfigErrors> {
    let vars: BTreeMap<&str, &str> = vars.iter().copied().collect();
    parse(text, "node.toml", Path::new("/etc/sgc"), &|name| vars.get(name).map(|value| (*value).to_owned()))
}

fn good(text: &str) -> Config {
    parse_with(text, &[]).unwrap_or_else(|errors| panic!("{text}\n{errors}"))
}

/// Returns all messages about `text`. `NODE` precedes it, so line 3 is its first.
fn said_about(text: &str) -> Vec<String> {
    let text = format!("{NODE}{text}");
    match parse_with(&text, &[]) {
        Ok(config) => panic!("accepted:\n{text}\n{config:?}"),
        Err(errors) => errors.iter().map(ToString::to_string).collect(),
    }
}

fn said_of_whole(text: &str) -> Vec<String> {
    let errors = parse_with(text, &[]).expect_err(text);
    errors.iter().map(ToString::to_string).collect()
}

fn check_all(cases: &[(&str, &[&str])]) {
    for (text, expected) in cases {
        assert_eq!(said_about(text), *expected, "\n{text}");
    }
}

fn texts(values: &[impl ToString]) -> Vec<String> {
    values.iter().map(ToString::to_string).collect()
}

#[test]
fn links_that_can_be_read_on_their_way_are_warned_of() {
    let config = good(
        r#"
        identity = "x"
        node.routers = ["quic://a:1,tcp://a:2", "udp://b:3", "tls://c:4"]
        router.listen = ["quic://[::]:7447", "tcp://[::]:7447", "wss://[::]:443"]
        "#,
    );
    let warnings = config.warnings();
    let about: Vec<_> = warnings.iter().filter_map(|line| line.split_once(' ')).collect();
    let addresses: Vec<_> = about.iter().map(|(address, _)| *address).collect();
    assert_eq!(addresses, ["tcp://[::]:7447", "tcp://a:2", "udp://b:3"]);
    assert!(about.iter().all(|(_, text)| text.starts_with("can be read by everybody")), "{warnings:#?}");
    assert_eq!(good(NODE).warnings(), Vec::<String>::new());
}

#[test]
fn the_example_of_the_design_is_valid() {
    let config = good(
        r#"
        [node]
        name = "arm-1"
        routers = ["quic://router.lab.example:7447"]

        [[share]]
        topic = "/camera/image"
        to = ["desk", "group:operators"]

        [[use]]
        from = "desk"
        topic = "/cmd_vel"
        "#,
    );
    assert_eq!(config.node_name.map(|name| name.to_string()).as_deref(), Some("arm-1"));
    assert_eq!(config.identity, Path::new("/etc/sgc/arm-1.identity"));
    assert_eq!(texts(&config.routers), ["quic://router.lab.example:7447"]);
    assert!(config.listen.is_empty());
    assert_eq!(config.ros, Some(Default::default()));
    assert_eq!(config.shares.len(), 1);
    let share = &config.shares[0];
    assert_eq!((share.topic.as_str(), share.type_name.as_deref()), ("/camera/image", None));
    assert_eq!(
        share.to,
        [Recipient::Node("desk".parse().unwrap()), Recipient::Group("operators".parse().unwrap())]
    );
    assert_eq!((share.priority, share.suite), (Class::Default, Suite::DEFAULT));
    assert_eq!(config.uses.len(), 1);
    let one = &config.uses[0];
    assert_eq!((one.from.as_str(), one.topic.as_str()), ("desk", "/cmd_vel"));
    assert_eq!(one.type_name.as_deref(), None);
    assert_eq!(config.admin_socket, None);
}

#[test]
fn every_key_is_taken_over() {
    let config = good(
        r#"
        identity = "keys/arm-1.identity"
        [node]
        name = "arm-1"
        routers = ["quic://a:1", "quic://[2001:db8::1]:65535", "quic://10.0.0.1:7447"]
        [ros]
        domain_id = 232
        discovery_range = "localhost"
        localhost_only = false
        static_peers = ["10.0.0.2", "arm-2.local", "fe80::1"]
        graph = false
        definitions = ["share", "/opt/robot/share"]
        [[share]]
        topic = "/a__b/_c"
        to = ["*"]
        type = "sensor_msgs::msg::dds_::Image_"
        priority = "bulk"
        suite = "group"
        description = "d"
        author = "a"
        maintainer = "m"
        interface = "i"
        unique = "u"
        node = "/camera"
        [[use]]
        from = "desk"
        topic = "/cmd_vel"
        type = "geometry_msgs/msg/Twist"
        [[use]]
        from = "desk-2"
        topic = "/cmd_vel"
        [router]
        listen = ["quic://0.0.0.0:0", "quic://[::]:7447"]
        [admin]
        socket = "/run/arm.sock"
        "#,
    );
    assert_eq!(config.identity, Path::new("/etc/sgc/keys/arm-1.identity"));
    assert_eq!(texts(&config.routers), ["quic://a:1", "quic://[2001:db8::1]:65535", "quic://10.0.0.1:7447"]);
    let ros = config.ros.as_ref().unwrap();
    assert_eq!((ros.domain_id, ros.discovery), (232, DiscoveryRange::Localhost));
    assert_eq!(ros.static_peers, ["10.0.0.2", "arm-2.local", "fe80::1"]);
    assert!(!ros.graph);
    assert_eq!(ros.definitions, [Path::new("/etc/sgc/share"), Path::new("/opt/robot/share")]);
    let share = &config.shares[0];
    assert_eq!(texts(&share.to), ["*"]);
    assert_eq!(share.type_name.as_deref(), Some("sensor_msgs/msg/Image"));
    assert_eq!(share.priority, Class::Bulk);
    let metadata = &share.metadata;
    assert_eq!(
        [
            &metadata.description,
            &metadata.author,
            &metadata.maintainer,
            &metadata.interface,
            &metadata.unique,
            &metadata.node
        ],
        ["d", "a", "m", "i", "u", "/camera"]
    );
    assert_eq!(config.uses.len(), 2);
    assert_eq!(config.uses[0].type_name.as_deref(), Some("geometry_msgs/msg/Twist"));
    assert_eq!(texts(&config.listen), ["quic://0.0.0.0:0", "quic://[::]:7447"]);
    assert_eq!(config.admin_socket, Some(PathBuf::from("/run/arm.sock")));
    assert!(!config.is_pure_router());
}

#[test]
fn without_ros_it_is_a_pure_router() {
    let text = "identity = '/r.identity'\nrouter.listen = ['quic://0.0.0.0:7447']";
    // A router's environment may hold anything.
    let config = parse_with(text, &[("ROS_DOMAIN_ID", "nonsense")]).unwrap();
    assert!(config.is_pure_router());
    assert_eq!((config.identity.as_path(), config.node_name), (Path::new("/r.identity"), None));
    assert!(!good(&format!("{text}\n[ros]")).is_pure_router());
}

#[test]
fn the_identity_may_stand_in_node() {
    let config = good("[node]\nidentity = 'a.identity'\nrouters = ['quic://r:7447']");
    assert_eq!(config.identity, Path::new("/etc/sgc/a.identity"));
}

#[test]
fn unknown_keys_are_answered_with_the_nearest() {
    check_all(&[
        (
            "[[share]]\ntpoic = '/a'\nto = ['b']",
            &["node.toml:4: [[share]] has no key `tpoic`; did you mean `topic`?"],
        ),
        ("[ros]\ndomain = 3", &["node.toml:4: [ros] has no key `domain`; did you mean `domain_id`?"]),
        (
            "[[use]]\nfrom = 'b'\ntopic = '/a'\ncolour = 1",
            &[
                "node.toml:6: [[use]] has no key `colour`; it has `from`, `topic`, `service`, `action`, `parameters`, `except`, `as`, `namespace`, `frame_prefix`, `type`, `publish`, `priority`, `max_rate`, `max_bandwidth`, `max_age`, `compress`, `encoding`, `reliability`, `durability`, `history`, `depth`, `deadline`, `lifespan`, `token`, `deadman`, `link`",
            ],
        ),
        ("\n\n[shares]\na = 1", &["node.toml:5: the top level has no key `shares`; did you mean `share`?"]),
        ("[[user]]", &["node.toml:3: the top level has no key `user`; did you mean `use`?"]),
        (
            "node.router = ['quic://s:1']",
            &["node.toml:3: [node] has no key `router`; did you mean `routers`?"],
        ),
        (
            "[[share]]\ntopic = '/a'\nto = ['b']\nlisten = []",
            &["node.toml:6: [[share]] has no key `listen`; it belongs in [gateway] or [router] or [metrics]"],
        ),
        (
            "[[use]]\nfrom = 'b'\ntopic = '/a'\nto = ['c']",
            &["node.toml:6: [[use]] has no key `to`; it belongs in [[share]]"],
        ),
        (
            "[ros]\nidentity = 'y'",
            &["node.toml:4: [ros] has no key `identity`; it belongs in the top level or [node]"],
        ),
    ]);
    // A misspelt key is not reported as missing as well.
    assert_eq!(
        said_of_whole("[nod]\nname = 'a'"),
        ["node.toml:1: the top level has no key `nod`; did you mean `node`?"]
    );
    assert_eq!(
        said_of_whole("identiti = 'a'\n[node]\nroutes = []"),
        [
            "node.toml:1: the top level has no key `identiti`; did you mean `identity`?",
            "node.toml:3: [node] has no key `routes`; did you mean `routers`?",
        ]
    );
}

#[test]
fn planned_keys_are_called_planned() {
    for table in Table::ALL {
        for key in table.planned_keys() {
            let text = match table {
                Table::Share => format!("[[share]]\ntopic = '/a'\nto = ['b']\n{key} = 1"),
                Table::Use => format!("[[use]]\nfrom = 'b'\ntopic = '/a'\n{key} = 1"),
                Table::Ros => format!("\n\n[ros]\n{key} = 1"),
                _ => format!("\n\n\n[{key}]"),
            };
            let expected = format!("node.toml:6: `{key}` is planned but not in this version; take it out");
            assert_eq!(said_about(&text), [expected]);
        }
    }
}

#[test]
fn a_table_is_about_a_topic_a_service_an_action_or_parameters() {
    let config = good(&format!(
        "{NODE}[[share]]\ntopic = '/a'\nto = ['b']\n[[share]]\nservice = '/a'\nto = ['b']\ntype = \
         'std_srvs::srv::dds_::Empty_'\n[[share]]\naction = '/a'\nto = ['b']\ntype = 'p/action/T'\n[[share]]\n\
         parameters = '/n'\nto = ['b']\n[[use]]\nfrom = 'b'\nservice = '/s'\npriority = 'realtime'"
    ));
    let interfaces: Vec<_> =
        config.shares.iter().map(|s| (s.interface.key(), s.type_name.as_deref())).collect();
    let expected = [
        ("topic", None),
        ("service", Some("std_srvs/srv/Empty")),
        ("action", Some("p/action/T")),
        ("parameters", None),
    ];
    assert_eq!((&interfaces[..], config.uses[0].interface.key()), (&expected[..], "service"));
    check_all(&[
        (
            "[[share]]\ntopic = '/a'\nservice = '/b'\nto = ['b']",
            &[
                "node.toml:5: `service` stands beside `topic`: a table is about one of them; make it two tables",
            ],
        ),
        (
            "[[share]]\nto = ['b']",
            &["node.toml:3: [[share]] has no `topic`; add one, such as topic = \"/camera/image\""],
        ),
        (
            "[[use]]\nfrom = 'b'\naction = '/a'\ntype = 'p/msg/T'\nmax_rate = '1Hz'\npublish = true",
            &[
                "node.toml:6: `type` is \"p/msg/T\"; the type of `action` is spelt like \
                 \"nav2_msgs/action/NavigateToPose\"",
                "node.toml:7: `max_rate` is for topics, and this is about `action`: take it out",
                "node.toml:8: `publish` is for topics, and this is about `action`: take it out",
            ],
        ),
        (
            "[[share]]\nparameters = '/a'\nto = ['b']\ntype = 'p/srv/T'",
            &["node.toml:6: `type` is for topics, and this is about `parameters`: take it out"],
        ),
        (
            "[[share]]\nservice = '/a'\nto = ['b']\n[[share]]\nservice = '/a'\nto = ['c']",
            &[
                "node.toml:7: `service` is \"/a\", which line 4 shares already: make it one share and join the \
                 recipients",
            ],
        ),
    ]);
}

#[test]
fn a_topic_has_the_type_of_a_message() {
    check_all(&[(
        "[[share]]\ntopic = '/a'\nto = ['b']\ntype = 'std_srvs/srv/Empty'",
        &[
            "node.toml:6: `type` is \"std_srvs/srv/Empty\"; the type of `topic` is spelt like \"std_msgs/msg/String\"",
        ],
    )]);
}

#[test]
fn a_use_may_have_a_dead_man_switch() {
    let uses = good(&format!(
        "{NODE}[[use]]\nfrom = 'b'\ntopic = '/a'\ndeadman = {{ after = '300ms', publish = 'zero' }}\n\
         [[use]]\nfrom = 'b'\ntopic = '/b'\n[use.deadman]\nafter = '1s'\npublish = 'stop.json'\nrepeat = '100ms'\n\
         resume = 'manual'\n[[use]]\nfrom = 'b'\ntopic = '/c'"
    ))
    .uses;
    let ms = Duration::from_millis;
    let first = DeadManConfig { after: ms(300), stop: StopSource::Zero, repeat: None, resume: Resume::Auto };
    let second = DeadManConfig {
        after: ms(1000),
        stop: StopSource::File("/etc/sgc/stop.json".into()),
        repeat: Some(ms(100)),
        resume: Resume::Manual,
    };
    let switches: Vec<_> = uses.into_iter().map(|one| one.dead_man).collect();
    assert_eq!(switches, [Some(first.clone()), Some(second), None]);

    let text = "[[share]]\ntopic = '/a'\ntype = 'p/msg/M'\nto = ['b']\npublish = ['b']\n";
    let shares = good(&format!("{NODE}{text}[share.deadman]\nafter = '300ms'\npublish = 'zero'")).shares;
    assert_eq!(shares[0].dead_man, Some(first));
    assert_eq!(good(&format!("{NODE}{text}")).shares[0].dead_man, None);
}

#[test]
fn names_may_be_patterns_and_others_elsewhere() {
    let config = good(&format!(
        "{NODE}[[share]]\ntopic = '/camera/**'\nexcept = ['/camera/debug/**', '/camera/raw']\nas = '/r/cam/**'\nto = ['b']\n\
         [[share]]\ntopic = '/a'\nnamespace = '/r'\nto = ['b']\n\
         [[use]]\nfrom = 'b'\ntopic = '/**'\nnamespace = '/b'\nframe_prefix = 'b/'\n\
         [[use]]\nfrom = 'b'\ntopic = '/a'\nas = '/b_a'\n\
         [[use]]\nfrom = 'b'\ntopic = '/*/cmd'\n[[use]]\nfrom = 'b'\ntopic = '/*/cmd'\npublish = true"
    ));
    let expected = Naming {
        except: vec!["/camera/debug/**".into(), "/camera/raw".into()],
        rename: Rename::As("/r/cam/**".into()),
    };
    assert_eq!((config.shares[0].topic.as_str(), &config.shares[0].naming), ("/camera/**", &expected));
    assert_eq!(config.shares[1].naming.rename, Rename::Namespace("/r".into()));
    let share_of = |topic| config.share_of(topic).map(|share| share.topic.as_str());
    assert_eq!((share_of("/a"), share_of("/camera/x")), (Some("/a"), Some("/camera/**")));
    for topic in ["/camera/raw", "/camera/debug/x", "/camera/_action/status", "/camera", "/b"] {
        assert_eq!(share_of(topic), None, "{topic}");
    }
    assert_eq!(config.uses[0].naming.rename, Rename::Namespace("/b".into()));
    assert_eq!(config.uses[0].frame_prefix.as_deref(), Some("b/"));
    assert_eq!(config.uses[1].naming.rename, Rename::As("/b_a".into()));
}

#[test]
fn compression_applies_to_shares_only() {
    for (word, encoding) in
        [("zstd", PayloadEncoding::Zstd), ("lz4", PayloadEncoding::Lz4), ("none", PayloadEncoding::Plain)]
    {
        let config = good(&format!(
            "{NODE}[[share]]\ntopic = '/a'\nto = ['b']\ncompress = '{word}'\n\
             [[use]]\nfrom = 'b'\ntopic = '/b'\npublish = true\ncompress = '{word}'"
        ));
        let found = (config.shares[0].shaping.compression, config.uses[0].shaping.compression);
        assert_eq!(found, (encoding, encoding));
    }
    check_all(&[
        (
            "[[share]]\ntopic = '/a'\nto = ['b']\ncompress = 'zst'",
            &[
                "node.toml:6: `compress` is \"zst\"; did you mean \"zstd\"? It takes \"zstd\", \"lz4\", \"none\"",
            ],
        ),
        (
            "[[use]]\nfrom = 'b'\ntopic = '/a'\ncompress = 'lz4'",
            &[
                "node.toml:6: `compress` is for what this node publishes there: what comes here is compressed as the owner's share says; set `publish = true`, or take it out",
            ],
        ),
    ]);
}

#[test]
fn topics_that_leave_may_travel_as_json_and_nothing_else() {
    for (word, form) in [("cdr", PayloadForm::Cdr), ("json", PayloadForm::Json)] {
        let config = good(&format!(
            "{NODE}[[share]]\ntopic = '/a'\nto = ['b']\nencoding = '{word}'\n\
             [[use]]\nfrom = 'b'\ntopic = '/b'\npublish = true\nencoding = '{word}'"
        ));
        assert_eq!((config.shares[0].shaping.form, config.uses[0].shaping.form), (form, form));
    }
    check_all(&[
        (
            "[[share]]\ntopic = '/a'\nto = ['b']\nencoding = 'jsn'",
            &["node.toml:6: `encoding` is \"jsn\"; did you mean \"json\"? It takes \"cdr\", \"json\""],
        ),
        (
            "[[share]]\nservice = '/a'\nto = ['b']\nencoding = 'json'",
            &["node.toml:6: `encoding` is for topics, and this is about `service`: take it out"],
        ),
        (
            "[[use]]\nfrom = 'b'\ntopic = '/a'\nencoding = 'json'",
            &[
                "node.toml:6: `encoding` is for what this node publishes there: what comes here is written as the owner's share says, and every node reads both; set `publish = true`, or take it out",
            ],
        ),
    ]);
}

#[test]
fn names_that_do_not_fit_together_are_told() {
    let share = |keys: &str| format!("[[share]]\nto = ['b']\n{keys}");
    let one = |keys: &str, said: &str| assert_eq!(said_about(&share(keys)), [format!("node.toml:{said}")]);
    one(
        "topic = '/cam*'",
        "5: `topic` is \"/cam*\"; a wildcard is a whole word of a name: '*' for one word, '**' for any number: \"/*\"",
    );
    one("topic = '/a//**'", "5: `topic` is \"/a//**\"; a topic name has no '//'");
    one(
        "topic = '/a'\nexcept = ['/b']",
        "6: `except` is for a `topic` with wildcards, and \"/a\" has none: take it out",
    );
    one(
        "topic = '/a/*'\nexcept = ['/b/c']",
        "6: `except` names \"/b/c\", which \"/a/*\" does not cover anyway: take it out, or correct it",
    );
    one("topic = '/a/*'\nexcept = ['/a/c', '/a/c']", "6: `except` names \"/a/c\" twice; once is enough");
    let both = "both end in the same wildcard, or neither has one";
    let needs = "another name needs a topic whose only wildcard is its last word; use `namespace`";
    for (topic, other, right) in [
        ("/a/**", "/b", format!("{both}: \"/b/**\"")),
        ("/a/**", "/b/*", format!("{both}: \"/b/**\"")),
        ("/a", "/b/**", format!("{both}: \"/b\"")),
        ("/*/a", "/b/a", needs.to_owned()),
        ("/*/a/*", "/b/*", needs.to_owned()),
        ("/a/*", "/*/*", needs.to_owned()),
    ] {
        one(
            &format!("topic = '{topic}'\nas = '{other}'"),
            &format!("6: `as` is \"{other}\", but the topic is \"{topic}\": {right}"),
        );
    }
    one(
        "topic = '/a'\nas = '/b'\nnamespace = '/c'",
        "7: `namespace` stands beside `as`, which gives the whole name: take one of them out",
    );
    one("topic = '/a'\nnamespace = 'c'", "6: `namespace` is \"c\"; a topic name starts with '/': \"/c\"");
    one(
        "topic = '/a/*'\ntype = 'p/msg/T'\npublish = ['b']",
        "7: `publish` lets others publish, which needs the name of one topic, not \"/a/*\": add a [[share]] for it",
    );
    let long = "w".repeat(200);
    let said = said_about(&share(&format!("topic = '/{long}'\nnamespace = '/{long}'")));
    assert!(said.len() == 1 && said[0].contains("at most 247 bytes"), "{said:?}");
    check_all(&[
        (
            "[[share]]\ntopic = '/a'\nto = ['b']\nas = '/c'\n[[share]]\ntopic = '/b'\nto = ['b']\nas = '/c'",
            &[
                "node.toml:8: `topic`: for others it would be \"/c\", as which line 4 is shared already: change one name",
            ],
        ),
        (
            "[[use]]\nfrom = 'b'\ntopic = '/tf'\nframe_prefix = '/b'",
            &[
                "node.toml:6: `frame_prefix` is \"/b\"; it takes 1 to 64 letters, digits, '_', '-', '.' and '/', and no '/' at the beginning: \"robot1/\"",
            ],
        ),
        (
            "[[use]]\nfrom = 'b'\ntopic = '/tf'\nframe_prefix = 'b/'\npublish = true",
            &["node.toml:6: `frame_prefix` is for what comes here: take it out, or `publish`"],
        ),
        (
            "[[use]]\nfrom = 'b'\ntopic = '/**'\ndeadman = { after = '5ms', publish = 'halt', repeat = 'x', resume = 'car', of = 1 }",
            &[
                "node.toml:6: [use.deadman] has no key `of`; it has `after`, `publish`, `repeat`, `resume`",
                "node.toml:6: `deadman` is for one topic, and \"/**\" may match several: name the topic of commands",
                "node.toml:6: `after` is \"5ms\"; it takes a length of time, \"20ms\" to \"60s\": \"300ms\", \"1s\"",
                "node.toml:6: `publish` is \"halt\"; it takes \"zero\", \"last\", \"FILE.json\"",
                "node.toml:6: `repeat` is \"x\"; it takes a length of time, \"20ms\" to \"60s\": \"300ms\", \"1s\"",
                "node.toml:6: `resume` is \"car\"; it takes \"auto\", \"manual\"",
            ],
        ),
        (
            "[[share]]\ntopic = '/a'\nto = ['b']\ndeadman = { after = '1s', publish = 'last', of = 1 }",
            &[
                "node.toml:6: [share.deadman] has no key `of`; it has `after`, `publish`, `repeat`, `resume`",
                "node.toml:6: `deadman` is for commands that others publish: add them with `publish = [\"desk\"]`, or take it out",
            ],
        ),
        (
            "[[use]]\nfrom = 'b'\nservice = '/a'\ndeadman = {}",
            &[
                "node.toml:6: [use.deadman] has no `after`; add one, such as after = \"300ms\"",
                "node.toml:6: [use.deadman] has no `publish`; add one, such as publish = \"zero\"",
                "node.toml:6: `deadman` is for topics, and this is about `service`: take it out",
            ],
        ),
        (
            "[[use]]\nfrom = 'b'\ntopic = '/**'\n[[use]]\nfrom = 'b'\ntopic = '/**'",
            &["node.toml:8: `topic` is \"/**\" from \"b\", which line 5 uses already: take one of them out"],
        ),
        (
            "[[share]]\ntopic = '/b'\nto = ['b']\n[[use]]\nfrom = 'b'\ntopic = '/a'\nas = '/b'",
            &[
                "node.toml:8: `topic` is \"/b\", which line 4 shares: what is used here would be shared again, in a loop; keep one",
            ],
        ),
    ]);
    // The local name would make the loop.
    good(&format!("{NODE}[[share]]\ntopic = '/a'\nto = ['b']\n[[use]]\nfrom = 'b'\ntopic = '/a'\nas = '/b'"));
}

#[test]
fn tables_and_values_of_the_wrong_type_are_told() {
    check_all(&[
        (
            "[share]\ntopic = '/a'",
            &["node.toml:3: `share` is one table but may occur many times; write [[share]]"],
        ),
        ("[[ros]]", &["node.toml:3: `ros` is an array of tables but may occur only once; write [ros]"]),
        ("admin = 5", &["node.toml:3: `admin` is an integer (5) but may occur only once; write [admin]"]),
        (
            "use = ['a']",
            &[
                "node.toml:3: `use` is a string ('a'); it takes tables: [[share]], [[use]], [[partner]] or [[gateway.client]], and the keys below",
            ],
        ),
        (
            "[ros]\ndomain_id = '0'",
            &["node.toml:4: `domain_id` is a string ('0'); it takes a number, such as 7"],
        ),
        (
            "[ros]\nlocalhost_only = 1",
            &["node.toml:4: `localhost_only` is an integer (1); it takes true or false"],
        ),
        (
            "[[share]]\ntopic = '/a'\nto = 'desk'",
            &["node.toml:5: `to` is a string ('desk'); it takes an array of strings, such as [\"desk\", \
               \"group:operators\"]"],
        ),
        (
            "[[share]]\ntopic = '/a'\nto = [\n  'desk',\n  7,\n]",
            &[
                "node.toml:7: `to` is an integer (7); it takes an array of strings, such as [\"desk\", \"group:operators\"]",
            ],
        ),
    ]);
}

#[test]
fn missing_required_keys_are_reported() {
    check_all(&[
        (
            "[[share]]",
            &[
                "node.toml:3: [[share]] has no `topic`; add one, such as topic = \"/camera/image\"",
                "node.toml:3: [[share]] has no `to`; add one, such as to = [\"desk\", \"group:operators\"]",
            ],
        ),
        (
            "\n[[use]]",
            &[
                "node.toml:4: [[use]] has no `from`; add one, such as from = \"arm-1\"",
                "node.toml:4: [[use]] has no `topic`; add one, such as topic = \"/camera/image\"",
            ],
        ),
    ]);
    assert_eq!(
        said_of_whole(""),
        [
            "node.toml: neither `identity` nor `name` in [node] is given: every link is authenticated, so a node needs an \
             identity file",
            "node.toml: neither `routers` in [node] nor `listen` in [router] is given, so this node connects to nobody: \
             name a router (\"quic://router.lab.example:7447\") or listen as one (\"quic://0.0.0.0:7447\")",
        ]
    );
    assert_eq!(
        said_of_whole("identity = ''\nrouter.listen = ['quic://0.0.0.0:1']"),
        ["node.toml:1: `identity` is empty; give it a value, such as \"arm-1.identity\""]
    );
    assert_eq!(
        said_about("node.identity = 'y'"),
        ["node.toml:3: `identity` is given on line 1 already; keep one"]
    );
}

#[test]
fn topics_follow_the_rules_of_ros() {
    for (topic, said) in [
        ("chatter", "a topic name starts with '/': \"/chatter\""),
        ("camera/image", "a topic name starts with '/': \"/camera/image\""),
        ("rt/chatter", "a topic name starts with '/': \"/chatter\""),
        ("", "a topic name has at least one word after a '/'"),
        ("/", "a topic name has at least one word after a '/'"),
        ("/a/", "a topic name does not end with '/': \"/a\""),
        ("/a//b", "a topic name has no '//': \"/a/b\""),
        ("/a-b", "a topic name has letters, digits, '_' and '/', not '-': \"/a_b\""),
        ("/ä", "a topic name has letters, digits, '_' and '/', not 'ä'"),
        ("/a\\u0000", "a topic name has letters, digits, '_' and '/', not '\\0'"),
        ("/2d/scan", "no word of a topic name starts with a digit"),
        ("~/a", "'~' stands for the name of a ROS node, which is not known here: write the name in full"),
    ] {
        let text = format!("[[share]]\ntopic = \"{topic}\"\nto = ['b']");
        let shown = topic.replace("\\u0000", "\\0");
        assert_eq!(said_about(&text), [format!("node.toml:4: `topic` is \"{shown}\"; {said}")], "{topic}");
    }
    let longest = format!("/{}", "a".repeat(246));
    good(&format!("{NODE}[[share]]\ntopic = '{longest}'\nto = ['b']"));
    let said = said_about(&format!("[[use]]\nfrom = 'b'\ntopic = '{longest}a'"));
    assert!(said[0].ends_with("a topic name has at most 247 bytes"), "{said:?}");
}

#[test]
fn types_have_the_form_of_ros() {
    for (name, right) in [
        ("String", "\"std_msgs/msg/String\", for example"),
        ("sensor_msgs/Image", "\"sensor_msgs/msg/Image\""),
        ("sensor_msgs.msg.Image", "\"sensor_msgs/msg/Image\""),
        ("sensor_msgs::msg::Image", "\"sensor_msgs/msg/Image\""),
        ("sensor_msgs::msg::dds_::Image", "\"std_msgs/msg/String\", for example"),
        ("a/msg/", "\"std_msgs/msg/String\", for example"),
    ] {
        let text = format!("[[use]]\nfrom = 'b'\ntopic = '/a'\ntype = '{name}'");
        let said = format!("node.toml:6: `type` is \"{name}\"; a message type is PACKAGE/msg/NAME: {right}");
        assert_eq!(said_about(&text), [said]);
    }
}

#[test]
fn addresses_are_checked() {
    for (url, said) in [
        ("router:7447", "\"router:7447\" has no transport in front: write quic://HOST or quic://HOST:PORT"),
        ("quic://router:0", "\"0\" is not a port number"),
        ("quic://router:65536", "\"65536\" is not a port number"),
        (
            "quic://10.0.0.256:1",
            "\"10.0.0.256\" is neither a host name nor an IP address (IPv6 is written in brackets)",
        ),
        ("quic://::1", "\"::1\" is neither a host name nor an IP address (IPv6 is written in brackets)"),
        ("quic://0.0.0.0:7447", "0.0.0.0 can be listened at but not dialled: name the router's host"),
        ("http://router/x", "http:// is not known: it takes quic://HOST:PORT, srv://DOMAIN and mdns://"),
        (
            "srv://",
            "after srv:// comes the domain whose _sgc._udp records name routers: \"srv://lab.example\"",
        ),
        ("srv://lab.example:7447", "the SRV records say the port: write \"srv://lab.example\""),
        (
            "srv://10.0.0.1",
            "10.0.0.1 is an address, which DNS has no SRV records of: write \"quic://10.0.0.1\"",
        ),
        ("srv://_sgc._udp.lab.example", "_sgc._udp is put in front by itself: write \"srv://lab.example\""),
        (
            "mdns://Cloud",
            "after mdns:// comes nothing, for any router that this node trusts, or a router's name: \"mdns://cloud\"",
        ),
    ] {
        let said = format!("node.toml:1: `routers` is {url:?}; {said}");
        assert_eq!(said_of_whole(&format!("node = {{ name = 'a', routers = ['{url}'] }}")), [said]);
    }
    check_all(&[(
        "[router]\nlisten = ['quic://router.lab.example:7447']",
        &[
            "node.toml:4: `listen` is \"quic://router.lab.example:7447\"; \"router.lab.example\" is no IP address to listen \
             on: [::] and 0.0.0.0 stand for every interface",
        ],
    )]);
    assert_eq!(
        said_of_whole("node = { name = 'a', routers = ['quic://r:7447', 'quic://r'] }"),
        ["node.toml:1: `routers` names \"quic://r\" twice; once is enough"]
    );
    for server in ["dns.lab.example", "10.0.0.53:0", "0.0.0.0", "::1:53:x", ""] {
        let said = format!(
            "node.toml:1: `resolver` is {server:?}; it takes the IP address of a DNS server, with its port unless that is \
             53: \"10.0.0.53\", \"127.0.0.1:5353\" or \"[::1]:5353\""
        );
        let text = format!("node = {{ name = 'a', routers = ['srv://a'], resolver = '{server}' }}");
        assert_eq!(said_of_whole(&text), [said]);
    }
}

#[test]
fn topics_say_how_much_of_them_goes_on() {
    const SHARE: &str = "[[share]]\ntopic = '/a'\nto = ['b']\n";
    let shaped = |text: &str| good(&format!("{NODE}{SHARE}{text}")).shares[0].shaping;
    let shaping = shaped("max_rate = '10Hz'\nmax_bandwidth = '2Mbps'\nmax_age = '500ms'");
    assert_eq!(shaping.interval, Some(Duration::from_millis(100)));
    assert_eq!((shaping.bits_per_s, shaping.max_age), (Some(2_000_000), Some(Duration::from_millis(500))));
    assert_eq!(shaped("max_rate = '0.5Hz'\nmax_age = '2s'").interval, Some(Duration::from_secs(2)));
    assert_eq!(shaped(""), Shaping::default());
    let used = "[[use]]\nfrom = 'b'\ntopic = '/a'\npublish = true\npriority = 'realtime'\nmax_rate = '50Hz'";
    let one = &good(&format!("{NODE}{used}")).uses[0];
    assert_eq!(
        (one.priority, one.shaping.interval),
        (Some(Class::Realtime), Some(Duration::from_millis(20)))
    );
    for (key, values) in [
        ("max_rate", ["10", "0Hz", "-1Hz", "1e3Hz", "NaNHz", "infHz", "100000Hz"].as_slice()),
        ("max_bandwidth", &["2", "0kbps", "2MB", "2000Gbps"]),
        ("max_age", &["0ms", "5", "2h", "99999999999999999999999ms"]),
    ] {
        for value in values {
            let said = said_about(&format!("{SHARE}{key} = '{value}'"));
            assert!(
                said.len() == 1 && said[0].contains(&format!("`{key}` is {value:?}; it takes")),
                "{said:?}"
            );
        }
    }
    let said = said_about("[[use]]\nfrom = 'b'\ntopic = '/a'\npriority = 'bulk'");
    assert!(said.len() == 1 && said[0].contains("set `publish = true`"), "{said:?}");
    let said = said_about("[[use]]\ntoken = 'a.token'\nmax_rate = '1Hz'");
    assert!(said.iter().any(|s| s.contains("`max_rate` cannot stand beside `token`")), "{said:?}");
}

#[test]
fn transports_are_set_by_a_table_of_their_own() {
    let set = |text: &str| good(&format!("{NODE}[transport]\n{text}")).transport;
    assert_eq!((good(NODE).transport, set("")), (TransportConfig::default(), TransportConfig::default()));
    let all = "congestion = 'cubic'\noffload = false\nmtu_discovery = false\nbulk_lanes = false\ndtls_1_2 = true\ndscp = 'CS1'\nlane_dscp = 'AF41'";
    let expected = TransportConfig {
        congestion: Congestion::Cubic,
        offload: false,
        mtu_discovery: false,
        bulk_lanes: false,
        dtls12: true,
        dscp: Some(8),
        lane_dscp: Some(34),
    };
    assert_eq!(set(all), expected);
    for (text, mark) in
        [("EF", 46), ("CS0", 0), ("CS7", 56), ("AF11", 10), ("AF43", 38), ("0", 0), ("63", 63)]
    {
        assert_eq!(set(&format!("dscp = '{text}'")).dscp, Some(mark), "{text}");
    }
    for wrong in ["", "CS8", "AF40", "AF01", "AF14", "ef", "64", "007", "CS", "EF "] {
        let said = said_about(&format!("[transport]\ndscp = '{wrong}'"));
        assert!(
            said.len() == 1 && said[0].contains("it takes a class of differentiated services"),
            "{said:?}"
        );
    }
    let said = said_about("[transport]\ncongestion = 'cubik'");
    assert!(said[0].contains("did you mean \"cubic\"?"), "{said:?}");
}

#[test]
fn direct_links_are_for_all_for_none_or_for_the_named() {
    let direct = |text: &str| good(&format!("{NODE}node.direct = {text}")).direct;
    let words = |peers: Vec<Recipient>| peers.iter().map(ToString::to_string).collect::<Vec<_>>();
    assert_eq!(words(good(NODE).direct), ["*"]);
    assert_eq!(words(direct("'auto'")), ["*"]);
    assert!(direct("'never'").is_empty() && direct("[]").is_empty());
    assert_eq!(words(direct("['group:operators', 'desk']")), ["group:operators", "desk"]);
    let acme = "[[partner]]\nname = 'acme'\nca = 'acme.pem'\n";
    assert_eq!(
        words(good(&format!("{NODE}node.direct = ['*', 'partner:acme']\n{acme}")).direct),
        ["*", "partner:acme"]
    );
    for wrong in ["'always'", "true", "['partner:acme']", "['desk', 'desk']", "['']"] {
        let said = said_about(&format!("node.direct = {wrong}"));
        assert!(said.len() == 1 && said[0].contains("direct"), "{said:?}");
    }
}

#[test]
fn ports_are_mapped_unless_the_file_says_otherwise() {
    let maps = |text: &str| good(&format!("{NODE}{text}")).port_mapping;
    assert!(maps("") && maps("node.port_mapping = true") && !maps("node.port_mapping = false"));
    let said = said_about("node.port_mapping = 'upnp'");
    assert!(said.len() == 1 && said[0].contains("port_mapping"), "{said:?}");
}

#[test]
fn keep_alive_is_a_time_or_left_to_the_node() {
    let kept = |text: &str| good(&format!("{NODE}node.keep_alive = '{text}'")).keep_alive;
    assert_eq!(good(NODE).keep_alive, None);
    let seconds = |text: &str| kept(text).map(|time| time.as_secs());
    assert_eq!((seconds("auto"), seconds("5s"), seconds("1min")), (None, Some(5), Some(60)));
    for wrong in ["0s", "61s", "5", "often"] {
        let said = said_about(&format!("node.keep_alive = '{wrong}'"));
        assert!(said.len() == 1 && said[0].contains("keep_alive") && said[0].contains(wrong), "{said:?}");
    }
}

#[test]
fn routers_are_found_in_three_ways() {
    let config = good(
        "[node]\nidentity = 'a'\nrouters = ['quic://r', 'srv://Lab.Example.', 'mdns://', 'mdns://cloud']\n\
         resolver = '10.0.0.53'",
    );
    let expected = ["quic://r:7447", "srv://lab.example", "mdns://", "mdns://cloud"];
    assert_eq!(texts(&config.routers), expected);
    assert_eq!(config.resolver, Some("10.0.0.53:53".parse().unwrap()));
    let config = good("node.routers = [['quic://a', 'quic://b:443'], 'quic://c']\nidentity = 'a'");
    assert_eq!(texts(&config.routers), ["quic://a:7447,quic://b:443", "quic://c:7447"]);
    for wrong in ["[['quic://a', 1]]", "[[]]", "[['quic://a', 'mdns://']]", "[['quic://a', 'quic://a']]"] {
        let errors = said_of_whole(&format!("identity = 'a'\nnode.routers = {wrong}"));
        assert_eq!(errors.len(), 1, "{errors:?}");
    }
    for (text, addr) in [("127.0.0.1:5353", "127.0.0.1:5353"), ("::1", "[::1]:53"), ("[::1]:5", "[::1]:5")] {
        let config = good(&format!("{NODE}node.resolver = '{text}'"));
        assert_eq!(config.resolver, Some(addr.parse().unwrap()), "{text}");
    }
}

#[test]
fn a_router_says_who_may_attach_and_whether_it_is_told_of() {
    let text = "identity = 'r'\n[router]\nlisten = ['quic://0.0.0.0:7447']\nannounce = true\n\
                accept = ['a-ca.pem', 'b-ca.pem']";
    let config = good(text);
    assert!(config.announce && config.is_pure_router());
    assert_eq!(config.accept, [Path::new("/etc/sgc/a-ca.pem"), Path::new("/etc/sgc/b-ca.pem")]);
    assert!(!good(NODE).announce && good(NODE).accept.is_empty());
    check_all(&[
        (
            "[router]\nannounce = true\naccept = ['a.pem']",
            &[
                "node.toml:4: `announce` is on, but `listen` in [router] is not given, so nobody could connect: add an \
                 address, such as \"quic://0.0.0.0:7447\"",
                "node.toml:5: `accept` says whose nodes may attach, but `listen` in [router] is not given, so nobody can: \
                 take it out, or listen",
            ],
        ),
        (
            "[router]\nlisten = ['mdns://']",
            &["node.toml:4: `listen` is \"mdns://\", which finds routers: listen at an address \
                 (\"quic://0.0.0.0:7447\"), and be found on the local network with `announce`"],
        ),
        (
            "[router]\nlisten = ['quic://0.0.0.0:1']\naccept = []",
            &[
                "node.toml:5: `accept` is empty; give it a value, such as accept = [\"lab-ca.pem\"], or leave it out to \
                 accept every CA that is trusted here",
            ],
        ),
        (
            "[router]\nlisten = ['quic://0.0.0.0:1']\naccept = ['a.pem', 'a.pem']\nannounce = 'yes'",
            &[
                "node.toml:5: `accept` names \"a.pem\" twice; once is enough",
                "node.toml:6: `announce` is a string ('yes'); it takes true or false",
            ],
        ),
    ]);
}

#[test]
fn recipients_and_nodes_are_checked() {
    check_all(&[
        (
            "[[share]]\ntopic = '/a'\nto = []",
            &[
                "node.toml:5: `to` is empty, so nobody may subscribe: name nodes (\"desk\"), groups (\"group:operators\") or \
               \"*\"",
            ],
        ),
        (
            "[[share]]\ntopic = '/a'\nto = ['grp:ops', 'group:']",
            &[
                "node.toml:5: `to` names \"grp:ops\"; name nodes (\"desk\"), groups (\"group:operators\"), partners \
               (\"partner:acme\") or \"*\", names of 1 to 64 of a-z, 0-9, '-', '_' and '.'",
                "node.toml:5: `to` names \"group:\"; name nodes (\"desk\"), groups (\"group:operators\"), partners \
               (\"partner:acme\") or \"*\", names of 1 to 64 of a-z, 0-9, '-', '_' and '.'",
            ],
        ),
        (
            "[[share]]\ntopic = '/a'\nto = ['b', 'c', 'b']",
            &["node.toml:5: `to` names \"b\" twice; once is enough"],
        ),
        (
            "[[share]]\ntopic = '/a'\nto = ['*', 'group:ops']",
            &[
                "node.toml:5: `to` names \"*\", which is every member of the fleet, and \"group:ops\" beside it: keep one of \
               them",
            ],
        ),
        (
            "node.name = 'me'\n[[share]]\ntopic = '/a'\nto = ['me']",
            &[
                "node.toml:6: `to` names only \"me\", which is this node: name those who may subscribe from elsewhere",
            ],
        ),
        (
            "node.name = 'me'\n[[use]]\ntopic = '/a'\nfrom = 'me'",
            &["node.toml:6: `from` is \"me\", which is this node: name the node that shares the topic"],
        ),
        (
            "node.name = 'Arm 1'",
            &[
                "node.toml:3: `name` is \"Arm 1\"; a node's name is 1 to 64 of a-z, 0-9, '-', '_' and '.', the first a \
               letter or digit: \"arm-1\"",
            ],
        ),
        (
            "[[use]]\ntopic = '/a'\nfrom = '*'",
            &[
                "node.toml:5: `from` is \"*\"; a node's name is 1 to 64 of a-z, 0-9, '-', '_' and '.', the first a letter \
               or digit: \"arm-1\"",
            ],
        ),
    ]);
}

#[test]
fn words_are_checked() {
    check_all(&[
        (
            "[[share]]\ntopic = '/a'\nto = ['b']\npriority = 'realtme'\nsuite = 'none'",
            &[
                "node.toml:6: `priority` is \"realtme\"; did you mean \"realtime\"? It takes \"realtime\", \"default\", \
               \"bulk\"",
                "node.toml:7: `suite` is \"none\"; it takes \"group\", \"group-chacha\", \"standard\", \"standard-chacha\", \
               \"paper\", \"paper-3072\", \"paper-chacha\", \"paper-3072-chacha\", \"pairwise\", \"pairwise-chacha\"",
            ],
        ),
        (
            "[ros]\ndiscovery_range = 'SUBNET'",
            &[
                "node.toml:4: `discovery_range` is \"SUBNET\"; did you mean \"subnet\"? It takes \"off\", \"localhost\", \
               \"subnet\", \"system_default\"",
            ],
        ),
    ]);
}

#[test]
fn suites_are_called_by_name() {
    assert_eq!(Suite::DEFAULT, Suite::Pairwise);
    for (name, id) in SUITES.iter().zip(1..) {
        let text = format!("[[share]]\ntopic = '/a'\nto = ['b']\nsuite = '{name}'");
        match Suite::from_id(id) {
            Some(suite) => assert_eq!(good(&format!("{NODE}{text}")).shares[0].suite, suite, "{name}"),
            None => assert!(said_about(&text)[0].contains("planned but not in this version"), "{name}"),
        }
    }
}

#[test]
fn publish_lists_use_the_syntax_of_subscribe_lists() {
    let config = good(&format!(
        "{NODE}[[share]]\ntopic = '/a'\ntype = 'p/msg/T'\nto = ['*', 'partner:acme']\npublish = ['desk', 'group:ops', 'partner:acme']\n\
         [[partner]]\nname = 'acme'\nca = 'acme.pem'"
    ));
    assert_eq!(texts(&config.shares[0].publish), ["desk", "group:ops", "partner:acme"]);
    assert_eq!(texts(&config.shares[0].to), ["*", "partner:acme"]);
    assert!(
        good(&format!("{NODE}[[share]]\ntopic = '/a'\ntype = 'p/msg/T'\nto = ['b']\npublish = []")).shares[0]
            .publish
            .is_empty()
    );
    check_all(&[(
        "[[share]]\ntopic = '/a'\ntype = 'p/msg/T'\nto = ['b']\npublish = ['b', 'b', 7]",
        &[
            "node.toml:7: `publish` is an integer (7); it takes an array of strings, such as [\"desk\", \
             \"group:operators\"]",
            "node.toml:7: `publish` names \"b\" twice; once is enough",
        ],
    )]);
    check_all(&[(
        "[[share]]\ntopic = '/a'\nto = ['b']\npublish = ['b']",
        &[
            "node.toml:6: `publish` lets others publish, so the share needs a `type`: no local publisher has to be \
           there to show it; add one, such as type = \"geometry_msgs/msg/Twist\"",
        ],
    )]);
}

#[test]
fn partners_are_described_once_and_completely() {
    let id = "ab".repeat(32);
    let config = good(&format!(
        "{NODE}[[partner]]\nname = 'acme'\nca = 'acme.pem'\nnode = '{id}'\n\
         [[partner]]\nname = 'bolt'\nca = '/ca/bolt.pem'\nnode = ['{id}', '{}']",
        "cd".repeat(32)
    ));
    assert_eq!(config.partners[0].ca, Path::new("/etc/sgc/acme.pem"));
    assert_eq!(texts(&config.partners[0].nodes), [id.as_str()]);
    assert_eq!(config.partners[1].nodes.len(), 2);
    check_all(&[
        (
            "[[partner]]",
            &[
                "node.toml:3: [[partner]] has no `name`; add one, such as name = \"acme\"",
                "node.toml:3: [[partner]] has no `ca`; add one, such as ca = \"acme-ca.pem\"",
            ],
        ),
        (
            "[[partner]]\nname = 'Acme'\nca = ''\nnode = 'arm-7'",
            &[
                "node.toml:4: `name` is \"Acme\"; a partner's name is 1 to 64 of a-z, 0-9, '-', '_' and '.', the first a \
                 letter or digit: \"acme\"",
                "node.toml:5: `ca` is empty; give it a value, such as \"acme-ca.pem\"",
                "node.toml:6: `node` names \"arm-7\"; a node id is 64 hexadecimal digits: `sgc status` there shows it",
            ],
        ),
        (
            "[[partner]]\nname = 'a'\nca = 'a'\n[[partner]]\nname = 'a'\nca = 'b'",
            &[
                "node.toml:7: `name` is \"a\", which line 4 describes already: make it one [[partner]] and join the nodes",
            ],
        ),
        (
            "[[share]]\ntopic = '/a'\nto = ['partner:acme']",
            &[
                "node.toml:5: `to` names partner \"acme\", which no [[partner]] describes: add [[partner]] with name = \
                 \"acme\" and ca = \"FILE\"",
            ],
        ),
        (
            "[[share]]\ntopic = '/a'\nto = ['partner:acme/arm-7']",
            &[
                "node.toml:5: `to` names \"partner:acme/arm-7\"; name nodes (\"desk\"), groups (\"group:operators\"), \
                 partners (\"partner:acme\") or \"*\", names of 1 to 64 of a-z, 0-9, '-', '_' and '.'",
            ],
        ),
        (
            "[[share]]\ntopic = '/a'\nto = ['partner:acne']\n[[partner]]\nname = 'acme'\nca = 'a'",
            &[
                "node.toml:5: `to` names partner \"acne\", which no [[partner]] describes (did you mean \"acme\"?): add \
                 [[partner]] with name = \"acne\" and ca = \"FILE\"",
            ],
        ),
    ]);
}

#[test]
fn a_rate_for_peers_is_taken_over() {
    assert_eq!(good(NODE).peer_rate, None);
    for (text, bits) in [("50Mbps", 50_000_000), ("64kbps", 64_000), ("1 Gbps", 1_000_000_000)] {
        assert_eq!(good(&format!("{NODE}[router]\npeer_rate = '{text}'")).peer_rate, Some(bits));
    }
    let right = "it takes a number with kbps, Mbps or Gbps (bits a second), from \"64kbps\" to \"1000Gbps\"";
    for text in ["63kbps", "1001Gbps", "50", "50mbps", "50MB", "-1Mbps", "99999999999999999999Gbps"] {
        let said = said_about(&format!("[router]\npeer_rate = '{text}'"));
        assert_eq!(said, [format!("node.toml:4: `peer_rate` is \"{text}\"; {right}")]);
    }
}

#[test]
fn trust_authority_rotation_and_audit_are_taken_over() {
    let config = good(
        r#"
        identity = "x"
        [node]
        routers = ["quic://r:7447"]
        state = "state"
        trust = ["old-ca.pem", "/ca/other.pem"]
        [authority]
        fleet = "lab.fleet"
        operators = ["group:operators", "desk"]
        [rotation]
        every = "15min"
        messages = 4096
        [audit]
        file = "/var/log/sgc.jsonl"
        max_bytes = 1048576
        files = 99
        "#,
    );
    assert_eq!(config.state.as_deref(), Some(Path::new("/etc/sgc/state")));
    assert_eq!(config.trust, [Path::new("/etc/sgc/old-ca.pem"), Path::new("/ca/other.pem")]);
    let authority = config.authority.unwrap();
    assert_eq!(authority.fleet, Path::new("/etc/sgc/lab.fleet"));
    let operators: Vec<_> = authority.operators.iter().map(ToString::to_string).collect();
    assert_eq!(operators, ["group:operators", "desk"]);
    let every = std::time::Duration::from_secs(900);
    assert_eq!(config.rotation, RotationConfig { every, messages: 4096 });
    let file = Some(PathBuf::from("/var/log/sgc.jsonl"));
    assert_eq!(
        config.audit,
        AuditConfig { file, room: AuditRoom { max_bytes: 1 << 20, files: 99 }, off: false }
    );
    let plain = good(NODE);
    assert_eq!(plain.rotation.every, std::time::Duration::from_secs(3600));
    assert_eq!(
        (plain.rotation.messages, plain.audit.room),
        (1 << 24, AuditRoom { max_bytes: 16 << 20, files: 8 })
    );
    assert!(good(&format!("{NODE}[audit]\noff = true")).audit.off);
    let duration = "it takes a number with s, min, h or d, from \"10s\" to \"30d\"";
    for (every, said) in
        [("9s", duration), ("31d", duration), ("1", duration), ("1w", duration), ("-1h", duration)]
    {
        let text = format!("[rotation]\nevery = '{every}'");
        assert_eq!(said_about(&text), [format!("node.toml:4: `every` is \"{every}\"; {said}")]);
    }
    check_all(&[
        (
            "[rotation]\nmessages = 5",
            &["node.toml:4: `messages` is 5; it takes a number of messages from 1024 to 4294967296"],
        ),
        (
            "[audit]\nmax_bytes = -1",
            &["node.toml:4: `max_bytes` is -1; it takes a number of bytes from 65536 to 1099511627776"],
        ),
        ("[audit]\nfiles = 0", &["node.toml:4: `files` is 0; it takes a number of files from 1 to 99"]),
        (
            "[audit]\noff = true\nfiles = 3",
            &["node.toml:5: `off` is true, but `files` is given: take one of them out"],
        ),
        (
            "[audit]\noff = true\nfile = 'x'",
            &["node.toml:5: `off` is true, but `file` is given: take one of them out"],
        ),
        (
            "[authority]\nfleet = 'a.fleet'\noperators = ['group:ops', '*', 'partner:acme']",
            &[
                "node.toml:5: `operators` names \"*\": operators change the fleet itself, so each is a node (\"desk\") or a \
                 group (\"group:operators\") of it",
                "node.toml:5: `operators` names \"partner:acme\": operators change the fleet itself, so each is a node \
                 (\"desk\") or a group (\"group:operators\") of it",
            ],
        ),
        ("[authority]", &["node.toml:3: [authority] has no `fleet`; add one, such as fleet = \"lab.fleet\""]),
        ("node.trust = ['a', 'a']", &["node.toml:3: `trust` names \"a\" twice; once is enough"]),
        (
            "node.state = ''",
            &["node.toml:3: `state` is empty; give it a value, such as \"/var/lib/sgc/arm-1\""],
        ),
    ]);
}

#[test]
fn a_token_says_owner_and_topic_itself() {
    let config = good(&format!("{NODE}[[use]]\ntoken = 'tokens/pose.token'"));
    let source = TokenSource::File("/etc/sgc/tokens/pose.token".into());
    assert_eq!(
        config.tokens,
        [TokenConfig {
            source,
            naming: Default::default(),
            frame_prefix: None,
            dead_man: None,
            qos: Default::default(),
            dedicated: false
        }]
    );
    let config = good(&format!("{NODE}[[use]]\ntoken = 'tokens/pose.token'\nlink = 'dedicated'"));
    assert!(config.tokens[0].dedicated);
    assert!(config.uses.is_empty() && !config.is_pure_router());
    check_all(&[
        (
            "[[use]]\ntoken = 'a'\nfrom = 'b'\ntopic = '/c'",
            &[
                "node.toml:5: `from` stands beside `token`, which says it already: take `from` out",
                "node.toml:6: `topic` stands beside `token`, which says it already: take `topic` out",
            ],
        ),
        (
            "[[use]]\ntoken = 'a'\n[[use]]\ntoken = 'a'",
            &["node.toml:6: `token` is the one that line 4 has already: take one of them out"],
        ),
        (
            "[[use]]\ntoken = 'sgc-token-1:c2VjcmV0'",
            &[
                "node.toml:4: `token` is no token: it was cut or mistyped: its checksum is wrong; ask the topic's owner for a \
                 new one, or name the file that holds it",
            ],
        ),
    ]);
}

#[test]
fn topic_may_be_configured_once() {
    check_all(&[
        (
            "[[share]]\ntopic = '/a'\nto = ['b']\n[[share]]\ntopic = '/a'\nto = ['c']",
            &[
                "node.toml:7: `topic` is \"/a\", which line 4 shares already: make it one share and join the recipients",
            ],
        ),
        (
            "[[use]]\ntopic = '/a'\nfrom = 'b'\n[[use]]\ntopic = '/a'\nfrom = 'b'",
            &["node.toml:7: `topic` is \"/a\" from \"b\", which line 4 uses already: take one of them out"],
        ),
        (
            "[[use]]\ntopic = '/a'\nfrom = 'b'\n[[share]]\ntopic = '/a'\nto = ['b']",
            &[
                "node.toml:4: `topic` is \"/a\", which line 7 shares: what is used here would be shared again, in a loop; \
               keep one",
            ],
        ),
    ]);
}

#[test]
fn the_ros_network_is_checked() {
    check_all(&[
        (
            "[ros]\ndomain_id = 233",
            &["node.toml:4: `domain_id` is 233; a ROS domain id is a number from 0 to 232"],
        ),
        (
            "[ros]\ndomain_id = -1",
            &["node.toml:4: `domain_id` is -1; a ROS domain id is a number from 0 to 232"],
        ),
        (
            "[ros]\nstatic_peers = ['a b', '10.0.0.2', '10.0.0.2', '10.0.0.2:7400', '10.0.0']",
            &[
                "node.toml:4: `static_peers` names \"a b\"; a peer is a host name or an IP address: \"10.0.0.2\", for example",
                "node.toml:4: `static_peers` names \"10.0.0.2\" twice; once is enough",
                "node.toml:4: `static_peers` names \"10.0.0.2:7400\"; a peer is a host name or an IP address: \"10.0.0.2\", \
               for example",
                "node.toml:4: `static_peers` names \"10.0.0\"; a peer is a host name or an IP address: \"10.0.0.2\", for \
               example",
            ],
        ),
        (
            "[ros]\nlocalhost_only = true\ndiscovery_range = 'subnet'",
            &[
                "node.toml:4: `localhost_only` is true, but `discovery_range` is \"subnet\": keep `discovery_range`, which has \
               replaced the other",
            ],
        ),
        (
            "[ros]\ndiscovery_range = 'off'\nstatic_peers = ['a']",
            &[
                "node.toml:5: `static_peers` is not empty, but `discovery_range` is \"off\": no peer would be contacted; set \
               `discovery_range` to \"localhost\" or \"subnet\", or take the peers out",
            ],
        ),
        (
            "[ros]\nlocalhost_only = true\nstatic_peers = ['a']",
            &[
                "node.toml:5: `static_peers` is not empty, but `localhost_only` is true: no peer would be contacted; set \
               `discovery_range` to \"localhost\" or \"subnet\", or take the peers out",
            ],
        ),
    ]);
}

#[test]
fn the_environment_says_what_the_file_does_not() {
    use DiscoveryRange::{Localhost, Off, Subnet, SystemDefault};
    const RANGE: &str = "ROS_AUTOMATIC_DISCOVERY_RANGE";
    const PEERS: (&str, &str) = ("ROS_STATIC_PEERS", "10.0.0.2; b.local;;10.0.0.2");
    const ONLY: (&str, &str) = ("ROS_LOCALHOST_ONLY", "1");
    let two: &[&str] = &["10.0.0.2", "b.local"];
    type Case<'c> = (&'c str, &'c [(&'c str, &'c str)], u32, DiscoveryRange, &'c [&'c str]);
    let cases: &[Case<'_>] = &[
        ("", &[], 0, Subnet, &[]),
        (
            "",
            &[("ROS_DOMAIN_ID", ""), (RANGE, ""), ("ROS_LOCALHOST_ONLY", ""), ("ROS_STATIC_PEERS", "")],
            0,
            Subnet,
            &[],
        ),
        ("", &[("ROS_DOMAIN_ID", "42"), PEERS], 42, Subnet, two),
        ("", &[("ROS_DOMAIN_ID", " 0x10")], 16, Subnet, &[]),
        ("domain_id = 7", &[("ROS_DOMAIN_ID", "999")], 7, Subnet, &[]),
        ("", &[(RANGE, "LOCALHOST"), PEERS], 0, Localhost, two),
        ("", &[(RANGE, "OFF"), PEERS], 0, Off, &[]),
        ("", &[(RANGE, "SYSTEM_DEFAULT"), PEERS], 0, SystemDefault, &[]),
        // The deprecated switch overrides the newer variables, but only if it is on.
        ("", &[ONLY, (RANGE, "SUBNET"), PEERS], 0, Localhost, &[]),
        ("", &[("ROS_LOCALHOST_ONLY", "0"), (RANGE, "OFF")], 0, Off, &[]),
        // The file overrides all of them.
        ("discovery_range = 'subnet'", &[ONLY, PEERS], 0, Subnet, two),
        ("localhost_only = false", &[ONLY, PEERS], 0, Subnet, two),
        ("localhost_only = true", &[(RANGE, "SUBNET"), PEERS], 0, Localhost, &[]),
        ("static_peers = ['c']", &[ONLY, PEERS], 0, Localhost, &["c"]),
        ("static_peers = []", &[PEERS], 0, Subnet, &[]),
        ("discovery_range = 'off'", &[(RANGE, "nonsense"), PEERS], 0, Off, &[]),
    ];
    for (ros, vars, domain_id, discovery, peers) in cases {
        let config = parse_with(&format!("{NODE}[ros]\n{ros}"), vars).unwrap();
        let found = config.ros.unwrap();
        assert_eq!((found.domain_id, found.discovery), (*domain_id, *discovery), "{ros} {vars:?}");
        assert_eq!(found.static_peers, *peers, "{ros} {vars:?}");
    }
    let config = parse_with(&format!("{NODE}[ros]"), &[("CYCLONEDDS_URI", "<Tracing/>")]).unwrap();
    assert_eq!(config.ros.unwrap().cyclonedds_uri.as_deref(), Some("<Tracing/>"));
}

#[test]
fn mistakes_in_the_environment_name_the_variable() {
    for (var, value, said) in [
        ("ROS_DOMAIN_ID", "300", "`ROS_DOMAIN_ID` is \"300\"; a ROS domain id is a number from 0 to 232"),
        ("ROS_DOMAIN_ID", "lab", "`ROS_DOMAIN_ID` is \"lab\"; a ROS domain id is a number from 0 to 232"),
        (
            "ROS_LOCALHOST_ONLY",
            "true",
            "`ROS_LOCALHOST_ONLY` is \"true\"; ROS 2 reads \"1\" as on and anything else as off: set \"1\" or \"0\", or \
             unset it",
        ),
        (
            "ROS_AUTOMATIC_DISCOVERY_RANGE",
            "localhost",
            "`ROS_AUTOMATIC_DISCOVERY_RANGE` is \"localhost\"; did you mean \"LOCALHOST\"? It takes \"OFF\", \
             \"LOCALHOST\", \"SUBNET\", \"SYSTEM_DEFAULT\"",
        ),
        (
            "ROS_STATIC_PEERS",
            "a;b c",
            "`ROS_STATIC_PEERS` names \"b c\"; a peer is a host name or an IP address: \"10.0.0.2\", for example",
        ),
    ] {
        let errors = parse_with(&format!("{NODE}[ros]"), &[(var, value)]).unwrap_err();
        assert_eq!(errors.to_string(), format!("environment: {said}"));
    }
    let errors = parse_with(
        &format!("{NODE}[ros]\nstatic_peers = ['a']"),
        &[("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")],
    );
    assert!(errors.unwrap_err().to_string().starts_with(
        "node.toml:4: `static_peers` is not empty, but `ROS_AUTOMATIC_DISCOVERY_RANGE` is \"OFF\": no peer"
    ));
}

#[test]
fn security_is_what_the_file_says_or_else_the_environment() {
    const ENABLE: (&str, &str) = ("ROS_SECURITY_ENABLE", "true");
    const ENFORCE: (&str, &str) = ("ROS_SECURITY_STRATEGY", "Enforce");
    const KEYSTORE: (&str, &str) = ("ROS_SECURITY_KEYSTORE", "/keys");
    const OVERRIDE: (&str, &str) = ("ROS_SECURITY_ENCLAVE_OVERRIDE", "/other");
    let parse = |keys: &str, vars: &[(&str, &str)]| {
        let config = parse_with(&format!("{NODE}[ros]\n{keys}"), vars);
        config.map(|config| config.ros.unwrap().security).map_err(|errors| errors.to_string())
    };
    let security = |keystore: &str, enclave: &str, enforced| {
        let (keystore, enclave) = (keystore.into(), enclave.to_owned());
        Ok(Some(SecurityConfig { keystore, enclave, enforced }))
    };
    let file = "enclave = '/sgc'\nsecurity_root = '/here'";
    assert_eq!(parse("", &[ENFORCE, KEYSTORE, OVERRIDE]), Ok(None));
    assert_eq!(parse("", &[ENABLE]), Ok(None), "rcl goes without where no keystore is named");
    assert_eq!(parse("", &[ENABLE, KEYSTORE]), security("/keys", "/", false));
    assert_eq!(parse("", &[ENABLE, ENFORCE, KEYSTORE, OVERRIDE]), security("/keys", "/other", true));
    assert_eq!(parse(file, &[]), security("/here", "/sgc", true));
    assert_eq!(parse(file, &[ENABLE, KEYSTORE, OVERRIDE]), security("/here", "/sgc", true));
    assert_eq!(parse("enclave = '/sgc'", &[KEYSTORE]), security("/keys", "/sgc", true));
    assert_eq!(parse("security_root = '/here'", &[]), security("/here", "/", true));
    assert_eq!(parse(&format!("{file}\n[gateway]"), &[]), security("/here", "/sgc", true));

    let error = |keys: &str, vars: &[(&str, &str)]| parse(keys, vars).unwrap_err();
    let keystore = "DDS Security is asked for without a keystore: set `security_root`";
    assert!(error("enclave = '/sgc'", &[]).starts_with(&format!("node.toml:4: {keystore}")));
    assert!(error("", &[ENABLE, ENFORCE]).starts_with(&format!("environment: {keystore}")));
    let name = "node.toml:4: `enclave` is \"/../private\"; an enclave is";
    assert!(error("enclave = '/../private'\nsecurity_root = '/here'", &[]).starts_with(name));
}

#[test]
fn syntax_errors_have_their_lines() {
    assert_eq!(
        said_of_whole("a = 'x'\na = 'y'\n[node\nb ==\n"),
        [
            "node.toml:2: not TOML: duplicate key",
            "node.toml:3: not TOML: unclosed table, expected `]`",
            "node.toml:4: not TOML: extra `=`, expected nothing",
        ]
    );
    assert_eq!(said_of_whole("a = 1\r\na = 2\r\n"), ["node.toml:2: not TOML: duplicate key"]);
}

#[test]
fn all_mistakes_are_told_in_the_order_of_the_file() {
    let errors = parse_with(
        "[[use]]\nfrom = 'Desk'\ntopic = 'cmd_vel'\n[[share]]\ntopic = '/a'\nto = []\n[ros]\ndomian_id = 1\n[profile]\n",
        &[("ROS_DOMAIN_ID", "x")],
    )
    .unwrap_err();
    let places: Vec<String> = errors.iter().map(|error| error.origin.to_string()).collect();
    assert_eq!(
        places,
        [
            "node.toml:2",
            "node.toml:3",
            "node.toml:6",
            "node.toml:8",
            "node.toml:9",
            "node.toml",
            "node.toml",
            "environment"
        ]
    );
    assert_eq!(errors.to_string().lines().count(), errors.iter().count());
}

#[test]
fn a_gateway_is_for_programs_of_this_host_unless_it_says_more() {
    let config = good(&format!("{NODE}[gateway]\n"));
    assert_eq!(config.gateway, Some(GatewayConfig::default()));
    assert!(config.ros.is_some(), "a gateway is one to a ROS network");
    let gateway = config.gateway.unwrap();
    assert_eq!(
        texts(&gateway.listen),
        ["ws://127.0.0.1:9090", "ws://127.0.0.1:8765", "grpc://127.0.0.1:50051"]
    );
    assert_eq!((gateway.clients_max, gateway.client_bytes_max), (512, 64 << 20));
    assert_eq!(gateway.warnings(), [""; 0]);
    assert_eq!(good(NODE).gateway, None);
}

#[test]
fn every_key_of_a_gateway_is_taken_over() {
    let config = good(&format!(
        r#"{NODE}
        [[partner]]
        name = "acme"
        ca = "acme-ca.pem"
        [gateway]
        listen = ["wss://0.0.0.0:443", "grpcs://[::]", "ws://10.0.0.1"]
        certificate = "robot.pem"
        key = "robot.key"
        anonymous = "all"
        origins = ["https://Dash.example.org:443"]
        plain = true
        clients_max = 16
        client_bytes_max = "1MiB"
        [[gateway.client]]
        who = ["desk", "group:operators", "partner:acme"]
        subscribe = ["/**"]
        [[gateway.client]]
        who = ["*"]
        publish = ["/cmd_vel"]
        call = ["/plan"]
        serve = ["/arm/*"]
        "#
    ));
    let gateway = config.gateway.unwrap();
    assert_eq!(texts(&gateway.listen), ["wss://0.0.0.0:443", "grpcs://[::]:50051", "ws://10.0.0.1:9090"]);
    let tls = gateway.tls.as_ref().unwrap();
    assert_eq!(
        (&*tls.certificate, &*tls.key),
        (Path::new("/etc/sgc/robot.pem"), Path::new("/etc/sgc/robot.key"))
    );
    assert_eq!((gateway.anonymous, gateway.plain), (Anonymous::All, true));
    assert_eq!(texts(&gateway.origins), ["https://dash.example.org"]);
    assert_eq!((gateway.clients_max, gateway.client_bytes_max), (16, 1 << 20));
    assert_eq!(gateway.clients.len(), 2);
    assert_eq!(texts(&gateway.clients[0].who), ["desk", "group:operators", "partner:acme"]);
    assert_eq!(gateway.clients[1].scope.to_string(), "publish /cmd_vel; call /plan; serve /arm/*");
    assert!(gateway.clients[0].scope.permits(Right::Subscribe, "/a/b"));
    let warnings = gateway.warnings();
    assert!(
        warnings[0].contains("anonymous = \"all\": whoever reaches wss://0.0.0.0:443 may"),
        "{warnings:?}"
    );
    assert!(warnings[1].contains("ws://10.0.0.1:9090 is not encrypted"), "{warnings:?}");
}

#[test]
fn gateway_takes_names_for_the_certificate_that_it_makes_itself() {
    let of =
        |text: &str| good(&format!("{NODE}[gateway]\nlisten = ['wss://0.0.0.0']\n{text}")).gateway.unwrap();
    assert_eq!(of("").names, []);
    let names = of("names = ['Arm-1.lab.example', '10.0.0.7', 'fd00::7']").names;
    assert_eq!(texts(&names), ["arm-1.lab.example", "10.0.0.7", "fd00::7"]);
    let many: Vec<_> = (0..=GATEWAY_NAMES_MAX).map(|n| format!("'robot-{n}'")).collect();
    let said = said_about(&format!("[gateway]\nnames = [{}]", many.join(", ")));
    assert!(said.len() == 1 && said[0].contains("33"), "{said:?}");
}

#[test]
fn metrics_are_served_on_loopback_unless_told_otherwise() {
    let of = |text: &str| good(&format!("{NODE}{text}")).metrics;
    assert_eq!(of(""), None);
    let usual = of("[metrics]").unwrap();
    assert_eq!((usual.listen.to_string(), usual.warnings()), ("127.0.0.1:9464".to_owned(), Vec::new()));
    assert_eq!(of("[metrics]\nlisten = '[::1]:0'").unwrap().warnings(), Vec::<String>::new());
    let open = of("metrics.listen = '0.0.0.0:9464'").unwrap().warnings();
    assert!(
        open[0].starts_with("metrics: http://0.0.0.0:9464 is neither encrypted nor protected"),
        "{open:?}"
    );
    for wrong in ["localhost:9464", "9464", "http://127.0.0.1:9464", "127.0.0.1"] {
        let said = said_about(&format!("[metrics]\nlisten = '{wrong}'"));
        assert_eq!(said.len(), 1, "{said:?}");
        assert!(
            said[0].contains(&format!("`listen` in [metrics] is {wrong:?}: it takes an IP address")),
            "{said:?}"
        );
    }
}

#[test]
#[cfg(feature = "otlp")]
fn metrics_are_pushed_to_a_collector_by_its_url() {
    let of = |text: &str| good(&format!("{NODE}[metrics]\n{text}")).metrics.unwrap().otlp;
    assert_eq!(of(""), None);
    let usual = of("otlp = 'http://collector.example:4318'").unwrap();
    assert_eq!(usual, OtlpConfig::new("http://collector.example:4318/".parse().unwrap()));
    assert_eq!(usual.interval, Duration::from_secs(60));
    let own = of(
        "otlp = 'https://a.example'\notlp_interval = '15s'\notlp_headers_file = 'a.headers'\notlp_ca = 'ca.pem'",
    );
    let own = own.unwrap();
    assert_eq!((own.url.to_string().as_str(), own.interval.as_secs()), ("https://a.example/v1/metrics", 15));
    assert_eq!(own.headers_file.as_deref(), Some(Path::new("/etc/sgc/a.headers")));
    assert_eq!(own.ca.as_deref(), Some(Path::new("/etc/sgc/ca.pem")));
    check_all(&[
        (
            "[metrics]\notlp = 'collector.example:4318'",
            &["node.toml:4: `otlp` is \"collector.example:4318\": it takes the URL of a collector, such as \
               \"http://collector.example:4318\""],
        ),
        (
            "[metrics]\notlp = 'http://a:4317'",
            &[
                "node.toml:4: `otlp` is \"http://a:4317\": 4317 is the port of OTLP over gRPC, and this is OTLP over HTTP: \
               collectors usually have it at port 4318",
            ],
        ),
        (
            "[metrics]\notlp = 'https://me:secret@a'",
            &[
                "node.toml:4: `otlp` has a user or a password before its host, which logs would show: put them into \
               `otlp_headers_file`",
            ],
        ),
        (
            "[metrics]\notlp = 'http://a'\notlp_interval = '0s'",
            &[
                "node.toml:5: `otlp_interval` is \"0s\"; it takes a number with s, min, h or d, from \"1s\" to \"1d\"",
            ],
        ),
        (
            "[metrics]\notlp = 'http://a'\notlp_ca = 'ca.pem'",
            &["node.toml:5: `otlp_ca` is for https://, and `otlp` begins with http://: correct one of them"],
        ),
        (
            "[metrics]\notlp_interval = '15s'\notlp_headers_file = 'a'",
            &[
                "node.toml:4: `otlp_interval` is for pushes of metrics, and `otlp` does not say where they go: add it, or \
                 take `otlp_interval` out",
                "node.toml:5: `otlp_headers_file` is for pushes of metrics, and `otlp` does not say where they go: add it, or \
                 take `otlp_headers_file` out",
            ],
        ),
    ]);
}

#[test]
fn mistakes_in_a_gateway_are_told() {
    check_all(&[
        (
            "[gateway]\nlisten = ['ws://0.0.0.0:9090', 'grpc://127.0.0.1', 'grpc://[::]']",
            &[
                "node.toml:4: `listen` is \"ws://0.0.0.0:9090\": other hosts may connect, and nothing is encrypted, so that \
                 anybody on the way can read and change everything, tokens too: write \"wss://0.0.0.0:9090\", listen at \
                 127.0.0.1, or say `plain = true` if the network is one that you trust",
                "node.toml:4: `listen` is \"grpc://[::]\": other hosts may connect, and nothing is encrypted, so that \
                 anybody on the way can read and change everything, tokens too: write \"grpcs://[::]:50051\", listen at \
                 127.0.0.1, or say `plain = true` if the network is one that you trust",
            ],
        ),
        (
            "[gateway]\nlisten = ['ws://localhost', 'http://127.0.0.1']",
            &[
                "node.toml:4: `listen` is \"ws://localhost\"; it listens at an IP address, not at a name: \
                 \"ws://127.0.0.1:9090\"",
                "node.toml:4: `listen` is \"http://127.0.0.1\"; it takes ws://, wss://, grpc:// and grpcs://, such as \
                 \"ws://127.0.0.1:9090\"",
            ],
        ),
        (
            "[gateway]\nlisten = []",
            &[
                "node.toml:4: `listen` is empty; give it a value, such as listen = [\"ws://127.0.0.1:9090\"], or leave it out \
                 to listen at the usual ports of this host",
            ],
        ),
        (
            "[gateway]\nlisten = ['ws://127.0.0.1', 'ws://127.0.0.1:9090']",
            &["node.toml:4: `listen` names \"ws://127.0.0.1:9090\" twice; once is enough"],
        ),
        (
            "[gateway]\ncertificate = 'a.pem'",
            &[
                "node.toml:4: `certificate` needs `key` beside it: give both, or neither for a certificate that the \
                 gateway makes itself",
            ],
        ),
        (
            "[gateway]\ncertificate = 'a.pem'\nkey = 'a.key'",
            &[
                "node.toml:4: `certificate` is for wss:// and grpcs://, and `listen` has neither: take it out, or listen there",
            ],
        ),
        (
            "[gateway]\nnames = ['*.lab', 'wss://a', '0.0.0.0', 'a b', 'A', 'a.']",
            &[
                "node.toml:4: `names` names \"*.lab\"; it has a wildcard, and the certificate is for this gateway alone: list \
                 each name",
                "node.toml:4: `names` names \"wss://a\"; it takes a bare name, without a scheme, a port or a path: \
                 \"arm-1.lab.example\"",
                "node.toml:4: `names` names \"0.0.0.0\"; no client connects to that address: list the addresses that \
                 clients use",
                "node.toml:4: `names` names \"a b\"; it takes a DNS name or an IP address, such as \"arm-1.lab.example\" or \
                 \"10.0.0.7\"",
                "node.toml:4: `names` names \"a.\" twice; once is enough",
            ],
        ),
        (
            "[gateway]\nlisten = ['wss://127.0.0.1']\ncertificate = 'a.pem'\nkey = 'a.key'\nnames = ['robot']",
            &[
                "node.toml:7: `names` is for the gateway's own certificate, and `certificate` is another one, with names of \
                 its own: take one of the two out",
            ],
        ),
        (
            "[gateway]\nanonymous = 'any'\norigins = ['null', '*']",
            &[
                "node.toml:4: `anonymous` is \"any\"; it takes \"local\", \"none\", \"all\"",
                "node.toml:5: `origins` names \"null\"; \"null\" is what pages of anywhere can be made to say: name where the \
                 page is from",
                "node.toml:5: `origins` names \"*\"; it is no origin of pages: write \"https://dashboard.example.org\", with \
                 :PORT behind it if there is one",
            ],
        ),
        (
            "[gateway]\nclients_max = 0\nclient_bytes_max = '64MB'",
            &[
                "node.toml:4: `clients_max` is 0; it takes a number of clients from 1 to 65536",
                "node.toml:5: `client_bytes_max` is \"64MB\"; it takes a number with KiB, MiB or GiB, from \"64KiB\" to \
                 \"16GiB\"",
            ],
        ),
        (
            "[[gateway.client]]\nwho = ['partner:acme']\nsubscribe = ['odom']",
            &[
                "node.toml:4: `who` names partner \"acme\", which no [[partner]] describes: add [[partner]] with name = \"acme\" and \
                 ca = \"FILE\"",
                "node.toml:5: `subscribe` is \"odom\"; a topic name starts with '/': \"/odom\"",
            ],
        ),
        (
            "[[gateway.client]]\nwho = ['desk']",
            &[
                "node.toml:3: [[gateway.client]]: it permits nothing: name at least one interface to subscribe to, publish on, \
                 call or serve",
            ],
        ),
        (
            "[[gateway.client]]\nsubscribe = ['/a']",
            &[
                "node.toml:3: [[gateway.client]] has no `who`; add one, such as who = [\"desk\", \"group:operators\"]",
            ],
        ),
        (
            "[[gateway.client]]\nwho = ['desk']\nsubscribe = 1",
            &[
                "node.toml:5: `subscribe` is an integer (1); it takes an array of strings, such as [\"/odom\", \"/camera/**\"]",
            ],
        ),
        (
            "[gateway]\nclient = 1",
            &[
                "node.toml:4: `gateway.client` is an integer (1); it takes tables: [[share]], [[use]], [[partner]] or \
             [[gateway.client]], and the keys below",
            ],
        ),
        (
            "[gateway.client]\nwho = ['desk']\nsubscribe = ['/a']",
            &[
                "node.toml:3: `gateway.client` is one table but may occur many times; write [[gateway.client]]",
            ],
        ),
        (
            "[[gateway]]\n",
            &["node.toml:3: `gateway` is an array of tables but may occur only once; write [gateway]"],
        ),
        (
            "[gateway]\nport = 9090",
            &[
                "node.toml:4: [gateway] has no key `port`; it has `listen`, `certificate`, `key`, `names`, `anonymous`, `origins`, `plain`, \
             `clients_max`, `client_bytes_max`, `client`",
            ],
        ),
    ]);
}

#[test]
fn an_argument_turns_a_gateway_on() {
    let config = Config::from_args(
        &args(&[("identity", "x"), ("router", "quic://r:7447"), ("gateway", "yes")]),
        &no_env,
    )
    .unwrap();
    assert_eq!(config.gateway, Some(GatewayConfig::default()));
    assert!(config.ros.is_some());
}

#[test]
fn limits_hold() {
    let share = |i: usize| format!("[[share]]\ntopic = '/t{i}'\nto = ['b']\n");
    let shares = |count: usize| (0..count).map(share).collect::<String>();
    assert_eq!(good(&format!("{NODE}{}", shares(SHARES_MAX))).shares.len(), SHARES_MAX);
    assert_eq!(
        said_about(&shares(SHARES_MAX + 1)),
        ["node.toml: [[share]] occurs 1025 times; it may occur at most 1024 times"]
    );
    let many =
        |count: usize, one: &dyn Fn(usize) -> String| (0..count).map(one).collect::<Vec<_>>().join(", ");
    let to = many(1025, &|i| format!("'n{i}'"));
    assert_eq!(
        said_about(&format!("[[share]]\ntopic = '/a'\nto = [{to}]")),
        ["node.toml:5: `to` has 1025 entries; it may have at most 1024"]
    );
    let listen = many(17, &|i| format!("'quic://0.0.0.0:{}'", i + 1));
    assert_eq!(
        said_about(&format!("[router]\nlisten = [{listen}]")),
        ["node.toml:4: `listen` has 17 entries; it may have at most 16"]
    );
    let peers = many(65, &|i| format!("'10.0.0.{i}'"));
    assert_eq!(
        said_about(&format!("[ros]\nstatic_peers = [{peers}]")),
        ["node.toml:4: `static_peers` has 65 entries; it may have at most 64"]
    );
    let text = "x".repeat(1025);
    assert_eq!(
        said_about(&format!("[[share]]\ntopic = '/a'\nto = ['b']\nauthor = '{text}'")),
        ["node.toml:6: `author` has 1025 bytes; it has at most 1024"]
    );
    let path = "x".repeat(99);
    assert_eq!(
        said_about(&format!("[admin]\nsocket = '{path}'")),
        ["node.toml:4: `socket` has 108 bytes; it has at most 107"]
    );
}

fn args(args: &[(&str, &str)]) -> ArgsConfig {
    let all = |name| {
        args.iter().filter(|(n, _)| *n == name).map(|(_, value)| (*value).to_owned()).collect::<Vec<_>>()
    };
    ArgsConfig {
        identity: all("identity").first().map(PathBuf::from),
        routers: all("router"),
        shares: all("share"),
        to: all("to"),
        uses: all("use"),
        listen: all("listen"),
        peers: all("peer"),
        announce: !all("announce").is_empty(),
        accept: all("accept").iter().map(PathBuf::from).collect(),
        gateway: !all("gateway").is_empty(),
    }
}

#[test]
fn arguments_say_the_same_as_a_file() {
    let from_args = Config::from_args(
        &args(&[
            ("identity", "/etc/sgc/arm-1.identity"),
            ("router", "quic://r:7447"),
            ("listen", "quic://0.0.0.0:7447"),
            ("share", "/chatter"),
            ("share", "/image=group:vision, desk"),
            ("to", "desk"),
            ("to", "group:ops"),
            ("use", "desk:/cmd_vel"),
        ]),
        &no_env,
    )
    .unwrap();
    let from_file = good(
        "identity = 'arm-1.identity'\nnode.routers = ['quic://r:7447']\nrouter.listen = ['quic://0.0.0.0:7447']\n\
         [[share]]\ntopic = '/chatter'\nto = ['desk', 'group:ops']\n[[share]]\ntopic = '/image'\n\
         to = ['group:vision', 'desk']\n[[use]]\nfrom = 'desk'\ntopic = '/cmd_vel'",
    );
    assert_eq!(from_args, from_file);
    let of_kinds = args(&[
        ("identity", "/etc/sgc/arm-1.identity"),
        ("router", "quic://r:7447"),
        ("share", "topic:/chatter"),
        ("share", "service:/add_two_ints"),
        ("share", "action:/fibonacci=ops"),
        ("share", "parameters:/talker"),
        ("to", "desk"),
        ("use", "desk:service:/plan/**"),
        ("use", "service:/status"),
    ]);
    let from_file = good(
        "identity = 'arm-1.identity'\nnode.routers = ['quic://r:7447']\n[[share]]\ntopic = '/chatter'\nto = ['desk']\n\
         [[share]]\nservice = '/add_two_ints'\nto = ['desk']\n[[share]]\naction = '/fibonacci'\nto = ['ops']\n\
         [[share]]\nparameters = '/talker'\nto = ['desk']\n[[use]]\nfrom = 'desk'\nservice = '/plan/**'\n\
         [[use]]\nfrom = 'service'\ntopic = '/status'",
    );
    assert_eq!(Config::from_args(&of_kinds, &no_env).unwrap(), from_file);
    let router = args(&[("identity", "r"), ("listen", "quic://0.0.0.0:7447")]);
    assert!(Config::from_args(&router, &no_env).unwrap().is_pure_router());
    let mesh = args(&[
        ("identity", "/etc/sgc/r"),
        ("listen", "quic://0.0.0.0:7447"),
        ("peer", "quic://r2"),
        ("peer", "srv://lab.example"),
        ("announce", ""),
        ("accept", "/etc/sgc/a.pem"),
    ]);
    let from_file = good(
        "identity = 'r'\nnode.routers = ['quic://r2', 'srv://lab.example']\n[router]\nannounce = true\n\
         accept = ['a.pem']\nlisten = ['quic://0.0.0.0:7447']",
    );
    assert_eq!(Config::from_args(&mesh, &no_env).unwrap(), from_file);
    let env = |name: &str| (name == "ROS_DOMAIN_ID").then(|| "5".to_owned());
    let robot = args(&[("identity", "r"), ("router", "quic://r:1"), ("use", "b:/a")]);
    assert_eq!(Config::from_args(&robot, &env).unwrap().ros.unwrap().domain_id, 5);
}

#[test]
fn mistakes_in_arguments_name_the_argument() {
    type Case<'c> = (&'c [(&'c str, &'c str)], &'c [&'c str]);
    let cases: &[Case<'_>] = &[
        (
            &[("share", "/chatter=")],
            &[
                "`--share` is empty, so nobody may subscribe: name nodes (\"desk\"), groups (\"group:operators\") or \"*\"",
            ],
        ),
        (&[("to", "desk")], &["`--to` is given, but no `--share` takes it: add --share /TOPIC"]),
        (
            &[("share", "chatter=desk")],
            &["`--share` is \"chatter\"; a topic name starts with '/': \"/chatter\""],
        ),
        (
            &[("use", "/cmd_vel")],
            &[
                "`--use` is \"/cmd_vel\"; write NODE:/TOPIC: \"arm-1:/camera/image\" or \"arm-1:service:/add_two_ints\", for \
               example",
            ],
        ),
        (
            &[("share", "servce:/add=c")],
            &[
                "`--share` is \"servce\"; did you mean \"service\"? It takes \"topic\", \"service\", \"action\", \"parameters\"",
            ],
        ),
        (
            &[("share", "service:/a=c"), ("use", "b:service:/a"), ("use", "b:action:/a")],
            &[
                "`--use service` is \"/a\", which a `--share service` shares: what is used here would be shared again, in a \
               loop; keep one",
            ],
        ),
        (
            &[("share", "/a"), ("share", "/a=c"), ("to", "b"), ("use", "b:/a")],
            &[
                "`--share` is \"/a\", which a `--share` shares already: make it one share and join the recipients",
                "`--use` is \"/a\", which a `--share` shares: what is used here would be shared again, in a loop; keep \
               one",
            ],
        ),
        (
            &[("router", "r:1")],
            &[
                "`--router` is \"r:1\"; \"r:1\" has no transport in front: write quic://HOST or quic://HOST:PORT",
            ],
        ),
    ];
    let said =
        Config::from_args(&args(&[("identity", "x"), ("peer", "cloud")]), &no_env).unwrap_err().to_string();
    assert!(said.starts_with("command line: `--peer` is \"cloud\"; "), "{said}");
    for (extra, expected) in cases {
        let mut all = vec![("identity", "x"), ("listen", "quic://0.0.0.0:7447")];
        all.extend_from_slice(extra);
        let errors = Config::from_args(&args(&all), &no_env).unwrap_err();
        let expected: Vec<String> = expected.iter().map(|one| format!("command line: {one}")).collect();
        assert_eq!(errors.iter().map(ToString::to_string).collect::<Vec<_>>(), expected);
    }
    assert_eq!(
        Config::from_args(&ArgsConfig::default(), &no_env).unwrap_err().to_string(),
        "command line: no `--identity` is given: every link is authenticated, so a node needs an identity file\n\
         command line: neither `--router` nor `--listen` is given, so this node connects to nobody: name a router \
         (\"quic://router.lab.example:7447\") or listen as one (\"quic://0.0.0.0:7447\")"
    );
}

#[test]
fn a_file_of_nothing_but_mistakes_is_answered_in_time() {
    let text = "a.b=1\n[[share]]\nto=['','']\n".repeat(20_000);
    let begin = std::time::Instant::now();
    assert!(parse_with(&text, &[]).is_err());
    let text = format!("{NODE}[[share]]\ntopic = '/a'\nto = [{}]", "'b',\n".repeat(400_000));
    assert!(parse_with(&text, &[]).is_err());
    assert!(begin.elapsed().as_secs() < 30, "{:?}", begin.elapsed());
}

fn reference() -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/reference/configuration.md");
    fs::read_to_string(path).expect("the reference is in docs/")
}

#[test]
fn the_reference_lists_every_key_and_no_other() {
    let reference = reference();
    let sections: BTreeMap<&str, &str> =
        reference.split("\n## ").skip(1).filter_map(|section| section.split_once('\n')).collect();
    // One section may be about two tables.
    let sections: BTreeMap<&str, &str> = sections
        .into_iter()
        .flat_map(|(headings, text)| headings.split(" and ").map(move |heading| (heading, text)))
        .collect();
    for table in Table::ALL {
        let heading =
            if table == Table::Top { "The top level".to_owned() } else { format!("`{}`", table.header()) };
        let section = sections.get(heading.as_str()).unwrap_or_else(|| panic!("no section {heading}"));
        let rows = section.lines().filter_map(|line| line.strip_prefix("| `")?.split_once('`'));
        let listed: Vec<&str> = rows.map(|(key, _)| key).collect();
        assert_eq!(listed, table.keys(), "{heading}");

        let place = if table == Table::Top { "the top level".to_owned() } else { heading };
        let row = sections["Planned"].lines().find_map(|line| line.strip_prefix(&format!("| {place} | ")));
        let planned: Vec<&str> =
            row.map(|row| row.split('`').skip(1).step_by(2).collect()).unwrap_or_default();
        assert_eq!(planned, table.planned_keys(), "planned in {place}");
    }
}

#[test]
fn the_examples_of_the_reference_are_valid() {
    let text = reference();
    let examples: Vec<&str> =
        text.split("```toml\n").skip(1).filter_map(|rest| Some(rest.split_once("```")?.0)).collect();
    assert!(examples.len() >= 4);
    let is_built = |example: &&str| cfg!(feature = "zenoh") || !example.contains("[ros.zenoh]");
    for example in examples.into_iter().filter(is_built) {
        good(example);
    }
}

#[test]
fn policies_are_named_as_in_ros_2_and_contradict_each_other_nowhere() {
    use sgc_config::QosOverride;
    use sgc_wire::{Durability, History, Reliability};

    const SHARE: &str = "[[share]]\ntopic = '/a'\nto = ['b']\n";
    const USE: &str = "[[use]]\nfrom = 'b'\ntopic = '/a'\n";
    let set = "reliability = 'reliable'\ndurability = 'transient_local'\nhistory = 'keep_last'\ndepth = 5\n\
               deadline = '100ms'\nlifespan = '2s'";
    let expected = QosOverride {
        reliability: Some(Reliability::Reliable),
        durability: Some(Durability::TransientLocal),
        history: Some(History::KeepLast(5)),
        deadline_ns: Some(100_000_000),
        lifespan_ns: Some(2_000_000_000),
    };
    assert_eq!(good(&format!("{NODE}{SHARE}{set}")).shares[0].qos, expected);
    assert_eq!(good(&format!("{NODE}{USE}{set}")).uses[0].qos, expected);
    let all = good(&format!("{NODE}{USE}history = 'keep_all'")).uses[0].qos;
    assert_eq!(all, QosOverride { history: Some(History::KeepAll), ..QosOverride::default() });
    assert_eq!(good(&format!("{NODE}{SHARE}")).shares[0].qos, QosOverride::default());
    for (wrong, said) in [
        ("reliability = 'best-effort'", "`reliability` is \"best-effort\""),
        ("durability = 'persistent'", "`durability` is \"persistent\""),
        ("depth = 0", "`depth` is 0; it takes a number of messages from 1 to 4096"),
        ("history = 'keep_last'", "`history` is keep_last, and there is no `depth`"),
        ("history = 'keep_all'\ndepth = 3", "`history` is keep_all, but `depth` is 3"),
        ("deadline = '5'", "`deadline` is \"5\""),
        (
            "reliability = 'best_effort'\ndurability = 'transient_local'",
            "`durability` is transient_local, but `reliability` is best_effort",
        ),
    ] {
        let found = said_about(&format!("{SHARE}{wrong}"));
        assert!(found.len() == 1 && found[0].contains(said), "{found:?}");
    }
    let there = said_about(&format!("{USE}publish = true\ndepth = 3"));
    assert!(there.len() == 1 && there[0].contains("`depth` is for what comes here"), "{there:?}");
    let service = said_about("[[use]]\nfrom = 'b'\nservice = '/a'\nlifespan = '1s'");
    assert!(service.len() == 1 && service[0].contains("`lifespan` is for topics"), "{service:?}");
}

#[test]
fn router_keeps_names_in_a_store_by_its_urls() {
    const ROUTER: &str = "[router]\nlisten = ['quic://0.0.0.0:7447']\n";
    let of = |text: &str| good(&format!("{NODE}{ROUTER}{text}")).store;
    assert_eq!(of("mapping = 'query'"), None);
    let usual = of("mapping = 'store'\nstore = ['valkey://store.example']").unwrap();
    assert_eq!(usual.servers, ["valkey://store.example:6379".parse().unwrap()]);
    assert_eq!(
        (usual.prefix.as_str(), &usual.user, &usual.ca, &usual.certificate),
        ("sgc", &None, &None, &None)
    );
    let own = of("mapping = 'store'\nstore = ['valkeys://a:1', 'rediss://b:2']\nstore_prefix = 'acme'\n\
         store_user = 'router'\nstore_password_file = 'secret'\nstore_ca = 'ca.pem'\n\
         store_certificate = 'r.pem'\nstore_key = 'r.key'")
    .unwrap();
    let file = |name: &str| Path::new("/etc/sgc").join(name);
    assert_eq!((own.servers.len(), own.prefix.as_str()), (2, "acme"));
    assert_eq!(own.user, Some(("router".to_owned(), file("secret"))));
    assert_eq!((own.ca, own.certificate), (Some(file("ca.pem")), Some((file("r.pem"), file("r.key")))));
    check_all(&[
        (
            "[router]\nmapping = 'store'",
            &["node.toml:4: `mapping` is \"store\", and `store` does not say where: add it, such as \
               store = [\"valkey://store.example:6379\"]"],
        ),
        (
            "[router]\nstore = ['valkey://a']\nstore_prefix = 'b'",
            &[
                "node.toml:4: `store` is for a store of names: add mapping = \"store\", or take `store` out",
                "node.toml:5: `store_prefix` is for a store of names: add mapping = \"store\", or take `store_prefix` out",
            ],
        ),
        (
            "[router]\nmapping = 'stor'\nstore = ['valkey://a']",
            &[
                "node.toml:4: `mapping` is \"stor\"; did you mean \"store\"? It takes \"flood\", \"query\", \"store\"",
            ],
        ),
        (
            "[router]\nmapping = 'store'\nstore = ['http://a', 'valkey://me:secret@a']",
            &[
                "node.toml:5: `store`: \"http://a\" is no server of a store: write valkey://HOST:PORT, or \
                 valkeys://HOST:PORT with TLS",
                "node.toml:5: `store`: a URL with a user or password ends up in logs: give the user and the file of its \
                 password apart",
            ],
        ),
        (
            "[router]\nmapping = 'store'\nstore = ['valkey://a', 'valkeys://b']",
            &[
                "node.toml:5: `store` has servers with TLS (valkeys://) and without (valkey://): the password would go \
               unencrypted",
            ],
        ),
        (
            "[router]\nmapping = 'store'\nstore = ['valkey://a']\nstore_ca = 'ca.pem'\nstore_user = 'u'",
            &[
                "node.toml:6: `store_ca` is for valkeys://, and `store` begins with valkey://: correct one of them",
                "node.toml:7: `store_user` needs `store_password_file` beside it: add that, or take `store_user` out",
            ],
        ),
        (
            "[router]\nmapping = 'store'\nstore = ['valkey://a']\nstore_prefix = 'a:b'",
            &["node.toml:6: `store_prefix`: ':' in a prefix: use letters, digits, '-', '_' and '.'"],
        ),
    ]);
}
