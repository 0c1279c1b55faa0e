//! Writes `charts.html`, `stability.html` and `identification.html`.

use super::elements::text_table;
use super::frame::report_page_frame;
use crate::error::{ReportError, write_file};
use crate::text::Table;
use maud::{Markup, PreEscaped, html};
use std::path::Path;

const STYLE: &str = "figure{margin:1.5rem 0}figure img{max-width:100%;height:auto;border:1px solid var(--hair);\
                     border-radius:.5rem}p{max-width:70ch;margin:.6rem 0}pre{white-space:pre-wrap}\
                     @media screen and (max-width:40rem){figure img{max-width:none;width:44rem}}";

#[derive(Debug, Clone, PartialEq)]
pub struct BlockPage {
    pub title: String,
    /// May be empty.
    pub intro: String,
    pub blocks: Vec<PageBlock>,
}

#[derive(Debug, Clone, PartialEq)]
pub enum PageBlock {
    Heading(String),
    Text(String),
    /// Text with its line feeds and columns.
    Preformatted(String),
    /// Drawings side by side: an SVG file and its caption each.
    Drawings(Vec<(String, String)>),
    Table(Table),
    /// A link to a file in the page's folder.
    File(String),
}

impl BlockPage {
    pub fn write(&self, path: &Path) -> Result<(), ReportError> {
        write_file(path, &self.html())
    }

    pub fn html(&self) -> String {
        let body = html! {
            header { h1 { (self.title) } @if !self.intro.is_empty() { p.lead { (self.intro) } } }
            main { @for block in &self.blocks { (block.html()) } }
        };
        report_page_frame(&self.title, &html! { style { (PreEscaped(STYLE)) } }, &body)
    }
}

impl PageBlock {
    fn html(&self) -> Markup {
        html! {
            @match self {
                Self::Heading(text) => h2 { (text) },
                Self::Text(text) => p { (text) },
                Self::Preformatted(text) => div.scroll role="group" aria-label="Text" tabindex="0" { pre { (text) } },
                Self::Drawings(drawings) => div.figures {
                    @for (svg, caption) in drawings {
                        figure {
                            div.scroll role="group" aria-label=(caption) tabindex="0" {
                                img src={ "data:image/svg+xml," (percent_encode(svg)) } alt=(caption);
                            }
                            figcaption { (caption) }
                        }
                    }
                },
                Self::Table(table) => (text_table(table)),
                Self::File(name) => p { a href=(name) { code { (name) } } },
            }
        }
    }
}

fn percent_encode(svg: &str) -> String {
    svg.replace('%', "%25").replace('#', "%23").replace('\n', "%0A")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_text_becomes_markup() {
        let mut table = Table::new(["<h>"]);
        table.rows.push(vec!["<r>".to_owned()]);
        let blocks = vec![
            PageBlock::Heading("a < b".to_owned()),
            PageBlock::Text("\u{202e}".to_owned()),
            PageBlock::Preformatted("<1>\n<2>".to_owned()),
            PageBlock::Drawings(vec![("<svg fill=\"#fff\" width=\"100%\"/>".to_owned(), "drawn".to_owned())]),
            PageBlock::Table(table),
            PageBlock::File("precision.csv".to_owned()),
        ];
        let page = BlockPage { title: "t".to_owned(), intro: "i".to_owned(), blocks }.html();
        let body = page.split_once("<body>").unwrap().1;
        insta::assert_snapshot!(body.replace("><", ">\n<"));
    }
}
