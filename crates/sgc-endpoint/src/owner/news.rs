//! News over the wire: what a node tells the owners of interfaces that it uses. These are its consumers, which are the ROS 2
//! subscribers, publishers and service clients behind it, and its wishes for less.
//!
//! Owners ask a node at a name of its own if they granted it something. The answer is sealed to the owner, holds only what
//! concerns that owner's interfaces, and is repeated after each change. The owner's driver decides what follows.

use std::collections::BTreeMap;
use std::fmt::Debug;

use sgc_wire::{
    CONSUMERS_MAX, Consumer, GrantContent, NodeId, RefuseReason, Request, SinkId, WISHES_MAX, Wish,
};

use super::adverts::Adverts;
use super::askers::Askers;
use super::granted::GrantedSink;
use crate::context::Context;
use crate::names::BlindName;

/// Something that a node tells owners.
pub(crate) trait NewsItem: Clone + PartialEq + Debug {
    /// Most items in one answer.
    const MAX: usize;

    /// Returns the name at which a node is asked.
    fn name(node: &NodeId) -> BlindName;

    /// Returns the answer.
    fn content(items: Vec<Self>) -> GrantContent;
}

impl NewsItem for Consumer {
    const MAX: usize = CONSUMERS_MAX;

    fn name(node: &NodeId) -> BlindName {
        BlindName::consumers(node)
    }

    fn content(items: Vec<Self>) -> GrantContent {
        GrantContent::Consumers(items)
    }
}

impl NewsItem for Wish {
    const MAX: usize = WISHES_MAX;

    fn name(node: &NodeId) -> BlindName {
        BlindName::wishes(node)
    }

    fn content(items: Vec<Self>) -> GrantContent {
        GrantContent::Wishes(items)
    }
}

/// The items of one kind of this node, and the owners that ask for them.
#[derive(Debug)]
pub(crate) struct News<T> {
    /// The items, by the owner that they concern; `None` until there is one.
    items: Option<BTreeMap<NodeId, Vec<T>>>,
    /// The owners, each with its last answer.
    askers: Askers<Option<Vec<T>>>,
}

impl<T: NewsItem> News<T> {
    pub(crate) fn new(node: &NodeId) -> Self {
        Self { items: None, askers: Askers::new(T::name(node)) }
    }

    /// Returns the name of the question.
    pub(crate) fn name(&self) -> BlindName {
        self.askers.name()
    }

    /// Returns `true` once the name of the question is advertised.
    pub(crate) fn is_advertised(&self) -> bool {
        self.items.is_some()
    }

    /// Sets the items, and tells the owners that ask.
    pub(crate) fn set(
        &mut self,
        cx: &mut Context,
        adverts: &mut Adverts,
        mut items: BTreeMap<NodeId, Vec<T>>,
    ) {
        items.values_mut().for_each(|all| all.truncate(T::MAX));
        if self.items.is_none() {
            if items.is_empty() {
                return;
            }
            adverts.add(self.name().blind);
        }
        self.items = Some(items);
        for sink in self.askers.iter().map(|(sink, _)| sink).collect::<Vec<_>>() {
            self.tell(cx, sink);
        }
    }

    pub(crate) fn handle_question(&mut self, cx: &mut Context, sink: SinkId, asked: GrantedSink) {
        if !matches!(&asked.request, Request::Ask { what } if what.is_empty()) {
            self.askers.refuse(cx, sink, RefuseReason::RoleNotOffered);
        } else if self.items.is_none() {
            self.askers.refuse(cx, sink, RefuseReason::NotShared);
        } else if self.askers.admit(cx, sink, asked, None) {
            self.tell(cx, sink);
        }
    }

    pub(crate) fn handle_leave(&mut self, sink: SinkId) {
        self.askers.remove(sink);
    }

    /// Cuts owners that lost their certificate.
    pub(crate) fn enforce(&mut self, cx: &mut Context) {
        self.askers.enforce(cx);
    }

    pub(crate) fn withdraw(&mut self, adverts: &mut Adverts) {
        if self.items.take().is_some() {
            adverts.withdraw(self.name().blind);
        }
        self.askers.clear();
    }

    /// Tells an owner what concerns it if that differs from the last answer.
    fn tell(&mut self, cx: &mut Context, sink: SinkId) {
        let (Some((owner, told)), Some(items)) = (self.askers.get_mut(sink), &self.items) else {
            return;
        };
        let items = items.get(&owner.node_id).cloned().unwrap_or_default();
        if told.as_ref() == Some(&items) {
            return;
        }
        *told = Some(items.clone());
        self.askers.answer(cx, sink, &T::content(items));
    }
}
