//! Draws lines, areas, spans and marks over time.

use super::svg::{
    Canvas, DrawArea, DrawResult, Role, UNITS_PER_PIXEL, extent, length, svg_document, svg_elements, text_style,
};
use crate::error::ReportError;
use plotters::prelude::*;
use plotters::style::text_anchor::HPos;

/// Width and height, CSS pixels.
pub(crate) const SIZE: (i32, i32) = (560, 306);

/// Height of the text of the first mark and distance to the text of the next one, as shares of the
/// plot.
const LOWEST_TEXT: f64 = 0.12;
const TEXT_HEIGHT: f64 = 0.1;

pub(crate) type CurvePoint = (f64, f64);

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

#[derive(Debug, Clone)]
pub(crate) struct Mark {
    pub(crate) role: Role,
    pub(crate) at_ms: f64,
    pub(crate) text: Option<String>,
}

/// The fields are in drawing order, from the back to the front.
#[derive(Debug, Clone)]
pub(crate) struct TimeChart {
    pub(crate) window: TimeWindow,
    pub(crate) range: (f64, f64),
    pub(crate) unit: &'static str,
    pub(crate) spans: Vec<(Role, TimeWindow)>,
    /// Upper and lower edge, both from left to right.
    pub(crate) areas: Vec<(Role, [Vec<CurvePoint>; 2])>,
    pub(crate) lines: Vec<(Role, Vec<CurvePoint>)>,
    pub(crate) marks: Vec<Mark>,
    pub(crate) points: Vec<(Role, CurvePoint, String)>,
}

impl TimeChart {
    pub(crate) fn new(window: TimeWindow, range: (f64, f64), unit: &'static str) -> Self {
        let (spans, areas, lines) = (Vec::new(), Vec::new(), Vec::new());
        Self { window, range, unit, spans, areas, lines, marks: Vec::new(), points: Vec::new() }
    }

    pub(crate) fn elements(&self, title: &str) -> Result<String, ReportError> {
        svg_elements(title, SIZE, |root| self.draw(root))
    }

    pub(crate) fn document(&self, title: &str) -> Result<String, ReportError> {
        svg_document(title, SIZE, |root| self.draw(root))
    }

    fn draw(&self, root: &DrawArea<'_>) -> DrawResult {
        let (low, high) = self.range;
        let units = |pixels: i32| pixels * UNITS_PER_PIXEL;
        let mut chart = ChartBuilder::on(root)
            .margin_top(units(30))
            .margin_right(units(14))
            .set_label_area_size(LabelAreaPosition::Left, units(66))
            .set_label_area_size(LabelAreaPosition::Bottom, units(50))
            .build_cartesian_2d(self.window.from_ms..self.window.to_ms, low..high)?;
        for (role, span) in &self.spans {
            chart.draw_series([Rectangle::new([(span.from_ms, low), (span.to_ms, high)], role.colour().filled())])?;
        }
        let (x_decimals, y_decimals) = (tick_decimals(self.window.span_ms()), tick_decimals(high - low));
        chart
            .configure_mesh()
            .disable_x_mesh()
            .x_labels(7)
            .y_labels(6)
            .x_label_formatter(&|value| format_tick(*value, x_decimals))
            .y_label_formatter(&|value| format_tick(*value, y_decimals))
            .label_style(text_style(Role::Text, HPos::Center))
            .axis_style(Role::Axis.colour())
            .bold_line_style(Role::Grid.colour())
            .light_line_style(TRANSPARENT)
            .set_all_tick_mark_size(length(4.0))
            .draw()?;
        for (role, [upper, lower]) in &self.areas {
            let outline: Vec<CurvePoint> = upper.iter().chain(lower.iter().rev()).copied().collect();
            chart.draw_series([Polygon::new(outline, role.colour().filled())])?;
        }
        for (role, points) in &self.lines {
            chart.draw_series([PathElement::new(points.clone(), role.colour())])?;
        }
        // Right of early marks and left of late ones, a settled response leaves room for text.
        let text_beside = |role: Role, text: &str, (at_ms, value): CurvePoint, distance: f64| {
            let is_left = at_ms - self.window.from_ms < 0.55 * self.window.span_ms();
            let (side, shift) = if is_left { (HPos::Left, distance) } else { (HPos::Right, -distance) };
            Text::new(text.to_owned(), (at_ms + shift * self.window.span_ms(), value), text_style(role, side))
        };
        let mut share = LOWEST_TEXT;
        for Mark { role, at_ms, text } in &self.marks {
            chart.draw_series([PathElement::new([(*at_ms, low), (*at_ms, high)], role.colour())])?;
            let Some(text) = text else { continue };
            chart.draw_series([text_beside(*role, text, (*at_ms, low + share * (high - low)), 0.012)])?;
            share += TEXT_HEIGHT;
        }
        for (role, point, text) in &self.points {
            chart.draw_series([Circle::new(*point, length(4.0), role.colour().filled())])?;
            chart.draw_series([text_beside(*role, text, *point, 0.015)])?;
        }
        drop(chart);
        let canvas = Canvas(root);
        canvas.text(Role::Text, HPos::Right, (58, 14), self.unit)?;
        canvas.text(Role::Text, HPos::Right, (SIZE.0 - 14, SIZE.1 - 9), "time, ms")
    }
}

pub(crate) fn padded_range(values: impl Iterator<Item = f64>) -> (f64, f64) {
    let (low, high) = extent(values).unwrap_or((f64::MAX, f64::MIN));
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

#[cfg(test)]
mod tests {
    use super::*;
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
    fn draws_every_kind_of_element() {
        let chart = TimeChart {
            window: TimeWindow { from_ms: 0.0, to_ms: 10.0 },
            range: (0.0, 1.0),
            unit: "µm",
            spans: vec![(Role::Saturated, TimeWindow { from_ms: 1.0, to_ms: 2.0 })],
            areas: vec![(Role::Band, [vec![(0.0, 1.0), (1.0, 1.0)], vec![(0.0, 0.5), (1.0, 0.5)]])],
            lines: vec![(Role::First, vec![(0.0, 0.0), (10.0, 1.0)])],
            marks: vec![Mark { role: Role::Settling, at_ms: 9.0, text: Some("settled".to_owned()) }],
            points: vec![(Role::Worst, (3.0, 0.4), "0.4 µm at 3 ms".to_owned())],
        };
        insta::assert_snapshot!(chart.elements("test").unwrap().replace("><", ">\n<"));
    }
}
