//! Tests how controller and bench react to faults on the line.

use crate::test_folder::{TestFolder, run_bench, step_scenario, step_text, workspace_root};
use platebench_model::record::{Cause, RunRecord, Telemetry, Verdict};
use platebench_model::trace::{Flags, Row};
use rstest::rstest;
use std::fs;
use std::path::Path;

const MISSED: &str = "metric = \"missed_replies\"\nat_most = 100.0";

fn run_with_faults(faults: &str) -> (RunRecord, Vec<Row>) {
    TestFolder::new().run_scenario(&(step_text(MISSED) + faults))
}

fn telemetry(record: &RunRecord) -> &Telemetry {
    &record.scenarios[0].trials[0].telemetry
}

fn first_zero_drive_ms(rows: &[Row]) -> Option<f64> {
    rows.iter().find(|row| row.t_s > 0.0 && row.drive_vpp == 0.0).map(|row| row.t_s * 1e3)
}

fn times_with_flag_ms(rows: &[Row], flag: Flags) -> Vec<f64> {
    rows.iter().filter(|row| row.flags.contains(flag)).map(|row| (row.t_s * 1e3).round()).collect()
}

fn run_faults(folder: &Path, name: &str, out: &str, more: &[&str]) -> RunRecord {
    let scenarios = workspace_root().join("scenarios/faults").join(name);
    let output = run_bench(folder, ["run", scenarios.to_str().unwrap(), "--out", out].iter().chain(more));
    output.assert_exit_in(&[0, 1]);
    RunRecord::read(&folder.join(out)).unwrap()
}

#[test]
fn the_fault_suite_passes_with_any_number_of_jobs() {
    let folder = tempfile::tempdir().unwrap();
    for jobs in ["1", "2"] {
        let record = run_faults(folder.path(), "", jobs, &["--rig", "hosted", "--jobs", jobs]);
        assert_eq!(record.verdict, Verdict::Pass);
        let all_applied = record.scenarios.iter().all(|it| !it.trials[0].telemetry.faults.is_empty());
        assert!(record.scenarios.len() > 10 && all_applied, "every scenario applied its fault");
        for scenario in &record.scenarios {
            let trace = |run: &str| fs::read(folder.path().join(run).join(&scenario.trials[0].trace)).unwrap();
            assert!(trace("1") == trace(jobs), "{}", scenario.file);
        }
    }
}

#[test]
fn a_slew_over_late_replies_is_no_violation() {
    // Deadbeat approaches a distant resonance in steps of at most the slew limit. Two late replies
    // act at once, so the frequency changes by two steps.
    let heat = "temperature_offset_k = { hold = [[0.0, 0.0], [24.8, 5.0]] }";
    let text = step_scenario("aluminium-198x138", "law = \"deadbeat\"", heat, MISSED);
    let fault = "[[fault]]\nkind = \"delay\"\ndelay_ms = 1.01\ndirection = \"from-controller\"\n\
                 from_ms = 25.0\nuntil_ms = 27.0\n";
    let (record, rows) = TestFolder::new().run_scenario(&(text + fault));
    let frequencies: Vec<f64> = rows.iter().map(|row| row.frequency_hz).collect();
    let largest = frequencies.windows(2).map(|pair| (pair[1] - pair[0]).abs()).fold(0.0, f64::max);
    assert!(largest > 100.0, "one actuation contains two steps: {largest} Hz");
    assert_eq!(telemetry(&record).violations, []);
}

#[rstest]
#[case::hosted("hosted")]
#[case::emulated("emulated")]
fn a_flipped_bit_has_the_effect_of_a_lost_sample(#[case] rig: &str) {
    let folder = tempfile::tempdir().unwrap();
    let traces = ["lost-sample", "flipped-bit"].map(|name| {
        let record = run_faults(folder.path(), &format!("{name}.toml"), name, &["--rig", rig]);
        fs::read(folder.path().join(name).join(&record.scenarios[0].trials[0].trace)).unwrap()
    });
    assert!(traces[0] == traces[1]);
}

#[rstest]
#[case::hosted("hosted")]
#[case::emulated("emulated")]
fn the_record_has_the_cause_of_the_controller_s_stop(#[case] rig: &str) {
    let folder = tempfile::tempdir().unwrap();
    let record = run_faults(folder.path(), "", "run", &["--rig", rig]);
    let stopped = |name: &str| {
        let scenario = record.scenarios.iter().find(|scenario| scenario.file.contains(name)).unwrap();
        scenario.trials[0].telemetry.stopped.as_deref()
    };
    assert_eq!(stopped("five-periods-of-silence"), Some("no sample within the watchdog timeout"));
    assert_eq!(stopped("disconnect-and-reconnect"), Some("no sample within the watchdog timeout"));
    assert_eq!(stopped("noise-storm"), Some("too many rejected frames"));
    for runs in ["four-periods-of-silence", "noise-borne", "flipped-bit", "truncated-messages", "frozen-sensor"] {
        assert_eq!(stopped(runs), None, "{runs}");
    }
}

