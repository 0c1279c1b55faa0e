//! `platebench stability`: where methods and loops fail, predicted and measured.

mod methods;

use crate::exit::Exit;
use crate::output;
use crate::plate_file;
use clap::Args;
use platebench_analysis::study::Order;
use platebench_analysis::{AnalysisError, Condition, Integral, PlainLoops, Study, shown, study};
use platebench_methods::stability::{limits, to_csv};
use platebench_plate::Plate;
use platebench_report::ReportError;
use platebench_report::map::{Map, Panel, RigDelay, Section, page};
use platebench_scenario::Diagnostic;
use platebench_verdict::RunRecord;
use platebench_wire::LawId;
use std::fs;
use std::num::NonZero;
use std::path::{Path, PathBuf};

/// The paper's setpoint, response time and period, for the known surprise.
const SETPOINT_UM: f64 = 2.0;
const RESPONSE_S: f64 = 2e-3;
const PERIOD_S: f64 = 1e-3;
const SURPRISE_PERIODS: u32 = 4_000;
const HIGHEST_DELAY_US: f64 = 12e3;

/// `platebench stability`
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench stability                                   methods' steps; every law, resonant, detuned and under a finger
  platebench stability --out /tmp/stability              the same with CSV, a map per law and a page
  platebench stability --law dq-pi --law deadbeat        two laws
  platebench stability --run runs/night --out /tmp/maps  with the loop delay that a run measured drawn into the maps")]
pub(crate) struct Stability {
    /// The folder for CSV, maps and page; only the table is shown where not given
    #[arg(long, value_name = "FOLDER")]
    out: Option<PathBuf>,
    /// Control laws of the firmware under test; all of them where not given
    #[arg(long = "law", value_name = "NAME", value_parser = clap::builder::PossibleValuesParser::new(LawId::ALL.map(LawId::name)))]
    laws: Vec<String>,
    /// The plate file
    #[arg(long, value_name = "FILE", default_value = "scenarios/plates/aluminium-198x138.toml")]
    plate: PathBuf,
    /// The loop delay of a rig, µs: margins are taken there, maps show it
    #[arg(long, value_name = "X", conflicts_with = "run", value_parser = delay_us)]
    measured_delay_us: Option<f64>,
    /// A stored run whose rig's loop delay is taken
    #[arg(long, value_name = "RUN")]
    run: Option<PathBuf>,
    /// Threads; as many as there are cores where not given
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    jobs: Option<u16>,
}

fn delay_us(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(delay) if (0.0..=HIGHEST_DELAY_US).contains(&delay) => Ok(delay),
        _ => Err(format!("expected a delay in µs from 0 to {HIGHEST_DELAY_US}")),
    }
}

