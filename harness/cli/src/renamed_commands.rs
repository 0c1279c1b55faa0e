//! Names the replacement of each command that version 0.3.0 renamed.

/// Old name and new command line. A second word distinguishes command lines that begin alike, so
/// its row comes first. CHANGELOG.md contains the same table.
const RENAMED: [(&str, &str); 19] = [
    ("judge", "report RUN --rejudge"),
    ("export", "report RUN --export FORMAT"),
    ("merge", "report --merge RUN... --out RUN"),
    ("compare --against", "compare A B"),
    ("emulate", "plate serve"),
    ("export-fmu", "plate fmu"),
    ("boards clear", "board clear"),
    ("boards", "board list"),
    ("soak", "board soak"),
    ("accept verify", "acceptance verify"),
    ("accept", "acceptance run"),
    ("trust", "suite trust"),
    ("coverage", "suite coverage"),
    ("mutate", "suite mutate"),
    ("explore", "suite explore"),
    ("schema", "generate schema"),
    ("completions", "generate completions"),
    ("man", "generate man"),
    ("chart", "cargo charts"),
];

/// Returns the error message for a command line with an old name. `words` begins after the name of
/// the program; `is_command` tells whether a word is a command of today.
pub(crate) fn message(words: &[String], is_command: impl Fn(&str) -> bool) -> Option<String> {
    let is_known = |word: &str| is_command(word) || RENAMED.iter().any(|(was, _)| first_word(was) == word);
    let start = words.iter().position(|word| is_known(word))?;
    let (command, rest) = words.get(start..)?.split_first()?;
    // An option may contain its value: --against=RUN.
    let has = |part: &str| rest.iter().any(|word| word.split('=').next() == Some(part));
    let is_meant = |was: &str| first_word(was) == command && was.split(' ').skip(1).all(has);
    RENAMED.iter().find(|(was, _)| is_meant(was)).map(|(was, now)| format!("'{was}' is now '{now}'"))
}

fn first_word(text: &str) -> &str {
    text.split(' ').next().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::args::{Arguments, parse_words};
    use clap::CommandFactory;
    use std::fs;

    fn error(words: &str) -> clap::Error {
        parse_words(&mut Arguments::command(), words.split(' ').map(Into::into).collect()).unwrap_err()
    }

    #[test]
    fn each_old_name_prints_the_new_one() {
        for (was, now) in RENAMED {
            for call in
                [was.to_owned(), format!("-v --color never {was} a --rig hosted --out b"), format!("help {was}")]
            {
                let error = error(&format!("platebench {call}"));
                let text = error.to_string();
                let is_option = was.starts_with("compare") && call.starts_with("help");
                assert!(is_option || text.starts_with(&format!("error: '{was}' is now '{now}'\n")), "{call}: {text}");
                assert_eq!(error.exit_code(), 2, "{call}");
            }
        }
        assert!(error("platebench compare a --against=b").to_string().contains("is now 'compare A B'"));
    }

    #[test]
    fn each_new_name_is_a_command() {
        for (_, now) in RENAMED.iter().filter(|(_, now)| !now.starts_with("cargo ")) {
            let words: Vec<_> = now.split(' ').collect();
            let command = Arguments::command();
            let first = command.find_subcommand(words[0]).unwrap_or_else(|| panic!("{now}"));
            assert!(!first.has_subcommands() || first.find_subcommand(words[1]).is_some(), "{now}");
        }
    }

    #[test]
    fn other_wrong_words_are_not_renamed() {
        for call in ["frobnicate", "suite judge", "run --against a", "report a --merge b --draw c", "--color judge run"]
        {
            assert!(!error(&format!("platebench {call}")).to_string().contains(" is now "), "{call}");
        }
    }

    #[test]
    fn the_changelog_has_the_same_table() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../CHANGELOG.md");
        let text = fs::read_to_string(path).unwrap();
        let rows = text.lines().map(str::trim).skip_while(|line| *line != "| was | is now |").skip(2);
        let rows: Vec<_> = rows.take_while(|line| line.starts_with('|')).collect();
        assert_eq!(rows, RENAMED.map(|(was, now)| format!("| `{was}` | `{now}` |")));
    }
}
