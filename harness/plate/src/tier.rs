//! Names the models of the plate, ordered from the simplest to the most complete.

use crate::plate::Plate;

/// Model of the plate, the key `model` of a scenario. `docs/mathematics.md` states the terms that
/// each tier omits, and its error.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub enum Tier {
    /// Equations 13 and 19: V gives Wd and Δω gives Wq/Wd, by two decoupled first-order systems.
    Linear,
    /// First order in the complex W, with the slow pole only.
    Envelope,
    /// Second order, exact for one mode.
    #[default]
    Modal,
    /// Modal plate with carrier, converter and demodulator. W and U equal the modal ones bit for
    /// bit.
    Carrier,
}

impl Tier {
    pub const ALL: [Self; 4] = [Self::Linear, Self::Envelope, Self::Modal, Self::Carrier];

    pub const fn name(self) -> &'static str {
        match self {
            Self::Linear => "linear",
            Self::Envelope => "envelope",
            Self::Modal => "modal",
            Self::Carrier => "carrier",
        }
    }

    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|tier| tier.name() == name)
    }

    pub const fn exact_for(plate: &Plate) -> Self {
        if plate.lockin.is_some() { Self::Carrier } else { Self::Modal }
    }

    pub const fn has_both_poles(self) -> bool {
        matches!(self, Self::Modal | Self::Carrier)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tiers_are_ordered_and_found_by_name() {
        for tier in Tier::ALL {
            assert_eq!(Tier::from_name(tier.name()), Some(tier));
        }
        assert!(Tier::ALL.is_sorted());
        assert_eq!(Tier::from_name("Modal"), None);
        assert_eq!(Tier::default(), Tier::Modal);
    }
}
