//! Lists the scripts: messages that no closed loop with a plate sends.

use super::script::Script;
use super::script::Step::{
    self, Again, Ahead, Ask, AskBody, Body, Bytes, Damaged, InPieces, Rejected, Repeat, Sample, Send, Setup, Silence,
    Wait, WaitUs,
};
use platebench_wire::{
    Command, Configure, Configured, ControllerState, FaultReport, Gains, Identity, LawId, Message, Rejection, Setpoint,
    StateCause, Tick, capabilities,
};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use std::time::Duration;

pub(super) const CONFIGURED_GAINS: Gains =
    Gains { amplitude_kp: 275.0, amplitude_ki: 110_000.0, frequency_kp: 900.0, frequency_ki: 400_000.0 };
/// Length of a sample's frame, bytes.
const SAMPLE_FRAME: usize = 24;
/// Number of pairs of random scripts, and of samples in each script.
const RANDOM_SCRIPTS: u64 = 40;
const RANDOM_SAMPLES: usize = 40;
/// A script with periods of 300 µs tolerates a delay of an exchange below one period.
const SHORT_STALL: Duration = Duration::from_micros(250);

pub(super) fn scripts(base: &Configure, identity: &Identity, seed: u64, own_law: bool) -> Vec<Script> {
    let fixed = Configure { gains: Some(CONFIGURED_GAINS), start_frequency_mhz: 32_307_654, ..*base };
    let own_design = Configure { gains: None, ..fixed };
    let with = |name, configure, steps: Vec<Step>| Script::new(name, [Setup(configure)].into_iter().chain(steps));
    let start = |name, steps| with(name, fixed, steps);
    let mut all = vec![
        start("a repeated sample", repeated_samples(fixed)),
        start("numbers of samples with gaps", gaps()),
        start("samples at rest and negative components", rest()),
        start("hello and 0 V while running", hello(fixed)),
        start("samples with the number of another message", numbers(fixed)),
        start("messages that only a controller sends", ignored(identity)),
        start("the counter of rejected frames", counter(fixed)),
        start("one damaged bit in every byte of a frame", damaged()),
        start("invalid messages with a valid CRC", invalid_bodies()),
        start("the watchdog with its own timeout", watchdog(fixed)),
        Script { stall: SHORT_STALL, ..start("a watchdog of five short periods", short_watchdog(fixed)) },
        start("a watchdog near its timeout, with other periods", near_watchdog(fixed)),
        Script::new("configurations that differ in one figure", figures(own_design)),
        many_samples(fixed),
        start("frames in two pieces", pieces()),
        start("configurations that are rejected as messages", invalid_configurations(fixed)),
        with("a drive limit with a fraction", Configure { drive_limit_vpp: 9.75, ..fixed }, drive_limit(1.0)),
        // A controller that stores the limit in units of 0.1 V as 16 bits must fail here.
        with("a drive limit of 70 kV", Configure { drive_limit_vpp: 70_000.25, ..fixed }, drive_limit(500.0)),
        // No multiple of the slew lies halfway between two mHz, so that rounding is unambiguous.
        with(
            "frequency limits of a few mHz",
            Configure { frequency_range_hz: 0.0506, frequency_slew_hz: 0.0014, ..fixed },
            [vec![Sample(2.0, 1.0, 2.5); 40], vec![Sample(2.0, 1.0, -2.5); 80]].concat(),
        ),
        with(
            "Wq/Wd beyond its limits",
            Configure { frequency_range_hz: 5_000.0, frequency_slew_hz: 5_000.0, ..fixed },
            [1.9, -1.9, 2.2, -2.2, 9.0, -9.0, 0.5].map(|wq| Sample(2.0, 1.0, wq)).into(),
        ),
        with("gains that are not used", own_design, unused_gains(&own_design)),
        Script::new("gains of the law's own design", designs(own_design)),
        // This script tests an exact threshold, so Wd must not vary.
        Script { is_varied: false, ..Script::new("Wd of a tenth of the setpoint", threshold(fixed)) },
    ];
    if identity.has_capability(capabilities::TARGET_PACED) {
        all.push(start("ticks", ticks(fixed)));
        all.push(start("ticks of a short period", short_ticks(fixed)));
    }
    for component in 0..3 {
        all.push(start("values that are not finite", not_finite(component, fixed)));
    }
    for configure in unusable(&fixed, identity, own_law) {
        all.push(start(
            "a configuration that is not accepted",
            vec![
                Sample(2.0, 0.0, 0.0),
                Sample(2.0, 1.2, -0.2),
                Setup(configure),
                Sample(2.0, 1.2, -0.2),
                Setup(fixed),
                Sample(2.0, 1.2, -0.2),
            ],
        ));
    }
    all.extend(random_scripts(base, identity, seed));
    all
}

