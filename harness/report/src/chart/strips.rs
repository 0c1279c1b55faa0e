//! Draws one quantity in rows: small multiples over a few settings, and one line of points per item.

use super::marks::{
    Axis, Drawing, Point, Role, Shape, TextEnd, decades, format_power_of_ten, logarithmic_extent, round_ticks,
};
use std::ops::Range;

/// Width and height. All lengths in this module are in CSS pixels.
const MULTIPLES_PANEL: Point = (216.0, 150.0);
const MULTIPLES_HEAD: f64 = 62.0;
const MULTIPLES_LEFT: f64 = 34.0;
const MULTIPLES_TOP: f64 = 26.0;
const MULTIPLES_LINE_HEIGHT: f64 = 20.0;
const MULTIPLES_LEGEND_COLUMNS: usize = 5;
const MULTIPLES_RADIUS: f64 = 2.6;
/// Distance of points without a value from the upper edge.
const NO_VALUE_HEIGHT: f64 = 7.0;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MultiplesPoint {
    pub series: usize,
    pub setting: usize,
    /// Value above 0. A point without a value lies on the upper edge.
    pub value: Option<f64>,
    pub is_hollow: bool,
}

/// One quantity over a few settings, one panel per row and column, one colour per series.
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
    pub fn svg(&self) -> String {
        let (width, height) = MULTIPLES_PANEL;
        let (columns, rows) = (self.columns.len().max(1) as f64, self.rows.len() as f64);
        let legend_lines = self.series.len().div_ceil(MULTIPLES_LEGEND_COLUMNS) as f64 + 1.0;
        let mut drawing = Drawing::default();
        drawing.text(Role::Title, TextEnd::Left, (8.0, 14.0), &self.title);
        let axes = format!("{}, over {}", self.value_label, self.setting_label);
        drawing.text(Role::Text, TextEnd::Left, (8.0, 34.0), &axes);
        for (column, name) in self.columns.iter().enumerate() {
            let at = (width * column as f64 + MULTIPLES_LEFT, MULTIPLES_HEAD - 8.0);
            drawing.text(Role::Title, TextEnd::Left, at, name);
        }
        for (row, panels) in self.panels.iter().enumerate() {
            for (column, points) in panels.iter().enumerate() {
                let corner = (width * column as f64, MULTIPLES_HEAD + height * row as f64);
                self.draw_panel(&mut drawing, corner, self.rows.get(row).map_or("", String::as_str), points);
            }
        }
        let below = MULTIPLES_HEAD + height * rows + MULTIPLES_LINE_HEIGHT;
        self.draw_legend(&mut drawing, below, width * columns);
        drawing.into_document(&self.title, (width * columns, below + legend_lines * MULTIPLES_LINE_HEIGHT))
    }

    fn scale(&self) -> Range<f64> {
        let values = self.panels.iter().flatten().flatten().filter_map(|point| point.value);
        logarithmic_extent(values).map_or(0.5..20.0, |(low, high)| low / 1.3..high * 1.3)
    }

    fn draw_panel(&self, drawing: &mut Drawing, (x0, y0): Point, name: &str, points: &[MultiplesPoint]) {
        let (left, right) = (x0 + MULTIPLES_LEFT, x0 + MULTIPLES_PANEL.0 - 8.0);
        let (top, bottom) = (y0 + MULTIPLES_TOP, y0 + MULTIPLES_PANEL.1 - 20.0);
        let y = Axis::logarithmic(self.scale(), bottom..top + 2.0 * NO_VALUE_HEIGHT);
        drawing.text(Role::Text, TextEnd::Left, (left, y0 + MULTIPLES_TOP / 2.0), name);
        for tick in round_ticks(&y.values) {
            drawing.line(Role::Grid, [(left, y.pixel(tick)), (right, y.pixel(tick))]);
            drawing.text(Role::Text, TextEnd::Right, (left - 4.0, y.pixel(tick)), &tick.to_string());
        }
        drawing.line(Role::Mark, [(left, top + NO_VALUE_HEIGHT), (right, top + NO_VALUE_HEIGHT)]);
        drawing.line(Role::Axis, [(left, top), (left, bottom), (right, bottom)]);
        let width = (right - left) / self.settings.len().max(1) as f64;
        let centre = |setting: usize| left + (setting as f64 + 0.5) * width;
        for (setting, text) in self.settings.iter().enumerate() {
            drawing.text(Role::Text, TextEnd::Centre, (centre(setting), bottom + 11.0), text);
        }
        // Points of different series are side by side, so that equal values stay visible.
        let step = 0.8 * width / self.series.len().max(1) as f64;
        for point in points {
            let offset = (point.series as f64 - (self.series.len() as f64 - 1.0) / 2.0) * step;
            let value = point.value.filter(|value| value.is_finite() && *value > 0.0);
            let height = value.map_or(top + NO_VALUE_HEIGHT, |value| y.pixel(value));
            let shape = if point.is_hollow { Shape::Ring } else { Shape::Disc };
            let at = (centre(point.setting) + offset, height);
            drawing.shape(Role::Series(point.series), shape, at, MULTIPLES_RADIUS);
        }
    }

    fn draw_legend(&self, drawing: &mut Drawing, top: f64, width: f64) {
        for (number, name) in self.series.iter().enumerate() {
            let column = (number % MULTIPLES_LEGEND_COLUMNS) as f64;
            let x = 12.0 + column * width / MULTIPLES_LEGEND_COLUMNS as f64;
            let y = top + MULTIPLES_LINE_HEIGHT * (number / MULTIPLES_LEGEND_COLUMNS) as f64;
            drawing.shape(Role::Series(number), Shape::Disc, (x, y), MULTIPLES_RADIUS + 1.0);
            drawing.text(Role::Text, TextEnd::Left, (x + 10.0, y), name);
        }
        let y = top + MULTIPLES_LINE_HEIGHT * self.series.len().div_ceil(MULTIPLES_LEGEND_COLUMNS) as f64;
        let middle = width / 2.0;
        drawing.shape(Role::Axis, Shape::Ring, (12.0, y), MULTIPLES_RADIUS + 1.0);
        drawing.text(Role::Text, TextEnd::Left, (22.0, y), &self.hollow_label);
        drawing.line(Role::Mark, [(middle, y), (middle + 16.0, y)]);
        drawing.text(Role::Text, TextEnd::Left, (middle + 22.0, y), &self.edge_label);
    }
}

