//! The cheapest plate that is good enough, scenario by scenario: the one that `model = "auto"` chooses beforehand beside the one that would have done.

use super::{ChartError, Charted, Folder, counted, quoted};
use platebench_plate::Tier;
use platebench_report::chart::{Block, Row, Strip, Table};
use platebench_runner::Cancel;
use platebench_runner::fidelity::{TierError, tier_errors};
use platebench_scenario::Scenario;
use std::fmt::Write as _;

const FILE: &str = "scenes.csv";
const DRAWING: &str = "scenes.svg";
/// Smallest error that is told apart from none.
const LEAST: f64 = 1e-9;
const DEARER: &str = "dearer than needed";
const UNCLAIMED: &str = "dearer: no bound is known";
const OVER: &str = "OVER BUDGET";

/// A scenario with what was chosen for it and what was measured.
struct Found {
    file: String,
    law: String,
    budget: f64,
    /// What `auto` chooses, whatever the scenario names.
    picked: Tier,
    bound: f64,
    /// Bounds of [`Tier::ALL`].
    bounds: Vec<f64>,
    /// Of [`Tier::ALL`], cheapest first.
    errors: Vec<TierError>,
}

impl Found {
    fn of(scenario: &Scenario) -> Result<Self, ChartError> {
        let mut scenario = scenario.clone();
        scenario.model.asked = None;
        scenario.choose_model(true);
        let errors = tier_errors(&scenario, &Cancel::default())
            .map_err(|why| ChartError::NotPlayed { file: scenario.file.clone(), why: why.to_string() })?;
        let bounds = Tier::ALL.map(|tier| scenario.bound(tier, true)).into();
        let (budget, bound) = (scenario.model.budget, scenario.model.bound);
        Ok(Self {
            file: scenario.file,
            law: scenario.controller.law,
            budget,
            picked: scenario.tier,
            bound,
            bounds,
            errors,
        })
    }

    fn error_of(&self, tier: Tier) -> f64 {
        self.errors.iter().find(|error| error.tier == tier).map_or(f64::INFINITY, |error| error.watched)
    }

    /// The cheapest tier whose measured error was within the budget; the chosen one where none cheaper was.
    fn cheapest(&self) -> Tier {
        let cheaper = self.errors.iter().filter(|error| error.tier < self.picked);
        cheaper.filter(|error| error.watched <= self.budget).map(|error| error.tier).next().unwrap_or(self.picked)
    }

    fn is_dearer(&self) -> bool {
        self.cheapest() < self.picked
    }

    /// True where nothing was known beforehand of the tier that would have done.
    fn is_unclaimed(&self) -> bool {
        let cheapest = self.cheapest();
        self.is_dearer()
            && self.errors.iter().zip(&self.bounds).any(|(error, bound)| error.tier == cheapest && bound.is_infinite())
    }

    /// The exact tiers have no error of their own to hold against a budget.
    fn is_over(&self) -> bool {
        let error = self.error_of(self.picked);
        error > self.budget && error > LEAST
    }

    fn remark(&self) -> &'static str {
        match self {
            _ if self.is_over() => OVER,
            _ if self.is_unclaimed() => UNCLAIMED,
            _ if self.is_dearer() => DEARER,
            _ => "",
        }
    }
}

/// Plays every scenario on every tier and draws what came of it.
pub(crate) fn chart(scenarios: &[Scenario], folder: &Folder) -> Result<Charted, ChartError> {
    let found = scenarios.iter().map(Found::of).collect::<Result<Vec<_>, _>>()?;
    folder.write(FILE, &csv(&found))?;
    let svg = drawing(&found).svg()?;
    folder.write(DRAWING, &svg)?;
    let summary = tally(&found);
    let mut blocks: Vec<Block> = EXPLANATION.map(|text| Block::Text(text.to_owned())).into();
    blocks.push(Block::Text(summary.clone()));
    blocks.push(Block::Drawing(
        svg,
        format!("{}: error of every tier, budget and choice", counted(found.len(), "scenario")),
    ));
    let dearer: Vec<Vec<String>> = found.iter().filter(|found| !found.remark().is_empty()).map(line).collect();
    if !dearer.is_empty() {
        blocks.push(Block::Table(Table { head: HEAD.map(str::to_owned).into(), rows: dearer }));
    }
    blocks.push(Block::File(FILE.to_owned()));
    Ok(Charted { blocks, summary: summary + "\n" })
}

