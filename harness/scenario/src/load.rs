//! Raw to checked: every rule that a scenario file can break, each with a pointer to where it breaks it.

use self::expectation::expectation_names;
use crate::diagnostic::{Diagnostic, suggestion};
use crate::fault::Fault;
use crate::parse::{MAX_DIAGNOSTICS, parse, with_truncation_note};
use crate::raw::{RawController, RawScenario, RawSpread, RawTrials};
use crate::scenario::{AUTO_MODEL, Controller, Gains, InputFile, Scenario, Trials};
use crate::variation::Spread;
use crate::window::ProfileChanges;
use platebench_plate::RawPlate;
use platebench_plate::RawProfile;
use platebench_plate::input;
use platebench_plate::{ConditionProfiles, Plate, Profile, Tier, Time};
use std::f64::consts::TAU;
use std::path::{Path, PathBuf};

mod expectation;
mod expectation_window;
mod fault;
mod profile;

const DEFAULT_LAW: &str = "dq-pi";
const DEFAULT_PERIOD_MS: f64 = 1.0;
pub(crate) const LONGEST_PERIOD_MS: f64 = 1_000.0;
const MAX_DELAY_PERIODS: u64 = 100;
/// The day's temperature moves the paper's plate by 87 Hz; more than twice that is not a plate any more but another mode.
const DEFAULT_FREQUENCY_RANGE_HZ: f64 = 250.0;
/// Enough to cross the day's range in one period of 1 ms.
const DEFAULT_FREQUENCY_SLEW_HZ: f64 = 100.0;
const DEFAULT_TRACE_STEP_MS: f64 = 0.05;
/// Longer scenarios have a row per control period unless they say otherwise.
const MAX_FINE_TRACE_MS: f64 = 1_000.0;
/// A trial is held in memory: some 250 MB at the most.
const MAX_ROWS: f64 = 2e6;
/// A plate that rings longer than hours is a mistyped unit; far beyond it rounding loses its damping altogether.
const MAX_QUALITY: f64 = 1e9;
/// Each expectation is measured on every trial.
const MAX_EXPECTATIONS: usize = 2_000;
/// A TOML document takes some fifty times its size in memory.
const MAX_TOML_BYTES: usize = 4 << 20;
pub(crate) const MOST_TRIALS: i64 = 100_000;
pub(crate) const LARGEST_SPREAD_PERCENT: f64 = 20.0;

/// Reads and checks the scenario at `path`, which will be called `file` in records.
///
/// # Errors
/// The first [`Diagnostic`] of the scenario, its plate or one of its profile files.
pub fn load(path: &Path, file: &str) -> Result<Scenario, Diagnostic> {
    load_with_diagnostics(path, file).map_err(|faults| first_diagnostic(path, faults))
}

/// The same, with all that is wrong and not only the first: of a text that cannot be read every key, else every key that does not depend on a wrong one, and
/// the first of each `[[fault]]` and each `[[expect]]`.
///
/// # Errors
/// At least one [`Diagnostic`].
pub fn load_with_diagnostics(path: &Path, file: &str) -> Result<Scenario, Vec<Diagnostic>> {
    load_from(path, file, &[])
}

/// Reads and checks the scenario whose inputs were copied to `copies`, in the order of [`Scenario::inputs`], wherever its plate and its profiles were when it was written.
///
/// # Errors
/// As for [`load()`].
pub fn load_copies(copies: &[PathBuf], file: &str) -> Result<Scenario, Diagnostic> {
    let [path, named @ ..] = copies else { return Err(Diagnostic::for_file(Path::new(file), "has no copy")) };
    load_from(path, file, named).map_err(|faults| first_diagnostic(path, faults))
}

fn first_diagnostic(path: &Path, faults: Vec<Diagnostic>) -> Diagnostic {
    faults.into_iter().next().unwrap_or_else(|| Diagnostic::for_file(path, "refused without a reason"))
}

