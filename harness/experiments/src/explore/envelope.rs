//! Reads the operating envelope.

use platebench_model::scenario::{Diagnostic, load, parse_file};
use platebench_plate::Plate;
use schemars::JsonSchema;
use serde::Deserialize;
use sha2::{Digest, Sha256};
use std::path::{Path, PathBuf};

/// An envelope file.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawEnvelope {
    /// Title, one line.
    #[schemars(length(min = 1))]
    title: String,
    /// Plate file, relative to this file.
    plate: PathBuf,
    /// Smallest and largest value of each quantity.
    range: Ranges,
    /// Smallest and largest number of events and trials.
    count: Counts,
}

#[derive(Debug, Clone, Copy, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Ranges {
    /// Setpoints above 0, µm.
    pub setpoint_um: [f64; 2],
    /// Normal force of the finger, N.
    pub finger_force_n: [f64; 2],
    /// Rate of a force ramp, N/s.
    pub force_rate_n_per_s: [f64; 2],
    /// Temperature above the plate's reference temperature, K.
    pub temperature_offset_k: [f64; 2],
    /// Rate of a temperature ramp, K/s.
    pub temperature_rate_k_per_s: [f64; 2],
    /// Excitation frequency minus resonance at the start of a trial, Hz.
    pub start_frequency_offset_hz: [f64; 2],
    /// Limit of the amplifier, Vpp.
    pub drive_limit_vpp: [f64; 2],
    /// Control period, ms.
    pub period_ms: [f64; 2],
    /// Loop delay, control periods. The law is configured with it.
    pub loop_delay_periods: [f64; 2],
    /// Sensor noise of each component, µm.
    pub noise_um_rms: [f64; 2],
    /// Change of the plate's gain from the plate file, percent. The law is configured with it.
    pub plate_gain_percent: [f64; 2],
    /// Change of the plate's time constant from the plate file, percent. The law is configured with
    /// it.
    pub plate_time_constant_percent: [f64; 2],
    /// Deviation of the played plate's gain from the configured gain, percent.
    pub gain_deviation_percent: [f64; 2],
    /// Deviation of the played plate's time constant from the configured one, percent.
    pub time_constant_deviation_percent: [f64; 2],
    /// Configured response time, ms.
    pub response_time_ms: [f64; 2],
    /// Configured gains, percent of the gains of the law's own design.
    pub configured_gains_percent: [f64; 2],
    /// Configured limit: deviation of the excitation frequency from the start frequency, Hz.
    pub frequency_range_hz: [f64; 2],
    /// Configured limit: change of the excitation frequency per control period, Hz.
    pub frequency_slew_hz: [f64; 2],
    /// Time between two changes of setpoint, force or temperature, ms.
    pub quiet_ms: [f64; 2],
    /// Time of a long hold or rest between two changes, ms.
    pub long_quiet_ms: [f64; 2],
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Counts {
    /// Number of events of a trial.
    pub events: [u32; 2],
    /// Number of trials before the judged one, in scenes with earlier trials.
    pub earlier_trials: [u32; 2],
}

#[derive(Debug, Clone)]
pub struct Envelope {
    pub path: PathBuf,
    pub title: String,
    pub plate: Plate,
    pub range: Ranges,
    pub count: Counts,
    /// SHA-256 of the envelope file and its plate file.
    pub digest: [u8; 32],
}

