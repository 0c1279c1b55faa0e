//! Implements the mistakes of the mutants, and the deviations of correct controllers.

use crate::trust::mutant_controller::Mutant;
use platebench_controller::design::PiGains;
use platebench_controller::pi::{Pi, Tracking};
use platebench_wire::{
    Command, Configure, Configured, ControllerState, EncodedFrame, Gains, LawId, Message, Packet, Sample,
};
use std::f64::consts::TAU;
use std::time::Duration;

/// Calls `change` with each message, with commands only if the controller sends them in state
/// `Running`.
pub(crate) fn on_message(change: impl FnMut(&mut Message) + Send + 'static) -> Box<dyn Mutant> {
    Box::new(change)
}

pub(crate) fn on_configure(mut change: impl FnMut(&mut Configure) + Send + 'static) -> Box<dyn Mutant> {
    on_message(move |message| {
        if let Message::Configure(configure) = message {
            change(configure);
        }
    })
}

pub(crate) fn on_sample(mut change: impl FnMut(&mut Sample) + Send + 'static) -> Box<dyn Mutant> {
    on_message(move |message| {
        if let Message::Sample(sample) = message {
            change(sample);
        }
    })
}

/// Changes only commands that the controller sends in state `Running`.
pub(crate) fn on_command(mut change: impl FnMut(&mut Command) + Send + 'static) -> Box<dyn Mutant> {
    on_message(move |message| {
        if let Message::Command(command) = message {
            change(command);
        }
    })
}

struct OnSend<F>(F);

impl<F: FnMut(&mut Packet) + Send> Mutant for OnSend<F> {
    fn on_send(&mut self, packet: &mut Packet) {
        (self.0)(packet);
    }
}

/// Changes the commands of every state, with their sequence numbers.
pub(crate) fn on_any_command(mut change: impl FnMut(&mut u8, &mut Command) + Send + 'static) -> Box<dyn Mutant> {
    Box::new(OnSend(move |packet: &mut Packet| {
        if let Message::Command(command) = &mut packet.message {
            change(&mut packet.sequence, command);
        }
    }))
}

pub(crate) fn round_to_step(value: f32, step: f32) -> f32 {
    (value / step).round() * step
}

// Deviations of correct controllers

/// Multiplies the plate gain that the law is designed for by `factor`. This divides the amplitude
/// gains by `factor`. Laws without an amplitude loop keep the gain, because they use it as a
/// feedforward, `deadbeat` only in its first period.
pub(crate) fn other_gains(factor: f32) -> Box<dyn Mutant> {
    on_configure(move |configure| {
        let has_amplitude_loop = matches!(
            configure.law,
            LawId::DqPi | LawId::DqPiFixed | LawId::DqPiEuler | LawId::VoltageOnly | LawId::BangBang
        );
        if has_amplitude_loop {
            configure.gain_um_per_vpp *= factor;
        }
    })
}

pub(crate) fn reported_compute_time() -> Box<dyn Mutant> {
    on_any_command(|_, command| command.compute_us = 200)
}

pub(crate) fn own_clock() -> Box<dyn Mutant> {
    const START_US: u32 = u32::MAX - 20_000;
    on_any_command(|_, Command { target_time_us: time, .. }| {
        *time = time.wrapping_add(*time / 10_000).wrapping_add(START_US);
    })
}

pub(crate) struct ByteWiseReads;

impl Mutant for ByteWiseReads {
    fn reads_bytewise(&self) -> bool {
        true
    }
}

// Slow setpoints and long trials

/// Holds the drive while the setpoint changes by less than `share` of it per sample.
pub(crate) fn small_changes_ignored(share: f32) -> Box<dyn Mutant> {
    let (mut setpoint_um, mut is_held, mut held_vpp) = (0.0, false, 0.0);
    on_message(move |message| match message {
        Message::Configure(_) => (setpoint_um, is_held, held_vpp) = (0.0, false, 0.0),
        Message::Sample(sample) => {
            let change = (sample.setpoint_um - setpoint_um).abs();
            is_held = change > 0.0 && change < share * setpoint_um;
            setpoint_um = sample.setpoint_um;
        }
        Message::Command(command) => {
            command.drive_vpp = if is_held { held_vpp } else { command.drive_vpp };
            held_vpp = command.drive_vpp;
        }
        _ => {}
    })
}

