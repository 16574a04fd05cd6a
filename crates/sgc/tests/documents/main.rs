//! Documents cite what exists.
//!
//! Each module with a rule walks all Markdown files of the repository and compares what they cite with the code: paths
//! and links ([`paths`]), tests and long names ([`test_names`]), keys of the configuration ([`configuration`]),
//! counters ([`counters`]), command lines of `sgc` ([`commands`]), `make` and `cargo test` ([`build_commands`]), pages
//! of the book ([`summary`]). Placeholders, such as `…` and words in capitals, are passed over. Four reference pages
//! are made of the code and compared with what is committed ([`generated`]). One rule reads the code alone: files of a
//! crate import each other in one direction ([`import_circles`]).

#![allow(clippy::unwrap_used)]

mod build_commands;
mod command_line_page;
mod commands;
mod configuration;
mod counters;
mod generated;
mod import_circles;
mod markdown;
mod metrics_page;
mod paths;
mod report;
mod repository;
mod rust_tokens;
mod shell;
mod status_page;
mod summary;
mod test_names;
