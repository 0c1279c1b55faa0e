//! Draws the place where a response is farthest outside its tolerance tube.

use super::svg::Role;
use super::time_chart::{CurvePoint, Mark, TimeChart, TimeWindow, padded_range};
use crate::error::ReportError;
use crate::format;
use platebench_model::trace::Row;
use platebench_verdict::tube::{Exceedance, Tube, TubeSignal, signal_response};

const MARGIN_MS: f64 = 5.0;
const EDGE_POINTS: u32 = 400;

pub fn draw_exceedance(tube: &Tube, rows: &[Row], trial: u32, worst: &Exceedance) -> Result<String, ReportError> {
    let signal = TubeSignal::from_name(&tube.signal);
    let (first, last) = tube.span_ms();
    let from_ms = (worst.t_ms - MARGIN_MS).max(first);
    let window = TimeWindow { from_ms, to_ms: (worst.t_ms + MARGIN_MS).min(last).max(from_ms + 1e-6) };
    let instants =
        (0..=EDGE_POINTS).map(|index| window.from_ms + window.span_ms() * f64::from(index) / f64::from(EDGE_POINTS));
    let edges: Vec<(f64, [f64; 2])> = instants.map(|t_ms| (t_ms, tube.edges(t_ms))).collect();
    let edge = |end: usize| {
        edges.iter().filter_map(|(t_ms, ends)| Some((*t_ms, *ends.get(end)?))).collect::<Vec<CurvePoint>>()
    };
    let golden: Vec<CurvePoint> = edges.iter().map(|(t_ms, _)| (*t_ms, tube.point_at(*t_ms).value)).collect();
    let points: Vec<CurvePoint> = signal.map(|signal| signal_response(signal, rows)).unwrap_or_default();
    let points: Vec<CurvePoint> = points.into_iter().filter(|point| window.contains(point.0)).collect();
    let values = edges.iter().flat_map(|(_, ends)| *ends).chain(points.iter().map(|point| point.1));
    let text = Some(format!("{} at {} ms", tube.signal, format::number(worst.t_ms)));
    let mut chart = TimeChart::new(window, padded_range(values), signal.map_or("", |signal| signal.unit));
    chart.areas = vec![(Role::Tube, [edge(1), edge(0)])];
    chart.lines = vec![(Role::Golden, golden), (Role::First, points)];
    chart.marks = vec![Mark { role: Role::Deadline, at_ms: worst.t_ms, text }];
    chart.document(&format::exceedance(trial, worst))
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_verdict::golden::GoldenTubes;

    fn rows(height: f64) -> Vec<Row> {
        let row = |index: u32| Row {
            t_s: f64::from(index) * 1e-4,
            amplitude_um: if index >= 100 { height } else { 0.0 },
            ..Row::default()
        };
        (0..=300).map(row).collect()
    }

    #[test]
    fn draws_tube_golden_curve_trial_and_place() {
        let golden = GoldenTubes::from_rows(&rows(2.0)).unwrap();
        let bad = rows(2.5);
        let (trial, worst) = golden.compare([(7, bad.as_slice())]).worst.unwrap();
        let svg = draw_exceedance(&golden.tubes[0], &bad, trial, &worst).unwrap();
        let title = "trial 7: amplitude_um is 2.5 µm at 10 ms, 0.48 µm outside ± 0.02 µm around 2 µm";
        assert_eq!(svg.matches(&format!("<title>{title}</title>")).count(), 1, "{svg}");
        for class in ["f-tube", "s-golden", "s-first", "s-deadline"] {
            assert_eq!(svg.matches(&format!("class=\"{class}\"")).count(), 1, "{class}");
        }
        assert!(svg.contains(">amplitude_um at 10 ms<") && svg.len() < 60_000, "{} bytes", svg.len());
    }
}
