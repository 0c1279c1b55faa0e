//! Entering and leaving bands, to the nanosecond.

use crate::flow::State;
use crate::time::Time;

/// Entering and leaving a band is looked for at this spacing, some fifteen points per period of the fast pole.
const SCAN: u64 = 1_000;

/// Which signal of the plate a [`Watch`] looks at.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Signal {
    /// |W|
    Amplitude,
    /// Wd
    InPhase,
    /// Wq
    Quadrature,
}

impl Signal {
    /// The signal's value in µm.
    pub fn of(self, state: &State) -> f64 {
        match self {
            Self::Amplitude => state.amplitude(),
            Self::InPhase => state.w.re,
            Self::Quadrature => state.w.im,
        }
    }
}

/// A band whose crossings are to be found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Watch {
    /// What is watched.
    pub signal: Signal,
    /// Lower edge, µm, still inside.
    pub low: f64,
    /// Upper edge, µm, still inside.
    pub high: f64,
}

impl Watch {
    pub(crate) fn holds(&self, state: &State) -> bool {
        (self.low..=self.high).contains(&self.signal.of(state))
    }

    /// Distance in µm of `state` from the nearer edge.
    pub(crate) fn distance(&self, state: &State) -> f64 {
        let value = self.signal.of(state);
        (value - self.low).abs().min((value - self.high).abs())
    }
}

/// A watched signal has entered or left its band.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Crossing {
    /// The first nanosecond on the other side.
    pub time: Time,
    /// The state then.
    pub state: State,
    /// The state a nanosecond earlier, still on this side.
    pub before: State,
}

/// Puts into `found` where the plate enters or leaves the band of `watch` up to `end`; it is in `from` at `start` and in `after(t)`
/// t seconds later.
pub(crate) fn find_crossings(
    watch: &Watch,
    after: &impl Fn(f64) -> State,
    from: &State,
    start: Time,
    end: Time,
    found: &mut Vec<Crossing>,
) {
    let state_at = |nanos: u64| after(Time::from_nanos(nanos).since(start).seconds());
    let mut low = start.as_nanos();
    let mut inside = watch.holds(from);
    while low < end.as_nanos() {
        let high = (low + SCAN).min(end.as_nanos());
        if watch.holds(&state_at(high)) != inside {
            let (mut before, mut behind) = (low, high);
            while behind - before > 1 {
                let middle = u64::midpoint(before, behind);
                if watch.holds(&state_at(middle)) == inside {
                    before = middle;
                } else {
                    behind = middle;
                }
            }
            let time = Time::from_nanos(behind);
            found.push(Crossing { time, state: state_at(behind), before: state_at(before) });
            inside = !inside;
        }
        low = high;
    }
}
