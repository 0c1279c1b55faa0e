//! Signals over time.

use crate::history::Signal;
use crate::scope::Scope;
use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::style::{Color, Style};
use ratatui::symbols::Marker;
use ratatui::widgets::{Axis, Block, Chart, Dataset, GraphType};

/// The band, the resonance: what something is held against. Drawn over it, in every third character, so that neither hides the other.
const REFERENCE: Marker = Marker::Custom('-');
/// The second of two signals in one chart.
const SECOND: Marker = Marker::Custom('o');

type Points = Vec<(f64, f64)>;

/// What is drawn in one way.
struct Curve {
    lines: Vec<Points>,
    marker: Marker,
    style: Style,
}

impl Curve {
    fn new(lines: Vec<Points>, marker: Marker, style: Style) -> Self {
        Self { lines, marker, style }
    }

    /// What there is to draw in a chart of `width` characters from `x[0]` to `x[1]`.
    fn shown(&self, x: [f64; 2], width: usize) -> Self {
        let is_shown = |(at, value): &(f64, f64)| {
            let place = (at - x[0]) / (x[1] - x[0]) * width as f64;
            value.is_finite() && (self.marker != REFERENCE || (place as u64).is_multiple_of(3))
        };
        let lines = self.lines.iter().map(|line| line.iter().copied().filter(is_shown).collect());
        Self { lines: lines.collect(), ..*self }
    }
}

/// |W| and the band around the setpoint.
pub(super) fn amplitude(frame: &mut Frame<'_>, area: Rect, scope: &Scope) {
    let Some((show, _)) = scope.playing() else { return empty(frame, area, " |W| ") };
    let history = &scope.history;
    let edge = |number: usize| {
        history.lines(Signal::Setpoint, |setpoint| show.band(setpoint).map_or(f64::NAN, |band| band[number]))
    };
    let [_, highest] = history.range(&[Signal::Setpoint, Signal::Amplitude]).unwrap_or_default();
    let curves = [
        Curve::new(history.lines(Signal::Amplitude, |value| value), Marker::Braille, Style::new().fg(Color::Cyan)),
        Curve::new(edge(0), REFERENCE, Style::new().fg(Color::Green)),
        Curve::new(edge(1), REFERENCE, Style::new().fg(Color::Green)),
    ];
    let title = match show.band(scope.newest.map_or(0.0, |row| row.setpoint_um)) {
        Some([low, high]) => format!(" |W| in µm, dots; {} % band {low:.2} to {high:.2}, --- ", show.band_percent),
        None => " |W| in µm, dots ".to_owned(),
    };
    chart(frame, area, scope, &title, &curves, [0.0, above(highest * (1.0 + show.band_percent / 100.0))], 2);
}

/// Wd and Wq.
pub(super) fn components(frame: &mut Frame<'_>, area: Rect, scope: &Scope) {
    let history = &scope.history;
    let [lowest, highest] = history.range(&[Signal::Wd, Signal::Wq]).unwrap_or_default();
    let low = if lowest < -0.02 * highest.abs() { -above(-lowest) } else { 0.0 };
    let curves = [
        Curve::new(history.lines(Signal::Wq, |value| value), SECOND, Style::new().fg(Color::Magenta)),
        Curve::new(history.lines(Signal::Wd, |value| value), Marker::Braille, Style::new().fg(Color::Cyan)),
    ];
    chart(frame, area, scope, " Wd in µm, dots; Wq in µm, ooo ", &curves, [low, above(highest)], 2);
}

/// Drive, up to the amplifier's limit.
pub(super) fn drive(frame: &mut Frame<'_>, area: Rect, scope: &Scope) {
    let Some((show, _)) = scope.playing() else { return empty(frame, area, " drive ") };
    let history = &scope.history;
    let [_, highest] = history.range(&[Signal::Drive]).unwrap_or_default();
    let limit = history.lines(Signal::Drive, |_| show.limit_vpp);
    let top = above(highest).min(show.limit_vpp * 1.05);
    let curves = [
        Curve::new(history.lines(Signal::Drive, |value| value), Marker::Braille, Style::new().fg(Color::Yellow)),
        Curve::new(limit, REFERENCE, Style::new().fg(Color::Red)),
    ];
    let title = format!(" drive in Vpp, dots; limit of {:.0} Vpp, --- ", show.limit_vpp);
    chart(frame, area, scope, &title, &curves, [0.0, top], 0);
}

