//! `platebench identify`: plate parameters from recorded steps.

use crate::args::Format;
use crate::exit::Exit;
use crate::output;
use clap::{Args, ValueEnum};
use platebench_identify::{
    Columns, Fit, Identification, Named, Recording, TelemetryError, Unusable, plate_file, tables, telemetry,
};
use platebench_report::{ReportError, identification};
use platebench_trace::TraceError;
use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

/// Recordings whose curves stand on the page.
const DRAWN: usize = 12;

/// `platebench identify`
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench run scenarios/identify --out runs/plate
  platebench identify runs/plate --out plate.toml --drive-limit-vpp 900 --page identification.html
  platebench identify telemetry.csv --columns time=t:ms,drive=V,frequency=f,wd=Wd,wq=Wq

Columns: ROLE=NAME[:UNIT] with the roles and units time (s, ms, us), drive (Vpp, V for an amplitude), frequency (Hz, kHz, rad/s),
wd and wq (um, nm, m, peak to peak), temperature (K above the reference) and force (N); the first unit is meant where none is given.

Exit codes: 0 identified, 2 input that cannot be used, 3 not enough in it for what was asked, 4 no recording")]
pub(crate) struct Identify {
    /// Traces, or folders with traces below them, such as a run's
    #[arg(value_name = "TRACE|RUN", required = true)]
    recordings: Vec<PathBuf>,
    /// Take the files for tables of other origin with these columns
    #[arg(long, value_name = "COLUMNS")]
    columns: Option<Columns>,
    /// What a trace is read for: what the controller was given, or the emulated plate's own state
    #[arg(long, value_enum, default_value_t = Signal::Sensed, conflicts_with = "columns")]
    signal: Signal,
    /// Where the plate file is written; a file that is there already is never overwritten
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Where the page is written: Markdown for a name that ends in .md, else HTML with the fitted curves
    #[arg(long, value_name = "FILE")]
    page: Option<PathBuf>,
    /// The plate's name in its file
    #[arg(long, default_value = "identified plate")]
    name: String,
    /// Temperature from which offsets are counted
    #[arg(long, value_name = "C", default_value_t = 24.0, allow_negative_numbers = true, value_parser = temperature)]
    reference_temperature_c: f64,
    /// The amplifier's limit; the highest drive seen where not given
    #[arg(long, value_name = "VPP", value_parser = positive)]
    drive_limit_vpp: Option<f64>,
    /// The resonance's slope, for steps of the temperature where no recording shows it
    #[arg(long, value_name = "HZ", allow_negative_numbers = true, value_parser = finite)]
    slope_hz_per_k: Option<f64>,
    /// What standard output shows
    #[arg(long, value_enum, default_value_t = Format::Human)]
    format: Format,
}

/// `--signal`
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Signal {
    /// `sensed_wd_um`, `sensed_wq_um`
    Sensed,
    /// `wd_um`, `wq_um`
    True,
}

fn finite(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|value: &f64| value.is_finite()).ok_or_else(|| "expected a finite number".to_owned())
}

fn positive(text: &str) -> Result<f64, String> {
    finite(text).ok().filter(|value| *value > 0.0).ok_or_else(|| "expected a finite number above 0".to_owned())
}

fn temperature(text: &str) -> Result<f64, String> {
    finite(text).ok().filter(|value| *value > -273.15).ok_or_else(|| "expected a temperature above -273.15".to_owned())
}

