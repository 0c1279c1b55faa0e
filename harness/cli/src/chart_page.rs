//! Writes a page of charts and their files.

use platebench_report::ReportError;
use platebench_report::page::{BlockPage, PageBlock};
use platebench_study::charts::ChartSection;
use platebench_trace::write_atomically;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

#[derive(Debug, thiserror::Error)]
pub(crate) enum WriteError {
    #[error(transparent)]
    Page(#[from] ReportError),
    #[error("{}: {source}", path.display())]
    Io { path: PathBuf, source: io::Error },
}

pub(crate) fn create_folder(folder: &Path) -> Result<(), WriteError> {
    fs::create_dir_all(folder).map_err(|source| WriteError::Io { path: folder.to_owned(), source })
}

/// Returns the page's path. A section has a heading unless its title is that of the page.
pub(crate) fn write_page(
    folder: &Path,
    name: &str,
    title: &str,
    intro: String,
    sections: &[ChartSection],
) -> Result<PathBuf, WriteError> {
    let mut blocks = Vec::new();
    for section in sections {
        for (name, text) in &section.files {
            let path = folder.join(name);
            write_atomically(&path, text.as_bytes()).map_err(|source| WriteError::Io { path, source })?;
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
