//! Records the results of a trial: values, telemetry, step time and cost, lateness, real plate.

use crate::metrics::{EnablePin, FirmwareLog, Metric, OutputRead, RigReports};
use crate::record::reason;
use crate::record::reason::{LoopSymptom, TrialReason};
use crate::record::verdict::Cause;
use crate::record::verdict::{Violation, ViolationKind};
use platebench_plate::is_default;
use schemars::{JsonSchema, Schema, SchemaGenerator};
use serde::de::{Deserializer, MapAccess, Visitor};
use serde::ser::Serializer;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fmt;

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct TrialRecord {
    /// Counted from 0.
    pub index: u32,
    pub seed: u64,
    /// Path of the trace, relative to the run folder.
    pub trace: String,
    /// SHA-256 of the trace, hexadecimal; `null` if the trial was cut off before it was recorded.
    #[serde(default)]
    pub sha256: Option<String>,
    /// Value by metric; `null` if the trial has no number. The second expectation of a metric has
    /// the suffix `[2]`.
    pub metrics: MetricValues,
    #[serde(default)]
    pub telemetry: Telemetry,
    pub cause: Option<Cause>,
    #[serde(flatten, with = "reason::file_keys")]
    #[schemars(with = "reason::file_keys::Keys<TrialReason>")]
    pub reason: Option<TrialReason>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub diverged_at_s: Option<f64>,
    /// Absent unless the trace shows a likely cause of a failure.
    #[serde(rename = "sign_symptom", default, skip_serializing_if = "Option::is_none")]
    pub symptom: Option<LoopSymptom>,
    /// Wall-clock time of the trial, ms; `null` if the trial was judged again.
    pub wall_ms: Option<f64>,
}

#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Telemetry {
    /// Longest time from sampling to actuation as it acted on the plate, µs.
    pub loop_delay_us: Option<f64>,
    /// Longest time from sample to command through line and controller, µs; includes commands that
    /// did not act.
    pub rig_delay_us: Option<f64>,
    pub instructions_mean: Option<f64>,
    pub instructions_worst: Option<f64>,
    /// Absent on rigs that do not count instructions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub step_time: Option<StepTime>,
    /// Largest difference of a command from the reference implementation; absent without a
    /// comparison.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reference_difference_percent: Option<f64>,
    /// A sentence for each message script with an answer that differs from the reference; absent if
    /// none was sent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub protocol_differences: Option<Vec<String>>,
    /// Number of message scripts that were repeated because the line may have lost an answer or the
    /// host stalled.
    #[serde(default, skip_serializing_if = "is_default")]
    pub protocol_repeats: u32,
    /// Message scripts that `--long-scripts` plays and that this trial did not play.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub scripts_not_played: Vec<String>,
    /// Message scripts with other answers than the reference, each time after an exchange of more
    /// than 80 ms. A stall of the computer may be the cause.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub scripts_not_decided: Vec<String>,
    /// The rig's message about the loss of the controller.
    #[serde(default)]
    pub ended: Option<String>,
    /// `ended` without instants and callers: equal for the same fault at the same place.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub end_cause: Option<String>,
    /// True if the controller, not the rig, caused the end. A silence before it is then the controller's.
    #[serde(default, skip_serializing_if = "is_default")]
    pub ended_by_controller: bool,
    /// Absent on rigs without an emulated chip.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub transport: Option<Transport>,
    /// Bits per second of the emulated chip's line. Absent on other rigs and in older runs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub baud: Option<u32>,
    /// Absent on rigs without an emulated chip.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub enable_pin: Option<EnablePin>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub timing: Option<Box<TimingRecord>>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub real_plate: Option<Box<RealPlateRecord>>,
    /// The controller's first reason for a stop.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stopped: Option<String>,
    /// Text that the firmware wrote by RTT.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub firmware_output: Option<String>,
    /// Instants of `firmware_output`. Present if the scenario expects a text.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub firmware_output_reads: Option<Vec<OutputRead>>,
    /// Bytes of the frames of `defmt` that the firmware wrote by RTT, in the file with the name of
    /// the trace and the ending `.defmt`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub defmt_bytes: Option<usize>,
    /// The frames, until the bench has written the file.
    #[serde(skip)]
    pub defmt_frames: Option<Vec<u8>>,
    /// Instances of the emulated chip without a model that the firmware used.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub unmodelled_instances: Vec<UnmodelledInstance>,
    /// True if the image is marked as hard float and no instruction of the FPU ran.
    #[serde(default, skip_serializing_if = "is_default")]
    pub unused_fpu: bool,
    /// Number of messages that planned faults changed, by kind of fault.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub faults: BTreeMap<String, u64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub not_finite: Option<NonFiniteDrive>,
    /// Watchdog timeout of a controller whose clock runs while the plate waits, ms.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub watchdog_timeout_ms: Option<u16>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub violations: Vec<Violation>,
}

