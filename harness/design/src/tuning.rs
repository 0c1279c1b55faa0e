//! Tunes gains by equation 24 of the paper, evaluates them on other plates, and finds why a target
//! is infeasible.
//!
//! The search varies the response time of equation 24 until the plate meets the target. Equation 24
//! ignores the length of the period, the ripple of the fast mode, the delay and the drive limit.
//! The response is not smooth in the design. Therefore designs with logarithmically spaced response
//! times are simulated.

pub mod design;
pub mod verification;

use crate::loops::{Discretisation, LoopError, Margins};
use design::{BAND, GainDesign, LoopEvaluation, StepEvaluation, TuningTarget, delay_margin_ms, design_delay_boundary};
use platebench_document::format::with_decimals;
use platebench_document::{Block, Column, Document, Table};
use platebench_engine::delay_boundary::DelayBoundary;
use platebench_plate::{Model, Plate};
use platebench_verdict::statistics::try_bisect;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, Uniform};
use schemars::JsonSchema;
use serde::Serialize;

pub use design::{DesignEvaluation, evaluate_design};

#[derive(Debug, Clone, Copy, PartialEq, Serialize, JsonSchema)]
#[serde(rename_all = "kebab-case", tag = "kind")]
pub enum InfeasibilityCause {
    /// The drive limit cannot hold the setpoint.
    OutOfReach { needed_vpp: f64 },
    /// The drive limit does not allow the response time.
    DriveFloor { floor_ms: f64, needed_vpp: f64 },
    /// The response time ends before the first command with feedback acts.
    Period { first_feedback_ms: f64 },
    /// Equation 24 for the target's response time is unstable at the target's delay.
    Delay {
        /// Longest stable delay. 0 if the loop is unstable without delay.
        boundary_ms: f64,
    },
    /// Only designs with less phase margin meet the target.
    PhaseMargin {
        /// Phase margin of the design that otherwise meets the target, degrees.
        found_deg: f64,
    },
    /// No design of this discretisation is fast enough at this period and delay.
    Discretisation,
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct TuningResult {
    pub met: bool,
    pub obstacles: Vec<InfeasibilityCause>,
    /// Shortest time into the band with the drive limit. `None` if the setpoint is out of reach.
    pub floor_ms: Option<f64>,
    /// Equation 24 for the target's response time, in each discretisation.
    pub readings: Vec<DesignEvaluation>,
    pub chosen: Option<DesignEvaluation>,
    /// The fastest design with the target's phase margin, if no design meets the target.
    pub possible: Option<DesignEvaluation>,
    /// The chosen design on other plates, or the possible design if none is chosen.
    pub sensitivity: Option<DesignSensitivity>,
}

pub fn tune(
    target: &TuningTarget<'_>,
    discretisation: Discretisation,
    spread: &PlateSpread,
) -> Result<TuningResult, LoopError> {
    let printed = |discretisation| evaluate_design(target, GainDesign::new(target, discretisation, target.response));
    let readings = Discretisation::ALL.into_iter().map(printed).collect::<Result<Vec<_>, _>>()?;
    let search = DesignSearch::new(target, discretisation);
    // If the drive limit cannot hold the setpoint, a response inside the band does not count.
    let holds = target.mode().drive_for(target.setpoint) <= target.plate.drive_limit_vpp;
    let meeting = if holds { search.meeting_target(target.phase_margin_deg)? } else { None };
    let chosen = meeting.map(|candidate| evaluate_design(target, candidate.design)).transpose()?;
    let (mut obstacles, mut possible) = (Vec::new(), None);
    if chosen.is_none() {
        obstacles = infeasibility_causes(target, discretisation, &search)?;
        let fastest = if holds { search.fastest(target.phase_margin_deg)? } else { None };
        possible = fastest.map(|candidate| evaluate_design(target, candidate.design)).transpose()?;
    }
    let design = chosen.as_ref().or(possible.as_ref());
    let sensitivity = design.map(|figures| evaluate_sensitivity(target, &figures.design, spread)).transpose()?;
    let floor_ms = target.time_floor().map(|seconds| seconds * 1e3);
    Ok(TuningResult { met: chosen.is_some(), obstacles, floor_ms, readings, chosen, possible, sensitivity })
}

fn infeasibility_causes(
    target: &TuningTarget<'_>,
    discretisation: Discretisation,
    search: &DesignSearch<'_>,
) -> Result<Vec<InfeasibilityCause>, LoopError> {
    let mode = target.mode();
    let mut causes = Vec::new();
    let needed = |seconds: f64| 0.95 * mode.drive_for(target.setpoint) / (1.0 - (-mode.sigma * seconds).exp());
    let holds = mode.drive_for(target.setpoint);
    if holds > target.plate.drive_limit_vpp {
        causes.push(InfeasibilityCause::OutOfReach { needed_vpp: holds });
    } else if let Some(floor) = target.time_floor().filter(|floor| *floor > target.response) {
        causes.push(InfeasibilityCause::DriveFloor { floor_ms: floor * 1e3, needed_vpp: needed(target.response) });
    }
    let feedback = target.period() + target.delay;
    if target.response < feedback {
        causes.push(InfeasibilityCause::Period { first_feedback_ms: feedback * 1e3 });
    }
    let itself = GainDesign::new(target, discretisation, target.response);
    let bears = design_delay_boundary(target, target.plate, &itself)?;
    if let DelayBoundary::Unstable | DelayBoundary::At(_) = bears {
        let boundary = bears.seconds().unwrap_or(0.0);
        if boundary <= target.delay {
            causes.push(InfeasibilityCause::Delay { boundary_ms: boundary * 1e3 });
        }
    }
    if let Some(stable) = search.meeting_target(0.0)? {
        let closed = stable.design.closed_loop(target, target.plate, Model::Modal, [true; 2])?;
        causes.push(InfeasibilityCause::PhaseMargin { found_deg: closed.margins(None).phase_deg.unwrap_or(180.0) });
    }
    if causes.is_empty() {
        causes.push(InfeasibilityCause::Discretisation);
    }
    Ok(causes)
}

const DESIGNS: u32 = 160;
const REFINEMENT: u32 = 24;
/// Response time of the fastest design, in periods. After one period its error is e^(−15).
const FASTEST_RESPONSE_PERIODS: f64 = 0.2;
/// Slowest response time of a design, relative to the longer one of plate and target. It is at
/// least [`SLOWEST_RESPONSE_PERIODS`] times (period + delay).
const SLOWEST_RESPONSE_FACTOR: f64 = 3.0;
const SLOWEST_RESPONSE_PERIODS: f64 = 30.0;
const BISECTIONS: u32 = 20;
/// Safety factors of the response time: a marginal design misses the target on other plates.
const SAFETY_FACTORS: [f64; 3] = [0.97, 0.99, 1.0];

/// A design with an overshoot between this share of the band and the whole band is rejected,
/// because it leaves the band on other plates.
const MAX_OVERSHOOT_BAND_SHARE: f64 = 0.8;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DesignCandidate {
    pub design: GainDesign,
    pub settling: f64,
}

#[derive(Debug, Clone)]
pub struct DesignSearch<'a> {
    target: TuningTarget<'a>,
    discretisation: Discretisation,
    candidates: Vec<(f64, Option<DesignCandidate>)>,
}

