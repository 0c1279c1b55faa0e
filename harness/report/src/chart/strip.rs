//! Draws one line of marks per item on one logarithmic axis: values, the chosen value, the limit.

use super::svg::{Canvas, DrawArea, DrawResult, Role, count_factor, decades, format_power_of_ten, svg_document};
use crate::error::ReportError;
use plotters::style::text_anchor::HPos;

const WIDTH: i32 = 980;
const MARGIN_LEFT: i32 = 300;
const MARGIN_RIGHT: i32 = 190;
const MARGIN_TOP: i32 = 66;
const MARGIN_BOTTOM: i32 = 60;
const LINE_HEIGHT: i32 = 16;
const LEGEND_Y: i32 = 44;
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
    pub fn svg(&self) -> Result<String, ReportError> {
        let height = MARGIN_TOP + LINE_HEIGHT * count_factor(self.rows.len()) + MARGIN_BOTTOM;
        svg_document(&self.title, (WIDTH, height), |root| self.draw(root))
    }

    fn draw(&self, root: &DrawArea<'_>) -> DrawResult {
        let canvas = Canvas(root);
        let values = self.rows.iter().flat_map(|row| row.values.iter().map(|(_, value)| *value));
        let positive = values.chain(self.rows.iter().filter_map(|row| row.limit)).filter(|value| *value > 0.0);
        let xs = decades(positive.map(|value| value.max(self.floor)));
        let left = xs.start / ZERO_AREA_RATIO;
        let span = (xs.end / left).log10();
        let column = |value: f64| {
            let from_left = if value > 0.0 { (value.max(self.floor) / left).log10() } else { 0.5 };
            MARGIN_LEFT + (from_left / span * f64::from(WIDTH - MARGIN_LEFT - MARGIN_RIGHT)).round() as i32
        };
        let bottom = MARGIN_TOP + LINE_HEIGHT * count_factor(self.rows.len());
        for decade in 0..=(span.round() as i32) {
            let value = left * 10.0_f64.powi(decade);
            let x = column(value);
            canvas.line(if decade < 1 { Role::Axis } else { Role::Grid }, [(x, MARGIN_TOP - 6), (x, bottom)])?;
            if decade > 0 {
                canvas.text(Role::Text, HPos::Center, (x, bottom + 14), &format_power_of_ten(value))?;
            }
        }
        canvas.text(Role::Text, HPos::Center, (column(0.0), bottom + 14), "0")?;
        for (number, row) in self.rows.iter().enumerate() {
            let y = MARGIN_TOP + LINE_HEIGHT * count_factor(number) + LINE_HEIGHT / 2;
            canvas.text(Role::Text, HPos::Right, (MARGIN_LEFT - 8, y), &row.name)?;
            if !row.note.is_empty() {
                canvas.text(Role::Title, HPos::Left, (WIDTH - MARGIN_RIGHT + 8, y), &row.note)?;
            }
            if let Some(limit) = row.limit {
                let half = LINE_HEIGHT / 2 - 1;
                canvas.rectangle(Role::Shape, [(column(limit) - 1, y - half), (column(limit) + 1, y + half)])?;
            }
            // The circle of the first colour is the smallest and is drawn last, so that circles
            // with the same value are all visible.
            for (colour, value) in row.values.iter().filter(|(_, value)| value.is_finite()).rev() {
                let (at, role) = ((column(*value), y), Role::Series(*colour));
                canvas.circle(role, at, 2.5 + f64::from(count_factor(*colour)))?;
                if *colour == row.chosen_colour {
                    canvas.ring(role, at, 7.0)?;
                }
            }
        }
        canvas.text(Role::Title, HPos::Left, (14, 20), &self.title)?;
        canvas.text(Role::Text, HPos::Right, (WIDTH - MARGIN_RIGHT, bottom + 40), &self.x_label)?;
        self.draw_legend(&canvas)
    }

    fn draw_legend(&self, canvas: &Canvas<'_, '_>) -> DrawResult {
        let mut x = 20;
        for (number, name) in self.colours.iter().enumerate() {
            canvas.circle(Role::Series(number), (x, LEGEND_Y), 4.0)?;
            canvas.text(Role::Text, HPos::Left, (x + 10, LEGEND_Y), name)?;
            x += 90;
        }
        canvas.ring(Role::Series(0), (x, LEGEND_Y), 6.0)?;
        canvas.text(Role::Text, HPos::Left, (x + 14, LEGEND_Y), &self.chosen_label)?;
        x += 190;
        canvas.rectangle(Role::Shape, [(x - 1, LEGEND_Y - 7), (x + 1, LEGEND_Y + 7)])?;
        canvas.text(Role::Text, HPos::Left, (x + 10, LEGEND_Y), &self.limit_label)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chart(rows: Vec<StripRow>) -> StripChart {
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
        let svg = chart(vec![row(1, "dearer"), row(0, "")]).svg().unwrap();
        // One ring in the legend and one per row; the ring of the first row has the second colour.
        let rings = |class: &str| svg.matches(&format!("fill=\"none\" class=\"s-{class}\"")).count();
        assert_eq!((rings("series-0"), rings("series-1")), (2, 1), "{svg}");
        insta::assert_snapshot!(svg.replace("><", ">\n<"));
    }

    #[test]
    fn draws_charts_without_rows_and_without_numbers() {
        assert!(chart(Vec::new()).svg().unwrap().contains(">limit<"));
        let odd = StripRow { values: vec![(0, f64::INFINITY), (1, f64::NAN)], limit: None, ..row(1, "") };
        assert!(chart(vec![odd]).svg().unwrap().contains(">scene<"));
    }
}
