//! Roles `action-serve` and `action-call`, with `example_interfaces/action/Fibonacci`.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use hiroz::action::GoalStatus;
use hiroz::action::server::ExecutingGoal;
use hiroz::{Builder as _, Result};
use serde_json::json;
use tokio::time::sleep;

use crate::interfaces::{Fibonacci, Goal, Numbers};
use crate::options::{Action, ActionCall};
use crate::{INCOMPLETE, OK, Run, emit, open};

fn fibonacci(order: i32) -> Vec<i32> {
    let mut numbers = vec![0, 1];
    while numbers.len() <= order as usize {
        numbers.push(numbers[numbers.len() - 1] + numbers[numbers.len() - 2]);
    }
    numbers.truncate(order as usize + 1);
    numbers
}

pub async fn serve(options: &Action, mut run: Run) -> Result<u8> {
    let (_context, node) = open(&options.session, &run).await?;
    let goals = Arc::new(AtomicU64::new(0));
    let (step, counted) = (options.step, Arc::clone(&goals));
    let _server = node.create_action_server::<Fibonacci>(&options.name).build()?.with_handler(
        move |goal: ExecutingGoal<Fibonacci>| {
            let counted = Arc::clone(&counted);
            async move {
                counted.fetch_add(1, Ordering::Relaxed);
                emit("goal", json!({ "order": goal.goal.order }));
                let mut sequence = Vec::new();
                for number in fibonacci(goal.goal.order) {
                    sleep(step).await;
                    if goal.is_cancel_requested() {
                        emit("cancel", json!({}));
                        return drop(goal.canceled(Numbers { sequence }));
                    }
                    sequence.push(number);
                    let _ = goal.publish_feedback(Numbers { sequence: sequence.clone() });
                }
                let _ = goal.succeed(Numbers { sequence });
            }
        },
    );
    emit("ready", json!({}));
    run.within(std::future::pending::<()>()).await;
    emit("summary", json!({ "role": "action-serve", "goals": goals.load(Ordering::Relaxed) }));
    Ok(OK)
}

/// Sends one goal, and cancels it if told to.
pub async fn call(options: &ActionCall, mut run: Run) -> Result<u8> {
    let (_context, node) = open(&options.action.session, &run).await?;
    let client = node.create_action_client::<Fibonacci>(&options.action.name).build()?;
    emit("ready", json!({}));
    let (mut lengths, mut cancelling, mut last, mut right) = (Vec::new(), 0, None, false);
    let goal = async {
        client.wait_for_server(Duration::MAX / 4).await;
        emit("service", json!({ "there": true }));
        let mut goal = client.send_goal(Goal { order: options.order }).await?;
        emit("accepted", json!({ "accepted": true }));
        let (id, feedback) = (goal.id(), goal.feedback());
        let mut statuses = goal.status_watch();
        let heard = async {
            let Some(mut feedback) = feedback else { return Ok(()) };
            while let Some(numbers) = feedback.recv().await {
                lengths.push(numbers.sequence.len());
                emit("feedback", json!({ "length": numbers.sequence.len() }));
                if options.cancel && numbers.sequence.len() == 2 {
                    cancelling += client.cancel_goal(id).await?.goals_canceling.len();
                }
            }
            Ok(())
        };
        let result = tokio::select! {
            result = goal.result() => result,
            heard = heard => heard.and(Err("no result".into())),
        }?;
        if let Some(statuses) = &mut statuses {
            let ended =
                statuses.wait_for(|status| matches!(status, GoalStatus::Succeeded | GoalStatus::Canceled));
            last = ended.await.ok().map(|status| *status as i8);
        }
        let expected = fibonacci(options.order);
        let length = if options.cancel { result.sequence.len().min(expected.len()) } else { expected.len() };
        right = result.sequence == expected[..length];
        emit("result", json!({ "status": last, "right": right }));
        Result::Ok(())
    };
    match run.within(goal).await {
        Some(Err(error)) => emit("failed", json!({ "error": error.to_string() })),
        Some(Ok(())) | None => {}
    }
    let grows = lengths.windows(2).all(|pair| pair[1] == pair[0] + 1);
    emit(
        "summary",
        json!({ "role": "action-call", "feedback": lengths.len(), "grows": grows, "last_status": last,
                "cancelling": cancelling, "right": right }),
    );
    Ok(if right && last.is_some() { OK } else { INCOMPLETE })
}