impl<'a> DesignSearch<'a> {
    pub fn new(target: &TuningTarget<'a>, discretisation: Discretisation) -> Self {
        let first = FASTEST_RESPONSE_PERIODS * target.period();
        let own = 20.0_f64.ln() / target.mode().sigma;
        let last = (SLOWEST_RESPONSE_FACTOR * own.max(target.response))
            .max(SLOWEST_RESPONSE_PERIODS * (target.period() + target.delay));
        let mut search = Self { target: *target, discretisation, candidates: Vec::new() };
        let ratio = (last / first).ln() / f64::from(DESIGNS);
        let responses = (0..=DESIGNS).map(|number| first * (ratio * f64::from(number)).exp());
        search.candidates = responses.map(|response| (response, search.evaluate(response))).collect();
        search
    }

    /// `None` if the design does not settle or its overshoot almost fills the band.
    fn evaluate(&self, response: f64) -> Option<DesignCandidate> {
        let design = GainDesign::new(&self.target, self.discretisation, response);
        let transient = design.simulate_step(&self.target, self.target.plate);
        let by_a_hair = (MAX_OVERSHOOT_BAND_SHARE * BAND..=BAND).contains(&transient.overshoot);
        Some(DesignCandidate { design, settling: transient.settling.filter(|_| !by_a_hair)? })
    }

