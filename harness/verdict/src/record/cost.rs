//! What a control step costs, beside what it cost in earlier runs. No verdict comes from here: an expectation on `instructions_per_step` gives one.

use serde::{Deserialize, Serialize};

/// A change of less than this, or just this much, is not worth a word, percent.
pub(crate) const WORTH_A_WORD_PERCENT: f64 = 1.0;

/// Instructions per control step over some trials.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Cost {
    /// Mean over the trials of each trial's mean.
    pub mean: f64,
    /// The most that a step took.
    pub worst: f64,
}

/// Instructions per control step under one law.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CostTrend {
    /// The control law.
    pub law: String,
    /// Build identity of the firmware, hexadecimal.
    pub build: String,
    /// Over all trials of the run under this law.
    pub cost: Cost,
    /// Earlier runs that played some of the same trials on the same kind of rig to a firmware of the same name: the newest first, the reference last.
    pub earlier: Vec<EarlierCost>,
}

/// What it took in an earlier run. Only what both played is compared: the same law, the same inputs byte for byte, the same seed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EarlierCost {
    /// The run folder's name; `null` for the reference that came with the bench.
    pub run: Option<String>,
    /// When the run started, UTC, RFC 3339; `null` for the reference.
    pub started: Option<String>,
    /// Build identity of its firmware, hexadecimal.
    pub build: String,
    /// How many trials both played.
    pub trials: usize,
    /// What they took then.
    pub then: Cost,
    /// What they take now.
    pub now: Cost,
}

/// A change that is worth a word.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CostChange<'a> {
    /// What is compared: `worst` or `mean`.
    pub what: &'static str,
    /// Instructions per step now.
    pub now: f64,
    /// Instructions per step then.
    pub then: f64,
    /// From then to now, percent; positive where it takes more.
    pub percent: f64,
    /// The earlier run.
    pub against: &'a EarlierCost,
}

impl CostTrend {
    /// The newest earlier run with another build, or the newest where all have the same: a second run of a new build does not hide what the build changed.
    pub fn against(&self) -> Option<&EarlierCost> {
        self.earlier.iter().find(|earlier| earlier.build != self.build).or_else(|| self.earlier.first())
    }

    /// The change of the worst step against that run, or that of the mean where only the mean has changed by more than 1 %.
    pub fn change(&self) -> Option<CostChange<'_>> {
        let against = self.against()?;
        let EarlierCost { now, then, .. } = against;
        [("worst", now.worst, then.worst), ("mean", now.mean, then.mean)].into_iter().find_map(|(what, now, then)| {
            // Multiplied out: whole numbers are then compared exactly.
            let is_worth_it = (now - then).abs() * 100.0 > then * WORTH_A_WORD_PERCENT;
            is_worth_it.then(|| CostChange { what, now, then, percent: (now / then - 1.0) * 100.0, against })
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rstest::rstest;

    fn earlier(build: &str, then: [f64; 2], now: [f64; 2]) -> EarlierCost {
        let cost = |[mean, worst]: [f64; 2]| Cost { mean, worst };
        EarlierCost {
            run: Some("20260101T000000Z-abcdef".to_owned()),
            started: Some("2026-01-01T00:00:00Z".to_owned()),
            build: build.to_owned(),
            trials: 3,
            then: cost(then),
            now: cost(now),
        }
    }

    fn trend(earlier: Vec<EarlierCost>) -> CostTrend {
        let cost = Cost { mean: 2_000.0, worst: 2_600.0 };
        CostTrend { law: "dq-pi".to_owned(), build: "new".to_owned(), cost, earlier }
    }

    #[rstest]
    #[case::a_third_more([2_000.0, 2_000.0], [2_600.0, 2_600.0], Some(("worst", 30.0)))]
    #[case::at_the_threshold([2_000.0, 2_000.0], [2_020.0, 2_020.0], None)]
    #[case::just_beyond([2_000.0, 2_000.0], [2_020.0, 2_021.0], Some(("worst", 1.05)))]
    #[case::less([2_000.0, 2_000.0], [1_980.0, 1_979.0], Some(("worst", -1.05)))]
    #[case::at_the_lower_threshold([2_000.0, 2_000.0], [1_980.0, 1_980.0], None)]
    #[case::the_mean_alone([2_000.0, 2_500.0], [2_100.0, 2_500.0], Some(("mean", 5.0)))]
    #[case::the_same([2_000.0, 2_500.0], [2_000.0, 2_500.0], None)]
    fn a_change_is_told_from_the_first_whole_instruction_beyond_a_percent(
        #[case] then: [f64; 2],
        #[case] now: [f64; 2],
        #[case] expected: Option<(&str, f64)>,
    ) {
        let trend = trend(vec![earlier("old", then, now)]);
        let change = trend.change().map(|change| (change.what, (change.percent * 1e6).round() / 1e6));
        assert_eq!(change, expected);
    }

    #[test]
    fn another_build_is_compared_with_before_the_same_one() {
        let (same, old) = (earlier("new", [9.0; 2], [9.0; 2]), earlier("old", [5.0; 2], [9.0; 2]));
        let older = EarlierCost { run: None, started: None, ..earlier("older", [1.0; 2], [9.0; 2]) };
        assert_eq!(trend(vec![same.clone(), old.clone(), older]).against(), Some(&old));
        assert_eq!(trend(vec![same.clone(), same.clone()]).against(), Some(&same));
        assert_eq!(trend(Vec::new()).change(), None);
    }
}