fn repeated_samples(configure: Configure) -> Vec<Step> {
    vec![
        Sample(2.0, 0.0, 0.0),
        Repeat,
        Sample(2.0, 1.1, -0.2),
        Repeat,
        Repeat,
        // This sample has the number of the last one: a repetition, despite other values.
        Ahead(0, 2.5, 1.9, 0.4),
        Sample(2.0, 1.6, -0.3),
        Ask(Message::Safe),
        // The controller answers this repetition with 0 V and the state *safe*.
        Repeat,
        Setup(configure),
        Sample(2.0, 0.3, 0.1),
        Setup(configure),
        Repeat,
        Sample(2.0, 1.0, 0.1),
    ]
}

fn gaps() -> Vec<Step> {
    let steps = [1, 5, 1, 127, 128, 255, 2].into_iter().enumerate();
    steps.flat_map(|(step, ahead)| [Ahead(ahead, 2.0, 0.05 + 0.3 * step as f32, -0.1), Repeat]).collect()
}

fn pieces() -> Vec<Step> {
    [1, 2, 7, 12, SAMPLE_FRAME - 2, SAMPLE_FRAME - 1].map(|at| InPieces(at, 2.0, 0.05 * at as f32, -0.1)).into()
}

fn rest() -> Vec<Step> {
    vec![
        Sample(2.0, 0.0, 0.0),
        Sample(2.0, -1.2, 0.4),
        Sample(2.0, -0.5, -0.8),
        Sample(2.0, 0.9, 0.4),
        Sample(0.0, 1.5, 0.3),
        Sample(0.0, -0.4, 0.3),
        Sample(0.5, 0.045, 0.2),
        Sample(0.5, 0.06, 0.2),
        Sample(-1.0, 0.5, 0.2),
        Sample(0.02, 0.01, 0.004),
        Sample(2.0, 0.25, -3.0),
        Sample(4.0, 3.9, 0.1),
    ]
}

fn hello(configure: Configure) -> Vec<Step> {
    vec![
        Sample(2.0, 0.0, 0.0),
        Ask(Message::Hello),
        Sample(2.0, 1.2, -0.2),
        Ask(Message::Safe),
        Sample(2.0, 1.2, -0.2),
        Ask(Message::Hello),
        Ask(Message::Safe),
        Sample(2.0, f32::NAN, -0.2),
        Setup(configure),
        Ask(Message::Safe),
        Sample(2.0, 1.2, -0.2),
        Setup(configure),
        Sample(2.0, 1.2, -0.2),
    ]
}

/// Only the number of the last sample marks a repetition, not that of another message.
fn numbers(configure: Configure) -> Vec<Step> {
    vec![
        Ahead(0, 2.0, 0.0, 0.0),
        Ask(Message::Hello),
        Ahead(0, 2.0, 1.2, -0.2),
        Damaged(5),
        Ahead(0, 2.0, 1.3, -0.1),
        Send(Message::Tick(Tick { target_time_us: 5 })),
        Ahead(0, 2.0, 1.4, 0.1),
        Ask(Message::Safe),
        Ahead(0, 2.0, 1.2, -0.2),
        Setup(configure),
        Ahead(0, 2.0, 1.1, 0.2),
        Sample(2.0, 1.2, 0.1),
    ]
}

fn ignored(identity: &Identity) -> Vec<Step> {
    let command = Command {
        target_time_us: 1,
        drive_vpp: 100.0,
        frequency_mhz: 32_300_000,
        state: ControllerState::Running,
        cause: StateCause::None,
        flags: 0,
        compute_us: 0,
    };
    let mut messages = vec![
        Message::Identity(*identity),
        Message::Configured(Configured { outcome: Err(Rejection::Value) }),
        Message::Command(command),
        Message::Tick(Tick { target_time_us: 5 }),
        Message::Fault(FaultReport { code: 2, pc: 0x0800_1234, lr: 1, cfsr: 0, address: 0 }),
    ];
    if !identity.has_capability(capabilities::OWN_PLATE) {
        messages.push(Message::Setpoint(Setpoint { setpoint_um: 1.0 }));
    }
    let mut steps = vec![Sample(2.0, 0.0, 0.0)];
    for message in messages {
        // Six rejected frames would stop the controller, six ignored ones do not.
        steps.extend(vec![Send(message); 6]);
        steps.push(Sample(2.0, 1.2, -0.2));
    }
    steps.extend([Bytes(vec![0; 8]), Sample(2.0, 1.3, -0.2)]);
    steps
}

