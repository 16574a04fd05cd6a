//! The meaning and the remedy of each refusal: the table from which `sgc why` and `sgc status` explain counters.
//!
//! The specification of routing lists the counters, and the node keeps them. `tests/documents` compares both with this
//! table. Where an enum without data has the counters, a row names the variant.

use sgc_endpoint::CallLoss;
use sgc_gateway::{ClientRefusal, Pool};
use sgc_node::{DataDrop, NodeDrop};
use sgc_transport::{PeerRefusal, RefusalKind};
use sgc_trust::CertError;
use sgc_wire::{OperationRefusal, RefuseReason, RejectReason};

/// A counter's explanation.
#[derive(Debug, PartialEq, Eq)]
pub struct Refusal {
    /// The counter, as the node spells it.
    pub key: &'static str,
    /// The meaning.
    pub means: &'static str,
    /// The user's remedy; empty if there is nothing to do.
    pub fix: &'static str,
    /// `sgc why` reports the refusal for any topic, because a sound network never causes it or an operator has to act.
    pub is_named: bool,
}

/// The counters of one kind.
#[derive(Debug)]
pub struct CounterTable {
    /// A heading.
    pub title: &'static str,
    /// Where a user finds the counters.
    pub place: &'static str,
    /// The counters.
    pub counters: &'static [Refusal],
}

/// All counters that have a meaning and a remedy.
pub const COUNTERS: [CounterTable; 5] = [
    CounterTable {
        title: "Control plane and local network",
        place: "`sgc status` lists them under Drops, and `sgc status --json` has them in `drops`.",
        counters: CONTROL,
    },
    CounterTable {
        title: "Packets and messages",
        place: "`sgc status` lists them under Drops, and `sgc why TOPIC` those of one topic.",
        counters: PACKETS,
    },
    CounterTable {
        title: "Packets that a subscribing node refuses",
        place: "`sgc status` lists them under Drops. Each packet also counts as `sink`.",
        counters: SINK,
    },
    CounterTable {
        title: "Refused links",
        place: "`sgc status` lists them under Refused peers, and `sgc status --json` has them in `refused`.",
        counters: DOOR,
    },
    CounterTable {
        title: "Refused clients of a gateway",
        place: "`sgc status` lists them under Refused there, and `sgc status --json` has them in `refused` of `gateway`.",
        counters: GATEWAY,
    },
];

/// Returns a refusal on which an operator has to act.
const fn named(key: &'static str, means: &'static str, fix: &'static str) -> Refusal {
    Refusal { key, means, fix, is_named: true }
}

/// Returns a refusal that happens in a sound network, or that the walk of a topic reports.
const fn counted(key: &'static str, means: &'static str, fix: &'static str) -> Refusal {
    Refusal { key, means, fix, is_named: false }
}

const SAME_VERSION: &str = "do both nodes have one version of sgc?";
const SET_CLOCK: &str =
    "compare `date -u` on both machines and set the clock that is wrong, for instance by NTP (`timedatectl`)";
const ENROLL_AGAIN: &str = "if the node is to come back, `sgc fleet enroll` it again, which gives it the next incarnation, and \
                            install the new identity there";
const TAMPERED: &str = "somebody on the way alters packets; do all nodes have one version of sgc?";
const DDS_LOG: &str = "look into the node's log for what DDS said";
const DEFINITIONS: &str =
    "name a directory that defines it with `definitions` in [ros]; a few when a topic begins are no fault";
const FLEET_FILE: &str =
    "look into the node's log: is the fleet's file there, and may the node's user write it?";
const RAISE_CLIENTS: &str = "close clients that are not needed, or raise `clients_max` in [gateway]; of one token, certificate or \
                             address a quarter of the places at most: make several tokens for many viewers";
const FEWER: &str = "subscribe to and publish less in one client, or spread it over several tokens (docs/reference/gateway.md, how much one \
                     may have)";
const SLOW_CLIENTS: &str = "if it is somebody who connects again and again, keep the address out by a firewall; programs of this \
                            host have places of their own";

