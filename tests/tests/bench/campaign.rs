use crate::test_folder::{
    ChildGuard, PLATE, ProgramOutput, TestFolder, bench_command, run_bench, start_bench, step_scenario, wait_until,
};
use platebench_model::record::FileLock;
use rstest::rstest;
use serde_json::Value;
use std::fs;
use std::process::{Command, Stdio};

const SCENARIO: &str = "title = \"Step\"\nplate = \"scenarios/plates/plate.toml\"\nduration_ms = 20.0\n\
    [profile]\nsetpoint_um = { hold = [[0.0, 0.0], [1.0, 2.0]] }\n\
    [[expect]]\nmetric = \"settling_time_ms\"\nat_most = 2.0\n\
    [[expect]]\nmetric = \"static_error_percent\"\nat_most = 1.0\n";

const VARY: &str = "title = \"Tolerance\"\nscenario = \"step.toml\"\n[vary]\n\
    \"controller.law\" = { each = [\"dq-pi\", \"deadbeat\"] }\n\
    \"profile.finger_force_n\" = { steps = [0.0, 1.0, 3] }\n\
    \"plate.mode.gain_um_per_vpp\" = { normal = { mean = 0.00698, sd_percent = 2.0 } }\n\
    \"controller.loop_delay_ms\" = { uniform = [0.0, 0.1] }\n";

pub(crate) fn folder(plan: &str) -> TestFolder {
    let folder = TestFolder::new();
    let plate = folder.read(PLATE).replace("noise_um_rms = 0.0", "noise_um_rms = 0.001");
    folder.write("scenarios/plates/plate.toml", &plate);
    folder.write("step.toml", SCENARIO);
    folder.write("campaign.toml", &format!("{VARY}{plan}"));
    folder
}

pub(crate) const GRID: &str = "[plan]\nmethod = \"grid\"\ntrials = 4\nseed = 5\n[judge]\n";

pub(crate) fn plan(folder: &TestFolder, out: &str, shards: u32) {
    let shards = shards.to_string();
    folder.bench(["campaign", "plan", "campaign.toml", "--out", out, "--shards", &shards]).assert_exit(0);
}

pub(crate) fn play(folder: &TestFolder, out: &str, shard: u32, jobs: u32) {
    let (shard, jobs) = (shard.to_string(), jobs.to_string());
    folder.bench(["campaign", "play", out, "--shard", &shard, "--jobs", &jobs]).assert_exit(0);
}

pub(crate) fn results(folder: &TestFolder, out: &str) -> Vec<Vec<u8>> {
    let names = ["results.csv", "results.parquet", "summary.json", "report.html"];
    names.map(|name| fs::read(folder.join(out).join(name)).unwrap()).to_vec()
}

pub(crate) fn summary(folder: &TestFolder, out: &str) -> Value {
    serde_json::from_str(&folder.read(&format!("{out}/summary.json"))).unwrap()
}

#[rstest]
#[case::grid(GRID)]
#[case::random("[plan]\nmethod = \"random\"\ntrials = 30\n[judge]\nat_most = 0.9\n")]
#[case::search("[plan]\nmethod = \"search\"\ntrials = 200\n")]
#[case::sobol("[plan]\nmethod = \"sobol\"\ntrials = 30\n[judge]\nat_most = 0.9\n")]
fn results_do_not_depend_on_shards_and_jobs(#[case] plan_text: &str) {
    let folder = folder(plan_text);
    let mut merged = Vec::new();
    let mut exits = Vec::new();
    for (out, shards, jobs) in [("a", 1, 1), ("b", 7, 2), ("c", 13, 1)] {
        plan(&folder, out, shards);
        // Plays the last shard first, because the order of the shards must not matter.
        (1..=shards).rev().for_each(|shard| play(&folder, out, shard, jobs));
        exits.push(folder.bench(["campaign", "merge", out]).exit);
        merged.push(results(&folder, out));
    }
    exits.push(folder.bench(["campaign", "run", "campaign.toml", "--out", "d", "--jobs", "2"]).exit);
    merged.push(results(&folder, "d"));
    assert!(merged.windows(2).all(|pair| pair[0] == pair[1]), "results depend on shards or jobs");
    assert!(exits.windows(2).all(|pair| pair[0] == pair[1]), "{exits:?}");
    let header = String::from_utf8_lossy(&merged[0][0]).lines().next().unwrap().to_owned();
    assert_eq!(
        header,
        "trial,seed,controller.law,profile.finger_force_n,plate.mode.gain_um_per_vpp,controller.loop_delay_ms,\
         settling_time_ms,settling_time_ms_margin,static_error_percent,static_error_percent_margin,verdict,cause,\
         settling_time_ms_error_numerical,settling_time_ms_error_quantisation,settling_time_ms_error_sensor,\
         settling_time_ms_error_statistics,static_error_percent_error_numerical,\
         static_error_percent_error_quantisation,static_error_percent_error_sensor,\
         static_error_percent_error_statistics"
    );
}