/// Each rejected frame adds 2 to the counter, each control step subtracts 1, and the controller
/// stops at 10.
fn counter(configure: Configure) -> Vec<Step> {
    // In the state *idle*, rejected frames do not count.
    let mut steps = vec![Rejected(6)];
    steps.extend(vec![Sample(2.0, 1.2, -0.2); 20]);
    steps.extend([
        Rejected(4),
        Sample(2.0, 1.3, -0.2),
        Rejected(1),
        Repeat,
        Repeat,
        Sample(2.0, 1.4, -0.2),
        // The counter is 8 − 1 + 2 − 1 = 8 before this frame.
        Rejected(1),
        Sample(2.0, 1.4, -0.2),
        Setup(configure),
        Rejected(3),
        Sample(2.0, 1.2, -0.2),
        Rejected(4),
        Sample(2.0, 1.3, -0.2),
        Rejected(1),
        Sample(2.0, 1.3, -0.2),
        Rejected(1),
        Sample(2.0, 1.3, -0.2),
        Sample(2.0, f32::NAN, -0.2),
        Ask(Message::Safe),
        Setup(configure),
        Sample(2.0, 1.2, -0.2),
        // The controller rejects this overlong frame once.
        Bytes([[7; 100].as_slice(), &[0]].concat()),
        Sample(2.0, 1.3, -0.2),
        Rejected(4),
        Sample(2.0, 1.3, -0.2),
    ]);
    steps
}

/// Starts the loop, then plays two samples after each of `steps`.
fn with_samples(steps: impl IntoIterator<Item = Step>) -> Vec<Step> {
    let followed = |step| [step, Sample(2.0, 1.2, -0.2), Sample(2.0, 1.3, -0.2)];
    [Sample(2.0, 0.0, 0.0)].into_iter().chain(steps.into_iter().flat_map(followed)).collect()
}

fn damaged() -> Vec<Step> {
    with_samples((0..SAMPLE_FRAME - 1).map(Damaged))
}

fn invalid_bodies() -> Vec<Step> {
    let zeros = [0; 16];
    let bodies = [
        [[0x25, 90].as_slice(), &zeros].concat(),
        [[0x05, 91].as_slice(), &zeros].concat(),
        [[0x15, 92].as_slice(), &zeros, &[0]].concat(),
        [[0x15, 93].as_slice(), &zeros[1..]].concat(),
        vec![0x17, 94, 0],
        vec![0x11],
        vec![0x1c, 95],
        vec![0x10, 96],
    ];
    let mut steps = with_samples(bodies.map(Body));
    steps.extend(vec![Body(vec![0x1c, 97]); 5]);
    steps.push(Sample(2.0, 1.3, -0.2));
    steps
}

fn invalid_configurations(configure: Configure) -> Vec<Step> {
    let values = [0.007, 0.0019, 0.0, 900.0, 250.0, 50.0, 200.0, 90_000.0, 700.0, 300_000.0];
    let valid = configuration_body(&configure, 1, values);
    let with = |changes: &[(usize, u8)]| {
        let changed = |(at, byte)| changes.iter().find(|(place, _)| *place == at).map_or(byte, |(_, value)| *value);
        valid.iter().copied().enumerate().map(changed).collect::<Vec<u8>>()
    };
    let (_, short) = valid.split_last().unwrap_or((&0, &[]));
    let bodies = [
        with(&[(2, 9)]),
        with(&[(2, 200)]),
        with(&[(3, 0x10)]),
        with(&[(3, 0x81)]),
        [&*valid, &[0]].concat(),
        short.to_vec(),
        [with(&[(3, 4)]), vec![0; 4]].concat(),
    ];
    with_samples(bodies.map(Body))
}

