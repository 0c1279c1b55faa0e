//! A controller or program that changes during an experiment ends it.

use crate::controller_end::{Change, controller};
use crate::test_folder::{TestFolder, step_text};
use std::fs;

const FITS: &str = "metric = \"final_amplitude_um\"\nat_least = 0.5\nrequirement = \"R-1\"";
const CRASH: &str = "os.kill(os.getpid(), 11) if number == 21 else None";
const NAME: &str = "name = b\"python-example\".ljust(16, b\"\\0\")";

/// The name contains the number of the process, so each start is another controller.
#[test]
fn a_campaign_refuses_another_controller_after_a_restart() {
    let folder = TestFolder::with_step(FITS);
    let Some(rig) = controller(&folder, Change::Message { kind: "SAMPLE", action: CRASH }) else { return };
    let program = folder.read("controller.py");
    assert!(program.contains(NAME));
    fs::write(
        folder.join("controller.py"),
        program.replace(NAME, "name = (b\"c%d\" % os.getpid()).ljust(16, b\"\\0\")"),
    )
    .unwrap();
    folder.write(
        "campaign.toml",
        "title = \"t\"\nscenario = \"scenarios/s.toml\"\n[vary]\n\
         \"profile.finger_force_n\" = { uniform = [0.0, 0.1] }\n[plan]\nmethod = \"random\"\ntrials = 4\n",
    );
    let played = folder.bench(["campaign", "run", "campaign.toml", "--out", "c", "--rig", &rig, "--jobs", "1"]);
    // The failure before the change is stated with the number of its trial.
    played.assert_text(5, &["the controller is now", "trials that failed before", "failed [0]"]);
    assert!(!folder.exists("c/parts/1.parquet"));
}

#[test]
fn a_session_refuses_another_program_in_a_later_step() {
    let folder = TestFolder::with_step(FITS);
    folder.write_scenario("t.toml", &step_text(FITS));
    let plan = "title = \"A session\"\nrepetitions = 1\n[[requirement]]\nid = \"R-1\"\ntext = \"It moves.\"\n\
                [[scenario]]\nfile = \"scenarios/s.toml\"\n[[scenario]]\nfile = \"scenarios/t.toml\"\n\
                [bench]\ntiming_trials = 1\nclean_runs = 2\n";
    folder.write("plan.toml", plan);
    let action = "open(__file__, 'a').write('# changed\\n')";
    let Some(rig) = controller(&folder, Change::Message { kind: "CONFIGURE", action }) else { return };
    let arguments = ["acceptance", "run", "--plan", "plan.toml", "--out", "record", "--rig", &rig, "--yes"];
    folder
        .bench(arguments)
        .assert_message(2, &["the program of the controller is", "but the session was started with"]);
}
