//! Describes the figures of a scenario once, for the page's script and for the SVG drawings of readers without scripts.

use super::curves::{self, percentiles};
use super::trace_data::{GoldenCurves, SampledTrial, TraceData, View};
use crate::format;
use crate::time_chart::{SIZE, TimeChart, TimeWindow, worst_point};
use maud::{Markup, html};
use platebench_document::chart::marks::{AxisValue, Mark, Point, Role, extent, view_box};
use platebench_model::trace::Column;
use platebench_verdict::tube::Exceedance;

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

/// With fewer trials the figures show the range, because 5 % of the trials is less than one.
const MIN_PERCENTILE_TRIALS: usize = 20;

#[derive(Debug, Default)]
pub(crate) struct ReferenceCurves<'a> {
    pub(crate) golden: Option<&'a GoldenCurves>,
    /// Name, line style and first trial of another scenario or run.
    pub(crate) other: Option<(String, Role, &'a SampledTrial)>,
}

pub(crate) fn scenario_figures(data: &TraceData, references: &ReferenceCurves<'_>, overlaid: usize) -> Vec<Figure> {
    if data.views.is_empty() {
        return Vec::new();
    }
    let builder = FigureBuilder { data, references, overlaid };
    let mut figures = vec![builder.amplitude()];
    figures.extend(builder.stimulus(Column::Force, "Finger force"));
    figures.extend(builder.stimulus(Column::Temperature, "Temperature above the reference"));
    figures.extend([builder.drive(), builder.frequency(), builder.components()]);
    figures
}

struct FigureBuilder<'a> {
    data: &'a TraceData,
    references: &'a ReferenceCurves<'a>,
    overlaid: usize,
}

fn trial_line(trial: &SampledTrial, signal: Column) -> SampledLine {
    trial.peak_lines.get(&signal).cloned().unwrap_or_default()
}

fn one_line(signal: Column, line: SampledLine) -> Content {
    Content::Lines { is_stepped: curves::is_zero_order_hold(signal), lines: vec![line] }
}