/// The waits differ much from the timeouts, because the host may stall and lengthen a wait.
fn watchdog(configure: Configure) -> Vec<Step> {
    vec![
        // A timeout of 0 means five periods, here 250 ms.
        Setup(Configure { period_us: 50_000, watchdog_timeout_ms: 0, ..configure }),
        Sample(2.0, 0.0, 0.0),
        Wait(120),
        Sample(2.0, 1.2, -0.2),
        Wait(150),
        Repeat,
        Wait(150),
        Sample(2.0, 1.3, -0.2),
        Sample(2.0, 1.3, -0.2),
        // This timeout needs more than eight bits. The watchdog does not act before the first sample.
        Setup(Configure { watchdog_timeout_ms: 300, ..configure }),
        Wait(400),
        Sample(2.0, 0.0, 0.0),
        Wait(150),
        Sample(2.0, 1.2, -0.2),
        Wait(400),
        Sample(2.0, f32::NAN, -0.2),
        Repeat,
        // The watchdog starts with the first sample. Rejected frames do not restart it.
        Setup(Configure { watchdog_timeout_ms: 200, ..configure }),
        Sample(2.0, 0.0, 0.0),
        Wait(110),
        Damaged(5),
        Wait(220),
        Sample(2.0, 1.2, -0.2),
        // This timeout needs more than 15 bits.
        Setup(Configure { watchdog_timeout_ms: 40_000, ..configure }),
        Sample(2.0, 0.0, 0.0),
        Wait(150),
        Sample(2.0, 1.2, -0.2),
    ]
}

/// A timeout that is 20 % short, or that counts periods instead of milliseconds, stops after the first
/// wait or not after the second one.
fn near_watchdog(configure: Configure) -> Vec<Step> {
    let with = |period_us, watchdog_timeout_ms, wait| {
        let configure = Configure { period_us, watchdog_timeout_ms, ..configure };
        [Setup(configure), Sample(2.0, 0.0, 0.0), Wait(wait), Sample(2.0, 1.2, -0.2)]
    };
    [with(500, 600, 510), with(4_000, 150, 300)].concat()
}

/// Each configuration follows one that differs in one figure, and then one that differs in all. The
/// same samples must give the same commands.
fn figures(base: Configure) -> Vec<Step> {
    let other = Configure {
        period_us: 2_000,
        start_frequency_mhz: 32_200_000,
        gain_um_per_vpp: 1.3 * base.gain_um_per_vpp,
        time_constant_s: 1.4 * base.time_constant_s,
        response_time_s: 0.004,
        drive_limit_vpp: 0.7 * base.drive_limit_vpp,
        frequency_range_hz: 0.5 * base.frequency_range_hz,
        frequency_slew_hz: 0.6 * base.frequency_slew_hz,
        ..base
    };
    let changed = [
        Configure { period_us: other.period_us, ..base },
        Configure { start_frequency_mhz: other.start_frequency_mhz, ..base },
        Configure { gain_um_per_vpp: other.gain_um_per_vpp, ..base },
        Configure { time_constant_s: other.time_constant_s, ..base },
        Configure { response_time_s: other.response_time_s, ..base },
        Configure { drive_limit_vpp: other.drive_limit_vpp, ..base },
        Configure { frequency_range_hz: other.frequency_range_hz, ..base },
        Configure { frequency_slew_hz: other.frequency_slew_hz, ..base },
        Configure { gains: Some(CONFIGURED_GAINS), ..base },
    ];
    let play = |configure| {
        let samples = [Sample(2.0, 1.7, 1.2), Sample(2.0, 1.9, -0.9), Sample(2.0, 1.97, 0.02), Sample(0.5, 0.45, 0.0)];
        [Setup(configure)].into_iter().chain(samples)
    };
    changed.into_iter().flat_map(|changed| [base, changed, other, changed]).flat_map(play).collect()
}

/// Tests a watchdog timeout of five periods of 300 µs, which is not a whole number of milliseconds.
fn short_watchdog(configure: Configure) -> Vec<Step> {
    let configure = Configure { period_us: 300, watchdog_timeout_ms: 0, ..configure };
    let with_wait = |us| [Setup(configure), Sample(2.0, 0.0, 0.0), WaitUs(us), Sample(2.0, 1.2, -0.2)];
    [with_wait(1_200), with_wait(1_800)].concat()
}

