//! Access control of a gateway: decides which clients may connect and which rights they get.
//!
//! A front end describes a connection in an [`AdmissionRequest`]. It gets a [`Client`] with a [`Scope`], or a
//! [`Denial`] with the reason. This module reads no file, clock or socket: the node builds an [`Access`] from its
//! configuration at each reload. Certificates are verified before they come here; tokens are verified here.

mod attempts;
mod origin;
mod scope;
mod token;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::net::{IpAddr, SocketAddr};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use sgc_sync::lock;
use sgc_trust::{AddressPrefix, Grantees, TrustAnchors, VerifiedPeer};
use sgc_wire::{NodeId, UnixMillis};

pub use origin::{ORIGIN_BYTES_MAX, PageOrigin, PageOriginError};
pub use scope::{Right, SCOPE_BYTES_MAX, SCOPE_PATTERNS_MAX, Scope, ScopeError};
pub use token::{
    ACCESS_LABEL_BYTES_MAX, ACCESS_TOKEN_PREFIX, ACCESS_TOKEN_TEXT_BYTES_MAX, ACCESS_VALID_MS_MAX,
    AccessGrant, AccessToken, AccessTokenError, TokenId, TokenIdError, check_access_label,
};

use attempts::Attempts;

/// Clients that are admitted without a token or certificate. They may do everything.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Anonymous {
    /// Programs on this host.
    #[default]
    Local,
    /// No client.
    None,
    /// Every client that reaches the gateway.
    All,
}

/// The scope of nodes that show a certificate.
#[derive(Clone, Debug, Default)]
pub struct ClientRule {
    /// Nodes to which the rule applies.
    pub who: Grantees,
    /// Rights of these nodes.
    pub scope: Scope,
}

/// The access rules from a gateway's configuration. By default programs on this host may do everything and other
/// clients nothing.
#[derive(Clone, Debug, Default)]
pub struct AccessRules {
    /// Clients that are admitted without proof.
    pub anonymous: Anonymous,
    /// Origins of pages that may connect without a token, or with the certificate of the browser.
    pub origins: Vec<PageOrigin>,
    /// `true` if tokens are accepted over connections that are not encrypted.
    pub plain: bool,
    /// Rules for certificates. A node gets the rights of all rules that name it.
    pub clients: Vec<ClientRule>,
    /// The certificate of this node, which signs tokens. Without it no token is valid.
    pub gateway: Option<VerifiedPeer>,
    /// The CAs that certificates are verified against, with their revocation lists.
    pub anchors: Option<TrustAnchors>,
    /// Revoked tokens.
    pub revoked: BTreeSet<TokenId>,
    /// Known names of nodes.
    pub names: BTreeMap<NodeId, String>,
}

/// A callback for refused tokens, with address and reason. It is called at most ten times a minute for one address.
pub type RefusalListener = Arc<dyn Fn(SocketAddr, &Denial) + Send + Sync>;

/// The access rules and their state. Clones share the state.
#[derive(Clone, Default)]
pub struct Access {
    rules: Arc<AccessRules>,
    attempts: Arc<Mutex<Attempts>>,
    listener: Option<RefusalListener>,
    denied: Arc<AtomicU64>,
}

impl fmt::Debug for Access {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Access").field("rules", &self.rules).finish_non_exhaustive()
    }
}

/// The properties of a connection that decide its admission.
#[derive(Clone, Copy, Debug)]
pub struct AdmissionRequest<'a> {
    /// The address of the client.
    pub peer: SocketAddr,
    /// `true` if the connection is encrypted.
    pub encrypted: bool,
    /// The `Origin` header. Only pages in browsers send one.
    pub origin: Option<&'a str>,
    /// The token that the client showed.
    pub token: Option<&'a str>,
    /// The identity that the client's certificate proves.
    pub certificate: Option<&'a VerifiedPeer>,
    /// The current time.
    pub now: UnixMillis,
}