/// How messages pass between the bench and the USART of an emulated chip, or the hosted controller. All
/// give the same results.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Transport {
    /// Each word of the line is an event of its own. The hosted controller receives bytes.
    Words,
    /// Words that the firmware cannot tell apart pass as one block. The hosted controller receives
    /// samples without bytes.
    #[default]
    Blocks,
    /// As blocks. The bench also played the exchanges of the trial as words, with the same answers,
    /// delays and instruction counts.
    BlocksAndWords,
}

/// Accesses to an instance of the emulated chip without a model. They change nothing in a trial.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct UnmodelledInstance {
    pub instance: String,
    pub registers: Vec<String>,
    /// Number of reads and writes.
    pub accesses: u64,
}

impl Telemetry {
    pub fn firmware_log(&self) -> Option<FirmwareLog<'_>> {
        let text = self.firmware_output.as_deref().unwrap_or_default();
        self.firmware_output_reads.as_deref().map(|reads| FirmwareLog { text, reads })
    }

    pub fn reports(&self) -> RigReports {
        RigReports {
            loop_delay_us: self.loop_delay_us,
            instructions_worst: self.instructions_worst,
            step_time_percent: self.step_time.map(|step| step.longest_percent),
            reference_difference_percent: self.reference_difference_percent,
            protocol_differences: self.protocol_differences.as_ref().map(|all| all.len() as f64),
            has_undecided_scripts: !self.scripts_not_decided.is_empty(),
            enable_pin: self.enable_pin,
        }
    }

    /// Adds what a scene between the trials shows about the controller. Its motion of the plate is
    /// not judged.
    pub fn include_scene(&mut self, scene: Self) {
        self.violations.extend(scene.violations);
        if let Some(steps) = scene.step_time {
            self.step_time.get_or_insert_default().include(&steps);
        }
    }
}

/// Commands that were NaN or infinite. The bench applied 0 V, so the trace does not contain them.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct NonFiniteDrive {
    pub at_s: f64,
    pub count: u64,
}

/// Value of each metric in the order of the expectations; `None` if the trial has no number.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct MetricValues(Vec<(Cow<'static, str>, Option<f64>)>);

impl MetricValues {
    pub fn with_capacity(count: usize) -> Self {
        Self(Vec::with_capacity(count))
    }

    pub fn set(&mut self, name: impl Into<Cow<'static, str>>, value: Option<f64>) {
        let name = name.into();
        match self.0.iter_mut().find(|(known, _)| *known == name) {
            Some((_, known)) => *known = value,
            None => self.0.push((name, value)),
        }
    }

    /// `Some(None)` if the trial has no number for this metric.
    pub fn get(&self, name: &str) -> Option<Option<f64>> {
        self.iter().find(|(known, _)| *known == name).map(|(_, value)| value)
    }

    pub fn number(&self, name: &str) -> Option<f64> {
        self.get(name).flatten()
    }

    pub fn iter(&self) -> impl Iterator<Item = (&str, Option<f64>)> {
        self.0.iter().map(|(name, value)| (name.as_ref(), *value))
    }
}

impl Serialize for MetricValues {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_map(self.iter())
    }
}

