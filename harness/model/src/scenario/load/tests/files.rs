use super::{BASE, create_folder, render};
use crate::scenario::definition::Scenario;
use crate::scenario::diagnostic::Diagnostic;
use crate::scenario::load::load;
use insta::assert_snapshot;
use std::fmt::Write;
use std::path::Path;

fn loaded_bytes(bytes: &[u8]) -> Result<Scenario, Diagnostic> {
    let folder = create_folder(&[]);
    let path = folder.path().join("s.toml");
    std::fs::write(&path, bytes).unwrap();
    load(&path, "s.toml").map_err(|mut fault| {
        fault.path = "s.toml".into();
        fault
    })
}

#[test]
fn reads_crlf_and_a_byte_order_mark() {
    assert!(loaded_bytes(BASE.replace('\n', "\r\n").as_bytes()).is_ok(), "CRLF");
    assert!(loaded_bytes(format!("\u{feff}{BASE}").as_bytes()).is_ok(), "BOM");
    let broken = BASE.replace("period_ms = 1.0", "period_ms = 0.0");
    for text in [broken.replace('\n', "\r\n"), format!("\u{feff}{broken}")] {
        assert_eq!(loaded_bytes(text.as_bytes()).unwrap_err().position(), (12, 13));
    }
}

#[test]
fn reports_files_that_are_not_scenarios() {
    let cases: [(&str, &[u8]); 8] = [
        ("Latin 1", b"title = \"\xe9\""),
        ("empty", b""),
        ("blank", b"\n\n"),
        ("an umlaut", "\u{e9}".as_bytes()),
        ("a string that does not end", "title = \"\u{e9}".as_bytes()),
        ("a table that does not end", "title = \"\u{e9}\"\n[controller".as_bytes()),
        ("a byte order mark and nothing", "\u{feff}".as_bytes()),
        ("binary", &[0, 1, 2, 0xff]),
    ];
    let mut table = String::new();
    for (name, bytes) in cases {
        let fault = loaded_bytes(bytes).unwrap_err();
        write!(table, "## {name}\n{fault}\n{}\n\n", render(&fault)).unwrap();
    }
    assert_snapshot!("no_scenario", table);
}

#[test]
fn names_missing_files() {
    let nowhere = load(Path::new("no/such.toml"), "such.toml").unwrap_err();
    assert!(nowhere.to_string().starts_with("no/such.toml: cannot be read: "), "{nowhere}");
    let folder = create_folder(&[]);
    let fault = load(folder.path(), "x").unwrap_err();
    assert!(fault.message.starts_with("cannot be read: "), "{fault}");
}

#[test]
fn points_into_a_plate_file_that_is_not_text() {
    let folder = create_folder(&[]);
    std::fs::write(folder.path().join("plates/plate.toml"), b"name = \"\xff\"\n").unwrap();
    let fault = load(&folder.path().join("s.toml"), "s.toml").unwrap_err();
    assert!(fault.path.ends_with("plates/plate.toml"));
    assert_eq!(fault.position(), (1, 9));
}
