//! Draws points on two logarithmic axes: lines of points, and panels of points by colour and shape.

use super::marks::{
    Axis, AxisValue, COLOURS, Mark, Point, Role, Scale, Shape, Ticks, decades, format_power_of_ten, logarithmic_extent,
    round_ticks,
};
use super::panels::{LegendEntry, Panel, PanelAxis, PanelChart, Symbol};
use std::ops::Range;

/// Width and height, CSS pixels.
const LOGLOG_PANEL: Point = (620.0, 400.0);
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
        let line = self.vertical_line.iter();
        let points = self.series.iter().flat_map(|series| &series.points);
        let xs = decades(points.clone().map(|point| point.0).chain(line.clone().map(|(x, _)| *x)));
        let failed = || self.series.iter().flat_map(|series| &series.failed);
        let ys = decades(points.map(|point| point.1).chain(failed().copied()));
        // The x axis has one more decade at the right for settings without a result.
        let has_failed = failed().next().is_some();
        let edge = xs.end * 10.0_f64.sqrt();
        let right = if has_failed { xs.end * 10.0 } else { xs.end };
        let x_text = |value: f64| if value > xs.end * 1.01 { String::new() } else { format_power_of_ten(value) };
        let limit = |(x, _): &(f64, String)| Mark::Limit { role: Role::Mark, at: AxisValue::X(*x), text: None };
        let mut marks: Vec<Mark> = line.clone().map(limit).collect();
        for (number, series) in self.series.iter().enumerate().rev() {
            let (role, radius) = (Role::Series(number), if series.is_highlighted { 7.0 } else { 4.0 });
            marks.push(Mark::Line(role, series.points.clone()));
            marks.extend(series.points.iter().map(|at| Mark::point(role, *at, disc_or_ring(number), radius)));
            marks.extend(series.failed.iter().map(|y| Mark::point(role, (edge, *y), Shape::Cross, 5.0)));
        }
        let names = self.series.iter().enumerate().map(|(number, series)| {
            LegendEntry::new(Symbol::Point(Role::Series(number), disc_or_ring(number)), &series.name)
        });
        let failed = has_failed.then(|| LegendEntry::new(Symbol::Point(Role::Axis, Shape::Cross), &self.failed_label));
        let line = line.map(|(_, name)| LegendEntry::new(Symbol::Line(Role::Mark), name));
        let x = PanelAxis::new(&self.x_label, Scale::Logarithmic, xs.start..right, |axis| {
            Ticks::new(axis.ticks(MAX_LABELS), true, x_text)
        });
        let y_ticks = |axis: &Axis| Ticks::new(axis.ticks(MAX_LABELS), true, format_power_of_ten);
        let y = PanelAxis::new(&self.y_label, Scale::Logarithmic, ys, y_ticks);
        let chart = PanelChart {
            title: self.title.clone(),
            has_heading: true,
            panel_size: LOGLOG_PANEL,
            columns: 1,
            panels: vec![Panel { title: String::new(), x, y, cells: Vec::new(), marks }],
            legend: names.chain(failed).chain(line).collect(),
        };
        chart.svg()
    }
}

/// Series that repeat a colour have rings.
const fn disc_or_ring(series: usize) -> Shape {
    if series >= COLOURS { Shape::Ring } else { Shape::Disc }
}

