//! Access to this node's gateway: builds an [`Access`] from the configuration and from the access tokens that were made
//! and revoked.
//!
//! The gateway decides when a client connects. Records of tokens are kept in the state directory, so that users can
//! list and revoke them. A token is valid without its record, since the node signed it.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use sgc_config::{Config, Recipient};
use sgc_gateway::{
    ACCESS_VALID_MS_MAX, Access, AccessGrant, AccessRules, ClientRule, RefusalListener, Right, Scope, TokenId,
};
use sgc_trust::{AnchorError, Identity};
use sgc_wire::{Now, UnixMillis};

use crate::control::fleet::partners::{PartnerError, Partners};
use crate::control::settings::policy;
use crate::state::audit::{Audit, AuditEvent, AuditRecord};
use crate::state::credentials::with_kept_crls;
use crate::state::records::{self, Records};

/// Most tokens of one node that have not expired, revoked ones included.
pub const ACCESS_TOKENS_MAX: usize = 1024;
/// Largest file of records, bytes. It holds that many tokens with the largest scopes.
const RECORDS_BYTES_MAX: u64 = 16 * 1024 * 1024;
const RECORDS_FILE: &str = "access.json";
const RECORDS_VERSION: u32 = 1;
/// Fewest digits that abbreviate a token id.
const PREFIX_DIGITS_MIN: usize = 4;

/// Returns the access rules for the gateway of `config`; `None` if it has none. The CAs are those of the configuration,
/// with the revocation lists of the state directory. A running node passes newer lists with [`Access::with_anchors`].
pub fn access_of(
    config: &Config,
    identity: &Identity,
    state: Option<&Path>,
    now: Now,
) -> Result<Option<Access>, AccessError> {
    if config.gateway.is_none() {
        return Ok(None);
    }
    let partners = Partners::load(config, state, now.unix)?;
    access_with(config, identity, &partners, state, now)
}

/// Returns the access rules with partners that were loaded before.
pub fn access_with(
    config: &Config,
    identity: &Identity,
    partners: &Partners,
    state: Option<&Path>,
    now: Now,
) -> Result<Option<Access>, AccessError> {
    let Some(gateway) = &config.gateway else { return Ok(None) };
    let records = state.map(AccessRecords::load).transpose()?.unwrap_or_default();
    let rule = |client: &sgc_config::GatewayClientConfig| ClientRule {
        who: policy::grantees(&client.who, identity, partners),
        scope: client.scope.clone(),
    };
    let named = gateway.clients.iter().flat_map(|client| &client.who);
    let names = named.filter_map(|recipient| match recipient {
        Recipient::Node(node) => Some((identity.node_id_of(node.as_str())?, node.to_string())),
        _ => None,
    });
    let anchors = with_kept_crls(state, partners.extend(identity)?, now);
    Ok(Some(Access::new(AccessRules {
        anonymous: gateway.anonymous,
        origins: gateway.origins.clone(),
        plain: gateway.plain,
        clients: gateway.clients.iter().map(rule).collect(),
        gateway: Some(identity.as_peer().clone()),
        anchors: Some(anchors),
        revoked: records.revoked()?.collect(),
        names: names.collect(),
    })))
}

/// Returns a handler that logs each refused access token.
pub(crate) fn refused_tokens(audit: Audit) -> RefusalListener {
    Arc::new(move |peer, denied| {
        let record = AuditRecord::new(AuditEvent::TokenRefused);
        audit.write(record.remote(peer).reason(denied));
    })
}

/// Records of the access tokens that a node made, `access.json` in its state directory. The tokens themselves are not
/// kept.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct AccessRecords {
    version: u32,
    /// Tokens that have not expired, in order of creation. Expired ones are removed when another is added.
    pub tokens: Vec<AccessRecord>,
}

impl Default for AccessRecords {
    fn default() -> Self {
        Self { version: RECORDS_VERSION, tokens: Vec::new() }
    }
}

