//! How finely a page draws, so that it stays small however many scenarios were played.
//!
//! Neighbours: `bundle` reduces traces to this many points. Only what is shown is reduced; traces and verdicts are not.

/// Characters that the interactive curves of all scenarios may take together.
const CURVES: usize = 1_600_000;
/// Points that the drawings of all scenarios may take together.
const DRAWN: usize = 100_000;
/// Scenarios with all drawings. What did not pass is among the first.
const FULL: usize = 30;
/// Lines of a scenario in its plots beside those of its trials: first trial, percentiles, tubes, profiles.
const OTHER_LINES: usize = 34;
/// Characters of a point in a packed line, most of the time.
const PACKED: usize = 2;

/// Points of what is shown of one scenario.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Resolution {
    /// Instants of the interactive curves.
    pub(crate) instants: usize,
    /// Trials that are laid over each other there.
    pub(crate) overlaid: usize,
    /// How many scenarios, the first of the page, have all drawings; the others have those of |W| and drive.
    pub(crate) full: usize,
    /// Points of a line in a drawing.
    pub(crate) points: usize,
    /// Stretches of time of a range in a drawing.
    pub(crate) buckets: usize,
}

impl Resolution {
    /// For each of so many scenarios on a page, which have up to `trials` trials.
    pub(crate) fn of(scenarios: usize, trials: usize) -> Self {
        let scenarios = scenarios.max(1);
        let curves = CURVES / scenarios / PACKED;
        // Two signals are shown of every trial. Few trials in detail are of more use than many without.
        let overlaid = trials.min((curves / 100).saturating_sub(OTHER_LINES) / 2).max(1);
        let points = (DRAWN / scenarios / 8).clamp(100, 400);
        Self {
            instants: (curves / (OTHER_LINES + 2 * overlaid)).clamp(60, 1_200),
            overlaid,
            full: FULL,
            points,
            buckets: points / 2,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn few_scenarios_are_drawn_finely_and_many_still_as_curves() {
        let one = Resolution::of(1, 30);
        assert_eq!(one, Resolution { instants: 1_200, overlaid: 30, full: 30, points: 400, buckets: 200 });
        let forty = Resolution::of(40, 30);
        assert!(forty.instants >= 180 && forty.overlaid == 30, "{forty:?}");
        let hundred = Resolution::of(100, 30);
        assert!(hundred.instants >= 80 && hundred.overlaid >= 20, "{hundred:?}");
        for (scenarios, trials) in [(0, 0), (1, 0), (1_000_000, 30)] {
            let coarse = Resolution::of(scenarios, trials);
            assert!(coarse.instants >= 60 && coarse.overlaid >= 1 && coarse.points >= 100, "{coarse:?}");
        }
    }
}
