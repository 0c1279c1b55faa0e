//! Writes `report.html`: maps of the cells and the worst trials.

use crate::campaign::Variable;
use crate::error::CampaignError;
use crate::results::{CSV_FILE, PARQUET_FILE, unit_of_key};
use crate::row::Row;
use crate::sample::Quantile;
use crate::summary::{SUMMARY_FILE, Summary};
use crate::tally::Tally;
use platebench_record::Verdict;
use platebench_report::chart::{HeatAxis, HeatFigure, HeatPanel};
use platebench_report::format;
use platebench_report::page::{BlockPage, PageBlock};
use platebench_report::text::Table;
use std::path::Path;

pub const REPORT_FILE: &str = "report.html";
/// Bounds of the page's size.
const MAX_PANELS: usize = 12;
const MAX_PANEL_CELLS: usize = 10_000;
const MAX_VALUE_MAPS: usize = 6;

pub(crate) fn write(folder: &Path, summary: &Summary<'_>) -> Result<(), CampaignError> {
    let mut blocks = vec![PageBlock::Preformatted(summary.text())];
    blocks.extend(maps(summary)?);
    let quantiles = quantiles(summary);
    if !quantiles.rows.is_empty() {
        blocks.push(PageBlock::Heading("Quantiles".to_owned()));
        blocks.push(PageBlock::Table(quantiles));
    }
    blocks.push(PageBlock::Heading("Trials with the smallest margins".to_owned()));
    blocks.push(PageBlock::Table(worst_trials(summary)));
    if !summary.failing.is_empty() {
        let text = "Each failing trial of this table is a scenario in the folder counterexamples: play it with \
                    `platebench run` to see its response.";
        blocks.push(PageBlock::Text(text.to_owned()));
    }
    blocks.push(PageBlock::Heading("Files".to_owned()));
    blocks.extend([CSV_FILE, PARQUET_FILE, SUMMARY_FILE].map(|name| PageBlock::File(name.to_owned())));
    let page = BlockPage { title: summary.campaign.title.clone(), intro: String::new(), blocks };
    Ok(page.write(&folder.join(REPORT_FILE))?)
}

/// Listed values as axes of the maps, and the others as panels.
struct Layout<'a> {
    x: &'a Variable,
    y: Option<&'a Variable>,
    panels: usize,
}

impl<'a> Layout<'a> {
    /// The last two keys with numbers are the axes: they vary fastest.
    fn new(summary: &'a Summary<'_>) -> Option<Self> {
        let lists = || summary.campaign.variables.iter().filter(|variable| variable.distribution.choices().is_some());
        let long = |variable: &&Variable| length(variable) > 1;
        let mut axes = lists().filter(long).filter(|variable| variable.is_number()).rev();
        let (x, y) = (axes.next().or_else(|| lists().next_back())?, axes.next());
        let cells = length(x) * y.map_or(1, length);
        Some(Self { x, y, panels: summary.cells.len() / cells.max(1) })
    }
}

fn length(variable: &Variable) -> usize {
    variable.distribution.choices().map_or(1, <[_]>::len)
}

fn maps(summary: &Summary<'_>) -> Result<Vec<PageBlock>, CampaignError> {
    let Some(layout) = Layout::new(summary) else { return Ok(Vec::new()) };
    let cells_per_panel = summary.cells.len() / layout.panels.max(1);
    if layout.panels > MAX_PANELS || cells_per_panel > MAX_PANEL_CELLS {
        let text = format!("{} cells, too many for maps: see {CSV_FILE}", summary.cells.len());
        return Ok(vec![PageBlock::Text(text)]);
    }
    let figure = |title: String, is_low_bad, of: &dyn Fn(&Tally) -> Option<f64>| {
        let panels = panels(summary, &layout, of);
        let svg = HeatFigure { title: title.clone(), panels, is_low_bad }.svg()?;
        Ok::<_, CampaignError>((svg, title))
    };
    let share = |cell: &Tally| (cell.trials > 0).then(|| cell.failures as f64 / cell.trials as f64 * 100.0);
    let margin = |cell: &Tally| (cell.trials > 0).then_some(cell.smallest_margin);
    let mut drawings = vec![
        figure("share of failing trials, %".to_owned(), false, &share)?,
        figure("smallest margin, relative to the limit".to_owned(), true, &margin)?,
    ];
    let expectations = summary.campaign.template.scenario.expectations.iter().take(MAX_VALUE_MAPS);
    for (index, expectation) in expectations.enumerate() {
        let unit = format::unit(expectation.metric);
        let title =
            [&*expectation.name, unit].into_iter().filter(|part| !part.is_empty()).collect::<Vec<_>>().join(", ");
        drawings.push(figure(format!("mean {title}"), false, &|cell| cell.mean(index))?);
    }
    Ok(vec![PageBlock::Heading("Maps".to_owned()), PageBlock::Drawings(drawings)])
}

