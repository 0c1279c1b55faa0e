use super::*;
use crate::metrics::{Metric, SignalPoint};
use crate::record::reason::{Evidence, EvidenceMethod, MetricDefinition, Statistic, WorstInstant};
use crate::record::reason::{Reason, TrialReason};
use crate::record::run_folder::{RECORD_FILE, RecordError, RunSummary};
use crate::record::run_record::Firmware;
use crate::record::trial_record::Telemetry;
use crate::record::verdict::Exclusion;
use crate::scenario::Limit;
use rstest::rstest;
use serde_json::json;
use std::fs;
use tempfile::TempDir;

#[test]
fn combines_verdicts() {
    use Verdict::{Fail, Inconclusive, Pass};
    assert_eq!(Verdict::combine([Pass, Pass]), Pass);
    assert_eq!(Verdict::combine([Pass, Inconclusive]), Inconclusive);
    assert_eq!(Verdict::combine([Inconclusive, Pass]), Inconclusive);
    assert_eq!(Verdict::combine([Inconclusive, Fail, Pass]), Fail);
    assert_eq!(Verdict::combine([Fail, Inconclusive]), Fail);
    assert_eq!(Verdict::combine([]), Inconclusive);
}

#[expect(clippy::too_many_lines, reason = "one value of every field")]
pub(crate) fn record() -> RunRecord {
    let passed = ExpectationRecord {
        name: "settling".to_owned(),
        worst: Some(WorstInstant {
            trial: 0,
            window_ms: [0.0, 60.0],
            points: vec![SignalPoint { t_ms: 1.5, value: 1.9 }],
        }),
        windows_ms: vec![[0.0, 60.0]],
        metric: Metric::SettlingTime,
        verdict: Verdict::Pass,
        value: Some(1.93),
        statistic: Statistic::Worst,
        limit: Limit::AtMost(2.0),
        bench_error: None,
        margin: Some(0.025),
        interval: Some([1.9, 1.96]),
        confidence: Some(0.95),
        cause: None,
        reason: None,
        paper: Some(2.0),
        requirement: Some("ACC-1".to_owned()),
        definition: MetricDefinition {
            from_ms: Some(20.0),
            band_percent: Some(1.0),
            signal: Some("amplitude_um".to_owned()),
            text: None,
        },
        evidence: Evidence {
            method: Some(EvidenceMethod::ClopperPearson),
            failure_rate: Some([0.0, 0.095]),
            quantile: Some(0.95),
            power: Some(0.99),
            look: Some([2, 4]),
            says: Some("30 trials without a failure".to_owned()),
            observed: None,
        },
    };
    let lost = ExpectationRecord {
        verdict: Verdict::Inconclusive,
        value: None,
        interval: None,
        confidence: None,
        cause: Some(Cause::Rig),
        reason: Some(Reason::Excluded { trial: 0, exclusion: Exclusion::NoAnswer { at_ms: 3.0 } }),
        limit: Limit::Within(1.0, 2.0),
        worst: None,
        margin: None,
        paper: None,
        requirement: None,
        definition: MetricDefinition::default(),
        evidence: Evidence::default(),
        ..passed.clone()
    };
    let metrics = json!({ "settling_time_ms": 1.93, "settling_time_ms[2]": null });
    let trial = TrialRecord {
        index: 0,
        seed: u64::MAX,
        trace: "traces/paper/fig13-closed-loop/000.csv".to_owned(),
        metrics: serde_json::from_value(metrics).unwrap(),
        cause: Some(Cause::Bench),
        reason: Some(TrialReason::Excluded(Exclusion::LateBench { count: 1, first_ms: 3.0 })),
        sha256: None,
        telemetry: Telemetry::default(),
        symptom: None,
        diverged_at_s: None,
        wall_ms: Some(12.5),
    };
    RunRecord {
        format: FORMAT,
        sequence: 7,
        verdict: Verdict::Inconclusive,
        complete: true,
        tool: Tool { name: "platebench".to_owned(), version: "0.1.0".to_owned(), ..Tool::default() },
        started: "2025-01-02T03:04:05Z".to_owned(),
        rig: RigRecord {
            name: "hosted".to_owned(),
            firmware: Some(Firmware {
                name: "dq".to_owned(),
                version: "0.1.0".to_owned(),
                build: "0123abcd".to_owned(),
                chip: "00000000".to_owned(),
            }),
            program_sha256: None,
            bench_firmware: false,
        },
        clock: ClockKind::Lockstep,
        overrides: Overrides { law: None, trials: Some(1), ..Overrides::default() },
        safe_confirmed: None,
        drive_after_safe: false,
        wall_ms: Some(12.5),
        host: Host { os: "linux".to_owned(), arch: "x86_64".to_owned(), ..Host::default() },
        scenarios: vec![ScenarioRecord {
            file: "paper/fig13-closed-loop.toml".to_owned(),
            title: "At resonance".to_owned(),
            source: Some("Fig. 13".to_owned()),
            tags: Vec::new(),
            verdict: Verdict::Inconclusive,
            law: "dq-pi".to_owned(),
            model: "modal".to_owned(),
            period_ms: Some(1.0),
            inputs: vec![InputRecord { file: "inputs/0.toml".to_owned(), sha256: "00ff".to_owned() }],
            expectations: vec![passed, lost],
            not_applicable: Vec::new(),
            requirement_texts: std::collections::BTreeMap::new(),
            time_limit_s: None,
            planned_trials: Some(1),
            trials: vec![trial],
        }],
        not_applicable: Vec::new(),
        cost: Vec::new(),
        merge: None,
        journal: None,
    }
}

