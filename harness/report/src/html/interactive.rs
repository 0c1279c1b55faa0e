//! The curves of a scenario for the page's script: panels with their lines, areas, spans and marks.
//!
//! The script knows no metric and no signal: what stands in a panel, what it is called and what is shown at first is said here. Neighbours: `bundle` holds the
//! curves, `golden` the accepted ones, `pack` writes them in few characters, `plots.js` draws.

use super::bundle::{Bundle, Sampled};
use super::curves::{Signal, Window};
use super::golden::Curves;
use super::grid::percentiles;
use super::pack::packed;
use super::plot::Ink;
use super::timed::until;
use crate::shown;
use serde_json::{Value, json};

type Line = Vec<Option<f64>>;

/// Fewer trials are shown by their range: so few have no outer percentiles.
const FOR_PERCENTILES: usize = 20;

/// Curves from elsewhere, at the instants of the scenario's grid.
#[derive(Debug, Default)]
pub(crate) struct Beside<'a> {
    /// What was accepted.
    pub(crate) golden: Option<&'a Curves>,
    /// Another response, its first trial: what it is and its lines.
    pub(crate) other: Option<(String, &'a Sampled)>,
}

/// Everything that the script draws of a scenario; `None` where no trace could be read.
pub(crate) fn scenario(bundle: &Bundle, beside: &Beside<'_>, title: &str, overlaid: usize) -> Option<Value> {
    let whole = bundle.views.last()?;
    let maker = Maker { bundle, beside, overlaid };
    let mut panels = vec![maker.amplitude(), maker.drive(&whole.saturated), maker.frequency(), maker.components()];
    panels.extend(maker.profile(Signal::Force, "Finger force", "N"));
    panels.extend(maker.profile(Signal::Temperature, "Temperature above the reference", "K"));
    let names = ["Response", "Whole trial"];
    let views = bundle.views.iter().rev().zip(names.iter().rev()).rev();
    let views: Vec<Value> = views.map(|(view, name)| json!([name, view.window.from_ms, view.window.to_ms])).collect();
    Some(json!({
        "title": title,
        "t": packed(bundle.grid.t_ms.iter().copied().map(Some)),
        "views": views,
        "panels": panels.into_iter().map(Panel::finish).collect::<Vec<_>>(),
    }))
}

struct Maker<'a> {
    bundle: &'a Bundle,
    beside: &'a Beside<'a>,
    overlaid: usize,
}

/// A panel in the making. What is switched on and off together is a group.
struct Panel {
    title: &'static str,
    unit: &'static str,
    from_zero: bool,
    /// What its vertical axis spans at least, of the whole trial.
    least: f64,
    groups: Vec<Value>,
    series: Vec<Value>,
    bands: Vec<Value>,
    spans: Vec<Value>,
    marks: Vec<Value>,
}

impl Panel {
    fn new(title: &'static str, unit: &'static str, from_zero: bool, least: f64) -> Self {
        let (groups, series, bands, spans, marks) = (vec![], vec![], vec![], vec![], vec![]);
        Self { title, unit, from_zero, least, groups, series, bands, spans, marks }
    }

    fn group(&mut self, ink: Ink, is_area: bool, text: &str) -> usize {
        self.groups.push(json!({ "ink": ink.name(), "area": is_area, "text": text }));
        self.groups.len() - 1
    }

    fn series(&mut self, group: usize, signal: Signal, line: Line, role: &str) -> usize {
        self.series.push(json!({ "g": group, "step": signal.is_held(), "role": role, "y": packed(line) }));
        self.series.len() - 1
    }

    fn line(&mut self, ink: Ink, text: &str, signal: Signal, line: Line) {
        if line.iter().any(Option::is_some) {
            let group = self.group(ink, false, text);
            self.series(group, signal, line, "line");
        }
    }

    fn area(&mut self, ink: Ink, text: &str, signal: Signal, [upper, lower]: [Line; 2]) {
        if upper.iter().any(Option::is_some) {
            let group = self.group(ink, true, text);
            let upper = self.series(group, signal, upper, "edge");
            let lower = self.series(group, signal, lower, "edge");
            self.bands.push(json!([upper, lower, group]));
        }
    }

