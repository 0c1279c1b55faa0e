//! Makes records and traces for the tests of all reports.

use platebench_model::record::{
    BestResponse, Cause, ClockKind, CostTrend, EarlierCost, Evidence, Exclusion, Excuse, ExpectationRecord, FORMAT,
    Firmware, Host, InputRecord, Limit, Metric, MetricDefinition, MetricValues, MissingValue, NotApplicable, Overrides,
    Reason, RigRecord, RunRecord, ScenarioRecord, Statistic, StepCost, Telemetry, TightestStep, Tool, TrialFinding,
    TrialReason, TrialRecord, Verdict,
};
use platebench_model::scenario::expect::SIGNALS;
use platebench_model::scenario::{Expectation, Window};
use platebench_model::trace::read_trace;
use platebench_plate::Time;
use platebench_verdict::golden::{Baseline, BaselineBuild, GoldenTubes, JudgedResponse, judged_values};
use platebench_verdict::metrics::measure_with_instants;
use serde_json::{Value, json};
use std::path::Path;

pub(crate) use crate::response::Response;

pub(crate) fn run(scenarios: Vec<ScenarioRecord>) -> RunRecord {
    RunRecord {
        format: FORMAT,
        sequence: 0,
        verdict: Verdict::combine(scenarios.iter().map(|scenario| scenario.verdict)),
        complete: true,
        tool: Tool { name: "platebench".to_owned(), version: "0.1.0".to_owned(), ..Tool::default() },
        started: "2026-03-02T09:30:00Z".to_owned(),
        rig: RigRecord {
            name: "hosted".to_owned(),
            firmware: Some(Firmware {
                name: "dq-pi".to_owned(),
                version: "0.1.0".to_owned(),
                build: "5f3a9c01".to_owned(),
                chip: "0".to_owned(),
            }),
            program_sha256: None,
            bench_firmware: false,
        },
        clock: ClockKind::Lockstep,
        overrides: Overrides { seed: Some(7), ..Overrides::default() },
        safe_confirmed: Some(true),
        drive_after_safe: false,
        wall_ms: Some(2_500.0),
        host: Host { os: "linux".to_owned(), arch: "x86_64".to_owned(), ..Host::default() },
        scenarios,
        not_applicable: Vec::new(),
        cost: Vec::new(),
        merge: None,
        journal: None,
    }
}

pub(crate) fn scenario(file: &str, title: &str, law: &str, expectations: Vec<ExpectationRecord>) -> ScenarioRecord {
    let input = |file: String, digit: &str| InputRecord { file, sha256: digit.repeat(64) };
    ScenarioRecord {
        file: file.to_owned(),
        title: title.to_owned(),
        source: Some("Fig. 13".to_owned()),
        tags: Vec::new(),
        verdict: Verdict::combine(expectations.iter().map(|expectation| expectation.verdict)),
        law: law.to_owned(),
        model: "modal".to_owned(),
        period_ms: Some(1.0),
        inputs: vec![
            input(format!("inputs/{file}"), "3"),
            input("inputs/plates/aluminium-198x138.toml".to_owned(), "a"),
        ],
        expectations: with_default_names(expectations),
        not_applicable: Vec::new(),
        requirement_texts: std::collections::BTreeMap::new(),
        time_limit_s: None,
        planned_trials: None,
        trials: Vec::new(),
    }
}

/// Names expectations as the scenario reader does: the metric, `metric 2`, `metric 3`.
fn with_default_names(mut expectations: Vec<ExpectationRecord>) -> Vec<ExpectationRecord> {
    for index in 0..expectations.len() {
        let metric = expectations[index].metric;
        let number = expectations[..=index].iter().filter(|other| other.metric == metric).count();
        expectations[index].name = if number == 1 { metric.to_string() } else { format!("{metric} {number}") };
    }
    expectations
}