/// Smallest and largest allowed value, and their unit.
type Bounds = (f64, f64, &'static str);

const MAX_EVENTS: u32 = 20;
const MAX_EARLIER_TRIALS: u32 = 4;

impl Ranges {
    fn with_bounds(&self) -> [(&'static str, [f64; 2], Bounds); 20] {
        [
            ("setpoint_um", self.setpoint_um, (0.01, 100.0, "µm")),
            ("finger_force_n", self.finger_force_n, (0.0, 20.0, "N")),
            ("force_rate_n_per_s", self.force_rate_n_per_s, (0.01, 1e4, "N/s")),
            ("temperature_offset_k", self.temperature_offset_k, (-100.0, 100.0, "K")),
            ("temperature_rate_k_per_s", self.temperature_rate_k_per_s, (0.01, 1e4, "K/s")),
            ("start_frequency_offset_hz", self.start_frequency_offset_hz, (-100.0, 100.0, "Hz")),
            ("drive_limit_vpp", self.drive_limit_vpp, (1.0, 1e5, "Vpp")),
            ("period_ms", self.period_ms, (0.1, 20.0, "ms")),
            ("loop_delay_periods", self.loop_delay_periods, (0.0, 1.0, "periods")),
            ("noise_um_rms", self.noise_um_rms, (0.0, 1.0, "µm")),
            ("plate_gain_percent", self.plate_gain_percent, (-90.0, 900.0, "%")),
            ("plate_time_constant_percent", self.plate_time_constant_percent, (-90.0, 900.0, "%")),
            ("gain_deviation_percent", self.gain_deviation_percent, (-50.0, 50.0, "%")),
            ("time_constant_deviation_percent", self.time_constant_deviation_percent, (-50.0, 50.0, "%")),
            ("response_time_ms", self.response_time_ms, (0.1, 100.0, "ms")),
            ("configured_gains_percent", self.configured_gains_percent, (1.0, 1000.0, "%")),
            ("frequency_range_hz", self.frequency_range_hz, (1.0, 1e4, "Hz")),
            ("frequency_slew_hz", self.frequency_slew_hz, (1.0, 1e4, "Hz")),
            ("quiet_ms", self.quiet_ms, (1.0, 1e4, "ms")),
            ("long_quiet_ms", self.long_quiet_ms, (1.0, 1e5, "ms")),
        ]
    }
}

impl Envelope {
    /// Reports all wrong keys at once. If every key is right, reports all wrong values.
    pub fn load(path: &Path) -> Result<Self, Vec<Diagnostic>> {
        let (text, raw) = parse_file::<RawEnvelope>(path)?;
        let mut faults = raw.faults(path, &text);
        let plate_path = path.parent().unwrap_or_else(|| Path::new(".")).join(&raw.plate);
        let plate = load::load_plate(&plate_path).map_err(|found| faults.extend(found)).ok();
        let effects = plate.as_ref().map(|plate| load::require_no_effects(&plate_path, plate, "explore"));
        faults.extend(effects.and_then(Result::err));
        match plate {
            Some(plate) if faults.is_empty() => {
                let mut digest = Sha256::new_with_prefix(&text);
                digest.update(format!("{plate:?}"));
                let (title, range, count) = (raw.title, raw.range, raw.count);
                Ok(Self { path: path.to_owned(), title, plate, range, count, digest: digest.finalize().into() })
            }
            _ => Err(faults),
        }
    }
}

impl RawEnvelope {
    fn faults(&self, path: &Path, text: &str) -> Vec<Diagnostic> {
        let mut faults = Vec::new();
        let mut require = |holds: bool, key: String, message: &dyn Fn() -> String| {
            if !holds {
                faults.push(Diagnostic::at_key(path, text, &key, message()));
            }
        };
        let one_line = !self.title.trim().is_empty() && !self.title.contains(char::is_control);
        require(one_line, "title".to_owned(), &|| format!("{:?}, expected one line of text", self.title));
        for (key, [low, high], (least, most, unit)) in self.range.with_bounds() {
            // `inside` is false if a value is NaN.
            let inside = least <= low && high <= most;
            require(inside && low <= high, format!("range.{key}"), &|| {
                format!("[{low}, {high}], expected [low, high] with low not above high, from {least} to {most} {unit}")
            });
        }
        let counts = [("events", self.count.events, MAX_EVENTS)];
        let counts = counts.into_iter().chain([("earlier_trials", self.count.earlier_trials, MAX_EARLIER_TRIALS)]);
        for (key, [low, high], most) in counts {
            require(1 <= low && low <= high && high <= most, format!("count.{key}"), &|| {
                format!("[{low}, {high}], expected [low, high] with low not above high, from 1 to {most}")
            });
        }
        faults
    }
}
