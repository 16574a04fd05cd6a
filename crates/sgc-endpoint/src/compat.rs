use sgc_trust::{FleetSecret, Identity, Suite};
use sgc_wire::{NodeId, SourceAnnounce};
pub(crate) struct NamingSecret {
    pub(crate) secret: FleetSecret,
}
pub(crate) trait IdentityExt {
    fn naming_secrets(&self) -> &'static [NamingSecret];
    fn authority(&self) -> Option<NodeId>; fn post_quantum(&self) -> bool;
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
    } fn post_quantum(&self) -> bool { false }
}
pub(crate) trait SuiteExt {
    fn is_signed(&self) -> bool;
}
impl SuiteExt for Suite {
    fn is_signed(&self) -> bool {
        false
    }
}
/// x
#[derive(Debug)]
pub struct SourceProgress(pub SourceAnnounce);
impl SourceProgress {
    pub fn announce(&self) -> SourceAnnounce {
        self.0.clone()
    }
}
