//! Finds the times at which a signal enters or leaves a band, to the nanosecond.

use crate::flow::State;
use crate::time::Time;

/// Spacing of the points at which the band is checked, about 15 points per period of the fast pole.
const SCAN_STEP_NS: u64 = 1_000;
/// Margin above the rounding error of a state.
const ROUNDING_UM: f64 = 1e-9;

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum BandSignal {
    Amplitude,
    InPhase,
    Quadrature,
}

impl BandSignal {
    /// The signal of a column of a trace. `None` for a column that is not the motion of the plate.
    pub fn from_column(name: &str) -> Option<Self> {
        match name {
            "amplitude_um" => Some(Self::Amplitude),
            "wd_um" => Some(Self::InPhase),
            "wq_um" => Some(Self::Quadrature),
            _ => None,
        }
    }

    pub fn value(self, state: &State) -> f64 {
        match self {
            Self::Amplitude => state.amplitude(),
            Self::InPhase => state.w.re,
            Self::Quadrature => state.w.im,
        }
    }
}

/// A band from `low` to `high` µm. Both edges are inside.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BandMonitor {
    pub signal: BandSignal,
    pub low: f64,
    pub high: f64,
}

impl BandMonitor {
    /// True if the signal is inside the band or on an edge.
    pub fn contains(&self, state: &State) -> bool {
        (self.low..=self.high).contains(&self.signal.value(state))
    }

    /// Distance to the nearest edge, µm, but for a rounding error.
    pub fn distance(&self, state: &State) -> f64 {
        let value = match self.signal {
            // `hypot`, without a rounding error, takes ten times as long.
            BandSignal::Amplitude => state.w.norm_sqr().sqrt(),
            signal => signal.value(state),
        };
        (value - self.low).abs().min((value - self.high).abs())
    }
}

/// Time from `state` on during which no signal reaches an edge of its band. In `seconds_within(d)`
/// seconds, W changes by less than d µm.
pub(crate) fn time_without_crossing(
    monitors: &[BandMonitor],
    state: &State,
    seconds_within: impl Fn(f64) -> f64,
) -> Time {
    // Rounds down; 0 for a negative number or NaN.
    let nanos = |monitor: &BandMonitor| (seconds_within(monitor.distance(state) - ROUNDING_UM) * 1e9) as u64;
    Time::from_nanos(monitors.iter().map(nanos).min().unwrap_or(u64::MAX))
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Crossing {
    /// The first nanosecond on the other side of the edge.
    pub time: Time,
    pub state: State,
    /// State 1 ns before `time`.
    pub before: State,
    /// Self-heating at `before` and at `state`, K.
    pub temperature_rise_k: [f64; 2],
}

/// Bands to monitor, and the crossings found so far.
pub(crate) struct BandSearch<'a> {
    pub(crate) monitors: &'a [BandMonitor],
    pub(crate) found: &'a mut Vec<Crossing>,
}

impl BandSearch<'_> {
    /// Appends the crossings between `start` and `end` in order of time. The state is `from` at
    /// `start` and `after(t)` t seconds later. Until `end`, W changes by at most `reach` µm. From any
    /// instant on, W changes by less than d µm for `seconds_within(d)` seconds. The search skips this
    /// time if d is the distance to the band.
    #[inline]
    pub(crate) fn find(
        &mut self,
        after: impl Fn(f64) -> State,
        reach: f64,
        seconds_within: impl Fn(f64) -> f64,
        from: &State,
        (start, end): (Time, Time),
    ) {
        let known = self.found.len();
        for monitor in self.monitors {
            // False if the reach is NaN.
            let is_far = monitor.distance(from) - ROUNDING_UM > reach;
            if !is_far {
                find_crossings(monitor, &after, &seconds_within, from, (start, end), self.found);
            }
        }
        if self.found.len() == known {
            return;
        }
        if self.monitors.len() > 1
            && let Some(new) = self.found.get_mut(known..)
        {
            new.sort_by_key(|crossing| crossing.time);
        }
    }
}

