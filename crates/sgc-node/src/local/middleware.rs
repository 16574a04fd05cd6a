//! The local network of a node by its middleware: DDS, Zenoh or both.

use sgc_dds::{CycloneNetwork, DdsConfig};
use sgc_ros::RosError;

use crate::local::zenoh::ZenohConfig;

/// The local network of a node.
#[cfg(feature = "zenoh")]
pub(crate) type LocalNetwork = crate::local::joined::Joined<CycloneNetwork, sgc_zenoh_network::ZenohNetwork>;
/// The local network of a node.
#[cfg(not(feature = "zenoh"))]
pub(crate) type LocalNetwork = CycloneNetwork;

/// Opens the networks that have a configuration. May block.
///
/// # Errors
/// [`RosError::Domain`] of the first network that does not open.
#[cfg(feature = "zenoh")]
pub(crate) fn open_both(
    dds: Option<&DdsConfig>,
    zenoh: Option<&ZenohConfig>,
) -> Result<LocalNetwork, RosError> {
    let dds = dds.map(CycloneNetwork::open).transpose()?;
    // Zenoh's TLS takes the provider of the process. It would make that `ring`, and cryptography here is AWS-LC alone. Another
    // network of this process may have done so already.
    let _ = rustls::crypto::aws_lc_rs::default_provider().install_default();
    let zenoh = zenoh.map(sgc_zenoh_network::ZenohNetwork::open).transpose()?;
    Ok(LocalNetwork::new(dds, zenoh))
}

/// Opens the DDS network. The configuration has no other in a build without Zenoh.
#[cfg(not(feature = "zenoh"))]
pub(crate) fn open_both(
    dds: Option<&DdsConfig>,
    _zenoh: Option<&ZenohConfig>,
) -> Result<LocalNetwork, RosError> {
    CycloneNetwork::open(dds.unwrap_or(&DdsConfig::default()))
}
