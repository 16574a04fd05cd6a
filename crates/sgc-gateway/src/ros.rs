//! [`LocalRos`]: a local ROS 2 network of any implementation, as the hub uses it.

use std::any::Any;
use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use sgc_ros::{
    DiscoveryHandler, EndpointSpec, GraphNode, Guid, Reach, RequestHandler, RosClient, RosError, RosNetwork,
    RosServer, RosWriter, SampleHandler, ServiceSpec,
};

/// A reader on the local network. Dropping it may block.
pub struct LocalReader {
    guid: Guid,
    _reader: Box<dyn Any + Send>,
}

impl LocalReader {
    /// Wraps what keeps the reader until it is dropped.
    pub fn new(guid: Guid, reader: impl Any + Send) -> Self {
        Self { guid, _reader: Box::new(reader) }
    }

    /// Returns the GUID.
    pub fn guid(&self) -> Guid {
        self.guid
    }
}

impl fmt::Debug for LocalReader {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("LocalReader").field(&self.guid).finish()
    }
}

/// [`RosNetwork`] without its types. Every call may block.
pub trait LocalRos: Send + Sync + 'static {
    /// [`RosNetwork::discover`].
    fn discover(&self, handler: DiscoveryHandler) -> Result<(), RosError>;
    /// [`RosNetwork::create_reader`].
    fn reader(&self, spec: &EndpointSpec, handler: SampleHandler) -> Result<LocalReader, RosError>;
    /// [`RosNetwork::create_writer`].
    fn writer(&self, spec: &EndpointSpec) -> Result<Box<dyn RosWriter>, RosError>;
    /// [`RosNetwork::create_client`].
    fn client(&self, spec: &ServiceSpec, handler: RequestHandler) -> Result<Box<dyn RosClient>, RosError>;
    /// [`RosNetwork::create_server`].
    fn server(&self, spec: &ServiceSpec, handler: RequestHandler) -> Result<Box<dyn RosServer>, RosError>;
    /// [`RosNetwork::announce`].
    fn announce(&self, nodes: &[GraphNode]) -> Result<(), RosError>;
    /// [`RosNetwork::reach`].
    fn reach(&self) -> Reach;
    /// [`RosNetwork::gains_by_reopening`].
    fn gains_by_reopening(&self) -> Result<bool, RosError>;
    /// [`RosNetwork::close`].
    fn close(self: Arc<Self>, max: Duration) -> bool;
}

impl<N: RosNetwork> LocalRos for N {
    fn discover(&self, handler: DiscoveryHandler) -> Result<(), RosError> {
        RosNetwork::discover(self, handler)
    }

    fn reader(&self, spec: &EndpointSpec, handler: SampleHandler) -> Result<LocalReader, RosError> {
        let reader = self.create_reader(spec, handler)?;
        Ok(LocalReader::new(self.reader_guid(&reader), reader))
    }

    fn writer(&self, spec: &EndpointSpec) -> Result<Box<dyn RosWriter>, RosError> {
        Ok(Box::new(self.create_writer(spec)?))
    }

    fn client(&self, spec: &ServiceSpec, handler: RequestHandler) -> Result<Box<dyn RosClient>, RosError> {
        Ok(Box::new(self.create_client(spec, handler)?))
    }

    fn server(&self, spec: &ServiceSpec, handler: RequestHandler) -> Result<Box<dyn RosServer>, RosError> {
        Ok(Box::new(self.create_server(spec, handler)?))
    }

    fn announce(&self, nodes: &[GraphNode]) -> Result<(), RosError> {
        RosNetwork::announce(self, nodes)
    }

    fn reach(&self) -> Reach {
        RosNetwork::reach(self)
    }

    fn gains_by_reopening(&self) -> Result<bool, RosError> {
        RosNetwork::gains_by_reopening(self)
    }

    fn close(self: Arc<Self>, max: Duration) -> bool {
        RosNetwork::close(self, max)
    }
}
