//! Defines `explore.json`.

use crate::explore::coverage::{ChangeKind, RangeCoverage};
use crate::explore::exploration::{
    Exploration, ExploreConfig, FailedRegression, FailedScene, PropertyTally, UndecidedScene,
};
use crate::explore::player::violated;
use crate::explore::properties::Property;
use platebench_engine::SafeEnds;
use platebench_model::record::Verdict;
use platebench_verdict::statistics::clopper_pearson;
use serde::Serialize;
use std::collections::BTreeMap;

const CONFIDENCE: f64 = 0.95;
pub const FILE: &str = "explore.json";

#[derive(Debug, Clone, Serialize)]
pub struct ExploreReport {
    pub format: u32,
    /// `fail` after a violation. Otherwise `inconclusive` if a scene is undecided, a signal ended
    /// the exploration or a controller did not confirm 0 V.
    pub verdict: Verdict,
    /// True if every controller confirmed 0 V and stayed there.
    pub safe_confirmed: bool,
    /// True if a signal ended the exploration. Failing scenes are then not shrunk.
    pub is_interrupted: bool,
    pub envelope: String,
    /// The rig as named on the command line.
    pub rig: String,
    pub firmware: String,
    pub law: &'static str,
    pub seed: u64,
    pub scenes: u64,
    pub failed: u64,
    pub undecided: u64,
    pub undecided_scenes: Vec<UndecidedScene>,
    /// Duration of the exploration without shrinking, s.
    pub elapsed_s: f64,
    /// Bounds of the share of failing scenes that the generator makes, each one-sided at 95 %.
    pub failing_share: Option<[f64; 2]>,
    pub properties: Vec<PropertyReport>,
    pub regressions: usize,
    pub failed_regressions: Vec<FailedRegression>,
    /// Violations of at most three properties, one per property.
    pub violations: Vec<ViolationReport>,
    pub coverage: CoverageReport,
}

#[derive(Debug, Clone, Serialize)]
pub struct PropertyReport {
    pub property: Property,
    #[serde(flatten)]
    pub tally: PropertyTally,
}

#[derive(Debug, Clone, Serialize)]
pub struct ViolationReport {
    pub property: Property,
    pub scene: u64,
    pub value: Option<f64>,
    pub limit: Option<f64>,
    /// The violated rule of the protocol, in words.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rule: Option<String>,
    /// The original scene as a scenario file.
    pub original: String,
    /// The minimal scene as a scenario file.
    pub minimal: String,
    pub minimal_value: Option<f64>,
    pub minimal_limit: Option<f64>,
    pub file: String,
    /// True if the minimal scene from the written file fails with a new controller.
    pub is_reproduced: bool,
    pub replays: u32,
}

#[derive(Debug, Clone, Serialize)]
pub struct CoverageReport {
    pub ranges: Vec<RangeCoverage>,
    pub pairs: Vec<PairCoverage>,
    pub histories: BTreeMap<usize, u64>,
}

#[derive(Debug, Clone, Copy, Serialize)]
pub struct PairCoverage {
    pub first: &'static str,
    pub second: &'static str,
    pub count: u64,
}

