//! Builds the figures of a scenario from its traces.

use super::curves;
use super::figure::{Content, Figure, SampledLine};
use super::golden::GoldenCurves;
use super::grid::percentiles;
use super::trace_data::{SampledTrial, TraceData};
use crate::chart::marks::Role;
use crate::format;
use platebench_model::trace::Column;
use platebench_verdict::tube::Exceedance;

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
