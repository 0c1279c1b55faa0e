//! Escapes text of files and devices, so that it cannot act on a terminal, a table or a CI system.

use std::borrow::Cow;

/// Escapes control characters and changes of the writing direction, for example as `\u{1b}`.
pub fn printable(text: &str) -> Cow<'_, str> {
    escape(text, is_active)
}

/// Like [`printable`], but keeps line feeds.
pub fn printable_lines(text: &str) -> Cow<'_, str> {
    escape(text, |character| character != '\n' && is_active(character))
}

fn escape(text: &str, is_escaped: fn(char) -> bool) -> Cow<'_, str> {
    if !text.contains(is_escaped) {
        return Cow::Borrowed(text);
    }
    let mut escaped = String::with_capacity(text.len() + 8);
    for character in text.chars() {
        if is_escaped(character) {
            escaped.extend(character.escape_default());
        } else {
            escaped.push(character);
        }
    }
    Cow::Owned(escaped)
}

/// Control characters, separators of lines and paragraphs, marks of the writing direction.
pub fn is_active(character: char) -> bool {
    character.is_control()
        || matches!(character, '\u{61c}' | '\u{200b}'..='\u{200f}' | '\u{2028}'..='\u{202e}')
        || matches!(character, '\u{2060}'..='\u{206f}' | '\u{feff}')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn escapes_hostile_text() {
        let hostile = "=1\u{1b}[2J\u{202e}\n::error::#|";
        assert_eq!(printable(hostile), "=1\\u{1b}[2J\\u{202e}\\n::error::#|");
        assert_eq!(printable_lines(hostile), "=1\\u{1b}[2J\\u{202e}\n::error::#|");
        assert_eq!([printable, printable_lines].map(|escape| escape("µm ≤ 2 …")), ["µm ≤ 2 …"; 2]);
    }
}
