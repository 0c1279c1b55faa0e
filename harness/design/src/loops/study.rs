//! Computes stability boundaries per law and condition, and maps over period, delay and response.

use crate::loops::case::{LoopCase, OperatingCondition};
use crate::loops::closed_loop::{AnalysisError, ClosedLoop, LoopTiming};
use crate::loops::margins::delay_boundary;
use crate::loops::measured_boundary;
use platebench_engine::delay_boundary::DelayBoundary;
use platebench_engine::parallel::collect_in_parallel;
use platebench_plate::{Plate, Tier, Time};
use platebench_wire::LawId;

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
    pub gain_margin: Option<f64>,
    pub phase_margin_deg: Option<f64>,
    /// Predicted delay boundary minus [`StudyConfig::delay`], s.
    pub delay_margin: Option<f64>,
}

impl StudyRow {
    pub fn difference_percent(&self) -> Option<f64> {
        let measured = self.measured?.seconds()?;
        Some((measured / self.predicted.seconds()? - 1.0) * 100.0)
    }
}

#[derive(Debug, Clone, PartialEq)]
pub struct StabilityMap {
    pub law: LawId,
    pub condition: OperatingCondition,
    pub response: f64,
    pub periods: Vec<f64>,
    pub delays: Vec<f64>,
    /// Indexed by period, then by delay.
    pub spectral_radius: Vec<Vec<f64>>,
    /// 5 % settling time, s, of a start with the f32 controller, indexed like `spectral_radius`.
    /// `None` if it does not settle.
    pub settling: Vec<Vec<Option<f64>>>,
    /// Control periods and their measured delay boundaries, s.
    pub measured: Vec<(f64, f64)>,
}

#[derive(Debug, Clone, PartialEq, Default)]
pub struct Study {
    pub rows: Vec<StudyRow>,
    pub out_of_reach: Vec<(LawId, OperatingCondition)>,
    pub maps: Vec<StabilityMap>,
}

pub fn study(config: &StudyConfig) -> Result<Study, AnalysisError> {
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

fn study_row(
    config: &StudyConfig,
    law: LawId,
    condition: OperatingCondition,
) -> Result<Option<StudyRow>, AnalysisError> {
    let case = LoopCase::new(&config.plate, law, condition);
    let Some((plant, controller)) = case.linearise(Tier::Modal) else { return Ok(None) };
    let predicted = delay_boundary(&plant, &controller, case.period(), MAX_DELAY_S)?;
    let closed = ClosedLoop::new(plant, controller, LoopTiming { period: case.period(), delay: config.delay })?;
    let margins = closed.margins();
    Ok(Some(StudyRow {
        law,
        condition,
        period_us: case.period_us,
        response: case.response(),
        spectral_radius: closed.spectral_radius()?,
        predicted,
        measured: measured_boundary::measure_delay_boundary(&case, MAX_DELAY_S),
        from_rest: measured_boundary::measure_delay_boundary_from_rest(&case, MAX_DELAY_S),
        gain_margin: margins.gain,
        phase_margin_deg: margins.phase_deg,
        delay_margin: predicted.seconds().map(|boundary| boundary - config.delay),
    }))
}

fn stability_map(
    config: &StudyConfig,
    law: LawId,
    condition: OperatingCondition,
    response: f64,
) -> Result<Option<StabilityMap>, AnalysisError> {
    let case = LoopCase { response_s: Some(response), ..LoopCase::new(&config.plate, law, condition) };
    let [first, last] = MAP_PERIODS_US;
    let periods: Vec<u32> =
        (0..MAP_COLUMNS).map(|column| first + (last - first) * column / (MAP_COLUMNS - 1)).collect();
    let delays: Vec<f64> =
        (0..MAP_ROWS).map(|row| MAX_MAP_DELAY_S * f64::from(row) / f64::from(MAP_ROWS - 1)).collect();
    let (mut radius, mut settling) = (Vec::with_capacity(periods.len()), Vec::with_capacity(periods.len()));
    for &period_us in &periods {
        let case = LoopCase { period_us, ..case };
        let Some((plant, controller)) = case.linearise(Tier::Modal) else { return Ok(None) };
        let of = |&delay: &f64| {
            let timing = LoopTiming { period: case.period(), delay };
            ClosedLoop::new(plant.clone(), controller, timing)?.spectral_radius()
        };
        let at_rest = measured_boundary::loop_at_rest(&case);
        let settles = |&delay: &f64| at_rest.clone()?.settling_time(Time::from_seconds(delay)?, MAX_SETTLING_S);
        settling.push(delays.iter().map(settles).collect());
        radius.push(delays.iter().map(of).collect::<Result<_, _>>()?);
    }
    let at = |&period_us: &u32| {
        let case = LoopCase { period_us, ..case };
        Some((case.period(), measured_boundary::measure_delay_boundary(&case, MAX_MAP_DELAY_S)?.seconds()?))
    };
    let measured = MEASURED_PERIODS_US.iter().filter_map(at).collect();
    let periods = periods.into_iter().map(|period_us| f64::from(period_us) * 1e-6).collect();
    Ok(Some(StabilityMap { law, condition, response, periods, delays, spectral_radius: radius, settling, measured }))
}
