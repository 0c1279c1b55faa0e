//! Builds scripts of messages that no closed loop with a plate sends.

use super::builder::{Builder, Script, Variation, configuration_body, script};
use super::{limits, random, timing};
use platebench_wire::{
    Command, Configure, Configured, ControllerState, FaultReport, Gains, Identity, Message, Rejection, Setpoint,
    StateCause, Tick, capabilities,
};

pub(super) const CONFIGURED_GAINS: Gains =
    Gains { amplitude_kp: 275.0, amplitude_ki: 110_000.0, frequency_kp: 900.0, frequency_ki: 400_000.0 };
/// Length of a sample's frame, bytes.
const SAMPLE_FRAME: usize = 24;

pub(super) fn scripts(base: &Configure, identity: &Identity, variation: Variation, seed: u64) -> Vec<Script> {
    let fixed = Configure { gains: Some(CONFIGURED_GAINS), start_frequency_mhz: 32_307_654, ..*base };
    let start = |name, write: &dyn Fn(&mut Builder)| {
        script(name, variation, |builder| {
            builder.configure(fixed);
            write(builder);
        })
    };
    let mut all = vec![
        start("a repeated sample", &|builder| repeated_samples(builder, fixed)),
        start("numbers of samples with gaps", &gaps),
        start("samples at rest and negative components", &rest),
        start("hello and 0 V while running", &|builder| hello(builder, fixed)),
        start("samples with the number of another message", &|builder| numbers(builder, fixed)),
        start("messages that only a controller sends", &|builder| ignored(builder, identity)),
        start("the counter of rejected frames", &|builder| counter(builder, fixed)),
        start("one damaged bit in every byte of a frame", &damaged),
        start("invalid messages with a valid CRC", &invalid_bodies),
        start("the watchdog with its own timeout", &|builder| timing::watchdog(builder, fixed)),
        start("a watchdog of five short periods", &|builder| timing::short_watchdog(builder, fixed)),
        start("more samples than sixteen bits count", &timing::many_samples),
        start("frames in two pieces", &pieces),
        start("configurations that are rejected as messages", &|builder| invalid_configurations(builder, fixed)),
    ];
    all.extend(limits::scripts(&fixed, variation));
    if identity.has_capability(capabilities::TARGET_PACED) {
        all.push(start("ticks", &|builder| timing::ticks(builder, fixed)));
        all.push(start("ticks of a short period", &|builder| timing::short_ticks(builder, fixed)));
    }
    for component in 0..3 {
        all.push(start("values that are not finite", &|builder| not_finite(builder, component, fixed)));
    }
    for configure in unusable(&fixed, identity) {
        all.push(start("a configuration that is not accepted", &|builder| {
            builder.sample(2.0, 0.0, 0.0);
            builder.sample(2.0, 1.2, -0.2);
            builder.configure(configure);
            builder.sample(2.0, 1.2, -0.2);
            builder.configure(fixed);
            builder.sample(2.0, 1.2, -0.2);
        }));
    }
    all.extend(random::scripts(base, identity, variation, seed));
    all
}

fn repeated_samples(builder: &mut Builder, configure: Configure) {
    builder.sample(2.0, 0.0, 0.0);
    builder.repeat_sample();
    builder.sample(2.0, 1.1, -0.2);
    builder.repeat_sample();
    builder.repeat_sample();
    // This sample has the number of the last one: a repetition, despite other values.
    builder.sample_after(0, 2.5, 1.9, 0.4);
    builder.sample(2.0, 1.6, -0.3);
    builder.ask(Message::Safe);
    // The controller answers this repetition with 0 V and the state *safe*.
    builder.repeat_sample();
    builder.configure(configure);
    builder.sample(2.0, 0.3, 0.1);
    builder.configure(configure);
    builder.repeat_sample();
    builder.sample(2.0, 1.0, 0.1);
}

fn gaps(builder: &mut Builder) {
    for (step, ahead) in [1, 5, 1, 127, 128, 255, 2].into_iter().enumerate() {
        builder.sample_after(ahead, 2.0, 0.05 + 0.3 * step as f32, -0.1);
        builder.repeat_sample();
    }
}

