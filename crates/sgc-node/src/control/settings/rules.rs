//! [`Rules`]: everything that follows from a configuration and its files at one moment, such as rules for the route
//! machine, CAs and routers. Start and reload use the same code.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use sgc_config::{
    Config, DeadManConfig, Recipient, RouterUrl, StopSource, TokenConfig, TokenSource, UseConfig,
};
use sgc_ros::{
    DeadManRule, Direction, Interface, Part, Shaping, ShareRule, StopMessage, UseRule, is_topic_name,
};
use sgc_trust::{Grantees, Identity, ShareToken, TOKEN_TEXT_BYTES_MAX, TokenError};
use sgc_wire::{Kind, NodeId, UnixMillis};

use crate::admin::report::ReportRights;
use crate::control::fleet::members::{MemberNames, unknown_members};
use crate::control::fleet::partners::{PartnerError, Partners};
use crate::control::settings::policy;
use crate::state;
use crate::state::fleet_file::read_fleet;

/// Most routers that tokens may add.
const TOKEN_ROUTERS_MAX: usize = 16;
/// Longest file with a stop message, in bytes.
const STOP_TEXT_BYTES_MAX: u64 = 64 << 10;

/// Everything that follows from a configuration and may change at run time.
#[derive(Clone, Debug, Default)]
pub(crate) struct Rules {
    pub(crate) shares: Vec<ShareRule>,
    pub(crate) uses: Vec<UseRule>,
    pub(crate) partners: Partners,
    /// Routers of tokens that the configuration does not name.
    pub(crate) routers: Vec<RouterUrl>,
    pub(crate) names: BTreeMap<NodeId, String>,
    pub(crate) members: MemberNames,
    /// The peers that may ask this node how it is doing.
    pub(crate) observers: Grantees,
    /// The peers that may have direct links.
    pub(crate) direct: Grantees,
    /// Whether the gateway is asked to map a port for these.
    pub(crate) port_mapping: bool,
    /// The nodes that may change the fleet, if this node is its authority.
    pub(crate) operators: Grantees,
    /// The rights in the words of the configuration, for observers.
    pub(crate) rights: Arc<ReportRights>,
    /// Faults that prevent nothing.
    pub(crate) warnings: Vec<String>,
}

impl Rules {
    /// Loads the files that `config` names, and those of the state directory.
    pub(crate) fn load(
        config: &Config,
        identity: &Identity,
        state: Option<&Path>,
        now: UnixMillis,
    ) -> Result<Self, RulesError> {
        let mut rules = Self { partners: Partners::load(config, state, now)?, ..Self::default() };
        let mut names = BTreeSet::new();
        for one in &config.tokens {
            let token = match &one.source {
                TokenSource::File(path) => read_token(path)?,
                TokenSource::Text(token) => ShareToken::clone(token),
            };
            if !names.insert(token.name()) {
                return Err(RulesError::TokenTwice { topic: token.metadata.ros_name.clone() });
            }
            rules.add_token(config, identity, token, one, now)?;
        }
        let partners = &rules.partners;
        let mut shares = Vec::new();
        for one in &config.shares {
            let dead_man = one.dead_man.as_ref().map(dead_man_rule).transpose()?;
            shares.extend(policy::share_rules(one, dead_man.as_ref(), identity, partners));
        }
        rules.shares = shares;
        let mut of_fleet = Vec::new();
        for one in &config.uses {
            let dead_man = one.dead_man.as_ref().map(dead_man_rule).transpose()?;
            of_fleet.extend(use_rules(one, dead_man.as_ref(), identity));
        }
        rules.uses.splice(0..0, of_fleet);
        rules.names = peer_names(config, identity, &rules);
        rules.members = MemberNames::from_config(config, identity);
        rules.rights = Arc::new(policy::written_rights(config, &rules.partners));
        rules.observers = policy::grantees(&config.observers(), identity, &rules.partners);
        rules.port_mapping = config.port_mapping;
        rules.direct = policy::grantees(&config.direct, identity, &rules.partners);
        let operators =
            config.authority.as_ref().map(|authority| &authority.operators[..]).unwrap_or_default();
        rules.operators = policy::grantees(operators, identity, &rules.partners);
        let is_unknown = |one: &Recipient| match one {
            Recipient::Node(node) => identity.node_id_of(node.as_str()).is_none(),
            Recipient::Group(group) => identity.group_tag(group.as_str()).is_none(),
            Recipient::Everyone | Recipient::Partner(_) => false,
        };
        if let Some(one) = config.observers.iter().flatten().find(|one| is_unknown(one)) {
            rules.warnings.push(format!(
                "`observers` names \"{one}\", which this node cannot recognise: it only routes and holds no secret of the \
                 fleet. It knows \"group:observers\" and \"*\""
            ));
        }
        if let Some(authority) = &config.authority
            && let Ok(fleet) = read_fleet(&authority.fleet)
        {
            // The authority itself reports an unusable fleet file.
            let known = fleet.nodes().map(|node| node.name.as_str());
            let named = known.filter_map(|name| Some((identity.node_id_of(name)?, name.to_owned())));
            rules.names.extend(named);
            rules.warnings.extend(unknown_members(config, &fleet).iter().map(ToString::to_string));
        }
        for grant in &rules.partners.tokens {
            let is_shared = |s: &sgc_config::ShareConfig| {
                (s.interface, &s.topic) == (Interface::Topic, &grant.topic)
                    && s.type_name.as_ref().is_none_or(|t| *t == grant.type_name)
            };
            if !config.shares.iter().any(is_shared) {
                rules.warnings.push(format!(
                    "token {} is for {} [{}], which is not shared any more: sgc token share revoke {}",
                    grant.id, grant.topic, grant.type_name, grant.id
                ));
            }
        }
        Ok(rules)
    }

