use super::{Config, FILE, SETTINGS, with_settings};
use crate::args::{Arguments, Command};
use crate::run::RunArgs;
use clap::{CommandFactory, FromArgMatches};
use platebench_model::scenario::Diagnostic;
use rstest::rstest;
use std::fs;
use std::path::{Path, PathBuf};
use tempfile::{TempDir, tempdir};

fn write_config(text: &str) -> TempDir {
    let folder = tempdir().unwrap();
    fs::write(folder.path().join(FILE), text).unwrap();
    folder
}

fn read_config(path: &Path) -> Result<Config, Vec<Diagnostic>> {
    Config::read(path, &Arguments::command())
}

fn parse_run(config: &Config, arguments: &[&str]) -> RunArgs {
    let matches =
        with_settings(Arguments::command(), config).get_matches_from([&["platebench", "run"], arguments].concat());
    match Arguments::from_arg_matches(&matches).unwrap().command {
        Command::Run(run) => run,
        other => panic!("{other:?}"),
    }
}

#[test]
fn the_commands_are_consistent_with_and_without_a_file() {
    let folder = write_config(
        "rig = \"hosted\"\njobs = 1\nformat = \"json\"\nbaselines = \"b\"\nscenarios = [\"s\"]\n\
         runs = \"r\"\nout = \"o\"\n[run]\nlaw = \"dq-pi\"\nmodel = \"auto\"\nclock = \"lockstep\"\n\
         time_scale = 1.0\npacing = \"bench\"\ntrials = 1\nseed = 0\n",
    );
    let config = read_config(&folder.path().join(FILE)).unwrap();
    assert_eq!(config.values.len(), SETTINGS.len(), "one value per setting");
    with_settings(Arguments::command(), &config).debug_assert();
    with_settings(Arguments::command(), &Config::default()).debug_assert();
}

#[test]
fn every_setting_is_an_option_and_in_the_help() {
    let help = with_settings(Arguments::command(), &Config::default())
        .find_subcommand_mut("run")
        .unwrap()
        .render_long_help()
        .to_string();
    for setting in &SETTINGS {
        let arguments = Arguments::command();
        let mut commands = vec![&arguments];
        while let Some(command) = commands.pop() {
            if command.get_arguments().any(|option| option.get_id() == setting.id) {
                break;
            }
            assert!(!commands.is_empty() || command.has_subcommands(), "{} is no option", setting.id);
            commands.extend(command.get_subcommands());
        }
        if let Some(variable) = setting.variable.filter(|_| setting.id != "baselines") {
            assert!(help.contains(variable), "{variable}");
        }
    }
}

#[test]
fn the_file_overrides_defaults_and_the_command_line_the_file() {
    let folder = write_config(
        "rig = \"hosted\"\njobs = 3\nruns = \"mine\"\nscenarios = [\"a\", \"b\"]\n\
         [run]\ntrials = 7\ntime_scale = 0.5\nlaw = \"deadbeat\"\n",
    );
    let config = read_config(&folder.path().join(FILE)).unwrap();
    let built_in = parse_run(&Config::default(), &[]);
    assert_eq!((built_in.rig.to_string().as_str(), built_in.jobs, built_in.trials), ("emulated", None, None));
    assert_eq!((built_in.runs, built_in.scenarios), (PathBuf::from("runs"), vec![PathBuf::from("scenarios")]));
    let from_file = parse_run(&config, &[]);
    assert_eq!((from_file.rig.to_string().as_str(), from_file.jobs, from_file.trials), ("hosted", Some(3), Some(7)));
    assert_eq!((from_file.time_scale, from_file.law.as_deref()), (0.5, Some("deadbeat")));
    assert_eq!(from_file.runs, folder.path().join("mine"), "relative to the file");
    assert_eq!(from_file.scenarios, ["a", "b"].map(|name| folder.path().join(name)));
    let given = parse_run(
        &config,
        &["c", "--jobs", "4", "--runs", "r", "--rig", "exec:a {port}", "--trials", "1", "--time-scale", "1"],
    );
    assert_eq!(
        (given.rig.to_string().as_str(), given.jobs, given.trials, given.time_scale),
        ("exec:a {port}", Some(4), Some(1), 1.0)
    );
    assert_eq!((given.runs, given.scenarios), (PathBuf::from("r"), vec![PathBuf::from("c")]));
}

#[test]
fn the_nearest_file_upwards_applies() {
    let folder = write_config("jobs = 3\n");
    let deep = folder.path().join("a/b");
    fs::create_dir_all(&deep).unwrap();
    assert_eq!(Config::find_above(&deep, &Arguments::command()).unwrap().value("jobs").unwrap(), ["3"]);
    fs::write(folder.path().join("a").join(FILE), "jobs = 4\n").unwrap();
    assert_eq!(Config::find_above(&deep, &Arguments::command()).unwrap().value("jobs").unwrap(), ["4"]);
}

#[rstest]
#[case("rigs = \"hosted\"", "1:1: unknown key `rigs`")]
#[case("[run]\nlaws = \"dq-pi\"", "2:1: unknown key `laws`")]
#[case("jobs = \"many\"", "1:8: invalid type")]
#[case("jobs = 0", "1:8: invalid value '0' for '--jobs <N>'")]
#[case("jobs = 1025", "1:8: invalid value '1025' for '--jobs <N>'")]
#[case("jobs = 1024", "")]
#[case("rig = \"can:0\"", "1:7: invalid value 'can:0' for '--rig <RIG>'")]
#[case("format = \"xml\"", "1:10: invalid value 'xml' for '--format <FORMAT>'")]
#[case("[run]\nlaw = \"dq-pid\"", "2:7: invalid value 'dq-pid' for '--law <NAME>'")]
#[case("[run]\ntime_scale = 0.0009", "2:14: `time_scale`: invalid value '0.0009'")]
#[case("[run]\ntime_scale = 0.001", "")]
#[case("[run]\ntrials = 100001", "2:10: invalid value '100001'")]
#[case("[run]\nseed = -1", "2:8: invalid value '-1'")]
#[case("runs = \"\"", "1:8: `runs` is empty, expected a path")]
#[case("jobs = ", "1:")]
fn reports_the_position_of_a_fault(#[case] text: &str, #[case] expected: &str) {
    let folder = write_config(text);
    let path = folder.path().join(FILE);
    match read_config(&path) {
        Ok(_) => assert_eq!(expected, "", "{text} was accepted"),
        Err(faults) => {
            let fault = faults[0].to_string();
            assert!(!expected.is_empty() && fault.starts_with(&format!("{}:{expected}", path.display())), "{fault}");
        }
    }
}

#[rstest]
#[case::dangling_link(&["ln", "-s", "gone"], "cannot be read: No such file or directory (os error 2)")]
#[case::pipe(&["mkfifo"], "cannot be read: it is a pipe or a device, expected a file")]
#[case::device(&["ln", "-s", "/dev/zero"], "cannot be read: it is a pipe or a device, expected a file")]
#[case::folder(&["mkdir"], "cannot be read: it is a folder, expected a file")]
fn rejects_a_settings_file_that_is_no_file(#[case] make: &[&str], #[case] expected: &str) {
    let folder = tempdir().unwrap();
    let path = folder.path().join(FILE);
    assert!(std::process::Command::new(make[0]).args(&make[1..]).arg(&path).status().unwrap().success());
    let below = folder.path().join("below");
    fs::create_dir(&below).unwrap();
    let faults = Config::find_above(&below, &Arguments::command()).unwrap_err();
    assert_eq!(faults[0].to_string(), format!("{}: {expected}", path.display()));
}
