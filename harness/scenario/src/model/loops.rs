//! What is known of a scenario's loop before it is played: ranges of the plate, drives that the law will ask for, and by how much its loop
//! amplifies a difference between two plates.
//!
//! Only laws whose loop is one of the matched designs, or none, are known here. Of laws that decide (`deadbeat`, `bang-bang`), of gains that somebody
//! else chose and of lines that lose messages nothing is claimed.

use crate::scenario::Scenario;
use platebench_plate::{Beforehand, Profile};
use std::f64::consts::{PI, SQRT_2, TAU};

/// The laws' own design value of the 5 % response time, s.
const MATCHED_RESPONSE_S: f64 = 1.9e-3;
const PRINTED_RESPONSE_S: f64 = 2.0e-3;
/// |W| and the drive go beyond the sampled design's step response by less than this: a start off resonance and the fast mode, which it does not know.
const BEYOND_DESIGN: f64 = 1.2;
/// What the noise is taken to stay within, in standard deviations.
const NOISE_SPAN: f64 = 5.0;
/// `dq-pi` takes a plate for another one from a quarter on; up to here it never does.
const SAME_PLATE: f64 = 1.1;
/// The ratio Wq/Wd is cut off at 2: up to here it never is.
const LARGEST_RATIO: f64 = 1.5;
/// The frequency loop rests while Wd is below a tenth of the setpoint: up to this ratio of setpoints a step never leads there.
const LARGEST_STEP: f64 = 8.0;
/// Periods over which a response is followed, and what has to be left of it then.
const HORIZON: u32 = 400;
const AT_REST: f64 = 1e-6;

/// What is known of a scenario.
#[derive(Debug, Clone, Copy)]
pub(super) struct Known {
    pub(super) beforehand: Beforehand,
    /// Factor from a difference under the same drives to the difference in the loop.
    pub(super) amplification: f64,
}

/// Smallest and largest of what trials draw, as factors, and of the temperature in K.
struct Drawn {
    gain: (f64, f64),
    time_constant: (f64, f64),
    sensor_gain: (f64, f64),
    temperature_k: (f64, f64),
}

fn over((low, high): (f64, f64), value: f64) -> (f64, f64) {
    (low.min(value), high.max(value))
}

impl Drawn {
    /// The draws themselves: they follow from the seed.
    fn of(scenario: &Scenario) -> Self {
        let start =
            Self { gain: (1.0, 1.0), time_constant: (1.0, 1.0), sensor_gain: (1.0, 1.0), temperature_k: (0.0, 0.0) };
        if scenario.trials.spread == crate::Spread::default() {
            return start;
        }
        (0..scenario.trials.max_count).map(|index| scenario.variation(index)).fold(start, |drawn, trial| Self {
            gain: over(drawn.gain, trial.gain),
            time_constant: over(drawn.time_constant, trial.time_constant),
            sensor_gain: over(drawn.sensor_gain, trial.sensor_gain),
            temperature_k: over(drawn.temperature_k, trial.temperature_k),
        })
    }
}

/// Lowest and highest σ over the forces and the trials, 1/s.
pub(super) fn sigma(scenario: &Scenario) -> (f64, f64) {
    sigma_of(scenario, &Drawn::of(scenario))
}

fn sigma_of(scenario: &Scenario, drawn: &Drawn) -> (f64, f64) {
    let (low, high) = scenario.plate.sigma_within(scenario.scene.finger_force_n.range());
    (low / drawn.time_constant.1, high / drawn.time_constant.0)
}

/// The law's loops, as far as they are known.
struct Loops {
    /// Proportional gain and integral gain per period, Vpp per µm; both 0 without a loop.
    proportional: f64,
    integral: f64,
    follows_frequency: bool,
    /// True where the gains follow the plate's damping.
    schedules: bool,
}

fn loops(scenario: &Scenario) -> Option<Loops> {
    let controller = &scenario.controller;
    let (gain, sigma0, period) = (scenario.plate.gain, scenario.plate.sigma0, controller.period.seconds());
    let response = |own: f64| controller.response_time_ms.map_or(own, |ms| ms / 1e3);
    let pole = (-sigma0 * period).exp();
    let matched = (1.0 - (-3.0 * period / response(MATCHED_RESPONSE_S)).exp()) / (gain * (1.0 - pole));
    let printed = 3.0 / (sigma0 * gain * response(PRINTED_RESPONSE_S));
    let of = |proportional, integral, follows_frequency, schedules| {
        Some(Loops { proportional, integral, follows_frequency, schedules })
    };
    match controller.law.as_str() {
        "open-loop" => of(0.0, 0.0, false, false),
        _ if controller.gains.is_some() => None,
        "dq-pi" => of(matched, matched * (1.0 - pole), true, true),
        "dq-pi-fixed" => of(matched, matched * (1.0 - pole), true, false),
        "dq-pi-euler" => of(printed, printed * sigma0 * period, true, false),
        "voltage-only" => of(matched, matched * (1.0 - pole), false, false),
        _ => None,
    }
}