    fn spans(&mut self, ink: Ink, text: &str, spans: &[Window]) {
        if !spans.is_empty() {
            let group = self.group(ink, true, text);
            self.spans.extend(spans.iter().map(|span| json!([group, span.from_ms, span.to_ms])));
        }
    }

    fn finish(self) -> Value {
        json!({
            "title": self.title, "unit": self.unit, "zero": self.from_zero, "least": self.least, "groups": self.groups, "series": self.series,
            "bands": self.bands, "spans": self.spans, "marks": self.marks,
        })
    }
}

fn of(trial: &Sampled, signal: Signal) -> Line {
    trial.lines.get(&signal).cloned().unwrap_or_default()
}

impl Maker<'_> {
    fn first(&self, signal: Signal) -> Line {
        self.bundle.sampled.first().map(|trial| of(trial, signal)).unwrap_or_default()
    }

    fn setpoint(&self, panel: &mut Panel, with_band: bool) {
        let setpoint = self.first(Signal::Setpoint);
        let band = self.bundle.band;
        if with_band && setpoint.iter().flatten().any(|value| *value != 0.0) {
            let edge = |side: f64| setpoint.iter().map(|value| value.map(|value| band.edge(value, side))).collect();
            let text = format!("{} % band", shown::number(band.percent));
            panel.area(Ink::Band, &text, Signal::Setpoint, [edge(1.0), edge(-1.0)]);
        }
        panel.line(Ink::Setpoint, "setpoint", Signal::Setpoint, setpoint);
    }

    /// What was accepted and what another run did, below what this one did.
    fn beside(&self, panel: &mut Panel, signal: Signal) {
        if let Some((text, tube)) =
            self.beside.golden.and_then(|golden| Some((&golden.text, golden.of_signal(signal)?)))
        {
            let [lower, upper] = tube.edges.clone();
            panel.area(Ink::Tube, &format!("tolerance tube of the {text}"), signal, [upper, lower]);
            panel.line(Ink::Golden, text, signal, tube.line.clone());
        }
        if let Some((text, other)) = &self.beside.other {
            panel.line(Ink::Other, text, signal, of(other, signal));
        }
    }

    /// Where most trials are, `ink` apart from another signal of the panel.
    fn spread(&self, panel: &mut Panel, signal: Signal, ink: Ink, name: &str) {
        let trials: Vec<&[Option<f64>]> =
            self.bundle.sampled.iter().filter_map(|trial| trial.at.get(&signal).map(Vec::as_slice)).collect();
        let differ = trials.windows(2).any(|pair| matches!(pair, [one, other] if one != other));
        if !differ {
            return;
        }
        let many = trials.len() >= FOR_PERCENTILES;
        let [low, middle, high] = percentiles(&trials, if many { [0.05, 0.5, 0.95] } else { [0.0, 0.5, 1.0] });
        let count = trials.len();
        let text = if many { format!("5 % to 95 % of {count} trials") } else { format!("range of {count} trials") };
        panel.area(ink, &format!("{name}{text}"), signal, [high, low]);
        if many && ink == Ink::Spread {
            panel.line(Ink::Median, &format!("{name}median"), signal, middle);
        }
    }

    fn trials(&self, panel: &mut Panel, signal: Signal, all: bool) {
        self.spread(panel, signal, Ink::Spread, "");
        let first = self.first(signal);
        if all && self.bundle.sampled.len() > 1 {
            let others: Vec<Line> = self
                .bundle
                .sampled
                .iter()
                .skip(1)
                .take(self.overlaid.saturating_sub(1))
                .map(|trial| of(trial, signal))
                .filter(|line| *line != first)
                .collect();
            if !others.is_empty() {
                let group = panel.group(Ink::Trial, false, &shown::count(others.len(), "more trial"));
                for line in others {
                    panel.series(group, signal, line, "trial");
                }
            }
        }
        panel.line(Ink::First, &format!("trial {}", self.bundle.first), signal, first.clone());
        if let Some((index, metric)) = &self.bundle.exhibit {
            let exhibit = self.bundle.sampled.iter().find(|trial| trial.index == *index).map(|trial| of(trial, signal));
            let text = format!("trial {index}, decided {metric}");
            if let Some(line) = exhibit.filter(|line| *line != first) {
                panel.line(Ink::Exhibit, &text, signal, line);
            }
        }
    }

    fn amplitude(&self) -> Panel {
        let mut panel = Panel::new("Amplitude |W|", "µm", true, 0.1);
        self.setpoint(&mut panel, !self.bundle.band.of_components);
        self.beside(&mut panel, Signal::Amplitude);
        self.trials(&mut panel, Signal::Amplitude, true);
        self.timed(&mut panel, false);
        panel.spans(Ink::Lost, "link lost", &self.bundle.lost);
        panel
    }

    /// What was to come in time: from when it counts, when it came, and until when it was demanded.
    fn timed(&self, panel: &mut Panel, of_drive: bool) {
        for timed in self.bundle.timed.iter().filter(|timed| timed.of_drive == of_drive) {
            let group = panel.group(Ink::Settling, false, &format!("trial {} {}", self.bundle.first, timed.text));
            let instants = timed.from_ms.into_iter().chain(timed.instant_ms);
            panel.marks.extend(instants.map(|at_ms| json!([group, at_ms])));
            if let Some((at_ms, demand)) = &timed.deadline {
                let group = panel.group(Ink::Deadline, false, &until(*at_ms, demand));
                panel.marks.push(json!([group, at_ms]));
            }
        }
    }

    fn drive(&self, saturated: &[Window]) -> Panel {
        let mut panel = Panel::new("Drive", "Vpp", true, 10.0);
        self.beside(&mut panel, Signal::Drive);
        self.trials(&mut panel, Signal::Drive, true);
        let text = if self.bundle.shown > 1 { "saturated in a trial" } else { "saturated" };
        panel.spans(Ink::Saturated, text, saturated);
        panel.spans(Ink::Lost, "link lost", &self.bundle.lost);
        self.timed(&mut panel, true);
        if !self.bundle.overruns.is_empty() {
            let text = format!("overrun of the bench ({})", self.bundle.overruns.len());
            let group = panel.group(Ink::Overrun, false, &text);
            panel.marks.extend(self.bundle.overruns.iter().map(|at_ms| json!([group, at_ms])));
        }
        panel
    }

    fn frequency(&self) -> Panel {
        let mut panel = Panel::new("Excitation frequency against resonance", "Hz", false, 20.0);
        self.beside(&mut panel, Signal::Frequency);
        // Before the controller has spoken there is no excitation, and 0 Hz would flatten everything else.
        let driven = self.first(Signal::Frequency).iter().flatten().all(|value| *value > 0.0);
        if driven {
            self.trials(&mut panel, Signal::Frequency, false);
        } else {
            let line = self.first(Signal::Frequency).into_iter().map(|value| value.filter(|value| *value > 0.0));
            panel.line(Ink::First, &format!("trial {}", self.bundle.first), Signal::Frequency, line.collect());
        }
        panel.line(Ink::Resonance, "resonance", Signal::Resonance, self.first(Signal::Resonance));
        panel
    }

    fn components(&self) -> Panel {
        let mut panel = Panel::new("Components Wd and Wq", "µm", false, 0.1);
        self.setpoint(&mut panel, self.bundle.band.of_components);
        for (signal, ink, spread, name) in [
            (Signal::InPhase, Ink::First, Ink::Spread, "Wd"),
            (Signal::Quadrature, Ink::Second, Ink::SecondSpread, "Wq"),
        ] {
            self.spread(&mut panel, signal, spread, &format!("{name}: "));
            panel.line(ink, &format!("{name}, trial {}", self.bundle.first), signal, self.first(signal));
        }
        panel
    }

    /// A profile of the scene, where it is not zero throughout.
    fn profile(&self, signal: Signal, title: &'static str, unit: &'static str) -> Option<Panel> {
        let all = self.bundle.sampled.iter().filter_map(|trial| trial.lines.get(&signal)).flatten().flatten();
        let is_there = all.into_iter().any(|value| *value != 0.0);
        is_there.then(|| {
            let mut panel = Panel::new(title, unit, true, 0.1);
            self.trials(&mut panel, signal, false);
            panel
        })
    }
}
