//! `traceability.csv` and the same table in the report.

use crate::made;
use platebench_report::{html, traceability};

#[test]
fn every_requirement_leads_to_a_verdict_and_a_trace() {
    let folder = tempfile::tempdir().unwrap();
    let mut record = made::mixed();
    record.scenarios[1].expectations[1].requirement = Some("ACC-1".to_owned());
    record.scenarios[2].expectations[4].requirement = Some("A, \"quoted\"".to_owned());
    traceability::write(&record, folder.path()).unwrap();
    let text = std::fs::read_to_string(folder.path().join(traceability::FILE)).unwrap();
    insta::assert_snapshot!(text);
    html::write(&record, folder.path()).unwrap();
    let page = std::fs::read_to_string(folder.path().join(html::FILE)).unwrap();
    let table = page.split("id=\"requirements\"").nth(1).unwrap().split("</section>").next().unwrap();
    assert_eq!(table.matches("<tr>").count(), 1 + 4);
    assert!(table.contains("4 of 10 expectations hold a requirement"), "{table}");
    assert!(table.contains("A, &quot;quoted&quot;") && table.contains("href=\"#scenario-1\""));
}

#[test]
fn without_requirements_there_is_a_table_with_a_head_and_no_section() {
    let folder = tempfile::tempdir().unwrap();
    let mut record = made::mixed();
    for expectation in record.scenarios.iter_mut().flat_map(|scenario| &mut scenario.expectations) {
        expectation.requirement = None;
    }
    traceability::write(&record, folder.path()).unwrap();
    let text = std::fs::read_to_string(folder.path().join(traceability::FILE)).unwrap();
    assert_eq!(text, "requirement,expectation,limit,scenario,verdict,value,trace\n");
    html::write(&record, folder.path()).unwrap();
    assert!(!std::fs::read_to_string(folder.path().join(html::FILE)).unwrap().contains("id=\"requirements\""));
}
