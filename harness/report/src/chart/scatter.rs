//! Draws panels of points by colour and shape on two logarithmic axes; the panels share x.

use super::svg::{
    Canvas, DrawArea, DrawResult, Role, UNITS_PER_PIXEL, count_factor, decades, format_power_of_ten, length,
    logarithmic_extent, svg_document, text_style,
};
use crate::error::ReportError;
use plotters::prelude::*;
use plotters::style::text_anchor::HPos;
use std::ops::Range;

/// All lengths below are in CSS pixels.
const WIDTH: i32 = 900;
const PLOT_HEIGHT: i32 = 250;
const MARGIN_TOP: i32 = 84;
const MARGIN_BOTTOM: i32 = 56;
const MARGIN_LEFT: i32 = 70;
const MARGIN_RIGHT: i32 = 330;
const TITLE_HEIGHT: i32 = 30;
const LINE_HEIGHT: i32 = 19;
const RADIUS: f64 = 5.0;
/// Corners of the shapes in units of the radius. The first shape is almost a circle.
const SHAPES: [&[(f64, f64)]; 5] = [
    &[
        (1.0, 0.0),
        (0.87, 0.5),
        (0.5, 0.87),
        (0.0, 1.0),
        (-0.5, 0.87),
        (-0.87, 0.5),
        (-1.0, 0.0),
        (-0.87, -0.5),
        (-0.5, -0.87),
        (0.0, -1.0),
        (0.5, -0.87),
        (0.87, -0.5),
    ],
    &[(0.9, 0.9), (-0.9, 0.9), (-0.9, -0.9), (0.9, -0.9)],
    &[(0.0, -1.25), (1.1, 0.75), (-1.1, 0.75)],
    &[(0.0, -1.35), (1.0, 0.0), (0.0, 1.35), (-1.0, 0.0)],
    &[(0.0, 1.25), (1.1, -0.75), (-1.1, -0.75)],
];

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ScatterPoint {
    pub colour: usize,
    pub shape: usize,
    /// A point without a value lies at the right edge.
    pub x: Option<f64>,
    pub y: f64,
}

#[derive(Debug, Clone, PartialEq)]
pub struct ScatterPanel {
    pub y_label: String,
    /// Points with a smaller y lie on the lower edge.
    pub floor: f64,
    pub shapes: Vec<String>,
    pub points: Vec<ScatterPoint>,
    pub x_limits: Vec<(f64, String)>,
    pub y_limits: Vec<(f64, String)>,
}

#[derive(Debug, Clone, PartialEq)]
pub struct ScatterChart {
    pub title: String,
    pub x_label: String,
    pub colours: Vec<String>,
    /// Text for points at the right edge.
    pub edge_label: String,
    pub panels: Vec<ScatterPanel>,
}

impl ScatterChart {
    pub fn svg(&self) -> Result<String, ReportError> {
        let height = TITLE_HEIGHT + (MARGIN_TOP + PLOT_HEIGHT + MARGIN_BOTTOM) * count_factor(self.panels.len());
        svg_document(&self.title, (WIDTH, height), |root| self.draw(root))
    }

    fn draw(&self, root: &DrawArea<'_>) -> DrawResult {
        Canvas(root).text(Role::Title, HPos::Left, (14, 20), &self.title)?;
        let points = || self.panels.iter().flat_map(|panel| &panel.points);
        let limits = self.panels.iter().flat_map(|panel| panel.x_limits.iter().map(|(x, _)| *x));
        let xs = padded_range(points().filter_map(|point| point.x).chain(limits));
        let (_, rest) = root.split_vertically(TITLE_HEIGHT * UNITS_PER_PIXEL);
        for (number, (panel, area)) in self.panels.iter().zip(rest.split_evenly((self.panels.len(), 1))).enumerate() {
            self.draw_panel(panel, &area, &xs)?;
            if number == 0 {
                self.draw_legend(&area)?;
            }
        }
        Ok(())
    }