/// Why there is no answer. All of it is invalid input or a folder that cannot be written.
#[derive(Debug, thiserror::Error)]
enum StabilityError {
    #[error("{}: {source}", path.display())]
    File { path: PathBuf, source: std::io::Error },
    #[error("the plate file cannot be meant")]
    Plate(Box<Diagnostic>),
    #[error("{}: {reason}", path.display())]
    Run { path: PathBuf, reason: String },
    #[error(transparent)]
    Analysis(#[from] AnalysisError),
    #[error(transparent)]
    Report(#[from] ReportError),
}

/// Analyses, measures and shows.
pub(crate) fn stability(arguments: &Stability) -> Exit {
    match answer(arguments) {
        Ok(text) => {
            output::show(&text);
            Exit::Passed
        }
        Err(error) => {
            match error {
                StabilityError::Plate(diagnostic) => output::diagnostic(&diagnostic),
                error => output::error(&error.to_string()),
            }
            Exit::Invalid
        }
    }
}

fn answer(arguments: &Stability) -> Result<String, StabilityError> {
    let plate = plate_file::read(&arguments.plate).map_err(|fault| StabilityError::Plate(Box::new(fault)))?;
    let rig = match (&arguments.run, arguments.measured_delay_us) {
        (Some(run), _) => Some(delay_of_run(run)?),
        (None, Some(delay)) => Some(RigDelay { typical_ms: delay * 1e-3, longest_ms: delay * 1e-3 }),
        (None, None) => None,
    };
    let named: Vec<LawId> = arguments.laws.iter().filter_map(|name| LawId::from_name(name)).collect();
    let delay = rig.map_or(0.0, |rig| rig.longest_ms * 1e-3);
    let cores = || std::thread::available_parallelism().map_or(1, NonZero::get);
    let order = Order {
        laws: LawId::ALL.into_iter().filter(|law| named.is_empty() || named.contains(law)).collect(),
        delay,
        maps: arguments.out.is_some(),
        jobs: arguments.jobs.map_or_else(cores, usize::from),
        plate,
    };
    let done = study(&order)?;
    let steps = limits(&order.plate);
    let of_methods = methods::table(&steps);
    let table = shown::table(&done, delay);
    let surprise = surprise(&order.plate)?;
    if let Some(folder) = &arguments.out {
        let text = |name: &str, text: String| {
            let path = folder.join(name);
            fs::write(&path, text).map_err(|source| StabilityError::File { path, source })
        };
        fs::create_dir_all(folder).map_err(|source| StabilityError::File { path: folder.clone(), source })?;
        text("methods.csv", to_csv(&steps))?;
        text("boundaries.csv", shown::boundaries_csv(&done))?;
        text("maps.csv", shown::maps_csv(&done))?;
        let maps: Vec<(LawId, Map)> = order.laws.iter().filter_map(|&law| Some((law, map(&done, law, rig)?))).collect();
        for (law, map) in &maps {
            text(&format!("{}.svg", law.name()), map.svg()?)?;
        }
        let sections = sections(&of_methods, &table, &surprise, maps);
        text("stability.html", page("Where methods and loops fail", &sections)?)?;
    }
    Ok(format!("{of_methods}\n{table}\n{surprise}"))
}

/// The largest median and the longest loop delay of a stored run.
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
        Some([_, longest]) => {
            Err(refused(format!("its longest loop delay of {longest} µs is beyond what is looked at")))
        }
        None => Err(refused("no trial of it has a loop delay".to_owned())),
    }
}

/// Backward Euler, no delay: a small spectral radius, and from a detuned start it never settles.
fn surprise(plate: &Plate) -> Result<String, AnalysisError> {
    let loops = PlainLoops::as_printed(plate, Integral::Backward, RESPONSE_S, PERIOD_S);
    let starts = [Condition::Resonant, Condition::Detuned].map(|condition| {
        let radius = loops.linear(plate, condition, SETPOINT_UM)?.spectral_radius()?;
        Ok((condition, radius, loops.start(plate, condition, SETPOINT_UM, SURPRISE_PERIODS)))
    });
    Ok(shown::surprise(&starts.into_iter().collect::<Result<Vec<_>, AnalysisError>>()?))
}

/// Surroundings from row to row, response times from panel to panel. `None` for a law without a loop.
fn map(study: &Study, law: LawId, rig: Option<RigDelay>) -> Option<Map> {
    let ms = |seconds: &f64| seconds * 1e3;
    let maps: Vec<_> = study.maps.iter().filter(|map| map.law == law).collect();
    let columns = maps.iter().filter(|map| Some(map.condition) == maps.first().map(|map| map.condition)).count();
    let panels = maps.iter().map(|map| Panel {
        title: format!("{}, response {:.3} ms", map.condition.name(), ms(&map.response)),
        periods_ms: map.periods.iter().map(ms).collect(),
        delays_ms: map.delays.iter().map(ms).collect(),
        radius: map.radius.clone(),
        measured: map.measured.iter().map(|(period, delay)| (ms(period), ms(delay))).collect(),
    });
    let title = format!("{}: spectral radius over control period and loop delay, ms", law.name());
    (!maps.is_empty()).then(|| Map { title, panels: panels.collect(), columns, rig })
}

fn sections(of_methods: &str, table: &str, surprise: &str, maps: Vec<(LawId, Map)>) -> Vec<Section> {
    let text = |title: &str, text: &str| Section {
        title: title.to_owned(),
        note: String::new(),
        table: Some(text.to_owned()),
        map: None,
    };
    let mut steps = text("The largest stable step of a method", of_methods);
    methods::NOTE.clone_into(&mut steps.note);
    let mut sections = vec![steps, text("Boundaries and margins", table), text("A known surprise", surprise)];
    sections.extend(maps.into_iter().map(|(law, map)| Section {
        title: law.name().to_owned(),
        note: shown::note(law).unwrap_or_default().to_owned(),
        table: None,
        map: Some(map),
    }));
    sections
}

#[cfg(test)]
mod tests;
