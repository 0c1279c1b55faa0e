//! Draws maps of coloured cells: a value over listed quantities, and the settling time over control period and loop
//! delay.

use super::marks::{Axes, Axis, AxisValue, Drawing, Mark, Point, Role, Shape, TextEnd, Ticks, extent};

const CLASSES: usize = 10;
/// Number of orange colours, which are the last. The other colours are blue.
const BAD_CLASSES: usize = 4;
const LEGEND_LINE_HEIGHT: f64 = 22.0;

/// Width and height, CSS pixels. A page is two panels wide, a telephone one.
const HEAT_PANEL: Point = (360.0, 280.0);
/// Edges of the cells in their panel.
const LEFT: f64 = 64.0;
const TOP: f64 = 36.0;
const RIGHT: f64 = HEAT_PANEL.0 - 14.0;
const BOTTOM: f64 = HEAT_PANEL.1 - 44.0;
const MAX_TICKS: usize = 6;

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

    fn has_edge(&self) -> bool {
        self.panels.iter().any(|panel| !panel.edge_lines().is_empty())
    }

    fn panel_grid(&self) -> (usize, usize) {
        let columns = self.panels.len().clamp(1, 2);
        (columns, self.panels.len().div_ceil(columns).max(1))
    }

    fn classes_per_line(&self) -> usize {
        if self.panel_grid().0 == 1 { 2 } else { 5 }
    }

    /// Width of the drawing, height of the panels, height of the drawing; CSS pixels.
    fn size(&self) -> (f64, f64, f64) {
        let (columns, rows) = self.panel_grid();
        let height = HEAT_PANEL.1 * rows as f64;
        let legend_lines = CLASSES.div_ceil(self.classes_per_line()) + usize::from(self.has_edge());
        (HEAT_PANEL.0 * columns as f64, height, height + legend_lines as f64 * LEGEND_LINE_HEIGHT)
    }

    fn axes(&self, number: usize, panel: &HeatPanel) -> Axes {
        let (x, y) = panel_corner(number, self.panel_grid().0, HEAT_PANEL);
        let count = |axis: &HeatAxis| 0.0..axis.values.len().max(1) as f64;
        Axes {
            x: Axis::linear(count(&panel.x), x + LEFT..x + RIGHT),
            y: Axis::linear(count(&panel.y), y + BOTTOM..y + TOP),
        }
    }

    /// Left, top, width, height of a cell, as shares of the drawing. `None` if it does not exist.
    pub fn cell_area(&self, panel: usize, column: usize, row: usize) -> Option<[f64; 4]> {
        let Axes { x, y } = self.axes(panel, self.panels.get(panel)?);
        let [left, right] = [column, column + 1].map(|edge| x.pixel(edge as f64));
        let [bottom, top] = [row, row + 1].map(|edge| y.pixel(edge as f64));
        let (width, _, height) = self.size();
        Some([left / width, top / height, (right - left) / width, (bottom - top) / height])
    }

    pub fn svg(&self) -> String {
        let (width, panel_height, height) = self.size();
        let edges = self.edges();
        let mut drawing = Drawing::default();
        for (number, panel) in self.panels.iter().enumerate() {
            self.draw_panel(&mut drawing, number, panel, &edges);
        }
        self.draw_legend(&mut drawing, &edges, (width, panel_height));
        drawing.into_document(&self.title, (width, height))
    }

    fn role(&self, class: usize) -> Role {
        Role::Radius(if self.scale == HeatScale::Diverging { CLASSES - 1 - class } else { class })
    }

    fn draw_panel(&self, drawing: &mut Drawing, number: usize, panel: &HeatPanel, edges: &[f64]) {
        let axes = self.axes(number, panel);
        let cells = panel.values.iter().enumerate().flat_map(|(row, values)| {
            let cell = move |(column, value): (usize, &Option<f64>)| {
                let corner = (column as f64, row as f64);
                let class = class_of((*value)?, edges);
                Some(Mark::Cell(self.role(class), [corner, (corner.0 + 1.0, corner.1 + 1.0)]))
            };
            values.iter().enumerate().filter_map(cell)
        });
        drawing.marks(&axes, &cells.collect::<Vec<_>>());
        let lines = panel.edge_lines().into_iter().map(|line| Mark::Line(Role::Boundary, line.to_vec()));
        drawing.marks(&axes, &lines.collect::<Vec<_>>());
        let ((left, right), (bottom, top)) =
            ((axes.x.pixels.start, axes.x.pixels.end), (axes.y.pixels.start, axes.y.pixels.end));
        drawing.line(Role::Axis, [(left, top), (left, bottom), (right, bottom)]);
        for tick in heat_ticks(panel.x.values.len().max(1)) {
            let at = (axes.x.pixel(tick as f64 + 0.5), bottom + 12.0);
            drawing.text(Role::Text, TextEnd::Centre, at, short(panel.x.values.get(tick)));
        }
        for tick in heat_ticks(panel.y.values.len().max(1)) {
            let at = (left - 6.0, axes.y.pixel(tick as f64 + 0.5));
            drawing.text(Role::Text, TextEnd::Right, at, short(panel.y.values.get(tick)));
        }
        drawing.text(Role::Title, TextEnd::Left, (left, top - 26.0), &panel.title);
        drawing.text(Role::Text, TextEnd::Left, (left - LEFT + 4.0, top - 12.0), &panel.y.label);
        drawing.text(Role::Text, TextEnd::Right, (right, bottom + 32.0), &panel.x.label);
    }

    fn draw_legend(&self, drawing: &mut Drawing, edges: &[f64], (width, top): Point) {
        let per_line = self.classes_per_line();
        let place = |entry: usize| {
            let x = 8.0 + (entry % per_line) as f64 * width / per_line as f64;
            (x, top + LEGEND_LINE_HEIGHT * (0.5 + (entry / per_line) as f64))
        };
        for (class, [from, to]) in edges.array_windows().enumerate() {
            let (x, y) = place(class);
            drawing.rectangle(self.role(class), [(x, y - 5.0), (x + 16.0, y + 5.0)]);
            let text = format!("{} to {}", number(*from), number(*to));
            drawing.text(Role::Text, TextEnd::Left, (x + 21.0, y), &text);
        }
        if self.has_edge() {
            let (x, y) = place(CLASSES);
            drawing.line(Role::Boundary, [(x, y), (x + 16.0, y)]);
            drawing.text(Role::Text, TextEnd::Left, (x + 21.0, y), "edge of the passing cells");
        }
    }
}

