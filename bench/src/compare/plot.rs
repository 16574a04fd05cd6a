//! Plots as SVG text: curves and bars with axes, units and a legend, legible on light and on dark pages.
//!
//! It draws what it is given and knows neither figures nor systems; which plots there are is [`super::report`]'s. A
//! crate for plots would bring fonts and bitmaps, and writes colours where a page's scheme cannot change them.

use std::fmt::Write as _;

/// Colours that stand out from white as well as from near black.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Hue {
    Grey,
    Orange,
    Pink,
    Olive,
    Brown,
    Blue,
    Green,
    Purple,
    Teal,
}

/// How a line is drawn, and how much of its colour a bar has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Stroke {
    Solid,
    Dashed,
    Dotted,
    DashDotted,
}

/// The unit of an axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Unit {
    /// A number without a unit.
    Plain,
    Bytes,
    Seconds,
    PerSecond,
    Percent,
}

/// A line or a group of bars.
pub(crate) struct Series {
    pub(crate) name: String,
    pub(crate) hue: Hue,
    pub(crate) stroke: Stroke,
    /// (x, y), in the units of the axes, by x.
    pub(crate) points: Vec<(f64, f64)>,
}

/// An axis: what it says and what its numbers are.
pub(crate) struct Axis<'a> {
    pub(crate) title: &'a str,
    pub(crate) unit: Unit,
}

/// A bar: from nothing to `value`, with a tick at `tail`.
pub(crate) struct Bar {
    pub(crate) name: String,
    pub(crate) hue: Hue,
    pub(crate) stroke: Stroke,
    pub(crate) value: f64,
    /// For instance the 99th percentile of what `value` is the median of.
    pub(crate) tail: Option<f64>,
}

const WIDTH: f64 = 880.0;
const PLOT_HEIGHT: f64 = 360.0;
const TOP: f64 = 46.0;
const LEFT: f64 = 84.0;
/// Right of the curves, where the legend is.
const LEGEND_WIDTH: f64 = 250.0;
const BOTTOM: f64 = 58.0;
const LEGEND_STEP: f64 = 20.0;
/// Names of bars.
const BAR_LEFT: f64 = 230.0;
/// Numbers at the ends of bars.
const BAR_RIGHT: f64 = 160.0;
const BAR_STEP: f64 = 24.0;
const BAR_HEIGHT: f64 = 15.0;
const GROUP_GAP: f64 = 30.0;
/// Labels of the x axis that come closer than this are left out.
const LABEL_GAP: f64 = 52.0;

/// Logarithms of 1, 2, 5 and 10.
const ROUND: [f64; 4] = [0.0, std::f64::consts::LOG10_2, 1.0 - std::f64::consts::LOG10_2, 1.0];

const STYLE: &str = "<style>\
.page{fill:#ffffff}.ink{fill:#1f2328}.soft{fill:#59636e}.grid{stroke:#d1d9e0;stroke-width:1}\
.axis{stroke:#59636e;stroke-width:1}.line{fill:none;stroke-width:2;stroke-linejoin:round}\
text{font-family:system-ui,-apple-system,'Segoe UI','DejaVu Sans',sans-serif;font-size:12px}\
.title{font-size:15px;font-weight:600}\
@media (prefers-color-scheme:dark){.page{fill:#0d1117}.ink{fill:#e6edf3}.soft{fill:#9198a1}\
.grid{stroke:#3d444d}.axis{stroke:#9198a1}}</style>";

impl Hue {
    fn colour(self) -> &'static str {
        match self {
            Self::Grey => "#7d8590",
            Self::Orange => "#d9730d",
            Self::Pink => "#d03592",
            Self::Olive => "#9a8200",
            Self::Brown => "#a5634a",
            Self::Blue => "#2f7fe0",
            Self::Green => "#2b9a53",
            Self::Purple => "#8c62d9",
            Self::Teal => "#1295a5",
        }
    }
}

