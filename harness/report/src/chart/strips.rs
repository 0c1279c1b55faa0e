//! Draws one quantity in rows: small multiples over a few settings, and one line of points per item.

use super::marks::{
    Axis, AxisValue, Mark, Point, Role, Scale, Shape, Ticks, decades, format_power_of_ten, logarithmic_extent,
    round_ticks,
};
use super::panels::{LegendEntry, Panel, PanelAxis, PanelChart, Symbol};

/// Width and height, CSS pixels.
const MULTIPLES_PANEL: Point = (216.0, 190.0);
const MULTIPLES_RADIUS: f64 = 2.6;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MultiplesPoint {
    pub series: usize,
    pub setting: usize,
    /// Value above 0. A point without a value lies on the upper edge.
    pub value: Option<f64>,
    pub is_hollow: bool,
}

/// One quantity over a few settings, one panel per row and column, one colour per series.
#[derive(Debug, Clone, PartialEq)]
pub struct MultiplesChart {
    pub title: String,
    pub value_label: String,
    pub setting_label: String,
    pub settings: Vec<String>,
    pub series: Vec<String>,
    pub rows: Vec<String>,
    pub columns: Vec<String>,
    /// Text for points on the upper edge.
    pub edge_label: String,
    pub hollow_label: String,
    /// Points by row and then by column.
    pub panels: Vec<Vec<Vec<MultiplesPoint>>>,
}

impl MultiplesChart {
    pub fn svg(&self) -> String {
        let values = self.panels.iter().flatten().flatten().filter_map(|point| point.value);
        let range = logarithmic_extent(values).map_or((0.5, 20.0), |(low, high)| (low / 1.3, high * 1.3));
        let panels = self.panels.iter().zip(&self.rows).flat_map(|(panels, row)| {
            let named = panels.iter().zip(&self.columns);
            named.map(move |(points, column)| self.panel([row, column], points, range))
        });
        let names = self
            .series
            .iter()
            .enumerate()
            .map(|(number, name)| LegendEntry::new(Symbol::Point(Role::Series(number), Shape::Disc), name));
        let rest = [
            LegendEntry::new(Symbol::Point(Role::Axis, Shape::Ring), &self.hollow_label),
            LegendEntry::new(Symbol::Line(Role::Mark), &self.edge_label),
        ];
        let chart = PanelChart {
            title: format!("{} ({})", self.title, self.value_label),
            has_heading: true,
            panel_size: MULTIPLES_PANEL,
            columns: self.columns.len(),
            panels: panels.collect(),
            legend: names.chain(rest).collect(),
        };
        chart.svg()
    }

    /// The names of row and column are two lines, because one would be wider than the panel.
    fn panel(&self, [row, column]: [&String; 2], points: &[MultiplesPoint], (low, high): (f64, f64)) -> Panel {
        let no_value = high * 1.25;
        // Points of different series are side by side, so that equal values stay visible.
        let step = 0.8 / self.series.len().max(1) as f64;
        let drawn = points.iter().map(|point| {
            let offset = (point.series as f64 - (self.series.len() as f64 - 1.0) / 2.0) * step;
            let value = point.value.filter(|value| value.is_finite() && *value > 0.0).unwrap_or(no_value);
            let shape = if point.is_hollow { Shape::Ring } else { Shape::Disc };
            let at = (point.setting as f64 + 0.5 + offset, value);
            Mark::point(Role::Series(point.series), at, shape, MULTIPLES_RADIUS)
        });
        let edge = Mark::Limit { role: Role::Mark, at: AxisValue::Y(no_value), text: None };
        let ticks = |_: &Axis| Ticks::new(round_ticks(&(low..high)), true, |value| value.to_string());
        Panel {
            title: row.clone(),
            x: PanelAxis::names(&self.setting_label, &self.settings, usize::MAX),
            y: PanelAxis::new(column, Scale::Logarithmic, low..high * 1.5, ticks),
            cells: Vec::new(),
            marks: [edge].into_iter().chain(drawn).collect(),
        }
    }
}

const STRIP_WIDTH: f64 = 980.0;
const STRIP_LINE_HEIGHT: f64 = 16.0;
/// Heights of title and labels of the panel.
const STRIP_MARGINS: f64 = 84.0;
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