    fn draw_panel(&self, panel: &ScatterPanel, area: &DrawArea<'_>, xs: &Range<f64>) -> DrawResult {
        let canvas = Canvas(area);
        let values = panel.points.iter().map(|point| point.y).chain(panel.y_limits.iter().map(|(y, _)| *y));
        let ys = decades(values.map(|y| if y.is_finite() { y.max(panel.floor) } else { y }));
        // Points without x lie between the last x and the end of the axis.
        let (edge, right) = (xs.end * 1.35, xs.end * 1.8);
        let mut chart = ChartBuilder::on(area)
            .margin_top(MARGIN_TOP * UNITS_PER_PIXEL)
            .margin_right(MARGIN_RIGHT * UNITS_PER_PIXEL)
            .set_label_area_size(LabelAreaPosition::Left, MARGIN_LEFT * UNITS_PER_PIXEL)
            .set_label_area_size(LabelAreaPosition::Bottom, MARGIN_BOTTOM * UNITS_PER_PIXEL)
            .build_cartesian_2d((xs.start..right).log_scale(), (ys.start..ys.end).log_scale())?;
        let labels = (ys.end / ys.start).log10().round() as usize + 1;
        chart
            .configure_mesh()
            .disable_x_mesh()
            .x_labels(0)
            .y_labels(labels)
            .x_label_formatter(&|_| String::new())
            .y_label_formatter(&|value| format_power_of_ten(*value))
            .label_style(text_style(Role::Text, HPos::Center))
            .axis_style(Role::Axis.colour())
            .bold_line_style(Role::Grid.colour())
            .light_line_style(TRANSPARENT)
            .set_all_tick_mark_size(length(4.0))
            .draw()?;
        let log =
            |value: f64, range: &Range<f64>, end: f64| (value / range.start).log10() / (end / range.start).log10();
        let width = f64::from(WIDTH - MARGIN_LEFT - MARGIN_RIGHT);
        let column = |x: f64| MARGIN_LEFT + (log(x, xs, right) * width).round() as i32;
        let row = |y: f64| MARGIN_TOP + PLOT_HEIGHT - (log(y, &ys, ys.end) * f64::from(PLOT_HEIGHT)).round() as i32;
        for x in ticks(xs) {
            chart.draw_series([PathElement::new([(x, ys.start), (x, ys.end)], Role::Grid.colour())])?;
            canvas.text(Role::Text, HPos::Center, (column(x), MARGIN_TOP + PLOT_HEIGHT + 14), &x.to_string())?;
        }
        if ys.start <= panel.floor * 1.01 {
            let label = format!("≤ {}", format_power_of_ten(panel.floor));
            canvas.text(Role::Text, HPos::Right, (MARGIN_LEFT - 8, MARGIN_TOP + PLOT_HEIGHT), &label)?;
        }
        // Names of neighbouring limits have different heights, so that they do not overlap.
        let mut x_limits = panel.x_limits.clone();
        x_limits.sort_by(|a, b| a.0.total_cmp(&b.0));
        for (number, (x, name)) in x_limits.iter().enumerate() {
            chart.draw_series([PathElement::new([(*x, ys.start), (*x, ys.end)], Role::Mark.colour())])?;
            let height = MARGIN_TOP - 10 - 16 * count_factor(number % 3);
            canvas.text(Role::Text, HPos::Left, (column(*x) - 3, height), name)?;
        }
        for (y, name) in panel.y_limits.iter().filter(|(y, _)| ys.contains(y)) {
            chart.draw_series([PathElement::new([(xs.start, *y), (right, *y)], Role::Mark.colour())])?;
            canvas.text(Role::Text, HPos::Left, (MARGIN_LEFT + 6, row(*y) - 8), name)?;
        }
        let drawn = panel.points.iter().filter(|point| point.y.is_finite() && point.x.is_none_or(f64::is_finite));
        chart.draw_series(drawn.map(|point| {
            let at = (point.x.unwrap_or(edge), point.y.max(panel.floor));
            EmptyElement::at(at) + shape_polygon(point.shape, (0, 0), Role::Series(point.colour))
        }))?;
        drop(chart);
        canvas.text(Role::Title, HPos::Left, (14, MARGIN_TOP - 62), &panel.y_label)?;
        let below = MARGIN_TOP + PLOT_HEIGHT + MARGIN_BOTTOM - 14;
        canvas.text(Role::Text, HPos::Right, (WIDTH - MARGIN_RIGHT, below), &self.x_label)?;
        self.draw_labels(panel, area)
    }

    fn draw_legend(&self, area: &DrawArea<'_>) -> DrawResult {
        for (number, name) in self.colours.iter().enumerate() {
            let (column, line) = (count_factor(number % 2), count_factor(number / 2));
            let (x, y) = (WIDTH - MARGIN_RIGHT + 24 + 150 * column, MARGIN_TOP - 62 + LINE_HEIGHT * line);
            area.draw(&shape_polygon(0, (x, y), Role::Series(number)))?;
            Canvas(area).text(Role::Text, HPos::Left, (x + 12, y), name)?;
        }
        Ok(())
    }

    fn draw_labels(&self, panel: &ScatterPanel, area: &DrawArea<'_>) -> DrawResult {
        let canvas = Canvas(area);
        let x = WIDTH - MARGIN_RIGHT + 24;
        let mut y = MARGIN_TOP - 62 + LINE_HEIGHT * (count_factor(self.colours.len().div_ceil(2)) + 1);
        for (number, name) in panel.shapes.iter().enumerate() {
            area.draw(&shape_polygon(number, (x, y), Role::Shape))?;
            canvas.text(Role::Text, HPos::Left, (x + 12, y), name)?;
            y += LINE_HEIGHT;
        }
        if panel.points.iter().any(|point| point.x.is_none()) {
            y += LINE_HEIGHT / 2;
            canvas.text(Role::Text, HPos::Left, (x - 6, y), &format!("at the right edge, {}:", self.edge_label))?;
        }
        for (colour, name) in self.colours.iter().enumerate() {
            let at_edge = panel.points.iter().filter(|point| point.colour == colour && point.x.is_none());
            let shapes: Vec<usize> = at_edge.map(|point| point.shape).collect();
            if shapes.is_empty() {
                continue;
            }
            y += LINE_HEIGHT - 2;
            canvas.text(Role::Text, HPos::Left, (x + 12, y), name)?;
            for (number, shape) in shapes.into_iter().enumerate() {
                let at = (x + 130 + 18 * count_factor(number), y);
                area.draw(&shape_polygon(shape, at, Role::Series(colour)))?;
            }
        }
        Ok(())
    }
}

