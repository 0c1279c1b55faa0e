//! Compares the instructions per control step with earlier runs and with the shipped image.
//!
//! The plate's motion changes the count by 1 to 2 %, so only equal trials on the same kind of rig
//! are compared. A trial that ended early has other control steps, so only complete trials of
//! complete runs are compared.

use platebench_model::record::{
    CostTrend, EarlierCost, RecordError, RigRecord, RunRecord, ScenarioRecord, StepCost, TightestStep, TrialRecord,
};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::Path;
use tracing::{info, warn};

/// Counts of the shipped firmware image. `ci/cost --update` writes this file.
const REFERENCE: &str = include_str!("../../../firmware-under-test/images/cost.toml");
const EMULATED: &str = "emulated";

/// Trial as law, digest of the input files, seed, whether the controller stopped, and baud rate, which
/// affects the count by the wait for the end of a frame.
type TrialKey = (String, String, u64, bool, Option<u32>);
type Costs = BTreeMap<TrialKey, StepCost>;

#[derive(Deserialize)]
struct Reference {
    firmware: String,
    build: String,
    baud: u32,
    #[serde(default)]
    trial: Vec<ReferenceTrial>,
}

#[derive(Deserialize)]
struct ReferenceTrial {
    law: String,
    inputs: String,
    seed: u64,
    mean: f64,
    worst: f64,
}

pub(crate) fn cost_trends(record: &RunRecord, folder: &Path) -> Vec<CostTrend> {
    if trial_costs(record, |_| true).is_empty() {
        return Vec::new();
    }
    let log_unreadable =
        |path: &Path, error: &RecordError| info!(run = %path.display(), %error, "earlier run ignored by the trend");
    let mut earlier = record.earlier_runs(folder, log_unreadable);
    earlier.retain(|(_, earlier): &(String, RunRecord)| earlier.complete && is_comparable(&record.rig, &earlier.rig));
    compare_costs(record, earlier.into_iter().map(earlier_run).collect(), load_reference())
}

fn compare_costs(
    record: &RunRecord,
    mut earlier: Vec<(EarlierRun, Costs)>,
    reference: Option<Reference>,
) -> Vec<CostTrend> {
    let for_this = |reference: &Reference| {
        record.rig.kind() == EMULATED && firmware_name(&record.rig) == Some(&reference.firmware)
    };
    earlier.extend(reference.filter(for_this).map(reference_run));
    let mut laws: Vec<&str> = Vec::new();
    for scenario in &record.scenarios {
        if !laws.contains(&scenario.law.as_str()) {
            laws.push(&scenario.law);
        }
    }
    laws.into_iter().filter_map(|law| law_trend(law, record, &earlier)).collect()
}

struct EarlierRun {
    run: Option<String>,
    started: Option<String>,
    build: String,
}

fn law_trend(law: &str, record: &RunRecord, earlier: &[(EarlierRun, Costs)]) -> Option<CostTrend> {
    let of_law = |mut costs: Costs| {
        costs.retain(|(of, ..), _| of == law);
        costs
    };
    let all = of_law(trial_costs(record, |_| true));
    let cost = average_cost(all.values().copied())?;
    let complete = of_law(trial_costs(record, is_complete));
    let earlier = earlier.iter().filter_map(|(run, costs)| {
        let both: Vec<(StepCost, StepCost)> =
            complete.iter().filter_map(|(key, &now)| Some((*costs.get(key)?, now))).collect();
        Some(EarlierCost {
            run: run.run.clone(),
            started: run.started.clone(),
            build: run.build.clone(),
            trials: both.len(),
            then: average_cost(both.iter().map(|&(then, _)| then))?,
            now: average_cost(both.iter().map(|&(_, now)| now))?,
        })
    });
    let (law, build) = (law.to_owned(), firmware_build(&record.rig));
    Some(CostTrend { tightest: tightest_step(&law, record), law, build, cost, earlier: earlier.collect() })
}

/// Control step with the largest share of its period. Control periods differ between scenarios.
fn tightest_step(law: &str, record: &RunRecord) -> Option<TightestStep> {
    let of_law = record.scenarios.iter().filter(|scenario| scenario.law == law);
    let steps = of_law.flat_map(|scenario| {
        let counts = scenario.trials.iter().filter_map(|trial| trial.telemetry.instructions_worst);
        counts.filter_map(|instructions| Some(TightestStep { instructions, period_ms: scenario.period_ms? }))
    });
    steps.max_by(|a, b| a.share().total_cmp(&b.share()))
}

fn average_cost(costs: impl ExactSizeIterator<Item = StepCost>) -> Option<StepCost> {
    let count = costs.len() as f64;
    let sum = costs.reduce(|a, b| StepCost { mean: a.mean + b.mean, worst: a.worst.max(b.worst) })?;
    Some(StepCost { mean: sum.mean / count, ..sum })
}

