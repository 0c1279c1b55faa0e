//! Compares instructions per control step with earlier runs.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

const MIN_CHANGE_PERCENT: f64 = 1.0;

/// Speed of the emulated board: one instruction per cycle of 168 MHz.
const INSTRUCTIONS_PER_MS: f64 = 168_000.0;

/// The control step that needs the largest share of its period.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct TightestStep {
    pub instructions: f64,
    pub period_ms: f64,
}

impl TightestStep {
    /// Share of the control period that the step takes on the emulated board.
    pub fn share(&self) -> f64 {
        self.instructions / (INSTRUCTIONS_PER_MS * self.period_ms)
    }
}

/// Instructions per control step over some trials.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct StepCost {
    /// Mean over the trials of each trial's mean.
    pub mean: f64,
    pub worst: f64,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct CostTrend {
    pub law: String,
    /// Build identity of the firmware, hexadecimal.
    pub build: String,
    pub cost: StepCost,
    /// `null` in records of earlier versions.
    #[serde(default)]
    pub tightest: Option<TightestStep>,
    /// Runs on the same kind of rig and firmware, newest first. The reference that came with the
    /// bench is last.
    pub earlier: Vec<EarlierCost>,
}

/// Cost in an earlier run, over the trials with the same law, inputs and seed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct EarlierCost {
    /// The run folder's name; `null` for the reference that came with the bench.
    pub run: Option<String>,
    pub started: Option<String>,
    pub build: String,
    /// Number of trials that both runs have.
    pub trials: usize,
    pub then: StepCost,
    pub now: StepCost,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CostChange<'a> {
    pub statistic: &'static str,
    pub now: f64,
    pub then: f64,
    /// Change from `then` to `now`, percent; positive if a step costs more now.
    pub percent: f64,
    pub earlier: &'a EarlierCost,
}

impl CostTrend {
    /// The newest earlier run of another build, so that a second run of the same build does not
    /// hide a change.
    pub fn comparison_run(&self) -> Option<&EarlierCost> {
        self.earlier.iter().find(|earlier| earlier.build != self.build).or_else(|| self.earlier.first())
    }

    /// The change of the worst step, or of the mean if only the mean changed by more than 1 %.
    pub fn significant_change(&self) -> Option<CostChange<'_>> {
        let against = self.comparison_run()?;
        let EarlierCost { now, then, .. } = against;
        [("worst", now.worst, then.worst), ("mean", now.mean, then.mean)].into_iter().find_map(|(what, now, then)| {
            let is_significant = (now - then).abs() * 100.0 > then * MIN_CHANGE_PERCENT;
            is_significant.then(|| CostChange {
                statistic: what,
                now,
                then,
                percent: (now / then - 1.0) * 100.0,
                earlier: against,
            })
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rstest::rstest;

    fn earlier(build: &str, then: [f64; 2], now: [f64; 2]) -> EarlierCost {
        let cost = |[mean, worst]: [f64; 2]| StepCost { mean, worst };
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
        let cost = StepCost { mean: 2_000.0, worst: 2_600.0 };
        CostTrend { law: "dq-pi".to_owned(), build: "new".to_owned(), cost, tightest: None, earlier }
    }

    #[rstest]
    #[case::a_third_more([2_000.0, 2_000.0], [2_600.0, 2_600.0], Some(("worst", 30.0)))]
    #[case::at_the_threshold([2_000.0, 2_000.0], [2_020.0, 2_020.0], None)]
    #[case::just_beyond([2_000.0, 2_000.0], [2_020.0, 2_021.0], Some(("worst", 1.05)))]
    #[case::less([2_000.0, 2_000.0], [1_980.0, 1_979.0], Some(("worst", -1.05)))]
    #[case::at_the_lower_threshold([2_000.0, 2_000.0], [1_980.0, 1_980.0], None)]
    #[case::the_mean_alone([2_000.0, 2_500.0], [2_100.0, 2_500.0], Some(("mean", 5.0)))]
    #[case::the_same([2_000.0, 2_500.0], [2_000.0, 2_500.0], None)]
    fn reports_a_change_of_more_than_a_percent(
        #[case] then: [f64; 2],
        #[case] now: [f64; 2],
        #[case] expected: Option<(&str, f64)>,
    ) {
        let trend = trend(vec![earlier("old", then, now)]);
        let change = trend.significant_change().map(|change| (change.statistic, (change.percent * 1e6).round() / 1e6));
        assert_eq!(change, expected);
    }

    #[test]
    fn prefers_another_build_for_the_comparison() {
        let (same, old) = (earlier("new", [9.0; 2], [9.0; 2]), earlier("old", [5.0; 2], [9.0; 2]));
        let older = EarlierCost { run: None, started: None, ..earlier("older", [1.0; 2], [9.0; 2]) };
        assert_eq!(trend(vec![same.clone(), old.clone(), older]).comparison_run(), Some(&old));
        assert_eq!(trend(vec![same.clone(), same.clone()]).comparison_run(), Some(&same));
        assert_eq!(trend(Vec::new()).significant_change(), None);
    }
}