    fn has_margin(&self, candidate: &DesignCandidate, phase_deg: f64) -> Result<bool, LoopError> {
        let closed = candidate.design.closed_loop(&self.target, self.target.plate, Model::Modal, [true; 2])?;
        Ok(closed.spectral_radius()? < 1.0 && closed.margins(None).phase_deg.is_none_or(|found| found >= phase_deg))
    }

    pub fn fastest(&self, phase_deg: f64) -> Result<Option<DesignCandidate>, LoopError> {
        let settled = self.candidates.iter().enumerate();
        let mut ranked: Vec<(usize, DesignCandidate)> =
            settled.filter_map(|(number, (_, played))| Some((number, (*played)?))).collect();
        ranked.sort_by(|(_, a), (_, b)| a.settling.total_cmp(&b.settling));
        for (number, coarse) in ranked {
            if !self.has_margin(&coarse, phase_deg)? {
                continue;
            }
            let at = |number: usize| self.candidates.get(number).map(|(response, _)| *response);
            let low = number.checked_sub(1).and_then(at).unwrap_or(coarse.design.response);
            let high = at(number + 1).unwrap_or(coarse.design.response);
            let between = (1..REFINEMENT).map(|part| low + (high - low) * f64::from(part) / f64::from(REFINEMENT));
            let mut finer: Vec<_> = between.filter_map(|response| self.evaluate(response)).collect();
            finer.retain(|candidate| candidate.settling < coarse.settling);
            finer.sort_by(|a, b| a.settling.total_cmp(&b.settling));
            for candidate in finer {
                if self.has_margin(&candidate, phase_deg)? {
                    return Ok(Some(candidate));
                }
            }
            return Ok(Some(coarse));
        }
        Ok(None)
    }

    /// The design for the target's response time, if it meets the target. Otherwise the slowest
    /// design that does, with a safety factor.
    pub fn meeting_target(&self, phase_deg: f64) -> Result<Option<DesignCandidate>, LoopError> {
        let meets = |response: f64| -> Result<Option<DesignCandidate>, LoopError> {
            match self.evaluate(response).filter(|candidate| candidate.settling <= self.target.response) {
                Some(candidate) => Ok(self.has_margin(&candidate, phase_deg)?.then_some(candidate)),
                None => Ok(None),
            }
        };
        if let Some(itself) = meets(self.target.response)? {
            return Ok(Some(itself));
        }
        let mut slower = None;
        for (response, played) in self.candidates.iter().rev() {
            let in_time = played.is_some_and(|candidate| candidate.settling <= self.target.response);
            if !in_time || meets(*response)?.is_none() {
                slower = Some(*response);
                continue;
            }
            let is_met = |response| meets(response).map(|candidate| candidate.is_some());
            let [low, _] = try_bisect([*response, slower.unwrap_or(*response)], BISECTIONS, is_met)?;
            for inside in SAFETY_FACTORS {
                if let Some(candidate) = meets(inside * low)? {
                    return Ok(Some(candidate));
                }
            }
        }
        Ok(None)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, JsonSchema)]
pub struct PlateSpread {
    /// Largest deviation of the plate's gain K1.
    pub gain_percent: f64,
    pub time_constant_percent: f64,
    /// Number of random plates, uniform between the corners.
    pub samples: u32,
    pub seed: u64,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, JsonSchema)]
pub struct PlateVariant {
    /// Deviation of the gain K1 from the plate file.
    pub gain_percent: f64,
    pub time_constant_percent: f64,
    pub force_n: f64,
    /// Step response with the drive limit.
    pub plate: StepEvaluation,
    /// The smaller margins of both loops, each with the other loop closed.
    #[serde(flatten)]
    pub margins: Margins,
}

