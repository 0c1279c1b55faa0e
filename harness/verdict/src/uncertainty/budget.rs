//! Defines an uncertainty budget (instruments, and the components of each quantity), and reads it
//! from a TOML file.

use jiff::civil::Date;
use platebench_model::scenario::{Diagnostic, FileChecker, Metric};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::path::Path;

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

#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
struct RawBudget {
    title: String,
    /// Coverage probability of the expanded uncertainty, percent.
    #[serde(default = "default_coverage")]
    #[schemars(range(min = 50.0, max = 99.9))]
    coverage_percent: f64,
    #[serde(default)]
    instrument: Vec<RawInstrument>,
    #[serde(default)]
    budget: Vec<RawQuantity>,
}

const fn default_coverage() -> f64 {
    95.0
}

#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
struct RawInstrument {
    name: String,
    serial: String,
    certificate: Option<String>,
    calibrated: String,
    due: String,
}

#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
struct RawQuantity {
    quantity: String,
    #[serde(default)]
    component: Vec<RawComponent>,
}

#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
struct RawComponent {
    kind: ComponentKind,
    distribution: Distribution,
    #[schemars(range(min = 0.0))]
    standard: Option<f64>,
    #[schemars(range(min = 0.0))]
    half_width: Option<f64>,
    #[schemars(range(min = 0.0))]
    expanded: Option<f64>,
    #[schemars(range(min = 0.5, max = 10.0))]
    coverage_factor: Option<f64>,
    #[serde(default)]
    percent_of_value: bool,
    #[serde(default = "default_sensitivity")]
    sensitivity: f64,
    #[schemars(range(min = 1.0, max = 1e9))]
    degrees_of_freedom: Option<f64>,
    source: String,
    date: String,
    instrument: Option<String>,
}

const fn default_sensitivity() -> f64 {
    1.0
}

/// Plate parameters that `platebench identify` estimates.
const PLATE_QUANTITIES: [&str; 4] = ["gain_um_per_vpp", "time_constant_s", "resonance_hz", "slope_hz_per_k"];

pub fn known_quantities() -> Vec<&'static str> {
    Metric::NAMES.iter().copied().chain(PLATE_QUANTITIES).collect()
}

impl Budget {
    /// Returns the budget or all problems of the file. `quantities` are the accepted names.
    pub fn load(path: &Path, quantities: &[&str]) -> Result<Self, Vec<Diagnostic>> {
        let (checker, raw) = FileChecker::read::<RawBudget>(path)?;
        let mut checker = BudgetChecker { checker, quantities };
        let budget = checker.check(raw);
        checker.checker.finish().map(|text| Self { bytes: text.into_bytes(), ..budget })
    }
}

struct BudgetChecker<'a> {
    checker: FileChecker,
    quantities: &'a [&'a str],
}

