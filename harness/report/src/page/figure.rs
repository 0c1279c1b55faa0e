//! Describes a figure once; the page's script and the SVG drawings show the same figures.

use crate::chart::marks::{AxisValue, Mark, Point, Role, extent};
use crate::chart::time::{TimeChart, TimeWindow, worst_point};

/// One value per instant of the time grid; `None` for a missing value.
pub(crate) type SampledLine = Vec<Option<f64>>;

#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Figure {
    pub(crate) title: &'static str,
    pub(crate) unit: &'static str,
    pub(crate) from_zero: bool,
    pub(crate) min_span: f64,
    /// True for a stimulus, which shares the time axis of the figure above it.
    pub(crate) is_stimulus: bool,
    /// Layers from the back to the front.
    pub(crate) layers: Vec<Layer>,
}

/// Curves that are switched together and share an entry of the legend.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Layer {
    pub(crate) role: Role,
    pub(crate) text: String,
    pub(crate) content: Content,
}

/// `is_stepped` is true for a signal that holds its value. Marks are instants in ms with an
/// optional text, points are instants in ms with a value and a text.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Content {
    Lines { is_stepped: bool, lines: Vec<SampledLine> },
    Area { is_stepped: bool, upper: SampledLine, lower: SampledLine },
    Spans(Vec<TimeWindow>),
    Marks(Vec<(f64, Option<String>)>),
    Points(Vec<(f64, f64, String)>),
}

impl Layer {
    pub(crate) fn is_area(&self) -> bool {
        matches!(self.content, Content::Area { .. } | Content::Spans(_))
    }

    /// False for the lines of all trials, which would make an SVG drawing too large.
    pub(crate) fn is_in_drawing(&self) -> bool {
        self.role != Role::Trial
    }
}

impl Figure {
    pub(crate) fn new(title: &'static str, unit: &'static str, from_zero: bool, min_span: f64) -> Self {
        Self { title, unit, from_zero, min_span, is_stimulus: false, layers: Vec::new() }
    }

    pub(crate) fn add(&mut self, role: Role, text: impl Into<String>, content: Content) {
        let has_values = |line: &SampledLine| line.iter().any(Option::is_some);
        let is_empty = match &content {
            Content::Lines { lines, .. } => !lines.iter().any(has_values),
            Content::Area { upper, .. } => !has_values(upper),
            Content::Spans(spans) => spans.is_empty(),
            Content::Marks(marks) => marks.is_empty(),
            Content::Points(points) => points.is_empty(),
        };
        if !is_empty {
            self.layers.push(Layer { role, text: text.into(), content });
        }
    }

    /// `t_ms` contains the instants of the time grid. Each line is reduced to about `limit` points.
    pub(crate) fn chart(&self, t_ms: &[f64], window: TimeWindow, limit: usize) -> TimeChart {
        let points = |line: &SampledLine, is_stepped| line_points(t_ms, line, is_stepped, window, limit);
        let mut marks = Vec::new();
        for layer in self.layers.iter().filter(|layer| layer.is_in_drawing()) {
            let role = layer.role;
            match &layer.content {
                Content::Lines { is_stepped, lines } => {
                    marks.extend(lines.iter().map(|line| Mark::Line(role, points(line, *is_stepped))));
                }
                Content::Area { is_stepped, upper, lower } => {
                    marks.push(Mark::Band(role, [points(upper, *is_stepped), points(lower, *is_stepped)]));
                }
                Content::Spans(spans) => marks.extend(spans.iter().filter_map(|span| {
                    let (from_ms, to_ms) = (span.from_ms.max(window.from_ms), span.to_ms.min(window.to_ms));
                    let corners = [(from_ms, f64::NEG_INFINITY), (to_ms, f64::INFINITY)];
                    (from_ms < to_ms).then_some(Mark::Cell(role, corners))
                })),
                Content::Marks(instants) => {
                    let inside = instants.iter().filter(|(at_ms, _)| window.contains(*at_ms)).cloned();
                    marks.extend(inside.map(|(at_ms, text)| Mark::Limit { role, at: AxisValue::X(at_ms), text }));
                }
                Content::Points(points) => {
                    let inside = points.iter().filter(|(at_ms, ..)| window.contains(*at_ms)).cloned();
                    marks.extend(inside.map(|(at_ms, value, text)| worst_point(role, (at_ms, value), text)));
                }
            }
        }
        TimeChart { window, range: self.axis_range(&marks), unit: self.unit, marks }
    }

