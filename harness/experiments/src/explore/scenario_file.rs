//! Builds the scenario of a scene with its plates, or of a sequence of messages, checks it, and writes
//! it as files.

use crate::explore::envelope::Envelope;
use crate::explore::limits::ExploredLaw;
use crate::explore::player::ExploreError;
use crate::explore::properties::{Demand, Property, REFERENCE_DIFFERENCE_PERCENT};
use crate::explore::scene::{Course, LineFault, PlateChoice, Relation, Scene, SceneTrial, rounded};
use platebench_model::scenario::load::check_raw;
use platebench_model::scenario::raw::{
    RawBetween, RawController, RawExpectation, RawOtherTrials, RawProfiles, RawScenario, RawTrials,
};
use platebench_model::scenario::{Metric, Scenario, ScenarioMessage};
use platebench_model::trace::{AtPath, FileError, OutputFolder};
use platebench_plate::{
    Plate, RawDrive, RawFinger, RawMode, RawPlate, RawProfile, RawSensor, RawShape, RawSine, Uncertainty,
};
use std::collections::BTreeMap;
use std::f64::consts::TAU;
use std::fmt::Write as _;
use std::io;
use std::path::{Path, PathBuf};

const TRACE_STEP_MS: f64 = 0.1;
/// Trace step of trials that are longer than [`LONG_TRIAL_US`].
const LONG_TRACE_STEP_MS: f64 = 1.0;
const LONG_TRIAL_US: u32 = 20_000_000;
/// Largest difference between two trials that differ only in history or time stamps, µm. This is
/// some tens of times the wire's resolution at the largest setpoints.
pub(crate) const SAME_RESPONSE_UM: f64 = 1e-5;

/// A scenario that no file contains.
#[derive(Debug, Clone)]
pub struct SceneScenario {
    pub scenario: RawScenario,
    /// Plate files by path relative to the scenario.
    pub plates: BTreeMap<PathBuf, RawPlate>,
}

impl SceneScenario {
    pub fn check(self) -> Result<Scenario, ExploreError> {
        check_raw(self.scenario, "scene.toml", &self.plates).map_err(|fault| ExploreError::Generated(Box::new(fault)))
    }

    /// Text of the scenario file, with each line of `comment` as a comment at its head.
    pub fn text(&self, comment: &[String]) -> io::Result<String> {
        let scenario = toml::to_string(&self.scenario).map_err(io::Error::other)?;
        let comment: Vec<String> = comment.iter().map(|line| format!("# {line}\n")).collect();
        Ok(comment.concat() + &scenario)
    }

    /// Writes the files; the scenario is `folder/name.toml`.
    pub fn write(&self, folder: &Path, name: &str, comment: &[String]) -> Result<(), FileError> {
        let folder = OutputFolder::create(folder)?;
        for (file, plate) in &self.plates {
            folder.write(file, toml::to_string(plate).map_err(io::Error::other).at(file)?)?;
        }
        folder.write(format!("{name}.toml"), self.text(comment).at(folder.path())?)
    }
}

pub struct ScenarioBuilder<'a> {
    pub base: &'a Plate,
    pub title: &'a str,
    pub source: &'a str,
    /// Start of the names of plate files.
    pub plate_prefix: &'a str,
}

