//! Renders a result as console text, HTML, Markdown and CSV from one list of blocks.
//!
//! A result derives `Serialize` for its JSON and builds one [`Document`] for everything that a person reads.

use crate::chart::marks;
use crate::escape::markdown_text;
use crate::format;
use crate::style::{Style, write_wrapped_at};
use crate::table::{Table, verdict_badge};
use maud::{DOCTYPE, Markup, PreEscaped, html};
use platebench_model::printable::{printable, printable_lines};
use platebench_model::record::Verdict;
use platebench_model::trace::{AtPath, FileError, write_atomically};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

const STYLE: &str = "figure{margin:1.5rem 0}figure img{max-width:100%;height:auto;border:1px solid var(--hair);\
                     border-radius:.5rem}p{max-width:70ch;margin:.6rem 0}pre{white-space:pre-wrap}\
                     @media screen and (max-width:40rem){figure img{max-width:none;width:44rem}\
                     figure .linked{width:44rem}}.linked{position:relative;display:inline-block}\
                     .linked img{display:block}.linked a{position:absolute}\
                     .linked a:hover,.linked a:focus-visible{outline:2px solid var(--ink)}\
                     .form{display:grid;grid-template-columns:repeat(auto-fit,minmax(14rem,1fr));gap:2rem;\
                     margin-top:2rem}.form .line{display:block;height:2rem;border-bottom:1px solid var(--ink)}";

#[derive(Debug, Clone, PartialEq)]
pub struct Document {
    /// Title of the page and of the Markdown text. The console omits it.
    pub title: String,
    /// First paragraph below the title. Empty for none. The console omits it.
    pub lead: String,
    pub blocks: Vec<Block>,
}

#[derive(Debug, Clone, PartialEq)]
pub enum Block {
    Heading(String),
    Paragraph(String),
    /// Lines whose breaks and columns are kept, such as a file or a list of items.
    Preformatted(String),
    /// Result in one line.
    Verdict(Verdict, String),
    /// Names and values.
    Facts(Vec<(String, String)>),
    Table(Table),
    /// Figures next to each other. The console omits them.
    Figures(Vec<Figure>),
    /// Link to a file in the folder of the page. The console omits it.
    File(String),
    /// Names of lines that a person fills in on paper. The console omits them.
    Form(Vec<String>),
    /// Blocks that the console omits.
    Details(Vec<Block>),
}

/// A drawing with a caption and areas that link to other pages.
#[derive(Debug, Clone, PartialEq)]
pub struct Figure {
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

impl Document {
    pub fn new(title: impl Into<String>, blocks: Vec<Block>) -> Self {
        Self { title: title.into(), lead: String::new(), blocks }
    }

    /// Wraps paragraphs and wide tables at `width` columns. An empty line precedes a block, except
    /// after a heading or a verdict.
    pub fn to_console(&self, width: Option<usize>, style: Style) -> String {
        let mut text = String::new();
        let mut is_after_heading = false;
        for block in self.blocks.iter().filter(|block| block.is_on_console()) {
            if !text.is_empty() && (!is_after_heading || matches!(block, Block::Heading(_))) {
                text.push('\n');
            }
            block.write_console(&mut text, width, style);
            is_after_heading = matches!(block, Block::Heading(_) | Block::Verdict(..));
        }
        text
    }

    pub fn to_html(&self) -> String {
        let body = html! {
            header { h1 { (self.title) } @if !self.lead.is_empty() { p.lead { (self.lead) } } }
            main { (self.body()) }
        };
        page_frame(&self.title, &html! { style { (PreEscaped(STYLE)) } }, &body)
    }

    /// The blocks as a part of a page.
    pub fn body(&self) -> Markup {
        html! { @for block in &self.blocks { (block.html()) } }
    }

    pub fn to_markdown(&self) -> String {
        let title = markdown_text(&self.title);
        let lead = if self.lead.is_empty() { String::new() } else { format!("\n{}\n", markdown_text(&self.lead)) };
        format!("# {title}\n{lead}{}", self.blocks_to_markdown())
    }

    /// The blocks as a part of a page. Each follows an empty line.
    pub fn blocks_to_markdown(&self) -> String {
        let mut text = String::new();
        self.blocks.iter().for_each(|block| block.write_markdown(&mut text));
        text
    }

    /// The tables, with an empty line between them.
    pub fn to_csv(&self) -> String {
        let mut tables = Vec::new();
        collect_tables(&self.blocks, &mut tables);
        tables.iter().map(|table| table.csv()).collect::<Vec<_>>().join("\n")
    }

    /// Writes the page.
    pub fn write(&self, path: &Path) -> Result<(), FileError> {
        write_atomically(path, self.to_html().as_bytes()).at(path)
    }
}

fn collect_tables<'a>(blocks: &'a [Block], tables: &mut Vec<&'a Table>) {
    for block in blocks {
        match block {
            Block::Table(table) => tables.push(table),
            Block::Details(blocks) => collect_tables(blocks, tables),
            _ => {}
        }
    }
}

impl Block {
    pub fn heading(text: impl Into<String>) -> Self {
        Self::Heading(text.into())
    }

