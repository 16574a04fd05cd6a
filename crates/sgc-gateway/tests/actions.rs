//! Clients that send goals to clients that serve actions, on a network in memory.
#![allow(clippy::unwrap_used)]

mod support;

use std::time::Duration;

use sgc_gateway::{
    ActionEvent, CancelAnswer, Content, Form, GatewayError, Goal, GoalStatus, Session, SessionLimits,
    Subscribe,
};

use support::Site;

const ACTION: &str = "/fibonacci";
const TYPE: &str = "example_interfaces/action/Fibonacci";
const PATIENCE: Duration = Duration::from_secs(10);

/// Serves goals: negative orders are rejected, those below ten succeed at once, others end when they are cancelled.
async fn serve(session: Session) {
    let mut serving = session.serve_action(ACTION, Some(TYPE)).await.unwrap();
    let replier = serving.replier();
    tokio::spawn(async move {
        while let Some(event) = serving.next().await {
            match event {
                ActionEvent::Goal { id, goal } => {
                    let goal = serving.write(&goal, Form::Json).unwrap();
                    let is_taken = !goal.starts_with(br#"{"order":-"#);
                    replier.answer(&id, is_taken).await.unwrap();
                    if !is_taken {
                        continue;
                    }
                    let feedback = Content::json(r#"{"sequence":[0,1]}"#);
                    replier.feedback(&id, &feedback).await.unwrap();
                    if goal == r#"{"order":5}"# {
                        let result = Content::json(r#"{"sequence":[0,1,1,2,3]}"#);
                        replier.finish(&id, GoalStatus::Succeeded, &result).await.unwrap();
                    }
                }
                ActionEvent::Cancel { id } => {
                    let result = Content::json(r#"{"sequence":[0]}"#);
                    replier.finish(&id, GoalStatus::Canceled, &result).await.unwrap();
                }
            }
        }
    });
}

fn order(order: i32) -> Content {
    Content::json(format!(r#"{{"order":{order}}}"#))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_goal_is_taken_told_of_and_done() {
    let site = Site::new().await;
    serve(site.session("server")).await;
    let client = site.session("client");
    assert_eq!(client.graph().actions[ACTION].type_name, TYPE);
    let (goal, mut feedback) = client.send_goal(ACTION, None, &order(5)).await.unwrap();
    assert_eq!(feedback.next(Form::Json).await.unwrap().unwrap(), r#"{"sequence":[0,1]}"#);
    for _ in 0..2 {
        let outcome = goal.outcome(Form::Json, PATIENCE).await.unwrap();
        assert_eq!(outcome.status, GoalStatus::Succeeded);
        assert_eq!(outcome.result, r#"{"sequence":[0,1,1,2,3]}"#);
    }
    assert_eq!(goal.cancel().await.unwrap(), CancelAnswer::Ended);
    let rejected = client.send_goal(ACTION, None, &order(-1)).await.unwrap_err();
    assert_eq!(rejected, GatewayError::GoalRejected { name: ACTION.into() });
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_goal_is_given_up_as_its_client_wishes() {
    let site = Site::new().await;
    serve(site.session("server")).await;
    let client = site.session("client");
    let (goal, _feedback) = client.send_goal(ACTION, None, &order(50)).await.unwrap();
    let waiting = {
        let goal = goal.clone();
        tokio::spawn(async move { goal.outcome(Form::Json, PATIENCE).await.unwrap() })
    };
    assert_eq!(goal.cancel().await.unwrap(), CancelAnswer::Taken);
    assert_eq!(waiting.await.unwrap().status, GoalStatus::Canceled);
    // A late subscriber sees the current status.
    let wanted = Subscribe { topic: format!("{ACTION}/_action/status"), depth: 1, ..Subscribe::default() };
    let mut heard = client.subscribe(wanted).await.unwrap();
    let status = heard.next().await.unwrap();
    let status = heard.write(&status.message, Form::Json).unwrap();
    assert!(status.ends_with(br#""status":5}]}"#), "{status:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn goals_of_a_server_that_goes_are_aborted() {
    let site = Site::new().await;
    let server = site.session("server");
    let mut serving = server.serve_action(ACTION, Some(TYPE)).await.unwrap();
    let client = site.session("client");
    let served = tokio::spawn(async move {
        let Some(ActionEvent::Goal { id, .. }) = serving.next().await else { panic!("no goal") };
        serving.replier().answer(&id, true).await.unwrap();
        serving
    });
    let (goal, _feedback) = client.send_goal(ACTION, None, &order(50)).await.unwrap();
    let waiting = tokio::spawn(async move { goal.outcome(Form::Json, PATIENCE).await.unwrap() });
    drop(served.await.unwrap());
    let outcome = waiting.await.unwrap();
    assert_eq!((outcome.status, &outcome.result[..]), (GoalStatus::Aborted, &br#"{"sequence":[]}"#[..]));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn results_that_are_kept_are_bounded_in_bytes() {
    let site = Site::new().await;
    let server = site.session("server");
    let limits = SessionLimits { waiting_bytes_max: 4096, ..SessionLimits::default() };
    let server = Session::new(&site.hub, server.client().clone(), limits);
    let mut serving = server.serve_action(ACTION, Some(TYPE)).await.unwrap();
    let client = site.session("client");
    let mut goals = Vec::new();
    // There is room for one result of 2 kB or more, and for none of 8 kB.
    for numbers in [500, 501, 2000] {
        let wanted = order(7);
        let (sent, taken) = tokio::join!(client.send_goal(ACTION, None, &wanted), async {
            let Some(ActionEvent::Goal { id, .. }) = serving.next().await else { panic!("a goal was sent") };
            serving.replier().answer(&id, true).await.unwrap();
            id
        });
        let result = Content::json(format!(r#"{{"sequence":[0{}]}}"#, ",1".repeat(numbers - 1)));
        serving.replier().finish(&taken, GoalStatus::Succeeded, &result).await.unwrap();
        goals.push(sent.unwrap().0);
        let status = async |goal: &Goal| goal.outcome(Form::Json, PATIENCE).await.unwrap().status;
        let expected: &[GoalStatus] = match numbers {
            500 => &[GoalStatus::Succeeded],
            501 => &[GoalStatus::Unknown, GoalStatus::Succeeded],
            _ => &[GoalStatus::Unknown; 3],
        };
        for (goal, expected) in goals.iter().zip(expected) {
            assert_eq!(status(goal).await, *expected, "{numbers}");
        }
    }
}
