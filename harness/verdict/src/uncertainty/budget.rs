//! Defines a checked uncertainty budget: instruments, and the components of each quantity.

use jiff::civil::Date;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum ComponentKind {
    SensorGain,
    SensorOffset,
    /// Steps and nonlinearity of the converters.
    Converter,
    /// Amplitude and phase of the demodulator.
    Demodulator,
    /// Temperature of plate and sensor.
    Temperature,
    /// Clock and jitter.
    Timing,
    /// Error of the bench's own model and arithmetic.
    Bench,
    /// Scatter of repeated trials. Without a magnitude in the budget it is computed from the
    /// trials.
    Repeatability,
}

/// Distribution of a component. The half width a gives the standard uncertainty u (JCGM
/// 100:2008, 4.3).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Distribution {
    Normal,
    /// u = a/√3.
    Rectangular,
    /// u = a/√6.
    Triangular,
    /// Arcsine distribution of a sinusoidal influence, u = a/√2.
    UShaped,
}

impl Distribution {
    /// `None` for a normal distribution, which has no half width.
    pub fn standard_of_half_width(self) -> Option<f64> {
        match self {
            Self::Normal => None,
            Self::Rectangular => Some(3.0_f64.sqrt().recip()),
            Self::Triangular => Some(6.0_f64.sqrt().recip()),
            Self::UShaped => Some(2.0_f64.sqrt().recip()),
        }
    }
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Instrument {
    pub name: String,
    pub serial: String,
    pub certificate: Option<String>,
    pub calibrated: Date,
    /// Last day on which the calibration is valid.
    pub due: Date,
}

impl Instrument {
    pub fn is_valid_on(&self, day: Date) -> bool {
        (self.calibrated..=self.due).contains(&day)
    }
}

#[derive(Debug, Clone, PartialEq)]
pub struct Component {
    pub kind: ComponentKind,
    pub distribution: Distribution,
    /// Standard uncertainty in the unit of the quantity or in percent of its value. `None` if it is
    /// computed from the trials.
    pub standard: Option<f64>,
    pub is_percent_of_value: bool,
    /// Degrees of freedom; infinite if the budget states none.
    pub degrees_of_freedom: f64,
    pub source: String,
    pub date: Date,
    pub instrument: Option<String>,
}

#[derive(Debug, Clone, PartialEq)]
pub struct QuantityBudget {
    pub quantity: String,
    pub components: Vec<Component>,
}

#[derive(Debug, Clone, PartialEq)]
pub struct Budget {
    pub bytes: Vec<u8>,
    pub title: String,
    /// Probability that the expanded uncertainty contains the true value, 0 to 1.
    pub coverage: f64,
    pub instruments: Vec<Instrument>,
    pub quantities: Vec<QuantityBudget>,
}

impl Budget {
    pub fn quantity(&self, name: &str) -> Option<&QuantityBudget> {
        self.quantities.iter().find(|budget| budget.quantity == name)
    }

    pub fn expired_on(&self, day: Date) -> impl Iterator<Item = &Instrument> {
        self.instruments.iter().filter(move |instrument| !instrument.is_valid_on(day))
    }
}
