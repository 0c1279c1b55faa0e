//! Raw to checked: every rule that a scenario file can break, each with a pointer to where it breaks it.

use crate::diagnostic::Diagnostic;
use crate::expect::{Expectation, Limit, Metric, SIGNALS, Window};
use crate::raw::{RawController, RawExpectation, RawScenario, RawSpread, RawTrials, RawWindow};
use crate::scenario::{Controller, Gains, Input, Scenario, Trials};
use crate::variation::Spread;
use platebench_plate::file::RawPlate;
use platebench_plate::profile::RawProfile;
use platebench_plate::{Conditions, Plate, Profile, Scene, Tier, Time};
use std::f64::consts::TAU;
use std::fs;
use std::path::Path;

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
const MOST_ROWS: f64 = 2e7;
const MOST_TRIALS: i64 = 100_000;
const LARGEST_SPREAD_PERCENT: f64 = 20.0;
const DEFAULT_CONFIDENCE: f64 = 0.95;
const DEFAULT_BAND_PERCENT: f64 = 5.0;
const DEFAULT_TOLERANCE_PERCENT: f64 = 5.0;
const LARGEST_SETPOINT_UM: f64 = 1_000.0;

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
    fs::read_to_string(path).map_err(|error| Diagnostic::of_file(path, format!("cannot be read: {error}")))
}

