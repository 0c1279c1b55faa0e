//! Lists the metrics. A file below defines each metric with its computation.

mod band_entry;
mod control_instants;
mod deviation;
mod drive;
mod enable_pin;
mod firmware_text;
mod input;
mod last_row;
mod measurement;
mod reported;
mod ripple;
mod shutdown_time;
mod spec;
mod window_mean;

pub(crate) use input::band_around;
pub use input::{EnablePin, FirmwareLog, MeasureInput, MetricSignal, OutputRead, RigReports, setpoint_steps};
pub use measurement::{Measure, Measurement, MissingValue, SignalPoint, UndefinedValue};
pub use spec::{
    DriveBound, ElapsedLabels, Levels, LimitMarkSpec, MetricSpec, Subject, TrialRule, Unit, ValidIf, WindowRule,
};

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::fmt;

macro_rules! metrics {
    ($($metric:ident => $module:ident::$spec:ident,)+) => {
        /// A quantity that is measured in a trial or over trials. Definitions: `docs/verdicts.md`.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub enum Metric {
            $($metric,)+
        }

        impl Metric {
            pub const ALL: &[Self] = &[$(Self::$metric),+];
            pub const NAMES: &[&str] = &[$($module::$spec.name),+];

            pub const fn spec(self) -> &'static MetricSpec {
                match self {
                    $(Self::$metric => &$module::$spec,)+
                }
            }
        }
    };
}

metrics! {
    SettlingTime => band_entry::SETTLING_TIME,
    StaticError => window_mean::STATIC_ERROR,
    Repeatability => window_mean::REPEATABILITY,
    Overshoot => deviation::OVERSHOOT,
    PeakDeviation => deviation::PEAK_DEVIATION,
    RecoveryTime => band_entry::RECOVERY_TIME,
    FrequencyError => last_row::FREQUENCY_ERROR,
    QuadratureRatio => last_row::QUADRATURE_RATIO,
    FinalAmplitude => last_row::FINAL_AMPLITUDE,
    DrivePeak => drive::DRIVE_PEAK,
    Saturated => drive::SATURATED,
    LoopDelay => reported::LOOP_DELAY,
    InstructionsPerStep => reported::INSTRUCTIONS_PER_STEP,
    StepTime => reported::STEP_TIME,
    Overruns => control_instants::OVERRUNS,
    ShutdownTime => shutdown_time::SHUTDOWN_TIME,
    EnableOff => enable_pin::ENABLE_OFF,
    Text => firmware_text::TEXT,
    MissedReplies => control_instants::MISSED_REPLIES,
    RipplePercent => ripple::PERCENT,
    Ripple => ripple::MICROMETRES,
    RestDrive => drive::REST_DRIVE,
    TrialDifference => control_instants::TRIAL_DIFFERENCE,
    ReferenceDifference => reported::REFERENCE_DIFFERENCE,
    ProtocolDifferences => reported::PROTOCOL_DIFFERENCES,
}

impl Metric {
    pub const fn name(self) -> &'static str {
        self.spec().name
    }

    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.iter().copied().find(|metric| metric.name() == name)
    }

    pub const fn has_band(self) -> bool {
        self.spec().takes_band
    }

    pub const fn has_signal(self) -> bool {
        self.spec().takes_signal
    }

    pub const fn has_text(self) -> bool {
        matches!(self, Self::Text)
    }

    pub const fn has_window_ms(self) -> bool {
        matches!(self.spec().window, WindowRule::ConstantSetpoint)
    }

    /// True if the keys `from_ms` and `until_ms` apply. The other metrics cover the whole trial.
    pub const fn has_from_ms(self) -> bool {
        !matches!(self.spec().window, WindowRule::WholeTrial)
    }

    /// True if the key `over` (statistic over trials) applies. The others compare trials already.
    pub const fn has_over(self) -> bool {
        matches!(self.spec().trials, TrialRule::Each | TrialRule::Mean)
    }
}

impl fmt::Display for Metric {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.pad(self.name())
    }
}

impl JsonSchema for Metric {
    fn schema_name() -> std::borrow::Cow<'static, str> {
        "Metric".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({ "type": "string", "enum": Self::NAMES })
    }
}

impl Serialize for Metric {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}

impl<'de> Deserialize<'de> for Metric {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let name = String::deserialize(deserializer)?;
        Self::from_name(&name).ok_or_else(|| D::Error::custom(format!("unknown metric `{name}`")))
    }
}
