//! [`Shares`]: all shares of a node, by name.

use std::collections::BTreeMap;
use std::time::Instant;

use sgc_trust::VerifiedPeer;
use sgc_wire::{Blind, CatalogueEntry, Metadata, Name};

use super::share::{RotationStep, Share, ShareError, ShareSpec};
use crate::context::Context;

/// The shares of a node.
#[derive(Debug, Default)]
pub(crate) struct Shares {
    shares: BTreeMap<Name, Share>,
}

impl Shares {
    pub(crate) fn get(&self, name: &Name) -> Option<&Share> {
        self.shares.get(name)
    }

    pub(crate) fn get_mut(&mut self, name: &Name) -> Option<&mut Share> {
        self.shares.get_mut(name)
    }

    pub(crate) fn contains(&self, name: &Name) -> bool {
        self.shares.contains_key(name)
    }

    /// Iterates over the shares.
    pub(crate) fn iter(&self) -> impl Iterator<Item = &Share> {
        self.shares.values()
    }

    /// Iterates over the names.
    pub(crate) fn names(&self) -> impl Iterator<Item = Name> {
        self.shares.keys().copied()
    }

    /// Begins a share, and tells this node's own sink.
    pub(crate) fn begin(
        &mut self,
        cx: &mut Context,
        name: Name,
        blind: Blind,
        spec: ShareSpec,
    ) -> Result<(), ShareError> {
        if self.shares.contains_key(&name) {
            let Metadata { ros_name, type_name, .. } = spec.metadata;
            return Err(ShareError::Duplicate { ros_name, type_name });
        }
        let max = cx.limits().shares_max;
        if self.shares.len() >= max {
            return Err(ShareError::Limit { max });
        }
        let mut share = Share::new(cx, name, blind, spec);
        share.tell_own(cx);
        self.shares.insert(name, share);
        Ok(())
    }

    /// Takes a share out.
    pub(crate) fn remove(&mut self, name: &Name) -> Option<Share> {
        self.shares.remove(name)
    }

    /// Cuts every sink that has lost the right to its grant, and begins new epochs for the others.
    pub(crate) fn enforce(&mut self, cx: &mut Context) {
        let mut rekey = Vec::new();
        for (name, share) in &mut self.shares {
            if share.cut_denied(cx) {
                rekey.push(*name);
            }
        }
        self.shares.values_mut().for_each(|share| share.forget_denied(cx));
        for name in rekey {
            if let Some(share) = self.shares.get_mut(&name) {
                share.begin_epoch(cx);
            }
        }
    }

    /// Ends the epochs of all shares at a time, unless they end before.
    pub(crate) fn end_epochs_by(&mut self, at: Instant) {
        self.shares.values_mut().for_each(|share| share.end_epoch_by(at));
    }

    /// Returns the time of the next step of a rotation.
    pub(crate) fn rotation_deadline(&self) -> Option<Instant> {
        self.shares.values().map(Share::rotation_deadline).min()
    }

    /// Carries out the due steps of rotations.
    pub(crate) fn rotate_due(&mut self, cx: &mut Context) {
        let now = cx.instant();
        let due = |(name, share): (&Name, &Share)| Some((*name, share.rotation_due(now)?));
        let due: Vec<_> = self.shares.iter().filter_map(due).collect();
        for step in [RotationStep::Finish, RotationStep::Begin] {
            for (name, _) in due.iter().filter(|(_, its)| *its == step) {
                if let Some(share) = self.shares.get_mut(name) {
                    share.rotate(cx, step);
                }
            }
        }
    }

    /// Returns the entries that `peer` may see in the catalogue.
    pub(crate) fn entries_for(&self, peer: &VerifiedPeer) -> Vec<CatalogueEntry> {
        let entries = self.shares.values().map(|share| share.entry(peer));
        entries.filter(|entry| entry.subscribe || entry.publish).collect()
    }
}
