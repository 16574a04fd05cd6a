//! `sgc ping`: measures the round trip to another node.

use std::process::ExitCode;
use std::time::{Duration, Instant};

use clap::Args;
use serde::Serialize;
use sgc_diagnosis::fleet::ping as ask;
use sgc_node::admin::ReportAnswer;
use sgc_node::admin::report::ReportPath;
use sgc_process::style::Line;
use sgc_trust::NodeName;

use crate::error::{CliError, EXIT_FAILURE};
use crate::node::NodeArgs;
use crate::output;
use crate::span::parse_span;

/// Measure the round trip to another node, and show over which path it answers
///
/// Your node that runs here asks the other over the mesh, as an observer: enroll your node with `--group observers`. The
/// time includes the signatures of question and answer. The first answer takes longer, because the name of the node is
/// looked up. Exit code 0 means that an answer came; 1 means that none did.
#[derive(Debug, Args)]
pub(crate) struct PingArgs {
    /// Node to ask
    #[arg(value_name = "NODE")]
    at: String,
    /// End after N questions
    #[arg(short = 'n', long, value_name = "N", default_value_t = 4, value_parser = clap::value_parser!(u64).range(1..))]
    count: u64,
    /// Time from question to question
    #[arg(long, value_name = "TIME", default_value = "1s", value_parser = parse_span)]
    interval: Duration,
    #[command(flatten)]
    node: NodeArgs,
    /// Print each answer as a line of JSON
    #[arg(long)]
    json: bool,
}

/// Runs `sgc ping`.
pub(crate) fn ping(args: &PingArgs) -> Result<ExitCode, CliError> {
    args.at.parse::<NodeName>()?;
    let socket = args.node.socket()?;
    let mut answered = Vec::new();
    for n in 0..args.count {
        let begun = Instant::now();
        let answer = ask(&socket, &args.at)?;
        if answer.error.is_none() {
            answered.push(answer.answered_us);
        }
        if args.json {
            output::json(&AnswerJson::of(&args.at, &answer))?;
        } else {
            lines(&args.at, &answer).into_iter().try_for_each(|line| line.cleaned().print())?;
        }
        if n + 1 < args.count {
            std::thread::sleep(args.interval.saturating_sub(begun.elapsed()));
        }
    }
    if !args.json {
        output::line(summary(args.count, &answered))?;
    }
    Ok(if answered.is_empty() { ExitCode::from(EXIT_FAILURE) } else { ExitCode::SUCCESS })
}

/// An answer as JSON.
#[derive(Debug, Serialize)]
struct AnswerJson<'a> {
    node: &'a str,
    /// Time from question to answer; null if none came.
    answered_us: Option<u64>,
    /// Version of the other program.
    version: Option<&'a str>,
    /// Path over which it answered; null for the node here.
    path: Option<&'a ReportPath>,
    error: Option<&'a str>,
    fix: &'a str,
}

impl<'a> AnswerJson<'a> {
    fn of(node: &'a str, answer: &'a ReportAnswer) -> Self {
        let ReportAnswer { pong, answered_us, path, error, fix, .. } = answer;
        Self {
            node,
            answered_us: error.is_none().then_some(*answered_us),
            version: pong.as_ref().map(|pong| pong.version.as_str()),
            path: path.as_ref(),
            error: error.as_deref(),
            fix,
        }
    }
}

fn lines(node: &str, answer: &ReportAnswer) -> Vec<Line> {
    if let Some(error) = &answer.error {
        let fix = (!answer.fix.is_empty()).then(|| format!("  {}", answer.fix).into());
        return [Some(format!("{node}: {error}").into()), fix].into_iter().flatten().collect();
    }
    let path = match &answer.path {
        None => "the node here".into(),
        Some(path) if path.direct => "directly".into(),
        Some(path) => format!("relayed by {}", path.via),
    };
    let links = answer.path.as_ref().map(|path| format!(" ({} by its links)", output::millis(path.path_us)));
    let answered = output::millis(answer.answered_us);
    vec![format!("{node} answered after {answered}, {path}{}", links.unwrap_or_default()).into()]
}

fn summary(asked: u64, answered: &[u64]) -> String {
    let came = answered.len() as u64;
    let (Some(min), Some(max)) = (answered.iter().min(), answered.iter().max()) else {
        return format!("{asked} asked, none answered");
    };
    let mean = answered.iter().sum::<u64>() / came;
    let [min, mean, max] = [*min, mean, *max].map(output::millis);
    format!("{asked} asked, {came} answered: {min} at least, {mean} on average, {max} at most")
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn answers_say_how_long_and_over_which_path() {
        let said = |answer: &ReportAnswer| {
            lines("robot", answer).iter().map(ToString::to_string).collect::<Vec<_>>()
        };
        let over = |direct| {
            let path = ReportPath { via: "cloud".into(), direct, path_us: 42_000 };
            ReportAnswer { answered_us: 43_200, path: Some(path), ..ReportAnswer::default() }
        };
        assert_eq!(said(&over(false)), ["robot answered after 43 ms, relayed by cloud (42 ms by its links)"]);
        assert_eq!(said(&over(true)), ["robot answered after 43 ms, directly (42 ms by its links)"]);
        let answer = over(true);
        let path = json!({ "via": "cloud", "direct": true, "path_us": 42_000 });
        let told = json!({
            "node": "robot", "answered_us": 43_200, "version": null, "path": path, "error": null, "fix": "",
        });
        assert_eq!(serde_json::to_value(AnswerJson::of("robot", &answer)).unwrap(), told);
        let own = ReportAnswer { answered_us: 900, ..ReportAnswer::default() };
        assert_eq!(said(&own), ["robot answered after 0.90 ms, the node here"]);
        let error = ReportAnswer {
            error: Some("it does not answer".into()),
            fix: "try again".into(),
            ..ReportAnswer::default()
        };
        assert_eq!(said(&error), ["robot: it does not answer", "  try again"]);
        assert_eq!(AnswerJson::of("robot", &error).answered_us, None);
    }

    #[test]
    fn summary_counts_what_came() {
        assert_eq!(summary(3, &[]), "3 asked, none answered");
        let some = summary(3, &[1000, 3000]);
        assert_eq!(some, "3 asked, 2 answered: 1.00 ms at least, 2.00 ms on average, 3.00 ms at most");
    }
}
