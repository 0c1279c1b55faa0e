use super::MAX_DIAGNOSTICS;
use crate::scenario::diagnostic::Diagnostic;
use crate::scenario::raw::RawScenario;
use rstest::rstest;
use std::path::Path;

const BASE: &str = "title = \"t\"\nplate = \"p.toml\"\nduration_ms = 60.0\n[profile]\nsetpoint_um = 2.0\n\
                    [[expect]]\nmetric = \"overruns\"\nat_most = 0.0\n\
                    [[expect]]\nmetric = \"overruns\"\nat_most = 1.0\n";

fn parse_errors(text: &str) -> Vec<String> {
    let faults = super::parse::<RawScenario>(Path::new("s.toml"), text).err().unwrap_or_default();
    faults.iter().map(Diagnostic::to_string).collect()
}

#[test]
fn parses_a_valid_file() {
    let raw: RawScenario = super::parse(Path::new("s.toml"), BASE).unwrap();
    assert_eq!((raw.duration_ms, raw.expect.len()), (60.0, 2));
}

/// Each wrong place is reported once, and no error causes another one.
#[rstest]
#[case::two_keys_of_a_table(&[("title", "titel"), ("plate", "plte")], &["1:1", "2:1"])]
#[case::kinds(&[("\"t\"", "3"), ("60.0", "\"60\"")], &["1:9", "3:15"])]
#[case::tables_of_an_array(&[("at_most = 0.0", "atmost = 0.0"), ("at_most = 1.0", "at_most = \"1\"")],
    &["8:1", "11:11"])]
#[case::a_number_of_a_list(&[("at_most = 0.0", "within = [0.0, \"1\"]"), ("60.0", "true")], &["3:15", "8:16"])]
#[case::missing_in_an_element(
    &[("metric = \"overruns\"\nat_most = 0.0", "at_most = 0.0"), ("at_most = 1.0", "atmost = 1.0")],
    &["10:1", "6:1"]
)]
#[case::values_of_a_profile(
    &[("= 2.0", "= { linear = [[0.0, \"x\"]] }\nfinger_force_n = { sine = { mean = 0.0, amplitude = true } }")],
    &["5:33", "6:53"]
)]
#[case::keys_of_a_profile(
    &[(
        "= 2.0",
        "= { sqare = { low = 0.0 } }\nfinger_force_n = { square = { low = 0.0, hgih = 1.0, period_ms = 2.0 } }"
    )],
    &["5:17", "6:42"]
)]
#[case::shapes_of_a_profile(
    &[("= 2.0", "= {}\nfinger_force_n = { hold = [[0.0, 1.0]], linear = [[0.0, 1.0]] }")],
    &["6:18", "5:15"]
)]
#[case::missing_in_a_profile(&[("2.0", "{ sine = { mean = 0.0, amplitude = 1.0 } }")], &["5:24"])]
#[case::missing_in_a_table(&[("setpoint_um = 2.0\n", ""), ("title", "titel")], &["1:1", "4:1"])]
fn reports_every_error(#[case] changes: &[(&str, &str)], #[case] places: &[&str]) {
    let text = changes.iter().fold(BASE.to_owned(), |text, (good, bad)| {
        assert!(text.contains(good), "{good}");
        text.replacen(good, bad, 1)
    });
    let errors = parse_errors(&text);
    let found: Vec<_> =
        errors.iter().map(|line| line.split(':').skip(1).take(2).collect::<Vec<_>>().join(":")).collect();
    assert_eq!(found, places, "{errors:#?}");
}

#[test]
fn reports_every_syntax_error() {
    let errors = parse_errors("title = \nplate = plate\n");
    assert!(
        errors.len() >= 2 && errors[0].starts_with("s.toml:1:") && errors[1].starts_with("s.toml:2:"),
        "{errors:#?}"
    );
}

#[test]
fn limits_the_number_of_errors() {
    for (wrong, expected) in [
        (MAX_DIAGNOSTICS - 1, MAX_DIAGNOSTICS - 1),
        (MAX_DIAGNOSTICS, MAX_DIAGNOSTICS + 1),
        (20_000, MAX_DIAGNOSTICS + 1),
    ] {
        let keys = (0..wrong).fold(String::new(), |keys, number| keys + &format!("unknown{number} = 1\n"));
        let errors = parse_errors(&format!("{keys}{BASE}"));
        assert_eq!(errors.len(), expected, "of {wrong}");
        assert_eq!(
            errors.iter().any(|line| line == "s.toml: only the first 50 errors are listed"),
            expected > MAX_DIAGNOSTICS
        );
    }
}

#[test]
fn suggests_the_name_of_a_shape() {
    let errors = parse_errors(&BASE.replacen("2.0", "{ sqare = 1 }", 1));
    let expected = "s.toml:5:17: unknown key `sqare`, expected one of `hold`, `linear`, `repeat`, `square`, `sine`, \
                    `chirp`, `csv`; did you mean `square`?";
    assert_eq!(errors, [expected]);
}

#[rstest]
#[case("duration_s", "; did you mean `duration_ms`, in ms?")]
#[case("duration", "; did you mean `duration_ms`, in ms?")]
#[case("duration_min", "; did you mean `duration_ms`, in ms?")]
#[case("trace_step_us", "; did you mean `trace_step_ms`, in ms?")]
#[case("duratoin_ms", "; did you mean `duration_ms`?")]
#[case("expects", "; did you mean `expect`?")]
#[case("colour", "")]
fn suggests_a_key_in_another_unit(#[case] key: &str, #[case] hint: &str) {
    let errors = parse_errors(&BASE.replacen("title", &format!("{key} = 1\ntitle"), 1));
    assert_eq!(errors.len(), 1, "{errors:#?}");
    assert!(errors[0].starts_with(&format!("s.toml:1:1: unknown key `{key}`")), "{errors:#?}");
    assert_eq!(
        errors[0].rsplit_once('`').map_or("", |_| errors[0].rsplit_once("; ").map_or("", |(_, last)| last)),
        hint.trim_start_matches("; ")
    );
}