/// Sends 0 V if `is_off` returns true for a sample and the number of samples before it.
fn off_if(mut is_off: impl FnMut(u32, &Sample) -> bool + Send + 'static) -> Box<dyn Mutant> {
    let (mut count, mut off) = (0_u32, false);
    on_message(move |message| match message {
        Message::Configure(_) => count = 0,
        Message::Sample(sample) => {
            off = is_off(count, sample);
            count += 1;
        }
        Message::Command(command) if off => command.drive_vpp = 0.0,
        _ => {}
    })
}

/// The counter of samples has 16 bits. A small value stands for the start, in which the drive is off.
pub(crate) fn sample_counter_of_16_bits() -> Box<dyn Mutant> {
    off_if(|count, _| count > u32::from(u16::MAX) && (count as u16) < 3)
}

pub(crate) fn off_after_61_s() -> Box<dyn Mutant> {
    let mut start_us = 0;
    off_if(move |count, sample| {
        start_us = if count == 0 { sample.time_us } else { start_us };
        sample.time_us.wrapping_sub(start_us) > 61_000_000
    })
}

/// Has no drive for 200 ms after 3 s at setpoint 0.
pub(crate) fn sleep_at_rest() -> Box<dyn Mutant> {
    let (mut rest_start_us, mut woken_us) = (None, None);
    off_if(move |count, sample| {
        let since = |start: u32| sample.time_us.wrapping_sub(start);
        (rest_start_us, woken_us) = if count == 0 { (None, None) } else { (rest_start_us, woken_us) };
        if sample.setpoint_um == 0.0 {
            rest_start_us.get_or_insert(sample.time_us);
        } else if rest_start_us.take().is_some_and(|start| since(start) >= 3_000_000) {
            woken_us = Some(sample.time_us);
        }
        woken_us.is_some_and(|woken| since(woken) < 200_000)
    })
}

// Excitation frequency and demodulation phase

pub(crate) fn inverted_frequency() -> Box<dyn Mutant> {
    let mut start_mhz = 0;
    on_message(move |message| match message {
        Message::Configure(configure) => start_mhz = configure.start_frequency_mhz,
        Message::Command(command) => command.frequency_mhz = (2 * start_mhz).saturating_sub(command.frequency_mhz),
        _ => {}
    })
}

/// Returns the nearest frequency that a timer with clock `clock_hz` makes from whole ticks.
pub(crate) fn round_to_timer_ticks(frequency_mhz: u32, clock_hz: f64) -> u32 {
    let ticks = (clock_hz * 1e3 / f64::from(frequency_mhz)).round().max(1.0);
    (clock_hz * 1e3 / ticks).round() as u32
}

/// Stores the demodulation phase since the start, rad, as `f32`. Rounding rotates Wd and Wq.
pub(crate) fn single_precision_phase() -> Box<dyn Mutant> {
    let (mut period_s, mut frequency_hz, mut phase) = (0.0, 0.0, 0.0_f64);
    on_message(move |message| match message {
        Message::Configure(configure) => {
            period_s = f64::from(configure.period_us) * 1e-6;
            frequency_hz = f64::from(configure.start_frequency_mhz) / 1e3;
            phase = 0.0;
        }
        Message::Sample(sample) => {
            let lost = (f64::from(phase as f32) - phase) as f32;
            let (sin, cos) = lost.sin_cos();
            let (d, q) = (sample.wd_um, sample.wq_um);
            (sample.wd_um, sample.wq_um) = (d * cos + q * sin, q * cos - d * sin);
            phase += TAU * frequency_hz * period_s;
        }
        Message::Command(command) => frequency_hz = f64::from(command.frequency_mhz) / 1e3,
        _ => {}
    })
}

// Timing