impl<'de> Deserialize<'de> for MetricValues {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct ValuesVisitor;

        impl<'de> Visitor<'de> for ValuesVisitor {
            type Value = MetricValues;

            fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
                formatter.write_str("metrics by name")
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<MetricValues, A::Error> {
                let mut values = MetricValues::default();
                while let Some((name, value)) = map.next_entry::<Cow<'de, str>, _>()? {
                    let known = Metric::from_name(&name).map(|metric| Cow::Borrowed(metric.name()));
                    values.set(known.unwrap_or_else(|| Cow::Owned(name.into_owned())), value);
                }
                Ok(values)
            }
        }

        deserializer.deserialize_map(ValuesVisitor)
    }
}

impl JsonSchema for MetricValues {
    fn inline_schema() -> bool {
        true
    }

    fn schema_name() -> Cow<'static, str> {
        Map::<String, Value>::schema_name()
    }

    fn json_schema(generator: &mut SchemaGenerator) -> Schema {
        Map::<String, Value>::json_schema(generator)
    }
}

/// Limit of a scenario without an expectation of its own, percent of the control period.
const LIMIT_PERCENT: f64 = 100.0;
/// Above this share the bench warns, because a real chip needs more than one cycle per instruction.
const TIGHT_PERCENT: f64 = 80.0;

/// Control steps of a trial, at one instruction per cycle.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct StepTime {
    /// Longest step, percent of the control period.
    pub longest_percent: f64,
    /// Number of steps that took longer than the period.
    #[serde(default)]
    pub overlong: u64,
    /// Start of the first step that took longer than the period; absent if there is none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub first_overlong_s: Option<f64>,
}

impl StepTime {
    pub fn record(&mut self, percent: f64, at_s: f64) {
        let overlong = percent > LIMIT_PERCENT;
        self.include(&Self {
            longest_percent: percent,
            overlong: overlong.into(),
            first_overlong_s: overlong.then_some(at_s),
        });
    }

    /// Adds the steps of a later scene.
    pub fn include(&mut self, later: &Self) {
        self.longest_percent = self.longest_percent.max(later.longest_percent);
        self.overlong += later.overlong;
        self.first_overlong_s = self.first_overlong_s.or(later.first_overlong_s);
    }

    /// Present if a step took longer than the period.
    pub fn violation(&self) -> Option<Violation> {
        Some(Violation {
            kind: ViolationKind::StepTime,
            at_s: self.first_overlong_s?,
            count: self.overlong,
            worst: Some(self.longest_percent),
            limit: Some(LIMIT_PERCENT),
        })
    }

    /// True if the longest step fits into the period, but a real chip may need longer.
    pub fn is_tight(&self) -> bool {
        self.longest_percent > TIGHT_PERCENT && self.longest_percent <= LIMIT_PERCENT
    }
}

const MIN_CHANGE_PERCENT: f64 = 1.0;

/// Speed of the emulated board: one instruction per cycle of 168 MHz.
const INSTRUCTIONS_PER_MS: f64 = 168_000.0;

/// The control step that needs the largest share of its period.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct TightestStep {
    pub instructions: f64,
    pub period_ms: f64,
}

impl TightestStep {
    /// Share of the control period that the step takes on the emulated board.
    pub fn share(&self) -> f64 {
        self.instructions / (INSTRUCTIONS_PER_MS * self.period_ms)
    }
}

/// Instructions per control step over some trials.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct StepCost {
    /// Mean over the trials of each trial's mean.
    pub mean: f64,
    pub worst: f64,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct CostTrend {
    pub law: String,
    /// Build identity of the firmware, hexadecimal.
    pub build: String,
    pub cost: StepCost,
    /// `null` in records of earlier versions.
    #[serde(default)]
    pub tightest: Option<TightestStep>,
    /// Runs on the same kind of rig and firmware, newest first. The reference that came with the
    /// bench is last.
    pub earlier: Vec<EarlierCost>,
}

