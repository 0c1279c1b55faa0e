use super::*;
use tempfile::TempDir;

const PLATE: &str = include_str!("../../../../../scenarios/plates/aluminium-198x138.toml");
const GOOD: &str = "title = \"Good\"\nplate = \"PLATE\"\nduration_ms = 60.0\n[profile]\nsetpoint_um = 2.0\n\
                    [[expect]]\nmetric = \"settling_time_ms\"\nat_most = 2.0\n";

/// Creates scenarios at `paths`. A file whose name starts with `limit` has `only_if_named`.
fn create_tree(paths: &[&str]) -> TempDir {
    let folder = TempDir::new().unwrap();
    fs::write(folder.path().join("plate"), PLATE).unwrap();
    let plate = folder.path().join("plate").display().to_string();
    for path in paths {
        let file = folder.path().join(path);
        fs::create_dir_all(file.parent().unwrap()).unwrap();
        let limit = file.file_name().unwrap().to_string_lossy().starts_with("limit");
        let reason = if limit { "only_if_named = \"known limit\"\n" } else { "" };
        fs::write(file, format!("{reason}{}", GOOD.replace("PLATE", &plate))).unwrap();
    }
    folder
}

fn found_names(folder: &TempDir, arguments: &[&str]) -> (Vec<String>, Vec<String>) {
    let arguments: Vec<_> = arguments.iter().map(|argument| folder.path().join(argument)).collect();
    let found = find(&arguments).unwrap();
    [found.scenarios, found.skipped].map(|all| all.into_iter().map(|scenario| scenario.file).collect()).into()
}

fn find_errors(folder: &TempDir, arguments: &[&str]) -> Vec<String> {
    let arguments: Vec<_> = arguments.iter().map(|argument| folder.path().join(argument)).collect();
    let root = format!("{}/", fs::canonicalize(folder.path()).unwrap().display());
    find(&arguments).unwrap_err().iter().map(|fault| fault.to_string().replace(&root, "")).collect()
}

#[test]
fn searches_folders_for_scenarios_only() {
    let folder = create_tree(&["a/z.toml", "a/b/c.toml", "a/.hidden/e.toml", "a/.f.toml", "a/notes.md"]);
    fs::write(folder.path().join("a/plate.toml"), PLATE).unwrap();
    fs::write(folder.path().join("a/platebench.toml"), "[run]\n").unwrap();
    fs::write(folder.path().join("a/golden.toml"), "scenario = \"a.toml\"\ncurves_sha256 = \"\"\n").unwrap();
    assert_eq!(found_names(&folder, &["a"]).0, ["b/c.toml", "z.toml"]);
    assert_eq!(found_names(&folder, &["a/"]).0, ["b/c.toml", "z.toml"]);
}

#[test]
fn the_name_of_a_folder_does_not_hide_scenarios() {
    let names = ["baselines/a.toml", "hardware/b.toml", "identify/c.toml", "plans/d.toml", "plates/e.toml"];
    let folder = create_tree(&names);
    assert_eq!(found_names(&folder, &["."]).0, names);
}

#[test]
fn reports_a_file_that_is_no_toml_or_of_no_known_kind() {
    let folder = create_tree(&["a/x.toml"]);
    fs::create_dir(folder.path().join("a/plates")).unwrap();
    fs::write(folder.path().join("a/plates/broken.toml"), "[mode\n").unwrap();
    fs::write(folder.path().join("a/Cargo.toml"), "[package]\n").unwrap();
    let errors = find_errors(&folder, &["a", "a"]);
    assert_eq!(errors.len(), 2, "{errors:#?}");
    assert!(errors[0].starts_with("a/Cargo.toml: is a file of no known kind"), "{errors:#?}");
    assert!(errors[1].starts_with("a/plates/broken.toml:1:6: "), "{errors:#?}");
}

#[test]
fn finds_nothing_in_an_empty_folder() {
    let folder = create_tree(&[]);
    fs::create_dir(folder.path().join("a")).unwrap();
    fs::write(folder.path().join("a/plate.toml"), PLATE).unwrap();
    assert_eq!(found_names(&folder, &["a"]), (vec![], vec![]));
    assert_eq!(found_names(&folder, &[]), (vec![], vec![]));
}

#[test]
fn reports_a_named_folder_without_scenarios() {
    let folder = create_tree(&["a/x.toml", "limits/limit.toml", "b/notes.md"]);
    let empty = |arguments: &[&str]| {
        let arguments: Vec<_> = arguments.iter().map(|argument| folder.path().join(argument)).collect();
        let empty = find(&arguments).unwrap().empty_folders;
        empty.iter().map(|path| path.file_name().unwrap().to_string_lossy().into_owned()).collect::<Vec<_>>()
    };
    assert_eq!(empty(&["a", "b", "limits"]), ["b"]);
    assert!(empty(&["a", "a/x.toml", "limits"]).is_empty());
}

