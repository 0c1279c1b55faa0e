//! Draws lines of points on two logarithmic axes.

use platebench_document::chart::marks::{
    Axis, AxisValue, COLOURS, Mark, Point, Role, Scale, Shape, Ticks, decades, format_power_of_ten,
};
use platebench_document::chart::panels::{LegendEntry, Panel, PanelAxis, PanelChart, Symbol};

/// Width and height, CSS pixels.
const LOGLOG_PANEL: Point = (620.0, 400.0);
const MAX_LABELS: usize = 9;

#[derive(Debug, Clone, PartialEq)]
pub(crate) struct LogLogSeries {
    pub(crate) name: String,
    /// Positive x and y, in the order of the line.
    pub(crate) points: Vec<(f64, f64)>,
    /// y of each setting without a result; drawn as a cross at the right edge.
    pub(crate) failed: Vec<f64>,
    pub(crate) is_highlighted: bool,
}

/// Lines of points on two logarithmic axes.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct LogLogChart {
    pub(crate) title: String,
    pub(crate) x_label: String,
    pub(crate) y_label: String,
    /// The first series is drawn in front.
    pub(crate) series: Vec<LogLogSeries>,
    /// x and name of a dashed line.
    pub(crate) vertical_line: Option<(f64, String)>,
    pub(crate) failed_label: String,
}

impl LogLogChart {
    pub(crate) fn svg(&self) -> String {
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
}
