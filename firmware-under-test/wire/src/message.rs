//! What a frame's body means.
//!
//! Every body starts with two bytes: version (upper four bits) and kind (lower four bits), then the sequence number.
//! An answer carries the sequence number of what it answers. All numbers are little-endian, floats are IEEE 754
//! binary32, amplitudes and voltages are peak to peak.
//!
//! | kind | message | from | body bytes |
//! |---|---|---|---|
//! | 1 | [`Message::Hello`] | bench | 2 |
//! | 2 | [`Identity`] | target | 50 |
//! | 3 | [`Configure`] | bench | 54, or 58 with a loop delay |
//! | 4 | [`Configured`] | target | 20 |
//! | 5 | [`Sample`] | bench | 18 |
//! | 6 | [`Command`] | target | 18 |
//! | 7 | [`Message::Safe`] | bench | 2 |
//! | 8 | [`FaultReport`] | target | 20 |
//! | 9 | [`Tick`] | target | 6 |
//! | 10 | [`Setpoint`] | bench | 6 |
//! | 11 | [`Telemetry`] | target | 37 |

use crate::cursor::{Reader, Writer};
use crate::frame::Encoded;

mod layout;

/// Version of the protocol, in the upper four bits of every body's first byte.
pub const VERSION: u8 = 1;

/// A message with its sequence number: the whole content of a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Packet {
    /// Counts up by one, wrapping, per message of the bench; answers repeat it. Ticks and telemetry count by themselves.
    pub sequence: u8,
    /// What is said.
    pub message: Message,
}

/// Everything that either side can say.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Message {
    /// Bench: who are you?
    Hello,
    /// Target: the answer to `Hello`.
    Identity(Identity),
    /// Bench: the next trial's law, period, plate and limits. Leaves `Fault` and `Safe`.
    Configure(Configure),
    /// Target: what it made of `Configure`.
    Configured(Configured),
    /// Bench: the plate as the sensor sees it, once per period.
    Sample(Sample),
    /// Target: what to drive the plate with from now on.
    Command(Command),
    /// Bench: 0 V now, until the next `Configure`. Answered by a `Command` of 0 V in state `Safe`.
    Safe,
    /// Target: the processor trapped; sent once, with the drive already at 0 V.
    Fault(FaultReport),
    /// Target: a period of mine begins, sample the plate. Only where the configuration asked for it; numbered by itself.
    Tick(Tick),
    /// Bench: the amplitude that a target with a plate of its own is to hold from now on. Answered by a `Command`.
    Setpoint(Setpoint),
    /// Target: what it did to its own plate in a period. Only where the configuration asked for it; numbered by itself.
    Telemetry(Telemetry),
}

/// Control laws by number. The names are those of scenario files and `--law`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum LawId {
    /// Constant drive and frequency.
    OpenLoop = 0,
    /// Two PI loops, equation 24 matched to the zero-order hold and to the plate's damping.
    DqPi = 1,
    /// Two PI loops, equation 24 as printed with a forward-Euler integral.
    DqPiEuler = 2,
    /// PI on the amplitude, fixed frequency.
    VoltageOnly = 3,
    /// Constant drive, the frequency adjusts the amplitude.
    FrequencyOnly = 4,
    /// PI on the amplitude, fixed frequency steps by the sign of Wq.
    BangBang = 5,
    /// Phase locked to the resonance, voltage of constant magnitude.
    Pll = 6,
    /// Steers to the setpoint in one period once the first has shown the plate, then holds with PI loops.
    Deadbeat = 7,
    /// As `DqPi`, with the gains of the untouched plate whatever touches it.
    DqPiFixed = 8,
}

impl LawId {
    /// Every law, in the order of their numbers.
    pub const ALL: [Self; 9] = [
        Self::OpenLoop,
        Self::DqPi,
        Self::DqPiEuler,
        Self::VoltageOnly,
        Self::FrequencyOnly,
        Self::BangBang,
        Self::Pll,
        Self::Deadbeat,
        Self::DqPiFixed,
    ];

