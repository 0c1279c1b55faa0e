//! Lists the kinds of events in a trial.

/// The kind of an event.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum EventKind {
    /// The setpoint steps.
    Step,
    /// The setpoint goes in several steps.
    Staircase,
    /// The setpoint is 0 for some time.
    Rest,
    /// The force steps.
    Touch,
    /// The force ramps.
    Press,
    /// The temperature steps.
    Shock,
    /// The temperature ramps.
    Heat,
    /// Force and temperature ramp together.
    Both,
}

impl EventKind {
    /// Every kind.
    pub(crate) const ALL: [Self; 8] =
        [Self::Step, Self::Staircase, Self::Rest, Self::Touch, Self::Press, Self::Shock, Self::Heat, Self::Both];
}
