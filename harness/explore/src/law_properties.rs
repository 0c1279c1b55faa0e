//! Declares what each law promises. Limits differ between laws by these properties only.

use platebench_wire::LawId;

/// Declared properties of a law, see `docs/laws.md`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LawProperties {
    /// The gains follow the damping; otherwise they are those of the untouched plate.
    pub adapts_to_damping: bool,
    /// It compensates a configured loop delay; otherwise it is explored without a loop delay.
    pub compensates_delay: bool,
    /// It computes the drives after a step: from rest with the configured plate, and if they miss, it searches for a
    /// loop delay.
    pub steers: bool,
    /// Time constant with which it tracks a small change of the damping, control periods.
    pub tracking_periods: f64,
}

impl LawProperties {
    pub fn explored_laws() -> impl Iterator<Item = LawId> {
        LawId::ALL.into_iter().filter(|law| Self::of(*law).is_some())
    }

    /// `None` if the law is not explored: it has a static error by design, or settles only near the resonance.
    pub const fn of(law: LawId) -> Option<Self> {
        let adapting = Self { adapts_to_damping: true, compensates_delay: true, steers: false, tracking_periods: 8.0 };
        match law {
            LawId::DqPi => Some(adapting),
            LawId::Deadbeat => Some(Self { steers: true, ..adapting }),
            LawId::DqPiFixed => {
                Some(Self { adapts_to_damping: false, compensates_delay: false, steers: false, tracking_periods: 0.0 })
            }
            LawId::OpenLoop
            | LawId::DqPiEuler
            | LawId::VoltageOnly
            | LawId::FrequencyOnly
            | LawId::BangBang
            | LawId::Pll => None,
        }
    }
}