/// The file under examination.
struct Checker<'a> {
    path: &'a Path,
    text: &'a str,
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

    fn span(&self, key: &str, ms: f64) -> Result<Time, Diagnostic> {
        match Time::from_ms(ms) {
            Some(time) => Ok(time),
            None => self.refuse(key, format!("{ms} ms, expected a time from 0 to 9.0e9 ms")),
        }
    }

    fn scenario(&self, raw: RawScenario, file: &str) -> Result<Scenario, Diagnostic> {
        let folder = self.path.parent().unwrap_or_else(|| Path::new("."));
        self.require(!raw.title.trim().is_empty(), "title", || "an empty title, expected one line".to_owned())?;
        let mut inputs = vec![Input { path: self.path.to_owned(), bytes: self.text.as_bytes().to_vec() }];
        let plate = self.plate(&folder.join(&raw.plate), &mut inputs)?;
        let controller = self.controller(&raw.controller, &plate)?;
        let duration = self.span("duration_ms", self.positive("duration_ms", raw.duration_ms)?)?;
        self.require(duration >= controller.period, "duration_ms", || {
            format!("{} ms, expected at least one control period of {}", raw.duration_ms, controller.period)
        })?;
        let trace_step = self.trace_step(raw.trace_step_ms, duration, controller.period)?;
        let mut profile = |key: &str, raw: &RawProfile| self.profile(folder, key, raw, &mut inputs);
        let setpoint = profile("profile.setpoint_um", &raw.profile.setpoint_um)?;
        let temperature = profile("profile.temperature_offset_k", &raw.profile.temperature_offset_k)?;
        let force = profile("profile.finger_force_n", &raw.profile.finger_force_n)?;
        let trials = self.trials(&raw.trials)?;
        self.surroundings(&plate, &setpoint, &temperature, &force, &trials)?;
        self.require(!raw.expect.is_empty(), "title", || {
            "no [[expect]], expected at least one: a scenario that expects nothing cannot fail".to_owned()
        })?;
        let expectations = (0..).zip(&raw.expect).map(|(index, expect)| self.expectation(index, expect, duration));
        Ok(Scenario {
            file: file.to_owned(),
            title: raw.title,
            source: raw.source,
            tags: raw.tags,
            tier: self.tier(raw.model.as_deref())?,
            expected_exit: self.expected_exit(raw.expected_exit)?,
            expectations: expectations.collect::<Result<_, _>>()?,
            scene: Scene { temperature_offset_k: temperature, finger_force_n: force },
            inputs,
            plate,
            duration,
            trace_step,
            controller,
            setpoint,
            trials,
        })
    }

    fn plate(&self, path: &Path, inputs: &mut Vec<Input>) -> Result<Plate, Diagnostic> {
        let text = match fs::read_to_string(path) {
            Ok(text) => text,
            Err(error) => {
                return self.refuse("plate", format!("plate file {} cannot be read: {error}", path.display()));
            }
        };
        let raw: RawPlate = toml::from_str(&text).map_err(|error| Diagnostic::of_toml(path, &text, &error))?;
        let plate = raw.check().map_err(|error| Diagnostic::at_key(path, &text, error.key, error.to_string()))?;
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
        let resonance_hz = plate.omega0 / TAU;
        let key = "controller.start_frequency_hz";
        let start_frequency_hz = self.positive(key, raw.start_frequency_hz.unwrap_or(resonance_hz))?;
        let share = start_frequency_hz / resonance_hz;
        self.require((0.5..=1.5).contains(&share), key, || {
            format!("{start_frequency_hz} Hz, expected within half of the plate's resonance at {resonance_hz:.1} Hz")
        })?;
        let optional = |key: &str, value: Option<f64>| value.map(|value| self.positive(key, value)).transpose();
        let range = optional("controller.frequency_range_hz", raw.frequency_range_hz)?;
        let slew = optional("controller.frequency_slew_hz", raw.frequency_slew_hz)?;
        Ok(Controller {
            law: raw.law.clone().unwrap_or_else(|| DEFAULT_LAW.to_owned()),
            period,
            start_frequency_hz,
            loop_delay,
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
        let rows = duration.seconds() / step.seconds();
        self.require(rows <= MOST_ROWS, key, || {
            format!("{} ms over {duration} is {rows:.0} rows, expected at most {MOST_ROWS:.0}", step.ms())
        })?;
        Ok(step)
    }

    fn tier(&self, raw: Option<&str>) -> Result<Tier, Diagnostic> {
        let Some(name) = raw else { return Ok(Tier::default()) };
        match Tier::ALL.into_iter().find(|tier| tier.name() == name) {
            Some(tier) => Ok(tier),
            None => self.refuse(
                "model",
                format!("unknown model `{name}`, expected one of {}", quoted(Tier::ALL.map(Tier::name))),
            ),
        }
    }

    fn expected_exit(&self, raw: Option<i64>) -> Result<Option<u8>, Diagnostic> {
        match raw {
            None => Ok(None),
            Some(code @ (1 | 3)) => Ok(Some(code as u8)),
            Some(code) => self.refuse(
                "expected_exit",
                format!("{code}, expected 1 (something fails) or 3 (something is inconclusive)"),
            ),
        }
    }

    fn profile(
        &self,
        folder: &Path,
        key: &str,
        raw: &RawProfile,
        inputs: &mut Vec<Input>,
    ) -> Result<Profile, Diagnostic> {
        let profile = match raw.check(folder) {
            Ok(profile) => profile,
            Err(error) => return self.refuse(key, error.to_string()),
        };
        if let Some(path) = raw.file(folder) {
            let bytes =
                fs::read(&path).map_err(|error| Diagnostic::of_file(&path, format!("cannot be read: {error}")))?;
            inputs.push(Input { path, bytes });
        }
        Ok(profile)
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

    /// Whether the plate exists under everything that is played to it.
    fn surroundings(
        &self,
        plate: &Plate,
        setpoint: &Profile,
        temperature: &Profile,
        force: &Profile,
        trials: &Trials,
    ) -> Result<(), Diagnostic> {
        let (low, high) = setpoint.range();
        self.require(low >= 0.0 && high <= LARGEST_SETPOINT_UM, "profile.setpoint_um", || {
            format!("setpoints from {low} to {high} µm, expected 0 to {LARGEST_SETPOINT_UM} µm")
        })?;
        let (lightest, heaviest) = force.range();
        self.require(lightest >= 0.0, "profile.finger_force_n", || {
            format!("a force of {lightest} N, expected 0 or more: a finger cannot pull")
        })?;
        // Five deviations beyond the profile: no draw of a trial comes near it.
        let margin = 5.0 * trials.spread.temperature_k;
        let (coldest, hottest) = temperature.range();
        for temperature_offset_k in [coldest - margin, hottest + margin] {
            for finger_force_n in [lightest, heaviest] {
                let mode = plate.mode(&Conditions { temperature_offset_k, finger_force_n });
                self.require(mode.is_resonant(), "profile.temperature_offset_k", || {
                    format!("at {temperature_offset_k} K and {finger_force_n} N the plate has no resonance left")
                })?;
            }
        }
        Ok(())
    }

    fn expectation(&self, index: usize, raw: &RawExpectation, duration: Time) -> Result<Expectation, Diagnostic> {
        let key = |name: &str| format!("expect.{index}.{name}");
        let Some(metric) = Metric::from_name(&raw.metric) else {
            let known = quoted(Metric::ALL.map(Metric::name));
            return self.refuse(&key("metric"), format!("unknown metric `{}`, expected one of {known}", raw.metric));
        };
        for (name, given, used) in [
            ("band_percent", raw.band_percent.is_some(), metric.has_band()),
            ("from_ms", raw.from_ms.is_some(), metric.has_from()),
            ("window_ms", raw.window_ms.is_some(), metric.has_window()),
            ("signal", raw.signal.is_some(), metric.has_signal()),
            (
                "tolerance_percent",
                raw.tolerance_percent.is_some(),
                raw.about.is_some() && metric != Metric::Repeatability,
            ),
        ] {
            self.require(used || !given, &key(name), || {
                format!("`{name}` means nothing to this expectation of {metric}")
            })?;
        }
        self.require(raw.paper.is_none_or(f64::is_finite), &key("paper"), || "expected a finite number".to_owned())?;
        let band_percent = raw.band_percent.unwrap_or(DEFAULT_BAND_PERCENT);
        self.require(band_percent > 0.0 && band_percent < 100.0, &key("band_percent"), || {
            format!("{band_percent} %, expected above 0 and below 100")
        })?;
        let confidence = raw.confidence.unwrap_or(DEFAULT_CONFIDENCE);
        self.require((0.5..1.0).contains(&confidence), &key("confidence"), || {
            format!("{confidence}, expected 0.5 or more and below 1")
        })?;
        let from = raw.from_ms.map(|ms| self.span(&key("from_ms"), ms)).transpose()?;
        self.require(from.is_none_or(|from| from < duration), &key("from_ms"), || {
            format!("{} ms, expected before the scenario's end at {duration}", raw.from_ms.unwrap_or_default())
        })?;
        self.require(from.is_some() || metric != Metric::RecoveryTime, &key("metric"), || {
            format!("{metric} without `from_ms`, expected the instant of the disturbance")
        })?;
        let name = raw.signal.as_deref().unwrap_or("amplitude_um");
        let Some(signal) = SIGNALS.into_iter().find(|signal| *signal == name) else {
            return self
                .refuse(&key("signal"), format!("unknown signal `{name}`, expected one of {}", quoted(SIGNALS)));
        };
        Ok(Expectation {
            metric,
            limit: self.limit(&key, raw)?,
            paper: raw.paper,
            requirement: raw.requirement.clone(),
            confidence,
            band_percent,
            from,
            window: self.window(&key("window_ms"), raw.window_ms, duration)?,
            signal,
        })
    }

    fn limit(&self, key: &impl Fn(&str) -> String, raw: &RawExpectation) -> Result<Limit, Diagnostic> {
        let tolerance_percent = raw.tolerance_percent.unwrap_or(DEFAULT_TOLERANCE_PERCENT);
        self.require(tolerance_percent.is_finite() && tolerance_percent > 0.0, &key("tolerance_percent"), || {
            format!("{tolerance_percent} %, expected a finite number above 0")
        })?;
        let given = [
            ("at_most", raw.at_most.map(Limit::AtMost)),
            ("at_least", raw.at_least.map(Limit::AtLeast)),
            ("within", raw.within.map(|[low, high]| Limit::Within(low, high))),
            ("about", raw.about.map(|value| Limit::About { value, tolerance_percent })),
        ];
        let mut limits = given.into_iter().filter_map(|(name, limit)| limit.map(|limit| (name, limit)));
        let (Some((name, limit)), None) = (limits.next(), limits.next()) else {
            return self.refuse(&key("metric"), "expected exactly one of `at_most`, `at_least`, `within`, `about`");
        };
        let numbers = match limit {
            Limit::AtMost(value) | Limit::AtLeast(value) | Limit::About { value, .. } => [value, value],
            Limit::Within(low, high) => [low, high],
        };
        self.require(numbers.iter().all(|value| value.is_finite()), &key(name), || {
            "expected finite numbers".to_owned()
        })?;
        self.require(numbers[0] <= numbers[1], &key(name), || {
            "expected [low, high] with low not above high".to_owned()
        })?;
        Ok(limit)
    }

    fn window(&self, key: &str, raw: Option<RawWindow>, duration: Time) -> Result<Window, Diagnostic> {
        let window = match raw {
            None => Window { from: Time::from_nanos(duration.as_nanos() / 3 * 2), to: duration },
            Some(RawWindow::Last(ms)) => {
                Window { from: duration - self.span(key, self.positive(key, ms)?)?, to: duration }
            }
            Some(RawWindow::Between([from, to])) => Window { from: self.span(key, from)?, to: self.span(key, to)? },
        };
        self.require(window.from < window.to && window.to <= duration, key, || {
            format!(
                "a window from {} to {}, expected a stretch within the scenario's {duration}",
                window.from, window.to
            )
        })?;
        Ok(window)
    }
}

fn quoted<const N: usize>(names: [&str; N]) -> String {
    names.map(|name| format!("`{name}`")).join(", ")
}