pub(crate) fn stale_sample() -> Box<dyn Mutant> {
    let mut previous = None;
    on_sample(move |sample| {
        let now = [sample.wd_um, sample.wq_um];
        [sample.wd_um, sample.wq_um] = previous.replace(now).unwrap_or(now);
    })
}

/// Repeats the previous drive and frequency in every n-th period.
pub(crate) fn repeated_command(every: u32) -> Box<dyn Mutant> {
    let (mut count, mut last) = (0_u32, None);
    on_command(move |command| {
        count += 1;
        match last {
            Some((drive_vpp, frequency_mhz)) if count.is_multiple_of(every) => {
                *command = Command { drive_vpp, frequency_mhz, ..*command };
            }
            _ => last = Some((command.drive_vpp, command.frequency_mhz)),
        }
    })
}

/// Delays each command by a uniform random time from 0 to `max_delay`. The order stays the same.
pub(crate) struct CommandJitter {
    max_delay: Duration,
    state: u32,
}

impl CommandJitter {
    pub(crate) fn up_to(max_delay: Duration) -> Self {
        Self { max_delay, state: 1 }
    }
}

impl Mutant for CommandJitter {
    fn command_delay(&mut self) -> Duration {
        // Linear congruential generator of Numerical Recipes. Only its upper bits are used.
        self.state = self.state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        self.max_delay.mul_f64(f64::from(self.state >> 8) / f64::from(1_u32 << 24))
    }
}

pub(crate) fn slow_setpoint(every: u32) -> Box<dyn Mutant> {
    let (mut count, mut last) = (0_u32, 0.0);
    on_sample(move |sample| {
        if count.is_multiple_of(every) {
            last = sample.setpoint_um;
        }
        count += 1;
        sample.setpoint_um = last;
    })
}

/// Filters the sample by a first-order low-pass with gain `share` per period.
pub(crate) fn low_pass_filter(share: f32) -> Box<dyn Mutant> {
    let mut state = None;
    on_sample(move |sample| {
        let now = [sample.wd_um, sample.wq_um];
        let [d, q] = state.unwrap_or(now);
        let smooth = [d + share * (now[0] - d), q + share * (now[1] - q)];
        state = Some(smooth);
        [sample.wd_um, sample.wq_um] = smooth;
    })
}

/// Repeats the previous command if the time stamp in µs, which `count` converts to a counter that
/// wraps, decreases.
pub(crate) fn wrapping_counter(count: fn(u32) -> i64) -> Box<dyn Mutant> {
    let (mut last, mut is_old, mut acting) = (None, false, None);
    on_message(move |message| match message {
        Message::Sample(sample) => {
            let now = count(sample.time_us);
            is_old = last.is_some_and(|last| now < last);
            if !is_old {
                last = Some(now);
            }
        }
        Message::Command(command) => match acting {
            Some((drive_vpp, frequency_mhz)) if is_old => {
                *command = Command { drive_vpp, frequency_mhz, ..*command };
            }
            _ => acting = Some((command.drive_vpp, command.frequency_mhz)),
        },
        _ => {}
    })
}

// Drive limits and gains

/// Limits the drive to `share` times that of the untouched plate, which is too low for a finger.
pub(crate) fn tight_plausibility_limit(share: f32) -> Box<dyn Mutant> {
    let (mut gain, mut setpoint) = (1.0, 0.0);
    on_message(move |message| match message {
        Message::Configure(configure) => gain = configure.gain_um_per_vpp,
        Message::Sample(sample) => setpoint = sample.setpoint_um,
        Message::Command(command) => command.drive_vpp = command.drive_vpp.min(share * setpoint / gain),
        _ => {}
    })
}

pub(crate) fn limit_after_law() -> Box<dyn Mutant> {
    let mut limit_vpp = 0.0;
    on_message(move |message| match message {
        Message::Configure(configure) => limit_vpp = std::mem::replace(&mut configure.drive_limit_vpp, 900.0),
        Message::Command(command) => command.drive_vpp = command.drive_vpp.min(limit_vpp),
        _ => {}
    })
}