fn write_record() -> (TempDir, String) {
    let folder = TempDir::new().unwrap();
    record().write(folder.path()).unwrap();
    let text = fs::read_to_string(folder.path().join(RECORD_FILE)).unwrap();
    (folder, text)
}

#[test]
fn writes_the_documented_layout() {
    insta::assert_snapshot!("layout", write_record().1);
}

#[test]
fn round_trips_and_leaves_no_other_file() {
    let (folder, _) = write_record();
    assert_eq!(RunRecord::read(folder.path()).unwrap(), record());
    let again = RunRecord { complete: false, ..record() };
    again.write(folder.path()).unwrap();
    assert_eq!(RunRecord::read(folder.path()).unwrap(), again);
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
}

#[test]
fn finds_earlier_runs_in_neighbouring_folders() {
    let runs = TempDir::new().unwrap();
    let started = |name: &str, sequence: u64, second: u32| {
        let folder = runs.path().join(name);
        fs::create_dir(&folder).unwrap();
        let record = RunRecord { sequence, started: format!("2026-01-01T00:00:{second:02}Z"), ..record() };
        record.write(&folder).unwrap();
        (folder, record)
    };
    // The clock was set back between two runs.
    started("before", 6, 9);
    started("old-format", 0, 9);
    started("after", 8, 6);
    started("at-once", 7, 7);
    let (own, record) = started("own", 7, 7);
    fs::create_dir(runs.path().join("damaged")).unwrap();
    fs::write(runs.path().join("damaged").join(RECORD_FILE), "{}").unwrap();
    let skipped = std::cell::RefCell::new(Vec::new());
    // The start of this record is valid, so the rest is read too, and is rejected.
    let cut = RunRecord { sequence: 5, started: "2026-01-01T00:00:05Z".to_owned(), ..record.clone() };
    fs::create_dir(runs.path().join("cut")).unwrap();
    let text = serde_json::to_string_pretty(&cut).unwrap();
    fs::write(runs.path().join("cut").join(RECORD_FILE), &text[..text.len() / 2]).unwrap();
    let skip = |path: &Path, _: &_| skipped.borrow_mut().push(path.file_name().unwrap().to_owned());
    let earlier: Vec<(String, RunSummary)> = record.earlier_runs(&own, skip);
    assert_eq!(earlier.iter().map(|(name, _)| name.as_str()).collect::<Vec<_>>(), ["at-once", "before", "old-format"]);
    assert_eq!(skipped.into_inner(), ["damaged", "cut"]);
}

#[test]
fn passes_only_a_complete_run_at_0_v() {
    let verdict = |complete, safe_confirmed, of_scenario| {
        let mut record = RunRecord { complete, safe_confirmed, ..record() };
        record.scenarios.iter_mut().for_each(|scenario| scenario.verdict = of_scenario);
        record.update_verdict();
        record.verdict
    };
    assert_eq!(verdict(true, Some(true), Verdict::Pass), Verdict::Pass);
    assert_eq!(verdict(true, None, Verdict::Pass), Verdict::Pass);
    assert_eq!(verdict(true, Some(false), Verdict::Pass), Verdict::Inconclusive);
    assert_eq!(verdict(false, None, Verdict::Pass), Verdict::Inconclusive);
    assert_eq!(verdict(false, None, Verdict::Fail), Verdict::Fail);
}

#[test]
fn a_missing_trace_leaves_nothing_passed() {
    let folder = TempDir::new().unwrap();
    let mut record = RunRecord { safe_confirmed: Some(true), ..record() };
    record.scenarios[0].expectations.truncate(1);
    record.scenarios[0].verdict = Verdict::Pass;
    record.scenarios[0].trials[0].sha256 = Some("00".to_owned());
    let path = folder.path().join(&record.scenarios[0].trials[0].trace);
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    fs::write(&path, "").unwrap();
    record.discount_missing_traces(folder.path());
    assert_eq!(record.verdict, Verdict::Pass);
    fs::remove_file(&path).unwrap();
    record.discount_missing_traces(folder.path());
    assert_eq!((record.verdict, record.scenarios[0].verdict), (Verdict::Inconclusive, Verdict::Inconclusive));
    let reason = record.scenarios[0].expectations[0].reason.as_ref().unwrap().to_string();
    assert_eq!(reason, "trial 0: its trace is missing");
}

