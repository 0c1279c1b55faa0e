//! Runs all commands of the tutorial in order and compares their output with the page.

use crate::command::bench_arguments;
use crate::page::{DocumentPage, workspace_root};
use std::fs;
use std::path::Path;
use std::process::Command;

/// Copies the files that the tutorial uses. Links would change the relative paths in a run.
fn example_clone() -> tempfile::TempDir {
    let clone = tempfile::tempdir().unwrap();
    for folder in ["scenarios/paper", "scenarios/plates"] {
        fs::create_dir_all(clone.path().join(folder)).unwrap();
        for file in fs::read_dir(workspace_root().join(folder)).unwrap() {
            let path = file.unwrap().path();
            fs::copy(&path, clone.path().join(folder).join(path.file_name().unwrap())).unwrap();
        }
    }
    clone
}

fn commands_with_output(text: &str) -> Vec<(String, Vec<String>)> {
    let mut typed: Vec<(String, Vec<String>)> = Vec::new();
    for line in text.lines() {
        match (line.strip_prefix("$ "), typed.last_mut()) {
            (Some(command), _) => typed.push((command.to_owned(), Vec::new())),
            (None, Some((_, lines))) => lines.push(line.trim_end().to_owned()),
            (None, None) => panic!("`{line}` has no command"),
        }
    }
    typed
}

/// Returns the first of `lines` that `output` lacks in this order. `…` matches any text.
fn first_missing_line<'a>(lines: &'a [String], output: &str) -> Option<&'a String> {
    let mut output_lines = output.lines().map(str::trim_end);
    lines.iter().find(|line| {
        let (start, end) = line.split_once('…').unwrap_or((line, ""));
        let open = line.contains('…');
        !line.is_empty()
            && !output_lines
                .any(|text| if open { text.starts_with(start) && text.ends_with(end) } else { text == **line })
    })
}

#[test]
fn the_tutorial_shows_the_actual_output() {
    let clone = example_clone();
    let mut last_code = None;
    let mut run_count = 0;
    for block in DocumentPage::read(Path::new("docs/tutorial.md")).blocks {
        match &*block.language {
            "toml" => {
                let name =
                    block.text.lines().next().and_then(|line| line.strip_prefix("# ")).expect("a file has a name");
                let path = clone.path().join(name);
                fs::create_dir_all(path.parent().unwrap()).unwrap();
                fs::write(path, &block.text).unwrap();
            }
            "console" => {
                for (line, lines) in commands_with_output(&block.text) {
                    let words = shlex::split(&line).unwrap();
                    if line == "echo $?" {
                        assert_eq!(
                            last_code.map(|code: i32| code.to_string()).as_ref(),
                            lines.first(),
                            "{}",
                            block.line
                        );
                    } else if let Some(arguments) = bench_arguments(&words) {
                        let mut program = Command::new(env!("CARGO_BIN_EXE_platebench-under-test"));
                        let output = program.current_dir(clone.path()).args(arguments).output().unwrap();
                        let text = [&output.stdout[..], &output.stderr[..]].map(String::from_utf8_lossy).concat();
                        let missing = first_missing_line(&lines, &text);
                        assert!(
                            missing.is_none(),
                            "docs/tutorial.md:{}: {line}: `{missing:?}` is not in\n{text}",
                            block.line
                        );
                        last_code = output.status.code();
                        run_count += 1;
                    }
                }
            }
            _ => {}
        }
    }
    assert!(run_count >= 5, "only {run_count} commands were run");
}

#[test]
fn finds_missing_output_lines() {
    let lines = |text: &str| text.lines().map(str::to_owned).collect::<Vec<_>>();
    assert_eq!(first_missing_line(&lines("a\n\nc … e"), "a\nb\nc d e\n"), None);
    assert_eq!(first_missing_line(&lines("c\na"), "a\nb\nc\n").map(String::as_str), Some("a"), "not in this order");
    assert_eq!(first_missing_line(&lines("c … f"), "c d e").map(String::as_str), Some("c … f"));
}
