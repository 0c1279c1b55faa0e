//! Writes `report.html`: maps of the cells and the worst trials.

use crate::campaign::error::CampaignError;
use crate::campaign::maps;
use crate::campaign::results::{CSV_FILE, PARQUET_FILE};
use crate::campaign::row::Row;
use crate::campaign::sample::Quantile;
use crate::campaign::summary::{SUMMARY_FILE, Summary};
use crate::campaign::worst_run::ResponseLinks;
use platebench_model::record::Verdict;
use platebench_report::page::{BlockPage, PageBlock};
use platebench_report::text::Table;
use std::path::Path;

pub const REPORT_FILE: &str = "report.html";

pub fn write(folder: &Path, summary: &Summary<'_>, links: &ResponseLinks) -> Result<(), CampaignError> {
    let mut blocks = vec![PageBlock::Preformatted(summary.text())];
    blocks.extend(maps::blocks(summary, links)?);
    let quantiles = quantiles(summary);
    if !quantiles.rows.is_empty() {
        blocks.push(PageBlock::Heading("Quantiles".to_owned()));
        blocks.push(PageBlock::Table(quantiles));
    }
    blocks.push(PageBlock::Heading("Trials with the smallest margins".to_owned()));
    let worst_links = summary.worst.iter().map(|row| links.get(&row.trial).cloned());
    blocks.push(PageBlock::LinkedTable(worst_trials(summary), worst_links.collect()));
    if !summary.failing.is_empty() {
        let text = "Each failing trial of this table is a scenario in the folder counterexamples; \
                    `platebench run` plays it again.";
        blocks.push(PageBlock::Text(text.to_owned()));
    }
    blocks.push(PageBlock::Heading("Files".to_owned()));
    blocks.extend([CSV_FILE, PARQUET_FILE, SUMMARY_FILE].map(|name| PageBlock::File(name.to_owned())));
    let page = BlockPage { title: summary.campaign.title.clone(), intro: String::new(), blocks };
    Ok(page.write(&folder.join(REPORT_FILE))?)
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
    let keys = campaign.variables.iter().map(maps::axis_label);
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
        cells.extend(variables.map(|(variable, draw)| variable.text(*draw)));
        cells
            .extend(row.values.iter().map(|value| if value.is_nan() { "–".to_owned() } else { format!("{value:.4}") }));
        cells
    };
    table.rows = summary.worst.iter().map(row).collect();
    table
}