/// A connected client and its rights. Clones share.
#[derive(Clone, Debug)]
pub struct Client {
    /// The label of the token, the name of the node, or the address.
    pub name: Arc<str>,
    /// The rights of the client.
    pub scope: Arc<Scope>,
    /// The time at which the rights end and the client is disconnected.
    pub expires: Option<UnixMillis>,
    /// The id of the client's token.
    pub token: Option<TokenId>,
    /// The proof by which the client was admitted.
    pub how: AdmittedBy,
    evidence: Evidence,
    /// `true` if the connection comes from a loopback address.
    is_local: bool,
}

/// The proof by which sessions were admitted. Sessions with the same credential share a quota.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Credential {
    /// Programs on this host without a token.
    Local,
    /// Programs on another host without a token.
    Address(AddressPrefix),
    /// Clients that show this token.
    Token(TokenId),
    /// Clients that show a certificate of this node.
    Certificate(NodeId),
}

/// The proof by which a client was admitted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AdmittedBy {
    /// No proof: the client is on this host, or all clients are admitted.
    Anonymous,
    /// A certificate of this node.
    Certificate(NodeId),
    /// A token.
    Token(TokenId),
}

/// The data that is judged again after the rules have changed.
#[derive(Clone)]
enum Evidence {
    /// A part of this program, without a connection.
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
    /// Returns a client for a part of this program, with all rights.
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

    /// Returns the credential of the client, or `None` for a part of this program.
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

    /// Returns `true` if the client holds this right to the interface with this full name.
    pub fn may(&self, right: Right, name: &str) -> bool {
        self.scope.permits(right, name)
    }

    /// Returns the client with another scope, for tests of rights.
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
    /// Creates an `Access` with these rules.
    pub fn new(rules: AccessRules) -> Self {
        Self { rules: Arc::new(rules), attempts: Arc::default(), listener: None, denied: Arc::default() }
    }

    /// Takes over the failed attempts, the listener and the refusal count of `before`, the `Access` under the former
    /// rules.
    #[must_use]
    pub fn after(mut self, before: &Self) -> Self {
        self.attempts = Arc::clone(&before.attempts);
        self.listener.clone_from(&before.listener);
        self.denied = Arc::clone(&before.denied);
        self
    }

    /// Sets a listener for refused tokens. The listener must not block.
    #[must_use]
    pub fn with_refusal_listener(mut self, listener: RefusalListener) -> Self {
        self.listener = Some(listener);
        self
    }

    /// Returns the rules with other CAs or newer revocation lists.
    #[must_use]
    pub fn with_anchors(mut self, anchors: TrustAnchors) -> Self {
        Arc::make_mut(&mut self.rules).anchors = Some(anchors);
        self
    }

    /// Returns the rules with another certificate of this node.
    #[must_use]
    pub fn with_gateway(mut self, gateway: VerifiedPeer) -> Self {
        Arc::make_mut(&mut self.rules).gateway = Some(gateway);
        self
    }

    /// Returns the rules.
    pub fn rules(&self) -> &AccessRules {
        &self.rules
    }

    /// Returns `true` if a rule gives rights to certificates, so that TLS front ends must request one.
    pub fn takes_certificates(&self) -> bool {
        !self.rules.clients.is_empty()
    }

    /// Returns the number of refusals.
    pub fn denied(&self) -> u64 {
        self.denied.load(Ordering::Relaxed)
    }

    /// Admits a client and returns its rights. If the client shows a token, the token alone decides: a certificate
    /// beside it adds no rights.
    pub fn admit(&self, admission: &AdmissionRequest<'_>) -> Result<Client, Denial> {
        self.judge(admission).inspect_err(|_| {
            self.denied.fetch_add(1, Ordering::Relaxed);
        })
    }

