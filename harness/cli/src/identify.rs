//! `platebench identify`: identifies plate parameters from recorded steps.

use crate::board_args::BoardSelection;
use crate::exit::Exit;
use crate::options::{OutputFormat, parse_number};
use crate::stdio;
use clap::{Args, ValueEnum};
use platebench_boards::Board;
use platebench_identify::{
    ColumnMapping, DirectFit, ExternalCsvError, Identification, ParameterUncertainty, PlateFileDetails, Recording,
    RecordingError, external_csv, parameter_uncertainties, plate_file, tables, uncertainty_table,
};
use platebench_report::ReportError;
use platebench_report::chart::FitChart;
use platebench_report::page::{BlockPage, PageBlock};
use platebench_report::text::Table;
use platebench_scenario::Diagnostic;
use platebench_trace::{TraceError, write_atomically, write_new};
use platebench_uncertainty::{Budget, EvaluationError, known_quantities};
use serde::Serialize;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

const MAX_DRAWN_RECORDINGS: usize = 12;

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench run scenarios/identify --out runs/plate
  platebench identify runs/plate --out plate.toml --drive-limit-vpp 900 --page identification.html
  platebench identify telemetry.csv --columns time=t:ms,drive=V,frequency=f,wd=Wd,wq=Wq

Columns: ROLE=NAME[:UNIT]; roles and units: time (s, ms, us), drive (Vpp, V for an amplitude),
frequency (Hz, kHz, rad/s), wd and wq (um, nm, m, peak to peak), temperature (K above the reference)
and force (N); the first unit is the default.

Exit codes: 0 identified, 2 unusable input, 3 the input does not determine the plate or is doubtful, 4 no recording")]
pub(crate) struct IdentifyArgs {
    /// Traces, or folders with traces below them, such as a run folder
    #[arg(value_name = "TRACE|RUN", required = true)]
    recordings: Vec<PathBuf>,
    /// Read the files as foreign tables with these columns
    #[arg(long, value_name = "COLUMNS")]
    columns: Option<ColumnMapping>,
    /// Signal of a trace: the samples that the controller received, or the true state of the emulated plate
    #[arg(long, value_enum, default_value_t = SignalSource::Sensed, conflicts_with = "columns")]
    signal: SignalSource,
    /// Write the plate file; an existing file is never overwritten
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Write a page: Markdown if the name ends in .md, else HTML with the fitted curves
    #[arg(long, value_name = "FILE")]
    page: Option<PathBuf>,
    /// Write the plate file although the recordings are doubtful; the file states the reasons
    #[arg(long)]
    even_if_doubtful: bool,
    /// Name of the plate in its file
    #[arg(long, default_value = "identified plate")]
    name: String,
    #[command(flatten)]
    board: BoardSelection,
    /// Reference temperature of the offsets
    #[arg(long, value_name = "C", default_value_t = 24.0, allow_negative_numbers = true,
        value_parser = parse_temperature)]
    reference_temperature_c: f64,
    /// Limit of the amplifier; default: the highest recorded drive
    #[arg(long, value_name = "VPP", value_parser = parse_positive)]
    drive_limit_vpp: Option<f64>,
    /// Slope of the resonance, if no recording contains a temperature step
    #[arg(long, value_name = "HZ", allow_negative_numbers = true, value_parser = parse_finite)]
    slope_hz_per_k: Option<f64>,
    /// Uncertainty budget: adds combined and expanded uncertainties of the parameters that it covers
    #[arg(long, value_name = "FILE")]
    budget: Option<PathBuf>,
    /// Format of standard output
    #[arg(long, value_enum, default_value_t = OutputFormat::Human)]
    format: OutputFormat,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum SignalSource {
    /// `sensed_wd_um`, `sensed_wq_um`
    Sensed,
    /// `wd_um`, `wq_um`
    True,
}

fn parse_finite(text: &str) -> Result<f64, String> {
    parse_number(text, f64::is_finite, "a finite number")
}

fn parse_positive(text: &str) -> Result<f64, String> {
    parse_number(text, |value| value.is_finite() && value > 0.0, "a finite number above 0")
}

fn parse_temperature(text: &str) -> Result<f64, String> {
    parse_number(text, |value| value.is_finite() && value > -273.15, "a temperature above -273.15")
}