impl HeatPanel {
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

/// Upper left corner of a panel.
fn panel_corner(number: usize, columns: usize, size: Point) -> Point {
    (size.0 * (number % columns) as f64, size.1 * (number / columns) as f64)
}

fn heat_ticks(count: usize) -> impl Iterator<Item = usize> {
    (0..count).step_by(count.div_ceil(MAX_TICKS).max(1))
}

fn short(text: Option<&String>) -> &str {
    let text = text.map_or("", |text| &**text);
    text.char_indices().nth(9).map_or(text, |(end, _)| text.get(..end).unwrap_or(text))
}

fn number(value: f64) -> String {
    let magnitude = value.abs();
    match magnitude {
        0.0 => "0".to_owned(),
        _ if !(1e-3..1e5).contains(&magnitude) => format!("{value:.1e}"),
        _ if magnitude < 10.0 => format!("{value:.3}"),
        _ => format!("{value:.1}"),
    }
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
        let columns = self.columns.max(1);
        let rows = self.panels.len().div_ceil(columns).max(1);
        let (width, height) = (MAP_PANEL.0 * columns as f64, MAP_PANEL.1 * rows as f64);
        let legend = legend_places(self.rig.is_some(), width, height);
        let legend_bottom = legend.last().map_or(height, |(_, (_, y))| y + LEGEND_LINE_HEIGHT);
        let mut drawing = Drawing::default();
        for (number, panel) in self.panels.iter().enumerate() {
            panel.draw(&mut drawing, panel_corner(number, columns, MAP_PANEL), self.rig.as_ref());
        }
        for (entry, at) in &legend {
            entry.draw(&mut drawing, *at);
        }
        drawing.into_document(&self.title, (width, legend_bottom))
    }
}

