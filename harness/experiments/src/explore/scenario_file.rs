//! Writes a scene as a scenario file with its plate files.

use crate::explore::properties::{Demand, Property};
use crate::explore::scene::{Course, PlateChoice, Scene, SceneTrial};
use crate::explore::tuning::rounded;
use platebench_plate::Plate;
use std::collections::BTreeMap;
use std::f64::consts::TAU;
use std::fmt::Write as _;
use std::path::Path;
use std::{fs, io};

const TRACE_STEP_MS: f64 = 0.1;
/// Largest difference between two trials that differ only in history or time stamps, µm. This is
/// some tens of times the wire's resolution at the largest setpoints.
pub(crate) const SAME_RESPONSE_UM: f64 = 1e-5;

#[derive(Debug, Clone, PartialEq)]
pub struct ScenarioText {
    pub scenario: String,
    /// Text of each plate file, by its path relative to the scenario.
    pub plates: BTreeMap<String, String>,
}

impl ScenarioText {
    /// Writes the files; the scenario is `folder/name.toml`.
    pub fn write(&self, folder: &Path, name: &str) -> io::Result<()> {
        for (file, text) in &self.plates {
            let path = folder.join(file);
            if let Some(parent) = path.parent() {
                fs::create_dir_all(parent)?;
            }
            fs::write(path, text)?;
        }
        fs::write(folder.join(format!("{name}.toml")), &self.scenario)
    }
}

pub struct ScenarioWriter<'a> {
    pub base: &'a Plate,
    pub title: &'a str,
    pub source: &'a str,
    pub comment: &'a [String],
    /// Start of the names of plate files.
    pub plate_prefix: &'a str,
}

impl ScenarioWriter<'_> {
    pub fn text(&self, scene: &Scene, demands: &[Demand]) -> ScenarioText {
        let mut plates = BTreeMap::new();
        let mut text = String::new();
        for line in self.comment {
            let _ = writeln!(text, "# {line}");
        }
        let _ = self.write_scenario(&mut text, scene, demands, &mut plates);
        ScenarioText { scenario: text, plates }
    }

    fn write_scenario(
        &self,
        text: &mut String,
        scene: &Scene,
        demands: &[Demand],
        plates: &mut BTreeMap<String, String>,
    ) -> std::fmt::Result {
        let trial = &scene.judged;
        writeln!(text, "title = {:?}", self.title)?;
        writeln!(text, "source = {:?}", self.source)?;
        writeln!(text, "plate = {:?}", self.plate_file(trial.plate, plates))?;
        writeln!(text, "duration_ms = {:?}", ms(trial.duration_us))?;
        writeln!(text, "trace_step_ms = {TRACE_STEP_MS:?}")?;
        writeln!(text, "tags = [\"explored\"]\n\n[controller]")?;
        for (key, value) in self.controller(trial, plates) {
            writeln!(text, "{key} = {value}")?;
        }
        writeln!(text, "\n[profile]")?;
        for (key, value) in profile(trial) {
            writeln!(text, "{key} = {value}")?;
        }
        writeln!(text, "\n[trials]\ncount = {}", scene.count)?;
        if let Some(seed) = scene.script_seed {
            writeln!(text, "seed = {seed}")?;
        }
        for earlier in &scene.earlier {
            writeln!(text, "\n[[between]]\nduration_ms = {:?}", ms(earlier.duration_us))?;
            writeln!(text, "plate = {:?}", self.plate_file(earlier.plate, plates))?;
            let controller = self.controller(earlier, plates);
            for (table, keys) in [("controller", controller), ("profile", profile(earlier))] {
                let keys: Vec<_> = keys.into_iter().map(|(key, value)| format!("{key} = {value}")).collect();
                writeln!(text, "{table} = {{ {} }}", keys.join(", "))?;
            }
        }
        for fault in &trial.faults {
            fault.write(text)?;
        }
        let mut counts: BTreeMap<Property, u32> = BTreeMap::new();
        for demand in demands {
            let count = counts.entry(demand.property).or_default();
            *count += 1;
            write_demand(text, demand, *count)?;
        }
        if scene.compares_trials() {
            let name = Property::SameResponse.name();
            writeln!(text, "\n[[expect]]\nname = {name:?}\nmetric = \"trial_difference_um\"")?;
            writeln!(text, "at_most = {SAME_RESPONSE_UM:?}")?;
        } else if demands.is_empty() {
            // A scenario needs an expectation, although the protocol rules are checked without one.
            writeln!(text, "\n[[expect]]\nname = {:?}", Property::Protocol.name())?;
            let planned: u32 = trial.faults.iter().map(|fault| fault.longest_silence(trial.period_us)).sum();
            writeln!(text, "metric = \"missed_replies\"\nwithin = [0.0, {:?}]", f64::from(planned))?;
        }
        Ok(())
    }

    fn controller(&self, trial: &SceneTrial, plates: &mut BTreeMap<String, String>) -> Vec<(&'static str, String)> {
        let mut keys = vec![
            ("law", format!("{:?}", trial.law.name())),
            ("period_ms", format!("{:?}", ms(trial.period_us))),
            ("start_frequency_hz", format!("{:?}", f64::from(trial.start_frequency_tenths) / 10.0)),
        ];
        if trial.delay_us > 0 {
            keys.push(("loop_delay_ms", format!("{:?}", ms(trial.delay_us))));
            keys.push(("design_delay_ms", format!("{:?}", ms(trial.delay_us))));
        }
        if trial.plate != trial.plate.design() {
            keys.push(("design_plate", format!("{:?}", self.plate_file(trial.plate.design(), plates))));
        }
        let design = trial.plate.design().apply(self.base);
        keys.extend(trial.tuning.keys(trial.law, &design, trial.period_us));
        keys
    }

    fn plate_file(&self, choice: PlateChoice, plates: &mut BTreeMap<String, String>) -> String {
        let PlateChoice { limit_vpp, noise_pm, gain_permille, time_constant_permille, .. } = choice;
        let mut name = format!("plates/{}{limit_vpp}vpp", self.plate_prefix);
        for (value, unit) in [
            (i64::from(choice.nominal_gain_permille), "k1"),
            (choice.nominal_time_constant_permille.into(), "tau1"),
            (noise_pm.into(), "pm"),
            (gain_permille.into(), "gain"),
            (time_constant_permille.into(), "tau"),
        ] {
            if value != 0 {
                let _ = write!(name, "-{value}{unit}");
            }
        }
        name.push_str(".toml");
        plates.entry(name.clone()).or_insert_with(|| self.plate_text(choice));
        name
    }

    fn plate_text(&self, choice: PlateChoice) -> String {
        let plate = choice.apply(self.base);
        // Removes the rounding errors of products.
        let rounded = |value| rounded(value, 9);
        let time_constant_ms = rounded(1e3 / plate.sigma0);
        let curve: Vec<_> =
            plate.damping_ratio.iter().map(|[force, ratio]| format!("[{force:?}, {ratio:?}]")).collect();
        // The escapes of `{:?}` are not those of TOML.
        let [name, source] = [&plate.name, &plate.source].map(|text| toml::Value::from(text.as_str()));
        format!(
            "name = {name}\nsource = {source}\n\n[mode]\nresonance_hz = {:?}\nreference_temperature_c = {:?}\n\
             resonance_slope_hz_per_k = {:?}\ntime_constant_ms = {time_constant_ms:?}\ngain_um_per_vpp = {:?}\n\n\
             [finger]\ndamping_ratio = [{}]\nresonance_shift_hz_per_n = {:?}\n\n[drive]\nlimit_vpp = {:?}\n\n\
             [sensor]\nnoise_um_rms = {:?}\n",
            rounded(plate.omega0 / TAU),
            plate.reference_temperature_c,
            rounded(plate.omega0_per_k / TAU),
            rounded(plate.gain),
            curve.join(", "),
            rounded(plate.omega0_per_n / TAU),
            plate.drive_limit_vpp,
            rounded(plate.noise_um_rms),
        )
    }
}