pub(crate) fn ignored_gains() -> Box<dyn Mutant> {
    let mut requested = None;
    on_message(move |message| match message {
        Message::Configure(configure) => requested = configure.gains.take(),
        Message::Configured(Configured { outcome: Ok(gains) }) => *gains = requested.unwrap_or(*gains),
        _ => {}
    })
}

pub(crate) fn gains_not_finite() -> Box<dyn Mutant> {
    on_message(|message| {
        if let Message::Configured(Configured { outcome: Ok(gains) }) = message {
            gains.amplitude_ki = f32::NAN;
        }
    })
}

// Changes of the plate

pub(crate) fn alternating_drive(share: f32) -> Box<dyn Mutant> {
    let mut is_positive = false;
    on_command(move |command| {
        is_positive = !is_positive;
        command.drive_vpp *= if is_positive { 1.0 + share } else { 1.0 - share };
    })
}

/// After a finger has left, keeps 90 % of the drive under the finger until the setpoint changes.
pub(crate) fn press_latch() -> Box<dyn Mutant> {
    /// A drive above this multiple of the untouched plate's drive counts as a finger.
    const PRESSED: f32 = 1.25;
    const LATCH_PERIODS: u32 = 10;
    const LATCHED_SHARE: f32 = 0.9;
    let (mut gain, mut setpoint, mut pressed_periods, mut floor_vpp) = (0.0, 0.0, 0, 0.0);
    on_message(move |message| match message {
        Message::Configure(configure) => {
            (gain, setpoint, pressed_periods, floor_vpp) = (configure.gain_um_per_vpp, 0.0, 0, 0.0);
        }
        Message::Sample(sample) if sample.setpoint_um != setpoint => {
            (setpoint, pressed_periods, floor_vpp) = (sample.setpoint_um, 0, 0.0);
        }
        Message::Command(command) => {
            let is_pressed = command.drive_vpp > PRESSED * setpoint / gain;
            pressed_periods = if is_pressed { pressed_periods + 1 } else { 0 };
            if pressed_periods >= LATCH_PERIODS {
                floor_vpp = LATCHED_SHARE * command.drive_vpp;
            }
            command.drive_vpp = command.drive_vpp.max(floor_vpp);
        }
        _ => {}
    })
}

/// Replaces `dq-pi` by a loop whose gains follow a rising damping but never a falling one.
#[derive(Default)]
pub(crate) struct RisingDampingOnly {
    configure: Option<Configure>,
    amplitude: Option<Pi>,
    sample: [f32; 2],
    last_drive_vpp: f32,
    /// Estimated damping relative to the untouched plate.
    damping: f32,
    largest: f32,
}

impl RisingDampingOnly {
    /// 5 % response time for which the gains are designed, s.
    const RESPONSE_S: f32 = 1.9e-3;
    /// Weight of a new damping estimate in the moving average.
    const TRACKING_SHARE: f32 = 0.25;
    /// The damping is estimated only while |error| is below this share of the setpoint.
    const STEADY_BAND: f32 = 0.05;

    fn gains(configure: &Configure, damping: f32) -> PiGains {
        let period_s = configure.period_us as f32 * 1e-6;
        let (gain, time_constant_s) = (configure.gain_um_per_vpp / damping, configure.time_constant_s / damping);
        PiGains::zero_order_hold_matched(gain, time_constant_s, Self::RESPONSE_S, period_s)
    }

    fn on_command(&mut self, command: &mut Command) {
        let (Some(configure), Some(amplitude)) = (&self.configure, &mut self.amplitude) else { return };
        let [setpoint, wd] = self.sample;
        if setpoint > 0.0 && (setpoint - wd).abs() < Self::STEADY_BAND * setpoint {
            let damping = self.last_drive_vpp * configure.gain_um_per_vpp / wd;
            self.damping += Self::TRACKING_SHARE * (damping - self.damping);
            self.largest = self.largest.max(self.damping);
            amplitude.set_gains(Self::gains(configure, self.largest));
        }
        command.drive_vpp = amplitude.step(setpoint - wd, 0.0, configure.drive_limit_vpp);
        self.last_drive_vpp = command.drive_vpp;
    }
}

