//! Draws heat maps: a value over one or two listed quantities.

use super::svg::{Canvas, DrawArea, DrawResult, Role, UNITS_PER_PIXEL, count_factor, svg_document};
use crate::error::ReportError;
use plotters::style::text_anchor::HPos;

/// CSS pixels; two panels fit on a page, one on a telephone.
const PANEL_SIZE: (i32, i32) = (360, 280);
const LEFT: i32 = 64;
const TOP: i32 = 36;
const RIGHT: i32 = 14;
const BOTTOM: i32 = 44;
const LEGEND_LINE_HEIGHT: i32 = 22;
const CLASSES: usize = 10;
const MAX_TICKS: usize = 6;

/// One quantity of an axis: its values in order.
#[derive(Debug, Clone, PartialEq)]
pub struct HeatAxis {
    /// Name with unit.
    pub label: String,
    /// At least one.
    pub values: Vec<String>,
}

#[derive(Debug, Clone, PartialEq)]
pub struct HeatPanel {
    /// May be empty.
    pub title: String,
    pub x: HeatAxis,
    pub y: HeatAxis,
    /// By row (y) and then by column (x); `None` without a value.
    pub values: Vec<Vec<Option<f64>>>,
}

/// Panels with one scale.
#[derive(Debug, Clone, PartialEq)]
pub struct HeatFigure {
    /// Names the value and its unit.
    pub title: String,
    pub panels: Vec<HeatPanel>,
    /// True if small values are the bad ones.
    pub is_low_bad: bool,
}

impl HeatFigure {
    /// Finite values only; an infinite one has the class of its end.
    fn scale(&self) -> (f64, f64) {
        let values = self.panels.iter().flat_map(|panel| panel.values.iter().flatten().copied().flatten());
        let ends = values.filter(|value| value.is_finite());
        let (low, high) = ends.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)));
        match () {
            () if low < high => (low, high),
            () if low.is_finite() => (low - 0.5, low + 0.5),
            () => (0.0, 1.0),
        }
    }

    pub fn svg(&self) -> Result<String, ReportError> {
        let columns = self.panels.len().clamp(1, 2);
        let rows = self.panels.len().div_ceil(columns).max(1);
        let (width, height) = (PANEL_SIZE.0 * count_factor(columns), PANEL_SIZE.1 * count_factor(rows));
        let per_line = if columns == 1 { 2 } else { 5 };
        let legend_lines = count_factor(CLASSES.div_ceil(per_line));
        let scale = self.scale();
        svg_document(&self.title, (width, height + legend_lines * LEGEND_LINE_HEIGHT), |root| {
            let (maps, below) = root.split_vertically(height * UNITS_PER_PIXEL);
            for (area, panel) in maps.split_evenly((rows, columns)).iter().zip(&self.panels) {
                self.draw_panel(area, panel, scale)?;
            }
            self.draw_legend(&Canvas(&below), scale, (per_line, width))
        })
    }

    fn role(&self, value: f64, (low, high): (f64, f64)) -> Role {
        let share = ((value - low) / (high - low)).clamp(0.0, 1.0);
        let class = ((share * CLASSES as f64) as usize).min(CLASSES - 1);
        Role::Radius(if self.is_low_bad { CLASSES - 1 - class } else { class })
    }

    fn draw_panel(&self, area: &DrawArea<'_>, panel: &HeatPanel, scale: (f64, f64)) -> DrawResult {
        let canvas = Canvas(area);
        let (right, bottom) = (PANEL_SIZE.0 - RIGHT, PANEL_SIZE.1 - BOTTOM);
        let (columns, rows) = (panel.x.values.len().max(1), panel.y.values.len().max(1));
        let edge =
            |from: i32, to: i32, at: usize, count: usize| from + (to - from) * count_factor(at) / count_factor(count);
        let x = |column: usize| edge(LEFT, right, column, columns);
        // The first value of the vertical axis is at the bottom.
        let y = |row: usize| edge(bottom, TOP, row, rows);
        for (row, values) in panel.values.iter().enumerate() {
            for (column, value) in values.iter().enumerate() {
                if let Some(value) = value {
                    let corners = [(x(column), y(row + 1)), (x(column + 1), y(row))];
                    canvas.rectangle(self.role(*value, scale), corners)?;
                }
            }
        }
        for ends in [[(LEFT, TOP), (LEFT, bottom)], [(LEFT, bottom), (right, bottom)]] {
            canvas.line(Role::Axis, ends)?;
        }
        for tick in ticks(columns) {
            let at = i32::midpoint(x(tick), x(tick + 1));
            canvas.text(Role::Text, HPos::Center, (at, bottom + 12), short(panel.x.values.get(tick)))?;
        }
        for tick in ticks(rows) {
            let at = i32::midpoint(y(tick), y(tick + 1));
            canvas.text(Role::Text, HPos::Right, (LEFT - 6, at), short(panel.y.values.get(tick)))?;
        }
        canvas.text(Role::Title, HPos::Left, (LEFT, 10), &panel.title)?;
        canvas.text(Role::Text, HPos::Left, (4, 24), &panel.y.label)?;
        canvas.text(Role::Text, HPos::Right, (right, PANEL_SIZE.1 - 12), &panel.x.label)
    }

    fn draw_legend(&self, canvas: &Canvas<'_, '_>, scale: (f64, f64), (per_line, width): (usize, i32)) -> DrawResult {
        let (low, high) = scale;
        let step = (high - low) / CLASSES as f64;
        for class in 0..CLASSES {
            let from = low + step * class as f64;
            let (column, line) = (count_factor(class % per_line), count_factor(class / per_line));
            let (x, y) =
                (8 + column * width / count_factor(per_line), LEGEND_LINE_HEIGHT / 2 + line * LEGEND_LINE_HEIGHT);
            canvas.rectangle(self.role(from + step / 2.0, scale), [(x, y - 5), (x + 16, y + 5)])?;
            let text = format!("{} to {}", number(from), number(from + step));
            canvas.text(Role::Text, HPos::Left, (x + 21, y), &text)?;
        }
        Ok(())
    }
}