impl BudgetChecker<'_> {
    fn report(&mut self, key: &str, message: String) {
        self.checker.report(key, message);
    }

    /// The budget has no bytes yet.
    fn check(&mut self, raw: RawBudget) -> Budget {
        self.check_text("title", &raw.title);
        if raw.budget.is_empty() {
            self.report("budget", "no [[budget]], expected at least one".to_owned());
        }
        let instruments: Vec<Instrument> =
            raw.instrument.into_iter().enumerate().map(|(number, raw)| self.instrument(number, raw)).collect();
        let mut known = BTreeSet::new();
        for (number, instrument) in instruments.iter().enumerate() {
            if !known.insert(&instrument.name) {
                self.report(
                    &format!("instrument.{number}.name"),
                    format!("two instruments have the name `{}`", instrument.name),
                );
            }
        }
        let mut seen = BTreeSet::new();
        let mut quantities = Vec::new();
        for (number, raw) in raw.budget.into_iter().enumerate() {
            let key = format!("budget.{number}");
            if !self.quantities.contains(&raw.quantity.as_str()) {
                let message = format!("`{}`, expected one of {}", raw.quantity, self.quantities.join(", "));
                self.report(&format!("{key}.quantity"), message);
            } else if !seen.insert(raw.quantity.clone()) {
                self.report(&format!("{key}.quantity"), format!("`{}` has two budgets", raw.quantity));
            }
            if raw.component.is_empty() {
                self.report(&key, "no [[budget.component]], expected at least one".to_owned());
            }
            let components = raw.component.into_iter().enumerate();
            let components = components
                .map(|(index, raw)| self.component(&format!("{key}.component.{index}"), raw, &known))
                .collect();
            quantities.push(QuantityBudget { quantity: raw.quantity, components });
        }
        let coverage = raw.coverage_percent / 100.0;
        Budget { bytes: Vec::new(), title: raw.title, coverage, instruments, quantities }
    }

    fn check_text(&mut self, key: &str, text: &str) {
        if text.trim().is_empty() {
            self.report(key, "empty, expected a text".to_owned());
        }
    }

    /// Reports an invalid date.
    fn date(&mut self, key: &str, text: &str) -> Option<Date> {
        let date = text.parse().ok();
        self.checker.require(date.is_some(), key, || format!("`{text}`, expected a date, such as \"2026-03-01\""));
        date
    }

    fn instrument(&mut self, number: usize, raw: RawInstrument) -> Instrument {
        let key = |name: &str| format!("instrument.{number}.{name}");
        self.check_text(&key("name"), &raw.name);
        self.check_text(&key("serial"), &raw.serial);
        let calibrated = self.date(&key("calibrated"), &raw.calibrated);
        let due = self.date(&key("due"), &raw.due);
        if let (Some(calibrated), Some(due)) = (calibrated, due)
            && due < calibrated
        {
            self.report(
                &key("due"),
                format!("{due} is before the calibration on {calibrated}; expected the last day on which it is valid"),
            );
        }
        let [calibrated, due] = [calibrated, due].map(Option::unwrap_or_default);
        Instrument { name: raw.name, serial: raw.serial, certificate: raw.certificate, calibrated, due }
    }

    fn component(&mut self, key: &str, raw: RawComponent, instruments: &BTreeSet<&String>) -> Component {
        let at = |name: &str| format!("{key}.{name}");
        self.check_text(&at("source"), &raw.source);
        let date = self.date(&at("date"), &raw.date).unwrap_or_default();
        if let Some(name) = raw.instrument.as_ref().filter(|name| !instruments.contains(name)) {
            self.report(&at("instrument"), format!("there is no [[instrument]] with the name `{name}`"));
        }
        if raw.sensitivity == 0.0 {
            self.report(&at("sensitivity"), format!("{}, expected a finite number other than 0", raw.sensitivity));
        }
        if raw.coverage_factor.is_some() && raw.expanded.is_none() {
            let message = "a coverage factor belongs to `expanded`, which is missing";
            self.report(&at("coverage_factor"), message.to_owned());
        }
        let standard = self.standard(key, &raw);
        Component {
            kind: raw.kind,
            distribution: raw.distribution,
            standard: standard.map(|standard| standard * raw.sensitivity.abs()),
            is_percent_of_value: raw.percent_of_value,
            degrees_of_freedom: raw.degrees_of_freedom.unwrap_or(f64::INFINITY),
            source: raw.source,
            date,
            instrument: raw.instrument,
        }
    }

    fn standard(&mut self, key: &str, raw: &RawComponent) -> Option<f64> {
        match (raw.standard, raw.half_width, raw.expanded, raw.distribution.standard_of_half_width()) {
            (Some(standard), None, None, _) => Some(standard),
            (None, Some(half_width), None, Some(factor)) => Some(half_width * factor),
            (None, Some(_), None, None) => {
                let message = "a normal distribution has no half width, expected `standard` or `expanded`".to_owned();
                self.report(&format!("{key}.half_width"), message);
                None
            }
            (None, None, Some(expanded), None) => Some(expanded / raw.coverage_factor.unwrap_or(2.0)),
            (None, None, Some(_), Some(_)) => {
                let message =
                    "`expanded` is only for a normal distribution, expected `half_width` or `standard`".to_owned();
                self.report(&format!("{key}.expanded"), message);
                None
            }
            (None, None, None, _) if raw.kind == ComponentKind::Repeatability => None,
            _ => {
                let message = "expected exactly one of `standard`, `half_width` and `expanded`".to_owned();
                self.report(&format!("{key}.kind"), message);
                None
            }
        }
    }
}

#[cfg(test)]
mod tests;
