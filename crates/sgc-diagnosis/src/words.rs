//! The English of `sgc why`: renders findings and the advice how to mend them.

use std::collections::BTreeMap;
use std::fmt;

use serde::ser::{Serialize, SerializeStruct as _, Serializer};
use sgc_node::graph::Interface;
use sgc_process::output;
use sgc_process::style::{Line, Tone, Toned};

use crate::finding::{
    Direction, Finding, Hop, LinkFinding, LocalFinding, NameFinding, NodeFinding, QosMismatch, Reach,
    Refused, RefusedSide, RuleFinding, ShareFinding, TrafficFinding, UnansweredCalls, UseFinding,
};
use crate::near::hint;
use crate::refusals;
use crate::step::{Step, Verdict};

const DDS_LOG: &str = "look into the node's log for what DDS said";
const LOG_AND_STATUS: &str = "look into the node's log, and at `sgc status`";
const ASK_AGAIN: &str = "wait a few seconds and ask again";
const ASK_AGAIN_OR_SILENT: &str =
    "wait a few seconds and ask again; if it stays, see `sgc status` for links that are silent";
const ASK_AGAIN_OR_DDS_LOG: &str =
    "wait a few seconds and ask again; then look into the node's log for what DDS said";
const ONE_VERSION: &str = "build both sides from one version of the interface package";
const FOR_ANOTHER_REASON: &str = "for another reason";

impl Step {
    /// Returns the finding.
    pub fn found(&self) -> String {
        self.finding.to_string()
    }

    /// Returns the advice how to mend it.
    pub fn fix(&self) -> Option<String> {
        self.finding.fix().filter(|fix| !fix.is_empty())
    }

    /// Returns the lines of `sgc why`: the finding behind a mark, and the advice.
    pub fn lines(&self) -> Vec<Line> {
        let (mark, tone) = match self.verdict {
            Verdict::Fine => ("✓", Tone::Good),
            Verdict::Wrong => ("✗", Tone::Bad),
            Verdict::Unknown => ("?", Tone::Attention),
        };
        let found = Line::new([Toned::new(tone, mark), format!(" {}", self.found()).into()]);
        let fix = self.fix().map(|fix| Line::from(format!("    {fix}")));
        [Some(found), fix].into_iter().flatten().map(Line::cleaned).collect()
    }
}

impl Serialize for Step {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let fix = self.fix();
        let mut step = serializer.serialize_struct("Step", 2 + usize::from(fix.is_some()))?;
        step.serialize_field("verdict", &self.verdict)?;
        step.serialize_field("found", &self.found())?;
        if let Some(fix) = fix {
            step.serialize_field("fix", &fix)?;
        }
        step.end()
    }
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Node(node) => node.fmt(f),
            Self::Refused(refused) => refused.fmt(f),
            Self::Unanswered(calls) => calls.fmt(f),
            Self::Link(link) => link.fmt(f),
            Self::Rule(rule) => rule.fmt(f),
            Self::Share(share) => share.fmt(f),
            Self::Use(used) => used.fmt(f),
            Self::Local(local) => local.fmt(f),
            Self::Name(name) => name.fmt(f),
            Self::Traffic(traffic) => traffic.fmt(f),
            Self::FarHalf { node, .. } => {
                write!(f, "all is well up to here; the other half of the way is known to {node}")
            }
        }
    }
}

impl Finding {
    /// Returns the advice. It may be empty.
    fn fix(&self) -> Option<String> {
        match self {
            Self::Node(node) => node.fix(),
            Self::Refused(refused) => Some(refused.counter.fix.to_owned()),
            Self::Unanswered(calls) => Some(meaning_of_loss(&calls.reason).1.to_owned()),
            Self::Link(link) => link.fix().map(str::to_owned),
            Self::Rule(rule) => Some(rule.fix()),
            Self::Share(share) => share.fix(),
            Self::Use(used) => used.fix(),
            Self::Local(local) => local.fix(),
            Self::Name(name) => name.fix().map(str::to_owned),
            Self::Traffic(traffic) => traffic.fix().map(str::to_owned),
            Self::FarHalf { topic, .. } => Some(format!("run `sgc why {topic}` there")),
        }
    }
}

