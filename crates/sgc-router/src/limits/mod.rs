//! Bounds on the memory and work that neighbours may cause at a router.

pub(crate) mod allowances;
pub(crate) mod budget;

use std::time::Duration;

/// Longest route of data, in links.
pub(crate) const HOPS_MAX: u8 = sgc_wire::HOP_LIMIT - 3;
/// Interval at which a name that somebody waits for is asked for again.
pub(crate) const QUERY_EVERY: Duration = Duration::from_secs(20);
/// Multiple of a proxy's requests that a router may bring.
pub(crate) const ROUTER_FACTOR: u32 = 16;

/// Bounds on the memory that neighbours may take at this node.
#[derive(Clone, Debug)]
pub struct Limits {
    /// Names known in all.
    pub names_max: usize,
    /// Names of one owner.
    pub names_per_owner_max: usize,
    /// Names that are known over one link to a router.
    pub names_per_router_max: usize,
    /// Nodes whose links are known.
    pub nodes_max: usize,
    /// Branches that one node may have here.
    pub branches_per_peer_max: usize,
    /// Branches of one name.
    pub branches_per_name_max: usize,
    /// Names that one node may be interested in, over all its links; also the unknown names that a router may have
    /// asked for.
    pub interests_per_peer_max: usize,
    /// Unknown names that all routers are asked for on behalf of one node within 20 s, counted separately for first and
    /// repeated questions. Others wait for their turn. A router has sixteen times as many.
    pub unknown_per_peer_max: u32,
    /// Advertisements and withdrawals of one owner that are in force; beyond it the oldest are void.
    pub adverts_per_owner_max: usize,
    /// Bytes of them.
    pub advert_bytes_per_owner_max: usize,
    /// Unknown names that all routers together may have asked for. Beyond it the router with the most loses its oldest
    /// question.
    pub asks_max: usize,
    /// Questions remembered after passing them on. Beyond it the neighbour that brought the most loses its oldest; that
    /// neighbour itself brings more only when that one is 5 s old.
    pub questions_max: usize,
    /// Withdrawn names remembered against replay. Beyond it the owner with the most loses its oldest withdrawal, and
    /// with it every earlier advertisement.
    pub tombstones_max: usize,
    /// Time that an owner may take to answer a join, and a sink to ask over a better route.
    pub answer_wait: Duration,
    /// Longest lease of an advertisement or link state that is honoured.
    pub lease_max: Duration,
    /// Links of one node at one time.
    pub links_per_node_max: usize,
    /// Requests to join that a proxy may bring at once; refilled by an eighth of it a second. A router, which brings
    /// those of many, may bring sixteen times as many.
    pub joins_burst: u32,
    /// Names that a neighbour may ask for at once; refilled by an eighth of it a second. A router may ask for sixteen
    /// times as many.
    pub queries_burst: u32,
    /// Advertisements and link states of a node that are passed on at once, each to all routers; refilled by an eighth
    /// of it a second. Further ones wait, and only the newest of them is passed on.
    pub announcements_burst: u32,
    /// Verified announcements without news, or beyond their signer's allowance, that a neighbour may bring at once;
    /// refilled by an eighth of it a second. A router may bring sixteen times as many.
    pub stale_burst: u32,
    /// New revocation lists of one CA that are taken from neighbours at once; refilled by one a second. Further ones
    /// wait, and only the newest of them is taken. The CA of this node's own fleet has no such bound. Greater than
    /// [`sgc_trust::FLEET_LISTS_MAX`], so that all lists in force fit.
    pub lists_burst: u32,
    /// Memory for values of the store that were read lately, bytes.
    pub store_cache_bytes: usize,
    /// Unverifiable bodies that a node may bring before its link is closed; one is forgiven a second.
    pub forgeries_max: u32,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            names_max: 16_000_000,
            names_per_owner_max: 16_384,
            names_per_router_max: 4_000_000,
            nodes_max: 1_000_000,
            branches_per_peer_max: 65_536,
            branches_per_name_max: 4096,
            interests_per_peer_max: 65_536,
            unknown_per_peer_max: 1024,
            adverts_per_owner_max: 512,
            advert_bytes_per_owner_max: 4 << 20,
            asks_max: 262_144,
            questions_max: 100_000,
            tombstones_max: 100_000,
            answer_wait: Duration::from_secs(10),
            lease_max: Duration::from_secs(600),
            links_per_node_max: 8,
            joins_burst: 1024,
            queries_burst: 65_536,
            announcements_burst: 256,
            stale_burst: 256,
            lists_burst: 64,
            store_cache_bytes: 32 << 20,
            forgeries_max: 64,
        }
    }
}