    pub fn paragraph(text: impl Into<String>) -> Self {
        Self::Paragraph(text.into())
    }

    /// One line of text per item, also if the item contains a line feed.
    pub fn lines(lines: impl IntoIterator<Item = String>) -> Self {
        Self::Preformatted(lines.into_iter().map(|line| printable(&line).into_owned()).collect::<Vec<_>>().join("\n"))
    }

    pub fn figure(svg: impl Into<String>, caption: impl Into<String>) -> Self {
        Self::Figures(vec![Figure::new(svg, caption)])
    }

    const fn is_on_console(&self) -> bool {
        !matches!(self, Self::Figures(_) | Self::File(_) | Self::Form(_) | Self::Details(_))
    }

    fn write_console(&self, text: &mut String, width: Option<usize>, style: Style) {
        match self {
            Self::Heading(heading) => {
                let _ = writeln!(text, "{}", style.paint("1", &printable(heading)));
            }
            Self::Paragraph(sentences) => match width {
                Some(width) => write_wrapped_at(width, text, "", "", sentences),
                None => {
                    let _ = writeln!(text, "{}", printable(sentences));
                }
            },
            Self::Preformatted(lines) => {
                let _ = writeln!(text, "{}", printable_lines(lines.trim_end_matches('\n')));
            }
            Self::Verdict(verdict, sentence) => {
                let sign = style.paint_verdict(*verdict, &format!("{} {verdict}", format::sign(*verdict)));
                let _ = writeln!(text, "{sign}  {}", printable(sentence));
            }
            Self::Facts(facts) => {
                let width = facts.iter().map(|(name, _)| name.chars().count()).max().unwrap_or(0);
                for (name, value) in facts {
                    let _ = writeln!(text, "{:width$}  {}", printable(name), printable(value));
                }
            }
            Self::Table(table) => {
                for line in table.console_lines(width, style) {
                    let _ = writeln!(text, "{line}");
                }
            }
            Self::Figures(_) | Self::File(_) | Self::Form(_) | Self::Details(_) => {}
        }
    }

    /// Adds an empty line and the block.
    fn write_markdown(&self, text: &mut String) {
        let _ = match self {
            Self::Heading(heading) => writeln!(text, "\n## {}", markdown_text(heading)),
            Self::Paragraph(sentences) => writeln!(text, "\n{}", markdown_text(sentences)),
            Self::Preformatted(lines) => {
                let fence = code_fence(lines);
                writeln!(text, "\n{fence}text\n{}\n{fence}", printable_lines(lines.trim_end_matches('\n')))
            }
            Self::Verdict(verdict, sentence) => {
                writeln!(text, "\n**{} {verdict}** {}", format::sign(*verdict), markdown_text(sentence))
            }
            Self::Facts(facts) => {
                let fact = |(name, value): &(String, String)| {
                    format!("- **{}**: {}\n", markdown_text(name), markdown_text(value))
                };
                write!(text, "\n{}", facts.iter().map(fact).collect::<String>())
            }
            Self::Table(table) => write!(text, "\n{}", table.markdown()),
            Self::Figures(figures) => {
                let caption = |figure: &Figure| format!("\nFigure: {}\n", markdown_text(&figure.caption));
                write!(text, "{}", figures.iter().map(caption).collect::<String>())
            }
            Self::File(name) => writeln!(text, "\n[{}](<{}>)", markdown_text(name), printable(name)),
            Self::Form(names) => {
                let line = |name: &String| format!("- {}: \\_\\_\\_\\_\n", markdown_text(name));
                write!(text, "\n{}", names.iter().map(line).collect::<String>())
            }
            Self::Details(blocks) => {
                for block in blocks {
                    block.write_markdown(text);
                }
                Ok(())
            }
        };
    }

    fn html(&self) -> Markup {
        html! {
            @match self {
                Self::Heading(text) => h2 { (text) },
                Self::Paragraph(text) => p { (text) },
                Self::Preformatted(text) => div.scroll role="group" aria-label="Text" tabindex="0" { pre { (text) } },
                Self::Verdict(verdict, text) => p { (verdict_badge(*verdict, verdict.name())) " " (text) },
                Self::Facts(facts) => dl { @for (name, value) in facts { div { dt { (name) } dd { (value) } } } },
                Self::Table(table) => (table.html()),
                Self::Figures(figures) => div.figures { @for figure in figures { (figure.html()) } },
                Self::File(name) => p { a href=(name) { code { (name) } } },
                Self::Form(names) => div.form { @for name in names { div { span.line {} span { (name) } } } },
                Self::Details(blocks) => @for block in blocks { (block.html()) },
            }
        }
    }
}

/// A document that is a section of a page of charts.
#[derive(Debug, Clone, PartialEq)]
pub struct ChartSection {
    pub document: Document,
    /// Name and content of each file.
    pub files: Vec<(String, String)>,
}

