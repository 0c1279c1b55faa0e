//! Draws points on two logarithmic axes: lines of points, and panels of points by colour and shape.

use super::marks::{
    Axes, Axis, AxisValue, COLOURS, Drawing, Mark, Point, Role, Shape, TextEnd, Ticks, decades, format_power_of_ten,
    logarithmic_extent, round_ticks,
};
use std::ops::Range;

/// Width and height. All lengths in this module are in CSS pixels.
const LOGLOG_SIZE: Point = (720.0, 430.0);
const LOGLOG_LEGEND_WIDTH: f64 = 236.0;
const LOGLOG_LEGEND_TOP: f64 = 72.0;
const LOGLOG_LINE_HEIGHT: f64 = 24.0;
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

/// Lines of points on two logarithmic axes.
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
    pub fn svg(&self) -> String {
        let (width, height) = LOGLOG_SIZE;
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
        let axes = Axes {
            x: Axis::logarithmic(xs.start..right, 70.0..width - LOGLOG_LEGEND_WIDTH),
            y: Axis::logarithmic(ys, height - 56.0..60.0),
        };
        let x_text = |value: f64| if value > xs.end * 1.01 { String::new() } else { format_power_of_ten(value) };
        let mut drawing = Drawing::default();
        drawing.frame(
            &axes,
            &Ticks::new(axes.x.ticks(MAX_LABELS), true, x_text),
            &Ticks::new(axes.y.ticks(MAX_LABELS), true, format_power_of_ten),
        );
        let limit = |(x, _): &(f64, String)| Mark::Limit { role: Role::Mark, at: AxisValue::X(*x), text: None };
        drawing.marks(&axes, &self.vertical_line.iter().map(limit).collect::<Vec<_>>());
        for (number, series) in self.series.iter().enumerate().rev() {
            let (role, radius) = (Role::Series(number), if series.is_highlighted { 7.0 } else { 4.0 });
            let point = |at: Point, shape, radius| Mark::Point { role, at, shape, radius, text: None };
            let mut marks = vec![Mark::Line(role, series.points.clone())];
            marks.extend(series.points.iter().map(|at| point(*at, disc_or_ring(number), radius)));
            marks.extend(series.failed.iter().map(|y| point((edge, *y), Shape::Cross, 5.0)));
            drawing.marks(&axes, &marks);
        }
        drawing.text(Role::Title, TextEnd::Left, (14.0, 20.0), &self.title);
        drawing.text(Role::Text, TextEnd::Left, (14.0, 44.0), &self.y_label);
        drawing.text(Role::Text, TextEnd::Right, (width - LOGLOG_LEGEND_WIDTH, height - 10.0), &self.x_label);
        self.draw_legend(&mut drawing, has_failed);
        drawing.into_document(&self.title, LOGLOG_SIZE)
    }

    fn draw_legend(&self, drawing: &mut Drawing, has_failed: bool) {
        let left = LOGLOG_SIZE.0 - LOGLOG_LEGEND_WIDTH + 18.0;
        let lines = self.series.len() + usize::from(has_failed) + usize::from(self.vertical_line.is_some());
        let line_height = LOGLOG_LINE_HEIGHT.min((LOGLOG_SIZE.1 - LOGLOG_LEGEND_TOP) / lines.max(1) as f64);
        let mut y = LOGLOG_LEGEND_TOP;
        for (number, series) in self.series.iter().enumerate() {
            let (role, radius) = (Role::Series(number), if series.is_highlighted { 6.0 } else { 4.0 });
            drawing.line(role, [(left, y), (left + 22.0, y)]);
            drawing.shape(role, disc_or_ring(number), (left + 11.0, y), radius);
            drawing.text(Role::Text, TextEnd::Left, (left + 30.0, y), &series.name);
            y += line_height;
        }
        if has_failed {
            drawing.shape(Role::Axis, Shape::Cross, (left + 11.0, y), 5.0);
            drawing.text(Role::Text, TextEnd::Left, (left + 30.0, y), &self.failed_label);
            y += line_height;
        }
        if let Some((_, name)) = &self.vertical_line {
            drawing.line(Role::Mark, [(left, y), (left + 22.0, y)]);
            drawing.text(Role::Text, TextEnd::Left, (left + 30.0, y), name);
        }
    }
}