impl FigureBuilder<'_> {
    fn first_trial_line(&self, signal: Column) -> SampledLine {
        self.data.sampled_trials.first().map(|trial| trial_line(trial, signal)).unwrap_or_default()
    }

    fn first_trial_name(&self) -> String {
        format!("trial {}", self.data.first_trial)
    }

    fn add_setpoint(&self, figure: &mut Figure, with_band: bool) {
        let setpoint = self.first_trial_line(Column::Setpoint);
        if let Some(band) = self.data.band.filter(|_| with_band)
            && setpoint.iter().flatten().any(|value| *value != 0.0)
        {
            let edge = |side: f64| setpoint.iter().map(|value| value.map(|value| band.edge(value, side))).collect();
            let text = format!("{} % band", format::number(band.percent));
            figure.add(Role::Band, text, Content::Area { is_stepped: true, upper: edge(1.0), lower: edge(-1.0) });
        }
        figure.add(Role::Setpoint, "setpoint", one_line(Column::Setpoint, setpoint));
    }

    fn add_references(&self, figure: &mut Figure, signal: Column) {
        if let Some(golden) = self.references.golden
            && let Some(tube) = golden.tube_of(signal)
        {
            let [lower, upper] = tube.edges.clone();
            let area = Content::Area { is_stepped: curves::is_zero_order_hold(signal), upper, lower };
            figure.add(Role::Tube, format!("tolerance tube of the {}", golden.text), area);
            figure.add(Role::Golden, &golden.text, one_line(signal, tube.line.clone()));
            let outside = self.data.golden.exceedances.iter().filter(|worst| worst.signal == signal.name());
            let point = |worst: &Exceedance| {
                let (distance, unit) = (format::number(worst.distance), curves::unit(signal));
                (worst.t_ms, worst.value, format!("{distance} {unit} outside the tube"))
            };
            figure.add(Role::Worst, "outside the tube", Content::Points(outside.map(point).collect()));
        }
        if let Some((text, role, other)) = &self.references.other {
            figure.add(*role, text, one_line(signal, trial_line(other, signal)));
        }
    }

    /// Adds percentiles of many trials, or the range of few. Equal trials have no spread.
    fn add_spread(&self, figure: &mut Figure, signal: Column, role: Role, name: &str) {
        let lines = self.data.sampled_trials.iter().filter_map(|trial| trial.values.get(&signal).map(Vec::as_slice));
        let lines: Vec<&[Option<f64>]> = lines.collect();
        if !lines.array_windows().any(|[one, other]| one != other) {
            return;
        }
        let count = lines.len();
        let has_percentiles = count >= MIN_PERCENTILE_TRIALS;
        let shares = if has_percentiles { [0.05, 0.5, 0.95] } else { [0.0, 0.5, 1.0] };
        let [lower, middle, upper] = percentiles(&lines, shares);
        let text =
            if has_percentiles { format!("5 % to 95 % of {count} trials") } else { format!("range of {count} trials") };
        let is_stepped = curves::is_zero_order_hold(signal);
        figure.add(role, format!("{name}{text}"), Content::Area { is_stepped, upper, lower });
        if has_percentiles && role == Role::Spread {
            figure.add(Role::Median, format!("{name}median"), one_line(signal, middle));
        }
    }

    fn add_trials(&self, figure: &mut Figure, signal: Column, all: bool) {
        self.add_spread(figure, signal, Role::Spread, "");
        let trials = &self.data.sampled_trials;
        let first = self.first_trial_line(signal);
        if all {
            let others = trials.iter().skip(1).take(self.overlaid.saturating_sub(1));
            let lines: Vec<SampledLine> =
                others.map(|trial| trial_line(trial, signal)).filter(|line| *line != first).collect();
            let text = format::count(lines.len(), "more trial");
            figure.add(Role::Trial, text, Content::Lines { is_stepped: curves::is_zero_order_hold(signal), lines });
        }
        figure.add(Role::First, self.first_trial_name(), one_line(signal, first.clone()));
        for (index, metric) in &self.data.deciding_trials {
            let Some(trial) = trials.iter().find(|trial| trial.index == *index) else { continue };
            let line = trial_line(trial, signal);
            if line != first {
                figure.add(Role::DecidingTrial, format!("trial {index}, decided {metric}"), one_line(signal, line));
            }
        }
    }

    fn add_markers(&self, figure: &mut Figure, on_drive: bool) {
        for marker in self.data.markers.iter().filter(|marker| marker.is_on_drive == on_drive) {
            let start = marker.from_ms.map(|at_ms| (at_ms, None));
            let end = marker.instant_ms.map(|at_ms| (at_ms, Some(marker.text.clone())));
            let marks = start.into_iter().chain(end).collect();
            figure.add(Role::Settling, format!("{} {}", self.first_trial_name(), marker.text), Content::Marks(marks));
            if let Some((at_ms, demand)) = &marker.deadline {
                let text = format!("{demand}: until {} ms", format::number(*at_ms));
                figure.add(Role::Deadline, text, Content::Marks(vec![(*at_ms, None)]));
            }
        }
    }

    fn add_limits(&self, figure: &mut Figure, signal: Column) {
        let t_ms = &self.data.grid.t_ms;
        for limit in self.data.limits.iter().filter(|limit| limit.signal == signal) {
            let window = limit.window;
            let text = format!(
                "{}, window {} … {} ms",
                limit.text,
                format::number(window.from_ms),
                format::number(window.to_ms)
            );
            // A shaded window that covers most of the trial shows nothing.
            if limit.is_missed && !limit.window.covers_most_of(self.data.views.last().map(|view| view.window)) {
                figure.add(Role::JudgedWindow, format!("window of {}", limit.name), Content::Spans(vec![window]));
            }
            let lines = limit.levels.iter().map(|level| {
                let base = level.base.and_then(|base| self.data.sampled_trials.first()?.values.get(&base));
                let value = |(index, t_ms): (usize, &f64)| {
                    let base = base.map_or(Some(0.0), |base| base.get(index).copied().flatten())?;
                    window.contains(*t_ms).then_some(level.share * base + level.offset)
                };
                t_ms.iter().enumerate().map(value).collect()
            });
            figure.add(Role::Limit, text, Content::Lines { is_stepped: true, lines: lines.collect() });
            let worst = limit.worst.iter().map(|worst| (worst.t_ms, worst.value, worst.text.clone()));
            figure.add(Role::Worst, format!("{}: {}", limit.name, limit.kind), Content::Points(worst.collect()));
        }
    }

    fn amplitude(&self) -> Figure {
        let mut figure = Figure::new("Amplitude |W|", "µm", true, 0.1);
        self.add_setpoint(&mut figure, self.data.band.is_none_or(|band| !band.is_for_components));
        self.add_references(&mut figure, Column::Amplitude);
        self.add_trials(&mut figure, Column::Amplitude, true);
        self.add_markers(&mut figure, false);
        self.add_limits(&mut figure, Column::Amplitude);
        figure.add(Role::Lost, "link lost", Content::Spans(self.data.link_lost.clone()));
        figure
    }

    fn drive(&self) -> Figure {
        let mut figure = Figure::new("Drive", "Vpp", true, 10.0);
        self.add_references(&mut figure, Column::Drive);
        self.add_trials(&mut figure, Column::Drive, true);
        let text = if self.data.trial_count > 1 { "saturated in a trial" } else { "saturated" };
        figure.add(Role::Saturated, text, Content::Spans(self.data.saturated.clone()));
        figure.add(Role::Lost, "link lost", Content::Spans(self.data.link_lost.clone()));
        self.add_markers(&mut figure, true);
        self.add_limits(&mut figure, Column::Drive);
        let overruns = &self.data.overruns;
        let text = format!("overrun of the bench ({})", overruns.len());
        figure.add(Role::Overrun, text, Content::Marks(overruns.iter().map(|at_ms| (*at_ms, None)).collect()));
        figure
    }

    fn frequency(&self) -> Figure {
        let mut figure = Figure::new("Excitation frequency against resonance", "Hz", false, 20.0);
        self.add_references(&mut figure, Column::Frequency);
        let first = self.first_trial_line(Column::Frequency);
        // 0 Hz before the first command would flatten all other values.
        if first.iter().flatten().all(|value| *value > 0.0) {
            self.add_trials(&mut figure, Column::Frequency, false);
        } else {
            let excited = first.into_iter().map(|value| value.filter(|value| *value > 0.0)).collect();
            figure.add(Role::First, self.first_trial_name(), one_line(Column::Frequency, excited));
        }
        let resonance = self.first_trial_line(Column::Resonance);
        figure.add(Role::Resonance, "resonance", one_line(Column::Resonance, resonance));
        self.add_limits(&mut figure, Column::Frequency);
        figure
    }

    fn components(&self) -> Figure {
        let mut figure = Figure::new("Components Wd and Wq", "µm", false, 0.1);
        self.add_setpoint(&mut figure, self.data.band.is_some_and(|band| band.is_for_components));
        for (signal, role, spread, name) in
            [(Column::Wd, Role::First, Role::Spread, "Wd"), (Column::Wq, Role::Second, Role::SecondSpread, "Wq")]
        {
            self.add_spread(&mut figure, signal, spread, &format!("{name}: "));
            let text = format!("{name}, {}", self.first_trial_name());
            figure.add(role, text, one_line(signal, self.first_trial_line(signal)));
            if self.data.golden.exceedances.iter().any(|worst| worst.signal == signal.name()) {
                self.add_references(&mut figure, signal);
            }
            self.add_limits(&mut figure, signal);
        }
        figure
    }

    fn stimulus(&self, signal: Column, title: &'static str) -> Option<Figure> {
        let mut values = self.data.sampled_trials.iter().filter_map(|trial| trial.peak_lines.get(&signal)).flatten();
        values.any(|value| value.is_some_and(|value| value != 0.0)).then(|| {
            let mut figure = Figure { is_stimulus: true, ..Figure::new(title, curves::unit(signal), true, 0.1) };
            self.add_trials(&mut figure, signal, false);
            figure
        })
    }
}