/// What the scenario names is read from `copies`, in the order in which it names it, as long as there are any.
fn load_from(path: &Path, file: &str, copies: &[PathBuf]) -> Result<Scenario, Vec<Diagnostic>> {
    let text = read_text(path).map_err(|fault| vec![fault])?;
    let mut raw: RawScenario = parse(path, &text)?;
    for (named, copy) in raw.files().zip(copies) {
        // A name is relative to the scenario; an absolute one is not.
        *named = std::path::absolute(copy).unwrap_or_else(|_| copy.clone());
    }
    let mut faults = Diagnostics::default();
    match (Checker { path, text: &text }.scenario(raw, file, &mut faults), faults.0) {
        (Some(scenario), faults) if faults.is_empty() => Ok(scenario),
        (_, faults) => Err(with_truncation_note(path, faults)),
    }
}

/// Reads and checks the plate file at `path`.
///
/// # Errors
/// All that is wrong with its keys, else the first value that cannot be meant.
pub fn load_plate(path: &Path) -> Result<Plate, Vec<Diagnostic>> {
    parse_plate(path, &read_text(path).map_err(|fault| vec![fault])?)
}

/// What is wrong so far.
#[derive(Debug, Default)]
struct Diagnostics(Vec<Diagnostic>);

impl Diagnostics {
    /// What there is, where there is something; else why not is kept.
    fn collect<T>(&mut self, result: Result<T, Diagnostic>) -> Option<T> {
        result.map_err(|fault| self.0.push(fault)).ok()
    }

    /// Those that there are. Once more is wrong than is told, the rest is not looked at.
    fn collect_each<T>(&mut self, results: &mut dyn Iterator<Item = Result<T, Diagnostic>>) -> Vec<T> {
        let mut kept = Vec::new();
        while self.0.len() < MAX_DIAGNOSTICS
            && let Some(result) = results.next()
        {
            kept.extend(self.collect(result));
        }
        kept
    }
}

fn read_text(path: &Path) -> Result<String, Diagnostic> {
    let bytes = input::read(path).map_err(|error| Diagnostic::for_file(path, format!("cannot be read: {error}")))?;
    if bytes.len() > MAX_TOML_BYTES {
        let message =
            format!("is larger than {} MiB; write the points of a profile to a CSV file", MAX_TOML_BYTES >> 20);
        return Err(Diagnostic::for_file(path, message));
    }
    decode_text(path, bytes)
}

fn decode_text(path: &Path, bytes: Vec<u8>) -> Result<String, Diagnostic> {
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

/// The parts of a scenario that the windows of expectations depend on.
struct TrialContext<'a> {
    duration: Time,
    /// Longest time from a setpoint change to the actuation that follows it.
    response_delay: Time,
    setpoint: &'a Profile,
    changes: ProfileChanges,
    faults: &'a [Fault],
}

