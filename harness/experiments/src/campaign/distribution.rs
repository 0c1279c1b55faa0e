//! Defines varied values, their distributions and their correlations.

use schemars::JsonSchema;
use serde::Deserialize;
use statrs::function::erf::{erfc, erfc_inv};
use std::f64::consts::SQRT_2;
use std::fmt;
use toml::Value;

const MAX_STEPS: u32 = 1_000_000;

#[derive(Debug, Clone, PartialEq, Deserialize, JsonSchema)]
#[serde(untagged, expecting = "expected a number, a text, true or false")]
pub enum Choice {
    Integer(i64),
    Number(f64),
    Bool(bool),
    Text(String),
}

impl Choice {
    pub fn is_number(&self) -> bool {
        matches!(self, Self::Integer(_) | Self::Number(_))
    }

    pub fn number(&self) -> Option<f64> {
        match self {
            Self::Integer(value) => Some(*value as f64),
            Self::Number(value) => Some(*value),
            Self::Bool(_) | Self::Text(_) => None,
        }
    }
}

impl From<&Choice> for Value {
    fn from(choice: &Choice) -> Self {
        match choice {
            Choice::Integer(value) => Self::Integer(*value),
            Choice::Number(value) => Self::Float(*value),
            Choice::Bool(value) => Self::Boolean(*value),
            Choice::Text(value) => Self::String(value.clone()),
        }
    }
}

impl fmt::Display for Choice {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Integer(value) => value.fmt(formatter),
            Self::Number(value) => value.fmt(formatter),
            Self::Bool(value) => value.fmt(formatter),
            Self::Text(value) => value.fmt(formatter),
        }
    }
}

#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase", deny_unknown_fields)]
pub enum RawDistribution {
    /// Listed values.
    Each(#[schemars(length(min = 1))] Vec<Choice>),
    /// Equally spaced values: first value, last value, number of values.
    Steps(RawSteps),
    /// Uniform distribution: smallest and largest value.
    Uniform([f64; 2]),
    /// Normal distribution.
    Normal(RawNormal),
    /// Lognormal distribution. Mean and standard deviation are those of the value, not of its
    /// logarithm.
    Lognormal(RawNormal),
}

#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(expecting = "a list [from, to, number of values]")]
#[schemars(inline)]
pub struct RawSteps(f64, f64, #[schemars(with = "u32")] f64);

#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawNormal {
    /// Mean.
    mean: f64,
    /// Standard deviation. Exactly one of `sd` and `sd_percent` is required.
    #[schemars(extend("exclusiveMinimum" = 0))]
    sd: Option<f64>,
    /// Standard deviation, percent of the mean.
    #[schemars(extend("exclusiveMinimum" = 0))]
    sd_percent: Option<f64>,
    /// Smallest and largest value of a truncated distribution.
    truncate: Option<[f64; 2]>,
}

#[derive(Debug, Clone, PartialEq)]
pub enum Distribution {
    Choices(Vec<Choice>),
    Uniform([f64; 2]),
    Normal(NormalDistribution),
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NormalDistribution {
    mean: f64,
    sd: f64,
    truncate: Option<[f64; 2]>,
    /// True if the other fields describe the logarithm of the value.
    is_logarithm: bool,
}

impl RawDistribution {
    pub fn check(self) -> Result<Distribution, String> {
        match self {
            Self::Each(values) if values.is_empty() => Err("each = [], expected at least one value".to_owned()),
            Self::Each(values) => {
                let is_uniform = values.iter().all(Choice::is_number) || !values.iter().any(Choice::is_number);
                if !is_uniform {
                    return Err("`each` mixes numbers with other values, expected values of one type".to_owned());
                }
                if values.iter().any(|value| value.number().is_some_and(|number| !number.is_finite())) {
                    return Err("`each` has a value that is not finite, expected finite numbers".to_owned());
                }
                Ok(Distribution::Choices(values))
            }
            Self::Steps(RawSteps(from, to, count)) => {
                let is_single = count == 1.0 && from == to;
                let is_valid = is_single || (2.0..=f64::from(MAX_STEPS)).contains(&count);
                if !(from.is_finite() && to.is_finite() && is_valid && count.fract() == 0.0) {
                    return Err(format!(
                        "steps = [{from}, {to}, {count}], expected [from, to, number of values], with a whole number \
                         from 2 to {MAX_STEPS}, not a width"
                    ));
                }
                let count = count as u32;
                // The formula rounds. So the ends are copied, and the others have 15 digits: 0.2, not
                // 0.19999999999999998.
                let value = |index: u32| match index {
                    0 => from,
                    _ if index + 1 == count => to,
                    _ => {
                        let exact = from + (to - from) * f64::from(index) / f64::from(count - 1);
                        format!("{exact:.14e}").parse().unwrap_or(exact)
                    }
                };
                Ok(Distribution::Choices((0..count).map(|index| Choice::Number(value(index))).collect()))
            }
            Self::Uniform([low, high]) => {
                let holds = low.is_finite() && high.is_finite() && low < high;
                let error = || format!("uniform = [{low}, {high}], expected [low, high] with low below high");
                if holds { Ok(Distribution::Uniform([low, high])) } else { Err(error()) }
            }
            Self::Normal(raw) => raw.check().map(Distribution::Normal),
            Self::Lognormal(raw) => raw.check_lognormal().map(Distribution::Normal),
        }
    }
}

impl RawNormal {
    fn check(&self) -> Result<NormalDistribution, String> {
        let sd = match (self.sd, self.sd_percent) {
            (Some(sd), None) => sd,
            (None, Some(percent)) => self.mean.abs() * percent / 100.0,
            _ => return Err("expected exactly one of `sd` and `sd_percent`".to_owned()),
        };
        if !(self.mean.is_finite() && sd.is_finite() && sd > 0.0) {
            return Err(format!("normal with mean {} and sd {sd}, expected finite numbers and sd above 0", self.mean));
        }
        if let Some([low, high]) = self.truncate {
            let share = normal_cdf((high - self.mean) / sd) - normal_cdf((low - self.mean) / sd);
            if !(low < high && share > 1e-6) {
                return Err(format!(
                    "truncate = [{low}, {high}], expected [low, high] with a part of the distribution"
                ));
            }
        }
        Ok(NormalDistribution { mean: self.mean, sd, truncate: self.truncate, is_logarithm: false })
    }

