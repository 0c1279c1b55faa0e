//! Parses a Markdown page of the documentation.

use pulldown_cmark::{CodeBlockKind, Event, Options, Parser, Tag, TagEnd};
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

pub(crate) use platebench_test_kit::workspace_root;

#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Block {
    /// Word after the opening fence, or `indented` for a block without a fence.
    pub(crate) language: String,
    pub(crate) text: String,
    pub(crate) line: usize,
}

#[derive(Debug, Default)]
pub(crate) struct DocumentPage {
    /// Path relative to the workspace.
    pub(crate) file: PathBuf,
    pub(crate) anchors: Vec<String>,
    /// Destination and line number of each link.
    pub(crate) links: Vec<(String, usize)>,
    pub(crate) blocks: Vec<Block>,
    pub(crate) code_spans: Vec<(String, usize)>,
}

impl DocumentPage {
    pub(crate) fn read(file: &Path) -> Self {
        let text = fs::read_to_string(workspace_root().join(file)).unwrap();
        Self { file: file.to_owned(), ..Self::parse(&text) }
    }

    pub(crate) fn parse(text: &str) -> Self {
        let line = |at: usize| text.get(..at).unwrap_or_default().matches('\n').count() + 1;
        let mut page = Self::default();
        let mut heading: Option<String> = None;
        let mut block: Option<Block> = None;
        let mut counts = BTreeMap::new();
        for (event, range) in
            Parser::new_ext(text, Options::ENABLE_TABLES | Options::ENABLE_STRIKETHROUGH).into_offset_iter()
        {
            match event {
                Event::Start(Tag::Heading { .. }) => heading = Some(String::new()),
                Event::End(TagEnd::Heading(_)) => {
                    page.anchors.extend(heading.take().map(|title| anchor(&title, &mut counts)));
                }
                Event::Start(Tag::Link { dest_url, .. } | Tag::Image { dest_url, .. }) => {
                    page.links.push((dest_url.into_string(), line(range.start)));
                }
                Event::Start(Tag::CodeBlock(kind)) => {
                    let (language, line) = match kind {
                        CodeBlockKind::Fenced(language) => (language.into_string(), line(range.start) + 1),
                        CodeBlockKind::Indented => ("indented".to_owned(), line(range.start)),
                    };
                    block = Some(Block { language, text: String::new(), line });
                }
                Event::End(TagEnd::CodeBlock) => page.blocks.extend(block.take()),
                Event::Text(words) => match (&mut block, &mut heading) {
                    (Some(block), _) => block.text.push_str(&words),
                    (None, Some(heading)) => heading.push_str(&words),
                    (None, None) => {}
                },
                Event::Code(words) => {
                    if let Some(heading) = &mut heading {
                        heading.push_str(&words);
                    }
                    page.code_spans.push((words.replace('\n', " "), line(range.start)));
                }
                _ => {}
            }
        }
        page
    }
}

/// GitHub's anchor: lower case, no punctuation, hyphens for spaces, a number if repeated.
fn anchor(title: &str, counts: &mut BTreeMap<String, usize>) -> String {
    let kept = title.trim().to_lowercase().replace(' ', "-");
    let name: String = kept.chars().filter(|c| c.is_alphanumeric() || matches!(c, '-' | '_')).collect();
    let times = counts.entry(name.clone()).or_default();
    *times += 1;
    if *times == 1 { name } else { format!("{name}-{}", *times - 1) }
}

pub(crate) fn read_pages() -> Vec<DocumentPage> {
    let mut files = Vec::new();
    collect(Path::new(""), &mut files);
    files.sort();
    files.iter().map(|file| DocumentPage::read(file)).collect()
}

fn collect(folder: &Path, files: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(workspace_root().join(folder)).unwrap() {
        let entry = entry.unwrap();
        let path = folder.join(entry.file_name());
        let name = entry.file_name().to_string_lossy().into_owned();
        if entry.file_type().unwrap().is_dir() {
            if !name.starts_with('.') && !matches!(&*name, "target" | "runs" | "charts" | "node_modules" | "book") {
                collect(&path, files);
            }
        } else if path.extension().is_some_and(|extension| extension == "md") {
            files.push(path);
        }
    }
}

#[test]
fn parses_a_page() {
    let page = DocumentPage::parse(
        "# A `b` c: d!\n\n[x](y.md#z)\n\n## Same\n## Same\n\n```toml\na = 1\n```\n\n![i](j.png) `[no](link)`\n",
    );
    assert_eq!(page.anchors, ["a-b-c-d", "same", "same-1"]);
    assert_eq!(page.links, [("y.md#z".to_owned(), 3), ("j.png".to_owned(), 12)]);
    assert_eq!(page.code_spans, [("b".to_owned(), 1), ("[no](link)".to_owned(), 12)]);
    assert_eq!(page.blocks, [Block { language: "toml".to_owned(), text: "a = 1\n".to_owned(), line: 9 }]);
}

#[test]
fn finds_the_pages() {
    let files: Vec<_> = read_pages().into_iter().map(|page| page.file).collect();
    for file in ["README.md", "CHANGELOG.md", "docs/verdicts.md", "firmware-under-test/stm32f4/README.md"] {
        assert!(files.iter().any(|found| found == Path::new(file)), "{file}");
    }
}
