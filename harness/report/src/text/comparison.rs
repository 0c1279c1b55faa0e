//! Describes the comparison of responses with their baseline.

use crate::escape::printable;
use crate::format;
use platebench_verdict::golden::TubeComparison;

pub fn lines(name: &str, comparison: &TubeComparison) -> Vec<String> {
    let verdict = comparison.verdict;
    let trials = format::count(comparison.trials, "trial");
    let mut lines = vec![format!("{} {verdict}  {}  ({trials})", format::sign(verdict), printable(name))];
    lines.extend(comparison.worst.as_ref().map(|(trial, worst)| format!("  {}", format::exceedance(*trial, worst))));
    lines.extend(comparison.reason.as_ref().map(|reason| format!("  {reason}")));
    lines
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_model::trace::Row;
    use platebench_verdict::golden::GoldenTubes;

    #[test]
    fn names_signal_time_distance_and_trial() {
        let rows = |height: f64| -> Vec<Row> {
            let amplitude = |index: u32| if index >= 100 { height } else { 0.0 };
            (0..=300)
                .map(|index| Row { t_s: f64::from(index) * 1e-4, amplitude_um: amplitude(index), ..Row::default() })
                .collect()
        };
        let (good, bad) = (rows(2.0), rows(2.5));
        let comparison = GoldenTubes::from_rows(&good).unwrap().compare([(0, good.as_slice()), (7, bad.as_slice())]);
        assert_eq!(
            lines("paper/step.toml", &comparison),
            [
                "✗ fail  paper/step.toml  (2 trials)",
                "  trial 7: amplitude_um is 2.5 µm at 10 ms, 0.48 µm outside ± 0.02 µm around 2 µm",
                "  1 of 2 trials are outside the tube",
            ]
        );
    }
}
