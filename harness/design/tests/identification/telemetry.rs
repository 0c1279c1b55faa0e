//! Checks the units of CSV tables from other programs, and their errors with line and column.

use platebench_model::external_csv;
use platebench_model::external_csv::ColumnMapping;
use rstest::rstest;
use std::f64::consts::TAU;

const HEADER: &str = "t,V,f,Wd,Wq,T";
const COLUMNS: &str = "time=t:ms,drive=V:Vpp,frequency=f:kHz,wd=Wd:nm,wq=Wq:nm,temperature=T:K";

fn step_table() -> Vec<String> {
    let row = |k: u32| {
        let (vpp, wd) = if k < 2 { (0.0, 0.0) } else { (300.0, 2094.0 * (1.0 - (-f64::from(k - 2) / 1.88).exp())) };
        format!("{k},{vpp},32.3076,{wd:.3},0.5,1.5")
    };
    std::iter::once(HEADER.to_owned()).chain((0..30).map(row)).collect()
}

fn read_error(lines: &[String]) -> String {
    external_csv::read("plate.csv", lines.join("\n").as_bytes(), &COLUMNS.parse().unwrap()).unwrap_err().to_string()
}

#[test]
fn units_are_converted() {
    let (recording, dialect) =
        external_csv::read("plate.csv", step_table().join("\n").as_bytes(), &COLUMNS.parse().unwrap()).unwrap();
    assert!(dialect.is_plain(), "{dialect}");
    assert_eq!((recording.outputs.len(), recording.inputs.len()), (30, 2), "inputs that change nothing are dropped");
    let step = recording.inputs[1];
    assert!((step.t - 2e-3).abs() < 1e-15 && step.vpp == 300.0 && (step.omega - TAU * 32_307.6).abs() < 1e-6);
    assert_eq!(step.conditions.temperature_offset_k, 1.5);
    assert!((recording.outputs[29].w.re - 2.094).abs() < 1e-3 && (recording.outputs[29].w.im - 5e-4).abs() < 1e-12);
    let fit = platebench_design::identify::fit_direct(&recording).unwrap();
    assert!(
        (fit.gain.value - 0.006_98).abs() < 1e-5 && (fit.time_constants[0].1.value - 1.88e-3).abs() < 1e-5,
        "{fit:?}"
    );
}

#[rstest]
#[case(5, "x,300,32.3,1,0,0", ":6: column 1 (`t`) is `x`, expected a finite number")]
#[case(5, "4,300,32.3,NaN,0,0", ":6: column 4 (`Wd`) is `NaN`, expected a finite number")]
#[case(
    5,
    "4,-6.1,32.3,1,0,0",
    ":6: column 2 (`V`) is `-6.1`, expected 0 or more, or noise of at most 2 % of the highest drive, which counts as 0"
)]
#[case(5, "4,300,0,1,0,0", ":6: column 3 (`f`) is `0`, expected a frequency above 0")]
#[case(5, "3,300,32.3,1,0,0", ":6: column 1 (`t`) is `3`, expected a time after that of the row above")]
#[case(0, "t,V,f,Wd,Wq,T,V", ":1: columns 2 and 7 both have the title `V`; expected V#1 or V#2")]
#[case(0, "t,V,f,Wd,W_q,T", ":1: no column `Wq` in: t, V, f, Wd, W_q, T; --columns names the columns")]
fn rejects_a_bad_cell_with_its_line(#[case] line: usize, #[case] text: &str, #[case] message: &str) {
    let mut lines = step_table();
    text.clone_into(&mut lines[line]);
    assert_eq!(read_error(&lines), format!("plate.csv{message}"));
}

#[test]
fn a_repeated_title_without_a_role_is_accepted() {
    let table = step_table().join("\n").replacen("t,V,f,Wd,Wq,T", "t,V,f,Wd,Wq,T,x,x", 1).replace(",1.5", ",1.5,0,1");
    external_csv::read("plate.csv", table.as_bytes(), &COLUMNS.parse().unwrap()).unwrap();
}