impl fmt::Display for NodeFinding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Absent { error } => f.write_str(error),
            Self::Runs { node, version } => write!(f, "{node} runs, sgc {version}"),
            Self::Alert(alert) => alert.fmt(f),
            Self::RelativeName { topic } => {
                write!(f, "{topic} is not a full ROS 2 name: it begins with no /")
            }
            Self::RouterAlone => f.write_str(
                "this node is a router alone: it touches no ROS 2 network and knows topics by their 256-bit names only",
            ),
        }
    }
}

impl NodeFinding {
    fn fix(&self) -> Option<String> {
        Some(match self {
            Self::Absent { .. } => {
                "start it with `sgc run -c FILE`; if it runs elsewhere, ask there, or as the user that runs it".into()
            }
            Self::Runs { .. } => return None,
            Self::Alert(alert) => alert.fix().into(),
            Self::RelativeName { topic } => format!("ask for /{topic}"),
            Self::RouterAlone => {
                "ask the nodes at both ends, or here `sgc why --name HEX`, with the name that `sgc status` shows there".into()
            }
        })
    }
}

impl fmt::Display for Refused {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let what = match self.side {
            RefusedSide::Frames => "refused here",
            RefusedSide::Peers => "peers refused a link",
            RefusedSide::Programs => "programs refused at the gateway",
        };
        let by: Vec<_> = self.by.iter().map(|(count, hop)| format!("{count} over {hop}")).collect();
        let by = if by.is_empty() { String::new() } else { format!(", of these {}", by.join(", ")) };
        write!(f, "{what}: {} {}{by} ({})", self.counter.key, self.count, self.counter.means)
    }
}

/// Returns the meaning and the remedy of a reason for lost calls.
fn meaning_of_loss(reason: &str) -> (&'static str, &'static str) {
    refusals::call_loss(reason).unwrap_or((FOR_ANOTHER_REASON, ""))
}

impl fmt::Display for UnansweredCalls {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let side =
            if self.is_served { "calls of others to the server here" } else { "calls of clients here" };
        let by: Vec<_> = self.by.iter().map(|(caller, count)| format!("{count} of {caller}")).collect();
        let by = if by.is_empty() { String::new() } else { format!(", among them {}", by.join(", ")) };
        let (means, _) = meaning_of_loss(&self.reason);
        write!(
            f,
            "{}: {} {side} got no answer{by}, the last {} s ago: {} ({means})",
            self.service, self.count, self.last_s, self.reason
        )
    }
}

impl fmt::Display for LinkFinding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Linked(hop) => write!(f, "linked: {hop}"),
            Self::Silent(hop) => write!(f, "{hop} is silent: something should come over it and does not"),
            Self::NoRouter => f.write_str("no link is up, and no router is configured"),
            Self::Unlinked { router, state, failure } => {
                write!(f, "no link is up; {router} is {state}")?;
                failure.iter().try_for_each(|why| write!(f, ": {why}"))
            }
        }
    }
}

impl LinkFinding {
    fn fix(&self) -> Option<&'static str> {
        Some(match self {
            Self::Linked(_) => return None,
            Self::Silent(_) => {
                "is the peer still there, and does the network between carry UDP? Another way is taken as soon as there is one"
            }
            Self::NoRouter => "name one: `routers` in [node], or `sgc run --router URL`",
            Self::Unlinked { failure, .. } => failure.as_deref().and_then(refusals::fix_of_link).unwrap_or(
                "is the router running and in reach? Where UDP is blocked, a URL with tls:// or wss:// passes \
                 (docs/explanation/transports.md)",
            ),
        })
    }
}

impl fmt::Display for RuleFinding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Unused { owner, topic, .. } => write!(
                f,
                "{} shares {topic} with this node, but no [[use]] asks for it",
                owner.as_deref().unwrap_or("another node")
            ),
            Self::Unshared { count, kind, meant, .. } => {
                write!(f, "{count} local {}s have it, but no rule names it{}", provider(*kind), hint(meant))
            }
            Self::Unbrought { count, kind, meant, .. } => write!(
                f,
                "{count} local {}s want it, but no rule brings it here{}",
                consumer(*kind),
                hint(meant)
            ),
            Self::Absent { topic, pattern: Some(pattern), meant } => write!(
                f,
                "nobody on the local network has {topic}, which the [[share]] of {pattern} would cover{}",
                hint(meant)
            ),
            Self::Absent { topic, pattern: None, meant } => write!(
                f,
                "nobody on the local network has {topic}, no rule names it, and no followed node lists it{}",
                hint(meant)
            ),
        }
    }
}