/// Costs of the trials that `counts` selects.
fn trial_costs(record: &RunRecord, counts: impl Fn(&TrialRecord) -> bool) -> Costs {
    let of_scenario = |scenario: &ScenarioRecord| {
        let digest = scenario.inputs_digest();
        let counted = scenario.trials.iter().filter(|trial| counts(trial)).filter_map(|trial| {
            let cost =
                StepCost { mean: trial.telemetry.instructions_mean?, worst: trial.telemetry.instructions_worst? };
            let stopped = trial.telemetry.stopped.is_some();
            Some(((scenario.law.clone(), digest.clone(), trial.seed, stopped, trial.telemetry.baud), cost))
        });
        counted.collect::<Vec<_>>()
    };
    record.scenarios.iter().flat_map(of_scenario).collect()
}

/// True if the controller was not lost and the trial counts.
fn is_complete(trial: &TrialRecord) -> bool {
    trial.telemetry.ended.is_none() && trial.cause.is_none()
}

fn firmware_name(rig: &RigRecord) -> Option<&String> {
    rig.firmware.as_ref().map(|firmware| &firmware.name)
}

fn firmware_build(rig: &RigRecord) -> String {
    rig.firmware.as_ref().map(|firmware| firmware.build.clone()).unwrap_or_default()
}

fn is_comparable(one: &RigRecord, other: &RigRecord) -> bool {
    one.kind() == other.kind() && firmware_name(one) == firmware_name(other)
}

fn earlier_run((run, record): (String, RunRecord)) -> (EarlierRun, Costs) {
    let costs = trial_costs(&record, is_complete);
    (EarlierRun { run: Some(run), build: firmware_build(&record.rig), started: Some(record.started) }, costs)
}

fn load_reference() -> Option<Reference> {
    toml::from_str(REFERENCE)
        .inspect_err(|error| warn!(%error, "the reference of instructions per step is damaged and ignored"))
        .ok()
}

