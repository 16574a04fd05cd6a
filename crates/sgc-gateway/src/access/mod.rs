//! Who may connect to a gateway, and what they may do there.
//!
//! A front end says what it knows of a connection ([`Admission`]) and is given a [`Client`] with its [`Scope`], or why not
//! ([`Denied`]). This module reads no file, no clock and no socket: the node makes an [`Access`] of its configuration, anew
//! at each reload, and hands it on. Certificates were verified before; tokens are verified here.

mod attempts;
mod origin;
mod scope;
mod token;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::net::{IpAddr, SocketAddr};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use sgc_trust::{AddressPrefix, Grantees, TrustAnchors, VerifiedPeer};
use sgc_wire::{NodeId, UnixMillis};

pub use origin::{ORIGIN_BYTES_MAX, PageOrigin, PageOriginError};
pub use scope::{Right, SCOPE_BYTES_MAX, SCOPE_PATTERNS_MAX, Scope, ScopeError};
pub use token::{
    ACCESS_LABEL_BYTES_MAX, ACCESS_TOKEN_PREFIX, ACCESS_TOKEN_TEXT_BYTES_MAX, ACCESS_VALID_MS_MAX,
    AccessGrant, AccessToken, AccessTokenError, TokenId, TokenIdError, check_access_label,
};

use attempts::Attempts;

/// Who is admitted without a token or a certificate, and then to everything.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Anonymous {
    /// Programs of this host.
    #[default]
    Local,
    /// Nobody.
    None,
    /// Whoever reaches the gateway.
    All,
}

/// What nodes may do whose certificates prove who they are.
#[derive(Clone, Debug, Default)]
pub struct ClientRule {
    /// Who.
    pub who: Grantees,
    /// What.
    pub scope: Scope,
}

/// What a gateway's configuration comes to. By default programs of this host may do everything, and nobody else anything.
#[derive(Clone, Debug, Default)]
pub struct AccessRules {
    /// Who is admitted without proof.
    pub anonymous: Anonymous,
    /// Whose pages may connect by what a browser does unasked: without a token, or with a certificate.
    pub origins: Vec<PageOrigin>,
    /// Whether tokens are taken that others on the way could have read.
    pub plain: bool,
    /// What certificates permit; of all rules that name a node it has the rights.
    pub clients: Vec<ClientRule>,
    /// This node, which signs tokens; without it none holds.
    pub gateway: Option<VerifiedPeer>,
    /// The CAs that certificates are verified with, and what they have revoked.
    pub anchors: Option<TrustAnchors>,
    /// Tokens that were taken back.
    pub revoked: BTreeSet<TokenId>,
    /// What nodes are called, as far as that is known.
    pub names: BTreeMap<NodeId, String>,
}

/// Hears of refused tokens: the address, and the reason. It hears of at most ten a minute for one address.
pub type HearRefusals = Arc<dyn Fn(SocketAddr, &Denied) + Send + Sync>;

/// Who may connect, and what they may do. Cloning shares.
#[derive(Clone, Default)]
pub struct Access {
    rules: Arc<AccessRules>,
    attempts: Arc<Mutex<Attempts>>,
    hears: Option<HearRefusals>,
    denied: Arc<AtomicU64>,
}

impl fmt::Debug for Access {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Access").field("rules", &self.rules).finish_non_exhaustive()
    }
}

/// What a front end knows of a connection.
#[derive(Clone, Copy, Debug)]
pub struct Admission<'a> {
    /// Who is at the other end.
    pub peer: SocketAddr,
    /// Whether nobody on the way could read what it says.
    pub encrypted: bool,
    /// Its `Origin`, if it sent that header: then it is a page in a browser.
    pub origin: Option<&'a str>,
    /// The token that it showed.
    pub token: Option<&'a str>,
    /// What its certificate proves.
    pub certificate: Option<&'a VerifiedPeer>,
    /// The time.
    pub now: UnixMillis,
}

