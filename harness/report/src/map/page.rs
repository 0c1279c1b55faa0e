//! Maps and tables on one page that needs nothing else.

use super::{EDGES, Map};
use crate::error::ReportError;
use crate::html::frame::titled;
use maud::{Markup, PreEscaped, html};

/// A part of the page.
#[derive(Debug, Clone, PartialEq)]
pub struct Section {
    /// Its heading.
    pub title: String,
    /// What has to be known to read it; may be empty.
    pub note: String,
    /// Text that is shown as it stands, columns and all.
    pub table: Option<String>,
    /// A map.
    pub map: Option<Map>,
}

/// The page.
///
/// # Errors
/// [`ReportError::Plot`] of any of its maps.
pub fn page(title: &str, sections: &[Section]) -> Result<String, ReportError> {
    let drawn = |section: &Section| section.map.as_ref().map(Map::svg).transpose();
    let parts: Vec<(&Section, Option<String>)> =
        sections.iter().map(|section| Ok((section, drawn(section)?))).collect::<Result<_, ReportError>>()?;
    let main = html! {
        @for (section, svg) in &parts {
            section {
                h2 { (section.title) }
                @if !section.note.is_empty() { p class="lead" { (section.note) } }
                @if let Some(table) = &section.table { div class="scroll" { pre style="white-space: pre-wrap" { (table) } } }
                @if let Some(svg) = svg {
                    div class="scroll" { (PreEscaped(svg)) }
                    (legend())
                }
            }
        }
    };
    Ok(titled(title, None, &html! {}, &main).into_string())
}

/// Which colour is which spectral radius.
fn legend() -> Markup {
    let text = |class: usize| match (class.checked_sub(1).and_then(|below| EDGES.get(below)), EDGES.get(class)) {
        (None, Some(high)) => format!("below {high}"),
        (Some(low), Some(high)) => format!("{low} to {high}"),
        (Some(low), None) => format!("from {low}"),
        (None, None) => String::new(),
    };
    html! {
        ul class="legend" {
            li { "spectral radius:" }
            @for class in 0..=EDGES.len() {
                li {
                    svg class="map scale" viewBox="0 0 16 8" aria-hidden="true" { rect class={ "f-r" (class) } width="16" height="8"; }
                    (text(class))
                }
            }
            li { "line: predicted boundary" }
            li { "circles: measured boundary" }
            li { "dashes: a rig's measured loop delay, where one is given" }
        }
    }
}