/// One line of points per item on one logarithmic axis: values, the chosen value, the limit.
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
    pub fn svg(&self) -> String {
        let values = self.rows.iter().flat_map(|row| row.values.iter().map(|(_, value)| *value));
        let positive = values.chain(self.rows.iter().filter_map(|row| row.limit)).filter(|value| *value > 0.0);
        let xs = decades(positive.map(|value| value.max(self.floor)));
        let left = xs.start / ZERO_AREA_RATIO;
        // The position of 0 is in the middle of its decade.
        let zero = left * ZERO_AREA_RATIO.sqrt();
        let column = |value: f64| if value > 0.0 { value.max(self.floor) } else { zero };
        let x_ticks = |axis: &Axis| {
            let decades = axis.ticks(usize::MAX).into_iter().filter(|decade| *decade > left * 1.01);
            let mut ticks = Ticks::new(decades.collect(), true, format_power_of_ten);
            ticks.texts.insert(0, (zero, "0".to_owned()));
            ticks
        };
        let name = |row: &StripRow| match &*row.note {
            "" => row.name.clone(),
            note => format!("{} ({note})", row.name),
        };
        let names: Vec<String> = self.rows.iter().map(name).collect();
        let marks = self.rows.iter().enumerate().flat_map(|(number, row)| row.marks(number as f64, &column));
        let panel = Panel {
            title: String::new(),
            x: PanelAxis::new(&self.x_label, Scale::Logarithmic, left..xs.end, x_ticks),
            y: PanelAxis::names("", &names, usize::MAX).downwards(),
            cells: Vec::new(),
            marks: marks.collect(),
        };
        let colours = self
            .colours
            .iter()
            .enumerate()
            .map(|(number, name)| LegendEntry::new(Symbol::Point(Role::Series(number), Shape::Disc), name));
        let rest = [
            LegendEntry::new(Symbol::Point(Role::Series(0), Shape::Ring), &self.chosen_label),
            LegendEntry::new(Symbol::Line(Role::Axis), &self.limit_label),
        ];
        let chart = PanelChart {
            title: self.title.clone(),
            has_heading: true,
            panel_size: (STRIP_WIDTH, STRIP_MARGINS + STRIP_LINE_HEIGHT * self.rows.len() as f64),
            columns: 1,
            panels: vec![panel],
            legend: colours.chain(rest).collect(),
        };
        chart.svg()
    }
}

impl StripRow {
    fn marks(&self, top: f64, column: &impl Fn(f64) -> f64) -> Vec<Mark> {
        let limit = self.limit.map(column).map(|x| Mark::Line(Role::Axis, vec![(x, top + 0.1), (x, top + 0.9)]));
        let mut marks: Vec<Mark> = limit.into_iter().collect();
        // The circle of the first colour is the smallest and is drawn last, so that circles with the
        // same value are all visible.
        for (colour, value) in self.values.iter().filter(|(_, value)| value.is_finite()).rev() {
            let (at, role) = ((column(*value), top + 0.5), Role::Series(*colour));
            marks.push(Mark::point(role, at, Shape::Disc, 2.5 + *colour as f64));
            if *colour == self.chosen_colour {
                marks.push(Mark::point(role, at, Shape::Ring, 7.0));
            }
        }
        marks
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn multiples(points: Vec<MultiplesPoint>) -> MultiplesChart {
        MultiplesChart {
            title: "a < b".to_owned(),
            value_label: "settling time, ms".to_owned(),
            setting_label: "delay".to_owned(),
            settings: vec!["0".to_owned(), "0.4".to_owned()],
            series: vec!["first".to_owned(), "second".to_owned()],
            rows: vec!["scene".to_owned()],
            columns: vec!["unknown".to_owned()],
            edge_label: "never".to_owned(),
            hollow_label: "overshoot".to_owned(),
            panels: vec![vec![points]],
        }
    }

    fn point(series: usize, value: Option<f64>) -> MultiplesPoint {
        MultiplesPoint { series, setting: 1, value, is_hollow: false }
    }

    /// Heights of the points of a series. The last point is that of the legend.
    fn heights(svg: &str, series: usize) -> Vec<i64> {
        let circles = svg.split("<circle").filter(|part| part.contains(&format!("f-series-{series}\"")));
        circles.map(|part| part.split("cy=\"").nth(1).unwrap().split('"').next().unwrap().parse().unwrap()).collect()
    }

    #[test]
    fn a_larger_value_lies_higher_and_no_value_highest() {
        let svg = multiples(vec![point(0, Some(1.0)), point(0, Some(10.0)), point(1, None)]).svg();
        let (values, none) = (heights(&svg, 0), heights(&svg, 1));
        assert!(values[0] > values[1] && values[1] > none[0], "{values:?} {none:?}");
        assert!(svg.contains(">0.4<") && svg.contains(">overshoot<") && svg.contains(">5<"), "{svg}");
    }

    #[test]
    fn a_hollow_point_is_a_ring() {
        let hollow = MultiplesPoint { is_hollow: true, ..point(1, Some(2.0)) };
        let svg = multiples(vec![hollow]).svg();
        assert!(svg.contains("s-series-1"), "{svg}");
        assert_eq!(heights(&svg, 1).len(), 1, "only in the legend");
    }

    fn strip(rows: Vec<StripRow>) -> StripChart {
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
        let svg = strip(vec![row(1, "dearer"), row(0, "")]).svg();
        // One ring in the legend and one per row; the ring of the first row has the second colour.
        let rings = |class: &str| svg.matches(&format!("class=\"s-{class}\"")).count();
        assert_eq!((rings("series-0"), rings("series-1")), (2, 1), "{svg}");
        insta::assert_snapshot!(svg.replace("><", ">\n<"));
    }

    #[test]
    fn draws_charts_without_rows_and_without_numbers() {
        assert!(strip(Vec::new()).svg().contains(">limit<"));
        let odd = StripRow { values: vec![(0, f64::INFINITY), (1, f64::NAN)], limit: None, ..row(1, "") };
        assert!(strip(vec![odd]).svg().contains(">scene<"));
    }
}