/// Who is connected, and what it may do. Cloning shares.
#[derive(Clone, Debug)]
pub struct Client {
    /// What to call it: the label of its token, the name of its node, or its address.
    pub name: Arc<str>,
    /// What it may do.
    pub scope: Arc<Scope>,
    /// Last moment at which that holds; then it is to be disconnected.
    pub expires: Option<UnixMillis>,
    /// Its token.
    pub token: Option<TokenId>,
    /// Because of what it is admitted.
    pub how: AdmittedBy,
    evidence: Evidence,
    /// `true` if the connection comes from a loopback address.
    is_local: bool,
}

/// The proof by which sessions were admitted. Sessions with the same one share a quota.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Credential {
    /// Programs of this host without a token.
    Local,
    /// Programs of another host without a token.
    Address(AddressPrefix),
    /// Whoever shows this token.
    Token(TokenId),
    /// Whoever shows a certificate of this node.
    Certificate(NodeId),
}

/// Because of what a client is admitted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AdmittedBy {
    /// It is of this host, or everybody is admitted.
    Anonymous,
    /// The certificate of this node.
    Certificate(NodeId),
    /// A token.
    Token(TokenId),
}

/// What is judged again when the rules have changed.
#[derive(Clone)]
enum Evidence {
    /// It came over no connection.
    Own,
    Anonymous {
        ip: IpAddr,
        origin: Option<Arc<str>>,
    },
    Certificate {
        peer: VerifiedPeer,
        ip: IpAddr,
        origin: Option<Arc<str>>,
    },
    Token {
        id: TokenId,
        is_exposed: bool,
    },
}

impl Client {
    /// A part of this program, which may do everything.
    pub fn own(name: &str) -> Self {
        Self {
            name: name.into(),
            scope: Arc::new(Scope::everything()),
            expires: None,
            token: None,
            how: AdmittedBy::Anonymous,
            evidence: Evidence::Own,
            is_local: true,
        }
    }

    /// Returns the proof by which it was admitted; none for a part of this program.
    pub(crate) fn credential(&self) -> Option<Credential> {
        Some(match &self.evidence {
            Evidence::Own => return None,
            Evidence::Anonymous { ip, .. } if ip.is_loopback() => Credential::Local,
            Evidence::Anonymous { ip, .. } => Credential::Address((*ip).into()),
            Evidence::Certificate { peer, .. } => Credential::Certificate(peer.node_id),
            Evidence::Token { id, .. } => Credential::Token(*id),
        })
    }

    /// `true` if the connection comes from a loopback address.
    pub(crate) fn is_local(&self) -> bool {
        self.is_local
    }

    /// Whether it holds this right to the interface of this full name.
    pub fn may(&self, right: Right, name: &str) -> bool {
        self.scope.permits(right, name)
    }

    /// The same with another scope, for tests of what asks for rights.
    #[must_use]
    pub fn with_scope(mut self, scope: Scope) -> Self {
        self.scope = Arc::new(scope);
        self
    }
}

impl fmt::Debug for Evidence {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Own => "Own",
            Self::Anonymous { .. } => "Anonymous",
            Self::Certificate { .. } => "Certificate",
            Self::Token { .. } => "Token",
        })
    }
}

impl Access {
    /// Access by these rules.
    pub fn new(rules: AccessRules) -> Self {
        Self { rules: Arc::new(rules), attempts: Arc::default(), hears: None, denied: Arc::default() }
    }

    /// The same with what is remembered of failed attempts before the rules changed, with who hears of them and how many were
    /// refused.
    #[must_use]
    pub fn after(mut self, before: &Self) -> Self {
        self.attempts = Arc::clone(&before.attempts);
        self.hears.clone_from(&before.hears);
        self.denied = Arc::clone(&before.denied);
        self
    }

    /// The same, and `hears` is told of tokens that are refused. It must not wait.
    #[must_use]
    pub fn heard_by(mut self, hears: HearRefusals) -> Self {
        self.hears = Some(hears);
        self
    }

