//! Decides whether the output has colours.

use clap::{ColorChoice, ValueEnum};
use std::ffi::OsStr;
use std::io::IsTerminal;
use std::sync::OnceLock;

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum)]
pub(crate) enum ColorArg {
    /// On a terminal, unless `NO_COLOR` is set
    #[default]
    Auto,
    /// Also in files and pipes
    Always,
    /// No colours
    Never,
}

static CHOICE: OnceLock<ColorArg> = OnceLock::new();

pub(crate) fn set(choice: ColorArg) {
    CHOICE.get_or_init(|| choice);
}

pub(crate) fn applies_to(output: &impl IsTerminal) -> bool {
    let choice = CHOICE.get().copied().unwrap_or_default();
    choice.applies(output.is_terminal(), std::env::var_os("NO_COLOR").as_deref())
}

/// Reads `--color` before clap parses the command line, because help and wrong usage need it too.
pub(crate) fn choice_of_arguments(words: impl Iterator<Item = String>) -> ColorArg {
    let words: Vec<_> = words.take_while(|word| word != "--").collect();
    let separate = words.array_windows().filter(|[word, _]| word == "--color").map(|[_, value]| value.as_str());
    let joined = words.iter().filter_map(|word| word.strip_prefix("--color="));
    separate.chain(joined).find_map(|value| ColorArg::from_str(value, false).ok()).unwrap_or_default()
}

impl ColorArg {
    pub(crate) const fn for_clap(self) -> ColorChoice {
        match self {
            Self::Auto => ColorChoice::Auto,
            Self::Always => ColorChoice::Always,
            Self::Never => ColorChoice::Never,
        }
    }

    /// An empty `NO_COLOR` counts as not set: <https://no-color.org>.
    fn applies(self, is_terminal: bool, no_color: Option<&OsStr>) -> bool {
        match self {
            Self::Auto => is_terminal && no_color.is_none_or(OsStr::is_empty),
            Self::Always => true,
            Self::Never => false,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rstest::rstest;

    #[rstest]
    #[case(ColorArg::Auto, true, None, true)]
    #[case(ColorArg::Auto, true, Some(""), true)]
    #[case(ColorArg::Auto, true, Some("1"), false)]
    #[case(ColorArg::Auto, false, None, false)]
    #[case(ColorArg::Always, false, Some("1"), true)]
    #[case(ColorArg::Never, true, None, false)]
    fn colours_follow_option_variable_and_terminal(
        #[case] choice: ColorArg,
        #[case] is_terminal: bool,
        #[case] no_color: Option<&str>,
        #[case] expected: bool,
    ) {
        assert_eq!(choice.applies(is_terminal, no_color.map(OsStr::new)), expected);
    }

    #[rstest]
    #[case(&["run", "--color", "never"], ColorArg::Never)]
    #[case(&["--color=always", "run"], ColorArg::Always)]
    #[case(&["run", "--", "--color=always"], ColorArg::Auto)]
    #[case(&["run", "--color", "blue"], ColorArg::Auto)]
    fn the_option_is_read_before_parsing(#[case] words: &[&str], #[case] expected: ColorArg) {
        assert_eq!(choice_of_arguments(words.iter().map(ToString::to_string)), expected);
    }
}