impl RuleFinding {
    fn fix(&self) -> String {
        match self {
            Self::Unused { owner, kind, topic, node, needs_publish } => {
                let owner = owner.as_deref().unwrap_or("another node");
                let line = if *needs_publish { ", publish = true" } else { "" };
                format!(
                    "add [[use]] from = \"{owner}\", {kind} = \"{topic}\"{line} to the file of {node}, then `sgc reload`"
                )
            }
            Self::Unshared { kind, topic, node, .. } => format!(
                "to share it, add [[share]] {kind} = \"{topic}\", to = [\"NODE\"] to the file of {node}, then `sgc reload`"
            ),
            Self::Unbrought { kind, topic, node, .. } => format!(
                "add [[use]] from = \"OWNER\", {kind} = \"{topic}\" to the file of {node}; the owner has to share it with \
                 {node}"
            ),
            Self::Absent { .. } => {
                "start what publishes it; if it runs, compare `domain_id` and `discovery_range` in [ros] with its ROS_DOMAIN_ID and \
                 ROS_AUTOMATIC_DISCOVERY_RANGE, or `router` in [ros.zenoh] with its Zenoh router; `sgc topic list` shows what there is"
                    .into()
            }
        }
    }
}

impl fmt::Display for ShareFinding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::TypeDiffers { kind, topic, wanted, types } => write!(
                f,
                "the [[share]] of {topic} says type {wanted}, and the {}s have {}",
                provider(*kind),
                types.join(", ")
            ),
            Self::Covered { to } => write!(f, "a [[share]] covers it, for {}", whom(*to)),
            Self::Misspelt { name, meant, .. } => write!(
                f,
                "the [[share]] names \"{name}\", which nobody here is called; \"{meant}\" is here"
            ),
            Self::Unheard { names, node } => {
                let names: Vec<_> = names.iter().map(|name| format!("\"{name}\"")).collect();
                write!(
                    f,
                    "the [[share]] names {}, and no member of that name has been heard of since {node} started; `sgc fleet list` \
                     shows how names are spelt",
                    names.join(", ")
                )
            }
            Self::Idle { topic, problem } => {
                let problem = problem.as_deref().unwrap_or("nothing of it runs");
                write!(f, "{topic} is covered by a rule, but not shared: {problem}")
            }
            Self::Refused { node, reason } => write!(f, "{node} asked for it and was refused: {reason}"),
            Self::Unasked { .. } => f.write_str("nobody asked for it"),
            Self::Granted { to, refused } => {
                write!(f, "granted to {}", to.join(", "))?;
                refused.iter().try_for_each(|(node, reason)| write!(f, "; {node} was refused: {reason}"))
            }
            Self::NoBranch => f.write_str(
                "granted, but no branch leads away from this node: the way broke and is being looked for",
            ),
            Self::Leaves { over } => write!(f, "it leaves over {}", listed(over)),
            Self::Direct { to } => write!(f, "directly to {}: no router stands in between", to.join(", ")),
            Self::Relayed { to, reason } => {
                write!(f, "over a router, since there is no direct link to {}: {reason}", to.join(", "))
            }
            Self::DefinitionsDiffer { type_name, here, there, node } => write!(
                f,
                "the definitions of {type_name} differ: {} here, {} at {node}",
                short_hash(here),
                short_hash(there)
            ),
            Self::NoCaller => f.write_str(
                "granted, but nothing on the local network calls the server for others: DDS refused it, or it is being made",
            ),
            Self::Called => f.write_str("calls of others are put to the local server"),
            Self::NotRead => f.write_str(
                "the local publishers are not read, though somebody has it: the local network refused a reader",
            ),
            Self::NoMessage { .. } => {
                f.write_str("no message has come from the local publishers since somebody asked for it")
            }
            Self::Published { messages } => write!(f, "{messages} messages were published to the far side"),
            Self::Wished { interval_us, bits_per_s } => {
                let rate = |us: u64| (1e9 / us.max(1) as f64).round() / 1e3;
                let rate = interval_us.map(|us| format!("{} messages a second", rate(us)));
                let bandwidth = bits_per_s.map(|bits| format!("{bits} bit/s"));
                let most: Vec<_> = rate.into_iter().chain(bandwidth).collect();
                write!(f, "no more than {} is sent, because no subscriber wants more", most.join(" and "))
            }
            Self::Written { messages } => {
                write!(f, "{messages} messages of others were given to the local network")
            }
        }
    }
}