    /// The same with other CAs or newer revocation lists.
    #[must_use]
    pub fn with_anchors(mut self, anchors: TrustAnchors) -> Self {
        Arc::make_mut(&mut self.rules).anchors = Some(anchors);
        self
    }

    /// Returns the same rules with another certificate of this node.
    #[must_use]
    pub fn with_gateway(mut self, gateway: VerifiedPeer) -> Self {
        Arc::make_mut(&mut self.rules).gateway = Some(gateway);
        self
    }

    /// The rules.
    pub fn rules(&self) -> &AccessRules {
        &self.rules
    }

    /// Whether any certificate permits anything, so that front ends over TLS have to ask for one.
    pub fn takes_certificates(&self) -> bool {
        !self.rules.clients.is_empty()
    }

    /// How often somebody was not admitted.
    pub fn denied(&self) -> u64 {
        self.denied.load(Ordering::Relaxed)
    }

    /// Who this is, and what it may do. A token decides if there is one: what it does not permit, a certificate beside it
    /// does not either.
    pub fn admit(&self, admission: &Admission<'_>) -> Result<Client, Denied> {
        self.judge(admission).inspect_err(|_| {
            self.denied.fetch_add(1, Ordering::Relaxed);
        })
    }

    fn judge(&self, admission: &Admission<'_>) -> Result<Client, Denied> {
        if let Some(token) = admission.token {
            // Whoever goes on trying has been heard often enough: the log is for others, too.
            let is_heard = self.attempts().check(admission.peer.ip(), admission.now).is_ok();
            return self.admit_token(token, admission).inspect_err(|denied| {
                if let Some(hears) = self.hears.as_ref().filter(|_| is_heard) {
                    hears(admission.peer, denied);
                }
            });
        }
        let origin = admission.origin.map(Arc::from);
        if let Some(peer) = admission.certificate {
            let ip = admission.peer.ip().to_canonical();
            let evidence = Evidence::Certificate { peer: peer.clone(), ip, origin: origin.clone() };
            match self.judge_certificate(peer, ip, admission.origin, admission.now) {
                Ok(scope) => {
                    let name = self.rules.names.get(&peer.node_id).cloned();
                    let name = name.unwrap_or_else(|| format!("node {}", peer.node_id.short()));
                    return Ok(Client {
                        name: name.into(),
                        scope: Arc::new(scope),
                        expires: Some(peer.not_after),
                        token: None,
                        how: AdmittedBy::Certificate(peer.node_id),
                        evidence,
                        is_local: ip.is_loopback(),
                    });
                }
                // One that permits nothing is like none: without it the same program may be admitted.
                Err(why @ Denied::NotListed { .. }) => {
                    return self.admit_anonymous(admission, origin).map_err(|_| why);
                }
                Err(why) => return Err(why),
            }
        }
        self.admit_anonymous(admission, origin)
    }

    /// Whether a client that was admitted, maybe under other rules, is so still. If not, it is to be disconnected.
    pub fn still_admits(&self, client: &Client, now: UnixMillis) -> Result<(), Denied> {
        match &client.evidence {
            Evidence::Own => Ok(()),
            Evidence::Anonymous { ip, origin } => self.judge_anonymous(*ip, origin.as_deref()),
            Evidence::Certificate { peer, ip, origin } => {
                let scope = self.judge_certificate(peer, *ip, origin.as_deref(), now)?;
                if scope == *client.scope { Ok(()) } else { Err(Denied::Changed) }
            }
            Evidence::Token { id, is_exposed } => {
                if *is_exposed && !self.rules.plain {
                    return Err(Denied::PlainToken);
                }
                self.judge_time(*id, client.expires.unwrap_or(UnixMillis(0)), now)
            }
        }
    }

