//! Commands that people are told to type: the bench's own parse, and whatever else they name is there.

use crate::page::root;
use std::fs;
use std::path::Path;

/// Programs that are not ours and that pages may name.
const FOREIGN: [&str; 15] = [
    "cd",
    "chmod",
    "cp",
    "cyclictest",
    "echo",
    "export",
    "git",
    "ls",
    "mkdir",
    "openssl",
    "pip",
    "python3",
    "rustup",
    "test",
    "mdbook",
];
/// Folders of the project whose files a command may name.
const FOLDERS: [&str; 6] = ["ci/", "docs/", "firmware-under-test/", "harness/", "scenarios/", "tests/"];
const CARGO: [&str; 10] = ["add", "bench", "build", "clippy", "doc", "fmt", "install", "nextest", "run", "test"];

/// The commands of a shell script or, with a prompt before each, of a console.
pub(crate) fn commands(text: &str, prompted: bool) -> Vec<String> {
    let joined = text.replace("\\\n", " ");
    let lines = joined.lines().map(str::trim);
    let told = lines.filter_map(|line| if prompted { line.strip_prefix("$ ") } else { Some(line) });
    told.filter(|line| !line.is_empty() && !line.starts_with('#')).map(str::to_owned).collect()
}

/// What is wrong with a line of shell whose files are below `folder`.
pub(crate) fn fault(line: &str, folder: &Path) -> Option<String> {
    let Some(words) = shlex::split(line) else { return Some("quotes that are not closed".to_owned()) };
    words.split(|word| matches!(&**word, "&&" | "||" | "|" | ";")).find_map(|words| one(words, folder))
}

/// The words of a command of the bench itself, however it is called.
pub(crate) fn of_bench(words: &[String]) -> Option<&[String]> {
    match words {
        [program, arguments @ ..] if program == "platebench" => Some(arguments),
        [cargo, program, arguments @ ..] if cargo == "cargo" && program == "platebench" => Some(arguments),
        _ => None,
    }
}

fn one(words: &[String], folder: &Path) -> Option<String> {
    let assigned = words.iter().take_while(|word| word.split_once('=').is_some_and(|(name, _)| is_name(name))).count();
    let words = words.get(assigned..).unwrap_or_default();
    let Some((program, arguments)) = words.split_first() else { return Some("no command".to_owned()) };
    // Where the output goes is not an argument.
    let end = words.iter().position(|word| word.starts_with('>')).unwrap_or(words.len());
    let fault = match (of_bench(&words[..end]), &**program) {
        (Some(arguments), _) => parses(arguments).err(),
        (None, "cargo") => cargo(arguments),
        (None, program) if program.starts_with("ci/") => None,
        (None, program) => (!FOREIGN.contains(&program)).then(|| format!("nobody knows the program `{program}`")),
    };
    fault.or_else(|| words.iter().find_map(|word| missing(word, folder)))
}

fn is_name(name: &str) -> bool {
    !name.is_empty() && name.chars().all(|c| c.is_ascii_uppercase() || c == '_')
}

/// Whether the bench understands `arguments`.
pub(crate) fn parses(arguments: &[String]) -> Result<(), String> {
    let words = std::iter::once("platebench".to_owned()).chain(arguments.iter().cloned());
    match platebench_cli::command().try_get_matches_from(words) {
        Ok(_) => Ok(()),
        Err(error) if !error.use_stderr() => Ok(()),
        Err(error) => Err(error.to_string()),
    }
}

fn cargo(arguments: &[String]) -> Option<String> {
    let configuration: toml::Table = fs::read_to_string(root().join(".cargo/config.toml")).unwrap().parse().unwrap();
    let command = arguments.first()?;
    if !CARGO.contains(&&**command) && configuration["alias"].get(command).is_none() {
        return Some(format!("cargo has no command `{command}`"));
    }
    arguments.windows(2).find_map(|pair| match pair {
        [flag, name] if flag == "-p" || flag == "--package" => {
            let workspace = fs::read_to_string(root().join("Cargo.lock")).unwrap();
            let there = workspace.contains(&format!("name = \"{name}\"\n"));
            (!there).then(|| format!("there is no package `{name}`"))
        }
        _ => None,
    })
}

/// Something of the project that `word` names and that is not there.
fn missing(word: &str, folder: &Path) -> Option<String> {
    let path = word.split_once("./").map_or(word, |(before, rest)| if before.is_empty() { rest } else { word });
    if !FOLDERS.iter().any(|folder| path.starts_with(folder)) {
        return None;
    }
    let there = match path.split_once('*') {
        Some((before, after)) => matches_one(folder, before, after),
        None => folder.join(path).exists(),
    };
    (!there).then(|| format!("there is no `{path}`"))
}

/// Whether some file's path begins with `before` and ends with `after`.
fn matches_one(folder: &Path, before: &str, after: &str) -> bool {
    let (parent, start) = before.rsplit_once('/').unwrap_or(("", before));
    let entries = fs::read_dir(folder.join(parent)).into_iter().flatten().flatten();
    let mut names = entries.map(|entry| entry.file_name().to_string_lossy().into_owned());
    names.any(|name| name.starts_with(start) && name.ends_with(after))
}

#[test]
fn what_is_wrong_with_a_command_is_seen() {
    for good in [
        "platebench run scenarios/paper --rig hosted --trials 3   # a comment",
        "cargo platebench run scenarios/paper/fig14-*.toml",
        "PLATEBENCH_LOG=debug platebench judge RUN && echo $?",
        "platebench run --format json > run.json",
        "cargo test --ignore-rust-version -p platebench-tests --test docs",
        "cargo test-all",
        "ci/release",
    ] {
        assert_eq!(fault(good, &root()), None, "{good}");
    }
    for bad in [
        "platebench ran",
        "platebench run --trials many",
        "cargo platebench run --rigs hosted",
        "platebench compare RUN",
        "platebench run --quiet --verbose",
        "platebench run scenarios/papers",
        "platebench run scenarios/paper/fig99-*.toml",
        "echo x && platebench ran",
        "cargo tset",
        "cargo test -p platebench-test",
        "ci/relese",
        "plattbench run",
        "platebench run 'x",
        "",
    ] {
        assert!(fault(bad, &root()).is_some(), "{bad}");
    }
}
