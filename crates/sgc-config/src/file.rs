//! TOML to draft: reads tables, keys and types of values, with the line of each.
//!
//! `resolve` judges the values.

use std::collections::BTreeSet;
use std::ops::Range;
use std::path::PathBuf;
use std::sync::Arc;

use sgc_ros::Interface;
use toml::Spanned;
use toml::de::{DeTable, DeValue};

use crate::draft::{
    AuditDraft, DeadManDraft, Draft, GatewayClientDraft, GatewayDraft, MetricsDraft, NamingDraft,
    PartnerDraft, QosDraft, RosDraft, RotationDraft, ShapingDraft, ShareDraft, StoreDraft, TransportDraft,
    UseDraft, WithOrigin, Words, ZenohDraft,
};
use crate::error::{ConfigError, Mistake, Origin};
use crate::schema::{Table, nearest};

const WORDS: Words = Words {
    no_identity: "neither `identity` nor `name` in [node]",
    identity: "identity",
    dial: "`routers` in [node]",
    listen: "`listen` in [router]",
    share: "[[share]]",
    uses: "[[use]]",
};

/// Kinds of interfaces that a table may describe.
const INTERFACES: [Interface; 4] =
    [Interface::Topic, Interface::Service, Interface::Action, Interface::Parameters];

/// Reads the text. Returns a draft even with errors, unless the text is no TOML, so that `resolve` can report its own
/// errors as well.
pub(crate) fn read(text: &str, file: &str) -> (Option<Draft>, Vec<ConfigError>) {
    let line_starts =
        text.bytes().enumerate().filter(|(_, byte)| *byte == b'\n').map(|(at, _)| at + 1).collect();
    let mut reader =
        FileReader { file: file.into(), text, line_starts, attempted: BTreeSet::new(), errors: Vec::new() };
    let (top, syntax) = DeTable::parse_recoverable(text);
    if !syntax.is_empty() {
        reader.record_syntax(&syntax);
        return (None, reader.errors);
    }
    let draft = reader.draft(top.get_ref());
    (Some(draft), reader.errors)
}

struct FileReader<'t> {
    file: Arc<str>,
    text: &'t str,
    /// Offsets of the lines after the first.
    line_starts: Vec<usize>,
    attempted: BTreeSet<&'static str>,
    errors: Vec<ConfigError>,
}

/// A table of the file while it is read.
struct Section<'s, 't> {
    table: Table,
    entries: &'s DeTable<'t>,
    span: Range<usize>,
    /// Keys of the table that unknown ones were probably meant to be.
    meant: Vec<&'static str>,
}

type Value<'t> = Spanned<DeValue<'t>>;

