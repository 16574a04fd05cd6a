//! Names from metadata and secrets (`docs/spec/names.md`).
//!
//! Everyone with the topic secret derives the name, nobody reverses it, and a router that knows the owner's certificate
//! checks a claim to a name from its blind alone.

use aws_lc_rs::{digest, hkdf, hmac};
use sgc_wire::{Blind, Encode, Metadata, Name, NodeId};
use zeroize::Zeroize;

use crate::{CaFingerprint, FleetSecret};

/// The secret of one interface: enough to derive its name, and no other name.
#[derive(Clone, Zeroize)]
#[zeroize(drop)]
pub struct TopicSecret([u8; 32]);

impl TopicSecret {
    /// Derives `HKDF-SHA-256(fleet secret, metadata)`: salt `sgc topic secret v1`, info the canonical encoding.
    pub fn derive(fleet: &FleetSecret, metadata: &Metadata) -> Self {
        let salt = hkdf::Salt::new(hkdf::HKDF_SHA256, b"sgc topic secret v1");
        let info = metadata.to_vec();
        let mut out = [0; 32];
        salt.extract(fleet.expose())
            .expand(&[&info], hkdf::HKDF_SHA256)
            .and_then(|okm| okm.fill(&mut out))
            .expect("HKDF-SHA-256 always yields 32 bytes");
        Self(out)
    }

    /// Takes the bytes of a secret.
    pub fn from_bytes(bytes: [u8; 32]) -> Self {
        Self(bytes)
    }

    /// Returns the bytes, for handing on this one interface. They belong in no log, and in no packet.
    pub fn expose(&self) -> &[u8; 32] {
        &self.0
    }

    /// Returns `HMAC-SHA-256(topic secret, "sgc name")`.
    pub fn blind(&self) -> Blind {
        let key = hmac::Key::new(hmac::HMAC_SHA256, &self.0);
        let mut out = [0; 32];
        out.copy_from_slice(hmac::sign(&key, b"sgc name").as_ref());
        Blind(out)
    }
}

impl PartialEq for TopicSecret {
    /// Compares in constant time.
    fn eq(&self, other: &Self) -> bool {
        aws_lc_rs::constant_time::verify_slices_are_equal(&self.0, &other.0).is_ok()
    }
}

impl Eq for TopicSecret {}

impl std::fmt::Debug for TopicSecret {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("TopicSecret(..)")
    }
}

/// Returns `SHA-256("sgc name v1" ‖ owner id ‖ blind)`.
pub fn name_of(owner: &NodeId, blind: &Blind) -> Name {
    let mut context = digest::Context::new(&digest::SHA256);
    context.update(b"sgc name v1");
    context.update(&owner.0);
    context.update(&blind.0);
    let mut out = [0; 32];
    out.copy_from_slice(context.finish().as_ref());
    Name(out)
}

/// Returns the blind for certificate requests to the authority of a fleet: everyone who knows the fleet's CA can derive
/// it, also routers, which hold no secret.
pub fn renewal_blind(ca: &CaFingerprint) -> Blind {
    blind_of(b"sgc renewal v1", &ca.0)
}

/// Returns the blind for operations on a fleet at its authority.
pub fn operations_blind(ca: &CaFingerprint) -> Blind {
    blind_of(b"sgc operations v1", &ca.0)
}

/// Returns the blind for questions to an owner about the types of its interfaces: everyone who knows the owner can
/// derive it, also partners, which cannot derive its catalogue's.
pub fn types_blind(owner: &NodeId) -> Blind {
    blind_of(b"sgc types v1", &owner.0)
}

/// Returns the blind for an owner's question to a node about consumers: everyone who knows the node can derive it, also
/// owners of other fleets.
pub fn consumers_blind(node: &NodeId) -> Blind {
    blind_of(b"sgc consumers v1", &node.0)
}

/// Returns the blind for questions to a node about its condition: everyone who knows the node can derive it, since the
/// node decides who gets an answer.
pub fn reports_blind(node: &NodeId) -> Blind {
    blind_of(b"sgc reports v1", &node.0)
}

