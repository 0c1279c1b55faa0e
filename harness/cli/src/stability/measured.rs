//! Measures the margins of a controller on a rig.

use super::StabilityArgs;
use crate::exit::{CommandResult, Exit, Failure, OrInvalid};
use crate::options::job_count;
use crate::selection::warn_of_plate;
use crate::shutdown::{EventSender, run_until_signal, unless_signalled};
use crate::stdio;
use platebench_design::margins::report::build_section;
use platebench_design::margins::result::{CaseMargins, MarginReport};
use platebench_design::margins::scenes::{PointChoice, Quantity};
use platebench_design::margins::{MarginConfig, MarginError, identify, measure_margins, select_requirements};
use platebench_document::write_chart_page;
use platebench_engine::SafeEnds;
use platebench_model::record::Cause;
use platebench_model::scenario::load::{ScenarioTemplate, load_plate, load_template};
use platebench_model::scenario::{OWN_LAW, Scenario};
use platebench_model::trace::create_folder;
use platebench_rig::{CancelToken, ConnectOptions, RigSpec};
use platebench_wire::LawId;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

const SCENARIO: &str = "scenarios/paper/fig13-closed-loop.toml";
const PROGRESS_INTERVAL: Duration = Duration::from_secs(10);

pub(super) fn measure(arguments: &StabilityArgs, rig: &RigSpec) -> CommandResult {
    for rig in [Some(rig), arguments.reference.as_ref()].into_iter().flatten() {
        rig.check().or_invalid()?;
    }
    let search = MarginSearch {
        template: template(arguments)?,
        points: points(arguments),
        laws: arguments.laws.clone(),
        requirement: arguments.requirement.clone(),
        quantities: quantities(arguments),
        jobs: job_count(arguments.jobs),
        reply_timeout: arguments.reply_timeout,
    };
    // Refuses values that no scenario can have before the rig is started.
    search.cases(arguments.laws.first().map_or(OWN_LAW, |law| law))?;
    if let Some(folder) = &arguments.out {
        create_folder(folder).or_invalid_at(folder)?;
    }
    let (rig, reference) = (rig.clone(), arguments.reference.clone());
    let ends = Arc::new(SafeEnds::default());
    let recorded = Arc::clone(&ends);
    let work = move |cancel: &CancelToken, events: &mut EventSender<(usize, usize)>| {
        search.run(&rig, reference.as_ref(), cancel, &recorded, &mut |done, all| events.send((done, all)))
    };
    let mut last = Instant::now();
    let ended = run_until_signal(None, work, |(done, all)| {
        if last.elapsed() >= PROGRESS_INTERVAL {
            last = Instant::now();
            stdio::note(&format!("{done} of {all} searches"));
        }
    });
    let report = unless_signalled(ended)?;
    let section = build_section(&report);
    if let Some(folder) = &arguments.out {
        let title = section.document.title.clone();
        write_chart_page(folder, "stability.html", &title, String::new(), std::slice::from_ref(&section))
            .or_invalid()?;
    }
    stdio::show_result(arguments.format, &report, &section.document);
    if ends.are_confirmed() && !ends.have_drive() {
        return Ok(Exit::Passed);
    }
    let message =
        "the controller did not confirm 0 V, or did not stay there: check the amplifier before you touch the plate";
    Err(Failure::new(Exit::Unreachable, &message))
}

fn template(arguments: &StabilityArgs) -> Result<ScenarioTemplate, Failure> {
    let path = arguments.scenario.as_deref().unwrap_or_else(|| Path::new(SCENARIO));
    let plate = match &arguments.plate {
        Some(plate) => {
            warn_of_plate(plate, &load_plate(plate)?);
            Some(std::path::absolute(plate).or_invalid_at(plate)?.to_string_lossy().into_owned())
        }
        None => None,
    };
    let template = load_template(path, &path.to_string_lossy(), |table| {
        if let Some(plate) = plate {
            table.insert("plate".to_owned(), plate.into());
        }
    });
    Ok(template?)
}

fn quantities(arguments: &StabilityArgs) -> Vec<Quantity> {
    let named = |quantity: &Quantity| arguments.margins.iter().any(|name| name == quantity.key());
    Quantity::ALL.into_iter().filter(|quantity| arguments.margins.is_empty() || named(quantity)).collect()
}

