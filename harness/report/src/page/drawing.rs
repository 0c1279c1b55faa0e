//! Writes figures as SVG drawings with their legends, for readers without scripts and for paper.

use super::figure::{Figure, Layer};
use crate::chart::svg::view_box;
use crate::chart::time_chart::{SIZE, TimeWindow};
use crate::error::ReportError;
use crate::format;
use maud::{Markup, PreEscaped, html};

/// `views` are the response and the whole trial, or the whole trial alone.
/// The response, and everything if not `all`, has the first two figures only.
pub(super) fn drawings(
    t_ms: &[f64],
    views: &[TimeWindow],
    figures: &[Figure],
    limit: usize,
    all: bool,
) -> Result<Markup, ReportError> {
    let headings =
        ["Response to the setpoint step", "Whole trial"].into_iter().skip(2_usize.saturating_sub(views.len()));
    let mut groups = Vec::new();
    for (number, (heading, window)) in headings.zip(views).enumerate().take(if all { 2 } else { 1 }) {
        let is_whole = number + 1 == views.len();
        let count = if is_whole && all { figures.len() } else { 2 };
        let drawn = figures.iter().take(count).map(|figure| drawing(figure, t_ms, *window, limit));
        groups.push((heading, drawn.collect::<Result<Vec<_>, _>>()?));
    }
    Ok(html! {
        div.drawings {
            @for (heading, drawn) in &groups {
                h3 { (heading) }
                div.figures { @for figure in drawn { (figure) } }
            }
            @if !all && !groups.is_empty() {
                p.facts { "The other signals are in the interactive plots, which need scripts, and in the traces." }
            }
        }
    })
}

fn drawing(figure: &Figure, t_ms: &[f64], window: TimeWindow, limit: usize) -> Result<Markup, ReportError> {
    let layers: Vec<&Layer> = figure.layers.iter().filter(|layer| layer.is_drawn()).collect();
    let keys: Vec<&str> = layers.iter().map(|layer| layer.text.as_str()).collect();
    let (from_ms, to_ms) = (format::number(window.from_ms), format::number(window.to_ms));
    let label =
        format!("{} in {} against time, {from_ms} to {to_ms} ms: {}", figure.title, figure.unit, keys.join("; "));
    let svg = figure.chart(t_ms, window, limit).elements(figure.title)?;
    Ok(html! {
        figure {
            figcaption { (figure.title) }
            svg viewBox=(view_box(SIZE)) role="img" aria-label=(label) { (PreEscaped(svg)) }
            ul.legend { @for layer in layers { li { (legend_swatch(layer)) (layer.text) } } }
        }
    })
}

fn legend_swatch(layer: &Layer) -> Markup {
    html! {
        svg.swatch viewBox="0 0 24 10" aria-hidden="true" {
            @if layer.is_area() { rect width="24" height="10" rx="2" class={ "f-" (layer.role.name()) } {} }
            @else { path d="M0 5H24" class={ "s-" (layer.role.name()) } {} }
        }
    }
}