    /// The law's name in scenario files and on the command line.
    pub const fn name(self) -> &'static str {
        match self {
            Self::OpenLoop => "open-loop",
            Self::DqPi => "dq-pi",
            Self::DqPiEuler => "dq-pi-euler",
            Self::VoltageOnly => "voltage-only",
            Self::FrequencyOnly => "frequency-only",
            Self::BangBang => "bang-bang",
            Self::Pll => "pll",
            Self::Deadbeat => "deadbeat",
            Self::DqPiFixed => "dq-pi-fixed",
        }
    }

    /// The law of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|law| law.name() == name)
    }

    fn from_number(number: u8) -> Option<Self> {
        Self::ALL.into_iter().find(|&law| law as u8 == number)
    }
}

/// Bits of [`Identity::capabilities`].
pub mod capabilities {
    /// A timer of the target's own can pace the control: [`Configure::paced_by_target`](super::Configure::paced_by_target).
    pub const TARGET_PACED: u8 = 1;
    /// The target measures how long a control step takes it: [`Command::compute_us`](super::Command::compute_us).
    pub const MEASURES_COMPUTING: u8 = 2;
    /// The target reads a configuration with a loop delay in it: [`Configure::loop_delay_us`](super::Configure::loop_delay_us).
    pub const TOLD_DELAY: u8 = 4;
    /// The target has a plate of its own, with sensor and amplifier, and can be given setpoints: [`Configure::drives_own_plate`](super::Configure::drives_own_plate).
    pub const OWN_PLATE: u8 = 8;
}

/// Who the target is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Identity {
    /// Firmware version: major, minor, patch.
    pub version: [u8; 3],
    /// See [`capabilities`]; bits that are not known there mean nothing.
    pub capabilities: u8,
    /// Bit n set: the law with number n is there.
    pub laws: u32,
    /// First eight bytes of the SHA-256 of the firmware's sources; zero where the build did not say.
    pub build: [u8; 8],
    /// The chip's identity code (`DBGMCU_IDCODE` on an STM32); zero for a program on a computer.
    pub chip: u32,
    /// The chip's unique number; zero for a program on a computer.
    pub unique: [u8; 12],
    /// Name of the firmware in ASCII, filled up with zeros.
    pub name: [u8; 16],
}

impl Identity {
    /// True when the target says that it has `law`.
    pub fn has(&self, law: LawId) -> bool {
        self.laws & 1 << law as u8 != 0
    }

    /// True when the target says that it can do `capability`, one of [`capabilities`].
    pub fn can(&self, capability: u8) -> bool {
        self.capabilities & capability != 0
    }
}

/// Proportional and integral gains of both loops.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gains {
    /// Amplitude loop, Vpp per µm.
    pub amplitude_kp: f32,
    /// Amplitude loop, Vpp per µm and second.
    pub amplitude_ki: f32,
    /// Frequency loop, rad/s per unit of Wq/Wd.
    pub frequency_kp: f32,
    /// Frequency loop, rad/s per unit of Wq/Wd and second.
    pub frequency_ki: f32,
}

/// Everything a controller needs to know before a trial.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Configure {
    /// The law to run.
    pub law: LawId,
    /// True where the target is to say [`Tick`] at each of its own periods, and the bench answers with a sample; false where the bench's samples pace the control.
    pub paced_by_target: bool,
    /// True where the target is to drive its own plate by its own sensor and timer: the bench sends a [`Setpoint`] instead of samples and hears [`Telemetry`]. Only for
    /// a target with [`capabilities::OWN_PLATE`].
    pub drives_own_plate: bool,
    /// Without a sample, or a setpoint where it drives its own plate, for this long on the target's own clock the drive goes to 0 V, ms; zero for five periods.
    pub patience_ms: u16,
    /// Control period, µs.
    pub period_us: u32,
    /// Sampling to actuation as far as the bench knows it, µs; zero for unknown or none. Only a target with [`capabilities::TOLD_DELAY`] reads a message that has it.
    pub loop_delay_us: u32,
    /// Excitation frequency at the start, mHz.
    pub start_frequency_mhz: u32,
    /// Nominal gain K1 of the plate, µm per Vpp.
    pub gain_um_per_vpp: f32,
    /// Nominal time constant τ of the plate, s.
    pub time_constant_s: f32,
    /// Design value of the 5 % response time, s (equation 24); zero for the law's own.
    pub response_time_s: f32,
    /// Highest drive the amplifier gives, Vpp.
    pub drive_limit_vpp: f32,
    /// The excitation frequency stays within this much of the start frequency, Hz.
    pub frequency_range_hz: f32,
    /// The excitation frequency moves at most this much per period, Hz.
    pub frequency_slew_hz: f32,
    /// Gains to use instead of the law's own design.
    pub gains: Option<Gains>,
}

