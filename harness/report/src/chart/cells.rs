//! Draws maps of coloured cells: a value over listed quantities, and the settling time over control period and loop
//! delay.

use super::marks::{Axis, AxisValue, Mark, Point, Role, Scale, Shape, Ticks, extent};
use super::panels::{LegendEntry, Panel, PanelAxis, PanelChart, Symbol};
use crate::format;

const CLASSES: usize = 10;
/// Number of orange colours, which are the last. The other colours are blue.
const BAD_CLASSES: usize = 4;

/// Width and height, CSS pixels. A page is two panels wide, a telephone one.
const HEAT_PANEL: Point = (360.0, 280.0);
const MAX_NAMES: usize = 6;
const MAX_NAME_CHARS: usize = 9;

#[derive(Debug, Clone, PartialEq)]
pub struct HeatAxis {
    pub label: String,
    pub values: Vec<String>,
}

#[derive(Debug, Clone, PartialEq)]
pub struct HeatPanel {
    pub title: String,
    pub x: HeatAxis,
    pub y: HeatAxis,
    /// Values by row (y) and then by column (x).
    pub values: Vec<Vec<Option<f64>>>,
    /// Whether a cell passes, by row and then by column; `None` if it is not known.
    pub passes: Vec<Vec<Option<bool>>>,
}

/// How colours are assigned to values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum HeatScale {
    /// Classes of equal width from the smallest to the largest value.
    Range,
    /// Orange classes from the smallest value to 0, blue ones from 0 to the largest value.
    Diverging,
}

#[derive(Debug, Clone, PartialEq)]
pub struct HeatFigure {
    pub title: String,
    pub panels: Vec<HeatPanel>,
    pub scale: HeatScale,
}

impl HeatFigure {
    /// Ascending edges of the classes. A class contains its lower edge. An infinite value has the
    /// first or the last class.
    fn edges(&self) -> Vec<f64> {
        let values = self.panels.iter().flat_map(|panel| panel.values.iter().flatten().copied().flatten());
        let range = extent(values.filter(|value| value.is_finite()));
        let share = |number: usize, count: usize| number as f64 / count as f64;
        match self.scale {
            HeatScale::Range => {
                let (low, high) = match range {
                    Some((low, high)) if low < high => (low, high),
                    Some((low, _)) => (low - 0.5, low + 0.5),
                    None => (0.0, 1.0),
                };
                (0..=CLASSES).map(|edge| low + (high - low) * share(edge, CLASSES)).collect()
            }
            HeatScale::Diverging => {
                const GOOD_CLASSES: usize = CLASSES - BAD_CLASSES;
                let (low, high) = range.map_or((0.0, 0.0), |(low, high)| (low.min(0.0), high.max(0.0)));
                // A side without values is as wide as the other one.
                let (low, high) = match (low < 0.0, high > 0.0) {
                    (true, true) => (low, high),
                    (true, false) => (low, -low),
                    (false, true) => (-high, high),
                    (false, false) => (-0.5, 0.5),
                };
                let below = (0..BAD_CLASSES).map(|edge| low * share(BAD_CLASSES - edge, BAD_CLASSES));
                below.chain((0..=GOOD_CLASSES).map(|edge| high * share(edge, GOOD_CLASSES))).collect()
            }
        }
    }

    fn role(&self, class: usize) -> Role {
        Role::Radius(if self.scale == HeatScale::Diverging { CLASSES - 1 - class } else { class })
    }

    /// The chart without its cells.
    fn layout(&self, edges: &[f64]) -> PanelChart {
        let class = |(class, [from, to]): (usize, &[f64; 2])| {
            let text = format!("{} to {}", format::number(*from), format::number(*to));
            LegendEntry::new(Symbol::Area(self.role(class)), text)
        };
        let has_edge = self.panels.iter().any(|panel| !panel.edge_lines().is_empty());
        let edge = has_edge.then(|| LegendEntry::new(Symbol::Line(Role::Boundary), "edge of the passing cells"));
        PanelChart {
            title: self.title.clone(),
            has_heading: false,
            panel_size: HEAT_PANEL,
            columns: self.panels.len().clamp(1, 2),
            panels: self.panels.iter().map(HeatPanel::layout).collect(),
            legend: edges.array_windows().enumerate().map(class).chain(edge).collect(),
        }
    }

    /// Left, top, width, height of a cell, as shares of the drawing. `None` if it does not exist.
    pub fn cell_area(&self, panel: usize, column: usize, row: usize) -> Option<[f64; 4]> {
        self.layout(&self.edges()).area(panel, unit_cell(column, row))
    }

