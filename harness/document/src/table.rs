//! Renders one table as aligned text, Markdown, HTML or CSV.

use crate::escape::{csv_field, markdown_cell};
use crate::format::{self, NOTHING};
use crate::style::Style;
use maud::{Markup, PreEscaped, html};
use platebench_model::printable::printable;
use platebench_model::record::Verdict;

/// Every row is as wide as the header.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Table {
    pub columns: Vec<Column>,
    pub rows: Vec<Vec<Cell>>,
    /// Lines below rows on a page: index of the row, class and text.
    pub remarks: Vec<(usize, &'static str, String)>,
}

#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Column {
    pub name: String,
    /// Follows the name in the header. Empty for a column without a unit.
    pub unit: &'static str,
    pub alignment: Alignment,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Alignment {
    #[default]
    Left,
    Right,
}

#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Cell {
    pub text: String,
    /// Adds the sign and the colour of this verdict to the text. CSV contains the text only.
    pub verdict: Option<Verdict>,
    /// Address that the text links to on a page.
    pub link: Option<String>,
    /// Small lines below the text on a page; in other formats they follow the text after commas.
    pub notes: Vec<String>,
    /// Follows the text. Empty for none. CSV contains the text only.
    pub unit: &'static str,
    /// True for a name or a digest.
    pub is_code: bool,
    /// HTML in place of the text on a page. It begins with the text.
    pub markup: Option<String>,
    /// A page highlights the row of this cell.
    pub is_highlighted: bool,
}

impl Column {
    /// A column of numbers, aligned right.
    pub fn number(name: impl Into<String>, unit: &'static str) -> Self {
        Self { name: name.into(), unit, alignment: Alignment::Right }
    }

    fn label(&self) -> String {
        if self.unit.is_empty() { self.name.clone() } else { format!("{}, {}", self.name, self.unit) }
    }

    fn class(&self) -> Option<&'static str> {
        (self.alignment == Alignment::Right).then_some("number")
    }
}

impl<T: Into<String>> From<T> for Column {
    fn from(name: T) -> Self {
        Self { name: name.into(), ..Self::default() }
    }
}

impl<T: Into<String>> From<T> for Cell {
    fn from(text: T) -> Self {
        Self { text: text.into(), ..Self::default() }
    }
}

impl Cell {
    pub fn verdict(verdict: Verdict) -> Self {
        Self { verdict: Some(verdict), ..Self::from(verdict.name()) }
    }

    /// A dash if there is no text.
    pub fn optional(text: Option<String>) -> Self {
        text.map_or_else(|| NOTHING.into(), Self::from)
    }

    pub fn code(text: impl Into<String>) -> Self {
        Self { is_code: true, ..Self::from(text) }
    }

    #[must_use]
    pub fn with_unit(self, unit: &'static str) -> Self {
        Self { unit, ..self }
    }

    #[must_use]
    pub fn with_markup(self, markup: Markup) -> Self {
        Self { markup: Some(markup.into_string()), ..self }
    }

    #[must_use]
    pub fn with_verdict(self, verdict: Verdict) -> Self {
        Self { verdict: Some(verdict), ..self }
    }

    #[must_use]
    pub fn with_link(self, link: Option<String>) -> Self {
        Self { link, ..self }
    }

    #[must_use]
    pub fn with_notes(self, notes: impl IntoIterator<Item = String>) -> Self {
        Self { notes: notes.into_iter().collect(), ..self }
    }

    fn line(&self) -> String {
        let sign = self.verdict.map(|verdict| format!("{} ", format::sign(verdict))).unwrap_or_default();
        let parts: Vec<&str> = std::iter::once(&self.text).chain(&self.notes).map(String::as_str).collect();
        let unit = if self.unit.is_empty() { String::new() } else { format!(" {}", self.unit) };
        format!("{sign}{}{unit}", parts.join(", "))
    }

    pub fn html(&self) -> Markup {
        if let Some(markup) = &self.markup {
            return PreEscaped(markup.clone());
        }
        html! {
            @match (&self.link, self.verdict) {
                (Some(link), _) => a href=(link) { (self.text) },
                (None, Some(verdict)) => (verdict_badge(verdict, &self.text)),
                (None, None) if self.is_code => code { (self.text) },
                (None, None) if self.text == NOTHING => span.nothing { (self.text) },
                (None, None) if !self.unit.is_empty() => span { (self.text) " " span.unit { (self.unit) } },
                (None, None) => (self.text),
            }
            @for note in &self.notes { span.file { (note) } }
        }
    }
}

pub fn verdict_badge(verdict: Verdict, text: &str) -> Markup {
    html! { span class={ "badge " (verdict) } { span aria-hidden="true" { (format::sign(verdict)) } " " (text) } }
}

impl Table {
    pub fn new<C: Into<Column>>(columns: impl IntoIterator<Item = C>) -> Self {
        Self { columns: columns.into_iter().map(Into::into).collect(), ..Self::default() }
    }

    pub fn push<C: Into<Cell>>(&mut self, row: impl IntoIterator<Item = C>) {
        self.rows.push(row.into_iter().map(Into::into).collect());
    }

    pub fn extend<C: Into<Cell>, R: IntoIterator<Item = C>>(&mut self, rows: impl IntoIterator<Item = R>) {
        for row in rows {
            self.push(row);
        }
    }

    /// The header and the rows as lines of text with aligned columns.
    pub fn lines(&self) -> Vec<String> {
        self.styled_lines(Style::default())
    }

