//! Limits the values of `search` and `rare` to those that the scenario accepts.
//!
//! Normal distributions are truncated, one variable at a time. This equals the rule of the other
//! methods, which draw a refused normal value again. Combinations of accepted values are checked at
//! the corners of the range.

use crate::campaign::distribution::Variable;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Largest number of corners that are checked.
const MAX_CORNERS: u128 = 256;

/// A normal distribution that the scenario truncates.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Truncation {
    pub key: String,
    /// Smallest and largest value that is played.
    pub range: [f64; 2],
    /// Share of the distribution outside `range`.
    pub excluded: f64,
}

impl Truncation {
    pub fn line(&self) -> String {
        let Self { key, range: [low, high], excluded } = self;
        format!(
            "`{key}` is truncated to {low} to {high}, because the scenario refuses other values; this excludes \
             {excluded:.2e} of its distribution"
        )
    }
}

/// Truncates the normal distributions. `is_accepted` receives the key of a variable and its value;
/// the other values are those of the scenario.
pub(crate) fn truncate_to_accepted(
    variables: &mut [Variable],
    deviations: f64,
    is_accepted: &dyn Fn(&str, f64) -> bool,
) -> Vec<Truncation> {
    let truncate = |Variable { key, distribution }: &mut Variable| {
        let (range, excluded) = distribution.truncate_to(deviations, &|value| is_accepted(key, value))?;
        Some(Truncation { key: key.clone(), range, excluded })
    };
    variables.iter_mut().filter_map(truncate).collect()
}

/// Combinations of the extreme values of all variables, at most [`MAX_CORNERS`].
pub(crate) fn corners(variables: &[Variable], deviations: f64) -> impl Iterator<Item = Vec<f64>> {
    let extremes: Vec<Vec<f64>> = variables.iter().map(|variable| variable.distribution.extremes(deviations)).collect();
    let count = extremes.iter().fold(1_u128, |count, values| count.saturating_mul(values.len() as u128));
    let checked = count.min(MAX_CORNERS);
    (0..checked).map(move |number| {
        // Spreads the numbers evenly, from the first to the last corner.
        let (step, rest) = ((count - 1) / (checked - 1).max(1), (count - 1) % (checked - 1).max(1));
        let mut place = number * step + number * rest / (checked - 1).max(1);
        let mut corner = Vec::with_capacity(extremes.len());
        for values in &extremes {
            let length = values.len().max(1) as u128;
            corner.push(values.get((place % length) as usize).copied().unwrap_or_default());
            place /= length;
        }
        corner
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::campaign::distribution::RawDistribution;

    fn variable(text: &str) -> Variable {
        let table: toml::Table = toml::from_str(&format!("x = {text}")).unwrap();
        let raw: RawDistribution = table["x"].clone().try_into().unwrap();
        Variable { key: text.to_owned(), distribution: raw.check().unwrap() }
    }

    fn truncate(text: &str, accepted: std::ops::RangeInclusive<f64>) -> Option<(Truncation, Variable)> {
        let mut variables = [variable(text)];
        let mut truncated = truncate_to_accepted(&mut variables, 8.0, &|_, value| accepted.contains(&value));
        let [variable] = variables;
        truncated.pop().map(|truncation| (truncation, variable))
    }

    #[test]
    fn the_ends_are_those_of_the_accepted_range() {
        let (truncation, variable) = truncate("{ normal = { mean = 1.0, sd = 0.5 } }", 0.0..=1.7).unwrap();
        assert_eq!(truncation.range, [0.0, 1.7]);
        // Φ(−2) + Φ(−1.4)
        assert!((truncation.excluded - 0.103_506_8).abs() < 1e-7, "{truncation:?}");
        let ends = [-8.0, 8.0].map(|score| variable.distribution.at_score(score));
        assert!((0.0..1e-9).contains(&ends[0]) && (1.7 - 1e-9..=1.7).contains(&ends[1]), "{ends:?}");
        // The median of the rest: Φ⁻¹((Φ(−2) + Φ(1.4))/2) = −0.072765
        assert!((variable.distribution.at_score(0.0) - 0.963_618).abs() < 1e-4);
        assert_eq!(truncate("{ normal = { mean = 1.0, sd = 0.5 } }", -3.0..=5.0), None);
        assert_eq!(truncate("{ uniform = [0.0, 9.0] }", 0.0..=1.0), None);
    }

    #[test]
    fn a_given_truncation_is_narrowed() {
        let text = "{ normal = { mean = 1.0, sd = 0.5, truncate = [-1.0, 2.0] } }";
        let (truncation, _) = truncate(text, 0.0..=5.0).unwrap();
        assert_eq!(truncation.range, [0.0, 2.0]);
        // (Φ(−2) − Φ(−4))/(Φ(2) − Φ(−4))
        assert!((truncation.excluded - 0.023_247_1).abs() < 1e-6, "{truncation:?}");
        let (truncation, _) = truncate("{ lognormal = { mean = 1.0, sd = 0.5 } }", 0.5..=9.0).unwrap();
        assert!((truncation.range[0] - 0.5).abs() < 1e-9 && truncation.range[0] >= 0.5, "{truncation:?}");
    }

    #[test]
    fn corners_include_the_first_and_the_last_one() {
        let variables: Vec<_> = (0..10).map(|_| variable("{ uniform = [0.0, 9.0] }")).collect();
        let corners: Vec<_> = corners(&variables, 8.0).collect();
        assert_eq!(corners.len(), 256);
        assert_eq!(corners.first(), Some(&vec![0.0; 10]));
        assert!(corners.iter().any(|corner| *corner == [9.0; 10]), "{:?}", corners.last());
        let few = [variable("{ each = [\"a\", \"b\", \"c\"] }"), variable("{ steps = [0.0, 1.0, 5] }")];
        assert_eq!(super::corners(&few, 8.0).count(), 6);
    }
}
