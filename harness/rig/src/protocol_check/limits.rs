//! Builds scripts that test limits with fractions, unused gains, and a threshold.

use super::builder::{Builder, Script, Variation, configuration_body, script};
use platebench_wire::Configure;

pub(super) fn scripts(fixed: &Configure, variation: Variation) -> Vec<Script> {
    let start = |name, configure, write: &dyn Fn(&mut Builder)| {
        script(name, variation, |builder| {
            builder.configure(configure);
            write(builder);
        })
    };
    let own_design = Configure { gains: None, ..*fixed };
    // This script tests an exact threshold, so Wd must not vary.
    let exact = Variation { components: 0.0, ..variation };
    vec![
        start("a drive limit with a fraction", Configure { drive_limit_vpp: 9.75, ..*fixed }, &|builder| {
            drive_limit(builder, 1.0);
        }),
        // A controller that stores the limit in units of 0.1 V as 16 bits must fail here.
        start("a drive limit of 70 kV", Configure { drive_limit_vpp: 70_000.25, ..*fixed }, &|builder| {
            drive_limit(builder, 500.0);
        }),
        // No multiple of the slew lies halfway between two mHz, so that rounding is unambiguous.
        start(
            "frequency limits of a few mHz",
            Configure { frequency_range_hz: 0.0506, frequency_slew_hz: 0.0014, ..*fixed },
            &frequency_limits,
        ),
        start(
            "Wq/Wd beyond its limits",
            Configure { frequency_range_hz: 5_000.0, frequency_slew_hz: 5_000.0, ..*fixed },
            &ratio,
        ),
        start("gains that are not used", own_design, &|builder| unused_gains(builder, &own_design)),
        script("gains of the law's own design", variation, |builder| designs(builder, &own_design)),
        script("Wd of a tenth of the setpoint", exact, |builder| threshold(builder, fixed)),
    ]
}

fn drive_limit(builder: &mut Builder, scale: f32) {
    for wd in [0.0, 1.0, 3.0, 1.9, 1.99, 1.0] {
        builder.sample(2.0 * scale, wd * scale, -0.1 * scale);
    }
}

fn frequency_limits(builder: &mut Builder) {
    for _ in 0..40 {
        builder.sample(2.0, 1.0, 2.5);
    }
    for _ in 0..80 {
        builder.sample(2.0, 1.0, -2.5);
    }
}

fn ratio(builder: &mut Builder) {
    for wq in [1.9, -1.9, 2.2, -2.2, 9.0, -9.0, 0.5] {
        builder.sample(2.0, 1.0, wq);
    }
}

/// If bit 0 of the configuration's flags is not set, the controller must ignore the gains.
fn unused_gains(builder: &mut Builder, configure: &Configure) {
    let Configure { gain_um_per_vpp, time_constant_s, drive_limit_vpp, .. } = *configure;
    for gain in [f32::NAN, f32::INFINITY, -7e5] {
        let values = [gain_um_per_vpp, time_constant_s, 0.0, drive_limit_vpp, 250.0, 50.0, gain, gain, gain, gain];
        builder.ask_body(&configuration_body(configure, 0, values));
        builder.sample(2.0, 0.0, 0.0);
        builder.sample(2.0, 1.2, -0.2);
    }
}

fn designs(builder: &mut Builder, configure: &Configure) {
    for (period_us, response_time_s, time_constant_s) in [
        (1_000, 0.000_3, 0.0019),
        (1_000, 0.000_9, 0.0019),
        (1_000, 0.02, 0.0019),
        (1_000, 0.5, 0.0019),
        (100, 0.0019, 0.0019),
        (20_000, 0.03, 0.05),
        (70_000, 0.0, 0.2),
        (1_000, 0.0, 0.000_2),
        (250, 0.004, 0.03),
    ] {
        builder.configure(Configure { period_us, response_time_s, time_constant_s, ..*configure });
        for (wd, wq) in [(0.0, 0.0), (0.15, 0.05), (0.9, -0.3), (1.6, -0.2), (1.95, 0.1)] {
            builder.sample(2.0, wd, wq);
        }
    }
}

/// The control loop rests if Wd is at most a tenth of the setpoint.
fn threshold(builder: &mut Builder, configure: &Configure) {
    builder.configure(*configure);
    builder.sample(2.5, 0.25, 0.1);
    builder.sample(2.5, 0.26, 0.1);
    builder.sample(0.0, 0.25, 0.1);
}