fn ticks(configure: Configure) -> Vec<Step> {
    let paced = Configure { paced_by_target: true, period_us: 50_000, ..configure };
    vec![
        Setup(paced),
        Silence(225),
        Sample(2.0, 0.0, 0.0),
        Silence(120),
        Sample(2.0, 1.2, -0.2),
        Ask(Message::Safe),
        Silence(150),
        Setup(paced),
        Silence(125),
        Setup(configure),
        Silence(150),
        // Without samples, ticks end one second after the configuration.
        Setup(paced),
        Silence(1_175),
        Sample(2.0, 0.0, 0.0),
    ]
}

/// Plays 300 ticks, so that their numbers wrap and delays of some microseconds add up to a large
/// part of a period.
fn short_ticks(configure: Configure) -> Vec<Step> {
    let paced = Configure { paced_by_target: true, period_us: 3_000, ..configure };
    vec![Setup(paced), Silence(900), Setup(configure)]
}

/// After the first sample, Wd is equal to the setpoint and the drive is constant. No variation is
/// needed, because nothing depends on rounding.
fn many_samples(configure: Configure) -> Script {
    let steps =
        [Setup(configure), Sample(2.0, 1.9, 0.05), Sample(2.0, 2.0, 0.0), Again { steps: 1, times: (1 << 16) - 1 }];
    Script { is_varied: false, ..Script::new("more samples than sixteen bits count", steps) }
}

fn drive_limit(scale: f32) -> Vec<Step> {
    [0.0, 1.0, 3.0, 1.9, 1.99, 1.0].map(|wd| Sample(2.0 * scale, wd * scale, -0.1 * scale)).into()
}

/// If bit 0 of the configuration's flags is not set, the controller must ignore the gains.
fn unused_gains(configure: &Configure) -> Vec<Step> {
    let Configure { gain_um_per_vpp, time_constant_s, drive_limit_vpp, .. } = *configure;
    let body = |gain| {
        let values = [gain_um_per_vpp, time_constant_s, 0.0, drive_limit_vpp, 250.0, 50.0, gain, gain, gain, gain];
        configuration_body(configure, 0, values)
    };
    let gains = [f32::NAN, f32::INFINITY, -7e5].into_iter();
    gains.flat_map(|gain| [AskBody(body(gain)), Sample(2.0, 0.0, 0.0), Sample(2.0, 1.2, -0.2)]).collect()
}

fn designs(configure: Configure) -> Vec<Step> {
    let mut steps = Vec::new();
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
        steps.push(Setup(Configure { period_us, response_time_s, time_constant_s, ..configure }));
        let components = [(0.0, 0.0), (0.15, 0.05), (0.9, -0.3), (1.6, -0.2), (1.95, 0.1)];
        steps.extend(components.map(|(wd, wq)| Sample(2.0, wd, wq)));
    }
    steps
}

/// The control loop rests if Wd is at most a tenth of the setpoint.
fn threshold(configure: Configure) -> [Step; 4] {
    [Setup(configure), Sample(2.5, 0.25, 0.1), Sample(2.5, 0.26, 0.1), Sample(0.0, 0.25, 0.1)]
}

fn not_finite(component: usize, configure: Configure) -> Vec<Step> {
    let with = |value: f32, setpoint: f32| match component {
        0 if setpoint > 0.0 => Sample(value, 1.2, -0.2),
        1 => Sample(setpoint, value, -0.2),
        2 => Sample(setpoint, 1.2, value),
        _ => Sample(setpoint, 1.2, -0.2),
    };
    let mut steps = Vec::new();
    for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        steps.extend([
            Sample(2.0, 0.0, 0.0),
            Sample(2.0, 1.2, -0.4),
            with(value, 2.0),
            // A stopped controller keeps the cause of its stop and sends no second report.
            Rejected(6),
            Sample(2.0, 1.2, -0.2),
            Repeat,
            Ask(Message::Safe),
            with(value, 2.0),
            Setup(configure),
        ]);
    }
    // A NaN in Wd or Wq stops the controller even at a setpoint of zero.
    steps.extend([Sample(0.0, 1.0, 0.0), with(f32::NAN, 0.0)]);
    steps
}

