//! Selects the expectations that apply to a controller with a law of its own.

use crate::metrics::{Metric, Subject};
use crate::scenario::definition::Scenario;
use crate::scenario::expect::Expectation;
use crate::scenario::raw::DEFAULT_LAW;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Name of a law that is none of the bench's.
pub const OWN_LAW: &str = "own";
const REMEDY: &str = "--law NAME judges it if the controller announces that law";

/// Expectation that is not judged, because it does not apply to the controller's law.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct NotApplicableExpectation {
    /// Position in the scenario file, counted from 0.
    pub number: usize,
    pub name: String,
    pub reason: String,
}

impl Scenario {
    pub fn has_own_law(&self) -> bool {
        self.controller.law == OWN_LAW
    }

    /// Replaces the law. Another scene of the file keeps its law if that differs from the scenario's.
    pub fn set_law(&mut self, law: &str) {
        let previous = std::mem::replace(&mut self.controller.law, law.to_owned());
        let others = self.between.iter_mut().chain(self.other_trials.as_deref_mut());
        let mut laws = others.map(|scene| &mut scene.controller.law);
        laws.by_ref().filter(|other| **other == previous).for_each(|other| law.clone_into(other));
        if law == OWN_LAW {
            self.select_expectations_of_own_law(&previous);
            let expectations = &self.expectations;
            let is_selected = |name: &str| expectations.iter().any(|expectation| expectation.name == name);
            if let Some(others) = &mut self.other_trials {
                others.expectations.retain(|expectation| is_selected(&expectation.name));
            }
        }
    }

    /// Moves the expectations that do not apply to an own law from `expectations` to
    /// `not_applicable`. `described` is the law in the scenario file.
    fn select_expectations_of_own_law(&mut self, described: &str) {
        let all = std::mem::take(&mut self.expectations);
        for (number, expectation) in all.into_iter().enumerate() {
            match reason_not_applicable(&expectation, described) {
                None => self.expectations.push(expectation),
                Some(reason) => {
                    let name = expectation.name;
                    self.not_applicable.push(NotApplicableExpectation { number, name, reason });
                }
            }
        }
    }
}

/// Position of the judged expectation `index` in the scenario file.
pub fn number_in_file(not_applicable: &[NotApplicableExpectation], index: usize) -> usize {
    not_applicable.iter().fold(index, |number, skipped| number + usize::from(skipped.number <= number))
}

/// A requirement applies to every law. So do the rules of the protocol and a number of the
/// controller, such as its missed replies, because the protocol and not the law decides them.
fn reason_not_applicable(expectation: &Expectation, described: &str) -> Option<String> {
    if expectation.metric == Metric::ProtocolDifferences {
        return None;
    }
    if compares_with_bench_law(expectation.metric) {
        return Some(format!("a comparison with the bench's law; {REMEDY}"));
    }
    // The checks of every trial hold the limit of the amplifier for every law.
    if expectation.metric == Metric::DrivePeak && described != OWN_LAW {
        return Some(format!("a peak drive of the bench's law {described}; {REMEDY}"));
    }
    let is_general = expectation.requirement.is_some() || expectation.metric.spec().subject == Subject::Controller;
    match described {
        OWN_LAW => None,
        DEFAULT_LAW if is_general => None,
        DEFAULT_LAW => Some(format!("a description of the bench's law {DEFAULT_LAW}, not a requirement; {REMEDY}")),
        law => Some(format!("a description of the bench's law {law}; {REMEDY}")),
    }
}

pub(crate) fn compares_with_bench_law(metric: Metric) -> bool {
    metric == Metric::ReferenceDifference
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::load;
    use std::path::Path;

    fn shipped(file: &str) -> Scenario {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios").join(file);
        load(&path, file).unwrap_or_else(|fault| panic!("{fault}"))
    }

    fn with_own_law(file: &str) -> Scenario {
        let mut scenario = shipped(file);
        scenario.set_law(OWN_LAW);
        scenario
    }

    #[test]
    fn requirements_apply_to_an_own_law() {
        let scenario = with_own_law("paper/fig13-closed-loop.toml");
        assert_eq!((scenario.expectations.len(), scenario.not_applicable.len()), (4, 1));
        // The peak of 600 Vpp describes the step of dq-pi.
        assert!(scenario.not_applicable[0].reason.starts_with("a peak drive of the bench's law dq-pi;"));
        assert!(scenario.has_own_law());
    }

    #[test]
    fn descriptions_of_the_default_law_do_not_apply() {
        let scenario = with_own_law("laws/specified-delay-half-a-period-dq-pi.toml");
        let names = |scenario: &Scenario| {
            scenario.expectations.iter().map(|expectation| expectation.name.clone()).collect::<Vec<_>>()
        };
        assert_eq!(names(&scenario), ["static_error_percent"]);
        let skipped: Vec<_> = scenario.not_applicable.iter().map(|skipped| (skipped.number, &*skipped.name)).collect();
        assert_eq!(skipped, [(0, "settling_time_ms"), (1, "overshoot_percent")]);
        assert_eq!(
            scenario.not_applicable[0].reason,
            "a description of the bench's law dq-pi, not a requirement; --law NAME judges it if the controller \
             announces that law"
        );
        assert_eq!(number_in_file(&scenario.not_applicable, 0), 2);
    }

    #[test]
    fn numbers_of_the_controller_apply() {
        let scenario = with_own_law("faults/five-periods-of-silence.toml");
        assert_eq!((scenario.expectations.len(), scenario.not_applicable.len()), (2, 0));
    }

    #[test]
    fn the_rules_of_the_protocol_apply() {
        let scenario = with_own_law("reference/protocol.toml");
        assert_eq!((scenario.expectations.len(), scenario.not_applicable.len()), (1, 0));
    }

    #[test]
    fn scenarios_of_other_laws_and_comparisons_do_not_apply() {
        for (file, part) in [
            ("paper/fig13-open-loop.toml", "description of the bench's law open-loop;"),
            ("laws/deadbeat-fig13.toml", "description of the bench's law deadbeat;"),
            ("reference/long.toml", "comparison with the bench's law;"),
        ] {
            let scenario = with_own_law(file);
            assert!(scenario.expectations.is_empty(), "{file}");
            assert!(scenario.not_applicable[0].reason.contains(part), "{file}: {:?}", scenario.not_applicable);
        }
    }

    #[test]
    fn a_file_for_an_own_law_keeps_its_expectations() {
        let mut scenario = shipped("guards/hot-plate.toml");
        scenario.controller.law = OWN_LAW.to_owned();
        scenario.set_law(OWN_LAW);
        assert_eq!(scenario.not_applicable, []);
    }

    #[test]
    fn another_law_changes_no_expectation() {
        let mut scenario = shipped("laws/deadbeat-fig13.toml");
        let before = scenario.expectations.clone();
        scenario.set_law("pll");
        assert_eq!((scenario.expectations, scenario.not_applicable), (before, Vec::new()));
    }
}
