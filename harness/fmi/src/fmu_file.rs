//! Writes the FMU, a ZIP archive: description (`modelDescription.xml`), plate file and shared
//! library.

use crate::instance::PLATE_FILE;
use crate::instance::{INPUTS, OUTPUTS, TIME_REFERENCE, input_reference, output_reference};
use platebench_model::trace::{AtPath as _, FileError, MAX_IMAGE_BYTES, OutputFile, read_regular_file};
use platebench_plate::Plate;
use std::borrow::Cow;
use std::f64::consts::TAU;
use std::fmt::Write as _;
use std::io::Write;
use std::path::{Path, PathBuf};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

const LIBRARY_FILE: &str = "libplatebench_fmi.so";

#[derive(Debug, thiserror::Error)]
pub enum FmuError {
    #[error(
        "no {LIBRARY_FILE} next to {}: an FMU contains the plate as a shared library, which a build for musl does not \
         make; build it with `cargo build --release --ignore-rust-version --package platebench-fmi` and name it with \
         --library",
        program.display()
    )]
    NoLibrary { program: PathBuf },
    #[error(transparent)]
    File(#[from] FileError),
    #[error("{} is not a shared library of Linux (ELF)", .0.display())]
    NotALibrary(PathBuf),
    #[error("an FMU needs a computer with x86_64 or aarch64, this one has {0}")]
    Architecture(&'static str),
    #[error("{} exists already, expected another name", .0.display())]
    FileExists(PathBuf),
    #[error("{}: {source}", path.display())]
    Archive { path: PathBuf, source: zip::result::ZipError },
}

/// Returns the shared library: the file `named`, else `embedded` if the build contains it, else
/// that of the folder of `program`, of its `deps` (Cargo) or of `../lib/platebench` (installed).
pub fn find_library<'a>(named: Option<&Path>, embedded: &'a [u8], program: &Path) -> Result<Cow<'a, [u8]>, FmuError> {
    if named.is_none() && !embedded.is_empty() {
        return Ok(Cow::Borrowed(embedded));
    }
    let folder = program.parent().unwrap_or(Path::new("."));
    let folders = [folder.to_owned(), folder.join("deps"), folder.join("../lib/platebench")];
    let mut files = folders.into_iter().map(|folder| folder.join(LIBRARY_FILE));
    let file = named.map(Path::to_owned).or_else(|| files.find(|file| file.is_file()));
    let file = file.ok_or_else(|| FmuError::NoLibrary { program: program.to_owned() })?;
    let content = read_regular_file(&file, MAX_IMAGE_BYTES).at(&file)?;
    if content.starts_with(b"\x7fELF") { Ok(Cow::Owned(content)) } else { Err(FmuError::NotALibrary(file)) }
}

const fn platform() -> Option<&'static str> {
    if cfg!(target_arch = "x86_64") {
        Some("x86_64-linux")
    } else if cfg!(target_arch = "aarch64") {
        Some("aarch64-linux")
    } else {
        None
    }
}

/// `plate_text` is the content of the plate file. Fails if `out` exists.
pub fn write(plate: &Plate, plate_text: &str, title: &str, library: &[u8], out: &Path) -> Result<(), FmuError> {
    let platform = platform().ok_or(FmuError::Architecture(std::env::consts::ARCH))?;
    if out.exists() {
        return Err(FmuError::FileExists(out.to_owned()));
    }
    let archive = |source| FmuError::Archive { path: out.to_owned(), source };
    let file = OutputFile::named_by_user(out)?;
    let mut zip = ZipWriter::new(file.file());
    let options = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
    let description = model_description(plate, title);
    let binary = format!("binaries/{platform}/{MODEL_IDENTIFIER}.so");
    let resource = format!("resources/{PLATE_FILE}");
    for (name, bytes) in [
        ("modelDescription.xml", description.as_bytes()),
        (resource.as_str(), plate_text.as_bytes()),
        (binary.as_str(), library),
    ] {
        zip.start_file(name, options).map_err(archive)?;
        zip.write_all(bytes).at(out)?;
    }
    zip.finish().map_err(archive)?;
    Ok(file.commit()?)
}

const MODEL_IDENTIFIER: &str = "platebench_fmi";
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

fn model_description(plate: &Plate, title: &str) -> String {
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
    use super::*;

    #[test]
    fn escapes_the_title() {
        assert_eq!(escape_attribute("a < \"b\" & c\u{0}\n"), "a &lt; &quot;b&quot; &amp; c");
    }
}