    /// The logarithm is normal with `σ² = ln(1 + (sd/mean)²)` and `µ = ln mean − σ²/2`.
    fn check_lognormal(&self) -> Result<NormalDistribution, String> {
        let NormalDistribution { mean, sd, .. } = (Self { truncate: None, ..self.clone() }).check()?;
        if mean <= 0.0 || self.truncate.is_some_and(|[low, _]| low <= 0.0) {
            return Err(format!("lognormal with mean {mean}, expected a mean and a range above 0"));
        }
        let variance = (sd / mean).powi(2).ln_1p();
        let logarithm = Self {
            mean: mean.ln() - variance / 2.0,
            sd: Some(variance.sqrt()),
            sd_percent: None,
            truncate: self.truncate.map(|ends| ends.map(f64::ln)),
        };
        Ok(NormalDistribution { is_logarithm: true, ..logarithm.check()? })
    }
}

/// A search covers this number of standard deviations on both sides of the mean.
pub(crate) const SEARCH_DEVIATIONS: f64 = 4.0;
/// After this many bisections the end of a range is known to 10⁻¹³ standard deviations.
const MAX_BISECTIONS: u32 = 47;

pub(crate) fn normal_cdf(z: f64) -> f64 {
    0.5 * erfc(-z / SQRT_2)
}

pub(crate) fn normal_quantile(p: f64) -> f64 {
    -SQRT_2 * erfc_inv(2.0 * p)
}

impl NormalDistribution {
    fn at(&self, u: f64) -> f64 {
        let ends = self.truncate.map(|ends| ends.map(|end| normal_cdf((end - self.mean) / self.sd)));
        let [from, to] = ends.unwrap_or([0.0, 1.0]);
        self.value(self.mean + self.sd * normal_quantile(from + (to - from) * u))
    }