#[test]
fn the_cells_of_a_grid_are_in_the_order_of_its_keys() {
    let folder = folder(GRID);
    folder.bench(["campaign", "run", "campaign.toml", "--out", "c"]);
    let summary = summary(&folder, "c");
    let cells = summary["cells"].as_array().unwrap();
    assert_eq!((cells.len(), &summary["overall"]["trials"]), (6, &24.into()));
    let values = |cell: usize| (cells[cell]["values"].clone(), cells[cell]["trials"].clone());
    let expected = |law: &str, force: f64| {
        (serde_json::json!({ "controller.law": law, "profile.finger_force_n": force }), Value::from(4))
    };
    assert_eq!(values(1), expected("dq-pi", 0.5));
    assert_eq!(values(5), expected("deadbeat", 1.0));
    let csv = folder.read("c/results.csv");
    assert!(csv.lines().nth(5).unwrap().starts_with("4,9,dq-pi,0.5,"), "{csv}");
    let total: u64 = cells.iter().map(|cell| cell["failures"].as_u64().unwrap()).sum();
    assert_eq!(summary["overall"]["failures"], total);
}

/// Trials under 1 N miss the settling time.
#[test]
fn a_grid_without_judge_and_requirement_is_a_map() {
    let folder = folder(&GRID.replace("[judge]\n", ""));
    plan(&folder, "c", 2);
    play(&folder, "c", 1, 1);
    folder.bench(["campaign", "merge", "c"]).assert_exit(3).assert_stdout(&["inconclusive (evidence)"]);
    play(&folder, "c", 2, 1);
    let merged = folder.bench(["campaign", "merge", "c"]).assert_exit(0);
    let result = summary(&folder, "c");
    let firmware = result["firmware_sha256"].as_str().unwrap();
    assert_eq!((&result["rig"], firmware.len()), (&Value::from("hosted"), 64));
    let tested = format!("tested: rig hosted, firmware SHA-256 {firmware:.12}\n");
    merged.assert_stdout(&["map, not judged", "of 24 trials", " inconclusive\n", &tested]);
    assert!(result["overall"]["failures"].as_u64().unwrap() > 0, "{result}");
    assert_eq!((&result["verdict"], &result["judged"]), (&Value::Null, &Value::Bool(false)));
    assert!(result["cells"].as_array().unwrap().iter().any(|cell| cell["verdict"] == "fail"), "{result}");
    folder.write("step.toml", &SCENARIO.replace("at_most = 1.0", "at_most = 1.0\nrequirement = \"ACC-1\""));
    folder.bench(["campaign", "run", "campaign.toml", "--out", "d"]).assert_exit(1);
    assert_eq!(summary(&folder, "d")["judged"], true);
}

#[test]
fn a_damaged_part_is_refused_and_played_anew() {
    let folder = folder(GRID);
    plan(&folder, "c", 3);
    (1..=3).for_each(|shard| play(&folder, "c", shard, 2));
    let exit = folder.bench(["campaign", "merge", "c"]).exit;
    let before = results(&folder, "c");
    let part = folder.join("c/parts/2.parquet");
    let whole = fs::read(&part).unwrap();
    let flip = |at: usize| {
        let mut bytes = whole.clone();
        bytes[at] ^= 1;
        bytes
    };
    let other = fs::read(folder.join("c/parts/3.parquet")).unwrap();
    let damaged =
        [flip(4), flip(whole.len() / 2), flip(whole.len() - 1), whole[..whole.len() - 9].to_vec(), Vec::new()];
    for bytes in damaged {
        fs::write(&part, &bytes).unwrap();
        folder.bench(["campaign", "merge", "c"]).assert_message(2, &["2.parquet", "damaged"]);
        assert!(results(&folder, "c") == before, "earlier results were lost");
        play(&folder, "c", 2, 1);
        assert!(fs::read(&part).unwrap() == whole);
    }
    fs::write(&part, other).unwrap();
    folder.bench(["campaign", "merge", "c"]).assert_message(2, &["2.parquet", "another plan or shard"]);
    let again = folder.bench(["campaign", "play", "c", "--shard", "2"]);
    again.assert_message(2, &["2.parquet", "another plan or shard"]);
    fs::remove_file(&part).unwrap();
    folder.bench(["campaign", "status", "c"]).assert_exit(3).assert_stdout(&[
        "2 of 3 shards complete",
        "missing: 2",
        "missing parts: parts/2.parquet",
    ]);
    folder
        .bench(["campaign", "merge", "c"])
        .assert_exit(3)
        .assert_stdout(&["inconclusive (evidence)", "missing shards: 2 (parts/2.parquet)"]);
    play(&folder, "c", 2, 1);
    assert_eq!(folder.bench(["campaign", "merge", "c"]).exit, exit);
    assert!(results(&folder, "c") == before);
}