impl ShareFinding {
    fn fix(&self) -> Option<String> {
        Some(match self {
            Self::TypeDiffers { .. } => "change `type` in the [[share]], or leave it out".into(),
            Self::Misspelt { meant, node, .. } => {
                format!("if \"{meant}\" is meant, correct it in the file of {node}, then `sgc reload`")
            }
            Self::Idle { .. } => LOG_AND_STATUS.into(),
            Self::Refused { node, reason } => refusals::fix_at_owner(reason).map_or_else(
                || {
                    format!(
                        "if {node} may have it, add it to `to` of this [[share]] (`publish`, if it is to publish), then \
                         `sgc reload`; `sgc policy test` says who may. A node of another fleet needs a token (`sgc \
                         token share create`)"
                    )
                },
                str::to_owned,
            ),
            Self::Unasked { kind, topic, node } => format!(
                "on the other node: [[use]] from = \"{node}\", {kind} = \"{topic}\"; if it is there, run `sgc why {topic}` \
                 there"
            ),
            Self::Relayed { reason, .. } => reason.fix().into(),
            Self::NoBranch => ASK_AGAIN_OR_SILENT.into(),
            Self::DefinitionsDiffer { .. } => ONE_VERSION.into(),
            Self::NoCaller => ASK_AGAIN_OR_DDS_LOG.into(),
            Self::NotRead => DDS_LOG.into(),
            Self::NoMessage { topic } => format!("`sgc topic hz {topic}` shows whether they publish"),
            Self::Covered { .. }
            | Self::Unheard { .. }
            | Self::Granted { .. }
            | Self::Leaves { .. }
            | Self::Direct { .. }
            | Self::Called
            | Self::Published { .. }
            | Self::Wished { .. }
            | Self::Written { .. } => return None,
        })
    }
}

