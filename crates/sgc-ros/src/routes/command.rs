//! The commands of the route machine to its driver.

use sgc_endpoint::ShareSpec;
use sgc_trust::Policy;
use sgc_wire::{CatalogueSource, Class, Name, NodeId, Qos, RosNode, SourceId};

use super::problem::Problem;
use super::rules::{DeadManRule, Shaping};
use crate::network::{EndpointSpec, Guid, ServiceSpec};

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
    /// Set the dead-man switch of this name. Without this command there is none.
    DeadMan {
        /// The joined name.
        name: Name,
        /// The switch.
        rule: Option<DeadManRule>,
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
    /// The last writer of a source is gone: have its last messages confirmed. The source stays for now.
    CloseSource {
        /// The share.
        name: Name,
        /// The source.
        source: SourceId,
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
    /// Pass on the liveliness assertions of these local publishers, whose messages are published under another node's
    /// name, and of no others.
    WatchPublishers {
        /// The joined name.
        name: Name,
        /// The publishers with their offers.
        publishers: Vec<(Guid, Qos)>,
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
