//! Defines the settings of a configuration other than plate, period and delay.

use crate::explore::envelope::Ranges;
use platebench_controller::design::{PiGains, default_response_time_s};
use platebench_model::scenario::Gains;
use platebench_model::scenario::raw::RawController;
use platebench_plate::Plate;
use platebench_wire::LawId;
use proptest::option;
use proptest::prelude::{BoxedStrategy, Just, Strategy};

/// In each field, `None` means the default of the law or of the scenario.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Tuning {
    /// Design value of the response time, 0.1 ms.
    pub response_tenths: Option<u32>,
    /// Gains of the amplitude loop and the frequency loop, percent of the law's own design.
    pub gains_percent: Option<[u32; 2]>,
    /// Largest deviation of the excitation frequency from the start frequency, 0.1 Hz.
    pub range_tenths: Option<u32>,
    /// Largest change of the excitation frequency per control period, 0.1 Hz.
    pub slew_tenths: Option<u32>,
}

/// Probability of each setting in a scene whose stratum has tuned configurations.
const SHARE: f64 = 0.4;

impl Tuning {
    pub(crate) fn strategy(ranges: &Ranges, is_tuned: bool) -> BoxedStrategy<Self> {
        if !is_tuned {
            return Just(Self::default()).boxed();
        }
        let whole = |[low, high]: [f64; 2], scale: f64| (low * scale) as u32..=(high * scale) as u32;
        let percent = || whole(ranges.configured_gains_percent, 1.0);
        let fields = (
            option::weighted(SHARE, whole(ranges.response_time_ms, 10.0)),
            option::weighted(SHARE, (percent(), percent())),
            option::weighted(SHARE, whole(ranges.frequency_range_hz, 10.0)),
            option::weighted(SHARE, whole(ranges.frequency_slew_hz, 10.0)),
        );
        fields
            .prop_map(|(response_tenths, gains, range_tenths, slew_tenths)| Self {
                response_tenths,
                gains_percent: gains.map(|(amplitude, frequency)| [amplitude, frequency]),
                range_tenths,
                slew_tenths,
            })
            .boxed()
    }

    /// `controller` with these settings. `design` is the configured plate.
    pub(crate) fn apply(&self, controller: RawController, law: LawId, design: &Plate, period_us: u32) -> RawController {
        let tenths = |value: Option<u32>| value.map(|tenths| f64::from(tenths) / 10.0);
        let gains = self.gains_percent.map(|[amplitude, frequency]| {
            let period = f64::from(period_us) * 1e-6;
            let (tau, response) = (1.0 / design.sigma0, default_response_time_s(law));
            let scaled = |plant_gain: f64, percent: u32| {
                let PiGains { proportional, integral_per_period } =
                    PiGains::of_law(law, plant_gain, tau, response, period);
                [proportional, integral_per_period / period].map(|gain| rounded(gain * f64::from(percent) / 100.0, 4))
            };
            let ([amplitude_kp, amplitude_ki], [frequency_kp, frequency_ki]) =
                (scaled(design.gain, amplitude), scaled(tau, frequency));
            Gains { amplitude_kp, amplitude_ki, frequency_kp, frequency_ki }
        });
        RawController {
            response_time_ms: tenths(self.response_tenths),
            frequency_range_hz: tenths(self.range_tenths),
            frequency_slew_hz: tenths(self.slew_tenths),
            gains,
            ..controller
        }
    }
}

/// Rounds to `decimals` + 1 significant digits.
pub(crate) fn rounded(value: f64, decimals: usize) -> f64 {
    format!("{value:.decimals$e}").parse().unwrap_or(value)
}