/// Refusals of control frames, of the machines, of the authority and of the local network.
pub(crate) const CONTROL: &[Refusal] = &[
    named(
        "not_verified",
        "a neighbour brought what is not signed as it says, or under a certificate that does not hold here: over, revoked with \
         its node's incarnation, or of another CA",
        "the log names the neighbour and the cause; a node that was revoked by mistake has to be enrolled again",
    ),
    named(
        "not_owner",
        "a node that carries nobody else's names announced names of another node",
        "if it is a router, enroll it with --role router or --may-route; else find out what runs there",
    ),
    counted("stale", "older than what is known; a few when announcements cross are no fault", ""),
    named(
        "hop_limit",
        "it went in a circle, or over too many routers",
        "look at the links between the routers",
    ),
    named(
        "limit",
        "a neighbour, or a node behind it, has no place left here for more names, branches, interests or requests a second",
        "the log says which limit; have that node share or use fewer topics, or use them over several nodes",
    ),
    counted(
        "unknown",
        "a frame for what is not here any more; a few when things end are no fault",
        SAME_VERSION,
    ),
    counted(
        "wrong_way",
        "it came from a neighbour that is not on the way; a few when a way changes are no fault",
        "",
    ),
    counted("no_link", "a frame of a link that had ended", ""),
    named(
        "crl",
        "a revocation list is not believed: altered, of a CA that is not trusted here, or more than there is room for",
        "the log says which; where copies of a fleet's file went their own ways, `sgc fleet merge` them and hand out the new list",
    ),
    named(
        "crl_flood",
        "a partner's CA signs new revocation lists faster than one a second; of those beyond it the newest waits",
        "ask the partner whether somebody else has the key of its CA; until that is known, take the CA out of its [[partner]]",
    ),
    counted("clock", "signed by a clock that is not near the one here", SET_CLOCK),
    named(
        "not_router",
        "a neighbour says that it carries others' names, and its certificate does not let it: nothing goes through it",
        "enroll it with --role router or --may-route",
    ),
    named(
        "invited",
        "the holder of a code of `sgc fleet invite` asks for more than its identity",
        "the code ends by itself, or by `sgc fleet revoke` of the node that it is for; the log names the link",
    ),
    named(
        "stale_flood",
        "a neighbour brings too many announcements that are old; more of them are not looked at for a while",
        "look at that neighbour: somebody behind it replays, or signs anew all the time; end the link to it if it goes on",
    ),
    named(
        "questions_full",
        "too many questions for names wait here; a neighbour's further ones are dropped for a while",
        "have the nodes behind it use fewer topics that do not exist; the log names the neighbour",
    ),
    counted(
        "owner_key",
        "an answer that does not verify with the key that is known of its owner",
        "a few when an owner gets another certificate are no fault",
    ),
    named(
        NodeDrop::MalformedControl.key(),
        "a neighbour sends control frames that cannot be read",
        SAME_VERSION,
    ),
    named(
        NodeDrop::ControlQueueFull.key(),
        "a peer does not take control frames, so its link was closed",
        "is it stopped, or the link far too thin? It is dialled again by itself",
    ),
    counted(
        NodeDrop::IdentityInUse.key(),
        "two processes use one identity",
        "`sgc status` says where, under what needs attention",
    ),
    counted(NodeDrop::ClocksDiffer.key(), "the clock of a peer differs from the one here", SET_CLOCK),
    named(
        "endpoint_not_verified",
        "an answer or request is not signed by whom it says, or under a certificate that does not hold",
        "a router on the way alters it, or a clock is wrong: compare `date -u` on both machines",
    ),
    named("endpoint_grant", "a grant cannot be opened, or is not for this node", SAME_VERSION),
    counted("endpoint_unexpected", "a frame that nobody asked for", SAME_VERSION),
    named(
        "endpoint_catalogue_too_large",
        "this node shares more than fits into what it lists for others: some topics are left out",
        "share fewer topics, or give some to another node",
    ),
    named(
        "endpoint_invited",
        "the holder of a code of `sgc fleet invite` asks for more than its identity, through a router of an earlier version",
        "upgrade the router; the code ends by itself, or by `sgc fleet revoke` of the node that it is for",
    ),
    counted(
        NodeDrop::JoinRefused.key(),
        "a node that may not have a topic asked for it",
        "`sgc why TOPIC` names it",
    ),
    named(
        NodeDrop::ReplaysFull.key(),
        "too many ask for a history at once; they ask again by themselves",
        "",
    ),
    named(
        NodeDrop::RenewalRefused.key(),
        "the fleet's authority gives this node no new certificate",
        "see `sgc fleet list` there: is the node revoked or unknown? Then enroll it again",
    ),
    named(
        NodeDrop::CredentialsUnusable.key(),
        "what the fleet's authority sent is not usable with this node's key",
        "is the identity file in use on two machines? Enroll one of them under a name of its own",
    ),
    named(
        NodeDrop::RenewalTooSoon.key(),
        "a node asks this authority for another certificate too soon; it is answered later",
        "is it started again and again, or is its identity in use at two places?",
    ),
    named(
        NodeDrop::RenewalQueueFull.key(),
        "too many nodes ask this authority at once; they ask again by themselves",
        "",
    ),
    named(
        NodeDrop::RenewalFleetFile.key(),
        "this authority cannot read or write the fleet's file",
        FLEET_FILE,
    ),
    named(
        NodeDrop::RenewalUnknownNode.key(),
        "a node asks this authority that the fleet's file does not know",
        "another copy of the file enrolled it: bring that here and `sgc fleet merge` it",
    ),
    named(
        NodeDrop::RenewalRevoked.key(),
        "a node asks this authority whose incarnation is revoked",
        ENROLL_AGAIN,
    ),
    named(NodeDrop::RenewalUnusable.key(), "a node's request for a certificate is not usable", SAME_VERSION),
    named(
        NodeDrop::OperationNotPermitted.key(),
        "a node that is no operator wants to change the fleet",
        "if it may, name it in `operators` of [authority]",
    ),
    counted(
        NodeDrop::ReportNotPermitted.key(),
        "a node that is no observer asks how this one is doing",
        "if it may, enroll it with `--group observers`, or name it in `observers` of [admin]",
    ),
    counted(
        NodeDrop::DirectNotPermitted.key(),
        "a node asks for a direct link that this one does not permit",
        "if it may have one, name it in `direct` of [node]",
    ),
    counted(
        NodeDrop::CandidateRefused.key(),
        "a peer names an address to which no checks go: of its own host, of one network segment, or of a group",
        "",
    ),
    counted(
        NodeDrop::CheckWithheld.key(),
        "no more checks went to addresses of a peer that do not answer",
        "",
    ),
    counted(
        NodeDrop::CheckOverflowed.key(),
        "more checks of addresses arrived than could be handled",
        "is the node busy, or under attack?",
    ),
    counted(
        NodeDrop::DtlsOverflowed.key(),
        "more datagrams of a DTLS link arrived than could be handled; QUIC sends their content again",
        "is the node busy?",
    ),
    counted(
        OperationRefusal::Stale.key(),
        "an operator's request was of an earlier run; it is made again by itself",
        "",
    ),
    counted(
        NodeDrop::OperationRepeated.key(),
        "an operator's request came twice and was carried out once",
        "",
    ),
    named(
        OperationRefusal::Busy.key(),
        "too many operations wait at this authority",
        "try again in a minute",
    ),
    named(OperationRefusal::File.key(), "this authority cannot read or write the fleet's file", FLEET_FILE),
    counted(OperationRefusal::Fleet.key(), "an operation was not possible; the operator was told why", ""),
    named(OperationRefusal::Malformed.key(), "an operator's request cannot be read", SAME_VERSION),
    counted(
        NodeDrop::TypeDiffers.key(),
        "an owner describes a type otherwise than its publishers announce it",
        "build both from one version of the interface package",
    ),
    named(
        NodeDrop::TypeRefused.key(),
        "a description of a type is not what its hash says, or larger than any",
        SAME_VERSION,
    ),
    counted(NodeDrop::TypeNotDescribed.key(), "an owner does not know what a type looks like", DEFINITIONS),
    named(
        NodeDrop::TypesFull.key(),
        "there is no room for more descriptions of types",
        "use fewer types from other nodes at this one",
    ),
    counted(
        NodeDrop::TypesBusy.key(),
        "descriptions of types come faster than they are judged; they are asked for again",
        "",
    ),
    named(
        NodeDrop::TypeFailed.key(),
        "a description of a type could not be judged: a fault in this program",
        "please report it",
    ),
    counted(
        NodeDrop::JsonUnknownType.key(),
        "messages travel as JSON, and what their type looks like is not known here",
        DEFINITIONS,
    ),
    named(
        NodeDrop::JsonRefused.key(),
        "JSON that is not what its type says",
        "build both sides from one version of the package",
    ),
    named(NodeDrop::Decompress.key(), "a compressed message is not what it claims", SAME_VERSION),
    named(NodeDrop::CreateReader.key(), "the local network refused a reader", DDS_LOG),
    named(NodeDrop::CreateWriter.key(), "the local network refused a writer", DDS_LOG),
    counted(NodeDrop::CreateService.key(), "the local network refused an end of a service", DDS_LOG),
    counted(NodeDrop::AnnounceNodes.key(), "the local network could not be told of other nodes", DDS_LOG),
    counted(
        NodeDrop::ShowConsumer.key(),
        "the local network could not be shown a subscriber or client of another node",
        DDS_LOG,
    ),
    counted(
        NodeDrop::ConsumersForbidden.key(),
        "the enclave of this node may not show subscribers and clients of other nodes in the local graph; messages flow all the same",
        "grant it the partition `sgc/shown` in permissions.p7s (docs/how-to/sros2.md)",
    ),
    counted(
        NodeDrop::ConsumersUntold.key(),
        "more subscribers or clients use one interface of another node than its owner is told of",
        "",
    ),
    counted(
        NodeDrop::ConsumersUnshown.key(),
        "more subscribers or clients of other nodes use what is shared here than the local graph shows",
        "",
    ),
    counted(NodeDrop::Frames.key(), "a transform could not be given the prefix of its owner", SAME_VERSION),
    counted(
        CallLoss::Refused.key(),
        "calls were not taken: 1024 of one client, or 8192 or 128 MiB of all, were without an answer",
        "have the client wait for answers; if none come, look at the server",
    ),
    counted(
        CallLoss::OwnerFull.key(),
        "calls were not taken: 4096 calls of one node were under way at the owner",
        "look at the server: it answers too slowly, or not at all",
    ),
    counted(
        CallLoss::ServerGone.key(),
        "the server that was asked is gone: its process ended or was killed, or its network broke",
        "start the server again and call again; what it was asked may have been carried out in part",
    ),
    counted(
        CallLoss::OwnerRestarted.key(),
        "the owner's sgc started anew and no longer knows whether the calls were carried out",
        "call again if that does no harm",
    ),
    counted(
        CallLoss::Withdrawn.key(),
        "the service ended while calls waited: its server stayed away for more than 2 s, its node stopped, or a rule changed",
        "start the server again and call again; `sgc why` on the owner says what it has",
    ),
    counted(CallLoss::ClientGone.key(), "clients ended, or were dropped, before their answer came", ""),
    counted(
        CallLoss::Forgotten.key(),
        "the answer came while the way was broken, and the owner kept it no longer when the way was back",
        "call again if that does no harm",
    ),
    counted(
        CallLoss::TooLarge.key(),
        "a request or an answer is larger than 64 MiB",
        "send it in parts, or as a topic",
    ),
    counted(
        CallLoss::Unheard.key(),
        "the answer came, and DDS did not find the client that had asked",
        "is the client still there, and does DDS match it with this node?",
    ),
    counted(
        CallLoss::Unreadable.key(),
        "a request or reply on the local network does not say to which call it belongs",
        "look for a program of another DDS vendor on that service",
    ),
    counted(
        CallLoss::Unsaid.key(),
        "the owner gave calls up; its sgc is older and does not say why",
        "`sgc why` on the owner",
    ),
    counted(
        NodeDrop::NoLocalPeer.key(),
        "no server, or no client, was there on the local network when something was to be handed to it",
        "calls are handed over again after 5 s while the service is shared",
    ),
    counted(
        NodeDrop::ReplyToNothing.key(),
        "a reply came to a call that nobody waits for any more, or a second one",
        "",
    ),
    counted(NodeDrop::WritePayload.key(), "a message could not be given to the local network", DDS_LOG),
    counted(
        NodeDrop::WriteTimeout.key(),
        "a local subscriber that is to get everything took nothing for too long",
        "is it stopped?",
    ),
    counted(NodeDrop::WriteFailed.key(), "the local network did not take a message", DDS_LOG),
    named(NodeDrop::KeyHash.key(), "a message of a topic with keys is not what it claims", SAME_VERSION),
    named(
        NodeDrop::KeyUnknown.key(),
        "messages of a topic with keys came without the hashes of their keys, at which subscribers of ROS 2 Kilted crash",
        "update `sgc` on the far side; its publishers of that topic should all use Cyclone DDS, or none of them",
    ),
    named(
        NodeDrop::OverRate.key(),
        "a peer sends more than `peer_rate` lets it: best-effort messages are dropped, reliable ones slowed",
        "raise `peer_rate` in [router], or set max_rate or max_bandwidth in the [[share]] on the peer",
    ),
    counted(
        NodeDrop::MdnsCrowded.key(),
        "more nodes announce themselves on the local network than are listened to",
        "",
    ),
    counted(
        NodeDrop::MdnsUnknown.key(),
        "an announcement on the local network is of another version",
        SAME_VERSION,
    ),
    counted(
        NodeDrop::MdnsOverrun.key(),
        "announcements on the local network come faster than they are read",
        "",
    ),
    named(
        NodeDrop::AuditLost.key(),
        "records could not be written into the audit log",
        "is the disk full, or does the directory belong to another user?",
    ),
    counted(
        NodeDrop::AuditSummedUp.key(),
        "records of one peer came too fast for the audit log and stand there as a number",
        "",
    ),
];

