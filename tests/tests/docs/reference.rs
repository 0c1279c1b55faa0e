//! Generates the reference pages and the table of metrics from clap, `Metric` and the JSON Schemas
//! of the input files. The tests compare them with the stored pages; `ci/reference --update` writes
//! them.

use crate::page::workspace_root;
use clap::Arg;
use platebench_model::metrics::TrialRule;
use platebench_model::scenario::{ChangingProfile, Metric};
use serde_json::Value;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;
use std::process::Command;

const HEAD: &str = "<!-- Written by `ci/reference --update`; a test compares it with the code. -->\n\n";

#[test]
fn the_command_reference_matches_the_program() {
    let mut page = format!(
        "{HEAD}# Commands\n\nThe output of `--help` for every command. The options of the first block apply to all \
         commands.\nAn option that several commands have is printed for the first of them; the others name it.\n"
    );
    let mut program = without_environment(platebench_cli::command()).color(clap::ColorChoice::Never).term_width(100);
    program.build();
    append_command(&mut program, "platebench", &mut BTreeMap::new(), &mut page);
    check_or_update("docs/reference-commands.md", &page);
}

#[test]
fn the_short_help_of_run_has_at_most_30_lines() {
    let output = Command::new(env!("CARGO_BIN_EXE_platebench-under-test")).args(["run", "-h"]).output().unwrap();
    let help = String::from_utf8(output.stdout).unwrap();
    assert!((10..=30).contains(&help.lines().count()), "{help}");
}

/// Hides values of environment variables, because they differ between machines.
fn without_environment(command: clap::Command) -> clap::Command {
    command.mut_args(|argument| argument.hide_env_values(true)).mut_subcommands(without_environment)
}

/// Appends the help of `command` and of the commands below it. `printed` has the first command of each option.
fn append_command(command: &mut clap::Command, name: &str, printed: &mut BTreeMap<String, String>, page: &mut String) {
    let mut repeated: BTreeMap<String, Vec<String>> = BTreeMap::new();
    let hide_repeated = |argument: Arg| match (printed.get(&description_of(&argument)), argument.get_long()) {
        (Some(first), Some(long)) if !argument.is_hide_set() => {
            repeated.entry(first.clone()).or_default().push(format!("`--{long}`"));
            argument.hide(true)
        }
        _ => argument,
    };
    *command = std::mem::take(command).mut_args(hide_repeated);
    let help = command.render_long_help().to_string();
    let lines: Vec<&str> = help.lines().map(str::trim_end).collect();
    write!(page, "\n## {name}\n\n```text\n{}\n```\n", lines.join("\n").trim_end()).unwrap();
    for (first, options) in repeated {
        let anchor = first.replace(' ', "-");
        writeln!(page, "\nAs for [{first}](#{anchor}): {}.", options.join(", ")).unwrap();
    }
    for argument in command.get_arguments().filter(|argument| !argument.is_positional() && !argument.is_hide_set()) {
        printed.entry(description_of(argument)).or_insert_with(|| name.to_owned());
    }
    for below in command.get_subcommands_mut().filter(|below| below.get_name() != "help" && !below.is_hide_set()) {
        let name = format!("{name} {}", below.get_name());
        let is_of_all = |argument: &Arg| argument.is_global_set() || argument.get_id() == "help";
        let hide = |argument: Arg| if is_of_all(&argument) { argument.hide(true) } else { argument };
        *below = std::mem::take(below).mut_args(hide);
        append_command(below, &name, printed, page);
    }
}

/// Everything that the help says about an option.
fn description_of(argument: &Arg) -> String {
    let help = argument.get_long_help().or(argument.get_help()).map(ToString::to_string);
    let values: Vec<_> = argument.get_possible_values().iter().map(|value| format!("{value:?}")).collect();
    format!("{argument} {help:?} {:?} {values:?}", argument.get_default_values())
}

