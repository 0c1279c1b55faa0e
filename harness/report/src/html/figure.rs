//! Which curves stand together in a figure, and what its legend says.
//!
//! Neighbours: `bundle` holds the curves, `plot` draws them, `scenario` puts figures onto the page.

use super::bundle::{Bundle, Strand, View};
use super::curves::{self, Point, Signal};
use super::plot::{Chart, Ink, Mark};
use super::timed::until;
use crate::shown;

/// A drawing with its words.
#[derive(Debug, Clone)]
pub(crate) struct Figure {
    pub(crate) title: &'static str,
    pub(crate) legend: Vec<Key>,
    pub(crate) chart: Chart,
}

/// A line of a legend.
#[derive(Debug, Clone)]
pub(crate) struct Key {
    pub(crate) ink: Ink,
    pub(crate) is_area: bool,
    pub(crate) text: String,
}

/// Another response that is shown behind: of the open loop, or of another run.
#[derive(Debug, Clone)]
pub(crate) struct Behind<'a> {
    /// What it is.
    pub(crate) text: String,
    pub(crate) bundle: &'a Bundle,
}

const RESPONSE: &str = "Response to the setpoint step";
const WHOLE: &str = "Whole trial";

/// The figures of a scenario in groups, each with its heading; `all` of them, or those of |W| and drive where the response is.
pub(crate) fn figures(
    bundle: &Bundle,
    behind: Option<&Behind<'_>>,
    points: usize,
    all: bool,
) -> Vec<(&'static str, Vec<Figure>)> {
    let Some((whole, before)) = bundle.views.split_last() else { return Vec::new() };
    let maker = |view| Maker { bundle, view, behind, points };
    if !all {
        let short = maker(before.first().unwrap_or(whole));
        let heading = if before.is_empty() { WHOLE } else { RESPONSE };
        return vec![(heading, vec![short.amplitude(), short.drive()])];
    }
    let response = before.iter().map(|view| {
        let maker = maker(view);
        (RESPONSE, vec![maker.amplitude(), maker.drive()])
    });
    let maker = maker(whole);
    let mut figures = vec![maker.amplitude(), maker.components(), maker.drive(), maker.frequency()];
    figures.extend(maker.profile(Signal::Force, "Finger force", "N"));
    figures.extend(maker.profile(Signal::Temperature, "Temperature above the reference", "K"));
    response.chain([(WHOLE, figures)]).collect()
}

struct Maker<'a> {
    bundle: &'a Bundle,
    view: &'a View,
    behind: Option<&'a Behind<'a>>,
    points: usize,
}

/// A figure in the making.
struct Draft {
    areas: Vec<(Ink, [Vec<Point>; 2])>,
    lines: Vec<(Ink, Vec<Point>)>,
    legend: Vec<Key>,
}

impl Draft {
    fn new() -> Self {
        Self { areas: Vec::new(), lines: Vec::new(), legend: Vec::new() }
    }

    fn area(&mut self, ink: Ink, edges: [Vec<Point>; 2], text: String) {
        self.areas.push((ink, edges));
        self.legend.push(Key { ink, is_area: true, text });
    }

    fn line(&mut self, ink: Ink, points: Vec<Point>, text: String) {
        if !points.is_empty() {
            self.lines.push((ink, points));
            self.legend.push(Key { ink, is_area: false, text });
        }
    }

    /// Lowest and highest value of everything in it.
    fn range(&self) -> (f64, f64) {
        let edges = self.areas.iter().flat_map(|(_, edges)| edges).flatten();
        let values = self.lines.iter().flat_map(|(_, points)| points).chain(edges).map(|point| point.1);
        let range = values.fold((f64::MAX, f64::MIN), |(low, high), value| (low.min(value), high.max(value)));
        if range.0 <= range.1 { range } else { (0.0, 0.0) }
    }

    /// The range with air around it and at least `least` wide; `from_zero` where 0 is an end that means something.
    fn axis(&self, least: f64, from_zero: bool) -> (f64, f64) {
        let (low, high) = self.range();
        let (low, high) = if from_zero { (low.min(0.0), high.max(0.0)) } else { (low, high) };
        let span = (high - low).max(least);
        let centred = if from_zero { 0.0 } else { (span - (high - low)) / 2.0 };
        let bottom = if from_zero && low >= 0.0 { 0.0 } else { low - centred - 0.06 * span };
        (bottom, low - centred + span * 1.08)
    }
}