/// Record of one token, without the token itself.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct AccessRecord {
    /// Token id, hexadecimal digits.
    pub id: String,
    /// Label for people.
    pub label: String,
    /// Topics that its holder may receive.
    pub subscribe: Vec<String>,
    /// Topics that its holder may publish on.
    pub publish: Vec<String>,
    /// Services that its holder may call.
    pub call: Vec<String>,
    /// Services that its holder may serve.
    pub serve: Vec<String>,
    /// Time of creation, milliseconds since 1970.
    pub created: u64,
    /// Last moment of validity, milliseconds since 1970.
    pub expires: u64,
    /// Time of revocation, milliseconds since 1970.
    pub revoked: Option<u64>,
}

impl From<&AccessGrant> for AccessRecord {
    fn from(grant: &AccessGrant) -> Self {
        let patterns = |right| grant.scope.patterns(right).to_vec();
        Self {
            id: grant.id.to_string(),
            label: grant.label.clone(),
            subscribe: patterns(Right::Subscribe),
            publish: patterns(Right::Publish),
            call: patterns(Right::Call),
            serve: patterns(Right::Serve),
            created: grant.issued.0,
            expires: grant.expires.0,
            revoked: None,
        }
    }
}

impl AccessRecord {
    /// Returns the rights of its holder.
    pub fn scope(&self) -> Scope {
        let Self { subscribe, publish, call, serve, .. } = self.clone();
        Scope { subscribe, publish, call, serve }
    }

    /// Creates the record of a revoked token that the list lacks, for example because the state directory was lost. It
    /// is kept for the longest validity of a token.
    fn unknown(id: TokenId, now: UnixMillis) -> Self {
        Self {
            id: id.to_string(),
            label: String::new(),
            subscribe: Vec::new(),
            publish: Vec::new(),
            call: Vec::new(),
            serve: Vec::new(),
            created: now.0,
            expires: now.0.saturating_add(ACCESS_VALID_MS_MAX),
            revoked: None,
        }
    }
}

impl Records for AccessRecords {
    type Error = AccessError;
    const FILE: &str = RECORDS_FILE;
    const BYTES_MAX: u64 = RECORDS_BYTES_MAX;
    const VERSION: u32 = RECORDS_VERSION;

    fn version(&self) -> u32 {
        self.version
    }

    fn failed(path: PathBuf, source: io::Error) -> AccessError {
        AccessError::Records { path, source }
    }
}

impl AccessRecords {
    /// Loads the records; none if there is no file. An unreadable file is an error, since it may hold revocations.
    pub fn load(state: &Path) -> Result<Self, AccessError> {
        records::load(state)
    }

    /// Changes the file under its lock.
    pub fn change<T>(
        state: &Path,
        change: impl FnOnce(&mut Self) -> Result<T, AccessError>,
    ) -> Result<T, AccessError> {
        records::change(state, change)
    }

    /// Adds a record and removes those that expired before `now`.
    pub fn add(&mut self, record: AccessRecord, now: UnixMillis) -> Result<(), AccessError> {
        self.make_room(now)?;
        self.tokens.push(record);
        Ok(())
    }

    /// Revokes a token by its id, or by the first digits if they are unique. A token without a record needs the whole
    /// id.
    pub fn revoke(&mut self, digits: &str, now: UnixMillis) -> Result<AccessRecord, AccessError> {
        let begins = |record: &AccessRecord| {
            digits.len() >= PREFIX_DIGITS_MIN && record.id.starts_with(digits) && record.expires >= now.0
        };
        let mut found = self.tokens.iter().enumerate().filter(|(_, record)| begins(record)).map(|(at, _)| at);
        let at = match (found.next(), found.next(), digits.parse::<TokenId>()) {
            (Some(at), None, _) => at,
            (Some(_), Some(_), _) => return Err(AccessError::Ambiguous { digits: digits.to_owned() }),
            (None, _, Ok(id)) => {
                self.make_room(now)?;
                self.tokens.push(AccessRecord::unknown(id, now));
                self.tokens.len() - 1
            }
            (None, _, Err(_)) => return Err(AccessError::NoSuchToken { digits: digits.to_owned() }),
        };
        let record = &mut self.tokens[at];
        record.revoked.get_or_insert(now.0);
        Ok(record.clone())
    }