fn shape_polygon(number: usize, (x, y): (i32, i32), role: Role) -> Polygon<(i32, i32)> {
    let corner = |corner: &(f64, f64)| {
        (x * UNITS_PER_PIXEL + length(corner.0 * RADIUS), y * UNITS_PER_PIXEL + length(corner.1 * RADIUS))
    };
    let corners: Vec<_> = SHAPES[number % SHAPES.len()].iter().map(corner).collect();
    Polygon::new(corners, role.colour().filled())
}

fn padded_range(values: impl Iterator<Item = f64>) -> Range<f64> {
    logarithmic_extent(values).map_or(0.5..20.0, |(low, high)| low / 1.4..high * 1.4)
}

fn ticks(range: &Range<f64>) -> Vec<f64> {
    let decades = range.start.log10().floor() as i32..=range.end.log10().ceil() as i32;
    let of_decade = |decade: i32| {
        let power = 10.0_f64.powi(decade.abs());
        [1.0, 2.0, 5.0].map(|digit| if decade < 0 { digit / power } else { digit * power })
    };
    decades.flat_map(of_decade).filter(|tick| range.contains(tick)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn point(colour: usize, shape: usize, x: Option<f64>, y: f64) -> ScatterPoint {
        ScatterPoint { colour, shape, x, y }
    }

    fn scatter(points: Vec<ScatterPoint>) -> ScatterChart {
        let panel = ScatterPanel {
            y_label: "error, %".to_owned(),
            floor: 1e-4,
            shapes: vec!["scene one".to_owned(), "scene two".to_owned()],
            points,
            x_limits: vec![(2.0, "two periods".to_owned())],
            y_limits: vec![(0.1, "noise floor".to_owned())],
        };
        ScatterChart {
            title: "a < b".to_owned(),
            x_label: "time, ms".to_owned(),
            colours: vec!["first".to_owned(), "second".to_owned()],
            edge_label: "never settles".to_owned(),
            panels: vec![panel],
        }
    }

    /// First corner of each shape with this colour. The last shape is that of the legend.
    fn corners(svg: &str, colour: usize) -> Vec<(i64, i64)> {
        let class = format!("<path class=\"f-series-{colour}\" d=\"m");
        let first = |path: &str| {
            let (x, rest) = path.split_once([' ', '-']).unwrap();
            (x.parse().unwrap(), rest.split(['l', ' ']).next().unwrap().parse().unwrap())
        };
        svg.split(&class).skip(1).map(first).collect()
    }

    #[test]
    fn draws_points_limits_and_legend() {
        let svg = scatter(vec![point(0, 0, Some(3.0), 0.5), point(1, 1, None, 30.0)]).svg().unwrap();
        insta::assert_snapshot!(svg.replace("><", ">\n<"));
    }

    #[test]
    fn draws_points_without_x_at_the_right_edge() {
        let svg = scatter(vec![point(0, 0, Some(9.9), 1e-2), point(1, 0, None, 1e-2)]).svg().unwrap();
        let (settled, never) = (corners(&svg, 0)[0], corners(&svg, 1)[0]);
        assert!(never.0 > settled.0 && never.1 == settled.1, "{settled:?} {never:?}");
    }

    #[test]
    fn draws_points_below_the_floor_on_the_lower_edge() {
        let svg = scatter(vec![point(0, 0, Some(2.0), 1e-9), point(0, 0, Some(9.0), 1e-4)]).svg().unwrap();
        let found = corners(&svg, 0);
        assert_eq!(found[0].1, found[1].1, "{found:?}");
    }

    #[test]
    fn ticks_are_round_and_within_the_range() {
        assert_eq!(ticks(&(0.48..21.0)), [0.5, 1.0, 2.0, 5.0, 10.0, 20.0]);
        assert_eq!(ticks(&(0.02..0.0499)), [0.02]);
        assert_eq!(padded_range([f64::NAN, 0.0, 2.8].into_iter()), 2.8 / 1.4..2.8 * 1.4);
        assert_eq!(padded_range(std::iter::empty()), 0.5..20.0);
    }

    #[test]
    fn draws_a_chart_without_points() {
        assert!(scatter(Vec::new()).svg().unwrap().contains(">noise floor<"));
    }
}
