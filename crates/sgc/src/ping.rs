//! `sgc ping`: measures the round trip to another node.

use std::process::ExitCode;
use std::time::{Duration, Instant};

use clap::Args;
use serde::Serialize;
use sgc_diagnosis::fleet::ping as ask;
use sgc_node::admin::ReportAnswer;
use sgc_node::admin::not_direct::NotDirectReason;
use sgc_node::admin::report::ReportPath;
use sgc_process::style::Line;
use sgc_trust::NodeName;

use crate::error::{CliError, EXIT_FAILURE};
use crate::node::NodeArgs;
use crate::output;
use crate::span::parse_span;

/// Measure the round trip to another node, directly and over routers, and show over which path it answers
///
/// Your node that runs here asks the other over the mesh, as an observer: enroll your node with `--group observers`. If a
/// direct link leads to it, each question is asked twice: over that link, then over routers. If there is none, the reason
/// is shown. The time includes the signatures of question and answer, and often the search for the node's name. Exit code
/// 0 means that an answer came; 1 means that none did.
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
    let mut times = Times::default();
    let mut not_direct = None;
    for n in 0..args.count {
        let begun = Instant::now();
        let answer = ask(&socket, &args.at)?;
        times.take(&answer);
        if args.json {
            output::json(&AnswerJson::of(&args.at, &answer))?;
        } else {
            let mut lines = lines(&args.at, &answer);
            // The reason is said once.
            if answer.not_direct != not_direct {
                not_direct = answer.not_direct;
                lines.extend(not_direct.into_iter().flat_map(why_not_direct));
            }
            lines.into_iter().try_for_each(|line| line.cleaned().print())?;
        }
        if n + 1 < args.count {
            std::thread::sleep(args.interval.saturating_sub(begun.elapsed()));
        }
    }
    if !args.json {
        times.summary(args.count).into_iter().try_for_each(output::line)?;
    }
    Ok(if times.answered.is_empty() { ExitCode::from(EXIT_FAILURE) } else { ExitCode::SUCCESS })
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
    /// Time from question to answer over the direct path; null if none came there.
    direct_us: Option<u64>,
    /// The same over routers.
    relayed_us: Option<u64>,
    /// Why there is no direct link; null if there is one.
    not_direct: Option<NotDirectJson>,
    error: Option<&'a str>,
    fix: &'a str,
}

#[derive(Debug, Serialize)]
struct NotDirectJson {
    reason: NotDirectReason,
    /// The same in words.
    why: String,
    fix: &'static str,
}

impl<'a> AnswerJson<'a> {
    fn of(node: &'a str, answer: &'a ReportAnswer) -> Self {
        let ReportAnswer { pong, answered_us, path, not_direct, error, fix, .. } = answer;
        let over =
            |direct| ways(answer).find(|(_, path)| path.direct == direct).map(|(answered_us, _)| answered_us);
        let not_direct =
            not_direct.map(|reason| NotDirectJson { reason, why: reason.to_string(), fix: reason.fix() });
        Self {
            node,
            answered_us: error.is_none().then_some(*answered_us),
            version: pong.as_ref().map(|pong| pong.version.as_str()),
            path: path.as_ref(),
            direct_us: over(true),
            relayed_us: over(false),
            not_direct,
            error: error.as_deref(),
            fix,
        }
    }
}

/// Iterates over the times of an answer with their paths, the direct one first.
fn ways(answer: &ReportAnswer) -> impl Iterator<Item = (u64, &ReportPath)> {
    let first = answer.path.as_ref().filter(|_| answer.error.is_none());
    let relayed = answer.relayed.as_ref().map(|relayed| (relayed.answered_us, &relayed.path));
    first.map(|path| (answer.answered_us, path)).into_iter().chain(relayed)
}

fn lines(node: &str, answer: &ReportAnswer) -> Vec<Line> {
    if let Some(error) = &answer.error {
        let fix = (!answer.fix.is_empty()).then(|| format!("  {}", answer.fix).into());
        return [Some(format!("{node}: {error}").into()), fix].into_iter().flatten().collect();
    }
    let said = ways(answer).map(|(answered_us, path)| {
        let over = if path.direct { "directly".to_owned() } else { format!("relayed by {}", path.via) };
        let links = output::millis(path.path_us);
        format!("after {}, {over} ({links} by its links)", output::millis(answered_us))
    });
    let said: Vec<_> = said.collect();
    if said.is_empty() {
        return vec![
            format!("{node} answered after {}, the node here", output::millis(answer.answered_us)).into(),
        ];
    }
    vec![format!("{node} answered {}", said.join("; ")).into()]
}

/// Returns the lines that explain why there is no direct link.
fn why_not_direct(reason: NotDirectReason) -> impl Iterator<Item = Line> {
    let fix = Some(reason.fix()).filter(|fix| !fix.is_empty());
    let why = format!("  no direct link: {reason}").into();
    [Some(why), fix.map(|fix| format!("    {fix}").into())].into_iter().flatten()
}

/// The times of all answers, microseconds.
#[derive(Debug, Default)]
struct Times {
    /// Of the first answer to each question.
    answered: Vec<u64>,
    direct: Vec<u64>,
    relayed: Vec<u64>,
}

