use crate::suite;
use platebench_experiments::mutation::mutants::MutantFilter;
use platebench_experiments::mutation::{MutantStatus, mutation_json};
use platebench_experiments::mutation::{MutationConfig, MutationReport, measure_mutation};
use platebench_rig::CancelToken;
use serde_json::Value;

const SCHEMA: &str = include_str!("mutation-testing-report-schema.json");

fn mutate(sample: Option<usize>, until_width: Option<f64>, jobs: usize) -> MutationReport {
    let config = MutationConfig {
        suite: suite(&["paper/fig13-closed-loop.toml", "paper/fig13-open-loop.toml"]),
        filter: MutantFilter { functions: vec!["dq_pi".to_owned()], files: Vec::new() },
        sample,
        until_width,
        seed: 7,
        jobs,
        cancel: CancelToken::never(),
    };
    measure_mutation(&config, &mut |_| {}).unwrap().0
}

fn statuses(report: &MutationReport) -> Vec<(u32, &'static str)> {
    report.results.iter().map(|result| (result.mutant.address, result.status.name())).collect()
}

#[test]
fn kills_mutants_of_the_law_for_any_number_of_jobs() {
    let report = mutate(Some(60), None, 1);
    assert_eq!(report.results.len(), 60);
    let killed = report.results.iter().filter(|result| matches!(result.status, MutantStatus::Killed { .. })).count();
    assert!(killed >= 3, "{:?}", statuses(&report));
    assert_eq!(statuses(&mutate(Some(60), None, 3)), statuses(&report));
}

#[test]
fn stops_at_the_wanted_width() {
    let report = mutate(None, Some(60.0), 2);
    let [low, high] = report.score().interval().unwrap();
    assert!(high - low <= 60.0);
    assert!(report.results.len() < report.population, "{}", report.population);
}

#[test]
fn the_report_is_valid_by_the_open_schema() {
    let report = mutation_json(&mutate(Some(6), None, 2));
    let schema: Value = serde_json::from_str(SCHEMA).unwrap();
    let validator = jsonschema::validator_for(&schema).unwrap();
    let errors: Vec<String> = validator.iter_errors(&report).map(|error| error.to_string()).collect();
    assert!(errors.is_empty(), "{errors:?}");
    let mut wrong = report;
    wrong["schemaVersion"] = Value::from(2);
    assert!(!validator.is_valid(&wrong));
}
