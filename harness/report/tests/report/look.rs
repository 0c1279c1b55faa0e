//! A page to look at: `REPORT_FOLDER=some/folder cargo test -p platebench-report -- --ignored look`.

use crate::made::{self, Response};
use platebench_report::{Style, console, html, junit};
use platebench_verdict::{Cause, ExpectationRecord, RunRecord};
use serde_json::json;
use std::path::PathBuf;

#[test]
#[ignore = "writes a page for people"]
fn look() {
    let folder =
        PathBuf::from(std::env::var_os("REPORT_FOLDER").expect("REPORT_FOLDER names the folder to write into"));
    let settling = |value: f64, paper: f64| ExpectationRecord {
        paper: Some(paper),
        requirement: Some("ACC-1".to_owned()),
        ..made::passed("settling_time_ms", ("at_most", json!(2.0)), value)
    };
    let mut closed = made::scenario(
        "paper/fig13-closed-loop.toml",
        "Step of 2 µm at resonance, closed loop",
        "dq-pi",
        vec![
            settling(1.991, 2.0),
            ExpectationRecord {
                statistic: "deviation".to_owned(),
                interval: Some([0.58, 0.88]),
                confidence: Some(0.95),
                paper: Some(1.3),
                ..made::passed("repeatability_percent", ("at_most", json!(1.3)), 0.7)
            },
            made::passed("quadrature_ratio", ("at_most", json!(0.01)), 0.000_012_3),
        ],
    );
    made::play(&mut closed, &folder, 30, Response::default(), 0.01);
    let mut open =
        made::scenario("paper/fig13-open-loop.toml", "Step of 2 µm at resonance, open loop", "open-loop", vec![]);
    made::play(&mut open, &folder, 30, Response { time_constant_ms: 1.88, ..Response::default() }, 0.02);
    let times = open.trials.iter().map(|trial| trial.metrics["settling_time_ms"].as_f64().unwrap());
    let worst = times.fold(0.0, f64::max);
    open.expectations = vec![made::failed(settling(worst, 5.0), &format!("trial 2: {worst:.4}, expected ≤ 2"))];
    open.verdict = platebench_verdict::Verdict::Fail;
    let mut finger = made::scenario(
        "limits/fig16-400-vpp.toml",
        "Tuned for 33 °C, plate at 24 °C, 2 N finger, amplifier of 400 Vpp",
        "dq-pi",
        vec![
            made::doubtful(
                settling(3.37, 2.0),
                Cause::Infeasible,
                "saturated: holding the setpoint needs 668 Vpp, the amplifier gives 400 Vpp",
            ),
            made::passed("frequency_error_hz", ("at_most", json!(5.0)), 0.3),
        ],
    );
    let weak = Response {
        force_n: 2.0,
        temperature_k: 4.0,
        detuned_hz: -86.7,
        gain: 0.98,
        drive_limit_vpp: 400.0,
        ..Response::default()
    };
    made::play(&mut finger, &folder, 5, weak, 0.004);
    let record: RunRecord = made::run(vec![closed, open, finger]);
    record.write(&folder).unwrap();
    html::write(&record, &folder).unwrap();
    junit::write(&record, &folder.join(junit::FILE)).unwrap();
    console::print(&console::table(&record, Style { colour: true }), &mut std::io::stderr()).unwrap();
}