const EXPLANATION: [&str; 3] = [
    "For every scenario, from left to right, how far each tier of the plate ends from the exact one: the largest |ΔW|/setpoint over what the scenario's expectations look at, the law in the loop, on \
     the hosted rig. Each was really played. Exact tiers stand at 0.",
    "The stroke is the budget, a tenth of the scenario's tightest tolerance; the ring is the tier that model = \"auto\" chooses before anything is played, as the cheapest whose bound is within the budget.",
    "A bound is no measurement: it has to hold for whatever the law does. Where a cheaper tier than the chosen one would have been within the budget the scenario is marked, and where that is because no bound is \
     known for such a loop at all (it decides, saturates, is not linear, or its line has faults), that is said. A scenario without a stroke bears no error at all: it asks whether a drive was at its limit.",
];

fn tally(found: &[Found]) -> String {
    let count = |is: &dyn Fn(&Found) -> bool| found.iter().filter(|found| is(found)).count();
    let picks = Tier::ALL.into_iter().filter_map(|tier| {
        let picked = count(&|found| found.picked == tier);
        (picked > 0).then(|| format!("{} for {picked}", tier.name()))
    });
    format!(
        "{}: auto chooses {}. Dearer than needed in {}, in {} of them because no bound is known; over budget in {}.",
        counted(found.len(), "scenario"),
        picks.collect::<Vec<_>>().join(", "),
        count(&Found::is_dearer),
        count(&Found::is_unclaimed),
        count(&Found::is_over),
    )
}

const HEAD: [&str; 8] =
    ["scenario", "law", "budget", "chosen", "its bound", "its error", "would have done", "with an error of"];

fn line(found: &Found) -> Vec<String> {
    let number = |value: f64| if value == 0.0 { "0".to_owned() } else { format!("{value:.1e}") };
    let cheapest = found.cheapest();
    vec![
        found.file.clone(),
        found.law.clone(),
        number(found.budget),
        found.picked.name().to_owned(),
        number(found.bound),
        number(found.error_of(found.picked)),
        cheapest.name().to_owned(),
        number(found.error_of(cheapest)),
    ]
}

fn csv(found: &[Found]) -> String {
    let mut text = "scenario,law,budget,chosen,bound_of_chosen".to_owned();
    for what in ["bound", "error", "error_anywhere"] {
        text.extend(Tier::ALL.map(|tier| format!(",{what}_{}", tier.name())));
    }
    text += ",cheapest_within_budget,remark\n";
    for row in found {
        let _ =
            write!(text, "{},{},{:e},{},{:e}", quoted(&row.file), row.law, row.budget, row.picked.name(), row.bound);
        text.extend(row.bounds.iter().map(|bound| format!(",{bound:e}")));
        text.extend(row.errors.iter().map(|error| format!(",{:e}", error.watched)));
        text.extend(row.errors.iter().map(|error| format!(",{:e}", error.anywhere)));
        let _ = writeln!(text, ",{},{}", row.cheapest().name(), row.remark());
    }
    text
}

fn drawing(found: &[Found]) -> Strip {
    let row = |found: &Found| Row {
        name: found.file.trim_end_matches(".toml").to_owned(),
        allowed: (found.budget > 0.0).then_some(found.budget),
        found: found.errors.iter().enumerate().map(|(number, error)| (number, error.watched)).collect(),
        chosen: found.errors.iter().position(|error| error.tier == found.picked).unwrap_or_default(),
        remark: found.remark().to_owned(),
    };
    Strip {
        title: "The cheapest plate that is good enough".to_owned(),
        x_label: "largest |ΔW| / setpoint".to_owned(),
        least: LEAST,
        colours: Tier::ALL.map(|tier| tier.name().to_owned()).into(),
        chosen_label: "ring: chosen by auto".to_owned(),
        allowed_label: "budget".to_owned(),
        rows: found.iter().map(row).collect(),
    }
}
