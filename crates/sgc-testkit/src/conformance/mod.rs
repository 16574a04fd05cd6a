//! Tests that every [`RosNetwork`] passes: [`conformance_tests!`](crate::conformance_tests) makes them for one.
//!
//! A [`Site`] is a place where networks meet, a ROS domain on Cyclone DDS or a domain in memory. An untagged network
//! stands for a plain ROS 2 program, one with a tag for a proxy. Functions of this module panic if the implementation
//! does not behave as the documentation of [`RosNetwork`] says.
//!
//! Keys, partitions, acknowledgements and threads of their own, which only some networks have, are tested beside them.

mod discovery;
pub mod rig;
mod samples;
mod services;

use std::sync::mpsc::Receiver;

use sgc_ros::{DiscoveredEndpoint, DiscoveryEvent, Guid, RosNetwork};
use sgc_wire::{Durability, History, Liveliness, Qos, Reliability};

pub use self::discovery::*;
use self::rig::{next, string_cdr};
pub use self::samples::*;
pub use self::services::*;

/// A place where networks of one implementation meet.
pub trait Site {
    /// The implementation.
    type Network: RosNetwork;

    /// Whether endpoints of two proxies match, although no samples pass between them.
    const PROXIES_MATCH: bool;

    /// Returns a place that no other network is at.
    fn new() -> Self;

    /// Opens a network: a proxy's with a tag, a program's without.
    fn open(&self, tag: Option<&str>) -> Self::Network;

    /// Opens a network that reports and announces nodes.
    fn open_with_graph(&self, tag: Option<&str>) -> Self::Network {
        self.open(tag)
    }

    /// Returns a payload as a reader gets it.
    fn received(payload: &[u8]) -> Vec<u8> {
        payload.to_vec()
    }

    /// Returns the QoS, different from the default in everything that discovery tells.
    fn told_qos() -> Qos {
        common_qos()
    }
}

/// Makes the tests of this module for a [`Site`](crate::conformance::Site).
#[macro_export]
macro_rules! conformance_tests {
    ($site:ty) => {
        $crate::conformance_tests!(@each $site:
            discovery_tells_name_type_hash_and_full_qos_and_the_end,
            discovery_tells_what_was_there_before,
            proxies_do_not_see_each_others_endpoints_nor_their_own,
            domains_are_apart_even_in_one_process,
            dropped_network_ends_discovery_and_leaves_its_endpoints,
            nodes_and_their_endpoints_are_told_and_gone_with_their_participant,
            announcements_of_proxies_are_hidden_from_other_proxies,
            program_and_proxy_exchange_strings_both_ways,
            network_does_not_hear_itself,
            programs_behind_one_network_without_tag_hear_each_other,
            readers_are_waited_for_until_they_are_there_or_the_time_is_over,
            samples_of_other_proxies_are_skipped,
            large_messages_arrive_intact,
            late_joiners_get_history_of_the_depth_asked_for,
            source_time_and_writer_are_preserved,
            queued_samples_leave_with_the_next_or_a_flush,
            payloads_outlive_reader_and_network,
            requests_and_replies_find_each_other,
            request_without_a_server_says_so_and_proxies_do_not_call_each_other,
            programs_behind_one_network_without_tag_call_each_other,
            server_made_anew_answers_what_the_one_before_was_asked,
            many_calls_at_once_are_each_answered_once,
        );
    };
    (@each $site:ty: $($test:ident,)*) => {
        $(#[test] fn $test() {
            $crate::conformance::$test::<$site>();
        })*
    };
}

/// Returns the QoS that every network tells, different from the default in each policy.
pub fn common_qos() -> Qos {
    Qos {
        reliability: Reliability::Reliable,
        durability: Durability::TransientLocal,
        history: History::KeepLast(70),
        deadline_ns: Some(1_500_000_000),
        lifespan_ns: Some(60_000_000_000),
        liveliness: Liveliness::ManualByTopic,
        lease_ns: Some(2_000_000_000),
        ..Qos::default()
    }
}

/// Returns a string as a reader gets it.
fn received<S: Site>(text: &str) -> Vec<u8> {
    S::received(&string_cdr(text))
}

/// Returns the next event about endpoints, and skips those about nodes, which some networks report unasked.
fn about_endpoints(events: &Receiver<DiscoveryEvent>) -> DiscoveryEvent {
    loop {
        match next(events) {
            DiscoveryEvent::Nodes { .. } => {}
            other => return other,
        }
    }
}

fn appeared(events: &Receiver<DiscoveryEvent>) -> DiscoveredEndpoint {
    match about_endpoints(events) {
        DiscoveryEvent::Appeared(endpoint) => endpoint,
        other => panic!("an appearance was expected: {other:?}"),
    }
}

fn vanished(events: &Receiver<DiscoveryEvent>) -> Guid {
    match about_endpoints(events) {
        DiscoveryEvent::Vanished { guid } => guid,
        other => panic!("an end was expected: {other:?}"),
    }
}
