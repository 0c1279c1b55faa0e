//! `charts.html`: drawings, tables and a few words on one page that needs nothing else.

use crate::error::ReportError;
use crate::html::frame::titled;
use maud::{PreEscaped, html};
use std::fs;
use std::path::Path;

/// A drawing on this page is a picture and keeps its own style sheet to itself.
const OWN_STYLE: &str = "figure{margin:1.5rem 0}figure>img{max-width:100%;height:auto;border:1px solid var(--hair);border-radius:.5rem}p{max-width:70ch;margin:.6rem 0}";

/// A page of charts.
#[derive(Debug, Clone, PartialEq)]
pub struct Page {
    /// What it is about.
    pub title: String,
    /// What was measured with and when.
    pub lead: String,
    /// Its parts, from the top.
    pub blocks: Vec<Block>,
}

/// A part of a page.
#[derive(Debug, Clone, PartialEq)]
pub enum Block {
    /// A heading.
    Heading(String),
    /// A paragraph.
    Text(String),
    /// A drawing: an SVG document, and what it shows.
    Drawing(String, String),
    /// A table.
    Table(Table),
    /// A file beside the page.
    File(String),
}

/// A table.
#[derive(Debug, Clone, PartialEq)]
pub struct Table {
    /// Names of the columns.
    pub head: Vec<String>,
    /// Rows of as many fields.
    pub rows: Vec<Vec<String>>,
}

impl Page {
    /// The file's name in its folder.
    pub const FILE: &str = "charts.html";

    /// Writes the page into `folder`.
    ///
    /// # Errors
    /// [`ReportError::Io`].
    pub fn write(&self, folder: &Path) -> Result<(), ReportError> {
        let path = folder.join(Self::FILE);
        fs::write(&path, self.html()).map_err(ReportError::io(&path))
    }

    fn html(&self) -> String {
        let main = html! {
            @for block in &self.blocks {
                @match block {
                    Block::Heading(text) => h2 { (text) },
                    Block::Text(text) => p { (text) },
                    Block::Drawing(svg, text) => figure {
                        img src=(format!("data:image/svg+xml,{}", percent(svg))) alt=(text);
                        figcaption { (text) }
                    },
                    Block::Table(table) => (table.html()),
                    Block::File(name) => p { a href=(name) { code { (name) } } },
                }
            }
        };
        titled(&self.title, Some(&self.lead), &html! { style { (PreEscaped(OWN_STYLE)) } }, &main).into_string()
    }
}

impl Table {
    fn html(&self) -> maud::Markup {
        html! {
            div.scroll {
                table {
                    thead { tr { @for name in &self.head { th { (name) } } } }
                    tbody {
                        @for row in &self.rows { tr { @for field in row { td { (field) } } } }
                    }
                }
            }
        }
    }
}

/// An SVG document as part of a URL.
fn percent(svg: &str) -> String {
    svg.replace('%', "%25").replace('#', "%23").replace('\n', "%0A")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_on_the_page_is_taken_for_markup() {
        let table = Table { head: vec!["<h>".to_owned()], rows: vec![vec!["<r>".to_owned()]] };
        let blocks = vec![
            Block::Heading("a < b".to_owned()),
            Block::Drawing("<svg fill=\"#fff\" width=\"100%\"/>".to_owned(), "drawn".to_owned()),
            Block::Table(table),
            Block::File("precision.csv".to_owned()),
        ];
        let page = Page { title: "t".to_owned(), lead: "l".to_owned(), blocks }.html();
        for part in ["a &lt; b", "&lt;h&gt;", "&lt;r&gt;", "%23fff", "100%25", "href=\"precision.csv\""] {
            assert!(page.contains(part), "{part}: {page}");
        }
        assert!(!page.contains("src=\"http") && !page.contains("<script"), "{page}");
    }
}