/// By how much a drive moves at once when W does, Vpp per µm; infinite where that is not known.
pub(super) fn proportional_gain(scenario: &Scenario) -> f64 {
    loops(scenario).map_or(f64::INFINITY, |loops| 2.0 * loops.proportional)
}

/// What is known of a scenario; `None` where the loop is not.
pub(super) fn known(scenario: &Scenario) -> Option<Known> {
    let loops = loops(scenario)?;
    let drawn = Drawn::of(scenario);
    let (plate, scene, controller) = (&scenario.plate, &scenario.scene, &scenario.controller);
    let sigma = sigma_of(scenario, &drawn);
    let period = controller.period.seconds();
    let omega0 = {
        let (cold, warm) = scene.temperature_offset_k.range();
        let (light, heavy) = scene.finger_force_n.range();
        let temperatures = [cold + drawn.temperature_k.0, warm + drawn.temperature_k.1];
        let all = temperatures.iter().flat_map(|kelvin| {
            [light, heavy].map(|force| plate.omega0 + plate.omega0_per_k * kelvin + plate.omega0_per_n * force)
        });
        all.fold((f64::INFINITY, f64::NEG_INFINITY), over)
    };
    let start = TAU * controller.start_frequency_hz;
    let off = (start - omega0.0).abs().max((start - omega0.1).abs());
    let constant = plate.gain * plate.sigma0 * drawn.gain.1 / drawn.time_constant.0;
    let weakest = plate.gain * plate.sigma0 * drawn.gain.0 / drawn.time_constant.1;
    let (per_n, per_k) = plate.pole_sensitivity();
    let variation =
        |profile: &Profile, from_rest| profile.decayed_variation(sigma.0, from_rest) * (sigma.0 * period).exp();
    let pole_swing = per_n / drawn.time_constant.0 * variation(&scene.finger_force_n, false)
        + per_k * variation(&scene.temperature_offset_k, false);
    let steps_um = variation(&scenario.setpoint, true);
    let largest_um = scenario.setpoint.range().1;
    let beforehand = Beforehand {
        sigma,
        omega0,
        reference_omega0: plate.omega0,
        envelope_constant: constant,
        detuning: if loops.follows_frequency { off + TAU * controller.frequency_range_hz } else { off },
        varies: scene.temperature_offset_k.varies() || scene.finger_force_n.varies(),
        pole_swing,
        sensor_latency_s: 0.0,
        sensor_error_um: 0.0,
        amplitude_um: 0.0,
        push_um: 0.0,
        drive_vpp: 0.0,
        drive_swing_vpp: 0.0,
    };
    if loops.proportional == 0.0 {
        let drive_vpp = (largest_um / plate.gain).min(plate.drive_limit_vpp);
        let push_um = constant * drive_vpp / sigma.0;
        let drive_swing_vpp = steps_um / plate.gain;
        let beforehand = Beforehand { amplitude_um: push_um, push_um, drive_vpp, drive_swing_vpp, ..beforehand };
        return Some(Known { beforehand: sensed(scenario, beforehand)?, amplification: 1.0 });
    }
    if !is_regular(scenario, &loops, &drawn, sigma, off) {
        return None;
    }
    let response = response(scenario, &loops, &drawn, sigma)?;
    let damped = sigma.1.hypot(off);
    let amplitude_um = BEYOND_DESIGN * response.peak * largest_um / drawn.sensor_gain.0;
    let holding = |um: f64| um * damped / weakest;
    let jump_um = largest_jump(&scenario.setpoint, period);
    let noise_vpp = NOISE_SPAN * loops.proportional * plate.noise_um_rms;
    let stepped = BEYOND_DESIGN * response.drive_peak * jump_um + holding(largest_um - jump_um);
    let drive_vpp = noise_vpp + stepped.max(holding(amplitude_um));
    // Another plate asks for another drive, and the loop goes there with an overshoot of its own.
    let settled = holding(largest_um) - largest_um * sigma.0 / weakest;
    let drive_swing_vpp = BEYOND_DESIGN * response.drive_variation * steps_um
        + 2.0 * response.peak * (settled + amplitude_um * pole_swing / weakest)
        + 2.0 * noise_vpp / (1.0 - (-sigma.0 * period).exp());
    if drive_vpp > plate.drive_limit_vpp {
        return None;
    }
    let push_um = amplitude_um * damped / sigma.0;
    let beforehand = Beforehand { amplitude_um, push_um, drive_vpp, drive_swing_vpp, ..beforehand };
    let amplification = response.sensitivity * of_both_loops(scenario, &loops, off);
    Some(Known { beforehand: sensed(scenario, beforehand)?, amplification })
}

