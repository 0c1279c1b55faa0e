//! Raw to checked: every rule that a scenario file can break, each with a pointer to where it breaks it.

use crate::diagnostic::{Diagnostic, suggestion};
use crate::fault::Fault;
use crate::model::{AUTO, Model};
use crate::raw::{RawController, RawScenario, RawSpread, RawTrials};
use crate::scenario::{Controller, Gains, Input, Scenario, Trials};
use crate::variation::Spread;
use platebench_plate::file::RawPlate;
use platebench_plate::profile::RawProfile;
use platebench_plate::{Plate, Profile, Scene, Tier, Time};
use std::f64::consts::TAU;
use std::fs;
use std::path::Path;

mod expectation;
mod fault;
mod profile;

const DEFAULT_LAW: &str = "dq-pi";
const DEFAULT_PERIOD_MS: f64 = 1.0;
const LONGEST_PERIOD_MS: f64 = 1_000.0;
const LONGEST_DELAY_PERIODS: u64 = 100;
/// The day's temperature moves the paper's plate by 87 Hz; more than twice that is not a plate any more but another mode.
const DEFAULT_FREQUENCY_RANGE_HZ: f64 = 250.0;
/// Enough to cross the day's range in one period of 1 ms.
const DEFAULT_FREQUENCY_SLEW_HZ: f64 = 100.0;
const DEFAULT_TRACE_STEP_MS: f64 = 0.05;
/// Longer scenarios have a row per control period unless they say otherwise.
const LONGEST_FINE_TRACE_MS: f64 = 1_000.0;
/// A trial is held in memory: some 250 MB at the most.
const MOST_ROWS: f64 = 2e6;
/// A plate that rings longer than hours is a mistyped unit; far beyond it rounding loses its damping altogether.
const HIGHEST_QUALITY: f64 = 1e9;
const MOST_TRIALS: i64 = 100_000;
const LARGEST_SPREAD_PERCENT: f64 = 20.0;

/// Reads and checks the scenario at `path`, which will be called `file` in records.
///
/// # Errors
/// The first [`Diagnostic`] of the scenario, its plate or one of its profile files.
pub fn load(path: &Path, file: &str) -> Result<Scenario, Diagnostic> {
    let text = read(path)?;
    let raw: RawScenario = toml::from_str(&text).map_err(|error| Diagnostic::of_toml(path, &text, &error))?;
    Checker { path, text: &text }.scenario(raw, file)
}

fn read(path: &Path) -> Result<String, Diagnostic> {
    let bytes = fs::read(path).map_err(|error| Diagnostic::of_file(path, format!("cannot be read: {error}")))?;
    text_of(path, bytes)
}

fn text_of(path: &Path, bytes: Vec<u8>) -> Result<String, Diagnostic> {
    String::from_utf8(bytes).map_err(|error| {
        // Up to the fault the replaced text is the same, byte for byte.
        let at = error.utf8_error().valid_up_to();
        let shown = String::from_utf8_lossy(error.as_bytes());
        Diagnostic::at_span(
            path,
            &shown,
            at..at + char::REPLACEMENT_CHARACTER.len_utf8(),
            "not UTF-8, expected a text file in UTF-8",
        )
    })
}

/// The file under examination.
struct Checker<'a> {
    path: &'a Path,
    text: &'a str,
}

/// What expectations are checked against.
#[derive(Clone, Copy)]
struct Play<'a> {
    duration: Time,
    setpoint: &'a Profile,
    faults: &'a [Fault],
}

