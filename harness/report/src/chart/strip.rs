//! A line of marks for each of many things, on one logarithmic axis: what was found, what was chosen, what was allowed.

use super::ink::{Area, Drawn, FINE, Role, decades, document, many, power, text};
use crate::error::ReportError;
use plotters::prelude::*;
use plotters::style::text_anchor::HPos;

/// CSS pixels.
const WIDTH: i32 = 980;
const LEFT: i32 = 300;
const RIGHT: i32 = 190;
const ABOVE: i32 = 66;
const BELOW: i32 = 60;
const LINE: i32 = 16;
/// Decades at the left for what is exactly 0.
const ZERO: f64 = 10.0;

/// A thing and its marks.
#[derive(Debug, Clone, PartialEq)]
pub struct Row {
    /// Its name.
    pub name: String,
    /// What is allowed: a stroke across the line; none where nothing is.
    pub allowed: Option<f64>,
    /// What was found of each colour; 0 stands at the left edge.
    pub found: Vec<(usize, f64)>,
    /// The colour that was chosen: it has a ring.
    pub chosen: usize,
    /// What has to be said of it, at the right.
    pub remark: String,
}

/// A drawing.
#[derive(Debug, Clone, PartialEq)]
pub struct Strip {
    /// What it shows.
    pub title: String,
    /// What goes from left to right.
    pub x_label: String,
    /// Smallest value that is told apart from 0.
    pub least: f64,
    /// Names of colours.
    pub colours: Vec<String>,
    /// What the ring means.
    pub chosen_label: String,
    /// What the stroke means.
    pub allowed_label: String,
    /// From the top.
    pub rows: Vec<Row>,
}

impl Strip {
    /// The drawing as an SVG document.
    ///
    /// # Errors
    /// [`ReportError::Plot`] where it cannot be drawn.
    pub fn svg(&self) -> Result<String, ReportError> {
        let (width, height) = self.size();
        document(&self.title, (width * FINE, height * FINE), self.colours.len(), |root| self.draw(root))
    }

    /// CSS pixels.
    fn size(&self) -> (i32, i32) {
        (WIDTH, ABOVE + LINE * many(self.rows.len()) + BELOW)
    }

