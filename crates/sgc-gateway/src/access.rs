//! What a client may do.

use std::sync::Arc;

/// What a client does with an interface.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Right {
    /// Reads a topic.
    Subscribe,
    /// Writes to one.
    Publish,
    /// Calls a service or an action.
    Call,
    /// Serves one.
    Serve,
}

/// What a client may do.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Scope {
    /// Patterns of topics.
    pub subscribe: Vec<String>,
    /// Patterns of topics.
    pub publish: Vec<String>,
    /// Patterns of services and actions.
    pub call: Vec<String>,
    /// Patterns of services and actions.
    pub serve: Vec<String>,
}

impl Scope {
    /// All of it.
    pub fn everything() -> Self {
        let all = || vec!["/**".to_owned()];
        Self { subscribe: all(), publish: all(), call: all(), serve: all() }
    }

    /// Whether something is within.
    pub fn permits(&self, right: Right, name: &str) -> bool {
        let patterns = match right {
            Right::Subscribe => &self.subscribe,
            Right::Publish => &self.publish,
            Right::Call => &self.call,
            Right::Serve => &self.serve,
        };
        patterns.iter().any(|pattern| sgc_ros::matches(pattern, name))
    }
}

/// Who was admitted.
#[derive(Clone, Debug)]
pub struct Client {
    /// What it is called in status and logs.
    pub name: Arc<str>,
    /// What it may do.
    pub scope: Arc<Scope>,
}
