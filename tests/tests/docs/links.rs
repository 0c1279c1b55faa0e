//! Every link inside the project leads to a file that is there, and to a heading that is in it.

use crate::page::{Page, pages, root};
use std::path::Path;

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
    for good in ["#metrics", "verdicts.md", "../README.md#two-commands", "../scenarios/paper", "https://example.org/#x"]
    {
        assert_eq!(fault(&page, good), None, "{good}");
    }
    for bad in
        ["#metric", "verdict.md", "README.md", "verdicts.md#", "../README.md#one-command", "../ci/release#x", "../../x"]
    {
        assert!(fault(&page, bad).is_some(), "{bad}");
    }
}
