//! Who may connect to this node's gateway: from what the user wrote, and the tokens that were made and revoked, to an
//! [`Access`].
//!
//! It decides nothing: the gateway does, when somebody connects. What was made is kept in the state directory, so that it can
//! be shown and taken back; a token holds without that, since the node signed it.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use sgc_gateway::{
    ACCESS_VALID_MS_MAX, Access, AccessGrant, AccessRules, ClientRule, HearRefusals, Right, Scope, TokenId,
};
use sgc_trust::{AnchorError, Identity};
use sgc_wire::{Now, UnixMillis};

use crate::audit::{Audit, AuditEvent, AuditRecord};
use crate::config::{Config, Recipient};
use crate::credentials::with_kept_crls;
use crate::partners::{PartnerError, Partners};
use crate::policy;
use crate::records::{self, Records};

/// Most tokens of one node that have not ended, revoked ones among them.
pub const ACCESS_TOKENS_MAX: usize = 1024;
/// Largest file of tokens made, bytes: that many with the largest scopes fit.
const RECORDS_BYTES_MAX: u64 = 16 * 1024 * 1024;
const RECORDS_FILE: &str = "access.json";
const RECORDS_VERSION: u32 = 1;
/// Fewest digits that stand for a token.
const PREFIX_DIGITS_MIN: usize = 4;

/// Who may connect to the gateway of `config`, and what they may do; `None` if it has none. The CAs are those that the
/// configuration names, with the revocation lists kept in the state directory: a running node that knows newer ones hands them
/// on with [`Access::with_anchors`].
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

/// The same for partners that were read already.
pub fn access_with(
    config: &Config,
    identity: &Identity,
    partners: &Partners,
    state: Option<&Path>,
    now: Now,
) -> Result<Option<Access>, AccessError> {
    let Some(gateway) = &config.gateway else { return Ok(None) };
    let records = state.map(AccessRecords::load).transpose()?.unwrap_or_default();
    let rule = |client: &crate::config::GatewayClientConfig| ClientRule {
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

/// Writes down each access token that is refused.
pub(crate) fn refused_tokens(audit: Audit) -> HearRefusals {
    Arc::new(move |peer, denied| {
        let record = AuditRecord::new(AuditEvent::TokenRefused);
        audit.write(record.remote(peer).reason(denied));
    })
}

/// The access tokens that a node made, `access.json` in its state directory. No token is in it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct AccessRecords {
    version: u32,
    /// Those that have not ended, in the order in which they were made; ended ones leave when another is added.
    pub tokens: Vec<AccessRecord>,
}

impl Default for AccessRecords {
    fn default() -> Self {
        Self { version: RECORDS_VERSION, tokens: Vec::new() }
    }
}

/// One token. The token itself is not kept.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct AccessRecord {
    /// Which, in hexadecimal digits.
    pub id: String,
    /// For whom.
    pub label: String,
    /// Topics that its holder may receive.
    pub subscribe: Vec<String>,
    /// Topics that its holder may publish on.
    pub publish: Vec<String>,
    /// What its holder may call.
    pub call: Vec<String>,
    /// What its holder may serve.
    pub serve: Vec<String>,
    /// When it was made, milliseconds since 1970.
    pub created: u64,
    /// Last moment at which it holds, milliseconds since 1970.
    pub expires: u64,
    /// When it was taken back, milliseconds since 1970.
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
    /// What its holder may do.
    pub fn scope(&self) -> Scope {
        let Self { subscribe, publish, call, serve, .. } = self.clone();
        Scope { subscribe, publish, call, serve }
    }

    /// One that is not in the list: made before the state directory was lost, for example. It is kept for as long as any token
    /// can hold.
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
    /// Reads them; none if there is no file. One that cannot be read is an error: it may hold what was revoked.
    pub fn load(state: &Path) -> Result<Self, AccessError> {
        records::load(state)
    }

    /// Changes them on the disk, as nobody else does at the same time.
    pub fn change<T>(
        state: &Path,
        change: impl FnOnce(&mut Self) -> Result<T, AccessError>,
    ) -> Result<T, AccessError> {
        records::change(state, change)
    }

    /// Adds one; those that ended before `now` leave.
    pub fn add(&mut self, record: AccessRecord, now: UnixMillis) -> Result<(), AccessError> {
        self.make_room(now)?;
        self.tokens.push(record);
        Ok(())
    }

    /// Takes one back: by its id, or by the first digits of that if no other begins so. One that is not in the list needs the
    /// whole id.
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

    /// Those that were taken back.
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

/// Why it cannot be said who may connect.
#[derive(Debug, thiserror::Error)]
pub enum AccessError {
    /// Partners.
    #[error(transparent)]
    Partner(#[from] PartnerError),
    /// The CAs of partners.
    #[error("the CAs that are trusted: {0}")]
    Anchors(#[from] AnchorError),
    /// The file of tokens made.
    #[error("access tokens made, {}: {source}", path.display())]
    Records {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: io::Error,
    },
    /// One token of it.
    #[error(
        "{RECORDS_FILE} in the state directory has a token {id:?}, which is no id: it was changed by hand; correct it"
    )]
    Record {
        /// What stands there.
        id: String,
    },
    /// Too many tokens.
    #[error(
        "{ACCESS_TOKENS_MAX} access tokens have not ended, which is the limit: make them for a shorter time, or name nodes \
         in a [[gateway.client]]"
    )]
    TooManyTokens,
    /// No token has that id.
    #[error(
        "no access token begins with {digits:?}: `sgc token list` shows them; {PREFIX_DIGITS_MIN} digits at least, or all 32 \
         of one that is not listed"
    )]
    NoSuchToken {
        /// What was asked for.
        digits: String,
    },
    /// Several have.
    #[error("several access tokens begin with {digits:?}: add digits; `sgc token list` shows them")]
    Ambiguous {
        /// What was asked for.
        digits: String,
    },
}

