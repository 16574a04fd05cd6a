//! Questions of this node's users to other nodes of the fleet, for reports: several at a time, one for each node, each
//! with a deadline.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_endpoint::{CompressionError, RefusedBy};
use sgc_trust::NodeName;
use sgc_wire::{Name, NodeId, RefuseReason, ReportQuestion};
use tokio::sync::oneshot;

/// Most nodes that are asked at one time.
const ASKED_MAX: usize = 128;
/// Most questions that are asked or wait.
const INQUIRIES_MAX: usize = 1024;
/// Longest time for one node to answer. Over a slow path it takes four passages and the document.
pub(crate) const INQUIRY_MAX: Duration = Duration::from_secs(5);

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
    #[error("not in reach, or it gives no reports (`observers` in its [admin])")]
    NotFound,
    /// This node is no observer.
    #[error(
        "it does not take this node for an observer: enroll this node with `--group observers`, or name it in `observers` \
         of its [admin]"
    )]
    NotObserver,
    /// The node or a router refused the request itself.
    #[error("it was not asked: {0}")]
    Denied(RefusedBy),
    /// The node did not answer.
    #[error("it does not answer")]
    Silent,
    /// The answer cannot be read.
    #[error("its report cannot be read: {0}")]
    Unreadable(CompressionError),
    /// The node stops.
    #[error("the node is stopping")]
    Stopping,
}

/// The document of a report, JSON that is not verified; or the reason why there is none.
pub(crate) type InquiryAnswer = Result<Bytes, InquiryError>;

/// The node that a user asks.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum InquiryTarget {
    /// The node with this name.
    Node(NodeName),
    /// The authority that this node's identity names.
    Authority,
}

/// A question of a user.
#[derive(Debug)]
struct Inquiry {
    node: NodeId,
    question: ReportQuestion,
    reply: oneshot::Sender<InquiryAnswer>,
}

/// A question that a node was asked.
#[derive(Debug)]
struct Asked {
    inquiry: Inquiry,
    name: Name,
    until: Instant,
}

/// The questions that wait, and those under way.
#[derive(Debug, Default)]
pub(crate) struct Inquiries {
    waiting: VecDeque<Inquiry>,
    asked: Vec<Asked>,
}

impl Inquiries {
    /// Queues a question. [`Inquiries::next`] begins it.
    pub(crate) fn push(
        &mut self,
        node: NodeId,
        question: ReportQuestion,
        reply: oneshot::Sender<InquiryAnswer>,
    ) {
        if self.waiting.len() + self.asked.len() >= INQUIRIES_MAX {
            let _ = reply.send(Err(InquiryError::Full));
            return;
        }
        self.waiting.push_back(Inquiry { node, question, reply });
    }

    /// Begins the next question to a node that is not being asked. `ask` asks it, and returns the name of the question.
    /// Returns `true` if there was one.
    pub(crate) fn next(&mut self, now: Instant, ask: impl FnOnce(NodeId, &ReportQuestion) -> Name) -> bool {
        // Some users have left.
        self.waiting.retain(|inquiry| !inquiry.reply.is_closed());
        let is_free = |node: &NodeId| self.asked.iter().all(|asked| asked.inquiry.node != *node);
        let next = self.waiting.iter().position(|inquiry| is_free(&inquiry.node));
        let Some(next) = next.filter(|_| self.asked.len() < ASKED_MAX) else { return false };
        let Some(inquiry) = self.waiting.remove(next) else { return false };
        let name = ask(inquiry.node, &inquiry.question);
        self.asked.push(Asked { inquiry, name, until: now + INQUIRY_MAX });
        true
    }

    /// Ends the question at a name. Returns `true` if there was one, so that the name is to be left.
    pub(crate) fn end(&mut self, name: Name, answer: InquiryAnswer) -> bool {
        let Some(at) = self.asked.iter().position(|asked| asked.name == name) else { return false };
        let _ = self.asked.swap_remove(at).inquiry.reply.send(answer);
        true
    }

    /// Ends the question at a name that is refused. Returns `true` if there was one.
    pub(crate) fn denied(&mut self, name: Name, by: RefusedBy) -> bool {
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
        self.asked.iter().map(|asked| asked.until).min()
    }

    /// Ends the questions whose time is over, and those whose users have left. `is_found` returns whether a name is
    /// advertised. Returns the names to leave.
    pub(crate) fn expire(&mut self, now: Instant, is_found: impl Fn(&Name) -> bool) -> Vec<Name> {
        let is_over = |asked: &mut Asked| asked.until <= now || asked.inquiry.reply.is_closed();
        let over: Vec<_> = self.asked.extract_if(.., is_over).collect();
        let end = |asked: Asked| {
            let why = if is_found(&asked.name) { InquiryError::Silent } else { InquiryError::NotFound };
            let _ = asked.inquiry.reply.send(Err(why));
            asked.name
        };
        over.into_iter().map(end).collect()
    }

