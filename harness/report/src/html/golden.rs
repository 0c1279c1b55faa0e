//! The accepted response of a scenario, at the instants of its plots.
//!
//! Neighbours: `platebench-verdict` reads baselines and says where their tubes end. Nothing is compared here.

use super::curves::Signal;
use super::grid::Grid;
use platebench_verdict::golden::{Accepted, BaselineError};
use std::collections::BTreeMap;
use std::path::Path;

/// Golden curves with their tubes.
#[derive(Debug, Clone)]
pub(crate) struct Curves {
    /// Whose they are.
    pub(crate) text: String,
    tubes: BTreeMap<Signal, Tube>,
}

/// A golden curve with the lower and the upper edge of its tube.
#[derive(Debug, Clone)]
pub(crate) struct Tube {
    pub(crate) line: Vec<Option<f64>>,
    pub(crate) edges: [Vec<Option<f64>>; 2],
}

impl Curves {
    /// What lies in `folder` of the scenario in `file`; `None` where nothing was accepted.
    ///
    /// # Errors
    /// [`BaselineError`] where what lies there is no baseline.
    pub(crate) fn read(folder: &Path, file: &str, grid: &Grid) -> Result<Option<Self>, BaselineError> {
        Ok(Accepted::read(folder, file)?.map(|accepted| Self::of(&accepted, grid)))
    }

    fn of(accepted: &Accepted, grid: &Grid) -> Self {
        let signals =
            [("amplitude_um", Signal::Amplitude), ("drive_vpp", Signal::Drive), ("frequency_hz", Signal::Frequency)];
        let tubes = accepted.golden.tubes.iter().filter_map(|tube| {
            let (_, signal) = signals.iter().find(|(name, _)| *name == tube.signal)?;
            let (from_ms, to_ms) = tube.span_ms();
            let inside = |t_ms: &f64| (from_ms..=to_ms).contains(t_ms).then_some(*t_ms);
            let sampled = |value: &dyn Fn(f64) -> f64| grid.t_ms.iter().map(|t_ms| inside(t_ms).map(value)).collect();
            let [lower, upper]: [fn([f64; 2]) -> f64; 2] = [|[low, _]| low, |[_, high]| high];
            let edges = [sampled(&|t_ms| lower(tube.edges(t_ms))), sampled(&|t_ms| upper(tube.edges(t_ms)))];
            Some((*signal, Tube { line: sampled(&|t_ms| tube.at(t_ms).value), edges }))
        });
        Self { text: format!("golden trace ({})", accepted.law), tubes: tubes.collect() }
    }

    /// The curve of that signal.
    pub(crate) fn of_signal(&self, signal: Signal) -> Option<&Tube> {
        self.tubes.get(&signal)
    }
}
