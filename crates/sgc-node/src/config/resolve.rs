//! Draft → configuration: the values, and what they have to do with each other.
//!
//! All mistakes are collected. One that follows from another is not reported: a value that is wrong in itself
//! takes no part in comparisons.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use sgc_trust::{NodeName, Suite};
use sgc_wire::{Class, METADATA_FIELD_BYTES_MAX};

use super::draft::{Draft, Located, RosDraft, ShareDraft, UseDraft, Words};
use super::error::{ConfigError, Mistake, Origin};
use super::names::{self, Recipient};
use super::schema::nearest;
use super::{Config, Environment, ShareConfig, ShareMetadata, UseConfig, ros_env};

/// Shares of one node.
pub const SHARES_MAX: usize = 1024;
/// Uses of one node.
pub const USES_MAX: usize = 1024;
/// Recipients of one share.
pub const RECIPIENTS_MAX: usize = 1024;
/// Routers that one node dials.
pub const ROUTERS_MAX: usize = 16;
/// Addresses that one node listens at.
pub const LISTEN_MAX: usize = 16;
/// Path of a Unix socket: `sun_path` less its terminator.
pub const SOCKET_PATH_BYTES_MAX: usize = 107;

const SUITE_DEFAULT: Suite = Suite::Group;
const PRIORITIES: [&str; 3] = ["realtime", "default", "bulk"];
const SUITES: [&str; 1] = ["group"];
const SUITES_PLANNED: [&str; 2] = ["standard", "paper"];

/// An identity file and what an error about it needs to know.
pub(super) struct IdentityFile<'i> {
    pub(super) path: &'i Path,
    pub(super) key: &'static str,
    /// Not written down but following from the name.
    pub(super) implied: bool,
    pub(super) node_name: Option<&'i NodeName>,
}