/// Cost in an earlier run, over the trials with the same law, inputs and seed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct EarlierCost {
    /// The run folder's name; `null` for the reference that came with the bench.
    pub run: Option<String>,
    pub started: Option<String>,
    pub build: String,
    /// Number of trials that both runs have.
    pub trials: usize,
    pub then: StepCost,
    pub now: StepCost,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CostChange<'a> {
    pub statistic: &'static str,
    pub now: f64,
    pub then: f64,
    /// Change from `then` to `now`, percent; positive if a step costs more now.
    pub percent: f64,
    pub earlier: &'a EarlierCost,
}

impl CostTrend {
    /// The newest earlier run of another build, so that a second run of the same build does not
    /// hide a change.
    pub fn comparison_run(&self) -> Option<&EarlierCost> {
        self.earlier.iter().find(|earlier| earlier.build != self.build).or_else(|| self.earlier.first())
    }

    /// The change of the worst step, or of the mean if only the mean changed by more than 1 %.
    pub fn significant_change(&self) -> Option<CostChange<'_>> {
        let against = self.comparison_run()?;
        let EarlierCost { now, then, .. } = against;
        [("worst", now.worst, then.worst), ("mean", now.mean, then.mean)].into_iter().find_map(|(what, now, then)| {
            let is_significant = (now - then).abs() * 100.0 > then * MIN_CHANGE_PERCENT;
            is_significant.then(|| CostChange {
                statistic: what,
                now,
                then,
                percent: (now / then - 1.0) * 100.0,
                earlier: against,
            })
        })
    }
}

/// Times are wall-clock times unless stated otherwise.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct TimingRecord {
    /// Clock that sets the control instants: `bench` or `target`.
    pub pacing: String,
    /// Seconds of plate time per second of wall-clock time.
    pub time_scale: f64,
    /// Scheduling of the loop's thread, or why it is not real-time.
    pub scheduling: String,
    pub memory_locked: bool,
    pub periods: u64,
    pub overruns: u64,
    pub skipped: u64,
    /// Samples without an answer in time. If `pacing` is `target`, also periods without a tick of
    /// the target.
    pub missed_replies: u64,
    /// Samples that are still without an answer at the end of the trial.
    #[serde(default)]
    pub lost_replies: u64,
    pub rejected_frames: u64,
    pub lost_rows: u64,
    /// Time from a control instant to its sample, µs.
    pub lateness_us: Quantiles,
    /// From control instant to actuation, µs of plate time; `null` without an answer.
    pub loop_delay_us: Option<Quantiles>,
    /// Longest constant delay at which the law settles on the nominal plate, µs of plate time.
    pub loop_delay_budget_us: Option<f64>,
    /// Deviation of the target's clock from the bench's, positive if fast; `null` if unknown.
    pub target_clock_ppm: Option<f64>,
    pub target_clock_error_ppm: Option<f64>,
    pub safe_confirmed: bool,
    /// Time that the hypervisor took from this machine's processors during the trial, ms; `null` if
    /// unknown.
    #[serde(default)]
    pub steal_ms: Option<f64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Quantiles {
    pub p50: f64,
    pub p99: f64,
    pub p999: f64,
    pub max: f64,
}

#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct RealPlateRecord {
    /// Control periods that the controller reported.
    pub periods: u64,
    /// Control periods without a report between them.
    pub missing: u64,
    pub setpoints: u64,
    pub unacknowledged: u64,
    /// From sending a setpoint to its acknowledgement, µs; `None` if there was none.
    pub acknowledged_us: Option<Quantiles>,
    pub rejected_frames: u64,
    pub lost_rows: u64,
    /// Deviation of the controller's clock from the bench's, positive if fast, and its standard
    /// error; ppm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub clock_ppm: Option<[f64; 2]>,
    pub force_measured: bool,
    pub safe_confirmed: bool,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub asked: Vec<OperatorRequest>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub undone: Option<String>,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct OperatorRequest {
    pub what: String,
    pub done: bool,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keeps_order_names_and_missing_numbers() {
        let text = r#"{"static_error_percent":0.25,"settling_time_ms":null,"settling_time_ms[2]":4.0}"#;
        let values: MetricValues = serde_json::from_str(text).unwrap();
        assert_eq!(values.get("settling_time_ms"), Some(None));
        assert_eq!(values.get("settling_time_ms[2]"), Some(Some(4.0)));
        assert_eq!(values.get("overshoot_percent"), None);
        assert_eq!(serde_json::to_string(&values).unwrap(), text);
    }
}

