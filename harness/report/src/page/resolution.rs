//! Chooses the resolution of figures, so that a page stays small for any number of scenarios.

const MAX_CURVE_CHARS: usize = 2_000_000;
const MAX_DRAWN_POINTS: usize = 100_000;
/// Largest number of scenarios with drawings. Scenarios that did not pass have them first.
const MAX_DRAWN_SCENARIOS: usize = 30;
/// Lines of a scenario besides overlaid trials, such as percentiles, tubes and profiles.
const OTHER_LINES: usize = 34;
const CHARS_PER_POINT: usize = 2;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct PlotResolution {
    pub(crate) instants: usize,
    pub(crate) overlaid_trials: usize,
    /// Scenarios with drawings for readers without scripts.
    pub(crate) drawn_scenarios: usize,
    pub(crate) line_points: usize,
}

impl PlotResolution {
    /// `trials` is the largest number of trials of a scenario.
    pub(crate) fn of(scenarios: usize, trials: usize) -> Self {
        let scenarios = scenarios.max(1);
        let curves = MAX_CURVE_CHARS / scenarios / CHARS_PER_POINT;
        // Two figures contain the lines of overlaid trials.
        let overlaid = trials.min((curves / 100).saturating_sub(OTHER_LINES) / 2).max(1);
        Self {
            instants: (curves / (OTHER_LINES + 2 * overlaid)).clamp(60, 1_200),
            overlaid_trials: overlaid,
            drawn_scenarios: if scenarios > 100 { MAX_DRAWN_SCENARIOS / 3 } else { MAX_DRAWN_SCENARIOS },
            line_points: (MAX_DRAWN_POINTS / scenarios.min(MAX_DRAWN_SCENARIOS) / 8).clamp(100, 400),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fewer_scenarios_have_finer_figures() {
        let one = PlotResolution::of(1, 30);
        assert_eq!(one, PlotResolution { instants: 1_200, overlaid_trials: 30, drawn_scenarios: 30, line_points: 400 });
        let forty = PlotResolution::of(40, 30);
        assert!(forty.instants >= 180 && forty.overlaid_trials == 30, "{forty:?}");
        let hundred = PlotResolution::of(100, 30);
        assert!(hundred.instants >= 80 && hundred.overlaid_trials >= 20, "{hundred:?}");
        for (scenarios, trials) in [(0, 0), (1, 0), (1_000_000, 30)] {
            let coarse = PlotResolution::of(scenarios, trials);
            assert!(coarse.instants >= 60 && coarse.overlaid_trials >= 1 && coarse.line_points >= 100, "{coarse:?}");
        }
    }
}
