//! Draws maps of the settling time over control period and loop delay.

use crate::law_loops::OperatingCondition;
use platebench_document::chart::marks::{Axis, AxisValue, Mark, Point, Role, Scale, Shape, Ticks};
use platebench_document::chart::panels::{LegendEntry, Panel, PanelAxis, PanelChart, Symbol};
use platebench_wire::LawId;
use std::ops::Range;

/// Width and height, CSS pixels.
const PANEL_SIZE: Point = (330.0, 262.0);
/// Upper edges of the classes of settling time, ms. A further class has longer times and responses
/// that never settle.
const CLASS_EDGES: [f64; 9] = [1.5, 2.0, 3.0, 4.0, 6.0, 10.0, 15.0, 25.0, 40.0];

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RigDelay {
    pub typical_ms: f64,
    pub longest_ms: f64,
}

/// Periods and delays are ascending and evenly spaced.
#[derive(Debug, Clone, PartialEq)]
pub struct StabilityMap {
    pub law: LawId,
    pub condition: OperatingCondition,
    pub response: f64,
    pub periods: Vec<f64>,
    pub delays: Vec<f64>,
    /// Indexed by period, then by delay. The loop is unstable from 1 on.
    pub spectral_radius: Vec<Vec<f64>>,
    /// 5 % settling time, s, of a start with the f32 controller, indexed like `spectral_radius`.
    /// `None` if it does not settle.
    pub settling: Vec<Vec<Option<f64>>>,
    /// Control periods and their measured delay boundaries, s.
    pub measured: Vec<(f64, f64)>,
}

/// One row per condition, one panel per response time. `None` for a law without a loop.
pub(crate) fn draw_maps(all: &[StabilityMap], law: LawId, rig: Option<RigDelay>) -> Option<PanelChart> {
    let maps: Vec<&StabilityMap> = all.iter().filter(|map| map.law == law).collect();
    let first = maps.first()?.condition;
    let entry = |symbol, text| LegendEntry::new(symbol, text);
    let classes =
        (0..=CLASS_EDGES.len()).map(|class| LegendEntry::new(Symbol::Area(Role::Radius(class)), class_text(class)));
    let lines = [
        entry(Symbol::Line(Role::Boundary), "predicted boundary of stability"),
        entry(Symbol::Point(Role::Measured, Shape::Disc), "measured boundary"),
    ];
    let delay = rig.map(|_| entry(Symbol::Line(Role::Delay), "measured loop delay of the rig: median and maximum"));
    Some(PanelChart {
        title: format!("{}: settling time from rest over control period and loop delay, ms", law.name()),
        has_heading: false,
        panel_size: PANEL_SIZE,
        columns: maps.iter().filter(|map| map.condition == first).count(),
        panels: maps.iter().filter_map(|map| map.panel(rig)).collect(),
        legend: [entry(Symbol::None, "settling time, ms:")]
            .into_iter()
            .chain(classes)
            .chain(lines)
            .chain(delay)
            .collect(),
    })
}

fn ms(seconds: f64) -> f64 {
    seconds * 1e3
}

impl StabilityMap {
    /// `None` without two periods and two delays.
    fn panel(&self, rig: Option<RigDelay>) -> Option<Panel> {
        let (periods, half_period) = even_range(&self.periods)?;
        let (delays, half_delay) = even_range(&self.delays)?;
        let axis = |label: &str, range: &Range<f64>| {
            let ticks = |axis: &Axis| Ticks::new(axis.ticks(6), false, |value| format!("{value:.1}"));
            PanelAxis::new(label, Scale::Linear, range.clone(), ticks)
        };
        let cells = self.periods.iter().copied().map(ms).zip(&self.settling).flat_map(|(period, settling)| {
            let cell = move |(class, from, to): (usize, usize, usize)| {
                let [first, last] = [*self.delays.get(from)?, *self.delays.get(to)?].map(ms);
                let corners = [(period - half_period, first - half_delay), (period + half_period, last + half_delay)];
                Some(Mark::Cell(Role::Radius(class), corners))
            };
            class_runs(settling).into_iter().filter_map(cell)
        });
        let is_inside = |range: &Range<f64>, value| (range.start..=range.end).contains(&value);
        let boundary = self.stability_boundary().into_iter().map(|line| Mark::Line(Role::Boundary, line));
        let lines = rig.into_iter().flat_map(|rig| [rig.typical_ms, rig.longest_ms]);
        let lines = lines.filter(|delay| is_inside(&delays, *delay));
        let lines = lines.map(|at| Mark::Limit { role: Role::Delay, at: AxisValue::Y(at), text: None });
        let measured = self.measured.iter().map(|(period, delay)| (ms(*period), ms(*delay)));
        let measured = measured.filter(|(x, y)| is_inside(&periods, *x) && is_inside(&delays, *y));
        let measured = measured.map(|at| Mark::point(Role::Measured, at, Shape::Disc, 4.0));
        Some(Panel {
            title: format!("{}, response {:.3} ms", self.condition.name(), ms(self.response)),
            x: axis("period, ms", &periods),
            y: axis("delay, ms", &delays),
            cells: cells.collect(),
            marks: boundary.chain(lines).chain(measured).collect(),
        })
    }