/// The same with the sensor's electronics; `None` where they may clip.
fn sensed(scenario: &Scenario, beforehand: Beforehand) -> Option<Beforehand> {
    let Some(lockin) = scenario.plate.lockin else { return Some(beforehand) };
    let omega = beforehand.omega0.0 - beforehand.detuning;
    let periods = f64::from(lockin.periods);
    let samples = periods * TAU / (beforehand.omega0.1 + beforehand.detuning) * lockin.converter_hz;
    let (step_um, range_um) = lockin.resolution.map_or((0.0, f64::INFINITY), |adc| (adc.step_um(), adc.range_um));
    // The oldest sample counts in part; each is off by half a step at most, and is doubled.
    let sensor_error_um = PI * periods / (2.0 * samples * samples) * beforehand.amplitude_um + step_um;
    let known = Beforehand { sensor_latency_s: lockin.latency(omega), sensor_error_um, ..beforehand };
    (known.amplitude_um <= range_um).then_some(known)
}

/// True where no decision that a law takes can turn out differently on two plates that are nearly alike.
fn is_regular(scenario: &Scenario, loops: &Loops, drawn: &Drawn, sigma: (f64, f64), off: f64) -> bool {
    let (plate, controller) = (&scenario.plate, &scenario.controller);
    let same = |(low, high): (f64, f64)| high < SAME_PLATE && low > 1.0 / SAME_PLATE;
    let known_plate = same((sigma.0 / plate.sigma0, sigma.1 / plate.sigma0)) && same(drawn.gain);
    let silent = plate.noise_um_rms == 0.0 && controller.loop_delay.as_nanos() == 0;
    let unchanged = !loops.schedules || (known_plate && silent && same(drawn.sensor_gain));
    let (low, high) = (super::smallest_setpoint(&scenario.setpoint), scenario.setpoint.range().1);
    let never_rests = match &scenario.setpoint {
        Profile::Hold(points) => points.iter().skip_while(|point| point.1 <= 0.0).all(|point| point.1 > 0.0),
        _ => true,
    };
    let in_range = off < TAU * controller.frequency_range_hz;
    let followed = !loops.follows_frequency || (never_rests && high <= LARGEST_STEP * low && in_range);
    unchanged && followed && off <= LARGEST_RATIO * sigma.0
}

/// The largest change of the setpoint that a law sees within a period, µm.
fn largest_jump(setpoint: &Profile, period: f64) -> f64 {
    let first = setpoint.at(platebench_plate::Time::ZERO).abs();
    match setpoint {
        Profile::Hold(points) => points.windows(2).map(|pair| (pair[1].1 - pair[0].1).abs()).fold(first, f64::max),
        Profile::Linear(points) => points
            .windows(2)
            .map(|pair| (pair[1].1 - pair[0].1).abs() * (period / (pair[1].0 - pair[0].0).seconds()).min(1.0))
            .fold(first, f64::max),
        Profile::Sine { amplitude, omega, .. } => first + (amplitude * omega * period).abs(),
    }
}

/// What two loops make of a difference beyond what one does. A ratio Wq/Wd that is off turns a larger setpoint by as much, and a start off resonance couples
/// the loops: each turns the other's error by Δω Ts.
fn of_both_loops(scenario: &Scenario, loops: &Loops, off: f64) -> f64 {
    let coupled = (1.0 + off * scenario.controller.period.seconds()).powi(2);
    let spread = scenario.setpoint.range().1 / super::smallest_setpoint(&scenario.setpoint);
    if loops.follows_frequency { SQRT_2 * spread * coupled } else { coupled }
}

/// What the sampled loop does, worst over the plates that trials have.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Response {
    /// `1 + Σ|w|` over the response w to an impulse in what the controller sees: a difference e under the same drives enters there, and leaves nowhere more
    /// than this times its largest value.
    sensitivity: f64,
    /// Largest |W| after a unit step of the setpoint.
    peak: f64,
    /// Highest drive after that step, Vpp per µm.
    drive_peak: f64,
    /// Sum of the drive's changes after it, Vpp per µm.
    drive_variation: f64,
}

