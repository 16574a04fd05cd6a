//! Environment variables.

/// Looks up an environment variable for the configuration.
pub(crate) fn environment(name: &str) -> Option<String> {
    std::env::var(name).ok()
}
