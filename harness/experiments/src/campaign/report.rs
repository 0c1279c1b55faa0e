//! Writes `report.html`: maps of the cells, which are the combinations of listed values, and the
//! worst trials.

use crate::campaign::distribution::Variable;
use crate::campaign::error::CampaignError;
use crate::campaign::passing_region::PassingRegion;
use crate::campaign::results::{CSV_FILE, PARQUET_FILE, axis_label, with_unit};
use crate::campaign::row::{Tally, TrialRow, margin_text};
use crate::campaign::sample::{FirstOrderIndex, Quantile, RankSensitivity, SampleResult};
use crate::campaign::summary::{SUMMARY_FILE, Summary};
use crate::campaign::worst_run::ResponseLinks;
use platebench_document::chart::{HeatAxis, HeatFigure, HeatPanel, HeatScale};
use platebench_document::{AreaLink, Block, Cell, Column, Document, Figure, Table};
use platebench_model::record::Verdict;
use std::path::Path;

pub const REPORT_FILE: &str = "report.html";

/// Writes the page and returns its content.
pub fn write(folder: &Path, summary: &Summary<'_>, links: &ResponseLinks) -> Result<Document, CampaignError> {
    let document = document(summary, links);
    document.write(&folder.join(REPORT_FILE))?;
    Ok(document)
}

fn document(summary: &Summary<'_>, links: &ResponseLinks) -> Document {
    let mut blocks = vec![Block::lines(summary.lines()), Block::Details(maps(summary, links))];
    let (region, further_ranges) = PassingRegion::new(summary).map(|region| region.blocks()).unwrap_or_default();
    blocks.extend(region);
    let sample = summary.sample.result(summary.campaign);
    let sensitivities = sensitivities(&sample);
    if !sensitivities.rows.is_empty() {
        blocks.push(Block::heading("Rank correlation with the smallest margin, and first-order index"));
        blocks.push(Block::Table(sensitivities));
    }
    let mut details = Vec::new();
    if let Some(ranges) = further_ranges {
        details.extend([Block::heading("Further combinations"), ranges]);
    }
    let quantiles = quantiles(&sample);
    if !quantiles.rows.is_empty() {
        details.extend([Block::heading("Quantiles"), Block::Table(quantiles)]);
    }
    details.extend([Block::heading("Trials with the smallest margins"), Block::Table(worst_trials(summary, links))]);
    if !summary.failing.is_empty() {
        details.push(Block::paragraph(
            "Each failing trial of this table is a scenario in the folder counterexamples; `platebench run` plays it \
             again.",
        ));
    }
    details.push(Block::heading("Files"));
    details.extend([CSV_FILE, PARQUET_FILE, SUMMARY_FILE].map(|name| Block::File(name.to_owned())));
    blocks.push(Block::Details(details));
    Document::new(&summary.campaign.title, blocks)
}

fn sensitivities(sample: &SampleResult) -> Table {
    let number = |name: &str| Column::number(name, "");
    let names = ["rank correlation", "from", "to", "first-order index", "from", "to"];
    let mut table = Table::new([Column::from("value")].into_iter().chain(names.map(number)));
    table.extend(sample.sensitivities.iter().map(|sensitivity| {
        let RankSensitivity { key, correlation, interval: [low, high], first_order } = sensitivity;
        let index = first_order.map(|FirstOrderIndex { index, interval: [low, high] }| [index, low, high]);
        let index = index.map_or_else(|| [const { String::new() }; 3], |index| index.map(|part| format!("{part:.3}")));
        [key.clone()].into_iter().chain([correlation, low, high].map(|part| format!("{part:.3}"))).chain(index)
    }));
    table
}

fn quantiles(sample: &SampleResult) -> Table {
    let mut table = Table::new(["expectation", "share of trials below", "value", "from", "to"]);
    let number = |value: f64| if value.is_finite() { format!("{value:.4}") } else { "–".to_owned() };
    table.extend(sample.quantiles.iter().map(|Quantile { expectation, share, value, interval }| {
        let [low, high] = interval.map(number);
        [expectation.clone(), format!("{} %", share * 100.0), number(*value), low, high]
    }));
    table
}

fn worst_trials(summary: &Summary<'_>, links: &ResponseLinks) -> Table {
    let campaign = summary.campaign;
    let names = campaign.expectation_names();
    let keys = campaign.variables.iter().map(axis_label);
    let header: Vec<_> =
        ["trial", "verdict", "margin"].map(str::to_owned).into_iter().chain(keys).chain(names).collect();
    let mut table = Table::new(header);
    let row = |row: &TrialRow| {
        let cause = row.cause.filter(|_| row.verdict != Verdict::Pass).map(|cause| format!(" ({cause})"));
        let response = links.get(&row.trial);
        let mut cells = vec![
            Cell::from(row.trial.to_string()).with_link(response.map(|response| response.link.clone())),
            Cell::from(format!("{}{}", row.verdict, cause.unwrap_or_default()))
                .with_notes(response.and_then(|response| response.reason.clone())),
            margin_text(row.margin()).into(),
        ];
        let variables = campaign.variables.iter().zip(&row.draws);
        cells.extend(variables.map(|(variable, draw)| Cell::from(variable.text(*draw))));
        let value = |value: &f64| Cell::from(if value.is_nan() { "–".to_owned() } else { format!("{value:.4}") });
        cells.extend(row.values.iter().map(value));
        cells
    };
    table.extend(summary.worst.iter().map(row));
    table
}

/// Limits of the number and size of maps, because larger maps make the page too large.
const MAX_PANELS: usize = 12;
const MAX_PANEL_CELLS: usize = 10_000;
const MAX_VALUE_MAPS: usize = 6;

