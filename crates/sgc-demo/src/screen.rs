//! The demo's display: an introduction, a table that is redrawn while the demo runs, and a summary.
//!
//! On a terminal the table stays in its place. Elsewhere it is printed again every two seconds. With `--json` there is
//! none.

use std::io::IsTerminal;
use std::time::Duration;

use sgc_process::{ProcessError, output};

use crate::report::Flow;
use crate::topics::{Role, Topic};

const REDRAW_PERIOD: Duration = Duration::from_secs(1);
const REPRINT_PERIOD: Duration = Duration::from_secs(2);
/// Switches wrapping off, so that long lines are cut and the table keeps its height.
const WRAP_OFF: &str = "\x1b[?7l";
const WRAP_ON: &str = "\x1b[?7h";
const CLEAR_LINE: &str = "\x1b[2K";

/// The output of the demo.
pub(crate) struct Screen {
    kind: Kind,
    /// Number of table lines on the terminal.
    drawn: usize,
    /// Messages that each topic had received at the last display.
    before: Vec<(Topic, u64)>,
    before_at: Duration,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Kind {
    Nothing,
    Plain,
    Terminal,
}

impl Screen {
    /// Chooses the kind of display by the type of standard output.
    pub(crate) fn new(json: bool) -> Self {
        let kind = match json {
            true => Kind::Nothing,
            false if std::io::stdout().is_terminal() => Kind::Terminal,
            false => Kind::Plain,
        };
        Self { kind, drawn: 0, before: Vec::new(), before_at: Duration::ZERO }
    }

    /// Returns the period of the table.
    pub(crate) fn period(&self) -> Duration {
        if self.kind == Kind::Terminal { REDRAW_PERIOD } else { REPRINT_PERIOD }
    }

    /// Prints the introduction, which says how to join the demo's networks.
    pub(crate) fn introduce(&self, robot_domain: u32, operator_domain: u32) -> Result<(), ProcessError> {
        self.say(&format!(
            "Two ROS 2 networks that cannot see each other, and three sgc processes that join them:\n\n  \
             ROS domain {robot_domain} ─ robot ══ cloud ══ operator ─ ROS domain {operator_domain}\n\n\
             The cloud is a router only: what it passes on is sealed from robot to operator and back.\n\n\
             If you have ROS 2, join from another terminal (`--duration 600s` leaves more time):\n"
        ))?;
        for (domain, receives) in [(operator_domain, Role::Robot), (robot_domain, Role::Operator)] {
            for topic in Topic::owned_by(receives).filter(|topic| *topic != Topic::Image) {
                let echo = format!("ros2 topic echo {}", topic.ros_name());
                self.say(&format!(
                    "  ROS_DOMAIN_ID={domain} ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST {echo}"
                ))?;
            }
        }
        self.say(&format!(
            "  ROS_DOMAIN_ID={operator_domain} ROS_LOCALHOST_ONLY=1 ros2 topic echo /chatter    # Humble\n"
        ))
    }

    /// Prints a line between introduction and table.
    pub(crate) fn say(&self, text: &str) -> Result<(), ProcessError> {
        if self.kind == Kind::Nothing { Ok(()) } else { output::line(text) }
    }

    /// Shows the table while the demo runs.
    pub(crate) fn show(&mut self, elapsed: Duration, flows: &[Flow]) -> Result<(), ProcessError> {
        let rates = self.rates(elapsed, flows);
        let lines = table(flows, &rates);
        match self.kind {
            Kind::Nothing => Ok(()),
            Kind::Plain => {
                output::line(format!("after {} s", elapsed.as_secs()))?;
                output::line(lines.join("\n"))
            }
            Kind::Terminal => {
                let mut text = String::from(WRAP_OFF);
                if self.drawn > 0 {
                    text += &format!("\x1b[{}A", self.drawn);
                }
                for line in &lines {
                    text += &format!("{CLEAR_LINE}{line}\n");
                }
                text += WRAP_ON;
                self.drawn = lines.len();
                output::raw(&text)
            }
        }
    }