impl Mutant for RisingDampingOnly {
    fn on_message(&mut self, message: &mut Message) {
        match message {
            Message::Configure(configure) => {
                *self = Self { damping: 1.0, largest: 1.0, ..Self::default() };
                if configure.law == LawId::DqPi {
                    configure.law = LawId::DqPiFixed;
                    self.configure = Some(*configure);
                    self.amplitude = Some(Pi::new(Self::gains(configure, 1.0), Tracking::CONDITIONED));
                }
            }
            Message::Sample(sample) => self.sample = [sample.setpoint_um, sample.wd_um],
            Message::Command(command) => self.on_command(command),
            _ => {}
        }
    }
}

// The paper's two PI loops

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Omission {
    Nothing,
    AmplitudeIntegral,
    FrequencyIntegral,
    AntiWindup,
    SmallWdGuard,
}

/// Smallest Wd in parts of the setpoint, and largest |Wq/Wd|, as in the firmware's `dq_pi.rs`.
const SMALLEST_WD: f32 = 0.1;
const LARGEST_RATIO: f32 = 2.0;

/// Implements the paper's two PI loops independently, with one omission. The loops replace `dq-pi`
/// and `dq-pi-fixed` and use the gains of these laws.
pub(crate) struct HandwrittenLoops {
    omission: Omission,
    /// `None` if the configured law is not replaced.
    configure: Option<Configure>,
    loops: Option<PiLoops>,
    sample: [f32; 3],
}

struct PiLoops {
    amplitude: Pi,
    frequency: Pi,
    offset: f32,
}

impl HandwrittenLoops {
    pub(crate) fn without(omission: Omission) -> Box<dyn Mutant> {
        Box::new(Self { omission, configure: None, loops: None, sample: [0.0; 3] })
    }

    /// Returns Wq/Wd, the input of the frequency loop. `None` if the frequency loop is inactive.
    fn ratio(&self) -> Option<f32> {
        let [setpoint, wd, wq] = self.sample;
        if self.omission == Omission::SmallWdGuard {
            return (wd != 0.0).then(|| wq / wd);
        }
        (setpoint > 0.0 && wd > SMALLEST_WD * setpoint).then(|| (wq / wd).clamp(-LARGEST_RATIO, LARGEST_RATIO))
    }

    fn on_configure(&mut self, configure: &mut Configure) {
        let own = matches!(configure.law, LawId::DqPi | LawId::DqPiFixed);
        if own {
            configure.law = LawId::DqPiFixed;
        }
        self.configure = own.then_some(*configure);
        self.loops = None;
    }

    fn on_configured(&mut self, gains: &Gains) {
        let Some(configure) = &self.configure else { return };
        let period = configure.period_us as f32 * 1e-6;
        let integral = |gain: f32, missing| if self.omission == missing { 0.0 } else { gain * period };
        let amplitude = PiGains {
            proportional: gains.amplitude_kp,
            integral_per_period: integral(gains.amplitude_ki, Omission::AmplitudeIntegral),
        };
        let frequency = PiGains {
            proportional: gains.frequency_kp,
            integral_per_period: integral(gains.frequency_ki, Omission::FrequencyIntegral),
        };
        let share = if self.omission == Omission::AntiWindup { 0.0 } else { 1.0 };
        self.loops = Some(PiLoops {
            amplitude: Pi::new(amplitude, Tracking { low: share, high: share }),
            frequency: Pi::new(frequency, Tracking::CONDITIONED),
            offset: 0.0,
        });
    }

    fn on_command(&mut self, command: &mut Command) {
        use std::f32::consts::TAU;
        let ratio = self.ratio();
        let [setpoint, wd, _] = self.sample;
        let (Some(configure), Some(loops)) = (&self.configure, &mut self.loops) else { return };
        command.drive_vpp = loops.amplitude.step(setpoint - wd, 0.0, configure.drive_limit_vpp);
        if let Some(ratio) = ratio {
            let [range, slew] = [configure.frequency_range_hz, configure.frequency_slew_hz].map(|hz| hz * TAU);
            let (low, high) = ((loops.offset - slew).max(-range), (loops.offset + slew).min(range));
            loops.offset = loops.frequency.step(ratio, low, high);
        }
        let offset_mhz = (loops.offset / TAU * 1e3).round() as i32;
        command.frequency_mhz = configure.start_frequency_mhz.saturating_add_signed(offset_mhz);
    }
}