#[test]
fn detects_a_controller_that_the_rig_lost() {
    let lost = |cause, ended: Option<&str>| {
        let mut record = record();
        for trial in record.scenarios.iter_mut().flat_map(|scenario| &mut scenario.trials) {
            trial.cause = None;
            trial.telemetry.ended = None;
        }
        let last = record.scenarios.last_mut().and_then(|scenario| scenario.trials.last_mut()).unwrap();
        last.cause = cause;
        last.telemetry.ended = ended.map(str::to_owned);
        record.has_lost_controller()
    };
    assert!(lost(Some(Cause::Rig), Some("unplugged")));
    assert!(!lost(Some(Cause::Rig), None), "one missed reply");
    assert!(!lost(None, Some("trapped")), "a trap is the controller's failure");
    assert!(!lost(Some(Cause::Bench), Some("too late")));
}

#[rstest]
#[case("../outside.toml", "inputs/a.toml", "traces/a/000.csv", "scenario `../outside.toml`")]
#[case("a.toml", "/etc/passwd", "traces/a/000.csv", "input `/etc/passwd`")]
#[case("a.toml", "inputs/a.toml", "traces/../../a.csv", "trace `traces/../../a.csv`")]
fn rejects_a_path_that_leaves_the_run_folder(
    #[case] file: &str,
    #[case] input: &str,
    #[case] trace: &str,
    #[case] expected: &str,
) {
    let mut record = record();
    let scenario = &mut record.scenarios[0];
    file.clone_into(&mut scenario.file);
    input.clone_into(&mut scenario.inputs[0].file);
    trace.clone_into(&mut scenario.trials[0].trace);
    let folder = TempDir::new().unwrap();
    record.write(folder.path()).unwrap();
    let error = RunRecord::read(folder.path()).unwrap_err().to_string();
    assert!(error.ends_with(&format!("{expected}, expected a path below the run folder")), "{error}");
}

#[test]
fn does_not_read_a_device() {
    for link in ["/dev/zero", "/dev"] {
        let folder = TempDir::new().unwrap();
        std::os::unix::fs::symlink(link, folder.path().join(RECORD_FILE)).unwrap();
        assert!(matches!(RunRecord::read(folder.path()), Err(RecordError::File(_))), "{link}");
    }
}

fn read_error(text: &str) -> RecordError {
    let folder = TempDir::new().unwrap();
    fs::write(folder.path().join(RECORD_FILE), text).unwrap();
    RunRecord::read(folder.path()).unwrap_err()
}

#[test]
fn rejects_another_format() {
    assert!(matches!(read_error(r#"{"format": 2, "something": "else"}"#), RecordError::Format { found: 2, .. }));
    assert!(read_error(r#"{"format": 0}"#).to_string().ends_with("run.json: the record has format 0, expected 1"));
    assert!(matches!(read_error(r#"{"verdict": "pass"}"#), RecordError::Content { .. }));
    assert!(matches!(read_error(r#"{"format": -1}"#), RecordError::Content { .. }));
}

#[test]
fn rejects_a_truncated_record() {
    let (_, text) = write_record();
    for end in (0..text.trim_end().len()).step_by(23) {
        assert!(matches!(read_error(&text[..end]), RecordError::Content { .. }), "cut at {end}");
    }
    let nowhere = TempDir::new().unwrap();
    assert!(matches!(RunRecord::read(nowhere.path()), Err(RecordError::File(_))));
}

#[test]
fn rejects_an_unknown_verdict_with_its_position() {
    let (_, text) = write_record();
    let error = read_error(&text.replacen("inconclusive", "passed", 1)).to_string();
    assert!(error.contains("run.json:4:"), "{error}");
}

#[test]
fn arguments_of_a_program_belong_to_the_controller() {
    let rig = |name: &str| RigRecord { name: name.to_owned(), program_sha256: Some("00".to_owned()), ..record().rig };
    let first = rig("exec:./c {port} --law=1");
    assert!(first.has_same_controller(&rig("exec: /opt/c  {port} --law=1")));
    assert!(!first.has_same_controller(&rig("exec:./c {port} --law=2")));
    assert!(rig("emulated:a b.elf").has_same_controller(&rig("emulated:a c.elf")), "the same image");
}