fn pieces(builder: &mut Builder) {
    for at in [1, 2, 7, 12, SAMPLE_FRAME - 2, SAMPLE_FRAME - 1] {
        builder.sample_in_pieces(at, 2.0, 0.05 * at as f32, -0.1);
    }
}

fn rest(builder: &mut Builder) {
    for (setpoint, wd, wq) in [
        (2.0, 0.0, 0.0),
        (2.0, -1.2, 0.4),
        (2.0, -0.5, -0.8),
        (2.0, 0.9, 0.4),
        (0.0, 1.5, 0.3),
        (0.0, -0.4, 0.3),
        (0.5, 0.045, 0.2),
        (0.5, 0.06, 0.2),
        (-1.0, 0.5, 0.2),
        (0.02, 0.01, 0.004),
        (2.0, 0.25, -3.0),
        (4.0, 3.9, 0.1),
    ] {
        builder.sample(setpoint, wd, wq);
    }
}

fn hello(builder: &mut Builder, configure: Configure) {
    builder.sample(2.0, 0.0, 0.0);
    builder.ask(Message::Hello);
    builder.sample(2.0, 1.2, -0.2);
    builder.ask(Message::Safe);
    builder.sample(2.0, 1.2, -0.2);
    builder.ask(Message::Hello);
    builder.ask(Message::Safe);
    builder.sample(2.0, f32::NAN, -0.2);
    builder.configure(configure);
    builder.ask(Message::Safe);
    builder.sample(2.0, 1.2, -0.2);
    builder.configure(configure);
    builder.sample(2.0, 1.2, -0.2);
}

/// Only the number of the last sample marks a repetition, not that of another message.
fn numbers(builder: &mut Builder, configure: Configure) {
    builder.sample_after(0, 2.0, 0.0, 0.0);
    builder.ask(Message::Hello);
    builder.sample_after(0, 2.0, 1.2, -0.2);
    builder.add_damaged(5);
    builder.sample_after(0, 2.0, 1.3, -0.1);
    builder.add_message(Message::Tick(Tick { target_time_us: 5 }));
    builder.sample_after(0, 2.0, 1.4, 0.1);
    builder.ask(Message::Safe);
    builder.sample_after(0, 2.0, 1.2, -0.2);
    builder.configure(configure);
    builder.sample_after(0, 2.0, 1.1, 0.2);
    builder.sample(2.0, 1.2, 0.1);
}

fn ignored(builder: &mut Builder, identity: &Identity) {
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
    builder.sample(2.0, 0.0, 0.0);
    for message in messages {
        // Six rejected frames would stop the controller, six ignored ones do not.
        for _ in 0..6 {
            builder.add_message(message);
        }
        builder.sample(2.0, 1.2, -0.2);
    }
    builder.add(&[0; 8]);
    builder.sample(2.0, 1.3, -0.2);
}

/// Each rejected frame adds 2 to the counter, each control step subtracts 1, and the controller
/// stops at 10.
fn counter(builder: &mut Builder, configure: Configure) {
    // In the state *idle*, rejected frames do not count.
    builder.add_rejected(6);
    for _ in 0..20 {
        builder.sample(2.0, 1.2, -0.2);
    }
    builder.add_rejected(4);
    builder.sample(2.0, 1.3, -0.2);
    builder.add_rejected(1);
    builder.repeat_sample();
    builder.repeat_sample();
    builder.sample(2.0, 1.4, -0.2);
    // The counter is 8 − 1 + 2 − 1 = 8 before this frame.
    builder.add_rejected(1);
    builder.sample(2.0, 1.4, -0.2);
    builder.configure(configure);
    builder.add_rejected(3);
    builder.sample(2.0, 1.2, -0.2);
    builder.add_rejected(4);
    builder.sample(2.0, 1.3, -0.2);
    builder.add_rejected(1);
    builder.sample(2.0, 1.3, -0.2);
    builder.add_rejected(1);
    builder.sample(2.0, 1.3, -0.2);
    builder.sample(2.0, f32::NAN, -0.2);
    builder.ask(Message::Safe);
    builder.configure(configure);
    builder.sample(2.0, 1.2, -0.2);
    // The controller rejects this overlong frame once.
    builder.add(&[[7; 100].as_slice(), &[0]].concat());
    builder.sample(2.0, 1.3, -0.2);
    builder.add_rejected(4);
    builder.sample(2.0, 1.3, -0.2);
}