#[derive(Debug, thiserror::Error)]
enum IdentifyError {
    #[error(transparent)]
    Trace(#[from] TraceError),
    #[error(transparent)]
    Telemetry(#[from] ExternalCsvError),
    #[error("{}: {source}", path.display())]
    Unusable { path: PathBuf, source: RecordingError },
    #[error("{0}")]
    Together(RecordingError),
    #[error("{}: {source}", path.display())]
    Io { path: PathBuf, source: io::Error },
    #[error("{} exists already, expected another name", .0.display())]
    Taken(PathBuf),
    #[error(transparent)]
    Report(#[from] ReportError),
    #[error("the budget is not valid")]
    Budget(Vec<Diagnostic>),
    #[error("{0}")]
    Evaluation(EvaluationError),
}

#[derive(Serialize)]
struct IdentifyOutput<'a> {
    #[serde(flatten)]
    found: &'a Identification,
    #[serde(skip_serializing_if = "<[_]>::is_empty")]
    uncertainties: &'a [ParameterUncertainty],
}

pub(crate) fn identify(arguments: &IdentifyArgs) -> Exit {
    match identify_plate(arguments) {
        Ok(exit) => exit,
        Err(IdentifyError::Budget(faults)) => stdio::reject_files(&faults),
        Err(error) => stdio::reject(&error),
    }
}

fn identify_plate(arguments: &IdentifyArgs) -> Result<Exit, IdentifyError> {
    let board = match arguments.board.find() {
        Ok(board) => board,
        Err(exit) => return Ok(exit),
    };
    let mut files = Vec::new();
    for path in &arguments.recordings {
        collect_tables(path, &mut files)?;
    }
    if files.is_empty() {
        stdio::error("there is no recording");
        return Ok(Exit::NothingToRun);
    }
    if let Some(path) = arguments.out.as_ref().filter(|path| path.exists()) {
        return Err(IdentifyError::Taken(path.clone()));
    }
    let recordings = files.iter().map(|file| read_recording(file, arguments)).collect::<Result<Vec<_>, _>>()?;
    let (found, fits) =
        platebench_identify::identify(&recordings, arguments.slope_hz_per_k).map_err(IdentifyError::Together)?;
    let mut tables = tables(&found);
    let budget = arguments.budget.as_deref().map(|path| Budget::load(path, &known_quantities()));
    let budget = budget.transpose().map_err(IdentifyError::Budget)?;
    let uncertainties = budget.map(|budget| parameter_uncertainties(&found, &budget)).transpose();
    let uncertainties = uncertainties.map_err(IdentifyError::Evaluation)?.unwrap_or_default();
    if !uncertainties.is_empty() {
        tables.push(uncertainty_table(&uncertainties));
    }
    match arguments.format {
        OutputFormat::Human => {
            stdio::show(&tables.iter().map(|table| table.markdown() + "\n").collect::<Vec<_>>().concat());
        }
        OutputFormat::Json => stdio::show_json(&IdentifyOutput { found: &found, uncertainties: &uncertainties }),
    }
    if let Some(path) = &arguments.page {
        write_file(path, &write_page(path, arguments, &tables, &recordings, &found, &fits)?)?;
    }
    found.doubts.iter().for_each(|doubt| stdio::error(&format!("doubtful: {doubt}")));
    let exit = if found.doubts.is_empty() { Exit::Passed } else { Exit::Inconclusive };
    let Some(path) = &arguments.out else { return Ok(exit) };
    if exit != Exit::Passed && !arguments.even_if_doubtful {
        stdio::error(
            "no plate file: the identification is doubtful; --even-if-doubtful writes it with the reasons in it",
        );
        return Ok(exit);
    }
    let details = PlateFileDetails {
        name: arguments.name.clone(),
        source: describe_source(arguments, &recordings, board.as_ref()),
        reference_temperature_c: arguments.reference_temperature_c,
        limit_vpp: arguments.drive_limit_vpp,
        slope_hz_per_k: arguments.slope_hz_per_k,
    };
    if let Some(text) = plate_file(&found, &details) {
        write_new(path, text.as_bytes()).map_err(|source| IdentifyError::Io { path: path.clone(), source })?;
        stdio::note(&format!("plate file: {}", path.display()));
        if details.limit_vpp.is_none() {
            stdio::note(
                "its drive limit is the highest recorded drive; --drive-limit-vpp VPP sets the amplifier's limit",
            );
        }
        return Ok(exit);
    }
    stdio::error(
        "no plate file: the recordings do not determine gain, time constant and resonance of the free plate at a known \
         temperature",
    );
    Ok(Exit::Inconclusive)
}

fn describe_source(arguments: &IdentifyArgs, recordings: &[Recording], board: Option<&Board>) -> String {
    let count = recordings.len();
    let names: Vec<String> = arguments.recordings.iter().map(|path| path.display().to_string()).collect();
    let board = board.map_or_else(String::new, |board| format!("; {}", board.describe_instruments()));
    format!("platebench identify, {count} recording{}: {}{board}", if count == 1 { "" } else { "s" }, names.join(", "))
}

fn write_file(path: &Path, text: &str) -> Result<(), IdentifyError> {
    write_atomically(path, text.as_bytes()).map_err(|source| IdentifyError::Io { path: path.to_owned(), source })
}

/// Adds the tables below `path`, sorted by name, or the file `path`.
fn collect_tables(path: &Path, files: &mut Vec<PathBuf>) -> Result<(), IdentifyError> {
    let refused = |source| IdentifyError::Io { path: path.to_owned(), source };
    if !path.is_dir() {
        files.push(path.to_owned());
        return Ok(());
    }
    // A run folder also holds copies of its inputs.
    let traces = path.join("traces");
    let folder = if traces.is_dir() { traces } else { path.to_owned() };
    let mut entries = fs::read_dir(folder).and_then(Iterator::collect::<Result<Vec<_>, _>>).map_err(refused)?;
    entries.sort_by_key(fs::DirEntry::path);
    for entry in entries {
        let (path, is_link) = (entry.path(), entry.file_type().map_err(refused)?.is_symlink());
        if path.is_dir() && !is_link || path.extension().is_some_and(|extension| extension == "csv") {
            collect_tables(&path, files)?;
        }
    }
    Ok(())
}

fn read_recording(path: &Path, arguments: &IdentifyArgs) -> Result<Recording, IdentifyError> {
    let name = path.display().to_string();
    if let Some(columns) = &arguments.columns {
        let file = fs::File::open(path).map_err(|source| IdentifyError::Io { path: path.to_owned(), source })?;
        return Ok(external_csv::read(&name, file, columns)?);
    }
    let signal = match arguments.signal {
        SignalSource::Sensed => platebench_identify::SampleSource::Sensed,
        SignalSource::True => platebench_identify::SampleSource::True,
    };
    let rows = platebench_trace::read_trace(path)?;
    Recording::from_trace(name, &rows, signal)
        .map_err(|source| IdentifyError::Unusable { path: path.to_owned(), source })
}

fn write_page(
    path: &Path,
    arguments: &IdentifyArgs,
    tables: &[platebench_identify::IdentificationTable],
    recordings: &[Recording],
    found: &Identification,
    fits: &[DirectFit],
) -> Result<String, IdentifyError> {
    let title = format!("Identification: {}", arguments.name);
    if path.extension().is_some_and(|extension| extension == "md") {
        let body: String = tables.iter().map(|table| table.markdown() + "\n").collect();
        return Ok(format!("# {title}\n\n{body}"));
    }
    let fitted =
        found.recordings.iter().filter_map(|whole| recordings.iter().find(|each| each.name == whole.recording));
    let mut curves = Vec::new();
    for (recording, fit) in fitted.zip(fits).take(MAX_DRAWN_RECORDINGS) {
        let of = |part: fn(&platebench_plate::Complex64) -> f64| {
            let measured = recording.outputs.iter().map(|output| (output.t * 1e3, part(&output.w))).collect();
            (measured, recording.outputs.iter().zip(&fit.curve).map(|(output, w)| (output.t * 1e3, part(w))).collect())
        };
        for (name, (measured, fitted)) in [("Wd", of(|w| w.re)), ("Wq", of(|w| w.im))] {
            curves.push(FitChart { title: format!("{name}, {}", recording.name), unit: "µm", measured, fitted });
        }
    }
    let mut blocks = Vec::new();
    for table in tables {
        blocks.push(PageBlock::Heading(table.title.clone()));
        blocks.push(PageBlock::Table(Table { header: table.header.clone(), rows: table.rows.clone() }));
        blocks.extend(table.notes.iter().cloned().map(PageBlock::Text));
    }
    blocks.push(PageBlock::Heading("Measured (dashed) and fitted response".to_owned()));
    let drawings = curves.iter().map(|curve| Ok((curve.svg()?, curve.title.clone())));
    blocks.push(PageBlock::Drawings(drawings.collect::<Result<_, ReportError>>()?));
    Ok(BlockPage { title, intro: String::new(), blocks }.html())
}
