//! Compares predicted and measured stability limits of methods and loops, and draws maps over
//! period, delay and response.

use crate::law_loops::{
    LoopCase, OperatingCondition, PlainLoops, loop_at_rest, measure_delay_boundary, measure_delay_boundary_from_rest,
};
use crate::loops::{ClosedLoop, Discretisation, LoopError, LoopTiming, Margins, delay_boundary};
use crate::stability_map::draw_maps;
pub use crate::stability_map::{RigDelay, StabilityMap};
use crate::step_limits::{NOTE, limits_csv, limits_table, step_limits};
use platebench_document::format::with_decimals;
use platebench_document::{Block, ChartSection, Column, Document, NOTHING, Table};
use platebench_engine::delay_boundary::DelayBoundary;
use platebench_engine::workers::collect_in_parallel;
use platebench_model::record::RunRecord;
use platebench_plate::{Model, Plate, Time};
use platebench_wire::LawId;
use std::fmt::Write;

const SETPOINT_UM: f64 = 2.0;
const RESPONSE_S: f64 = 2e-3;
const PERIOD_S: f64 = 1e-3;
const START_PERIODS: u32 = 4_000;

#[derive(Debug, thiserror::Error)]
pub enum StabilityError {
    #[error(transparent)]
    Analysis(#[from] LoopError),
}

pub fn build_chart(config: &StudyConfig, rig: Option<RigDelay>) -> Result<ChartSection, StabilityError> {
    let result = study(config)?;
    let steps = step_limits(&config.plate);
    let mut files = vec![
        ("methods.csv".to_owned(), limits_csv(&steps)),
        ("boundaries.csv".to_owned(), boundaries_csv(&result)),
        ("maps.csv".to_owned(), maps_csv(&result)),
    ];
    let delay_us = config.delay * 1e6;
    let mut blocks = vec![
        Block::heading("Methods: the largest stable step"),
        Block::Details(vec![Block::paragraph(NOTE)]),
        Block::Table(limits_table(&steps)),
        Block::heading(format!(
            "Loops: longest stable loop delay of each law at 1 kHz; margins at a loop delay of {delay_us:.0} µs"
        )),
        Block::Table(boundary_table(&result)),
    ];
    let mut laws: Vec<LawId> = result.rows.iter().map(|row| row.law).collect();
    laws.dedup();
    let notes = laws.into_iter().filter_map(|law| Some(format!("{}: {}", law.name(), law_note(law)?)));
    blocks.extend(notes.map(Block::Paragraph));
    blocks.push(Block::heading(
        "Known limit: equation 24 with a backward-Euler integral, no delay, no limits, from rest to 2 µm",
    ));
    blocks.push(Block::lines(known_limit(&config.plate)?));
    for &law in &config.laws {
        let Some(map) = draw_maps(&result.maps, law, rig) else { continue };
        let svg = map.svg();
        files.push((format!("{}.svg", law.name()), svg.clone()));
        blocks.push(Block::Details(vec![Block::heading(law.name()), Block::figure(svg, map.title)]));
    }
    Ok(ChartSection { document: Document::new("Where methods and loops become unstable", blocks), files })
}

/// Largest median and largest maximum of the loop delays of all trials. `None` without delays.
pub fn rig_delay(record: &RunRecord) -> Option<RigDelay> {
    let trials = record.scenarios.iter().flat_map(|scenario| &scenario.trials);
    let delays = trials.filter_map(|trial| {
        let timed = trial.telemetry.timing.as_ref().and_then(|timing| timing.loop_delay_us);
        let timed = timed.map(|delay| [delay.p50, delay.max]);
        timed.or_else(|| trial.telemetry.loop_delay_us.map(|delay| [delay; 2]))
    });
    let [typical, longest] = delays.reduce(|[a, b], [c, d]| [a.max(c), b.max(d)])?;
    Some(RigDelay { typical_ms: typical * 1e-3, longest_ms: longest * 1e-3 })
}

/// Shows that backward Euler has a small spectral radius but never settles from a detuned start.
fn known_limit(plate: &Plate) -> Result<Vec<String>, LoopError> {
    let loops = PlainLoops::new(plate, Discretisation::Backward, RESPONSE_S, PERIOD_S);
    let lines = [OperatingCondition::Resonant, OperatingCondition::Detuned].map(|condition| {
        let radius = loops.linearise(plate, condition, SETPOINT_UM)?.spectral_radius()?;
        let found = loops.simulate_start(plate, condition, SETPOINT_UM, START_PERIODS);
        let outcome = match found.settled {
            Some(seconds) => format!("within 5 % from {:.0} ms on", seconds * 1e3),
            None if found.diverged => "never settles: Wq/Wd is not linear, and the excitation diverges".to_owned(),
            None => format!("never settles: |W| between {:.2} and {:.2} setpoints", found.range[0], found.range[1]),
        };
        Ok(format!("{:<10} spectral radius {radius:.2}: {outcome}", condition.name()))
    });
    lines.into_iter().collect()
}

pub const MAX_DELAY_S: f64 = 12e-3;
const MAP_PERIODS_US: [u32; 2] = [200, 2_000];
const MAX_MAP_DELAY_S: f64 = 3e-3;
const MAP_COLUMNS: u32 = 37;
const MAP_ROWS: u32 = 40;
/// Duration of a start. It has settled only if |W| is in its band for the last quarter.
const MAX_SETTLING_S: f64 = 53e-3;
const MEASURED_PERIODS_US: [u32; 7] = [250, 500, 750, 1_000, 1_300, 1_600, 1_900];
/// Response times of the maps, relative to the law's default response time.
const MAP_RESPONSE_FACTORS: [f64; 3] = [0.75, 1.0, 2.0];

#[derive(Debug, Clone)]
pub struct StudyConfig {
    pub plate: Plate,
    pub laws: Vec<LawId>,
    /// Loop delay at which radius and margins are computed, s. 0 if unknown.
    pub delay: f64,
    pub maps: bool,
    pub jobs: usize,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StudyRow {
    pub law: LawId,
    pub condition: OperatingCondition,
    pub period_us: u32,
    /// Response time of the design, s.
    pub response: f64,
    /// Spectral radius at the loop delay [`StudyConfig::delay`].
    pub spectral_radius: f64,
    pub predicted: DelayBoundary,
    /// Delay boundary measured with the firmware's code. `None` if there is no steady state.
    pub measured: Option<DelayBoundary>,
    /// Longest delay with which the firmware reaches its setpoint from rest.
    pub from_rest: DelayBoundary,
    /// The delay margin is the predicted delay boundary minus [`StudyConfig::delay`].
    pub margins: Margins,
}

impl StudyRow {
    pub fn difference_percent(&self) -> Option<f64> {
        let measured = self.measured?.seconds()?;
        Some((measured / self.predicted.seconds()? - 1.0) * 100.0)
    }
}

#[derive(Debug, Clone, PartialEq, Default)]
pub struct Study {
    pub rows: Vec<StudyRow>,
    pub out_of_reach: Vec<(LawId, OperatingCondition)>,
    pub maps: Vec<StabilityMap>,
}

pub fn study(config: &StudyConfig) -> Result<Study, LoopError> {
    let conditions = config.laws.iter().flat_map(|&law| OperatingCondition::ALL.map(|condition| (law, condition)));
    let cases: Vec<(LawId, OperatingCondition)> = conditions.collect();
    let mut study = Study::default();
    let rows = collect_in_parallel(config.jobs, &cases, |(law, condition)| study_row(config, *law, *condition))?;
    for (case, row) in cases.iter().zip(rows) {
        match row {
            Some(row) => study.rows.push(row),
            None => study.out_of_reach.push(*case),
        }
    }
    let mapped = cases.iter().filter(|(law, _)| config.maps && *law != LawId::OpenLoop);
    let mapped = mapped.flat_map(|&(law, condition)| {
        let own = LoopCase::new(&config.plate, law, condition).response();
        MAP_RESPONSE_FACTORS.map(|share| (law, condition, share * own))
    });
    let mapped: Vec<(LawId, OperatingCondition, f64)> = mapped.collect();
    let maps = collect_in_parallel(config.jobs, &mapped, |(law, condition, response)| {
        stability_map(config, *law, *condition, *response)
    })?;
    study.maps = maps.into_iter().flatten().collect();
    Ok(study)
}

fn study_row(config: &StudyConfig, law: LawId, condition: OperatingCondition) -> Result<Option<StudyRow>, LoopError> {
    let case = LoopCase::new(&config.plate, law, condition);
    let Some((plant, controller)) = case.linearise(Model::Modal) else { return Ok(None) };
    let predicted = delay_boundary(&plant, &controller, case.period(), MAX_DELAY_S)?;
    let closed = ClosedLoop::new(plant, controller, LoopTiming { period: case.period(), delay: config.delay })?;
    let delay_ms = predicted.seconds().map(|boundary| (boundary - config.delay) * 1e3);
    Ok(Some(StudyRow {
        law,
        condition,
        period_us: case.period_us,
        response: case.response(),
        spectral_radius: closed.spectral_radius()?,
        predicted,
        measured: measure_delay_boundary(&case, MAX_DELAY_S),
        from_rest: measure_delay_boundary_from_rest(&case, MAX_DELAY_S),
        margins: closed.margins(delay_ms),
    }))
}

fn stability_map(
    config: &StudyConfig,
    law: LawId,
    condition: OperatingCondition,
    response: f64,
) -> Result<Option<StabilityMap>, LoopError> {
    let case = LoopCase { response_s: Some(response), ..LoopCase::new(&config.plate, law, condition) };
    let [first, last] = MAP_PERIODS_US;
    let periods: Vec<u32> =
        (0..MAP_COLUMNS).map(|column| first + (last - first) * column / (MAP_COLUMNS - 1)).collect();
    let delays: Vec<f64> =
        (0..MAP_ROWS).map(|row| MAX_MAP_DELAY_S * f64::from(row) / f64::from(MAP_ROWS - 1)).collect();
    let (mut radius, mut settling) = (Vec::with_capacity(periods.len()), Vec::with_capacity(periods.len()));
    for &period_us in &periods {
        let case = LoopCase { period_us, ..case };
        let Some((plant, controller)) = case.linearise(Model::Modal) else { return Ok(None) };
        let of = |&delay: &f64| {
            let timing = LoopTiming { period: case.period(), delay };
            ClosedLoop::new(plant.clone(), controller, timing)?.spectral_radius()
        };
        let at_rest = loop_at_rest(&case);
        let settles = |&delay: &f64| at_rest.clone()?.settling_time(Time::from_seconds(delay)?, MAX_SETTLING_S);
        settling.push(delays.iter().map(settles).collect());
        radius.push(delays.iter().map(of).collect::<Result<_, _>>()?);
    }
    let at = |&period_us: &u32| {
        let case = LoopCase { period_us, ..case };
        Some((case.period(), measure_delay_boundary(&case, MAX_MAP_DELAY_S)?.seconds()?))
    };
    let measured = MEASURED_PERIODS_US.iter().filter_map(at).collect();
    let periods = periods.into_iter().map(|period_us| f64::from(period_us) * 1e-6).collect();
    Ok(Some(StabilityMap { law, condition, response, periods, delays, spectral_radius: radius, settling, measured }))
}

/// Delays are in µs.
pub fn boundary_table(study: &Study) -> Table {
    let mut table = Table::new([
        Column::from("law"),
        Column::from("condition"),
        Column::number("predicted", "µs"),
        Column::number("measured", "µs"),
        Column::number("difference", "%"),
        Column::number("from rest", "µs"),
        Column::number("radius", ""),
        Column::number("gain margin", ""),
        Column::number("phase margin", "°"),
        Column::number("delay margin", "µs"),
    ]);
    table.extend(study.rows.iter().map(|row| {
        let measured =
            row.measured.map_or_else(|| "unsteady".to_owned(), |boundary| format_microseconds(boundary, "none"));
        [
            row.law.name().to_owned(),
            row.condition.name().to_owned(),
            format_microseconds(row.predicted, "unstable"),
            measured,
            row.difference_percent().map_or_else(|| NOTHING.to_owned(), |percent| format!("{percent:+.2}")),
            format_microseconds(row.from_rest, "never"),
            format!("{:.3}", row.spectral_radius),
            with_decimals(row.margins.gain, 2),
            with_decimals(row.margins.phase_deg, 1),
            with_decimals(row.margins.delay_ms.map(|ms| ms * 1e3), 0),
        ]
    }));
    for (law, condition) in &study.out_of_reach {
        let mut row = vec![law.name(), condition.name(), "no steady state within the drive's limit"];
        row.resize(table.columns.len(), "");
        table.push(row);
    }
    table
}

const fn law_note(law: LawId) -> Option<&'static str> {
    Some(match law {
        LawId::OpenLoop => "without feedback no delay makes it unstable; its poles are the plate's",
        LawId::DqPi => {
            "in steady state it equals dq-pi-fixed matched to the plate's damping; \
             from rest its boundary is lower, because it interprets a delay as damping"
        }
        LawId::BangBang => {
            "the frequency relay has no linear form and always hunts; \
             predicted is the boundary of the amplitude loop, measured is the delay at which |W| leaves the 5 % band"
        }
        LawId::Deadbeat => {
            "predicted and measured are the boundaries of the holding loops, which do not compensate the delay; \
             from rest the law identifies a delay of up to 0.9 periods"
        }
        LawId::FrequencyOnly => "the drive is half of the limit; it reaches the setpoint of 1 µm under the finger",
        LawId::VoltageOnly | LawId::Pll | LawId::DqPiEuler | LawId::DqPiFixed => return None,
    })
}

fn format_microseconds(boundary: DelayBoundary, never: &str) -> String {
    match boundary {
        DelayBoundary::Unstable => never.to_owned(),
        DelayBoundary::At(seconds) => format!("{:.0}", seconds * 1e6),
        DelayBoundary::Beyond(seconds) => format!("> {:.0}", seconds * 1e6),
    }
}

/// A boundary is empty without a steady state, `inf` beyond the search, 0 if never stable.
pub fn boundaries_csv(study: &Study) -> String {
    let mut text = String::from(
        "law,condition,period_us,response_ms,predicted_us,measured_us,difference_percent,from_rest_us,\
         spectral_radius,gain_margin,phase_margin_deg,delay_margin_us\n",
    );
    for row in &study.rows {
        let StudyRow { law, condition, period_us, response, .. } = row;
        let cells = [
            Some(boundary_us(row.predicted)),
            row.measured.map(boundary_us),
            row.difference_percent(),
            Some(boundary_us(row.from_rest)),
            Some(row.spectral_radius),
            row.margins.gain,
            row.margins.phase_deg,
            row.margins.delay_ms.map(|ms| ms * 1e3),
        ];
        let cells = cells.map(|cell| cell.map_or_else(String::new, |value| value.to_string())).join(",");
        let _ = writeln!(text, "{},{},{period_us},{},{cells}", law.name(), condition.name(), response * 1e3);
    }
    text
}

fn boundary_us(boundary: DelayBoundary) -> f64 {
    match boundary {
        DelayBoundary::Unstable => 0.0,
        DelayBoundary::At(seconds) => seconds * 1e6,
        DelayBoundary::Beyond(_) => f64::INFINITY,
    }
}

/// Writes a row per point. `kind` is `predicted` for the map and `measured` for a boundary.
pub fn maps_csv(study: &Study) -> String {
    let mut text = String::from("law,condition,response_ms,kind,period_us,delay_us,spectral_radius,settling_ms\n");
    for map in &study.maps {
        let head = format!("{},{},{}", map.law.name(), map.condition.name(), map.response * 1e3);
        let columns = map.spectral_radius.iter().zip(&map.settling);
        for (period, (radii, settling)) in map.periods.iter().zip(columns) {
            for ((delay, radius), settling) in map.delays.iter().zip(radii).zip(settling) {
                let settling = settling.map_or_else(String::new, |seconds| format!("{:.3}", seconds * 1e3));
                let _ = writeln!(text, "{head},predicted,{:.0},{:.1},{radius},{settling}", period * 1e6, delay * 1e6);
            }
        }
        for (period, delay) in &map.measured {
            let _ = writeln!(text, "{head},measured,{:.0},{:.1},1,", period * 1e6, delay * 1e6);
        }
    }
    text
}