    fn axis_range(&self, marks: &[Mark]) -> (f64, f64) {
        let mut values = Vec::new();
        for mark in marks {
            match mark {
                Mark::Line(_, points) => values.extend(points.iter().map(|point| point.1)),
                Mark::Band(_, edges) => values.extend(edges.iter().flatten().map(|point| point.1)),
                Mark::Point { .. } | Mark::Cell(..) | Mark::Limit { .. } => {}
            }
        }
        let (low, high) = extent(values.into_iter()).unwrap_or((0.0, 0.0));
        let (low, high) = if self.from_zero { (low.min(0.0), high.max(0.0)) } else { (low, high) };
        let span = (high - low).max(self.min_span);
        let centred = if self.from_zero { 0.0 } else { (span - (high - low)) / 2.0 };
        let bottom = if self.from_zero && low >= 0.0 { 0.0 } else { low - centred - 0.06 * span };
        (bottom, low - centred + span * 1.08)
    }
}

/// Omits missing values and adds corners to a stepped line.
fn line_points(t_ms: &[f64], line: &SampledLine, is_stepped: bool, window: TimeWindow, limit: usize) -> Vec<Point> {
    let known = t_ms.iter().zip(line).filter_map(|(t_ms, value)| Some((*t_ms, (*value)?)));
    let mut points: Vec<Point> = Vec::new();
    for point in known.filter(|point| window.contains(point.0)) {
        match points.last() {
            Some((_, before)) if is_stepped && *before != point.1 => points.push((point.0, *before)),
            _ => {}
        }
        points.push(point);
    }
    decimate(&points, window, limit)
}

/// Keeps the extremes of each of `limit / 2` parts of the window, and both ends.
fn decimate(points: &[Point], window: TimeWindow, limit: usize) -> Vec<Point> {
    if points.len() <= limit {
        return points.to_vec();
    }
    let buckets = (limit / 2).max(1) as f64;
    let bucket = |point: &Point| ((point.0 - window.from_ms) / window.span_ms() * buckets).floor();
    let mut kept: Vec<Point> = points.first().copied().into_iter().collect();
    for part in points.chunk_by(|a, b| bucket(a) == bucket(b)) {
        let by_value = |a: &&Point, b: &&Point| a.1.total_cmp(&b.1);
        let extremes = [part.iter().min_by(by_value), part.iter().max_by(by_value)];
        let mut extremes: Vec<Point> = extremes.into_iter().flatten().copied().collect();
        extremes.sort_by(|a, b| a.0.total_cmp(&b.0));
        kept.extend(extremes);
    }
    kept.extend(points.last());
    kept.dedup();
    kept
}

#[cfg(test)]
mod tests {
    use super::*;

    const WINDOW: TimeWindow = TimeWindow { from_ms: 0.0, to_ms: 4.0 };

    #[test]
    fn decimation_keeps_a_single_peak() {
        let mut many: Vec<Point> = (0..60_000).map(|n| (f64::from(n) * 4.0 / 60_000.0, 1.0)).collect();
        many[31_234].1 = 9.0;
        let thinned = decimate(&many, WINDOW, 400);
        assert!(thinned.len() <= 402, "{}", thinned.len());
        assert!(thinned.contains(&many[31_234]));
        assert!(thinned.is_sorted_by(|a, b| a.0 <= b.0));
    }

    #[test]
    fn a_stepped_line_has_corners() {
        let t_ms = [0.0, 1.0, 2.0, 5.0];
        let line = vec![Some(0.0), None, Some(4.0), Some(9.0)];
        assert_eq!(line_points(&t_ms, &line, true, WINDOW, 10), [(0.0, 0.0), (2.0, 0.0), (2.0, 4.0)]);
        assert_eq!(line_points(&t_ms, &line, false, WINDOW, 10), [(0.0, 0.0), (2.0, 4.0)]);
    }

    #[test]
    fn draws_layers_within_the_window() {
        let mut figure = Figure::new("Drive", "Vpp", true, 10.0);
        let line = || vec![Some(2.0), Some(4.0), Some(100.0)];
        figure.add(Role::First, "trial 0", Content::Lines { is_stepped: false, lines: vec![line()] });
        figure.add(Role::Trial, "1 more trial", Content::Lines { is_stepped: false, lines: vec![line()] });
        figure.add(Role::Other, "empty", Content::Lines { is_stepped: false, lines: vec![vec![None; 3]] });
        figure.add(Role::Saturated, "saturated", Content::Spans(vec![TimeWindow { from_ms: 3.0, to_ms: 9.0 }]));
        figure.add(Role::Settling, "settled", Content::Marks(vec![(2.0, None), (8.0, None)]));
        assert_eq!(
            figure.layers.iter().map(|layer| layer.role).collect::<Vec<_>>(),
            [Role::First, Role::Trial, Role::Saturated, Role::Settling]
        );
        let chart = figure.chart(&[0.0, 1.0, 8.0], WINDOW, 10);
        let expected = [
            Mark::Line(Role::First, vec![(0.0, 2.0), (1.0, 4.0)]),
            Mark::Cell(Role::Saturated, [(3.0, f64::NEG_INFINITY), (4.0, f64::INFINITY)]),
            Mark::Limit { role: Role::Settling, at: AxisValue::X(2.0), text: None },
        ];
        assert_eq!(chart.marks, expected);
        assert_eq!(chart.range, (0.0, 10.8));
    }
}