/// All combinations of the values that the user names.
fn points(arguments: &StabilityArgs) -> Vec<PointChoice> {
    let mut points = vec![PointChoice::default()];
    vary(&mut points, &arguments.period_ms, |point, value| point.period_ms = Some(value));
    vary(&mut points, &arguments.setpoint_um, |point, value| point.setpoint_um = Some(value));
    vary(&mut points, &arguments.detuning_hz, |point, value| point.detuning_hz = Some(value));
    vary(&mut points, &arguments.force_n, |point, value| point.force_n = Some(value));
    points
}

/// Replaces each point by one per value. Without values, the points stay.
fn vary(points: &mut Vec<PointChoice>, values: &[f64], set: impl Fn(&mut PointChoice, f64)) {
    if values.is_empty() {
        return;
    }
    let varied = |point: &PointChoice| {
        let mut each = vec![*point; values.len()];
        each.iter_mut().zip(values).for_each(|(point, value)| set(point, *value));
        each
    };
    *points = points.iter().flat_map(varied).collect();
}

struct MarginSearch {
    template: ScenarioTemplate,
    points: Vec<PointChoice>,
    /// Empty for the law of the scenario, or the controller's own if it announces none.
    laws: Vec<String>,
    requirement: Option<String>,
    quantities: Vec<Quantity>,
    jobs: usize,
    reply_timeout: Duration,
}

impl MarginSearch {
    fn run(
        &self,
        rig: &RigSpec,
        reference: Option<&RigSpec>,
        cancel: &CancelToken,
        ends: &SafeEnds,
        on_progress: &mut dyn FnMut(usize, usize),
    ) -> Result<MarginReport, MarginError> {
        let (mut cases, not_applicable) = self.measure(rig, false, &self.laws, cancel, ends, on_progress)?;
        if cases.is_empty() {
            return Err(MarginError::NotApplicable(not_applicable.join("\n")));
        }
        if let Some(reference) = reference {
            let is_measured = |name: &&str| {
                let same = |case: &CaseMargins| case.law == *name && case.rig == reference.to_string();
                cases.iter().any(same)
            };
            let laws = LawId::ALL.map(LawId::name).into_iter().filter(|name| !is_measured(name)).map(str::to_owned);
            let laws: Vec<String> = laws.collect();
            cases.extend(self.measure(reference, true, &laws, cancel, ends, on_progress)?.0);
        }
        Ok(MarginReport { scenario: self.template.scenario.file.clone(), cases, not_applicable })
    }

    fn measure(
        &self,
        rig: &RigSpec,
        is_reference: bool,
        laws: &[String],
        cancel: &CancelToken,
        ends: &SafeEnds,
        on_progress: &mut dyn FnMut(usize, usize),
    ) -> Result<(Vec<CaseMargins>, Vec<String>), MarginError> {
        let options =
            ConnectOptions { cancel: cancel.clone(), reply_timeout: self.reply_timeout, ..ConnectOptions::default() };
        let connect = || rig.connect_with(&options);
        let announces_none = laws.is_empty() && identify(&connect, ends, cancel)?.laws == 0;
        let default = if announces_none { OWN_LAW } else { &self.template.scenario.controller.law };
        let default = [default.to_owned()];
        let laws = if laws.is_empty() { &default[..] } else { laws };
        let cases = laws.iter().map(|law| self.cases(law)).collect::<Result<Vec<_>, _>>()?.concat();
        let config = MarginConfig {
            rig: rig.to_string(),
            is_reference,
            cases: &cases,
            quantities: &self.quantities,
            own_clock: rig.has_own_clock(),
            jobs: if rig.allows_parallel_links() { self.jobs } else { 1 },
            cancel,
        };
        measure_margins(&config, &connect, ends, on_progress)
    }

    fn cases(&self, law: &str) -> Result<Vec<Scenario>, MarginError> {
        let case = |point: &PointChoice| {
            let mut scenario = point.scenario(&self.template, law).map_err(MarginError::Files)?;
            select_requirements(&mut scenario, self.requirement.as_deref())?;
            Ok(scenario)
        };
        self.points.iter().map(case).collect()
    }
}

impl From<MarginError> for Failure {
    fn from(error: MarginError) -> Self {
        match error {
            MarginError::Files(faults) => faults.into(),
            MarginError::Run(error) => error.into(),
            MarginError::SeveralTrials { .. } | MarginError::NoRequirement { .. } | MarginError::Analysis(_) => {
                Self::invalid(&error)
            }
            MarginError::NotApplicable(_) => Self::new(Exit::NothingToRun, &error),
            MarginError::Undecided { cause: Cause::Rig, .. } => Self::new(Exit::Unreachable, &error),
            MarginError::Undecided { .. } => Self::new(Exit::Inconclusive, &error),
        }
    }
}
