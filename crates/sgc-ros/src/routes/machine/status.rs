//! The state of every rule and route, for status. The driver puts it into words.

use sgc_endpoint::RefusedBy;
use sgc_wire::{Metadata, Name};

use super::Routes;
use crate::routes::owners::OwnerState;
use crate::routes::rules::{Direction, ShareRule, UseRule};
use crate::routes::share_route::ShareRoute;
use crate::routes::token_join::TokenJoin;
use crate::routes::use_route::UseRoute;

/// The way of a rule's interfaces.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RouteKind {
    /// A topic that is shared.
    Share,
    /// A service that is shared.
    Serve,
    /// A topic that is brought here.
    Use,
    /// A topic on which this node publishes elsewhere.
    Publish,
    /// A service that is called elsewhere.
    Call,
}

impl RouteKind {
    /// Returns the stable name.
    pub fn key(self) -> &'static str {
        match self {
            Self::Share => "share",
            Self::Serve => "serve",
            Self::Use => "use",
            Self::Publish => "publish",
            Self::Call => "call",
        }
    }
}

/// The state of a route, for status.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RouteStatus {
    /// The way of its messages.
    pub kind: RouteKind,
    /// The ROS name of the topic or service.
    pub topic: String,
    /// The name on the other side, if it is another one.
    pub topic_there: Option<String>,
    /// The ROS type, once it is known.
    pub type_name: Option<String>,
    /// The name, once it is known.
    pub name: Option<Name>,
    /// The owner's node name.
    pub owner: String,
    /// The activity of the route, or the reason why it waits.
    pub state: RouteState,
}

/// The activity of a route, or the reason why it waits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RouteState {
    /// The share waits for a local publisher or server.
    AwaitsLocal,
    /// The topic is shared.
    Shared {
        /// The number of local publishers.
        publishers: usize,
        /// The number of remote subscribers.
        subscribers: usize,
        /// `true` if the local publishers are read.
        is_read: bool,
    },
    /// The service is shared.
    Served {
        /// The number of local servers.
        servers: usize,
        /// The number of remote nodes that may call.
        callers: usize,
    },
    /// The owner's catalogue does not come.
    Owner(OwnerState),
    /// The owner's catalogue has no such interface for this node.
    NotListed {
        /// `true` if the rule is a pattern.
        is_pattern: bool,
    },
    /// The owner has not granted the interface yet.
    AwaitsGrant,
    /// The interface is refused.
    Refused(RefusedBy),
    /// The interface is granted.
    Granted {
        /// The number of local publishers that are read, or of local writers.
        local: usize,
    },
}

impl<R> Routes<R> {
    /// Returns the state of every rule.
    pub fn status(&self) -> Vec<RouteStatus> {
        let mut all = Vec::new();
        for (id, rule) in self.share_rules.with_ids() {
            let before = all.len();
            all.extend(
                self.shares.values().filter(|s| s.rule() == id).map(|route| share_status(rule, route)),
            );
            if all.len() == before {
                all.push(idle_share(rule));
            }
        }
        for (id, rule) in self.use_rules.with_ids() {
            let before = all.len();
            let routes = self.uses.iter().filter(|(_, u)| u.rule() == id);
            all.extend(routes.map(|(name, route)| use_status(rule, *name, route)));
            if all.len() == before {
                all.push(self.idle_use(rule));
            }
        }
        all
    }

    /// Returns the status of a rule without a route.
    fn idle_use(&self, rule: &UseRule) -> RouteStatus {
        let (type_name, name, state) = match &rule.token {
            Some((name, metadata)) => {
                let refused = self.tokens.get(name).and_then(TokenJoin::refused);
                let state = refused.map_or(RouteState::AwaitsGrant, RouteState::Refused);
                (Some(metadata.type_name.clone()), Some(*name), state)
            }
            None => {
                let not_listed = RouteState::NotListed { is_pattern: rule.is_pattern() };
                let state = self.owners.state(&rule.owner).map_or(not_listed, RouteState::Owner);
                (rule.type_name.clone(), None, state)
            }
        };
        let (topic, owner) = (rule.topic.clone(), rule.owner_name.clone());
        RouteStatus { kind: use_kind(rule), topic, topic_there: None, type_name, name, owner, state }
    }
}

fn share_kind(rule: &ShareRule) -> RouteKind {
    if rule.is_service() { RouteKind::Serve } else { RouteKind::Share }
}

fn use_kind(rule: &UseRule) -> RouteKind {
    match rule.direction {
        _ if rule.is_service() => RouteKind::Call,
        Direction::Publish => RouteKind::Publish,
        Direction::Bring => RouteKind::Use,
    }
}

/// Returns the status of a share rule without a route.
fn idle_share(rule: &ShareRule) -> RouteStatus {
    let Metadata { ros_name, type_name, owner, .. } = &rule.metadata;
    RouteStatus {
        kind: share_kind(rule),
        topic: ros_name.clone(),
        topic_there: None,
        type_name: Some(type_name.clone()).filter(|name| !name.is_empty()),
        name: None,
        owner: owner.clone(),
        state: RouteState::AwaitsLocal,
    }
}

fn share_status(rule: &ShareRule, route: &ShareRoute) -> RouteStatus {
    let (local, remote) = (route.writers().len(), route.sink_count());
    let (topic_there, state) = if rule.is_service() {
        (None, RouteState::Served { servers: local, callers: remote })
    } else {
        let is_read = route.is_read();
        let there = rule.naming.renamed(&rule.metadata.ros_name, route.local_name());
        let state = RouteState::Shared { publishers: local, subscribers: remote, is_read };
        (Some(there).filter(|there| there != route.local_name()), state)
    };
    RouteStatus {
        kind: share_kind(rule),
        topic: route.local_name().to_owned(),
        topic_there,
        type_name: Some(route.type_name()),
        name: Some(route.name()),
        owner: rule.metadata.owner.clone(),
        state,
    }
}

fn use_status(rule: &UseRule, name: Name, route: &UseRoute) -> RouteStatus {
    let local = match rule.direction {
        Direction::Publish => route.publisher_count(),
        Direction::Bring => route.writer_count(),
    };
    let state = match (route.is_granted(), route.refused()) {
        (true, _) => RouteState::Granted { local },
        (false, Some(by)) => RouteState::Refused(by),
        (false, None) => RouteState::AwaitsGrant,
    };
    let Metadata { ros_name, type_name, .. } = &route.entry().metadata;
    RouteStatus {
        kind: use_kind(rule),
        topic: route.local_name().to_owned(),
        topic_there: Some(ros_name.clone()).filter(|there| there != route.local_name()),
        type_name: Some(type_name.clone()),
        name: Some(name),
        owner: rule.owner_name.clone(),
        state,
    }
}
