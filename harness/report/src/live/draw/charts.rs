//! Draws signals over time.

use crate::live::view_state::{ViewState, band, band_percent};
use platebench_model::trace::Column;
use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::style::{Color, Style};
use ratatui::symbols::Marker;
use ratatui::widgets::{Axis, Block, Chart, Dataset, GraphType};

/// Marker of limits and resonance, at every third character. The signal below stays visible.
const REFERENCE_MARKER: Marker = Marker::Custom('-');
const SECOND_MARKER: Marker = Marker::Custom('o');

type Points = Vec<(f64, f64)>;

struct ChartCurve {
    lines: Vec<Points>,
    marker: Marker,
    style: Style,
}

impl ChartCurve {
    fn new(lines: Vec<Points>, marker: Marker, colour: Color) -> Self {
        Self { lines, marker, style: Style::new().fg(colour) }
    }

    fn of(state: &ViewState, signal: Column, marker: Marker, colour: Color) -> Self {
        Self::new(state.history.lines(signal, |value| value), marker, colour)
    }

    fn visible(&self, x: [f64; 2], width: usize) -> Self {
        let is_shown = |(at, value): &(f64, f64)| {
            let place = (at - x[0]) / (x[1] - x[0]) * width as f64;
            value.is_finite() && (self.marker != REFERENCE_MARKER || (place as u64).is_multiple_of(3))
        };
        let lines = self.lines.iter().map(|line| line.iter().copied().filter(is_shown).collect());
        Self { lines: lines.collect(), ..*self }
    }
}

pub(super) fn draw_amplitude(frame: &mut Frame<'_>, area: Rect, state: &ViewState) {
    let Some((scenario, _)) = state.current_trial() else { return draw_empty(frame, area, " |W| ") };
    let history = &state.history;
    let edge = |number: usize| {
        history.lines(Column::Setpoint, |setpoint| band(scenario, setpoint).map_or(f64::NAN, |band| band[number]))
    };
    let [_, highest] = history.range(&[Column::Setpoint, Column::Amplitude]).unwrap_or_default();
    let curves = [
        ChartCurve::of(state, Column::Amplitude, Marker::Braille, Color::Cyan),
        ChartCurve::new(edge(0), REFERENCE_MARKER, Color::Green),
        ChartCurve::new(edge(1), REFERENCE_MARKER, Color::Green),
    ];
    let title = match band(scenario, state.newest_row.map_or(0.0, |row| row.setpoint_um)) {
        Some([low, high]) => format!(" |W| in µm, dots; {} % band {low:.2} to {high:.2}, --- ", band_percent(scenario)),
        None => " |W| in µm, dots ".to_owned(),
    };
    let top = round_up(highest * (1.0 + band_percent(scenario) / 100.0));
    draw_chart(frame, area, state, &title, &curves, [0.0, top], 2);
}

pub(super) fn draw_components(frame: &mut Frame<'_>, area: Rect, state: &ViewState) {
    let [lowest, highest] = state.history.range(&[Column::Wd, Column::Wq]).unwrap_or_default();
    let low = if lowest < -0.02 * highest.abs() { -round_up(-lowest) } else { 0.0 };
    let curves = [
        ChartCurve::of(state, Column::Wq, SECOND_MARKER, Color::Magenta),
        ChartCurve::of(state, Column::Wd, Marker::Braille, Color::Cyan),
    ];
    draw_chart(frame, area, state, " Wd in µm, dots; Wq in µm, ooo ", &curves, [low, round_up(highest)], 2);
}

pub(super) fn draw_drive(frame: &mut Frame<'_>, area: Rect, state: &ViewState) {
    let Some((scenario, _)) = state.current_trial() else { return draw_empty(frame, area, " drive ") };
    let history = &state.history;
    let [_, highest] = history.range(&[Column::Drive]).unwrap_or_default();
    let limit_vpp = scenario.plate.drive_limit_vpp;
    let limit = history.lines(Column::Drive, |_| limit_vpp);
    let top = round_up(highest).min(limit_vpp * 1.05);
    let curves = [
        ChartCurve::of(state, Column::Drive, Marker::Braille, Color::Yellow),
        ChartCurve::new(limit, REFERENCE_MARKER, Color::Red),
    ];
    let title = format!(" drive in Vpp, dots; limit of {limit_vpp:.0} Vpp, --- ");
    draw_chart(frame, area, state, &title, &curves, [0.0, top], 0);
}

pub(super) fn draw_frequency(frame: &mut Frame<'_>, area: Rect, state: &ViewState) {
    let [lowest, highest] = state.history.range(&[Column::Frequency, Column::Resonance]).unwrap_or_default();
    // The margin is at least 1 Hz, because smaller differences do not matter.
    let margin = (0.1 * (highest - lowest)).max(1.0);
    let curves = [
        ChartCurve::of(state, Column::Frequency, Marker::Braille, Color::Cyan),
        ChartCurve::of(state, Column::Resonance, REFERENCE_MARKER, Color::Green),
    ];
    let title = " excitation in Hz, dots; resonance in Hz, --- ";
    draw_chart(frame, area, state, title, &curves, [lowest - margin, highest + margin], 1);
}

fn draw_empty(frame: &mut Frame<'_>, area: Rect, title: &str) {
    frame.render_widget(Block::bordered().title(title), area);
}

fn draw_chart(
    frame: &mut Frame<'_>,
    area: Rect,
    state: &ViewState,
    title: &str,
    curves: &[ChartCurve],
    y: [f64; 2],
    digits: usize,
) {
    let x = state.history.span_s();
    let (scale, unit) = if x[1] - x[0] < 1.0 { (1e3, "ms") } else { (1.0, "s") };
    let middle = f64::midpoint(y[0], y[1]);
    let y_labels = [y[0], middle, y[1]].map(|value| format!("{value:.digits$}"));
    let taken = 3 + y_labels.iter().map(String::len).max().unwrap_or(0);
    let width = usize::from(area.width).saturating_sub(taken);
    let visible: Vec<_> = curves.iter().map(|curve| curve.visible(x, width)).collect();
    let datasets = visible.iter().flat_map(|curve| {
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

/// Rounds up to 1, 1.5, 2, 2.5, 3, 4, 5 or 8 times a power of ten, so that the axis rarely changes.
fn round_up(value: f64) -> f64 {
    const STEPS: [f64; 8] = [1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 8.0];
    if !(value > 0.0 && value < 1e12) {
        return 1.0;
    }
    let decade = 10_f64.powf(value.log10().floor());
    STEPS.into_iter().map(|step| step * decade).find(|round| *round > value * 1.02).unwrap_or(10.0 * decade)
}

#[cfg(test)]
mod tests {
    use super::round_up;

    #[test]
    fn axes_end_at_round_numbers_above_the_value() {
        for (value, expected) in [(2.0, 2.5), (2.1, 2.5), (0.0123, 0.015), (7.9, 10.0), (850.0, 1_000.0), (0.999, 1.0)]
        {
            let found = round_up(value);
            assert!((found / expected - 1.0).abs() < 1e-9, "{value}: {found}");
        }
        for odd in [0.0, -1.0, f64::NAN, f64::INFINITY, 1e300] {
            assert_eq!(round_up(odd), 1.0, "{odd}");
        }
    }
}
