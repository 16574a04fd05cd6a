//! Questions of this node's users to other nodes of the fleet, for reports: several at a time, one for each node, each
//! with a deadline.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_endpoint::RefusedBy;
use sgc_router::PathKind;
use sgc_trust::NodeName;
use sgc_wire::{Name, NodeId, RefuseReason, ReportQuestion};
use tokio::sync::oneshot;

use crate::admin::not_direct::NotDirectReason;
use crate::admin::report::ReportPath;

/// Most nodes that are asked at one time.
const ASKED_MAX: usize = 128;
/// Most questions that are asked or wait.
const INQUIRIES_MAX: usize = 1024;
/// Longest time for one node to answer. Over a slow path it takes four passages and the document.
const ANSWER_MAX: Duration = Duration::from_secs(5);
/// Longest time in which the name of a node has to be found. A node that is off has none.
const FIND_MAX: Duration = Duration::from_secs(2);
/// Longest time for a question, waiting for others included.
const INQUIRY_MAX: Duration = Duration::from_secs(10);

/// Reasons why there is no report.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum InquiryError {
    /// A router cannot derive a node's name.
    #[error("this node is a router: it holds no secret of the fleet and finds no node by its name")]
    NoSecret,
    /// There is no authority to ask.
    #[error("the identity of this node names no authority of its fleet")]
    NoAuthority,
    /// Too many questions wait.
    #[error("{INQUIRIES_MAX} questions wait at this node already")]
    Full,
    /// Nobody advertises the name.
    #[error("it is not in reach, or gives no reports")]
    NotFound,
    /// This node is no observer.
    #[error("it does not take the node here for an observer")]
    NotObserver,
    /// The node or a router refused the request itself.
    #[error("it refuses a report: {0}")]
    Denied(RefusedBy),
    /// The node did not answer.
    #[error("it does not answer")]
    Silent,
    /// The node was not asked in time, since others were.
    #[error("it was not asked: {ASKED_MAX} other nodes are being asked")]
    Waited,
    /// The answer cannot be read.
    #[error("its report cannot be read")]
    Unreadable,
    /// The node stops.
    #[error("the node is stopping")]
    Stopping,
}

impl InquiryError {
    /// Returns the remedy; empty if there is none to name.
    pub(crate) fn fix(&self) -> &'static str {
        match self {
            Self::NotFound => {
                "see that it runs, with sgc of this version or a later one and `observers` in its [admin]; `sgc status` there \
                 shows its links"
            }
            Self::NotObserver => {
                "enroll the node here with `--group observers`, or name it in `observers` of [admin] there"
            }
            Self::NoAuthority => "`sgc fleet set --authority NODE`, then renew the node here",
            Self::Unreadable => "compare the versions of sgc on both nodes",
            Self::Silent | Self::Waited => "try again",
            Self::NoSecret | Self::Full | Self::Denied(_) | Self::Stopping => "",
        }
    }
}

/// The answer of a node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct InquiryReport {
    /// The document of the report, JSON that is not verified.
    pub(crate) document: Bytes,
    /// The path to the node; `None` if it is this one.
    pub(crate) path: Option<InquiryPath>,
}

/// The path over which a node answered.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct InquiryPath {
    pub(crate) path: ReportPath,
    /// It is a direct link, and there are links to others.
    pub(crate) has_relayed: bool,
    /// Why there is no direct link; `None` if there is one.
    pub(crate) not_direct: Option<NotDirectReason>,
}

/// The answer, or the reason why there is none.
pub(crate) type InquiryAnswer = Result<InquiryReport, InquiryError>;

/// The node that a user asks.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum InquiryTarget {
    /// The node with this name.
    Node(NodeName),
    /// The authority that this node's identity names.
    Authority,
}