impl Stroke {
    fn dashes(self) -> &'static str {
        match self {
            Self::Solid => "none",
            Self::Dashed => "7 4",
            Self::Dotted => "2 4",
            Self::DashDotted => "7 4 2 4",
        }
    }

    fn opacity(self) -> f64 {
        match self {
            Self::Solid => 1.0,
            Self::Dashed => 0.72,
            Self::Dotted => 0.48,
            Self::DashDotted => 0.85,
        }
    }
}

/// Curves over a common x axis. Numbers that are not finite, and on logarithmic axes those that are not above nothing,
/// are left out. `None` if no curve has anything to show.
pub(crate) fn curves(title: &str, x: &Axis<'_>, y: &Axis<'_>, series: &[Series]) -> Option<String> {
    let finite = |(x, y): &&(f64, f64)| x.is_finite() && y.is_finite();
    let points: Vec<_> = series.iter().flat_map(|s| &s.points).filter(finite).copied().collect();
    let across = Scale::from_values(points.iter().map(|p| p.0), false)?;
    let up = Scale::from_values(points.iter().map(|p| p.1), true)?;
    let width = WIDTH - LEFT - LEGEND_WIDTH;
    let height = PLOT_HEIGHT.max(series.len() as f64 * LEGEND_STEP);
    let total = TOP + height + BOTTOM;
    let at_x = |value: f64| LEFT + across.part(value) * width;
    let at_y = |value: f64| TOP + (1.0 - up.part(value)) * height;

    let mut svg = head(title, WIDTH, total);
    for tick in up.ticks() {
        let y_at = at_y(tick);
        let _ = write!(svg, r#"<path class="grid" d="M{LEFT:.1} {y_at:.1}h{width:.1}"/>"#);
        text(&mut svg, LEFT - 8.0, y_at + 4.0, "soft", "end", &y.unit.text(tick));
    }
    // Labels are where the measurements are, so that no size has to be guessed.
    let mut measured: Vec<f64> = points.iter().map(|p| p.0).collect();
    measured.sort_unstable_by(f64::total_cmp);
    measured.dedup();
    let mut labelled = f64::NEG_INFINITY;
    for value in measured {
        let x_at = at_x(value);
        let _ = write!(svg, r#"<path class="grid" d="M{x_at:.1} {TOP:.1}v{height:.1}"/>"#);
        if x_at - labelled >= LABEL_GAP {
            text(&mut svg, x_at, TOP + height + 18.0, "soft", "middle", &x.unit.text(value));
            labelled = x_at;
        }
    }
    let _ = write!(svg, r#"<path class="axis" fill="none" d="M{LEFT:.1} {TOP:.1}v{height:.1}h{width:.1}"/>"#);
    text(&mut svg, LEFT + width / 2.0, TOP + height + 42.0, "ink", "middle", x.title);
    let middle = TOP + height / 2.0;
    let _ = write!(
        svg,
        r#"<text class="ink" text-anchor="middle" transform="translate(18 {middle:.1}) rotate(-90)">{}</text>"#,
        escaped(y.title)
    );
    for (number, line) in series.iter().enumerate() {
        let (colour, dashes) = (line.hue.colour(), line.stroke.dashes());
        let shown: Vec<_> = line
            .points
            .iter()
            .filter(finite)
            .filter(|p| across.shows(p.0) && up.shows(p.1))
            .map(|p| (at_x(p.0), at_y(p.1)))
            .collect();
        let path: Vec<_> = shown.iter().map(|(x, y)| format!("{x:.1} {y:.1}")).collect();
        if path.len() > 1 {
            let d = format!("M{}", path.join("L"));
            let _ =
                write!(svg, r#"<path class="line" stroke="{colour}" stroke-dasharray="{dashes}" d="{d}"/>"#);
        }
        for (x, y) in shown {
            let _ = write!(svg, r#"<circle cx="{x:.1}" cy="{y:.1}" r="3" fill="{colour}"/>"#);
        }
        let (x, y) = (LEFT + width + 18.0, TOP + 10.0 + number as f64 * LEGEND_STEP);
        let _ = write!(
            svg,
            r#"<path class="line" stroke="{colour}" stroke-dasharray="{dashes}" d="M{x:.1} {y:.1}h28"/>"#
        );
        let _ = write!(svg, r#"<circle cx="{:.1}" cy="{y:.1}" r="3" fill="{colour}"/>"#, x + 14.0);
        text(&mut svg, x + 36.0, y + 4.0, "ink", "start", &line.name);
    }
    svg.push_str("</svg>\n");
    Some(svg)
}

/// Bars from the left, one below the other, in groups with a heading each. `None` if there is no bar.
///
/// `axis` says what they are and in what unit; its text goes under the title.
pub(crate) fn bars(title: &str, axis: &Axis<'_>, groups: &[(String, Vec<Bar>)]) -> Option<String> {
    let reach = |bar: &Bar| bar.tail.unwrap_or(0.0).max(bar.value);
    let all = groups.iter().flat_map(|(_, bars)| bars);
    let longest = all.clone().map(reach).filter(|r| r.is_finite()).fold(0.0, f64::max);
    if longest <= 0.0 {
        return None;
    }
    let width = WIDTH - BAR_LEFT - BAR_RIGHT;
    let headings = if groups.len() > 1 { groups.len() as f64 * GROUP_GAP } else { 0.0 };
    let total = TOP + 22.0 + all.count() as f64 * BAR_STEP + headings + 14.0;
    let mut svg = head(title, WIDTH, total);
    text(&mut svg, 20.0, TOP + 2.0, "soft", "start", axis.title);
    let mut y = TOP + 20.0;
    for (heading, bars) in groups {
        if groups.len() > 1 {
            text(&mut svg, 20.0, y + 16.0, "ink", "start", heading);
            y += GROUP_GAP;
        }
        for bar in bars.iter().filter(|bar| reach(bar).is_finite()) {
            let (colour, opacity) = (bar.hue.colour(), bar.stroke.opacity());
            let length = (bar.value / longest * width).max(1.0);
            let foot = y + BAR_HEIGHT / 2.0 + 4.0;
            text(&mut svg, BAR_LEFT - 10.0, foot, "ink", "end", &bar.name);
            let _ = write!(
                svg,
                r#"<rect x="{BAR_LEFT:.1}" y="{y:.1}" width="{length:.1}" height="{BAR_HEIGHT:.1}" rx="2" fill="{colour}" fill-opacity="{opacity}"/>"#
            );
            let mut label = axis.unit.text(bar.value);
            let mut end = BAR_LEFT + length;
            if let Some(tail) = bar.tail {
                let tail_at = BAR_LEFT + tail / longest * width;
                let _ = write!(
                    svg,
                    r#"<path class="axis" d="M{end:.1} {:.1}H{tail_at:.1}M{tail_at:.1} {:.1}v9"/>"#,
                    y + BAR_HEIGHT / 2.0,
                    y + BAR_HEIGHT / 2.0 - 4.5
                );
                end = end.max(tail_at);
                let _ = write!(label, " – {}", axis.unit.text(tail));
            }
            text(&mut svg, end + 7.0, foot, "soft", "start", &label);
            y += BAR_STEP;
        }
    }
    svg.push_str("</svg>\n");
    Some(svg)
}

impl Unit {
    /// A number with about three digits, and its unit.
    pub(crate) fn text(self, value: f64) -> String {
        let (scale, unit) = self.scale(value);
        join(&three_digits(value / scale), unit)
    }

    /// Returns the divisor for numbers of this size, and the unit that follows them.
    pub(crate) fn scale(self, value: f64) -> (f64, &'static str) {
        // A number that would be written as 1000 of the smaller unit is one of the larger.
        let value = value.abs() * 1.0005;
        match self {
            Self::Plain => (1.0, ""),
            Self::PerSecond => (1.0, "/s"),
            Self::Percent => (1.0, "%"),
            Self::Seconds if value >= 1.0 => (1.0, "s"),
            Self::Seconds if value >= 1e-3 => (1e-3, "ms"),
            Self::Seconds => (1e-6, "µs"),
            Self::Bytes if value >= 1e9 => (1e9, "GB"),
            Self::Bytes if value >= 1e6 => (1e6, "MB"),
            Self::Bytes if value >= 1e3 => (1e3, "KB"),
            Self::Bytes => (1.0, "B"),
        }
    }
}

/// A number and what stands behind it.
pub(crate) fn join(number: &str, unit: &str) -> String {
    match unit {
        "" | "/s" => format!("{number}{unit}"),
        _ => format!("{number} {unit}"),
    }
}

/// With three digits that mean something, no zeros behind the point, and the thousands apart.
pub(crate) fn three_digits(value: f64) -> String {
    if value == 0.0 {
        return "0".into();
    }
    if !value.is_finite() {
        return "–".into();
    }
    let magnitude = value.abs().log10().floor() as i32;
    if magnitude < -6 {
        return format!("{value:.1e}");
    }
    // Rounded to three digits, of which the last may carry into a new one.
    let step = 10f64.powi(magnitude - 2);
    let rounded = (value / step).round() * step;
    let decimals = usize::try_from(2 - magnitude).unwrap_or(0);
    let text = format!("{rounded:.decimals$}");
    if text.contains('.') {
        return text.trim_end_matches('0').trim_end_matches('.').to_owned();
    }
    let (sign, digits) = text.strip_prefix('-').map_or(("", &*text), |digits| ("-", digits));
    if digits.len() < 5 {
        return text;
    }
    let mut grouped = String::new();
    for (at, digit) in digits.char_indices() {
        if at > 0 && (digits.len() - at) % 3 == 0 {
            grouped.push('\u{a0}');
        }
        grouped.push(digit);
    }
    format!("{sign}{grouped}")
}

/// From numbers to a part of an axis, 0 to 1.
struct Scale {
    low: f64,
    high: f64,
    is_logarithmic: bool,
}

impl Scale {
    /// Logarithmic where the numbers differ 20 times or more and all are above nothing; those of a vertical axis
    /// otherwise begin at nothing. `None` without numbers.
    fn from_values(values: impl Iterator<Item = f64>, is_vertical: bool) -> Option<Self> {
        let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
        if low > high {
            return None;
        }
        if low > 0.0 && high / low >= 20.0 {
            let (low, high) = if is_vertical {
                (below(low.log10()), above(high.log10()))
            } else {
                (low.log10(), high.log10())
            };
            return Some(Self { low, high, is_logarithmic: true });
        }
        let low = if is_vertical { low.min(0.0) } else { low };
        let high = if is_vertical { high * 1.06 } else { high };
        let high = if high > low { high } else { low + 1.0 };
        Some(Self { low, high, is_logarithmic: false })
    }

    fn shows(&self, value: f64) -> bool {
        !self.is_logarithmic || value > 0.0
    }

    fn part(&self, value: f64) -> f64 {
        let value = if self.is_logarithmic { value.log10() } else { value };
        (value - self.low) / (self.high - self.low)
    }

    /// Returns the positions of grid lines in the unit of the axis: decades, or four to nine round steps.
    fn ticks(&self) -> Vec<f64> {
        if self.is_logarithmic {
            let decades = self.low.floor() as i32..=self.high.floor() as i32;
            // Few decades have room for the numbers between.
            let between: &[f64] = if self.high - self.low < 3.0 { &[1.0, 2.0, 5.0] } else { &[1.0] };
            let ticks = decades.flat_map(|d| between.iter().map(move |b| b * 10f64.powi(d)));
            let is_inside = |tick: &f64| (self.low - 1e-9..=self.high + 1e-9).contains(&tick.log10());
            return ticks.filter(is_inside).collect();
        }
        let rough = (self.high - self.low) / 5.0;
        let decade = 10f64.powf(rough.log10().floor());
        let step = [1.0, 2.0, 5.0, 10.0].map(|s| s * decade).into_iter().find(|s| *s >= rough);
        let step = step.unwrap_or(rough);
        let first = (self.low / step).ceil() as i64;
        let last = (self.high / step).floor() as i64;
        (first..=last).map(|n| n as f64 * step).collect()
    }
}

/// The next of 1, 2 and 5 times a decade above.
fn above(log: f64) -> f64 {
    let floor = log.floor();
    ROUND.map(|part| floor + part).into_iter().find(|a| *a >= log).unwrap_or(log)
}

/// The same below.
fn below(log: f64) -> f64 {
    let floor = log.floor();
    ROUND.map(|part| floor + part).into_iter().rev().find(|b| *b <= log).unwrap_or(log)
}

fn head(title: &str, width: f64, height: f64) -> String {
    let title = escaped(title);
    format!(
        r#"<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0} {height:.0}" width="{width:.0}" height="{height:.0}" role="img" aria-label="{title}"><title>{title}</title>{STYLE}<rect class="page" width="{width:.0}" height="{height:.0}" rx="6"/><text class="ink title" x="20" y="28">{title}</text>"#
    )
}

fn text(svg: &mut String, x: f64, y: f64, class: &str, anchor: &str, text: &str) {
    let text = escaped(text);
    let _ =
        write!(svg, r#"<text class="{class}" x="{x:.1}" y="{y:.1}" text-anchor="{anchor}">{text}</text>"#);
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_three_digits() {
        let cases = [
            (0.0, "0"),
            (0.012_34, "0.0123"),
            (0.999_9, "1"),
            (1.0, "1"),
            (7.496, "7.5"),
            (168.4, "168"),
            (999.6, "1000"),
            (1234.0, "1230"),
            (125_900.0, "126\u{a0}000"),
            (-12_345_678.0, "-12\u{a0}300\u{a0}000"),
        ];
        for (value, text) in cases {
            assert_eq!(three_digits(value), text, "{value}");
        }
    }

    #[test]
    fn units_follow_the_size() {
        assert_eq!(Unit::Seconds.text(168e-6), "168 µs");
        assert_eq!(Unit::Seconds.text(0.999_8e-3), "1 ms");
        assert_eq!(Unit::Seconds.text(42.1), "42.1 s");
        assert_eq!(Unit::Bytes.text(16.0), "16 B");
        assert_eq!(Unit::Bytes.text(65_536.0), "65.5 KB");
        assert_eq!(Unit::Bytes.text(13e6), "13 MB");
        assert_eq!(Unit::PerSecond.text(640.0), "640/s");
    }

    #[test]
    fn wide_ranges_are_logarithmic_and_others_begin_at_nothing() {
        let wide = Scale::from_values([16.0, 13e6].into_iter(), false).unwrap();
        assert!(wide.is_logarithmic);
        assert!((wide.part(16.0), wide.part(13e6)) == (0.0, 1.0));
        let narrow = Scale::from_values([3.0, 9.0].into_iter(), true).unwrap();
        assert!(!narrow.is_logarithmic && narrow.part(0.0) == 0.0);
        assert_eq!(narrow.ticks(), [0.0, 2.0, 4.0, 6.0, 8.0]);
        assert!(Scale::from_values(std::iter::empty(), true).is_none());
    }

    #[test]
    fn point_outside_axis_is_not_drawn() {
        let line = |points| Series { name: "a < b".into(), hue: Hue::Blue, stroke: Stroke::Solid, points };
        let axis = |title| Axis { title, unit: Unit::Plain };
        let draw = |points| curves("t", &axis("x"), &axis("y"), &[line(points)]);
        assert_eq!(draw(vec![(1.0, f64::NAN)]), None);
        let svg = draw(vec![(1.0, 2.0), (2.0, f64::INFINITY), (100.0, 3.0)]).unwrap();
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        assert!(svg.contains("a &lt; b"));
        // Two points and the one of the legend.
        assert_eq!(svg.matches("<circle").count(), 3);
    }

    #[test]
    fn bars_without_length_are_no_plot() {
        let axis = Axis { title: "x", unit: Unit::Plain };
        assert_eq!(bars("t", &axis, &[(String::new(), Vec::new())]), None);
    }
}
