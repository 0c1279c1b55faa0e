//! Checks that every way of playing states why a trial did not pass.

use crate::boards::inventory;
use crate::controller_end::{Change, controller};
use crate::test_folder::{TestFolder, step_scenario};
use rstest::rstest;
use std::fs;

/// Stops in the middle of the trial.
const STOP: Change = Change::Message {
    kind: "SAMPLE",
    action: "self.samples = getattr(self, 'samples', 0) + 1
            if self.samples % 60 == 20:
                self.stop(FAULT, NOT_FINITE)
                return self.command(number)",
};
const STOPPED: &str = "the controller stopped: a value that is not finite";

/// Sends four bytes after each command.
const SHORT_FRAME: Change = Change::AfterAnswer(
    "                        if body and body[0] & 15 == SAMPLE:
                            port.write(b'\\x03\\x01\\x02\\x00')
",
);
const REJECTED: &str = "frame of the controller rejected, 4 bytes instead of 24";

#[rstest]
#[case::stop(STOP, STOPPED)]
#[case::rejected_frame(SHORT_FRAME, REJECTED)]
fn every_way_of_playing_states_the_reason(#[case] change: Change, #[case] reason: &str) {
    let expect = "metric = \"final_amplitude_um\"\nat_least = 1.0\nrequirement = \"R-1\"";
    let folder = TestFolder::with_scenario(&step_scenario("aluminium-198x138", "law = \"dq-pi-fixed\"", "", expect));
    let Some(rig) = controller(&folder, change) else { return };
    let run = folder.bench(["run", "--rig", &rig, "--out", "run", "--summary", "summary.md"]);
    // The console wraps long lines.
    assert!(run.stdout.split_whitespace().collect::<Vec<_>>().join(" ").contains(reason), "{run:?}");
    for file in ["run/run.json", "run/report.html", "run/junit.xml", "summary.md"] {
        assert!(folder.read(file).contains(reason), "{file}");
    }
    let plan = "title = \"A session\"\nrepetitions = 1\n[[requirement]]\nid = \"R-1\"\ntext = \"It moves.\"\n\
                [[scenario]]\nfile = \"scenarios/s.toml\"\n[bench]\ntiming_trials = 1\nclean_runs = 2\n";
    folder.write("plan.toml", plan);
    let session = folder.bench(["acceptance", "run", "--plan", "plan.toml", "--out", "record", "--rig", &rig, "--yes"]);
    let verdict = session.stdout.lines().find(|line| line.starts_with("verdict: ")).unwrap();
    assert!(verdict.contains("R-1 (final_amplitude_um is ") && verdict.contains(reason), "{session:?}");
    assert!(folder.read("record/record.html").contains(reason));
    folder.write("boards.toml", &inventory(&[("left", format!("rig = {rig:?}"))]));
    folder
        .bench(["board", "soak", "--board", "left", "--hours", "0.0000001", "--out", "soak"])
        .assert_stdout(&["First run that did not pass: ", reason]);
    assert!(folder.read("soak/soak.json").contains(reason) && folder.read("soak/report.html").contains(reason));
}

#[test]
fn a_campaign_states_the_reason_of_its_worst_trials() {
    let expect = "metric = \"settling_time_ms\"\nat_most = 1.9";
    let folder = TestFolder::with_scenario(&step_scenario("aluminium-198x138", "law = \"dq-pi\"", "", expect));
    folder.write(
        "campaign.toml",
        "title = \"t\"\nscenario = \"scenarios/s.toml\"\n[vary]\n\
         \"profile.finger_force_n\" = { uniform = [0.0, 0.01] }\n[plan]\nmethod = \"random\"\ntrials = 2\n",
    );
    folder.bench(["campaign", "run", "campaign.toml", "--out", "c", "--rig", "hosted"]).assert_exit(1);
    let page = folder.read("c/report.html");
    assert!(page.contains("settling_time_ms: ") && page.contains("limit ≤ 1.9, window 0 … 60 ms"), "{page}");
    assert!(fs::read_dir(folder.join("c/counterexamples")).unwrap().next().is_some());
}
