//! Draws lines, areas, spans and marks over time: figures of a page, a fitted response, and the place where a response
//! is farthest outside its tolerance tube.

use crate::format;
use maud::Markup;
use platebench_document::chart::marks::{
    Axes, Axis, AxisValue, Drawing, Mark, Point, Role, Shape, TextEnd, Ticks, extent,
};
use platebench_model::trace::Row;
use platebench_verdict::tube::{Exceedance, Tube, TubeSignal, signal_response};

/// Width and height, CSS pixels.
pub(crate) const SIZE: Point = (560.0, 306.0);

#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct TimeWindow {
    pub(crate) from_ms: f64,
    pub(crate) to_ms: f64,
}

impl TimeWindow {
    pub(crate) fn span_ms(self) -> f64 {
        self.to_ms - self.from_ms
    }

    pub(crate) fn covers_most_of(self, whole: Option<Self>) -> bool {
        whole.is_some_and(|whole| self.span_ms() >= 0.8 * whole.span_ms())
    }

    pub(crate) fn contains(self, t_ms: f64) -> bool {
        (self.from_ms..=self.to_ms).contains(&t_ms)
    }
}

/// Marks with time in ms on the x axis.
#[derive(Debug, Clone)]
pub(crate) struct TimeChart {
    pub(crate) window: TimeWindow,
    pub(crate) range: (f64, f64),
    pub(crate) unit: &'static str,
    pub(crate) marks: Vec<Mark>,
}

impl TimeChart {
    pub(crate) fn markup(&self) -> Markup {
        self.draw().into_markup()
    }

    pub(crate) fn document(&self, title: &str) -> String {
        self.draw().into_document(title, SIZE)
    }

    /// Draws spans behind the grid and texts in front of lines.
    fn draw(&self) -> Drawing {
        let (low, high) = self.range;
        let x = Axis::linear(self.window.from_ms..self.window.to_ms, 66.0..SIZE.0 - 14.0);
        let axes = Axes { x, y: Axis::linear(low..high, SIZE.1 - 50.0..30.0) };
        let layer = |rank: u8| self.marks.iter().filter(move |mark| rank_of(mark) == rank);
        let mut drawing = Drawing::default();
        drawing.marks(&axes, layer(0));
        let (x_decimals, y_decimals) = (tick_decimals(self.window.span_ms()), tick_decimals(high - low));
        let x_ticks = Ticks::new(axes.x.ticks(7), false, |value| format_tick(value, x_decimals));
        let y_ticks = Ticks::new(axes.y.ticks(6), true, |value| format_tick(value, y_decimals));
        drawing.frame(&axes, &x_ticks, &y_ticks);
        for rank in 1..=4 {
            drawing.marks(&axes, layer(rank));
        }
        drawing.text(Role::Text, TextEnd::Right, (58.0, 14.0), self.unit);
        drawing.text(Role::Text, TextEnd::Right, (SIZE.0 - 14.0, SIZE.1 - 9.0), "time, ms");
        drawing
    }
}

/// Position between back and front.
const fn rank_of(mark: &Mark) -> u8 {
    match mark {
        Mark::Cell(..) => 0,
        Mark::Band(..) => 1,
        Mark::Line(..) => 2,
        Mark::Limit { .. } => 3,
        Mark::Point { .. } => 4,
    }
}

/// A point with a text, such as the worst value of a response.
pub(crate) const fn worst_point(role: Role, at: Point, text: String) -> Mark {
    Mark::Point { role, at, shape: Shape::Disc, radius: 4.0, text: Some(text) }
}

pub(crate) fn padded_range(values: impl Iterator<Item = f64>) -> (f64, f64) {
    let (low, high) = extent(values).unwrap_or((0.0, 1.0));
    let margin = ((high - low) * 0.06).max(f64::EPSILON);
    (low - margin, high + margin)
}

fn tick_decimals(span: f64) -> usize {
    let step = span / 8.0;
    if step > 0.0 { (-step.log10().floor()).clamp(0.0, 9.0) as usize } else { 0 }
}

fn format_tick(value: f64, decimals: usize) -> String {
    let text = format!("{value:.decimals$}");
    let text = if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { &text };
    if text == "-0" { "0".to_owned() } else { text.replace('-', "−") }
}

const MAX_POINTS: usize = 2_000;

/// A recording and the response of the plate that was fitted to it.
#[derive(Debug, Clone)]
pub struct FitChart {
    pub title: String,
    pub unit: &'static str,
    /// `(ms, value)`, in order of time.
    pub measured: Vec<(f64, f64)>,
    pub fitted: Vec<(f64, f64)>,
}

impl FitChart {
    pub fn svg(&self) -> String {
        let shorten = |points: &[Point]| points.iter().take(MAX_POINTS).copied().collect::<Vec<Point>>();
        let (measured, fitted) = (shorten(&self.measured), shorten(&self.fitted));
        let all = || measured.iter().chain(&fitted);
        let (from_ms, to_ms) = extent(all().map(|point| point.0)).unwrap_or((0.0, 1.0));
        let window = TimeWindow { from_ms, to_ms: to_ms.max(from_ms + 1e-6) };
        let range = padded_range(all().map(|point| point.1));
        let marks = vec![Mark::Line(Role::Other, measured), Mark::Line(Role::First, fitted)];
        TimeChart { window, range, unit: self.unit, marks }.document(&self.title)
    }
}

