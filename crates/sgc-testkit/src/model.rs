//! The reference model: the expected outcome, computed from cables, runs, shares, uses, and the revocations that nodes
//! know. It reads no other state of a machine.

use std::collections::{BTreeMap, BTreeSet};

use sgc_endpoint::JoinStatus;

use sgc_router::MappingKind;

use crate::{NodeKey, Sharing, World};

/// The expected reachability, permissions, and grants of a world at rest.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Model {
    /// The nodes that each running node reaches: neighbours, and nodes behind those that forward.
    pub reached: BTreeMap<NodeKey, BTreeSet<NodeKey>>,
    /// The nodes to which each shared topic of a running owner is granted.
    pub granted: BTreeMap<(NodeKey, String), BTreeSet<NodeKey>>,
    /// The nodes that follow each running owner's catalogue and reach it.
    pub following: BTreeMap<NodeKey, BTreeSet<NodeKey>>,
}

impl Model {
    /// Computes the expected outcome of a world with its present configuration.
    pub fn from_world(world: &World) -> Self {
        // A node that knows of its own revocation does not believe its own certificate and is alone.
        let alive =
            |n: NodeKey| world.is_running(n) && world.nodes[n.0].frozen.is_none() && world.believes(n, n);
        let reached: BTreeMap<_, _> =
            world.nodes().filter(|n| alive(*n)).map(|n| (n, reach(world, n, alive, true))).collect();
        let mut granted = BTreeMap::new();
        let mut following = BTreeMap::new();
        for (owner, reached) in &reached {
            let users = reached.iter().filter(|u| *u != owner);
            for (topic, sharing) in &world.nodes[owner.0].shares {
                let uses = |u: &&NodeKey| world.nodes[u.0].uses.contains(&(*owner, topic.clone()));
                let permitted = users.clone().filter(|u| permits(world, *owner, sharing, **u));
                granted.insert((*owner, topic.clone()), permitted.filter(uses).copied().collect());
            }
            let follows = |u: &&NodeKey| world.nodes[u.0].uses.iter().any(|(o, _)| o == owner);
            let of_fleet = |u: &&NodeKey| same_fleet(world, *owner, **u);
            let has_secret = !world.members[owner.0].router;
            let followers = users.filter(follows).filter(of_fleet).filter(|_| has_secret);
            following.insert(*owner, followers.copied().collect());
        }
        Self { reached, granted, following }
    }

    /// Returns `true` if a node reaches another one without direct links.
    pub fn reaches_over_routers(world: &World, from: NodeKey, to: NodeKey) -> bool {
        let alive = |n: NodeKey| world.is_running(n) && world.believes(n, n);
        alive(from) && alive(to) && reach(world, from, alive, false).contains(&to)
    }

    /// Returns the nodes that may use a shared topic, whether they want to or not.
    pub fn permitted(world: &World, owner: NodeKey, topic: &str) -> BTreeSet<NodeKey> {
        let Some(sharing) = world.nodes[owner.0].shares.get(topic) else { return BTreeSet::new() };
        world.nodes().filter(|user| permits(world, owner, sharing, *user)).collect()
    }

    /// Compares a world at rest with the model. The error describes the first difference.
    pub fn check(&self, world: &World) -> Result<(), String> {
        self.check_revocations(world)?;
        for ((owner, topic), expected) in &self.granted {
            let granted = world.granted(*owner, topic);
            if !granted.iter().eq(expected) {
                return Err(format!("{owner:?}:{topic} is granted to {granted:?}, not {expected:?}"));
            }
        }
        for user in self.reached.keys() {
            for (owner, topic) in &world.nodes[user.0].uses {
                let expected =
                    self.granted.get(&(*owner, topic.clone())).is_some_and(|users| users.contains(user));
                let status = world.status(*user, *owner, topic);
                if (status == Some(JoinStatus::Granted)) != expected {
                    return Err(format!("{user:?} stands at {status:?} with {owner:?}:{topic}"));
                }
            }
            self.check_tables(world, *user)?;
        }
        Ok(())
    }

