//! Finds the instants at which a solver's response enters or leaves a band, to the nanosecond.

use crate::integration::failure::MethodFailure;
use crate::integration::method::IntegrationMethod;
use crate::integration::problem::{ModalProblem, Problem};
use crate::integration::replay::{EquationForm, MethodReplay};
use crate::integration::sweep::Solver;
use platebench_plate::{BandMonitor, Model, State, Time};

/// Spacing of the points at which the band is checked, as that of the bench.
const SCAN_STEP: Time = Time::from_nanos(1_000);
const RESOLUTION: Time = Time::from_nanos(1);
/// Margin of the bound of |W'| for a resonance other than the scale of the equations.
const RATE_MARGIN: f64 = 1.02;

impl MethodReplay {
    /// Calls `see` with the state at rest, at the end of every interval, and on both sides of every
    /// crossing of `band`, 1 ns apart. A general method integrates each interval as in
    /// [`Self::integrate`]; the search integrates from the start of the interval again, in steps of
    /// 1 µs or more. It needs the modal equations with a constant mode; otherwise the result is
    /// [`MethodFailure::UnsupportedProblem`].
    pub fn find_crossings(
        &self,
        solver: &Solver,
        band: &BandMonitor,
        mut see: impl FnMut(Time, &State),
    ) -> Result<(), MethodFailure> {
        see(Time::ZERO, &State::default());
        match solver {
            Solver::Exact(model) => {
                self.find_exact_crossings(*model, band, see);
                Ok(())
            }
            Solver::General(EquationForm::Modal, method, setting) => {
                self.find_modal_crossings(*method, *setting, band, see)
            }
            Solver::General(..) => Err(MethodFailure::UnsupportedProblem),
        }
    }

    fn find_exact_crossings(&self, model: Model, band: &BandMonitor, mut see: impl FnMut(Time, &State)) {
        let (mut plant, mut crossings) = (self.plant(model), Vec::new());
        for piece in self.intervals() {
            plant.set_drive(piece.situation.drive);
            plant.advance(piece.end, &[*band], &mut crossings);
            for crossing in crossings.drain(..) {
                see(crossing.time - RESOLUTION, &crossing.before);
                see(crossing.time, &crossing.state);
            }
            see(piece.end, &plant.state());
        }
    }

    fn find_modal_crossings(
        &self,
        method: IntegrationMethod,
        setting: f64,
        band: &BandMonitor,
        mut see: impl FnMut(Time, &State),
    ) -> Result<(), MethodFailure> {
        let (mut start, mut state) = (Time::ZERO, [0.0; 4]);
        let state_of = |x: &[f64; 4]| ModalProblem::unpack(x, self.scale());
        let is_inside = |x: &[f64; 4]| band.contains(&state_of(x));
        for piece in self.intervals() {
            if piece.situation.is_time_varying() {
                return Err(MethodFailure::UnsupportedProblem);
            }
            let problem = ModalProblem::new(&piece.situation, self.scale());
            let advance = |x: &[f64; 4], time: Time| method.advance(&problem, *x, time.seconds(), setting, &mut None);
            let (mut now, mut x) = (start, state);
            (start, state) = (piece.end, advance(&x, piece.end - now)?);
            while now < piece.end {
                // The norm of the rate of (W, U/ω0) never grows while drive and mode are constant,
                // so |W| needs at least this time to the band's edge.
                let rate = problem.rate(&x).iter().map(|rate| rate * rate).sum::<f64>().sqrt();
                let nanos = band.distance(&state_of(&x)) / (RATE_MARGIN * rate) * 1e9;
                let step = Time::from_nanos(nanos as u64).max(SCAN_STEP).min(piece.end - now);
                let (mut before, mut behind) = ((now, x), (now + step, advance(&x, step)?));
                (now, x) = behind;
                if is_inside(&before.1) == is_inside(&x) {
                    continue;
                }
                while behind.0 - before.0 > RESOLUTION {
                    let half = before.0.midpoint(behind.0) - before.0;
                    let middle = (before.0 + half, advance(&before.1, half)?);
                    if is_inside(&middle.1) == is_inside(&before.1) { before = middle } else { behind = middle }
                }
                see(before.0, &state_of(&before.1));
                see(behind.0, &state_of(&behind.1));
            }
            see(piece.end, &state_of(&state));
        }
        Ok(())
    }
}
