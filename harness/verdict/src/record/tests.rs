use super::*;
use serde_json::json;
use std::fs;
use tempfile::TempDir;

#[test]
fn one_failure_fails_all_and_nothing_is_no_pass() {
    use Verdict::{Fail, Inconclusive, Pass};
    assert_eq!(Verdict::over([Pass, Pass]), Pass);
    assert_eq!(Verdict::over([Pass, Inconclusive]), Inconclusive);
    assert_eq!(Verdict::over([Inconclusive, Pass]), Inconclusive);
    assert_eq!(Verdict::over([Inconclusive, Fail, Pass]), Fail);
    assert_eq!(Verdict::over([Fail, Inconclusive]), Fail);
    assert_eq!(Verdict::over([]), Inconclusive);
}

fn map(value: &Value) -> Map<String, Value> {
    value.as_object().unwrap().clone()
}

/// A record with something in every field.
fn record() -> RunRecord {
    let passed = ExpectationRecord {
        metric: "settling_time_ms".to_owned(),
        verdict: Verdict::Pass,
        value: Some(1.93),
        statistic: "worst".to_owned(),
        limit: map(&json!({ "at_most": 2.0 })),
        interval: Some([1.9, 1.96]),
        confidence: Some(0.95),
        cause: None,
        reason: None,
        paper: Some(2.0),
        requirement: Some("ACC-1".to_owned()),
        definition: Definition {
            from_ms: Some(20.0),
            band_percent: Some(1.0),
            signal: Some("amplitude_um".to_owned()),
        },
        evidence: Evidence {
            method: Some("clopper-pearson".to_owned()),
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
        reason: Some("trial 0: no answer at 3 ms".to_owned()),
        limit: map(&json!({ "within": [1.0, 2.0] })),
        paper: None,
        requirement: None,
        definition: Definition::default(),
        evidence: Evidence::default(),
        ..passed.clone()
    };
    let trial = TrialRecord {
        index: 0,
        seed: u64::MAX,
        trace: "traces/paper/fig13-closed-loop/000.csv".to_owned(),
        metrics: map(&json!({ "settling_time_ms": 1.93, "settling_time_ms[2]": null })),
        cause: Some(Cause::Bench),
        reason: Some("the bench was too late at 3 ms".to_owned()),
        sha256: None,
        telemetry: Telemetry::default(),
        diverged_at_s: None,
        wall_ms: Some(12.5),
    };
    RunRecord {
        format: FORMAT,
        verdict: Verdict::Inconclusive,
        complete: true,
        tool: Tool { name: "platebench".to_owned(), version: "0.1.0".to_owned() },
        started: "2025-01-02T03:04:05Z".to_owned(),
        rig: RigRecord {
            name: "hosted".to_owned(),
            firmware: Some(Firmware {
                name: "dq".to_owned(),
                version: "0.1.0".to_owned(),
                build: "0123abcd".to_owned(),
                chip: "00000000".to_owned(),
            }),
        },
        clock: "lockstep".to_owned(),
        overrides: Overrides { law: None, trials: Some(1), seed: None, model: None },
        safe_confirmed: None,
        host: Host { os: "linux".to_owned(), arch: "x86_64".to_owned() },
        scenarios: vec![ScenarioRecord {
            file: "paper/fig13-closed-loop.toml".to_owned(),
            title: "At resonance".to_owned(),
            source: Some("Fig. 13".to_owned()),
            verdict: Verdict::Inconclusive,
            law: "dq-pi".to_owned(),
            model: "modal".to_owned(),
            model_choice: None,
            inputs: vec![InputRecord { file: "inputs/0.toml".to_owned(), sha256: "00ff".to_owned() }],
            expectations: vec![passed, lost],
            trials: vec![trial],
        }],
        cost: Vec::new(),
    }
}

fn written() -> (TempDir, String) {
    let folder = TempDir::new().unwrap();
    record().write(folder.path()).unwrap();
    let text = fs::read_to_string(folder.path().join(FILE)).unwrap();
    (folder, text)
}

#[test]
fn the_layout_is_the_documented_one() {
    insta::assert_snapshot!("layout", written().1);
}

#[test]
fn a_record_comes_back_as_it_was_and_leaves_nothing_beside_it() {
    let (folder, _) = written();
    assert_eq!(RunRecord::read(folder.path()).unwrap(), record());
    let again = RunRecord { complete: false, ..record() };
    again.write(folder.path()).unwrap();
    assert_eq!(RunRecord::read(folder.path()).unwrap(), again);
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
}

#[test]
fn earlier_is_what_did_not_start_later_and_lies_beside_it() {
    let runs = TempDir::new().unwrap();
    let started = |name: &str, second: u32| {
        let folder = runs.path().join(name);
        fs::create_dir(&folder).unwrap();
        let record = RunRecord { started: format!("2026-01-01T00:00:{second:02}Z"), ..record() };
        record.write(&folder).unwrap();
        (folder, record)
    };
    started("before", 6);
    started("after", 8);
    started("at-once", 7);
    let (own, record) = started("own", 7);
    fs::create_dir(runs.path().join("damaged")).unwrap();
    fs::write(runs.path().join("damaged").join(FILE), "{}").unwrap();
    let refused = std::cell::RefCell::new(Vec::new());
    let earlier = record.earlier(&own, |path, _| refused.borrow_mut().push(path.file_name().unwrap().to_owned()));
    assert_eq!(earlier.iter().map(|(name, _)| name.as_str()).collect::<Vec<_>>(), ["at-once", "before"]);
    assert_eq!(refused.into_inner(), ["damaged"]);
}

#[test]
fn only_a_run_that_came_to_its_end_at_0_v_passes() {
    let verdict = |complete, safe_confirmed, of_scenario| {
        let mut record = RunRecord { complete, safe_confirmed, ..record() };
        record.scenarios.iter_mut().for_each(|scenario| scenario.verdict = of_scenario);
        record.decide();
        record.verdict
    };
    assert_eq!(verdict(true, Some(true), Verdict::Pass), Verdict::Pass);
    // Records of a bench that did not ask.
    assert_eq!(verdict(true, None, Verdict::Pass), Verdict::Pass);
    assert_eq!(verdict(true, Some(false), Verdict::Pass), Verdict::Inconclusive);
    assert_eq!(verdict(false, None, Verdict::Pass), Verdict::Inconclusive);
    assert_eq!(verdict(false, None, Verdict::Fail), Verdict::Fail);
}

#[test]
fn a_controller_is_lost_where_a_trial_ended_for_the_sake_of_its_rig() {
    let lost = |cause, ended: Option<&str>| {
        let mut record = record();
        for trial in record.scenarios.iter_mut().flat_map(|scenario| &mut scenario.trials) {
            trial.cause = None;
            trial.telemetry.ended = None;
        }
        let last = record.scenarios.last_mut().and_then(|scenario| scenario.trials.last_mut()).unwrap();
        last.cause = cause;
        last.telemetry.ended = ended.map(str::to_owned);
        record.lost_a_controller()
    };
    assert!(lost(Some(Cause::Rig), Some("unplugged")));
    assert!(!lost(Some(Cause::Rig), None), "a reply that was missed is not a controller that is gone");
    assert!(!lost(None, Some("trapped")), "a trap is the controller's own doing");
    assert!(!lost(Some(Cause::Bench), Some("too late")));
}

fn refusal(text: &str) -> RecordError {
    let folder = TempDir::new().unwrap();
    fs::write(folder.path().join(FILE), text).unwrap();
    RunRecord::read(folder.path()).unwrap_err()
}

#[test]
fn another_format_is_refused_whatever_else_is_in_it() {
    assert!(matches!(refusal(r#"{"format": 2, "something": "else"}"#), RecordError::Format { found: 2, .. }));
    assert!(refusal(r#"{"format": 0}"#).to_string().ends_with("run.json: format 0, expected 1"));
    assert!(matches!(refusal(r#"{"verdict": "pass"}"#), RecordError::Content { .. }));
    assert!(matches!(refusal(r#"{"format": -1}"#), RecordError::Content { .. }));
}

#[test]
fn a_half_written_record_is_an_error_wherever_it_ends() {
    let (_, text) = written();
    for end in (0..text.trim_end().len()).step_by(23) {
        assert!(matches!(refusal(&text[..end]), RecordError::Content { .. }), "cut at {end}");
    }
    let nowhere = TempDir::new().unwrap();
    assert!(matches!(RunRecord::read(nowhere.path()), Err(RecordError::Io { .. })));
}

#[test]
fn a_verdict_that_is_none_is_refused_with_its_place() {
    let (_, text) = written();
    let error = refusal(&text.replacen("inconclusive", "passed", 1)).to_string();
    assert!(error.contains("run.json:3:"), "{error}");
}