    fn add_token(
        &mut self,
        config: &Config,
        identity: &Identity,
        token: ShareToken,
        wanted: &TokenConfig,
        now: UnixMillis,
    ) -> Result<(), RulesError> {
        let topic = token.metadata.ros_name.clone();
        if token.owner == identity.node_id() {
            return Err(RulesError::OwnToken { topic });
        }
        let here = wanted.naming.renamed(&topic, &topic);
        if config.shares.iter().any(|share| (share.interface, &share.topic) == (Interface::Topic, &here)) {
            return Err(RulesError::SharedAndUsed { topic: here });
        }
        if !is_topic_name(&here) {
            return Err(RulesError::TokenName { topic: here });
        }
        if token.expires < now {
            let (owner, expires) = (&token.owner_name, token.expires);
            self.warnings
                .push(format!("the token for {topic} ended at {expires}: ask {owner} for a new one"));
            return Ok(());
        }
        for url in &token.routers {
            match url.parse::<RouterUrl>() {
                // A search of the owner's local network is useless on this one.
                Ok(RouterUrl::Mdns(_)) => {}
                Ok(url) if config.routers.contains(&url) || self.routers.contains(&url) => {}
                Ok(url) if self.routers.len() < TOKEN_ROUTERS_MAX => self.routers.push(url),
                Ok(_) => {}
                Err(_) => {
                    self.warnings.push(format!("the token for {topic} names a router that cannot be dialled"))
                }
            }
        }
        self.partners.trust(vec![token.ca.clone()]);
        self.uses.push(UseRule {
            direction: Direction::Bring,
            owner: token.owner,
            owner_name: token.owner_name.to_string(),
            kind: Kind::Topic,
            topic,
            naming: wanted.naming.clone(),
            frame_prefix: wanted.frame_prefix.clone(),
            dead_man: wanted.dead_man.as_ref().map(dead_man_rule).transpose()?,
            type_name: Some(token.metadata.type_name.clone()),
            token: Some((token.name(), token.metadata)),
            class: None,
            shaping: Shaping::default(),
            qos: wanted.qos,
            dedicated: wanted.dedicated,
        });
        Ok(())
    }
}

/// Reads the stop message of a dead-man switch, if it is in a file.
fn dead_man_rule(config: &DeadManConfig) -> Result<DeadManRule, RulesError> {
    let stop = match &config.stop {
        StopSource::Zero => StopMessage::Zero,
        StopSource::Last => StopMessage::Last,
        StopSource::File(path) => StopMessage::Json(read_stop(path)?),
    };
    Ok(DeadManRule { after: config.after, stop, repeat: config.repeat, resume: config.resume })
}

/// Reads a file with a stop message as JSON, at most 64 KiB.
///
/// # Errors
/// It cannot be read, is too long, or holds no JSON object.
pub fn read_stop(path: &Path) -> Result<Arc<str>, RulesError> {
    let failed = |source| RulesError::StopFile { path: path.to_owned(), source };
    let mut text = String::new();
    let file = fs::File::open(path).map_err(failed)?;
    file.take(STOP_TEXT_BYTES_MAX + 1).read_to_string(&mut text).map_err(failed)?;
    if text.len() as u64 > STOP_TEXT_BYTES_MAX {
        return Err(failed(io::Error::other(format!("it has more than {STOP_TEXT_BYTES_MAX} bytes"))));
    }
    let is_object = serde_json::from_str(&text).map(|json: serde_json::Value| json.is_object());
    match is_object {
        Ok(true) => Ok(text.into()),
        Ok(false) => Err(failed(io::Error::other("it is no JSON object"))),
        Err(error) => Err(failed(io::Error::other(error))),
    }
}

/// Reads a token file, which only its owner may read.
pub fn read_token(path: &Path) -> Result<ShareToken, RulesError> {
    let failed = |source| RulesError::TokenFile { path: path.to_owned(), source };
    let file = fs::File::open(path).map_err(failed)?;
    if let Some(mode) = state::exposed(&file.metadata().map_err(failed)?) {
        return Err(failed(io::Error::other(format!("its mode {mode:04o} lets others at it; chmod 600 it"))));
    }
    let mut text = zeroize::Zeroizing::new(String::with_capacity(TOKEN_TEXT_BYTES_MAX + 2));
    file.take(TOKEN_TEXT_BYTES_MAX as u64 + 2).read_to_string(&mut text).map_err(failed)?;
    ShareToken::parse(&text).map_err(|source| RulesError::Token { path: path.to_owned(), source })
}