#[test]
fn the_key_reference_matches_the_loader() {
    let mut page = format!("{HEAD}# Keys\n\n");
    page.push_str(
        "The keys of all files. [Scenarios](scenarios.md), [verdicts](verdicts.md) and [acceptance](acceptance.md) \
         explain\nthem. The metrics are in [verdicts](verdicts.md#metrics).\n",
    );
    for (title, schema) in [
        ("Scenario file", "scenario"),
        ("Plate file", "plate"),
        ("Plan of an acceptance session", "plan"),
        ("Campaign", "campaign"),
        ("Operating envelope", "envelope"),
        ("`boards.toml`", "boards"),
        ("`platebench.toml`", "config"),
    ] {
        write!(page, "\n## {title}\n").unwrap();
        // A test of the program compares this file with the types of serde.
        let path = workspace_root().join(format!("scenarios/schema/{schema}.json"));
        let schema: Value = serde_json::from_str(&fs::read_to_string(path).unwrap()).unwrap();
        append_keys(&schema, &schema, "", &mut BTreeMap::new(), &mut page);
    }
    check_or_update("docs/reference-keys.md", &page);
}

#[test]
fn the_metric_table_matches_the_metrics() {
    const FILE: &str = "docs/verdicts.md";
    const BEGIN: &str = "<!-- metrics: written by `ci/reference --update` -->\n";
    const END: &str = "<!-- end of metrics -->";
    let page = fs::read_to_string(workspace_root().join(FILE)).unwrap();
    let (before, rest) = page.split_once(BEGIN).unwrap();
    let (_, after) = rest.split_once(END).unwrap();
    check_or_update(FILE, &format!("{before}{BEGIN}{}{END}{after}", metric_table()));
}

fn metric_table() -> String {
    let mut table = "| metric | unit | definition | options | over trials |\n|---|---|---|---|---|\n".to_owned();
    for &metric in Metric::ALL {
        let spec = metric.spec();
        let takes_after = ChangingProfile::ALL.into_iter().any(|profile| profile.applies_to(metric));
        let options = [
            (metric.has_band(), "`band_percent`"),
            (metric.has_from_ms(), "`from_ms`"),
            (metric.has_from_ms(), "`until_ms`"),
            (takes_after, "`after`"),
            (metric.has_window_ms(), "`window_ms`"),
            (metric.has_signal(), "`signal`"),
            (metric.has_text(), "`text`"),
        ];
        let options: Vec<_> = options.iter().filter_map(|(has, name)| has.then_some(*name)).collect();
        let over = match spec.trials {
            TrialRule::Each => "each",
            TrialRule::Mean => "mean",
            TrialRule::Deviation => "deviation",
            TrialRule::FromFirst => "difference",
        };
        let (name, unit, definition) = (spec.name, spec.unit.symbol(), spec.definition.replace('|', "\\|"));
        writeln!(table, "| `{name}` | {unit} | {definition} | {} | {over} |", options.join(", ")).unwrap();
    }
    table
}

/// Appends the keys of `table` and of the tables below it. `printed` has the path of each list of keys.
fn append_keys(root: &Value, table: &Value, path: &str, printed: &mut BTreeMap<String, String>, page: &mut String) {
    let mut rows = String::new();
    let required = |key: &str| table["required"].as_array().is_some_and(|keys| keys.iter().any(|name| name == key));
    let mut below = Vec::new();
    for (key, schema) in table["properties"].as_object().unwrap() {
        let help = schema["description"].as_str().unwrap_or_else(|| panic!("`{key}` in {path} has no description"));
        let help = help.replace('\n', " ").replace('|', "\\|");
        let default = match &schema["default"] {
            _ if required(key) => Some("required".to_owned()),
            Value::Null | Value::Array(_) | Value::Object(_) => None,
            default => Some(format!("default {}", default.to_string().trim_matches('"'))),
        };
        let schema = without_placeholder(schema);
        let value: Vec<_> = [Some(type_of(root, schema)), range_of(schema), default].into_iter().flatten().collect();
        writeln!(rows, "| `{key}` | {} | {help} |", value.join(", ")).unwrap();
        let is_list = schema["type"] == "array";
        let inner = resolve(root, if is_list { &schema["items"] } else { schema });
        if inner["properties"].is_object() {
            let name = if path.is_empty() { key.clone() } else { format!("{}.{key}", path.trim_matches(['[', ']'])) };
            below.push((inner, if is_list { format!("[[{name}]]") } else { format!("[{name}]") }));
        }
    }
    if let Some(first) = printed.get(&rows) {
        write!(page, "\n`{path}` has the keys of `{first}`.\n").unwrap();
        return;
    }
    if !path.is_empty() {
        write!(page, "\n### `{path}`\n").unwrap();
    }
    write!(page, "\n| key | value | what |\n|---|---|---|\n{rows}").unwrap();
    printed.insert(rows, path.to_owned());
    for (table, path) in below {
        append_keys(root, table, &path, printed, page);
    }
}

