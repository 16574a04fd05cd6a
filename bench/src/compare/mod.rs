//! `compare`: SGC and what a user would pick instead, side by side in one run over one emulated network.
//!
//! What is compared is a [`System`] between two places of a [`Lab`]: it carries topics of programs that know nothing of it.
//! A table is a module here; what it measures are [`Figure`]s, which `report` turns into pages, plots and goals.

mod figures;
mod goals;
mod plot;
mod report;

pub(crate) use figures::{Figure, Figures};
pub(crate) use report::Run;