fn panels(summary: &Summary<'_>, layout: &Layout<'_>, of: &dyn Fn(&Tally) -> Option<f64>) -> Vec<HeatPanel> {
    let axis = |variable: Option<&Variable>| HeatAxis {
        label: variable.map(axis_label).unwrap_or_default(),
        values: variable.map_or_else(
            || vec![String::new()],
            |variable| variable.distribution.choices().unwrap_or_default().iter().map(ToString::to_string).collect(),
        ),
    };
    let (x, y) = (axis(Some(layout.x)), axis(layout.y));
    let empty = vec![vec![None; x.values.len()]; y.values.len()];
    let mut panels: Vec<HeatPanel> = Vec::new();
    for (number, cell) in summary.cells.iter().enumerate() {
        let (mut column, mut row, mut title) = (0, 0, Vec::new());
        for (variable, choice) in summary.cell_choices(number) {
            if std::ptr::eq(variable, layout.x) {
                column = choice;
            } else if layout.y.is_some_and(|y| std::ptr::eq(variable, y)) {
                row = choice;
            } else {
                let name = variable.key.rsplit('.').next().unwrap_or_default();
                title.push(format!("{name} {}", variable.distribution.text(choice as f64)));
            }
        }
        let title = title.join(", ");
        let place = panels.iter().position(|panel| panel.title == title).unwrap_or_else(|| {
            panels.push(HeatPanel { title, x: x.clone(), y: y.clone(), values: empty.clone() });
            panels.len() - 1
        });
        let panel = panels.get_mut(place).and_then(|panel| panel.values.get_mut(row)?.get_mut(column));
        if let Some(value) = panel {
            *value = of(cell);
        }
    }
    panels
}

fn axis_label(variable: &Variable) -> String {
    match unit_of_key(&variable.key) {
        "" => variable.key.clone(),
        unit => format!("{}, {unit}", variable.key),
    }
}

fn quantiles(summary: &Summary<'_>) -> Table {
    let mut table = Table::new(["expectation", "share of trials below", "value", "from", "to"]);
    let number = |value: f64| if value.is_finite() { format!("{value:.4}") } else { "–".to_owned() };
    let quantiles = summary.sample.quantiles(summary.campaign).into_iter();
    let row = |quantile: Quantile| {
        let [low, high] = quantile.interval.map(number);
        vec![quantile.expectation, format!("{} %", quantile.share * 100.0), number(quantile.value), low, high]
    };
    table.rows = quantiles.map(row).collect();
    table
}

fn worst_trials(summary: &Summary<'_>) -> Table {
    let campaign = summary.campaign;
    let names = campaign.expectation_names();
    let keys = campaign.variables.iter().map(axis_label);
    let header: Vec<_> =
        ["trial", "verdict", "margin"].map(str::to_owned).into_iter().chain(keys).chain(names).collect();
    let mut table = Table::new(header.iter().map(|name| &**name));
    let row = |row: &Row| {
        let cause = row.cause.filter(|_| row.verdict != Verdict::Pass).map(|cause| format!(" ({cause})"));
        let mut cells = vec![
            row.trial.to_string(),
            format!("{}{}", row.verdict, cause.unwrap_or_default()),
            format!("{:.4}", row.margin()),
        ];
        let variables = campaign.variables.iter().zip(&row.draws);
        cells.extend(variables.map(|(variable, draw)| match variable.distribution.number(*draw) {
            Some(number) => format!("{number:.6}").trim_end_matches('0').trim_end_matches('.').to_owned(),
            None => variable.distribution.text(*draw),
        }));
        cells
            .extend(row.values.iter().map(|value| if value.is_nan() { "–".to_owned() } else { format!("{value:.4}") }));
        cells
    };
    table.rows = summary.worst.iter().map(row).collect();
    table
}
