//! A log-log drawing that stands alone: its own colours for light and dark, its own legend.

use super::ink::{Area, Drawn, FINE, Role, decades, document, power, text};
use crate::error::ReportError;
use plotters::prelude::*;
use plotters::style::text_anchor::HPos;
use std::ops::Range;

const SIZE: (i32, i32) = (720 * FINE, 430 * FINE);
/// Room on the right for the legend.
const LEGEND: i32 = 236 * FINE;
/// So many labels stand beside each other without touching.
const MOST_LABELS: usize = 9;
/// One method's line.
#[derive(Debug, Clone, PartialEq)]
pub struct Series {
    /// Its name in the legend.
    pub name: String,
    /// x and y of each setting, both above zero, in the order in which they are joined.
    pub points: Vec<(f64, f64)>,
    /// y of settings without a result: crosses at the right edge.
    pub failed: Vec<f64>,
    /// True for a thicker line and larger points.
    pub is_ours: bool,
}

/// A drawing.
#[derive(Debug, Clone, PartialEq)]
pub struct LogLog {
    /// What it shows.
    pub title: String,
    /// What stands below, with its unit.
    pub x_label: String,
    /// What stands at the left, with its unit.
    pub y_label: String,
    /// Lines, the first in front.
    pub series: Vec<Series>,
    /// A dashed line at an x, with its word.
    pub mark: Option<(f64, String)>,
    /// What the crosses at the right edge mean.
    pub failed_label: String,
}

impl LogLog {
    /// The drawing as an SVG document.
    ///
    /// # Errors
    /// [`ReportError::Plot`] where it cannot be drawn.
    pub fn svg(&self) -> Result<String, ReportError> {
        document(&self.title, SIZE, self.series.len(), |root| self.draw(root))
    }

    fn draw(&self, root: &Area<'_>) -> Drawn<()> {
        let marked = self.mark.iter().map(|(x, _)| *x);
        let xs = decades(self.series.iter().flat_map(|series| series.points.iter().map(|point| point.0)).chain(marked));
        let costs = |series: &Series| {
            series.points.iter().map(|point| point.1).chain(series.failed.clone()).collect::<Vec<_>>()
        };
        let ys = decades(self.series.iter().flat_map(costs));
        // A decade at the right for what has no error that could be told.
        let has_failed = self.series.iter().any(|series| !series.failed.is_empty());
        let edge = xs.end * 10.0_f64.sqrt();
        let right = if has_failed { xs.end * 10.0 } else { xs.end };
        let mut chart = ChartBuilder::on(root)
            .margin_top(u32::try_from(60 * FINE)?)
            .margin_right(u32::try_from(LEGEND)?)
            .set_label_area_size(LabelAreaPosition::Left, u32::try_from(70 * FINE)?)
            .set_label_area_size(LabelAreaPosition::Bottom, u32::try_from(56 * FINE)?)
            .build_cartesian_2d((xs.start..right).log_scale(), (ys.start..ys.end).log_scale())?;
        let many = |range: &Range<f64>| ((range.end / range.start).log10().round() as usize + 1).min(MOST_LABELS);
        chart
            .configure_mesh()
            .x_labels(many(&(xs.start..right)))
            .y_labels(many(&ys))
            .x_label_formatter(&|value| if *value > xs.end * 1.01 { String::new() } else { power(*value) })
            .y_label_formatter(&|value| power(*value))
            .label_style(text(Role::Text, HPos::Center))
            .axis_style(Role::Axis.colour())
            .bold_line_style(Role::Grid.colour())
            .light_line_style(TRANSPARENT)
            .set_all_tick_mark_size(u32::try_from(4 * FINE)?)
            .draw()?;
        if let Some((x, _)) = &self.mark {
            chart.draw_series([PathElement::new([(*x, ys.start), (*x, ys.end)], Role::Mark.colour())])?;
        }
        for (number, series) in self.series.iter().enumerate().rev() {
            let colour = Role::Series(number).colour();
            let radius = if series.is_ours { 7 * FINE } else { 4 * FINE };
            chart.draw_series([PathElement::new(series.points.clone(), colour)])?;
            chart.draw_series(series.points.iter().map(|point| Circle::new(*point, radius, colour.filled())))?;
            chart.draw_series(series.failed.iter().map(|y| Cross::new((edge, *y), 5 * FINE, colour)))?;
        }
        drop(chart);
        self.words(root, has_failed)
    }

    fn words(&self, root: &Area<'_>, has_failed: bool) -> Drawn<()> {
        let at = |x: i32, y: i32| (x * FINE, y * FINE);
        let left = SIZE.0 / FINE - LEGEND / FINE + 18;
        root.draw_text(&self.title, &text(Role::Title, HPos::Left), at(14, 20))?;
        root.draw_text(&self.y_label, &text(Role::Text, HPos::Left), at(14, 44))?;
        root.draw_text(&self.x_label, &text(Role::Text, HPos::Right), (SIZE.0 - LEGEND, SIZE.1 - 10 * FINE))?;
        let mut y = 72;
        for (number, series) in self.series.iter().enumerate() {
            let colour = Role::Series(number).colour();
            root.draw(&PathElement::new([at(left, y), at(left + 22, y)], colour))?;
            let radius = if series.is_ours { 6 * FINE } else { 4 * FINE };
            root.draw(&Circle::new(at(left + 11, y), radius, colour.filled()))?;
            root.draw_text(&series.name, &text(Role::Text, HPos::Left), at(left + 30, y))?;
            y += 24;
        }
        if has_failed {
            root.draw(&Cross::new(at(left + 11, y), 5 * FINE, Role::Axis.colour()))?;
            root.draw_text(&self.failed_label, &text(Role::Text, HPos::Left), at(left + 30, y))?;
            y += 24;
        }
        if let Some((_, word)) = &self.mark {
            root.draw(&PathElement::new([at(left, y), at(left + 22, y)], Role::Mark.colour()))?;
            root.draw_text(word, &text(Role::Text, HPos::Left), at(left + 30, y))?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chart() -> LogLog {
        LogLog {
            title: "a < b".to_owned(),
            x_label: "error".to_owned(),
            y_label: "cost".to_owned(),
            series: vec![
                Series {
                    name: "one".to_owned(),
                    points: vec![(1e-9, 30.0), (1e-3, 2.0)],
                    failed: vec![],
                    is_ours: true,
                },
                Series { name: "two".to_owned(), points: vec![], failed: vec![5.0], is_ours: false },
            ],
            mark: Some((1e-6, "here".to_owned())),
            failed_label: "without a result".to_owned(),
        }
    }

    #[test]
    fn every_element_has_a_class_and_every_class_its_colours() {
        let svg = chart().svg().unwrap();
        let (style, body) = svg.split_once("</style>").unwrap();
        assert!(!body.contains("=\"#"), "{body}");
        for class in ["l s0", "f0", "l s1", "g", "a", "m", "t"] {
            assert!(body.contains(&format!("class=\"{class}\"")), "{class}: {body}");
        }
        assert!(style.contains("prefers-color-scheme:dark") && style.contains("aria-label=\"a &lt; b\""), "{style}");
        assert!(body.contains("without a result") && body.contains("here"));
    }

    #[test]
    fn a_chart_without_points_is_still_a_chart() {
        let chart = LogLog { series: Vec::new(), mark: None, ..chart() };
        assert!(!chart.svg().unwrap().contains("without a result"));
    }
}
