//! Conditions that are reported to a user: alerts, problems of routes, and refused nodes.

pub mod alerts;
pub(crate) mod problem_log;
pub(crate) mod refusals;