/// Refusals of packets and messages of a name.
const PACKETS: &[Refusal] = &[
    counted(DataDrop::NoTree.key(), "nobody asked for it yet, or any more", ""),
    counted(
        DataDrop::WrongWay.key(),
        "it came over a link that the tree does not use",
        "a few when a way changes are no fault",
    ),
    counted(
        DataDrop::HopLimit.key(),
        "it went in a circle, or over too many routers",
        "look at the links between the routers",
    ),
    counted(DataDrop::NoSuchSink.key(), "it was for a subscriber that is gone", ""),
    counted(
        DataDrop::Stalled.key(),
        "a reliable consumer took nothing for seconds",
        "is a subscriber stopped? A best-effort one would hold nothing up",
    ),
    counted(
        DataDrop::Stale.key(),
        "newer messages took the place of what could not be sent in time",
        "the link is thinner than the topic: set max_rate, max_bandwidth or a `priority` in the [[share]]",
    ),
    counted(
        DataDrop::LinkClosed.key(),
        "a link ended with something under way",
        "reliable topics ask for it again by themselves",
    ),
    counted(DataDrop::Malformed.key(), "it could not be read", SAME_VERSION),
    counted(DataDrop::UnknownLabel.key(), "it could not be read", SAME_VERSION),
    counted(
        DataDrop::NotGranted.key(),
        "there was no key for it yet",
        "a few when a topic begins are no fault",
    ),
    counted(
        DataDrop::SourceExhausted.key(),
        "a publisher has sent 2^48 messages, which is all that its source has numbers for",
        "start the publisher again",
    ),
    counted(
        DataDrop::Sink.key(),
        "it was refused when it was opened: a replay, a broken seal or signature, or lost for good",
        "`sgc status` counts the kinds under Drops",
    ),
    counted(DataDrop::NoWriter.key(), "no local writer was there for it", DDS_LOG),
    counted(DataDrop::TooLarge.key(), "larger than 64 MiB", "publish smaller messages"),
    counted(
        DataDrop::Thinned.key(),
        "more came than max_rate or max_bandwidth let on",
        "raise the limit if that is not meant",
    ),
    counted(
        DataDrop::TooOld.key(),
        "older than max_age",
        "raise max_age, or compare the clocks of the hosts",
    ),
    counted(
        DataDrop::LateCommand.key(),
        "a command of a topic with `deadman` came late",
        "a queue on the way, or the publisher's clock was set back: `sgc topic resume` measures anew",
    ),
    counted(
        DataDrop::UnjudgedCommand.key(),
        "a command of a topic with `deadman` whose lateness is not known: it has no time stamp, or its publisher is new",
        "",
    ),
    counted(
        DataDrop::NotResumed.key(),
        "`deadman` stopped the robot, and the publisher of the commands has not let go since",
        "let go for the time of `after`, and begin again; with resume = \"manual\": `sgc topic resume`",
    ),
    counted(DataDrop::Repeated.key(), "a publisher's history came once more after its node started anew", ""),
    counted(
        DataDrop::Overrun.key(),
        "a local publisher writes faster than the link takes it, and does not keep all its messages (`KEEP_ALL`)",
        "set max_rate or max_bandwidth in the [[share]], or have the program publish less",
    ),
    counted(
        DataDrop::NoDefinition.key(),
        "its messages travel as JSON, and what its type looks like was not known",
        DEFINITIONS,
    ),
    counted(
        DataDrop::NotConverted.key(),
        "a publisher wrote something else than its type says, so that it could not become JSON",
        "build the publisher and the definitions that this node finds from one version of the package",
    ),
];

