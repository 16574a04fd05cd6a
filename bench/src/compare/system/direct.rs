//! One DDS network over the path, with nothing in between.

use anyhow::Result;

use super::{Dds, Networks, Running, System, Topic};
use crate::compare::lab::{Lab, Side};

/// Programs that see each other.
pub(crate) struct Direct;

impl System for Direct {
    fn name(&self) -> String {
        "direct".into()
    }

    fn start(&self, lab: &Lab, _: &[Topic]) -> Result<Running> {
        let dds = Side::BOTH.map(|side| match lab.networks {
            Networks::Loopback => Dds::between(lab.address(side), lab.address(side.other())),
            Networks::Stock => Dds::stock(0),
        });
        Ok(Running { processes: Vec::new(), dds })
    }
}
