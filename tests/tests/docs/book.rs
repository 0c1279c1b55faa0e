//! The book: every page is in its table of contents, and every entry of that is a page.

use crate::page::{Page, root};
use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

#[test]
fn every_page_has_its_place() {
    let summary = Page::read(Path::new("docs/SUMMARY.md"));
    let listed: BTreeSet<_> = summary.links.iter().map(|(link, _)| link.clone()).collect();
    assert_eq!(listed.len(), summary.links.len(), "a page is listed twice");
    let paths = fs::read_dir(root().join("docs")).unwrap().map(|entry| entry.unwrap().path());
    let pages = paths.filter(|path| path.extension().is_some_and(|extension| extension == "md"));
    let mut pages: BTreeSet<_> = pages.map(|path| path.file_name().unwrap().to_string_lossy().into_owned()).collect();
    assert!(pages.remove("SUMMARY.md"));
    assert_eq!(listed, pages);
}

#[test]
fn the_book_is_made_of_the_pages() {
    let book: toml::Table = fs::read_to_string(root().join("book.toml")).unwrap().parse().unwrap();
    assert_eq!(book["book"]["src"].as_str(), Some("docs"));
    let built = book["build"]["build-dir"].as_str().unwrap();
    assert!(built.starts_with("target/"), "{built} would be a stray folder");
}