/// Packets that a sink refuses (`SinkDrop` of `sgc-endpoint`), and messages that are lost for good.
const SINK: &[Refusal] = &[
    counted("sink_suite", "a packet is sealed in another suite than its owner granted", SAME_VERSION),
    counted(
        "sink_epoch",
        "a packet is sealed with a key that this node has retired",
        "a few after a key change are no fault",
    ),
    counted("sink_length", "a packet is longer or shorter than its header says", TAMPERED),
    counted(
        "sink_forged",
        "a seal does not verify: the packet was altered, or its sender lacks the key",
        TAMPERED,
    ),
    counted("sink_trailer", "the bytes behind the seal of a packet contradict each other", TAMPERED),
    counted(
        "sink_signature",
        "the publisher did not sign the packet: it was altered, or another member made it",
        "if the count grows, find out which member of the topic or which router does this",
    ),
    counted(
        "sink_no_mac",
        "a packet has no MAC for this node: its message began before its source knew of this subscriber",
        "a few when a subscriber starts are no fault, of a large message many; if the count grows, find out which router alters \
         packets",
    ),
    counted(
        "sink_mac",
        "the MAC for this node does not verify: the packet was altered, or another member made it",
        "if the count grows, find out which member of the topic or which router does this",
    ),
    counted(
        "sink_not_for_us",
        "a packet is for another subscriber, or for an earlier request of this one",
        "",
    ),
    counted(
        "sink_unknown_source",
        "the owner does not announce the publisher of a packet",
        "a few when a publisher starts or ends are no fault",
    ),
    counted(
        "sink_unknown_epoch",
        "no grant brought the key of a packet",
        "a few after a key change are no fault; else look for refusals at the owner with `sgc why TOPIC` there",
    ),
    counted(
        "sink_parking_full",
        "too many packets wait for a grant; the oldest went",
        "a few when a topic begins are no fault; else look at the way to the owner with `sgc why TOPIC`",
    ),
    counted("sink_below_floor", "a message is older than what this subscriber asked for", ""),
    counted(
        "sink_replayed",
        "a message was delivered before, or is too old to tell",
        "a few when a route changes are no fault; many are a replay by somebody on the way",
    ),
    counted("sink_late", "a newer message of a best-effort publisher was delivered before", ""),
    counted("sink_duplicate_fragment", "a part of a message came twice", ""),
    counted("sink_inconsistent", "a part of a message contradicts another part", SAME_VERSION),
    counted("sink_head", "the head of a message cannot be read", SAME_VERSION),
    counted("sink_awaiting_history", "the history that this subscriber asked for contains the message", ""),
    counted(
        "sink_partials_full",
        "there is no room for more messages of which parts are missing",
        "many large messages lose packets: limit the topic with max_rate or max_bandwidth in the [[share]]",
    ),
    counted(
        NodeDrop::SinkLost.key(),
        "a publisher's node no longer keeps messages that were lost on the way",
        "the interruption was longer than what the node keeps; is a link too thin for the topic?",
    ),
];

