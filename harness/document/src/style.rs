//! Writes coloured and wrapped lines.

use platebench_model::printable::printable;
use platebench_model::record::Verdict;
use std::fmt::Write as _;

const WIDTH: usize = 100;

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Style {
    /// ANSI colours. Verdicts have a sign in any case.
    pub colour: bool,
    /// Columns of the terminal. `None` if the output is no terminal.
    pub width: Option<usize>,
}

impl Style {
    pub fn paint(self, code: &str, text: &str) -> String {
        if self.colour { format!("\u{1b}[{code}m{text}\u{1b}[0m") } else { text.to_owned() }
    }

    pub fn paint_verdict(self, verdict: Verdict, text: &str) -> String {
        let code = match verdict {
            Verdict::Pass => "32",
            Verdict::Fail => "1;31",
            Verdict::Inconclusive => "33",
        };
        self.paint(code, text)
    }

    /// Lines as wide as the terminal, or of at most 100 columns. Only a longer word gives a
    /// longer line.
    pub fn write_wrapped(self, text: &mut String, first: &str, further: &str, sentence: &str) {
        write_wrapped_at(self.width.unwrap_or(WIDTH), text, first, further, sentence);
    }

    /// One line without a terminal, so that programs find the whole line.
    pub fn write_wrapped_on_terminals(self, text: &mut String, first: &str, further: &str, sentence: &str) {
        match self.width {
            Some(width) => write_wrapped_at(width, text, first, further, sentence),
            None => text.extend([first, sentence, "\n"]),
        }
    }
}

pub(crate) fn write_wrapped_at(width: usize, text: &mut String, first: &str, further: &str, sentence: &str) {
    let mut line = first.to_owned();
    let mut empty = true;
    for word in printable(sentence).split_whitespace() {
        if !empty && line.chars().count() + 1 + word.chars().count() > width {
            let _ = writeln!(text, "{line}");
            further.clone_into(&mut line);
            empty = true;
        }
        if !empty {
            line.push(' ');
        }
        line.push_str(word);
        empty = false;
    }
    if !empty {
        let _ = writeln!(text, "{line}");
    }
}
