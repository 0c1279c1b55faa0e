//! A page to look at: `REPORT_FOLDER=some/folder cargo test -p platebench-report -- --ignored look`.

use crate::made;
use platebench_report::{Style, console, html, junit};
use std::path::PathBuf;

#[test]
#[ignore = "writes a page for people"]
fn look() {
    let folder =
        PathBuf::from(std::env::var_os("REPORT_FOLDER").expect("REPORT_FOLDER names the folder to write into"));
    let record = made::varied(&folder);
    record.write(&folder).unwrap();
    html::write(&record, &folder).unwrap();
    junit::write(&record, &folder.join(junit::FILE)).unwrap();
    console::print(&console::table(&record, Style { colour: true }), &mut std::io::stderr()).unwrap();
}
