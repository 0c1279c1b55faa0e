//! Every link inside the project leads to a file that is there, and to a heading that is in it. A page of the book links to nothing outside of it, where its readers have nothing.

use crate::page::{Page, pages, root};
use std::path::Path;

/// The book's pages, as `book.toml` says; `examples` below it are no pages of it.
const BOOK: &str = "docs";

/// What is wrong with a link of `page`.
fn fault(page: &Page, link: &str) -> Option<String> {
    if link.contains("://") || link.starts_with("mailto:") {
        return None;
    }
    let (path, anchor) = link.split_once('#').map_or((link, None), |(path, anchor)| (path, Some(anchor)));
    let folder = page.file.parent().unwrap_or(Path::new(""));
    let file = if path.is_empty() { page.file.clone() } else { folder.join(path) };
    let Ok(there) = root().join(&file).canonicalize() else { return Some(format!("there is no {}", file.display())) };
    if !there.starts_with(root()) {
        return Some(format!("{} is not in the project", file.display()));
    }
    if page.file.parent() == Some(Path::new(BOOK)) && !there.starts_with(root().join(BOOK)) {
        return Some(format!("{} is not in the book", file.display()));
    }
    let anchor = anchor?;
    if there.is_file() && there.extension().is_some_and(|extension| extension == "md") {
        let target = Page::read(&there);
        let known = target.anchors.iter().any(|known| known == anchor);
        return (!known).then(|| format!("{} has no heading `{anchor}`, only {:?}", file.display(), target.anchors));
    }
    Some(format!("{} has no headings", file.display()))
}

#[test]
fn every_link_leads_somewhere() {
    let mut checked = 0;
    let mut faults = Vec::new();
    for page in pages() {
        for (link, line) in &page.links {
            checked += 1;
            faults.extend(fault(&page, link).map(|fault| format!("{}:{line}: `{link}`: {fault}", page.file.display())));
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
    assert!(checked > 50, "only {checked} links were found");
}

#[test]
fn links_that_lead_nowhere_are_seen() {
    let page = Page { file: "docs/verdicts.md".into(), ..Page::default() };
    for good in ["#metrics", "verdicts.md", "report.md#plots", "examples/controller.py", "https://example.org/#x"] {
        assert_eq!(fault(&page, good), None, "{good}");
    }
    let outside = ["../README.md#two-commands", "../scenarios/paper"];
    let lost = [
        "#metric",
        "verdict.md",
        "README.md",
        "verdicts.md#",
        "../README.md#one-command",
        "../ci/release#x",
        "../../x",
    ];
    for bad in outside.into_iter().chain(lost) {
        assert!(fault(&page, bad).is_some(), "{bad}");
    }
    let readme = Page { file: "docs/examples/native-tests/README.md".into(), ..Page::default() };
    assert_eq!(fault(&readme, "../../../README.md#two-commands"), None, "no page of the book");
}