/// A question that users wait for.
#[derive(Debug)]
struct Inquiry {
    node: NodeId,
    question: ReportQuestion,
    /// The only kind of path to take.
    over: Option<PathKind>,
    until: Instant,
    /// The time by which its name has to be found, unless it was.
    find_until: Option<Instant>,
    /// The name at which the node is asked, once it is.
    name: Option<Name>,
    replies: Vec<oneshot::Sender<InquiryAnswer>>,
}

impl Inquiry {
    fn end(self, answer: InquiryAnswer) {
        for reply in self.replies {
            // A user may have left.
            let _ = reply.send(answer.clone());
        }
    }
}

/// The questions that wait, and those under way.
#[derive(Debug, Default)]
pub(crate) struct Inquiries {
    all: VecDeque<Inquiry>,
}

impl Inquiries {
    /// Queues a question. A user who asks the same as another gets the same answer. [`Inquiries::next`] begins it.
    pub(crate) fn push(
        &mut self,
        now: Instant,
        node: NodeId,
        question: ReportQuestion,
        over: Option<PathKind>,
        reply: oneshot::Sender<InquiryAnswer>,
    ) {
        let users = self.all.iter().map(|inquiry| inquiry.replies.len()).sum::<usize>();
        if users >= INQUIRIES_MAX {
            let _ = reply.send(Err(InquiryError::Full));
        } else if let Some(known) = self
            .all
            .iter_mut()
            .find(|known| (known.node, &known.question, known.over) == (node, &question, over))
        {
            known.replies.push(reply);
        } else {
            let (until, replies) = (now + INQUIRY_MAX, vec![reply]);
            self.all.push_back(Inquiry {
                node,
                question,
                over,
                until,
                find_until: None,
                name: None,
                replies,
            });
        }
    }

    /// Begins the next question to a node that is not being asked. `ask` asks it over a kind of path, and returns the name
    /// of the question. Returns `true` if there was one.
    pub(crate) fn next(
        &mut self,
        now: Instant,
        ask: impl FnOnce(NodeId, &ReportQuestion, Option<PathKind>) -> Name,
    ) -> bool {
        let asked: Vec<_> = self.all.iter().filter(|i| i.name.is_some()).map(|i| i.node).collect();
        if asked.len() >= ASKED_MAX {
            return false;
        }
        let is_next = |inquiry: &&mut Inquiry| inquiry.name.is_none() && !asked.contains(&inquiry.node);
        let Some(inquiry) = self.all.iter_mut().find(is_next) else { return false };
        inquiry.name = Some(ask(inquiry.node, &inquiry.question, inquiry.over));
        inquiry.until = inquiry.until.min(now + ANSWER_MAX);
        inquiry.find_until = Some(now + FIND_MAX);
        true
    }

    /// Ends the question at a name. Returns `true` if there was one, so that the name is to be left.
    pub(crate) fn end(&mut self, name: Name, answer: InquiryAnswer) -> bool {
        let at = self.all.iter().position(|inquiry| inquiry.name == Some(name));
        let Some(inquiry) = at.and_then(|at| self.all.remove(at)) else { return false };
        inquiry.end(answer);
        true
    }

    /// Ends the question at a name that is refused. Returns `true` if there was one.
    pub(crate) fn refused(&mut self, name: Name, by: RefusedBy) -> bool {
        self.end(
            name,
            Err(match by {
                RefusedBy::Owner(RefuseReason::NotPermitted) => InquiryError::NotObserver,
                by => InquiryError::Denied(by),
            }),
        )
    }

    /// Returns the time at which to call [`Inquiries::expire`].
    pub(crate) fn deadline(&self) -> Option<Instant> {
        self.all
            .iter()
            .map(|inquiry| inquiry.find_until.map_or(inquiry.until, |at| at.min(inquiry.until)))
            .min()
    }