impl Times {
    fn take(&mut self, answer: &ReportAnswer) {
        if answer.error.is_none() {
            self.answered.push(answer.answered_us);
        }
        for (answered_us, path) in ways(answer) {
            if path.direct { &mut self.direct } else { &mut self.relayed }.push(answered_us);
        }
    }

    /// Returns the lines that sum up: all answers, and those of each path if there were two.
    fn summary(&self, asked: u64) -> Vec<String> {
        let Some(all) = spread(&self.answered) else { return vec![format!("{asked} asked, none answered")] };
        let mut lines = vec![format!("{asked} asked, {} answered: {all}", self.answered.len())];
        if let (Some(direct), Some(relayed)) = (spread(&self.direct), spread(&self.relayed)) {
            lines.extend([format!("  directly: {direct}"), format!("  relayed: {relayed}")]);
        }
        lines
    }
}

fn spread(times: &[u64]) -> Option<String> {
    let (min, max) = (times.iter().min()?, times.iter().max()?);
    let mean = times.iter().sum::<u64>() / times.len() as u64;
    let [min, mean, max] = [*min, mean, *max].map(output::millis);
    Some(format!("{min} at least, {mean} on average, {max} at most"))
}

#[cfg(test)]
mod tests {
    use serde_json::json;
    use sgc_node::admin::RelayedAnswer;

    use super::*;

    fn path(direct: bool) -> ReportPath {
        let via = if direct { "robot" } else { "cloud" }.to_owned();
        ReportPath { via, direct, path_us: if direct { 20_000 } else { 42_000 } }
    }

    fn over(direct: bool) -> ReportAnswer {
        ReportAnswer { answered_us: 43_200, path: Some(path(direct)), ..ReportAnswer::default() }
    }

    fn over_both() -> ReportAnswer {
        let relayed = Some(RelayedAnswer { answered_us: 61_000, path: path(false) });
        ReportAnswer { answered_us: 22_000, relayed, ..over(true) }
    }

    fn said(answer: &ReportAnswer) -> Vec<String> {
        lines("robot", answer).iter().map(ToString::to_string).collect()
    }

    #[test]
    fn answers_say_how_long_and_over_which_path() {
        assert_eq!(said(&over(false)), ["robot answered after 43 ms, relayed by cloud (42 ms by its links)"]);
        assert_eq!(said(&over(true)), ["robot answered after 43 ms, directly (20 ms by its links)"]);
        assert_eq!(
            said(&over_both()),
            [
                "robot answered after 22 ms, directly (20 ms by its links); after 61 ms, relayed by cloud (42 ms by its links)"
            ]
        );
        let own = ReportAnswer { answered_us: 900, ..ReportAnswer::default() };
        assert_eq!(said(&own), ["robot answered after 0.90 ms, the node here"]);
        let error = ReportAnswer {
            error: Some("it does not answer".into()),
            fix: "try again".into(),
            ..ReportAnswer::default()
        };
        assert_eq!(said(&error), ["robot: it does not answer", "  try again"]);
        assert_eq!(AnswerJson::of("robot", &error).answered_us, None);
        let why: Vec<_> = why_not_direct(NotDirectReason::Refused).map(|line| line.to_string()).collect();
        assert_eq!(why[0], "  no direct link: the peer permits no direct link with this node");
        assert!(why[1].starts_with("    name this node in `direct`"), "{why:?}");
    }

    #[test]
    fn json_has_the_times_of_both_paths_or_the_reason() {
        let answer = over_both();
        let told = json!({
            "node": "robot", "answered_us": 22_000, "version": null,
            "path": { "via": "robot", "direct": true, "path_us": 20_000 },
            "direct_us": 22_000, "relayed_us": 61_000, "not_direct": null, "error": null, "fix": "",
        });
        assert_eq!(serde_json::to_value(AnswerJson::of("robot", &answer)).unwrap(), told);
        let answer = ReportAnswer { not_direct: Some(NotDirectReason::Lost), ..over(false) };
        let told = serde_json::to_value(AnswerJson::of("robot", &answer)).unwrap();
        assert_eq!((&told["direct_us"], &told["relayed_us"]), (&json!(null), &json!(43_200)));
        assert_eq!(
            told["not_direct"],
            json!({ "reason": "lost", "why": "the direct link ended", "fix": "" })
        );
    }

    #[test]
    fn summary_counts_what_came_over_each_path() {
        let summary = |answers: &[ReportAnswer]| {
            let mut times = Times::default();
            answers.iter().for_each(|answer| times.take(answer));
            times.summary(3)
        };
        assert_eq!(summary(&[]), ["3 asked, none answered"]);
        let once = "43 ms at least, 43 ms on average, 43 ms at most";
        assert_eq!(summary(&[over(false)]), [format!("3 asked, 1 answered: {once}")]);
        assert_eq!(
            summary(&[over_both(), over(false)]),
            [
                "3 asked, 2 answered: 22 ms at least, 33 ms on average, 43 ms at most",
                "  directly: 22 ms at least, 22 ms on average, 22 ms at most",
                "  relayed: 43 ms at least, 52 ms on average, 61 ms at most",
            ]
        );
    }
}
