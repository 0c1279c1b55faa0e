//! Builds scripts that test the watchdog, ticks and a long trial.

use super::builder::Builder;
use platebench_wire::{Configure, Message};

/// The waits differ much from the timeouts, because the host may stall and lengthen a wait.
pub(super) fn watchdog(builder: &mut Builder, configure: Configure) {
    // A timeout of 0 means five periods, here 250 ms.
    builder.configure(Configure { period_us: 50_000, watchdog_timeout_ms: 0, ..configure });
    builder.sample(2.0, 0.0, 0.0);
    builder.wait_ms(120);
    builder.sample(2.0, 1.2, -0.2);
    builder.wait_ms(150);
    builder.repeat_sample();
    builder.wait_ms(150);
    builder.sample(2.0, 1.3, -0.2);
    builder.sample(2.0, 1.3, -0.2);
    // This timeout needs more than eight bits. The watchdog does not act before the first sample.
    builder.configure(Configure { watchdog_timeout_ms: 300, ..configure });
    builder.wait_ms(400);
    builder.sample(2.0, 0.0, 0.0);
    builder.wait_ms(150);
    builder.sample(2.0, 1.2, -0.2);
    builder.wait_ms(400);
    builder.sample(2.0, f32::NAN, -0.2);
    builder.repeat_sample();
    // This timeout needs more than 15 bits.
    builder.configure(Configure { watchdog_timeout_ms: 40_000, ..configure });
    builder.sample(2.0, 0.0, 0.0);
    builder.wait_ms(150);
    builder.sample(2.0, 1.2, -0.2);
}

/// Tests a watchdog timeout of five periods of 300 µs, which is not a whole number of milliseconds.
pub(super) fn short_watchdog(builder: &mut Builder, configure: Configure) {
    builder.set_stall_us(250);
    let configure = Configure { period_us: 300, watchdog_timeout_ms: 0, ..configure };
    builder.configure(configure);
    builder.sample(2.0, 0.0, 0.0);
    builder.wait_us(1_200);
    builder.sample(2.0, 1.2, -0.2);
    builder.configure(configure);
    builder.sample(2.0, 0.0, 0.0);
    builder.wait_us(1_800);
    builder.sample(2.0, 1.2, -0.2);
}

pub(super) fn ticks(builder: &mut Builder, configure: Configure) {
    let paced = Configure { paced_by_target: true, period_us: 50_000, ..configure };
    builder.configure(paced);
    builder.add_wait_ms(225);
    builder.sample(2.0, 0.0, 0.0);
    builder.add_wait_ms(120);
    builder.sample(2.0, 1.2, -0.2);
    builder.ask(Message::Safe);
    builder.add_wait_ms(150);
    builder.configure(paced);
    builder.add_wait_ms(125);
    builder.configure(configure);
    builder.add_wait_ms(150);
    // Without samples, ticks end one second after the configuration.
    builder.configure(paced);
    builder.add_wait_ms(1_175);
    builder.sample(2.0, 0.0, 0.0);
}

/// Plays 300 ticks, so that their numbers wrap and delays of some microseconds add up to a large
/// part of a period.
pub(super) fn short_ticks(builder: &mut Builder, configure: Configure) {
    builder.configure(Configure { paced_by_target: true, period_us: 3_000, ..configure });
    builder.add_wait_ms(900);
    builder.configure(configure);
}

/// After the first sample, Wd is equal to the setpoint and the drive is constant. No variation is
/// needed, because nothing depends on rounding.
pub(super) fn many_samples(builder: &mut Builder) {
    if builder.has_variation() {
        builder.discard();
        return;
    }
    builder.sample(2.0, 1.9, 0.05);
    for _ in 0..=u16::MAX {
        builder.sample(2.0, 2.0, 0.0);
    }
}
