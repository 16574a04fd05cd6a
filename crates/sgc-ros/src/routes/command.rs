//! The commands of the route machine to its driver, and the problems that it reports to the user.

use sgc_endpoint::ShareSpec;
use sgc_trust::Policy;
use sgc_wire::{CatalogueSource, Class, ENTRY_SOURCES_MAX, Name, NodeId, Qos, RosNode, SourceId};

use super::{ENTRIES_PER_RULE_MAX, LOCAL_ENDPOINTS_MAX, ROUTES_PER_WILDCARD_MAX, Shaping};
use crate::network::{EndpointSpec, Guid, ServiceSpec};
use crate::qos::QosMismatch;

/// A command to the driver.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Command {
    /// Share an interface at the endpoint.
    Share(ShareSpec),
    /// Update the offer of a share at the endpoint.
    UpdateShare {
        /// The share.
        name: Name,
        /// The offer of all writers together.
        qos: Qos,
        /// The writers.
        sources: Vec<CatalogueSource>,
    },
    /// Update the policy of a share. Nodes that lose their right are cut off.
    UpdatePolicy {
        /// The share.
        name: Name,
        /// The policy.
        policy: Policy,
    },
    /// Shape the traffic of a name that is shared, published or joined here. Without this command there is no limit.
    Shape {
        /// The name.
        name: Name,
        /// The settings.
        shaping: Shaping,
    },
    /// Set the prefix for frames in tf messages of this name. Without this command there is none.
    Frames {
        /// The joined name.
        name: Name,
        /// The prefix.
        prefix: Option<String>,
    },
    /// End the share.
    Unshare {
        /// The share.
        name: Name,
    },
    /// Read a local topic and publish it under `name`.
    OpenReader {
        /// The share.
        name: Name,
        /// The reader to create.
        spec: EndpointSpec,
    },
    /// Map local writers to sources.
    MapSources {
        /// The share.
        name: Name,
        /// The class of their packets.
        class: Class,
        /// The writers with their sources and offers. Each has its own source unless there are too many. A writer may
        /// be gone while its last messages are still published.
        own: Vec<(Guid, SourceId, Qos)>,
    },
    /// Close the reader.
    CloseReader {
        /// The share.
        name: Name,
    },
    /// Follow an owner's catalogue.
    Follow {
        /// The owner's name in the fleet.
        owner_name: String,
    },
    /// Stop following the catalogue.
    Unfollow {
        /// The owner.
        owner: NodeId,
    },
    /// Join a name.
    Join {
        /// The name.
        name: Name,
        /// The required owner.
        owner: NodeId,
        /// `true` to request histories.
        transient_local: bool,
        /// `true` if the grant must describe the interface.
        describe: bool,
    },
    /// Repeat the join of a name, and keep its local endpoints.
    JoinAgain {
        /// The name.
        name: Name,
        /// The required owner.
        owner: NodeId,
    },
    /// Join a name to publish local messages under it.
    Publish {
        /// The name.
        name: Name,
        /// The required owner.
        owner: NodeId,
        /// The id of the cipher suite.
        suite: u8,
        /// The class of the packets.
        class: Class,
        /// `true` if a full path slows the reader down.
        reliable: bool,
    },
    /// Join a service to call it for local clients.
    Call {
        /// The name.
        name: Name,
        /// The required owner.
        owner: NodeId,
        /// The id of the cipher suite.
        suite: u8,
        /// The class of the packets.
        class: Class,
    },
    /// Call the local servers of a shared service for remote callers under `name`.
    OpenClient {
        /// The share.
        name: Name,
        /// The client to create.
        spec: ServiceSpec,
    },
    /// Close the client once pending calls are answered.
    CloseClient {
        /// The share.
        name: Name,
    },
    /// All local servers of a shared service are gone, so pending calls will get no answer.
    ServersGone {
        /// The share.
        name: Name,
    },
    /// Accept calls of local clients for a joined service.
    OpenServer {
        /// The joined name.
        name: Name,
        /// The server to create.
        spec: ServiceSpec,
    },
    /// Close the server.
    CloseServer {
        /// The joined name.
        name: Name,
    },
    /// Leave a name.
    Leave {
        /// The name.
        name: Name,
    },
    /// Write messages under `name` to the local network.
    OpenWriter {
        /// The joined name.
        name: Name,
        /// The source of the messages; `None` for all sources without a writer of their own.
        source: Option<SourceId>,
        /// The writer to create.
        spec: EndpointSpec,
    },
    /// Reduce the depth that an open writer gives late joiners. Nothing else changes.
    ResizeWriter {
        /// The joined name.
        name: Name,
        /// The current source of the writer.
        source: Option<SourceId>,
        /// The spec with the new depth.
        spec: EndpointSpec,
    },
    /// Assign a writer to another source. The publisher is the same, so samples that the writer has written must not
    /// be written again.
    MoveWriter {
        /// The joined name.
        name: Name,
        /// The former source.
        from: SourceId,
        /// The new source.
        to: SourceId,
    },
    /// Show a writer in the local graph as part of this node. By default, and for `None`, it is shown as part of this
    /// proxy. Valid until the writer is closed.
    SetNode {
        /// The joined name.
        name: Name,
        /// The source for which the writer was opened.
        source: Option<SourceId>,
        /// The owner of the node.
        owner: NodeId,
        /// The node, under its local name.
        node: Option<RosNode>,
    },
    /// Close the writer.
    CloseWriter {
        /// The joined name.
        name: Name,
        /// The source for which the writer was opened.
        source: Option<SourceId>,
    },
    /// Report a problem to the user, once.
    Report(Problem),
}