impl ScenarioBuilder<'_> {
    pub fn build(&self, scene: &Scene, demands: &[Demand]) -> SceneScenario {
        let mut plates = BTreeMap::new();
        let others = scene.relation.map(|relation| self.other_trials(&scene.judged, relation, &mut plates));
        let (first, resonance) = match scene.relation {
            Some(Relation::Delayed) => (&SceneTrial { delay_us: 0, ..scene.judged.clone() }, Resonance::AtStart),
            _ => (&scene.judged, Resonance::OfPlate),
        };
        let trial = &scene.judged;
        let seed = scene.script_seed.map(|seed| i64::try_from(seed).unwrap_or(i64::MAX));
        let default = RawTrials::default();
        let scenario = RawScenario {
            title: self.title.to_owned(),
            source: Some(self.source.to_owned()),
            plate: self.plate_file(first, resonance, &mut plates),
            duration_ms: ms(trial.played_us(scene.relation)),
            tags: vec!["explored".to_owned()],
            trace_step_ms: Some(if trial.duration_us > LONG_TRIAL_US { LONG_TRACE_STEP_MS } else { TRACE_STEP_MS }),
            model: scene.relation.filter(|relation| relation.needs_envelope()).map(|_| "envelope".to_owned()),
            only_if_named: None,
            expected_exit: None,
            timeout_s: None,
            controller: self.controller(first, resonance, &mut plates),
            profile: profiles(trial, 1.0),
            trials: RawTrials { count: scene.count.into(), seed: seed.unwrap_or(default.seed), ..default },
            fault: trial.faults.iter().map(LineFault::raw).collect(),
            between: scene.earlier.iter().map(|earlier| self.between(earlier, &mut plates)).collect(),
            other_trials: others,
            message: Vec::new(),
            expect: expectations(scene, demands),
            matrix: None,
        };
        SceneScenario { scenario, plates }
    }

    fn between(&self, trial: &SceneTrial, plates: &mut BTreeMap<PathBuf, RawPlate>) -> RawBetween {
        RawBetween {
            plate: Some(self.plate_file(trial, Resonance::OfPlate, plates)),
            duration_ms: ms(trial.duration_us),
            controller: self.controller(trial, Resonance::OfPlate, plates),
            profile: profiles(trial, 1.0),
        }
    }

    fn other_trials(
        &self,
        trial: &SceneTrial,
        relation: Relation,
        plates: &mut BTreeMap<PathBuf, RawPlate>,
    ) -> RawOtherTrials {
        let (mut trial, mut resonance) = (trial.clone(), Resonance::OfPlate);
        let (mut factor, mut later_us) = (1.0, 0);
        match relation {
            Relation::Proportional => {
                factor = Relation::FACTOR;
                trial.plate.limit_vpp = (f64::from(trial.plate.limit_vpp) * factor) as u32;
            }
            Relation::Mirrored => resonance = Resonance::Mirrored,
            Relation::Delayed => (resonance, later_us) = (Resonance::AtStart, trial.delay_us),
        }
        RawOtherTrials {
            plate: Some(self.plate_file(&trial, resonance, plates)),
            amplitude_factor: factor,
            later_ms: ms(later_us),
            controller: self.controller(&trial, resonance, plates),
            profile: profiles(&trial, factor),
        }
    }

    fn controller(
        &self,
        trial: &SceneTrial,
        resonance: Resonance,
        plates: &mut BTreeMap<PathBuf, RawPlate>,
    ) -> RawController {
        let design = trial.plate.design();
        let designed = SceneTrial { plate: design, ..trial.clone() };
        let controller = RawController {
            law: Some(trial.law.name().to_owned()),
            period_ms: Some(ms(trial.period_us)),
            start_frequency_hz: Some(f64::from(trial.start_frequency_tenths) / 10.0),
            loop_delay_ms: ms(trial.delay_us),
            design_delay_ms: ms(trial.delay_us),
            design_plate: (trial.plate != design).then(|| self.plate_file(&designed, resonance, plates)),
            ..RawController::default()
        };
        trial.tuning.apply(controller, trial.law, &design.apply(self.base), trial.period_us)
    }

    fn plate_file(
        &self,
        trial: &SceneTrial,
        resonance: Resonance,
        plates: &mut BTreeMap<PathBuf, RawPlate>,
    ) -> PathBuf {
        let choice = trial.plate;
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
        let path = PathBuf::from(name + resonance.suffix() + ".toml");
        let start_hz = f64::from(trial.start_frequency_tenths) / 10.0;
        plates.entry(path.clone()).or_insert_with(|| resonance.apply(raw_plate(&choice.apply(self.base)), start_hz));
        path
    }
}

