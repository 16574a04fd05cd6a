//! Endpoints that the local graph shows and that match no other: a partition, which the ROS 2 graph does not contain,
//! keeps them apart.
//!
//! An endpoint without matches gets no data, answers no heartbeat and keeps nothing. Neither Fast DDS nor Cyclone
//! reports a partition as an incompatible QoS.
//!
//! Where DDS Security protects the network, the permissions of the enclave must grant the partition. Those of SROS2
//! do not by default: they name no partitions, which means the default one alone (DDS Security 1.1, 9.4.1.3.2.3).

use std::sync::Arc;

use cyclors::{dds_create_reader, dds_create_writer};
use sgc_ros::{EndpointKind, EndpointSpec, ShownEndpoint};
use sgc_wire::{History, Qos};

use crate::entity::Entity;
use crate::log;
use crate::participant::Participant;

/// The partition of shown endpoints. Endpoints of ROS 2 are in none.
pub(crate) const PARTITION: &str = "sgc/shown";

/// Fields drop in this order: children first.
struct ShownEntities {
    _endpoint: Entity,
    _group: Option<Entity>,
    _topic: Entity,
    _participant: Arc<Participant>,
}

/// Creates the endpoint.
pub(crate) fn create(
    participant: &Arc<Participant>,
    kind: EndpointKind,
    spec: &EndpointSpec,
) -> Result<ShownEndpoint, String> {
    let (history, partitions) = (History::KeepLast(1), vec![PARTITION.to_owned()]);
    let spec = EndpointSpec { qos: Qos { history, partitions, ..spec.qos.clone() }, ..spec.clone() };
    let qos = participant.endpoint_qos(kind, &spec, "")?;
    let topic = participant.topic(&spec)?;
    let group = participant.group(kind, &spec)?;
    let parent = group.as_ref().unwrap_or(participant.entity()).handle();
    // The error reports a refusal, so no log line is needed for each endpoint.
    // SAFETY: the QoS object outlives the call, which copies it; null means no listener.
    let (handle, _) = log::listen(|| unsafe {
        match kind {
            EndpointKind::Reader => dds_create_reader(parent, topic.handle(), qos.as_ptr(), std::ptr::null()),
            EndpointKind::Writer => dds_create_writer(parent, topic.handle(), qos.as_ptr(), std::ptr::null()),
        }
    });
    let endpoint = Entity::new(handle)?;
    let guid = endpoint.guid()?;
    let participant = Arc::clone(participant);
    Ok(ShownEndpoint::new(
        guid,
        ShownEntities { _endpoint: endpoint, _group: group, _topic: topic, _participant: participant },
    ))
}
