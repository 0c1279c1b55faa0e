//! Tests `traceability.csv` and the same table in `report.html`.

use crate::fixtures;
use crate::page::write_page;
use crate::page_text::{page_text, section};
use platebench_report::traceability;

#[test]
fn every_requirement_has_a_verdict_and_a_trace() {
    let folder = tempfile::tempdir().unwrap();
    let mut record = fixtures::mixed_run();
    record.scenarios[1].expectations[1].requirement = Some("ACC-1".to_owned());
    record.scenarios[2].expectations[4].requirement = Some("A, \"quoted\"".to_owned());
    traceability::write(&record, folder.path()).unwrap();
    let text = std::fs::read_to_string(folder.path().join(traceability::FILE)).unwrap();
    let page = write_page(&record, folder.path());
    insta::assert_snapshot!(format!("{text}\n{}", page_text(section(&page, "requirements"))));
}

#[test]
fn without_requirements_there_is_only_a_header() {
    let folder = tempfile::tempdir().unwrap();
    let mut record = fixtures::mixed_run();
    for expectation in record.scenarios.iter_mut().flat_map(|scenario| &mut scenario.expectations) {
        expectation.requirement = None;
    }
    assert_eq!(
        traceability::requirement_document(&record).to_csv(),
        "requirement,expectation,limit,scenario,verdict,value,unit,interval_low,interval_high,trace\n"
    );
    assert!(!write_page(&record, folder.path()).contains("id=\"requirements\""));
}