#[allow(clippy::needless_pass_by_value, reason = "short calls")]
pub(crate) fn passed_expectation(metric: &str, limit: (&str, Value), value: f64) -> ExpectationRecord {
    let limit: Limit = serde_json::from_value(json!({ limit.0: limit.1 })).unwrap();
    ExpectationRecord {
        name: String::new(),
        windows_ms: vec![[0.0, 60.0]],
        worst: None,
        metric: Metric::from_name(metric).unwrap(),
        verdict: Verdict::Pass,
        value: Some(value),
        statistic: Statistic::Worst,
        limit,
        margin: Some(limit.margin(value, 10.0)),
        bench_error: Some(3e-7),
        interval: Some([value * 0.98, value]),
        confidence: None,
        cause: None,
        reason: None,
        paper: None,
        requirement: None,
        definition: if metric == "settling_time_ms" {
            settling_definition(5.0, "amplitude_um")
        } else {
            MetricDefinition::default()
        },
        evidence: Evidence::default(),
    }
}

pub(crate) fn settling_definition(band_percent: f64, signal: &str) -> MetricDefinition {
    MetricDefinition { from_ms: None, band_percent: Some(band_percent), signal: Some(signal.to_owned()), text: None }
}

pub(crate) fn closed_loop() -> ScenarioRecord {
    let settling = passed_expectation("settling_time_ms", ("at_most", json!(2.0)), 1.949);
    scenario("paper/fig13-closed-loop.toml", "Closed loop", "dq-pi", vec![settling])
}

pub(crate) fn open_loop() -> ScenarioRecord {
    let settling = passed_expectation("settling_time_ms", ("at_most", json!(2.0)), 5.632);
    let settling = failed_expectation(settling, outside(0, 5.632, 2.0));
    scenario("paper/fig13-open-loop.toml", "Open loop", "open-loop", vec![settling])
}

pub(crate) fn failed_expectation(expectation: ExpectationRecord, reason: Reason) -> ExpectationRecord {
    ExpectationRecord { verdict: Verdict::Fail, reason: Some(reason), ..expectation }
}

pub(crate) fn outside(trial: u32, value: f64, limit: f64) -> Reason {
    let finding = TrialFinding::Outside { value: Some(value), limit: Limit::AtMost(limit) };
    Reason::Trial { trial, divergence: None, finding, ended: None, stopped: None }
}

pub(crate) fn never_settles(trial: u32) -> Reason {
    let finding = TrialFinding::Missing(MissingValue::NeverSettles);
    Reason::Trial { trial, divergence: None, finding, ended: None, stopped: None }
}

fn out_of_reach(settling_ms: f64) -> Reason {
    let best = BestResponse::Value(Metric::SettlingTime, settling_ms);
    Reason::Excused(Excuse::SetpointOutOfReach { needed_vpp: 668.0, limit_vpp: 400.0, best })
}

pub(crate) fn inconclusive_expectation(
    expectation: ExpectationRecord,
    cause: Cause,
    reason: Reason,
) -> ExpectationRecord {
    ExpectationRecord { verdict: Verdict::Inconclusive, cause: Some(cause), reason: Some(reason), ..expectation }
}

pub(crate) fn metric_values(values: &[(&str, Value)]) -> MetricValues {
    let mut metrics = MetricValues::default();
    for (name, value) in values {
        metrics.set((*name).to_owned(), value.as_f64());
    }
    metrics
}

pub(crate) fn trial(file: &str, index: u32, metrics: &[(&str, Value)]) -> TrialRecord {
    let name = file.strip_suffix(".toml").unwrap();
    TrialRecord {
        index,
        seed: 7 + u64::from(index),
        trace: format!("traces/{name}/{index:03}.csv"),
        metrics: metric_values(metrics),
        cause: None,
        reason: None,
        sha256: Some("00".repeat(32)),
        telemetry: Telemetry::default(),
        symptom: None,
        diverged_at_s: None,
        wall_ms: Some(12.5),
    }
}

const NO_ANSWER: Exclusion = Exclusion::NoAnswer { at_ms: 12.0 };
const LATE_BENCH: Exclusion = Exclusion::LateBench { count: 1, first_ms: 31.05 };