/// Returns the rules for the topics and services of a use.
fn use_rules(rule: &UseConfig, dead_man: Option<&DeadManRule>, identity: &Identity) -> Vec<UseRule> {
    let Some(owner) = identity.node_id_of(rule.from.as_str()) else { return Vec::new() };
    let part = |part: &Part| UseRule {
        direction: match part.kind {
            // A client publishes requests.
            Kind::Service => Direction::Publish,
            _ if rule.publish => Direction::Publish,
            _ => Direction::Bring,
        },
        owner,
        owner_name: rule.from.to_string(),
        kind: part.kind,
        topic: part.name(&rule.topic),
        naming: rule.naming.for_part(part),
        frame_prefix: rule.frame_prefix.clone(),
        dead_man: dead_man.cloned(),
        type_name: part.type_name(rule.type_name.as_deref()),
        token: None,
        class: rule.priority,
        shaping: rule.shaping,
        qos: rule.qos,
        dedicated: rule.dedicated,
    };
    rule.interface.parts().iter().map(part).collect()
}

/// Returns the names that the configuration has for peers.
fn peer_names(config: &Config, identity: &Identity, rules: &Rules) -> BTreeMap<NodeId, String> {
    let mut names = BTreeMap::new();
    for (partner, resolved) in config.partners.iter().zip(rules.partners.configured.values()) {
        let name = |node: &NodeId| (*node, format!("partner:{}", partner.name));
        names.extend(resolved.nodes.iter().map(name));
    }
    names.extend(rules.uses.iter().map(|rule| (rule.owner, rule.owner_name.clone())));
    let named = config.shares.iter().flat_map(|s| s.to.iter().chain(&s.publish));
    let operators = config.authority.iter().flat_map(|authority| &authority.operators);
    let named = named.chain(operators).chain(config.observers.iter().flatten()).chain(&config.direct);
    for recipient in named {
        if let Recipient::Node(node) = recipient {
            names.extend(identity.node_id_of(node.as_str()).map(|id| (id, node.to_string())));
        }
    }
    names
}

/// Reasons why a valid configuration cannot be applied.
#[derive(Debug, thiserror::Error)]
pub enum RulesError {
    /// The partners are invalid.
    #[error(transparent)]
    Partner(#[from] PartnerError),
    /// A token cannot be read.
    #[error("token {}: {source}", path.display())]
    TokenFile {
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        source: io::Error,
    },
    /// A token file holds no token.
    #[error("token {}: {source}", path.display())]
    Token {
        /// The file.
        path: PathBuf,
        /// The fault.
        source: TokenError,
    },
    /// The stop message of a dead-man switch cannot be read.
    #[error("stop message {}: {source}", path.display())]
    StopFile {
        /// The file.
        path: PathBuf,
        /// The fault.
        source: io::Error,
    },
    /// Two tokens for the same topic.
    #[error("two tokens for {topic} of the same owner: take one [[use]] out")]
    TokenTwice {
        /// The topic.
        topic: String,
    },
    /// A token that this node issued itself.
    #[error("the token for {topic} is this node's own: it is for a partner")]
    OwnToken {
        /// The topic.
        topic: String,
    },
    /// The topic of a token has no valid local name.
    #[error(
        "a token brings {topic:?} here, which is no name for a topic of ROS 2, or too long a one: give another with `as`"
    )]
    TokenName {
        /// The name here.
        topic: String,
    },
    /// The topic of a token would return in a loop.
    #[error(
        "a token brings {topic} here, which a [[share]] shares: it would be shared again, in a loop; keep one"
    )]
    SharedAndUsed {
        /// The topic.
        topic: String,
    },
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use rand_core::{OsRng, TryRngCore as _};
    use sgc_config::AuthorityConfig;
    use sgc_trust::{EnrollRequest, Fleet};

    use super::*;

    #[test]
    fn authority_knows_its_operators_and_the_nodes_of_its_file_by_name() {
        let now = UnixMillis(1_795_000_000_000);
        let rng = &mut OsRng.unwrap_err();
        let mut fleet = Fleet::create("lab".parse().unwrap(), now, rng).unwrap();
        let keeper = fleet.enroll(&EnrollRequest::new("keeper".parse().unwrap(), now), rng).unwrap();
        let arm = fleet.enroll(&EnrollRequest::new("arm".parse().unwrap(), now), rng).unwrap();
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("lab.fleet");
        let operators = vec![Recipient::Node("laptop".parse().unwrap())];
        let authority = Some(AuthorityConfig { fleet: file.clone(), operators });
        let config = Config { authority, ..Config::default() };
        let name = |node: &sgc_wire::NodeId| {
            Rules::load(&config, &keeper, None, now).unwrap().names.get(node).cloned()
        };
        let laptop = keeper.node_id_of("laptop").unwrap();
        assert_eq!((name(&laptop).as_deref(), name(&arm.node_id())), (Some("laptop"), None));
        state::replace(&file, fleet.to_text().as_bytes()).unwrap();
        assert_eq!(name(&arm.node_id()).as_deref(), Some("arm"));
    }
}
