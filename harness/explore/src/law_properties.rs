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
    /// The loops are a matched design that reaches every setpoint without static error and finds the resonance.
    /// Other laws are not explored.
    pub is_explored: bool,
}

impl LawProperties {
    const FIXED: Self = Self {
        adapts_to_damping: false,
        compensates_delay: false,
        steers: false,
        tracking_periods: 0.0,
        is_explored: true,
    };

    /// The properties of `law`.
    pub const fn of(law: LawId) -> Self {
        match law {
            LawId::DqPi | LawId::Deadbeat => Self {
                adapts_to_damping: true,
                compensates_delay: true,
                steers: matches!(law, LawId::Deadbeat),
                tracking_periods: 8.0,
                is_explored: true,
            },
            LawId::DqPiFixed => Self::FIXED,
            LawId::OpenLoop
            | LawId::DqPiEuler
            | LawId::VoltageOnly
            | LawId::FrequencyOnly
            | LawId::BangBang
            | LawId::Pll => Self { is_explored: false, ..Self::FIXED },
        }
    }
}
