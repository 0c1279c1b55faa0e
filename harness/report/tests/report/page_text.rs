//! Reads the text of a page, one line per block, for snapshots.

/// Elements that end a line; cells of a row are separated by ` | `.
const BLOCKS: [&str; 16] = [
    "p",
    "li",
    "tr",
    "h1",
    "h2",
    "h3",
    "figcaption",
    "div",
    "section",
    "header",
    "main",
    "footer",
    "details",
    "ul",
    "ol",
    "dl",
];
const CELLS: [&str; 4] = ["th", "td", "dt", "summary"];

pub(crate) fn page_text(html: &str) -> String {
    let html = ["style", "script", "title"].iter().fold(html.to_owned(), |html, name| strip_elements(&html, name));
    let mut text = String::new();
    let mut drawing = 0;
    for part in html.split('<').skip(1) {
        let (tag, content) = part.split_once('>').unwrap();
        let name = tag.trim_start_matches('/').split([' ', '/']).next().unwrap();
        let is_end = tag.starts_with('/');
        match name {
            "svg" if is_end => drawing -= 1,
            "svg" => {
                drawing += 1;
                let label = tag.split("aria-label=\"").nth(1).and_then(|rest| rest.split('"').next());
                text.extend(label.map(|label| format!("[{label}]\n")));
            }
            name if BLOCKS.contains(&name) => text.push('\n'),
            "span" if !is_end => text.push(' '),
            name if CELLS.contains(&name) && is_end => text.push_str(" | "),
            _ => {}
        }
        if drawing == 0 {
            text.push_str(content);
        }
    }
    for (entity, character) in [("&lt;", "<"), ("&gt;", ">"), ("&quot;", "\""), ("&amp;", "&")] {
        text = text.replace(entity, character);
    }
    let lines = text.lines().map(|line| line.split_whitespace().collect::<Vec<_>>().join(" "));
    let lines: Vec<String> = lines.map(|line| line.trim_matches([' ', '|']).to_owned()).collect();
    lines.into_iter().filter(|line| !line.is_empty()).collect::<Vec<_>>().join("\n")
}

pub(crate) fn section<'a>(page: &'a str, id: &str) -> &'a str {
    let labelled = page.split("<section").find(|part| part.contains(&format!("id=\"{id}\"")));
    labelled
        .unwrap_or_else(|| panic!("no section {id}"))
        .split("</section>")
        .next()
        .map(|part| &part[part.find('>').unwrap() + 1..])
        .unwrap()
}

pub(crate) fn strip_elements(page: &str, element: &str) -> String {
    let (start, end) = (format!("<{element}"), format!("</{element}>"));
    let mut parts = page.split(&start);
    let first = parts.next().unwrap().to_owned();
    parts.fold(first, |kept, part| kept + part.split_once(&end).unwrap().1)
}

pub(crate) fn assert_balanced(page: &str) {
    const VOID: [&str; 3] = ["meta", "!DOCTYPE", "br"];
    let mut open: Vec<&str> = Vec::new();
    let page = strip_elements(&strip_elements(page, "style"), "script");
    for tag in page.split('<').skip(1) {
        let (tag, _) = tag.split_once('>').unwrap();
        if tag.ends_with('/') {
            continue;
        }
        let name = tag.split([' ', '/']).find(|part| !part.is_empty()).unwrap();
        if tag.starts_with('/') {
            let expected = open.pop();
            assert!(expected.is_none_or(|expected| expected == name), "</{name}> closes {expected:?}");
        } else if !VOID.contains(&name) {
            open.push(name);
        }
    }
    assert_eq!(open, Vec::<&str>::new());
}
