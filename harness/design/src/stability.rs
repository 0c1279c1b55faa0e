//! Compares predicted and measured stability limits of methods and loops, and draws maps.

use crate::integration::stability::{NOTE, limits_table, step_limits, to_csv};
use crate::loops::{AnalysisError, Discretisation, OperatingCondition, PlainLoops, Study, StudyConfig, study, table};
use platebench_model::record::RunRecord;
use platebench_plate::Plate;
use platebench_report::ReportError;
use platebench_report::chart::{MapFigure, MapPanel, RigDelay};
use platebench_report::page::{ChartSection, PageBlock};
use platebench_wire::LawId;

const SETPOINT_UM: f64 = 2.0;
const RESPONSE_S: f64 = 2e-3;
const PERIOD_S: f64 = 1e-3;
const START_PERIODS: u32 = 4_000;

#[derive(Debug, thiserror::Error)]
pub enum StabilityError {
    #[error(transparent)]
    Analysis(#[from] AnalysisError),
    #[error(transparent)]
    Report(#[from] ReportError),
}

pub fn build_chart(config: &StudyConfig, rig: Option<RigDelay>) -> Result<ChartSection, StabilityError> {
    let result = study(config)?;
    let steps = step_limits(&config.plate);
    let step_table = limits_table(&steps);
    let boundaries = table::boundary_table(&result, config.delay);
    let known_limit = known_limit(&config.plate)?;
    let mut files = vec![
        ("methods.csv".to_owned(), to_csv(&steps)),
        ("boundaries.csv".to_owned(), table::boundaries_csv(&result)),
        ("maps.csv".to_owned(), table::maps_csv(&result)),
    ];
    let maps: Vec<(LawId, MapFigure)> =
        config.laws.iter().filter_map(|&law| Some((law, build_map(&result, law, rig)?))).collect();
    for (law, map) in &maps {
        files.push((format!("{}.svg", law.name()), map.svg()?));
    }
    let summary = format!("{step_table}\n{boundaries}\n{known_limit}");
    let blocks = page_blocks([step_table, boundaries, known_limit], &maps)?;
    Ok(ChartSection { title: "Where methods and loops become unstable", summary, blocks, files })
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
fn known_limit(plate: &Plate) -> Result<String, AnalysisError> {
    let loops = PlainLoops::new(plate, Discretisation::Backward, RESPONSE_S, PERIOD_S);
    let starts = [OperatingCondition::Resonant, OperatingCondition::Detuned].map(|condition| {
        let radius = loops.linearise(plate, condition, SETPOINT_UM)?.spectral_radius()?;
        Ok((condition, radius, loops.simulate_start(plate, condition, SETPOINT_UM, START_PERIODS)))
    });
    Ok(table::format_plain_loop_starts(&starts.into_iter().collect::<Result<Vec<_>, AnalysisError>>()?))
}

/// One row per condition, one panel per response time. `None` for a law without a loop.
fn build_map(study: &Study, law: LawId, rig: Option<RigDelay>) -> Option<MapFigure> {
    let ms = |seconds: &f64| seconds * 1e3;
    let maps: Vec<_> = study.maps.iter().filter(|map| map.law == law).collect();
    let columns = maps.iter().filter(|map| Some(map.condition) == maps.first().map(|map| map.condition)).count();
    let panels = maps.iter().map(|map| MapPanel {
        title: format!("{}, response {:.3} ms", map.condition.name(), ms(&map.response)),
        periods_ms: map.periods.iter().map(ms).collect(),
        delays_ms: map.delays.iter().map(ms).collect(),
        radius: map.spectral_radius.clone(),
        settling_ms: map
            .settling
            .iter()
            .map(|column| column.iter().map(|time| time.as_ref().map(ms)).collect())
            .collect(),
        measured: map.measured.iter().map(|(period, delay)| (ms(period), ms(delay))).collect(),
    });
    let title = format!("{}: settling time from rest over control period and loop delay, ms", law.name());
    (!maps.is_empty()).then(|| MapFigure { title, panels: panels.collect(), columns, rig })
}

fn page_blocks(
    [steps, boundaries, known_limit]: [String; 3],
    maps: &[(LawId, MapFigure)],
) -> Result<Vec<PageBlock>, ReportError> {
    let heading = |text: &str| PageBlock::Heading(text.to_owned());
    let text = |text: &str| PageBlock::Text(text.to_owned());
    let mut blocks = vec![
        heading("The largest stable step of a method"),
        text(NOTE),
        PageBlock::Preformatted(steps),
        heading("Boundaries and margins"),
        PageBlock::Preformatted(boundaries),
        heading("Known limit"),
        PageBlock::Preformatted(known_limit),
    ];
    for (law, map) in maps {
        blocks.push(heading(law.name()));
        blocks.extend(table::law_note(*law).map(text));
        blocks.push(PageBlock::Drawings(vec![(map.svg()?, map.title.clone())]));
    }
    Ok(blocks)
}