#[cfg(test)]
mod step_time_tests {
    use super::*;

    #[test]
    fn only_a_step_longer_than_its_period_is_a_violation() {
        let mut steps = StepTime::default();
        steps.record(80.0, 0.0);
        assert!(!steps.is_tight() && steps.violation().is_none(), "{steps:?}");
        steps.record(100.0, 1e-3);
        assert!(steps.is_tight() && steps.violation().is_none(), "{steps:?}");
        steps.record(111.25, 2e-3);
        steps.record(100.5, 3e-3);
        assert!(!steps.is_tight(), "{steps:?}");
        let violation = steps.violation().unwrap();
        assert_eq!((violation.worst, violation.limit, violation.count), (Some(111.25), Some(100.0), 2));
        assert_eq!(
            violation.to_string(),
            "the longest control step takes 111.2 % of the control period on the emulated chip, limit 100 %, first at \
             2.0 ms, 2 in total"
        );
    }
}

#[cfg(test)]
mod cost_tests {
    use super::*;
    use rstest::rstest;

    fn earlier(build: &str, then: [f64; 2], now: [f64; 2]) -> EarlierCost {
        let cost = |[mean, worst]: [f64; 2]| StepCost { mean, worst };
        EarlierCost {
            run: Some("20260101T000000Z-abcdef".to_owned()),
            started: Some("2026-01-01T00:00:00Z".to_owned()),
            build: build.to_owned(),
            trials: 3,
            then: cost(then),
            now: cost(now),
        }
    }

    fn trend(earlier: Vec<EarlierCost>) -> CostTrend {
        let cost = StepCost { mean: 2_000.0, worst: 2_600.0 };
        CostTrend { law: "dq-pi".to_owned(), build: "new".to_owned(), cost, tightest: None, earlier }
    }

    #[rstest]
    #[case::a_third_more([2_000.0, 2_000.0], [2_600.0, 2_600.0], Some(("worst", 30.0)))]
    #[case::at_the_threshold([2_000.0, 2_000.0], [2_020.0, 2_020.0], None)]
    #[case::just_beyond([2_000.0, 2_000.0], [2_020.0, 2_021.0], Some(("worst", 1.05)))]
    #[case::less([2_000.0, 2_000.0], [1_980.0, 1_979.0], Some(("worst", -1.05)))]
    #[case::at_the_lower_threshold([2_000.0, 2_000.0], [1_980.0, 1_980.0], None)]
    #[case::the_mean_alone([2_000.0, 2_500.0], [2_100.0, 2_500.0], Some(("mean", 5.0)))]
    #[case::the_same([2_000.0, 2_500.0], [2_000.0, 2_500.0], None)]
    fn reports_a_change_of_more_than_a_percent(
        #[case] then: [f64; 2],
        #[case] now: [f64; 2],
        #[case] expected: Option<(&str, f64)>,
    ) {
        let trend = trend(vec![earlier("old", then, now)]);
        let change = trend.significant_change().map(|change| (change.statistic, (change.percent * 1e6).round() / 1e6));
        assert_eq!(change, expected);
    }

    #[test]
    fn prefers_another_build_for_the_comparison() {
        let (same, old) = (earlier("new", [9.0; 2], [9.0; 2]), earlier("old", [5.0; 2], [9.0; 2]));
        let older = EarlierCost { run: None, started: None, ..earlier("older", [1.0; 2], [9.0; 2]) };
        assert_eq!(trend(vec![same.clone(), old.clone(), older]).comparison_run(), Some(&old));
        assert_eq!(trend(vec![same.clone(), same.clone()]).comparison_run(), Some(&same));
        assert_eq!(trend(Vec::new()).significant_change(), None);
    }
}
