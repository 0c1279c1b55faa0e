//! Builds scripts of random configurations and samples.

use super::builder::{Builder, Script, Variation, script};
use platebench_wire::{Configure, Gains, Identity, LawId, capabilities};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

const SCRIPTS: u64 = 40;
const SAMPLES: usize = 40;

/// Returns pairs of scripts, each with its own random configuration. The first of a pair has
/// configured gains, the second the law's own design.
pub(super) fn scripts(base: &Configure, identity: &Identity, variation: Variation, seed: u64) -> Vec<Script> {
    let mut all = Vec::new();
    for number in 0..SCRIPTS {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        random.set_stream(number);
        // Only the second script may have a loop delay. With a delay, the law predicts the plate
        // with K1, which no variation changes if the gains are configured.
        let has_delay = number % 4 == 3 && identity.has_capability(capabilities::LOOP_DELAY);
        all.push(script("random samples with configured gains", variation, |builder| {
            builder.configure(random_configuration(&mut random, base, true, false));
            random_samples(&mut random, builder);
        }));
        let law = match number % 8 {
            1 if identity.has_law(LawId::DqPiFixed) => LawId::DqPiFixed,
            5 if identity.has_law(LawId::DqPiEuler) => LawId::DqPiEuler,
            _ => base.law,
        };
        all.push(script("random samples with the law's own design", variation, |builder| {
            builder.configure(Configure { law, ..random_configuration(&mut random, base, false, has_delay) });
            random_samples(&mut random, builder);
        }));
    }
    all
}

fn uniform(random: &mut ChaCha8Rng, low: f32, high: f32) -> f32 {
    low + (high - low) * ((random.next_u32() >> 8) as f32 / (1_u32 << 24) as f32)
}

fn random_configuration(random: &mut ChaCha8Rng, base: &Configure, has_gains: bool, has_delay: bool) -> Configure {
    let mut range = |low, high| uniform(random, low, high);
    let longest_us = range(300.0, 4000.0);
    let time_constant_s = range(0.001, 0.004);
    // Over a period of several time constants, the factor e^z of the law's identification becomes
    // too small for single precision.
    let period_us = if has_gains { longest_us } else { longest_us.min(time_constant_s * 1e6) } as u32;
    let gains = Gains {
        amplitude_kp: range(-60.0, 600.0),
        amplitude_ki: range(0.0, 150_000.0),
        frequency_kp: range(-200.0, 2000.0),
        frequency_ki: range(0.0, 600_000.0),
    };
    Configure {
        period_us,
        start_frequency_mhz: range(32_100_000.0, 32_500_000.0) as u32,
        gain_um_per_vpp: range(0.004, 0.012),
        time_constant_s,
        response_time_s: if has_gains { 0.0 } else { range(0.0009, 0.006) },
        drive_limit_vpp: range(300.0, 1500.0),
        frequency_range_hz: range(20.0, 400.0),
        frequency_slew_hz: range(2.0, 200.0),
        gains: has_gains.then_some(gains),
        loop_delay_us: if has_delay { period_us / 3 } else { 0 },
        ..*base
    }
}

/// Adds samples whose setpoint lasts five samples on average. Wd follows the setpoint and Wq goes
/// to zero, both with random jumps. Wd is sometimes negative.
fn random_samples(random: &mut ChaCha8Rng, builder: &mut Builder) {
    let (mut setpoint, mut wd, mut wq) = (1.0, 0.0, 0.0);
    for _ in 0..SAMPLES {
        if random.next_u32().is_multiple_of(5) {
            setpoint = if random.next_u32().is_multiple_of(5) { 0.0 } else { uniform(random, 0.1, 4.0) };
        }
        let share = uniform(random, 0.1, 0.9);
        wd += (setpoint - wd) * share + uniform(random, -0.2, 0.2) * setpoint;
        wq += uniform(random, -0.3, 0.3) * setpoint - 0.3 * wq;
        if random.next_u32().is_multiple_of(17) {
            wd = -wd;
        }
        builder.sample(setpoint, wd, wq);
    }
}