#[test]
fn ignores_the_case_of_the_extension() {
    let folder = create_tree(&["a/x.TOML", "a/y.Toml"]);
    assert_eq!(found_names(&folder, &["a"]).0, ["x.TOML", "y.Toml"]);
}

#[cfg(unix)]
#[test]
fn reports_a_broken_symbolic_link() {
    let folder = create_tree(&["a/x.toml"]);
    for name in ["vendor", ".hidden"] {
        std::os::unix::fs::symlink(folder.path().join("gone"), folder.path().join("a").join(name)).unwrap();
    }
    let errors = find_errors(&folder, &["a"]);
    assert_eq!(errors.len(), 1, "{errors:?}");
    assert!(errors[0].starts_with("a/vendor: a broken symbolic link"), "{errors:?}");
}

#[test]
fn loads_a_scenario_that_is_named_twice_once() {
    let folder = create_tree(&["a/x.toml", "a/y.toml"]);
    assert_eq!(found_names(&folder, &["a", "a/x.toml", "a/../a/x.toml", "a"]).0, ["x.toml", "y.toml"]);
}

#[test]
fn a_name_starts_below_the_nearest_folder_called_scenarios() {
    let folder = create_tree(&["scenarios/old/scenarios/paper/x.toml", "scenarios/y.toml", "scenarios/scenarios"]);
    assert_eq!(found_names(&folder, &["scenarios/old"]).0, ["paper/x.toml"]);
    assert_eq!(found_names(&folder, &["scenarios/old/scenarios/paper/x.toml"]).0, ["paper/x.toml"]);
    assert_eq!(found_names(&folder, &["scenarios"]).0, ["paper/x.toml", "y.toml"]);
    assert_eq!(found_names(&folder, &["scenarios/scenarios"]).0, ["scenarios"], "a file of that name is not a folder");
}

#[test]
fn a_name_elsewhere_is_the_path_below_the_named_folder_or_the_file_name() {
    let folder = create_tree(&["a/b/x.toml"]);
    assert_eq!(found_names(&folder, &["a"]).0, ["b/x.toml"]);
    assert_eq!(found_names(&folder, &["a/b/x.toml"]).0, ["x.toml"]);
}

#[test]
fn loads_a_scenario_with_only_if_named_only_if_it_or_its_folder_is_named() {
    let folder = create_tree(&["scenarios/x.toml", "scenarios/limits/limit.toml"]);
    let (x, limit) = (|| "x.toml".to_owned(), || "limits/limit.toml".to_owned());
    assert_eq!(found_names(&folder, &["scenarios"]), (vec![x()], vec![limit()]));
    assert_eq!(found_names(&folder, &["scenarios/limits"]), (vec![limit()], vec![]));
    assert_eq!(found_names(&folder, &["scenarios/limits/"]), (vec![limit()], vec![]));
    assert_eq!(found_names(&folder, &["scenarios/limits/limit.toml"]), (vec![limit()], vec![]));
    assert_eq!(found_names(&folder, &["scenarios", "scenarios/limits/limit.toml"]), (vec![limit(), x()], vec![]));
    assert_eq!(found_names(&folder, &["scenarios/limits/limit.toml", "scenarios"]), (vec![limit(), x()], vec![]));
}

#[test]
fn rejects_two_scenarios_of_one_name() {
    let folder = create_tree(&["a/x.toml", "b/x.toml", "c/x.toml"]);
    let errors = find_errors(&folder, &["a", "b", "c"]);
    assert_eq!(errors.len(), 2, "{errors:?}");
    assert_eq!(errors[0], "b/x.toml: has the name x.toml in records, like a/x.toml; rename one of them");
}

#[test]
fn reports_every_invalid_file() {
    let folder = create_tree(&["a/good.toml"]);
    fs::write(folder.path().join("a/bad.toml"), "title = 1\ntrace_step_ms = 1.0").unwrap();
    fs::write(folder.path().join("a/limit-bad.toml"), "only_if_named = \"a\"\ntitle = 1").unwrap();
    fs::create_dir(folder.path().join("a/sub")).unwrap();
    fs::write(folder.path().join("a/sub/worse.toml"), b"\xff").unwrap();
    let errors = find_errors(&folder, &["a", "no-such.toml"]);
    assert_eq!(errors.len(), 4, "{errors:?}");
    for part in [
        "a/bad.toml:1:9: invalid type",
        "a/limit-bad.toml:2:9: invalid type",
        "a/sub/worse.toml:1:1: not UTF-8",
        "no-such.toml: cannot be read",
    ] {
        assert!(errors.iter().any(|fault| fault.starts_with(part)), "{part} in {errors:#?}");
    }
}

