//! Finds the times at which a signal enters or leaves a band, to the nanosecond.

use crate::flow::State;
use crate::time::Time;

/// Spacing of the search: about 15 points per period of the fast pole.
const SCAN_STEP_NS: u64 = 1_000;

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum BandSignal {
    Amplitude,
    InPhase,
    Quadrature,
}

impl BandSignal {
    pub fn value(self, state: &State) -> f64 {
        match self {
            Self::Amplitude => state.amplitude(),
            Self::InPhase => state.w.re,
            Self::Quadrature => state.w.im,
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BandMonitor {
    pub signal: BandSignal,
    /// µm; the edge is inside.
    pub low: f64,
    /// µm; the edge is inside.
    pub high: f64,
}

impl BandMonitor {
    pub(crate) fn contains(&self, state: &State) -> bool {
        (self.low..=self.high).contains(&self.signal.value(state))
    }

    pub(crate) fn distance(&self, state: &State) -> f64 {
        let value = self.signal.value(state);
        (value - self.low).abs().min((value - self.high).abs())
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Crossing {
    /// The first nanosecond on the other side.
    pub time: Time,
    pub state: State,
    /// 1 ns before `time`.
    pub before: State,
}

/// Appends to `found`. The state is `from` at `start` and `after(t)` t seconds later.
pub(crate) fn find_crossings(
    monitor: &BandMonitor,
    after: &impl Fn(f64) -> State,
    from: &State,
    start: Time,
    end: Time,
    found: &mut Vec<Crossing>,
) {
    let state_at = |nanos: u64| after(Time::from_nanos(nanos).since(start).seconds());
    let mut low = start.as_nanos();
    let mut inside = monitor.contains(from);
    while low < end.as_nanos() {
        let high = (low + SCAN_STEP_NS).min(end.as_nanos());
        if monitor.contains(&state_at(high)) != inside {
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
            found.push(Crossing { time, state: state_at(behind), before: state_at(before) });
            inside = !inside;
        }
        low = high;
    }
}
