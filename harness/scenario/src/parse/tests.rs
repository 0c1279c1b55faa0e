use super::MAX_DIAGNOSTICS;
use crate::diagnostic::Diagnostic;
use crate::raw::RawScenario;
use rstest::rstest;
use std::path::Path;

const BASE: &str = "title = \"t\"\nplate = \"p.toml\"\nduration_ms = 60.0\n[profile]\nsetpoint_um = 2.0\n\
                    [[expect]]\nmetric = \"overruns\"\nat_most = 0.0\n[[expect]]\nmetric = \"overruns\"\nat_most = 1.0\n";

fn told(text: &str) -> Vec<String> {
    let faults = super::parse::<RawScenario>(Path::new("s.toml"), text).err().unwrap_or_default();
    faults.iter().map(Diagnostic::to_string).collect()
}

#[test]
fn what_is_right_is_read() {
    let raw: RawScenario = super::parse(Path::new("s.toml"), BASE).unwrap();
    assert_eq!((raw.duration_ms, raw.expect.len()), (60.0, 2));
}

/// The replacements that are made all at once, and where something is then told: nothing twice, nothing for what a fault has taken with it.
#[rstest]
#[case::two_keys_of_a_table(&[("title", "titel"), ("plate", "plte")], &["1:1", "2:1"])]
#[case::kinds(&[("\"t\"", "3"), ("60.0", "\"60\"")], &["1:9", "3:15"])]
#[case::tables_of_an_array(&[("at_most = 0.0", "atmost = 0.0"), ("at_most = 1.0", "at_most = \"1\"")], &["8:1", "11:11"])]
#[case::a_number_of_a_list(&[("at_most = 0.0", "within = [0.0, \"1\"]"), ("60.0", "true")], &["3:15", "8:16"])]
#[case::what_an_element_lacks(&[("metric = \"overruns\"\nat_most = 0.0", "at_most = 0.0"), ("at_most = 1.0", "atmost = 1.0")], &["10:1", "6:1"])]
#[case::what_a_table_lacks(&[("setpoint_um = 2.0\n", ""), ("title", "titel")], &["1:1", "4:1"])]
fn all_that_is_wrong_is_told(#[case] changes: &[(&str, &str)], #[case] places: &[&str]) {
    let text = changes.iter().fold(BASE.to_owned(), |text, (good, bad)| {
        assert!(text.contains(good), "{good}");
        text.replacen(good, bad, 1)
    });
    let told = told(&text);
    let found: Vec<_> = told.iter().map(|line| line.split(':').skip(1).take(2).collect::<Vec<_>>().join(":")).collect();
    assert_eq!(found, places, "{told:#?}");
}

#[test]
fn what_is_no_toml_is_told_with_all_its_places() {
    let told = told("title = \nplate = plate\n");
    assert!(told.len() >= 2 && told[0].starts_with("s.toml:1:") && told[1].starts_with("s.toml:2:"), "{told:#?}");
}

/// Each fault is found by reading all again: a file of nothing else would be looked at for hours.
#[test]
fn so_many_faults_are_told_and_no_more() {
    for (wrong, expected) in [
        (MAX_DIAGNOSTICS - 1, MAX_DIAGNOSTICS - 1),
        (MAX_DIAGNOSTICS, MAX_DIAGNOSTICS + 1),
        (20_000, MAX_DIAGNOSTICS + 1),
    ] {
        let keys = (0..wrong).fold(String::new(), |keys, number| keys + &format!("unknown{number} = 1\n"));
        let told = told(&format!("{keys}{BASE}"));
        assert_eq!(told.len(), expected, "of {wrong}");
        assert_eq!(
            told.iter().any(|line| line == "s.toml: only the first 50 faults are told"),
            expected > MAX_DIAGNOSTICS
        );
    }
}

/// A unit in a key's name is easily another one.
#[rstest]
#[case("duration_s", "; did you mean `duration_ms`, in ms?")]
#[case("duration", "; did you mean `duration_ms`, in ms?")]
#[case("duration_min", "; did you mean `duration_ms`, in ms?")]
#[case("trace_step_us", "; did you mean `trace_step_ms`, in ms?")]
#[case("duratoin_ms", "; did you mean `duration_ms`?")]
#[case("expects", "; did you mean `expect`?")]
#[case("colour", "")]
fn a_key_in_another_unit_is_known(#[case] key: &str, #[case] hint: &str) {
    let told = told(&BASE.replacen("title", &format!("{key} = 1\ntitle"), 1));
    assert_eq!(told.len(), 1, "{told:#?}");
    assert!(told[0].starts_with(&format!("s.toml:1:1: unknown key `{key}`")), "{told:#?}");
    assert_eq!(
        told[0].rsplit_once('`').map_or("", |_| told[0].rsplit_once("; ").map_or("", |(_, last)| last)),
        hint.trim_start_matches("; ")
    );
}
