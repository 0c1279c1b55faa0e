//! Defines the entry of the metric table: everything that the bench needs to know about a metric.

use super::input::MeasureInput;
use super::measurement::{Measurement, UndefinedValue};
use crate::trace::Column;

/// A metric. `DEFAULT` has the properties of a number of the plate over the whole trial, smaller
/// values are better.
#[derive(Debug, Clone, Copy)]
#[expect(clippy::struct_excessive_bools, reason = "each is a property of its own")]
pub struct MetricSpec {
    pub name: &'static str,
    pub unit: Unit,
    /// Row of the table in `docs/verdicts.md`, in Markdown.
    pub definition: &'static str,
    /// Smallest and largest possible value. A limit must exclude a part of it.
    pub value_range: (f64, f64),
    pub window: WindowRule,
    pub trials: TrialRule,
    pub subject: Subject,
    /// True for the key `band_percent`.
    pub takes_band: bool,
    /// True for the key `signal`.
    pub takes_signal: bool,
    /// True if the metric has no value in a window with the setpoint 0.
    pub needs_setpoint: bool,
    /// True if the value of a trial has a sign. It is judged without it.
    pub is_signed: bool,
    pub valid_if: ValidIf,
    /// Why the metric has no value on a real plate.
    pub on_real_plate: Option<UndefinedValue>,
    pub drive_bound: DriveBound,
    /// Error of the simulation, in the unit of the metric.
    pub simulation_error: f64,
    pub mark: Option<LimitMarkSpec>,
    pub elapsed: Option<ElapsedLabels>,
    pub measure: fn(&MeasureInput<'_>) -> Result<Measurement, UndefinedValue>,
}

impl MetricSpec {
    pub(crate) const DEFAULT: Self = Self {
        name: "",
        unit: Unit::Count,
        definition: "",
        value_range: (0.0, f64::INFINITY),
        window: WindowRule::Any,
        trials: TrialRule::Each,
        subject: Subject::Plate,
        takes_band: false,
        takes_signal: false,
        needs_setpoint: false,
        is_signed: false,
        valid_if: ValidIf::Running,
        on_real_plate: None,
        drive_bound: DriveBound::None,
        simulation_error: 0.0,
        mark: None,
        elapsed: None,
        measure: |_| Err(UndefinedValue::NotReported),
    };

    /// The value as it is compared with a limit.
    pub fn judged(&self, value: f64) -> f64 {
        if self.is_signed { value.abs() } else { value }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unit {
    Milliseconds,
    Microseconds,
    Micrometres,
    Hertz,
    /// Volts, peak to peak.
    Vpp,
    Percent,
    Ratio,
    Count,
}

impl Unit {
    /// Empty for a ratio or a count.
    pub const fn symbol(self) -> &'static str {
        match self {
            Self::Milliseconds => "ms",
            Self::Microseconds => "µs",
            Self::Micrometres => "µm",
            Self::Hertz => "Hz",
            Self::Vpp => "Vpp",
            Self::Percent => "%",
            Self::Ratio | Self::Count => "",
        }
    }
}

/// Where a metric is judged, and which keys select the window.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WindowRule {
    /// `from_ms`, `until_ms` or `after`; without them the whole trial.
    Any,
    /// As `Any`, but one of the keys is required.
    Required,
    /// As `Any`, or `window_ms`. The setpoint is constant in the window. The default is the last
    /// third.
    ConstantSetpoint,
    /// From a setpoint step to the next one.
    StepResponse,
    /// From a disturbance at `from_ms`, which is required, until the controller starts again.
    FromDisturbance,
    /// The parts of the window in which the setpoint is 0.
    SetpointZero,
    /// Always the whole trial.
    WholeTrial,
}

/// How the values of trials become one value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TrialRule {
    /// The key `over` selects the statistic. The default judges each trial.
    Each,
    /// The key `over` selects the statistic. The default is the mean.
    Mean,
    /// The standard deviation over trials. A single trial has no value.
    Deviation,
    /// The largest difference from the first trial. A single trial has no value.
    FromFirst,
}

/// What a metric says something about.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Subject {
    /// The motion of the plate or its drive.
    Plate,
    /// Messages or computing time of the controller.
    Controller,
    /// The line and the bench, so a miss is not the controller's failure.
    Rig,
}

/// State of the controller in which a trial has a value.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum ValidIf {
    /// The controller runs at the end. A plate at rest could not overshoot.
    Running,
    /// The controller may have stopped, but was not lost.
    Present,
}

/// How an ideal controller shows that the amplifier makes a limit unreachable.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DriveBound {
    /// The drive limit excuses nothing.
    None,
    /// The ideal controller has the smallest possible value.
    Smallest,
    /// The ideal controller has the largest possible value.
    Largest,
    /// The mean of the ideal controller is below the setpoint.
    MeanBelowSetpoint,
}

/// How a figure draws the limit and the worst instants.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LimitMarkSpec {
    /// `None` for the signal of the expectation.
    pub signal: Option<Column>,
    pub levels: Levels,
    /// Meaning of the worst instants, such as `mean` or `end`.
    pub label: &'static str,
}

/// Where the ends of a limit lie in a figure of the signal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Levels {
    None,
    /// At the ends themselves.
    Constant,
    /// At the edges of the band of the expectation.
    Band,
    /// At the setpoint ± the ends in percent.
    PercentOfSetpoint,
    /// As `PercentOfSetpoint`, with the worst value as a line.
    PercentOfSetpointAndValue,
    /// At the new setpoint + the ends in percent of the step.
    PercentOfStep,
    /// At the column ± the ends.
    Around(Column),
    /// At ± the ends times the column.
    TimesColumn(Column),
}

/// Labels of the time from `from_ms` to the event that the metric measures.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ElapsedLabels {
    pub reached: &'static str,
    pub not_reached: &'static str,
    pub is_on_drive: bool,
}
