//! Reads tables in the forms that instruments and spreadsheets write.

use platebench_model::external_csv::{self, Dialect, TelemetryTable, propose_columns};
use rstest::rstest;
use std::fmt::Write;

const COLUMNS: &str = "time=Time:s,drive=Drive:Vpp,frequency=Freq:Hz,wd=Wd:um,wq=Wq:um";
const TITLES: &str = "Time,Drive,Freq,Wd,Wq";

/// Rows at 1 kHz: 286.5 Vpp from 2 ms on.
fn numbers() -> Vec<[f64; 5]> {
    (0..12_i32)
        .map(|k| [f64::from(k) * 1e-3, if k < 2 { 0.0 } else { 286.5 }, 32_307.6, 0.25 * f64::from(k), -0.5])
        .collect()
}

fn rows(numbers: &[[f64; 5]], separator: &str, decimal: &str) -> String {
    numbers.iter().fold(String::new(), |mut text, row| {
        let cells = row.map(|number| number.to_string().replace('.', decimal));
        writeln!(text, "{}", cells.join(separator)).unwrap();
        text
    })
}

fn read(table: impl AsRef<[u8]>, columns: &str) -> Result<TelemetryTable, String> {
    external_csv::read_rows("scope.csv", table.as_ref(), &columns.parse().unwrap()).map_err(|error| error.to_string())
}

#[track_caller]
fn assert_numbers(table: &TelemetryTable) {
    let found: Vec<_> = table.rows.iter().map(|row| (row.t, row.vpp, row.w.re, row.w.im)).collect();
    let expected: Vec<_> = numbers().iter().map(|[t, vpp, _, wd, wq]| (*t, *vpp, *wd, *wq)).collect();
    assert_eq!(found, expected);
}

#[rstest]
// An oscilloscope that writes its settings before the titles.
#[case::settings(
    "Model,DSO-1\nFirmware,1.2\nSample Interval,1.0E-03\n\n",
    TITLES,
    ",",
    ".",
    "",
    "4 lines before the titles, commas between the columns"
)]
// A recorder with a row of units and an empty line below the titles.
#[case::units(
    "",
    TITLES,
    ",",
    ".",
    "(s),(Vpp),(Hz),(µm),(um)\n\n",
    "0 lines before the titles, commas between the columns, a row of units"
)]
#[case::long_units(
    "",
    TITLES,
    ",",
    ".",
    "second,Volt,Hertz,,\n",
    "0 lines before the titles, commas between the columns, a row of units"
)]
#[case::spreadsheet(
    "sep=;\n",
    "Time;Drive;Freq;Wd;Wq",
    ";",
    ",",
    "",
    "1 lines before the titles, semicolons between the columns, decimal commas"
)]
#[case::tabs("", "Time\tDrive\tFreq\tWd\tWq", "\t", ".", "", "0 lines before the titles, tabs between the columns")]
#[case::numeric_library(
    "# recorded by hand\n",
    "# Time,Drive,Freq,Wd,Wq",
    ",",
    ".",
    "# end of the header\n",
    "1 lines before the titles, commas between the columns"
)]
#[case::quoted(
    "\"A plate; 24,5 °C\"\n",
    "\"Time\",\"Drive\",\"Freq\",\"Wd\",\"Wq\"",
    ",",
    ".",
    "",
    "1 lines before the titles, commas between the columns"
)]
fn finds_the_titles(
    #[case] before: &str,
    #[case] titles: &str,
    #[case] separator: &str,
    #[case] decimal: &str,
    #[case] below: &str,
    #[case] dialect: &str,
) {
    for line_end in ["\n", "\r\n"] {
        let text = format!("{before}{titles}\n{below}{}", rows(&numbers(), separator, decimal));
        let table = read(text.replace('\n', line_end), COLUMNS).unwrap();
        assert_numbers(&table);
        assert_eq!(table.dialect.to_string(), dialect);
    }
}

#[test]
fn a_file_in_iso_8859_1_has_its_degree_sign() {
    let mut bytes = b"Temp in \xb0C,24\n".to_vec();
    bytes.extend(format!("{TITLES}\n{}", rows(&numbers(), ",", ".")).into_bytes());
    let table = read(bytes, COLUMNS).unwrap();
    assert_numbers(&table);
    assert!(table.dialect.is_latin && table.dialect.lines_before_titles == 1);
    let message = read(b"\xff\xfeT\0", COLUMNS).unwrap_err();
    assert!(message.starts_with("scope.csv:1: UTF-16, expected UTF-8"), "{message}");
}

#[rstest]
#[case("drive=Drive:Vrms", 2.0 * 2.0_f64.sqrt() * 286.5)]
#[case("drive=Drive:mV", 2e-3 * 286.5)]
#[case("drive=Drive:mVpp", 0.2865)]
fn the_unit_of_the_drive_says_what_it_is(#[case] drive: &str, #[case] vpp: f64) {
    let table = read(format!("{TITLES}\n{}", rows(&numbers(), ",", ".")), &COLUMNS.replace("drive=Drive:Vpp", drive));
    assert!((table.unwrap().rows[5].vpp - vpp).abs() < 1e-12 * vpp);
}