    fn draw(&self, root: &Area<'_>) -> Drawn<()> {
        let found = self.rows.iter().flat_map(|row| row.found.iter().map(|(_, value)| *value));
        let told = found.chain(self.rows.iter().filter_map(|row| row.allowed)).filter(|value| *value > 0.0);
        let xs = decades(told.map(|value| value.max(self.least)));
        let left = xs.start / ZERO;
        let span = (xs.end / left).log10();
        let column = |value: f64| {
            let from_left = if value > 0.0 { (value.max(self.least) / left).log10() } else { 0.5 };
            LEFT + (from_left / span * f64::from(WIDTH - LEFT - RIGHT)).round() as i32
        };
        let foot = ABOVE + LINE * many(self.rows.len());
        for decade in 0..=(span.round() as i32) {
            let x = column(left * 10.0_f64.powi(decade)) * FINE;
            let ends = [(x, (ABOVE - 6) * FINE), (x, foot * FINE)];
            root.draw(&PathElement::new(ends, if decade < 1 { Role::Axis } else { Role::Grid }.colour()))?;
            if decade > 0 {
                let name = power(left * 10.0_f64.powi(decade));
                root.draw_text(&name, &text(Role::Text, HPos::Center), (x, (foot + 14) * FINE))?;
            }
        }
        root.draw_text("0", &text(Role::Text, HPos::Center), (column(0.0) * FINE, (foot + 14) * FINE))?;
        for (number, row) in self.rows.iter().enumerate() {
            let y = (ABOVE + LINE * many(number) + LINE / 2) * FINE;
            root.draw_text(&row.name, &text(Role::Text, HPos::Right), ((LEFT - 8) * FINE, y))?;
            if !row.remark.is_empty() {
                let at = ((WIDTH - RIGHT + 8) * FINE, y);
                root.draw_text(&row.remark, &text(Role::Title, HPos::Left), at)?;
            }
            if let Some(allowed) = row.allowed {
                let x = column(allowed) * FINE;
                let half = (LINE / 2 - 1) * FINE;
                root.draw(&Rectangle::new(
                    [(x - FINE, y - half), (x + FINE, y + half)],
                    Role::Shape.colour().filled(),
                ))?;
            }
            // The first on top and smallest, so that all are seen where they fall together.
            for (colour, value) in row.found.iter().filter(|(_, value)| value.is_finite()).rev() {
                let (at, ink) = ((column(*value) * FINE, y), Role::Series(*colour).colour());
                root.draw(&Circle::new(at, (5 + 2 * many(*colour)) * FINE / 2, ink.filled()))?;
                if *colour == row.chosen {
                    root.draw(&Circle::new(at, 7 * FINE, ink))?;
                }
            }
        }
        root.draw_text(&self.title, &text(Role::Title, HPos::Left), (14 * FINE, 20 * FINE))?;
        let below = ((WIDTH - RIGHT) * FINE, (foot + 40) * FINE);
        root.draw_text(&self.x_label, &text(Role::Text, HPos::Right), below)?;
        let mut x = 20;
        for (number, name) in self.colours.iter().enumerate() {
            root.draw(&Circle::new((x * FINE, 44 * FINE), 4 * FINE, Role::Series(number).colour().filled()))?;
            root.draw_text(name, &text(Role::Text, HPos::Left), ((x + 10) * FINE, 44 * FINE))?;
            x += 90;
        }
        root.draw(&Circle::new((x * FINE, 44 * FINE), 6 * FINE, Role::Series(0).colour()))?;
        root.draw_text(&self.chosen_label, &text(Role::Text, HPos::Left), ((x + 14) * FINE, 44 * FINE))?;
        x += 190;
        let stroke = [((x - 1) * FINE, 37 * FINE), ((x + 1) * FINE, 51 * FINE)];
        root.draw(&Rectangle::new(stroke, Role::Shape.colour().filled()))?;
        root.draw_text(&self.allowed_label, &text(Role::Text, HPos::Left), ((x + 10) * FINE, 44 * FINE))?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn strip(rows: Vec<Row>) -> Strip {
        Strip {
            title: "a < b".to_owned(),
            x_label: "error".to_owned(),
            least: 1e-9,
            colours: vec!["one".to_owned(), "two".to_owned()],
            chosen_label: "chosen".to_owned(),
            allowed_label: "allowed".to_owned(),
            rows,
        }
    }

    fn row(chosen: usize, remark: &str) -> Row {
        let name = "scene".to_owned();
        Row { name, allowed: Some(1e-3), found: vec![(0, 2e-2), (1, 0.0)], chosen, remark: remark.to_owned() }
    }

    #[test]
    fn everything_has_a_role_and_what_is_chosen_a_ring() {
        let svg = strip(vec![row(1, "dearer"), row(0, "")]).svg().unwrap();
        let (_, body) = svg.split_once("</style>").unwrap();
        assert!(!body.contains("=\"#"), "{body}");
        assert_eq!(body.matches("dearer").count(), 1, "{body}");
        // One ring in the legend, one for each row; the second row's is of the other colour.
        let rings = |class: &str| body.matches(&format!("class=\"l s{class}\"")).count();
        assert_eq!((rings("0"), rings("1")), (2, 1), "{body}");
    }

    #[test]
    fn nothing_at_all_can_be_drawn_and_so_can_what_is_no_number() {
        assert!(strip(Vec::new()).svg().unwrap().contains("allowed"));
        let odd = Row { found: vec![(0, f64::INFINITY), (1, f64::NAN)], allowed: None, ..row(1, "") };
        assert!(strip(vec![odd]).svg().unwrap().contains("scene"));
    }
}
