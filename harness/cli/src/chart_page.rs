//! Writes a page of charts and their files.

use crate::failure::{Failure, OrInvalid};
use platebench_model::trace::write_atomically;
use platebench_report::page::{BlockPage, PageBlock};
use platebench_study::charts::ChartSection;
use std::path::{Path, PathBuf};

/// Returns the path of the page. A section with the title of the page gets no heading of its own.
pub(crate) fn write_page(
    folder: &Path,
    name: &str,
    title: &str,
    intro: String,
    sections: &[ChartSection],
) -> Result<PathBuf, Failure> {
    let mut blocks = Vec::new();
    for section in sections {
        for (name, text) in &section.files {
            let path = folder.join(name);
            write_atomically(&path, text.as_bytes()).or_invalid_at(&path)?;
        }
        if section.title != title {
            blocks.push(PageBlock::Heading(section.title.to_owned()));
        }
        blocks.extend(section.blocks.iter().cloned());
    }
    let path = folder.join(name);
    BlockPage { title: title.to_owned(), intro, blocks }.write(&path).or_invalid()?;
    Ok(path)
}
