//! Draws a recording and the response of the plate that was fitted to it.

use super::svg::{Role, extent};
use super::time_chart::{CurvePoint, TimeChart, TimeWindow, padded_range};
use crate::error::ReportError;

const MAX_POINTS: usize = 2_000;

#[derive(Debug, Clone)]
pub struct FitChart {
    pub title: String,
    pub unit: &'static str,
    /// `(ms, value)`, in order of time.
    pub measured: Vec<(f64, f64)>,
    pub fitted: Vec<(f64, f64)>,
}

impl FitChart {
    pub fn svg(&self) -> Result<String, ReportError> {
        let shorten = |points: &[CurvePoint]| points.iter().take(MAX_POINTS).copied().collect::<Vec<CurvePoint>>();
        let (measured, fitted) = (shorten(&self.measured), shorten(&self.fitted));
        let all = || measured.iter().chain(&fitted);
        let (from_ms, to_ms) = extent(all().map(|point| point.0)).unwrap_or((f64::MAX, f64::MIN));
        let window = TimeWindow { from_ms, to_ms: to_ms.max(from_ms + 1e-6) };
        let mut chart = TimeChart::new(window, padded_range(all().map(|point| point.1)), self.unit);
        chart.lines = vec![(Role::Other, measured), (Role::First, fitted)];
        chart.document(&self.title)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn draws_both_curves() {
        let (measured, fitted) = (vec![(0.0, 0.0), (1.0, 1.1)], vec![(0.0, 0.0), (1.0, 1.0)]);
        let svg = FitChart { title: "W".to_owned(), unit: "µm", measured, fitted }.svg().unwrap();
        assert_eq!((svg.matches("class=\"s-other\"").count(), svg.matches("class=\"s-first\"").count()), (1, 1));
    }
}
