use super::{Failure, PLATE, PLATE_FILE, PLATE_SCHEMA_FILE, SCHEMA_FILE, write_files};
use platebench_model::scenario::load_with_all_errors;
use platebench_wire::LawId;
use rstest::rstest;
use std::fs;
use tempfile::tempdir;

#[test]
fn a_new_scenario_is_valid_for_every_law() {
    for law in LawId::ALL.map(LawId::name) {
        let folder = tempdir().unwrap();
        let files = write_files(folder.path(), "mine", law).unwrap();
        let written = ["mine.toml", PLATE_FILE, SCHEMA_FILE, PLATE_SCHEMA_FILE].map(|file| folder.path().join(file));
        assert_eq!(files, written);
        let scenario =
            load_with_all_errors(&files[0], "mine.toml").unwrap_or_else(|faults| panic!("{law}: {faults:?}"));
        assert_eq!((scenario.controller.law.as_str(), scenario.title.as_str()), (law, "mine"));
    }
}

#[test]
fn the_commented_keys_are_valid() {
    let folder = tempdir().unwrap();
    let files = write_files(folder.path(), "mine", "dq-pi").unwrap();
    let is_key = |line: &str| {
        let key = line.strip_prefix("# ").filter(|line| line.starts_with(char::is_lowercase));
        line.starts_with("# [") || key.is_some_and(|line| line.contains(" = "))
    };
    let text = fs::read_to_string(&files[0]).unwrap();
    let whole: Vec<_> = text.lines().map(|line| if is_key(line) { &line[2..] } else { line }).collect();
    assert!(whole.len() > 30 && whole.contains(&"[trials.spread]") && whole.contains(&"kind = \"drop\""));
    fs::write(&files[0], whole.join("\n")).unwrap();
    let scenario = load_with_all_errors(&files[0], "mine.toml").unwrap_or_else(|faults| panic!("{faults:?}"));
    assert_eq!((scenario.trials.count, scenario.faults.len()), (30, 1));
}

#[test]
fn nothing_is_ever_overwritten() {
    let folder = tempdir().unwrap();
    fs::create_dir(folder.path().join("plates")).unwrap();
    fs::write(folder.path().join(PLATE_FILE), "mine").unwrap();
    fs::write(folder.path().join("taken.toml"), "mine, too").unwrap();
    let taken = folder.path().join("taken.toml");
    let message = format!("{} exists already, expected another name", taken.display());
    assert_eq!(write_files(folder.path(), "taken", "dq-pi"), Err(Failure::invalid(&message)));
    assert_eq!(fs::read_to_string(taken).unwrap(), "mine, too");
    assert_eq!(write_files(folder.path(), "free", "dq-pi").unwrap()[0], folder.path().join("free.toml"));
    assert_eq!(fs::read_to_string(folder.path().join(PLATE_FILE)).unwrap(), "mine");
}

#[rstest]
#[case("a", "scenarios/a.toml", "plates/")]
#[case("a.toml", "scenarios/a.toml", "plates/")]
#[case("scenarios/deep/er/a b", "scenarios/deep/er/a b.toml", "../../plates/")]
#[case("scenarios/deep/er/est/one/a", "scenarios/deep/er/est/one/a.toml", "plates/")]
fn a_new_scenario_is_below_scenarios_and_finds_its_plate(#[case] name: &str, #[case] file: &str, #[case] plate: &str) {
    let folder = tempdir().unwrap();
    for (path, text) in [(PLATE_FILE, PLATE), (SCHEMA_FILE, "{}")] {
        let path = folder.path().join("scenarios").join(path);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    }
    let files = write_files(folder.path(), name, "dq-pi").unwrap();
    assert_eq!(files[0], folder.path().join(file));
    let text = fs::read_to_string(&files[0]).unwrap();
    assert!(text.contains(&format!("plate = \"{plate}aluminium")), "{text}");
    let schema = format!("{}{SCHEMA_FILE}", plate.trim_end_matches("plates/"));
    assert!(text.starts_with(&format!("#:schema {schema}\n")), "{text}");
    assert!(files[0].parent().unwrap().join(schema).is_file());
    assert!(load_with_all_errors(&files[0], "a.toml").is_ok());
}

#[rstest]
#[case("")]
#[case("folder/")]
#[case("..")]
#[case(".toml")]
#[case("two\nlines")]
fn rejects_invalid_names(#[case] name: &str) {
    let folder = tempdir().unwrap();
    let message = format!("{name:?} is not a file name, expected one without control characters");
    assert_eq!(write_files(folder.path(), name, "dq-pi"), Err(Failure::invalid(&message)));
    assert_eq!(fs::read_dir(folder.path()).map(Iterator::count).unwrap_or_default(), 0);
}

#[test]
fn a_name_with_quotes_is_a_title() {
    let folder = tempdir().unwrap();
    let files = write_files(folder.path(), "a \"b\" \\c", "dq-pi").unwrap();
    let scenario = load_with_all_errors(&files[0], "a.toml").unwrap_or_else(|faults| panic!("{faults:?}"));
    assert_eq!(scenario.title, "a \"b\" \\c");
}