/// A value of a scenario may be a placeholder of `[matrix]`, which each line need not repeat.
fn without_placeholder(schema: &Value) -> &Value {
    match schema["anyOf"].as_array().map(Vec::as_slice) {
        Some([own, placeholder]) if placeholder["$ref"] == "#/$defs/Placeholder" => own,
        _ => schema,
    }
}

fn resolve<'a>(root: &'a Value, schema: &'a Value) -> &'a Value {
    let place = schema["$ref"].as_str().and_then(|place| root.pointer(place.trim_start_matches('#')));
    place.map_or(schema, |definition| resolve(root, definition))
}

fn type_of(root: &Value, schema: &Value) -> String {
    let schema = resolve(root, schema);
    let alternatives = ["enum", "anyOf", "oneOf"].iter().find_map(|word| schema[word].as_array());
    if let Some(alternatives) = alternatives.filter(|all| all.len() <= 8) {
        let name = |one: &Value| match one.get("const").unwrap_or(one) {
            Value::Object(_) => type_of(root, one),
            name => format!("`{}`", name.to_string().trim_matches('"')),
        };
        let mut names: Vec<String> = alternatives.iter().map(name).collect();
        names.dedup();
        return names.join(" or ");
    }
    match (schema["type"].as_str(), &schema["items"]) {
        (Some("array"), items) if items.is_object() => {
            let inner = type_of(root, items);
            match schema["maxItems"].as_u64() {
                _ if inner == "table" => "tables".to_owned(),
                Some(2) => format!("[{inner}, {inner}]"),
                _ => format!("list of {inner}"),
            }
        }
        (Some("array"), _) => "list".to_owned(),
        (Some("integer"), _) => "whole number".to_owned(),
        (Some("string"), _) => "text".to_owned(),
        (Some("boolean"), _) => "true or false".to_owned(),
        (Some("object"), _) => "table".to_owned(),
        // Tables of several kinds, which `docs/scenarios.md` lists.
        (None, _) if schema["oneOf"].is_array() => "table".to_owned(),
        (Some("number"), _) => "number".to_owned(),
        (kind, _) => panic!("a key has the unknown type {kind:?}: {schema}"),
    }
}

fn range_of(schema: &Value) -> Option<String> {
    if schema["items"]["type"] == "number" || schema["items"]["type"] == "integer" {
        return range_of(&schema["items"]);
    }
    let bound = |words: [&str; 2]| words.into_iter().find_map(|word| Some((schema.get(word)?, word.starts_with("ex"))));
    let low = bound(["exclusiveMinimum", "minimum"])
        .map(|(low, open)| if open { format!("> {low}") } else { format!("≥ {low}") });
    let high = bound(["exclusiveMaximum", "maximum"])
        .map(|(high, open)| if open { format!("< {high}") } else { format!("≤ {high}") });
    low.into_iter().chain(high).reduce(|low, high| format!("{low}, {high}"))
}

#[track_caller]
fn check_or_update(file: &str, expected: &str) {
    let path = workspace_root().join(file);
    if std::env::var_os("PLATEBENCH_REFERENCE").is_some_and(|mode| mode == "update") {
        fs::write(&path, expected).unwrap();
    }
    let committed = fs::read_to_string(&path).unwrap_or_default();
    let differs = expected.lines().zip(committed.lines()).position(|(expected, committed)| expected != committed);
    let line = differs.unwrap_or_else(|| expected.lines().count().min(committed.lines().count()));
    assert!(
        expected == committed,
        "{file}:{} differs from the code, run `ci/reference --update`\ncommitted: {}\nexpected:  {}",
        line + 1,
        committed.lines().nth(line).unwrap_or_default(),
        expected.lines().nth(line).unwrap_or_default()
    );
}