/// Returns the path of the page. A section with the title of the page gets no heading of its own.
pub fn write_chart_page(
    folder: &Path,
    name: &str,
    title: &str,
    lead: String,
    sections: &[ChartSection],
) -> Result<PathBuf, FileError> {
    let mut blocks = Vec::new();
    for ChartSection { document, files } in sections {
        for (name, text) in files {
            let path = folder.join(name);
            write_atomically(&path, text.as_bytes()).at(&path)?;
        }
        if document.title != title {
            blocks.push(Block::heading(&document.title));
        }
        blocks.extend(document.blocks.iter().cloned());
    }
    let path = folder.join(name);
    Document { lead, ..Document::new(title, blocks) }.write(&path)?;
    Ok(path)
}

/// Longer than each row of backquotes in `text`, so that the text cannot end the code block.
fn code_fence(text: &str) -> String {
    let longest = text.split(|character| character != '`').map(str::len).max().unwrap_or(0);
    "`".repeat(longest.max(2) + 1)
}

impl Figure {
    pub fn new(svg: impl Into<String>, caption: impl Into<String>) -> Self {
        Self { svg: svg.into(), caption: caption.into(), links: Vec::new() }
    }

    fn html(&self) -> Markup {
        let image = html! { img src={ "data:image/svg+xml," (percent_encode(&self.svg)) } alt=(self.caption); };
        html! {
            figure {
                div.scroll role="group" aria-label=(self.caption) tabindex="0" {
                    @if self.links.is_empty() { (image) } @else { div.linked { (image) @for link in &self.links { (link.html()) } } }
                }
                figcaption { (self.caption) }
            }
        }
    }
}

impl AreaLink {
    fn html(&self) -> Markup {
        let [left, top, width, height] = self.area.map(|share| format!("{:.3}%", share * 100.0));
        html! {
            a href=(self.href) title=(self.title) aria-label=(self.title)
                style={ "left:" (left) ";top:" (top) ";width:" (width) ";height:" (height) } {}
        }
    }
}

fn percent_encode(svg: &str) -> String {
    svg.replace('%', "%25").replace('#', "%23").replace('\n', "%0A")
}

/// Style of every page.
const PAGE_STYLE: &str = include_str!("page.css");

pub fn page_frame(title: &str, head: &Markup, body: &Markup) -> String {
    let style = format!("{}\n{}\n{PAGE_STYLE}", marks::variables(), marks::RULES);
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::table::{Cell, Column};

    fn document() -> Document {
        let mut table = Table::new([Column::from("<h>"), Column::number("time", "ms"), Column::from("verdict")]);
        table.push([Cell::from("<r>").with_link(Some("a.html".to_owned())), "7".into(), Cell::verdict(Verdict::Pass)]);
        let slow = Cell::from("late").with_verdict(Verdict::Fail).with_notes(["=1+1".to_owned()]);
        table.push(["=x|y".into(), "12.5".into(), slow]);
        let mut map = Figure::new("<svg/>", "<map>");
        map.links.push(AreaLink {
            area: [0.25, 0.5, 0.125, 0.1],
            href: "worst/run/report.html#scenario-0".to_owned(),
            title: "<trial 0>".to_owned(),
        });
        let blocks = vec![
            Block::Verdict(Verdict::Inconclusive, "too few *trials*".to_owned()),
            Block::heading("a < b"),
            Block::paragraph("one two three\u{202e} four"),
            Block::lines(["<1>".to_owned(), "``` <2>\u{1b}".to_owned()]),
            Block::Facts(vec![("Rig".to_owned(), "<hosted>".to_owned()), ("Clock".to_owned(), "lockstep".to_owned())]),
            Block::Table(table),
            Block::figure("<svg fill=\"#fff\" width=\"100%\"/>", "drawn"),
            Block::Details(vec![
                Block::Figures(vec![map]),
                Block::Table({
                    let mut table = Table::new(["n"]);
                    table.push(["1"]);
                    table
                }),
                Block::File("precision.csv".to_owned()),
            ]),
            Block::Form(vec!["Operator".to_owned()]),
        ];
        Document { lead: "i".to_owned(), ..Document::new("t", blocks) }
    }

    #[test]
    fn no_text_becomes_markup() {
        let page = document().to_html();
        let body = page.split_once("<body>").unwrap().1;
        insta::assert_snapshot!(body.replace("><", ">\n<"));
    }

    #[test]
    fn the_console_omits_details_and_figures() {
        insta::assert_snapshot!(document().to_console(Some(12), Style::default()));
    }

    #[test]
    fn colours_verdicts_and_headings_only() {
        let text = document().to_console(None, Style { colour: true, ..Style::default() });
        assert!(text.contains("\u{1b}[1ma < b\u{1b}[0m\n"), "{text:?}");
        assert!(text.contains("12.5  \u{1b}[1;31m✗ late, =1+1\u{1b}[0m\n"), "{text:?}");
        assert!(!text.contains("\u{202e}"), "{text:?}");
    }

    #[test]
    fn markdown_contains_every_block() {
        insta::assert_snapshot!(document().to_markdown());
    }

    #[test]
    fn csv_contains_every_table() {
        assert_eq!(document().to_csv(), "<h>,\"time, ms\",verdict\n<r>,7,pass\n'=x|y,12.5,late\n\nn\n1\n");
    }
}
