//! Lists the kinds of events in a trial.

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum EventKind {
    Step,
    /// The setpoint changes in several steps.
    Staircase,
    /// The setpoint is 0 for some time.
    Rest,
    Touch,
    Press,
    Shock,
    Heat,
    /// Force and temperature ramp together.
    Both,
}

impl EventKind {
    pub(crate) const ALL: [Self; 8] =
        [Self::Step, Self::Staircase, Self::Rest, Self::Touch, Self::Press, Self::Shock, Self::Heat, Self::Both];
}