    fn at_score(&self, z: f64) -> f64 {
        let Some(ends) = self.truncate else { return self.value(self.mean + self.sd * z) };
        let [low, high] = ends.map(|end| (end - self.mean) / self.sd);
        // The tail beyond z keeps its digits, the probability near 1 does not.
        let (sign, ends) = if z > 0.0 { (-1.0, [-high, -low]) } else { (1.0, [low, high]) };
        let [from, to] = ends.map(normal_cdf);
        let score = normal_quantile(from + (to - from) * normal_cdf(-z.abs()));
        self.value(self.mean + self.sd * sign * score)
    }

    /// Truncates the distribution to the values up to `deviations` standard deviations from the
    /// mean that are accepted. Returns the ends and the excluded share, or `None` if all values are
    /// accepted.
    fn truncate_to(&mut self, deviations: f64, is_accepted: &dyn Fn(f64) -> bool) -> Option<([f64; 2], f64)> {
        let given = self.truncate.unwrap_or([f64::NEG_INFINITY, f64::INFINITY]);
        let edges = [-deviations, deviations].map(|score| (self.mean + self.sd * score).clamp(given[0], given[1]));
        if edges.iter().all(|edge| is_accepted(self.value(*edge))) {
            return None;
        }
        let ends = edges.map(|edge| self.accepted_end(edge, is_accepted));
        let share = |ends: [f64; 2]| {
            let [low, high] = ends.map(|end| (end - self.mean) / self.sd);
            // Both are tails, so that a small excluded share keeps its digits.
            (normal_cdf(low), normal_cdf(-high))
        };
        let ((below, above), (given_below, given_above)) = (share(ends), share(given));
        let excluded = (below - given_below + above - given_above) / (1.0 - given_below - given_above);
        self.truncate = Some(ends);
        Some((ends.map(|end| self.value(end)), excluded))
    }

    /// The accepted value between the mean and `edge` that is nearest to `edge`.
    fn accepted_end(&self, edge: f64, is_accepted: &dyn Fn(f64) -> bool) -> f64 {
        let is_accepted = |normal: f64| is_accepted(self.value(normal));
        if is_accepted(edge) {
            return edge;
        }
        let (mut inside, mut outside) = (self.mean, edge);
        for _ in 0..MAX_BISECTIONS {
            let middle = f64::midpoint(inside, outside);
            if is_accepted(middle) { inside = middle } else { outside = middle }
        }
        // Prefers a short number, because most ranges end at one, such as 0. Adding 0 removes −0.
        let scale = 10.0_f64.powf(9.0 - self.sd.log10().floor());
        let short = (inside * scale).round() / scale + 0.0;
        if is_accepted(short) { short } else { inside }
    }

    fn score(&self, value: f64) -> f64 {
        let score = |value: f64| (value - self.mean) / self.sd;
        let value = if self.is_logarithm { value.ln() } else { value };
        let Some(ends) = self.truncate else { return score(value) };
        let [from, to] = ends.map(|end| normal_cdf(score(end)));
        normal_quantile(((normal_cdf(score(value)) - from) / (to - from)).clamp(f64::EPSILON, 1.0 - f64::EPSILON))
    }

    fn value(&self, normal: f64) -> f64 {
        let normal = self.truncate.map_or(normal, |[low, high]| normal.clamp(low, high));
        if self.is_logarithm { normal.exp() } else { normal }
    }
}

impl Distribution {
    /// Quantile at the probability `u` in (0, 1); for [`Self::Choices`] the index of the choice.
    pub fn at(&self, u: f64) -> f64 {
        match self {
            Self::Choices(values) => (u * values.len() as f64).floor().min(values.len() as f64 - 1.0),
            Self::Uniform([low, high]) => low + (high - low) * u,
            Self::Normal(normal) => normal.at(u),
        }
    }

    /// Quantile at the probability `normal_cdf(z)`.
    pub fn at_score(&self, z: f64) -> f64 {
        if let Self::Normal(normal) = self { normal.at_score(z) } else { self.at(normal_cdf(z)) }
    }

    /// Standard normal score of `value`; 0 if the distribution is not normal.
    pub(crate) fn score(&self, value: f64) -> f64 {
        if let Self::Normal(normal) = self { normal.score(value) } else { 0.0 }
    }