fn reference_run(reference: Reference) -> (EarlierRun, Costs) {
    let baud = Some(reference.baud);
    let costs = reference.trial.into_iter().map(|trial| {
        ((trial.law, trial.inputs, trial.seed, false, baud), StepCost { mean: trial.mean, worst: trial.worst })
    });
    (EarlierRun { run: None, started: None, build: reference.build }, costs.collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_model::record::{
        Cause, ClockKind, FORMAT, Firmware, Host, InputRecord, Overrides, RECORD_FILE, Telemetry, Tool, Verdict,
    };
    use std::fs;
    use std::path::PathBuf;
    use tempfile::TempDir;

    const BAUD: u32 = 1_000_000;

    fn scenario(law: &str, input: &str, worst: &[f64]) -> ScenarioRecord {
        let trial = |(index, &worst): (usize, &f64)| TrialRecord {
            index: index as u32,
            seed: index as u64 + 1,
            trace: String::new(),
            sha256: None,
            metrics: platebench_model::record::MetricValues::default(),
            telemetry: Telemetry {
                instructions_mean: Some(0.9 * worst),
                instructions_worst: Some(worst),
                baud: Some(BAUD),
                ..Telemetry::default()
            },
            cause: None,
            reason: None,
            symptom: None,
            diverged_at_s: None,
            wall_ms: None,
        };
        ScenarioRecord {
            file: "s.toml".to_owned(),
            title: "s".to_owned(),
            source: None,
            tags: Vec::new(),
            verdict: Verdict::Pass,
            law: law.to_owned(),
            model: "modal".to_owned(),
            period_ms: Some(1.0),
            inputs: vec![InputRecord { file: "inputs/s.toml".to_owned(), sha256: input.to_owned() }],
            expectations: Vec::new(),
            not_applicable: Vec::new(),
            requirement_texts: std::collections::BTreeMap::new(),
            time_limit_s: None,
            planned_trials: None,
            trials: worst.iter().enumerate().map(trial).collect(),
        }
    }

    fn record(build: &str, second: u32, scenarios: Vec<ScenarioRecord>) -> RunRecord {
        let firmware = Firmware {
            name: "own".to_owned(),
            version: "1.0.0".to_owned(),
            build: build.to_owned(),
            chip: String::new(),
        };
        RunRecord {
            format: FORMAT,
            sequence: 0,
            verdict: Verdict::Pass,
            complete: true,
            tool: Tool { name: "platebench".to_owned(), version: "0.1.0".to_owned(), ..Tool::default() },
            started: format!("2026-01-01T00:00:{second:02}Z"),
            rig: RigRecord {
                name: format!("emulated:{build}.elf"),
                firmware: Some(firmware),
                program_sha256: None,
                bench_firmware: false,
            },
            clock: ClockKind::Lockstep,
            overrides: Overrides::default(),
            safe_confirmed: None,
            drive_after_safe: false,
            wall_ms: None,
            host: Host { os: String::new(), arch: String::new(), ..Host::default() },
            scenarios,
            not_applicable: Vec::new(),
            cost: Vec::new(),
            merge: None,
            journal: None,
        }
    }

    /// Folder with the earlier runs and the present run `now`.
    struct RunsFolder(TempDir);

    impl RunsFolder {
        fn new(earlier: &[(&str, RunRecord)]) -> Self {
            let runs = Self(tempfile::tempdir().unwrap());
            for (name, record) in earlier {
                let folder = runs.folder(name);
                fs::create_dir(&folder).unwrap();
                record.write(&folder).unwrap();
            }
            fs::create_dir(runs.folder("now")).unwrap();
            runs
        }

        fn folder(&self, name: &str) -> PathBuf {
            self.0.path().join(name)
        }

        fn cost(&self, record: &RunRecord) -> Vec<CostTrend> {
            record.write(&self.folder("now")).unwrap();
            cost_trends(record, &self.folder("now"))
        }
    }

    #[test]
    fn names_the_build_in_which_a_step_was_shorter() {
        let runs = RunsFolder::new(&[
            ("a", record("old", 1, vec![scenario("dq-pi", "1", &[1_000.0])])),
            ("b", record("new", 2, vec![scenario("dq-pi", "1", &[1_300.0])])),
        ]);
        let trends = runs.cost(&record("new", 3, vec![scenario("dq-pi", "1", &[1_300.0])]));
        let [trend] = &trends[..] else { panic!("{trends:?}") };
        assert_eq!((trend.law.as_str(), trend.build.as_str()), ("dq-pi", "new"));
        assert_eq!(trend.cost, StepCost { mean: 1_170.0, worst: 1_300.0 });
        let names: Vec<_> = trend.earlier.iter().map(|earlier| earlier.run.as_deref()).collect();
        assert_eq!(names, [Some("b"), Some("a")], "the newest first, and not the run itself");
        let change = trend.significant_change().unwrap();
        assert_eq!((change.statistic, change.now, change.then), ("worst", 1_300.0, 1_000.0));
        assert_eq!(change.earlier.build, "old");
    }

    #[test]
    fn compares_equal_trials_only() {
        let earlier = vec![
            scenario("dq-pi", "1", &[1_000.0, 2_000.0]),
            scenario("open-loop", "1", &[500.0]),
            scenario("dq-pi", "changed since", &[9_000.0]),
        ];
        let runs = RunsFolder::new(&[("a", record("old", 1, earlier))]);
        let now = vec![
            scenario("dq-pi", "1", &[1_010.0]),
            scenario("dq-pi", "2", &[4_000.0]),
            scenario("dq-pi-euler", "1", &[7_000.0]),
        ];
        let trends = runs.cost(&record("new", 2, now));
        let laws: Vec<_> = trends.iter().map(|trend| (trend.law.as_str(), trend.cost.worst)).collect();
        assert_eq!(laws, [("dq-pi", 4_000.0), ("dq-pi-euler", 7_000.0)]);
        let [earlier] = &trends[0].earlier[..] else { panic!("{trends:?}") };
        assert_eq!((earlier.trials, earlier.then.worst, earlier.now.worst), (1, 1_000.0, 1_010.0));
        assert_eq!(trends[0].significant_change(), None, "a percent is not worth a word");
        assert_eq!(trends[1].earlier, [], "another law is another matter");
    }

    #[test]
    fn ignores_other_firmware_rigs_and_damaged_records() {
        let played = || vec![scenario("dq-pi", "1", &[1_000.0])];
        let mut hosted = record("x", 1, played());
        hosted.rig.name = "serial:/dev/ttyUSB0".to_owned();
        let mut other = record("x", 1, played());
        other.rig.firmware.as_mut().unwrap().name = "other".to_owned();
        let runs = RunsFolder::new(&[("hosted", hosted), ("other", other), ("damaged", record("x", 1, played()))]);
        fs::write(runs.folder("damaged").join(RECORD_FILE), "{ \"format\": 1, \"started\": \"2026\" }").unwrap();
        fs::create_dir(runs.folder("no-run")).unwrap();
        fs::write(runs.folder("no-folder"), "").unwrap();
        let trends = runs.cost(&record("new", 2, played()));
        assert_eq!(trends[0].earlier, []);
        assert_eq!(runs.cost(&record("new", 2, vec![scenario("dq-pi", "1", &[])])), [], "nothing was counted");
    }

    #[test]
    fn ignores_runs_and_trials_that_ended_early() {
        let played = |worst| vec![scenario("dq-pi", "1", &[worst])];
        let aborted = RunRecord { complete: false, ..record("old", 1, played(90.0)) };
        let changed = |change: fn(&mut TrialRecord)| {
            let mut changed = record("old", 1, played(90.0));
            change(&mut changed.scenarios[0].trials[0]);
            changed
        };
        let crashed = changed(|trial| trial.telemetry.ended = Some("the firmware trapped: HardFault".to_owned()));
        let excluded = changed(|trial| trial.cause = Some(Cause::Rig));
        let stopped = changed(|trial| trial.telemetry.stopped = Some("too many rejected frames".to_owned()));
        let runs = RunsFolder::new(&[
            ("aborted", aborted),
            ("crashed", crashed),
            ("excluded", excluded),
            ("stopped", stopped),
        ]);
        let trends = runs.cost(&record("new", 2, played(4_000.0)));
        assert_eq!((trends[0].cost.worst, &trends[0].earlier[..]), (4_000.0, &[][..]));

        let runs = RunsFolder::new(&[("whole", record("old", 1, played(4_000.0)))]);
        let mut now = record("new", 2, played(90.0));
        now.scenarios[0].trials[0].telemetry.ended = Some("the firmware trapped: HardFault".to_owned());
        let trends = runs.cost(&now);
        assert_eq!((trends[0].cost.worst, &trends[0].earlier[..]), (90.0, &[][..]), "this run ended early");
    }

    #[test]
    fn reads_the_twenty_newest_runs() {
        let earlier: Vec<_> =
            (0..22).map(|second| record("old", second, vec![scenario("dq-pi", "1", &[1e3])])).collect();
        let names: Vec<String> = (0..22).map(|second| format!("run-{}", 99 - second)).collect();
        let named: Vec<_> = names.iter().map(String::as_str).zip(earlier).collect();
        let trends = RunsFolder::new(&named).cost(&record("new", 30, vec![scenario("dq-pi", "1", &[1e3])]));
        let started: Vec<_> = trends[0].earlier.iter().filter_map(|earlier| earlier.started.clone()).collect();
        assert_eq!(started.len(), 20);
        assert_eq!((started[0].as_str(), started[19].as_str()), ("2026-01-01T00:00:21Z", "2026-01-01T00:00:02Z"));
    }

    #[test]
    fn compares_no_trials_at_different_baud_rates() {
        let mut slow = scenario("dq-pi", "1", &[2_000.0]);
        slow.trials[0].telemetry.baud = Some(115_200);
        let runs = RunsFolder::new(&[
            ("a", record("old", 1, vec![scenario("dq-pi", "1", &[1_000.0])])),
            ("b", record("older", 0, vec![slow.clone()])),
        ]);
        let trends = runs.cost(&record("new", 2, vec![slow]));
        let names: Vec<_> = trends[0].earlier.iter().map(|earlier| earlier.run.as_deref()).collect();
        assert_eq!(names, [Some("b")]);
    }

    #[test]
    fn reference_comes_last_and_for_its_firmware_only() {
        let played = || scenario("dq-pi", "1", &[2_000.0]);
        let reference = |firmware: &str| Reference {
            firmware: firmware.to_owned(),
            build: "shipped".to_owned(),
            baud: BAUD,
            trial: vec![ReferenceTrial {
                law: "dq-pi".to_owned(),
                inputs: played().inputs_digest(),
                seed: 1,
                mean: 900.0,
                worst: 1_000.0,
            }],
        };
        let now = record("new", 2, vec![played()]);
        let earlier = || vec![earlier_run(("a".to_owned(), record("new", 1, vec![played()])))];
        let trends = compare_costs(&now, earlier(), Some(reference("own")));
        let builds: Vec<_> = trends[0].earlier.iter().map(|earlier| earlier.build.as_str()).collect();
        assert_eq!(builds, ["new", "shipped"]);
        let change = trends[0].significant_change().unwrap();
        assert_eq!((change.percent, change.earlier.run.as_ref()), (100.0, None));

        assert_eq!(compare_costs(&now, earlier(), Some(reference("other")))[0].earlier.len(), 1);
        let mut on_a_board = now.clone();
        on_a_board.rig.name = "probe:STM32F407VG".to_owned();
        assert_eq!(compare_costs(&on_a_board, earlier(), Some(reference("own")))[0].earlier.len(), 1);
    }

    #[test]
    fn reference_is_readable() {
        let reference = load_reference().unwrap();
        assert!(reference.trial.len() >= 30, "{} trials", reference.trial.len());
    }
}