/// `settling_ms` is `None` if a plate does not settle. A margin is `None` if no plate limits it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, JsonSchema)]
pub struct WorstCase {
    pub plates: usize,
    pub meeting: usize,
    pub settling_ms: Option<f64>,
    pub overshoot_percent: f64,
    #[serde(flatten)]
    pub margins: Margins,
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct DesignSensitivity {
    pub corners: Vec<PlateVariant>,
    pub worst_corner: WorstCase,
    pub worst_sample: Option<WorstCase>,
    /// The nominal plate without the design's finger, or under 2 N if the design has no finger.
    /// `None` if the plate file has no `[finger]`, because a force then changes nothing.
    pub other_finger: Option<PlateVariant>,
}

/// Unexpected finger for a design without a finger, N (Fig. 16 of the paper).
const FINGER: f64 = 2.0;

pub fn evaluate_sensitivity(
    target: &TuningTarget<'_>,
    design: &GainDesign,
    spread: &PlateSpread,
) -> Result<DesignSensitivity, LoopError> {
    let PlateSpread { gain_percent, time_constant_percent, samples, seed } = *spread;
    let shares = [-1.0, 0.0, 1.0];
    let pairs = shares.into_iter().flat_map(|gain| shares.map(|tau| [gain, tau]));
    let at =
        |[gain, tau]: [f64; 2]| evaluate_variant(target, design, [gain * gain_percent, tau * time_constant_percent]);
    let corners = pairs.filter(|pair| *pair != [0.0; 2]).map(at).collect::<Result<Vec<_>, _>>()?;
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let even = Uniform::new_inclusive(-1.0, 1.0).map_err(|_| LoopError::NotFinite)?;
    let drawn = (0..samples).map(|_| at([even.sample(&mut random), even.sample(&mut random)]));
    let drawn = drawn.collect::<Result<Vec<_>, _>>()?;
    let force_n = if target.force_n > 0.0 { 0.0 } else { FINGER };
    Ok(DesignSensitivity {
        worst_corner: worst_case(target, &corners),
        worst_sample: (!drawn.is_empty()).then(|| worst_case(target, &drawn)),
        corners,
        other_finger: target
            .plate
            .depends_on_force()
            .then(|| evaluate_variant(&TuningTarget { force_n, ..*target }, design, [0.0; 2]))
            .transpose()?,
    })
}

fn evaluate_variant(
    target: &TuningTarget<'_>,
    design: &GainDesign,
    [gain, tau]: [f64; 2],
) -> Result<PlateVariant, LoopError> {
    let nominal = target.plate;
    let factor = |percent: f64| 1.0 + percent / 100.0;
    let plate = Plate { gain: nominal.gain * factor(gain), sigma0: nominal.sigma0 / factor(tau), ..nominal.clone() };
    let delay_ms = delay_margin_ms(target, design_delay_boundary(target, &plate, design)?);
    Ok(PlateVariant {
        gain_percent: gain,
        time_constant_percent: tau,
        force_n: target.force_n,
        plate: design.simulate_step(target, &plate).into(),
        margins: design.closed_loop(target, &plate, Model::Modal, [true; 2])?.margins(delay_ms),
    })
}

fn worst_case(target: &TuningTarget<'_>, others: &[PlateVariant]) -> WorstCase {
    let settling = || others.iter().map(|other| other.plate.settling_ms);
    let smallest = |of: fn(&PlateVariant) -> Option<f64>| others.iter().filter_map(of).reduce(f64::min);
    WorstCase {
        plates: others.len(),
        meeting: settling().flatten().filter(|ms| *ms <= target.response * 1e3).count(),
        settling_ms: settling().try_fold(0.0, |longest: f64, ms| Some(longest.max(ms?))),
        overshoot_percent: others.iter().map(|other| other.plate.overshoot_percent).fold(0.0, f64::max),
        margins: Margins {
            gain: smallest(|other| other.margins.gain),
            phase_deg: smallest(|other| other.margins.phase_deg),
            delay_ms: smallest(|other| other.margins.delay_ms),
        },
    }
}

/// `spread` is the plate spread with which the sensitivity in `tuning` was computed.
pub fn document(target: &TuningTarget<'_>, spread: &PlateSpread, tuning: &TuningResult) -> Document {
    let mut blocks = vec![
        Block::lines(target_lines(target, tuning)),
        Block::heading("Equation 24 for the target response time"),
        Block::Table(readings_table(&tuning.readings)),
    ];
    match (&tuning.chosen, &tuning.possible) {
        (Some(chosen), _) => blocks.extend(design_blocks("The target is met", chosen)),
        (None, possible) => {
            blocks.push(Block::heading("The target cannot be met"));
            blocks.push(Block::lines(tuning.obstacles.iter().map(|cause| format_cause(target, cause))));
            match possible {
                Some(possible) => blocks.extend(design_blocks("Fastest possible design", possible)),
                None => {
                    blocks.push(Block::paragraph("No design of this discretisation settles with this phase margin."));
                }
            }
        }
    }
    blocks.extend(tuning.sensitivity.iter().flat_map(|sensitivity| sensitivity_blocks(spread, sensitivity)));
    Document::new(format!("Gains for {}", target.plate.name), blocks)
}

fn target_lines(target: &TuningTarget<'_>, tuning: &TuningResult) -> [String; 3] {
    let TuningTarget { plate, force_n, setpoint, response, delay, phase_margin_deg, .. } = target;
    let floor = tuning.floor_ms.map_or_else(
        || "the band cannot be reached".to_owned(),
        |floor| format!("the band is reached after {floor:.3} ms at the earliest"),
    );
    [
        plate.name.clone(),
        format!(
            "Target: {setpoint} µm within 5 % in {} ms at {force_n} N; period {} ms, delay {} ms, phase margin \
             {phase_margin_deg}°",
            without_rounding_noise(response * 1e3),
            without_rounding_noise(target.period() * 1e3),
            without_rounding_noise(delay * 1e3),
        ),
        format!(
            "Drive: {:.0} Vpp hold the setpoint; with the limit of {} Vpp {floor}",
            target.mode().drive_for(*setpoint),
            plate.drive_limit_vpp,
        ),
    ]
}

fn without_rounding_noise(ms: f64) -> f64 {
    (ms * 1e6).round() / 1e6
}

fn readings_table(readings: &[DesignEvaluation]) -> Table {
    let mut table = Table::new([
        Column::from("discretisation"),
        Column::number("linear loop, no limit: settling", "ms"),
        Column::number("overshoot", "%"),
        Column::number("drive", "Vpp"),
        Column::number("|W| of the plate: settling", "ms"),
        Column::number("overshoot", "%"),
        Column::number("drive", "Vpp"),
        Column::number("radius", ""),
        Column::number("phase margin", "°"),
        Column::number("delay margin", "ms"),
    ]);
    for row in readings {
        let step = |&StepEvaluation { settling_ms, overshoot_percent, peak_drive_vpp }: &StepEvaluation| {
            let settling = settling_ms.map_or_else(|| "never".to_owned(), |ms| format!("{ms:.3}"));
            let finite = |value: f64, decimals| with_decimals((overshoot_percent <= 999.0).then_some(value), decimals);
            [settling, finite(overshoot_percent, 1), finite(peak_drive_vpp, 0)]
        };
        let margins = [
            format!("{:.3}", row.spectral_radius),
            with_decimals(row.amplitude.margins.phase_deg, 1),
            with_decimals(row.amplitude.margins.delay_ms, 3),
        ];
        let steps = step(&row.linear).into_iter().chain(step(&row.plate));
        table.push([row.discretisation.name().to_owned()].into_iter().chain(steps).chain(margins));
    }
    table
}

fn design_blocks(title: &str, design: &DesignEvaluation) -> [Block; 3] {
    let predicted = format!(
        "predicted: settling {} ms, overshoot {:.1} %, peak drive {:.0} Vpp, {} periods at the limit; linear loop {} ms",
        with_decimals(design.plate.settling_ms, 3),
        design.plate.overshoot_percent,
        design.plate.peak_drive_vpp,
        design.saturated_periods,
        with_decimals(design.linear.settling_ms, 3),
    );
    let mut table = Table::new([
        Column::from("loop"),
        Column::number("kp", ""),
        Column::from("unit"),
        Column::number("ki", "unit/s"),
        Column::from("poles"),
        Column::number("gain margin", ""),
        Column::number("phase margin", "°"),
        Column::number("delay margin", "ms"),
    ]);
    for (name, unit, figures) in [("amplitude", "Vpp/µm", &design.amplitude), ("frequency", "rad/s", &design.frequency)]
    {
        let LoopEvaluation { kp, ki_per_s, poles, margins, .. } = figures;
        let poles: Vec<_> = poles.iter().map(|[re, im]| format_pole(*re, *im)).collect();
        table.push([
            name.to_owned(),
            format!("{kp:.6}"),
            unit.to_owned(),
            format!("{ki_per_s:.6}"),
            poles.join(", "),
            with_decimals(margins.gain, 2),
            with_decimals(margins.phase_deg, 1),
            with_decimals(margins.delay_ms, 3),
        ]);
    }
    let (name, response) = (design.discretisation.name(), design.designed_for_ms);
    let heading = format!("{title}: {name}, designed for {response:.3} ms");
    [Block::Heading(heading), Block::lines([predicted]), Block::Table(table)]
}

fn format_pole(re: f64, im: f64) -> String {
    if im == 0.0 { format!("{re:.4}") } else { format!("{re:.4}{im:+.4}j") }
}

fn sensitivity_blocks(spread: &PlateSpread, found: &DesignSensitivity) -> Vec<Block> {
    let PlateSpread { gain_percent, time_constant_percent, .. } = spread;
    let mut table = Table::new([
        Column::from("plate"),
        Column::number("settling", "ms"),
        Column::number("overshoot", "%"),
        Column::number("gain margin", ""),
        Column::number("phase margin", "°"),
        Column::number("delay margin", "ms"),
        Column::number("in time", ""),
    ]);
    let mut row = |name: String, settling_ms: Option<f64>, overshoot: f64, margins: Margins, in_time: String| {
        let Margins { gain, phase_deg, delay_ms } = margins;
        let numbers = [(settling_ms, 3), (Some(overshoot), 1), (gain, 2), (phase_deg, 1), (delay_ms, 3)];
        let numbers = numbers.map(|(value, decimals)| with_decimals(value, decimals));
        table.push([name].into_iter().chain(numbers).chain([in_time]));
    };
    let cases = [("worst corner", Some(&found.worst_corner)), ("worst random plate", found.worst_sample.as_ref())];
    for (name, worst) in cases.into_iter().filter_map(|(name, worst)| Some((name, worst?))) {
        let &WorstCase { plates, meeting, settling_ms, overshoot_percent, margins } = worst;
        row(name.to_owned(), settling_ms, overshoot_percent, margins, format!("{meeting}/{plates}"));
    }
    if let Some(PlateVariant { force_n, plate, margins, .. }) = found.other_finger {
        let name = format!("finger of {force_n} N instead");
        row(name, plate.settling_ms, plate.overshoot_percent, margins, String::new());
    }
    let heading = format!("These gains on other plates, K1 ±{gain_percent} %, τ ±{time_constant_percent} %");
    let mut blocks = vec![Block::Heading(heading), Block::Table(table)];
    if found.other_finger.is_none() {
        blocks.push(Block::paragraph("finger: the plate file has no [finger], so a force changes nothing"));
    }
    blocks
}

/// Reason why the target cannot be met. Empty if it is met.
pub fn infeasibility_reason(target: &TuningTarget<'_>, tuning: &TuningResult) -> String {
    let causes: Vec<_> = tuning.obstacles.iter().map(|cause| format_cause(target, cause)).collect();
    causes.join("; ")
}

fn format_cause(target: &TuningTarget<'_>, obstacle: &InfeasibilityCause) -> String {
    let limit = target.plate.drive_limit_vpp;
    match obstacle {
        InfeasibilityCause::OutOfReach { needed_vpp } => {
            format!("drive: the setpoint needs {needed_vpp:.0} Vpp, the limit is {limit} Vpp")
        }
        InfeasibilityCause::DriveFloor { floor_ms, needed_vpp } => format!(
            "drive: with {limit} Vpp the band is reached after {floor_ms:.3} ms at the earliest; \
             the target needs {needed_vpp:.1} Vpp"
        ),
        InfeasibilityCause::Period { first_feedback_ms } => format!(
            "period: the first command with feedback acts after {first_feedback_ms:.3} ms, later than the target time"
        ),
        InfeasibilityCause::Delay { boundary_ms } => {
            format!(
                "delay: the gains for this response time (paper, equation 24) are stable up to a delay of \
                 {boundary_ms:.3} ms only; a longer response time permits a longer delay"
            )
        }
        InfeasibilityCause::PhaseMargin { found_deg } => format!(
            "phase margin: designs that are fast enough have {found_deg:.1}°, the target is {}°",
            target.phase_margin_deg
        ),
        InfeasibilityCause::Discretisation => {
            "no design of this discretisation is fast enough at this period and delay".to_owned()
        }
    }
}