impl MapPanel {
    /// Draws nothing without two periods and two delays.
    fn draw(&self, drawing: &mut Drawing, (left, top): Point, rig: Option<&RigDelay>) {
        let (Some((periods, half_period)), Some((delays, half_delay))) =
            (even_range(&self.periods_ms), even_range(&self.delays_ms))
        else {
            return;
        };
        let x = Axis::linear(periods, left + 40.0..left + MAP_PANEL.0 - 16.0);
        let axes = Axes { x, y: Axis::linear(delays, top + MAP_PANEL.1 - 40.0..top + 34.0) };
        let mut marks = Vec::new();
        for (period, settling) in self.periods_ms.iter().zip(&self.settling_ms) {
            for (class, from, to) in class_runs(settling) {
                let (Some(first), Some(last)) = (self.delays_ms.get(from), self.delays_ms.get(to)) else { continue };
                let corners = [(period - half_period, first - half_delay), (period + half_period, last + half_delay)];
                marks.push(Mark::Cell(Role::Radius(class), corners));
            }
        }
        drawing.marks(&axes, &marks);
        let ticks = |axis: &Axis| Ticks::new(axis.ticks(6), false, |value| format!("{value:.1}"));
        drawing.frame(&axes, &ticks(&axes.x), &ticks(&axes.y));
        let mut marks: Vec<Mark> =
            self.stability_boundary().into_iter().map(|line| Mark::Line(Role::Boundary, line)).collect();
        let delays = rig.into_iter().flat_map(|rig| [rig.typical_ms, rig.longest_ms]);
        let delay = |at| Mark::Limit { role: Role::Delay, at: AxisValue::Y(at), text: None };
        marks.extend(delays.filter(|delay| axes.y.contains(*delay)).map(delay));
        let inside = self.measured.iter().filter(|(x, y)| axes.x.contains(*x) && axes.y.contains(*y));
        let point = |at: &Point| {
            let (role, shape) = (Role::Measured, Shape::Disc);
            Mark::Point { role, at: *at, shape, radius: 4.0, text: None }
        };
        marks.extend(inside.map(point));
        drawing.marks(&axes, &marks);
        drawing.text(Role::Title, TextEnd::Left, (left + 76.0, top + 22.0), &self.title);
        drawing.text(Role::Text, TextEnd::Left, (left + 2.0, top + 22.0), "delay, ms");
        let corner = (left + MAP_PANEL.0 - 16.0, top + MAP_PANEL.1 - 10.0);
        drawing.text(Role::Text, TextEnd::Right, corner, "period, ms");
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

enum LegendEntry {
    Heading,
    Class(usize),
    Boundary,
    Measured,
    Delay,
}

impl LegendEntry {
    fn text(&self) -> String {
        let edge = |class: usize| CLASS_EDGES.get(class).copied();
        match *self {
            Self::Heading => "settling time, ms:".to_owned(),
            Self::Class(class) => match (class.checked_sub(1).and_then(edge), edge(class)) {
                (Some(low), Some(high)) => format!("{low} to {high}"),
                (Some(low), None) => format!("longer than {low}, or never"),
                (None, high) => format!("below {}", high.unwrap_or(f64::INFINITY)),
            },
            Self::Boundary => "predicted boundary of stability".to_owned(),
            Self::Measured => "measured boundary".to_owned(),
            Self::Delay => "measured loop delay of the rig: median and maximum".to_owned(),
        }
    }

    fn draw(&self, drawing: &mut Drawing, (x, y): Point) {
        let line = [(x, y), (x + 16.0, y)];
        let indent = if matches!(self, Self::Heading) { 0.0 } else { 22.0 };
        match *self {
            Self::Heading => {}
            Self::Class(class) => drawing.rectangle(Role::Radius(class), [(x, y - 4.0), (x + 16.0, y + 4.0)]),
            Self::Boundary => drawing.line(Role::Boundary, line),
            Self::Measured => drawing.shape(Role::Measured, Shape::Disc, (x + 8.0, y), 4.0),
            Self::Delay => drawing.line(Role::Delay, line),
        }
        drawing.text(Role::Text, TextEnd::Left, (x + indent, y), &self.text());
    }
}

/// Entries below `top` with their positions, in lines of at most `width`.
fn legend_places(has_rig: bool, width: f64, top: f64) -> Vec<(LegendEntry, Point)> {
    let classes = (0..=CLASS_EDGES.len()).map(LegendEntry::Class);
    let lines = [LegendEntry::Boundary, LegendEntry::Measured].into_iter().chain(has_rig.then_some(LegendEntry::Delay));
    let (mut x, mut y) = (4.0, top + LEGEND_LINE_HEIGHT / 2.0);
    let place = |entry: LegendEntry| {
        // Characters are about 6.5 px wide.
        let entry_width = 40.0 + 6.5 * entry.text().chars().count() as f64;
        if x > 4.0 && x + entry_width > width {
            (x, y) = (4.0, y + LEGEND_LINE_HEIGHT);
        }
        let at = (x, y);
        x += entry_width;
        (entry, at)
    };
    std::iter::once(LegendEntry::Heading).chain(classes).chain(lines).map(place).collect()
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
        // Upper right cell of the right panel: columns 205 to 346 of 360, rows 36 to 136 of 280.
        let expected = [(360.0 + 205.0) / width, 36.0 / height, 141.0 / width, 100.0 / height];
        assert_eq!(figure.cell_area(1, 1, 1), Some(expected));
        assert_eq!(figure.cell_area(2, 0, 0), None);
        let svg = figure.svg();
        assert!(svg.contains("x=\"2260\" y=\"144\" width=\"564\" height=\"400\""), "{svg}");
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
