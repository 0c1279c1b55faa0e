//! A response beside what was accepted of it: in words, and where it is the farthest off as a drawing.
//!
//! Neighbours: `platebench-verdict` compares, `html::plot` draws.

use crate::error::ReportError;
use crate::html::curves::{Point, Window};
use crate::html::plot::{Chart, Ink, Mark, SIZE};
use crate::shown;
use platebench_trace::Row;
use platebench_verdict::golden::Comparison;
use platebench_verdict::tube::{Exceedance, Signal, Tube, response};

/// On either side of the worst place, ms.
const AROUND_MS: f64 = 5.0;
/// Instants at which the edges of a tube are drawn.
const EDGES: u32 = 400;

/// A comparison in lines: the verdict, the worst place with signal, time, distance and trial, and why it is not a pass.
pub fn lines(name: &str, comparison: &Comparison) -> Vec<String> {
    let verdict = comparison.verdict;
    let trials = shown::count(comparison.trials, "trial");
    let mut lines = vec![format!("{} {verdict}  {name}  ({trials})", shown::sign(verdict))];
    lines.extend(comparison.worst.as_ref().map(|(trial, worst)| format!("  {}", sentence(*trial, worst))));
    lines.extend(comparison.reason.as_ref().map(|reason| format!("  {reason}")));
    lines
}

/// Where a trial leaves its tube.
pub fn sentence(trial: u32, worst: &Exceedance) -> String {
    let number = shown::number;
    let unit = Signal::named(&worst.signal).map_or("", |signal| signal.unit);
    format!(
        "trial {trial}: {} is {} {unit} at {} ms, {} {unit} outside ± {} {unit} around {} {unit}",
        worst.signal,
        number(worst.value),
        number(worst.t_ms),
        number(worst.distance),
        number(worst.allowed),
        number(worst.golden)
    )
}

/// The tube, the golden curve and the trial around the worst place, as an SVG file of its own.
///
/// # Errors
/// [`ReportError::Plot`].
pub fn drawing(tube: &Tube, rows: &[Row], trial: u32, worst: &Exceedance) -> Result<String, ReportError> {
    let signal = Signal::named(&tube.signal);
    let (first, last) = tube.span_ms();
    let from_ms = (worst.t_ms - AROUND_MS).max(first);
    let window = Window { from_ms, to_ms: (worst.t_ms + AROUND_MS).min(last).max(from_ms + 1e-6) };
    let instants = (0..=EDGES).map(|index| window.from_ms + window.span_ms() * f64::from(index) / f64::from(EDGES));
    let edges: Vec<(f64, [f64; 2])> = instants.map(|t_ms| (t_ms, tube.edges(t_ms))).collect();
    let edge =
        |end: usize| edges.iter().filter_map(|(t_ms, ends)| Some((*t_ms, *ends.get(end)?))).collect::<Vec<Point>>();
    let golden: Vec<Point> = edges.iter().map(|(t_ms, _)| (*t_ms, tube.at(*t_ms).value)).collect();
    let trial_points: Vec<Point> = signal.map(|signal| response(signal, rows)).unwrap_or_default();
    let inside = |point: &Point| (window.from_ms..=window.to_ms).contains(&point.0);
    let trial_points: Vec<Point> = trial_points.into_iter().filter(inside).collect();
    let values = edges.iter().flat_map(|(_, ends)| *ends).chain(trial_points.iter().map(|point| point.1));
    let (low, high) = values.fold((f64::MAX, f64::MIN), |(low, high), value| (low.min(value), high.max(value)));
    let air = ((high - low) * 0.06).max(f64::EPSILON);
    let chart = Chart {
        window,
        range: (low - air, high + air),
        unit: signal.map_or("", |signal| signal.unit),
        spans: Vec::new(),
        areas: vec![(Ink::Band, [edge(1), edge(0)])],
        lines: vec![(Ink::Other, golden), (Ink::First, trial_points)],
        marks: vec![Mark {
            ink: Ink::Settling,
            at_ms: worst.t_ms,
            text: Some(format!("{} at {} ms", tube.signal, shown::number(worst.t_ms))),
        }],
    };
    let body = chart.draw(&tube.signal)?;
    let (width, height) = SIZE;
    let label = sentence(trial, worst);
    Ok(format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" role=\"img\">\n<title>{label}</title>\n\
         <style>{STYLE}</style>\n<rect width=\"{width}\" height=\"{height}\" fill=\"#fff\"/>\n{body}\n</svg>\n"
    ))
}

/// The roles' colours, for paper: a file of its own has no style sheet beside it.
const STYLE: &str = "text{font:52px sans-serif}[class^=s-]{fill:none;stroke-width:6}.f-text{fill:#5b646e}\
.s-grid{stroke:#e2e3df;stroke-width:3}.s-axis{stroke:#5b646e;stroke-width:3}.f-band{fill:#2b7a4b;fill-opacity:.2}\
.s-other{stroke:#2b7a4b}.s-first{stroke:#1f5fbf}.s-settling{stroke:#b3261e;stroke-dasharray:20 12}.f-settling{fill:#b3261e}";

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_verdict::Verdict;
    use platebench_verdict::golden::Golden;

    fn rows(height: f64) -> Vec<Row> {
        let row = |index: u32| Row {
            t_s: f64::from(index) * 1e-4,
            amplitude_um: if index >= 100 { height } else { 0.0 },
            ..Row::default()
        };
        (0..=300).map(row).collect()
    }

    fn compared() -> (Golden, Comparison) {
        let golden = Golden::of_rows(&rows(2.0)).unwrap();
        let (good, bad) = (rows(2.0), rows(2.5));
        let comparison = golden.compare([(0, good.as_slice()), (7, bad.as_slice())]);
        (golden, comparison)
    }

    #[test]
    fn signal_time_distance_and_trial_are_named() {
        let (_, comparison) = compared();
        assert_eq!(comparison.verdict, Verdict::Fail);
        let lines = lines("paper/step.toml", &comparison);
        assert_eq!(lines[0], "✗ fail  paper/step.toml  (2 trials)");
        assert_eq!(lines[1], "  trial 7: amplitude_um is 2.5 µm at 10 ms, 0.48 µm outside ± 0.02 µm around 2 µm");
        assert_eq!(lines[2], "  1 of 2 trials lie outside");
    }

    #[test]
    fn the_worst_place_is_drawn() {
        let (golden, comparison) = compared();
        let (trial, worst) = comparison.worst.unwrap();
        let svg = drawing(&golden.tubes[0], &rows(2.5), trial, &worst).unwrap();
        assert!(svg.starts_with("<svg xmlns=") && svg.ends_with("</svg>\n"));
        for class in ["f-band", "s-other", "s-first", "s-settling"] {
            assert!(svg.contains(&format!("class=\"{class}\"")), "{class}");
        }
        assert!(svg.contains("amplitude_um at 10 ms") && svg.len() < 60_000, "{} bytes", svg.len());
        assert_eq!(svg.matches("<svg").count(), 1);
    }
}
