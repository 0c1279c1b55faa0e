//! Writes `modelDescription.xml`.

use crate::variables::{INPUTS, OUTPUTS, TIME_REFERENCE, input_reference, output_reference};
use platebench_plate::Plate;
use std::f64::consts::TAU;
use std::fmt::Write as _;

pub(crate) const MODEL_IDENTIFIER: &str = "platebench_fmi";
/// The shared library rejects a description with another token.
pub(crate) const INSTANTIATION_TOKEN: &str = "platebench-plate-1";

/// Name of each unit, factor to its SI base units, and exponents of these base units.
const UNITS: [(&str, f64, &str); 6] = [
    ("V", 1.0, "kg=\"1\" m=\"2\" s=\"-3\" A=\"-1\""),
    ("Hz", 1.0, "s=\"-1\""),
    ("N", 1.0, "kg=\"1\" m=\"1\" s=\"-2\""),
    ("K", 1.0, "K=\"1\""),
    ("um", 1e-6, "m=\"1\""),
    ("um/s", 1e-6, "m=\"1\" s=\"-1\""),
];

pub(crate) fn model_description(plate: &Plate, title: &str) -> String {
    let mut units = String::new();
    for (name, factor, base) in UNITS {
        let _ = writeln!(units, "    <Unit name=\"{name}\"><BaseUnit {base} factor=\"{factor}\"/></Unit>");
    }
    let mut variables = format!(
        "    <Float64 name=\"time\" valueReference=\"{TIME_REFERENCE}\" causality=\"independent\" \
         variability=\"continuous\" description=\"time\"/>\n"
    );
    for (index, input) in INPUTS.iter().enumerate() {
        let start = if input.name == "frequency" { plate.omega0 / TAU } else { 0.0 };
        let _ = writeln!(
            variables,
            "    <Float64 name=\"{}\" valueReference=\"{}\" causality=\"input\" variability=\"discrete\" \
             start=\"{start}\" unit=\"{}\" description=\"{}\"/>",
            input.name,
            input_reference(index),
            input.unit,
            input.meaning
        );
    }
    let mut structure = String::new();
    for (index, output) in OUTPUTS.iter().enumerate() {
        let reference = output_reference(index);
        let _ = writeln!(
            variables,
            "    <Float64 name=\"{}\" valueReference=\"{reference}\" causality=\"output\" variability=\"continuous\" \
             initial=\"calculated\" unit=\"{}\" description=\"{}\"/>",
            output.name, output.unit, output.meaning
        );
        let _ = writeln!(structure, "    <Output valueReference=\"{reference}\"/>");
    }
    for index in 0..OUTPUTS.len() {
        let _ = writeln!(structure, "    <InitialUnknown valueReference=\"{}\"/>", output_reference(index));
    }
    format!(
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n\
         <fmiModelDescription fmiVersion=\"3.0\" modelName=\"plate\" description=\"{}\" \
         instantiationToken=\"{INSTANTIATION_TOKEN}\" generationTool=\"platebench {}\">\n\
         \x20 <CoSimulation modelIdentifier=\"{MODEL_IDENTIFIER}\" canHandleVariableCommunicationStepSize=\"true\" \
         canGetAndSetFMUState=\"true\"/>\n\
         \x20 <UnitDefinitions>\n{units}  </UnitDefinitions>\n\
         \x20 <DefaultExperiment startTime=\"0\" stopTime=\"0.06\" stepSize=\"0.001\"/>\n\
         \x20 <ModelVariables>\n{variables}  </ModelVariables>\n\
         \x20 <ModelStructure>\n{structure}  </ModelStructure>\n\
         </fmiModelDescription>\n",
        escape_attribute(title),
        env!("CARGO_PKG_VERSION")
    )
}

/// Omits control characters, because XML 1.0 forbids most of them.
fn escape_attribute(text: &str) -> String {
    let is_forbidden = |letter: char| letter.is_control() || "\u{fffe}\u{ffff}".contains(letter);
    text.replace(is_forbidden, "").replace('&', "&amp;").replace('<', "&lt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    #[test]
    fn escapes_the_title() {
        assert_eq!(super::escape_attribute("a < \"b\" & c\u{0}\n"), "a &lt; &quot;b&quot; &amp; c");
    }
}