/// Refusals of peers that requested a link.
pub(crate) const DOOR: &[Refusal] = &[
    named(
        RefusalKind::NoCertificate.label(),
        "it showed no certificate",
        "does that node have an identity, and is it an sgc at all?",
    ),
    named(
        RefusalKind::OtherCa.label(),
        "its certificate is of a CA that is not trusted here",
        "if its fleet may link here, name the CA in a [[partner]], or in `accept` of [router]",
    ),
    named(
        RefusalKind::NotAdmitted.label(),
        "its certificate is of a CA that is trusted here, but whose nodes may not link",
        "if they may, add the CA to `accept` in [router]",
    ),
    named(
        RefusalKind::Expired.label(),
        "its certificate is over",
        "`sgc fleet renew` it there, and compare the clocks",
    ),
    named(RefusalKind::NotYetValid.label(), "its certificate has not begun by the clock here", SET_CLOCK),
    named(
        RefusalKind::Revoked.label(),
        "its certificate, or its node's incarnation, is revoked",
        ENROLL_AGAIN,
    ),
    named(
        RefusalKind::BadCertificate.label(),
        "its certificate is altered, malformed or not for a node",
        "enroll that node again",
    ),
    named(RefusalKind::Version.label(), "it speaks another version, or another protocol", SAME_VERSION),
    named(
        RefusalKind::KeyExchange.label(),
        "it offers no key exchange that is accepted here",
        "one of the two requires post-quantum X25519MLKEM768: upgrade the other, or turn `post_quantum` off in both fleets",
    ),
    named(
        RefusalKind::HandshakeTooLong.label(),
        "its handshake is longer than any that is read",
        "is it an sgc? Certificates have room for many groups, but not for any number",
    ),
    named(
        RefusalKind::BadGreeting.label(),
        "it connected and said something that is no greeting",
        SAME_VERSION,
    ),
    named(
        RefusalKind::NoLane.label(),
        "it wants a link by `tls://` where only lanes of QUIC links are taken",
        "dial this node by `quic://`, or let it listen on a `tls://` address, too",
    ),
    named(
        RefusalKind::TimedOut.label(),
        "it did not finish in time",
        "a few are scanners, or nodes on bad networks; many from one address are somebody who holds places",
    ),
    named(
        RefusalKind::TooMany.label(),
        "too many were connecting at once: the heaviest address gave way",
        "they try again by themselves; if it goes on, keep the addresses that the log names out by a firewall",
    ),
    named(
        RefusalKind::TooManyFromAddress.label(),
        "too many were connecting at once from its address (IPv6: its /64)",
        "if many nodes share that address, let them start one after the other or link through a router of their own; else keep \
         it out by a firewall",
    ),
    counted(RefusalKind::ByPeer.label(), "it refused this node, or gave up", "see the log on the other side"),
    counted(RefusalKind::Transport.label(), "the connection broke while it was made", ""),
];