const STRIP_WIDTH: f64 = 980.0;
const STRIP_LEFT: f64 = 300.0;
const STRIP_RIGHT: f64 = STRIP_WIDTH - 190.0;
const STRIP_TOP: f64 = 66.0;
const STRIP_BOTTOM: f64 = 60.0;
const STRIP_LINE_HEIGHT: f64 = 16.0;
const STRIP_LEGEND_Y: f64 = 44.0;
/// Ratio of the first tick to the left edge: one decade is reserved for values of exactly 0.
const ZERO_AREA_RATIO: f64 = 10.0;

#[derive(Debug, Clone, PartialEq)]
pub struct StripRow {
    pub name: String,
    /// Limit, drawn as a stroke across the line.
    pub limit: Option<f64>,
    /// Colour and value of each mark. A value of 0 lies at the left edge.
    pub values: Vec<(usize, f64)>,
    /// The value with this colour has a ring.
    pub chosen_colour: usize,
    pub note: String,
}

/// One line of points per item on one logarithmic axis: values, the chosen value, the limit.
#[derive(Debug, Clone, PartialEq)]
pub struct StripChart {
    pub title: String,
    pub x_label: String,
    /// Smallest value that is distinguished from 0.
    pub floor: f64,
    pub colours: Vec<String>,
    pub chosen_label: String,
    pub limit_label: String,
    pub rows: Vec<StripRow>,
}

impl StripChart {
    pub fn svg(&self) -> String {
        let values = self.rows.iter().flat_map(|row| row.values.iter().map(|(_, value)| *value));
        let positive = values.chain(self.rows.iter().filter_map(|row| row.limit)).filter(|value| *value > 0.0);
        let xs = decades(positive.map(|value| value.max(self.floor)));
        let left = xs.start / ZERO_AREA_RATIO;
        let axis = Axis::logarithmic(left..xs.end, STRIP_LEFT..STRIP_RIGHT);
        // The position of 0 is in the middle of its decade.
        let zero = left * ZERO_AREA_RATIO.sqrt();
        let column = |value: f64| axis.pixel(if value > 0.0 { value.max(self.floor) } else { zero });
        let bottom = STRIP_TOP + STRIP_LINE_HEIGHT * self.rows.len() as f64;
        let mut drawing = Drawing::default();
        for decade in axis.ticks(usize::MAX) {
            let (x, is_first) = (axis.pixel(decade), decade <= left * 1.01);
            drawing.line(if is_first { Role::Axis } else { Role::Grid }, [(x, STRIP_TOP - 6.0), (x, bottom)]);
            if !is_first {
                drawing.text(Role::Text, TextEnd::Centre, (x, bottom + 14.0), &format_power_of_ten(decade));
            }
        }
        drawing.text(Role::Text, TextEnd::Centre, (axis.pixel(zero), bottom + 14.0), "0");
        for (number, row) in self.rows.iter().enumerate() {
            row.draw(&mut drawing, STRIP_TOP + STRIP_LINE_HEIGHT * (number as f64 + 0.5), &column);
        }
        drawing.text(Role::Title, TextEnd::Left, (14.0, 20.0), &self.title);
        drawing.text(Role::Text, TextEnd::Right, (STRIP_RIGHT, bottom + 40.0), &self.x_label);
        self.draw_legend(&mut drawing);
        drawing.into_document(&self.title, (STRIP_WIDTH, bottom + STRIP_BOTTOM))
    }