/// Why a configuration was refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Rejection {
    /// A value is not finite, not positive or beyond what the law can work with.
    Value = 1,
    /// The firmware does not have this law.
    Law = 2,
}

/// The target's answer to [`Configure`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Configured {
    /// The gains in force, or why there are none.
    pub outcome: Result<Gains, Rejection>,
}

/// The plate as the demodulated sensor shows it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sample {
    /// Instant of sampling on the bench's clock, µs, wrapping.
    pub time_us: u32,
    /// Wished amplitude, µm peak to peak.
    pub setpoint_um: f32,
    /// In-phase component, µm.
    pub wd_um: f32,
    /// Quadrature component, µm.
    pub wq_um: f32,
}

/// What the target is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum State {
    /// Powered, at 0 V, waiting for a configuration or a first sample.
    Idle = 0,
    /// Controlling.
    Running = 1,
    /// At 0 V after something went wrong; the cause is beside it.
    Fault = 2,
    /// At 0 V because the bench asked for it.
    Safe = 3,
}

/// Why the target left `Running`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[repr(u8)]
pub enum StateCause {
    /// Nothing happened.
    #[default]
    None = 0,
    /// No sample for as long as the configuration has patience, by default five periods.
    SampleTimeout = 1,
    /// Too many refused frames.
    LineNoise = 2,
    /// A sample or a computed value was not finite.
    NonFinite = 3,
}

/// Bits of [`Command::flags`].
pub mod flags {
    /// The law wished for a drive outside what the amplifier gives.
    pub const SATURATED: u8 = 1;
    /// The frequency loop is at the end of its range or slews at its limit.
    pub const FREQUENCY_LIMITED: u8 = 2;
    /// The frequency loop rests because the in-phase amplitude is too small to divide by.
    pub const FREQUENCY_HELD: u8 = 4;
    /// The plate did not do what the law predicted, and the law fell back to a simpler one.
    pub const PREDICTION_MISSED: u8 = 8;
}

/// What the plate is to be driven with.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Command {
    /// Instant at which the sample was taken in, on the target's own clock, µs, wrapping.
    pub target_time_us: u32,
    /// Drive, Vpp.
    pub drive_vpp: f32,
    /// Excitation frequency, mHz.
    pub frequency_mhz: u32,
    /// What the target is doing.
    pub state: State,
    /// Why, where it stopped.
    pub cause: StateCause,
    /// See [`flags`]; four bits.
    pub flags: u8,
    /// How long the previous control step took, µs; zero where nobody measured.
    pub compute_us: u16,
}

/// A processor trap, as the target's registers show it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FaultReport {
    /// 1 panic, 2 `HardFault`, 3 watchdog reset before this start.
    pub code: u16,
    /// Program counter.
    pub pc: u32,
    /// Link register.
    pub lr: u32,
    /// Configurable fault status register.
    pub cfsr: u32,
    /// Faulting address, zero where none is valid.
    pub address: u32,
}

/// The beginning of a control period that the target's own timer paces.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Tick {
    /// Instant at which it is said, on the target's own clock, µs, wrapping.
    pub target_time_us: u32,
}

/// What a target with a plate of its own is to do with it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Setpoint {
    /// Wished amplitude, µm peak to peak.
    pub setpoint_um: f32,
}

