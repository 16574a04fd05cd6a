//! Command line to draft: `sgc run --identity … --router … --share … --to … --use …` without a file.
//!
//! `--share /topic --to desk --to group:operators` shares with all recipients of `--to`; `--share
//! /topic=desk,group:operators` names recipients of one topic. A word in front of a name selects the kind of interface,
//! like the keys of a file: `--share service:/add_two_ints`, `--use arm-1:action:/fibonacci`. Without recipients, every
//! member of the fleet may subscribe; `sgc run` reports that.

use std::collections::BTreeSet;
use std::path::PathBuf;

use crate::draft::{
    AuditDraft, Draft, GatewayDraft, RosDraft, RotationDraft, ShareDraft, StoreDraft, TransportDraft,
    UseDraft, WithOrigin, Words,
};
use crate::error::{ConfigError, Mistake, Origin};
use crate::schema::nearest;

const WORDS: Words = Words {
    no_identity: "no `--identity`",
    identity: "--identity",
    dial: "`--router`",
    listen: "`--listen`",
    share: "`--share`",
    uses: "`--use`",
};

/// Words for the kinds of interfaces, each with its key in a share and in a use.
const KINDS: [(&str, &str, &str); 4] = [
    ("topic", "--share", "--use"),
    ("service", "--share service", "--use service"),
    ("action", "--share action", "--use action"),
    ("parameters", "--share parameters", "--use parameters"),
];
const KIND_WORDS: [&str; KINDS.len()] = [KINDS[0].0, KINDS[1].0, KINDS[2].0, KINDS[3].0];

/// The arguments of `sgc run` that replace a file, as given.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ArgsConfig {
    /// `--identity FILE`
    pub identity: Option<PathBuf>,
    /// `--router URL`, any number.
    pub routers: Vec<String>,
    /// `--share [KIND:]/NAME` or `--share [KIND:]/NAME=NODE,group:GROUP`, any number.
    pub shares: Vec<String>,
    /// `--to NODE`, `--to group:GROUP` or `--to '*'`, any number: recipients of the shares that name none. Without it,
    /// the whole fleet.
    pub to: Vec<String>,
    /// `--use NODE:[KIND:]/NAME`, any number.
    pub uses: Vec<String>,
    /// `--peer URL` of `sgc router`, any number: the same as `routers` in a file.
    pub peers: Vec<String>,
    /// `--listen URL`, any number.
    pub listen: Vec<String>,
    /// `--announce`
    pub announce: bool,
    /// `--accept FILE`, any number.
    pub accept: Vec<PathBuf>,
    /// `--gateway`: an empty `[gateway]`.
    pub gateway: bool,
}

/// Parses the arguments.
pub(crate) fn read(args: &ArgsConfig) -> (Draft, Vec<ConfigError>) {
    let mut errors = Vec::new();
    let mut record = |mistake| errors.push(ConfigError::new(Origin::Arguments, mistake));
    let mut to_taken = false;
    let mut shares = Vec::new();
    for share in &args.shares {
        let (topic, to) = match share.split_once('=') {
            Some((topic, to)) => {
                let to = to.split(',').map(str::trim).filter(|one| !one.is_empty());
                (topic, Some(located("--share", to.map(|one| located("--share", one.to_owned())).collect())))
            }
            None if args.to.is_empty() => {
                (share.as_str(), Some(located("--share", vec![located("--share", "*".to_owned())])))
            }
            None => {
                to_taken = true;
                (share.as_str(), Some(located("--to", all("--to", &args.to))))
            }
        };
        let named = named(topic, |(_, share, _)| share);
        shares.push(ShareDraft { topic: named.map_err(&mut record).ok(), to, ..ShareDraft::default() });
    }
    if !args.to.is_empty() && !to_taken {
        record(Mistake::ToWithoutShare);
    }
    let mut uses = Vec::new();
    for one in &args.uses {
        let Some((from, topic)) = one.split_once(':') else {
            record(Mistake::UseArgument { value: one.clone() });
            continue;
        };
        let named = named(topic, |(_, _, used)| used);
        uses.push(UseDraft {
            from: Some(located("--use", from.to_owned())),
            topic: named.map_err(&mut record).ok(),
            ..UseDraft::default()
        });
    }
    // A use that could not be parsed still shows that this node is more than a router.
    let touches_ros = !args.shares.is_empty() || !args.uses.is_empty();
    let draft = Draft {
        origin: Origin::Arguments,
        words: WORDS,
        attempted: BTreeSet::new(),
        identity: args.identity.clone().map(|identity| located("--identity", identity)),
        name: None,
        routers: [all("--router", &args.routers), all("--peer", &args.peers)].concat(),
        resolver: None,
        keep_alive: None,
        direct: None,
        port_mapping: None,
        listen: all("--listen", &args.listen),
        peer_rate: None,
        mapping: None,
        store: StoreDraft::default(),
        announce: args.announce.then(|| located("--announce", true)),
        accept: (!args.accept.is_empty()).then(|| {
            let files = args.accept.iter().map(|file| file.to_string_lossy().into_owned());
            located("--accept", files.map(|file| located("--accept", file)).collect())
        }),
        ros: touches_ros.then(RosDraft::default),
        shares,
        uses,
        admin_socket: None,
        observers: None,
        state: None,
        trust: Vec::new(),
        watch: None,
        authority: None,
        operators: None,
        rotation: RotationDraft::default(),
        audit: AuditDraft::default(),
        transport: TransportDraft::default(),
        partners: Vec::new(),
        gateway: args.gateway.then(GatewayDraft::default),
        metrics: None,
    };
    (draft, errors)
}

/// Splits the word for the kind from a name. Without one, the kind is a topic.
fn named(
    text: &str,
    key: fn((&'static str, &'static str, &'static str)) -> &'static str,
) -> Result<WithOrigin<String>, Mistake> {
    // The name may be invalid, but a word before its slash is no part of it.
    let (word, name) =
        text.split_once(':').filter(|(word, _)| !word.contains('/')).unwrap_or(("topic", text));
    match KINDS.into_iter().find(|(kind, ..)| *kind == word) {
        Some(kind) => Ok(located(key(kind), name.to_owned())),
        None => {
            let (key, value) = (key(KINDS[0]), word.to_owned());
            Err(Mistake::UnknownWord { key, value, nearest: nearest(word, &KIND_WORDS), known: &KIND_WORDS })
        }
    }
}

fn located<T>(key: &'static str, value: T) -> WithOrigin<T> {
    WithOrigin { value, key, origin: Origin::Arguments }
}

fn all(key: &'static str, values: &[String]) -> Vec<WithOrigin<String>> {
    values.iter().map(|value| located(key, value.clone())).collect()
}
