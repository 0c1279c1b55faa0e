//! Escapes text of files and devices, so that it cannot act on a table of Markdown or a spreadsheet.

use platebench_model::printable::printable;
use std::borrow::Cow;

const MAX_CELL_CHARS: usize = 400;

/// Escapes markup and characters that end a cell, and joins lines.
pub(crate) fn markdown_text(text: &str) -> String {
    escape_markdown(text.chars(), text.len())
}

/// Like [`markdown_text`], but shortens long texts.
pub(crate) fn markdown_cell(text: &str) -> String {
    let mut cell = escape_markdown(text.chars().take(MAX_CELL_CHARS), text.len());
    if text.chars().nth(MAX_CELL_CHARS).is_some() {
        cell.push('…');
    }
    cell
}

fn escape_markdown(characters: impl Iterator<Item = char>, length: usize) -> String {
    let mut escaped = String::with_capacity(length);
    let mut characters = characters.peekable();
    while let Some(character) = characters.next() {
        match character {
            '\n' | '\r' => escaped.push(' '),
            // No tag starts with a space.
            '<' if characters.peek() == Some(&' ') => escaped.push('<'),
            '<' => escaped.push_str("&lt;"),
            '&' => escaped.push_str("&amp;"),
            '|' | '\\' | '`' | '*' | '_' | '[' | ']' | '~' | '#' | '@' => {
                escaped.push('\\');
                escaped.push(character);
            }
            other => escaped.push_str(&printable(other.encode_utf8(&mut [0; 4]))),
        }
    }
    escaped
}

/// Returns a `'` and the text if a spreadsheet would read the text as a formula, otherwise the text.
pub fn without_formula(text: &str) -> Cow<'_, str> {
    let is_formula = text.starts_with(['=', '+', '-', '@', '\t', '\r']) && text.parse::<f64>().is_err();
    if is_formula { Cow::Owned(format!("'{text}")) } else { Cow::Borrowed(text) }
}

/// RFC 4180, without formulas of spreadsheets.
pub(crate) fn csv_field(text: &str) -> String {
    let text = without_formula(text);
    let text = printable(&text);
    if text.contains([',', '"']) { format!("\"{}\"", text.replace('"', "\"\"")) } else { text.into_owned() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rstest::rstest;

    #[rstest]
    #[case(markdown_cell, "=1\\u{1b}\\[2J\\u{202e} ::error::\\#\\|")]
    #[case(csv_field, "'=1\\u{1b}[2J\\u{202e}\\n::error::#|")]
    fn escapes_hostile_text(#[case] escape: fn(&str) -> String, #[case] expected: &str) {
        assert_eq!(escape("=1\u{1b}[2J\u{202e}\n::error::#|"), expected);
        assert_eq!(escape("µm ≤ 2 …"), "µm ≤ 2 …");
    }

    #[rstest]
    #[case("-0.5", "-0.5")]
    #[case("-x", "'-x")]
    #[case("@SUM(A1)", "'@SUM(A1)")]
    #[case("+1,=2", "\"'+1,=2\"")]
    #[case("a \"b\"", "\"a \"\"b\"\"\"")]
    fn quotes_fields_and_defuses_formulas(#[case] text: &str, #[case] expected: &str) {
        assert_eq!(csv_field(text), expected);
    }

    #[test]
    fn a_markdown_cell_has_no_markup_and_an_end() {
        assert_eq!(markdown_cell("a|b <img> & `x` [y](z)"), "a\\|b &lt;img> &amp; \\`x\\` \\[y\\](z)");
        assert_eq!(markdown_cell("a < 1 <b"), "a < 1 &lt;b");
        assert_eq!(markdown_cell(&"x".repeat(MAX_CELL_CHARS)), "x".repeat(MAX_CELL_CHARS));
        assert_eq!(markdown_cell(&"x".repeat(MAX_CELL_CHARS + 1)), "x".repeat(MAX_CELL_CHARS) + "…");
    }
}