/// Width and height, CSS pixels.
const SCATTER_PANEL: Point = (760.0, 340.0);
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
        let points = || self.panels.iter().flat_map(|panel| &panel.points);
        let limits = self.panels.iter().flat_map(|panel| panel.x_limits.iter().map(|(x, _)| *x));
        let xs = padded_range(points().filter_map(|point| point.x).chain(limits));
        let colour = |number: usize| Symbol::Point(Role::Series(number), Shape::Disc);
        let colours = self.colours.iter().enumerate().map(|(number, name)| LegendEntry::new(colour(number), name));
        let shapes = self.panels.iter().flat_map(|panel| panel.shapes.iter().enumerate());
        let shapes = shapes.map(|(number, name)| LegendEntry::new(Symbol::Point(Role::Shape, shape(number)), name));
        let at_edge = self.colours.iter().enumerate().filter_map(|(number, name)| {
            let scenes: Vec<&str> = self.panels.iter().flat_map(|panel| panel.shapes_at_edge(number)).collect();
            let text = || format!("{name} {} in {}", self.edge_label, scenes.join(", "));
            (!scenes.is_empty()).then(|| LegendEntry::new(colour(number), text()))
        });
        let chart = PanelChart {
            title: self.title.clone(),
            has_heading: true,
            panel_size: SCATTER_PANEL,
            columns: 1,
            panels: self.panels.iter().map(|panel| panel.draw(&xs, &self.x_label)).collect(),
            legend: colours.chain(shapes).chain(at_edge).collect(),
        };
        chart.svg()
    }
}

impl ScatterPanel {
    fn shapes_at_edge(&self, colour: usize) -> impl Iterator<Item = &str> {
        let at_edge = self.points.iter().filter(move |point| point.colour == colour && point.x.is_none());
        at_edge.filter_map(|point| self.shapes.get(point.shape).map(String::as_str))
    }

    fn draw(&self, xs: &Range<f64>, x_label: &str) -> Panel {
        let values = self.points.iter().map(|point| point.y).chain(self.y_limits.iter().map(|(y, _)| *y));
        let ys = decades(values.map(|y| if y.is_finite() { y.max(self.floor) } else { y }));
        // Points without x lie between the last x and the end of the axis.
        let (edge, right) = (xs.end * 1.35, xs.end * 1.8);
        let has_floor = ys.start <= self.floor * 1.01;
        let y_text = |value: f64| {
            let below = if has_floor && value <= self.floor * 1.01 { "≤ " } else { "" };
            format!("{below}{}", format_power_of_ten(value))
        };
        let limit = |at, name: &String| Mark::Limit { role: Role::Mark, at, text: Some(name.clone()) };
        let x_limits = self.x_limits.iter().map(|(x, name)| limit(AxisValue::X(*x), name));
        let y_limits = self.y_limits.iter().filter(|(y, _)| (ys.start..=ys.end).contains(y));
        let y_limits = y_limits.map(|(y, name)| limit(AxisValue::Y(*y), name));
        let drawn = self.points.iter().filter(|point| point.y.is_finite() && point.x.is_none_or(f64::is_finite));
        let drawn = drawn.map(|point| {
            let at = (point.x.unwrap_or(edge), point.y.max(self.floor));
            Mark::point(Role::Series(point.colour), at, shape(point.shape), SCATTER_RADIUS)
        });
        let marks = x_limits.chain(y_limits).chain(drawn).collect();
        let x_ticks = |_: &Axis| Ticks::new(round_ticks(xs), true, |value| value.to_string());
        let y_ticks = |axis: &Axis| Ticks::new(axis.ticks(usize::MAX), true, y_text);
        Panel {
            title: String::new(),
            x: PanelAxis::new(x_label, Scale::Logarithmic, xs.start..right, x_ticks),
            y: PanelAxis::new(&self.y_label, Scale::Logarithmic, ys.clone(), y_ticks),
            cells: Vec::new(),
            marks,
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
        let numbers = |name: &str| {
            let values = svg.split(name).skip(1).filter_map(|rest| rest.split('"').next());
            values.map(|value| value.parse::<f64>().unwrap()).collect::<Vec<_>>()
        };
        let height = svg.split("viewBox=\"").nth(1).and_then(|rest| rest.split(['"', ' ']).nth(3)).unwrap();
        let lowest = numbers(" cy=\"").into_iter().fold(0.0, f64::max);
        assert!(lowest < height.parse::<f64>().unwrap(), "{lowest} {height}");
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
