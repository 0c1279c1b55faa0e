//! Tables of other origin: what is read, in which units, and what is refused with line and column.

#![allow(clippy::unwrap_used, reason = "a helper that cannot set up its case has failed the case")]

use platebench_identify::{Columns, telemetry};
use rstest::rstest;
use std::f64::consts::TAU;

const HEADER: &str = "t,V,f,Wd,Wq,T";
const COLUMNS: &str = "time=t:ms,drive=V,frequency=f:kHz,wd=Wd:nm,wq=Wq:nm,temperature=T";

/// A step of 300 Vpp at 2 ms, sampled at 1 kHz.
fn table() -> Vec<String> {
    let row = |k: u32| {
        let (vpp, wd) = if k < 2 { (0.0, 0.0) } else { (300.0, 2094.0 * (1.0 - (-f64::from(k - 2) / 1.88).exp())) };
        format!("{k},{vpp},32.3076,{wd:.3},0.5,1.5")
    };
    std::iter::once(HEADER.to_owned()).chain((0..30).map(row)).collect()
}

fn refused(lines: &[String]) -> String {
    telemetry::read("plate.csv", lines.join("\n").as_bytes(), &COLUMNS.parse().unwrap()).unwrap_err().to_string()
}

#[test]
fn units_become_those_of_the_plate() {
    let recording = telemetry::read("plate.csv", table().join("\n").as_bytes(), &COLUMNS.parse().unwrap()).unwrap();
    assert_eq!((recording.outputs.len(), recording.inputs.len()), (30, 2), "inputs that change nothing are dropped");
    let step = recording.inputs[1];
    assert!((step.t - 2e-3).abs() < 1e-15 && step.vpp == 300.0 && (step.omega - TAU * 32_307.6).abs() < 1e-6);
    assert_eq!(step.conditions.temperature_offset_k, 1.5);
    assert!((recording.outputs[29].w.re - 2.094).abs() < 1e-3 && (recording.outputs[29].w.im - 5e-4).abs() < 1e-12);
    let fit = platebench_identify::direct(&recording).unwrap();
    assert!(
        (fit.gain.value - 0.006_98).abs() < 1e-5 && (fit.time_constants[0].1.value - 1.88e-3).abs() < 1e-5,
        "{fit:?}"
    );
}

#[rstest]
#[case(5, "x,300,32.3,1,0,0", ":6: column 1 (`t`) is `x`, expected a finite number")]
#[case(5, "4,300,32.3,NaN,0,0", ":6: column 4 (`Wd`) is `NaN`, expected a finite number")]
#[case(5, "4,-1,32.3,1,0,0", ":6: column 2 (`V`) is `-1`, expected 0 or more")]
#[case(5, "4,300,0,1,0,0", ":6: column 3 (`f`) is `0`, expected a frequency above 0")]
#[case(5, "3,300,32.3,1,0,0", ":6: column 1 (`t`) is `3`, expected a time after that of the row above")]
#[case(0, "t,V,f,Wd,W_q,T", ":1: no column `Wq` in: t, V, f, Wd, W_q, T")]
fn a_bad_cell_is_named(#[case] line: usize, #[case] text: &str, #[case] message: &str) {
    let mut lines = table();
    text.clone_into(&mut lines[line]);
    assert_eq!(refused(&lines), format!("plate.csv{message}"));
}

#[test]
fn what_is_no_recording_is_refused() {
    let lines = table();
    assert!(refused(&lines[..8]).contains("7 samples at control instants, expected at least 8"));
    telemetry::read("", lines[..9].join("\n").as_bytes(), &COLUMNS.parse().unwrap()).unwrap();
    let resting: Vec<String> = lines.iter().map(|line| line.replace(",300,", ",0,")).collect();
    assert!(refused(&resting).contains("the drive is 0 V throughout"));
    let mut short = lines.clone();
    "4,300".clone_into(&mut short[5]);
    assert!(refused(&short).starts_with("plate.csv:6: "), "{}", refused(&short));
}

#[rstest]
#[case("time=t,drive=V,frequency=f,wd=Wd", "no column for wq")]
#[case("time=t,drive=V,frequency=f,wd=Wd,wq=Wq,speed=v", "`speed`, expected a role of time, drive")]
#[case("time=t:min,drive=V,frequency=f,wd=Wd,wq=Wq", "unit `min` of time, expected s, ms, us")]
#[case("time=t,time=u,drive=V,frequency=f,wd=Wd,wq=Wq", "time is given twice")]
#[case("t,V", "`t`, expected ROLE=NAME")]
fn columns_that_cannot_be_meant_are_refused(#[case] text: &str, #[case] message: &str) {
    let error = text.parse::<Columns>().unwrap_err();
    assert!(error.starts_with(message), "{error}");
}
