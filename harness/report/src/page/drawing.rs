//! Writes figures as SVG drawings with their legends, for readers without scripts and for paper.

use super::figure::{Content, Figure, Layer};
use super::trace_data::View;
use crate::chart::svg::view_box;
use crate::chart::time_chart::{SIZE, TimeWindow};
use crate::error::ReportError;
use crate::format;
use maud::{Markup, PreEscaped, html};

/// Draws two figures of the first view, and all figures of the last view, which is the whole trial.
pub(super) fn drawings(t_ms: &[f64], views: &[View], figures: &[Figure], limit: usize) -> Result<Markup, ReportError> {
    let [rest @ .., whole] = views else { return Ok(Markup::default()) };
    let shown = rest.first().map(|view| (view, 2)).into_iter().chain([(whole, figures.len())]);
    let mut groups = Vec::new();
    for (view, count) in shown {
        let drawn = figures.iter().take(count).map(|figure| drawing(figure, t_ms, view.window, limit));
        groups.push((&view.name, drawn.collect::<Result<Vec<_>, _>>()?));
    }
    Ok(html! {
        div.drawings {
            @for (heading, drawn) in &groups {
                h3 { (heading) }
                div.figures { @for figure in drawn { (figure) } }
            }
        }
    })
}

fn drawing(figure: &Figure, t_ms: &[f64], window: TimeWindow, limit: usize) -> Result<Markup, ReportError> {
    let layers: Vec<&Layer> = figure.layers.iter().filter(|layer| layer.is_in_drawing()).collect();
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
            @else if matches!(layer.content, Content::Points(_)) {
                circle cx="12" cy="5" r="4" class={ "f-" (layer.role.name()) } {}
            }
            @else { path d="M0 5H24" class={ "s-" (layer.role.name()) } {} }
        }
    }
}
