//! Draws lines of points on two logarithmic axes.

use super::svg::{
    COLOURS, Canvas, DrawArea, DrawResult, Role, UNITS_PER_PIXEL, count_factor, decades, format_power_of_ten, length,
    svg_document, text_style,
};
use crate::error::ReportError;
use plotters::prelude::*;
use plotters::style::text_anchor::HPos;
use std::ops::Range;

const SIZE: (i32, i32) = (720, 430);
const LEGEND_WIDTH: i32 = 236;
const LEGEND_TOP: i32 = 72;
const LEGEND_LINE_HEIGHT: i32 = 24;
const MAX_LABELS: usize = 9;

#[derive(Debug, Clone, PartialEq)]
pub struct LogLogSeries {
    pub name: String,
    /// Positive x and y, in the order of the line.
    pub points: Vec<(f64, f64)>,
    /// y of each setting without a result; drawn as a cross at the right edge.
    pub failed: Vec<f64>,
    pub is_highlighted: bool,
}

#[derive(Debug, Clone, PartialEq)]
pub struct LogLogChart {
    pub title: String,
    pub x_label: String,
    pub y_label: String,
    /// The first series is drawn in front.
    pub series: Vec<LogLogSeries>,
    /// x and name of a dashed line.
    pub vertical_line: Option<(f64, String)>,
    pub failed_label: String,
}

impl LogLogChart {
    pub fn svg(&self) -> Result<String, ReportError> {
        svg_document(&self.title, SIZE, |root| self.draw(root))
    }

    fn draw(&self, root: &DrawArea<'_>) -> DrawResult {
        let marked = self.vertical_line.iter().map(|(x, _)| *x);
        let xs = decades(self.series.iter().flat_map(|series| series.points.iter().map(|point| point.0)).chain(marked));
        let costs = |series: &LogLogSeries| {
            series.points.iter().map(|point| point.1).chain(series.failed.clone()).collect::<Vec<_>>()
        };
        let ys = decades(self.series.iter().flat_map(costs));
        // The x axis has one more decade at the right for settings without a result.
        let has_failed = self.series.iter().any(|series| !series.failed.is_empty());
        let edge = xs.end * 10.0_f64.sqrt();
        let right = if has_failed { xs.end * 10.0 } else { xs.end };
        let mut chart = ChartBuilder::on(root)
            .margin_top(60 * UNITS_PER_PIXEL)
            .margin_right(LEGEND_WIDTH * UNITS_PER_PIXEL)
            .set_label_area_size(LabelAreaPosition::Left, 70 * UNITS_PER_PIXEL)
            .set_label_area_size(LabelAreaPosition::Bottom, 56 * UNITS_PER_PIXEL)
            .build_cartesian_2d((xs.start..right).log_scale(), (ys.start..ys.end).log_scale())?;
        let labels = |range: &Range<f64>| ((range.end / range.start).log10().round() as usize + 1).min(MAX_LABELS);
        chart
            .configure_mesh()
            .x_labels(labels(&(xs.start..right)))
            .y_labels(labels(&ys))
            .x_label_formatter(&|value| {
                if *value > xs.end * 1.01 { String::new() } else { format_power_of_ten(*value) }
            })
            .y_label_formatter(&|value| format_power_of_ten(*value))
            .label_style(text_style(Role::Text, HPos::Center))
            .axis_style(Role::Axis.colour())
            .bold_line_style(Role::Grid.colour())
            .light_line_style(TRANSPARENT)
            .set_all_tick_mark_size(length(4.0))
            .draw()?;
        if let Some((x, _)) = &self.vertical_line {
            chart.draw_series([PathElement::new([(*x, ys.start), (*x, ys.end)], Role::Mark.colour())])?;
        }
        for (number, series) in self.series.iter().enumerate().rev() {
            let colour = Role::Series(number).colour();
            let radius = length(if series.is_highlighted { 7.0 } else { 4.0 });
            chart.draw_series([PathElement::new(series.points.clone(), colour)])?;
            let fill = if repeats_a_colour(number) { colour.stroke_width(1) } else { colour.filled() };
            chart.draw_series(series.points.iter().map(|point| Circle::new(*point, radius, fill)))?;
            chart.draw_series(series.failed.iter().map(|y| Cross::new((edge, *y), length(5.0), colour)))?;
        }
        drop(chart);
        self.draw_labels(&Canvas(root), has_failed)
    }