impl ExploreReport {
    /// Leaves `violations` empty. The session adds them after shrinking.
    pub fn new(config: &ExploreConfig, exploration: &Exploration, rig: &str, firmware: &str) -> Self {
        let failed = exploration.failed.len() as u64;
        let has_failed = failed > 0 || !exploration.failed_regressions.is_empty();
        let is_empty = exploration.scenes == 0 && exploration.regressions == 0;
        let verdict = match (has_failed, exploration.undecided > 0 || exploration.is_interrupted || is_empty) {
            (true, _) => Verdict::Fail,
            (false, false) => Verdict::Pass,
            (false, true) => Verdict::Inconclusive,
        };
        let coverage = &exploration.coverage;
        let pairs = ChangeKind::ALL.iter().flat_map(|first| ChangeKind::ALL.iter().map(move |second| (first, second)));
        Self {
            format: 1,
            verdict,
            safe_confirmed: true,
            is_interrupted: exploration.is_interrupted,
            envelope: config.envelope.path.display().to_string(),
            rig: rig.to_owned(),
            firmware: firmware.to_owned(),
            law: config.law.name(),
            seed: config.seed,
            scenes: exploration.scenes,
            failed,
            undecided: exploration.undecided,
            undecided_scenes: exploration.undecided_scenes.clone(),
            elapsed_s: exploration.elapsed.as_secs_f64(),
            failing_share: clopper_pearson(
                failed as u32,
                (exploration.scenes - exploration.undecided) as u32,
                CONFIDENCE,
            ),
            properties: exploration
                .properties
                .iter()
                .map(|(property, tally)| PropertyReport { property: *property, tally: *tally })
                .collect(),
            regressions: exploration.regressions,
            failed_regressions: exploration.failed_regressions.clone(),
            violations: Vec::new(),
            coverage: CoverageReport {
                ranges: coverage.ranges().cloned().collect(),
                pairs: pairs
                    .map(|(first, second)| PairCoverage {
                        first: first.name(),
                        second: second.name(),
                        count: coverage.pair(*first, *second),
                    })
                    .collect(),
                histories: coverage.histories.clone(),
            },
        }
    }

    /// Reason of the verdict.
    pub fn reason(&self) -> String {
        let Self { scenes, failed, undecided, failed_regressions, is_interrupted, .. } = self;
        match self.verdict {
            Verdict::Fail if *failed == 0 && failed_regressions.is_empty() => {
                "the controller commanded a drive after it had confirmed 0 V".to_owned()
            }
            Verdict::Fail if failed_regressions.is_empty() => format!("{failed} of {scenes} scenes violate a property"),
            Verdict::Fail => format!(
                "{failed} of {scenes} scenes and {} scenarios of earlier explorations violate a property",
                failed_regressions.len()
            ),
            Verdict::Inconclusive if *is_interrupted => "a signal ended the exploration".to_owned(),
            Verdict::Inconclusive if !self.safe_confirmed => "the controller did not confirm 0 V at the end".to_owned(),
            Verdict::Inconclusive => format!("{undecided} of {scenes} scenes are undecided, because of the rig"),
            Verdict::Pass => format!("no property was violated in {scenes} scenes"),
        }
    }

    /// A drive after confirmed 0 V is a failure. A pass also needs confirmed 0 V.
    pub(crate) fn record_ends(&mut self, ends: &SafeEnds) {
        self.safe_confirmed = ends.are_confirmed();
        if ends.have_drive() {
            self.verdict = Verdict::Fail;
        } else if self.verdict == Verdict::Pass && !self.safe_confirmed {
            self.verdict = Verdict::Inconclusive;
        }
    }

    pub fn conclusion(&self) -> String {
        let Self { failed, scenes, .. } = self;
        let interrupted = if self.is_interrupted { " A signal ended the exploration." } else { "" };
        let unsafe_end = if self.safe_confirmed {
            ""
        } else {
            " The controller did not confirm 0 V or did not stay there: check the amplifier before you touch the plate."
        };
        match (failed, self.failing_share) {
            (0, Some([_, most])) => {
                let percent = most * 100.0;
                format!(
                    "No generated scene violates a property. \
                     At 95 % confidence fewer than {percent:.3} % of all scenes fail.{interrupted}{unsafe_end}"
                )
            }
            _ => format!("{failed} of {scenes} scenes violate a property.{interrupted}{unsafe_end}"),
        }
    }
}

pub(crate) fn format_value(value: Option<f64>, decimals: usize) -> String {
    value.map_or_else(|| "no value".to_owned(), |value| format!("{value:.decimals$}"))
}

/// Violated properties, the most frequent one first, with the first scene of each.
pub fn violated_properties(exploration: &Exploration) -> Vec<(Property, &FailedScene)> {
    let mut first: BTreeMap<Property, (usize, &FailedScene)> = BTreeMap::new();
    for scene in &exploration.failed {
        for property in violated(&scene.failures) {
            first.entry(property).or_insert((0, scene)).0 += 1;
        }
    }
    let mut violated: Vec<_> = first.into_iter().collect();
    violated.sort_by_key(|(property, (count, _))| (std::cmp::Reverse(*count), *property));
    violated.into_iter().map(|(property, (_, scene))| (property, scene)).collect()
}
