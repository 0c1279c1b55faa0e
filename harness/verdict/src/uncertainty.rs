//! Combines measurement uncertainties (GUM, JCGM 100:2008) and decides on conformity with them
//! (JCGM 106:2012, ILAC-G8:09/2019).
//!
//! The components uᵢ are independent and contain their sensitivities, so `u² = Σ uᵢ²`. The
//! effective degrees of freedom are `ν = u⁴ / Σ uᵢ⁴/νᵢ` (Welch and Satterthwaite; G.4). The
//! expanded uncertainty for a coverage p is `U = t_ν((1 + p)/2) u`.

mod bench;
mod budget;

use crate::statistics::student_quantile;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use statrs::distribution::{ContinuousCDF, Normal, StudentsT};

pub use bench::ErrorOrigin;
pub(crate) use bench::has_moving_modes;
pub use budget::{Budget, Component, ComponentKind, Distribution, Instrument, QuantityBudget, known_quantities};

/// For more degrees of freedom, Student's t equals the normal distribution to 1e-8.
const MAX_FREEDOM: f64 = 1e7;

/// Standard uncertainty that was evaluated from observations (JCGM 100:2008, 4.2).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TypeA {
    pub standard: f64,
    pub degrees_of_freedom: f64,
}

impl TypeA {
    /// Standard uncertainty of the mean of `values`. `None` for fewer than two values.
    pub fn of_mean(values: &[f64]) -> Option<Self> {
        let single = Self::of_single(values)?;
        Some(Self { standard: single.standard / (values.len() as f64).sqrt(), ..single })
    }

    /// Standard uncertainty of one value from the scatter of all; `None` for fewer than two.
    pub fn of_single(values: &[f64]) -> Option<Self> {
        let count = values.len() as f64;
        let mean = values.iter().sum::<f64>() / count;
        let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
        let degrees_of_freedom = count - 1.0;
        (values.len() > 1).then(|| Self { standard: (squares / degrees_of_freedom).sqrt(), degrees_of_freedom })
    }

