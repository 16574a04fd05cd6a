//! What the route machine asks of its driver, and what it has to say to the user.

use sgc_endpoint::ShareSpec;
use sgc_trust::Policy;
use sgc_wire::{CatalogueSource, Class, ENTRY_SOURCES_MAX, Name, NodeId, Qos, SourceId};

use super::{ENTRIES_PER_RULE_MAX, LOCAL_ENDPOINTS_MAX};
use crate::network::{EndpointSpec, Guid};

/// What the driver has to do.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Command {
    /// Share it with the endpoint.
    Share(ShareSpec),
    /// Tell the endpoint what the share offers now.
    UpdateShare {
        /// The share.
        name: Name,
        /// Offer of all its writers.
        qos: Qos,
        /// Its transient-local writers.
        sources: Vec<CatalogueSource>,
    },
    /// Tell the endpoint who may join the share now; who may no longer is to be cut off.
    UpdatePolicy {
        /// The share.
        name: Name,
        /// Who may join.
        policy: Policy,
    },
    /// End the share.
    Unshare {
        /// Which.
        name: Name,
    },
    /// Read a local topic and publish it under `name`.
    OpenReader {
        /// The share.
        name: Name,
        /// What to create.
        spec: EndpointSpec,
    },
    /// Which source publishes for which local writer; writers that are not listed share one.
    MapSources {
        /// The share.
        name: Name,
        /// What all writers together offer.
        qos: Qos,
        /// Class of their packets.
        class: Class,
        /// Transient-local writers, each with its own source and history.
        own: Vec<(Guid, SourceId, Qos)>,
    },
    /// Read it no longer.
    CloseReader {
        /// The share.
        name: Name,
    },
    /// Follow an owner's catalogue.
    Follow {
        /// Its name in the fleet.
        owner_name: String,
    },
    /// Follow it no longer.
    Unfollow {
        /// Whose.
        owner: NodeId,
    },
    /// Join a name.
    Join {
        /// Which.
        name: Name,
        /// Whose it must be.
        owner: NodeId,
        /// True if histories are to be asked for.
        transient_local: bool,
        /// True if the grant has to say what the name stands for.
        describe: bool,
    },
    /// Join a name to publish under it what is read locally.
    Publish {
        /// Which.
        name: Name,
        /// Whose it must be.
        owner: NodeId,
        /// Cipher suite id.
        suite: u8,
        /// Class of its packets.
        class: Class,
        /// Whether they push back.
        reliable: bool,
    },
    /// Leave a name.
    Leave {
        /// Which.
        name: Name,
    },
    /// Write what comes under `name` to the local network.
    OpenWriter {
        /// The joined name.
        name: Name,
        /// The one source that it is for; `None` for all that have no writer of their own.
        source: Option<SourceId>,
        /// What to create.
        spec: EndpointSpec,
    },
    /// Write it no longer.
    CloseWriter {
        /// The joined name.
        name: Name,
        /// As it was opened.
        source: Option<SourceId>,
    },
    /// Something that the user should know, told once.
    Report(Problem),
}

/// What is wrong between two sides, with both values and the fix.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, thiserror::Error)]
pub enum Problem {
    /// A local writer's type is not the one that the share names.
    #[error(
        "{topic}: shared as {expected}, but a local publisher has {found}; it is not shared. Change `type` in the [[share]] or the publisher"
    )]
    ShareType {
        /// Topic.
        topic: String,
        /// Type in the rule.
        expected: String,
        /// Type of the writer.
        found: String,
    },
    /// The owner shares another type than the rule asks for.
    #[error(
        "{topic}: {owner} shares it as {found}, but this node asks for {expected}. Change `type` in the [[use]] or at {owner}"
    )]
    UseType {
        /// Topic.
        topic: String,
        /// Owner.
        owner: String,
        /// Type in the rule.
        expected: String,
        /// Type in the catalogue.
        found: String,
    },
    /// A local endpoint on a used topic has another type than the owner shares.
    #[error("{topic}: {owner} shares it as {remote}, but a local {end} has {local}; the two will not talk")]
    LocalType {
        /// Topic.
        topic: String,
        /// Owner.
        owner: String,
        /// Type shared.
        remote: String,
        /// `"subscriber"` or `"publisher"`.
        end: &'static str,
        /// Type of the local endpoint.
        local: String,
    },
    /// A local subscriber asks for more than the far publisher offers.
    #[error(
        "{topic}: {owner} offers {offered}, but a local subscriber asks for {requested}; it will receive nothing"
    )]
    LocalQos {
        /// Topic.
        topic: String,
        /// Owner.
        owner: String,
        /// What is offered.
        offered: String,
        /// What is asked for.
        requested: String,
    },
    /// Local writers of one topic offer different QoS.
    #[error("{topic}: local publishers offer different QoS; it is shared with the weakest, {offered}")]
    MixedQos {
        /// Topic.
        topic: String,
        /// What is offered.
        offered: String,
    },
    /// An owner shares one topic in more forms than are brought here.
    #[error(
        "{topic}: {owner} shares it in more than {ENTRIES_PER_RULE_MAX} forms; the rest is not brought here"
    )]
    TooManyEntries {
        /// Topic.
        topic: String,
        /// Owner.
        owner: String,
    },
    /// What came for a token is not what the token says.
    #[error(
        "{topic}: {owner} gives something else for the token than it says; it is not brought here. Ask for a new token"
    )]
    TokenEntry {
        /// Topic.
        topic: String,
        /// Owner.
        owner: String,
    },
    /// More local endpoints than are looked at.
    #[error(
        "the local network has more than {LOCAL_ENDPOINTS_MAX} endpoints; those beyond are not looked at"
    )]
    TooManyEndpoints,
    /// More transient-local writers than can be told apart.
    #[error("{topic}: more than {ENTRY_SOURCES_MAX} transient-local publishers; the rest share one history")]
    TooManySources {
        /// Topic.
        topic: String,
    },
}