    fn draw_legend(&self, drawing: &mut Drawing) {
        let y = STRIP_LEGEND_Y;
        let mut x = 20.0;
        for (number, name) in self.colours.iter().enumerate() {
            drawing.shape(Role::Series(number), Shape::Disc, (x, y), 4.0);
            drawing.text(Role::Text, TextEnd::Left, (x + 10.0, y), name);
            x += 90.0;
        }
        drawing.shape(Role::Series(0), Shape::Ring, (x, y), 6.0);
        drawing.text(Role::Text, TextEnd::Left, (x + 14.0, y), &self.chosen_label);
        x += 190.0;
        drawing.rectangle(Role::Shape, [(x - 1.0, y - 7.0), (x + 1.0, y + 7.0)]);
        drawing.text(Role::Text, TextEnd::Left, (x + 10.0, y), &self.limit_label);
    }
}

impl StripRow {
    fn draw(&self, drawing: &mut Drawing, y: f64, column: &dyn Fn(f64) -> f64) {
        drawing.text(Role::Text, TextEnd::Right, (STRIP_LEFT - 8.0, y), &self.name);
        if !self.note.is_empty() {
            drawing.text(Role::Title, TextEnd::Left, (STRIP_RIGHT + 8.0, y), &self.note);
        }
        if let Some(x) = self.limit.map(column) {
            let half = STRIP_LINE_HEIGHT / 2.0 - 1.0;
            drawing.rectangle(Role::Shape, [(x - 1.0, y - half), (x + 1.0, y + half)]);
        }
        // The circle of the first colour is the smallest and is drawn last, so that circles with the
        // same value are all visible.
        for (colour, value) in self.values.iter().filter(|(_, value)| value.is_finite()).rev() {
            let (at, role) = ((column(*value), y), Role::Series(*colour));
            drawing.shape(role, Shape::Disc, at, 2.5 + *colour as f64);
            if *colour == self.chosen_colour {
                drawing.shape(role, Shape::Ring, at, 7.0);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn multiples(points: Vec<MultiplesPoint>) -> MultiplesChart {
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
        let svg = multiples(vec![point(0, Some(1.0)), point(0, Some(10.0)), point(1, None)]).svg();
        let (values, none) = (heights(&svg, 0), heights(&svg, 1));
        assert!(values[0] > values[1] && values[1] > none[0], "{values:?} {none:?}");
        assert!(svg.contains(">0.4<") && svg.contains(">overshoot<") && svg.contains(">5<"), "{svg}");
    }

    #[test]
    fn a_hollow_point_is_a_ring() {
        let hollow = MultiplesPoint { is_hollow: true, ..point(1, Some(2.0)) };
        let svg = multiples(vec![hollow]).svg();
        assert!(svg.contains("s-series-1"), "{svg}");
        assert_eq!(heights(&svg, 1).len(), 1, "only in the legend");
    }

    fn strip(rows: Vec<StripRow>) -> StripChart {
        StripChart {
            title: "a < b".to_owned(),
            x_label: "error".to_owned(),
            floor: 1e-9,
            colours: vec!["one".to_owned(), "two".to_owned()],
            chosen_label: "chosen".to_owned(),
            limit_label: "limit".to_owned(),
            rows,
        }
    }

    fn row(chosen_colour: usize, note: &str) -> StripRow {
        let (name, note) = ("scene".to_owned(), note.to_owned());
        StripRow { name, limit: Some(1e-3), values: vec![(0, 2e-2), (1, 0.0)], chosen_colour, note }
    }

    #[test]
    fn draws_marks_limits_rings_and_legend() {
        let svg = strip(vec![row(1, "dearer"), row(0, "")]).svg();
        // One ring in the legend and one per row; the ring of the first row has the second colour.
        let rings = |class: &str| svg.matches(&format!("class=\"s-{class}\"")).count();
        assert_eq!((rings("series-0"), rings("series-1")), (2, 1), "{svg}");
        insta::assert_snapshot!(svg.replace("><", ">\n<"));
    }

    #[test]
    fn draws_charts_without_rows_and_without_numbers() {
        assert!(strip(Vec::new()).svg().contains(">limit<"));
        let odd = StripRow { values: vec![(0, f64::INFINITY), (1, f64::NAN)], limit: None, ..row(1, "") };
        assert!(strip(vec![odd]).svg().contains(">scene<"));
    }
}