impl fmt::Display for UseFinding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Rule { publishes, topic, owner } => {
                let wish = if *publishes { "publishes on" } else { "brings" };
                write!(f, "a [[use]] {wish} {topic} of {owner}")
            }
            Self::NoCatalogue { owner, state, reach, meant, .. } => {
                let state = state.as_deref().unwrap_or("has not said yet what it shares");
                let why = match reach {
                    Reach::Refused { .. } => {
                        "it is in reach and refuses this node: are both of one fleet, and is neither revoked?"
                    }
                    Reach::Asked { .. } => "it is in reach and was asked; it has not answered",
                    Reach::Linked => "it is linked to this node, and announces nothing that it shares",
                    Reach::Unknown => {
                        "nobody in reach knows it: is its node running, and linked to the same routers? Is its name spelt right?"
                    }
                };
                write!(f, "{owner} {state}: {why}")?;
                meant.iter().try_for_each(|meant| write!(f, " \"{meant}\" is here"))
            }
            Self::TokenRefused { owner, reason } => write!(f, "{owner} refuses the token: {reason}"),
            Self::TokenUnanswered { owner } => write!(
                f,
                "{owner} has not granted what the token is for: nobody in reach knows the name, or it was not answered"
            ),
            Self::TypeDiffers { owner, topic, shared, wanted } => {
                write!(f, "{owner} shares {topic} as {shared}, and the [[use]] asks for {wanted}")
            }
            Self::KindDiffers { owner, topic, shared, wanted } => {
                write!(f, "{owner} shares {topic} as a {shared}, and the [[use]] asks for a {wanted}")
            }
            Self::MayNotPublish { owner, topic, node } => {
                write!(f, "{owner} shares {topic} with {node}, but does not let it publish")
            }
            Self::MayNotSubscribe { owner, topic, node } => {
                write!(f, "{owner} lets {node} publish on {topic}, but not subscribe")
            }
            Self::Idle { owner, topic, problem } => {
                let problem = problem.as_deref().unwrap_or("see the log");
                write!(f, "{owner} lists {topic}, but nothing of it runs here: {problem}")
            }
            Self::NotForWildcards { owner, topic, node, .. } => {
                write!(f, "{owner} is in reach and does not share {topic} with {node}")
            }
            Self::OwnerRevoked { owner } => write!(f, "the fleet of {owner} has revoked it"),
            Self::NotShared { owner, topic, node, meant } => {
                write!(f, "{owner} is in reach and does not share {topic} with {node}{}", hint(meant))
            }
            Self::Listed { owner, node } => write!(f, "{owner} lists it for {node}"),
            Self::Refused { owner, reason, .. } => write!(f, "{owner} refuses it: {reason}"),
            Self::NoRoute { owner } => write!(f, "{owner} listed it, but no way leads to it now"),
            Self::Unanswered { owner } => write!(f, "asked {owner} for it; the answer is not here yet"),
            Self::Granted { owner, type_name } => write!(f, "{owner} granted it [{type_name}]"),
            Self::Route { owner, next, rtt_us } => {
                write!(f, "the way to {owner}: {next}, {} round trip", output::millis((*rtt_us).into()))
            }
            Self::Direct { owner } => write!(f, "directly: no router stands between this node and {owner}"),
            Self::NotOverDirect { owner } => write!(
                f,
                "over a router, although a direct link to {owner} is up: that is faster, or other nodes get it over the \
                 router as well, and it leaves {owner} once"
            ),
            Self::Relayed { owner, reason } => {
                write!(f, "over a router, since there is no direct link to {owner}: {reason}")
            }
            Self::NoBranch => {
                f.write_str("granted, but no branch leads here: the way broke and is being looked for")
            }
            Self::NoServer => f.write_str(
                "granted, but nothing on the local network answers for it: DDS refused a server, or it is being made",
            ),
            Self::Answered { owner } => write!(f, "local clients are answered for {owner}"),
            Self::NoMessage { owner, .. } => write!(f, "nothing has come from {owner} yet"),
            Self::Received { messages, last_s, age } => {
                write!(f, "{messages} messages were given to the local network")?;
                match last_s {
                    Some(0) => f.write_str(", the last one less than a second ago"),
                    Some(s) => write!(f, ", the last one {s} s ago"),
                    None => Ok(()),
                }?;
                let Some((age_us, error_us)) = *age else { return Ok(()) };
                let age = output::signed_millis(age_us, Some(error_us));
                write!(f, "; the newest came {age} after its publication")
            }
            Self::TakesOther { owner, taken, types } => {
                write!(f, "{owner} takes it as {taken}, and the local publishers have {}", types.join(", "))
            }
            Self::NotRead => {
                f.write_str("the local publishers are not read: the local network refused a reader")
            }
            Self::NotPublished { .. } => f.write_str("no message has come from the local publishers yet"),
            Self::Published { messages, owner } => {
                write!(f, "{messages} messages were published to {owner}")
            }
        }
    }
}

