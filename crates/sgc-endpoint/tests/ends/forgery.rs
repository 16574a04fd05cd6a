//! Forged packets.
