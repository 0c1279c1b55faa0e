//! Defines the messages of a running trial: samples, commands, ticks, telemetry and fault reports.

use crate::field::{Field, MessageError, Reader, Writer, layout};

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sample {
    /// Time on the bench's clock; wraps.
    pub time_us: u32,
    pub setpoint_um: f32,
    pub wd_um: f32,
    pub wq_um: f32,
}
layout!(Sample { time_us, setpoint_um, wd_um, wq_um });

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum ControllerState {
    /// At 0 V, waiting for a configuration or a first sample.
    Idle = 0,
    Running = 1,
    /// At 0 V after a fault; see [`StateCause`].
    Fault = 2,
    /// At 0 V on request of the bench.
    Safe = 3,
}

impl Field for ControllerState {
    fn write(&self, writer: &mut Writer) {
        writer.write(&(*self as u8));
    }

    fn read(reader: &mut Reader<'_>) -> Result<Self, MessageError> {
        let number: u8 = reader.read()?;
        let states = [Self::Idle, Self::Running, Self::Fault, Self::Safe];
        states.into_iter().find(|&state| state as u8 == number).ok_or(MessageError::Field)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[repr(u8)]
pub enum StateCause {
    #[default]
    None = 0,
    SampleTimeout = 1,
    LineNoise = 2,
    /// A sample or a computed value was not finite.
    NonFinite = 3,
}

impl StateCause {
    fn from_number(number: u8) -> Result<Self, MessageError> {
        let causes = [Self::None, Self::SampleTimeout, Self::LineNoise, Self::NonFinite];
        causes.into_iter().find(|&cause| cause as u8 == number).ok_or(MessageError::Field)
    }
}

/// Bits of [`Command::flags`].
pub mod flags {
    pub const SATURATED: u8 = 1;
    /// The frequency is at the end of its range or changes at its largest rate.
    pub const FREQUENCY_LIMITED: u8 = 2;
    /// The frequency loop is inactive because the in-phase component is too small to divide by.
    pub const FREQUENCY_HELD: u8 = 4;
    /// The plate differs from the law's prediction, and the law uses its PI loops instead.
    pub const PREDICTION_MISSED: u8 = 8;
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Command {
    /// Time at which the target received the sample, on the target's clock; wraps.
    pub target_time_us: u32,
    pub drive_vpp: f32,
    pub frequency_mhz: u32,
    pub state: ControllerState,
    pub cause: StateCause,
    pub flags: u8,
    /// Duration of the previous control step; 0 if not measured.
    pub compute_us: u16,
}

fn cause_and_flags(cause: StateCause, flags: u8) -> u8 {
    (cause as u8) << 4 | flags & 0x0f
}

impl Field for Command {
    fn write(&self, writer: &mut Writer) {
        writer.write(&self.target_time_us);
        writer.write(&self.drive_vpp);
        writer.write(&self.frequency_mhz);
        writer.write(&self.state);
        writer.write(&cause_and_flags(self.cause, self.flags));
        writer.write(&self.compute_us);
    }

    fn read(reader: &mut Reader<'_>) -> Result<Self, MessageError> {
        let (target_time_us, drive_vpp, frequency_mhz) = (reader.read()?, reader.read()?, reader.read()?);
        let state = reader.read()?;
        let bits: u8 = reader.read()?;
        let (cause, flags) = (StateCause::from_number(bits >> 4)?, bits & 0x0f);
        Ok(Self { target_time_us, drive_vpp, frequency_mhz, state, cause, flags, compute_us: reader.read()? })
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FaultReport {
    /// Cause of the report: 1 panic, 2 `HardFault`, 3 watchdog reset before this start.
    pub code: u16,
    pub pc: u32,
    pub lr: u32,
    pub cfsr: u32,
    /// Faulting address; zero if the fault has none.
    pub address: u32,
}
layout!(FaultReport { code, pc, lr, cfsr, address });

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Tick {
    /// Time of sending on the target's clock; wraps.
    pub target_time_us: u32,
}
layout!(Tick { target_time_us });

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Setpoint {
    pub setpoint_um: f32,
}
layout!(Setpoint { setpoint_um });

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Telemetry {
    /// Number of the control period; 0 at the first setpoint after the configuration; wraps.
    pub period: u32,
    /// Time of sampling on the target's clock; wraps.
    pub target_time_us: u32,
    pub setpoint_um: f32,
    pub wd_um: f32,
    pub wq_um: f32,
    pub drive_vpp: f32,
    pub frequency_mhz: u32,
    /// Normal force of the finger, if the target measures it.
    pub force_n: Option<f32>,
    pub state: ControllerState,
    pub cause: StateCause,
    pub flags: u8,
}

const HAS_FORCE: u8 = 1;

impl Field for Telemetry {
    fn write(&self, writer: &mut Writer) {
        writer.write(&self.period);
        writer.write(&self.target_time_us);
        writer.write(&self.setpoint_um);
        writer.write(&self.wd_um);
        writer.write(&self.wq_um);
        writer.write(&self.drive_vpp);
        writer.write(&self.frequency_mhz);
        writer.write(&self.force_n.unwrap_or(0.0));
        writer.write(&self.state);
        writer.write(&cause_and_flags(self.cause, self.flags));
        writer.write(&if self.force_n.is_some() { HAS_FORCE } else { 0 });
    }

    fn read(reader: &mut Reader<'_>) -> Result<Self, MessageError> {
        let (period, target_time_us) = (reader.read()?, reader.read()?);
        let (setpoint_um, wd_um, wq_um, drive_vpp) = (reader.read()?, reader.read()?, reader.read()?, reader.read()?);
        let (frequency_mhz, force_n) = (reader.read()?, reader.read()?);
        let state = reader.read()?;
        let [bits, force_bits] = reader.read::<[u8; 2]>()?;
        if force_bits & !HAS_FORCE != 0 {
            return Err(MessageError::Field);
        }
        let force_n = Some(force_n).filter(|_| force_bits & HAS_FORCE != 0);
        let (cause, flags) = (StateCause::from_number(bits >> 4)?, bits & 0x0f);
        Ok(Self {
            period,
            target_time_us,
            setpoint_um,
            wd_um,
            wq_um,
            drive_vpp,
            frequency_mhz,
            force_n,
            state,
            cause,
            flags,
        })
    }
}