impl UseFinding {
    fn fix(&self) -> Option<String> {
        Some(match self {
            Self::NoCatalogue { owner, refusal, reach, .. } => {
                refusal.as_deref().and_then(refusals::fix_at_asker).map_or_else(
                    || match reach {
                        Reach::Linked | Reach::Refused { is_linked: true } => format!(
                            "if {owner} is a router, which shares nothing of its own: name in `from` the node beside the \
                             publishers"
                        ),
                        Reach::Refused { is_linked: false } | Reach::Asked { .. } | Reach::Unknown => format!(
                            "run `sgc status` on {owner}; its name in `from` has to be that of its identity"
                        ),
                    },
                    str::to_owned,
                )
            }
            Self::TokenRefused { owner, reason } => refusals::fix_at_asker(reason)
                .map_or_else(|| format!("ask {owner} for a new token (`sgc token share create`)"), str::to_owned),
            Self::TokenUnanswered { owner } => {
                format!("is {owner} running, and linked to a router that this node is linked to?")
            }
            Self::TypeDiffers { .. } => "change `type` in the [[use]], or leave it out".into(),
            Self::KindDiffers { topic, shared, .. } => format!("write {shared} = \"{topic}\" in the [[use]]"),
            Self::MayNotPublish { owner, node, .. } => {
                format!("on {owner}: add \"{node}\" to `publish` of its [[share]], then `sgc reload`")
            }
            Self::MayNotSubscribe { owner, node, .. } => format!(
                "on {owner}: add \"{node}\" to `to` of its [[share]]; or set publish = true in the [[use]]"
            ),
            Self::Idle { .. } => LOG_AND_STATUS.into(),
            Self::NotForWildcards { owner, kind, rule, .. } => {
                format!("on {owner}: no wildcard shares it; name it, [[share]] {kind} = \"{rule}\"")
            }
            Self::OwnerRevoked { owner } => format!(
                "nothing comes from {owner} any more; to have it back, the keeper of its fleet has to enroll it again (`sgc \
                 fleet enroll {owner} --again`)"
            ),
            Self::NotShared { owner, topic, node, .. } => format!(
                "on {owner}: is it in a [[share]] whose `to` has \"{node}\" or a group of it, and is it published there? `sgc why \
                 {topic}` there says more"
            ),
            Self::Refused { owner, reason, topic } => refusals::fix_at_asker(reason).map_or_else(
                || {
                    format!(
                        "on {owner}: `sgc why {topic}` names the entry that is missing; it is asked again by itself"
                    )
                },
                str::to_owned,
            ),
            Self::Relayed { reason, .. } => reason.fix().into(),
            Self::NoRoute { owner } => format!("is {owner} running and linked? `sgc status` there"),
            Self::Unanswered { .. } => ASK_AGAIN.into(),
            Self::NoBranch => ASK_AGAIN_OR_SILENT.into(),
            Self::NoServer => ASK_AGAIN_OR_DDS_LOG.into(),
            Self::NoMessage { owner, topic } => {
                format!("run `sgc why {topic}` on {owner}: its publishers may be silent")
            }
            Self::TakesOther { .. } => {
                "publish the type that the owner shares, or have the owner change its `type`".into()
            }
            Self::NotRead => DDS_LOG.into(),
            Self::NotPublished { topic } => {
                format!("`sgc topic hz --side local {topic}` shows whether they publish")
            }
            Self::Rule { .. }
            | Self::Listed { .. }
            | Self::Granted { .. }
            | Self::Route { .. }
            | Self::Direct { .. }
            | Self::NotOverDirect { .. }
            | Self::Answered { .. }
            | Self::Received { .. }
            | Self::Published { .. } => return None,
        })
    }
}