fn damaged(builder: &mut Builder) {
    builder.sample(2.0, 0.0, 0.0);
    for position in 0..SAMPLE_FRAME - 1 {
        builder.add_damaged(position);
        builder.sample(2.0, 1.2, -0.2);
        builder.sample(2.0, 1.3, -0.2);
    }
}

fn invalid_bodies(builder: &mut Builder) {
    let zeros = [0; 16];
    builder.sample(2.0, 0.0, 0.0);
    for body in [
        [[0x25, 90].as_slice(), &zeros].concat(),
        [[0x05, 91].as_slice(), &zeros].concat(),
        [[0x15, 92].as_slice(), &zeros, &[0]].concat(),
        [[0x15, 93].as_slice(), &zeros[1..]].concat(),
        vec![0x17, 94, 0],
        vec![0x11],
        vec![0x1c, 95],
        vec![0x10, 96],
    ] {
        builder.add_body(&body);
        builder.sample(2.0, 1.2, -0.2);
        builder.sample(2.0, 1.3, -0.2);
    }
    for _ in 0..5 {
        builder.add_body(&[0x1c, 97]);
    }
    builder.sample(2.0, 1.3, -0.2);
}

fn invalid_configurations(builder: &mut Builder, configure: Configure) {
    let body = |change: &dyn Fn(&mut Vec<u8>)| {
        let values = [0.007, 0.0019, 0.0, 900.0, 250.0, 50.0, 200.0, 90_000.0, 700.0, 300_000.0];
        let mut body = configuration_body(&configure, 1, values);
        change(&mut body);
        body
    };
    let set = |at: usize, value: u8| {
        move |bytes: &mut Vec<u8>| {
            if let Some(byte) = bytes.get_mut(at) {
                *byte = value;
            }
        }
    };
    let bodies = [
        body(&set(2, 9)),
        body(&set(2, 200)),
        body(&set(3, 0x10)),
        body(&set(3, 0x81)),
        body(&|bytes| bytes.push(0)),
        body(&|bytes| {
            bytes.pop();
        }),
        body(&|bytes| {
            set(3, 4)(bytes);
            bytes.extend_from_slice(&[0; 4]);
        }),
    ];
    builder.sample(2.0, 0.0, 0.0);
    for body in bodies {
        builder.add_body(&body);
        builder.sample(2.0, 1.2, -0.2);
        builder.sample(2.0, 1.3, -0.2);
    }
}

fn not_finite(builder: &mut Builder, component: usize, configure: Configure) {
    let with = |value: f32| {
        let mut values = [2.0, 1.2, -0.2];
        if let Some(place) = values.get_mut(component) {
            *place = value;
        }
        values
    };
    for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        builder.sample(2.0, 0.0, 0.0);
        builder.sample(2.0, 1.2, -0.4);
        let [setpoint, wd, wq] = with(value);
        builder.sample(setpoint, wd, wq);
        // A stopped controller keeps the cause of its stop and sends no second report.
        builder.add_rejected(6);
        builder.sample(2.0, 1.2, -0.2);
        builder.repeat_sample();
        builder.ask(Message::Safe);
        builder.sample(setpoint, wd, wq);
        builder.configure(configure);
    }
    // A NaN in Wd or Wq stops the controller even at a setpoint of zero.
    builder.sample(0.0, 1.0, 0.0);
    let [_, wd, wq] = with(f32::NAN);
    builder.sample(0.0, wd, wq);
}

fn unusable(base: &Configure, identity: &Identity) -> Vec<Configure> {
    let gains =
        base.gains.unwrap_or(Gains { amplitude_kp: 1.0, amplitude_ki: 1.0, frequency_kp: 1.0, frequency_ki: 1.0 });
    let mut all = vec![
        Configure { period_us: 0, ..*base },
        Configure { start_frequency_mhz: 0, ..*base },
        Configure { response_time_s: -0.001, ..*base },
        Configure { response_time_s: f32::INFINITY, ..*base },
        Configure { gains: Some(Gains { amplitude_kp: f32::NAN, ..gains }), ..*base },
        Configure { gains: Some(Gains { frequency_ki: f32::INFINITY, ..gains }), ..*base },
    ];
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