#[test]
fn amplitude_and_phase_of_a_lock_in_give_w() {
    let table = format!("{TITLES}\n{}", rows(&numbers(), ",", ".")).replace("-0.5", "90");
    let columns = COLUMNS.replace("wd=Wd:um,wq=Wq:um", "amplitude=Wd:um_pk,phase=Wq:-deg");
    let w = read(table, &columns).unwrap().rows[4].w;
    assert!(w.re.abs() < 1e-15 && (w.im + 2.0).abs() < 1e-15, "{w}");
}

#[test]
fn a_temperature_in_celsius_needs_its_reference() {
    let table = format!("{TITLES},Temp\n{}", rows(&numbers(), ",", ".").replace('\n', ",33\n"));
    let columns = format!("{COLUMNS},temperature=Temp:°C-24");
    assert_eq!(read(table, &columns).unwrap().rows[0].conditions.temperature_offset_k, 9.0);
    let error = columns.replace("°C-24", "degC").parse::<external_csv::ColumnMapping>().unwrap_err();
    assert!(error.contains("unit `degC` of temperature, expected K or degC-REFERENCE"), "{error}");
}

#[rstest]
#[case::utc("2026-11-28T12:00:00.000Z", "2026-11-28T12:00:00.001Z")]
#[case::with_a_space("2026-11-28 23:59:59.9995", "2026-11-29 00:00:00.0005")]
fn instants_count_from_the_first_row(#[case] first: &str, #[case] second: &str) {
    let columns = COLUMNS.replace("Time:s", "Time:datetime");
    let table = read(format!("{TITLES}\n{first},0,1,0,0\n{second},0,1,0,0\n"), &columns).unwrap();
    assert_eq!((table.rows[0].t, table.rows[1].t), (0.0, 1e-3));
    let message = read(format!("{TITLES}\n12 o'clock,0,1,0,0\n"), &columns).unwrap_err();
    assert!(message.ends_with("is `12 o'clock`, expected a date and a time, ISO 8601"), "{message}");
}

#[test]
fn a_repeated_title_is_named_by_its_number() {
    let table = format!("{}\n{}", TITLES.replace("Wq", "Wd"), rows(&numbers(), ",", "."));
    assert_numbers(&read(&table, &COLUMNS.replace("wd=Wd:um,wq=Wq:um", "wd=Wd#1:um,wq=Wd#2:um")).unwrap());
    let message = read(&table, &COLUMNS.replace("wd=Wd:um,wq=Wq:um", "wd=Wd#1:um,wq=Wd#3:um")).unwrap_err();
    assert!(message.starts_with("scope.csv:1: no column `Wd#3` in: Time, "), "{message}");
}

#[rstest]
#[case::other_unit(
    "s,mVpp,Hz,um,um\n0,1,1,0,0\n",
    ",",
    "2: the column `Drive` has the unit `mVpp`, but --columns names `Vpp`"
)]
#[case::both_marks("0;1,5;1;0;0\n0.001;1;1;0;0\n", ";", "3: `0.001`: the table has decimal commas and decimal points")]
#[case::commas_in_both("0,0,5,1,0,0,0,0\n", ",", "2: 8 columns, expected 5 as in the titles")]
fn rejects_what_is_ambiguous(#[case] data: &str, #[case] separator: &str, #[case] message: &str) {
    let found = read(format!("{}\n{data}", TITLES.replace(',', separator)), COLUMNS).unwrap_err();
    assert!(found.starts_with(&format!("scope.csv:{message}")), "{found}");
}

#[rstest]
#[case::units_in_titles(
    "Time (ms),Drive [Vpp],Frequency (kHz),Wd (nm_pk),Wq (nm_pk),Temp (K)\n0,0,32,0,0,1\n",
    Some(
        "time=Time (ms):ms,drive=Drive [Vpp]:Vpp,frequency=Frequency (kHz):kHz,wd=Wd (nm_pk):nm_pk,wq=Wq (nm_pk):nm_pk,\
          temperature=Temp (K):K"
    )
)]
#[case::units_below(
    "Owner;me\nt;V;f;X;Y\ns;V;Hz;µm;µm\n0;0;32;0,5;0\n",
    Some("time=t:s,drive=V:UNIT,frequency=f:Hz,wd=X:UNIT,wq=Y:UNIT")
)]
#[case::no_table("a letter\nwithout numbers\n", None)]
#[case::no_drive("t,a,b,c\n1,2,3,4\n", None)]
fn columns_are_proposed_from_titles_and_units(#[case] text: &str, #[case] expected: Option<&str>) {
    assert_eq!(propose_columns(text.as_bytes()).as_deref(), expected);
}

#[test]
fn a_plain_table_needs_no_note() {
    let table = read(format!("{TITLES}\n{}", rows(&numbers(), ",", ".")), COLUMNS).unwrap();
    assert!(table.dialect.is_plain());
    let other = Dialect { lines_before_titles: 1, ..table.dialect };
    assert!(!other.is_plain());
}