fn find_crossings(
    monitor: &BandMonitor,
    after: &impl Fn(f64) -> State,
    seconds_within: &impl Fn(f64) -> f64,
    from: &State,
    (start, end): (Time, Time),
    found: &mut Vec<Crossing>,
) {
    let seconds_at = |nanos: u64| Time::from_nanos(nanos).since(start).seconds();
    let state_at = |nanos: u64| after(seconds_at(nanos));
    let end = end.as_nanos();
    // Skips whole steps, so that the checked points do not depend on the bound.
    let skip = |low: u64, state: &State| {
        let seconds = seconds_within(monitor.distance(state) - ROUNDING_UM);
        low.saturating_add((seconds * 1e9) as u64 / SCAN_STEP_NS * SCAN_STEP_NS)
    };
    let mut low = skip(start.as_nanos(), from);
    if low >= end {
        return;
    }
    let mut inside = monitor.contains(from);
    loop {
        let high = (low + SCAN_STEP_NS).min(end);
        let state = state_at(high);
        if monitor.contains(&state) != inside {
            let (mut before, mut behind) = (low, high);
            while behind - before > 1 {
                let middle = u64::midpoint(before, behind);
                if monitor.contains(&state_at(middle)) == inside {
                    before = middle;
                } else {
                    behind = middle;
                }
            }
            let time = Time::from_nanos(behind);
            let (state, before) = (state_at(behind), state_at(before));
            found.push(Crossing { time, state, before, temperature_rise_k: [0.0; 2] });
            inside = !inside;
        }
        low = skip(high, &state);
        if low >= end {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::{ExponentialSum, Flow, Model};
    use crate::mode::{Drive, Mode};
    use num_complex::Complex64;
    use proptest::prelude::*;

    const OMEGA0: f64 = 202_995.0;

    proptest! {
        #[test]
        fn skips_no_crossing(
            model in prop::sample::select(&Model::ALL),
            sigma in 300.0..2_000.0,
            vpp in 0.0..800.0,
            detuning in -3_000.0..3_000.0,
            w in prop::array::uniform2(-2.5..2.5),
            fast in 0.0..1.2,
            signal in prop::sample::select(&[BandSignal::Amplitude, BandSignal::InPhase, BandSignal::Quadrature]),
            low in -1.5..2.0,
            width in 0.001..1.0,
        ) {
            let mode = Mode { sigma, omega0: OMEGA0, force_constant: 1.5e6, envelope_constant: 3.71 };
            let drive = Drive { vpp, omega: OMEGA0 + detuning };
            let w = Complex64::new(w[0], w[1]);
            let state = match model {
                Model::Linear => State { w: w.re * Complex64::new(1.0, 0.4), u: 0.4.into() },
                Model::Envelope => State { w, u: Complex64::ZERO },
                Model::Modal | Model::Carrier => State { w, u: Complex64::I * drive.omega * fast * w },
            };
            let monitor = BandMonitor { signal, low, high: low + width };
            let flow = Flow::new(model, &mode, &drive, &state);
            let bound = flow.excursion_bound();
            let (start, end) = (Time::from_nanos(5_000_123), Time::from_nanos(6_000_400));
            let search = |reach, seconds_within: &dyn Fn(f64) -> f64| {
                let mut found = Vec::new();
                let mut bands = BandSearch { monitors: &[monitor], found: &mut found };
                bands.find(|t| flow.after(t), reach, seconds_within, &state, (start, end));
                found
            };
            let reach = bound.reach((end - start).seconds());
            let all = search(f64::INFINITY, &|_| 0.0);
            prop_assert_eq!(search(reach, &|distance| bound.seconds_within(distance)), all.clone());
            prop_assert_eq!(search(f64::INFINITY, &|distance| bound.seconds_within(distance)), all);
        }
    }
}
