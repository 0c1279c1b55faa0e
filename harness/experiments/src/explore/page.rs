//! Renders `report.html`: properties, violations with their scenes, and coverage.

use crate::explore::coverage::RangeCoverage;
use crate::explore::report::{CoverageReport, ExploreReport, PropertyReport, ViolationReport, format_value};
use platebench_report::document::{Block, Document, Figure, Table};
use std::fmt::Write as _;

pub const FILE: &str = "report.html";

/// Size of a field of a drawing, and width of the names next to the fields, px.
const FIELD: usize = 22;
const NAMES: usize = 210;

pub fn page(report: &ExploreReport) -> Document {
    let ExploreReport { verdict, law, envelope, rig, seed, .. } = report;
    let mut blocks = vec![Block::Table(properties(report))];
    for violation in &report.violations {
        blocks.extend(violation_blocks(violation));
    }
    blocks.push(Block::Heading("Coverage".to_owned()));
    blocks.push(Block::Paragraph(
        "The drawings show how many values of each quantity lie in each tenth of its range, and how often one change \
         followed another. A darker field has a higher count; an empty field has the count 0."
            .to_owned(),
    ));
    blocks.push(Block::Figures(drawings(&report.coverage)));
    blocks.push(Block::Table(ranges(&report.coverage)));
    Document {
        title: format!("{verdict}: exploration of {law}"),
        lead: format!("{envelope}, seed {seed}, on {rig}. {}", report.conclusion()),
        blocks,
    }
}

pub(crate) fn properties(report: &ExploreReport) -> Table {
    let mut table = Table::new(["property", "windows", "violations", "smallest margin", "in scene"]);
    table.extend(report.properties.iter().map(|PropertyReport { property, tally }| {
        let margin = tally.smallest_margin;
        vec![
            property.to_string(),
            tally.windows.to_string(),
            tally.violations.to_string(),
            if margin.is_finite() { format!("{:.1} %", margin * 100.0) } else { "–".to_owned() },
            tally.tightest_scene.to_string(),
        ]
    }));
    table
}

fn violation_blocks(violation: &ViolationReport) -> [Block; 6] {
    let measured = |value, limit| format!("measured {}, limit {}", format_value(value, 6), format_value(limit, 6));
    let reproduced = if violation.is_reproduced { "" } else { " The scene did not fail again with a new controller." };
    [
        Block::Heading(format!("Violated: {}", violation.property)),
        Block::Paragraph(format!(
            "Minimal scene, {}.{reproduced} Its file is {}.",
            measured(violation.minimal_value, violation.minimal_limit),
            violation.file
        )),
        Block::Preformatted(violation.minimal.clone()),
        Block::Paragraph(format!(
            "Original scene {}, {}.",
            violation.scene,
            measured(violation.value, violation.limit)
        )),
        Block::Preformatted(violation.original.clone()),
        Block::Paragraph(format!("The search for the minimal scene took {} replays.", violation.replays)),
    ]
}

fn ranges(coverage: &CoverageReport) -> Table {
    let mut table = Table::new(["quantity", "from", "to", "values", "empty tenths"]);
    table.extend(coverage.ranges.iter().map(|range| {
        let RangeCoverage { quantity, range: [low, high], counts } = range;
        let empty = counts.iter().filter(|count| **count == 0).count();
        vec![
            (*quantity).to_owned(),
            low.to_string(),
            high.to_string(),
            counts.iter().sum::<u64>().to_string(),
            empty.to_string(),
        ]
    }));
    table
}

fn drawings(coverage: &CoverageReport) -> Vec<Figure> {
    let ranges: Vec<_> =
        coverage.ranges.iter().map(|range| (range.quantity.to_owned(), range.counts.to_vec())).collect();
    let mut pairs: Vec<(String, Vec<u64>)> = Vec::new();
    for pair in &coverage.pairs {
        match pairs.last_mut() {
            Some((first, counts)) if first == pair.first => counts.push(pair.count),
            _ => pairs.push((pair.first.to_owned(), vec![pair.count])),
        }
    }
    let seconds: Vec<_> = coverage.pairs.iter().take(pairs.len()).map(|pair| pair.second).collect();
    vec![
        Figure::new(fields(&ranges), "Values by tenths of their range, lowest left"),
        Figure::new(fields(&pairs), format!("First change (rows) and second change: {}", seconds.join(", "))),
    ]
}

/// Draws a row of fields per name. The opacity is the count divided by the row's largest count.
fn fields(rows: &[(String, Vec<u64>)]) -> String {
    let columns = rows.iter().map(|(_, counts)| counts.len()).max().unwrap_or(0);
    let (width, height) = (NAMES + columns * FIELD, rows.len() * FIELD);
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" width=\"{width}\" \
         height=\"{height}\" font-family=\"sans-serif\" font-size=\"13\">\
         <rect width=\"100%\" height=\"100%\" fill=\"#fff\"/>"
    );
    for (row, (name, counts)) in rows.iter().enumerate() {
        let largest = counts.iter().copied().max().unwrap_or(0).max(1) as f64;
        let y = row * FIELD;
        let _ = write!(svg, "<text x=\"4\" y=\"{}\" fill=\"#222\">{name}</text>", y + 16);
        for (column, count) in counts.iter().enumerate() {
            let opacity = *count as f64 / largest;
            let x = NAMES + column * FIELD;
            let _ = write!(
                svg,
                "<rect x=\"{x}\" y=\"{y}\" width=\"{FIELD}\" height=\"{FIELD}\" fill=\"#0b62a4\" \
                 fill-opacity=\"{opacity:.2}\" stroke=\"#bbb\"><title>{count}</title></rect>"
            );
        }
    }
    svg.push_str("</svg>");
    svg
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_empty_field_is_transparent_and_the_largest_is_full() {
        let svg = fields(&[("one".to_owned(), vec![0, 2, 4]), ("two".to_owned(), vec![0, 0, 0])]);
        let opacities: Vec<_> = svg.split("fill-opacity=\"").skip(1).map(|rest| &rest[..4]).collect();
        assert_eq!(opacities, ["0.00", "0.50", "1.00", "0.00", "0.00", "0.00"]);
        assert!(svg.contains("height=\"44\""), "{svg}");
    }
}