/// Why nothing was identified.
#[derive(Debug, thiserror::Error)]
enum IdentifyError {
    #[error(transparent)]
    Trace(#[from] TraceError),
    #[error(transparent)]
    Telemetry(#[from] TelemetryError),
    #[error("{}: {source}", path.display())]
    Unusable { path: PathBuf, source: Unusable },
    #[error("{0}")]
    Together(Unusable),
    #[error("{}: {source}", path.display())]
    Io { path: PathBuf, source: io::Error },
    #[error("{} is there already, expected another name", .0.display())]
    Taken(PathBuf),
    #[error(transparent)]
    Report(#[from] ReportError),
}

/// Identifies a plate, says what came of it and writes what was asked for.
pub(crate) fn identify(arguments: &Identify) -> Exit {
    match identified(arguments) {
        Ok(exit) => exit,
        Err(error) => {
            output::error(&error.to_string());
            Exit::Invalid
        }
    }
}

fn identified(arguments: &Identify) -> Result<Exit, IdentifyError> {
    let mut files = Vec::new();
    for path in &arguments.recordings {
        tables_below(path, &mut files)?;
    }
    if files.is_empty() {
        output::error("there is no recording");
        return Ok(Exit::Nothing);
    }
    if let Some(path) = arguments.out.as_ref().filter(|path| path.exists()) {
        return Err(IdentifyError::Taken(path.clone()));
    }
    let recordings = files.iter().map(|file| recording(file, arguments)).collect::<Result<Vec<_>, _>>()?;
    let (found, fits) =
        platebench_identify::identify(&recordings, arguments.slope_hz_per_k).map_err(IdentifyError::Together)?;
    let tables = tables(&found);
    match arguments.format {
        Format::Human => output::show(&tables.iter().map(|table| table.markdown() + "\n").collect::<Vec<_>>().concat()),
        Format::Json => match serde_json::to_string_pretty(&found) {
            Ok(text) => output::show(&format!("{text}\n")),
            Err(error) => output::error(&format!("the identification cannot be shown as JSON: {error}")),
        },
    }
    if let Some(path) = &arguments.page {
        write(path, &page(path, arguments, &tables, &recordings, &found, &fits)?)?;
    }
    let Some(path) = &arguments.out else { return Ok(Exit::Passed) };
    let named = Named {
        name: arguments.name.clone(),
        source: source(arguments, &recordings),
        reference_temperature_c: arguments.reference_temperature_c,
        limit_vpp: arguments.drive_limit_vpp,
        slope_hz_per_k: arguments.slope_hz_per_k,
    };
    if let Some(text) = plate_file(&found, &named) {
        let created = File::create_new(path).and_then(|mut file| file.write_all(text.as_bytes()));
        created.map_err(|source| IdentifyError::Io { path: path.clone(), source })?;
        output::note(&format!("plate file: {}", path.display()));
        if named.limit_vpp.is_none() {
            output::note(
                "its drive limit is the highest drive that was seen, expected the amplifier's own: --drive-limit-vpp VPP",
            );
        }
        return Ok(Exit::Passed);
    }
    output::error(
        "no plate file: the recordings do not show gain, time constant and resonance of the untouched plate at a known temperature",
    );
    Ok(Exit::Inconclusive)
}

fn source(arguments: &Identify, recordings: &[Recording]) -> String {
    let count = recordings.len();
    let names: Vec<String> = arguments.recordings.iter().map(|path| path.display().to_string()).collect();
    format!("platebench identify, {count} recording{}: {}", if count == 1 { "" } else { "s" }, names.join(", "))
}

fn write(path: &Path, text: &str) -> Result<(), IdentifyError> {
    fs::write(path, text).map_err(|source| IdentifyError::Io { path: path.to_owned(), source })
}

/// The files of a folder in order of their names, down to the last one; a file is itself.
fn tables_below(path: &Path, files: &mut Vec<PathBuf>) -> Result<(), IdentifyError> {
    let refused = |source| IdentifyError::Io { path: path.to_owned(), source };
    if !path.is_dir() {
        files.push(path.to_owned());
        return Ok(());
    }
    // A run keeps copies of its inputs beside its traces.
    let traces = path.join("traces");
    let folder = if traces.is_dir() { traces } else { path.to_owned() };
    let mut entries = fs::read_dir(folder).and_then(Iterator::collect::<Result<Vec<_>, _>>).map_err(refused)?;
    entries.sort_by_key(fs::DirEntry::path);
    for entry in entries {
        let (path, is_link) = (entry.path(), entry.file_type().map_err(refused)?.is_symlink());
        if path.is_dir() && !is_link || path.extension().is_some_and(|extension| extension == "csv") {
            tables_below(&path, files)?;
        }
    }
    Ok(())
}

fn recording(path: &Path, arguments: &Identify) -> Result<Recording, IdentifyError> {
    let name = path.display().to_string();
    if let Some(columns) = &arguments.columns {
        let file = File::open(path).map_err(|source| IdentifyError::Io { path: path.to_owned(), source })?;
        return Ok(telemetry::read(&name, file, columns)?);
    }
    let signal = match arguments.signal {
        Signal::Sensed => platebench_identify::Signal::Sensed,
        Signal::True => platebench_identify::Signal::True,
    };
    let rows = platebench_trace::read(path)?;
    Recording::of_trace(name, &rows, signal).map_err(|source| IdentifyError::Unusable { path: path.to_owned(), source })
}

fn page(
    path: &Path,
    arguments: &Identify,
    tables: &[platebench_identify::Table],
    recordings: &[Recording],
    found: &Identification,
    fits: &[Fit],
) -> Result<String, IdentifyError> {
    let title = format!("Identification: {}", arguments.name);
    if path.extension().is_some_and(|extension| extension == "md") {
        let body: String = tables.iter().map(|table| table.markdown() + "\n").collect();
        return Ok(format!("# {title}\n\n{body}"));
    }
    let fitted =
        found.recordings.iter().filter_map(|whole| recordings.iter().find(|each| each.name == whole.recording));
    let mut curves = Vec::new();
    for (recording, fit) in fitted.zip(fits).take(DRAWN) {
        let of = |part: fn(&platebench_plate::Complex64) -> f64| {
            let seen = recording.outputs.iter().map(|output| (output.t * 1e3, part(&output.w))).collect();
            (seen, recording.outputs.iter().zip(&fit.curve).map(|(output, w)| (output.t * 1e3, part(w))).collect())
        };
        for (name, (seen, fitted)) in [("Wd", of(|w| w.re)), ("Wq", of(|w| w.im))] {
            curves.push(identification::Curves {
                title: format!("{name}, {}", recording.name),
                unit: "µm",
                seen,
                fitted,
            });
        }
    }
    let shown = |table: &platebench_identify::Table| identification::Table {
        title: table.title.clone(),
        header: table.header.clone(),
        rows: table.rows.clone(),
        notes: table.notes.clone(),
    };
    Ok(identification::page(&title, &tables.iter().map(shown).collect::<Vec<_>>(), &curves)?)
}
