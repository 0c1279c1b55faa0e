//! Records and traces to report on: what a run could have left behind.

use platebench_trace::{Flags, Row, Writer};
use platebench_verdict::record::{
    Cost, CostTrend, EarlierCost, FORMAT, Firmware, Host, InputRecord, Overrides, RigRecord, Tool,
};
use platebench_verdict::{
    Cause, Definition, Evidence, ExpectationRecord, RunRecord, ScenarioRecord, Telemetry, TrialRecord, Verdict,
};
use serde_json::{Map, Value, json};
use std::fs;
use std::path::Path;

/// A run of these scenarios.
pub(crate) fn run(scenarios: Vec<ScenarioRecord>) -> RunRecord {
    RunRecord {
        format: FORMAT,
        verdict: Verdict::over(scenarios.iter().map(|scenario| scenario.verdict)),
        complete: true,
        tool: Tool { name: "platebench".to_owned(), version: "0.1.0".to_owned() },
        started: "2026-03-02T09:30:00Z".to_owned(),
        rig: RigRecord {
            name: "hosted".to_owned(),
            firmware: Some(Firmware {
                name: "dq-pi".to_owned(),
                version: "0.1.0".to_owned(),
                build: "5f3a9c01".to_owned(),
                chip: "0".to_owned(),
            }),
        },
        clock: "lockstep".to_owned(),
        overrides: Overrides { seed: Some(7), ..Overrides::default() },
        safe_confirmed: Some(true),
        host: Host { os: "linux".to_owned(), arch: "x86_64".to_owned() },
        scenarios,
        cost: Vec::new(),
    }
}

/// A scenario without trials.
pub(crate) fn scenario(file: &str, title: &str, law: &str, expectations: Vec<ExpectationRecord>) -> ScenarioRecord {
    let input = |file: String, digit: &str| InputRecord { file, sha256: digit.repeat(64) };
    ScenarioRecord {
        file: file.to_owned(),
        title: title.to_owned(),
        source: Some("Fig. 13".to_owned()),
        verdict: Verdict::over(expectations.iter().map(|expectation| expectation.verdict)),
        law: law.to_owned(),
        model: "modal".to_owned(),
        model_choice: None,
        inputs: vec![
            input(format!("inputs/{file}"), "3"),
            input("inputs/plates/aluminium-198x138.toml".to_owned(), "a"),
        ],
        expectations,
        trials: Vec::new(),
    }
}

/// An expectation that passed, to be bent into another.
pub(crate) fn passed(metric: &str, limit: (&str, Value), value: f64) -> ExpectationRecord {
    ExpectationRecord {
        metric: metric.to_owned(),
        verdict: Verdict::Pass,
        value: Some(value),
        statistic: "worst".to_owned(),
        limit: Map::from_iter([(limit.0.to_owned(), limit.1)]),
        interval: Some([value * 0.98, value]),
        confidence: None,
        cause: None,
        reason: None,
        paper: None,
        requirement: None,
        definition: Definition::default(),
        evidence: Evidence::default(),
    }
}

/// The same, failed.
pub(crate) fn failed(expectation: ExpectationRecord, reason: &str) -> ExpectationRecord {
    ExpectationRecord { verdict: Verdict::Fail, reason: Some(reason.to_owned()), ..expectation }
}

/// The same, inconclusive.
pub(crate) fn doubtful(expectation: ExpectationRecord, cause: Cause, reason: &str) -> ExpectationRecord {
    let reason = Some(reason.to_owned());
    ExpectationRecord { verdict: Verdict::Inconclusive, cause: Some(cause), reason, ..expectation }
}

/// A trial with these metrics.
pub(crate) fn trial(file: &str, index: u32, metrics: &[(&str, Value)]) -> TrialRecord {
    let name = file.strip_suffix(".toml").unwrap();
    TrialRecord {
        index,
        seed: 7 + u64::from(index),
        trace: format!("traces/{name}/{index:03}.csv"),
        metrics: metrics.iter().map(|(name, value)| ((*name).to_owned(), value.clone())).collect(),
        cause: None,
        reason: None,
        sha256: None,
        telemetry: Telemetry::default(),
        diverged_at_s: None,
        wall_ms: Some(12.5),
    }
}