#[test]
fn a_killed_run_resumes_to_the_same_bytes() {
    let folder = folder("[plan]\nmethod = \"random\"\ntrials = 3000\n");
    let run = ["campaign", "run", "campaign.toml", "--jobs", "2", "--out"];
    let complete = folder.bench(run.into_iter().chain(["a"])).exit;
    let mut killed = start_bench(folder.path(), run.into_iter().chain(["b"]));
    wait_until("the run plays no shard", || folder.exists("b/parts/1.parquet"));
    killed.kill();
    assert!(!folder.exists("b/results.csv"), "the run ended before it was killed");
    let part = folder.join("b/parts/1.parquet");
    let written = fs::metadata(&part).unwrap().modified().unwrap();
    assert_eq!(folder.bench(run.into_iter().chain(["b"])).exit, complete);
    assert_eq!(fs::metadata(&part).unwrap().modified().unwrap(), written, "a complete shard was played again");
    assert!(results(&folder, "a") == results(&folder, "b"));
}

#[test]
fn a_counterexample_fails_under_run_with_the_same_values() {
    let folder = folder(GRID);
    folder.bench(["campaign", "run", "campaign.toml", "--out", "c"]).assert_exit(1);
    let mut reader = Vec::new();
    for line in folder.read("c/results.csv").lines() {
        reader.push(line.split(',').map(str::to_owned).collect::<Vec<_>>());
    }
    let entries = fs::read_dir(folder.join("c/counterexamples")).unwrap().map(|entry| entry.unwrap().path());
    let files: Vec<_> = entries.filter(|path| path.is_file()).collect();
    assert!(!files.is_empty() && files.len() <= 20, "{files:?}");
    for file in files.iter().take(5) {
        let trial = file.file_stem().unwrap().to_str().unwrap();
        let out = format!("again-{trial}");
        let arguments = ["run", file.to_str().unwrap(), "--rig", "hosted", "--out", &out];
        folder.bench(arguments).assert_exit(1);
        let record: Value = serde_json::from_slice(&fs::read(folder.join(&out).join("run.json")).unwrap()).unwrap();
        let row = reader.iter().find(|row| row[0] == trial).unwrap();
        assert_eq!(row[10], "fail");
        let expectations = record["scenarios"][0]["expectations"].as_array().unwrap();
        for (expectation, value) in expectations.iter().zip([&row[6], &row[8]]) {
            assert_eq!(expectation["value"].as_f64(), value.parse().ok(), "{trial}: {expectation}");
        }
    }
}

#[test]
fn some_trials_are_confirmed_on_the_emulated_firmware() {
    let folder = folder("[plan]\nmethod = \"random\"\ntrials = 400\nconfirm = \"emulated\"\n");
    plan(&folder, "a", 3);
    (1..=2).for_each(|shard| play(&folder, "a", shard, 2));
    folder.bench(["campaign", "merge", "a"]).assert_exit(3);
    assert_eq!(summary(&folder, "a").get("confirm"), None, "a shard is missing");
    play(&folder, "a", 3, 1);
    let merged = folder.bench(["campaign", "merge", "a", "--jobs", "1"]);
    merged.assert_stdout(&["trials replayed on emulated", "random trials: 0 of "]);
    let result = summary(&folder, "a");
    let confirmed = &result["confirm"];
    let failures = result["overall"]["failures"].as_u64().unwrap();
    assert!(failures > 0, "{result}");
    assert_eq!(confirmed["failing"]["replayed"].as_u64(), Some(failures));
    assert_eq!(confirmed["worst"]["replayed"], 20);
    let sampled = confirmed["random"]["replayed"].as_u64().unwrap();
    assert!((1..=15).contains(&sampled), "{confirmed}");
    assert!(confirmed["random"]["interval"][1].as_f64().unwrap() > 0.1, "few trials prove little: {confirmed}");
    assert_eq!((&confirmed["missed_failures"], &confirmed["differences"]), (&0.into(), &Value::Array(Vec::new())));
    folder.bench(["campaign", "run", "campaign.toml", "--out", "b", "--jobs", "2"]);
    assert_eq!(results(&folder, "a"), results(&folder, "b"));
    let other_rig = ["campaign", "run", "campaign.toml", "--out", "c", "--rig", "emulated"];
    folder.bench(other_rig).assert_message(2, &["expected --rig hosted"]);
}

