//! Writes figures as SVG drawings with their legends, for readers without scripts and for paper.

use super::figure::{Content, Figure, Layer};
use super::trace_data::View;
use crate::chart::marks::view_box;
use crate::chart::time::{SIZE, TimeWindow};
use crate::format;
use maud::{Markup, html};

/// Draws two figures of the first view, and all figures of the last view, which is the whole trial.
pub(super) fn drawings(t_ms: &[f64], views: &[View], figures: &[Figure], limit: usize) -> Markup {
    let [rest @ .., whole] = views else { return Markup::default() };
    let shown = rest.first().map(|view| (view, 2)).into_iter().chain([(whole, figures.len())]);
    html! {
        div.drawings {
            @for (view, count) in shown {
                h3 { (view.name) }
                div.figures { @for figure in figures.iter().take(count) { (drawing(figure, t_ms, view.window, limit)) } }
            }
        }
    }
}

fn drawing(figure: &Figure, t_ms: &[f64], window: TimeWindow, limit: usize) -> Markup {
    let layers: Vec<&Layer> = figure.layers.iter().filter(|layer| layer.is_in_drawing()).collect();
    let keys: Vec<&str> = layers.iter().map(|layer| layer.text.as_str()).collect();
    let (from_ms, to_ms) = (format::number(window.from_ms), format::number(window.to_ms));
    let label =
        format!("{} in {} against time, {from_ms} to {to_ms} ms: {}", figure.title, figure.unit, keys.join("; "));
    html! {
        figure {
            figcaption { (figure.title) }
            svg viewBox=(view_box(SIZE)) role="img" aria-label=(label) { (figure.chart(t_ms, window, limit).markup()) }
            ul.legend { @for layer in layers { li { (legend_swatch(layer)) (layer.text) } } }
        }
    }
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