fn unusable(base: &Configure, identity: &Identity, own_law: bool) -> Vec<Configure> {
    let gains =
        base.gains.unwrap_or(Gains { amplitude_kp: 1.0, amplitude_ki: 1.0, frequency_kp: 1.0, frequency_ki: 1.0 });
    let mut all = vec![
        Configure { period_us: 0, ..*base },
        Configure { start_frequency_mhz: 0, ..*base },
        Configure { response_time_s: -0.001, ..*base },
        Configure { response_time_s: f32::INFINITY, ..*base },
        Configure { response_time_s: f32::NAN, ..*base },
    ];
    // An own law may use configured gains or ignore them.
    if !own_law {
        all.extend([
            Configure { gains: Some(Gains { amplitude_kp: f32::NAN, ..gains }), ..*base },
            Configure { gains: Some(Gains { amplitude_ki: f32::NAN, ..gains }), ..*base },
            Configure { gains: Some(Gains { frequency_kp: f32::NAN, ..gains }), ..*base },
            Configure { gains: Some(Gains { frequency_ki: f32::NAN, ..gains }), ..*base },
            Configure { gains: Some(Gains { frequency_ki: f32::INFINITY, ..gains }), ..*base },
        ]);
    }
    // One unit beyond the border between two fields.
    if identity.has_capability(capabilities::LOOP_DELAY) {
        all.push(Configure { loop_delay_us: base.period_us + 1, ..*base });
    }
    if !identity.has_capability(capabilities::OWN_PLATE) {
        all.push(Configure { drives_own_plate: true, ..*base });
    }
    for value in [0.0, -1.0, f32::NAN, f32::INFINITY] {
        all.extend([
            Configure { gain_um_per_vpp: value, ..*base },
            Configure { time_constant_s: value, ..*base },
            Configure { drive_limit_vpp: value, ..*base },
            Configure { frequency_range_hz: value, ..*base },
            Configure { frequency_slew_hz: value, ..*base },
        ]);
    }
    all
}

/// Returns a configuration with the number 80. `values` are the floats from byte 14 on.
fn configuration_body(configure: &Configure, bits: u8, values: [f32; 10]) -> Vec<u8> {
    let mut body = vec![0x13, 80, configure.law as u8, bits];
    body.extend_from_slice(&configure.watchdog_timeout_ms.to_le_bytes());
    for number in [configure.period_us, configure.start_frequency_mhz] {
        body.extend_from_slice(&number.to_le_bytes());
    }
    for value in values {
        body.extend_from_slice(&value.to_le_bytes());
    }
    body
}

/// Returns pairs of scripts, each with its own random configuration. The first of a pair has
/// configured gains, the second the law's own design.
fn random_scripts(base: &Configure, identity: &Identity, seed: u64) -> Vec<Script> {
    let mut all = Vec::new();
    for number in 0..RANDOM_SCRIPTS {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        random.set_stream(number);
        // Only the second script may have a loop delay. With a delay, the law predicts the plate
        // with K1, which no variation changes if the gains are configured.
        let has_delay = number % 4 == 3 && identity.has_capability(capabilities::LOOP_DELAY);
        let mut script = |name, law, has_gains, has_delay| {
            let configure = random_configuration(&mut random, base, has_gains, has_delay);
            let setup = Setup(Configure { law, ..configure });
            Script::new(name, [setup].into_iter().chain(random_samples(&mut random)))
        };
        all.push(script("random samples with configured gains", base.law, true, false));
        let law = match number % 8 {
            1 if identity.has_law(LawId::DqPiFixed) => LawId::DqPiFixed,
            5 if identity.has_law(LawId::DqPiEuler) => LawId::DqPiEuler,
            _ => base.law,
        };
        all.push(script("random samples with the law's own design", law, false, has_delay));
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

/// Returns samples whose setpoint lasts five samples on average. Wd follows the setpoint and Wq goes
/// to zero, both with random jumps. Wd is sometimes negative.
fn random_samples(random: &mut ChaCha8Rng) -> Vec<Step> {
    let (mut setpoint, mut wd, mut wq) = (1.0, 0.0, 0.0);
    let step = |_| {
        if random.next_u32().is_multiple_of(5) {
            setpoint = if random.next_u32().is_multiple_of(5) { 0.0 } else { uniform(random, 0.1, 4.0) };
        }
        let share = uniform(random, 0.1, 0.9);
        wd += (setpoint - wd) * share + uniform(random, -0.2, 0.2) * setpoint;
        wq += uniform(random, -0.3, 0.3) * setpoint - 0.3 * wq;
        if random.next_u32().is_multiple_of(17) {
            wd = -wd;
        }
        Sample(setpoint, wd, wq)
    };
    (0..RANDOM_SAMPLES).map(step).collect()
}
