//! The goals: so many times the rate, and so small a part of the round trip, of the rosbridge that the paper measured.

use super::REFERENCE_BYTES;
use super::figures::Figure;
use crate::report::{Table, digits};

/// Rate of the paper's reference, `rosbridge_suite`, in messages of [`REFERENCE_BYTES`] per second. It was measured
/// once, on a machine such as that of the first published figures, not in this run.
const PEER_PER_SECOND: f64 = 640.0;
/// Its round trip, µs; and with its polling patched away.
const PEER_TRIP_US: f64 = 12_000.0;
const PEER_UNPOLLED_TRIP_US: f64 = 2_300.0;
/// At least so many times its rate.
const FASTER: f64 = 50.0;
/// At most this part of its round trip.
const SHORTER: f64 = 0.1;

/// Each goal, what was reached, and whether that is enough.
pub(super) fn table(figures: &[Figure]) -> Table {
    let mut rows = Vec::new();
    for figure in figures.iter().filter(|figure| figure.size == REFERENCE_BYTES) {
        let mut push = |what: &str, bound: String, reached: String, times: f64, is_met: bool| {
            let met = if is_met { "met" } else { "**not met**" };
            let row = [figure.way, what, &bound, &reached, &format!("{} ×", digits(times)), met];
            rows.push(row.map(str::to_owned).to_vec());
        };
        let least = FASTER * PEER_PER_SECOND;
        for (what, rate) in
            [("messages/s to the client", &figure.down), ("messages/s from the client", &figure.up)]
        {
            let rate = rate.per_second;
            push(what, format!("≥ {least:.0}"), format!("{rate:.0}"), rate / PEER_PER_SECOND, rate >= least);
        }
        let (most, trip) = (SHORTER * PEER_TRIP_US, figure.round_trip_us.p50);
        push("round trip p50, µs", format!("≤ {most:.0}"), digits(trip), PEER_TRIP_US / trip, trip <= most);
    }
    let title = format!(
        "Goals, at {REFERENCE_BYTES} B. The peer is the paper's rosbridge (`rosbridge_suite`): about {PEER_PER_SECOND:.0} messages/s and \
         {:.0} ms of round trip, {:.1} ms with its polling patched away; quoted, as measured once on such a machine, and not measured in \
         this run",
        PEER_TRIP_US / 1e3,
        PEER_UNPOLLED_TRIP_US / 1e3,
    );
    Table { title, columns: vec!["by", "what", "goal", "reached", "times the peer", ""], rows }
}