/// Refusals of programs at the gateway.
pub(crate) const GATEWAY: &[Refusal] = &[
    named(
        ClientRefusal::TooManyClients(Pool::Total).key(),
        "all places for clients are taken",
        RAISE_CLIENTS,
    ),
    named(
        ClientRefusal::TooManyClients(Pool::Remote).key(),
        "all places for clients of other hosts are taken",
        RAISE_CLIENTS,
    ),
    named(
        ClientRefusal::TooManyClients(Pool::Credential).key(),
        "one token, certificate or address has all the places that one may have",
        RAISE_CLIENTS,
    ),
    named(
        ClientRefusal::TooMuch(Pool::Credential).key(),
        "clients with one token, certificate or address have all the subscriptions, calls or memory that these may have",
        FEWER,
    ),
    named(
        ClientRefusal::TooMuch(Pool::Remote).key(),
        "clients of other hosts have all the subscriptions, calls or memory that these may have",
        FEWER,
    ),
    named(
        ClientRefusal::TooMuch(Pool::Total).key(),
        "the clients have all the subscriptions, calls or memory that there is",
        FEWER,
    ),
    named(ClientRefusal::TooManyHandshakes.key(), "too many were connecting at once", SLOW_CLIENTS),
    named(
        ClientRefusal::HandshakeGaveWay.key(),
        "too many were connecting at once, and it was the oldest of the heaviest",
        SLOW_CLIENTS,
    ),
    named(ClientRefusal::HandshakeTooSlow.key(), "it did not finish in time", SLOW_CLIENTS),
    named(
        ClientRefusal::NotAdmitted.key(),
        "it shows no token, certificate or origin that holds here, or tries too often",
        "make a token (`sgc token access create`), or name it in [gateway]; the log says at DEBUG why",
    ),
    named(
        "no longer admitted",
        "its token or certificate ended or was revoked while it was connected",
        "make a new token (`sgc token access create`) if it may come back",
    ),
    counted(
        "no WebSocket",
        "it is no WebSocket client, or asks for an unknown subprotocol",
        "does it use the right port?",
    ),
    counted(
        "TLS failed",
        "it speaks no TLS that is accepted",
        "does it use wss:// or https://, and trust the certificate?",
    ),
    named(
        "certificate does not hold",
        "its certificate is over, revoked or of a CA that is not trusted",
        ENROLL_AGAIN,
    ),
];