/// A check of the identity file; an argument because it looks at the file system.
pub(super) type IdentityCheck<'c> = &'c dyn Fn(&IdentityFile<'_>) -> Result<(), Mistake>;

/// Judges a draft whose reader found `errors` already. Relative paths are taken from `base_dir`.
pub(super) fn resolve(
    draft: &Draft,
    errors: Vec<ConfigError>,
    base_dir: &Path,
    env: Environment<'_>,
    identity_check: Option<IdentityCheck<'_>>,
) -> Result<Config, Vec<ConfigError>> {
    let mut resolver = Resolver { words: draft.words, errors };
    let node_name = draft.name.as_ref().and_then(|name| resolver.keep(name, names::node));
    let identity = resolver.identity(draft, node_name.as_ref(), base_dir, identity_check);
    let routers = resolver.addresses(&draft.routers, names::router, ROUTERS_MAX);
    let listen = resolver.addresses(&draft.listen, names::listen, LISTEN_MAX);
    let attempted = |key| draft.attempted.contains(key);
    let connects = !draft.routers.is_empty() || !draft.listen.is_empty();
    if !connects && !["routers", "listen", "node", "router"].into_iter().any(attempted) {
        let (dial, listen) = (draft.words.dial, draft.words.listen);
        resolver.record(&draft.origin, Mistake::ConnectsToNobody { dial, listen });
    }
    let touches_ros = draft.ros.is_some() || !draft.shares.is_empty() || !draft.uses.is_empty();
    let ros = touches_ros.then(|| {
        let nothing = RosDraft::default();
        ros_env::resolve(draft.ros.as_ref().unwrap_or(&nothing), env, &mut resolver.errors)
    });
    let shares = resolver.shares(draft, node_name.as_ref());
    let uses = resolver.uses(draft, node_name.as_ref());
    let admin_socket = draft.admin_socket.as_ref().and_then(|socket| resolver.socket(socket, base_dir));
    match identity {
        Some(identity) if resolver.errors.is_empty() => {
            Ok(Config { node_name, identity, routers, listen, ros, shares, uses, admin_socket })
        }
        _ => Err(resolver.errors),
    }
}

struct Resolver {
    words: Words,
    errors: Vec<ConfigError>,
}

impl Resolver {
    fn record(&mut self, origin: &Origin, mistake: Mistake) {
        self.errors.push(ConfigError::new(origin.clone(), mistake));
    }

    /// The checked value, or nothing and an error.
    fn keep<T>(
        &mut self,
        located: &Located<String>,
        check: impl FnOnce(&'static str, &str) -> Result<T, Mistake>,
    ) -> Option<T> {
        check(located.key, &located.value).map_err(|mistake| self.errors.push(located.error(mistake))).ok()
    }

    fn check_count(&mut self, origin: &Origin, what: &'static str, count: usize, max: usize) {
        if count > max {
            self.record(origin, Mistake::TooMany { what, count, max });
        }
    }

    fn identity(
        &mut self,
        draft: &Draft,
        node_name: Option<&NodeName>,
        base_dir: &Path,
        check: Option<IdentityCheck<'_>>,
    ) -> Option<PathBuf> {
        const EXAMPLE: &str = "\"arm-1.identity\"";
        let (path, origin, implied) = match (&draft.identity, &draft.name) {
            (Some(identity), _) if identity.value.as_os_str().is_empty() => {
                let mistake = Mistake::Empty { key: identity.key, example: EXAMPLE };
                self.record(&identity.origin, mistake);
                return None;
            }
            (Some(identity), _) => (base_dir.join(&identity.value), &identity.origin, false),
            (None, Some(name)) => (base_dir.join(format!("{}.identity", node_name?)), &name.origin, true),
            (None, None) => {
                if ["identity", "name", "node"].into_iter().any(|key| draft.attempted.contains(key)) {
                    return None;
                }
                self.record(&draft.origin, Mistake::NoIdentity { missing: self.words.no_identity });
                return None;
            }
        };
        let file = IdentityFile { path: &path, key: self.words.identity, implied, node_name };
        if let Some(Err(mistake)) = check.map(|check| check(&file)) {
            self.record(origin, mistake);
        }
        Some(path)
    }

    fn addresses<T: Ord + Clone>(
        &mut self,
        written: &[Located<String>],
        check: fn(&'static str, &str) -> Result<T, Mistake>,
        max: usize,
    ) -> Vec<T> {
        if let Some(first) = written.get(max) {
            let mistake = Mistake::TooManyEntries { key: first.key, count: written.len(), max };
            self.record(&first.origin, mistake);
        }
        let mut seen = BTreeSet::new();
        let mut valid = Vec::new();
        for one in written.iter().take(max) {
            let Some(address) = self.keep(one, check) else { continue };
            if seen.insert(address.clone()) {
                valid.push(address);
            } else {
                self.record(&one.origin, Mistake::Repeated { key: one.key, value: one.value.clone() });
            }
        }
        valid
    }

    fn shares(&mut self, draft: &Draft, node_name: Option<&NodeName>) -> Vec<ShareConfig> {
        self.check_count(&draft.origin, self.words.share, draft.shares.len(), SHARES_MAX);
        let mut first: BTreeMap<&str, &Located<String>> = BTreeMap::new();
        let mut valid = Vec::new();
        for share in draft.shares.iter().take(SHARES_MAX) {
            let topic = share.topic.as_ref().and_then(|topic| self.keep(topic, names::topic));
            if let (Some(topic), Some(written)) = (&topic, &share.topic) {
                if let Some(other) = first.get(topic.as_str()) {
                    let mistake = Mistake::SharedTwice {
                        key: written.key,
                        topic: topic.clone(),
                        other: other.reference(),
                    };
                    self.record(&written.origin, mistake);
                } else {
                    first.insert(&written.value, written);
                }
            }
            valid.extend(self.share(share, topic, node_name));
        }
        valid
    }

    fn share(
        &mut self,
        share: &ShareDraft,
        topic: Option<String>,
        node_name: Option<&NodeName>,
    ) -> Option<ShareConfig> {
        let to = share.to.as_ref().map(|to| self.recipients(to, node_name));
        let type_name = share.type_name.as_ref().and_then(|name| self.keep(name, names::message_type));
        let priority = share.priority.as_ref().and_then(|priority| self.keep(priority, priority_class));
        let suite = share.suite.as_ref().and_then(|name| self.keep(name, suite));
        let metadata = ShareMetadata {
            description: self.metadata(share.description.as_ref()),
            author: self.metadata(share.author.as_ref()),
            maintainer: self.metadata(share.maintainer.as_ref()),
            interface: self.metadata(share.interface.as_ref()),
            unique: self.metadata(share.unique.as_ref()),
            node: self.metadata(share.node.as_ref()),
        };
        Some(ShareConfig {
            topic: topic?,
            to: to?,
            type_name,
            priority: priority.unwrap_or_default(),
            suite: suite.unwrap_or(SUITE_DEFAULT),
            metadata,
        })
    }

    fn recipients(
        &mut self,
        to: &Located<Vec<Located<String>>>,
        node_name: Option<&NodeName>,
    ) -> Vec<Recipient> {
        if to.value.is_empty() {
            self.record(&to.origin, Mistake::NobodyMay { key: to.key });
        }
        if to.value.len() > RECIPIENTS_MAX {
            let (key, count) = (to.key, to.value.len());
            self.record(&to.origin, Mistake::TooManyEntries { key, count, max: RECIPIENTS_MAX });
        }
        let mut seen = BTreeSet::new();
        let mut valid = Vec::new();
        for one in to.value.iter().take(RECIPIENTS_MAX) {
            let Some(recipient) = self.keep(one, names::recipient) else { continue };
            if seen.insert(recipient.clone()) {
                valid.push(recipient);
            } else {
                self.record(&one.origin, Mistake::Repeated { key: one.key, value: one.value.clone() });
            }
        }
        let other = valid.iter().find(|recipient| **recipient != Recipient::Everyone);
        if let Some(other) = other.filter(|_| seen.contains(&Recipient::Everyone)) {
            let other = other.to_string();
            self.record(&to.origin, Mistake::EveryoneAndMore { key: to.key, other });
        }
        if let ([Recipient::Node(only)], 1, Some(name)) = (&valid[..], to.value.len(), node_name)
            && only == name
        {
            self.record(&to.origin, Mistake::OnlyItself { key: to.key, name: name.to_string() });
        }
        valid
    }

    fn metadata(&mut self, text: Option<&Located<String>>) -> String {
        let Some(text) = text else { return String::new() };
        let (bytes, max) = (text.value.len(), METADATA_FIELD_BYTES_MAX);
        if bytes > max {
            self.record(&text.origin, Mistake::TooLong { key: text.key, bytes, max });
        }
        text.value.clone()
    }

    fn uses(&mut self, draft: &Draft, node_name: Option<&NodeName>) -> Vec<UseConfig> {
        self.check_count(&draft.origin, self.words.uses, draft.uses.len(), USES_MAX);
        let shared: BTreeMap<&str, &Located<String>> = draft
            .shares
            .iter()
            .filter_map(|share| share.topic.as_ref())
            .map(|topic| (topic.value.as_str(), topic))
            .rev()
            .collect();
        let mut first: BTreeMap<(NodeName, String), &Located<String>> = BTreeMap::new();
        let mut valid = Vec::new();
        for one in draft.uses.iter().take(USES_MAX) {
            let resolved = self.one_use(one, node_name);
            if let (Some(resolved), Some(written)) = (&resolved, &one.topic) {
                let (key, topic) = (written.key, resolved.topic.clone());
                let pair = (resolved.from.clone(), topic.clone());
                if let Some(other) = first.get(&pair) {
                    let (from, other) = (pair.0.to_string(), other.reference());
                    self.record(&written.origin, Mistake::UsedTwice { key, topic, from, other });
                } else if let Some(share) = shared.get(topic.as_str()) {
                    let other = share.reference();
                    self.record(&written.origin, Mistake::SharedAndUsed { key, topic, other });
                } else {
                    first.insert(pair, written);
                }
            }
            valid.extend(resolved);
        }
        valid
    }

    fn one_use(&mut self, one: &UseDraft, node_name: Option<&NodeName>) -> Option<UseConfig> {
        let from = one.from.as_ref().and_then(|from| {
            let name = self.keep(from, names::node)?;
            if node_name == Some(&name) {
                self.record(&from.origin, Mistake::UseFromItself { key: from.key, name: name.to_string() });
            }
            Some(name)
        });
        let topic = one.topic.as_ref().and_then(|topic| self.keep(topic, names::topic));
        let type_name = one.type_name.as_ref().and_then(|name| self.keep(name, names::message_type));
        Some(UseConfig { from: from?, topic: topic?, type_name })
    }

    fn socket(&mut self, socket: &Located<PathBuf>, base_dir: &Path) -> Option<PathBuf> {
        const EXAMPLE: &str = "\"/run/sgc/arm-1.sock\"";
        let path = base_dir.join(&socket.value);
        let (bytes, max) = (path.as_os_str().len(), SOCKET_PATH_BYTES_MAX);
        if socket.value.as_os_str().is_empty() {
            self.record(&socket.origin, Mistake::Empty { key: socket.key, example: EXAMPLE });
        } else if bytes > max {
            self.record(&socket.origin, Mistake::TooLong { key: socket.key, bytes, max });
        }
        Some(path)
    }
}

fn priority_class(key: &'static str, value: &str) -> Result<Class, Mistake> {
    match value {
        "realtime" => Ok(Class::Realtime),
        "default" => Ok(Class::Default),
        "bulk" => Ok(Class::Bulk),
        _ => Err(unknown_word(key, value, &PRIORITIES)),
    }
}

fn suite(key: &'static str, value: &str) -> Result<Suite, Mistake> {
    match value {
        "group" => Ok(Suite::Group),
        _ if SUITES_PLANNED.contains(&value) => Err(Mistake::PlannedValue {
            key,
            value: value.to_owned(),
            what: "this suite is",
            instead: "use \"group\"",
        }),
        _ => Err(unknown_word(key, value, &SUITES)),
    }
}

fn unknown_word(key: &'static str, value: &str, known: &'static [&'static str]) -> Mistake {
    Mistake::UnknownWord { key, value: value.to_owned(), nearest: nearest(value, known), known }
}