    /// Ends the questions whose time is over. `is_found` returns whether a name is advertised. Returns the names to
    /// leave; only then may [`Inquiries::next`] ask the same nodes again.
    pub(crate) fn expire(&mut self, now: Instant, is_found: impl Fn(&Name) -> bool) -> Vec<Name> {
        for inquiry in &mut self.all {
            let is_found = || inquiry.name.is_some_and(|name| is_found(&name));
            inquiry.find_until = inquiry.find_until.filter(|at| *at > now || !is_found());
        }
        let is_over = |inquiry: &Inquiry| {
            inquiry.until <= now || inquiry.find_until.is_some_and(|find_until| find_until <= now)
        };
        let (over, left) = self.all.drain(..).partition(is_over);
        self.all = left;
        let over: VecDeque<Inquiry> = over;
        let end = |inquiry: Inquiry| {
            let name = inquiry.name;
            inquiry.end(Err(match name {
                None => InquiryError::Waited,
                Some(name) if is_found(&name) => InquiryError::Silent,
                Some(_) => InquiryError::NotFound,
            }));
            name
        };
        over.into_iter().filter_map(end).collect()
    }

    /// Ends all questions, because the node stops.
    pub(crate) fn stop(&mut self) {
        self.all.drain(..).for_each(|inquiry| inquiry.end(Err(InquiryError::Stopping)));
    }
}

#[cfg(test)]
mod tests {
    use sgc_wire::RejectReason;
    use tokio::sync::oneshot::Receiver;

    use super::*;

    const ARM: NodeId = NodeId([1; 32]);
    const DESK: NodeId = NodeId([2; 32]);

    fn name(node: NodeId) -> Name {
        Name(node.0)
    }

    fn push(
        inquiries: &mut Inquiries,
        now: Instant,
        node: NodeId,
        question: ReportQuestion,
    ) -> Receiver<InquiryAnswer> {
        let (reply, replied) = oneshot::channel();
        inquiries.push(now, node, question, None, reply);
        replied
    }

    fn interface() -> ReportQuestion {
        ReportQuestion::Interface("/a".into())
    }

    /// Begins all that can begin. Returns the asked nodes.
    fn begin(inquiries: &mut Inquiries, now: Instant) -> Vec<NodeId> {
        let mut asked = Vec::new();
        while inquiries.next(now, |node, _, _| {
            asked.push(node);
            name(node)
        }) {}
        asked
    }

    #[test]
    fn nodes_are_asked_at_one_time_and_each_one_question_after_the_other() {
        let (now, mut inquiries) = (Instant::now(), Inquiries::default());
        let mut first = push(&mut inquiries, now, ARM, ReportQuestion::Node);
        let mut second = push(&mut inquiries, now, ARM, interface());
        let mut of_desk = push(&mut inquiries, now, DESK, ReportQuestion::Node);
        let mut of_another_user = push(&mut inquiries, now, ARM, ReportQuestion::Node);
        assert_eq!(begin(&mut inquiries, now), [ARM, DESK]);
        assert!(!inquiries.end(Name([9; 32]), Err(InquiryError::Silent)), "of another name");
        let answer = Ok(InquiryReport { document: Bytes::from_static(b"{}"), path: None });
        assert!(inquiries.end(name(ARM), answer.clone()));
        for replied in [&mut first, &mut of_another_user] {
            assert_eq!(replied.try_recv(), Ok(answer.clone()));
        }
        assert_eq!(begin(&mut inquiries, now), [ARM]);
        assert!(inquiries.refused(name(ARM), RefusedBy::Owner(RefuseReason::NotPermitted)));
        assert_eq!(second.try_recv(), Ok(Err(InquiryError::NotObserver)));
        let by = RefusedBy::Router(RejectReason::Limit);
        assert!(inquiries.refused(name(DESK), by) && !inquiries.refused(name(DESK), by));
        assert_eq!(of_desk.try_recv(), Ok(Err(InquiryError::Denied(by))));
        assert_eq!(inquiries.deadline(), None);
    }

