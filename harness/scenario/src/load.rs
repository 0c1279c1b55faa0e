//! Raw to checked: every rule that a scenario file can break, each with a pointer to where it breaks it.

use crate::diagnostic::{Diagnostic, suggestion};
use crate::fault::Fault;
use crate::model::{AUTO, Model};
use crate::parse::{MOST_FAULTS, parse, with_rest};
use crate::raw::{RawController, RawScenario, RawSpread, RawTrials};
use crate::scenario::{Controller, Gains, Input, Scenario, Trials};
use crate::variation::Spread;
use platebench_plate::file::RawPlate;
use platebench_plate::input;
use platebench_plate::profile::RawProfile;
use platebench_plate::{Plate, Profile, Scene, Tier, Time};
use std::f64::consts::TAU;
use std::path::{Path, PathBuf};

mod expectation;
mod fault;
mod profile;

const DEFAULT_LAW: &str = "dq-pi";
const DEFAULT_PERIOD_MS: f64 = 1.0;
pub(crate) const LONGEST_PERIOD_MS: f64 = 1_000.0;
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
pub(crate) const MOST_TRIALS: i64 = 100_000;
pub(crate) const LARGEST_SPREAD_PERCENT: f64 = 20.0;

/// Reads and checks the scenario at `path`, which will be called `file` in records.
///
/// # Errors
/// The first [`Diagnostic`] of the scenario, its plate or one of its profile files.
pub fn load(path: &Path, file: &str) -> Result<Scenario, Diagnostic> {
    examine(path, file).map_err(|faults| first(path, faults))
}

/// The same, with all that is wrong and not only the first: of a text that cannot be read every key, else every key that does not depend on a wrong one, and
/// the first of each `[[fault]]` and each `[[expect]]`.
///
/// # Errors
/// At least one [`Diagnostic`].
pub fn examine(path: &Path, file: &str) -> Result<Scenario, Vec<Diagnostic>> {
    examined(path, file, &[])
}

/// Reads and checks the scenario whose inputs were copied to `copies`, in the order of [`Scenario::inputs`], wherever its plate and its profiles were when it was written.
///
/// # Errors
/// As for [`load()`].
pub fn load_copies(copies: &[PathBuf], file: &str) -> Result<Scenario, Diagnostic> {
    let [path, named @ ..] = copies else { return Err(Diagnostic::of_file(Path::new(file), "has no copy")) };
    examined(path, file, named).map_err(|faults| first(path, faults))
}

fn first(path: &Path, faults: Vec<Diagnostic>) -> Diagnostic {
    faults.into_iter().next().unwrap_or_else(|| Diagnostic::of_file(path, "refused without a reason"))
}

/// What the scenario names is read from `copies`, in the order in which it names it, as long as there are any.
fn examined(path: &Path, file: &str, copies: &[PathBuf]) -> Result<Scenario, Vec<Diagnostic>> {
    let text = read(path).map_err(|fault| vec![fault])?;
    let mut raw: RawScenario = parse(path, &text)?;
    for (named, copy) in raw.files().zip(copies) {
        // A name is relative to the scenario; an absolute one is not.
        *named = std::path::absolute(copy).unwrap_or_else(|_| copy.clone());
    }
    let mut faults = Faults::default();
    match (Checker { path, text: &text }.scenario(raw, file, &mut faults), faults.0) {
        (Some(scenario), faults) if faults.is_empty() => Ok(scenario),
        (_, faults) => Err(with_rest(path, faults)),
    }
}

/// Reads and checks the plate file at `path`.
///
/// # Errors
/// All that is wrong with its keys, else the first value that cannot be meant.
pub fn plate(path: &Path) -> Result<Plate, Vec<Diagnostic>> {
    plate_of(path, &read(path).map_err(|fault| vec![fault])?)
}

/// What is wrong so far.
#[derive(Debug, Default)]
struct Faults(Vec<Diagnostic>);