    pub fn svg(&self) -> String {
        let edges = self.edges();
        let mut chart = self.layout(&edges);
        for (panel, drawn) in self.panels.iter().zip(&mut chart.panels) {
            let cells = panel.values.iter().enumerate().flat_map(|(row, values)| {
                let cell = |(column, value): (usize, &Option<f64>)| {
                    Some(Mark::Cell(self.role(class_of((*value)?, &edges)), unit_cell(column, row)))
                };
                values.iter().enumerate().filter_map(cell).collect::<Vec<_>>()
            });
            drawn.cells = cells.collect();
        }
        chart.svg()
    }
}

fn unit_cell(column: usize, row: usize) -> [Point; 2] {
    let (x, y) = (column as f64, row as f64);
    [(x, y), (x + 1.0, y + 1.0)]
}

impl HeatPanel {
    fn layout(&self) -> Panel {
        let axis = |axis: &HeatAxis| {
            let names: Vec<String> =
                axis.values.iter().map(|name| name.chars().take(MAX_NAME_CHARS).collect()).collect();
            PanelAxis::names(&axis.label, &names, MAX_NAMES)
        };
        let edge = |line: [Point; 2]| Mark::Line(Role::Boundary, line.to_vec());
        let marks = self.edge_lines().into_iter().map(edge).collect();
        Panel { title: self.title.clone(), x: axis(&self.x), y: axis(&self.y), cells: Vec::new(), marks }
    }

    fn passes_at(&self, column: usize, row: usize) -> Option<bool> {
        *self.passes.get(row)?.get(column)?
    }

    /// Lines between passing and other known cells. The unit is the width or height of a cell.
    fn edge_lines(&self) -> Vec<[Point; 2]> {
        let mut lines = Vec::new();
        for (row, cells) in self.passes.iter().enumerate() {
            for (column, passes) in cells.iter().enumerate() {
                let (x, y) = (column as f64, row as f64);
                let differs = |other: Option<bool>| matches!((passes, other), (Some(a), Some(b)) if *a != b);
                if differs(self.passes_at(column + 1, row)) {
                    lines.push([(x + 1.0, y), (x + 1.0, y + 1.0)]);
                }
                if differs(self.passes_at(column, row + 1)) {
                    lines.push([(x, y + 1.0), (x + 1.0, y + 1.0)]);
                }
            }
        }
        lines
    }
}

fn class_of(value: f64, edges: &[f64]) -> usize {
    edges.partition_point(|edge| *edge <= value).saturating_sub(1).min(CLASSES - 1)
}

/// Width and height, CSS pixels.
const MAP_PANEL: Point = (330.0, 262.0);
/// Upper edges of the classes of settling time, ms. A further class has longer times and responses
/// that never settle.
const CLASS_EDGES: [f64; 9] = [1.5, 2.0, 3.0, 4.0, 6.0, 10.0, 15.0, 25.0, 40.0];

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RigDelay {
    pub typical_ms: f64,
    pub longest_ms: f64,
}

/// Results of one law, operating condition and response time. Periods and delays are ascending and
/// evenly spaced, at least two of each.
#[derive(Debug, Clone, PartialEq)]
pub struct MapPanel {
    pub title: String,
    pub periods_ms: Vec<f64>,
    pub delays_ms: Vec<f64>,
    /// Spectral radius of the loop by period and then by delay. The loop is unstable from 1 on.
    pub radius: Vec<Vec<f64>>,
    /// Settling time by period and then by delay; `None` if the response does not settle.
    pub settling_ms: Vec<Vec<Option<f64>>>,
    /// Period and delay of the measured boundary of stability, ms.
    pub measured: Vec<(f64, f64)>,
}

#[derive(Debug, Clone, PartialEq)]
pub struct MapFigure {
    pub title: String,
    pub panels: Vec<MapPanel>,
    pub columns: usize,
    pub rig: Option<RigDelay>,
}

