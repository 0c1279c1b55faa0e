//! Tests decision rules, uncertainty budgets and calibration dates of a session.

use super::{plan_text, read_session_record, run_session, session_folder, verify};
use crate::test_folder::{TestFolder, run_bench, workspace_root};
use platebench_lab::acceptance::SessionRecord;
use platebench_model::record::Verdict;
use rstest::rstest;

/// Returns a budget for the settling time. The plate settles in 2 to 3 ms, and the limit is 4 ms.
fn budget_text(half_width: f64, due: &str) -> String {
    format!(
        "title = \"Lab\"\n[[instrument]]\nname = \"laser\"\nserial = \"L-1\"\ncalibrated = \"2020-01-01\"\n\
         due = \"{due}\"\n[[budget]]\nquantity = \"settling_time_ms\"\n[[budget.component]]\nkind = \"timing\"\n\
         distribution = \"rectangular\"\nhalf_width = {half_width:?}\ninstrument = \"laser\"\nsource = \"sheet\"\n\
         date = \"2020-01-01\"\n[[budget.component]]\nkind = \"repeatability\"\ndistribution = \"normal\"\n\
         source = \"trials\"\ndate = \"2020-01-01\"\n"
    )
}

fn folder_with(decision: &str, half_width: f64, due: &str) -> TestFolder {
    let folder = session_folder();
    folder.write("plan.toml", &format!("{}[decision]\nbudget = \"lab.toml\"\n{decision}\n", plan_text(&["s.toml"], 3)));
    folder.write("lab.toml", &budget_text(half_width, due));
    folder
}

#[rstest]
#[case::guarded("rule = \"guarded\"", 0.1, 0, "accepted")]
#[case::guard_band("rule = \"guarded\"", 2.5, 3, "within the guard band")]
#[case::simple("rule = \"simple\"", 2.5, 0, "accepted")]
#[case::shared("rule = \"shared-risk\"\nlargest_uncertainty_percent = 20.0", 0.1, 0, "accepted")]
#[case::shared_wide("rule = \"shared-risk\"\nlargest_uncertainty_percent = 20.0", 2.5, 3, "% of the tolerance")]
fn a_rule_decides_with_the_uncertainty(
    #[case] decision: &str,
    #[case] half_width: f64,
    #[case] exit: i32,
    #[case] expected: &str,
) {
    let folder = folder_with(decision, half_width, "2999-12-31");
    run_session(&folder, &["--yes"]).assert_exit(exit);
    let record = read_session_record(&folder);
    let evidence = &record.requirements[0].evidence[0];
    let stated = evidence.uncertainty.as_ref().unwrap();
    let timing = stated.combined.contributions[0].standard;
    assert!((timing - half_width / 3.0_f64.sqrt()).abs() < 1e-12, "{stated:?}");
    assert!(stated.combined.expanded > 1.9 * timing && stated.interval[0] < stated.value, "{stated:?}");
    let text = format!("{} {}", evidence.reason.clone().unwrap_or_default(), serde_json::to_string(stated).unwrap());
    assert!(text.contains(expected), "{text}");
    let page = folder.read("record/record.html");
    assert!(page.contains("Decision rule and instruments") && page.contains("L-1") && page.contains("2999-12-31"));
    verify(&folder, "record", &[]).assert_exit(0);
    // The record stores the SHA-256 of its budget, so another budget contradicts it.
    folder.write("record/budget.toml", &budget_text(half_width / 2.0, "2999-12-31"));
    verify(&folder, "record", &[]).assert_text(1, &["decision rule or budget differs from plan.toml and budget.toml"]);
}

#[test]
fn an_expired_calibration_stops_the_session_unless_waived_by_name() {
    let folder = folder_with("rule = \"guarded\"", 0.1, "2021-01-01");
    run_session(&folder, &["--yes"])
        .assert_text(2, &["laser (L-1): its calibration is valid from 2020-01-01 to 2021-01-01"]);
    assert!(!folder.exists("record"));
    run_session(&folder, &["--yes", "--waive-calibration", "lamp"]).assert_text(2, &["no instrument"]);
    run_session(&folder, &["--yes", "--waive-calibration", "laser"]).assert_exit(0);
    let record: SessionRecord = read_session_record(&folder);
    let decision = record.decision.unwrap();
    assert!(decision.instruments[0].waived && record.verdict == Verdict::Pass, "{decision:?}");
    assert!(folder.read("record/record.html").contains("not valid; waived by the operator"));
}

/// Plays the example that docs/acceptance.md computes.
#[test]
fn the_example_of_the_documentation_passes() {
    let folder = tempfile::tempdir().unwrap();
    let plan = workspace_root().join("docs/examples/guarded-plan.toml");
    let waived = ["--waive-calibration", "vibrometer", "--waive-calibration", "thermometer"];
    let arguments =
        ["acceptance", "run", "--plan", plan.to_str().unwrap(), "--rig", "hosted", "--yes", "--out", "record"];
    run_bench(folder.path(), arguments.iter().chain(&waived)).assert_exit(0);
    let record = SessionRecord::read(&folder.path().join("record")).unwrap();
    let stated = record.requirements[0].evidence[0].uncertainty.clone().unwrap();
    assert_eq!(stated.combined.contributions.len(), 4);
    assert!((stated.combined.expanded - 0.017_3).abs() < 0.001, "{stated:?}");
}