/// Axes of each map. Each combination of the other listed values has its own panel.
struct Layout<'a> {
    x: &'a Variable,
    y: Option<&'a Variable>,
    panels: usize,
}

impl<'a> Layout<'a> {
    /// The axes are the last two variables with listed numbers, because these vary fastest.
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

fn maps(summary: &Summary<'_>, links: &ResponseLinks) -> Vec<Block> {
    let Some(layout) = Layout::new(summary) else { return Vec::new() };
    let cells_per_panel = summary.cells.len() / layout.panels.max(1);
    if layout.panels > MAX_PANELS || cells_per_panel > MAX_PANEL_CELLS {
        let text = format!("{} cells, too many for maps: see {CSV_FILE}", summary.cells.len());
        return vec![Block::Paragraph(text)];
    }
    let places = layout.places(summary);
    let figure = |title: String, scale, of: &dyn Fn(&Tally) -> Option<f64>| {
        let panels = places.panels(summary, of);
        let figure = HeatFigure { title, panels, scale };
        let links = places.links(summary, &figure, links);
        Figure { svg: figure.svg(), caption: figure.title, links }
    };
    let share = |cell: &Tally| (cell.trials > 0).then(|| cell.failures as f64 / cell.trials as f64 * 100.0);
    let margin = |cell: &Tally| (cell.trials > 0).then_some(cell.smallest_margin);
    let mut figures = vec![
        figure("share of failing trials, %".to_owned(), HeatScale::Range, &share),
        figure("smallest margin, relative to the limit".to_owned(), HeatScale::Diverging, &margin),
    ];
    let expectations = summary.campaign.template.scenario.expectations.iter().take(MAX_VALUE_MAPS);
    for (index, expectation) in expectations.enumerate() {
        let title = with_unit(&expectation.name, expectation.metric.spec().unit.symbol());
        figures.push(figure(format!("mean {title}"), HeatScale::Range, &|cell| cell.mean(index)));
    }
    let mut blocks = vec![Block::heading("Maps")];
    if !links.is_empty() {
        blocks.push(Block::paragraph("A cell opens the response of its worst trial."));
    }
    blocks.push(Block::Figures(figures));
    blocks
}

struct Places {
    /// Panels with titles, axes and passing cells, without values.
    panels: Vec<HeatPanel>,
    /// Panel, column and row of each cell.
    cells: Vec<(usize, usize, usize)>,
}

impl Layout<'_> {
    fn places(&self, summary: &Summary<'_>) -> Places {
        let axis = |variable: Option<&Variable>| HeatAxis {
            label: variable.map(axis_label).unwrap_or_default(),
            values: variable.map_or_else(
                || vec![String::new()],
                |variable| {
                    variable.distribution.choices().unwrap_or_default().iter().map(ToString::to_string).collect()
                },
            ),
        };
        let (x, y) = (axis(Some(self.x)), axis(self.y));
        let values = vec![vec![None; x.values.len()]; y.values.len()];
        let passes = vec![vec![None; x.values.len()]; y.values.len()];
        let mut places = Places { panels: Vec::new(), cells: Vec::new() };
        for number in 0..summary.cells.len() {
            let (is_x, is_y) = (
                |variable: &Variable| std::ptr::eq(variable, self.x),
                |variable: &Variable| self.y.is_some_and(|y| std::ptr::eq(variable, y)),
            );
            let choices = summary.campaign.cell_choices(number);
            let choice = |is_axis: &dyn Fn(&Variable) -> bool| {
                choices.iter().find(|(variable, _)| is_axis(variable)).map_or(0, |(_, choice)| *choice)
            };
            let (column, row) = (choice(&is_x), choice(&is_y));
            let title = summary.campaign.cell_text(number, |variable| !is_x(variable) && !is_y(variable));
            let panels = &mut places.panels;
            let panel = panels.iter().position(|panel| panel.title == title).unwrap_or_else(|| {
                let (x, y, values, passes) = (x.clone(), y.clone(), values.clone(), passes.clone());
                panels.push(HeatPanel { title, x, y, values, passes });
                panels.len() - 1
            });
            let passes = panels.get_mut(panel).and_then(|panel| panel.passes.get_mut(row)?.get_mut(column));
            if let (Some(passes), Some(cell)) = (passes, summary.cells.get(number)) {
                *passes = cell.passes(summary.campaign.at_most);
            }
            places.cells.push((panel, column, row));
        }
        places
    }
}

impl Places {
    fn panels(&self, summary: &Summary<'_>, of: &dyn Fn(&Tally) -> Option<f64>) -> Vec<HeatPanel> {
        let mut panels = self.panels.clone();
        for (cell, (panel, column, row)) in summary.cells.iter().zip(&self.cells) {
            let value = panels.get_mut(*panel).and_then(|panel| panel.values.get_mut(*row)?.get_mut(*column));
            if let Some(value) = value {
                *value = of(cell);
            }
        }
        panels
    }

    fn links(&self, summary: &Summary<'_>, figure: &HeatFigure, links: &ResponseLinks) -> Vec<AreaLink> {
        let link = |(number, (cell, (panel, column, row))): (usize, (&Tally, &(usize, usize, usize)))| {
            let href = links.get(&cell.worst_trial).filter(|_| cell.trials > 0)?.link.clone();
            let title = format!("{}; trial {}", summary.campaign.cell_text(number, |_| true), cell.worst_trial);
            Some(AreaLink { area: figure.cell_area(*panel, *column, *row)?, href, title })
        };
        summary.cells.iter().zip(&self.cells).enumerate().filter_map(link).collect()
    }
}