/// Excitation frequency against resonance.
pub(super) fn frequency(frame: &mut Frame<'_>, area: Rect, scope: &Scope) {
    let history = &scope.history;
    let [lowest, highest] = history.range(&[Signal::Frequency, Signal::Resonance]).unwrap_or_default();
    // A tenth of a hertz is nothing to look at.
    let margin = (0.1 * (highest - lowest)).max(1.0);
    let curves = [
        Curve::new(history.lines(Signal::Frequency, |value| value), Marker::Braille, Style::new().fg(Color::Cyan)),
        Curve::new(history.lines(Signal::Resonance, |value| value), REFERENCE, Style::new().fg(Color::Green)),
    ];
    let title = " excitation in Hz, dots; resonance in Hz, --- ";
    chart(frame, area, scope, title, &curves, [lowest - margin, highest + margin], 1);
}

fn empty(frame: &mut Frame<'_>, area: Rect, title: &str) {
    frame.render_widget(Block::bordered().title(title), area);
}

fn chart(frame: &mut Frame<'_>, area: Rect, scope: &Scope, title: &str, curves: &[Curve], y: [f64; 2], digits: usize) {
    let x = scope.history.span_s();
    // Milliseconds where a trial is short.
    let (scale, unit) = if x[1] - x[0] < 1.0 { (1e3, "ms") } else { (1.0, "s") };
    let middle = f64::midpoint(y[0], y[1]);
    let y_labels = [y[0], middle, y[1]].map(|value| format!("{value:.digits$}"));
    // Beside borders, labels and the axis.
    let taken = 3 + y_labels.iter().map(String::len).max().unwrap_or(0);
    let width = usize::from(area.width).saturating_sub(taken);
    let shown: Vec<_> = curves.iter().map(|curve| curve.shown(x, width)).collect();
    let datasets = shown.iter().flat_map(|curve| {
        curve.lines.iter().map(|line| {
            let graph = if curve.marker == Marker::Braille { GraphType::Line } else { GraphType::Scatter };
            Dataset::default().marker(curve.marker).graph_type(graph).style(curve.style).data(line)
        })
    });
    let x_axis =
        Axis::default().bounds(x).labels([format!("{:.0}", x[0] * scale), format!("{:.0} {unit}", x[1] * scale)]);
    let y_axis = Axis::default().bounds(y).labels(y_labels);
    let chart = Chart::new(datasets.collect()).block(Block::bordered().title(title)).x_axis(x_axis).y_axis(y_axis);
    frame.render_widget(chart.legend_position(None), area);
}

/// The next round number above a value that is not below 0: 1, 1.5, 2, 2.5, 3, 4, 5 or 8 times a power of ten. An axis that follows every row would be unreadable.
fn above(value: f64) -> f64 {
    const STEPS: [f64; 8] = [1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 8.0];
    if !(value > 0.0 && value < 1e12) {
        return 1.0;
    }
    let decade = 10_f64.powf(value.log10().floor());
    STEPS.into_iter().map(|step| step * decade).find(|round| *round > value * 1.02).unwrap_or(10.0 * decade)
}

#[cfg(test)]
mod tests {
    use super::above;

    #[test]
    fn axes_end_at_round_numbers_above_the_value() {
        for (value, expected) in [(2.0, 2.5), (2.1, 2.5), (0.0123, 0.015), (7.9, 10.0), (850.0, 1_000.0), (0.999, 1.0)]
        {
            let found = above(value);
            assert!((found / expected - 1.0).abs() < 1e-9, "{value}: {found}");
        }
        for odd in [0.0, -1.0, f64::NAN, f64::INFINITY, 1e300] {
            assert_eq!(above(odd), 1.0, "{odd}");
        }
    }
}