/// At most [`MAX_TICKS`] positions, the first one among them.
fn ticks(count: usize) -> impl Iterator<Item = usize> {
    (0..count).step_by(count.div_ceil(MAX_TICKS).max(1))
}

/// A text that fits next to an axis.
fn short(text: Option<&String>) -> &str {
    let text = text.map_or("", |text| &**text);
    text.char_indices().nth(9).map_or(text, |(end, _)| text.get(..end).unwrap_or(text))
}

fn number(value: f64) -> String {
    let magnitude = value.abs();
    match magnitude {
        0.0 => "0".to_owned(),
        _ if !(1e-3..1e5).contains(&magnitude) => format!("{value:.1e}"),
        _ if magnitude < 10.0 => format!("{value:.3}"),
        _ => format!("{value:.1}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn figure(values: Vec<Vec<Option<f64>>>) -> HeatFigure {
        let axis = |count: usize| HeatAxis {
            label: "finger_force_n, N".to_owned(),
            values: (0..count).map(|value| value.to_string()).collect(),
        };
        let (x, y) = (axis(values[0].len()), axis(values.len()));
        let panel = HeatPanel { title: "dq-pi".to_owned(), x, y, values };
        HeatFigure { title: "margin".to_owned(), panels: vec![panel], is_low_bad: true }
    }

    #[test]
    fn draws_a_rectangle_per_value_and_no_missing_one() {
        let svg = figure(vec![vec![Some(0.0), None], vec![Some(1.0), Some(f64::NEG_INFINITY)]]).svg().unwrap();
        // The lowest class twice and the highest once, each once more in the legend.
        assert_eq!((svg.matches("class=\"f-radius-9\"").count(), svg.matches("class=\"f-radius-0\"").count()), (3, 2));
        assert!(svg.contains("finger_force_n, N") && svg.contains("dq-pi"));
    }

    #[test]
    fn equal_values_have_a_scale() {
        for value in [0.0, -3.0, 5.0] {
            let (low, high) = figure(vec![vec![Some(value)]]).scale();
            assert!(low < high && (low..=high).contains(&value), "{value}: {low} {high}");
        }
        assert!(figure(vec![vec![None]]).svg().is_ok());
    }
}
