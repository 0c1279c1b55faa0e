//! `platebench stability`: predicts and measures where methods and loops become unstable.

use crate::exit::{CommandResult, Exit, Failure, OrInvalid};
use crate::options::{bench_law_names, job_count, parse_number};
use crate::selection::warn_of_plate;
use crate::stdio;
use clap::Args;
use platebench_design::stability::{StudyConfig, build_chart, rig_delay};
use platebench_model::record::RunRecord;
use platebench_model::scenario::load::{load_plate, require_no_effects};
use platebench_model::trace::create_folder;
use platebench_report::Style;
use platebench_report::chart::RigDelay;
use platebench_report::page::write_chart_page;
use platebench_wire::LawId;
use std::path::{Path, PathBuf};

const HIGHEST_DELAY_US: f64 = 12e3;

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench stability                                   methods; every law at resonance, detuned, with a finger
  platebench stability --out /tmp/stability              also CSV, a map per law and a page
  platebench stability --law dq-pi --law deadbeat        two laws
  platebench stability --run runs/night --out /tmp/maps  with the measured loop delay of a run in the maps")]
pub(crate) struct StabilityArgs {
    /// Folder for CSV, maps and page; default: only the table
    #[arg(long, value_name = "FOLDER")]
    out: Option<PathBuf>,
    /// Control laws of the firmware under test; default: all
    #[arg(long = "law", value_name = "NAME", value_parser = bench_law_names())]
    laws: Vec<String>,
    /// The plate file
    #[arg(long, value_name = "FILE", default_value = "scenarios/plates/aluminium-198x138.toml")]
    plate: PathBuf,
    /// Measured loop delay of a rig, µs; margins and maps include it
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
    let expected = format!("a delay in µs from 0 to {HIGHEST_DELAY_US}");
    parse_number(text, |delay| (0.0..=HIGHEST_DELAY_US).contains(&delay), &expected)
}

pub(crate) fn stability(arguments: &StabilityArgs) -> CommandResult {
    stdio::show(&analyse(arguments)?);
    Ok(Exit::Passed)
}

fn analyse(arguments: &StabilityArgs) -> Result<String, Failure> {
    let plate = load_plate(&arguments.plate)?;
    warn_of_plate(&arguments.plate, &plate);
    require_no_effects(&arguments.plate, &plate, "stability")?;
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
            plate: Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios/plates/aluminium-198x138.toml"),
            measured_delay_us: None,
            run: None,
            jobs: Some(1),
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
        let rows = step_limits(&load_plate(&arguments(None).plate).unwrap());
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