    fn judge(&self, admission: &AdmissionRequest<'_>) -> Result<Client, Denial> {
        if let Some(token) = admission.token {
            // The listener is not called again for an address that keeps trying: the log is for others, too.
            let is_heard = self.attempts().wait(admission.peer.ip(), admission.now).is_none();
            return self.admit_token(token, admission).inspect_err(|denied| {
                if let Some(listener) = self.listener.as_ref().filter(|_| is_heard) {
                    listener(admission.peer, denied);
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
                // A certificate without rights counts like no certificate, because the same program may be admitted
                // without one.
                Err(why @ Denial::NotListed { .. }) => {
                    return self.admit_anonymous(admission, origin).map_err(|_| why);
                }
                Err(why) => return Err(why),
            }
        }
        self.admit_anonymous(admission, origin)
    }

    /// Fails if the current rules no longer admit this client. The caller then disconnects it.
    pub fn still_admits(&self, client: &Client, now: UnixMillis) -> Result<(), Denial> {
        match &client.evidence {
            Evidence::Own => Ok(()),
            Evidence::Anonymous { ip, origin } => self.judge_anonymous(*ip, origin.as_deref()),
            Evidence::Certificate { peer, ip, origin } => {
                let scope = self.judge_certificate(peer, *ip, origin.as_deref(), now)?;
                if scope == *client.scope { Ok(()) } else { Err(Denial::Changed) }
            }
            Evidence::Token { id, is_exposed } => {
                if *is_exposed && !self.rules.plain {
                    return Err(Denial::PlainToken);
                }
                self.judge_time(*id, client.expires.unwrap_or(UnixMillis(0)), now)
            }
        }
    }

    fn admit_token(&self, text: &str, admission: &AdmissionRequest<'_>) -> Result<Client, Denial> {
        let ip = admission.peer.ip().to_canonical();
        let is_exposed = !admission.encrypted && !ip.is_loopback();
        // This host is never locked out, because a proxy on it may serve many clients.
        if !ip.is_loopback()
            && let Some(wait) = self.attempts().wait(ip, admission.now)
        {
            return Err(Denial::TooManyAttempts { ip, wait });
        }
        if is_exposed && !self.rules.plain {
            self.attempts().fail(ip, admission.now);
            return Err(Denial::PlainToken);
        }
        let result = AccessToken::parse(text).map_err(Denial::Token).and_then(|token| {
            let gateway = self.rules.gateway.as_ref().ok_or(Denial::NoTokens)?;
            let grant = token.verify(gateway).map_err(Denial::Token)?;
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

    fn judge_time(&self, id: TokenId, expires: UnixMillis, now: UnixMillis) -> Result<(), Denial> {
        if now > expires {
            return Err(Denial::TokenExpired { id, expires });
        }
        if self.rules.revoked.contains(&id) { Err(Denial::TokenRevoked { id }) } else { Ok(()) }
    }

    /// Returns the scope that a certificate permits.
    fn judge_certificate(
        &self,
        peer: &VerifiedPeer,
        ip: IpAddr,
        origin: Option<&str>,
        now: UnixMillis,
    ) -> Result<Scope, Denial> {
        let node = peer.node_id;
        if now > peer.not_after {
            return Err(Denial::CertificateExpired { node, expires: peer.not_after });
        }
        if self.rules.anchors.as_ref().is_some_and(|anchors| !anchors.stands(peer)) {
            return Err(Denial::CertificateRevoked { node });
        }
        let mut scope = Scope::default();
        let rules = self.rules.clients.iter().filter(|rule| rule.who.find(peer).is_some());
        rules.for_each(|rule| scope.add(&rule.scope));
        if scope.is_empty() {
            return Err(Denial::NotListed { node });
        }
        // A browser shows its certificate for any page that connects, so the origin must be checked too.
        self.judge_origin(origin, ip)?;
        Ok(scope)
    }

    fn admit_anonymous(
        &self,
        admission: &AdmissionRequest<'_>,
        origin: Option<Arc<str>>,
    ) -> Result<Client, Denial> {
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

    fn judge_anonymous(&self, ip: IpAddr, origin: Option<&str>) -> Result<(), Denial> {
        match self.rules.anonymous {
            Anonymous::Local if ip.is_loopback() => self.judge_origin(origin, ip),
            Anonymous::All => self.judge_origin(origin, ip),
            Anonymous::Local | Anonymous::None => Err(Denial::NoCredentials { ip }),
        }
    }

    /// Fails if a page of this origin may not connect without a token. Programs have no origin and pass. In a browser
    /// on another host, `http://localhost` is a page of that host.
    fn judge_origin(&self, origin: Option<&str>, ip: IpAddr) -> Result<(), Denial> {
        let Some(text) = origin else { return Ok(()) };
        let parsed = text.parse::<PageOrigin>();
        match &parsed {
            Ok(origin) if ip.is_loopback() && origin.is_loopback() => Ok(()),
            Ok(origin) if self.rules.origins.contains(origin) => Ok(()),
            _ => Err(Denial::Origin { origin: text.chars().take(ORIGIN_BYTES_MAX).collect() }),
        }
    }

    fn attempts(&self) -> std::sync::MutexGuard<'_, Attempts> {
        lock(&self.attempts)
    }
}

/// The reason of a refusal, for the gateway's log. [`Denial::client_message`] is the text for the client.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Denial {
    /// The client showed neither a token nor a certificate, and this address needs one.
    #[error(
        "a program at {ip} showed neither a token nor a certificate: make a token with `sgc token access create`, name its \
         node in a [[gateway.client]], or see `anonymous` in [gateway]"
    )]
    NoCredentials {
        /// The address of the client.
        ip: IpAddr,
    },
    /// The origin of the page is neither this host nor listed.
    #[error(
        "a page of {origin:?} wants to connect through somebody's browser: if that is meant, list it in `origins` of \
         [gateway], or give the page a token"
    )]
    Origin {
        /// The origin of the page.
        origin: String,
    },
    /// The token was shown over a connection that is not encrypted.
    #[error(
        "a token was shown over a connection that is not encrypted, where others may have read it: revoke it, make a new \
         one, and connect with wss:// or grpcs:// (or see `plain` in [gateway])"
    )]
    PlainToken,
    /// The token is not valid at this gateway.
    #[error("a token was shown that does not hold: {0}")]
    Token(#[source] AccessTokenError),
    /// The gateway has no identity, so no token is valid.
    #[error("a token was shown, but this gateway has no identity to verify it with")]
    NoTokens,
    /// The token has expired.
    #[error("token {id} ended at {expires}: make a new one with `sgc token access create`")]
    TokenExpired {
        /// The id of the token.
        id: TokenId,
        /// The time of expiry.
        expires: UnixMillis,
    },
    /// The token was revoked.
    #[error(
        "token {id} was revoked: if its holder may come back, make a new one with `sgc token access create`"
    )]
    TokenRevoked {
        /// The id of the token.
        id: TokenId,
    },
    /// Too many tokens of this address failed.
    #[error(
        "{ip} showed too many tokens that do not hold and is not listened to for {} s: see the reasons before this one",
        wait.as_secs() + 1
    )]
    TooManyAttempts {
        /// The address of the client.
        ip: IpAddr,
        /// The time until the address may try again.
        wait: Duration,
    },
    /// No rule gives rights to the certificate.
    #[error(
        "no [[gateway.client]] names node {node}, a group of it or its fleet: add it to the `who` of one, or make a token \
         with `sgc token access create`"
    )]
    NotListed {
        /// The node of the certificate.
        node: NodeId,
    },
    /// The certificate has expired.
    #[error("the certificate of node {node} ended at {expires}: renew it (docs/how-to/fleet.md)")]
    CertificateExpired {
        /// The node of the certificate.
        node: NodeId,
        /// The time of expiry.
        expires: UnixMillis,
    },
    /// The CA revoked the certificate.
    #[error(
        "the certificate of node {node} was revoked: if that is a mistake, the keeper of the fleet enrolls it again"
    )]
    CertificateRevoked {
        /// The node of the certificate.
        node: NodeId,
    },
    /// The rights of the certificate have changed since the client was admitted.
    #[error("what the certificate permits has changed: it gets that when it connects again")]
    Changed,
}

impl Denial {
    /// Returns the text for the client. It says what the user can do, but not why a token is invalid.
    pub fn client_message(&self) -> &'static str {
        match self {
            Self::NoCredentials { .. } | Self::NotListed { .. } => {
                "not admitted: this gateway wants a token (`sgc token access create` there makes one) or a certificate of its fleet"
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