    /// `share` is a position in the range that a search covers, from 0 to 1.
    pub fn at_share_of_range(&self, share: f64) -> f64 {
        match self {
            Self::Choices(_) => self.at(share),
            Self::Uniform([low, high]) => (low + (high - low) * share).clamp(*low, *high),
            Self::Normal(normal) => normal.value(normal.mean + normal.sd * SEARCH_DEVIATIONS * (2.0 * share - 1.0)),
        }
    }

    /// See [`NormalDistribution::truncate_to`]. `None` if the distribution is not normal.
    pub(crate) fn truncate_to(
        &mut self,
        deviations: f64,
        is_accepted: &dyn Fn(f64) -> bool,
    ) -> Option<([f64; 2], f64)> {
        if let Self::Normal(normal) = self { normal.truncate_to(deviations, is_accepted) } else { None }
    }

    /// Values whose combinations with those of other variables must be accepted: the ends of a
    /// range up to `deviations` from the mean, the first and the last number of a list, all texts.
    pub(crate) fn extremes(&self, deviations: f64) -> Vec<f64> {
        let mut extremes = match self {
            Self::Choices(values) if values.iter().all(Choice::is_number) => vec![0.0, values.len() as f64 - 1.0],
            Self::Choices(values) => (0..values.len()).map(|index| index as f64).collect(),
            Self::Uniform(ends) => ends.to_vec(),
            Self::Normal(normal) => {
                [-deviations, deviations].map(|score| normal.value(normal.mean + normal.sd * score)).to_vec()
            }
        };
        extremes.dedup();
        extremes
    }

    /// True for `normal` and `lognormal`.
    pub const fn is_normal(&self) -> bool {
        matches!(self, Self::Normal(_))
    }

    pub fn value(&self, drawn: f64) -> Value {
        match self {
            Self::Choices(values) => values.get(drawn as usize).map_or(Value::Float(f64::NAN), Value::from),
            Self::Uniform(_) | Self::Normal(_) => Value::Float(drawn),
        }
    }

    pub fn number(&self, drawn: f64) -> Option<f64> {
        match self {
            Self::Choices(values) => values.get(drawn as usize)?.number(),
            Self::Uniform(_) | Self::Normal(_) => Some(drawn),
        }
    }

    pub fn text(&self, drawn: f64) -> String {
        match self {
            Self::Choices(values) => values.get(drawn as usize).map(ToString::to_string).unwrap_or_default(),
            Self::Uniform(_) | Self::Normal(_) => drawn.to_string(),
        }
    }

    pub fn choices(&self) -> Option<&[Choice]> {
        if let Self::Choices(values) = self { Some(values) } else { None }
    }

    /// Values that the scenario must accept before the campaign starts.
    pub fn required_values(&self) -> Vec<Value> {
        match self {
            Self::Choices(values) => values.iter().map(Value::from).collect(),
            Self::Uniform(ends) => ends.iter().copied().map(Value::Float).collect(),
            Self::Normal(NormalDistribution { mean, is_logarithm, .. }) => {
                vec![Value::Float(if *is_logarithm { mean.exp() } else { *mean })]
            }
        }
    }
}

#[derive(Debug, Clone, PartialEq)]
pub struct Variable {
    pub key: String,
    pub distribution: Distribution,
}

impl Variable {
    pub fn is_number(&self) -> bool {
        self.distribution.choices().is_none_or(|list| list.iter().all(Choice::is_number))
    }

    pub fn short_name(&self) -> &str {
        self.key.rsplit('.').next().unwrap_or_default()
    }

    /// Formats a drawn value with at most six decimals.
    pub fn text(&self, drawn: f64) -> String {
        match self.distribution.number(drawn) {
            Some(number) => format!("{number:.6}").trim_end_matches('0').trim_end_matches('.').to_owned(),
            None => self.distribution.text(drawn),
        }
    }
}

#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct RawCorrelation {
    /// Two keys of `[vary]` with a `normal` or `lognormal` distribution.
    pub(crate) keys: [String; 2],
    /// Correlation coefficient of the two values; of the logarithm for `lognormal`.
    #[schemars(extend("exclusiveMinimum" = -1, "exclusiveMaximum" = 1))]
    coefficient: f64,
}

/// Lower triangle L (Cholesky factor) of the correlation matrix `R = L Lᵀ`.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Correlation {
    triangle: Vec<Vec<f64>>,
}

