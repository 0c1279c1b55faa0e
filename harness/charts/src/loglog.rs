//! Draws lines of points on two logarithmic axes.

use platebench_document::chart::marks::{
    Axis, AxisValue, COLOURS, Mark, Point, Role, Scale, Shape, Ticks, decades, format_power_of_ten,
};
use platebench_document::chart::panels::{LegendEntry, Panel, PanelAxis, PanelChart, Symbol};
use std::ops::Range;

/// Width and height, CSS pixels.
const LOGLOG_PANEL: Point = (620.0, 400.0);
const MAX_LABELS: usize = 9;

#[derive(Debug, Clone, PartialEq)]
pub(crate) struct LogLogSeries {
    pub(crate) name: String,
    /// Positive x and y, in the order of the line.
    pub(crate) points: Vec<(f64, f64)>,
    /// Labels of the first points.
    pub(crate) labels: Vec<String>,
    /// Cost of each setting without a result; drawn as a cross at the chart's `failed_edge`.
    pub(crate) failed: Vec<f64>,
    pub(crate) is_highlighted: bool,
}

/// The end of the axis of the error, which has one more decade for settings without a result.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum FailedEdge {
    Right,
    Top,
}

/// Lines of points on two logarithmic axes.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct LogLogChart {
    pub(crate) title: String,
    pub(crate) x_label: String,
    pub(crate) y_label: String,
    /// The first series is drawn in front.
    pub(crate) series: Vec<LogLogSeries>,
    /// Value and name of a dashed line.
    pub(crate) line: Option<(AxisValue, String)>,
    pub(crate) failed_edge: FailedEdge,
    pub(crate) failed_label: String,
}

impl LogLogChart {
    pub(crate) fn svg(&self) -> String {
        let points = || self.series.iter().flat_map(|series| &series.points);
        let failed = || self.series.iter().flat_map(|series| &series.failed).copied();
        let has_failed = failed().next().is_some();
        let failed_at = |edge| failed().filter(move |_| self.failed_edge == edge);
        let (line_x, line_y) = match self.line {
            Some((AxisValue::X(x), _)) => (Some(x), None),
            Some((AxisValue::Y(y), _)) => (None, Some(y)),
            None => (None, None),
        };
        let xs = decades(points().map(|point| point.0).chain(line_x).chain(failed_at(FailedEdge::Top)));
        let ys = decades(points().map(|point| point.1).chain(line_y).chain(failed_at(FailedEdge::Right)));
        let end = |values: &Range<f64>, edge| {
            if has_failed && self.failed_edge == edge { values.end * 10.0 } else { values.end }
        };
        let (right, top) = (end(&xs, FailedEdge::Right), end(&ys, FailedEdge::Top));
        let cross = |cost: f64| match self.failed_edge {
            FailedEdge::Right => (xs.end * 10.0_f64.sqrt(), cost),
            FailedEdge::Top => (cost, ys.end * 10.0_f64.sqrt()),
        };
        let limit = |(at, _): &(AxisValue, String)| Mark::Limit { role: Role::Mark, at: *at, text: None };
        let mut marks: Vec<Mark> = self.line.iter().map(limit).collect();
        for (number, series) in self.series.iter().enumerate().rev() {
            let (role, radius) = (Role::Series(number), if series.is_highlighted { 7.0 } else { 4.0 });
            marks.push(Mark::Line(role, series.points.clone()));
            marks.extend(series.points.iter().enumerate().map(|(index, at)| Mark::Point {
                role,
                at: *at,
                shape: disc_or_ring(number),
                radius,
                text: series.labels.get(index).cloned(),
            }));
            marks.extend(series.failed.iter().map(|cost| Mark::point(role, cross(*cost), Shape::Cross, 5.0)));
        }
        let names = self.series.iter().enumerate().map(|(number, series)| {
            LegendEntry::new(Symbol::Point(Role::Series(number), disc_or_ring(number)), &series.name)
        });
        let failed = has_failed.then(|| LegendEntry::new(Symbol::Point(Role::Axis, Shape::Cross), &self.failed_label));
        let line = self.line.iter().map(|(_, name)| LegendEntry::new(Symbol::Line(Role::Mark), name));
        let axis = |label: &str, values: Range<f64>, end: f64| {
            let text = |value: f64| if value > values.end * 1.01 { String::new() } else { format_power_of_ten(value) };
            let ticks = |axis: &Axis| Ticks::new(axis.ticks(MAX_LABELS), true, text);
            PanelAxis::new(label, Scale::Logarithmic, values.start..end, ticks)
        };
        let (x, y) = (axis(&self.x_label, xs.clone(), right), axis(&self.y_label, ys.clone(), top));
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
                    labels: vec![],
                    failed: vec![],
                    is_highlighted: true,
                },
                LogLogSeries {
                    name: "two".to_owned(),
                    points: vec![],
                    labels: vec![],
                    failed: vec![5.0],
                    is_highlighted: false,
                },
            ],
            line: Some((AxisValue::X(1e-6), "limit".to_owned())),
            failed_edge: FailedEdge::Right,
            failed_label: "without a result".to_owned(),
        }
    }

    #[test]
    fn draws_lines_crosses_and_legend() {
        insta::assert_snapshot!(loglog().svg().replace("><", ">\n<"));
    }

    #[test]
    fn crosses_are_at_the_end_of_the_error_axis() {
        let chart = |failed_edge| {
            let mut chart = LogLogChart { failed_edge, line: None, ..loglog() };
            chart.series[0].labels = vec!["label".to_owned()];
            chart.svg()
        };
        let (right, top) = (chart(FailedEdge::Right), chart(FailedEdge::Top));
        assert!(right.contains(">label<") && top.contains(">label<"), "{top}");
        let numbers = |text: &str| {
            let numbers = text.split(|letter: char| !letter.is_ascii_digit()).filter(|number| !number.is_empty());
            numbers.take(2).map(|number| number.parse().unwrap()).collect::<Vec<i32>>()
        };
        let cross = |svg: &str| numbers(svg.split("class=\"s-series-1\" d=\"").nth(1).unwrap());
        let text = |svg: &str, text: &str| {
            let before = svg.split(&format!(">{text}</text>")).next().unwrap();
            numbers(before.rsplit("<text").next().unwrap())
        };
        // 5 lies between 1 and 10 of the axis of the cost.
        assert!(cross(&right)[0] > text(&right, "10⁻³")[0], "{right}");
        assert!((text(&right, "10¹")[1]..text(&right, "10⁰")[1]).contains(&cross(&right)[1]), "{right}");
        assert!(cross(&top)[1] < text(&top, "10²")[1], "{top}");
        assert!((text(&top, "10⁰")[0]..text(&top, "10¹")[0]).contains(&cross(&top)[0]), "{top}");
    }

    #[test]
    fn a_long_legend_fits_and_repeated_colours_are_rings() {
        let nameless = loglog().series.remove(1);
        let series = (1..=17).map(|number| LogLogSeries { name: number.to_string(), ..nameless.clone() }).collect();
        let svg = LogLogChart { series, line: None, ..loglog() }.svg();
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
        let chart = LogLogChart { series: Vec::new(), line: None, ..loglog() };
        assert!(!chart.svg().contains("without a result"));
    }
}
