//! Holds the results of mutation testing and their score.

use super::mutant::Mutant;
use crate::firmware_analysis::suite::Margin;
use platebench_verdict::statistics::proportion::clopper_pearson;
use std::time::Duration;

/// Each end of the 95 % interval of the score has half of the error probability.
const ONE_SIDED_CONFIDENCE: f64 = 0.975;

#[derive(Debug, Clone, PartialEq, strum::IntoStaticStr)]
#[strum(const_into_str)]
pub enum Status {
    Killed {
        by: String,
        reason: String,
    },
    Survived {
        closest: Option<Margin>,
        /// True if every drive and frequency is that of the unchanged firmware.
        same_commands: bool,
    },
    NoCoverage,
    /// A scenario took much longer than with the unchanged firmware.
    Timeout {
        by: String,
    },
    /// The emulator failed.
    RuntimeError {
        by: String,
        reason: String,
    },
}

impl Status {
    /// Name of the status in the schema of mutation reports.
    pub const fn name(&self) -> &'static str {
        self.into_str()
    }

    pub const fn is_detected(&self) -> bool {
        matches!(self, Self::Killed { .. } | Self::Timeout { .. })
    }

    const fn is_valid(&self) -> bool {
        !matches!(self, Self::RuntimeError { .. })
    }
}

#[derive(Debug, Clone, PartialEq)]
pub struct MutantResult {
    pub mutant: Mutant,
    pub status: Status,
    /// Scenarios that execute the instruction, fastest first.
    pub covered_by: Vec<String>,
    pub duration: Duration,
}

#[derive(Debug, Clone, PartialEq)]
pub struct MutationReport {
    pub results: Vec<MutantResult>,
    /// Number of selected mutants, including those that were not drawn.
    pub population: usize,
    pub scenarios: Vec<String>,
}

/// Detected mutants divided by valid mutants. A mutant that the emulator cannot run is not valid.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Score {
    pub detected: u32,
    pub valid: u32,
}

impl Score {
    pub fn of<'a>(statuses: impl Iterator<Item = &'a Status>) -> Self {
        statuses.filter(|status| status.is_valid()).fold(Self { detected: 0, valid: 0 }, |score, status| Self {
            detected: score.detected + u32::from(status.is_detected()),
            valid: score.valid + 1,
        })
    }

    pub fn percent(self) -> f64 {
        if self.valid == 0 { 100.0 } else { f64::from(self.detected) / f64::from(self.valid) * 100.0 }
    }

    pub fn interval(self) -> Option<[f64; 2]> {
        let bounds = clopper_pearson(self.detected, self.valid, ONE_SIDED_CONFIDENCE)?;
        Some(bounds.map(|bound| bound * 100.0))
    }

    pub fn is_narrower_than(self, width: f64) -> bool {
        self.interval().is_some_and(|[low, high]| high - low <= width)
    }
}

impl MutationReport {
    pub fn score(&self) -> Score {
        self.score_if(|_| true)
    }

    pub fn score_of_executed(&self) -> Score {
        self.score_if(|result| result.status != Status::NoCoverage)
    }

    /// Number of survivors, and of those with the commands of the unchanged firmware.
    pub fn survivors(&self) -> [usize; 2] {
        let same = self.results.iter().filter_map(|result| match result.status {
            Status::Survived { same_commands, .. } => Some(same_commands),
            _ => None,
        });
        same.fold([0, 0], |[all, unchanged], same| [all + 1, unchanged + usize::from(same)])
    }

    pub fn score_of_control_step(&self) -> Score {
        self.score_if(|result| result.mutant.in_control_step)
    }

    /// Like `score_of_control_step`, without survivors that change no drive and no frequency.
    pub fn score_of_changed_control_step(&self) -> Score {
        let is_same = |status: &Status| matches!(status, Status::Survived { same_commands: true, .. });
        self.score_if(|result| result.mutant.in_control_step && !is_same(&result.status))
    }

    fn score_if(&self, is_counted: impl Fn(&MutantResult) -> bool) -> Score {
        Score::of(self.results.iter().filter(|result| is_counted(result)).map(|result| &result.status))
    }
}