#[test]
fn ctrl_c_keeps_complete_shards() {
    let folder = folder("[plan]\nmethod = \"random\"\ntrials = 200000\n");
    let run = start_bench(folder.path(), ["campaign", "run", "campaign.toml", "--out", "c"]);
    wait_until("the run plays no shard", || folder.exists("c/parts/1.parquet"));
    run.signal("INT");
    run.finish().assert_exit(130);
    let status = folder.bench(["campaign", "status", "c"]);
    status.assert_exit(3).assert_stdout(&["of 100 shards complete", "0 unusable"]);
}

#[rstest]
#[case::slurm("slurm", "sbatch", "SLURM_ARRAY_TASK_ID")]
#[case::hyperqueue("hyperqueue", "hq", "HQ_TASK_ID")]
fn submitted_commands_play_every_shard(#[case] on: &str, #[case] program: &str, #[case] task: &str) {
    let folder = folder(GRID);
    plan(&folder, "a folder", 3);
    let printed = folder.bench(["campaign", "submit", "a folder", "--on", on]);
    printed.assert_exit(0).assert_stdout(&[program, "--array=1-3", task, "campaign merge"]);
    // A script replaces the engine. It runs the last word of its command line for each task.
    let engine =
        format!("for word; do last=$word; done\nfor {task} in 1 2 3; do export {task}; sh -c \"$last\"; done\n");
    let output = ProgramOutput::from(submit_by_script(&folder, on, program, &engine).output().unwrap());
    let run = folder.bench(["campaign", "run", "campaign.toml", "--out", "b"]);
    assert_eq!(output.exit, run.exit);
    assert!(results(&folder, "a folder") == results(&folder, "b"));
}

fn submit_by_script(folder: &TestFolder, on: &str, program: &str, script: &str) -> Command {
    let tools = folder.join("tools");
    fs::create_dir(&tools).unwrap();
    fs::write(tools.join(program), format!("#!/bin/sh\n{script}")).unwrap();
    let executable = std::os::unix::fs::PermissionsExt::from_mode(0o755);
    fs::set_permissions(tools.join(program), executable).unwrap();
    let path = format!("{}:{}", tools.display(), std::env::var("PATH").unwrap());
    let mut command = bench_command(folder.path());
    command.args(["campaign", "submit", "a folder", "--on", on, "--run"]).env("PATH", path);
    command
}

#[rstest]
#[case::slurm("slurm", "sbatch", "scancel")]
#[case::hyperqueue("hyperqueue", "hq", "hq job cancel")]
fn ctrl_c_names_the_shards_in_the_queue(#[case] on: &str, #[case] program: &str, #[case] cancel: &str) {
    let folder = folder(GRID);
    plan(&folder, "a folder", 3);
    let mut command = submit_by_script(&folder, on, program, "touch waits; exec sleep 5 2>/dev/null\n");
    let bench = ChildGuard(command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap());
    wait_until("the engine is not called", || folder.exists("waits"));
    bench.signal("INT");
    bench.finish().assert_message(130, &["the shards stay in the queue", cancel]);
}

#[test]
fn a_campaign_moves_with_its_folder() {
    let folder = folder(GRID);
    let root = tempfile::tempdir().unwrap();
    plan(&folder, "c", 2);
    play(&folder, "c", 1, 1);
    let moved = root.path().join("moved");
    fs::rename(folder.path(), &moved).unwrap();
    run_bench(&moved, ["campaign", "play", "c", "--shard", "2"]).assert_exit(0);
    run_bench(&moved, ["campaign", "merge", "c"]).assert_exit(1);
    fs::create_dir(folder.path()).unwrap();
}

