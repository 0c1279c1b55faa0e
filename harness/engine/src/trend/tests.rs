use super::*;
use platebench_model::record::{
    Cause, ClockKind, FORMAT, Firmware, Host, InputRecord, Overrides, RECORD_FILE, Telemetry, Tool, Verdict,
};
use std::fs;
use std::path::PathBuf;
use tempfile::TempDir;

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
            ..Telemetry::default()
        },
        cause: None,
        reason: None,
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
        requirement_texts: std::collections::BTreeMap::new(),
        trials: worst.iter().enumerate().map(trial).collect(),
    }
}

fn record(build: &str, second: u32, scenarios: Vec<ScenarioRecord>) -> RunRecord {
    let firmware =
        Firmware { name: "own".to_owned(), version: "1.0.0".to_owned(), build: build.to_owned(), chip: String::new() };
    RunRecord {
        format: FORMAT,
        verdict: Verdict::Pass,
        complete: true,
        tool: Tool { name: "platebench".to_owned(), version: "0.1.0".to_owned(), ..Tool::default() },
        started: format!("2026-01-01T00:00:{second:02}Z"),
        rig: RigRecord { name: format!("emulated:{build}.elf"), firmware: Some(firmware) },
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
    let runs =
        RunsFolder::new(&[("aborted", aborted), ("crashed", crashed), ("excluded", excluded), ("stopped", stopped)]);
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
    let earlier: Vec<_> = (0..22).map(|second| record("old", second, vec![scenario("dq-pi", "1", &[1e3])])).collect();
    let names: Vec<String> = (0..22).map(|second| format!("run-{}", 99 - second)).collect();
    let named: Vec<_> = names.iter().map(String::as_str).zip(earlier).collect();
    let trends = RunsFolder::new(&named).cost(&record("new", 30, vec![scenario("dq-pi", "1", &[1e3])]));
    let started: Vec<_> = trends[0].earlier.iter().filter_map(|earlier| earlier.started.clone()).collect();
    assert_eq!(started.len(), 20);
    assert_eq!((started[0].as_str(), started[19].as_str()), ("2026-01-01T00:00:21Z", "2026-01-01T00:00:02Z"));
}

#[test]
fn reference_comes_last_and_for_its_firmware_only() {
    let played = || scenario("dq-pi", "1", &[2_000.0]);
    let reference = |firmware: &str| Reference {
        firmware: firmware.to_owned(),
        build: "shipped".to_owned(),
        trial: vec![ReferenceTrial {
            law: "dq-pi".to_owned(),
            inputs: inputs_digest(&played()),
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