impl Checker<'_> {
    fn error<T>(&self, key: &str, message: impl Into<String>) -> Result<T, Diagnostic> {
        Err(Diagnostic::at_key(self.path, self.text, key, message))
    }

    fn require(&self, holds: bool, key: &str, message: impl FnOnce() -> String) -> Result<(), Diagnostic> {
        if holds { Ok(()) } else { self.error(key, message()) }
    }

    fn positive(&self, key: &str, value: f64) -> Result<f64, Diagnostic> {
        self.require(value.is_finite() && value > 0.0, key, || format!("{value}, expected a finite number above 0"))?;
        Ok(value)
    }

    /// What the controller is told is carried in single precision.
    fn f32_range(&self, key: &str, value: f64) -> Result<f64, Diagnostic> {
        self.require((value as f32).is_finite(), key, || {
            format!("{value:e}, expected at most 3.4e38: the wire carries single precision")
        })?;
        Ok(value)
    }

    fn time_from_ms(&self, key: &str, ms: f64) -> Result<Time, Diagnostic> {
        match Time::from_ms(ms) {
            Some(time) => Ok(time),
            None => self.error(key, format!("{ms} ms, expected a time from 0 to 9.0e9 ms")),
        }
    }

    /// `None` where something is wrong, and what that is in `faults`.
    fn scenario(&self, raw: RawScenario, file: &str, faults: &mut Diagnostics) -> Option<Scenario> {
        let folder = self.path.parent().unwrap_or_else(|| Path::new("."));
        let one_line = !raw.title.trim().is_empty() && !raw.title.contains(char::is_control);
        faults.collect(self.require(one_line, "title", || format!("{:?}, expected one line of text", raw.title)));
        let mut inputs = vec![InputFile { path: self.path.to_owned(), bytes: self.text.as_bytes().to_vec() }];
        let plate = self.plate(&folder.join(&raw.plate), &mut inputs, faults);
        let controller = self.controller(&raw.controller, plate.as_ref(), faults);
        let positive = self.positive("duration_ms", raw.duration_ms);
        let duration = faults.collect(positive.and_then(|ms| self.time_from_ms("duration_ms", ms)));
        let timing = controller.as_ref().zip(duration);
        let trace_step =
            timing.and_then(|(controller, duration)| faults.collect(self.timing(&raw, controller, duration)));
        let mut profile = |key: &str, raw: &RawProfile| faults.collect(self.profile(folder, key, raw, &mut inputs));
        let setpoint = profile("profile.setpoint_um", &raw.profile.setpoint_um);
        let temperature_offset_k = profile("profile.temperature_offset_k", &raw.profile.temperature_offset_k);
        let finger_force_n = profile("profile.finger_force_n", &raw.profile.finger_force_n);
        let trials = faults.collect(self.trials(&raw.trials));
        if let Some(setpoint) = &setpoint {
            faults.collect(self.check_setpoints(folder, &raw.profile, setpoint));
        }
        let scene = temperature_offset_k.zip(finger_force_n);
        let scene = scene
            .map(|(temperature_offset_k, finger_force_n)| ConditionProfiles { temperature_offset_k, finger_force_n });
        if let (Some(plate), Some(scene), Some(trials)) = (&plate, &scene, &trials) {
            faults.collect(self.check_conditions(folder, &raw.profile, plate, scene, &trials.spread));
        }
        faults.collect(self.require(raw.expect.len() <= MAX_EXPECTATIONS, "expect", || {
            format!("{} [[expect]], expected at most {MAX_EXPECTATIONS}", raw.expect.len())
        }));
        faults.collect(self.require(!raw.expect.is_empty(), "expect", || {
            "no [[expect]], expected at least one: a scenario that expects nothing cannot fail".to_owned()
        }));
        let model = raw.model.as_deref().unwrap_or(AUTO_MODEL);
        let tier = plate.as_ref().and_then(|plate| faults.collect(self.tier(model, plate)));
        let expected_exit = faults.collect(self.expected_exit(raw.expected_exit));
        let (Some(controller), Some(duration), Some(setpoint), Some(scene)) = (controller, duration, setpoint, scene)
        else {
            return None;
        };
        let count = faults.0.len();
        let struck = (0..).zip(&raw.fault);
        let mut struck = struck.map(|(index, fault)| self.fault(index, fault, duration, controller.period));
        let struck = faults.collect_each(&mut struck);
        let changes = ProfileChanges::new(&setpoint, &scene.finger_force_n, &scene.temperature_offset_k, duration);
        let response_delay = controller.period + controller.loop_delay;
        let play = TrialContext { duration, response_delay, setpoint: &setpoint, changes, faults: &struck };
        let names = expectation_names(&raw.expect);
        let mut expected = (0..)
            .zip(raw.expect.iter().zip(names))
            .map(|(index, (expect, name))| self.expectation(index, expect, name, &play));
        let expected = faults.collect_each(&mut expected);
        faults.collect(self.check_names(&raw.expect, &expected));
        if faults.0.len() > count {
            return None;
        }
        Some(Scenario {
            file: file.to_owned(),
            title: raw.title,
            source: raw.source,
            tags: raw.tags,
            tier: tier?,
            expected_exit: expected_exit?,
            expectations: expected,
            faults: struck,
            conditions: scene,
            inputs,
            plate: plate?,
            duration,
            trace_step: trace_step?,
            controller,
            setpoint,
            trials: trials?,
        })
    }

    /// What ties the trial's length to the controller's timing; the spacing of rows.
    fn timing(&self, raw: &RawScenario, controller: &Controller, duration: Time) -> Result<Time, Diagnostic> {
        self.require(duration >= controller.period, "duration_ms", || {
            format!("{} ms, expected at least one control period of {}", raw.duration_ms, controller.period)
        })?;
        self.require(controller.loop_delay < duration, "controller.loop_delay_ms", || {
            format!(
                "{}, expected less than the scenario's {duration}: nothing would ever reach the plate",
                controller.loop_delay
            )
        })?;
        self.trace_step(raw.trace_step_ms, duration, controller.period)
    }

    fn plate(&self, path: &Path, inputs: &mut Vec<InputFile>, faults: &mut Diagnostics) -> Option<Plate> {
        let text = match input::read(path) {
            Ok(bytes) => faults.collect(decode_text(path, bytes))?,
            Err(error) => {
                let message = format!("plate file {} cannot be read: {error}", path.display());
                return faults.collect(self.error("plate", message));
            }
        };
        let plate = parse_plate(path, &text).map_err(|found| faults.0.extend(found)).ok()?;
        inputs.push(InputFile { path: path.to_owned(), bytes: text.into_bytes() });
        Some(plate)
    }

    fn controller(&self, raw: &RawController, plate: Option<&Plate>, faults: &mut Diagnostics) -> Option<Controller> {
        let period = faults.collect(self.period(raw));
        let delays = period.and_then(|period| {
            let loop_delay = faults.collect(self.loop_delay(raw, period));
            loop_delay.zip(faults.collect(self.design_delay(raw, period)))
        });
        let start_frequency_hz = plate.and_then(|plate| faults.collect(self.start_frequency(raw, plate)));
        let mut optional = |key: &str, value: Option<f64>| {
            let checked = |value| self.f32_range(key, self.positive(key, value)?);
            faults.collect(value.map(checked).transpose())
        };
        let range = optional("controller.frequency_range_hz", raw.frequency_range_hz);
        let slew = optional("controller.frequency_slew_hz", raw.frequency_slew_hz);
        let key = "controller.frequency_range_hz";
        if let (Some(Some(range)), Some(start_frequency_hz)) = (range, start_frequency_hz) {
            faults.collect(self.require(range < start_frequency_hz, key, || {
                format!("{range} Hz, expected less than the start frequency of {start_frequency_hz:.1} Hz")
            }));
        }
        let law = raw.law.clone().unwrap_or_else(|| DEFAULT_LAW.to_owned());
        faults.collect(
            self.require(!law.trim().is_empty(), "controller.law", || {
                "an empty name, expected a control law".to_owned()
            }),
        );
        let key = "controller.response_time_ms";
        let checked = |value| self.f32_range(key, self.positive(key, value)?);
        let response_time_ms = faults.collect(raw.response_time_ms.map(checked).transpose());
        let gains = faults.collect(self.gains(raw));
        let (loop_delay, design_delay) = delays?;
        Some(Controller {
            law,
            period: period?,
            start_frequency_hz: start_frequency_hz?,
            loop_delay,
            design_delay,
            response_time_ms: response_time_ms?,
            frequency_range_hz: range?.unwrap_or(DEFAULT_FREQUENCY_RANGE_HZ),
            frequency_slew_hz: slew?.unwrap_or(DEFAULT_FREQUENCY_SLEW_HZ),
            gains: gains?,
        })
    }

    fn period(&self, raw: &RawController) -> Result<Time, Diagnostic> {
        let period_ms = raw.period_ms.unwrap_or(DEFAULT_PERIOD_MS);
        let key = "controller.period_ms";
        let period = self.time_from_ms(key, self.positive(key, period_ms)?)?;
        self.require(period_ms <= LONGEST_PERIOD_MS, key, || {
            format!("{period_ms} ms, expected at most {LONGEST_PERIOD_MS} ms")
        })?;
        self.require(period.as_nanos() > 0 && period.as_nanos().is_multiple_of(1_000), key, || {
            format!("{period_ms} ms, expected whole microseconds: the wire carries no finer period")
        })?;
        Ok(period)
    }

    fn loop_delay(&self, raw: &RawController, period: Time) -> Result<Time, Diagnostic> {
        let key = "controller.loop_delay_ms";
        let loop_delay = self.time_from_ms(key, raw.loop_delay_ms)?;
        self.require(loop_delay <= period.times(MAX_DELAY_PERIODS), key, || {
            format!("{} ms, expected at most {MAX_DELAY_PERIODS} control periods", raw.loop_delay_ms)
        })?;
        Ok(loop_delay)
    }

    fn design_delay(&self, raw: &RawController, period: Time) -> Result<Time, Diagnostic> {
        let key = "controller.design_delay_ms";
        let design_delay = self.time_from_ms(key, raw.design_delay_ms)?;
        self.require(design_delay <= period, key, || {
            format!("{} ms, expected at most one control period of {period}", raw.design_delay_ms)
        })?;
        self.require(design_delay.as_nanos().is_multiple_of(1_000), key, || {
            format!("{} ms, expected whole microseconds: the wire carries no finer delay", raw.design_delay_ms)
        })?;
        Ok(design_delay)
    }

    fn start_frequency(&self, raw: &RawController, plate: &Plate) -> Result<f64, Diagnostic> {
        let resonance_hz = plate.omega0 / TAU;
        let key = "controller.start_frequency_hz";
        let start_frequency_hz = self.positive(key, raw.start_frequency_hz.unwrap_or(resonance_hz))?;
        let share = start_frequency_hz / resonance_hz;
        self.require((0.5..=1.5).contains(&share), key, || {
            format!("{start_frequency_hz} Hz, expected within half of the plate's resonance at {resonance_hz:.1} Hz")
        })?;
        Ok(start_frequency_hz)
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
            self.f32_range(&key, value)?;
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
            Some(ms) => self.time_from_ms(key, self.positive(key, ms)?)?,
            None if duration.ms() > MAX_FINE_TRACE_MS => period,
            None => self.time_from_ms(key, DEFAULT_TRACE_STEP_MS)?,
        };
        // There is a row at every control instant as well.
        let spacing = step.min(period);
        let rows = duration.seconds() / spacing.seconds();
        let key = if raw.is_some() && step <= period { key } else { "duration_ms" };
        self.require(rows <= MAX_ROWS, key, || {
            format!("a row every {spacing} over {duration} is {rows:.0} rows, expected at most {MAX_ROWS:.0}")
        })?;
        Ok(step)
    }

    /// The tier that is asked for by name; `None` where the bench is to choose.
    fn tier(&self, model: &str, plate: &Plate) -> Result<Tier, Diagnostic> {
        if let Some(tier) = Scenario::tier_for(model, plate) {
            return Ok(tier);
        }
        let [linear, envelope, modal, carrier] = Tier::ALL.map(Tier::name);
        let names = [AUTO_MODEL, linear, envelope, modal, carrier];
        let (known, hint) = (quoted_list(names), suggestion(model, names));
        self.error("model", format!("unknown model `{model}`, expected one of {known}{hint}"))
    }

    fn expected_exit(&self, raw: Option<i64>) -> Result<Option<u8>, Diagnostic> {
        match raw {
            None => Ok(None),
            Some(code @ (1 | 3 | 5)) => Ok(Some(code as u8)),
            Some(code) => self.error(
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

/// Checks the plate file with this text.
fn parse_plate(path: &Path, text: &str) -> Result<Plate, Vec<Diagnostic>> {
    let raw: RawPlate = parse(path, text)?;
    let refuse = |key: &str, message: String| vec![Diagnostic::at_key(path, text, key, message)];
    let plate = raw.check().map_err(|error| refuse(error.key, error.to_string()))?;
    let quality = plate.omega0 / (2.0 * plate.sigma0);
    if quality > MAX_QUALITY {
        let message = format!("a quality factor of {quality:.3e}, expected at most {MAX_QUALITY:e}");
        return Err(refuse("mode.time_constant_ms", message));
    }
    for (key, value) in [("mode.gain_um_per_vpp", plate.gain), ("drive.limit_vpp", plate.drive_limit_vpp)] {
        if !(value as f32).is_normal() {
            let message = format!("{value:e}, expected 1.2e-38 to 3.4e38: the wire carries single precision");
            return Err(refuse(key, message));
        }
    }
    Ok(plate)
}

fn quoted_list<const N: usize>(names: [&str; N]) -> String {
    names.map(|name| format!("`{name}`")).join(", ")
}

#[cfg(test)]
mod tests;
