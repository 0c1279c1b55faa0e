//! Draws small multiples: one quantity over a few settings, one panel per row and column, one
//! colour per series.

use super::svg::{Canvas, DrawResult, Role, count_factor, logarithmic_extent, svg_document};
use crate::error::ReportError;
use plotters::style::text_anchor::HPos;

/// Width and height. All lengths below are in CSS pixels.
const PANEL_SIZE: (i32, i32) = (216, 150);
const HEAD: i32 = 62;
const LEFT: i32 = 34;
const RIGHT: i32 = 8;
const TOP: i32 = 26;
const BOTTOM: i32 = 20;
const LINE_HEIGHT: i32 = 20;
const LEGEND_COLUMNS: usize = 5;
const RADIUS: f64 = 2.6;
/// Distance of points without a value from the upper edge.
const NO_VALUE_HEIGHT: i32 = 7;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MultiplesPoint {
    pub series: usize,
    pub setting: usize,
    /// Value above 0. A point without a value lies on the upper edge.
    pub value: Option<f64>,
    pub is_hollow: bool,
}

#[derive(Debug, Clone, PartialEq)]
pub struct MultiplesChart {
    pub title: String,
    pub value_label: String,
    pub setting_label: String,
    pub settings: Vec<String>,
    pub series: Vec<String>,
    pub rows: Vec<String>,
    pub columns: Vec<String>,
    /// Text for points on the upper edge.
    pub edge_label: String,
    pub hollow_label: String,
    /// Points by row and then by column.
    pub panels: Vec<Vec<Vec<MultiplesPoint>>>,
}

impl MultiplesChart {
    pub fn svg(&self) -> Result<String, ReportError> {
        let (columns, rows) = (count_factor(self.columns.len().max(1)), count_factor(self.rows.len()));
        let legend_lines = count_factor(self.series.len().div_ceil(LEGEND_COLUMNS)) + 1;
        let size = (PANEL_SIZE.0 * columns, HEAD + (PANEL_SIZE.1) * rows + (legend_lines + 1) * LINE_HEIGHT);
        svg_document(&self.title, size, |root| {
            let canvas = Canvas(root);
            canvas.text(Role::Title, HPos::Left, (8, 14), &self.title)?;
            let axes = format!("{}, over {}", self.value_label, self.setting_label);
            canvas.text(Role::Text, HPos::Left, (8, 34), &axes)?;
            for (column, name) in self.columns.iter().enumerate() {
                canvas.text(Role::Title, HPos::Left, (PANEL_SIZE.0 * count_factor(column) + LEFT, HEAD - 8), name)?;
            }
            for (row, panels) in self.panels.iter().enumerate() {
                for (column, points) in panels.iter().enumerate() {
                    let corner = (PANEL_SIZE.0 * count_factor(column), HEAD + PANEL_SIZE.1 * count_factor(row));
                    self.draw_panel(&canvas, corner, self.rows.get(row).map_or("", String::as_str), points)?;
                }
            }
            self.draw_legend(&canvas, HEAD + PANEL_SIZE.1 * rows + LINE_HEIGHT, PANEL_SIZE.0 * columns)
        })
    }

    fn scale(&self) -> (f64, f64) {
        let values = self.panels.iter().flatten().flatten().filter_map(|point| point.value);
        logarithmic_extent(values).map_or((0.5, 20.0), |(low, high)| (low / 1.3, high * 1.3))
    }