/// Resonance of a plate relative to the start frequency.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Resonance {
    OfPlate,
    AtStart,
    /// On the other side of the start frequency, also after every change of its own.
    Mirrored,
}

impl Resonance {
    const fn suffix(self) -> &'static str {
        match self {
            Self::OfPlate => "",
            Self::AtStart => "-at-start",
            Self::Mirrored => "-mirrored",
        }
    }

    fn apply(self, mut plate: RawPlate, start_hz: f64) -> RawPlate {
        match self {
            Self::OfPlate => {}
            Self::AtStart => plate.mode.resonance_hz = start_hz,
            Self::Mirrored => {
                plate.mode.resonance_hz = rounded(2.0 * start_hz - plate.mode.resonance_hz, 9);
                plate.mode.resonance_slope_hz_per_k *= -1.0;
                plate.finger.resonance_shift_hz_per_n *= -1.0;
            }
        }
        plate
    }
}

fn raw_plate(plate: &Plate) -> RawPlate {
    // Removes the rounding errors of products.
    let rounded = |value| rounded(value, 9);
    RawPlate {
        mode: RawMode {
            resonance_hz: rounded(plate.omega0 / TAU),
            reference_temperature_c: plate.reference_temperature_c,
            resonance_slope_hz_per_k: rounded(plate.omega0_per_k / TAU),
            time_constant_ms: rounded(1e3 / plate.sigma0),
            gain_um_per_vpp: rounded(plate.gain),
        },
        second_mode: None,
        finger: RawFinger {
            damping_ratio: plate.damping_ratio.clone(),
            resonance_shift_hz_per_n: rounded(plate.omega0_per_n / TAU),
        },
        drive: RawDrive { limit_vpp: plate.drive_limit_vpp, ..RawDrive::default() },
        sensor: RawSensor { noise_um_rms: rounded(plate.noise_um_rms), ..RawSensor::default() },
        heating: None,
        uncertainty: Uncertainty::default(),
        name: plate.name.clone(),
        source: plate.source.clone(),
    }
}

impl Scene {
    pub fn compares_trials(&self) -> bool {
        let SceneTrial { faults, period_us, plate, .. } = &self.judged;
        let stops_alike = !faults.iter().any(|fault| fault.may_stop_differently(*period_us));
        self.count > 1 && self.relation.is_none() && plate.noise_pm == 0 && stops_alike
    }
}

fn ms(us: u32) -> f64 {
    f64::from(us) / 1e3
}

fn profiles(trial: &SceneTrial, factor: f64) -> RawProfiles {
    RawProfiles {
        setpoint_um: profile(&trial.setpoint, |nm| nm / 1e3 * factor),
        temperature_offset_k: profile(&trial.temperature, |value| value / 100.0),
        finger_force_n: profile(&trial.force, |value| value / 100.0),
    }
}

/// `unit` converts a value of the course to the unit of the profile.
fn profile(course: &Course, unit: impl Fn(f64) -> f64) -> RawProfile {
    let value = |value: i32| unit(f64::from(value));
    let points = |points: &[(u32, i32)]| points.iter().map(|(at, level)| [ms(*at), value(*level)]).collect();
    match course {
        Course::Hold(list) if list.len() == 1 => RawProfile::Number(list.first().map_or(0.0, |(_, only)| value(*only))),
        Course::Hold(list) => RawProfile::Shape(RawShape::Hold(points(list))),
        Course::Linear(list) => RawProfile::Shape(RawShape::Linear(points(list))),
        Course::Sine { mean, amplitude, frequency_tenths } => RawProfile::Shape(RawShape::Sine(RawSine {
            mean: value(*mean),
            amplitude: value(*amplitude),
            frequency_hz: f64::from(*frequency_tenths) / 10.0,
            phase_deg: 0.0,
        })),
    }
}