    fn admit_token(&self, text: &str, admission: &Admission<'_>) -> Result<Client, Denied> {
        let ip = admission.peer.ip().to_canonical();
        let is_exposed = !admission.encrypted && !ip.is_loopback();
        // This host is not locked out: behind a proxy of it are many.
        if !ip.is_loopback() {
            let checked = self.attempts().check(ip, admission.now);
            checked.map_err(|wait| Denied::TooManyAttempts { ip, wait })?;
        }
        if is_exposed && !self.rules.plain {
            self.attempts().fail(ip, admission.now);
            return Err(Denied::PlainToken);
        }
        let result = AccessToken::parse(text).map_err(Denied::Token).and_then(|token| {
            let gateway = self.rules.gateway.as_ref().ok_or(Denied::NoTokens)?;
            let grant = token.verify(gateway).map_err(Denied::Token)?;
            self.judge_time(grant.id, grant.expires, admission.now)?;
            Ok(grant.clone())
        });
        let grant = result.inspect_err(|_| self.attempts().fail(ip, admission.now))?;
        Ok(Client {
            name: grant.label.into(),
            scope: Arc::new(grant.scope),
            expires: Some(grant.expires),
            token: Some(grant.id),
            how: AdmittedBy::Token(grant.id),
            evidence: Evidence::Token { id: grant.id, is_exposed },
            is_local: ip.is_loopback(),
        })
    }

    fn judge_time(&self, id: TokenId, expires: UnixMillis, now: UnixMillis) -> Result<(), Denied> {
        if now > expires {
            return Err(Denied::TokenExpired { id, expires });
        }
        if self.rules.revoked.contains(&id) { Err(Denied::TokenRevoked { id }) } else { Ok(()) }
    }

    /// What a certificate permits.
    fn judge_certificate(
        &self,
        peer: &VerifiedPeer,
        ip: IpAddr,
        origin: Option<&str>,
        now: UnixMillis,
    ) -> Result<Scope, Denied> {
        let node = peer.node_id;
        if now > peer.not_after {
            return Err(Denied::CertificateExpired { node, expires: peer.not_after });
        }
        if self.rules.anchors.as_ref().is_some_and(|anchors| !anchors.stands(peer)) {
            return Err(Denied::CertificateRevoked { node });
        }
        let mut scope = Scope::default();
        let rules = self.rules.clients.iter().filter(|rule| rule.who.find(peer).is_some());
        rules.for_each(|rule| scope.add(&rule.scope));
        if scope.is_empty() {
            return Err(Denied::NotListed { node });
        }
        // A browser shows a certificate to whatever page asks it to connect.
        self.judge_origin(origin, ip)?;
        Ok(scope)
    }

    fn admit_anonymous(&self, admission: &Admission<'_>, origin: Option<Arc<str>>) -> Result<Client, Denied> {
        let ip = admission.peer.ip().to_canonical();
        self.judge_anonymous(ip, admission.origin)?;
        Ok(Client {
            name: ip.to_string().into(),
            scope: Arc::new(Scope::everything()),
            expires: None,
            token: None,
            how: AdmittedBy::Anonymous,
            evidence: Evidence::Anonymous { ip, origin },
            is_local: ip.is_loopback(),
        })
    }

    fn judge_anonymous(&self, ip: IpAddr, origin: Option<&str>) -> Result<(), Denied> {
        match self.rules.anonymous {
            Anonymous::Local if ip.is_loopback() => self.judge_origin(origin, ip),
            Anonymous::All => self.judge_origin(origin, ip),
            Anonymous::Local | Anonymous::None => Err(Denied::NoCredentials { ip }),
        }
    }

    /// Decides if a page of there may connect without a token; a program, which has no origin, may. In the browser of another
    /// host, `http://localhost` is a page of that host.
    fn judge_origin(&self, origin: Option<&str>, ip: IpAddr) -> Result<(), Denied> {
        let Some(text) = origin else { return Ok(()) };
        let parsed = text.parse::<PageOrigin>();
        match &parsed {
            Ok(origin) if ip.is_loopback() && origin.is_loopback() => Ok(()),
            Ok(origin) if self.rules.origins.contains(origin) => Ok(()),
            _ => Err(Denied::Origin { origin: text.chars().take(ORIGIN_BYTES_MAX).collect() }),
        }
    }