/// Series that repeat a colour have rings.
const fn disc_or_ring(series: usize) -> Shape {
    if series >= COLOURS { Shape::Ring } else { Shape::Disc }
}

const SCATTER_WIDTH: f64 = 900.0;
const SCATTER_PLOT_HEIGHT: f64 = 250.0;
const SCATTER_TOP: f64 = 84.0;
const SCATTER_BOTTOM: f64 = 56.0;
const SCATTER_LEFT: f64 = 70.0;
const SCATTER_RIGHT: f64 = SCATTER_WIDTH - 330.0;
const SCATTER_TITLE_HEIGHT: f64 = 30.0;
const SCATTER_LINE_HEIGHT: f64 = 19.0;
const SCATTER_RADIUS: f64 = 5.0;
const SHAPES: [Shape; 5] = [Shape::Disc, Shape::Square, Shape::Triangle, Shape::Diamond, Shape::InvertedTriangle];

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

/// Panels of points by colour and shape on two logarithmic axes; the panels share x.
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
    pub fn svg(&self) -> String {
        let panel_height = SCATTER_TOP + SCATTER_PLOT_HEIGHT + SCATTER_BOTTOM;
        let points = || self.panels.iter().flat_map(|panel| &panel.points);
        let limits = self.panels.iter().flat_map(|panel| panel.x_limits.iter().map(|(x, _)| *x));
        let xs = padded_range(points().filter_map(|point| point.x).chain(limits));
        let mut drawing = Drawing::default();
        drawing.text(Role::Title, TextEnd::Left, (14.0, 20.0), &self.title);
        for (number, panel) in self.panels.iter().enumerate() {
            let top = SCATTER_TITLE_HEIGHT + panel_height * number as f64 + SCATTER_TOP;
            self.draw_panel(&mut drawing, panel, top, &xs);
            self.draw_edge_labels(&mut drawing, panel, top);
            if number == 0 {
                self.draw_legend(&mut drawing, top);
            }
        }
        let height = SCATTER_TITLE_HEIGHT + panel_height * self.panels.len() as f64;
        drawing.into_document(&self.title, (SCATTER_WIDTH, height))
    }

    /// `top` is the upper edge of the plot.
    fn draw_panel(&self, drawing: &mut Drawing, panel: &ScatterPanel, top: f64, xs: &Range<f64>) {
        let bottom = top + SCATTER_PLOT_HEIGHT;
        let values = panel.points.iter().map(|point| point.y).chain(panel.y_limits.iter().map(|(y, _)| *y));
        let ys = decades(values.map(|y| if y.is_finite() { y.max(panel.floor) } else { y }));
        // Points without x lie between the last x and the end of the axis.
        let (edge, right) = (xs.end * 1.35, xs.end * 1.8);
        let axes = Axes {
            x: Axis::logarithmic(xs.start..right, SCATTER_LEFT..SCATTER_RIGHT),
            y: Axis::logarithmic(ys, bottom..top),
        };
        let has_floor = axes.y.values.start <= panel.floor * 1.01;
        let y_text = |value: f64| {
            let below = if has_floor && value <= panel.floor * 1.01 { "≤ " } else { "" };
            format!("{below}{}", format_power_of_ten(value))
        };
        drawing.frame(
            &axes,
            &Ticks::new(round_ticks(xs), true, |value| value.to_string()),
            &Ticks::new(axes.y.ticks(usize::MAX), true, y_text),
        );
        let mut marks = Vec::new();
        // Names of neighbouring limits have different heights, so that they do not overlap.
        let mut x_limits = panel.x_limits.clone();
        x_limits.sort_by(|a, b| a.0.total_cmp(&b.0));
        for (number, (x, name)) in x_limits.iter().enumerate() {
            marks.push(Mark::Limit { role: Role::Mark, at: AxisValue::X(*x), text: None });
            let height = top - 10.0 - 16.0 * (number % 3) as f64;
            drawing.text(Role::Text, TextEnd::Left, (axes.x.pixel(*x) - 3.0, height), name);
        }
        let y_limits = panel.y_limits.iter().filter(|(y, _)| axes.y.contains(*y));
        marks.extend(y_limits.map(|(y, name)| {
            let (at, text) = (AxisValue::Y(*y), Some(name.clone()));
            Mark::Limit { role: Role::Mark, at, text }
        }));
        let drawn = panel.points.iter().filter(|point| point.y.is_finite() && point.x.is_none_or(f64::is_finite));
        marks.extend(drawn.map(|point| {
            let (role, shape) = (Role::Series(point.colour), shape(point.shape));
            let at = (point.x.unwrap_or(edge), point.y.max(panel.floor));
            Mark::Point { role, at, shape, radius: SCATTER_RADIUS, text: None }
        }));
        drawing.marks(&axes, &marks);
        drawing.text(Role::Title, TextEnd::Left, (14.0, top - 62.0), &panel.y_label);
        let below = (SCATTER_RIGHT, bottom + SCATTER_BOTTOM - 14.0);
        drawing.text(Role::Text, TextEnd::Right, below, &self.x_label);
    }

    fn draw_legend(&self, drawing: &mut Drawing, top: f64) {
        for (number, name) in self.colours.iter().enumerate() {
            let x = SCATTER_RIGHT + 24.0 + 150.0 * (number % 2) as f64;
            let y = top - 62.0 + SCATTER_LINE_HEIGHT * (number / 2) as f64;
            drawing.shape(Role::Series(number), Shape::Disc, (x, y), SCATTER_RADIUS);
            drawing.text(Role::Text, TextEnd::Left, (x + 12.0, y), name);
        }
    }

    /// Names the shapes, and the points at the right edge by colour.
    fn draw_edge_labels(&self, drawing: &mut Drawing, panel: &ScatterPanel, top: f64) {
        let x = SCATTER_RIGHT + 24.0;
        let mut y = top - 62.0 + SCATTER_LINE_HEIGHT * (self.colours.len().div_ceil(2) + 1) as f64;
        for (number, name) in panel.shapes.iter().enumerate() {
            drawing.shape(Role::Shape, shape(number), (x, y), SCATTER_RADIUS);
            drawing.text(Role::Text, TextEnd::Left, (x + 12.0, y), name);
            y += SCATTER_LINE_HEIGHT;
        }
        if panel.points.iter().any(|point| point.x.is_none()) {
            y += SCATTER_LINE_HEIGHT / 2.0;
            let text = format!("at the right edge, {}:", self.edge_label);
            drawing.text(Role::Text, TextEnd::Left, (x - 6.0, y), &text);
        }
        for (colour, name) in self.colours.iter().enumerate() {
            let at_edge = panel.points.iter().filter(|point| point.colour == colour && point.x.is_none());
            let shapes: Vec<usize> = at_edge.map(|point| point.shape).collect();
            if shapes.is_empty() {
                continue;
            }
            y += SCATTER_LINE_HEIGHT - 2.0;
            drawing.text(Role::Text, TextEnd::Left, (x + 12.0, y), name);
            for (number, found) in shapes.into_iter().enumerate() {
                let at = (x + 130.0 + 18.0 * number as f64, y);
                drawing.shape(Role::Series(colour), shape(found), at, SCATTER_RADIUS);
            }
        }
    }
}

