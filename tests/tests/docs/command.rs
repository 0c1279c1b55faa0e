//! Checks commands in the documentation: arguments parse, and programs, packages and files exist.

use crate::page::workspace_root;
use std::fs;
use std::path::Path;

const ALLOWED_PROGRAMS: [&str; 19] = [
    "cd",
    "chmod",
    "cp",
    "cyclictest",
    "echo",
    "export",
    "genhtml",
    "git",
    "just",
    "ls",
    "make",
    "mkdir",
    "openssl",
    "pip",
    "python3",
    "rustup",
    "test",
    "mdbook",
    "defmt-print",
];
const PROJECT_FOLDERS: [&str; 6] = ["ci/", "docs/", "firmware-under-test/", "harness/", "scenarios/", "tests/"];
const CARGO_COMMANDS: [&str; 10] =
    ["add", "bench", "build", "clippy", "doc", "fmt", "install", "nextest", "run", "test"];

/// Returns the commands of `text`. If `prompted`, only lines that begin with `$` are commands.
pub(crate) fn commands(text: &str, prompted: bool) -> Vec<String> {
    let joined = text.replace("\\\n", " ");
    let lines = joined.lines().map(str::trim);
    let typed = lines.filter_map(|line| if prompted { line.strip_prefix("$ ") } else { Some(line) });
    typed.filter(|line| !line.is_empty() && !line.starts_with('#')).map(str::to_owned).collect()
}

pub(crate) fn command_fault(line: &str, folder: &Path) -> Option<String> {
    let Some(words) = shlex::split(line) else { return Some("a quote is not closed".to_owned()) };
    words.split(|word| matches!(&**word, "&&" | "||" | "|" | ";")).find_map(|words| simple_command_fault(words, folder))
}

pub(crate) fn bench_arguments(words: &[String]) -> Option<&[String]> {
    match words {
        [program, arguments @ ..] if program == "platebench" => Some(arguments),
        [cargo, program, arguments @ ..] if cargo == "cargo" && program == "platebench" => Some(arguments),
        _ => None,
    }
}

fn simple_command_fault(words: &[String], folder: &Path) -> Option<String> {
    let assigned =
        words.iter().take_while(|word| word.split_once('=').is_some_and(|(name, _)| is_variable_name(name))).count();
    let words = words.get(assigned..).unwrap_or_default();
    let Some((program, arguments)) = words.split_first() else { return Some("no command".to_owned()) };
    let end = words.iter().position(|word| word.starts_with('>')).unwrap_or(words.len());
    let fault = match (bench_arguments(&words[..end]), &**program) {
        (Some(arguments), _) => parse_arguments(arguments).err(),
        (None, "cargo") => cargo_fault(arguments),
        (None, program) if program.starts_with("ci/") => None,
        (None, program) => (!ALLOWED_PROGRAMS.contains(&program)).then(|| format!("unknown program `{program}`")),
    };
    fault.or_else(|| words.iter().find_map(|word| missing_path(word, folder)))
}

fn is_variable_name(name: &str) -> bool {
    !name.is_empty() && name.chars().all(|c| c.is_ascii_uppercase() || c == '_')
}

pub(crate) fn parse_arguments(arguments: &[String]) -> Result<(), String> {
    let words = std::iter::once("platebench".to_owned()).chain(arguments.iter().cloned());
    match platebench_cli::command().try_get_matches_from(words) {
        Ok(_) => Ok(()),
        Err(error) if !error.use_stderr() => Ok(()),
        Err(error) => Err(error.to_string()),
    }
}

fn cargo_fault(arguments: &[String]) -> Option<String> {
    let configuration: toml::Table =
        fs::read_to_string(workspace_root().join(".cargo/config.toml")).unwrap().parse().unwrap();
    let command = arguments.first()?;
    if !CARGO_COMMANDS.contains(&&**command) && configuration["alias"].get(command).is_none() {
        return Some(format!("cargo has no command `{command}`"));
    }
    arguments.windows(2).find_map(|pair| match pair {
        [flag, name] if flag == "-p" || flag == "--package" => {
            let workspace = fs::read_to_string(workspace_root().join("Cargo.lock")).unwrap();
            let exists = workspace.contains(&format!("name = \"{name}\"\n"));
            (!exists).then(|| format!("the package `{name}` does not exist"))
        }
        _ => None,
    })
}

pub(crate) fn missing_path(word: &str, folder: &Path) -> Option<String> {
    let path = word.split_once("./").map_or(word, |(before, rest)| if before.is_empty() { rest } else { word });
    if !PROJECT_FOLDERS.iter().any(|folder| path.starts_with(folder)) {
        return None;
    }
    let exists = match path.split_once('*') {
        Some((before, after)) => exists_matching(folder, before, after),
        None => folder.join(path).exists(),
    };
    (!exists).then(|| format!("`{path}` does not exist"))
}

fn exists_matching(folder: &Path, before: &str, after: &str) -> bool {
    let (parent, start) = before.rsplit_once('/').unwrap_or(("", before));
    let entries = fs::read_dir(folder.join(parent)).into_iter().flatten().flatten();
    let mut names = entries.map(|entry| entry.file_name().to_string_lossy().into_owned());
    names.any(|name| name.starts_with(start) && name.ends_with(after))
}

#[test]
fn finds_faults_in_commands() {
    for good in [
        "platebench run scenarios/paper --rig hosted --trials 3   # a comment",
        "cargo platebench run scenarios/paper/fig14-*.toml",
        "PLATEBENCH_LOG=debug platebench report RUN --rejudge && echo $?",
        "platebench run --format json > run.json",
        "cargo test --ignore-rust-version -p platebench-tests --test docs",
        "cargo test-all",
        "ci/release",
    ] {
        assert_eq!(command_fault(good, &workspace_root()), None, "{good}");
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
        assert!(command_fault(bad, &workspace_root()).is_some(), "{bad}");
    }
}
