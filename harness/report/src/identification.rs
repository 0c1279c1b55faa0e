//! `identification.html`: tables and fitted curves on one page that needs nothing else.
//!
//! Neighbours: the command line brings tables and curves from `platebench-identify`, `html::plot` draws. Nothing here knows a parameter.

use crate::error::ReportError;
use crate::html::curves::{Point, Window};
use crate::html::frame::titled;
use crate::html::plot::{Chart, Ink, SIZE};
use maud::{PreEscaped, html};

/// Points of a curve beyond which a drawing shows no more.
const POINTS: usize = 2_000;

/// A table with its sentences.
#[derive(Debug, Clone)]
pub struct Table {
    /// What it shows.
    pub title: String,
    /// Titles of the columns.
    pub header: Vec<String>,
    /// Cells.
    pub rows: Vec<Vec<String>>,
    /// Sentences below it.
    pub notes: Vec<String>,
}

/// What was seen, and what the fitted model makes of it.
#[derive(Debug, Clone)]
pub struct Curves {
    /// What is drawn.
    pub title: String,
    /// The vertical axis.
    pub unit: &'static str,
    /// Seen, `(ms, value)`, in order of time.
    pub seen: Vec<(f64, f64)>,
    /// The model's, likewise.
    pub fitted: Vec<(f64, f64)>,
}

/// The page.
///
/// # Errors
/// [`ReportError::Plot`].
pub fn page(title: &str, tables: &[Table], curves: &[Curves]) -> Result<String, ReportError> {
    let drawings: Vec<String> = curves.iter().map(drawing).collect::<Result<_, _>>()?;
    let (width, height) = SIZE;
    let main = html! {
        @for table in tables {
            section {
                h2 { (table.title) }
                div style="overflow-x:auto" {
                    table {
                        thead { tr { @for cell in &table.header { th scope="col" { (cell) } } } }
                        tbody { @for row in &table.rows { tr { @for cell in row { td { (cell) } } } } }
                    }
                }
                @for note in &table.notes { p { (note) } }
            }
        }
        section {
            h2 { "Seen and fitted" }
            div class="figures" {
                @for (curve, drawing) in curves.iter().zip(&drawings) {
                    figure {
                        figcaption { (curve.title) ": seen behind, the fitted response in front" }
                        svg viewBox={ "0 0 " (width) " " (height) } role="img" aria-label=(curve.title) { (PreEscaped(drawing)) }
                    }
                }
            }
        }
    };
    Ok(titled(title, None, &html! {}, &main).into_string())
}

fn drawing(curves: &Curves) -> Result<String, ReportError> {
    let short = |points: &[Point]| points.iter().take(POINTS).copied().collect::<Vec<Point>>();
    let (seen, fitted) = (short(&curves.seen), short(&curves.fitted));
    let bounds = |of: fn(&Point) -> f64| {
        seen.iter()
            .chain(&fitted)
            .map(of)
            .fold((f64::MAX, f64::MIN), |(low, high), value| (low.min(value), high.max(value)))
    };
    let ((from_ms, to_ms), (low, high)) = (bounds(|point| point.0), bounds(|point| point.1));
    let air = ((high - low) * 0.06).max(f64::EPSILON);
    let chart = Chart {
        window: Window { from_ms, to_ms: to_ms.max(from_ms + 1e-6) },
        range: (low - air, high + air),
        unit: curves.unit,
        spans: Vec::new(),
        areas: Vec::new(),
        lines: vec![(Ink::Other, seen), (Ink::First, fitted)],
        marks: Vec::new(),
    };
    chart.draw(&curves.title)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_and_both_curves_are_on_the_page() {
        let table = Table {
            title: "Table I".to_owned(),
            header: vec!["Vpp".to_owned(), "K1".to_owned()],
            rows: vec![vec!["120".to_owned(), "7108 & more".to_owned()]],
            notes: vec!["said".to_owned()],
        };
        let curves = Curves {
            title: "W".to_owned(),
            unit: "µm",
            seen: vec![(0.0, 0.0), (1.0, 1.1)],
            fitted: vec![(0.0, 0.0), (1.0, 1.0)],
        };
        let page = page("A plate", &[table], &[curves]).unwrap();
        for part in ["<th scope=\"col\">K1</th>", "<td>7108 &amp; more</td>", "<p>said</p>", "s-other", "s-first"] {
            assert!(page.contains(part), "{part}");
        }
    }
}
