//! State of the search for each router, for `sgc status`. It displays and decides nothing.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Instant;

use serde::Serialize;
use sgc_sync::lock;
use sgc_transport::LinkUrl;
use sgc_wire::NodeId;

use super::target::DialTarget;
use super::urls::SkippedUrl;
use crate::clock::time_now;
use crate::data::stats::Drops;

/// State of a search whose router the node is linked to.
pub(crate) const LINKED: &str = "linked";

/// A router that the node looks for, or a place where it looks for routers.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct RouterStatus {
    /// The URL as the user wrote it: `quic://…`, `srv://…`, `mdns://…`.
    pub router: String,
    /// The origin of the URL: `"static"`, `"token"`, `"srv"` or `"mdns"`.
    pub found_by: &'static str,
    /// The URL that the node dials, or dialled last.
    pub at: Option<String>,
    /// The state of the search: `"connecting"`, `"linked"`, `"trying again"`, `"standing back"`, `"looking up"`,
    /// `"looking"`.
    pub state: &'static str,
    /// The node id of the linked router.
    pub peer: Option<String>,
    /// The number of failures in a row.
    pub failures: u32,
    /// The reason why the link uses another URL than the first of several.
    pub why_not_first: Option<String>,
    /// The last failure.
    pub last_failure: Option<String>,
    /// Seconds until the next attempt.
    pub again_in_s: Option<u64>,
}

/// Table of all searches for routers. Each task owns one row.
#[derive(Clone, Debug, Default)]
pub(crate) struct Board {
    shared: Arc<BoardInner>,
}

#[derive(Debug, Default)]
struct BoardInner {
    rows: Mutex<Rows>,
    drops: Drops,
}

#[derive(Debug, Default)]
struct Rows {
    next: u64,
    rows: BTreeMap<u64, (RouterStatus, Option<Instant>)>,
}

impl Board {
    /// Adds a row for a router. Dropping it removes the row.
    pub(crate) fn row(&self, router: impl ToString, found_by: &'static str) -> StatusRow {
        let mut rows = self.rows();
        let id = rows.next;
        rows.next += 1;
        let status = RouterStatus {
            router: router.to_string(),
            found_by,
            at: None,
            state: "looking",
            peer: None,
            failures: 0,
            why_not_first: None,
            last_failure: None,
            again_in_s: None,
        };
        rows.rows.insert(id, (status, None));
        drop(rows);
        StatusRow { id, board: self.clone() }
    }

    /// Returns all rows in the order in which they were added.
    pub(crate) fn snapshot(&self) -> Vec<RouterStatus> {
        let now = time_now();
        let shown = |(status, due): &(RouterStatus, Option<Instant>)| RouterStatus {
            again_in_s: due.map(|due| due.saturating_duration_since(now).as_secs()),
            ..status.clone()
        };
        self.rows().rows.values().map(shown).collect()
    }

    /// Counts announcements that were ignored.
    pub(crate) fn drops(&self) -> &Drops {
        &self.shared.drops
    }

    fn rows(&self) -> MutexGuard<'_, Rows> {
        lock(&self.shared.rows)
    }
}

/// The row of one task.
#[derive(Debug)]
pub(crate) struct StatusRow {
    id: u64,
    board: Board,
}

impl StatusRow {
    /// Shows that DNS is being asked.
    pub(crate) fn looking_up(&self) {
        self.change(|row, due| {
            row.state = "looking up";
            *due = None;
        });
    }

    /// Shows that this target is being dialled.
    pub(crate) fn connecting(&self, target: &DialTarget) {
        self.change(|row, due| {
            row.at = Some(target.url.to_string());
            row.state = "connecting";
            *due = None;
        });
    }

    /// Shows that a link is up.
    pub(crate) fn linked(&self, url: &LinkUrl, node: &NodeId) {
        self.change(|row, due| {
            row.at = Some(url.to_string());
            row.state = LINKED;
            row.peer = Some(node.to_string());
            row.failures = 0;
            *due = None;
        });
    }

    /// Shows why URLs that are better than the one in use were skipped.
    pub(crate) fn passed_over(&self, better: &[LinkUrl], passed: &[SkippedUrl]) {
        let of = |url: &LinkUrl| {
            let why = passed.iter().find(|passed| passed.url == *url).map(|passed| passed.why.as_str());
            // Messages of the transport already begin with the URL.
            let why = why.unwrap_or("did not work last time");
            let why = why.strip_prefix(&format!("{url}: ")).unwrap_or(why);
            format!("{}: {why}", url.scheme)
        };
        let why = better.iter().map(of).collect::<Vec<_>>().join("; ");
        self.change(|row, _| row.why_not_first = (!better.is_empty()).then_some(why));
    }

    /// Shows that the link ended.
    pub(crate) fn ended(&self, why: &str) {
        self.change(|row, _| {
            row.state = "trying again";
            row.peer = None;
            row.why_not_first = None;
            row.last_failure = Some(format!("link ended: {why}"));
        });
    }

    /// Shows that an attempt failed.
    pub(crate) fn failed(&self, why: &str) {
        self.change(|row, _| {
            row.failures = row.failures.saturating_add(1);
            row.last_failure = Some(why.to_owned());
        });
    }

    /// Shows a fault that is no failure of a link, such as a DNS fault while a link is up.
    pub(crate) fn noted(&self, why: &str) {
        self.change(|row, _| row.last_failure = Some(why.to_owned()));
    }

    /// Shows that the task waits until `until`.
    pub(crate) fn waits(&self, until: Option<Instant>, stands_back: bool) {
        self.change(|row, due| {
            row.state = if stands_back { "standing back" } else { "trying again" };
            *due = until;
        });
    }

    fn change(&self, change: impl FnOnce(&mut RouterStatus, &mut Option<Instant>)) {
        if let Some((row, due)) = self.board.rows().rows.get_mut(&self.id) {
            change(row, due);
        }
    }
}

impl Drop for StatusRow {
    fn drop(&mut self) {
        self.board.rows().rows.remove(&self.id);
    }
}
