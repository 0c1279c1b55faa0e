//! What stands where in a body behind the first two bytes.

use super::{
    Command, Configure, Configured, FaultReport, Gains, Identity, LawId, MessageError, Rejection, Sample, Setpoint,
    State, StateCause, Telemetry, Tick,
};
use crate::cursor::{Reader, Writer};

/// Bits of [`Configure`]'s second byte.
const HAS_GAINS: u8 = 1;
const PACED_BY_TARGET: u8 = 2;
/// Four bytes more at the end.
const HAS_LOOP_DELAY: u8 = 4;
const DRIVES_OWN_PLATE: u8 = 8;

/// Bits of [`Telemetry`]'s last byte.
const HAS_FORCE: u8 = 1;

fn whole<T>(field: Option<T>) -> Result<T, MessageError> {
    field.ok_or(MessageError::Length)
}

fn known<T>(field: Option<T>) -> Result<T, MessageError> {
    field.ok_or(MessageError::Field)
}

impl Identity {
    pub(super) fn write(&self, writer: &mut Writer) {
        writer.put(self.version);
        writer.u8(self.capabilities);
        writer.u32(self.laws);
        writer.put(self.build);
        writer.u32(self.chip);
        writer.put(self.unique);
        writer.put(self.name);
    }

    pub(super) fn read(reader: &mut Reader<'_>) -> Result<Self, MessageError> {
        Ok(Self {
            version: whole(reader.take())?,
            capabilities: whole(reader.u8())?,
            laws: whole(reader.u32())?,
            build: whole(reader.take())?,
            chip: whole(reader.u32())?,
            unique: whole(reader.take())?,
            name: whole(reader.take())?,
        })
    }
}

impl Gains {
    const NONE: Self = Self { amplitude_kp: 0.0, amplitude_ki: 0.0, frequency_kp: 0.0, frequency_ki: 0.0 };

    pub(super) fn write(&self, writer: &mut Writer) {
        writer.f32(self.amplitude_kp);
        writer.f32(self.amplitude_ki);
        writer.f32(self.frequency_kp);
        writer.f32(self.frequency_ki);
    }

    pub(super) fn read(reader: &mut Reader<'_>) -> Result<Self, MessageError> {
        Ok(Self {
            amplitude_kp: whole(reader.f32())?,
            amplitude_ki: whole(reader.f32())?,
            frequency_kp: whole(reader.f32())?,
            frequency_ki: whole(reader.f32())?,
        })
    }
}

impl Configure {
    pub(super) fn write(&self, writer: &mut Writer) {
        writer.u8(self.law as u8);
        let has_gains = if self.gains.is_some() { HAS_GAINS } else { 0 };
        let paced_by_target = if self.paced_by_target { PACED_BY_TARGET } else { 0 };
        let has_loop_delay = if self.loop_delay_us > 0 { HAS_LOOP_DELAY } else { 0 };
        let drives_own_plate = if self.drives_own_plate { DRIVES_OWN_PLATE } else { 0 };
        writer.u8(has_gains | paced_by_target | has_loop_delay | drives_own_plate);
        writer.u16(self.patience_ms);
        writer.u32(self.period_us);
        writer.u32(self.start_frequency_mhz);
        writer.f32(self.gain_um_per_vpp);
        writer.f32(self.time_constant_s);
        writer.f32(self.response_time_s);
        writer.f32(self.drive_limit_vpp);
        writer.f32(self.frequency_range_hz);
        writer.f32(self.frequency_slew_hz);
        self.gains.unwrap_or(Gains::NONE).write(writer);
        if self.loop_delay_us > 0 {
            writer.u32(self.loop_delay_us);
        }
    }

    pub(super) fn read(reader: &mut Reader<'_>) -> Result<Self, MessageError> {
        let law = known(LawId::from_number(whole(reader.u8())?))?;
        let bits = whole(reader.u8())?;
        if bits & !(HAS_GAINS | PACED_BY_TARGET | HAS_LOOP_DELAY | DRIVES_OWN_PLATE) != 0 {
            return Err(MessageError::Field);
        }
        let without_delay = Self {
            law,
            paced_by_target: bits & PACED_BY_TARGET != 0,
            drives_own_plate: bits & DRIVES_OWN_PLATE != 0,
            patience_ms: whole(reader.u16())?,
            period_us: whole(reader.u32())?,
            loop_delay_us: 0,
            start_frequency_mhz: whole(reader.u32())?,
            gain_um_per_vpp: whole(reader.f32())?,
            time_constant_s: whole(reader.f32())?,
            response_time_s: whole(reader.f32())?,
            drive_limit_vpp: whole(reader.f32())?,
            frequency_range_hz: whole(reader.f32())?,
            frequency_slew_hz: whole(reader.f32())?,
            gains: Some(Gains::read(reader)?).filter(|_| bits & HAS_GAINS != 0),
        };
        let loop_delay_us = if bits & HAS_LOOP_DELAY == 0 { 0 } else { whole(reader.u32())? };
        if bits & HAS_LOOP_DELAY != 0 && loop_delay_us == 0 {
            return Err(MessageError::Field);
        }
        Ok(Self { loop_delay_us, ..without_delay })
    }
}

impl Configured {
    pub(super) fn write(&self, writer: &mut Writer) {
        writer.u8(self.outcome.err().map_or(0, |rejection| rejection as u8));
        writer.u8(0);
        self.outcome.unwrap_or(Gains::NONE).write(writer);
    }

