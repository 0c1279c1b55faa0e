//! Defines a section of a page of charts and writes such pages with their files.

use super::block_page::{BlockPage, PageBlock};
use crate::error::{ReportError, write_file};
use crate::text::Table;
use std::path::{Path, PathBuf};

#[derive(Debug, Clone, PartialEq)]
pub struct ChartSection {
    pub title: &'static str,
    pub summary: String,
    pub blocks: Vec<PageBlock>,
    /// Name and content of each file.
    pub files: Vec<(String, String)>,
}

impl ChartSection {
    pub fn paragraphs(texts: &[&str]) -> Vec<PageBlock> {
        texts.iter().map(|text| PageBlock::Text((*text).to_owned())).collect()
    }

    pub fn indented(table: &Table) -> String {
        table.lines().iter().flat_map(|line| ["  ", line, "\n"]).collect()
    }
}

/// Returns the path of the page. A section with the title of the page gets no heading of its own.
pub fn write_chart_page(
    folder: &Path,
    name: &str,
    title: &str,
    intro: String,
    sections: &[ChartSection],
) -> Result<PathBuf, ReportError> {
    let mut blocks = Vec::new();
    for section in sections {
        for (name, text) in &section.files {
            write_file(&folder.join(name), text)?;
        }
        if section.title != title {
            blocks.push(PageBlock::Heading(section.title.to_owned()));
        }
        blocks.extend(section.blocks.iter().cloned());
    }
    let path = folder.join(name);
    BlockPage { title: title.to_owned(), intro, blocks }.write(&path)?;
    Ok(path)
}
