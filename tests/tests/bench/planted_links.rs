//! Plants links in folders that came from another person. No command writes a file outside of them.

use crate::campaign::{GRID, folder as campaign_folder, plan, play};
use crate::test_folder::{SETTLING, TestFolder, bench_command, lock_heavy_load, step_text};
use rstest::rstest;
use std::fs;
use std::os::unix::fs::symlink;
use std::path::Path;
use std::process::Stdio;

/// A file and an empty folder of the user, outside of the folders with planted links.
struct Private(tempfile::TempDir);

impl Private {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("file"), "kept").unwrap();
        fs::create_dir(folder.path().join("folder")).unwrap();
        Self(folder)
    }

    /// Replaces `path` by a link to the private file.
    #[track_caller]
    fn plant_file(&self, path: &Path) {
        let _ = fs::remove_file(path);
        symlink(self.0.path().join("file"), path).unwrap();
    }

    /// Replaces `path` by a link to the private folder.
    #[track_caller]
    fn plant_folder(&self, path: &Path) {
        let _ = fs::remove_dir_all(path);
        symlink(self.0.path().join("folder"), path).unwrap();
    }

    #[track_caller]
    fn assert_untouched(&self) {
        assert_eq!(fs::read_to_string(self.0.path().join("file")).unwrap(), "kept");
        assert_eq!(fs::read_dir(self.0.path()).unwrap().count(), 2);
        assert_eq!(fs::read_dir(self.0.path().join("folder")).unwrap().count(), 0);
    }
}

#[track_caller]
fn assert_written(folder: &TestFolder, files: &[&str]) {
    for file in files {
        assert!(fs::symlink_metadata(folder.join(file)).unwrap().is_file(), "{file} is a link");
        assert!(!folder.read(file).contains("kept"), "{file}");
    }
}

fn with_runs(names: &[&str]) -> TestFolder {
    let folder = TestFolder::with_step(SETTLING);
    for name in names {
        folder.run_hosted(name).assert_exit(0);
    }
    folder
}

#[rstest]
#[case::report(&["report", "run"], &["run/report.html", "run/traceability.csv"])]
#[case::comparison(&["report", "run", "--against", "other"], &["run/comparison.html", "run/traceability.csv"])]
#[case::export(&["report", "run", "--export", "csv", "--out", "."], &[])]
fn a_report_replaces_a_link_in_the_place_of_a_file(#[case] command: &[&str], #[case] files: &[&str]) {
    let (folder, private) = (with_runs(&["run", "other"]), Private::new());
    for file in files {
        private.plant_file(&folder.join(file));
    }
    folder.bench(command).assert_exit(0);
    assert_written(&folder, files);
    private.assert_untouched();
}

#[rstest]
#[case::of_the_folder("run/export")]
#[case::of_a_folder_below("run/export/s")]
fn an_export_refuses_a_link_in_the_place_of_a_folder(#[case] link: &str) {
    let folder = TestFolder::with_scenario(&format!("{}[trials]\ncount = 2\n", step_text(SETTLING)));
    folder.run_hosted("run").assert_exit(0);
    let private = Private::new();
    fs::create_dir_all(folder.join(link).parent().unwrap()).unwrap();
    private.plant_folder(&folder.join(link));
    let output = folder.bench(["report", "run", "--export", "mf4"]);
    output.assert_message(2, &[&format!("{link}: is a symbolic link")]);
    private.assert_untouched();
}

#[test]
fn an_export_refuses_a_dangling_link() {
    let (folder, private) = (with_runs(&["run"]), Private::new());
    fs::create_dir(folder.join("run/export")).unwrap();
    let link = folder.join("run/export/s.parquet");
    symlink(private.0.path().join("new"), &link).unwrap();
    folder.bench(["report", "run", "--export", "parquet"]).assert_message(2, &["run/export/s.parquet"]);
    private.assert_untouched();
}

#[test]
fn a_campaign_replaces_links_in_the_place_of_files() {
    const FILES: [&str; 3] = ["all/results.csv", "all/summary.json", "all/report.html"];
    let (folder, private) = (campaign_folder(GRID), Private::new());
    plan(&folder, "all", 1);
    play(&folder, "all", 1, 1);
    for file in FILES.iter().chain(&["all/results.parquet"]) {
        private.plant_file(&folder.join(file));
    }
    folder.bench(["campaign", "merge", "all"]).assert_exit_in(&[0, 1, 3]);
    assert_written(&folder, &FILES);
    private.assert_untouched();
}

