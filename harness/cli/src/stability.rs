//! `platebench stability`: predicts and measures where methods and loops become unstable.

mod measured;

use crate::exit::{CommandResult, Exit, Failure, OrInvalid};
use crate::options::{
    OutputFormat, job_count, law_names, parse_force_n, parse_number, parse_positive_ms, parse_reply_timeout,
    parse_setpoint_um, rig_help,
};
use crate::selection::warn_of_plate;
use crate::stdio;
use clap::Args;
use clap::builder::PossibleValuesParser;
use platebench_design::margins::scenes::Quantity;
use platebench_design::stability::RigDelay;
use platebench_design::stability::{StudyConfig, build_chart, rig_delay};
use platebench_document::Style;
use platebench_document::write_chart_page;
use platebench_model::record::RunRecord;
use platebench_model::scenario::OWN_LAW;
use platebench_model::scenario::load::{load_plate, require_no_effects};
use platebench_model::trace::create_folder;
use platebench_rig::RigSpec;
use platebench_wire::LawId;
use std::path::{Path, PathBuf};
use std::time::Duration;

const PLATE: &str = "scenarios/plates/aluminium-198x138.toml";
const HIGHEST_DELAY_US: f64 = 12e3;

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench stability                                   methods; every law at resonance, detuned, with a finger
  platebench stability --out /tmp/stability              also CSV, a map per law and a page
  platebench stability --law dq-pi --law deadbeat        two laws
  platebench stability --run runs/night --out /tmp/maps  with the measured loop delay of a run in the maps
  platebench stability --rig 'exec:./controller {port}' --law own          measured margins of a controller
  platebench stability --rig emulated --force-n 0 --force-n 1 --force-n 2  with a map over operating points
  platebench stability --rig emulated:my.elf --reference emulated --out M  next to the bench's laws, with a chart

Exit codes: 0 done, 2 wrong usage or invalid input, 4 the controller does not announce the law, 5 the rig could not be
reached or was lost")]
pub(crate) struct StabilityArgs {
    /// Folder for CSV, maps and page; default: only the table
    #[arg(long, value_name = "FOLDER")]
    out: Option<PathBuf>,
    /// Control laws of the firmware; default: all, with --rig that of the scenario. `own` is any
    /// algorithm, with --rig
    #[arg(long = "law", value_name = "NAME", value_parser = law_names())]
    laws: Vec<String>,
    /// The plate file; default: scenarios/plates/aluminium-198x138.toml, with --rig that of the
    /// scenario
    #[arg(long, value_name = "FILE")]
    plate: Option<PathBuf>,
    #[arg(long, value_name = "RIG", conflicts_with_all = ["run", "measured_delay_us"], help = format!("Measure the \
        margins of this controller instead. {}", rig_help()))]
    rig: Option<RigSpec>,
    /// Also measure the bench's laws on this rig, for comparison
    #[arg(long, value_name = "RIG", requires = "rig")]
    reference: Option<RigSpec>,
    /// Time to wait for a reply over a line before it counts as missed, ms
    #[arg(long, value_name = "MS", default_value = "500", requires = "rig", value_parser = parse_reply_timeout)]
    reply_timeout: Duration,
    /// Scenario with the step and the expectations; default:
    /// scenarios/paper/fig13-closed-loop.toml
    #[arg(long, value_name = "FILE", requires = "rig")]
    scenario: Option<PathBuf>,
    /// Only expectations whose requirement begins with this text, such as ACC or ACC-2
    #[arg(long, value_name = "ID", requires = "rig")]
    requirement: Option<String>,
    /// Limits to search; default: all
    #[arg(long = "margin", value_name = "NAME", requires = "rig",
        value_parser = PossibleValuesParser::new(Quantity::ALL.map(Quantity::key)))]
    margins: Vec<String>,
    /// Control period, ms; with each of the next options, every combination is an operating point
    #[arg(long, alias = "period", value_name = "X", requires = "rig", value_parser = parse_positive_ms)]
    period_ms: Vec<f64>,
    /// Setpoint, µm
    #[arg(long, value_name = "X", requires = "rig", value_parser = parse_setpoint_um)]
    setpoint_um: Vec<f64>,
    /// Resonance minus excitation frequency at the start, Hz
    #[arg(long, value_name = "X", requires = "rig", allow_negative_numbers = true, value_parser = parse_detuning_hz)]
    detuning_hz: Vec<f64>,
    /// Normal force of the finger, N
    #[arg(long, value_name = "X", requires = "rig", value_parser = parse_force_n)]
    force_n: Vec<f64>,
    /// Measured loop delay of a rig, µs; margins and maps include it
    #[arg(long, value_name = "X", conflicts_with = "run", value_parser = parse_delay_us)]
    measured_delay_us: Option<f64>,
    /// Take the loop delay from a stored run
    #[arg(long, value_name = "RUN")]
    run: Option<PathBuf>,
    /// Threads; default: one per core
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    jobs: Option<u16>,
    /// Format of standard output, with --rig
    #[arg(long, value_enum, default_value_t = OutputFormat::Human, requires = "rig")]
    format: OutputFormat,
}

fn parse_detuning_hz(text: &str) -> Result<f64, String> {
    parse_number(text, |hz| (-5e3..=5e3).contains(&hz), "a frequency in Hz from -5000 to 5000")
}

fn parse_delay_us(text: &str) -> Result<f64, String> {
    let expected = format!("a delay in µs from 0 to {HIGHEST_DELAY_US}");
    parse_number(text, |delay| (0.0..=HIGHEST_DELAY_US).contains(&delay), &expected)
}