/// The fault begins at 30 ms, so the last sample before it is at 29 ms.
#[test]
fn the_watchdog_acts_on_the_fifth_missing_sample() {
    let silence = |until: u32| {
        run_with_faults(&format!(
            "[[fault]]\nkind = \"drop\"\ndirection = \"to-controller\"\nfrom_ms = 30.0\nuntil_ms = {until}.0\n"
        ))
    };
    let (record, rows) = silence(33);
    assert_eq!((first_zero_drive_ms(&rows), telemetry(&record).stopped.as_deref()), (None, None));
    assert_eq!(times_with_flag_ms(&rows, Flags::LINK_LOST), [30.0, 31.0, 32.0]);
    assert_eq!((record.verdict, record.scenarios[0].expectations[0].value), (Verdict::Pass, Some(3.0)));
    let drives: Vec<_> = rows.iter().filter(|row| (0.029..0.033).contains(&row.t_s)).map(|row| row.drive_vpp).collect();
    assert!(drives.iter().all(|drive| *drive == drives[0] && *drive > 280.0));

    let (record, rows) = silence(34);
    assert_eq!(first_zero_drive_ms(&rows), Some(34.0), "five periods after the last sample");
    assert_eq!(telemetry(&record).stopped.as_deref(), Some("no sample within the watchdog timeout"));
    assert!(rows.last().unwrap().flags.contains(Flags::SAFE), "not configured again");
}

#[test]
fn a_stopped_controller_is_reconfigured_once_on_request() {
    let silence = "[[fault]]\nkind = \"drop\"\ndirection = \"to-controller\"\nfrom_ms = 10.0\nuntil_ms = 20.0\n";
    let again = silence.replace("10.0", "30.0").replace("20.0", "40.0");
    let (_, rows) = run_with_faults(&format!("{silence}reconfigure = true\n{again}"));
    let stopped = |ms: f64| {
        rows.iter()
            .rfind(|row| row.t_s <= ms / 1e3)
            .is_some_and(|row| row.flags.contains(Flags::SAFE) && row.drive_vpp == 0.0)
    };
    assert_eq!([13.9, 14.0, 19.9].map(stopped), [false, true, true]);
    assert_eq!([20.0, 33.9].map(stopped), [false, false], "configured again at the end of the window");
    assert_eq!([34.0, 40.0, 60.0].map(stopped), [true, true, true], "the second fault has no reconfigure");
}

#[test]
fn a_dead_line_is_lost_after_twenty_periods() {
    let (record, rows) = run_with_faults("[[fault]]\nkind = \"disconnect\"\nfrom_ms = 30.0\n");
    assert_eq!(first_zero_drive_ms(&rows), Some(50.0));
    assert_eq!(record.scenarios[0].expectations[0].cause, Some(Cause::Rig));
    assert!(telemetry(&record).ended.is_some());
    assert_eq!(telemetry(&record).faults["disconnect"], 21, "20 samples and the controller's stop message");

    let (record, rows) = run_with_faults("[[fault]]\nkind = \"disconnect\"\nfrom_ms = 20.0\nuntil_ms = 50.0\n");
    assert_eq!((first_zero_drive_ms(&rows), record.verdict), (Some(50.0), Verdict::Pass));
    assert_eq!((telemetry(&record).ended.as_deref(), rows.last().unwrap().drive_vpp), (None, 0.0));

    let folder = tempfile::tempdir().unwrap();
    let scenario = workspace_root().join("scenarios/limits/disconnect-for-good.toml");
    run_bench(folder.path(), ["run", scenario.to_str().unwrap()]).assert_exit(5);
}

#[test]
fn a_command_late_within_its_period_is_not_missed() {
    let (record, rows) = run_with_faults(
        "[[fault]]\nkind = \"delay\"\ndelay_ms = 0.3125\ndirection = \"from-controller\"\n\
         from_ms = 0.0\nuntil_ms = 60.0\n",
    );
    assert_eq!(times_with_flag_ms(&rows, Flags::LINK_LOST), [0.0; 0]);
    assert_eq!(rows.iter().find(|row| row.drive_vpp > 0.0).unwrap().t_s, 0.000_312_5);
    assert_eq!(telemetry(&record).loop_delay_us, Some(312.5));
    // A fault that delays every reply acts like a loop delay of the same length.
    let delayed = step_scenario("aluminium-198x138", "loop_delay_ms = 0.3125", "", MISSED);
    let (_, expected) = TestFolder::new().run_scenario(&delayed);
    let drives = |rows: &[Row]| rows.iter().map(|row| (row.t_s, row.drive_vpp, row.wd_um)).collect::<Vec<_>>();
    assert!(drives(&rows) == drives(&expected));
}

#[test]
fn a_command_later_than_a_period_is_missed_but_acts() {
    let (record, rows) = run_with_faults(
        "[[fault]]\nkind = \"delay\"\ndelay_ms = 1.5\ndirection = \"from-controller\"\n\
         from_ms = 30.0\nuntil_ms = 31.0\n",
    );
    assert_eq!(times_with_flag_ms(&rows, Flags::LINK_LOST), [30.0]);
    // The next command waits on the line behind the late one but is in time, so only one is missed.
    assert_eq!((record.scenarios[0].expectations[0].value, record.verdict), (Some(1.0), Verdict::Pass));
}

#[test]
fn the_trace_has_the_samples_of_the_controller() {
    let (_, rows) = run_with_faults("[[fault]]\nkind = \"freeze\"\nfrom_ms = 1.0\nuntil_ms = 4.0\n");
    let sensed: Vec<_> =
        rows.iter().filter(|row| row.flags.contains(Flags::CONTROL)).map(|row| row.sensed_wd_um).take(5).collect();
    assert_eq!(sensed[..4], [0.0; 4]);
    assert!(sensed[4] > 1.0);
}
