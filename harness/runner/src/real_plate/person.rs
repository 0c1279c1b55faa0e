//! Who warms the plate and presses it.

use platebench_plate::Time;

/// What came of asking.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Answer {
    /// It is done.
    Done,
    /// It is not, and will not be.
    Declined,
    /// There is nobody to ask.
    Absent,
    /// The run is to end.
    GivenUp,
}

/// Somebody at the plate, as the runner sees them. Nothing here may wait but [`Person::ask`].
pub trait Person: Sync {
    /// Asks for `what` and waits until it is done, nobody answers for a bounded time, or `is_over`.
    fn ask(&self, what: &str, is_over: &dyn Fn() -> bool) -> Answer;

    /// `what` is to be done in `seconds`; now where they are 0.
    fn cue(&self, what: &str, seconds: u32);

    /// Within a trial, at `now`: the force that the finger should have, N, and has, where it is measured.
    fn bar(&self, now: Time, wished_n: f64, force_n: Option<f64>);

    /// The trial is over.
    fn rest(&self) {}
}

/// Nobody is there: what needs a person stays undecided.
#[derive(Debug, Clone, Copy, Default)]
pub struct Nobody;

impl Person for Nobody {
    fn ask(&self, _what: &str, _is_over: &dyn Fn() -> bool) -> Answer {
        Answer::Absent
    }

    fn cue(&self, _what: &str, _seconds: u32) {}

    fn bar(&self, _now: Time, _wished_n: f64, _force_n: Option<f64>) {}
}
