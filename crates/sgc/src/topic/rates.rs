//! `sgc topic hz`, `bw` and `delay`: measure rate, bandwidth and age of messages.

use std::collections::VecDeque;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use clap::Args;
use serde::Serialize;
use sgc_cdr::HEADER_STAMP_BYTES;
use sgc_node::admin::TapHead;

use super::{TapArgs, echo};
use crate::error::CliError;
use crate::output;

/// The period of the reports.
const REPORT_EVERY: Duration = Duration::from_secs(1);

/// Measure the rate of a topic's messages
#[derive(Debug, Args)]
pub(crate) struct HzArgs {
    #[command(flatten)]
    rates: RateArgs,
}

/// Measure the bandwidth of a topic in bytes per second
#[derive(Debug, Args)]
pub(crate) struct BwArgs {
    #[command(flatten)]
    rates: RateArgs,
}

/// Measure the age of a topic's messages by the stamp of their header, which comes from the clock of the publisher's
/// host
#[derive(Debug, Args)]
pub(crate) struct DelayArgs {
    #[command(flatten)]
    rates: RateArgs,
    /// Directory with packages that define messages: DIR/PACKAGE/msg/NAME.msg
    #[arg(long, value_name = "DIR")]
    msg_dir: Vec<PathBuf>,
}

#[derive(Debug, Args)]
struct RateArgs {
    #[command(flatten)]
    tap: TapArgs,
    /// Number of messages from which figures are computed
    #[arg(short, long, value_name = "N", default_value_t = 1000, value_parser = clap::value_parser!(u32).range(2..=1_000_000))]
    window: u32,
    /// End after N reports
    #[arg(short = 'n', long, value_name = "N")]
    count: Option<u64>,
    /// Print each report as a line of JSON; its figures are null if no new messages came
    #[arg(long)]
    json: bool,
}

/// A report of `sgc topic hz` as JSON.
#[derive(Debug, Default, Serialize)]
struct RateJson {
    /// Number of messages from which the figures are computed.
    messages: usize,
    rate_hz: Option<f64>,
    period_min_s: Option<f64>,
    period_max_s: Option<f64>,
    period_std_dev_s: Option<f64>,
}

/// A report of `sgc topic bw` as JSON.
#[derive(Debug, Default, Serialize)]
struct BandwidthJson {
    messages: usize,
    bytes_per_s: Option<f64>,
    message_mean_bytes: Option<f64>,
    message_min_bytes: Option<f64>,
    message_max_bytes: Option<f64>,
}

/// A report of `sgc topic delay` as JSON.
#[derive(Debug, Default, Serialize)]
struct DelayJson {
    messages: usize,
    delay_s: Option<f64>,
    delay_min_s: Option<f64>,
    delay_max_s: Option<f64>,
    delay_std_dev_s: Option<f64>,
}

/// A report for people and for programs.
struct Report<J> {
    text: String,
    json: J,
}

pub(super) fn hz(args: &HzArgs) -> Result<ExitCode, CliError> {
    report(&args.rates, 0, |head, _| Some(head.seen_ns as f64 / 1e9), rate)
}

pub(super) fn bw(args: &BwArgs) -> Result<ExitCode, CliError> {
    report(&args.rates, 0, |head, _| Some(f64::from(head.bytes)), bandwidth)
}

pub(super) fn delay(args: &DelayArgs) -> Result<ExitCode, CliError> {
    let layout = echo::layout(&args.rates.tap.begin(0)?, &args.msg_dir)?;
    if !layout.begins_with_header() {
        return Err(CliError::NoHeader { topic: args.rates.tap.topic.clone() });
    }
    let old = move |head: &TapHead, payload: &[u8]| {
        let stamp = layout.header_stamp_ns(payload)?;
        Some(head.seen_unix_ns.saturating_sub(stamp) as f64 / 1e9)
    };
    report(&args.rates, HEADER_STAMP_BYTES as u32, old, ages)
}

/// The last messages: for each, the time in seconds at which it was seen, and the figure.
type Window = VecDeque<(f64, f64)>;