/// A pass, a failure, and an inconclusive expectation of every cause.
pub(crate) fn mixed() -> RunRecord {
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
                ..passed("settling_time_ms", settling(), 1.949_31)
            },
            ExpectationRecord {
                statistic: "mean".to_owned(),
                confidence: Some(0.95),
                interval: Some([0.0, 0.031]),
                ..passed("static_error_percent", ("at_most", json!(1.0)), 0.012)
            },
            passed("final_amplitude_um", ("within", json!([1.98, 2.02])), 1.9997),
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
                ..failed(passed("settling_time_ms", settling(), 5.632), "trial 1: 5.6320, expected ≤ 2")
            },
            ExpectationRecord {
                value: None,
                interval: None,
                ..failed(passed("settling_time_ms", settling(), 0.0), "trial 2: never stays inside the band")
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
            doubtful(
                passed("settling_time_ms", settling(), 9.1),
                Cause::Infeasible,
                "saturated: holding the setpoint needs 668 Vpp, the amplifier gives 400 Vpp",
            ),
            doubtful(
                passed("peak_deviation_percent", ("at_most", json!(5.0)), 3.2),
                Cause::Rig,
                "trial 1: no answer at 12 ms",
            ),
            doubtful(
                passed("overruns", ("at_most", json!(0.0)), 0.0),
                Cause::Bench,
                "trial 2: the bench was too late at 31.05 ms",
            ),
            ExpectationRecord {
                statistic: "deviation".to_owned(),
                confidence: Some(0.95),
                interval: Some([1.01, 1.62]),
                ..doubtful(
                    passed("repeatability_percent", ("at_most", json!(1.3)), 1.25),
                    Cause::Evidence,
                    "30 trials leave it between 1.0100 and 1.6200, which does not decide ≤ 1.3",
                )
            },
            passed("quadrature_ratio", ("about", json!(0.0)), 0.000_012_3),
        ],
    );
    doubted.trials = (0..3).map(|index| trial(limits, index, &[("settling_time_ms", json!(9.1))])).collect();
    doubted.trials[1].cause = Some(Cause::Rig);
    doubted.trials[1].reason = Some("no answer at 12 ms".to_owned());
    doubted.trials[2].cause = Some(Cause::Bench);
    doubted.trials[2].reason = Some("the bench was too late at 31.05 ms".to_owned());
    run(vec![passing, failing, doubted])
}

/// The cost of a step under three laws: a third more than in an earlier run, a mean that fell, and one that nobody played before.
pub(crate) fn costs() -> Vec<CostTrend> {
    let cost = |mean, worst| Cost { mean, worst };
    let earlier = |run: Option<&str>, build: &str, then, now| EarlierCost {
        run: run.map(str::to_owned),
        started: run.map(|_| "2026-03-01T09:30:00Z".to_owned()),
        build: build.to_owned(),
        trials: 42,
        then,
        now,
    };
    let trend = |law: &str, cost, earlier| CostTrend {
        law: law.to_owned(),
        build: "5f3a9c01aabbccdd".to_owned(),
        cost,
        earlier,
    };
    let slower = cost(3_280.5, 3_332.0);
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
        trend("open-loop", cost(2_417.0, 2_494.0), Vec::new()),
    ]
}

/// A first-order response to a step of 2 µm at 1 ms.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Response {
    pub(crate) duration_ms: f64,
    pub(crate) step_ms: f64,
    pub(crate) time_constant_ms: f64,
    /// Final value relative to the setpoint.
    pub(crate) gain: f64,
    /// Detuning at the start, Hz; the frequency then follows the resonance.
    pub(crate) detuned_hz: f64,
    pub(crate) follows: bool,
    /// Force that the finger ends at, over 20 ms from 20 ms on.
    pub(crate) force_n: f64,
    pub(crate) temperature_k: f64,
    pub(crate) drive_limit_vpp: f64,
}

impl Default for Response {
    fn default() -> Self {
        Self {
            duration_ms: 60.0,
            step_ms: 0.05,
            time_constant_ms: 0.6504,
            gain: 1.0,
            detuned_hz: 0.0,
            follows: true,
            force_n: 0.0,
            temperature_k: 0.0,
            drive_limit_vpp: 900.0,
        }
    }
}

impl Response {
    /// When it enters the 5 % band, counted from the step.
    pub(crate) fn settling_ms(&self) -> f64 {
        self.time_constant_ms * (1.0 / (1.0 - 0.95 / self.gain)).ln()
    }

