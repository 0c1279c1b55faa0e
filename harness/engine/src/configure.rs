//! Translates the controller section of a scenario into the message `Configure`.

use platebench_model::scenario::{Diagnostic, Scenario, suggestion};
use platebench_plate::Time;
use platebench_wire::{Configure, Gains, Identity, LawId, capabilities};

pub fn law(scenario: &Scenario) -> Result<LawId, Diagnostic> {
    let name = &scenario.controller.law;
    LawId::from_name(name).ok_or_else(|| {
        let known = LawId::ALL.map(|law| format!("`{}`", law.name())).join(", ");
        let hint = suggestion(name, LawId::ALL.map(LawId::name));
        scenario.diagnostic("controller.law", format!("unknown law `{name}`, expected one of {known}{hint}"))
    })
}

/// Uses the nominal plate, because a controller does not know how a trial varies its plate.
pub fn configure(scenario: &Scenario, law: LawId) -> Configure {
    let controller = &scenario.controller;
    let plate = scenario.design_plate();
    Configure {
        law,
        paced_by_target: false,
        drives_own_plate: false,
        watchdog_timeout_ms: 0,
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

pub fn missing_capability(scenario: &Scenario, law: LawId, identity: &Identity) -> Option<String> {
    if !identity.has_law(law) {
        return Some(format!("the controller does not announce the law {}", law.name()));
    }
    let needs_delay = scenario.controller.design_delay != Time::ZERO;
    (needs_delay && !identity.has_capability(capabilities::LOOP_DELAY))
        .then(|| "the controller does not announce that it accepts a loop delay (design_delay_ms)".to_owned())
}

pub(crate) fn start_frequency_mhz(scenario: &Scenario) -> u32 {
    (scenario.controller.start_frequency_hz * 1e3).round() as u32
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_model::scenario::load;
    use std::path::Path;

    #[test]
    fn names_the_law_or_capability_that_is_missing() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios/paper/fig13-closed-loop.toml");
        let mut scenario = load(&path, "fig13.toml").unwrap_or_else(|fault| panic!("{fault}"));
        let identity = |capabilities, laws| Identity {
            version: [0; 3],
            capabilities,
            laws,
            build: [0; 8],
            chip: 0,
            unique: [0; 12],
            name: [0; 16],
        };
        let missing = |scenario: &Scenario, identity| missing_capability(scenario, LawId::DqPi, &identity);
        assert_eq!(missing(&scenario, identity(0, u32::MAX)), None);
        let reason = missing(&scenario, identity(0, 1 << LawId::OpenLoop as u8)).unwrap();
        assert!(reason.contains("the law dq-pi"), "{reason}");
        // `loop_delay` is the simulated delay. The controller gets only `design_delay`.
        scenario.controller.loop_delay = Time::from_nanos(700_000);
        assert_eq!(configure(&scenario, LawId::DqPi).loop_delay_us, 0);
        assert_eq!(missing(&scenario, identity(0, u32::MAX)), None);
        scenario.controller.design_delay = Time::from_nanos(400_000);
        assert_eq!(configure(&scenario, LawId::DqPi).loop_delay_us, 400);
        assert_eq!(missing(&scenario, identity(capabilities::LOOP_DELAY, u32::MAX)), None);
        let reason = missing(&scenario, identity(!capabilities::LOOP_DELAY, u32::MAX)).unwrap();
        assert!(reason.contains("design_delay_ms"), "{reason}");
    }
}