fn report<J: Default + Serialize>(
    args: &RateArgs,
    bytes: u32,
    figure: impl Fn(&TapHead, &[u8]) -> Option<f64>,
    show: impl Fn(&Window) -> Option<Report<J>>,
) -> Result<ExitCode, CliError> {
    let mut tap = args.tap.begin(bytes)?;
    let mut window = Window::new();
    let (mut reports, mut is_news) = (0, false);
    let mut due = Instant::now() + REPORT_EVERY;
    while args.count.is_none_or(|count| reports < count) {
        let left = due.saturating_duration_since(Instant::now());
        if left.is_zero() {
            due += REPORT_EVERY;
            reports += 1;
            match (show(&window).filter(|_| is_news), args.json) {
                (Some(report), true) => output::json(&report.json)?,
                (Some(report), false) => output::line(report.text)?,
                (None, true) => output::json(&J::default())?,
                (None, false) => output::line("no new messages")?,
            }
            is_news = false;
            continue;
        }
        match tap.next(Some(left))? {
            Some((head, payload)) => {
                if let Some(figure) = figure(&head, &payload) {
                    is_news = true;
                    window.push_back((head.seen_ns as f64 / 1e9, figure));
                    if window.len() > args.window as usize {
                        window.pop_front();
                    }
                }
            }
            // The tap gave up before its patience ended: the stream is over.
            None if Instant::now() < due => break,
            None => {}
        }
    }
    Ok(ExitCode::SUCCESS)
}

/// Least, most, mean and standard deviation.
struct Spread {
    least: f64,
    most: f64,
    mean: f64,
    deviation: f64,
}

fn spread(all: impl Iterator<Item = f64> + Clone) -> Option<Spread> {
    let count = all.clone().count();
    if count == 0 {
        return None;
    }
    let mean = all.clone().sum::<f64>() / count as f64;
    let deviation = (all.clone().map(|x| (x - mean).powi(2)).sum::<f64>() / count as f64).sqrt();
    let (least, most) = all.fold((f64::MAX, f64::MIN), |(least, most), x| (least.min(x), most.max(x)));
    Some(Spread { least, most, mean, deviation })
}

fn rate(window: &Window) -> Option<Report<RateJson>> {
    let gaps = window.iter().zip(window.iter().skip(1)).map(|((a, _), (b, _))| b - a);
    let Spread { least, most, mean, deviation } = spread(gaps)?;
    let messages = window.len();
    let rate = if mean > 0.0 { 1.0 / mean } else { f64::INFINITY };
    let text = format!(
        "average rate: {rate:.3}\n\tmin: {least:.3}s max: {most:.3}s std dev: {deviation:.5}s window: {messages}"
    );
    let json = RateJson {
        messages,
        rate_hz: Some(rate),
        period_min_s: Some(least),
        period_max_s: Some(most),
        period_std_dev_s: Some(deviation),
    };
    Some(Report { text, json })
}

fn bandwidth(window: &Window) -> Option<Report<BandwidthJson>> {
    let Spread { least, most, mean, .. } = spread(window.iter().map(|(_, bytes)| *bytes))?;
    let span = window.back()?.0 - window.front()?.0;
    // The first message only marks the beginning of the time span.
    let all: f64 = window.iter().skip(1).map(|(_, bytes)| bytes).sum();
    let second = if span > 0.0 { all / span } else { 0.0 };
    let messages = window.len();
    let json = BandwidthJson {
        messages,
        bytes_per_s: Some(second),
        message_mean_bytes: Some(mean),
        message_min_bytes: Some(least),
        message_max_bytes: Some(most),
    };
    let [second, mean, least, most] = [second, mean, least, most].map(|bytes| output::bytes(bytes as u64));
    let text =
        format!("{second}/s from {messages} messages\n\tMessage size mean: {mean} min: {least} max: {most}");
    Some(Report { text, json })
}

fn ages(window: &Window) -> Option<Report<DelayJson>> {
    let Spread { least, most, mean, deviation } = spread(window.iter().map(|(_, age)| *age))?;
    let messages = window.len();
    let text = format!(
        "average delay: {mean:.3}\n\tmin: {least:.3}s max: {most:.3}s std dev: {deviation:.5}s window: {messages}"
    );
    let json = DelayJson {
        messages,
        delay_s: Some(mean),
        delay_min_s: Some(least),
        delay_max_s: Some(most),
        delay_std_dev_s: Some(deviation),
    };
    Some(Report { text, json })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_follow_from_window() {
        let window: Window = [(0.0, 100.0), (0.1, 200.0), (0.2, 300.0)].into();
        let rate = rate(&window).unwrap();
        assert_eq!(rate.text, "average rate: 10.000\n\tmin: 0.100s max: 0.100s std dev: 0.00000s window: 3");
        let bandwidth = bandwidth(&window).unwrap();
        let expected = "2.5 kB/s from 3 messages\n\tMessage size mean: 200 B min: 100 B max: 300 B";
        assert_eq!(bandwidth.text, expected);
        assert_eq!(
            (bandwidth.json.bytes_per_s, bandwidth.json.message_max_bytes),
            (Some(2500.0), Some(300.0))
        );
        assert!(super::rate(&[(0.0, 1.0)].into()).is_none());
    }
}