impl MapFigure {
    pub fn svg(&self) -> String {
        let classes =
            (0..=CLASS_EDGES.len()).map(|class| LegendEntry::new(Symbol::Area(Role::Radius(class)), class_text(class)));
        let entry = |symbol, text| LegendEntry::new(symbol, text);
        let lines = [
            entry(Symbol::Line(Role::Boundary), "predicted boundary of stability"),
            entry(Symbol::Point(Role::Measured, Shape::Disc), "measured boundary"),
        ];
        let delay =
            self.rig.map(|_| entry(Symbol::Line(Role::Delay), "measured loop delay of the rig: median and maximum"));
        let chart = PanelChart {
            title: self.title.clone(),
            has_heading: false,
            panel_size: MAP_PANEL,
            columns: self.columns,
            panels: self.panels.iter().map(|panel| panel.draw(self.rig.as_ref())).collect(),
            legend: [entry(Symbol::None, "settling time, ms:")]
                .into_iter()
                .chain(classes)
                .chain(lines)
                .chain(delay)
                .collect(),
        };
        chart.svg()
    }
}

impl MapPanel {
    /// The plot is empty without two periods and two delays.
    fn draw(&self, rig: Option<&RigDelay>) -> Panel {
        let ranges = even_range(&self.periods_ms).zip(even_range(&self.delays_ms));
        let axis = |label: &str, range: Option<std::ops::Range<f64>>| {
            let ticks = |axis: &Axis| Ticks::new(axis.ticks(6), false, |value| format!("{value:.1}"));
            PanelAxis::new(label, Scale::Linear, range.unwrap_or(0.0..1.0), ticks)
        };
        let (periods, delays) = ranges.clone().map(|((periods, _), (delays, _))| (periods, delays)).unzip();
        let mut panel = Panel {
            title: self.title.clone(),
            x: axis("period, ms", periods),
            y: axis("delay, ms", delays),
            cells: Vec::new(),
            marks: Vec::new(),
        };
        let Some(((periods, half_period), (delays, half_delay))) = ranges else { return panel };
        for (period, settling) in self.periods_ms.iter().zip(&self.settling_ms) {
            for (class, from, to) in class_runs(settling) {
                let (Some(first), Some(last)) = (self.delays_ms.get(from), self.delays_ms.get(to)) else { continue };
                let corners = [(period - half_period, first - half_delay), (period + half_period, last + half_delay)];
                panel.cells.push(Mark::Cell(Role::Radius(class), corners));
            }
        }
        panel.marks.extend(self.stability_boundary().into_iter().map(|line| Mark::Line(Role::Boundary, line)));
        let lines = rig.into_iter().flat_map(|rig| [rig.typical_ms, rig.longest_ms]);
        let line = |at| Mark::Limit { role: Role::Delay, at: AxisValue::Y(at), text: None };
        let is_inside = |range: &std::ops::Range<f64>, value| (range.start..=range.end).contains(&value);
        panel.marks.extend(lines.filter(|delay| is_inside(&delays, *delay)).map(line));
        let inside = self.measured.iter().filter(|(x, y)| is_inside(&periods, *x) && is_inside(&delays, *y));
        panel.marks.extend(inside.map(|at| Mark::point(Role::Measured, *at, Shape::Disc, 4.0)));
        panel
    }

    /// Interpolates for each period the smallest delay with a spectral radius of 1.
    fn stability_boundary(&self) -> Vec<Vec<(f64, f64)>> {
        let mut lines: Vec<Vec<(f64, f64)>> = vec![Vec::new()];
        for (period, radius) in self.periods_ms.iter().zip(&self.radius) {
            let passes = |[a, b]: &[f64; 2]| *a < 1.0 && *b >= 1.0;
            let passed = radius.array_windows().position(passes).and_then(|row| {
                let (a, b) = (radius.get(row)?, radius.get(row + 1)?);
                let (from, to) = (self.delays_ms.get(row)?, self.delays_ms.get(row + 1)?);
                Some(from + (to - from) * (1.0 - a) / (b - a))
            });
            match (passed, lines.last_mut()) {
                (Some(delay), Some(line)) => line.push((*period, delay)),
                (None, Some(line)) if !line.is_empty() => lines.push(Vec::new()),
                _ => {}
            }
        }
        lines.retain(|line| line.len() > 1);
        lines
    }
}

/// Range of evenly spaced values and half of their distance.
fn even_range(values: &[f64]) -> Option<(std::ops::Range<f64>, f64)> {
    let (first, last) = (*values.first()?, *values.last()?);
    let usable = values.len() > 1 && first.is_finite() && last.is_finite() && last > first;
    usable.then(|| (first..last, (last - first) / (values.len() - 1) as f64 / 2.0))
}

fn settling_class(settling_ms: Option<f64>) -> usize {
    let edge = settling_ms.and_then(|ms| CLASS_EDGES.iter().position(|edge| ms < *edge));
    edge.unwrap_or(CLASS_EDGES.len())
}