fn shape(number: usize) -> Shape {
    SHAPES[number % SHAPES.len()]
}

fn padded_range(values: impl Iterator<Item = f64>) -> Range<f64> {
    logarithmic_extent(values).map_or(0.5..20.0, |(low, high)| low / 1.4..high * 1.4)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn loglog() -> LogLogChart {
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
        insta::assert_snapshot!(loglog().svg().replace("><", ">\n<"));
    }

    #[test]
    fn a_long_legend_fits_and_repeated_colours_are_rings() {
        let nameless = loglog().series.remove(1);
        let series = (1..=17).map(|number| LogLogSeries { name: number.to_string(), ..nameless.clone() }).collect();
        let svg = LogLogChart { series, vertical_line: None, ..loglog() }.svg();
        let circles: Vec<&str> = svg.split("<circle").skip(1).filter_map(|rest| rest.split('>').next()).collect();
        let count = |class: &str| circles.iter().filter(|circle| circle.contains(class)).count();
        assert_eq!((count("class=\"f-series"), count("class=\"s-series")), (10, 7));
        let lowest =
            svg.split(" cy=\"").skip(1).map(|rest| rest.split('"').next().unwrap().parse::<i32>().unwrap()).max();
        assert!(f64::from(lowest.unwrap()) < 4.0 * (LOGLOG_SIZE.1 - LOGLOG_LINE_HEIGHT / 2.0), "{lowest:?}");
    }

    #[test]
    fn draws_a_chart_without_points() {
        let chart = LogLogChart { series: Vec::new(), vertical_line: None, ..loglog() };
        assert!(!chart.svg().contains("without a result"));
    }

    fn scatter_point(colour: usize, shape: usize, x: Option<f64>, y: f64) -> ScatterPoint {
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

    /// Centre of each disc with this colour. The last one is that of the legend.
    fn centres(svg: &str, colour: usize) -> Vec<(i64, i64)> {
        let discs = svg.split("<circle ").filter(|part| part.contains(&format!("f-series-{colour}\"")));
        let number =
            |part: &str, name: &str| part.split(name).nth(1).unwrap().split('"').next().unwrap().parse().unwrap();
        discs.map(|part| (number(part, "cx=\""), number(part, "cy=\""))).collect()
    }

    #[test]
    fn draws_points_limits_and_legend() {
        let svg = scatter(vec![scatter_point(0, 0, Some(3.0), 0.5), scatter_point(1, 1, None, 30.0)]).svg();
        insta::assert_snapshot!(svg.replace("><", ">\n<"));
    }

    #[test]
    fn draws_points_without_x_at_the_right_edge() {
        let svg = scatter(vec![scatter_point(0, 0, Some(9.9), 1e-2), scatter_point(1, 0, None, 1e-2)]).svg();
        let (settled, never) = (centres(&svg, 0)[0], centres(&svg, 1)[0]);
        assert!(never.0 > settled.0 && never.1 == settled.1, "{settled:?} {never:?}");
    }

    #[test]
    fn draws_points_below_the_floor_on_the_lower_edge() {
        let svg = scatter(vec![scatter_point(0, 0, Some(2.0), 1e-9), scatter_point(0, 0, Some(9.0), 1e-4)]).svg();
        let found = centres(&svg, 0);
        assert_eq!(found[0].1, found[1].1, "{found:?}");
    }

    #[test]
    fn ticks_are_round_and_within_the_range() {
        assert_eq!(round_ticks(&(0.48..21.0)), [0.5, 1.0, 2.0, 5.0, 10.0, 20.0]);
        assert_eq!(round_ticks(&(0.02..0.0499)), [0.02]);
        assert_eq!(padded_range([f64::NAN, 0.0, 2.8].into_iter()), 2.8 / 1.4..2.8 * 1.4);
        assert_eq!(padded_range(std::iter::empty()), 0.5..20.0);
    }

    #[test]
    fn draws_a_scatter_chart_without_points() {
        assert!(scatter(Vec::new()).svg().contains(">noise floor<"));
    }
}