pub(crate) fn mixed_run() -> RunRecord {
    let closed = "paper/fig13-closed-loop.toml";
    let open = "paper/fig13-open-loop.toml";
    let limits = "limits/drive-400.toml";
    let settling = || ("at_most", json!(2.0));
    let mut passing = scenario(
        closed,
        "Step of 2 µm at resonance, closed loop",
        "dq-pi",
        vec![
            ExpectationRecord {
                paper: Some(2.0),
                requirement: Some("ACC-1".to_owned()),
                ..passed_expectation("settling_time_ms", settling(), 1.949_31)
            },
            ExpectationRecord {
                statistic: Statistic::Mean,
                confidence: Some(0.95),
                interval: Some([0.0, 0.031]),
                ..passed_expectation("static_error_percent", ("at_most", json!(1.0)), 0.012)
            },
            passed_expectation("final_amplitude_um", ("within", json!([1.98, 2.02])), 1.9997),
        ],
    );
    passing.trials = (0..3).map(|index| trial(closed, index, &[("settling_time_ms", json!(1.949_31))])).collect();
    let mut failing = scenario(
        open,
        "Step of 2 µm at resonance, open loop",
        "open-loop",
        vec![
            ExpectationRecord {
                paper: Some(5.0),
                requirement: Some("ACC-2".to_owned()),
                ..failed_expectation(passed_expectation("settling_time_ms", settling(), 5.632), outside(1, 5.632, 2.0))
            },
            ExpectationRecord {
                value: None,
                interval: None,
                ..failed_expectation(passed_expectation("settling_time_ms", settling(), 0.0), never_settles(2))
            },
        ],
    );
    failing.trials = [(5.6, json!(1.0)), (5.632, json!(1.0)), (5.61, Value::Null)]
        .into_iter()
        .zip(0..)
        .map(|((first, second), index)| {
            trial(open, index, &[("settling_time_ms", json!(first)), ("settling_time_ms[2]", second)])
        })
        .collect();
    let mut doubted = scenario(
        limits,
        "A 2 N finger with 400 Vpp",
        "dq-pi",
        vec![
            inconclusive_expectation(
                passed_expectation("settling_time_ms", settling(), 9.1),
                Cause::Infeasible,
                out_of_reach(9.1),
            ),
            inconclusive_expectation(
                passed_expectation("peak_deviation_percent", ("at_most", json!(5.0)), 3.2),
                Cause::Rig,
                Reason::Excluded { trial: 1, exclusion: NO_ANSWER },
            ),
            inconclusive_expectation(
                passed_expectation("overruns", ("at_most", json!(0.0)), 0.0),
                Cause::Bench,
                Reason::Excluded { trial: 2, exclusion: LATE_BENCH },
            ),
            ExpectationRecord {
                statistic: Statistic::Deviation,
                confidence: Some(0.95),
                interval: Some([1.01, 1.62]),
                ..inconclusive_expectation(
                    passed_expectation("repeatability_percent", ("at_most", json!(1.3)), 1.25),
                    Cause::Evidence,
                    Reason::Undecided {
                        trials: 30,
                        bounds: [1.01, 1.62].into(),
                        limit: Limit::AtMost(1.3),
                        cause: None,
                    },
                )
            },
            passed_expectation("quadrature_ratio", ("about", json!(0.0)), 0.000_012_3),
        ],
    );
    doubted.trials = (0..3).map(|index| trial(limits, index, &[("settling_time_ms", json!(9.1))])).collect();
    doubted.trials[1].cause = Some(Cause::Rig);
    doubted.trials[1].reason = Some(TrialReason::Excluded(NO_ANSWER));
    doubted.trials[2].cause = Some(Cause::Bench);
    doubted.trials[2].reason = Some(TrialReason::Excluded(LATE_BENCH));
    let not_applicable = NotApplicable {
        file: "laws/foreign.toml".to_owned(),
        title: "Gains from the file".to_owned(),
        reason: "the controller does not announce the law `deadbeat`".to_owned(),
        expectations: 0,
    };
    RunRecord { not_applicable: vec![not_applicable], ..run(vec![passing, failing, doubted]) }
}