    /// Returns the ids of revoked tokens.
    pub fn revoked(&self) -> Result<impl Iterator<Item = TokenId>, AccessError> {
        let revoked = self.tokens.iter().filter(|record| record.revoked.is_some());
        let id = |record: &AccessRecord| {
            record.id.parse().map_err(|_| AccessError::Record { id: record.id.clone() })
        };
        Ok(revoked.map(id).collect::<Result<Vec<_>, _>>()?.into_iter())
    }

    fn make_room(&mut self, now: UnixMillis) -> Result<(), AccessError> {
        self.tokens.retain(|known| known.expires >= now.0);
        if self.tokens.len() >= ACCESS_TOKENS_MAX { Err(AccessError::TooManyTokens) } else { Ok(()) }
    }
}

/// Reasons why the access rules cannot be built.
#[derive(Debug, thiserror::Error)]
pub enum AccessError {
    /// The partners are invalid.
    #[error(transparent)]
    Partner(#[from] PartnerError),
    /// The CAs of partners are invalid.
    #[error("the CAs that are trusted: {0}")]
    Anchors(#[from] AnchorError),
    /// The file of records cannot be used.
    #[error("access tokens made, {}: {source}", path.display())]
    Records {
        /// The file.
        path: PathBuf,
        /// The fault.
        source: io::Error,
    },
    /// A record is invalid.
    #[error(
        "{RECORDS_FILE} in the state directory has a token {id:?}, which is no id: it was changed by hand; correct it"
    )]
    Record {
        /// The invalid id.
        id: String,
    },
    /// There are too many tokens.
    #[error(
        "{ACCESS_TOKENS_MAX} access tokens have not ended, which is the limit: make them for a shorter time, or name nodes \
         in a [[gateway.client]]"
    )]
    TooManyTokens,
    /// No token has that id.
    #[error(
        "no access token begins with {digits:?}: `sgc token access list` shows them; {PREFIX_DIGITS_MIN} digits at least, or all 32 \
         of one that is not listed"
    )]
    NoSuchToken {
        /// The given digits.
        digits: String,
    },
    /// Several tokens begin with these digits.
    #[error("several access tokens begin with {digits:?}: add digits; `sgc token access list` shows them")]
    Ambiguous {
        /// The given digits.
        digits: String,
    },
}

#[cfg(test)]
mod tests {
    use rand_chacha::ChaCha20Rng;
    use rand_chacha::rand_core::SeedableRng as _;
    use sgc_gateway::{AdmissionRequest, Denial};
    use sgc_trust::{EnrollRequest, Fleet};

    use super::*;

    const NOW: UnixMillis = UnixMillis(1_795_000_000_000);

    fn record(id: &str, expires: u64) -> AccessRecord {
        let id = format!("{id}{}", "0".repeat(32 - id.len()));
        AccessRecord { id, label: "desk".into(), expires, ..AccessRecord::unknown(TokenId([0; 16]), NOW) }
    }

    struct Cast {
        dir: tempfile::TempDir,
        gateway: Identity,
        desk: Identity,
    }

    impl Cast {
        fn new() -> Self {
            let rng = &mut ChaCha20Rng::seed_from_u64(8);
            let mut fleet = Fleet::create("lab".parse().unwrap(), NOW, rng).unwrap();
            let gateway = fleet.enroll(&EnrollRequest::new("arm-1".parse().unwrap(), NOW), rng).unwrap();
            let desk = EnrollRequest {
                groups: vec!["operators".parse().unwrap()],
                ..EnrollRequest::new("desk".parse().unwrap(), NOW)
            };
            Self { dir: tempfile::tempdir().unwrap(), gateway, desk: fleet.enroll(&desk, rng).unwrap() }
        }