impl fmt::Display for LocalFinding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Stopped { dead_man, .. } => {
                let cause = match dead_man.stopped.as_deref() {
                    Some("silence") => "no command came",
                    Some("late") => "commands came late",
                    Some("closed") => "nobody publishes it any more",
                    _ => "it began anew",
                };
                write!(
                    f,
                    "the dead-man switch stopped the robot {} s ago, because {cause}",
                    dead_man.stopped_s
                )?;
                if let Some(why) = &dead_man.no_stop_message {
                    return write!(f, "; no command passes, because it has no stop message: {why}");
                }
                let held = [
                    (dead_man.late, "late"),
                    (dead_man.not_resumed, "of a publisher that has not let go since"),
                    (dead_man.unjudged, "of a publisher that was new, or without a time stamp"),
                ];
                for (count, which) in held.into_iter().filter(|(count, _)| *count > 0) {
                    write!(f, "; {count} commands were {which}")?;
                }
                Ok(())
            }
            Self::CommandsPass { stops } => {
                write!(f, "commands pass the dead-man switch; it has published {stops} stop messages")
            }
            Self::NoProvider { kind, topic, consumers, meant } => {
                write!(f, "no {} of {topic} is on the local network", provider(*kind))?;
                if *consumers > 0 {
                    write!(f, " ({consumers} {}s are there)", consumer(*kind))?;
                }
                f.write_str(&hint(meant))
            }
            Self::Providers { count, kind, topic, types } => {
                write!(f, "{count} local {}s of {topic}", provider(*kind))?;
                types.iter().try_for_each(|types| write!(f, " [{}]", types.join(", ")))
            }
            Self::DefinitionsDiffer { kind, type_name, hashes } => {
                let hashes: Vec<_> = hashes.iter().map(|hash| short_hash(hash)).collect();
                write!(
                    f,
                    "local {}s have different definitions of {type_name}: {}",
                    provider(*kind),
                    hashes.join(" and ")
                )
            }
            Self::Unasserted { count } => write!(
                f,
                "{count} local publishers assert their liveliness by hand (MANUAL_BY_TOPIC): other nodes see their messages, \
                 and `assert_liveliness()` only with a lease of 100 ms or more"
            ),
            Self::NoSubscriber { topic, meant } => {
                write!(f, "nobody on this local network subscribes to {topic}{}", hint(meant))
            }
            Self::NoActionClient { action } => {
                write!(f, "no client of {action} runs on this local network")
            }
            Self::SubscribedTypeDiffers { far, here } => {
                write!(f, "the far side has {far}, and the local subscribers have {here}")
            }
            Self::SubscribedDefinitionDiffers { type_name, far, here } => write!(
                f,
                "the definitions of {type_name} differ: {} on the far side, {} here",
                short_hash(far),
                short_hash(here)
            ),
            Self::QosDiffers(mismatch) => write!(f, "QoS does not match, by {mismatch}"),
            Self::SomeQosDiffers { count, of, first } => {
                write!(f, "{count} of {of} local subscribers get nothing: QoS does not match, by {first}")
            }
            Self::NoWriter => {
                f.write_str("no writer for it is on the local network: DDS refused one, or it is being made")
            }
            Self::Unmatched { count } => {
                write!(f, "{count} local subscribers are there, and DDS matches none of them with this node")
            }
            Self::Matched { count } => write!(f, "{count} local subscribers are matched"),
            Self::NoDefinition { type_name } => write!(
                f,
                "its messages travel as JSON, and no definition of {type_name} is known here: none get through"
            ),
        }
    }
}

impl LocalFinding {
    fn fix(&self) -> Option<String> {
        Some(match self {
            Self::NoProvider { .. } => {
                "start it; if it runs, compare `domain_id` and `discovery_range` in [ros] with its ROS_DOMAIN_ID and \
                 ROS_AUTOMATIC_DISCOVERY_RANGE, or `router` in [ros.zenoh] with its Zenoh router; `sgc topic list` shows what was discovered"
                    .into()
            }
            Self::DefinitionsDiffer { .. } => "build them from one version of the interface package".into(),
            Self::Unasserted { .. } => {
                "publish a message within each lease, or choose a liveliness that is automatic".into()
            }
            Self::NoSubscriber { .. } => {
                "start a subscriber; if one runs, compare `domain_id` and `discovery_range` in [ros] with its ROS_DOMAIN_ID and \
                 ROS_AUTOMATIC_DISCOVERY_RANGE, or `router` in [ros.zenoh] with its Zenoh router"
                    .into()
            }
            Self::NoActionClient { .. } => {
                "that is no fault: start a client, or send a goal with `ros2 action send_goal`".into()
            }
            Self::SubscribedTypeDiffers { .. } => "the two never talk: use one type on both sides".into(),
            Self::SubscribedDefinitionDiffers { .. } => ONE_VERSION.into(),
            Self::QosDiffers(QosMismatch { policy, .. }) => {
                format!("ask for no more in the subscriber, or offer more in the publisher: {policy}")
            }
            Self::NoWriter => DDS_LOG.into(),
            Self::Unmatched { .. } => {
                "do they run in another security enclave (SROS2), with another partition, or behind a firewall for UDP?".into()
            }
            Self::NoDefinition { .. } => {
                "name a directory with packages that define it with `definitions` in [ros], or start the node where ROS 2 is \
                 sourced; or take `encoding = \"json\"` out of the [[share]]"
                    .into()
            }
            Self::Stopped { dead_man, .. } if dead_man.no_stop_message.is_some() => {
                "name a directory with packages that define the type with `definitions` in [ros], or correct `publish` of `deadman`"
                    .into()
            }
            Self::Stopped { dead_man, topic } if dead_man.is_manual => {
                format!("look at the robot, then `sgc topic resume {topic}`")
            }
            Self::Stopped { topic, .. } => format!(
                "let go of the control for the time of `after` and begin again; or look at the robot, then `sgc topic resume \
                 {topic}`"
            ),
            Self::Providers { .. }
            | Self::SomeQosDiffers { .. }
            | Self::Matched { .. }
            | Self::CommandsPass { .. } => return None,
        })
    }
}