const MARGIN_MS: f64 = 5.0;
const EDGE_POINTS: u32 = 400;

/// Draws the place where a response is farthest outside its tolerance tube.
pub fn draw_exceedance(tube: &Tube, rows: &[Row], trial: u32, worst: &Exceedance) -> String {
    let signal = TubeSignal::from_name(&tube.signal);
    let (first, last) = tube.span_ms();
    let from_ms = (worst.t_ms - MARGIN_MS).max(first);
    let window = TimeWindow { from_ms, to_ms: (worst.t_ms + MARGIN_MS).min(last).max(from_ms + 1e-6) };
    let instants =
        (0..=EDGE_POINTS).map(|index| window.from_ms + window.span_ms() * f64::from(index) / f64::from(EDGE_POINTS));
    let edges: Vec<(f64, [f64; 2])> = instants.map(|t_ms| (t_ms, tube.edges(t_ms))).collect();
    let edge =
        |end: usize| edges.iter().filter_map(|(t_ms, ends)| Some((*t_ms, *ends.get(end)?))).collect::<Vec<Point>>();
    let golden: Vec<Point> = edges.iter().map(|(t_ms, _)| (*t_ms, tube.point_at(*t_ms).value)).collect();
    let points: Vec<Point> = signal.map(|signal| signal_response(signal, rows)).unwrap_or_default();
    let points: Vec<Point> = points.into_iter().filter(|point| window.contains(point.0)).collect();
    let values = edges.iter().flat_map(|(_, ends)| *ends).chain(points.iter().map(|point| point.1));
    let text = Some(format!("{} at {} ms", tube.signal, format::number(worst.t_ms)));
    let range = padded_range(values);
    let marks = vec![
        Mark::Band(Role::Tube, [edge(1), edge(0)]),
        Mark::Line(Role::Golden, golden),
        Mark::Line(Role::First, points),
        Mark::Limit { role: Role::Deadline, at: AxisValue::X(worst.t_ms), text },
    ];
    let unit = signal.map_or("", |signal| signal.unit);
    TimeChart { window, range, unit, marks }.document(&format::exceedance(trial, worst))
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_verdict::golden::GoldenTubes;
    use rstest::rstest;

    #[rstest]
    #[case(0.5, 60.0, "0.5")]
    #[case(-20.0, 400.0, "−20")]
    #[case(-1e-12, 2.0, "0")]
    #[case(32_307.5, 3.0, "32307.5")]
    fn ticks_are_short(#[case] value: f64, #[case] span: f64, #[case] expected: &str) {
        assert_eq!(format_tick(value, tick_decimals(span).max(1)), expected);
    }

    #[test]
    fn draws_every_kind_of_mark() {
        let text = |text: &str| Some(text.to_owned());
        let marks = vec![
            Mark::Cell(Role::Saturated, [(1.0, f64::NEG_INFINITY), (2.0, f64::INFINITY)]),
            Mark::Band(Role::Band, [vec![(0.0, 1.0), (1.0, 1.0)], vec![(0.0, 0.5), (1.0, 0.5)]]),
            Mark::Line(Role::First, vec![(0.0, 0.0), (10.0, 1.0)]),
            Mark::Limit { role: Role::Settling, at: AxisValue::X(9.0), text: text("settled") },
            worst_point(Role::Worst, (3.0, 0.4), "0.4 µm at 3 ms".to_owned()),
        ];
        let chart =
            TimeChart { window: TimeWindow { from_ms: 0.0, to_ms: 10.0 }, range: (0.0, 1.0), unit: "µm", marks };
        insta::assert_snapshot!(chart.markup().into_string().replace("><", ">\n<"));
    }

    #[test]
    fn draws_both_curves() {
        let (measured, fitted) = (vec![(0.0, 0.0), (1.0, 1.1)], vec![(0.0, 0.0), (1.0, 1.0)]);
        let svg = FitChart { title: "W".to_owned(), unit: "µm", measured, fitted }.svg();
        assert_eq!((svg.matches("class=\"s-other\"").count(), svg.matches("class=\"s-first\"").count()), (1, 1));
    }

    fn rows(height: f64) -> Vec<Row> {
        let row = |index: u32| Row {
            t_s: f64::from(index) * 1e-4,
            amplitude_um: if index >= 100 { height } else { 0.0 },
            ..Row::default()
        };
        (0..=300).map(row).collect()
    }

    #[test]
    fn draws_tube_golden_curve_trial_and_place() {
        let golden = GoldenTubes::from_rows(&rows(2.0)).unwrap();
        let bad = rows(2.5);
        let (trial, worst) = golden.compare([(7, bad.as_slice())]).worst.unwrap();
        let svg = draw_exceedance(&golden.tubes[0], &bad, trial, &worst);
        let title = "trial 7: amplitude_um is 2.5 µm at 10 ms, 0.48 µm outside ± 0.02 µm around 2 µm";
        assert_eq!(svg.matches(&format!("<title>{title}</title>")).count(), 1, "{svg}");
        for class in ["f-tube", "s-golden", "s-first", "s-deadline"] {
            assert_eq!(svg.matches(&format!("class=\"{class}\"")).count(), 1, "{class}");
        }
        assert!(svg.contains(">amplitude_um at 10 ms<") && svg.len() < 60_000, "{} bytes", svg.len());
    }
}
