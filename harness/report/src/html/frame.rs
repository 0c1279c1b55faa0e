//! What every page begins and ends with: its head, its style, its title.

use super::STYLE;
use maud::{DOCTYPE, Markup, PreEscaped, html};

/// A page of its own that needs nothing else: `head` stands behind the report's style, `body` is all that is seen.
pub(crate) fn frame(title: &str, head: &Markup, body: &Markup) -> Markup {
    html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                meta name="color-scheme" content="light dark";
                title { (title) }
                style { (PreEscaped(STYLE)) }
                (head)
            }
            body { (body) }
        }
    }
}

/// A page under its title.
pub(crate) fn titled(title: &str, lead: Option<&str>, head: &Markup, main: &Markup) -> Markup {
    frame(
        title,
        head,
        &html! {
            header { h1 { (title) } @if let Some(lead) = lead { p.lead { (lead) } } }
            main { (main) }
        },
    )
}