    fn styled_lines(&self, style: Style) -> Vec<String> {
        let row = |row: &Vec<Cell>| -> Vec<(String, Option<Verdict>)> {
            row.iter().map(|cell| (printable(&cell.line()).into_owned(), cell.verdict)).collect()
        };
        let header = self.columns.iter().map(|column| (printable(&column.label()).into_owned(), None)).collect();
        let lines: Vec<_> = std::iter::once(header).chain(self.rows.iter().map(row)).collect();
        let width = |column: usize| lines.iter().filter_map(|line| Some(line.get(column)?.0.chars().count())).max();
        let widths: Vec<usize> = (0..self.columns.len()).map(|column| width(column).unwrap_or(0)).collect();
        let line = |cells: &Vec<(String, Option<Verdict>)>| {
            let columns = self.columns.iter().zip(&widths);
            let padded = cells.iter().zip(columns).map(|((text, verdict), (column, width))| {
                let spaces = " ".repeat(width.saturating_sub(text.chars().count()));
                let text = verdict.map_or_else(|| text.clone(), |verdict| style.paint_verdict(verdict, text));
                if column.alignment == Alignment::Right { spaces + &text } else { text + &spaces }
            });
            padded.collect::<Vec<_>>().join("  ").trim_end().to_owned()
        };
        let mut lines: Vec<String> = lines.iter().map(line).collect();
        if let Some(header) = lines.first_mut() {
            *header = style.paint("2", header);
        }
        lines
    }

    /// Lines of at most `width` columns if possible: a wider table has a line per cell, as on a narrow page.
    pub fn console_lines(&self, width: Option<usize>, style: Style) -> Vec<String> {
        let is_too_wide = |width: usize| self.lines().iter().any(|line| line.chars().count() > width);
        if width.is_some_and(is_too_wide) { self.stacked_lines(style) } else { self.styled_lines(style) }
    }

    fn stacked_lines(&self, style: Style) -> Vec<String> {
        let mut lines = Vec::new();
        for (index, cell) in self.rows.iter().flat_map(|row| row.iter().enumerate()) {
            let text = printable(&cell.line()).into_owned();
            let text = cell.verdict.map_or_else(|| text.clone(), |verdict| style.paint_verdict(verdict, &text));
            match self.columns.get(index) {
                Some(column) if index > 0 => lines.push(format!("  {}: {text}", printable(&column.label()))),
                _ => lines.push(style.paint("1", &text)),
            }
        }
        lines
    }

    pub fn markdown(&self) -> String {
        let line = |cells: Vec<String>| format!("| {} |\n", cells.join(" | "));
        let header = line(self.columns.iter().map(|column| markdown_cell(&column.label())).collect());
        let rule = self.columns.iter().map(|column| match column.alignment {
            Alignment::Left => "---|",
            Alignment::Right => "--:|",
        });
        let rows = self.rows.iter().map(|row| line(row.iter().map(|cell| markdown_cell(&cell.line())).collect()));
        format!("{header}|{}\n{}", rule.collect::<String>(), rows.collect::<String>())
    }

    /// Writes CSV by RFC 4180. Escapes formulas of spreadsheets.
    pub fn csv(&self) -> String {
        let line = |cells: Vec<String>| cells.join(",") + "\n";
        let header = line(self.columns.iter().map(|column| csv_field(&column.label())).collect());
        let row = |row: &Vec<Cell>| line(row.iter().map(|cell| csv_field(&cell.text)).collect());
        header + &self.rows.iter().map(row).collect::<String>()
    }

    pub fn html(&self) -> Markup {
        self.html_as("Table", "stacked")
    }

    /// `class` selects rules of the page's style.
    pub fn html_as(&self, label: &str, class: &str) -> Markup {
        html! {
            div.scroll role="group" aria-label=(label) tabindex="0" {
                table class=(class) {
                    thead { tr { @for column in &self.columns { th class=[column.class()] scope="col" {
                        (column.name)
                        @if !column.unit.is_empty() { ", " span.unit { (column.unit) } }
                    } } } }
                    tbody { @for (number, row) in self.rows.iter().enumerate() {
                        tr class=[row.iter().any(|cell| cell.is_highlighted).then_some("changed")] {
                            @for (index, (cell, column)) in row.iter().zip(&self.columns).enumerate() {
                                @if index == 0 { th class=[column.class()] scope="row" { (cell.html()) } }
                                @else { td class=[column.class()] data-label=(column.label()) { (cell.html()) } }
                            }
                        }
                        @for (_, class, text) in self.remarks.iter().filter(|(row, ..)| *row == number) {
                            tr class=(class) { td colspan=(self.columns.len()) { span { (text) } } }
                        }
                    } }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_page_shows_remarks_markup_and_highlighted_rows() {
        let mut table = Table::new(["a", "b"]);
        table.push([Cell::from("1"), Cell::optional(None).with_markup(html! { b { "<2>" } })]);
        table.push([Cell { is_highlighted: true, ..Cell::from("3") }, Cell::optional(None)]);
        table.remarks.push((0, "reason", "<why>".to_owned()));
        let page = table.html().into_string();
        let body = page.split_once("<tbody>").unwrap().1.split_once("</tbody>").unwrap().0;
        assert_eq!(
            body,
            "<tr><th scope=\"row\">1</th><td data-label=\"b\"><b>&lt;2&gt;</b></td></tr>\
             <tr class=\"reason\"><td colspan=\"2\"><span>&lt;why&gt;</span></td></tr>\
             <tr class=\"changed\"><th scope=\"row\">3</th>\
             <td data-label=\"b\"><span class=\"nothing\">–</span></td></tr>"
        );
        assert_eq!(table.csv(), "a,b\n1,–\n3,–\n");
    }
}
