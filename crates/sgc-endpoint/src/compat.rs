use sgc_trust::{FleetSecret, Identity};
use sgc_wire::NodeId;
pub(crate) struct NamingSecret {
    pub(crate) secret: FleetSecret,
}
pub(crate) trait IdentityExt {
    fn naming_secrets(&self) -> &'static [NamingSecret];
    fn authority(&self) -> Option<NodeId>;
    fn post_quantum(&self) -> bool;
}
impl IdentityExt for Identity {
    fn naming_secrets(&self) -> &'static [NamingSecret] {
        Box::leak(
            self.fleet_secret()
                .map(|s| NamingSecret { secret: s.clone() })
                .into_iter()
                .collect::<Vec<_>>()
                .into_boxed_slice(),
        )
    }
    fn authority(&self) -> Option<NodeId> {
        None
    }
    fn post_quantum(&self) -> bool {
        false
    }
}
