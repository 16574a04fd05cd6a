//! Conversion of QoS and encodings from and to the protocol.

use sgc_wire::{Durability, History, Liveliness, Qos, Reliability};

use super::fault::Fault;
use super::proto;
use crate::content::Form;

/// Converts a number to its enumeration; the error names the enumeration.
fn known<E: TryFrom<i32>>(what: &'static str, number: i32) -> Result<E, Fault> {
    E::try_from(number).map_err(|_| Fault::Enumeration { what, number })
}

/// Returns the form of an encoding.
pub(super) fn form(encoding: i32) -> Result<Form, Fault> {
    Ok(match known("encoding", encoding)? {
        proto::Encoding::Unspecified | proto::Encoding::Cdr => Form::Cdr,
        proto::Encoding::Json => Form::Json,
        proto::Encoding::Cbor => Form::Cbor,
    })
}

/// Converts the QoS in a request.
pub(super) fn from_proto(said: &proto::Qos) -> Result<Qos, Fault> {
    use proto::qos;
    let some = |ns: u64| Some(ns).filter(|ns| *ns > 0);
    let default = Qos::default();
    if said.keep_all && said.depth > 0 {
        return Err(Fault::KeepAllWithDepth);
    }
    Ok(Qos {
        reliability: match known("reliability", said.reliability)? {
            qos::Reliability::BestEffort => Reliability::BestEffort,
            qos::Reliability::Unspecified | qos::Reliability::Reliable => Reliability::Reliable,
        },
        durability: match known("durability", said.durability)? {
            qos::Durability::TransientLocal => Durability::TransientLocal,
            qos::Durability::Unspecified | qos::Durability::Volatile => Durability::Volatile,
        },
        history: match (said.keep_all, said.depth) {
            (true, _) => History::KeepAll,
            (false, 0) => default.history,
            (false, depth) => History::KeepLast(depth),
        },
        deadline_ns: some(said.deadline_ns),
        lifespan_ns: some(said.lifespan_ns),
        liveliness: match known("liveliness", said.liveliness)? {
            qos::Liveliness::ManualByTopic => Liveliness::ManualByTopic,
            qos::Liveliness::Unspecified | qos::Liveliness::Automatic => Liveliness::Automatic,
        },
        lease_ns: some(said.liveliness_lease_ns),
        ..default
    })
}

/// Converts an offered or requested QoS to the protocol.
pub(super) fn to_proto(qos: &Qos) -> proto::Qos {
    use proto::qos;
    let reliability = match qos.reliability {
        Reliability::BestEffort => qos::Reliability::BestEffort,
        Reliability::Reliable => qos::Reliability::Reliable,
    };
    let durability =
        if qos.is_transient_local() { qos::Durability::TransientLocal } else { qos::Durability::Volatile };
    let liveliness = match qos.liveliness {
        Liveliness::Automatic => qos::Liveliness::Automatic,
        Liveliness::ManualByParticipant | Liveliness::ManualByTopic => qos::Liveliness::ManualByTopic,
    };
    let (depth, keep_all) = match qos.history {
        History::KeepLast(depth) => (depth, false),
        History::KeepAll => (0, true),
    };
    proto::Qos {
        reliability: reliability.into(),
        durability: durability.into(),
        depth,
        keep_all,
        deadline_ns: qos.deadline_ns.unwrap_or(0),
        lifespan_ns: qos.lifespan_ns.unwrap_or(0),
        liveliness: liveliness.into(),
        liveliness_lease_ns: qos.lease_ns.unwrap_or(0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn qos_survives_conversion() {
        assert_eq!(from_proto(&proto::Qos::default()).unwrap(), Qos::default());
        let wanted = Qos {
            reliability: Reliability::BestEffort,
            durability: Durability::TransientLocal,
            history: History::KeepAll,
            deadline_ns: Some(5),
            lifespan_ns: Some(6),
            liveliness: Liveliness::ManualByTopic,
            lease_ns: Some(7),
            ..Qos::default()
        };
        assert_eq!(from_proto(&to_proto(&wanted)).unwrap(), wanted);
        let wrong = from_proto(&proto::Qos { reliability: 9, ..proto::Qos::default() }).unwrap_err();
        assert_eq!(wrong.to_string(), "9 is no reliability that this gateway knows");
        let both = proto::Qos { keep_all: true, depth: 1, ..proto::Qos::default() };
        assert_eq!(from_proto(&both), Err(Fault::KeepAllWithDepth));
        assert!(form(4).is_err() && form(0).unwrap() == Form::Cdr);
    }
}
