//! Defines a section of a page of charts and writes such pages with their files.

use crate::document::{Block, Document};
use crate::error::{ReportError, write_file};
use std::path::{Path, PathBuf};

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
) -> Result<PathBuf, ReportError> {
    let mut blocks = Vec::new();
    for ChartSection { document, files } in sections {
        for (name, text) in files {
            write_file(&folder.join(name), text)?;
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
