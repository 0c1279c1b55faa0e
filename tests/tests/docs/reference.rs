//! Generates the reference pages and the table of metrics from clap, `Metric` and the types of
//! serde. The tests compare them with the stored pages; `ci/reference --update` writes them.

use crate::page::workspace_root;
use crate::source::{describe_type, doc_comment, has_default};
use clap::Command;
use platebench_model::metrics::TrialRule;
use platebench_model::scenario::{ChangingProfile, Metric};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;
use syn::{Fields, Item, ItemStruct};

const HEAD: &str = "<!-- Written by `ci/reference --update`; a test compares it with the code. -->\n\n";

#[test]
fn the_command_reference_matches_the_program() {
    let mut page = format!("{HEAD}# Commands\n\nThe output of `--help` for every command.\n");
    let mut program = without_environment(platebench_cli::command()).color(clap::ColorChoice::Never).term_width(100);
    program.build();
    append_command(&mut program, "platebench", &mut page);
    check_or_update("docs/reference-commands.md", &page);
}

/// Hides values of environment variables, because they differ between machines.
fn without_environment(command: Command) -> Command {
    command.mut_args(|argument| argument.hide_env_values(true)).mut_subcommands(without_environment)
}

fn append_command(command: &mut Command, name: &str, page: &mut String) {
    let help = command.render_long_help().to_string();
    let lines: Vec<&str> = help.lines().map(str::trim_end).collect();
    write!(page, "\n## {name}\n\n```text\n{}\n```\n", lines.join("\n").trim_end()).unwrap();
    for below in command.get_subcommands_mut().filter(|below| below.get_name() != "help" && !below.is_hide_set()) {
        let name = format!("{name} {}", below.get_name());
        append_command(below, &name, page);
    }
}

#[test]
fn the_key_reference_matches_the_loader() {
    let mut page = format!("{HEAD}# Keys\n\n");
    page.push_str(
        "The keys of all files. [Scenarios](scenarios.md), [verdicts](verdicts.md) and [acceptance](acceptance.md) \
         explain\nthem. The metrics are in [verdicts](verdicts.md#metrics).\n",
    );
    for (title, files, top) in [
        (
            "Scenario file",
            &["harness/model/src/scenario/raw.rs", "harness/model/src/scenario/definition.rs"][..],
            "RawScenario",
        ),
        ("Plate file", &["harness/plate/src/effects.rs", "harness/plate/src/effects"], "RawPlate"),
        (
            "Plan of an acceptance session",
            &["harness/lab/src/acceptance/plan.rs", "harness/model/src/scenario/requirements.rs"],
            "RawPlan",
        ),
    ] {
        write!(page, "\n## {title}\n").unwrap();
        let types = files.iter().flat_map(|path| source_files(path)).flat_map(|file| structs_by_name(&file)).collect();
        append_keys(&types, top, "", &mut page);
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

fn parse_source(file: &str) -> syn::File {
    syn::parse_file(&fs::read_to_string(workspace_root().join(file)).unwrap()).unwrap()
}

/// The files of a folder, or the file itself.
fn source_files(path: &str) -> Vec<String> {
    match fs::read_dir(workspace_root().join(path)) {
        Ok(files) => files.map(|file| format!("{path}/{}", file.unwrap().file_name().display())).collect(),
        Err(_) => vec![path.to_owned()],
    }
}

fn structs_by_name(file: &str) -> BTreeMap<String, ItemStruct> {
    let items = parse_source(file).items.into_iter();
    let structs = items.filter_map(|item| match item {
        Item::Struct(of) => Some((of.ident.to_string(), of)),
        _ => None,
    });
    structs.collect()
}

fn append_keys(types: &BTreeMap<String, ItemStruct>, name: &str, path: &str, page: &mut String) {
    let of = types.get(name).unwrap_or_else(|| panic!("{name} does not exist"));
    let Fields::Named(fields) = &of.fields else { panic!("{name} has no keys") };
    if !path.is_empty() {
        write!(page, "\n### `{path}`\n").unwrap();
    }
    page.push_str("\n| key | value | | what |\n|---|---|---|---|\n");
    let all_optional = has_default(&of.attrs);
    let mut below = Vec::new();
    for field in &fields.named {
        let key = field.ident.as_ref().unwrap().to_string();
        let value = describe_type(&field.ty);
        let optional = all_optional || value.optional || has_default(&field.attrs);
        let meaning = doc_comment(&field.attrs).replace('|', "\\|");
        assert!(!meaning.is_empty(), "`{key}` in {name} has no docstring");
        let kind = if types.contains_key(&value.name) { "table".to_owned() } else { value.describe() };
        let kind = if value.list && kind == "table" { "tables".to_owned() } else { kind };
        writeln!(page, "| `{key}` | {kind} | {} | {meaning} |", if optional { "" } else { "required" }).unwrap();
        if types.contains_key(&value.name) {
            let inner = if path.is_empty() { key } else { format!("{}.{key}", path.trim_matches(['[', ']'])) };
            below.push((value.name, if value.list { format!("[[{inner}]]") } else { format!("[{inner}]") }));
        }
    }
    for (name, path) in below {
        append_keys(types, &name, &path, page);
    }
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
