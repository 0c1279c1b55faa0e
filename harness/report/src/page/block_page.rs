//! Writes `charts.html`, `stability.html` and `identification.html`.

use super::elements::text_table;
use super::frame::report_page_frame;
use crate::error::{ReportError, write_file};
use crate::text::Table;
use maud::{Markup, PreEscaped, html};
use std::path::Path;

const STYLE: &str = "figure{margin:1.5rem 0}figure img{max-width:100%;height:auto;border:1px solid var(--hair);\
                     border-radius:.5rem}p{max-width:70ch;margin:.6rem 0}pre{white-space:pre-wrap}\
                     @media screen and (max-width:40rem){figure img{max-width:none;width:44rem}\
                     figure .linked{width:44rem}}.linked{position:relative;display:inline-block}\
                     .linked img{display:block}.linked a{position:absolute}\
                     .linked a:hover,.linked a:focus-visible{outline:2px solid var(--ink)}";

#[derive(Debug, Clone, PartialEq)]
pub struct BlockPage {
    pub title: String,
    pub intro: String,
    pub blocks: Vec<PageBlock>,
}

#[derive(Debug, Clone, PartialEq)]
pub struct LinkedDrawing {
    pub svg: String,
    pub caption: String,
    pub links: Vec<AreaLink>,
}

#[derive(Debug, Clone, PartialEq)]
pub struct AreaLink {
    /// Left, top, width and height, as shares of the drawing.
    pub area: [f64; 4],
    pub href: String,
    pub title: String,
}

#[derive(Debug, Clone, PartialEq)]
pub enum PageBlock {
    Heading(String),
    Text(String),
    Preformatted(String),
    /// SVG drawings side by side, each with its caption.
    Drawings(Vec<(String, String)>),
    LinkedDrawings(Vec<LinkedDrawing>),
    Table(Table),
    /// The first cell of a row links to the page of the same index, if there is one.
    LinkedTable(Table, Vec<Option<String>>),
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
                    @for (svg, caption) in drawings { (figure(caption, &image(svg, caption))) }
                },
                Self::LinkedDrawings(drawings) => div.figures {
                    @for drawing in drawings { (figure(&drawing.caption, &drawing.html())) }
                },
                Self::Table(table) => (text_table(table, &[])),
                Self::LinkedTable(table, links) => (text_table(table, links)),
                Self::File(name) => p { a href=(name) { code { (name) } } },
            }
        }
    }
}

impl LinkedDrawing {
    fn html(&self) -> Markup {
        html! {
            div.linked {
                (image(&self.svg, &self.caption))
                @for AreaLink { area, href, title } in &self.links {
                    @let [left, top, width, height] = area.map(|share| format!("{:.3}%", share * 100.0));
                    a href=(href) title=(title) aria-label=(title)
                        style={ "left:" (left) ";top:" (top) ";width:" (width) ";height:" (height) } {}
                }
            }
        }
    }
}

fn figure(caption: &str, content: &Markup) -> Markup {
    html! {
        figure {
            div.scroll role="group" aria-label=(caption) tabindex="0" { (content) }
            figcaption { (caption) }
        }
    }
}

fn image(svg: &str, caption: &str) -> Markup {
    html! { img src={ "data:image/svg+xml," (percent_encode(svg)) } alt=(caption); }
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
            PageBlock::LinkedDrawings(vec![LinkedDrawing {
                svg: "<svg/>".to_owned(),
                caption: "<map>".to_owned(),
                links: vec![AreaLink {
                    area: [0.25, 0.5, 0.125, 0.1],
                    href: "worst/run/report.html#scenario-0".to_owned(),
                    title: "<trial 0>".to_owned(),
                }],
            }]),
            PageBlock::LinkedTable(table.clone(), vec![Some("a.html".to_owned())]),
            PageBlock::Table(table),
            PageBlock::File("precision.csv".to_owned()),
        ];
        let page = BlockPage { title: "t".to_owned(), intro: "i".to_owned(), blocks }.html();
        let body = page.split_once("<body>").unwrap().1;
        insta::assert_snapshot!(body.replace("><", ">\n<"));
    }
}
