//! Writes coverage in the tracefile format of LCOV: `geninfo(1)`, section FILES.

use crate::firmware_analysis::coverage::Coverage;
use std::fmt::{self, Write};

pub fn tracefile(coverage: &Coverage) -> String {
    let mut text = String::new();
    let _ = write_tracefile(&mut text, coverage);
    text
}

fn write_tracefile(text: &mut String, coverage: &Coverage) -> fmt::Result {
    for (path, file) in &coverage.files {
        writeln!(text, "TN:\nSF:{path}")?;
        for (name, function) in &file.functions {
            writeln!(text, "FN:{},{name}", function.line)?;
        }
        for (name, function) in &file.functions {
            writeln!(text, "FNDA:{},{name}", u8::from(function.executed))?;
        }
        let functions = file.function_ratio();
        writeln!(text, "FNF:{}\nFNH:{}", functions.total, functions.executed)?;
        for (line, state) in &file.lines {
            writeln!(text, "DA:{line},{}", u8::from(state.executed))?;
        }
        let lines = file.line_ratio();
        writeln!(text, "LF:{}\nLH:{}\nend_of_record", lines.total, lines.executed)?;
    }
    Ok(())
}
