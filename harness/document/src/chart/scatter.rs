//! Draws panels of points by colour and shape on two logarithmic axes.

use super::marks::{
    Axis, AxisValue, Mark, Point, Role, Scale, Shape, Ticks, decades, format_power_of_ten, logarithmic_extent,
    round_ticks,
};
use super::panels::{LegendEntry, Panel, PanelAxis, PanelChart, Symbol};
use std::ops::Range;

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
        let colours = LegendEntry::series(self.colours.iter().map(String::as_str));
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
