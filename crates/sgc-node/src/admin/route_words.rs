//! The states of routes in words, for status and graph.

use sgc_ros::{OwnerState, RouteKind, RouteState, RouteStatus};

/// Returns the state of a route.
pub(crate) fn route_state(route: &RouteStatus) -> String {
    let RouteStatus { kind, topic_there, owner, state, .. } = route;
    let called = match (topic_there, kind) {
        (None, _) => String::new(),
        (Some(there), RouteKind::Share | RouteKind::Serve) => format!("shared as {there}, "),
        (Some(there), _) => format!("{owner} calls it {there}, "),
    };
    let state = match (*state, kind) {
        (RouteState::AwaitsLocal, RouteKind::Serve) => "waits for a local server".to_owned(),
        (RouteState::AwaitsLocal, _) => "waits for a local publisher".to_owned(),
        (RouteState::Shared { publishers, subscribers, is_read }, _) => {
            let reading = if is_read { "reading" } else { "not reading: nobody subscribes" };
            format!("{publishers} local publishers, {subscribers} remote subscribers, {reading}")
        }
        (RouteState::Served { servers, callers }, _) => {
            format!("{servers} local servers, {callers} remote nodes may call")
        }
        (RouteState::Owner(state), _) => format!("{owner} {}", owner_state(state)),
        (RouteState::NotListed { is_pattern: true }, _) => {
            format!("{owner} lists nothing that matches (yet)")
        }
        (RouteState::NotListed { .. }, RouteKind::Call) => {
            format!("{owner} has no such service for this node (yet)")
        }
        (RouteState::NotListed { .. }, RouteKind::Publish) => {
            format!("{owner} does not let this node publish on it (yet)")
        }
        (RouteState::NotListed { .. }, _) => format!("{owner} does not share it with this node (yet)"),
        (RouteState::AwaitsGrant, _) => "waits for the owner's grant".to_owned(),
        (RouteState::Refused(by), _) => format!("refused: {by}"),
        (RouteState::Granted { .. }, RouteKind::Call) => "granted".to_owned(),
        (RouteState::Granted { local }, RouteKind::Publish) => format!("granted, {local} local publishers"),
        (RouteState::Granted { local }, _) => format!("granted, {local} local writers"),
    };
    called + &state
}

/// Returns the state of an owner, to stand behind its name.
pub(crate) fn owner_state(state: OwnerState) -> String {
    match state {
        OwnerState::OutOfReach => "is out of reach".to_owned(),
        OwnerState::Gone => "has gone".to_owned(),
        OwnerState::Refuses(by) => format!("refuses its catalogue: {by}"),
    }
}

#[cfg(test)]
mod tests {
    use sgc_endpoint::RefusedBy;
    use sgc_wire::RefuseReason;

    use super::*;

    #[test]
    fn each_state_has_its_words() {
        let mut route = RouteStatus {
            kind: RouteKind::Use,
            topic: "/a".into(),
            topic_there: Some("/b".into()),
            type_name: None,
            name: None,
            owner: "arm".into(),
            state: RouteState::Granted { local: 2 },
        };
        assert_eq!(route_state(&route), "arm calls it /b, granted, 2 local writers");
        route.topic_there = None;
        let refused = RouteState::Refused(RefusedBy::Owner(RefuseReason::NotPermitted));
        let shared = RouteState::Shared { publishers: 1, subscribers: 0, is_read: false };
        for (kind, state, words) in [
            (RouteKind::Share, RouteState::AwaitsLocal, "waits for a local publisher"),
            (RouteKind::Serve, RouteState::AwaitsLocal, "waits for a local server"),
            (
                RouteKind::Share,
                shared,
                "1 local publishers, 0 remote subscribers, not reading: nobody subscribes",
            ),
            (
                RouteKind::Use,
                RouteState::NotListed { is_pattern: false },
                "arm does not share it with this node (yet)",
            ),
            (RouteKind::Use, RouteState::Owner(OwnerState::Gone), "arm has gone"),
            (RouteKind::Use, RouteState::AwaitsGrant, "waits for the owner's grant"),
            (RouteKind::Use, refused, "refused: the owner does not share it with this node"),
        ] {
            (route.kind, route.state) = (kind, state);
            assert_eq!(route_state(&route), words);
        }
    }
}
