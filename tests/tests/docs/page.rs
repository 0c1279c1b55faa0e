//! A page of the documentation, taken apart.

use pulldown_cmark::{CodeBlockKind, Event, Options, Parser, Tag, TagEnd};
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// The workspace.
pub(crate) fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").canonicalize().unwrap()
}

/// A code block.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Block {
    /// What stands behind the fence.
    pub(crate) language: String,
    pub(crate) text: String,
    /// Line of its text in the page, from 1.
    pub(crate) line: usize,
}

/// What a test looks at.
#[derive(Debug, Default)]
pub(crate) struct Page {
    /// Relative to the workspace.
    pub(crate) file: PathBuf,
    pub(crate) anchors: Vec<String>,
    /// Destination and line.
    pub(crate) links: Vec<(String, usize)>,
    pub(crate) blocks: Vec<Block>,
}

impl Page {
    pub(crate) fn read(file: &Path) -> Self {
        let text = fs::read_to_string(root().join(file)).unwrap();
        Self { file: file.to_owned(), ..Self::of(&text) }
    }

    pub(crate) fn of(text: &str) -> Self {
        let line = |at: usize| text.get(..at).unwrap_or_default().matches('\n').count() + 1;
        let mut page = Self::default();
        let mut heading: Option<String> = None;
        let mut block: Option<Block> = None;
        let mut seen = BTreeMap::new();
        for (event, range) in
            Parser::new_ext(text, Options::ENABLE_TABLES | Options::ENABLE_STRIKETHROUGH).into_offset_iter()
        {
            match event {
                Event::Start(Tag::Heading { .. }) => heading = Some(String::new()),
                Event::End(TagEnd::Heading(_)) => {
                    page.anchors.extend(heading.take().map(|title| anchor(&title, &mut seen)));
                }
                Event::Start(Tag::Link { dest_url, .. } | Tag::Image { dest_url, .. }) => {
                    page.links.push((dest_url.into_string(), line(range.start)));
                }
                Event::Start(Tag::CodeBlock(CodeBlockKind::Fenced(language))) => {
                    block = Some(Block {
                        language: language.into_string(),
                        text: String::new(),
                        line: line(range.start) + 1,
                    });
                }
                Event::End(TagEnd::CodeBlock) => page.blocks.extend(block.take()),
                Event::Text(words) | Event::Code(words) => {
                    if let Some(block) = &mut block {
                        block.text.push_str(&words);
                    } else if let Some(heading) = &mut heading {
                        heading.push_str(&words);
                    }
                }
                _ => {}
            }
        }
        page
    }
}

/// What a forge calls a heading: lower case, no punctuation, hyphens for spaces; a second one of the same title gets a number.
fn anchor(title: &str, seen: &mut BTreeMap<String, usize>) -> String {
    let kept = title.trim().to_lowercase().replace(' ', "-");
    let name: String = kept.chars().filter(|c| c.is_alphanumeric() || matches!(c, '-' | '_')).collect();
    let times = seen.entry(name.clone()).or_default();
    *times += 1;
    if *times == 1 { name } else { format!("{name}-{}", *times - 1) }
}

/// Every page that people read: the README, what stands beside code, and `docs/`.
pub(crate) fn pages() -> Vec<Page> {
    let mut files = Vec::new();
    collect(Path::new(""), &mut files);
    files.sort();
    files.iter().map(|file| Page::read(file)).collect()
}

fn collect(folder: &Path, files: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(root().join(folder)).unwrap() {
        let entry = entry.unwrap();
        let path = folder.join(entry.file_name());
        let name = entry.file_name().to_string_lossy().into_owned();
        if entry.file_type().unwrap().is_dir() {
            // What is built, what is run, what is vendored.
            if !name.starts_with('.') && !matches!(&*name, "target" | "runs" | "charts" | "node_modules" | "book") {
                collect(&path, files);
            }
        } else if path.extension().is_some_and(|extension| extension == "md") {
            files.push(path);
        }
    }
}

#[test]
fn a_page_is_taken_apart() {
    let page = Page::of(
        "# A `b` c: d!\n\n[x](y.md#z)\n\n## Same\n## Same\n\n```toml\na = 1\n```\n\n![i](j.png) `[no](link)`\n",
    );
    assert_eq!(page.anchors, ["a-b-c-d", "same", "same-1"]);
    assert_eq!(page.links, [("y.md#z".to_owned(), 3), ("j.png".to_owned(), 12)]);
    assert_eq!(page.blocks, [Block { language: "toml".to_owned(), text: "a = 1\n".to_owned(), line: 9 }]);
}

#[test]
fn the_pages_are_found() {
    let files: Vec<_> = pages().into_iter().map(|page| page.file).collect();
    for file in ["README.md", "CHANGELOG.md", "docs/verdicts.md", "firmware-under-test/stm32f4/README.md"] {
        assert!(files.iter().any(|found| found == Path::new(file)), "{file}");
    }
}