        /// Returns the access rules under a configuration with this `[gateway]`.
        fn access(&self, gateway: &str) -> Result<Option<Access>, AccessError> {
            let text = format!("identity = 'x'\nnode.routers = ['quic://r']\n{gateway}");
            let config = sgc_config::parse(&text, "node.toml", Path::new(""), &|_| None).unwrap();
            let now = Now { instant: std::time::Instant::now(), unix: NOW };
            access_of(&config, &self.gateway, Some(self.dir.path()), now)
        }

        /// Returns the rights of the desk's certificate from another host.
        fn desk_may(&self, gateway: &str) -> Result<String, Denial> {
            let access = self.access(gateway).unwrap().unwrap();
            let admission = AdmissionRequest { certificate: Some(self.desk.as_peer()), ..elsewhere() };
            access.admit(&admission).map(|client| format!("{}: {}", client.name, client.scope))
        }
    }

    fn elsewhere() -> AdmissionRequest<'static> {
        let peer = "10.0.0.9:1".parse().unwrap();
        AdmissionRequest { peer, encrypted: true, origin: None, token: None, certificate: None, now: NOW }
    }

    #[test]
    fn names_of_the_configuration_stand_for_certificates() {
        let cast = Cast::new();
        let client = |who: &str| format!("[[gateway.client]]\nwho = ['{who}']\nsubscribe = ['/odom']\n");
        assert_eq!(cast.desk_may(&client("desk")).unwrap(), "desk: subscribe /odom");
        for who in ["group:operators", "*"] {
            assert!(cast.desk_may(&client(who)).unwrap().ends_with(": subscribe /odom"), "{who}");
        }
        for who in ["desk-2", "group:arms"] {
            assert_eq!(cast.desk_may(&client(who)), Err(Denial::NotListed { node: cast.desk.node_id() }));
        }
        assert!(cast.access("").unwrap().is_none());
    }

    #[test]
    fn a_token_that_was_revoked_on_the_disk_holds_no_more() {
        let cast = Cast::new();
        let grant = AccessGrant {
            id: TokenId([7; 16]),
            gateway: cast.gateway.node_id(),
            label: "dashboard".into(),
            scope: Scope { call: vec!["/plan".into()], ..Scope::default() },
            issued: NOW,
            expires: UnixMillis(NOW.0 + 1000),
        };
        let text = grant.clone().sign(&cast.gateway).unwrap().to_text();
        let admit = || {
            let access = cast.access("[gateway]").unwrap().unwrap();
            access
                .admit(&AdmissionRequest { token: Some(&text), ..elsewhere() })
                .map(|client| client.name.to_string())
        };
        AccessRecords::change(cast.dir.path(), |records| records.add((&grant).into(), NOW)).unwrap();
        assert_eq!(AccessRecords::load(cast.dir.path()).unwrap().tokens[0].scope(), grant.scope);
        assert_eq!(admit().as_deref(), Ok("dashboard"));
        AccessRecords::change(cast.dir.path(), |records| records.revoke("0707", NOW)).unwrap();
        assert_eq!(admit(), Err(Denial::TokenRevoked { id: grant.id }));
        std::fs::write(cast.dir.path().join(RECORDS_FILE), "?").unwrap();
        assert!(cast.access("[gateway]").is_err(), "what was revoked is not known, so nobody is admitted");
    }

    #[test]
    fn a_token_that_is_refused_stands_in_the_audit_log_without_itself() {
        let cast = Cast::new();
        let log = cast.dir.path().join("audit.jsonl");
        let (audit, writer) =
            Audit::open(&log, sgc_config::AuditConfig::default().room, Default::default()).unwrap();
        let access = cast.access("[gateway]").unwrap().unwrap().with_refusal_listener(refused_tokens(audit));
        let text = "sgc-access-1:AAAA";
        assert!(access.admit(&AdmissionRequest { token: Some(text), ..elsewhere() }).is_err());
        drop(access);
        writer.finish();
        let mut records = Vec::new();
        crate::state::audit::read(&log, |record| records.push(record)).unwrap();
        let [record] = &records[..] else { panic!("{records:?}") };
        assert_eq!((&*record.event, record.remote.as_deref()), ("token_refused", Some("10.0.0.9:1")));
        let why = record.reason.as_ref().unwrap();
        assert!(why.starts_with("a token was shown that does not hold: ") && !why.contains(text), "{why}");
    }

    #[test]
    fn revoked_token_stays_listed_until_it_expires() {
        let dir = tempfile::tempdir().unwrap();
        let later = UnixMillis(NOW.0 + 1000);
        let change = |change: &mut dyn FnMut(&mut AccessRecords) -> Result<(), AccessError>| {
            AccessRecords::change(dir.path(), |records| change(records)).unwrap();
            AccessRecords::load(dir.path()).unwrap()
        };
        change(&mut |records| records.add(record("aaaa1", later.0), NOW));
        change(&mut |records| records.add(record("bbbb", later.0 + 1000), NOW));
        let records = change(&mut |records| records.revoke("aaaa1", NOW).map(drop));
        assert_eq!(records.revoked().unwrap().count(), 1);
        assert_eq!(records.tokens.len(), 2);
        let records =
            change(&mut |records| records.add(record("cccc", later.0 + 2000), UnixMillis(later.0 + 1)));
        let ids: Vec<_> = records.tokens.iter().map(|token| &token.id[..4]).collect();
        assert_eq!((ids, records.revoked().unwrap().count()), (vec!["bbbb", "cccc"], 0));
    }

    #[test]
    fn a_token_is_found_by_its_first_digits_and_no_other_is_hit() {
        let mut records = AccessRecords::default();
        for id in ["aaaa1", "aaaa2", "bbbb"] {
            records.add(record(id, NOW.0 + 1), NOW).unwrap();
        }
        assert!(matches!(records.revoke("aaaa", NOW), Err(AccessError::Ambiguous { .. })));
        for digits in ["", "bbb", "dddd", "bbbbb", "zzzz", "BBBB"] {
            assert!(matches!(records.revoke(digits, NOW), Err(AccessError::NoSuchToken { .. })), "{digits}");
        }
        assert_eq!(records.revoked().unwrap().count(), 0);
        assert_eq!(records.revoke("bbbb", NOW).unwrap().revoked, Some(NOW.0));
        assert_eq!(records.revoke("bbbb", UnixMillis(NOW.0 + 1)).unwrap().revoked, Some(NOW.0));
        // The list was lost and does not have this token.
        let whole = "e".repeat(32);
        records.revoke(&whole, NOW).unwrap();
        assert!(records.revoked().unwrap().any(|id| id.to_string() == whole));
    }

    #[test]
    fn tokens_have_a_bound_and_broken_records_are_no_empty_list() {
        let mut records = AccessRecords::default();
        for _ in 0..ACCESS_TOKENS_MAX {
            records.add(record("aaaa", NOW.0 + 1), NOW).unwrap();
        }
        assert!(matches!(records.add(record("b", NOW.0), NOW), Err(AccessError::TooManyTokens)));
        let dir = tempfile::tempdir().unwrap();
        for text in ["", "{}", r#"{"version":2,"tokens":[]}"#] {
            std::fs::write(dir.path().join(RECORDS_FILE), text).unwrap();
            assert!(matches!(AccessRecords::load(dir.path()), Err(AccessError::Records { .. })), "{text}");
        }
        let mut broken = AccessRecords::default();
        broken.tokens.push(AccessRecord { id: "x".into(), revoked: Some(1), ..record("a", NOW.0) });
        assert!(matches!(broken.revoked().map(drop), Err(AccessError::Record { .. })));
    }
}