    fn draw_labels(&self, canvas: &Canvas<'_, '_>, has_failed: bool) -> DrawResult {
        let left = SIZE.0 - LEGEND_WIDTH + 18;
        canvas.text(Role::Title, HPos::Left, (14, 20), &self.title)?;
        canvas.text(Role::Text, HPos::Left, (14, 44), &self.y_label)?;
        canvas.text(Role::Text, HPos::Right, (SIZE.0 - LEGEND_WIDTH, SIZE.1 - 10), &self.x_label)?;
        let lines = self.series.len() + usize::from(has_failed) + usize::from(self.vertical_line.is_some());
        let line_height = LEGEND_LINE_HEIGHT.min((SIZE.1 - LEGEND_TOP) / count_factor(lines.max(1)));
        let mut y = LEGEND_TOP;
        for (number, series) in self.series.iter().enumerate() {
            let role = Role::Series(number);
            let (centre, radius) = ((left + 11, y), if series.is_highlighted { 6.0 } else { 4.0 });
            canvas.line(role, [(left, y), (left + 22, y)])?;
            if repeats_a_colour(number) {
                canvas.ring(role, centre, radius)?;
            } else {
                canvas.circle(role, centre, radius)?;
            }
            canvas.text(Role::Text, HPos::Left, (left + 30, y), &series.name)?;
            y += line_height;
        }
        if has_failed {
            canvas.cross(Role::Axis, (left + 11, y), 5.0)?;
            canvas.text(Role::Text, HPos::Left, (left + 30, y), &self.failed_label)?;
            y += line_height;
        }
        if let Some((_, name)) = &self.vertical_line {
            canvas.line(Role::Mark, [(left, y), (left + 22, y)])?;
            canvas.text(Role::Text, HPos::Left, (left + 30, y), name)?;
        }
        Ok(())
    }
}

fn repeats_a_colour(number: usize) -> bool {
    number >= COLOURS
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chart() -> LogLogChart {
        LogLogChart {
            title: "a < b".to_owned(),
            x_label: "error".to_owned(),
            y_label: "cost".to_owned(),
            series: vec![
                LogLogSeries {
                    name: "one".to_owned(),
                    points: vec![(1e-9, 30.0), (1e-3, 2.0)],
                    failed: vec![],
                    is_highlighted: true,
                },
                LogLogSeries { name: "two".to_owned(), points: vec![], failed: vec![5.0], is_highlighted: false },
            ],
            vertical_line: Some((1e-6, "limit".to_owned())),
            failed_label: "without a result".to_owned(),
        }
    }

    #[test]
    fn draws_lines_crosses_and_legend() {
        insta::assert_snapshot!(chart().svg().unwrap().replace("><", ">\n<"));
    }

    #[test]
    fn a_long_legend_fits_and_repeated_colours_are_rings() {
        let nameless = chart().series.remove(1);
        let series = (1..=17).map(|number| LogLogSeries { name: number.to_string(), ..nameless.clone() }).collect();
        let svg = LogLogChart { series, vertical_line: None, ..chart() }.svg().unwrap();
        let circles: Vec<&str> = svg.split("<circle").skip(1).filter_map(|rest| rest.split('>').next()).collect();
        let count = |class: &str| circles.iter().filter(|circle| circle.contains(class)).count();
        assert_eq!((count("class=\"f-series"), count("class=\"s-series")), (10, 7));
        let lowest =
            svg.split(" cy=\"").skip(1).map(|rest| rest.split('"').next().unwrap().parse::<i32>().unwrap()).max();
        assert!(lowest.unwrap() < (SIZE.1 - LEGEND_LINE_HEIGHT / 2) * UNITS_PER_PIXEL, "{lowest:?}");
    }

    #[test]
    fn draws_a_chart_without_points() {
        let chart = LogLogChart { series: Vec::new(), vertical_line: None, ..chart() };
        assert!(!chart.svg().unwrap().contains("without a result"));
    }
}
