//! Samples a scenario's baseline and its tolerance tube at the instants of its figures.

use super::grid::TimeGrid;
use platebench_model::trace::{Column, Row};
use platebench_verdict::golden::{Baseline, BaselineError, ResponseFeatures};
use platebench_verdict::tube::Exceedance;
use std::collections::BTreeMap;
use std::path::Path;

#[derive(Debug, Clone)]
pub(crate) struct GoldenCurves {
    pub(crate) text: String,
    tubes: BTreeMap<Column, SampledTube>,
}

#[derive(Debug, Clone)]
pub(crate) struct SampledTube {
    pub(crate) line: Vec<Option<f64>>,
    pub(crate) edges: [Vec<Option<f64>>; 2],
}

/// Differences from the baseline. Empty if there is none, or if the response is inside its tubes.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct GoldenDifference {
    /// The worst exceedance of each signal that leaves its tube.
    pub(crate) exceedances: Vec<Exceedance>,
    /// Name, golden value and value of this run of each feature that differs.
    pub(crate) features: Vec<(&'static str, Option<f64>, Option<f64>)>,
}

impl GoldenDifference {
    pub(crate) fn find(baseline: &Baseline, rows: &[Row]) -> Self {
        let exceedances = baseline.golden.exceedances(rows);
        if exceedances.is_empty() {
            return Self::default();
        }
        let now = ResponseFeatures::of(rows).by_name();
        let pairs = baseline.features.by_name().into_iter().zip(now);
        let features = pairs.map(|((name, before), (_, after))| (name, before, after));
        Self { exceedances, features: features.filter(|(_, before, after)| before != after).collect() }
    }
}

impl GoldenCurves {
    pub(crate) fn read(folder: &Path, file: &str, grid: &TimeGrid) -> Result<Option<Self>, BaselineError> {
        Ok(Baseline::read(folder, file)?.map(|accepted| Self::from_baseline(&accepted, grid)))
    }

    fn from_baseline(accepted: &Baseline, grid: &TimeGrid) -> Self {
        let tubes = accepted.golden.tubes.iter().filter_map(|tube| {
            let signal = Column::from_name(&tube.signal)?;
            let (from_ms, to_ms) = tube.span_ms();
            let inside = |t_ms: &f64| (from_ms..=to_ms).contains(t_ms).then_some(*t_ms);
            let sampled = |value: &dyn Fn(f64) -> f64| grid.t_ms.iter().map(|t_ms| inside(t_ms).map(value)).collect();
            let [lower, upper]: [fn([f64; 2]) -> f64; 2] = [|[low, _]| low, |[_, high]| high];
            let edges = [sampled(&|t_ms| lower(tube.edges(t_ms))), sampled(&|t_ms| upper(tube.edges(t_ms)))];
            Some((signal, SampledTube { line: sampled(&|t_ms| tube.point_at(t_ms).value), edges }))
        });
        Self { text: format!("golden trace ({})", accepted.law), tubes: tubes.collect() }
    }

    pub(crate) fn tube_of(&self, signal: Column) -> Option<&SampledTube> {
        self.tubes.get(&signal)
    }
}
