use super::{Config, FILE, SETTINGS, command};
use crate::args::{Arguments, Command};
use clap::{CommandFactory, FromArgMatches};
use rstest::rstest;
use std::fs;
use std::path::PathBuf;
use tempfile::{TempDir, tempdir};

fn with(text: &str) -> TempDir {
    let folder = tempdir().unwrap();
    fs::write(folder.path().join(FILE), text).unwrap();
    folder
}

fn run(config: &Config, arguments: &[&str]) -> crate::args::Run {
    let matches = command(config).get_matches_from([&["platebench", "run"], arguments].concat());
    match Arguments::from_arg_matches(&matches).unwrap().command {
        Command::Run(run) => run,
        other => panic!("{other:?}"),
    }
}

#[test]
fn the_commands_are_consistent_with_and_without_a_file() {
    let folder = with(
        "rig = \"hosted\"\njobs = 1\nformat = \"json\"\nbaselines = \"b\"\nscenarios = [\"s\"]\nruns = \"r\"\nout = \"o\"\n[run]\nlaw = \"dq-pi\"\nmodel = \"auto\"\nclock = \"lockstep\"\ntime_scale = 1.0\npacing = \"bench\"\ntrials = 1\nseed = 0\n",
    );
    let config = Config::read(&folder.path().join(FILE)).unwrap();
    assert_eq!(config.values.len(), SETTINGS.len(), "every setting has a key that is read");
    command(&config).debug_assert();
    command(&Config::default()).debug_assert();
}

#[test]
fn every_setting_is_an_option_and_every_variable_is_said_in_the_help() {
    let help = command(&Config::default()).find_subcommand_mut("run").unwrap().render_long_help().to_string();
    for setting in &SETTINGS {
        let arguments = Arguments::command();
        let mut commands = vec![&arguments];
        while let Some(command) = commands.pop() {
            if command.get_arguments().any(|option| option.get_id() == setting.id) {
                break;
            }
            assert!(!commands.is_empty() || command.has_subcommands(), "{} is an option of nothing", setting.id);
            commands.extend(command.get_subcommands());
        }
        if let Some(variable) = setting.variable.filter(|_| setting.id != "baselines") {
            assert!(help.contains(variable), "{variable}");
        }
    }
}

#[test]
fn a_file_comes_before_what_is_built_in_and_after_the_command_line() {
    let folder = with(
        "rig = \"hosted\"\njobs = 3\nruns = \"mine\"\nscenarios = [\"a\", \"b\"]\n[run]\ntrials = 7\ntime_scale = 0.5\nlaw = \"deadbeat\"\n",
    );
    let config = Config::read(&folder.path().join(FILE)).unwrap();
    let built_in = run(&Config::default(), &[]);
    assert_eq!((built_in.rig.to_string().as_str(), built_in.jobs, built_in.trials), ("emulated", None, None));
    assert_eq!((built_in.runs, built_in.scenarios), (PathBuf::from("runs"), vec![PathBuf::from("scenarios")]));
    let from_file = run(&config, &[]);
    assert_eq!((from_file.rig.to_string().as_str(), from_file.jobs, from_file.trials), ("hosted", Some(3), Some(7)));
    assert_eq!((from_file.time_scale, from_file.law.as_deref()), (0.5, Some("deadbeat")));
    assert_eq!(from_file.runs, folder.path().join("mine"), "relative to the file");
    assert_eq!(from_file.scenarios, ["a", "b"].map(|name| folder.path().join(name)));
    let said = run(
        &config,
        &["c", "--jobs", "4", "--runs", "r", "--rig", "exec:a {port}", "--trials", "1", "--time-scale", "1"],
    );
    assert_eq!(
        (said.rig.to_string().as_str(), said.jobs, said.trials, said.time_scale),
        ("exec:a {port}", Some(4), Some(1), 1.0)
    );
    assert_eq!((said.runs, said.scenarios), (PathBuf::from("r"), vec![PathBuf::from("c")]));
}

#[test]
fn the_nearest_file_upwards_holds() {
    let folder = with("jobs = 3\n");
    let deep = folder.path().join("a/b");
    fs::create_dir_all(&deep).unwrap();
    assert_eq!(Config::above(&deep).unwrap().value("jobs").unwrap(), ["3"]);
    fs::write(folder.path().join("a").join(FILE), "jobs = 4\n").unwrap();
    assert_eq!(Config::above(&deep).unwrap().value("jobs").unwrap(), ["4"]);
}

/// What is wrong is pointed at: a key, a kind, a value that the option does not take. The last good values are taken.
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
#[case("[run]\ntime_scale = 0.0009", "2:14: invalid value '0.0009'")]
#[case("[run]\ntime_scale = 0.001", "")]
#[case("[run]\ntrials = 100001", "2:10: invalid value '100001'")]
#[case("[run]\nseed = -1", "2:8: invalid value '-1'")]
#[case("runs = \"\"", "1:8: empty, expected a path")]
#[case("jobs = ", "1:")]
fn what_is_wrong_is_pointed_at(#[case] text: &str, #[case] told: &str) {
    let folder = with(text);
    let path = folder.path().join(FILE);
    match Config::read(&path) {
        Ok(_) => assert_eq!(told, "", "{text} was taken"),
        Err(faults) => {
            let fault = faults[0].to_string();
            assert!(!told.is_empty() && fault.starts_with(&format!("{}:{told}", path.display())), "{fault}");
        }
    }
}