/// Returns the blind for questions to a node about its addresses: everyone who knows the node can derive it, since the
/// node decides who gets an answer.
pub fn paths_blind(node: &NodeId) -> Blind {
    blind_of(b"sgc paths v1", &node.0)
}

/// Returns the blind for questions to a node about its clock: everyone who knows the node can derive it.
pub fn clock_blind(node: &NodeId) -> Blind {
    blind_of(b"sgc clock v1", &node.0)
}

/// Returns the blind for an owner's question to a node about its wishes: everyone who knows the node can derive it, also
/// owners of other fleets.
pub fn wishes_blind(node: &NodeId) -> Blind {
    blind_of(b"sgc wishes v1", &node.0)
}

/// Returns `SHA-256(label ‖ id)`, a blind that needs no secret.
fn blind_of(label: &[u8], id: &[u8]) -> Blind {
    let mut context = digest::Context::new(&digest::SHA256);
    context.update(label);
    context.update(id);
    let mut out = [0; 32];
    out.copy_from_slice(context.finish().as_ref());
    Blind(out)
}

/// Derives the name of an interface from the fleet secret.
pub fn derive_name(fleet: &FleetSecret, owner: &NodeId, metadata: &Metadata) -> Name {
    name_of(owner, &TopicSecret::derive(fleet, metadata).blind())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Computed with Python's `hmac` and `hashlib`: `scripts/name-vectors.py` prints these.
    #[test]
    fn golden_vectors() {
        let fleet = FleetSecret::from_bytes([0x11; 32]);
        let owner = NodeId([0x22; 32]);
        let plain = Metadata::topic("arm-1", "/camera/image", "sensor_msgs/msg/Image");
        let full = Metadata {
            node: "/camera".into(),
            author: "Ada".into(),
            maintainer: "ops@example.org".into(),
            interface: "v4l2".into(),
            description: "wrist camera".into(),
            unique: "left".into(),
            ..plain.clone()
        };
        for (metadata, name) in [
            (&plain, "601073d3847e79d3db60fcd14aa8569a002053404728fbf3da75e6b9a5c07364"),
            (&full, "e7f411adc7d43de473d8706a951c9047a69faafcf6f8ee06061e42b7bfab2dc7"),
            (
                &Metadata::catalogue("arm-1"),
                "a59aa68b61aa409eea546027b1f84203de8f853115e5bd5ad215b7107dd3a89b",
            ),
        ] {
            assert_eq!(derive_name(&fleet, &owner, metadata).to_string(), name);
        }
    }

    #[test]
    fn every_field_changes_the_name() {
        let fleet = FleetSecret::from_bytes([1; 32]);
        let owner = NodeId([2; 32]);
        let base = Metadata::topic("o", "/t", "p/msg/T");
        let mut all = vec![base.clone(), Metadata { kind: sgc_wire::Kind::Service, ..base.clone() }];
        for change in [
            |m: &mut Metadata| m.owner.push('x'),
            |m: &mut Metadata| m.ros_name.push('x'),
            |m: &mut Metadata| m.type_name.push('x'),
            |m: &mut Metadata| m.node.push('x'),
            |m: &mut Metadata| m.author.push('x'),
            |m: &mut Metadata| m.maintainer.push('x'),
            |m: &mut Metadata| m.interface.push('x'),
            |m: &mut Metadata| m.description.push('x'),
            |m: &mut Metadata| m.unique.push('x'),
        ] {
            let mut changed = base.clone();
            change(&mut changed);
            all.push(changed);
        }
        let names: std::collections::BTreeSet<_> =
            all.iter().map(|m| derive_name(&fleet, &owner, m)).collect();
        assert_eq!(names.len(), all.len());
        let other_owner = derive_name(&fleet, &NodeId([3; 32]), &base);
        let other_fleet = derive_name(&FleetSecret::from_bytes([4; 32]), &owner, &base);
        assert!(!names.contains(&other_owner) && !names.contains(&other_fleet));
    }
}