impl fmt::Display for QosMismatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { policy, offered, asked } = self;
        write!(f, "{policy}: {offered} is offered by the far side, {asked} is asked for")
    }
}

impl fmt::Display for NameFinding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::OwnerHere => f.write_str("its owner is this node"),
            Self::Route { next, rtt_us } => write!(
                f,
                "the way to its owner is {next}, {} round trip",
                output::millis((*rtt_us).into())
            ),
            Self::Unadvertised => f.write_str(
                "nobody in reach advertises it: its owner is not linked to these routers, shares it no more, or nobody \
                 publishes it there; with `mapping = \"query\"` it is known only while it is asked for",
            ),
            Self::NoBranch => {
                f.write_str("nobody asked for it over this router: no branch leads through it")
            }
            Self::Branch { to } => write!(f, "a branch leads through this node, to {}", listed(to)),
        }
    }
}

impl NameFinding {
    fn fix(&self) -> Option<&'static str> {
        match self {
            Self::Unadvertised => Some("see `sgc why /topic` at its owner; compare the name with `sgc name`"),
            Self::NoBranch => Some(
                "see `sgc why /topic` at the node that uses it: it may go over another router, or be refused",
            ),
            Self::OwnerHere | Self::Route { .. } | Self::Branch { .. } => None,
        }
    }
}

impl fmt::Display for TrafficFinding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Passed { packets, bytes, direction } => {
                let passed = match direction {
                    Direction::In => "came here",
                    Direction::Out => "left here",
                    Direction::Shared => "went through here",
                    Direction::Through => "passed through this node",
                };
                // Messages are counted for longer, and one may need several packets or share one.
                write!(f, "{packets} packets ({}) {passed} since the branch began", output::bytes(*bytes))
            }
            Self::Dropped { counts, worst } => {
                let means = refusals::packet_drop(worst).map_or(FOR_ANOTHER_REASON, |drop| drop.means);
                write!(f, "dropped here: {} ({means})", counted(counts))
            }
        }
    }
}

impl TrafficFinding {
    fn fix(&self) -> Option<&'static str> {
        match self {
            Self::Passed { .. } => None,
            Self::Dropped { worst, .. } => Some(
                refusals::packet_drop(worst)
                    .map(|drop| drop.fix)
                    .filter(|fix| !fix.is_empty())
                    .unwrap_or("`sgc status` shows all drops"),
            ),
        }
    }
}

impl fmt::Display for Hop {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::ThisNode => f.write_str("this node"),
            Self::Link { id, peer, remote, rtt_us } => {
                write!(f, "link {id} to {peer} at {remote} ({})", output::millis(*rtt_us))
            }
            Self::UnlistedLink { id } => write!(f, "link {id}"),
        }
    }
}

fn listed(hops: &[Hop]) -> String {
    hops.iter().map(Hop::to_string).collect::<Vec<_>>().join(", ")
}

fn counted(counts: &BTreeMap<String, u64>) -> String {
    counts.iter().map(|(counter, count)| format!("{counter} {count}")).collect::<Vec<_>>().join(", ")
}

fn provider(kind: Interface) -> &'static str {
    if kind == Interface::Topic { "publisher" } else { "server" }
}

fn consumer(kind: Interface) -> &'static str {
    if kind == Interface::Topic { "subscriber" } else { "client" }
}

fn whom([nodes, groups, fleets]: [usize; 3]) -> String {
    let count = |n: usize, noun: &str| (n > 0).then(|| output::several(n as u64, noun));
    let all: Vec<_> = [count(nodes, "node"), count(groups, "group"), count(fleets, "whole fleet")]
        .into_iter()
        .flatten()
        .collect();
    if all.is_empty() { "nobody".to_owned() } else { all.join(", ") }
}

/// Shortens a hash to a length that still identifies it.
fn short_hash(hash: &str) -> String {
    hash.chars().take("RIHS01_".len() + 12).collect()
}
