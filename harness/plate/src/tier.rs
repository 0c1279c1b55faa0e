//! How much of the plate is modelled, from cheapest to dearest.

/// How much of the plate is modelled.
///
/// `docs/mathematics.md` says what each leaves out and what that costs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub enum Tier {
    /// Equations 13 and 19: Wd from V and Wq/Wd from Δω, each of first order and without the other. For analysis.
    Linear,
    /// First order, W as a whole: the slow pole alone.
    Envelope,
    /// Second order, exact for one mode.
    #[default]
    Modal,
    /// The modal plate with the phase of its carrier: the waveform, and the sensor's converter and demodulator that read it.
    /// W and U are those of [`Tier::Modal`], bit for bit.
    Carrier,
}

impl Tier {
    /// Every tier, from cheapest to dearest.
    pub const ALL: [Self; 4] = [Self::Linear, Self::Envelope, Self::Modal, Self::Carrier];

    /// The tier's name in scenario files and records.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Linear => "linear",
            Self::Envelope => "envelope",
            Self::Modal => "modal",
            Self::Carrier => "carrier",
        }
    }

    /// The tier of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|tier| tier.name() == name)
    }

    /// True where W has both poles and U is part of the state.
    pub const fn has_both_poles(self) -> bool {
        matches!(self, Self::Modal | Self::Carrier)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_lead_back_and_the_order_is_that_of_cost() {
        for tier in Tier::ALL {
            assert_eq!(Tier::from_name(tier.name()), Some(tier));
        }
        assert!(Tier::ALL.is_sorted());
        assert_eq!(Tier::from_name("Modal"), None);
        assert_eq!(Tier::default(), Tier::Modal);
    }
}