#[rstest]
#[case::merge("worst", &["campaign", "merge", "all"])]
#[case::counterexamples("counterexamples", &["campaign", "merge", "all"])]
#[case::play("parts", &["campaign", "play", "all", "--shard", "1"])]
fn a_campaign_refuses_links_in_the_place_of_folders(#[case] name: &str, #[case] command: &[&str]) {
    let (folder, private) = (campaign_folder(GRID), Private::new());
    plan(&folder, "all", 1);
    if name != "parts" {
        play(&folder, "all", 1, 1);
    }
    let link = format!("all/{name}");
    private.plant_folder(&folder.join(&link));
    folder.bench(command).assert_message(2, &[&format!("{link}: is a symbolic link")]);
    private.assert_untouched();
}

#[test]
fn the_page_of_a_soak_replaces_a_link() {
    let (folder, private) = (TestFolder::with_step(SETTLING), Private::new());
    folder.write("boards.toml", "[[board]]\nname = \"left\"\nrig = \"hosted\"\n");
    let soak = ["board", "soak", "--board", "left", "--hours", "0.00001", "--out", "soak"];
    folder.bench(soak).assert_exit(0);
    private.plant_file(&folder.join("soak/report.html"));
    folder.bench(["report", "soak"]).assert_exit(0);
    assert_written(&folder, &["soak/report.html"]);
    private.assert_untouched();
}

#[test]
fn a_soak_refuses_a_folder_with_a_planted_link() {
    let (folder, private) = (TestFolder::with_step(SETTLING), Private::new());
    folder.write("boards.toml", "[[board]]\nname = \"left\"\nrig = \"hosted\"\n");
    let soak = ["board", "soak", "--board", "left", "--hours", "0.00001", "--out", "soak"];
    fs::create_dir(folder.join("soak")).unwrap();
    private.plant_file(&folder.join("soak/soak.json"));
    folder.bench(soak).assert_message(2, &["soak already contains a run"]);
    private.assert_untouched();
}

#[test]
fn an_exploration_replaces_links_in_the_place_of_files() {
    const FILES: [&str; 2] = ["explored/explore.json", "explored/report.html"];
    let (folder, private) = (TestFolder::new(), Private::new());
    fs::create_dir(folder.join("explored")).unwrap();
    for file in FILES {
        private.plant_file(&folder.join(file));
    }
    let explore = ["suite", "explore", "--rig", "hosted", "--scenes", "2", "--seed", "1", "--out", "explored"];
    folder.bench(explore).assert_exit(0);
    assert_written(&folder, &FILES);
    private.assert_untouched();
}

#[rstest]
#[case::of_the_inputs("joined/inputs")]
#[case::of_the_traces("joined/traces")]
fn joined_runs_refuse_a_link_in_the_place_of_a_folder(#[case] link: &str) {
    let (folder, private) = (TestFolder::new(), Private::new());
    for name in ["a.toml", "b.toml"] {
        folder.write_scenario(name, &step_text(SETTLING));
    }
    folder.bench(["run", "--rig", "hosted", "--shard", "1/2", "--out", "one"]).assert_exit(0);
    folder.bench(["run", "--rig", "hosted", "--shard", "2/2", "--out", "two"]).assert_exit(0);
    fs::create_dir(folder.join("joined")).unwrap();
    private.plant_folder(&folder.join(link));
    let output = folder.bench(["report", "--merge", "one", "two", "--out", "joined"]);
    output.assert_message(2, &[&format!("{link}: is a symbolic link")]);
    private.assert_untouched();
}

