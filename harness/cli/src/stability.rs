//! `platebench stability`: predicts and measures where methods and loops become unstable.

mod methods;

use crate::exit::Exit;
use crate::options::job_count;
use crate::plate_file;
use crate::stdio;
use clap::Args;
use platebench_plate::Plate;
use platebench_record::RunRecord;
use platebench_report::ReportError;
use platebench_report::chart::{MapFigure, MapPanel, RigDelay};
use platebench_report::page::{BlockPage, PageBlock};
use platebench_scenario::Diagnostic;
use platebench_study::integration::stability::{step_limits, to_csv};
use platebench_study::loops::study::StudyConfig;
use platebench_study::loops::{AnalysisError, IntegralMethod, OperatingCondition, PlainLoops, Study, study, table};
use platebench_wire::LawId;
use std::fs;
use std::path::{Path, PathBuf};

/// Setpoint, response time and period of the paper, for the known surprise.
const SETPOINT_UM: f64 = 2.0;
const RESPONSE_S: f64 = 2e-3;
const PERIOD_S: f64 = 1e-3;
const SURPRISE_PERIODS: u32 = 4_000;
const HIGHEST_DELAY_US: f64 = 12e3;

/// `platebench stability`
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench stability                                   steps of methods; every law at resonance, detuned and under a finger
  platebench stability --out /tmp/stability              also CSV, a map per law and a page
  platebench stability --law dq-pi --law deadbeat        two laws
  platebench stability --run runs/night --out /tmp/maps  with the measured loop delay of a run in the maps")]
pub(crate) struct StabilityArgs {
    /// Folder for CSV, maps and page; default: only the table
    #[arg(long, value_name = "FOLDER")]
    out: Option<PathBuf>,
    /// Control laws of the firmware under test; default: all
    #[arg(long = "law", value_name = "NAME", value_parser = clap::builder::PossibleValuesParser::new(LawId::ALL.map(LawId::name)))]
    laws: Vec<String>,
    /// The plate file
    #[arg(long, value_name = "FILE", default_value = "scenarios/plates/aluminium-198x138.toml")]
    plate: PathBuf,
    /// Loop delay of a rig, µs, for margins and maps
    #[arg(long, value_name = "X", conflicts_with = "run", value_parser = parse_delay_us)]
    measured_delay_us: Option<f64>,
    /// Take the loop delay from a stored run
    #[arg(long, value_name = "RUN")]
    run: Option<PathBuf>,
    /// Threads; default: one per core
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    jobs: Option<u16>,
}

fn parse_delay_us(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(delay) if (0.0..=HIGHEST_DELAY_US).contains(&delay) => Ok(delay),
        _ => Err(format!("expected a delay in µs from 0 to {HIGHEST_DELAY_US}")),
    }
}