fn expectations(scene: &Scene, demands: &[Demand]) -> Vec<RawExpectation> {
    let mut counts: BTreeMap<Property, u32> = BTreeMap::new();
    let mut expectations: Vec<RawExpectation> = demands
        .iter()
        .filter_map(|demand| {
            let count = counts.entry(demand.property).or_default();
            *count += 1;
            expectation(demand, *count)
        })
        .collect();
    if scene.compares_trials() {
        expectations.push(RawExpectation {
            name: Some(Property::SameResponse.name().to_owned()),
            metric: Metric::TrialDifference.name().to_owned(),
            at_most: Some(SAME_RESPONSE_UM),
            ..RawExpectation::default()
        });
    } else if demands.is_empty() {
        // A scenario needs an expectation, although the protocol rules are checked without one.
        let SceneTrial { faults, period_us, .. } = &scene.judged;
        let planned: u32 = faults.iter().map(|fault| fault.longest_silence(*period_us)).sum();
        expectations.push(RawExpectation {
            name: Some(Property::Protocol.name().to_owned()),
            metric: Metric::MissedReplies.name().to_owned(),
            within: Some([0.0, f64::from(planned)]),
            ..RawExpectation::default()
        });
    }
    expectations
}

fn expectation(demand: &Demand, number: u32) -> Option<RawExpectation> {
    let metric = demand.property.metric()?;
    let window = metric.has_from_ms().then(|| [demand.from_us, demand.until_us].map(ms));
    Some(RawExpectation {
        name: Some(format!("{} {number}", demand.property)),
        metric: metric.name().to_owned(),
        from_ms: window.map(|[from, _]| from),
        until_ms: window.map(|[_, until]| until),
        band_percent: demand.band_percent.filter(|band| *band != 5.0).map(|band| rounded(band, 4)),
        over: (demand.property == Property::StaticError).then(|| "each".to_owned()),
        at_most: Some(rounded(demand.at_most, 4)),
        ..RawExpectation::default()
    })
}

/// Builds the scenario of a sequence. Its trial is as short as possible.
pub(crate) fn sequence_scenario(
    envelope: &Envelope,
    law: ExploredLaw,
    messages: &[ScenarioMessage],
    title: &str,
    plate_prefix: &str,
    compares_reference: bool,
) -> SceneScenario {
    let expect = |property: Property, metric: Metric, at_most| RawExpectation {
        name: Some(property.name().to_owned()),
        metric: metric.name().to_owned(),
        at_most: Some(at_most),
        ..RawExpectation::default()
    };
    let mut expectations = vec![expect(Property::Answers, Metric::ProtocolDifferences, 0.0)];
    if compares_reference {
        let metric = Metric::ReferenceDifference;
        expectations.push(expect(Property::Reference, metric, REFERENCE_DIFFERENCE_PERCENT));
    }
    let plate = PathBuf::from(format!("plates/{plate_prefix}messages.toml"));
    let raw_plate = raw_plate(&envelope.plate);
    let scenario = RawScenario {
        title: title.to_owned(),
        source: Some("platebench suite explore; the rules: docs/wire-protocol.md".to_owned()),
        plate: plate.clone(),
        duration_ms: 1.0,
        tags: vec!["explored".to_owned()],
        trace_step_ms: None,
        model: None,
        only_if_named: None,
        expected_exit: None,
        timeout_s: None,
        controller: RawController { law: Some(law.name().to_owned()), ..RawController::default() },
        profile: RawProfiles {
            setpoint_um: RawProfile::Number(2.0),
            temperature_offset_k: RawProfile::Number(0.0),
            finger_force_n: RawProfile::Number(0.0),
        },
        trials: RawTrials::default(),
        fault: Vec::new(),
        between: Vec::new(),
        other_trials: None,
        message: messages.to_vec(),
        expect: expectations,
        matrix: None,
    };
    SceneScenario { scenario, plates: BTreeMap::from([(plate, raw_plate)]) }
}
