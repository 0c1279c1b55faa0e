//! Reads the operating envelope.

use platebench_model::scenario::{Diagnostic, FileChecker, load};
use platebench_model::trace::OutputFolder;
use platebench_plate::Plate;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
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

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Ranges {
    /// Setpoints above 0, µm.
    #[schemars(inner(range(min = 0.01, max = 100.0)))]
    pub setpoint_um: [f64; 2],
    /// Rate of a setpoint ramp, µm/s; default: 0.2 to 50.
    #[serde(default = "Ranges::setpoint_rate")]
    #[schemars(inner(range(min = 0.001, max = 1e4)))]
    pub setpoint_rate_um_per_s: [f64; 2],
    /// Normal force of the finger, N.
    #[schemars(inner(range(min = 0.0, max = 20.0)))]
    pub finger_force_n: [f64; 2],
    /// Rate of a force ramp, N/s.
    #[schemars(inner(range(min = 0.01, max = 1e4)))]
    pub force_rate_n_per_s: [f64; 2],
    /// Temperature above the plate's reference temperature, K.
    #[schemars(inner(range(min = -100.0, max = 100.0)))]
    pub temperature_offset_k: [f64; 2],
    /// Rate of a temperature ramp, K/s.
    #[schemars(inner(range(min = 0.01, max = 1e4)))]
    pub temperature_rate_k_per_s: [f64; 2],
    /// Excitation frequency minus resonance at the start of a trial, Hz.
    #[schemars(inner(range(min = -100.0, max = 100.0)))]
    pub start_frequency_offset_hz: [f64; 2],
    /// Limit of the amplifier, Vpp.
    #[schemars(inner(range(min = 1.0, max = 1e5)))]
    pub drive_limit_vpp: [f64; 2],
    /// Control period, ms.
    #[schemars(inner(range(min = 0.1, max = 20.0)))]
    pub period_ms: [f64; 2],
    /// Loop delay, control periods. The law is configured with it.
    #[schemars(inner(range(min = 0.0, max = 1.0)))]
    pub loop_delay_periods: [f64; 2],
    /// Sensor noise of each component, µm.
    #[schemars(inner(range(min = 0.0, max = 1.0)))]
    pub noise_um_rms: [f64; 2],
    /// Change of the plate's gain from the plate file, percent. The law is configured with it.
    #[schemars(inner(range(min = -90.0, max = 900.0)))]
    pub plate_gain_percent: [f64; 2],
    /// Change of the plate's time constant from the plate file, percent. The law is configured with
    /// it.
    #[schemars(inner(range(min = -90.0, max = 900.0)))]
    pub plate_time_constant_percent: [f64; 2],
    /// Deviation of the played plate's gain from the configured gain, percent.
    #[schemars(inner(range(min = -50.0, max = 50.0)))]
    pub gain_deviation_percent: [f64; 2],
    /// Deviation of the played plate's time constant from the configured one, percent.
    #[schemars(inner(range(min = -50.0, max = 50.0)))]
    pub time_constant_deviation_percent: [f64; 2],
    /// Configured response time, ms.
    #[schemars(inner(range(min = 0.1, max = 100.0)))]
    pub response_time_ms: [f64; 2],
    /// Configured gains, percent of the gains of the law's own design.
    #[schemars(inner(range(min = 1.0, max = 1000.0)))]
    pub configured_gains_percent: [f64; 2],
    /// Configured limit: deviation of the excitation frequency from the start frequency, Hz.
    #[schemars(inner(range(min = 1.0, max = 1e4)))]
    pub frequency_range_hz: [f64; 2],
    /// Configured limit: change of the excitation frequency per control period, Hz.
    #[schemars(inner(range(min = 1.0, max = 1e4)))]
    pub frequency_slew_hz: [f64; 2],
    /// Time between two changes of setpoint, force or temperature, ms.
    #[schemars(inner(range(min = 1.0, max = 1e4)))]
    pub quiet_ms: [f64; 2],
    /// Time of a long hold or rest between two changes, ms.
    #[schemars(inner(range(min = 1.0, max = 1e5)))]
    pub long_quiet_ms: [f64; 2],
}

impl Ranges {
    const fn setpoint_rate() -> [f64; 2] {
        [0.2, 50.0]
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Counts {
    /// Number of events of a trial.
    #[schemars(inner(range(min = 1, max = 20)))]
    pub events: [u32; 2],
    /// Number of trials before the judged one, in scenes with earlier trials.
    #[schemars(inner(range(min = 1, max = 4)))]
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

const BUILT_IN: [(&str, &str); 2] = [
    ("envelope.toml", include_str!("../../../../scenarios/envelope.toml")),
    ("plates/aluminium-198x138.toml", include_str!("../../../../scenarios/plates/aluminium-198x138.toml")),
];

impl Envelope {
    /// The envelope of the project, for use outside of it.
    pub fn built_in() -> Result<Self, Vec<Diagnostic>> {
        let failed = |error: &dyn std::fmt::Display| {
            vec![Diagnostic::for_file(Path::new("built-in envelope"), format!("cannot be written: {error}"))]
        };
        let folder = tempfile::tempdir().map_err(|error| failed(&error))?;
        let output = OutputFolder::create(folder.path()).map_err(|error| failed(&error))?;
        for (file, text) in BUILT_IN {
            output.write(file, text).map_err(|error| failed(&error))?;
        }
        let envelope = Self::load(&folder.path().join(BUILT_IN[0].0))?;
        Ok(Self { path: PathBuf::from("the built-in envelope"), ..envelope })
    }

    /// Reports all wrong keys at once, or all numbers outside their bounds, or all other wrong values.
    pub fn load(path: &Path) -> Result<Self, Vec<Diagnostic>> {
        let (mut checker, raw) = FileChecker::read::<RawEnvelope>(path)?;
        raw.check(&mut checker);
        let plate_path = checker.neighbour(&raw.plate);
        let plate = checker.accept(load::load_plate(&plate_path));
        if let Some(plate) = &plate {
            checker.accept_one(load::require_no_effects(&plate_path, plate, "explore"));
        }
        let Some(plate) = plate else { return Err(checker.into_problems()) };
        let mut digest = Sha256::new_with_prefix(checker.finish()?);
        digest.update(format!("{plate:?}"));
        let (title, range, count) = (raw.title, raw.range, raw.count);
        Ok(Self { path: path.to_owned(), title, plate, range, count, digest: digest.finalize().into() })
    }

    /// Drive limit of the plate file, limited to the range, Vpp.
    pub(crate) fn usual_limit_vpp(&self) -> f64 {
        let [low, high] = self.range.drive_limit_vpp;
        self.plate.drive_limit_vpp.min(high).max(low).round()
    }
}

impl RawEnvelope {
    fn check(&self, checker: &mut FileChecker) {
        checker.require_one_line("title", &self.title);
        for (table, ranges) in
            [("range", toml::Value::try_from(self.range)), ("count", toml::Value::try_from(self.count))]
        {
            for (key, ends) in ranges.iter().filter_map(toml::Value::as_table).flatten() {
                let ends: Vec<f64> = ends.as_array().into_iter().flatten().filter_map(number).collect();
                checker.require(ends.is_sorted(), &format!("{table}.{key}"), || {
                    format!("{ends:?}, expected [low, high] with low not above high")
                });
            }
        }
    }
}

fn number(value: &toml::Value) -> Option<f64> {
    value.as_float().or_else(|| value.as_integer().map(|number| number as f64))
}