    /// Checks that nodes that reach each other know the same revocations.
    fn check_revocations(&self, world: &World) -> Result<(), String> {
        for (node, reached) in &self.reached {
            for other in reached {
                if world.revocations(*node) != world.revocations(*other) {
                    return Err(format!("{node:?} and {other:?} know of different revocations"));
                }
            }
        }
        Ok(())
    }

    /// Checks that a router holds the state that running nodes need, and none of nodes that are gone.
    fn check_tables(&self, world: &World, node: NodeKey) -> Result<(), String> {
        let mut named = BTreeMap::new();
        let mut routed = 0;
        for (owner, reached) in &self.reached {
            if world.members[owner.0].router || !reached.contains(&node) {
                continue;
            }
            routed += 1;
            let followers = &self.following[owner];
            named.insert(world.catalogue_name(*owner), (followers.len(), None));
            if world.nodes[owner.0].is_direct {
                // Questions come and go.
                named.insert(world.paths_name(*owner), (world.nodes.len(), None));
                routed += 1;
            }
            for topic in world.nodes[owner.0].shares.keys() {
                let users = &self.granted[&(*owner, topic.clone())];
                let sinks: BTreeSet<_> =
                    world.granted_sinks(*owner, topic).into_iter().map(|(sink, _)| sink).collect();
                named.insert(world.name(*owner, topic), (users.len(), Some(sinks)));
                routed += 1;
            }
        }
        let stats = world.stats(node);
        // A router with mapping `query` knows the names that it needs. One with `flood` knows all names, unless it
        // learns them from a router with `query`.
        let floods = world.nodes.iter().all(|n| !n.transit || n.mapping == MappingKind::Flood);
        if world.nodes[node.0].transit
            && (stats.routed_names > routed || floods && stats.routed_names != routed)
        {
            let known = stats.routed_names;
            return Err(format!("{node:?} has routes to {known} names, not to {routed}"));
        }
        let mut branches = 0;
        for name in world.forwarding(node) {
            let forwarded = world.forwarding_sinks(node, &name);
            branches += forwarded.len();
            let Some((users, sinks)) = named.get(&name) else {
                return Err(format!("{node:?} forwards {name:?}, which nobody shares"));
            };
            if forwarded.len() > *users {
                return Err(format!("{node:?} forwards {name:?} to {forwarded:?}, more than {users} users"));
            }
            if let Some(gone) = sinks.as_ref().and_then(|all| forwarded.iter().find(|s| !all.contains(s))) {
                return Err(format!("{node:?} forwards {name:?} to {gone:?}, which its owner does not know"));
            }
        }
        if stats.branches != branches {
            return Err(format!("{node:?} has {} branches but forwards to {branches}", stats.branches));
        }
        Ok(())
    }
}

fn reach(world: &World, from: NodeKey, alive: impl Fn(NodeKey) -> bool, directly: bool) -> BTreeSet<NodeKey> {
    let mut reached = BTreeSet::from([from]);
    let mut edge = vec![from];
    while let Some(here) = edge.pop() {
        if here != from && !world.nodes[here.0].transit {
            continue;
        }
        for cable in world.cables.iter().filter(|c| c.whole && (directly || !c.is_direct)) {
            let Some(side) = cable.end_of(here) else { continue };
            let there = cable.ends[1 - side];
            let trust = world.believes(here, there) && world.believes(there, here);
            if alive(there) && trust && reached.insert(there) {
                edge.push(there);
            }
        }
    }
    reached
}

fn permits(world: &World, owner: NodeKey, sharing: &Sharing, user: NodeKey) -> bool {
    let member = &world.members[user.0];
    let in_fleet = same_fleet(world, owner, user);
    let in_group = member.groups.iter().any(|g| sharing.groups.contains(g));
    let good = world.believes(owner, user);
    // A rule for all members names nobody who may route.
    let by_fleet = sharing.fleet && !member.may_route;
    good && !member.router && in_fleet && (by_fleet || sharing.nodes.contains(&user) || in_group)
}

fn same_fleet(world: &World, a: NodeKey, b: NodeKey) -> bool {
    world.members[a.0].fleet == world.members[b.0].fleet
}