/// One law costs a third more than in an earlier run, one has a lower mean, one has no earlier run.
pub(crate) fn cost_trends() -> Vec<CostTrend> {
    let cost = |mean, worst| StepCost { mean, worst };
    let earlier = |run: Option<&str>, build: &str, then, now| EarlierCost {
        run: run.map(str::to_owned),
        started: run.map(|_| "2026-03-01T09:30:00Z".to_owned()),
        build: build.to_owned(),
        trials: 42,
        then,
        now,
    };
    let trend = |law: &str, cost: StepCost, earlier| CostTrend {
        law: law.to_owned(),
        build: "5f3a9c01aabbccdd".to_owned(),
        cost,
        tightest: Some(TightestStep { instructions: cost.worst, period_ms: 1.0 }),
        earlier,
    };
    let slower = cost(3_280.5, 3_332.0);
    // The control period of this step is a quarter of the usual one.
    let quarter = TightestStep { instructions: 2_400.0, period_ms: 0.25 };
    vec![
        trend(
            "dq-pi",
            slower,
            vec![
                earlier(Some("20260301T103000Z-0a0b0c"), "5f3a9c01aabbccdd", slower, slower),
                earlier(Some("20260301T093000Z-abcdef"), "1a2b3c4d00000000", cost(2_523.0, 2_563.0), slower),
            ],
        ),
        trend(
            "dq-pi-euler",
            cost(2_400.0, 2_640.0),
            vec![earlier(None, "00112233", cost(2_500.0, 2_610.0), cost(2_410.0, 2_610.0))],
        ),
        CostTrend { tightest: Some(quarter), ..trend("open-loop", cost(2_417.0, 2_494.0), Vec::new()) },
    ]
}

/// The firmware traps in each scenario at the same place, at another instant.
pub(crate) fn trapped_run(scenarios: u32) -> RunRecord {
    let trapped = |place: u32| {
        let file = format!("paper/{place}.toml");
        let cause = "the firmware trapped: HardFault, at 0x08000100 in step".to_owned();
        let ended = format!("{cause}, {} µs after power-on", 3_000 + place);
        let finding = TrialFinding::Missing(MissingValue::NotRunning);
        let reason = Reason::Trial { trial: 0, divergence: None, finding, ended: Some(ended.clone()), stopped: None };
        let metrics = [("settling_time_ms", 2.0), ("overshoot_percent", 5.0)];
        let expectations = metrics.map(|(metric, limit)| {
            let expectation = passed_expectation(metric, ("at_most", json!(limit)), limit);
            ExpectationRecord { value: None, ..failed_expectation(expectation, reason.clone()) }
        });
        let mut scenario = scenario(&file, &format!("Step {place}"), "dq-pi", expectations.to_vec());
        scenario.trials = vec![trial(&file, 0, &[])];
        scenario.trials[0].telemetry = Telemetry { ended: Some(ended), end_cause: Some(cause), ..Telemetry::default() };
        scenario
    };
    run((0..scenarios).map(trapped).collect())
}

/// Writes traces. Their gains vary by ±`spread` around the gain of `response`.
pub(crate) fn write_trials(scenario: &mut ScenarioRecord, folder: &Path, trials: u32, response: Response, spread: f64) {
    for index in 0..trials {
        let offset = (f64::from(index) * 2.399_963).sin() * spread;
        let response = Response { gain: response.gain * (1.0 + offset), ..response };
        let settling = response.settling_ms();
        let settling = if settling.is_finite() { json!(settling) } else { Value::Null };
        let trial = trial(&scenario.file, index, &[("settling_time_ms", settling)]);
        response.write(folder, &trial);
        scenario.trials.push(trial);
    }
}

