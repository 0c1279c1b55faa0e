//! Compares the table of contents of the book with its pages.

use crate::page::{DocumentPage, workspace_root};
use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

#[test]
fn every_page_is_in_the_table_of_contents() {
    let summary = DocumentPage::read(Path::new("docs/SUMMARY.md"));
    let listed: BTreeSet<_> = summary.links.iter().map(|(link, _)| link.clone()).collect();
    assert_eq!(listed.len(), summary.links.len(), "a page is listed twice");
    let mut pages = BTreeSet::new();
    for folder in ["", "decisions/"] {
        for entry in fs::read_dir(workspace_root().join("docs").join(folder)).unwrap() {
            let name = entry.unwrap().file_name().to_string_lossy().into_owned();
            if Path::new(&name).extension().is_some_and(|extension| extension == "md") {
                pages.insert(format!("{folder}{name}"));
            }
        }
    }
    assert!(pages.remove("SUMMARY.md"));
    assert_eq!(listed, pages);
}

#[test]
fn the_book_is_made_of_the_pages() {
    let book: toml::Table = fs::read_to_string(workspace_root().join("book.toml")).unwrap().parse().unwrap();
    assert_eq!(book["book"]["src"].as_str(), Some("docs"));
    let built = book["build"]["build-dir"].as_str().unwrap();
    assert!(built.starts_with("target/"), "{built} would be a stray folder");
}