    /// Prints the last table and the verdict.
    pub(crate) fn sum_up(&mut self, elapsed: Duration, flows: &[Flow]) -> Result<(), ProcessError> {
        if self.kind == Kind::Nothing {
            return Ok(());
        }
        let seconds = elapsed.as_secs_f64();
        let rates: Vec<f64> = flows.iter().map(|f| f.counts.received as f64 / seconds.max(0.001)).collect();
        if self.kind == Kind::Terminal && self.drawn > 0 {
            // Moves the cursor up, so that the new table replaces the last one.
            output::raw(&format!("\x1b[{}A\x1b[J", self.drawn))?;
        }
        output::line(format!("In {seconds:.1} s:\n"))?;
        output::line(table(flows, &rates).join("\n"))?;
        let faults: Vec<_> = flows.iter().filter_map(Flow::fault).collect();
        let received: u64 = flows.iter().map(|f| f.counts.received).sum();
        if faults.is_empty() {
            output::line(format!("\nAll {received} messages arrived, once each and unaltered."))
        } else {
            output::line(format!("\nIt did not work as it should:\n  {}", faults.join("\n  ")))
        }
    }

    /// Returns the messages per second since the last display.
    fn rates(&mut self, elapsed: Duration, flows: &[Flow]) -> Vec<f64> {
        let seconds = elapsed.saturating_sub(self.before_at).as_secs_f64().max(0.001);
        let rate = |flow: &Flow| {
            let before = self.before.iter().find(|(topic, _)| *topic == flow.topic).map_or(0, |(_, n)| *n);
            flow.counts.received.saturating_sub(before) as f64 / seconds
        };
        let rates = flows.iter().map(rate).collect();
        self.before = flows.iter().map(|flow| (flow.topic, flow.counts.received)).collect();
        self.before_at = elapsed;
        rates
    }
}

/// Formats two lines for each topic: its figures and its name.
fn table(flows: &[Flow], rates: &[f64]) -> Vec<String> {
    let head = ["topic", "messages", "rate", "p50", "p99", "lost", "duplicated", "altered"];
    let mut rows = vec![head.map(str::to_owned).to_vec()];
    for (flow, rate) in flows.iter().zip(rates) {
        let counts = &flow.counts;
        rows.push(vec![
            flow.topic.ros_name().to_owned(),
            counts.received.to_string(),
            format!("{rate:.1}/s"),
            output::millis(counts.p50_us),
            output::millis(counts.p99_us),
            flow.lost().to_string(),
            counts.duplicated.to_string(),
            counts.corrupt.to_string(),
        ]);
    }
    let mut lines = output::columns(&rows).into_iter();
    let mut table: Vec<String> = lines.next().into_iter().collect();
    for (line, flow) in lines.zip(flows) {
        table.push(line);
        table.push(format!("  {}", flow.name));
    }
    table
}

#[cfg(test)]
mod tests {
    use sgc_wire::Name;

    use super::*;
    use crate::tracker::Counts;

    #[test]
    fn table_fits_terminal_and_names_every_topic() {
        let flows = Topic::ALL.map(|topic| Flow {
            counts: Counts { received: 12_345, p50_us: 1234, p99_us: 123_456, ..Counts::default() },
            ..Flow::new(topic, Name([7; 32]))
        });
        let lines = table(&flows, &[10.0, 10.0, 50.0]);
        assert_eq!(lines.len(), 7);
        assert!(lines.iter().all(|line| line.chars().count() <= 80), "{lines:#?}");
        assert_eq!(lines[1], "/chatter       12345     10.0/s  1.23 ms  123 ms  0     0           0");
        assert_eq!(lines[2], format!("  {}", "07".repeat(32)));
    }

    #[test]
    fn rates_cover_last_interval() {
        let mut screen = Screen { kind: Kind::Nothing, ..Screen::new(true) };
        let mut flows = [Flow::new(Topic::Chatter, Name([7; 32]))];
        flows[0].counts.received = 10;
        assert_eq!(screen.rates(Duration::from_secs(1), &flows), [10.0]);
        flows[0].counts.received = 40;
        assert_eq!(screen.rates(Duration::from_secs(3), &flows), [15.0]);
    }
}
