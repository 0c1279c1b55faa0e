//! Draws maps of coloured cells: a value over listed quantities.

use super::marks::{Mark, Point, Role, extent};
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
}