impl Maker<'_> {
    fn strand(&self, signal: Signal) -> Option<&Strand> {
        self.view.strands.get(&signal)
    }

    fn first(&self, signal: Signal) -> Vec<Point> {
        self.strand(signal).map(|strand| strand.first.clone()).unwrap_or_default()
    }

    fn of_first(&self) -> String {
        format!("trial {}", self.bundle.first)
    }

    /// Spread, the first trial and the one that decided.
    fn trials(&self, draft: &mut Draft, signal: Signal) {
        let Some(strand) = self.strand(signal) else { return };
        if let Some(edges) = strand.envelope.edges() {
            draft.area(Ink::Spread, edges, format!("range of {}", shown::count(self.bundle.shown, "trial")));
        }
        draft.line(Ink::First, strand.first.clone(), self.of_first());
        // Where it does as the first one does it would only hide it.
        if let Some((index, metric)) = self.bundle.exhibit.as_ref().filter(|_| strand.exhibit != strand.first) {
            draft.line(Ink::Exhibit, strand.exhibit.clone(), format!("trial {index}, decided {metric}"));
        }
    }

    fn setpoint(&self, draft: &mut Draft, with_band: bool) {
        let setpoint = self.first(Signal::Setpoint);
        let band = self.bundle.band;
        let edge = |side: f64| setpoint.iter().map(|&(t, value)| (t, band.edge(value, side))).collect();
        if with_band && setpoint.iter().any(|point| point.1 != 0.0) {
            draft.area(Ink::Band, [edge(1.0), edge(-1.0)], format!("{} % band", shown::number(band.percent)));
        }
        draft.line(Ink::Setpoint, setpoint, "setpoint".to_owned());
    }

    fn finish(&self, title: &'static str, unit: &'static str, draft: Draft, range: (f64, f64)) -> Figure {
        let Draft { areas, lines, legend } = draft;
        let chart = Chart { window: self.view.window, range, unit, spans: Vec::new(), areas, lines, marks: Vec::new() };
        Figure { title, legend, chart }
    }

    fn amplitude(&self) -> Figure {
        let mut draft = Draft::new();
        self.setpoint(&mut draft, !self.bundle.band.of_components);
        if let Some(behind) = self.behind {
            let window = self.view.window;
            let inside = |point: &&Point| (window.from_ms..=window.to_ms).contains(&point.0);
            let points: Vec<Point> = behind.bundle.amplitude.iter().filter(inside).copied().collect();
            draft.line(Ink::Other, curves::thin(&points, window, self.points), behind.text.clone());
        }
        self.trials(&mut draft, Signal::Amplitude);
        let range = draft.axis(0.1, true);
        let mut figure = self.finish("Amplitude |W|", "µm", draft, range);
        self.timed(&mut figure, false);
        figure
    }

    /// Marks what was to come in time, as far as it lies in the window, and says what came of it.
    fn timed(&self, figure: &mut Figure, of_drive: bool) {
        let window = self.view.window;
        for timed in self.bundle.timed.iter().filter(|timed| timed.of_drive == of_drive) {
            let text = format!("{} {}", self.of_first(), timed.text);
            figure.legend.push(Key { ink: Ink::Settling, is_area: false, text });
            let mut marks = Vec::new();
            marks.extend(timed.instant_ms.map(|at_ms| (Ink::Settling, at_ms, Some(timed.text.clone()))));
            marks.extend(timed.from_ms.map(|at_ms| (Ink::Settling, at_ms, None)));
            if let Some((at_ms, demand)) = &timed.deadline {
                figure.legend.push(Key { ink: Ink::Deadline, is_area: false, text: until(*at_ms, demand) });
                marks.push((Ink::Deadline, *at_ms, None));
            }
            let inside = marks.into_iter().filter(|(_, at_ms, _)| (window.from_ms..=window.to_ms).contains(at_ms));
            figure.chart.marks.extend(inside.map(|(ink, at_ms, text)| Mark { ink, at_ms, text }));
        }
    }

    fn components(&self) -> Figure {
        let mut draft = Draft::new();
        self.setpoint(&mut draft, self.bundle.band.of_components);
        for (signal, ink, spread, name) in [
            (Signal::InPhase, Ink::First, Ink::Spread, "in-phase Wd"),
            (Signal::Quadrature, Ink::Second, Ink::SecondSpread, "quadrature Wq"),
        ] {
            if let Some(edges) = self.strand(signal).and_then(|strand| strand.envelope.edges()) {
                draft.areas.push((spread, edges));
            }
            draft.line(ink, self.first(signal), format!("{name}, {}", self.of_first()));
        }
        let range = draft.axis(0.1, false);
        self.finish("Components Wd and Wq", "µm", draft, range)
    }

    fn drive(&self) -> Figure {
        let mut draft = Draft::new();
        self.trials(&mut draft, Signal::Drive);
        let range = draft.axis(10.0, true);
        let mut figure = self.finish("Drive", "Vpp", draft, range);
        if !self.view.saturated.is_empty() {
            figure.chart.spans = self.view.saturated.iter().map(|span| (Ink::Saturated, *span)).collect();
            let text = if self.bundle.shown > 1 { "saturated in a trial" } else { "saturated" };
            figure.legend.push(Key { ink: Ink::Saturated, is_area: true, text: text.to_owned() });
        }
        self.timed(&mut figure, true);
        figure
    }

    fn frequency(&self) -> Figure {
        let mut draft = Draft::new();
        // Before the controller has spoken there is no excitation, and 0 Hz would flatten everything else.
        let driven =
            self.strand(Signal::Frequency).is_some_and(|strand| strand.first.iter().all(|point| point.1 > 0.0));
        if driven {
            self.trials(&mut draft, Signal::Frequency);
        } else {
            let points = self.first(Signal::Frequency).into_iter().filter(|point| point.1 > 0.0).collect();
            draft.line(Ink::First, points, self.of_first());
        }
        draft.line(Ink::Other, self.first(Signal::Resonance), "resonance".to_owned());
        let range = draft.axis(20.0, false);
        self.finish("Excitation frequency against resonance", "Hz", draft, range)
    }

    /// A profile of the scene, where it is not zero throughout.
    fn profile(&self, signal: Signal, title: &'static str, unit: &'static str) -> Option<Figure> {
        let mut draft = Draft::new();
        self.trials(&mut draft, signal);
        let (low, high) = draft.range();
        let range = draft.axis(0.1, true);
        (low != 0.0 || high != 0.0).then(|| self.finish(title, unit, draft, range))
    }
}