    /// Standard uncertainty `s/√(2(n − 1))` of the standard deviation s of n normal values. `None`
    /// for fewer than two values.
    pub fn of_stated_deviation(deviation: f64, count: usize) -> Option<Self> {
        let degrees_of_freedom = count.checked_sub(1).filter(|freedom| *freedom > 0)? as f64;
        Some(Self { standard: deviation / (2.0 * degrees_of_freedom).sqrt(), degrees_of_freedom })
    }
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Contribution {
    pub kind: ComponentKind,
    pub distribution: Distribution,
    /// Standard uncertainty in the unit of the quantity.
    pub standard: f64,
    /// Degrees of freedom; `null` in the file if unlimited.
    pub degrees_of_freedom: Option<f64>,
    pub source: String,
    pub date: String,
    pub instrument: Option<String>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct CombinedUncertainty {
    pub standard: f64,
    /// Effective degrees of freedom; `null` in the file if unlimited.
    pub degrees_of_freedom: Option<f64>,
    pub coverage: f64,
    pub coverage_factor: f64,
    pub expanded: f64,
    pub contributions: Vec<Contribution>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum EvaluationError {
    #[error("the budget takes the repeatability from the trials, which needs two or more trials")]
    NoRepeatability,
    #[error("the value is not a finite number, so it has no uncertainty")]
    NoValue,
}

impl Component {
    /// Standard uncertainty and degrees of freedom. `None` if they come from trials that were not
    /// observed.
    fn evaluate(&self, value: f64, observed: Option<TypeA>) -> Option<(f64, f64)> {
        match (self.standard, observed) {
            (Some(standard), _) if self.is_percent_of_value => {
                Some((standard / 100.0 * value.abs(), self.degrees_of_freedom))
            }
            (Some(standard), _) => Some((standard, self.degrees_of_freedom)),
            (None, observed) => observed.map(|observed| (observed.standard, observed.degrees_of_freedom)),
        }
    }
}

impl QuantityBudget {
    /// `observed` is the repeatability from trials, used if the budget states none.
    pub fn combine(
        &self,
        value: f64,
        observed: Option<TypeA>,
        coverage: f64,
    ) -> Result<CombinedUncertainty, EvaluationError> {
        if !value.is_finite() {
            return Err(EvaluationError::NoValue);
        }
        let mut contributions = Vec::with_capacity(self.components.len());
        for component in &self.components {
            let (standard, freedom) = component.evaluate(value, observed).ok_or(EvaluationError::NoRepeatability)?;
            contributions.push(Contribution {
                kind: component.kind,
                distribution: component.distribution,
                standard,
                degrees_of_freedom: freedom.is_finite().then_some(freedom),
                source: component.source.clone(),
                date: component.date.to_string(),
                instrument: component.instrument.clone(),
            });
        }
        Ok(CombinedUncertainty::of(contributions, coverage))
    }
}

impl CombinedUncertainty {
    pub fn of(contributions: Vec<Contribution>, coverage: f64) -> Self {
        let squares: f64 = contributions.iter().map(|part| part.standard.powi(2)).sum();
        let limited = contributions.iter().filter_map(|part| Some(part.standard.powi(4) / part.degrees_of_freedom?));
        let freedom = squares.powi(2) / limited.sum::<f64>();
        let degrees_of_freedom = (squares > 0.0 && freedom.is_finite()).then_some(freedom);
        let standard = squares.sqrt();
        let coverage_factor = quantile(degrees_of_freedom, f64::midpoint(1.0, coverage));
        Self {
            standard,
            degrees_of_freedom,
            coverage,
            coverage_factor,
            expanded: coverage_factor * standard,
            contributions,
        }
    }

    /// Distance that an error exceeds on one side with this probability.
    pub fn one_sided_reach(&self, probability: f64) -> f64 {
        quantile(self.degrees_of_freedom, 1.0 - probability) * self.standard
    }

    pub fn probability_above(&self, value: f64, limit: f64) -> f64 {
        let distance = limit - value;
        if self.standard <= 0.0 {
            return if distance < 0.0 { 1.0 } else { 0.0 };
        }
        survival(self.degrees_of_freedom, distance / self.standard)
    }
}

fn student(degrees_of_freedom: Option<f64>) -> Option<StudentsT> {
    let freedom = degrees_of_freedom.filter(|freedom| *freedom < MAX_FREEDOM)?;
    StudentsT::new(0.0, 1.0, freedom).ok()
}

fn quantile(degrees_of_freedom: Option<f64>, probability: f64) -> f64 {
    student_quantile(degrees_of_freedom.unwrap_or(f64::INFINITY), probability)
}

fn survival(degrees_of_freedom: Option<f64>, place: f64) -> f64 {
    student(degrees_of_freedom).map_or_else(|| Normal::standard().sf(place), |t| t.sf(place))
}

/// Decision rule.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema, strum::IntoStaticStr, strum::Display,
)]
#[strum(const_into_str, serialize_all = "kebab-case")]
#[serde(rename_all = "kebab-case")]
pub enum DecisionRule {
    /// The value must meet the limit. The record states the uncertainty, which changes no verdict.
    Simple,
    /// The value must meet the limit with a guard band. A false acceptance then has a probability
    /// below 2.5 %.
    Guarded,
    /// The value must meet the limit, and the expanded uncertainty must be small enough. Both
    /// parties share the risk.
    SharedRisk,
}

impl DecisionRule {
    pub const fn name(self) -> &'static str {
        self.into_str()
    }
}

/// Probability that a normal error exceeds 2 standard deviations on one side. It is below 2.5 % as
/// a reserve, because the Welch-Satterthwaite equation is an approximation.
pub const GUARD_PROBABILITY: f64 = 0.022_75;

/// Result of a decision rule for a value that meets its limits.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Conformity {
    Accepted,
    /// The distance from the value to the limit is smaller than the guard band.
    WithinGuardBand {
        guard_band: f64,
    },
    /// The expanded uncertainty is `share_percent` of the tolerance; allowed is `largest_percent`.
    TooUncertain {
        share_percent: f64,
        largest_percent: f64,
    },
}

/// `range` contains the smallest and the largest conforming value, and `value` must be within it.
/// For [`DecisionRule::SharedRisk`] the expanded uncertainty must be at most `largest_percent` of
/// `tolerance`, the scale of the limit.
pub fn decide(
    rule: DecisionRule,
    value: f64,
    uncertainty: &CombinedUncertainty,
    range: (f64, f64),
    tolerance: f64,
    largest_percent: f64,
) -> Conformity {
    match rule {
        DecisionRule::Simple => Conformity::Accepted,
        DecisionRule::Guarded => {
            let guard_band = uncertainty.one_sided_reach(GUARD_PROBABILITY);
            // The comparison is false for NaN, so NaN is not accepted.
            let is_inside = range.0 + guard_band <= value && value <= range.1 - guard_band;
            if is_inside { Conformity::Accepted } else { Conformity::WithinGuardBand { guard_band } }
        }
        DecisionRule::SharedRisk => {
            let share_percent = uncertainty.expanded / tolerance.abs() * 100.0;
            if share_percent <= largest_percent {
                Conformity::Accepted
            } else {
                Conformity::TooUncertain { share_percent, largest_percent }
            }
        }
    }
}

#[cfg(test)]
mod tests;
