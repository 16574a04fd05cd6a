//! Signing keys of this node's messages: one for each suite, created on a blocking thread.
//!
//! RSA keys take up to seconds. Keys never outlive the process.

use std::collections::BTreeMap;

use sgc_ros::ShareRule;
use sgc_trust::{MessageKey, Suite};

/// Signing keys by suite.
pub(crate) type MessageKeys = BTreeMap<Suite, MessageKey>;

/// Creates keys for suites of these shares that are not `known`. Blocks until they exist.
pub(crate) fn make_for(shares: &[ShareRule], known: impl Fn(Suite) -> bool) -> MessageKeys {
    let mut keys = MessageKeys::new();
    for suite in shares.iter().map(|share| share.suite).filter(|suite| !known(*suite)) {
        keys.entry(suite).or_insert_with(|| MessageKey::generate(suite));
    }
    keys
}
