//! The keys that this node signs messages with: one for each suite, made where it may take its time.
//!
//! RSA keys take up to seconds. They never outlive the process.

use std::collections::BTreeMap;

use sgc_ros::ShareRule;
use sgc_trust::{MessageKey, Suite};

/// By suite.
pub(crate) type MessageKeys = BTreeMap<Suite, MessageKey>;

/// Makes keys for the suites of these shares that are not among those `known`; blocks for as long as it takes.
pub(crate) fn make_for(shares: &[ShareRule], known: impl Fn(Suite) -> bool) -> MessageKeys {
    let mut keys = MessageKeys::new();
    for suite in shares.iter().map(|share| share.suite).filter(|suite| !known(*suite)) {
        keys.entry(suite).or_insert_with(|| MessageKey::generate(suite));
    }
    keys
}
