//! What the route machine asks of its driver, and what it has to say to the user.

use sgc_endpoint::ShareSpec;
use sgc_trust::Policy;
use sgc_wire::{CatalogueSource, Class, ENTRY_SOURCES_MAX, Name, NodeId, Qos, RosNode, SourceId};

use super::{ENTRIES_PER_RULE_MAX, LOCAL_ENDPOINTS_MAX, ROUTES_PER_WILDCARD_MAX, Shaping};
use crate::network::{EndpointSpec, Guid, ServiceSpec};
use crate::qos::QosMismatch;

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
        /// Its writers.
        sources: Vec<CatalogueSource>,
    },
    /// Tell the endpoint who may join the share now; who may no longer is to be cut off.
    UpdatePolicy {
        /// The share.
        name: Name,
        /// Who may join.
        policy: Policy,
    },
    /// How much goes on under a name that is shared, published or joined here; nothing is set until it is told.
    Shape {
        /// The name.
        name: Name,
        /// The settings.
        shaping: Shaping,
    },
    /// What the names of frames in tf messages of this name get in front, if anything; nothing does until it is told.
    Frames {
        /// The joined name.
        name: Name,
        /// The prefix.
        prefix: Option<String>,
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
    /// Which source publishes for which local writer.
    MapSources {
        /// The share.
        name: Name,
        /// Class of their packets.
        class: Class,
        /// The writers, each with its own source as long as there are not too many, and what that offers. Some may be
        /// gone: what they wrote last is still published.
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
    /// Ask anew for a name that is joined, and go on with what is there for it.
    JoinAgain {
        /// Which.
        name: Name,
        /// Whose it must be.
        owner: NodeId,
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
    /// Join a service to call it for local clients.
    Call {
        /// Which.
        name: Name,
        /// Whose it must be.
        owner: NodeId,
        /// Cipher suite id.
        suite: u8,
        /// Class of its packets.
        class: Class,
    },
    /// Call the local servers of a shared service for those who call it under `name`.
    OpenClient {
        /// The share.
        name: Name,
        /// What to create.
        spec: ServiceSpec,
    },
    /// Call them no longer, once what they were asked is answered.
    CloseClient {
        /// The share.
        name: Name,
    },
    /// All local servers of a shared service are gone: what they were asked will not be answered.
    ServersGone {
        /// The share.
        name: Name,
    },
    /// Take calls of local clients for a service that is joined.
    OpenServer {
        /// The joined name.
        name: Name,
        /// What to create.
        spec: ServiceSpec,
    },
    /// Take them no longer.
    CloseServer {
        /// The joined name.
        name: Name,
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
    /// A writer gives late joiners fewer samples from here on, and goes on with what it has otherwise.
    ResizeWriter {
        /// The joined name.
        name: Name,
        /// The source that it is for, by now.
        source: Option<SourceId>,
        /// As it would be opened now.
        spec: EndpointSpec,
    },
    /// A writer is for another source from here on: its publisher is the same, and what it has written already is not to be
    /// written again.
    MoveWriter {
        /// The joined name.
        name: Name,
        /// The source that it was for.
        from: SourceId,
        /// The one that it is for now.
        to: SourceId,
    },
    /// The local graph shows an open writer as that of this node; until it is told, and if there is none, as that of
    /// this proxy. Holds until the writer is closed.
    SetNode {
        /// The joined name.
        name: Name,
        /// As it was opened.
        source: Option<SourceId>,
        /// Whose node it is.
        owner: NodeId,
        /// The node, under its local name.
        node: Option<RosNode>,
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
    /// Both sides call the type alike and mean different things (type hashes of REP 2016).
    #[error(
        "{topic}: {owner} has {type_name} with the hash {remote}, but a local {end} has it with {local}; each reads the other's messages wrong or not at all. Build both from one definition of {type_name}"
    )]
    LocalHash {
        /// Topic.
        topic: String,
        /// Owner.
        owner: String,
        /// Type on both sides.
        type_name: String,
        /// Hash of the owner's.
        remote: String,
        /// `"subscriber"` or `"publisher"`.
        end: &'static str,
        /// Hash of the local endpoint's.
        local: String,
    },
    /// Two publishers of one share do so.
    #[error(
        "{topic}: local publishers have different definitions of {type_name}, with the hashes {first} and {second}; subscribers read some messages wrong. Build both from one definition"
    )]
    ShareHash {
        /// Topic.
        topic: String,
        /// Type of both.
        type_name: String,
        /// One hash.
        first: String,
        /// Another.
        second: String,
    },
    /// A local subscriber asks for more than the far publisher offers.
    #[error(
        "{topic}: {owner} offers {mismatch}; it receives nothing from there. {}", mismatch.fix(owner)
    )]
    LocalQos {
        /// Topic.
        topic: String,
        /// Owner.
        owner: String,
        /// Where the two differ.
        mismatch: QosMismatch,
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
    /// Two owners' topics have one name here and different types.
    #[error(
        "{topic}: {owner} shares it as {found}, but what {other} shares has the same name here and is {known}: \
         subscribers hear one of the two. Give one another name, with `as` or `namespace` in its [[use]]"
    )]
    MergedTypes {
        /// Topic here.
        topic: String,
        /// Owner of the one.
        owner: String,
        /// Its type.
        found: String,
        /// Owner of the other.
        other: String,
        /// Its type.
        known: String,
    },
    /// A wildcard would share what this node uses.
    #[error(
        "{topic}: a wildcard would share it, but this node uses it from {owner}, so that it is not shared. Put it into \
         `except` of the [[share]], or give what {owner} shares another name here, with `as` or `namespace` in the [[use]]"
    )]
    UsedNotShared {
        /// Topic here.
        topic: String,
        /// Whose.
        owner: String,
    },
    /// A wildcard would bring what this node shares.
    #[error(
        "{topic}: {owner} shares it, but so does this node, so that it is not brought here. Put it into `except` of the \
         [[use]], or give it another name here, with `as` or `namespace`"
    )]
    SharedNotUsed {
        /// Topic here.
        topic: String,
        /// Whose.
        owner: String,
    },
    /// Two local topics would be shared as one.
    #[error(
        "{topic}: would be shared as {called}, as which {other} is shared already; it is not shared. Change `as` or \
         `namespace` in one [[share]]"
    )]
    SharedAsOne {
        /// Topic here.
        topic: String,
        /// What both would be called.
        called: String,
        /// The one that is shared.
        other: String,
    },
    /// No name that ROS 2 allows.
    #[error(
        "{topic:?} of {owner} is no name for a topic of ROS 2, or too long a one; it is not brought here"
    )]
    NoName {
        /// The name here.
        topic: String,
        /// Owner.
        owner: String,
    },
    /// A shared name that ROS 2 does not allow.
    #[error(
        "{topic}: shared as {called:?} it would have too long a name; it is not shared. Take a shorter one"
    )]
    NoSharedName {
        /// Topic here.
        topic: String,
        /// What it would be called.
        called: String,
    },
    /// More matches a wildcard than is carried.
    #[error(
        "{topic}: more than {ROUTES_PER_WILDCARD_MAX} topics match; the rest is not {verb}. Leave some out with \
         `except`, or split it into several rules"
    )]
    TooManyMatches {
        /// The pattern.
        topic: String,
        /// `"shared"` or `"brought here"`.
        verb: &'static str,
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
    /// More writers than can be told apart.
    #[error("{topic}: more than {ENTRY_SOURCES_MAX} publishers; the rest pass for one, with one history")]
    TooManySources {
        /// Topic.
        topic: String,
    },
}