/// Joins neighbouring rows of the same class to (class, first row, last row).
fn class_runs(settling_ms: &[Option<f64>]) -> Vec<(usize, usize, usize)> {
    let mut runs: Vec<(usize, usize, usize)> = Vec::new();
    for (row, settling) in settling_ms.iter().enumerate() {
        let class = settling_class(*settling);
        match runs.last_mut() {
            Some(run) if run.0 == class => run.2 = row,
            _ => runs.push((class, row, row)),
        }
    }
    runs
}

fn class_text(class: usize) -> String {
    let edge = |class: usize| CLASS_EDGES.get(class).copied();
    match (class.checked_sub(1).and_then(edge), edge(class)) {
        (Some(low), Some(high)) => format!("{low} to {high}"),
        (Some(low), None) => format!("longer than {low}, or never"),
        (None, high) => format!("below {}", high.unwrap_or(f64::INFINITY)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rstest::rstest;

    fn figure(values: Vec<Vec<Option<f64>>>) -> HeatFigure {
        let axis = |count: usize| HeatAxis {
            label: "finger_force_n, N".to_owned(),
            values: (0..count).map(|value| value.to_string()).collect(),
        };
        let (x, y) = (axis(values[0].len()), axis(values.len()));
        let panel = HeatPanel { title: "dq-pi".to_owned(), x, y, values, passes: Vec::new() };
        HeatFigure { title: "margin".to_owned(), panels: vec![panel], scale: HeatScale::Diverging }
    }

    #[test]
    fn draws_a_rectangle_per_value_and_no_missing_one() {
        let svg = figure(vec![vec![Some(0.0), None], vec![Some(1.0), Some(f64::NEG_INFINITY)]]).svg();
        // Each class of a cell occurs once more in the legend.
        assert_eq!(
            [9, 5, 0, 4].map(|colour| svg.matches(&format!("class=\"f-radius-{colour}\"")).count()),
            [2, 2, 2, 1]
        );
        assert!(svg.contains("finger_force_n, N") && svg.contains("dq-pi"));
    }

    /// A map of two panels with 2×2 cells side by side; the legend has two lines.
    #[test]
    fn a_cell_is_where_it_is_drawn() {
        let mut figure = figure(vec![vec![Some(0.0), None], vec![Some(1.0), Some(2.0)]]);
        figure.panels.push(figure.panels[0].clone());
        let (width, height) = (720.0, 324.0);
        // Upper right cell of the right panel: columns 192 to 344 of 360, rows 40 to 138 of 280.
        let expected = [(360.0 + 192.0) / width, 40.0 / height, 152.0 / width, 98.0 / height];
        let area = figure.cell_area(1, 1, 1).unwrap();
        assert!(area.iter().zip(expected).all(|(value, expected)| (value - expected).abs() < 1e-9), "{area:?}");
        assert_eq!(figure.cell_area(2, 0, 0), None);
        let svg = figure.svg();
        assert!(svg.contains("x=\"2208\" y=\"160\" width=\"608\" height=\"392\""), "{svg}");
    }

    // Four classes of 5 below 0 and six of 1/6 above. The class of 0 is the first that passes.
    #[rstest]
    #[case(f64::NEG_INFINITY, 0)]
    #[case(-20.0, 0)]
    #[case(-5.1, 2)]
    #[case(-4.9, 3)]
    #[case(-1e-12, 3)]
    #[case(0.0, 4)]
    #[case(0.16, 4)]
    #[case(0.17, 5)]
    #[case(1.0, 9)]
    fn a_diverging_scale_changes_its_colour_at_zero(#[case] value: f64, #[case] class: usize) {
        let figure = figure(vec![vec![Some(-20.0), Some(1.0), Some(f64::NEG_INFINITY)]]);
        assert_eq!(class_of(value, &figure.edges()), class);
        // The rules have the light colours first and then the dark ones.
        let rule = format!(".f-{} {{ fill: #", figure.role(class).name());
        let svg = figure.svg();
        let colours: Vec<_> = svg.match_indices(&rule).map(|(at, _)| &svg[at + rule.len()..][..6]).collect();
        assert_eq!(colours.len(), 2, "{svg}");
        let is_blue = |colour: &&str| colour[..2] < colour[4..];
        assert!(colours.iter().all(|colour| is_blue(colour) == (value >= 0.0)), "{value}: {colours:?}");
    }

    #[test]
    fn an_edge_separates_passing_from_other_known_cells() {
        let mut figure = figure(vec![vec![Some(1.0), Some(1.0), None], vec![Some(1.0), Some(-1.0), Some(1.0)]]);
        assert!(!figure.svg().contains("s-boundary"));
        let [yes, no, unknown] = [Some(true), Some(false), None];
        figure.panels[0].passes = vec![vec![yes, yes, unknown], vec![yes, no, yes]];
        let lines = figure.panels[0].edge_lines();
        let expected = [[(1.0, 1.0), (2.0, 1.0)], [(1.0, 1.0), (1.0, 2.0)], [(2.0, 1.0), (2.0, 2.0)]];
        assert_eq!(lines, expected);
        // Three lines and the one of the legend.
        assert_eq!(figure.svg().matches("class=\"s-boundary\"").count(), 4);
        assert!(figure.svg().contains("edge of the passing cells"));
    }

    #[test]
    fn equal_values_have_a_scale() {
        for (value, scale) in [0.0, -3.0, 5.0].into_iter().zip([HeatScale::Range, HeatScale::Diverging].repeat(3)) {
            let edges = HeatFigure { scale, ..figure(vec![vec![Some(value)]]) }.edges();
            assert!(edges.is_sorted_by(|a, b| a < b) && edges.len() == CLASSES + 1, "{value}: {edges:?}");
            assert!((edges[0]..=edges[CLASSES]).contains(&value), "{value}: {edges:?}");
        }
        assert!(figure(vec![vec![None]]).svg().contains("finger_force_n"));
    }

    fn map() -> MapFigure {
        let panel = MapPanel {
            title: "resonant, 2 ms & more".to_owned(),
            periods_ms: vec![0.5, 1.0, 1.5],
            delays_ms: vec![0.0, 1.0, 2.0, 3.0],
            radius: vec![vec![0.2, 0.9, 1.1, 1.6], vec![0.2, 0.2, 0.8, 1.2], vec![0.4, 0.4, 0.4, 0.4]],
            settling_ms: vec![
                vec![Some(1.0), Some(12.0), None, None],
                vec![Some(1.0), Some(1.0), Some(5.0), None],
                vec![Some(2.5); 4],
            ],
            measured: vec![(0.5, 1.5), (1.0, 2.5), (1.0, 99.0)],
        };
        MapFigure {
            title: "a < b".to_owned(),
            panels: vec![panel.clone(), panel],
            columns: 2,
            rig: Some(RigDelay { typical_ms: 0.5, longest_ms: 0.9 }),
        }
    }

    #[test]
    fn draws_classes_boundaries_delays_and_legend() {
        insta::assert_snapshot!(map().svg().replace("><", ">\n<"));
    }

    #[test]
    fn interpolates_the_boundary_between_rows() {
        let panel = &map().panels[0];
        let [line] = &panel.stability_boundary()[..] else { panic!("{:?}", panel.stability_boundary()) };
        let [first, second] = line[..] else { panic!("{line:?}") };
        assert!((first.0 - 0.5).abs() < 1e-12 && (first.1 - 1.5).abs() < 1e-12, "{first:?}");
        assert!((second.0 - 1.0).abs() < 1e-12 && (second.1 - 2.5).abs() < 1e-12, "{second:?}");
    }

    #[rstest]
    #[case(Some(0.0), 0)]
    #[case(Some(1.4999), 0)]
    #[case(Some(1.5), 1)]
    #[case(Some(9.999), 5)]
    #[case(Some(10.0), 6)]
    #[case(Some(40.0), 9)]
    #[case(None, 9)]
    fn a_class_ends_below_its_edge(#[case] settling_ms: Option<f64>, #[case] expected: usize) {
        assert_eq!(settling_class(settling_ms), expected);
    }

    #[test]
    fn joins_rows_of_one_class() {
        assert_eq!(class_runs(&[Some(0.1), Some(0.2), Some(9.0), None]), [(0, 0, 1), (5, 2, 2), (9, 3, 3)]);
        assert!(class_runs(&[]).is_empty());
    }

    #[test]
    fn skips_a_panel_without_numbers() {
        let mut empty = map();
        empty.panels[0] = MapPanel { periods_ms: vec![1.0], ..empty.panels[0].clone() };
        empty.panels[1] = MapPanel { settling_ms: Vec::new(), measured: Vec::new(), ..empty.panels[1].clone() };
        assert_eq!(empty.svg().matches("<circle").count(), 1);
    }
}