impl Correlation {
    /// `variables` contains the key of each varied value and whether its distribution is normal.
    /// `None` if `raw` is empty.
    pub(crate) fn new(raw: &[RawCorrelation], variables: &[(&str, bool)]) -> Result<Option<Self>, String> {
        if raw.is_empty() {
            return Ok(None);
        }
        let count = variables.len();
        let mut matrix: Vec<Vec<f64>> =
            (0..count).map(|row| (0..count).map(|column| f64::from(u8::from(row == column))).collect()).collect();
        for RawCorrelation { keys: [one, other], coefficient } in raw {
            let place = |key: &String| {
                let place = variables.iter().position(|(name, is_normal)| name == key && *is_normal);
                place.ok_or_else(|| format!("`{key}`, expected a key of [vary] that is `normal` or `lognormal`"))
            };
            let (one, other) = (place(one)?, place(other)?);
            if one == other {
                return Err(format!("coefficient {coefficient} of one key, expected two different keys"));
            }
            for (row, column) in [(one, other), (other, one)] {
                if let Some(entry) = matrix.get_mut(row).and_then(|row| row.get_mut(column)) {
                    *entry = *coefficient;
                }
            }
        }
        let error = || "the coefficients contradict each other, expected a positive definite matrix".to_owned();
        cholesky(&matrix).map(|triangle| Some(Self { triangle })).ok_or_else(error)
    }

    /// Returns `L · scores`; `scores` are independent standard normal numbers.
    pub(crate) fn apply(&self, scores: &[f64]) -> Vec<f64> {
        let row = |row: &Vec<f64>| row.iter().zip(scores).map(|(factor, score)| factor * score).sum();
        self.triangle.iter().map(row).collect()
    }
}

