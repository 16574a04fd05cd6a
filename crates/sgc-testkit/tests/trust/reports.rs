//! A node's reports are for those whom it answers, sealed, and one question of a node at a time.

use bytes::Bytes;
use sgc_endpoint::{Event, RefusedBy, pack_report, unpack_report};
use sgc_testkit::{NodeKey, World, WorldConfig};
use sgc_trust::VerifiedPeer;
use sgc_wire::{Encode as _, Name, RefuseReason, Report, ReportQuestion, SinkId};

use crate::{Scene, ms, scene_with};

const HOW_IT_IS: ReportQuestion = ReportQuestion::Node;

/// Returns the questions that a node got.
fn questions(world: &World, node: NodeKey) -> Vec<(SinkId, VerifiedPeer, Bytes)> {
    let of_question = |(event, _): (&Event, _)| match event {
        Event::ReportAsked { sink, peer, question } => Some((*sink, peer.clone(), question.clone())),
        _ => None,
    };
    crate::events(world, node, 0).filter_map(of_question).collect()
}

/// Returns the reports that a node got, with the names of the questions.
fn reports(world: &World, node: NodeKey) -> Vec<(Name, Bytes)> {
    let of_report = |(event, _): (&Event, _)| match event {
        Event::Report { name, report } => Some((*name, unpack_report(report).expect("as packed"))),
        _ => None,
    };
    crate::events(world, node, 0).filter_map(of_report).collect()
}

/// Returns the refusals that a node got.
fn refusals(world: &World, node: NodeKey) -> Vec<RefusedBy> {
    let of_refusal = |(event, _): (&Event, _)| match event {
        Event::ReportRefused { by, .. } => Some(*by),
        _ => None,
    };
    crate::events(world, node, 0).filter_map(of_refusal).collect()
}

fn report(document: &str) -> Report {
    pack_report(&Bytes::copy_from_slice(document.as_bytes())).expect("it is short")
}

#[test]
fn question_reaches_a_node_through_routers_and_only_its_asker_gets_the_report() {
    let mut scene = scene_with(WorldConfig::new(310));
    let Scene { world, arm, east, desk, lap, .. } = &mut scene;
    // A router has no secret of the fleet, and reports all the same.
    for node in [*arm, *east] {
        let name = world.ask_report(*desk, node, &HOW_IT_IS).expect("it runs");
        world.run(ms(500));
        assert_eq!(questions(world, node).len(), 0, "it offers no reports yet");
        world.offer_reports(node, true);
        world.run(ms(1000));
        let got = questions(world, node);
        let [(sink, peer, question)] = &got[..] else { panic!("{got:?}") };
        assert_eq!((&question[..], peer.node_id), (&HOW_IT_IS.to_vec()[..], world.identity(*desk).node_id()));
        let text = format!("{{\"node\": \"{node:?}\"}}");
        world.answer_report(node, *sink, Ok(report(&text)));
        world.run(ms(500));
        assert_eq!(reports(world, *desk).pop(), Some((name, text.into())));
        world.leave_name(*desk, &name);
    }
    assert!(reports(world, *lap).is_empty());
}

#[test]
fn refused_asker_is_told_and_a_withdrawn_name_is_no_longer_found() {
    let mut scene = scene_with(WorldConfig::new(311));
    let Scene { world, arm, desk, .. } = &mut scene;
    world.offer_reports(*arm, true);
    let interface = ReportQuestion::Interface("/camera".into());
    let name = world.ask_report(*desk, *arm, &interface).expect("it runs");
    world.run(ms(1000));
    let (sink, _, question) = questions(world, *arm).pop().expect("it was asked");
    assert_eq!(&question[..], &interface.to_vec()[..]);
    world.answer_report(*arm, sink, Err(RefuseReason::NotPermitted));
    world.run(ms(500));
    assert_eq!(refusals(world, *desk), [RefusedBy::Owner(RefuseReason::NotPermitted)]);
    world.leave_name(*desk, &name);
    world.offer_reports(*arm, false);
    world.run(ms(500));
    world.ask_report(*desk, *arm, &HOW_IT_IS);
    world.run(ms(2000));
    assert_eq!((questions(world, *arm).len(), reports(world, *desk).len()), (1, 0));
    world.offer_reports(*arm, true);
    world.run(ms(2000));
    assert_eq!(questions(world, *arm).len(), 2, "it is found again");
}

#[test]
fn later_question_of_a_node_takes_the_place_of_its_earlier_one() {
    let mut scene = scene_with(WorldConfig::new(312));
    let Scene { world, arm, desk, lap, .. } = &mut scene;
    world.offer_reports(*arm, true);
    for asker in [*desk, *lap] {
        world.ask_report(asker, *arm, &HOW_IT_IS);
    }
    world.run(ms(1000));
    let earlier = questions(world, *arm);
    assert_eq!(earlier.len(), 2, "each node has a place");
    world.ask_report(*desk, *arm, &ReportQuestion::Interface("/a".into()));
    world.run(ms(1000));
    let desk_id = world.identity(*desk).node_id();
    let sink_of_desk = |questions: &[(SinkId, VerifiedPeer, Bytes)]| {
        questions.iter().rev().find(|(_, peer, _)| peer.node_id == desk_id).map(|(sink, ..)| *sink)
    };
    let (old, new) =
        (sink_of_desk(&earlier).expect("asked"), sink_of_desk(&questions(world, *arm)).expect("asked"));
    assert_ne!(old, new);
    for (sink, text) in [(old, "old"), (new, "new")] {
        world.answer_report(*arm, sink, Ok(report(text)));
    }
    world.run(ms(500));
    let texts: Vec<_> = reports(world, *desk).into_iter().map(|(_, text)| text).collect();
    assert_eq!(texts, ["new"]);
}
