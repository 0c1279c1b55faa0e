//! Correlates varied values that have normal or lognormal distributions.

use schemars::JsonSchema;
use serde::Deserialize;

#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct RawCorrelation {
    /// Two keys of `[vary]` with a `normal` or `lognormal` distribution.
    keys: [String; 2],
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
            if one == other || coefficient.abs() >= 1.0 || coefficient.is_nan() {
                return Err(format!(
                    "coefficient {coefficient}, expected two different keys and a coefficient above -1 and below 1"
                ));
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