/// Draws two figures of the first view, and all figures of the last view, which is the whole trial.
pub(super) fn drawings(t_ms: &[f64], views: &[View], figures: &[Figure], limit: usize) -> Markup {
    let [rest @ .., whole] = views else { return Markup::default() };
    let shown = rest.first().map(|view| (view, 2)).into_iter().chain([(whole, figures.len())]);
    html! {
        div.drawings {
            @for (view, count) in shown {
                h3 { (view.name) }
                div.figures { @for figure in figures.iter().take(count) { (drawing(figure, t_ms, view.window, limit)) } }
            }
        }
    }
}

/// Draws the figure of the first worst instant and, below it, drive and frequency.
pub(super) fn failure_drawings(t_ms: &[f64], window: TimeWindow, figures: &[Figure], limit: usize) -> Markup {
    let [amplitude, .., drive, frequency, components] = figures else { return Markup::default() };
    let has_worst = |figure: &&Figure| figure.layers.iter().any(|layer| layer.role == Role::Worst);
    let main = [amplitude, drive, frequency, components].into_iter().find(has_worst).unwrap_or(amplitude);
    let below = [drive, frequency, amplitude].into_iter().filter(|figure| figure.title != main.title).take(2);
    html! {
        div.failure { @for figure in std::iter::once(main).chain(below) { (drawing(figure, t_ms, window, limit)) } }
    }
}

fn drawing(figure: &Figure, t_ms: &[f64], window: TimeWindow, limit: usize) -> Markup {
    let layers: Vec<&Layer> = figure.layers.iter().filter(|layer| layer.is_in_drawing()).collect();
    let keys: Vec<&str> = layers.iter().map(|layer| layer.text.as_str()).collect();
    let (from_ms, to_ms) = (format::number(window.from_ms), format::number(window.to_ms));
    let label =
        format!("{} in {} against time, {from_ms} to {to_ms} ms: {}", figure.title, figure.unit, keys.join("; "));
    html! {
        figure {
            figcaption { (figure.title) }
            svg viewBox=(view_box(SIZE)) role="img" aria-label=(label) { (figure.chart(t_ms, window, limit).markup()) }
            ul.legend { @for layer in layers { li { (legend_swatch(layer)) (layer.text) } } }
        }
    }
}

fn legend_swatch(layer: &Layer) -> Markup {
    html! {
        svg.swatch viewBox="0 0 24 10" aria-hidden="true" {
            @if layer.is_area() { rect width="24" height="10" rx="2" class={ "f-" (layer.role.name()) } {} }
            @else if matches!(layer.content, Content::Points(_)) {
                circle cx="12" cy="5" r="4" class={ "f-" (layer.role.name()) } {}
            }
            @else { path d="M0 5H24" class={ "s-" (layer.role.name()) } {} }
        }
    }
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