/// Three scenarios: one passed, one failed, one is inconclusive and saturated.
pub(crate) fn run_with_traces(folder: &Path) -> RunRecord {
    let settling = |value: f64, paper: f64| ExpectationRecord {
        paper: Some(paper),
        requirement: Some("ACC-1".to_owned()),
        ..passed_expectation("settling_time_ms", ("at_most", json!(2.0)), value)
    };
    let mut closed = scenario(
        "paper/fig13-closed-loop.toml",
        "Step of 2 µm at resonance, closed loop",
        "dq-pi",
        vec![
            settling(1.991, 2.0),
            ExpectationRecord {
                statistic: Statistic::Deviation,
                interval: Some([0.58, 0.88]),
                confidence: Some(0.95),
                paper: Some(1.3),
                ..passed_expectation("repeatability_percent", ("at_most", json!(1.3)), 0.7)
            },
            passed_expectation("quadrature_ratio", ("at_most", json!(0.01)), 0.000_012_3),
        ],
    );
    write_trials(&mut closed, folder, 30, Response::default(), 0.01);
    let mut open = scenario("paper/fig13-open-loop.toml", "Step of 2 µm at resonance, open loop", "open-loop", vec![]);
    write_trials(&mut open, folder, 30, Response { time_constant_ms: 1.88, ..Response::default() }, 0.02);
    let times = open.trials.iter().map(|trial| trial.metrics.number("settling_time_ms").unwrap());
    let worst = times.fold(0.0, f64::max);
    open.expectations = vec![failed_expectation(settling(worst, 5.0), outside(2, worst, 2.0))];
    open.verdict = Verdict::Fail;
    let mut finger = scenario(
        "limits/fig16-400-vpp.toml",
        "Tuned for 33 °C, plate at 24 °C, 2 N finger, amplifier of 400 Vpp",
        "dq-pi",
        vec![
            inconclusive_expectation(settling(3.37, 2.0), Cause::Infeasible, out_of_reach(3.37)),
            passed_expectation("frequency_error_hz", ("at_most", json!(5.0)), 0.3),
        ],
    );
    let weak = Response {
        force_n: 2.0,
        temperature_k: 4.0,
        detuned_hz: -86.7,
        gain: 0.98,
        drive_limit_vpp: 400.0,
        ..Response::default()
    };
    write_trials(&mut finger, folder, 5, weak, 0.004);
    run(vec![closed, open, finger])
}

/// Adds the worst instants as the judge does, for expectations whose deciding trial has a trace.
pub(crate) fn with_worst_instants(record: &RunRecord, folder: &Path) -> RunRecord {
    let mut record = record.clone();
    for scenario in &mut record.scenarios {
        for index in 0..scenario.expectations.len() {
            let (key, expectation) = (scenario.metric_key(index), &scenario.expectations[index]);
            let is_deciding = |trial: &&TrialRecord| trial.metrics.get(&key) == Some(expectation.value);
            let deciding = scenario.trials.iter().find(is_deciding).or(scenario.trials.first());
            let rows = deciding.and_then(|trial| read_trace(&folder.join(&trial.trace)).ok());
            let has_band = expectation.definition.band_percent.is_some();
            let is_known = has_band || !matches!(expectation.metric, Metric::SettlingTime | Metric::RecoveryTime);
            let is_wanted = is_known && expectation.worst.is_none();
            let Some((trial, rows)) = deciding.zip(rows).filter(|_| is_wanted) else { continue };
            let expected = judged_expectation(expectation);
            scenario.expectations[index].worst =
                measure_with_instants(&expected, trial.index, &rows, &trial.telemetry).1;
        }
    }
    record
}

fn judged_expectation(record: &ExpectationRecord) -> Expectation {
    let window = |&[from, to]: &[f64; 2]| Window { from: Time::from_ms(from).unwrap(), to: Time::from_ms(to).unwrap() };
    let windows: Vec<Window> = record.windows_ms.iter().map(window).collect();
    let signal = record.definition.signal.as_deref().unwrap_or("amplitude_um");
    Expectation {
        signal: SIGNALS.into_iter().find(|known| *known == signal).unwrap(),
        band_percent: record.definition.band_percent.unwrap_or(5.0),
        limit: record.limit,
        windows,
        ..Expectation::for_window(record.metric, Window { from: Time::ZERO, to: Time::ZERO })
    }
}

pub(crate) fn write_baseline(scenario: &ScenarioRecord, folder: &Path, baselines: &Path) {
    let rows = read_trace(&folder.join(&scenario.trials[0].trace)).unwrap();
    let build =
        BaselineBuild { rig: "hosted".to_owned(), firmware: "dq-pi 0.1.0".to_owned(), id: "5f3a9c01".to_owned() };
    let baseline = Baseline {
        scenario: scenario.file.clone(),
        response: JudgedResponse { law: scenario.law.clone(), build, values: Some(judged_values(scenario)) },
        learned: None,
        golden: GoldenTubes::from_rows(&rows).unwrap(),
    };
    baseline.write(baselines).unwrap();
}