    /// Ends all questions, because the node stops.
    pub(crate) fn stop(&mut self) {
        let asked = self.asked.drain(..).map(|asked| asked.inquiry);
        for inquiry in self.waiting.drain(..).chain(asked) {
            let _ = inquiry.reply.send(Err(InquiryError::Stopping));
        }
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

    fn push(inquiries: &mut Inquiries, node: NodeId, question: ReportQuestion) -> Receiver<InquiryAnswer> {
        let (reply, replied) = oneshot::channel();
        inquiries.push(node, question, reply);
        replied
    }

    /// Begins all that can begin. Returns the asked nodes.
    fn begin(inquiries: &mut Inquiries, now: Instant) -> Vec<NodeId> {
        let mut asked = Vec::new();
        while inquiries.next(now, |node, _| {
            asked.push(node);
            name(node)
        }) {}
        asked
    }

    #[test]
    fn nodes_are_asked_at_one_time_and_each_one_question_after_the_other() {
        let (now, mut inquiries) = (Instant::now(), Inquiries::default());
        let mut first = push(&mut inquiries, ARM, ReportQuestion::Condition);
        let mut second = push(&mut inquiries, ARM, ReportQuestion::Interface("/a".into()));
        let mut of_desk = push(&mut inquiries, DESK, ReportQuestion::Condition);
        assert_eq!(begin(&mut inquiries, now), [ARM, DESK]);
        assert!(!inquiries.end(Name([9; 32]), Err(InquiryError::Silent)), "of another name");
        assert!(inquiries.end(name(ARM), Ok(Bytes::from_static(b"{}"))));
        assert_eq!(first.try_recv(), Ok(Ok(Bytes::from_static(b"{}"))));
        assert_eq!(begin(&mut inquiries, now), [ARM]);
        assert!(inquiries.denied(name(ARM), RefusedBy::Owner(RefuseReason::NotPermitted)));
        assert_eq!(second.try_recv(), Ok(Err(InquiryError::NotObserver)));
        let by = RefusedBy::Router(RejectReason::Limit);
        assert!(inquiries.denied(name(DESK), by) && !inquiries.denied(name(DESK), by));
        assert_eq!(of_desk.try_recv(), Ok(Err(InquiryError::Denied(by))));
        assert_eq!(inquiries.deadline(), None);
    }

    #[test]
    fn question_ends_in_time_and_says_whether_the_node_was_found() {
        let (now, mut inquiries) = (Instant::now(), Inquiries::default());
        let mut of_arm = push(&mut inquiries, ARM, ReportQuestion::Condition);
        let mut of_desk = push(&mut inquiries, DESK, ReportQuestion::Condition);
        begin(&mut inquiries, now);
        assert_eq!(inquiries.deadline(), Some(now + INQUIRY_MAX));
        assert!(inquiries.expire(now, |_| true).is_empty());
        let mut left = inquiries.expire(now + INQUIRY_MAX, |asked| *asked == name(ARM));
        left.sort();
        assert_eq!(left, [name(ARM), name(DESK)]);
        assert_eq!(of_arm.try_recv(), Ok(Err(InquiryError::Silent)));
        assert_eq!(of_desk.try_recv(), Ok(Err(InquiryError::NotFound)));
    }

    #[test]
    fn questions_are_bounded_and_those_of_users_who_left_are_dropped() {
        let (now, mut inquiries) = (Instant::now(), Inquiries::default());
        let node =
            |n: usize| NodeId(std::array::from_fn(|at| if at < 2 { (n >> (8 * at)) as u8 } else { 7 }));
        let mut waiting: Vec<_> =
            (0..INQUIRIES_MAX).map(|n| push(&mut inquiries, node(n), ReportQuestion::Condition)).collect();
        let mut one_more = push(&mut inquiries, ARM, ReportQuestion::Condition);
        assert_eq!(one_more.try_recv(), Ok(Err(InquiryError::Full)));
        assert_eq!(begin(&mut inquiries, now).len(), ASKED_MAX);
        waiting.truncate(ASKED_MAX + 1);
        // One of the asked, and all that wait but one.
        waiting.remove(0);
        assert_eq!(inquiries.expire(now, |_| true).len(), 1);
        assert_eq!(begin(&mut inquiries, now).len(), 1);
        inquiries.stop();
        assert!(waiting.iter_mut().all(|replied| replied.try_recv() == Ok(Err(InquiryError::Stopping))));
    }
}
