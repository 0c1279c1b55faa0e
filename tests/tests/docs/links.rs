//! Checks that links lead to existing files and headings, and that file names in text exist.
//!
//! Pages of the book link only to pages of the book, because its readers have no other files.

use crate::command::missing_path;
use crate::page::{DocumentPage, read_pages, workspace_root};
use std::path::Path;

/// Folder of the book's pages, as in `book.toml`. Its folder `examples` contains no pages.
const BOOK: &str = "docs";

fn link_fault(page: &DocumentPage, link: &str) -> Option<String> {
    if link.contains("://") || link.starts_with("mailto:") {
        return None;
    }
    let (path, anchor) = link.split_once('#').map_or((link, None), |(path, anchor)| (path, Some(anchor)));
    let folder = page.file.parent().unwrap_or(Path::new(""));
    let file = if path.is_empty() { page.file.clone() } else { folder.join(path) };
    let Ok(there) = workspace_root().join(&file).canonicalize() else {
        return Some(format!("{} does not exist", file.display()));
    };
    if !there.starts_with(workspace_root()) {
        return Some(format!("{} is not in the project", file.display()));
    }
    if page.file.parent() == Some(Path::new(BOOK)) && !there.starts_with(workspace_root().join(BOOK)) {
        return Some(format!("{} is not in the book", file.display()));
    }
    let anchor = anchor?;
    if there.is_file() && there.extension().is_some_and(|extension| extension == "md") {
        let target = DocumentPage::read(&there);
        let known = target.anchors.iter().any(|known| known == anchor);
        return (!known).then(|| format!("{} has no heading `{anchor}`, only {:?}", file.display(), target.anchors));
    }
    Some(format!("{} has no headings", file.display()))
}

#[test]
fn every_link_has_a_target() {
    let mut checked = 0;
    let mut faults = Vec::new();
    for page in read_pages() {
        for (link, line) in &page.links {
            checked += 1;
            faults.extend(
                link_fault(&page, link).map(|fault| format!("{}:{line}: `{link}`: {fault}", page.file.display())),
            );
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
    assert!(checked > 50, "only {checked} links were found");
}

#[test]
fn every_named_path_exists() {
    let mut checked = 0;
    let mut faults = Vec::new();
    // The changelog describes earlier versions, whose files need not exist.
    for page in read_pages().into_iter().filter(|page| page.file != Path::new("CHANGELOG.md")) {
        for (code, line) in &page.code_spans {
            // Placeholders such as `scenarios/<name>` are no file names.
            let path = code.split_whitespace().next().unwrap_or_default();
            if path.contains(['<', '{', '…']) {
                continue;
            }
            checked += usize::from(path.contains('/'));
            faults.extend(
                missing_path(path, &workspace_root()).map(|it| format!("{}:{line}: {it}", page.file.display())),
            );
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
    assert!(checked > 100, "only {checked} paths were found");
}

#[test]
fn every_scenario_in_the_help_exists() {
    let page = DocumentPage::read(Path::new("docs/reference-commands.md"));
    let words = page.blocks.iter().flat_map(|block| block.text.split_whitespace());
    let paths: Vec<_> = words
        .map(|word| word.trim_matches(|letter: char| !letter.is_alphanumeric() && letter != '/'))
        // `platebench new` writes this one.
        .filter(|word| word.starts_with("scenarios/") && !word.ends_with("first-step.toml"))
        .collect();
    let missing: Vec<_> = paths.iter().filter(|path| !workspace_root().join(path).exists()).collect();
    assert!(missing.is_empty(), "{missing:?}");
    assert!(paths.len() > 5, "{paths:?}");
}

#[test]
fn finds_links_without_a_target() {
    let page = DocumentPage { file: "docs/verdicts.md".into(), ..DocumentPage::default() };
    for good in ["#metrics", "verdicts.md", "report.md#plots", "examples/controller.py", "https://example.org/#x"] {
        assert_eq!(link_fault(&page, good), None, "{good}");
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
        assert!(link_fault(&page, bad).is_some(), "{bad}");
    }
    let readme = DocumentPage { file: "docs/examples/native-tests/README.md".into(), ..DocumentPage::default() };
    assert_eq!(link_fault(&readme, "../../../README.md#two-commands"), None, "not a page of the book");
}

/// Names of commands before version 0.3 that mean nothing else. CHANGELOG.md says what replaced them.
const OLD_COMMANDS: [&str; 4] = ["accept verify", "boards clear", "emulate", "export-fmu"];

#[test]
fn no_page_names_an_old_command() {
    for page in read_pages().into_iter().filter(|page| page.file != Path::new("CHANGELOG.md")) {
        for (code, line) in &page.code_spans {
            let name = code.strip_prefix("platebench ").unwrap_or(code);
            assert!(!OLD_COMMANDS.contains(&name), "{}:{line}: `{code}`", page.file.display());
        }
    }
}