impl Mutant for HandwrittenLoops {
    fn on_message(&mut self, message: &mut Message) {
        match message {
            Message::Configure(configure) => self.on_configure(configure),
            Message::Configured(Configured { outcome: Ok(gains) }) => self.on_configured(gains),
            Message::Sample(sample) => self.sample = [sample.setpoint_um, sample.wd_um, sample.wq_um],
            Message::Command(command) => self.on_command(command),
            _ => {}
        }
    }
}

// Frames, sequence numbers and states

const CHECKSUM_BYTES: usize = 4;

pub(crate) struct NoChecksumCheck;

impl Mutant for NoChecksumCheck {
    fn on_unreadable_frame(&mut self, frame: &[u8]) -> Option<Vec<u8>> {
        let content = frame.strip_suffix(&[0]).and_then(decode_cobs);
        let body = content.as_deref().and_then(|content| content.get(..content.len().checked_sub(CHECKSUM_BYTES)?));
        let accepted = body.filter(|body| Packet::decode(body).is_ok()).and_then(EncodedFrame::new);
        Some(accepted.map_or_else(|| frame.to_vec(), |frame| frame.as_bytes().to_vec()))
    }
}

fn decode_cobs(mut stuffed: &[u8]) -> Option<Vec<u8>> {
    let mut content = Vec::new();
    while let Some((&code, rest)) = stuffed.split_first() {
        let length = usize::from(code).checked_sub(1)?;
        content.extend_from_slice(rest.get(..length)?);
        stuffed = rest.get(length..)?;
        if code < u8::MAX && !stuffed.is_empty() {
            content.push(0);
        }
    }
    Some(content)
}

pub(crate) struct NoBadFrameCount;

impl Mutant for NoBadFrameCount {
    fn on_unreadable_frame(&mut self, _frame: &[u8]) -> Option<Vec<u8>> {
        None
    }
}

/// Executes a control step for every sample, also for a repeated one.
#[derive(Default)]
pub(crate) struct NoSequenceCheck {
    own_sequence: u8,
    bench_sequence: u8,
}

impl Mutant for NoSequenceCheck {
    fn on_receive(&mut self, packet: &mut Packet) {
        self.bench_sequence = packet.sequence;
        self.own_sequence = self.own_sequence.wrapping_add(1);
        packet.sequence = self.own_sequence;
    }

    fn on_send(&mut self, packet: &mut Packet) {
        packet.sequence = self.bench_sequence;
    }
}

/// Replaces every n-th command by the previous one, including its sequence number.
pub(crate) fn stale_answer(every: u32) -> Box<dyn Mutant> {
    let (mut count, mut last) = (0_u32, None);
    on_any_command(move |sequence, command| {
        count += 1;
        let before = last.replace((*sequence, *command));
        if let Some(before) = before.filter(|_| count.is_multiple_of(every)) {
            (*sequence, *command) = before;
        }
    })
}

#[derive(Default)]
pub(crate) struct RestartAfterStop {
    configured: Option<Configure>,
    stopped: bool,
}

impl Mutant for RestartAfterStop {
    fn on_receive(&mut self, packet: &mut Packet) {
        if let Message::Configure(configure) = packet.message {
            *self = Self { configured: Some(configure), stopped: false };
        }
    }

    fn on_send(&mut self, packet: &mut Packet) {
        if let Message::Command(Command { state, .. }) = packet.message {
            self.stopped = state == ControllerState::Fault;
        }
    }

    fn before_sample(&mut self, sequence: u8) -> Option<Packet> {
        let configure = self.configured.filter(|_| std::mem::take(&mut self.stopped))?;
        // The bench expects no answer with the previous sequence number any more.
        Some(Packet { sequence: sequence.wrapping_sub(1), message: Message::Configure(configure) })
    }
}