#[test]
fn jitter_follows_the_seed_of_the_trial() {
    let folder = folder("");
    let delays = |jitter: &str, seed: &str| {
        let scenario =
            SCENARIO.replace("[profile]", &format!("[controller]\nloop_delay_jitter_ms = {jitter}\n[profile]"));
        folder.write("jitter.toml", &scenario);
        folder.bench(["run", "jitter.toml", "--rig", "hosted", "--seed", seed, "--out", "run"]);
        let trace = folder.read("run/traces/jitter/000.csv");
        fs::remove_dir_all(folder.join("run")).unwrap();
        let rows = trace.lines().skip(1).map(|line| line.split(',').collect::<Vec<_>>()).collect::<Vec<_>>();
        let changes = rows.windows(2).filter(|pair| pair[0][5] != pair[1][5]);
        // Time since the control instant of the row, ns.
        let delay = |pair: &[Vec<&str>]| (pair[1][0].parse::<f64>().unwrap() * 1e9).round() as i64 % 1_000_000;
        changes.map(delay).collect::<Vec<_>>()
    };
    let prompt = delays("0.0", "1");
    assert!(prompt.len() >= 5 && prompt.iter().all(|delay| *delay == 0), "{prompt:?}");
    let jittered = delays("0.3", "1");
    assert!(jittered.len() >= 5 && jittered.iter().all(|delay| *delay <= 300_000), "{jittered:?}");
    assert!(jittered.iter().any(|delay| *delay != jittered[0]), "{jittered:?}");
    assert_eq!(jittered, delays("0.3", "1"));
    assert_ne!(jittered, delays("0.3", "2"));
}

#[test]
fn one_campaign_folder_has_one_run() {
    let folder = folder("[plan]\nmethod = \"random\"\ntrials = 200000\n");
    let mut running = start_bench(folder.path(), ["campaign", "run", "campaign.toml", "--out", "c"]);
    wait_until("the run plays no shard", || folder.exists("c/parts/1.parquet"));
    let in_use = |arguments: &[&str]| {
        let output = folder.bench(["campaign"].iter().chain(arguments)).assert_exit(2);
        output.assert_stderr(&["c: is in use by another campaign command"]);
    };
    in_use(&["run", "campaign.toml", "--out", "c"]);
    in_use(&["plan", "campaign.toml", "--out", "c", "--shards", "100"]);
    in_use(&["play", "c", "--shard", "100"]);
    in_use(&["merge", "c"]);
    assert!(!running.has_ended(), "the run ended before the other commands");
    running.kill();
    play(&folder, "c", 100, 2);
    assert!(!folder.exists("c/parts/100.lock"));
}

#[test]
fn only_one_process_plays_a_shard() {
    let folder = folder(GRID);
    plan(&folder, "c", 2);
    let other = folder.join("c/parts/1.lock");
    fs::write(&other, "").unwrap();
    let shared = FileLock::shared(&folder.join("c")).unwrap().unwrap();
    let own = FileLock::exclusive(&other).unwrap().unwrap();
    let play_first = || folder.bench(["campaign", "play", "c", "--shard", "1"]);
    play_first().assert_message(2, &["c: another process plays shard 1"]);
    play(&folder, "c", 2, 1);
    drop((shared, own));
    play_first().assert_exit(0);
    folder.bench(["campaign", "merge", "c"]).assert_exit(1);
}

/// `run` has the same rules (`exit_codes.rs`).
#[rstest]
#[case::chip_fault("", "metric = \"settling_time_ms\"\nat_most = 9.0\n[[fault]]\nkind = \"reset\"\nat_ms = 10.0")]
#[case::undefined_commands("law = \"pll\"", "metric = \"reference_difference_percent\"\nat_most = 1.0")]
#[case::step_time("", "metric = \"step_time_percent\"\nat_most = 90.0")]
fn a_campaign_plays_no_trial_that_run_does_not_play(#[case] controller: &str, #[case] expect: &str) {
    let folder = TestFolder::with_scenario(&step_scenario("aluminium-198x138", controller, "", expect));
    folder.bench(["run", "--rig", "hosted", "--out", "run"]).assert_exit(4);
    folder.write(
        "campaign.toml",
        "title = \"t\"\nscenario = \"scenarios/s.toml\"\n[vary]\n\
         \"profile.finger_force_n\" = { uniform = [0.0, 0.1] }\n[plan]\nmethod = \"random\"\ntrials = 2\n",
    );
    folder.bench(["campaign", "run", "campaign.toml", "--out", "c", "--rig", "hosted"]).assert_exit(4);
}