#[cfg(test)]
mod tests {
    use rand_chacha::ChaCha20Rng;
    use rand_chacha::rand_core::SeedableRng as _;
    use sgc_gateway::{Admission, Denied};
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

        /// Access under a configuration with this `[gateway]`.
        fn access(&self, gateway: &str) -> Result<Option<Access>, AccessError> {
            let text = format!("identity = 'x'\nnode.routers = ['quic://r']\n{gateway}");
            let config = crate::config::parse(&text, "node.toml", Path::new(""), &|_| None).unwrap();
            let now = Now { instant: std::time::Instant::now(), unix: NOW };
            access_of(&config, &self.gateway, Some(self.dir.path()), now)
        }

        /// What the desk may do, from another host, by its certificate.
        fn desk_may(&self, gateway: &str) -> Result<String, Denied> {
            let access = self.access(gateway).unwrap().unwrap();
            let admission = Admission { certificate: Some(self.desk.as_peer()), ..elsewhere() };
            access.admit(&admission).map(|client| format!("{}: {}", client.name, client.scope))
        }
    }

    fn elsewhere() -> Admission<'static> {
        let peer = "10.0.0.9:1".parse().unwrap();
        Admission { peer, encrypted: true, origin: None, token: None, certificate: None, now: NOW }
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
            assert_eq!(cast.desk_may(&client(who)), Err(Denied::NotListed { node: cast.desk.node_id() }));
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
                .admit(&Admission { token: Some(&text), ..elsewhere() })
                .map(|client| client.name.to_string())
        };
        AccessRecords::change(cast.dir.path(), |records| records.add((&grant).into(), NOW)).unwrap();
        assert_eq!(AccessRecords::load(cast.dir.path()).unwrap().tokens[0].scope(), grant.scope);
        assert_eq!(admit().as_deref(), Ok("dashboard"));
        AccessRecords::change(cast.dir.path(), |records| records.revoke("0707", NOW)).unwrap();
        assert_eq!(admit(), Err(Denied::TokenRevoked { id: grant.id }));
        std::fs::write(cast.dir.path().join(RECORDS_FILE), "?").unwrap();
        assert!(cast.access("[gateway]").is_err(), "what was revoked is not known, so nobody is admitted");
    }

    #[test]
    fn a_token_that_is_refused_stands_in_the_audit_log_without_itself() {
        let cast = Cast::new();
        let log = cast.dir.path().join("audit.jsonl");
        let (audit, writer) =
            Audit::open(&log, crate::config::AuditConfig::default().room, Default::default()).unwrap();
        let access = cast.access("[gateway]").unwrap().unwrap().heard_by(refused_tokens(audit));
        let text = "sgc-access-1:AAAA";
        assert!(access.admit(&Admission { token: Some(text), ..elsewhere() }).is_err());
        drop(access);
        writer.finish();
        let mut records = Vec::new();
        crate::audit::read(&log, |record| records.push(record)).unwrap();
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
        // One that this list does not know, after it was lost.
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
