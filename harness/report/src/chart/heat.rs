//! Draws heat maps: a value over one or two listed quantities.

use super::svg::{Canvas, DrawArea, DrawResult, Role, UNITS_PER_PIXEL, count_factor, extent, svg_document};
use crate::error::ReportError;
use plotters::style::text_anchor::HPos;

/// Width and height, CSS pixels. A page is two panels wide, a telephone one.
const PANEL_SIZE: (i32, i32) = (360, 280);
const LEFT: i32 = 64;
const TOP: i32 = 36;
const RIGHT: i32 = 14;
const BOTTOM: i32 = 44;
const LEGEND_LINE_HEIGHT: i32 = 22;
const CLASSES: usize = 10;
const MAX_TICKS: usize = 6;

#[derive(Debug, Clone, PartialEq)]
pub struct HeatAxis {
    pub label: String,
    pub values: Vec<String>,
}

#[derive(Debug, Clone, PartialEq)]
pub struct HeatPanel {
    pub title: String,
    pub x: HeatAxis,
    pub y: HeatAxis,
    /// Values by row (y) and then by column (x).
    pub values: Vec<Vec<Option<f64>>>,
}

#[derive(Debug, Clone, PartialEq)]
pub struct HeatFigure {
    pub title: String,
    pub panels: Vec<HeatPanel>,
    /// True if small values are the bad ones.
    pub is_low_bad: bool,
}

impl HeatFigure {
    /// Range of the finite values. An infinite value has the first or the last class.
    fn scale(&self) -> (f64, f64) {
        let values = self.panels.iter().flat_map(|panel| panel.values.iter().flatten().copied().flatten());
        match extent(values.filter(|value| value.is_finite())) {
            Some((low, high)) if low < high => (low, high),
            Some((low, _)) => (low - 0.5, low + 0.5),
            None => (0.0, 1.0),
        }
    }

    fn panel_grid(&self) -> (usize, usize) {
        let columns = self.panels.len().clamp(1, 2);
        (columns, self.panels.len().div_ceil(columns).max(1))
    }

    fn classes_per_line(&self) -> usize {
        if self.panel_grid().0 == 1 { 2 } else { 5 }
    }

    /// Width of the drawing, height of the panels, height of the drawing; CSS pixels.
    fn size(&self) -> (i32, i32, i32) {
        let (columns, rows) = self.panel_grid();
        let height = PANEL_SIZE.1 * count_factor(rows);
        let legend_lines = count_factor(CLASSES.div_ceil(self.classes_per_line()));
        (PANEL_SIZE.0 * count_factor(columns), height, height + legend_lines * LEGEND_LINE_HEIGHT)
    }

    /// Left, top, width, height of a cell, as shares of the drawing. `None` if it does not exist.
    pub fn cell_area(&self, panel: usize, column: usize, row: usize) -> Option<[f64; 4]> {
        let [(left, bottom), (right, top)] = cell_corners(self.panels.get(panel)?, column, row);
        let (width, _, height) = self.size();
        let columns = self.panel_grid().0;
        let origin =
            (PANEL_SIZE.0 * count_factor(panel % columns) + left, PANEL_SIZE.1 * count_factor(panel / columns) + top);
        let share = |pixels: i32, whole: i32| f64::from(pixels) / f64::from(whole);
        Some([share(origin.0, width), share(origin.1, height), share(right - left, width), share(bottom - top, height)])
    }

    pub fn svg(&self) -> Result<String, ReportError> {
        let (columns, rows) = self.panel_grid();
        let (width, panel_height, height) = self.size();
        let scale = self.scale();
        svg_document(&self.title, (width, height), |root| {
            let (maps, below) = root.split_vertically(panel_height * UNITS_PER_PIXEL);
            for (area, panel) in maps.split_evenly((rows, columns)).iter().zip(&self.panels) {
                self.draw_panel(area, panel, scale)?;
            }
            self.draw_legend(&Canvas(&below), scale, (self.classes_per_line(), width))
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
        for (row, values) in panel.values.iter().enumerate() {
            for (column, value) in values.iter().enumerate() {
                if let Some(value) = value {
                    let [(left, bottom), (right, top)] = cell_corners(panel, column, row);
                    canvas.rectangle(self.role(*value, scale), [(left, top), (right, bottom)])?;
                }
            }
        }
        for ends in [[(LEFT, TOP), (LEFT, bottom)], [(LEFT, bottom), (right, bottom)]] {
            canvas.line(Role::Axis, ends)?;
        }
        for tick in ticks(panel.x.values.len().max(1)) {
            let [(left, _), (right, _)] = cell_corners(panel, tick, 0);
            let at = i32::midpoint(left, right);
            canvas.text(Role::Text, HPos::Center, (at, bottom + 12), short(panel.x.values.get(tick)))?;
        }
        for tick in ticks(panel.y.values.len().max(1)) {
            let [(_, bottom), (_, top)] = cell_corners(panel, 0, tick);
            let at = i32::midpoint(bottom, top);
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

/// Lower left and upper right corner in the panel, CSS pixels. The first value of the vertical axis
/// is at the bottom.
fn cell_corners(panel: &HeatPanel, column: usize, row: usize) -> [(i32, i32); 2] {
    let edge = |from: i32, to: i32, at: usize, count: usize| {
        from + (to - from) * count_factor(at) / count_factor(count.max(1))
    };
    let x = |column| edge(LEFT, PANEL_SIZE.0 - RIGHT, column, panel.x.values.len());
    let y = |row| edge(PANEL_SIZE.1 - BOTTOM, TOP, row, panel.y.values.len());
    [(x(column), y(row)), (x(column + 1), y(row + 1))]
}

fn ticks(count: usize) -> impl Iterator<Item = usize> {
    (0..count).step_by(count.div_ceil(MAX_TICKS).max(1))
}

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
        // The lowest class occurs twice and the highest once, each once more in the legend.
        assert_eq!((svg.matches("class=\"f-radius-9\"").count(), svg.matches("class=\"f-radius-0\"").count()), (3, 2));
        assert!(svg.contains("finger_force_n, N") && svg.contains("dq-pi"));
    }

    /// A map of two panels with 2×2 cells side by side; the legend has two lines.
    #[test]
    fn a_cell_is_where_it_is_drawn() {
        let mut figure = figure(vec![vec![Some(0.0), None], vec![Some(1.0), Some(2.0)]]);
        figure.panels.push(figure.panels[0].clone());
        let (width, height) = (720.0, 324.0);
        // Upper right cell of the right panel: columns 205 to 346 of 360, rows 36 to 136 of 280.
        let expected = [(360.0 + 205.0) / width, 36.0 / height, 141.0 / width, 100.0 / height];
        assert_eq!(figure.cell_area(1, 1, 1), Some(expected));
        assert_eq!(figure.cell_area(2, 0, 0), None);
        let svg = figure.svg().unwrap();
        assert!(svg.contains("x=\"2260\" y=\"144\" width=\"564\" height=\"400\""), "{svg}");
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