#[test]
fn a_resumed_session_refuses_a_link_in_the_place_of_its_steps() {
    let (folder, private) = (crate::accept::session_folder(), Private::new());
    crate::accept::run_session(&folder, &["--yes"]).assert_exit(0);
    let text = folder.read("record/session.json").replacen("\"complete\": true", "\"complete\": false", 1);
    folder.write("record/session.json", &text.replace("\"done\": true", "\"done\": false"));
    private.plant_folder(&folder.join("record/steps"));
    private.plant_file(&folder.join("record/report.html"));
    let resume = ["acceptance", "run", "--plan", "plan.toml", "--rig", "hosted", "--yes", "--resume", "record"];
    let output = folder.bench(resume);
    output.assert_message(2, &["record/steps: is a symbolic link"]);
    private.assert_untouched();
}

#[test]
fn accepting_a_baseline_replaces_links_in_the_place_of_files() {
    const FILES: [&str; 2] = ["golden/s.csv", "golden/s.toml"];
    let (folder, private) = (with_runs(&["run"]), Private::new());
    let accept = ["baseline", "accept", "run", "--baselines", "golden"];
    folder.bench(accept).assert_exit(0);
    // A dangling link is no baseline, so nothing is compared with it.
    for file in FILES {
        fs::remove_file(folder.join(file)).unwrap();
        symlink(private.0.path().join("new"), folder.join(file)).unwrap();
    }
    folder.bench(accept).assert_exit(0);
    assert_written(&folder, &FILES);
    private.assert_untouched();
}

#[test]
fn accepting_a_baseline_refuses_a_link_in_the_place_of_a_folder() {
    let (folder, private) = (TestFolder::new(), Private::new());
    fs::create_dir(folder.join("scenarios/part")).unwrap();
    let step = step_text(SETTLING).replace("plates/", "../plates/");
    folder.write_scenario("part/s.toml", &step);
    folder.run_hosted("run").assert_exit(0);
    fs::create_dir(folder.join("golden")).unwrap();
    private.plant_folder(&folder.join("golden/part"));
    let output = folder.bench(["baseline", "accept", "run", "--baselines", "golden"]);
    output.assert_message(2, &["golden/part: is a symbolic link"]);
    private.assert_untouched();
}

#[test]
fn a_comparison_refuses_a_link_in_the_place_of_its_drawings() {
    let (folder, private) = (with_runs(&["run"]), Private::new());
    folder.bench(["run", "--rig", "hosted", "--law", "dq-pi-euler", "--out", "other"]);
    private.plant_folder(&folder.join("other/comparison"));
    let output = folder.bench(["compare", "other", "run"]);
    output.assert_message(2, &["other/comparison: is a symbolic link"]);
    private.assert_untouched();
}

/// Starts all commands before it waits for one.
fn run_at_once(folder: &TestFolder, commands: &[Vec<&str>]) -> Vec<(i32, String)> {
    let start = |arguments: &Vec<&str>| {
        bench_command(folder.path()).args(arguments).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap()
    };
    let children: Vec<_> = commands.iter().map(start).collect();
    let finish = |child: std::process::Child| {
        let output = child.wait_with_output().unwrap();
        (output.status.code().unwrap(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    children.into_iter().map(finish).collect()
}

#[test]
fn simultaneous_reports_of_one_run_all_succeed() {
    let _load = lock_heavy_load();
    let folder = with_runs(&["run"]);
    for (exit, message) in run_at_once(&folder, &vec![vec!["report", "run"]; 24]) {
        assert_eq!(exit, 0, "{message}");
    }
    assert!(
        folder.read("run/report.html").ends_with("</html>\n") || folder.read("run/report.html").ends_with("</html>")
    );
    let left = fs::read_dir(folder.join("run")).unwrap().map(|entry| entry.unwrap().file_name());
    assert_eq!(left.filter(|name| name.to_string_lossy().ends_with(".part")).count(), 0);
}

/// One process at a time writes a folder of baselines, so its files are of one run.
#[test]
fn a_baseline_folder_in_use_is_refused() {
    let folder = with_runs(&["run"]);
    fs::create_dir(folder.join("golden")).unwrap();
    let accept = ["baseline", "accept", "run", "--baselines", "golden"];
    let lock = fs::File::open(folder.join("golden")).unwrap();
    lock.lock().unwrap();
    folder.bench(accept).assert_message(2, &["golden is in use by another `platebench baseline`"]);
    assert_eq!(fs::read_dir(folder.join("golden")).unwrap().count(), 0);
    drop(lock);
    folder.bench(accept).assert_exit(0);
}