/// A mismatch between two sides, with both values and the fix.
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
    /// Two publishers of one share have different definitions of the type.
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
        /// The combined offer.
        offered: String,
    },
    /// An owner shares one topic in too many forms.
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
        /// The first owner.
        owner: String,
        /// Its type.
        found: String,
        /// The second owner.
        other: String,
        /// Its type.
        known: String,
    },
    /// A wildcard would share an interface that this node uses.
    #[error(
        "{topic}: a wildcard would share it, but this node uses it from {owner}, so that it is not shared. Put it into \
         `except` of the [[share]], or give what {owner} shares another name here, with `as` or `namespace` in the [[use]]"
    )]
    UsedNotShared {
        /// Topic here.
        topic: String,
        /// The owner.
        owner: String,
    },
    /// A wildcard would bring an interface that this node shares.
    #[error(
        "{topic}: {owner} shares it, but so does this node, so that it is not brought here. Put it into `except` of the \
         [[use]], or give it another name here, with `as` or `namespace`"
    )]
    SharedNotUsed {
        /// Topic here.
        topic: String,
        /// The owner.
        owner: String,
    },
    /// Two local topics would be shared under one name.
    #[error(
        "{topic}: would be shared as {called}, as which {other} is shared already; it is not shared. Change `as` or \
         `namespace` in one [[share]]"
    )]
    SharedAsOne {
        /// Topic here.
        topic: String,
        /// The shared name of both.
        called: String,
        /// The topic that is shared already.
        other: String,
    },
    /// The name is invalid in ROS 2.
    #[error(
        "{topic:?} of {owner} is no name for a topic of ROS 2, or too long a one; it is not brought here"
    )]
    NoName {
        /// The name here.
        topic: String,
        /// Owner.
        owner: String,
    },
    /// The shared name is invalid in ROS 2.
    #[error(
        "{topic}: shared as {called:?} it would have too long a name; it is not shared. Take a shorter one"
    )]
    NoSharedName {
        /// Topic here.
        topic: String,
        /// The shared name.
        called: String,
    },
    /// A wildcard matches too many interfaces.
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
    /// The granted interface differs from the token.
    #[error(
        "{topic}: {owner} gives something else for the token than it says; it is not brought here. Ask for a new token"
    )]
    TokenEntry {
        /// Topic.
        topic: String,
        /// Owner.
        owner: String,
    },
    /// The local network has too many endpoints.
    #[error(
        "the local network has more than {LOCAL_ENDPOINTS_MAX} endpoints; those beyond are not looked at"
    )]
    TooManyEndpoints,
    /// A topic has too many publishers to tell apart.
    #[error("{topic}: more than {ENTRY_SOURCES_MAX} publishers; the rest pass for one, with one history")]
    TooManySources {
        /// Topic.
        topic: String,
    },
}