pub(crate) fn stability(arguments: &StabilityArgs) -> CommandResult {
    if let Some(rig) = &arguments.rig {
        return measured::measure(arguments, rig);
    }
    stdio::show(&analyse(arguments)?);
    Ok(Exit::Passed)
}

fn analyse(arguments: &StabilityArgs) -> Result<String, Failure> {
    if arguments.laws.iter().any(|law| law == OWN_LAW) {
        return Err(Failure::invalid(
            &"--law own needs --rig, because the bench does not know the controller's own law",
        ));
    }
    let path = arguments.plate.as_deref().unwrap_or_else(|| Path::new(PLATE));
    let plate = load_plate(path)?;
    warn_of_plate(path, &plate);
    require_no_effects(path, &plate, "stability")?;
    let rig = match (&arguments.run, arguments.measured_delay_us) {
        (Some(run), _) => Some(delay_of_run(run)?),
        (None, Some(delay)) => Some(RigDelay { typical_ms: delay * 1e-3, longest_ms: delay * 1e-3 }),
        (None, None) => None,
    };
    let named: Vec<LawId> = arguments.laws.iter().filter_map(|name| LawId::from_name(name)).collect();
    let config = StudyConfig {
        laws: LawId::ALL.into_iter().filter(|law| named.is_empty() || named.contains(law)).collect(),
        delay: rig.map_or(0.0, |rig| rig.longest_ms * 1e-3),
        maps: arguments.out.is_some(),
        jobs: job_count(arguments.jobs),
        plate,
    };
    let section = build_chart(&config, rig).or_invalid()?;
    if let Some(folder) = &arguments.out {
        create_folder(folder).or_invalid_at(folder)?;
        write_chart_page(
            folder,
            "stability.html",
            &section.document.title,
            String::new(),
            std::slice::from_ref(&section),
        )
        .or_invalid()?;
    }
    Ok(section.document.to_console(None, Style::default()))
}

fn delay_of_run(run: &Path) -> Result<RigDelay, Failure> {
    let record = RunRecord::read(run).or_invalid_at(run)?;
    let delay = rig_delay(&record)
        .ok_or("no trial of this run has a loop delay, because the controller never answered")
        .or_invalid_at(run)?;
    let [typical, longest] = [delay.typical_ms * 1e3, delay.longest_ms * 1e3];
    let is_in_range = (0.0..=HIGHEST_DELAY_US).contains(&longest) && (0.0..=longest).contains(&typical);
    let wrong =
        || format!("its longest loop delay of {longest} µs is not in the range from 0 to {HIGHEST_DELAY_US} µs");
    is_in_range.then_some(delay).ok_or_else(wrong).or_invalid_at(run)
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_design::step_limits::{StepLimit, step_limits};
    use std::fs;

    fn arguments(out: Option<&Path>) -> StabilityArgs {
        StabilityArgs {
            out: out.map(Path::to_owned),
            laws: vec!["open-loop".to_owned()],
            plate: Some(Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").join(PLATE)),
            measured_delay_us: None,
            run: None,
            jobs: Some(1),
            rig: None,
            reference: None,
            reply_timeout: Duration::from_millis(500),
            scenario: None,
            requirement: None,
            margins: Vec::new(),
            period_ms: Vec::new(),
            setpoint_um: Vec::new(),
            detuning_hz: Vec::new(),
            force_n: Vec::new(),
            format: OutputFormat::Human,
        }
    }

    #[test]
    fn the_largest_steps_of_methods_are_next_to_theory() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("new");
        let text = analyse(&arguments(Some(&out))).unwrap();
        let row = |method: &str, problem: &str| {
            let found = text.lines().find(|line| line.starts_with(method) && line.contains(problem));
            let found = found.unwrap_or_else(|| panic!("{method}, {problem}: {text}"));
            found.split_whitespace().collect::<Vec<_>>().join(" ")
        };
        let euler = row("explicit Euler", "envelope, 545 rad/s off");
        assert!(euler.contains("1.834 ms 1.834 ms 0.00 %"), "{euler}");
        assert!(
            row("RK4", "modal").contains("6.974 µs 6.967 µs 0.10 %") && row("RK4", "modal").contains("h·2ω0 = 2.831"),
            "{text}"
        );
        assert!(row("Störmer-Verlet", "carrier").contains("3.142 points per period"), "{text}");
        assert!(row("exact", "modal").contains("no limit no limit"), "{text}");
        assert!(text.find("Methods").unwrap() < text.find("Loops").unwrap(), "{text}");
        let rows = step_limits(&load_plate(&arguments(None).plate.unwrap()).unwrap());
        let csv = fs::read_to_string(out.join("methods.csv")).unwrap();
        assert_eq!(csv.lines().count(), 1 + rows.len());
        for row in &rows {
            assert!(row.deviation().is_none_or(|share| share.abs() < 0.02), "{row:?}");
            assert_eq!(
                matches!(row.measured, StepLimit::Step(_)),
                matches!(row.predicted, StepLimit::Step(_)),
                "{row:?}"
            );
            assert!(csv.contains(row.problem), "{row:?}");
        }
        let page = fs::read_to_string(out.join("stability.html")).unwrap();
        assert!(page.find("the largest stable step").unwrap() < page.find("longest stable loop delay").unwrap());
        assert!(page.contains("3.142 points per period"), "{}", page.len());
    }
}
