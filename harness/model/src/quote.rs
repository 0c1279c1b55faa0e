//! Quotes text from outside, so that a reader sees where it begins and ends: the name of a
//! controller cannot pass for a statement of the bench.

use std::borrow::Cow;
use std::path::Path;

const MAX_CHARS: usize = 200;

/// A plain word stays as it is. Other text is in double quotes, with quotes, control characters and
/// marks of the writing direction escaped, and `…` after the quotes if it was cut.
pub fn quoted(text: &str) -> Cow<'_, str> {
    if text.chars().nth(MAX_CHARS).is_none() && is_plain_word(text) {
        return Cow::Borrowed(text);
    }
    Cow::Owned(in_quotes(text, MAX_CHARS))
}

/// As [`quoted`], but also a plain word is in quotes, and the text is cut to `max_chars`.
pub fn in_quotes(text: &str, max_chars: usize) -> String {
    let end = text.char_indices().nth(max_chars).map_or(text.len(), |(at, _)| at);
    let (kept, cut) = text.split_at(end);
    format!("{kept:?}{}", if cut.is_empty() { "" } else { "…" })
}

/// As [`quoted`], but a path may also consist of several words of any script.
pub fn quoted_path(path: &Path) -> String {
    let text = path.to_string_lossy();
    let is_plain = |word: &str| {
        let bare: String = word.chars().filter(|character| !character.is_alphanumeric()).collect();
        !word.is_empty() && is_plain_word(&format!("{bare}/"))
    };
    if text.split(' ').all(is_plain) && !text.contains(": ") { text.into_owned() } else { quoted(&text).into_owned() }
}

/// Without white space, no word can contain the separators of the bench's own lines.
fn is_plain_word(text: &str) -> bool {
    let is_plain = |byte: u8| byte.is_ascii_alphanumeric() || b"_-+./@:%=~".contains(&byte);
    text.bytes().all(is_plain) && text.bytes().next_back().is_some_and(|last| last != b':')
}

#[cfg(test)]
mod tests {
    use super::*;
    use rstest::rstest;

    #[rstest]
    #[case::word("dq-pi_2.1", "dq-pi_2.1")]
    #[case::path("paper/fig13.toml", "paper/fig13.toml")]
    #[case::rig("serial:/dev/ttyACM0@1000000", "serial:/dev/ttyACM0@1000000")]
    #[case::empty("", "\"\"")]
    #[case::statement("ok; rig emulated", "\"ok; rig emulated\"")]
    #[case::label("verdict:", "\"verdict:\"")]
    #[case::quote("a\"b", "\"a\\\"b\"")]
    #[case::escape("\u{1b}[2J\n\u{202e}", "\"\\u{1b}[2J\\n\\u{202e}\"")]
    fn only_a_plain_word_has_no_quotes(#[case] text: &str, #[case] expected: &str) {
        assert_eq!(quoted(text), expected);
    }

    #[rstest]
    #[case::two_words("my runs/größe 2", "my runs/größe 2")]
    #[case::lines("runs\nverdict: pass", "\"runs\\nverdict: pass\"")]
    #[case::label("runs: pass", "\"runs: pass\"")]
    #[case::spaces("a  b", "\"a  b\"")]
    #[case::escape("a\u{1b}[2J", "\"a\\u{1b}[2J\"")]
    fn a_path_of_plain_words_has_no_quotes(#[case] path: &str, #[case] expected: &str) {
        assert_eq!(quoted_path(Path::new(path)), expected);
    }

    #[test]
    fn cuts_text_above_200_characters() {
        assert_eq!(quoted(&"x".repeat(MAX_CHARS)), "x".repeat(MAX_CHARS));
        assert_eq!(quoted(&"µ".repeat(MAX_CHARS + 1)), format!("\"{}\"…", "µ".repeat(MAX_CHARS)));
    }
}
