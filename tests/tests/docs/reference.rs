//! The reference is made from the code: commands from clap, metrics from the table that the judge uses, keys from the types that serde reads.
//!
//! `ci/reference --update` writes it anew.

use crate::page::root;
use crate::source::{doc, has_default, type_words};
use clap::Command;
use platebench_scenario::{Metric, Over};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;
use syn::{Fields, Item, ItemStruct};

const HEAD: &str = "<!-- Written by `ci/reference --update`; a test holds it to the code. -->\n\n";

#[test]
fn the_commands_are_what_the_program_says() {
    let mut page = format!("{HEAD}# Commands\n\nWhat `--help` says of every command.\n");
    let mut program = same_everywhere(platebench_cli::command()).color(clap::ColorChoice::Never).term_width(100);
    program.build();
    describe(&mut program, "platebench", &mut page);
    hold("docs/reference-commands.md", &page);
}

/// Without what the environment of whoever makes the page says.
fn same_everywhere(command: Command) -> Command {
    command.mut_args(|argument| argument.hide_env_values(true)).mut_subcommands(same_everywhere)
}

fn describe(command: &mut Command, name: &str, page: &mut String) {
    let help = command.render_long_help().to_string();
    let lines: Vec<&str> = help.lines().map(str::trim_end).collect();
    write!(page, "\n## {name}\n\n```text\n{}\n```\n", lines.join("\n").trim_end()).unwrap();
    for below in command.get_subcommands_mut().filter(|below| below.get_name() != "help" && !below.is_hide_set()) {
        let name = format!("{name} {}", below.get_name());
        describe(below, &name, page);
    }
}

#[test]
fn the_metrics_and_keys_are_what_the_loader_reads() {
    let mut page = format!("{HEAD}# Metrics and keys\n\n");
    page.push_str("What a scenario may ask for and which keys the files may have. What they mean together: [scenarios](scenarios.md), [verdicts](verdicts.md),\n[acceptance](acceptance.md).\n\n");
    metrics(&mut page);
    for (title, file, top) in [
        ("Scenario file", "harness/scenario/src/raw.rs", "RawScenario"),
        ("Plate file", "harness/plate/src/file.rs", "RawPlate"),
        ("Plan of an acceptance session", "harness/acceptance/src/plan.rs", "RawPlan"),
    ] {
        write!(page, "\n## {title}\n").unwrap();
        let types = types(file);
        keys(&types, top, "", &mut page);
    }
    hold("docs/reference-keys.md", &page);
}

fn metrics(page: &mut String) {
    let scenario = parsed("harness/scenario/src/expect.rs");
    let listed = scenario.items.iter().find_map(|item| match item {
        Item::Enum(metric) if metric.ident == "Metric" => Some(metric),
        _ => None,
    });
    let docs: BTreeMap<_, _> =
        listed.unwrap().variants.iter().map(|variant| (variant.ident.to_string(), doc(&variant.attrs))).collect();
    assert_eq!(docs.len(), Metric::ALL.len(), "a metric is missing in `Metric::ALL`");
    page.push_str("## Metrics\n\n| metric | what | options | trials come to |\n|---|---|---|---|\n");
    for metric in Metric::ALL {
        let options = [
            (metric.has_band(), "`band_percent`"),
            (metric.has_from(), "`from_ms`"),
            (metric.has_window(), "`window_ms`"),
            (metric.has_signal(), "`signal`"),
        ];
        let options: Vec<_> = options.iter().filter_map(|(has, name)| has.then_some(*name)).collect();
        let over = match Over::default_of(metric) {
            Over::Each => "each by itself",
            Over::Mean => "their mean",
            Over::Quantile(_) => "a quantile",
            Over::Deviation => "their standard deviation",
        };
        let what = docs[&format!("{metric:?}")].replace('|', "\\|");
        writeln!(page, "| `{metric}` | {what} | {} | {over} |", options.join(", ")).unwrap();
    }
}

fn parsed(file: &str) -> syn::File {
    syn::parse_file(&fs::read_to_string(root().join(file)).unwrap()).unwrap()
}

/// The structs of a source file, by name.
fn types(file: &str) -> BTreeMap<String, ItemStruct> {
    let items = parsed(file).items.into_iter();
    let structs = items.filter_map(|item| match item {
        Item::Struct(of) => Some((of.ident.to_string(), of)),
        _ => None,
    });
    structs.collect()
}

/// The keys of a type, then those of the types in it.
fn keys(types: &BTreeMap<String, ItemStruct>, name: &str, path: &str, page: &mut String) {
    let of = types.get(name).unwrap_or_else(|| panic!("there is no {name}"));
    let Fields::Named(fields) = &of.fields else { panic!("{name} has no keys") };
    if !path.is_empty() {
        write!(page, "\n### `{path}`\n").unwrap();
    }
    page.push_str("\n| key | value | | what |\n|---|---|---|---|\n");
    let all_optional = has_default(&of.attrs);
    let mut below = Vec::new();
    for field in &fields.named {
        let key = field.ident.as_ref().unwrap().to_string();
        let value = type_words(&field.ty);
        let optional = all_optional || value.optional || has_default(&field.attrs);
        let told = doc(&field.attrs).replace('|', "\\|");
        assert!(!told.is_empty(), "nothing is said of `{key}` in {name}");
        let shown = if types.contains_key(&value.name) { "table".to_owned() } else { value.words() };
        let shown = if value.list && shown == "table" { "tables".to_owned() } else { shown };
        writeln!(page, "| `{key}` | {shown} | {} | {told} |", if optional { "" } else { "required" }).unwrap();
        if types.contains_key(&value.name) {
            let inner = if path.is_empty() { key } else { format!("{}.{key}", path.trim_matches(['[', ']'])) };
            below.push((value.name, if value.list { format!("[[{inner}]]") } else { format!("[{inner}]") }));
        }
    }
    for (name, path) in below {
        keys(types, &name, &path, page);
    }
}

/// Holds a page to what was made; writes it where `ci/reference --update` asks for that.
#[track_caller]
fn hold(file: &str, made: &str) {
    let path = root().join(file);
    if std::env::var_os("PLATEBENCH_REFERENCE").is_some_and(|wish| wish == "update") {
        fs::write(&path, made).unwrap();
    }
    let committed = fs::read_to_string(&path).unwrap_or_default();
    let differs = made.lines().zip(committed.lines()).position(|(made, committed)| made != committed);
    let line = differs.unwrap_or_else(|| made.lines().count().min(committed.lines().count()));
    assert!(
        made == committed,
        "{file}:{} is not what the code says, run `ci/reference --update`\nsays:   {}\nshould: {}",
        line + 1,
        committed.lines().nth(line).unwrap_or_default(),
        made.lines().nth(line).unwrap_or_default()
    );
}
