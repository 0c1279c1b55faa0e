//! A scenario's controller in the words of the wire.

use platebench_scenario::{Diagnostic, Scenario};
use platebench_wire::{Configure, Gains, LawId};

/// The law that a scenario asks for.
///
/// # Errors
/// A [`Diagnostic`] at the law's name where there is no such law.
pub(crate) fn law(scenario: &Scenario) -> Result<LawId, Diagnostic> {
    let name = &scenario.controller.law;
    LawId::from_name(name).ok_or_else(|| {
        let known = LawId::ALL.map(|law| format!("`{}`", law.name())).join(", ");
        scenario.diagnose("controller.law", format!("unknown law `{name}`, expected one of {known}"))
    })
}

/// What the controller is told before a trial: the nominal plate, never the one that the trial drew.
pub(crate) fn configure(scenario: &Scenario, law: LawId) -> Configure {
    let controller = &scenario.controller;
    let plate = &scenario.plate;
    Configure {
        law,
        paced_by_target: false,
        patience_ms: 0,
        period_us: controller.period.wrapping_micros(),
        start_frequency_mhz: start_frequency_mhz(scenario),
        gain_um_per_vpp: plate.gain as f32,
        time_constant_s: (1.0 / plate.sigma0) as f32,
        response_time_s: controller.response_time_ms.map_or(0.0, |ms| (ms / 1e3) as f32),
        drive_limit_vpp: plate.drive_limit_vpp as f32,
        frequency_range_hz: controller.frequency_range_hz as f32,
        frequency_slew_hz: controller.frequency_slew_hz as f32,
        gains: controller.gains.map(|gains| Gains {
            amplitude_kp: gains.amplitude_kp as f32,
            amplitude_ki: gains.amplitude_ki as f32,
            frequency_kp: gains.frequency_kp as f32,
            frequency_ki: gains.frequency_ki as f32,
        }),
    }
}

/// The excitation frequency at the start, to the millihertz that the wire carries.
pub(crate) fn start_frequency_mhz(scenario: &Scenario) -> u32 {
    (scenario.controller.start_frequency_hz * 1e3).round() as u32
}