/// A control period of a target that drives its own plate, as the target itself saw it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Telemetry {
    /// Number of the period, counted from 0 at the first setpoint after the configuration, wrapping.
    pub period: u32,
    /// Instant of sampling on the target's own clock, µs, wrapping.
    pub target_time_us: u32,
    /// The setpoint that the control step used, µm.
    pub setpoint_um: f32,
    /// In-phase component by the target's own sensor, µm.
    pub wd_um: f32,
    /// Quadrature component by the target's own sensor, µm.
    pub wq_um: f32,
    /// Drive from this control step on, Vpp.
    pub drive_vpp: f32,
    /// Excitation frequency from this control step on, mHz.
    pub frequency_mhz: u32,
    /// Normal force of the finger, N, where the target measures it.
    pub force_n: Option<f32>,
    /// What the target is doing.
    pub state: State,
    /// Why, where it stopped.
    pub cause: StateCause,
    /// See [`flags`]; four bits.
    pub flags: u8,
}

/// Why a body with a good checksum was refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MessageError {
    /// Another version of the protocol.
    Version(u8),
    /// No message has this number.
    Kind(u8),
    /// The body is shorter or longer than its kind has it.
    Length,
    /// A field holds a number that means nothing.
    Field,
}

impl Message {
    fn kind(&self) -> u8 {
        match self {
            Self::Hello => 1,
            Self::Identity(_) => 2,
            Self::Configure(_) => 3,
            Self::Configured(_) => 4,
            Self::Sample(_) => 5,
            Self::Command(_) => 6,
            Self::Safe => 7,
            Self::Fault(_) => 8,
            Self::Tick(_) => 9,
            Self::Setpoint(_) => 10,
            Self::Telemetry(_) => 11,
        }
    }
}

impl Message {
    /// True for what a target says of its own accord under numbers of its own, which therefore answers nothing.
    pub const fn counts_by_itself(&self) -> bool {
        matches!(self, Self::Tick(_) | Self::Telemetry(_))
    }
}

impl Packet {
    /// The frame of this packet.
    pub fn encode(&self) -> Encoded {
        let mut writer = Writer::new();
        writer.u8(VERSION << 4 | self.message.kind());
        writer.u8(self.sequence);
        match &self.message {
            Message::Hello | Message::Safe => {}
            Message::Identity(identity) => identity.write(&mut writer),
            Message::Configure(configure) => configure.write(&mut writer),
            Message::Configured(configured) => configured.write(&mut writer),
            Message::Sample(sample) => sample.write(&mut writer),
            Message::Command(command) => command.write(&mut writer),
            Message::Fault(report) => report.write(&mut writer),
            Message::Tick(tick) => tick.write(&mut writer),
            Message::Setpoint(setpoint) => setpoint.write(&mut writer),
            Message::Telemetry(telemetry) => telemetry.write(&mut writer),
        }
        // A writer holds at most MAX_BODY bytes, and such a body always has a frame.
        match Encoded::new(writer.body()) {
            Some(frame) => frame,
            None => unreachable!(),
        }
    }

    /// Reads the body of a frame.
    ///
    /// # Errors
    /// [`MessageError`] where version, kind, length or a field is not of this protocol.
    pub fn decode(body: &[u8]) -> Result<Self, MessageError> {
        let mut reader = Reader::new(body);
        let first = reader.u8().ok_or(MessageError::Length)?;
        if first >> 4 != VERSION {
            return Err(MessageError::Version(first >> 4));
        }
        let sequence = reader.u8().ok_or(MessageError::Length)?;
        let message = match first & 0x0f {
            1 => Message::Hello,
            2 => Message::Identity(Identity::read(&mut reader)?),
            3 => Message::Configure(Configure::read(&mut reader)?),
            4 => Message::Configured(Configured::read(&mut reader)?),
            5 => Message::Sample(Sample::read(&mut reader)?),
            6 => Message::Command(Command::read(&mut reader)?),
            7 => Message::Safe,
            8 => Message::Fault(FaultReport::read(&mut reader)?),
            9 => Message::Tick(Tick::read(&mut reader)?),
            10 => Message::Setpoint(Setpoint::read(&mut reader)?),
            11 => Message::Telemetry(Telemetry::read(&mut reader)?),
            kind => return Err(MessageError::Kind(kind)),
        };
        if reader.is_at_end() { Ok(Self { sequence, message }) } else { Err(MessageError::Length) }
    }
}

#[cfg(test)]
mod tests;