    #[test]
    fn question_over_one_kind_of_path_is_another_question() {
        let (now, mut inquiries) = (Instant::now(), Inquiries::default());
        for over in [None, Some(PathKind::Direct), Some(PathKind::Relayed), Some(PathKind::Direct)] {
            inquiries.push(now, ARM, ReportQuestion::Ping, over, oneshot::channel().0);
        }
        let mut asked = Vec::new();
        while inquiries.next(now, |node, _, over| {
            asked.push(over);
            name(node)
        }) {
            inquiries.end(name(ARM), Err(InquiryError::Silent));
        }
        assert_eq!(asked, [None, Some(PathKind::Direct), Some(PathKind::Relayed)]);
    }

    #[test]
    fn question_ends_in_time_and_says_whether_the_node_was_found() {
        let (now, mut inquiries) = (Instant::now(), Inquiries::default());
        let mut of_arm = push(&mut inquiries, now, ARM, ReportQuestion::Node);
        let mut of_desk = push(&mut inquiries, now, DESK, ReportQuestion::Node);
        let mut behind = push(&mut inquiries, now, DESK, interface());
        begin(&mut inquiries, now);
        assert_eq!(inquiries.deadline(), Some(now + FIND_MAX));
        assert!(inquiries.expire(now, |_| true).is_empty());
        // A node without a name is off, and one that has a name may be slow.
        let found = now + FIND_MAX;
        assert_eq!(inquiries.expire(found, |asked| *asked == name(ARM)), [name(DESK)]);
        assert_eq!(of_desk.try_recv(), Ok(Err(InquiryError::NotFound)));
        assert_eq!(inquiries.deadline(), Some(now + ANSWER_MAX));
        // The question behind begins once the name was left.
        let later = now + ANSWER_MAX;
        assert_eq!(begin(&mut inquiries, later), [DESK]);
        assert_eq!(inquiries.expire(later, |_| true), [name(ARM)]);
        assert_eq!(of_arm.try_recv(), Ok(Err(InquiryError::Silent)));
        // It has the rest of its time.
        assert!(inquiries.expire(later + FIND_MAX, |_| true).is_empty());
        assert_eq!(inquiries.deadline(), Some(now + INQUIRY_MAX));
        assert_eq!(inquiries.expire(now + INQUIRY_MAX, |_| true), [name(DESK)]);
        assert_eq!(behind.try_recv(), Ok(Err(InquiryError::Silent)));
    }

    #[test]
    fn questions_are_bounded_and_those_that_are_never_asked_end_in_time() {
        let (now, mut inquiries) = (Instant::now(), Inquiries::default());
        let node =
            |n: usize| NodeId(std::array::from_fn(|at| if at < 2 { (n >> (8 * at)) as u8 } else { 7 }));
        let mut all: Vec<_> =
            (0..INQUIRIES_MAX).map(|n| push(&mut inquiries, now, node(n), ReportQuestion::Node)).collect();
        for one_more in [ARM, node(0)] {
            let mut one_more = push(&mut inquiries, now, one_more, ReportQuestion::Node);
            assert_eq!(one_more.try_recv(), Ok(Err(InquiryError::Full)));
        }
        assert_eq!(begin(&mut inquiries, now).len(), ASKED_MAX);
        assert_eq!(inquiries.expire(now + INQUIRY_MAX, |_| true).len(), ASKED_MAX);
        let waited = all.split_off(ASKED_MAX);
        let ended = |mut replied: Receiver<InquiryAnswer>| replied.try_recv();
        assert!(all.into_iter().map(ended).all(|end| end == Ok(Err(InquiryError::Silent))));
        assert!(waited.into_iter().map(ended).all(|end| end == Ok(Err(InquiryError::Waited))));
        let mut stopped = push(&mut inquiries, now, ARM, ReportQuestion::Node);
        inquiries.stop();
        assert_eq!(stopped.try_recv(), Ok(Err(InquiryError::Stopping)));
    }
}