/// Channels in V without a column of the frequency, as an oscilloscope writes them.
#[test]
fn scaled_columns_and_constants_give_the_same_recording() {
    let table = step_table();
    let read =
        |text: &str, columns: &str| external_csv::read("", text.as_bytes(), &columns.parse().unwrap()).unwrap().0;
    let plain = read(&table.join("\n"), COLUMNS);
    // 0.1 V per 100 Vpp, 1 V per 0.5 µm, with noise of 2 % of the highest drive.
    let lines = table.iter().enumerate().map(|(number, line)| {
        let cells: Vec<&str> = line.split(',').collect();
        let volts = |place: usize, per_volt: f64| cells[place].parse::<f64>().unwrap() / per_volt;
        match number {
            0 => "t,CH1,CH2,CH3\n,V,V,V".to_owned(),
            1 => format!("{},-0.006,{},{}", cells[0], volts(3, 500.0), volts(4, 500.0)),
            _ => format!("{},{},{},{}", cells[0], volts(1, 1e3), volts(3, 500.0), volts(4, 500.0)),
        }
    });
    let scope = "time=t:ms,drive=CH1:1000*Vpp,frequency==32.3076:kHz,wd=CH2:0.5*um,wq=CH3:0.5*um,temperature==1.5:K";
    let scaled = read(&lines.collect::<Vec<_>>().join("\n"), scope);
    assert_eq!(plain.inputs.len(), scaled.inputs.len());
    for (one, other) in plain.inputs.iter().zip(&scaled.inputs) {
        assert!((one.vpp - other.vpp).abs() < 1e-9 && (one.omega - other.omega).abs() < 1e-6, "{one:?} {other:?}");
        assert_eq!(one.conditions, other.conditions);
    }
    assert!(plain.outputs.iter().zip(&scaled.outputs).all(|(one, other)| (one.w - other.w).norm() < 1e-12));
}

#[test]
fn a_minus_sign_before_the_unit_reverses_a_component() {
    let table = step_table().join("\n");
    let read = |columns: &str| external_csv::read("", table.as_bytes(), &columns.parse().unwrap()).unwrap().0.outputs;
    let (plain, reversed) = (read(COLUMNS), read(&COLUMNS.replace("Wq:nm", "Wq:-nm")));
    assert!(plain.iter().zip(&reversed).all(|(a, b)| a.w.re == b.w.re && a.w.im == -b.w.im && a.w.im != 0.0));
}

#[test]
fn rejects_an_unusable_recording() {
    let lines = step_table();
    assert!(read_error(&lines[..8]).contains("7 samples at control instants, expected at least 8"));
    external_csv::read("", lines[..9].join("\n").as_bytes(), &COLUMNS.parse().unwrap()).unwrap();
    let resting: Vec<String> = lines.iter().map(|line| line.replace(",300,", ",0,")).collect();
    assert!(read_error(&resting).contains("the drive is 0 V in the whole recording"));
    let mut short = lines.clone();
    "4,300".clone_into(&mut short[5]);
    assert!(read_error(&short).starts_with("plate.csv:6: "), "{}", read_error(&short));
}

#[rstest]
#[case("time=t:s,drive=V:V,frequency=f:Hz,wd=Wd:um", "no column for the role wq, expected wq=COLUMN:UNIT")]
#[case("time=t:s,drive=V:V,frequency=f:Hz,wd=Wd:um,wq=Wq:um,speed=v", "`speed`, expected a role of time, drive")]
#[case(
    "time=t:min,drive=V:V,frequency=f:Hz,wd=Wd:um,wq=Wq:um",
    "unit `min` of time, expected s or ms or us or datetime"
)]
#[case("time=t:ms,drive=V", "`drive=V` names the column `V` without its unit, expected drive=V:UNIT with Vpp or V")]
#[case("time=t:ms,drive=:V", "`drive=:V` names no column, expected drive=COLUMN:V")]
#[case("time=t:s,time=u:s,drive=V:V,frequency=f:Hz,wd=Wd:um,wq=Wq:um", "two columns for the role time")]
#[case("time=t:s,drive=V:V,frequency=f:Hz,wd=W:um,wq=W:um", "the column `W` has two roles, expected one")]
#[case("time=t:-s", "unit `-s` of time, expected s or ms or us")]
#[case("time==5:s", "`time==5:s` is a constant time, expected a column")]
#[case("frequency==0:Hz", "`frequency==0:Hz`, expected a frequency above 0")]
#[case("drive==-1:Vpp", "`drive==-1:Vpp`, expected 0 or more")]
#[case("frequency==x:Hz", "`frequency==x:Hz`, expected frequency==NUMBER:UNIT")]
#[case("wd=CH2:0*um", "`0` in wd=CH2:0*um, expected a number above 0")]
#[case("wd=CH2:a*um", "`a` in wd=CH2:a*um, expected a number above 0")]
#[case("wd=CH2:2*V", "unit `V` of wd, expected um or nm")]
#[case("t,V", "`t`, expected ROLE=COLUMN:UNIT")]
fn rejects_invalid_column_mappings(#[case] text: &str, #[case] message: &str) {
    let error = text.parse::<ColumnMapping>().unwrap_err();
    assert!(error.starts_with(message), "{error}");
}
