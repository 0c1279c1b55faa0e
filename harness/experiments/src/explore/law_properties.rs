//! Declares the properties of each law (`docs/laws.md`). Limits differ between laws only by these
//! properties.

use platebench_wire::LawId;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LawProperties {
    /// True if the gains follow the damping. Otherwise they fit only the plate without a finger.
    pub adapts_to_damping: bool,
    /// True if the law compensates a configured loop delay. Other laws are explored without delay.
    pub compensates_delay: bool,
    /// True if the law computes the drives after a step in advance, at rest from the configured
    /// plate. If the amplitude then misses the setpoint, the law searches for a loop delay.
    pub steers: bool,
    /// Time constant with which the law tracks a small change of the damping, control periods.
    pub tracking_periods: f64,
}

impl LawProperties {
    pub fn explored_laws() -> impl Iterator<Item = LawId> {
        LawId::ALL.into_iter().filter(|law| Self::of(*law).is_some())
    }

    /// `None` for laws with a static error by design, or laws that settle only near the resonance.
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