    fn row(&self, t_ms: f64) -> Row {
        let since = t_ms - 1.0;
        let rise = if since > 0.0 { 1.0 - (-since / self.time_constant_ms).exp() } else { 0.0 };
        let force = self.force_n * ((t_ms - 20.0) / 20.0).clamp(0.0, 1.0);
        let dip =
            if (20.0..45.0).contains(&t_ms) { 0.06 * (force / 2.0) * (-(t_ms - 40.0).max(0.0)).exp() } else { 0.0 };
        let amplitude = 2.0 * self.gain * rise * (1.0 - dip);
        let off = if self.follows { self.detuned_hz * (-since.max(0.0) / 3.0).exp() } else { self.detuned_hz };
        let ratio = -1.88e-3 * std::f64::consts::TAU * off;
        let in_phase = amplitude / ratio.hypot(1.0);
        // The drive holds from one control instant to the next.
        let held = (t_ms + 1e-9).floor() - 1.0;
        let wanted = if held < 0.0 {
            0.0
        } else {
            286.5 * self.gain * (1.0 + 0.9 * (-held / self.time_constant_ms).exp()) * (1.0 + force * 0.66)
        };
        let saturated = if wanted >= self.drive_limit_vpp { Flags::SATURATED } else { Flags::empty() };
        Row {
            t_s: t_ms / 1e3,
            setpoint_um: if since >= 0.0 { 2.0 } else { 0.0 },
            wd_um: in_phase,
            wq_um: in_phase * ratio,
            amplitude_um: amplitude,
            drive_vpp: wanted.min(self.drive_limit_vpp),
            frequency_hz: 32_307.6 - 9.638 * self.temperature_k + off,
            resonance_hz: 32_307.6 - 9.638 * self.temperature_k,
            temperature_offset_k: self.temperature_k,
            finger_force_n: force,
            flags: saturated,
            ..Row::default()
        }
    }

    /// Writes the trace of `trial` below `folder`.
    pub(crate) fn write(&self, folder: &Path, trial: &TrialRecord) {
        let path = folder.join(&trial.trace);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        let mut writer = Writer::create(&path).unwrap();
        let count = (self.duration_ms / self.step_ms).round() as u32;
        for index in 0..=count {
            writer.write(&self.row(f64::from(index) * self.step_ms)).unwrap();
        }
        writer.finish().unwrap();
    }
}

/// Gives `scenario` so many trials of `response`, each with a gain of its own within ±`spread`, and their traces.
pub(crate) fn play(scenario: &mut ScenarioRecord, folder: &Path, trials: u32, response: Response, spread: f64) {
    for index in 0..trials {
        // A fixed pattern that looks like scatter.
        let offset = (f64::from(index) * 2.399_963).sin() * spread;
        let response = Response { gain: response.gain * (1.0 + offset), ..response };
        let settling = response.settling_ms();
        let settling = if settling.is_finite() { json!(settling) } else { Value::Null };
        let trial = trial(&scenario.file, index, &[("settling_time_ms", settling)]);
        response.write(folder, &trial);
        scenario.trials.push(trial);
    }
}

/// A run of three scenarios with their traces below `folder`: one passed, one failed, one is inconclusive and saturated.
pub(crate) fn varied(folder: &Path) -> RunRecord {
    let settling = |value: f64, paper: f64| ExpectationRecord {
        paper: Some(paper),
        requirement: Some("ACC-1".to_owned()),
        ..passed("settling_time_ms", ("at_most", json!(2.0)), value)
    };
    let mut closed = scenario(
        "paper/fig13-closed-loop.toml",
        "Step of 2 µm at resonance, closed loop",
        "dq-pi",
        vec![
            settling(1.991, 2.0),
            ExpectationRecord {
                statistic: "deviation".to_owned(),
                interval: Some([0.58, 0.88]),
                confidence: Some(0.95),
                paper: Some(1.3),
                ..passed("repeatability_percent", ("at_most", json!(1.3)), 0.7)
            },
            passed("quadrature_ratio", ("at_most", json!(0.01)), 0.000_012_3),
        ],
    );
    play(&mut closed, folder, 30, Response::default(), 0.01);
    let mut open = scenario("paper/fig13-open-loop.toml", "Step of 2 µm at resonance, open loop", "open-loop", vec![]);
    play(&mut open, folder, 30, Response { time_constant_ms: 1.88, ..Response::default() }, 0.02);
    let times = open.trials.iter().map(|trial| trial.metrics["settling_time_ms"].as_f64().unwrap());
    let worst = times.fold(0.0, f64::max);
    open.expectations = vec![failed(settling(worst, 5.0), &format!("trial 2: {worst:.4}, expected ≤ 2"))];
    open.verdict = Verdict::Fail;
    let mut finger = scenario(
        "limits/fig16-400-vpp.toml",
        "Tuned for 33 °C, plate at 24 °C, 2 N finger, amplifier of 400 Vpp",
        "dq-pi",
        vec![
            doubtful(
                settling(3.37, 2.0),
                Cause::Infeasible,
                "saturated: holding the setpoint needs 668 Vpp, the amplifier gives 400 Vpp",
            ),
            passed("frequency_error_hz", ("at_most", json!(5.0)), 0.3),
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
    play(&mut finger, folder, 5, weak, 0.004);
    run(vec![closed, open, finger])
}