impl Scene {
    pub fn compares_trials(&self) -> bool {
        let SceneTrial { faults, period_us, plate, .. } = &self.judged;
        let stops_alike = !faults.iter().any(|fault| fault.may_stop_differently(*period_us));
        self.count > 1 && plate.noise_pm == 0 && stops_alike
    }
}

fn ms(us: u32) -> f64 {
    f64::from(us) / 1e3
}

fn points<T: Copy>(points: &[(u32, T)], value: impl Fn(T) -> f64) -> String {
    let points: Vec<_> = points.iter().map(|(at, level)| format!("[{:?}, {:?}]", ms(*at), value(*level))).collect();
    format!("[{}]", points.join(", "))
}

fn course(course: &Course) -> String {
    let hundredths = |value: i32| f64::from(value) / 100.0;
    match course {
        Course::Hold(list) if list.len() == 1 => list.first().map_or(0.0, |(_, value)| hundredths(*value)).to_string(),
        Course::Hold(list) => format!("{{ hold = {} }}", points(list, hundredths)),
        Course::Linear(list) => format!("{{ linear = {} }}", points(list, hundredths)),
        Course::Sine { mean, amplitude, frequency_tenths } => format!(
            "{{ sine = {{ mean = {:?}, amplitude = {:?}, frequency_hz = {:?} }} }}",
            hundredths(*mean),
            hundredths(*amplitude),
            f64::from(*frequency_tenths) / 10.0
        ),
    }
}

fn profile(trial: &SceneTrial) -> Vec<(&'static str, String)> {
    let mut keys = vec![("setpoint_um", format!("{{ hold = {} }}", points(&trial.setpoint, |nm| f64::from(nm) / 1e3)))];
    let is_constant_zero = |course: &Course| matches!(course, Course::Hold(list) if list[..] == [(0, 0)]);
    for (key, values) in [("temperature_offset_k", &trial.temperature), ("finger_force_n", &trial.force)] {
        if !is_constant_zero(values) {
            keys.push((key, course(values)));
        }
    }
    keys
}

fn write_demand(text: &mut String, demand: &Demand, number: u32) -> std::fmt::Result {
    let Some(metric) = demand.property.metric() else { return Ok(()) };
    writeln!(text, "\n[[expect]]\nname = \"{} {number}\"\nmetric = \"{metric}\"", demand.property)?;
    if metric.has_from_ms() {
        writeln!(text, "from_ms = {:?}\nuntil_ms = {:?}", ms(demand.from_us), ms(demand.until_us))?;
    }
    if let Some(band) = demand.band_percent
        && band != 5.0
    {
        writeln!(text, "band_percent = {:?}", rounded(band, 4))?;
    }
    if demand.property == Property::StaticError {
        writeln!(text, "over = \"each\"")?;
    }
    writeln!(text, "at_most = {:?}", rounded(demand.at_most, 4))
}