#[derive(Debug, thiserror::Error)]
enum StabilityError {
    #[error("{}: {source}", path.display())]
    File { path: PathBuf, source: std::io::Error },
    #[error("invalid plate file")]
    Plate(Box<Diagnostic>),
    #[error("{}: {reason}", path.display())]
    Run { path: PathBuf, reason: String },
    #[error(transparent)]
    Analysis(#[from] AnalysisError),
    #[error(transparent)]
    Report(#[from] ReportError),
}

/// Analyses methods and loops and prints the limits.
pub(crate) fn stability(arguments: &StabilityArgs) -> Exit {
    match analyse(arguments) {
        Ok(text) => {
            stdio::show(&text);
            Exit::Passed
        }
        Err(StabilityError::Plate(fault)) => stdio::reject_file(&fault),
        Err(error) => stdio::reject(&error),
    }
}

fn analyse(arguments: &StabilityArgs) -> Result<String, StabilityError> {
    let plate = plate_file::read(&arguments.plate).map_err(|fault| StabilityError::Plate(Box::new(fault)))?;
    let rig = match (&arguments.run, arguments.measured_delay_us) {
        (Some(run), _) => Some(delay_of_run(run)?),
        (None, Some(delay)) => Some(RigDelay { typical_ms: delay * 1e-3, longest_ms: delay * 1e-3 }),
        (None, None) => None,
    };
    let named: Vec<LawId> = arguments.laws.iter().filter_map(|name| LawId::from_name(name)).collect();
    let delay = rig.map_or(0.0, |rig| rig.longest_ms * 1e-3);
    let config = StudyConfig {
        laws: LawId::ALL.into_iter().filter(|law| named.is_empty() || named.contains(law)).collect(),
        delay,
        maps: arguments.out.is_some(),
        jobs: job_count(arguments.jobs),
        plate,
    };
    let result = study(&config)?;
    let steps = step_limits(&config.plate);
    let limits = methods::limits_table(&steps);
    let table = table::boundary_table(&result, delay);
    let surprise = surprise(&config.plate)?;
    if let Some(folder) = &arguments.out {
        let text = |name: &str, text: String| {
            let path = folder.join(name);
            fs::write(&path, text).map_err(|source| StabilityError::File { path, source })
        };
        fs::create_dir_all(folder).map_err(|source| StabilityError::File { path: folder.clone(), source })?;
        text("methods.csv", to_csv(&steps))?;
        text("boundaries.csv", table::boundaries_csv(&result))?;
        text("maps.csv", table::maps_csv(&result))?;
        let maps: Vec<(LawId, MapFigure)> =
            config.laws.iter().filter_map(|&law| Some((law, build_map(&result, law, rig)?))).collect();
        for (law, map) in &maps {
            text(&format!("{}.svg", law.name()), map.svg()?)?;
        }
        let blocks = page_blocks(&limits, &table, &surprise, &maps)?;
        let title = "Where methods and loops become unstable".to_owned();
        BlockPage { title, intro: String::new(), blocks }.write(&folder.join("stability.html"))?;
    }
    Ok(format!("{limits}\n{table}\n{surprise}"))
}

/// The largest median and the longest loop delay of the trials of a run.
fn delay_of_run(run: &Path) -> Result<RigDelay, StabilityError> {
    let refused = |reason: String| StabilityError::Run { path: run.to_owned(), reason };
    let record = RunRecord::read(run).map_err(|error| refused(error.to_string()))?;
    let trials = record.scenarios.iter().flat_map(|scenario| &scenario.trials);
    let delays = trials.filter_map(|trial| {
        let timed = trial.telemetry.timing.as_ref().and_then(|timing| timing.loop_delay_us);
        let timed = timed.map(|delay| [delay.p50, delay.max]);
        timed.or_else(|| trial.telemetry.loop_delay_us.map(|delay| [delay; 2]))
    });
    let worst = delays.reduce(|[a, b], [c, d]| [a.max(c), b.max(d)]);
    match worst {
        Some([typical, longest])
            if (0.0..=HIGHEST_DELAY_US).contains(&longest) && (0.0..=longest).contains(&typical) =>
        {
            Ok(RigDelay { typical_ms: typical * 1e-3, longest_ms: longest * 1e-3 })
        }
        Some([_, longest]) => Err(refused(format!(
            "its longest loop delay of {longest} µs is not in the range from 0 to {HIGHEST_DELAY_US} µs"
        ))),
        None => Err(refused("no trial has a loop delay".to_owned())),
    }
}

/// Backward Euler without delay: its spectral radius is small, but from a detuned start it never settles.
fn surprise(plate: &Plate) -> Result<String, AnalysisError> {
    let loops = PlainLoops::as_printed(plate, IntegralMethod::Backward, RESPONSE_S, PERIOD_S);
    let starts = [OperatingCondition::Resonant, OperatingCondition::Detuned].map(|condition| {
        let radius = loops.linearise(plate, condition, SETPOINT_UM)?.spectral_radius()?;
        Ok((condition, radius, loops.simulate_start(plate, condition, SETPOINT_UM, SURPRISE_PERIODS)))
    });
    Ok(table::format_plain_loop_starts(&starts.into_iter().collect::<Result<Vec<_>, AnalysisError>>()?))
}

/// The map of a law: one row per operating condition, one panel per response time. `None` for a law without a loop.
fn build_map(study: &Study, law: LawId, rig: Option<RigDelay>) -> Option<MapFigure> {
    let ms = |seconds: &f64| seconds * 1e3;
    let maps: Vec<_> = study.maps.iter().filter(|map| map.law == law).collect();
    let columns = maps.iter().filter(|map| Some(map.condition) == maps.first().map(|map| map.condition)).count();
    let panels = maps.iter().map(|map| MapPanel {
        title: format!("{}, response {:.3} ms", map.condition.name(), ms(&map.response)),
        periods_ms: map.periods.iter().map(ms).collect(),
        delays_ms: map.delays.iter().map(ms).collect(),
        radius: map.spectral_radius.clone(),
        measured: map.measured.iter().map(|(period, delay)| (ms(period), ms(delay))).collect(),
    });
    let title = format!("{}: spectral radius over control period and loop delay, ms", law.name());
    (!maps.is_empty()).then(|| MapFigure { title, panels: panels.collect(), columns, rig })
}

fn page_blocks(
    limits: &str,
    table: &str,
    surprise: &str,
    maps: &[(LawId, MapFigure)],
) -> Result<Vec<PageBlock>, ReportError> {
    let heading = |text: &str| PageBlock::Heading(text.to_owned());
    let text = |text: &str| PageBlock::Text(text.to_owned());
    let preformatted = |text: &str| PageBlock::Preformatted(text.to_owned());
    let mut blocks = vec![
        heading("The largest stable step of a method"),
        text(methods::NOTE),
        preformatted(limits),
        heading("Boundaries and margins"),
        preformatted(table),
        heading("A known surprise"),
        preformatted(surprise),
    ];
    for (law, map) in maps {
        blocks.push(heading(law.name()));
        blocks.extend(table::law_note(*law).map(text));
        blocks.push(PageBlock::Drawings(vec![(map.svg()?, map.title.clone())]));
    }
    Ok(blocks)
}

#[cfg(test)]
mod tests;