/// Refusals of a join by an owner, or by a router on the path, with the remedy at the owner and the one at the node
/// that asked.
const JOINS: &[(Answer, &str, &str)] = &[
    // The walk itself names the entry to add to `to`.
    (Answer::Owner(RefuseReason::NotPermitted), "", ""),
    (Answer::Owner(RefuseReason::NotShared), "it asks for what is shared no more; it will hear of that", ""),
    (Answer::Owner(RefuseReason::NotVerified), SAME_VERSION, SAME_VERSION),
    (
        Answer::Owner(RefuseReason::RoleNotOffered),
        "nobody may publish on it: name who may in `publish` of this [[share]]",
        "on the owner: name this node in `publish` of its [[share]]",
    ),
    (
        Answer::Owner(RefuseReason::Limit),
        "a topic has room for 4096 subscribers, of which one node may be 16: end those that are not needed",
        "the owner has no place for another subscriber of it, or of this node: end those that are not needed",
    ),
    (Answer::Owner(RefuseReason::Clock), SET_CLOCK, SET_CLOCK),
    (
        Answer::Owner(RefuseReason::Expired),
        "`sgc fleet renew` it, and compare the clocks",
        "`sgc fleet renew` this node, and compare the clocks",
    ),
    (Answer::Owner(RefuseReason::Revoked), ENROLL_AGAIN, ENROLL_AGAIN),
    (
        Answer::Router(RejectReason::NoRoute),
        "",
        "is the owner running, and linked to these routers? `sgc status` there",
    ),
    (Answer::Router(RejectReason::NotVerified), "", SAME_VERSION),
    (
        Answer::Router(RejectReason::Limit),
        "",
        "a router on the way has no place for more branches or requests of this node: use fewer topics at it; `sgc status` at the \
         router counts it (`limit`)",
    ),
    (Answer::Router(RejectReason::TimedOut), "", "is the owner running? It is asked again by itself"),
    (Answer::Router(RejectReason::RouteLost), "", "the way is looked for again by itself"),
    (Answer::Router(RejectReason::Clock), "", SET_CLOCK),
    (Answer::Router(RejectReason::Expired), "", "`sgc fleet renew` this node, and compare the clocks"),
    (Answer::Router(RejectReason::Revoked), "", ENROLL_AGAIN),
];

/// A refusal of a topic, by an owner or a router, with its reason.
#[derive(Clone, Copy, Debug)]
enum Answer {
    Owner(RefuseReason),
    Router(RejectReason),
}

impl Answer {
    /// Returns `true` if nodes of this version word the refusal like this.
    fn is_said_as(self, text: &str) -> bool {
        match self {
            Self::Owner(reason) => reason.to_string() == text,
            Self::Router(reason) => reason.to_string() == text,
        }
    }
}

/// Returns the remedy at the owner that refused a topic, unless its policy is the reason.
pub(crate) fn fix_at_owner(why: &str) -> Option<&'static str> {
    fixes(why).map(|(owner, _)| owner).filter(|fix| !fix.is_empty())
}

/// Returns the remedy at the node to which a topic is refused, unless the owner's policy is the reason.
pub(crate) fn fix_at_asker(why: &str) -> Option<&'static str> {
    fixes(why).map(|(_, asker)| asker).filter(|fix| !fix.is_empty())
}

fn fixes(why: &str) -> Option<(&'static str, &'static str)> {
    JOINS.iter().find(|(answer, ..)| answer.is_said_as(why)).map(|(_, owner, asker)| (*owner, *asker))
}

/// The words of a failure that the look-up of the router's name caused.
const LOOKUPS: [&str; 3] =
    ["cannot be looked up", "has no address", "the system's DNS servers are not known"];

