//! Chooses the resolution of figures, so that a page stays small for any number of scenarios.

/// Most characters of the interactive figures of all scenarios.
const MAX_CURVE_CHARS: usize = 2_000_000;
/// Most points of the drawings of all scenarios.
const MAX_DRAWN_POINTS: usize = 100_000;
/// Scenarios with all drawings; the page begins with those that did not pass.
const MAX_FULL_SCENARIOS: usize = 30;
/// Lines of a scenario's figures without those of its trials: first trial, percentiles, tubes, profiles.
const OTHER_LINES: usize = 34;
/// Typical characters of an encoded point.
const CHARS_PER_POINT: usize = 2;

/// Resolution of the figures of one scenario.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct PlotResolution {
    /// Instants of the figures.
    pub(crate) instants: usize,
    /// Trials with a line of their own in the interactive figures.
    pub(crate) overlaid_trials: usize,
    /// Scenarios with all drawings; the others have those of |W| and drive.
    pub(crate) full_scenarios: usize,
    /// Points of a line in a drawing.
    pub(crate) line_points: usize,
}

impl PlotResolution {
    /// For each of `scenarios` scenarios with at most `trials` trials.
    pub(crate) fn of(scenarios: usize, trials: usize) -> Self {
        let scenarios = scenarios.max(1);
        let curves = MAX_CURVE_CHARS / scenarios / CHARS_PER_POINT;
        // Two figures overlay trials. Few trials in detail are more useful than many without.
        let overlaid = trials.min((curves / 100).saturating_sub(OTHER_LINES) / 2).max(1);
        Self {
            instants: (curves / (OTHER_LINES + 2 * overlaid)).clamp(60, 1_200),
            overlaid_trials: overlaid,
            full_scenarios: MAX_FULL_SCENARIOS,
            line_points: (MAX_DRAWN_POINTS / scenarios / 8).clamp(100, 400),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fewer_scenarios_have_finer_figures() {
        let one = PlotResolution::of(1, 30);
        assert_eq!(one, PlotResolution { instants: 1_200, overlaid_trials: 30, full_scenarios: 30, line_points: 400 });
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
