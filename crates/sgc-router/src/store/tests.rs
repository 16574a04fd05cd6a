//! Tests of the store machine.