/// Returns the remedy for a link that could not be dialled for lack of an address, or that either end refused, by the
/// reason at the end of `why`.
pub(crate) fn fix_of_link(why: &str) -> Option<&'static str> {
    if LOOKUPS.iter().any(|said| why.contains(said)) {
        return Some(
            "is the name spelt right, and does `getent hosts NAME` find it on this machine? If nothing answers, look at the network and at \
             the DNS servers: `resolver` in [node], or /etc/resolv.conf. The node asks again by itself",
        );
    }
    let other_fleet = "`sgc check -c FILE` says of which fleet this node's identity is. If it is the wrong one, bring the right file here; if \
         the router is of another fleet on purpose, name this fleet's CA in `accept` there, and its CA in `trust` of [node] here";
    let fixes = [
        (CertError::UnknownIssuer.to_string(), other_fleet),
        (PeerRefusal::OtherCa.to_string(), other_fleet),
        (
            PeerRefusal::NotAdmitted.to_string(),
            "give the router's keeper the file that `sgc fleet ca` prints",
        ),
        (
            PeerRefusal::Expired.to_string(),
            "`sgc check -c FILE` says how long this node's identity holds. If it is over, `sgc fleet renew` the node and bring the file \
             here; if not, set the clock that is wrong",
        ),
        (PeerRefusal::Revoked.to_string(), ENROLL_AGAIN),
    ];
    fixes.into_iter().find(|(said, _)| why.ends_with(said.as_str())).map(|(_, fix)| fix)
}

/// Returns the explanation of a drop of packets or messages.
pub(crate) fn packet_drop(key: &str) -> Option<&'static Refusal> {
    find(PACKETS, key)
}

/// Returns the meaning and the remedy of a reason for lost calls.
pub(crate) fn call_loss(key: &str) -> Option<(&'static str, &'static str)> {
    if key == CallLoss::Overrun.key() {
        let means = "requests or replies came faster than they were taken, more than may wait";
        return Some((means, "have the programs on the local network make fewer calls at a time"));
    }
    find(CONTROL, key).map(|refusal| (refusal.means, refusal.fix))
}

/// Returns the meaning of a row of `sgc status`, Drops.
pub fn drop_meaning(row: &str) -> String {
    let key = row.split(" from ").next().unwrap_or(row);
    let all = [CONTROL, PACKETS, SINK].map(|table| find(table, key));
    let mut all: Vec<_> = all.into_iter().flatten().map(|refusal| refusal.means).collect();
    all.dedup();
    all.join("; or ")
}

/// Returns the meaning of a row of `sgc status`, Refused peers.
pub(crate) fn door_meaning(row: &str) -> String {
    find(DOOR, row).map_or_else(String::new, |refusal| refusal.means.to_owned())
}

/// Returns the meaning of a row of refused clients of the gateway.
pub(crate) fn gateway_meaning(row: &str) -> String {
    find(GATEWAY, row).map_or_else(String::new, |refusal| refusal.means.to_owned())
}

fn find(table: &'static [Refusal], key: &str) -> Option<&'static Refusal> {
    table.iter().find(|refusal| refusal.key == key)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::panic)]

    use std::collections::BTreeSet;

    use super::*;
    use crate::tests::scenarios::{REFUSED_WITH_REMEDY, REJECTED};

    fn keys(table: &[Refusal]) -> BTreeSet<String> {
        table.iter().map(|refusal| refusal.key.to_owned()).collect()
    }

    #[test]
    fn every_refusal_of_a_link_is_explained_and_no_other() {
        let kinds = RefusalKind::ALL.into_iter().map(|kind| kind.label().to_owned());
        assert_eq!(kinds.collect::<BTreeSet<_>>(), keys(DOOR));
    }

    #[test]
    fn every_drop_of_data_path_is_explained_and_no_other() {
        let keys_of_code = DataDrop::ALL.into_iter().map(|reason| reason.key().to_owned());
        assert_eq!(keys_of_code.collect::<BTreeSet<_>>(), keys(PACKETS));
    }

    #[test]
    fn every_refusal_of_a_client_is_explained_and_no_other() {
        let keys_of_code = ClientRefusal::ALL.into_iter().map(|why| why.key().to_owned());
        assert_eq!(keys_of_code.collect::<BTreeSet<_>>(), keys(GATEWAY));
    }

    #[test]
    fn every_reason_for_lost_calls_is_explained() {
        for loss in CallLoss::ALL {
            assert!(call_loss(loss.key()).is_some(), "{loss:?}");
        }
    }

    #[test]
    fn every_refused_join_has_remedy() {
        for reason in REFUSED_WITH_REMEDY {
            let why = reason.to_string();
            assert!(fix_at_owner(&why).is_some() && fix_at_asker(&why).is_some(), "{why}");
        }
        for reason in REJECTED {
            assert!(fix_at_asker(&reason.to_string()).is_some(), "{reason}");
        }
        // The walk names the entry to add to the policy.
        assert_eq!(fix_at_owner(&RefuseReason::NotPermitted.to_string()), None);
    }
}