    fn draw_panel(
        &self,
        canvas: &Canvas<'_, '_>,
        (x0, y0): (i32, i32),
        name: &str,
        points: &[MultiplesPoint],
    ) -> DrawResult {
        let (left, right) = (x0 + LEFT, x0 + PANEL_SIZE.0 - RIGHT);
        let (top, bottom) = (y0 + TOP, y0 + PANEL_SIZE.1 - BOTTOM);
        let (low, high) = self.scale();
        let floor = top + 2 * NO_VALUE_HEIGHT;
        let y = |value: f64| bottom - ((value / low).ln() / (high / low).ln() * f64::from(bottom - floor)) as i32;
        canvas.text(Role::Text, HPos::Left, (left, y0 + TOP / 2), name)?;
        for tick in [0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0] {
            if (low..=high).contains(&tick) {
                canvas.line(Role::Grid, [(left, y(tick)), (right, y(tick))])?;
                canvas.text(Role::Text, HPos::Right, (left - 4, y(tick)), &tick.to_string())?;
            }
        }
        canvas.line(Role::Mark, [(left, top + NO_VALUE_HEIGHT), (right, top + NO_VALUE_HEIGHT)])?;
        canvas.line(Role::Axis, [(left, top), (left, bottom)])?;
        canvas.line(Role::Axis, [(left, bottom), (right, bottom)])?;
        let width = f64::from(right - left) / self.settings.len().max(1) as f64;
        let centre = |setting: usize| f64::from(left) + (setting as f64 + 0.5) * width;
        for (setting, text) in self.settings.iter().enumerate() {
            canvas.text(Role::Text, HPos::Center, (centre(setting) as i32, bottom + 11), text)?;
        }
        // Points of different series are side by side, so that equal values stay visible.
        let step = 0.8 * width / self.series.len().max(1) as f64;
        for point in points {
            let offset = (point.series as f64 - (self.series.len() as f64 - 1.0) / 2.0) * step;
            let at = (
                (centre(point.setting) + offset).round() as i32,
                point.value.filter(|value| value.is_finite() && *value > 0.0).map_or(top + NO_VALUE_HEIGHT, y),
            );
            let role = Role::Series(point.series);
            if point.is_hollow { canvas.ring(role, at, RADIUS)? } else { canvas.circle(role, at, RADIUS)? }
        }
        Ok(())
    }

    fn draw_legend(&self, canvas: &Canvas<'_, '_>, top: i32, width: i32) -> DrawResult {
        for (number, name) in self.series.iter().enumerate() {
            let column = count_factor(number % LEGEND_COLUMNS);
            let x = 12 + column * width / count_factor(LEGEND_COLUMNS);
            let y = top + LINE_HEIGHT * count_factor(number / LEGEND_COLUMNS);
            canvas.circle(Role::Series(number), (x, y), RADIUS + 1.0)?;
            canvas.text(Role::Text, HPos::Left, (x + 10, y), name)?;
        }
        let y = top + LINE_HEIGHT * count_factor(self.series.len().div_ceil(LEGEND_COLUMNS));
        canvas.ring(Role::Axis, (12, y), RADIUS + 1.0)?;
        canvas.text(Role::Text, HPos::Left, (22, y), &self.hollow_label)?;
        canvas.line(Role::Mark, [(width / 2, y), (width / 2 + 16, y)])?;
        canvas.text(Role::Text, HPos::Left, (width / 2 + 22, y), &self.edge_label)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chart(points: Vec<MultiplesPoint>) -> MultiplesChart {
        MultiplesChart {
            title: "a < b".to_owned(),
            value_label: "settling time, ms".to_owned(),
            setting_label: "delay".to_owned(),
            settings: vec!["0".to_owned(), "0.4".to_owned()],
            series: vec!["first".to_owned(), "second".to_owned()],
            rows: vec!["scene".to_owned()],
            columns: vec!["unknown".to_owned()],
            edge_label: "never".to_owned(),
            hollow_label: "overshoot".to_owned(),
            panels: vec![vec![points]],
        }
    }

    fn point(series: usize, value: Option<f64>) -> MultiplesPoint {
        MultiplesPoint { series, setting: 1, value, is_hollow: false }
    }

    /// Heights of the points of a series. The last point is that of the legend.
    fn heights(svg: &str, series: usize) -> Vec<i64> {
        let circles = svg.split("<circle").filter(|part| part.contains(&format!("f-series-{series}\"")));
        circles.map(|part| part.split("cy=\"").nth(1).unwrap().split('"').next().unwrap().parse().unwrap()).collect()
    }

    #[test]
    fn a_larger_value_lies_higher_and_no_value_highest() {
        let svg = chart(vec![point(0, Some(1.0)), point(0, Some(10.0)), point(1, None)]).svg().unwrap();
        let (values, none) = (heights(&svg, 0), heights(&svg, 1));
        assert!(values[0] > values[1] && values[1] > none[0], "{values:?} {none:?}");
        assert!(svg.contains(">0.4<") && svg.contains(">overshoot<") && svg.contains(">5<"), "{svg}");
    }

    #[test]
    fn a_hollow_point_is_a_ring() {
        let hollow = MultiplesPoint { is_hollow: true, ..point(1, Some(2.0)) };
        let svg = chart(vec![hollow]).svg().unwrap();
        assert!(svg.contains("s-series-1"), "{svg}");
        assert_eq!(heights(&svg, 1).len(), 1, "only in the legend");
    }
}
