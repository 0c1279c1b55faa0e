//! Makes traces of first-order responses.

use platebench_model::record::TrialRecord;
use platebench_model::trace::{Flags, Row, TraceWriter};
use std::fs;
use std::path::Path;

/// A first-order response to a step of 2 µm at 1 ms.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Response {
    pub(crate) duration_ms: f64,
    pub(crate) step_ms: f64,
    pub(crate) time_constant_ms: f64,
    pub(crate) gain: f64,
    /// Detuning at the start, Hz; the frequency then follows the resonance.
    pub(crate) detuned_hz: f64,
    pub(crate) follows: bool,
    /// Force of the finger after a ramp from 20 ms to 40 ms.
    pub(crate) force_n: f64,
    pub(crate) temperature_k: f64,
    pub(crate) drive_limit_vpp: f64,
}

impl Default for Response {
    fn default() -> Self {
        Self {
            duration_ms: 60.0,
            step_ms: 0.05,
            time_constant_ms: 0.6504,
            gain: 1.0,
            detuned_hz: 0.0,
            follows: true,
            force_n: 0.0,
            temperature_k: 0.0,
            drive_limit_vpp: 900.0,
        }
    }
}

impl Response {
    pub(crate) fn settling_ms(&self) -> f64 {
        self.time_constant_ms * (1.0 / (1.0 - 0.95 / self.gain)).ln()
    }

    fn row(&self, t_ms: f64) -> Row {
        let since = t_ms - 1.0;
        let rise = if since > 0.0 { 1.0 - (-since / self.time_constant_ms).exp() } else { 0.0 };
        let force = self.force_n * ((t_ms - 20.0) / 20.0).clamp(0.0, 1.0);
        let dip =
            if (20.0..45.0).contains(&t_ms) { 0.06 * (force / 2.0) * (-(t_ms - 40.0).max(0.0)).exp() } else { 0.0 };
        let amplitude = 2.0 * self.gain * rise * (1.0 - dip);
        let off = if self.follows { self.detuned_hz * (-since.max(0.0) / 3.0).exp() } else { self.detuned_hz };
        let ratio = -1.88e-3 * std::f64::consts::TAU * off;
        let in_phase = amplitude / ratio.hypot(1.0);
        let held = (t_ms + 1e-9).floor() - 1.0;
        let wanted = if held < 0.0 {
            0.0
        } else {
            286.5 * self.gain * (1.0 + 0.9 * (-held / self.time_constant_ms).exp()) * (1.0 + force * 0.66)
        };
        let saturated = if wanted >= self.drive_limit_vpp { Flags::SATURATED } else { Flags::empty() };
        Row {
            t_s: t_ms / 1e3,
            setpoint_um: if since >= 0.0 { 2.0 } else { 0.0 },
            wd_um: in_phase,
            wq_um: in_phase * ratio,
            amplitude_um: amplitude,
            drive_vpp: wanted.min(self.drive_limit_vpp),
            frequency_hz: 32_307.6 - 9.638 * self.temperature_k + off,
            resonance_hz: 32_307.6 - 9.638 * self.temperature_k,
            temperature_offset_k: self.temperature_k,
            finger_force_n: force,
            flags: saturated,
            ..Row::default()
        }
    }

    pub(crate) fn write(&self, folder: &Path, trial: &TrialRecord) {
        let path = folder.join(&trial.trace);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        let mut writer = TraceWriter::create(&path).unwrap();
        let count = (self.duration_ms / self.step_ms).round() as u32;
        for index in 0..=count {
            writer.write(&self.row(f64::from(index) * self.step_ms)).unwrap();
        }
        writer.finish().unwrap();
    }
}
