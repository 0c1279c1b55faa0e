//! Writes the HTML around the content of every page.

use crate::chart::marks;
use crate::escape::printable_lines;
use maud::{DOCTYPE, Markup, PreEscaped, html};

const STYLE: &str = include_str!("../page/style.css");

pub(crate) fn report_page_frame(title: &str, head: &Markup, body: &Markup) -> String {
    let style = format!("{}\n{}\n{STYLE}", marks::variables(), marks::RULES);
    page_frame(title, &style, head, body)
}

pub fn page_frame(title: &str, style: &str, head: &Markup, body: &Markup) -> String {
    let page = html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                meta name="color-scheme" content="light dark";
                title { (title) }
                style { (PreEscaped(style)) }
                (head)
            }
            body { (body) }
        }
    };
    printable_lines(&page.into_string()).into_owned()
}
