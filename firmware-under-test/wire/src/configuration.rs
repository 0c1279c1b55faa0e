//! Defines the configuration message of a trial and the target's answer to it.

use crate::field::{Field, MessageError, Reader, Writer, layout};
use crate::identity::LawId;

/// The amplitude gains are in Vpp/µm and Vpp/(µm·s), the frequency gains in rad/s and rad/s² per
/// unit of Wq/Wd.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gains {
    pub amplitude_kp: f32,
    pub amplitude_ki: f32,
    pub frequency_kp: f32,
    pub frequency_ki: f32,
}
layout!(Gains { amplitude_kp, amplitude_ki, frequency_kp, frequency_ki });

impl Gains {
    const NONE: Self = Self { amplitude_kp: 0.0, amplitude_ki: 0.0, frequency_kp: 0.0, frequency_ki: 0.0 };
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Configure {
    pub law: LawId,
    /// If true, the target sends a [`Tick`](crate::Tick) in each period and the bench answers with
    /// a sample. If false, the bench's samples pace the control.
    pub paced_by_target: bool,
    /// If true, the target drives its own plate, receives [`Setpoint`](crate::Setpoint) instead of
    /// samples and sends [`Telemetry`](crate::Telemetry). Requires
    /// [`OWN_PLATE`](crate::capabilities::OWN_PLATE).
    pub drives_own_plate: bool,
    /// Time without a sample or setpoint after which the drive goes to 0 V; 0 means five periods.
    pub watchdog_timeout_ms: u16,
    pub period_us: u32,
    /// Time from sampling to actuation; 0 if unknown. Other values require
    /// [`LOOP_DELAY`](crate::capabilities::LOOP_DELAY).
    pub loop_delay_us: u32,
    pub start_frequency_mhz: u32,
    /// Gain K1 of the untouched plate.
    pub gain_um_per_vpp: f32,
    /// Time constant τ of the untouched plate.
    pub time_constant_s: f32,
    /// 5 % response time (equation 24); 0 means the law's default.
    pub response_time_s: f32,
    pub drive_limit_vpp: f32,
    /// Largest distance of the excitation from the start frequency.
    pub frequency_range_hz: f32,
    /// Largest change of the excitation frequency per period.
    pub frequency_slew_hz: f32,
    pub gains: Option<Gains>,
}

/// Bits of the second byte of a configuration.
const HAS_GAINS: u8 = 1;
const PACED_BY_TARGET: u8 = 2;
/// Marks a loop delay in four more bytes at the end of the body.
const HAS_LOOP_DELAY: u8 = 4;
const DRIVES_OWN_PLATE: u8 = 8;

impl Field for Configure {
    fn write(&self, writer: &mut Writer) {
        writer.write(&self.law);
        let bit = |is_set, bit| if is_set { bit } else { 0_u8 };
        let bits = bit(self.gains.is_some(), HAS_GAINS)
            | bit(self.paced_by_target, PACED_BY_TARGET)
            | bit(self.loop_delay_us > 0, HAS_LOOP_DELAY)
            | bit(self.drives_own_plate, DRIVES_OWN_PLATE);
        writer.write(&bits);
        writer.write(&self.watchdog_timeout_ms);
        writer.write(&self.period_us);
        writer.write(&self.start_frequency_mhz);
        writer.write(&self.gain_um_per_vpp);
        writer.write(&self.time_constant_s);
        writer.write(&self.response_time_s);
        writer.write(&self.drive_limit_vpp);
        writer.write(&self.frequency_range_hz);
        writer.write(&self.frequency_slew_hz);
        writer.write(&self.gains.unwrap_or(Gains::NONE));
        if self.loop_delay_us > 0 {
            writer.write(&self.loop_delay_us);
        }
    }

    fn read(reader: &mut Reader<'_>) -> Result<Self, MessageError> {
        let law = reader.read()?;
        let bits: u8 = reader.read()?;
        if bits & !(HAS_GAINS | PACED_BY_TARGET | HAS_LOOP_DELAY | DRIVES_OWN_PLATE) != 0 {
            return Err(MessageError::Field);
        }
        let without_delay = Self {
            law,
            paced_by_target: bits & PACED_BY_TARGET != 0,
            drives_own_plate: bits & DRIVES_OWN_PLATE != 0,
            watchdog_timeout_ms: reader.read()?,
            period_us: reader.read()?,
            loop_delay_us: 0,
            start_frequency_mhz: reader.read()?,
            gain_um_per_vpp: reader.read()?,
            time_constant_s: reader.read()?,
            response_time_s: reader.read()?,
            drive_limit_vpp: reader.read()?,
            frequency_range_hz: reader.read()?,
            frequency_slew_hz: reader.read()?,
            gains: Some(reader.read()?).filter(|_| bits & HAS_GAINS != 0),
        };
        if bits & HAS_LOOP_DELAY == 0 {
            return Ok(without_delay);
        }
        match reader.read()? {
            0 => Err(MessageError::Field),
            loop_delay_us => Ok(Self { loop_delay_us, ..without_delay }),
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Rejection {
    /// A value is not finite, not positive or outside the law's range.
    Value = 1,
    Law = 2,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Configured {
    pub outcome: Result<Gains, Rejection>,
}

impl Field for Configured {
    fn write(&self, writer: &mut Writer) {
        writer.write(&self.outcome.err().map_or(0, |rejection| rejection as u8));
        writer.write(&0_u8);
        writer.write(&self.outcome.unwrap_or(Gains::NONE));
    }

    fn read(reader: &mut Reader<'_>) -> Result<Self, MessageError> {
        let [status, _] = reader.read::<[u8; 2]>()?;
        let gains = reader.read()?;
        let outcome = match status {
            0 => Ok(gains),
            1 => Err(Rejection::Value),
            2 => Err(Rejection::Law),
            _ => return Err(MessageError::Field),
        };
        Ok(Self { outcome })
    }
}
