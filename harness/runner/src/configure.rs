//! A scenario's controller in the words of the wire.

use platebench_plate::Time;
use platebench_scenario::{Diagnostic, Scenario, suggestion};
use platebench_wire::{Configure, Gains, Identity, LawId, capabilities};

/// The law that a scenario asks for.
///
/// # Errors
/// A [`Diagnostic`] at the law's name where there is no such law.
pub fn law(scenario: &Scenario) -> Result<LawId, Diagnostic> {
    let name = &scenario.controller.law;
    LawId::from_name(name).ok_or_else(|| {
        let known = LawId::ALL.map(|law| format!("`{}`", law.name())).join(", ");
        let hint = suggestion(name, LawId::ALL.map(LawId::name));
        scenario.diagnose("controller.law", format!("unknown law `{name}`, expected one of {known}{hint}"))
    })
}

/// What the controller is told before a trial: the nominal plate, never the one that the trial drew.
pub fn configure(scenario: &Scenario, law: LawId) -> Configure {
    let controller = &scenario.controller;
    let plate = &scenario.plate;
    Configure {
        law,
        paced_by_target: false,
        drives_own_plate: false,
        patience_ms: 0,
        period_us: controller.period.wrapping_micros(),
        loop_delay_us: controller.design_delay.wrapping_micros(),
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

/// Nothing where the controller can be told all that `scenario` tells it.
///
/// # Errors
/// A [`Diagnostic`] at the loop delay where a controller that does not know this part of the protocol is to be told one.
pub(crate) fn can_be_told(scenario: &Scenario, identity: &Identity) -> Result<(), Diagnostic> {
    if scenario.controller.design_delay == Time::ZERO || identity.can(capabilities::TOLD_DELAY) {
        return Ok(());
    }
    Err(scenario.diagnose(
        "controller.design_delay_ms",
        "the controller does not say that it can be told a loop delay, expected 0 or no such key",
    ))
}

/// The excitation frequency at the start, to the millihertz that the wire carries.
pub(crate) fn start_frequency_mhz(scenario: &Scenario) -> u32 {
    (scenario.controller.start_frequency_hz * 1e3).round() as u32
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_scenario::load;
    use std::path::Path;

    #[test]
    fn only_a_controller_that_can_be_told_a_delay_is_told_one() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios/paper/fig13-closed-loop.toml");
        let mut scenario = load(&path, "fig13.toml").unwrap_or_else(|fault| panic!("{fault}"));
        let identity = |capabilities| Identity {
            version: [0; 3],
            capabilities,
            laws: u32::MAX,
            build: [0; 8],
            chip: 0,
            unique: [0; 12],
            name: [0; 16],
        };
        assert_eq!(configure(&scenario, LawId::DqPi).loop_delay_us, 0);
        can_be_told(&scenario, &identity(0)).unwrap();
        // What acts on the plate is not what the law is told.
        scenario.controller.loop_delay = Time::from_nanos(700_000);
        assert_eq!(configure(&scenario, LawId::DqPi).loop_delay_us, 0);
        scenario.controller.design_delay = Time::from_nanos(400_000);
        assert_eq!(configure(&scenario, LawId::DqPi).loop_delay_us, 400);
        can_be_told(&scenario, &identity(capabilities::TOLD_DELAY)).unwrap();
        let fault = can_be_told(&scenario, &identity(!capabilities::TOLD_DELAY)).unwrap_err();
        assert!(fault.message.contains("can be told a loop delay"), "{fault}");
    }
}