impl FileReader<'_> {
    fn record_syntax(&mut self, syntax: &[toml::de::Error]) {
        let mut last = None;
        for error in syntax {
            let origin = self.origin(error.span().unwrap_or_default());
            // Later errors in the same line are usually consequences of the first.
            if last.as_ref() != Some(&origin) {
                let message = error.message().to_owned();
                self.errors.push(ConfigError::new(origin.clone(), Mistake::Syntax { message }));
                last = Some(origin);
            }
        }
    }

    fn draft(&mut self, top: &DeTable<'_>) -> Draft {
        let top = self.section(Table::Top, top, 0..0);
        let node = self.single(&top, "node", Table::Node);
        let router = self.single(&top, "router", Table::Router);
        let admin = self.single(&top, "admin", Table::Admin);
        let ros = self.single(&top, "ros", Table::Ros);
        let authority = self.single(&top, "authority", Table::Authority);
        let rotation = self.single(&top, "rotation", Table::Rotation);
        let audit = self.single(&top, "audit", Table::Audit);
        let transport = self.single(&top, "transport", Table::Transport);
        let gateway = self.single(&top, "gateway", Table::Gateway);
        let metrics = self.single(&top, "metrics", Table::Metrics);
        let mut draft = Draft {
            origin: Origin::File { file: self.file.clone(), line: None },
            words: WORDS,
            attempted: BTreeSet::new(),
            identity: self.identity(&top, node.as_ref()),
            name: self.string(node.as_ref(), "name", "a string, such as \"arm-1\""),
            routers: self.routers(node.as_ref()),
            keep_alive: self.string(node.as_ref(), "keep_alive", "\"auto\", or a string such as \"5s\""),
            direct: self.direct(node.as_ref()),
            port_mapping: self.boolean(node.as_ref(), "port_mapping", "true or false"),
            resolver: self.string(node.as_ref(), "resolver", "a string, such as \"10.0.0.53\""),
            listen: self.flat_strings(
                router.as_ref(),
                "listen",
                "an array of strings, such as [\"quic://0.0.0.0:7447\"]",
            ),
            peer_rate: self.string(router.as_ref(), "peer_rate", "a string, such as \"50Mbps\""),
            mapping: self.string(router.as_ref(), "mapping", "\"flood\", \"query\" or \"store\""),
            store: self.store(router.as_ref()),
            announce: self.boolean(router.as_ref(), "announce", "true or false"),
            accept: self.strings(
                router.as_ref(),
                "accept",
                "an array of strings, such as [\"lab-ca.pem\", \"acme-ca.pem\"]",
            ),
            ros: ros.map(|ros| self.ros(&ros)),
            shares: self
                .repeated(&top, "share", Table::Share)
                .iter()
                .map(|share| self.share(share))
                .collect(),
            uses: self.repeated(&top, "use", Table::Use).iter().map(|one| self.read_use(one)).collect(),
            admin_socket: self
                .string(admin.as_ref(), "socket", "a string, such as \"/run/sgc/arm-1.sock\"")
                .map(|socket| socket.map(PathBuf::from)),
            observers: self.strings(
                admin.as_ref(),
                "observers",
                "an array of strings, such as [\"group:observers\"]",
            ),
            state: self
                .string(node.as_ref(), "state", "a string, such as \"/var/lib/sgc/arm-1\"")
                .map(|state| state.map(PathBuf::from)),
            trust: self.flat_strings(
                node.as_ref(),
                "trust",
                "an array of strings, such as [\"acme-ca.pem\"]",
            ),
            watch: self.boolean(node.as_ref(), "watch", "true or false"),
            authority: self.authority(authority.as_ref()),
            operators: self.strings(
                authority.as_ref(),
                "operators",
                "an array of strings, such as [\"group:operators\"]",
            ),
            rotation: RotationDraft {
                every: self.string(rotation.as_ref(), "every", "a string, such as \"1h\""),
                messages: self.integer(rotation.as_ref(), "messages", "a number, such as 16777216"),
            },
            audit: AuditDraft {
                file: self
                    .string(audit.as_ref(), "file", "a string, such as \"/var/log/sgc/arm-1.audit\"")
                    .map(|file| file.map(PathBuf::from)),
                max_bytes: self.integer(audit.as_ref(), "max_bytes", "a number, such as 16777216"),
                files: self.integer(audit.as_ref(), "files", "a number, such as 8"),
                off: self.boolean(audit.as_ref(), "off", "true or false"),
            },
            transport: self.transport(transport.as_ref()),
            partners: self
                .repeated(&top, "partner", Table::Partner)
                .iter()
                .map(|partner| self.partner(partner))
                .collect(),
            gateway: gateway.map(|gateway| self.gateway(&gateway)),
            metrics: metrics.map(|metrics| self.metrics(&metrics)),
        };
        draft.attempted = std::mem::take(&mut self.attempted);
        draft
    }

    fn identity(
        &mut self,
        top: &Section<'_, '_>,
        node: Option<&Section<'_, '_>>,
    ) -> Option<WithOrigin<PathBuf>> {
        const EXPECTED: &str = "a string, such as \"arm-1.identity\"";
        let above = self.string(Some(top), "identity", EXPECTED);
        let within = self.string(node, "identity", EXPECTED);
        if let (Some(above), Some(within)) = (&above, &within)
            && let Origin::File { line: Some(first), .. } = above.origin
        {
            self.errors.push(within.error(Mistake::IdentityTwice { first }));
        }
        above.or(within).map(|identity| identity.map(PathBuf::from))
    }

    fn ros(&mut self, ros: &Section<'_, '_>) -> RosDraft {
        let zenoh = self.single(ros, "ros.zenoh", Table::RosZenoh).map(|zenoh| self.zenoh(&zenoh));
        let ros = Some(ros);
        RosDraft {
            middleware: self.string(ros, "middleware", "a string, \"dds\", \"zenoh\" or \"both\""),
            domain_id: self.integer(ros, "domain_id", "a number, such as 7"),
            localhost_only: self.boolean(ros, "localhost_only", "true or false"),
            discovery_range: self.string(ros, "discovery_range", "a string, such as \"subnet\""),
            static_peers: self.strings(
                ros,
                "static_peers",
                "an array of strings, such as [\"10.0.0.2\", \"arm-2.local\"]",
            ),
            graph: self.boolean(ros, "graph", "true or false"),
            definitions: self.strings(
                ros,
                "definitions",
                "an array of strings, such as [\"/opt/robot/share\"]",
            ),
            enclave: self.string(ros, "enclave", "a string, such as \"/sgc\""),
            security_root: self.string(ros, "security_root", "a string, such as \"/opt/robot/keystore\""),
            zenoh,
        }
    }

    fn zenoh(&mut self, zenoh: &Section<'_, '_>) -> ZenohDraft {
        let origin = self.origin(zenoh.span.clone());
        let zenoh = Some(zenoh);
        ZenohDraft {
            origin,
            router: self.string(zenoh, "router", "a string, such as \"tcp/localhost:7447\""),
            config: self
                .string(zenoh, "config", "a string, such as \"session.json5\"")
                .map(|config| config.map(PathBuf::from)),
        }
    }

    fn share(&mut self, share: &Section<'_, '_>) -> ShareDraft {
        const TEXT: &str = "a string";
        self.check_required(share, "topic", "\"/camera/image\"");
        self.check_required(share, "to", "[\"desk\", \"group:operators\"]");
        let dead_man = self.single(share, "share.deadman", Table::ShareDeadMan);
        let dead_man = dead_man.map(|table| self.dead_man(&table));
        let share = Some(share);
        ShareDraft {
            topic: self.interface(share),
            to: self.strings(share, "to", "an array of strings, such as [\"desk\", \"group:operators\"]"),
            publish: self.strings(
                share,
                "publish",
                "an array of strings, such as [\"desk\", \"group:operators\"]",
            ),
            type_name: self.string(share, "type", "a string, such as \"sensor_msgs/msg/Image\""),
            priority: self.string(share, "priority", "a string, such as \"realtime\""),
            link: self.string(share, "link", "a string, \"shared\" or \"dedicated\""),
            suite: self.string(share, "suite", "a string, such as \"group\""),
            description: self.string(share, "description", TEXT),
            author: self.string(share, "author", TEXT),
            maintainer: self.string(share, "maintainer", TEXT),
            interface: self.string(share, "interface", TEXT),
            unique: self.string(share, "unique", TEXT),
            node: self.string(share, "node", TEXT),
            dead_man,
            shaping: self.shaping(share),
            qos: self.qos(share),
            naming: self.naming(share),
        }
    }

    fn read_use(&mut self, one: &Section<'_, '_>) -> UseDraft {
        // A token determines owner and topic.
        if !one.entries.contains_key("token") && !one.meant.contains(&"token") {
            self.check_required(one, "from", "\"arm-1\"");
            self.check_required(one, "topic", "\"/camera/image\"");
        }
        let dead_man = self.single(one, "use.deadman", Table::UseDeadMan).map(|table| self.dead_man(&table));
        let one = Some(one);
        UseDraft {
            token: self.string(one, "token", "a string, such as \"arm-1-pose.token\""),
            from: self.string(one, "from", "a string, such as \"arm-1\""),
            topic: self.interface(one),
            type_name: self.string(one, "type", "a string, such as \"sensor_msgs/msg/Image\""),
            publish: self.boolean(one, "publish", "true or false"),
            priority: self.string(one, "priority", "a string, such as \"realtime\""),
            shaping: self.shaping(one),
            qos: self.qos(one),
            naming: self.naming(one),
            frame_prefix: self.string(one, "frame_prefix", "a string, such as \"robot1/\""),
            dead_man,
            link: self.string(one, "link", "a string, \"shared\" or \"dedicated\""),
        }
    }

    fn dead_man(&mut self, table: &Section<'_, '_>) -> DeadManDraft {
        self.check_required(table, "after", "\"300ms\"");
        self.check_required(table, "publish", "\"zero\"");
        let origin = self.origin(table.span.clone());
        let table = Some(table);
        DeadManDraft {
            origin,
            after: self.string(table, "after", "a string, such as \"300ms\""),
            publish: self.string(table, "publish", "a string, \"zero\", \"last\" or the path of a JSON file"),
            repeat: self.string(table, "repeat", "a string, such as \"100ms\""),
            resume: self.string(table, "resume", "a string, \"auto\" or \"manual\""),
        }
    }

    /// Reads the name of a shared or used interface. Its key determines the kind.
    fn interface(&mut self, section: Option<&Section<'_, '_>>) -> Option<WithOrigin<String>> {
        let mut first: Option<WithOrigin<String>> = None;
        for interface in INTERFACES {
            let key = interface.key();
            let Some(named) = self.string(section, key, "a string, such as \"/camera/image\"") else {
                continue;
            };
            match &first {
                Some(other) => {
                    let other = other.key;
                    self.errors.push(named.error(Mistake::TwoInterfaces { key, other }));
                }
                None => first = Some(named),
            }
        }
        first
    }

    fn shaping(&mut self, topic: Option<&Section<'_, '_>>) -> ShapingDraft {
        ShapingDraft {
            max_rate: self.string(topic, "max_rate", "a string, such as \"10Hz\""),
            max_bandwidth: self.string(topic, "max_bandwidth", "a string, such as \"2Mbps\""),
            max_age: self.string(topic, "max_age", "a string, such as \"500ms\""),
            compress: self.string(topic, "compress", "a string, \"zstd\", \"lz4\" or \"none\""),
            encoding: self.string(topic, "encoding", "a string, \"cdr\" or \"json\""),
        }
    }

    fn qos(&mut self, topic: Option<&Section<'_, '_>>) -> QosDraft {
        const TIME: &str = "a string, such as \"500ms\"";
        QosDraft {
            reliability: self.string(topic, "reliability", "a string, \"reliable\" or \"best_effort\""),
            durability: self.string(topic, "durability", "a string, \"transient_local\" or \"volatile\""),
            history: self.string(topic, "history", "a string, \"keep_last\" or \"keep_all\""),
            depth: self.integer(topic, "depth", "a number, such as 10"),
            deadline: self.string(topic, "deadline", TIME),
            lifespan: self.string(topic, "lifespan", TIME),
        }
    }

    fn naming(&mut self, topic: Option<&Section<'_, '_>>) -> NamingDraft {
        const PATTERNS: &str = "an array of strings, such as [\"/camera/debug/**\"]";
        NamingDraft {
            except: self.strings(topic, "except", PATTERNS),
            renamed: self.string(topic, "as", "a string, such as \"/robot1/camera\""),
            namespace: self.string(topic, "namespace", "a string, such as \"/robot1\""),
        }
    }

    fn transport(&mut self, transport: Option<&Section<'_, '_>>) -> TransportDraft {
        const MARK: &str = "a string, such as \"EF\", \"AF41\", \"CS1\" or \"46\"";
        TransportDraft {
            congestion: self.string(transport, "congestion", "a string, such as \"delay\""),
            offload: self.boolean(transport, "offload", "true or false"),
            mtu_discovery: self.boolean(transport, "mtu_discovery", "true or false"),
            bulk_lanes: self.boolean(transport, "bulk_lanes", "true or false"),
            dtls_1_2: self.boolean(transport, "dtls_1_2", "true or false"),
            dscp: self.string(transport, "dscp", MARK),
            lane_dscp: self.string(transport, "lane_dscp", MARK),
        }
    }

    fn authority(&mut self, authority: Option<&Section<'_, '_>>) -> Option<WithOrigin<PathBuf>> {
        self.check_required(authority?, "fleet", "\"lab.fleet\"");
        let fleet = self.string(authority, "fleet", "a string, such as \"lab.fleet\"");
        fleet.map(|fleet| fleet.map(PathBuf::from))
    }

    fn partner(&mut self, partner: &Section<'_, '_>) -> PartnerDraft {
        const NODE: &str = "the node id of one node, or an array of such strings";
        self.check_required(partner, "name", "\"acme\"");
        self.check_required(partner, "ca", "\"acme-ca.pem\"");
        let is_one = partner.entries.get("node").is_some_and(|node| node.get_ref().is_str());
        let partner = Some(partner);
        let node = match is_one {
            true => self.string(partner, "node", NODE).map(|one| WithOrigin {
                key: one.key,
                origin: one.origin.clone(),
                value: vec![one],
            }),
            false => self.strings(partner, "node", NODE),
        };
        PartnerDraft {
            name: self.string(partner, "name", "a string, such as \"acme\""),
            ca: self
                .string(partner, "ca", "a string, such as \"acme-ca.pem\"")
                .map(|ca| ca.map(PathBuf::from)),
            node,
        }
    }

    fn store(&mut self, router: Option<&Section<'_, '_>>) -> StoreDraft {
        let mut file = |key, expected| Some(self.string(router, key, expected)?.map(PathBuf::from));
        let password_file = file("store_password_file", "a string, such as \"store.password\"");
        let ca = file("store_ca", "a string, such as \"store-ca.pem\"");
        let certificate = file("store_certificate", "a string, such as \"router.pem\"");
        let key = file("store_key", "a string, such as \"router.key\"");
        StoreDraft {
            servers: self.flat_strings(
                router,
                "store",
                "an array of strings, such as [\"valkey://store.example:6379\"]",
            ),
            prefix: self.string(router, "store_prefix", "a string, such as \"acme\""),
            user: self.string(router, "store_user", "a string, such as \"router\""),
            password_file,
            ca,
            certificate,
            key,
        }
    }

    fn metrics(&mut self, metrics: &Section<'_, '_>) -> MetricsDraft {
        let metrics = Some(metrics);
        let mut file = |key, expected| Some(self.string(metrics, key, expected)?.map(PathBuf::from));
        let headers = file("otlp_headers_file", "a string, such as \"collector.headers\"");
        let ca = file("otlp_ca", "a string, such as \"collector-ca.pem\"");
        MetricsDraft {
            listen: self.string(metrics, "listen", "a string, such as \"127.0.0.1:9464\""),
            otlp: self.string(metrics, "otlp", "a string, such as \"http://collector.example:4318\""),
            otlp_interval: self.string(metrics, "otlp_interval", "a string, such as \"60s\""),
            otlp_headers_file: headers,
            otlp_ca: ca,
        }
    }

    fn gateway(&mut self, gateway: &Section<'_, '_>) -> GatewayDraft {
        const FILES: &str = "a string, such as \"robot.pem\"";
        let clients = self.repeated(gateway, "gateway.client", Table::GatewayClient);
        let clients = clients.iter().map(|client| self.gateway_client(client)).collect();
        let origin = self.origin(gateway.span.clone());
        let gateway = Some(gateway);
        let mut file = |key| self.string(gateway, key, FILES).map(|written| written.map(PathBuf::from));
        let (certificate, key) = (file("certificate"), file("key"));
        GatewayDraft {
            origin: Some(origin),
            listen: self.strings(gateway, "listen", "an array of strings, such as [\"wss://0.0.0.0:9090\"]"),
            certificate,
            key,
            names: self.strings(
                gateway,
                "names",
                "an array of strings, such as [\"arm-1.lab.example\", \"10.0.0.7\"]",
            ),
            anonymous: self.string(gateway, "anonymous", "a string, \"local\", \"none\" or \"all\""),
            origins: self.flat_strings(
                gateway,
                "origins",
                "an array of strings, such as [\"https://dashboard.example.org\"]",
            ),
            plain: self.boolean(gateway, "plain", "true or false"),
            clients_max: self.integer(gateway, "clients_max", "a number, such as 512"),
            client_bytes_max: self.string(gateway, "client_bytes_max", "a string, such as \"64MiB\""),
            clients,
        }
    }

    fn gateway_client(&mut self, client: &Section<'_, '_>) -> GatewayClientDraft {
        const PATTERNS: &str = "an array of strings, such as [\"/odom\", \"/camera/**\"]";
        self.check_required(client, "who", "[\"desk\", \"group:operators\"]");
        let origin = self.origin(client.span.clone());
        let errors = self.errors.len();
        let is_meant = !client.meant.is_empty();
        let client = Some(client);
        let who = self.strings(client, "who", "an array of strings, such as [\"desk\", \"group:operators\"]");
        GatewayClientDraft {
            origin,
            who,
            subscribe: self.flat_strings(client, "subscribe", PATTERNS),
            publish: self.flat_strings(client, "publish", PATTERNS),
            call: self.flat_strings(client, "call", PATTERNS),
            serve: self.flat_strings(client, "serve", PATTERNS),
            is_broken: is_meant || self.errors.len() > errors,
        }
    }

    /// Reads the table `[key]`. `top` has the last word of the key.
    fn single<'s, 't>(
        &mut self,
        top: &Section<'s, 't>,
        key: &'static str,
        table: Table,
    ) -> Option<Section<'s, 't>> {
        let name = key.rsplit('.').next().unwrap_or(key);
        let value = top.entries.get(name)?;
        if let DeValue::Table(entries) = value.get_ref() {
            return Some(self.section(table, entries, value.span()));
        }
        let first = value.get_ref().as_array().and_then(|array| array.first());
        let is_repeated = first.is_some_and(|first| first.get_ref().is_table());
        let found = if is_repeated { "an array of tables".to_owned() } else { self.describe(value) };
        self.attempted.insert(key);
        self.record(value.span(), Mistake::NotSingle { key, found });
        None
    }

    /// Reads the tables `[[key]]`. `top` has the last word of the key.
    fn repeated<'s, 't>(
        &mut self,
        top: &Section<'s, 't>,
        key: &'static str,
        table: Table,
    ) -> Vec<Section<'s, 't>> {
        const EXPECTED: &str =
            "tables: [[share]], [[use]], [[partner]] or [[gateway.client]], and the keys below";
        let name = key.rsplit('.').next().unwrap_or(key);
        let Some(value) = top.entries.get(name) else { return Vec::new() };
        let mut sections = Vec::new();
        match value.get_ref() {
            DeValue::Array(array) => {
                for item in array.iter() {
                    if let DeValue::Table(entries) = item.get_ref() {
                        sections.push(self.section(table, entries, item.span()));
                    } else {
                        self.record_type(item, key, EXPECTED);
                    }
                }
            }
            DeValue::Table(_) => self.record(value.span(), Mistake::NotRepeated { key }),
            _ => self.record_type(value, key, EXPECTED),
        }
        sections
    }

    /// Creates a section after its keys were checked.
    fn section<'s, 't>(
        &mut self,
        table: Table,
        entries: &'s DeTable<'t>,
        span: Range<usize>,
    ) -> Section<'s, 't> {
        let mut meant = Vec::new();
        for (key, value) in entries.iter() {
            let name: &str = key.get_ref();
            if table.keys().contains(&name) {
                continue;
            }
            // A table's span begins with its header, which identifies it.
            let span = if value.get_ref().is_table() { value.span() } else { key.span() };
            let key = name.to_owned();
            let mistake = if table.planned_keys().contains(&name) {
                Mistake::PlannedKey { key }
            } else if let Some((known, homes)) = Table::homes(name) {
                self.attempted.insert(known);
                Mistake::MisplacedKey { table: table.header(), key, homes }
            } else {
                let nearest = nearest(name, table.keys());
                meant.extend(nearest);
                self.attempted.extend(nearest);
                Mistake::UnknownKey { table: table.header(), key, nearest, known: table.keys() }
            };
            self.record(span, mistake);
        }
        Section { table, entries, span, meant }
    }

    fn check_required(&mut self, section: &Section<'_, '_>, key: &'static str, example: &'static str) {
        let has = |key: &str| section.entries.contains_key(key) || section.meant.contains(&key);
        let replaced = key == "topic" && INTERFACES.iter().any(|interface| has(interface.key()));
        if !replaced && !has(key) {
            self.record(
                section.span.clone(),
                Mistake::MissingKey { table: section.table.header(), key, example },
            );
        }
    }

    fn string(
        &mut self,
        section: Option<&Section<'_, '_>>,
        key: &'static str,
        expected: &'static str,
    ) -> Option<WithOrigin<String>> {
        let value = section?.entries.get(key)?;
        self.typed(value, key, expected, |value| value.as_str().map(str::to_owned))
    }

    fn boolean(
        &mut self,
        section: Option<&Section<'_, '_>>,
        key: &'static str,
        expected: &'static str,
    ) -> Option<WithOrigin<bool>> {
        let value = section?.entries.get(key)?;
        self.typed(value, key, expected, DeValue::as_bool)
    }

    fn integer(
        &mut self,
        section: Option<&Section<'_, '_>>,
        key: &'static str,
        expected: &'static str,
    ) -> Option<WithOrigin<i64>> {
        let value = section?.entries.get(key)?;
        self.typed(value, key, expected, |value| {
            let integer = value.as_integer()?;
            i64::from_str_radix(integer.as_str(), integer.radix()).ok()
        })
    }

    fn strings(
        &mut self,
        section: Option<&Section<'_, '_>>,
        key: &'static str,
        expected: &'static str,
    ) -> Option<WithOrigin<Vec<WithOrigin<String>>>> {
        let value = section?.entries.get(key)?;
        let DeValue::Array(array) = value.get_ref() else {
            self.record_type(value, key, expected);
            return None;
        };
        let mut items = Vec::new();
        for item in array.iter() {
            items.extend(self.typed(item, key, expected, |item| item.as_str().map(str::to_owned)));
        }
        // A list of mistakes only is not meant to be empty.
        (array.is_empty() || !items.is_empty()).then(|| WithOrigin {
            value: items,
            key,
            origin: self.origin(value.span()),
        })
    }

    /// Reads a list of peers, or a word for all or none.
    fn direct(&mut self, node: Option<&Section<'_, '_>>) -> Option<WithOrigin<Vec<WithOrigin<String>>>> {
        const KEY: &str = "direct";
        const EXPECTED: &str = "\"auto\", \"never\", or an array of strings, such as [\"group:operators\"]";
        let value = node?.entries.get(KEY)?;
        let DeValue::String(_) = value.get_ref() else { return self.strings(node, KEY, EXPECTED) };
        let everyone = || WithOrigin { value: "*".to_owned(), key: KEY, origin: self.origin(value.span()) };
        let peers = match value.get_ref().as_str() {
            Some("auto") => vec![everyone()],
            Some("never") => Vec::new(),
            _ => {
                self.record_type(value, KEY, EXPECTED);
                return None;
            }
        };
        Some(WithOrigin { value: peers, key: KEY, origin: self.origin(value.span()) })
    }

    /// Reads strings, and arrays of strings with the URLs of one router.
    fn routers(&mut self, node: Option<&Section<'_, '_>>) -> Vec<WithOrigin<String>> {
        const KEY: &str = "routers";
        const EXPECTED: &str = "an array of strings, such as [\"quic://router.lab.example:7447\"], or of arrays of \
            strings that name the ways to one router";
        let Some(value) = node.and_then(|node| node.entries.get(KEY)) else { return Vec::new() };
        let DeValue::Array(array) = value.get_ref() else {
            self.record_type(value, KEY, EXPECTED);
            return Vec::new();
        };
        let mut routers = Vec::new();
        for item in array.iter() {
            let ways = item.get_ref().as_array().filter(|ways| !ways.is_empty());
            routers.extend(self.typed(item, KEY, EXPECTED, |item| match ways {
                Some(ways) => {
                    let ways = ways.iter().map(|way| way.get_ref().as_str());
                    Some(ways.collect::<Option<Vec<_>>>()?.join(","))
                }
                None => item.as_str().map(str::to_owned),
            }));
        }
        routers
    }

    fn flat_strings(
        &mut self,
        section: Option<&Section<'_, '_>>,
        key: &'static str,
        expected: &'static str,
    ) -> Vec<WithOrigin<String>> {
        self.strings(section, key, expected).map(|list| list.value).unwrap_or_default()
    }

    fn typed<'t, T>(
        &mut self,
        value: &Value<'t>,
        key: &'static str,
        expected: &'static str,
        convert: impl FnOnce(&DeValue<'t>) -> Option<T>,
    ) -> Option<WithOrigin<T>> {
        let converted = convert(value.get_ref());
        if converted.is_none() {
            self.record_type(value, key, expected);
        }
        Some(WithOrigin { value: converted?, key, origin: self.origin(value.span()) })
    }

    /// Describes the kind of a value, with the value itself if it is short.
    fn describe(&self, value: &Value<'_>) -> String {
        const WRITTEN_CHARS_MAX: usize = 40;
        let kind = match value.get_ref() {
            DeValue::String(_) => "a string",
            DeValue::Integer(_) => "an integer",
            DeValue::Float(_) => "a float",
            DeValue::Boolean(_) => "a boolean",
            DeValue::Datetime(_) => "a date",
            DeValue::Array(_) => return "an array".to_owned(),
            DeValue::Table(_) => return "a table".to_owned(),
        };
        match self.text.get(value.span()) {
            Some(written) if written.len() <= WRITTEN_CHARS_MAX && !written.contains('\n') => {
                format!("{kind} ({written})")
            }
            _ => kind.to_owned(),
        }
    }

    fn record_type(&mut self, value: &Value<'_>, key: &'static str, expected: &'static str) {
        self.attempted.insert(key);
        let found = self.describe(value);
        self.record(value.span(), Mistake::WrongType { key, found, expected });
    }

    fn record(&mut self, span: Range<usize>, mistake: Mistake) {
        let origin = self.origin(span);
        self.errors.push(ConfigError::new(origin, mistake));
    }

    fn origin(&self, span: Range<usize>) -> Origin {
        let line = 1 + self.line_starts.partition_point(|start| *start <= span.start);
        Origin::File { file: self.file.clone(), line: Some(line) }
    }
}