/// `None` where the loop does not come to rest.
fn response(scenario: &Scenario, loops: &Loops, drawn: &Drawn, sigma: (f64, f64)) -> Option<Response> {
    let period = scenario.controller.period.seconds();
    let delay = scenario.controller.loop_delay.seconds() / period;
    if delay >= 1.0 {
        return None;
    }
    let mut worst = Response { sensitivity: 0.0, peak: 0.0, drive_peak: 0.0, drive_variation: 0.0 };
    for step in 0..=4 {
        let damping = sigma.0 + (sigma.1 - sigma.0) * f64::from(step) / 4.0;
        let gain = scenario.plate.gain * scenario.plate.sigma0 / damping;
        for factor in [drawn.gain.0 * drawn.sensor_gain.0, drawn.gain.1 * drawn.sensor_gain.1] {
            let one = response_of(loops, gain * factor, damping * period, delay)?;
            worst = Response {
                sensitivity: worst.sensitivity.max(one.sensitivity),
                peak: worst.peak.max(one.peak),
                drive_peak: worst.drive_peak.max(one.drive_peak),
                drive_variation: worst.drive_variation.max(one.drive_variation),
            };
        }
    }
    Some(worst)
}

/// Of a plate of static `gain` that forgets with e^(−`decay`) per period, `delay` in periods below 1.
fn response_of(loops: &Loops, gain: f64, decay: f64, delay: f64) -> Option<Response> {
    let mut sensitivity = 1.0;
    let impulse = |instant| if instant == 0 { -1.0 } else { 0.0 };
    let came_back = play(loops, gain, decay, delay, impulse, |w, _| sensitivity += w.abs());
    let (mut peak, mut drive_peak, mut drive_variation, mut before) = (1.0_f64, 0.0_f64, 0.0, 0.0);
    let came_to_rest = play(
        loops,
        gain,
        decay,
        delay,
        |_| 1.0,
        |w, drive: f64| {
            peak = peak.max(w.abs());
            drive_peak = drive_peak.max(drive.abs());
            drive_variation += (drive - before).abs();
            before = drive;
        },
    );
    let rests = came_back.abs() < AT_REST && (came_to_rest - 1.0).abs() < AT_REST;
    rests.then_some(Response { sensitivity, peak, drive_peak, drive_variation })
}

/// Plays the sampled loop from rest on what `asks` adds to its error, and returns the last W; `tell` hears W at the end of each period, and its drive.
fn play(
    loops: &Loops,
    gain: f64,
    decay: f64,
    delay: f64,
    asks: impl Fn(u32) -> f64,
    mut tell: impl FnMut(f64, f64),
) -> f64 {
    let pole = (-decay).exp();
    // The last drive acts for the delay, the new one for the rest.
    let rest = (-decay * (1.0 - delay)).exp();
    let (old_share, new_share) = (gain * (rest - pole), gain * (1.0 - rest));
    let (mut w, mut integral, mut before) = (0.0_f64, 0.0, 0.0);
    for instant in 0..HORIZON {
        let error = asks(instant) - w;
        let drive = loops.proportional * error + integral;
        integral += loops.integral * error;
        w = pole * w + old_share * before + new_share * drive;
        before = drive;
        tell(w, drive);
    }
    w
}

#[cfg(test)]
mod tests {
    use super::*;
    use rstest::rstest;

    /// The matched design for a closed-loop pole, on a plate of gain 0.5.
    fn matched(closed: f64, decay: f64) -> Loops {
        let open = (-decay).exp();
        let proportional = (1.0 - closed) / (0.5 * (1.0 - open));
        Loops { proportional, integral: proportional * (1.0 - open), follows_frequency: false, schedules: false }
    }

    /// S = (z − 1)/(z − p): 1, and what is left sums to 1 whatever the pole is. The step response is 1 − p^k.
    #[rstest]
    fn every_matched_design_doubles_a_difference(
        #[values(0.05, 0.2, 0.6)] pole: f64,
        #[values(0.1, 0.53, 2.0)] decay: f64,
    ) {
        let found = response_of(&matched(pole, decay), 0.5, decay, 0.0).unwrap();
        assert!((found.sensitivity - 2.0).abs() < 1e-6, "{found:?}");
        assert!(
            (found.peak - 1.0).abs() < 1e-6
                && (found.drive_peak - matched(pole, decay).proportional.max(2.0)).abs() < 1e-6,
            "{found:?}"
        );
    }

    #[test]
    fn a_delay_makes_more_of_it_until_nothing_comes_to_rest() {
        let design = matched(0.206, 0.532);
        let found: Vec<_> =
            [0.0, 0.2, 0.4, 0.6, 0.8].map(|delay| response_of(&design, 0.5, 0.532, delay).unwrap()).into();
        assert!(found.is_sorted_by(|a, b| a.sensitivity < b.sensitivity && a.peak <= b.peak), "{found:?}");
        assert!(found[4].sensitivity > 3.5, "{found:?}");
        // Twice the plate's gain is more than the loop bears with that.
        assert!(response_of(&design, 1.0, 0.532, 0.8).is_none());
    }
}