impl Faults {
    /// What there is, where there is something; else why not is kept.
    fn keep<T>(&mut self, result: Result<T, Diagnostic>) -> Option<T> {
        result.map_err(|fault| self.0.push(fault)).ok()
    }

    /// Those that there are. Once more is wrong than is told, the rest is not looked at.
    fn keep_each<T>(&mut self, results: &mut dyn Iterator<Item = Result<T, Diagnostic>>) -> Vec<T> {
        let mut kept = Vec::new();
        while self.0.len() < MOST_FAULTS
            && let Some(result) = results.next()
        {
            kept.extend(self.keep(result));
        }
        kept
    }
}

fn read(path: &Path) -> Result<String, Diagnostic> {
    let bytes = input::read(path).map_err(|error| Diagnostic::of_file(path, format!("cannot be read: {error}")))?;
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

    /// `None` where something is wrong, and what that is in `faults`.
    fn scenario(&self, raw: RawScenario, file: &str, faults: &mut Faults) -> Option<Scenario> {
        let folder = self.path.parent().unwrap_or_else(|| Path::new("."));
        let one_line = !raw.title.trim().is_empty() && !raw.title.contains(char::is_control);
        faults.keep(self.require(one_line, "title", || format!("{:?}, expected one line of text", raw.title)));
        let mut inputs = vec![Input { path: self.path.to_owned(), bytes: self.text.as_bytes().to_vec() }];
        let plate = self.plate(&folder.join(&raw.plate), &mut inputs, faults);
        let controller = self.controller(&raw.controller, plate.as_ref(), faults);
        let positive = self.positive("duration_ms", raw.duration_ms);
        let duration = faults.keep(positive.and_then(|ms| self.span("duration_ms", ms)));
        let timing = controller.as_ref().zip(duration);
        let trace_step = timing.and_then(|(controller, duration)| faults.keep(self.timing(&raw, controller, duration)));
        let mut profile = |key: &str, raw: &RawProfile| faults.keep(self.profile(folder, key, raw, &mut inputs));
        let setpoint = profile("profile.setpoint_um", &raw.profile.setpoint_um);
        let temperature_offset_k = profile("profile.temperature_offset_k", &raw.profile.temperature_offset_k);
        let finger_force_n = profile("profile.finger_force_n", &raw.profile.finger_force_n);
        let trials = faults.keep(self.trials(&raw.trials));
        if let Some(setpoint) = &setpoint {
            faults.keep(self.setpoints(folder, &raw.profile, setpoint));
        }
        let scene = temperature_offset_k.zip(finger_force_n);
        let scene = scene.map(|(temperature_offset_k, finger_force_n)| Scene { temperature_offset_k, finger_force_n });
        if let (Some(plate), Some(scene), Some(trials)) = (&plate, &scene, &trials) {
            faults.keep(self.surroundings(folder, &raw.profile, plate, scene, &trials.spread));
        }
        faults.keep(self.require(!raw.expect.is_empty(), "expect", || {
            "no [[expect]], expected at least one: a scenario that expects nothing cannot fail".to_owned()
        }));
        let asked = faults.keep(self.tier(raw.model.as_deref()));
        let expected_exit = faults.keep(self.expected_exit(raw.expected_exit));
        let (Some(controller), Some(duration), Some(setpoint)) = (controller, duration, setpoint) else { return None };
        let count = faults.0.len();
        let struck = (0..).zip(&raw.fault);
        let mut struck = struck.map(|(index, fault)| self.fault(index, fault, duration, controller.period));
        let struck = faults.keep_each(&mut struck);
        let play = Play { duration, setpoint: &setpoint, faults: &struck };
        let mut expected = (0..).zip(&raw.expect).map(|(index, expect)| self.expectation(index, expect, play));
        let expected = faults.keep_each(&mut expected);
        if faults.0.len() > count {
            return None;
        }
        let asked = asked?;
        let mut scenario = Scenario {
            file: file.to_owned(),
            title: raw.title,
            source: raw.source,
            tags: raw.tags,
            tier: asked.unwrap_or_default(),
            model: Model::of(asked),
            expected_exit: expected_exit?,
            expectations: expected,
            faults: struck,
            scene: scene?,
            inputs,
            plate: plate?,
            duration,
            trace_step: trace_step?,
            controller,
            setpoint,
            trials: trials?,
        };
        if faults.0.is_empty() {
            scenario.choose_model(true);
        }
        Some(scenario)
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

    fn plate(&self, path: &Path, inputs: &mut Vec<Input>, faults: &mut Faults) -> Option<Plate> {
        let text = match input::read(path) {
            Ok(bytes) => faults.keep(text_of(path, bytes))?,
            Err(error) => {
                let message = format!("plate file {} cannot be read: {error}", path.display());
                return faults.keep(self.refuse("plate", message));
            }
        };
        let plate = plate_of(path, &text).map_err(|found| faults.0.extend(found)).ok()?;
        inputs.push(Input { path: path.to_owned(), bytes: text.into_bytes() });
        Some(plate)
    }

    fn controller(&self, raw: &RawController, plate: Option<&Plate>, faults: &mut Faults) -> Option<Controller> {
        let period = faults.keep(self.period(raw));
        let delays = period.and_then(|period| {
            let loop_delay = faults.keep(self.loop_delay(raw, period));
            loop_delay.zip(faults.keep(self.design_delay(raw, period)))
        });
        let start_frequency_hz = plate.and_then(|plate| faults.keep(self.start_frequency(raw, plate)));
        let mut optional = |key: &str, value: Option<f64>| {
            let checked = |value| self.single(key, self.positive(key, value)?);
            faults.keep(value.map(checked).transpose())
        };
        let range = optional("controller.frequency_range_hz", raw.frequency_range_hz);
        let slew = optional("controller.frequency_slew_hz", raw.frequency_slew_hz);
        let key = "controller.frequency_range_hz";
        if let (Some(Some(range)), Some(start_frequency_hz)) = (range, start_frequency_hz) {
            faults.keep(self.require(range < start_frequency_hz, key, || {
                format!("{range} Hz, expected less than the start frequency of {start_frequency_hz:.1} Hz")
            }));
        }
        let law = raw.law.clone().unwrap_or_else(|| DEFAULT_LAW.to_owned());
        faults.keep(
            self.require(!law.trim().is_empty(), "controller.law", || {
                "an empty name, expected a control law".to_owned()
            }),
        );
        let key = "controller.response_time_ms";
        let checked = |value| self.single(key, self.positive(key, value)?);
        let response_time_ms = faults.keep(raw.response_time_ms.map(checked).transpose());
        let gains = faults.keep(self.gains(raw));
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
        let period = self.span(key, self.positive(key, period_ms)?)?;
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
        let loop_delay = self.span(key, raw.loop_delay_ms)?;
        self.require(loop_delay <= period.times(LONGEST_DELAY_PERIODS), key, || {
            format!("{} ms, expected at most {LONGEST_DELAY_PERIODS} control periods", raw.loop_delay_ms)
        })?;
        Ok(loop_delay)
    }

    fn design_delay(&self, raw: &RawController, period: Time) -> Result<Time, Diagnostic> {
        let key = "controller.design_delay_ms";
        let design_delay = self.span(key, raw.design_delay_ms)?;
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

/// Checks the plate file with this text.
fn plate_of(path: &Path, text: &str) -> Result<Plate, Vec<Diagnostic>> {
    let raw: RawPlate = parse(path, text)?;
    let refuse = |key: &str, message: String| vec![Diagnostic::at_key(path, text, key, message)];
    let plate = raw.check().map_err(|error| refuse(error.key, error.to_string()))?;
    let quality = plate.omega0 / (2.0 * plate.sigma0);
    if quality > HIGHEST_QUALITY {
        let message = format!("a quality factor of {quality:.3e}, expected at most {HIGHEST_QUALITY:e}");
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

fn quoted<const N: usize>(names: [&str; N]) -> String {
    names.map(|name| format!("`{name}`")).join(", ")
}

#[cfg(test)]
mod tests;