    /// Interpolates for each period the smallest delay with a spectral radius of 1. In ms.
    fn stability_boundary(&self) -> Vec<Vec<(f64, f64)>> {
        let mut lines: Vec<Vec<(f64, f64)>> = vec![Vec::new()];
        for (period, radius) in self.periods.iter().zip(&self.spectral_radius) {
            let passes = |[a, b]: &[f64; 2]| *a < 1.0 && *b >= 1.0;
            let passed = radius.array_windows().position(passes).and_then(|row| {
                let (a, b) = (radius.get(row)?, radius.get(row + 1)?);
                let [from, to] = [*self.delays.get(row)?, *self.delays.get(row + 1)?].map(ms);
                Some(from + (to - from) * (1.0 - a) / (b - a))
            });
            match (passed, lines.last_mut()) {
                (Some(delay), Some(line)) => line.push((ms(*period), delay)),
                (None, Some(line)) if !line.is_empty() => lines.push(Vec::new()),
                _ => {}
            }
        }
        lines.retain(|line| line.len() > 1);
        lines
    }
}

/// Range of evenly spaced values and half of their distance, ms.
fn even_range(seconds: &[f64]) -> Option<(Range<f64>, f64)> {
    let (first, last) = (ms(*seconds.first()?), ms(*seconds.last()?));
    (last > first).then(|| (first..last, (last - first) / (seconds.len() - 1) as f64 / 2.0))
}

fn settling_class(settling: Option<f64>) -> usize {
    let edge = settling.and_then(|settling| CLASS_EDGES.iter().position(|edge| ms(settling) < *edge));
    edge.unwrap_or(CLASS_EDGES.len())
}

/// Joins neighbouring rows of the same class to (class, first row, last row).
fn class_runs(settling: &[Option<f64>]) -> Vec<(usize, usize, usize)> {
    let mut runs: Vec<(usize, usize, usize)> = Vec::new();
    for (row, time) in settling.iter().enumerate() {
        let class = settling_class(*time);
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

    fn map() -> StabilityMap {
        StabilityMap {
            law: LawId::DqPi,
            condition: OperatingCondition::Resonant,
            response: 2e-3,
            periods: vec![0.5e-3, 1e-3, 1.5e-3],
            delays: vec![0.0, 1e-3, 2e-3, 3e-3],
            spectral_radius: vec![vec![0.2, 0.9, 1.1, 1.6], vec![0.2, 0.2, 0.8, 1.2], vec![0.4, 0.4, 0.4, 0.4]],
            settling: vec![
                vec![Some(1e-3), Some(12e-3), None, None],
                vec![Some(1e-3), Some(1e-3), Some(5e-3), None],
                vec![Some(2.5e-3); 4],
            ],
            measured: vec![(0.5e-3, 1.5e-3), (1e-3, 2.5e-3), (1e-3, 99e-3)],
        }
    }

    fn svg(maps: &[StabilityMap]) -> String {
        let rig = RigDelay { typical_ms: 0.5, longest_ms: 0.9 };
        draw_maps(maps, LawId::DqPi, Some(rig)).unwrap().svg()
    }

    #[test]
    fn draws_classes_boundaries_delays_and_legend() {
        insta::assert_snapshot!(svg(&[map(), map()]).replace("><", ">\n<"));
    }

    #[test]
    fn interpolates_the_boundary_between_rows() {
        let map = map();
        let [line] = &map.stability_boundary()[..] else { panic!("{:?}", map.stability_boundary()) };
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
        assert_eq!(settling_class(settling_ms.map(|ms| ms / 1e3)), expected);
    }

    #[test]
    fn joins_rows_of_one_class() {
        assert_eq!(class_runs(&[Some(1e-4), Some(2e-4), Some(9e-3), None]), [(0, 0, 1), (5, 2, 2), (9, 3, 3)]);
        assert!(class_runs(&[]).is_empty());
    }

    #[test]
    fn skips_a_panel_without_numbers() {
        let short = StabilityMap { periods: vec![1e-3], ..map() };
        let empty = StabilityMap { settling: Vec::new(), measured: Vec::new(), ..map() };
        assert_eq!(svg(&[short, empty]).matches("<circle").count(), 1, "only in the legend");
        assert_eq!(draw_maps(&[], LawId::DqPi, None).map(|chart| chart.title), None);
    }
}