#[cfg(unix)]
#[test]
fn stops_at_a_folder_that_contains_itself() {
    let folder = create_tree(&["a/b/x.toml"]);
    for name in ["one", "two", "three"] {
        std::os::unix::fs::symlink(folder.path().join("a"), folder.path().join("a/b").join(name)).unwrap();
    }
    assert_eq!(found_names(&folder, &["a"]).0, ["b/x.toml"]);
}

#[test]
fn loads_every_scenario_of_the_repository() {
    let scenarios = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios");
    let folders = ["", "limits"].map(|folder| scenarios.join(folder));
    match find(&folders) {
        Ok(found) => {
            let limits = found.scenarios.iter().filter(|scenario| scenario.expected_exit.is_some());
            assert!(limits.into_iter().all(|scenario| scenario.file.starts_with("limits/")));
            assert!(found.scenarios.len() > 90 && found.skipped.len() > 70);
        }
        Err(faults) => panic!("{}", faults.iter().map(|fault| fault.render(false)).collect::<Vec<_>>().join("\n")),
    }
}

#[test]
fn skips_only_the_copies_in_a_run_folder() {
    let folder = create_tree(&["a/x.toml", "a/sub/y.toml", "a/sub/inputs/copy.toml"]);
    let all = ["sub/inputs/copy.toml", "sub/y.toml", "x.toml"];
    let record = folder.path().join("a/sub/run.json");
    for stray in ["", "{}", "{\"scenarios\": []}"] {
        fs::write(&record, stray).unwrap();
        assert_eq!(found_names(&folder, &["a"]).0, all, "{stray}");
    }
    fs::create_dir(folder.path().join("a/sub/traces")).unwrap();
    let found = find(&[folder.path().join("a")]).unwrap();
    assert_eq!(found.scenarios.into_iter().map(|scenario| scenario.file).collect::<Vec<_>>(), ["sub/y.toml", "x.toml"]);
    assert_eq!(found.copies, [folder.path().join("a/sub/inputs")]);
}

#[test]
fn the_extension_does_not_distinguish_names() {
    let files = [("a/x.toml", "x.toml"), ("b/x", "x"), ("c/y.toml", "y.toml")];
    let files = files.map(|(path, name)| (PathBuf::from(path), name.to_owned()));
    let errors: Vec<_> = repeated_names(&files).iter().map(ToString::to_string).collect();
    assert_eq!(errors, ["b/x: has the name x in records, like a/x.toml; rename one of them"]);
}

fn resolved(folder: &TempDir, from: &str, argument: &str) -> Result<String, String> {
    let path = resolve_argument(Path::new(argument), &folder.path().join(from));
    path.map(|path| path.display().to_string()).map_err(|fault| fault.to_string())
}

#[test]
fn a_name_is_an_argument_from_any_folder_of_the_project() {
    let folder = create_tree(&["scenarios/paper/x.toml", "scenarios/y.toml", "docs/notes/y.toml"]);
    for (from, argument, expected) in [
        ("", "paper/x.toml", "scenarios/paper/x.toml"),
        ("", "paper/x", "scenarios/paper/x.toml"),
        ("", "paper", "scenarios/paper"),
        ("", "scenarios/paper/x.toml", "scenarios/paper/x.toml"),
        ("docs", "paper/x.toml", "../scenarios/paper/x.toml"),
        ("docs/notes", "paper/x.toml", "../../scenarios/paper/x.toml"),
        ("docs/notes", "scenarios", "../../scenarios"),
        ("docs/notes", "scenarios/paper", "../../scenarios/paper"),
        ("scenarios/paper", "paper/x.toml", "../../scenarios/paper/x.toml"),
        ("scenarios/paper", "x.toml", "x.toml"),
        ("docs/notes", "y.toml", "y.toml"),
        ("docs", "y.toml", "../scenarios/y.toml"),
        ("", "-", "-"),
    ] {
        assert_eq!(resolved(&folder, from, argument).as_deref(), Ok(expected), "{argument} from `{from}`");
    }
}

#[test]
fn suggests_a_similar_name() {
    let folder = create_tree(&["scenarios/paper/fig13-closed-loop.toml", "scenarios/faults/noise.toml"]);
    let error = |argument| resolved(&folder, "scenarios", argument).unwrap_err();
    for near in [
        "paper/fig13-closd-loop.toml",
        "scenarios/paper/fig13-closed-lop.toml",
        "fig13-closed-loop.toml",
        "fig13-closed-loop",
        "papers/fig13-closed-loop.toml",
    ] {
        let error = error(near);
        assert!(error.starts_with(&format!("{near}: cannot be read: ")), "{error}");
        assert!(error.ends_with("; did you mean `paper/fig13-closed-loop.toml`?"), "{error}");
    }
    assert!(!error("other.toml").contains("did you mean"));
    assert!(!error("/paper/fig13-closed-loop.toml").contains("did you mean"));
}