    fn attempts(&self) -> std::sync::MutexGuard<'_, Attempts> {
        self.attempts.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Why somebody is not admitted: for the log of the gateway. [`Denied::told`] is what the other end hears.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Denied {
    /// Neither a token nor a certificate, and none is needed from elsewhere only.
    #[error(
        "a program at {ip} showed neither a token nor a certificate: make a token with `sgc token create`, name its \
         node in a [[gateway.client]], or see `anonymous` in [gateway]"
    )]
    NoCredentials {
        /// Where it is.
        ip: IpAddr,
    },
    /// A page that is not of this host.
    #[error(
        "a page of {origin:?} wants to connect through somebody's browser: if that is meant, list it in `origins` of \
         [gateway], or give the page a token"
    )]
    Origin {
        /// Where the page is from.
        origin: String,
    },
    /// A token that others could have read.
    #[error(
        "a token was shown over a connection that is not encrypted, where others may have read it: revoke it, make a new \
         one, and connect with wss:// or grpcs:// (or see `plain` in [gateway])"
    )]
    PlainToken,
    /// A token that is none of this gateway.
    #[error("a token was shown that does not hold: {0}")]
    Token(#[source] AccessTokenError),
    /// No token holds here.
    #[error("a token was shown, but this gateway has no identity to verify it with")]
    NoTokens,
    /// It is over.
    #[error("token {id} ended at {expires}: make a new one with `sgc token create`")]
    TokenExpired {
        /// Which.
        id: TokenId,
        /// When.
        expires: UnixMillis,
    },
    /// It was taken back.
    #[error("token {id} was revoked: if its holder may come back, make a new one with `sgc token create`")]
    TokenRevoked {
        /// Which.
        id: TokenId,
    },
    /// Too many tokens that do not hold.
    #[error(
        "{ip} showed too many tokens that do not hold and is not listened to for {} s: see the reasons before this one",
        wait.as_secs() + 1
    )]
    TooManyAttempts {
        /// From where.
        ip: IpAddr,
        /// How long it has to wait.
        wait: Duration,
    },
    /// A certificate that permits nothing.
    #[error(
        "no [[gateway.client]] names node {node}, a group of it or its fleet: add it to the `who` of one, or make a token \
         with `sgc token create`"
    )]
    NotListed {
        /// Whose.
        node: NodeId,
    },
    /// It is over.
    #[error("the certificate of node {node} ended at {expires}: renew it (docs/how-to/fleet.md)")]
    CertificateExpired {
        /// Whose.
        node: NodeId,
        /// When.
        expires: UnixMillis,
    },
    /// Its CA took it back.
    #[error(
        "the certificate of node {node} was revoked: if that is a mistake, the keeper of the fleet enrolls it again"
    )]
    CertificateRevoked {
        /// Whose.
        node: NodeId,
    },
    /// It may do something else now.
    #[error("what the certificate permits has changed: it gets that when it connects again")]
    Changed,
}

impl Denied {
    /// What the other end is told: what its user can do, and of a token that does not hold not why.
    pub fn told(&self) -> &'static str {
        match self {
            Self::NoCredentials { .. } | Self::NotListed { .. } => {
                "not admitted: this gateway wants a token (`sgc token create` there makes one) or a certificate of its fleet"
            }
            Self::Origin { .. } => "not admitted: pages of this origin may not connect without a token",
            Self::PlainToken => {
                "not admitted: tokens are not taken over connections that are not encrypted; use wss:// or grpcs://, and \
                 have a new token made"
            }
            Self::Token(_) | Self::NoTokens => "not admitted: the token does not hold here",
            Self::TokenExpired { .. } => "not admitted: the token has ended",
            Self::TokenRevoked { .. } => "not admitted: the token was revoked",
            Self::TooManyAttempts { .. } => "not admitted: too many attempts; wait a minute",
            Self::CertificateExpired { .. } => "not admitted: the certificate has ended",
            Self::CertificateRevoked { .. } => "not admitted: the certificate was revoked",
            Self::Changed => "the rights of this client have changed: connect again",
        }
    }
}

#[cfg(test)]
mod tests;