    pub(super) fn read(reader: &mut Reader<'_>) -> Result<Self, MessageError> {
        let status = whole(reader.u8())?;
        whole(reader.u8())?;
        let gains = Gains::read(reader)?;
        let outcome = match status {
            0 => Ok(gains),
            1 => Err(Rejection::Value),
            2 => Err(Rejection::Law),
            _ => return Err(MessageError::Field),
        };
        Ok(Self { outcome })
    }
}

impl Sample {
    pub(super) fn write(&self, writer: &mut Writer) {
        writer.u32(self.time_us);
        writer.f32(self.setpoint_um);
        writer.f32(self.wd_um);
        writer.f32(self.wq_um);
    }

    pub(super) fn read(reader: &mut Reader<'_>) -> Result<Self, MessageError> {
        Ok(Self {
            time_us: whole(reader.u32())?,
            setpoint_um: whole(reader.f32())?,
            wd_um: whole(reader.f32())?,
            wq_um: whole(reader.f32())?,
        })
    }
}

impl Command {
    pub(super) fn write(&self, writer: &mut Writer) {
        writer.u32(self.target_time_us);
        writer.f32(self.drive_vpp);
        writer.u32(self.frequency_mhz);
        writer.u8(self.state as u8);
        writer.u8((self.cause as u8) << 4 | self.flags & 0x0f);
        writer.u16(self.compute_us);
    }

    pub(super) fn read(reader: &mut Reader<'_>) -> Result<Self, MessageError> {
        let target_time_us = whole(reader.u32())?;
        let drive_vpp = whole(reader.f32())?;
        let frequency_mhz = whole(reader.u32())?;
        let state = known(State::from_number(whole(reader.u8())?))?;
        let bits = whole(reader.u8())?;
        Ok(Self {
            target_time_us,
            drive_vpp,
            frequency_mhz,
            state,
            cause: known(StateCause::from_number(bits >> 4))?,
            flags: bits & 0x0f,
            compute_us: whole(reader.u16())?,
        })
    }
}

impl State {
    fn from_number(number: u8) -> Option<Self> {
        [Self::Idle, Self::Running, Self::Fault, Self::Safe].into_iter().find(|&state| state as u8 == number)
    }
}

impl StateCause {
    fn from_number(number: u8) -> Option<Self> {
        [Self::None, Self::SampleTimeout, Self::LineNoise, Self::NonFinite]
            .into_iter()
            .find(|&cause| cause as u8 == number)
    }
}

impl FaultReport {
    pub(super) fn write(&self, writer: &mut Writer) {
        writer.u16(self.code);
        writer.u32(self.pc);
        writer.u32(self.lr);
        writer.u32(self.cfsr);
        writer.u32(self.address);
    }

    pub(super) fn read(reader: &mut Reader<'_>) -> Result<Self, MessageError> {
        Ok(Self {
            code: whole(reader.u16())?,
            pc: whole(reader.u32())?,
            lr: whole(reader.u32())?,
            cfsr: whole(reader.u32())?,
            address: whole(reader.u32())?,
        })
    }
}

impl Tick {
    pub(super) fn write(self, writer: &mut Writer) {
        writer.u32(self.target_time_us);
    }

    pub(super) fn read(reader: &mut Reader<'_>) -> Result<Self, MessageError> {
        Ok(Self { target_time_us: whole(reader.u32())? })
    }
}

impl Setpoint {
    pub(super) fn write(self, writer: &mut Writer) {
        writer.f32(self.setpoint_um);
    }

    pub(super) fn read(reader: &mut Reader<'_>) -> Result<Self, MessageError> {
        Ok(Self { setpoint_um: whole(reader.f32())? })
    }
}

impl Telemetry {
    pub(super) fn write(&self, writer: &mut Writer) {
        writer.u32(self.period);
        writer.u32(self.target_time_us);
        writer.f32(self.setpoint_um);
        writer.f32(self.wd_um);
        writer.f32(self.wq_um);
        writer.f32(self.drive_vpp);
        writer.u32(self.frequency_mhz);
        writer.f32(self.force_n.unwrap_or(0.0));
        writer.u8(self.state as u8);
        writer.u8((self.cause as u8) << 4 | self.flags & 0x0f);
        writer.u8(if self.force_n.is_some() { HAS_FORCE } else { 0 });
    }

    pub(super) fn read(reader: &mut Reader<'_>) -> Result<Self, MessageError> {
        let period = whole(reader.u32())?;
        let target_time_us = whole(reader.u32())?;
        let [setpoint_um, wd_um, wq_um, drive_vpp] =
            [whole(reader.f32())?, whole(reader.f32())?, whole(reader.f32())?, whole(reader.f32())?];
        let frequency_mhz = whole(reader.u32())?;
        let force_n = whole(reader.f32())?;
        let state = known(State::from_number(whole(reader.u8())?))?;
        let stopped = whole(reader.u8())?;
        let bits = whole(reader.u8())?;
        if bits & !HAS_FORCE != 0 {
            return Err(MessageError::Field);
        }
        Ok(Self {
            period,
            target_time_us,
            setpoint_um,
            wd_um,
            wq_um,
            drive_vpp,
            frequency_mhz,
            force_n: Some(force_n).filter(|_| bits & HAS_FORCE != 0),
            state,
            cause: known(StateCause::from_number(stopped >> 4))?,
            flags: stopped & 0x0f,
        })
    }
}