fn cholesky(matrix: &[Vec<f64>]) -> Option<Vec<Vec<f64>>> {
    let mut triangle: Vec<Vec<f64>> = Vec::new();
    for row in matrix {
        let mut factors: Vec<f64> = Vec::new();
        for above in &triangle {
            let column = factors.len();
            let known: f64 = factors.iter().zip(above).map(|(one, other)| one * other).sum();
            factors.push((row.get(column)? - known) / above.get(column)?);
        }
        let rest = row.get(factors.len())? - factors.iter().map(|factor| factor * factor).sum::<f64>();
        if rest <= 1e-12 {
            return None;
        }
        factors.push(rest.sqrt());
        triangle.push(factors);
    }
    Some(triangle)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<Distribution, String> {
        let raw: RawDistribution = toml::from_str::<toml::Table>(&format!("x = {text}")).unwrap()["x"]
            .clone()
            .try_into()
            .map_err(|error: toml::de::Error| error.message().to_owned())?;
        raw.check()
    }

    #[test]
    fn steps_have_the_shortest_decimals_and_both_ends() {
        let Distribution::Choices(values) = parse("{ steps = [0.0, 0.3, 4] }").unwrap() else { panic!() };
        let numbers: Vec<_> = values.iter().filter_map(Choice::number).collect();
        assert_eq!(numbers, [0.0, 0.1, 0.2, 0.3]);
    }

    #[test]
    fn a_normal_has_its_quantiles() {
        let normal = parse("{ normal = { mean = 10.0, sd_percent = 20.0 } }").unwrap();
        assert!((normal.at(0.5) - 10.0).abs() < 1e-9 && (normal.at(0.975) - 13.919_928).abs() < 1e-5);
        let truncated = parse("{ normal = { mean = 10.0, sd = 2.0, truncate = [9.0, 10.0] } }").unwrap();
        assert!((truncated.at(1e-9) - 9.0).abs() < 1e-6 && (truncated.at(1.0 - 1e-9) - 10.0).abs() < 1e-6);
    }

    #[test]
    fn a_lognormal_has_the_mean_and_deviation_of_its_value() {
        let lognormal = parse("{ lognormal = { mean = 10.0, sd = 5.0 } }").unwrap();
        let count = 100_000;
        let values: Vec<f64> =
            (0..count).map(|number| lognormal.at((f64::from(number) + 0.5) / f64::from(count))).collect();
        let mean = values.iter().sum::<f64>() / f64::from(count);
        let variance = values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / f64::from(count);
        assert!((mean - 10.0).abs() < 0.01 && (variance.sqrt() - 5.0).abs() < 0.05, "{mean} {}", variance.sqrt());
        assert!((lognormal.at_score(1.0) - lognormal.at(0.841_344_746)).abs() < 1e-6);
        let truncated = parse("{ lognormal = { mean = 10.0, sd = 5.0, truncate = [8.0, 9.0] } }").unwrap();
        assert!(truncated.at(1e-9) >= 8.0 && truncated.at(1.0 - 1e-9) <= 9.0);
    }

    #[test]
    fn a_search_covers_four_standard_deviations() {
        let ends = |text: &str| [0.0, 1.0].map(|share| parse(text).unwrap().at_share_of_range(share));
        assert_eq!(ends("{ normal = { mean = 10.0, sd = 1.0 } }"), [6.0, 14.0]);
        assert_eq!(ends("{ normal = { mean = 10.0, sd = 1.0, truncate = [9.0, 20.0] } }"), [9.0, 14.0]);
        assert_eq!(ends("{ uniform = [0.1, 0.7] }"), [0.1, 0.7]);
        assert_eq!(ends("{ steps = [0.0, 3.0, 4] }"), [0.0, 3.0]);
    }

    #[test]
    fn every_choice_has_the_same_share() {
        let each = parse("{ each = [\"a\", \"b\", \"c\"] }").unwrap();
        let drawn: Vec<_> = [0.01, 0.34, 0.67, 0.999_999].map(|u| each.text(each.at(u))).to_vec();
        assert_eq!(drawn, ["a", "b", "c", "c"]);
    }

    #[test]
    fn rejects_wrong_distributions() {
        for text in [
            "{ each = [] }",
            "{ each = [1.0, \"a\"] }",
            "{ steps = [0.0, 1.0, 1] }",
            "{ steps = [0.0, 1.0] }",
            "{ steps = [0.0, 2.0, 0.1] }",
            "{ steps = [0.0, 2.0, 2.5] }",
            "{ uniform = [1.0, 1.0] }",
            "{ uniform = [2.0, 1.0] }",
            "{ normal = { mean = 1.0 } }",
            "{ normal = { mean = 1.0, sd = 1.0, sd_percent = 1.0 } }",
            "{ normal = { mean = 0.0, sd_percent = 1.0 } }",
            "{ normal = { mean = 0.0, sd = 1.0, truncate = [1.0, 0.0] } }",
            "{ normal = { mean = 0.0, sd = 1.0, truncate = [90.0, 91.0] } }",
            "{ lognormal = { mean = 1.0 } }",
            "{ lognormal = { mean = -1.0, sd = 1.0 } }",
            "{ lognormal = { mean = 1.0, sd = 1.0, truncate = [0.0, 1.0] } }",
        ] {
            assert!(parse(text).is_err(), "{text}");
        }
    }

    #[test]
    fn the_triangle_gives_the_matrix() {
        let matrix = [vec![1.0, 0.5, -0.2], vec![0.5, 1.0, 0.3], vec![-0.2, 0.3, 1.0]];
        let triangle = cholesky(&matrix).unwrap();
        for (row, line) in matrix.iter().enumerate() {
            for (column, entry) in line.iter().enumerate() {
                let product: f64 = triangle[row].iter().zip(&triangle[column]).map(|(one, other)| one * other).sum();
                assert!((product - entry).abs() < 1e-12, "{row} {column}");
            }
        }
        let contradiction = [vec![1.0, 0.9, -0.9], vec![0.9, 1.0, 0.9], vec![-0.9, 0.9, 1.0]];
        assert_eq!(cholesky(&contradiction), None);
    }
}