impl Checker<'_> {
    fn refuse<T>(&self, key: &str, message: impl Into<String>) -> Result<T, Diagnostic> {
        Err(Diagnostic::at_key(self.path, self.text, key, message))
    }

    fn require(&self, holds: bool, key: &str, message: impl FnOnce() -> String) -> Result<(), Diagnostic> {
        if holds { Ok(()) } else { self.refuse(key, message()) }
    }

    fn positive(&self, key: &str, value: f64) -> Result<f64, Diagnostic> {
        self.require(value.is_finite() && value > 0.0, key, || format!("{value}, expected a finite number above 0"))?;
        Ok(value)
    }

    /// What the controller is told is carried in single precision.
    fn single(&self, key: &str, value: f64) -> Result<f64, Diagnostic> {
        self.require((value as f32).is_finite(), key, || {
            format!("{value:e}, expected at most 3.4e38: the wire carries single precision")
        })?;
        Ok(value)
    }

    fn span(&self, key: &str, ms: f64) -> Result<Time, Diagnostic> {
        match Time::from_ms(ms) {
            Some(time) => Ok(time),
            None => self.refuse(key, format!("{ms} ms, expected a time from 0 to 9.0e9 ms")),
        }
    }

    fn scenario(&self, raw: RawScenario, file: &str) -> Result<Scenario, Diagnostic> {
        let folder = self.path.parent().unwrap_or_else(|| Path::new("."));
        let one_line = !raw.title.trim().is_empty() && !raw.title.contains(char::is_control);
        self.require(one_line, "title", || format!("{:?}, expected one line of text", raw.title))?;
        let mut inputs = vec![Input { path: self.path.to_owned(), bytes: self.text.as_bytes().to_vec() }];
        let plate = self.plate(&folder.join(&raw.plate), &mut inputs)?;
        let controller = self.controller(&raw.controller, &plate)?;
        let duration = self.span("duration_ms", self.positive("duration_ms", raw.duration_ms)?)?;
        self.require(duration >= controller.period, "duration_ms", || {
            format!("{} ms, expected at least one control period of {}", raw.duration_ms, controller.period)
        })?;
        self.require(controller.loop_delay < duration, "controller.loop_delay_ms", || {
            format!(
                "{}, expected less than the scenario's {duration}: nothing would ever reach the plate",
                controller.loop_delay
            )
        })?;
        let trace_step = self.trace_step(raw.trace_step_ms, duration, controller.period)?;
        let mut profile = |key: &str, raw: &RawProfile| self.profile(folder, key, raw, &mut inputs);
        let setpoint = profile("profile.setpoint_um", &raw.profile.setpoint_um)?;
        let temperature = profile("profile.temperature_offset_k", &raw.profile.temperature_offset_k)?;
        let force = profile("profile.finger_force_n", &raw.profile.finger_force_n)?;
        let trials = self.trials(&raw.trials)?;
        let scene = Scene { temperature_offset_k: temperature, finger_force_n: force };
        self.setpoints(folder, &raw.profile, &setpoint)?;
        self.surroundings(folder, &raw.profile, &plate, &scene, &trials.spread)?;
        self.require(!raw.expect.is_empty(), "expect", || {
            "no [[expect]], expected at least one: a scenario that expects nothing cannot fail".to_owned()
        })?;
        let faults = (0..).zip(&raw.fault).map(|(index, fault)| self.fault(index, fault, duration, controller.period));
        let faults = faults.collect::<Result<Vec<_>, _>>()?;
        let play = Play { duration, setpoint: &setpoint, faults: &faults };
        let expectations = (0..).zip(&raw.expect).map(|(index, expect)| self.expectation(index, expect, play));
        let expectations = expectations.collect::<Result<_, _>>()?;
        let asked = self.tier(raw.model.as_deref())?;
        let mut scenario = Scenario {
            file: file.to_owned(),
            title: raw.title,
            source: raw.source,
            tags: raw.tags,
            tier: asked.unwrap_or_default(),
            model: Model::of(asked),
            expected_exit: self.expected_exit(raw.expected_exit)?,
            expectations,
            faults,
            scene,
            inputs,
            plate,
            duration,
            trace_step,
            controller,
            setpoint,
            trials,
        };
        scenario.choose_model(true);
        Ok(scenario)
    }

    fn plate(&self, path: &Path, inputs: &mut Vec<Input>) -> Result<Plate, Diagnostic> {
        let text = match fs::read(path) {
            Ok(bytes) => text_of(path, bytes)?,
            Err(error) => {
                return self.refuse("plate", format!("plate file {} cannot be read: {error}", path.display()));
            }
        };
        let raw: RawPlate = toml::from_str(&text).map_err(|error| Diagnostic::of_toml(path, &text, &error))?;
        let plate = raw.check().map_err(|error| Diagnostic::at_key(path, &text, error.key, error.to_string()))?;
        let refuse = |key: &str, message: String| Err(Diagnostic::at_key(path, &text, key, message));
        let quality = plate.omega0 / (2.0 * plate.sigma0);
        if quality > HIGHEST_QUALITY {
            let message = format!("a quality factor of {quality:.3e}, expected at most {HIGHEST_QUALITY:e}");
            return refuse("mode.time_constant_ms", message);
        }
        for (key, value) in [("mode.gain_um_per_vpp", plate.gain), ("drive.limit_vpp", plate.drive_limit_vpp)] {
            if !(value as f32).is_normal() {
                return refuse(
                    key,
                    format!("{value:e}, expected 1.2e-38 to 3.4e38: the wire carries single precision"),
                );
            }
        }
        inputs.push(Input { path: path.to_owned(), bytes: text.into_bytes() });
        Ok(plate)
    }

    fn controller(&self, raw: &RawController, plate: &Plate) -> Result<Controller, Diagnostic> {
        let period_ms = raw.period_ms.unwrap_or(DEFAULT_PERIOD_MS);
        let key = "controller.period_ms";
        let period = self.span(key, self.positive(key, period_ms)?)?;
        self.require(period_ms <= LONGEST_PERIOD_MS, key, || {
            format!("{period_ms} ms, expected at most {LONGEST_PERIOD_MS} ms")
        })?;
        self.require(period.as_nanos() > 0 && period.as_nanos().is_multiple_of(1_000), key, || {
            format!("{period_ms} ms, expected whole microseconds: the wire carries no finer period")
        })?;
        let key = "controller.loop_delay_ms";
        let loop_delay = self.span(key, raw.loop_delay_ms)?;
        self.require(loop_delay <= period.times(LONGEST_DELAY_PERIODS), key, || {
            format!("{} ms, expected at most {LONGEST_DELAY_PERIODS} control periods", raw.loop_delay_ms)
        })?;
        let key = "controller.design_delay_ms";
        let design_delay = self.span(key, raw.design_delay_ms)?;
        self.require(design_delay <= period, key, || {
            format!("{} ms, expected at most one control period of {period}", raw.design_delay_ms)
        })?;
        self.require(design_delay.as_nanos().is_multiple_of(1_000), key, || {
            format!("{} ms, expected whole microseconds: the wire carries no finer delay", raw.design_delay_ms)
        })?;
        let resonance_hz = plate.omega0 / TAU;
        let key = "controller.start_frequency_hz";
        let start_frequency_hz = self.positive(key, raw.start_frequency_hz.unwrap_or(resonance_hz))?;
        let share = start_frequency_hz / resonance_hz;
        self.require((0.5..=1.5).contains(&share), key, || {
            format!("{start_frequency_hz} Hz, expected within half of the plate's resonance at {resonance_hz:.1} Hz")
        })?;
        let optional = |key: &str, value: Option<f64>| {
            let checked = |value| self.single(key, self.positive(key, value)?);
            value.map(checked).transpose()
        };
        let range = optional("controller.frequency_range_hz", raw.frequency_range_hz)?;
        let slew = optional("controller.frequency_slew_hz", raw.frequency_slew_hz)?;
        let key = "controller.frequency_range_hz";
        self.require(range.is_none_or(|range| range < start_frequency_hz), key, || {
            format!(
                "{} Hz, expected less than the start frequency of {start_frequency_hz:.1} Hz",
                range.unwrap_or_default()
            )
        })?;
        let law = raw.law.clone().unwrap_or_else(|| DEFAULT_LAW.to_owned());
        self.require(!law.trim().is_empty(), "controller.law", || "an empty name, expected a control law".to_owned())?;
        Ok(Controller {
            law,
            period,
            start_frequency_hz,
            loop_delay,
            design_delay,
            response_time_ms: optional("controller.response_time_ms", raw.response_time_ms)?,
            frequency_range_hz: range.unwrap_or(DEFAULT_FREQUENCY_RANGE_HZ),
            frequency_slew_hz: slew.unwrap_or(DEFAULT_FREQUENCY_SLEW_HZ),
            gains: self.gains(raw)?,
        })
    }

    fn gains(&self, raw: &RawController) -> Result<Option<Gains>, Diagnostic> {
        let Some(raw) = raw.gains else { return Ok(None) };
        for (name, value) in [
            ("amplitude_kp", raw.amplitude_kp),
            ("amplitude_ki", raw.amplitude_ki),
            ("frequency_kp", raw.frequency_kp),
            ("frequency_ki", raw.frequency_ki),
        ] {
            let key = format!("controller.gains.{name}");
            self.require(value.is_finite(), &key, || format!("{value}, expected a finite number"))?;
            self.single(&key, value)?;
        }
        Ok(Some(Gains {
            amplitude_kp: raw.amplitude_kp,
            amplitude_ki: raw.amplitude_ki,
            frequency_kp: raw.frequency_kp,
            frequency_ki: raw.frequency_ki,
        }))
    }

    fn trace_step(&self, raw: Option<f64>, duration: Time, period: Time) -> Result<Time, Diagnostic> {
        let key = "trace_step_ms";
        let step = match raw {
            Some(ms) => self.span(key, self.positive(key, ms)?)?,
            None if duration.ms() > LONGEST_FINE_TRACE_MS => period,
            None => self.span(key, DEFAULT_TRACE_STEP_MS)?,
        };
        // There is a row at every control instant as well.
        let spacing = step.min(period);
        let rows = duration.seconds() / spacing.seconds();
        let key = if raw.is_some() && step <= period { key } else { "duration_ms" };
        self.require(rows <= MOST_ROWS, key, || {
            format!("a row every {spacing} over {duration} is {rows:.0} rows, expected at most {MOST_ROWS:.0}")
        })?;
        Ok(step)
    }

    /// The tier that is asked for by name; `None` where the bench is to choose.
    fn tier(&self, raw: Option<&str>) -> Result<Option<Tier>, Diagnostic> {
        let Some(name) = raw.filter(|name| *name != AUTO) else { return Ok(None) };
        if let Some(tier) = Tier::from_name(name) {
            return Ok(Some(tier));
        }
        let [linear, envelope, modal, carrier] = Tier::ALL.map(Tier::name);
        let names = [AUTO, linear, envelope, modal, carrier];
        let (known, hint) = (quoted(names), suggestion(name, names));
        self.refuse("model", format!("unknown model `{name}`, expected one of {known}{hint}"))
    }

    fn expected_exit(&self, raw: Option<i64>) -> Result<Option<u8>, Diagnostic> {
        match raw {
            None => Ok(None),
            Some(code @ (1 | 3 | 5)) => Ok(Some(code as u8)),
            Some(code) => self.refuse(
                "expected_exit",
                format!(
                    "{code}, expected 1 (something fails), 3 (something is inconclusive) or 5 (the controller is lost)"
                ),
            ),
        }
    }

    fn trials(&self, raw: &RawTrials) -> Result<Trials, Diagnostic> {
        let key = "trials.count";
        self.require((1..=MOST_TRIALS).contains(&raw.count), key, || {
            format!("{} trials, expected 1 to {MOST_TRIALS}", raw.count)
        })?;
        let max_count = raw.max_count.unwrap_or(raw.count);
        self.require((raw.count..=MOST_TRIALS).contains(&max_count), "trials.max_count", || {
            format!("{max_count} trials, expected count ({}) to {MOST_TRIALS}", raw.count)
        })?;
        self.require(raw.seed >= 0, "trials.seed", || format!("{}, expected 0 or more", raw.seed))?;
        Ok(Trials {
            count: raw.count as u32,
            max_count: max_count as u32,
            seed: raw.seed as u64,
            spread: self.spread(&raw.spread)?,
        })
    }

    fn spread(&self, raw: &RawSpread) -> Result<Spread, Diagnostic> {
        for (name, value, unit) in [
            ("gain_percent", raw.gain_percent, "%"),
            ("time_constant_percent", raw.time_constant_percent, "%"),
            ("sensor_gain_percent", raw.sensor_gain_percent, "%"),
            ("temperature_k", raw.temperature_k, "K"),
        ] {
            let fits = (0.0..=LARGEST_SPREAD_PERCENT).contains(&value);
            self.require(fits, &format!("trials.spread.{name}"), || {
                format!("a standard deviation of {value} {unit}, expected 0 to {LARGEST_SPREAD_PERCENT} {unit}")
            })?;
        }
        Ok(Spread {
            gain_percent: raw.gain_percent,
            time_constant_percent: raw.time_constant_percent,
            sensor_gain_percent: raw.sensor_gain_percent,
            temperature_k: raw.temperature_k,
        })
    }
}

fn quoted<const N: usize>(names: [&str; N]) -> String {
    names.map(|name| format!("`{name}`")).join(", ")
}

#[cfg(test)]
mod tests;
