//! The tutorial, played from its first command to its last: what it says is shown is shown.

use crate::command::of_bench;
use crate::page::{Page, root};
use std::fs;
use std::path::Path;
use std::process::Command;

/// A folder as a fresh clone has it, as far as the tutorial goes. No links: a run keeps how its inputs lie to each other.
fn clone() -> tempfile::TempDir {
    let clone = tempfile::tempdir().unwrap();
    for folder in ["scenarios/paper", "scenarios/plates"] {
        fs::create_dir_all(clone.path().join(folder)).unwrap();
        for file in fs::read_dir(root().join(folder)).unwrap() {
            let path = file.unwrap().path();
            fs::copy(&path, clone.path().join(folder).join(path.file_name().unwrap())).unwrap();
        }
    }
    clone
}

/// A command after its prompt, and the lines that it is said to show.
fn told(text: &str) -> Vec<(String, Vec<String>)> {
    let mut told: Vec<(String, Vec<String>)> = Vec::new();
    for line in text.lines() {
        match (line.strip_prefix("$ "), told.last_mut()) {
            (Some(command), _) => told.push((command.to_owned(), Vec::new())),
            (None, Some((_, lines))) => lines.push(line.trim_end().to_owned()),
            (None, None) => panic!("`{line}` comes of no command"),
        }
    }
    told
}

/// The first of `lines` that `shown` does not hold, in order; `…` stands for anything.
fn missing<'a>(lines: &'a [String], shown: &str) -> Option<&'a String> {
    let mut shown = shown.lines().map(str::trim_end);
    lines.iter().find(|line| {
        let (start, end) = line.split_once('…').unwrap_or((line, ""));
        let open = line.contains('…');
        !line.is_empty()
            && !shown.any(|shown| if open { shown.starts_with(start) && shown.ends_with(end) } else { shown == **line })
    })
}

#[test]
fn the_tutorial_is_as_it_says() {
    let clone = clone();
    let mut last_code = None;
    let mut played = 0;
    for block in Page::read(Path::new("docs/tutorial.md")).blocks {
        match &*block.language {
            "toml" => {
                let name =
                    block.text.lines().next().and_then(|line| line.strip_prefix("# ")).expect("a file has a name");
                let path = clone.path().join(name);
                fs::create_dir_all(path.parent().unwrap()).unwrap();
                fs::write(path, &block.text).unwrap();
            }
            "console" => {
                for (line, lines) in told(&block.text) {
                    let words = shlex::split(&line).unwrap();
                    if line == "echo $?" {
                        assert_eq!(
                            last_code.map(|code: i32| code.to_string()).as_ref(),
                            lines.first(),
                            "{}",
                            block.line
                        );
                    } else if let Some(arguments) = of_bench(&words) {
                        let mut program = Command::new(env!("CARGO_BIN_EXE_platebench-under-test"));
                        let output = program.current_dir(clone.path()).args(arguments).output().unwrap();
                        let shown = [&output.stdout[..], &output.stderr[..]].map(String::from_utf8_lossy).concat();
                        let missing = missing(&lines, &shown);
                        assert!(
                            missing.is_none(),
                            "docs/tutorial.md:{}: {line}: `{missing:?}` is not in\n{shown}",
                            block.line
                        );
                        last_code = output.status.code();
                        played += 1;
                    }
                }
            }
            _ => {}
        }
    }
    assert!(played >= 5, "only {played} commands were played");
}

#[test]
fn what_is_not_shown_is_seen() {
    let lines = |text: &str| text.lines().map(str::to_owned).collect::<Vec<_>>();
    assert_eq!(missing(&lines("a\n\nc … e"), "a\nb\nc d e\n"), None);
    assert_eq!(missing(&lines("c\na"), "a\nb\nc\n").map(String::as_str), Some("a"), "not in this order");
    assert_eq!(missing(&lines("c … f"), "c d e").map(String::as_str), Some("c … f"));
}
