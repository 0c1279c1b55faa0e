//! `platebench identify`: identifies plate parameters from recorded steps.

use crate::board::BoardSelection;
use crate::exit::{CommandResult, Exit, Failure, OrInvalid};
use crate::options::{OutputFormat, parse_number};
use crate::stdio;
use clap::{Args, ValueEnum};
use jiff::Timestamp;
use jiff::civil::Date;
use jiff::tz::TimeZone;
use platebench_design::identified_plate::{
    ParameterUncertainty, PlateFileDetails, document, parameter_uncertainties, plate_file,
};
use platebench_design::identify::{DirectFit, Identification};
use platebench_design::plate_history::{HistoryAnalysis, HistoryEntry, HistoryError, PlateHistory};
use platebench_document::format::count;
use platebench_document::{Block, Figure};
use platebench_lab::boards::Board;
use platebench_model::external_csv::{self, ColumnMapping, Dialect};
use platebench_model::quoted_path;
use platebench_model::record::sha256_of_file;
use platebench_model::recording::{Recording, RecordingError};
use platebench_model::scenario::load::parse_plate;
use platebench_model::trace::{MAX_TABLE_BYTES, TraceError, open_regular_file, write_new};
use platebench_report::FitChart;
use platebench_verdict::uncertainty::{Budget, known_quantities};
use schemars::JsonSchema;
use serde::Serialize;
use std::collections::HashSet;
use std::fs;
use std::path::{Path, PathBuf};

const MAX_DRAWN_RECORDINGS: usize = 12;

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench run scenarios/identify --out runs/plate
  platebench identify runs/plate --out plate.toml --drive-limit-vpp 900 --page identification.html
  platebench identify runs/plate --name P7 --history plates/P7.jsonl --page history.html
  platebench identify telemetry.csv --columns time=t:ms,drive=V:Vpp,frequency=f:Hz,wd=Wd:nm,wq=Wq:nm

Columns: ROLE=COLUMN:UNIT; roles and units: time (s, ms, us), drive (Vpp, V for an amplitude),
frequency (Hz, kHz, rad/s), wd and wq (um, nm, m, peak to peak; -nm reverses the sign), temperature
(K above the reference) and force (N). 0.5*um is 0.5 µm per unit of the column; ROLE==NUMBER:UNIT is a constant.

Exit codes: 0 identified, 2 unusable input, 3 the input does not determine the plate or is doubtful, 4 no recording")]
pub(crate) struct IdentifyArgs {
    /// Traces, or folders with traces below them, such as a run folder
    #[arg(value_name = "TRACE|RUN", required = true)]
    recordings: Vec<PathBuf>,
    /// Read the files as foreign tables with these columns
    #[arg(long, value_name = "COLUMNS")]
    columns: Option<ColumnMapping>,
    /// Signal of a trace: the samples that the controller received, or the true state of the
    /// emulated plate
    #[arg(long, value_enum, default_value_t = SignalSource::Sensed, conflicts_with = "columns")]
    signal: SignalSource,
    /// Write the plate file; an existing file is never overwritten; `-` is standard output
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Write a page: Markdown if the name ends in .md, else HTML with the fitted curves; `-` is
    /// standard output
    #[arg(long, value_name = "FILE")]
    page: Option<PathBuf>,
    /// Write the plate file although the recordings are doubtful or a parameter is impossible; the
    /// file states the reasons
    #[arg(long, alias = "even-if-doubtful")]
    force: bool,
    /// Name of the plate in its file and its history; default: identified plate
    #[arg(long)]
    name: Option<String>,
    /// Add the estimates to the history of the plate of --name, a file of JSON lines, and test them
    /// for drift
    #[arg(long, value_name = "FILE", requires = "name", value_parser = stdio::parse_named_file)]
    history: Option<PathBuf>,
    /// Date of the recordings, for --history; default: today, UTC
    #[arg(long, value_name = "YYYY-MM-DD", requires = "history", value_parser = parse_date)]
    date: Option<Date>,
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
    /// Uncertainty budget: adds combined and expanded uncertainties of the parameters that it
    /// covers
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

fn parse_date(text: &str) -> Result<Date, String> {
    text.parse().map_err(|_| "expected a date like 2026-03-02".to_owned())
}

#[derive(Serialize, JsonSchema)]
pub(crate) struct IdentifyOutput<'a> {
    #[serde(flatten)]
    found: &'a Identification,
    #[serde(skip_serializing_if = "<[_]>::is_empty")]
    uncertainties: &'a [ParameterUncertainty],
    /// Test of the plate's history for drift.
    #[serde(skip_serializing_if = "Option::is_none")]
    history: Option<HistoryAnalysis>,
}

impl IdentifyArgs {
    fn name(&self) -> &str {
        self.name.as_deref().unwrap_or("identified plate")
    }

    fn history_entry(&self, found: &Identification, recordings: &[PathBuf]) -> Result<HistoryEntry, Failure> {
        let date = self.date.unwrap_or_else(|| Timestamp::now().to_zoned(TimeZone::UTC).date());
        let digest = |path: &PathBuf| -> Result<(String, String), Failure> {
            Ok((path.display().to_string(), sha256_of_file(path).or_invalid_at(path)?))
        };
        let recordings = recordings.iter().map(digest).collect::<Result<_, _>>()?;
        Ok(HistoryEntry::new(self.name(), date, self.reference_temperature_c, found, recordings))
    }
}

impl From<HistoryError> for Failure {
    fn from(error: HistoryError) -> Self {
        Self::invalid(&error)
    }
}

pub(crate) fn identify(arguments: &IdentifyArgs) -> CommandResult {
    let to_stdout =
        [&arguments.out, &arguments.page].into_iter().flatten().filter(|file| stdio::is_stdout(file)).count();
    if to_stdout + usize::from(arguments.format == OutputFormat::Json) > 1 {
        return Err(Failure::invalid(&"only one of --out -, --page - and --format json can use standard output"));
    }
    let board = arguments.board.find()?;
    let files = find_recordings(arguments)?;
    if let Some(path) = arguments.out.as_ref().filter(|path| path.exists() && !stdio::is_stdout(path)) {
        return Err(Failure::invalid(&format!("{} exists already, expected another name", path.display())));
    }
    let history = arguments.history.as_deref().map(PlateHistory::read).transpose()?;
    let recordings = files.iter().map(|file| read_recording(file, arguments)).collect::<Result<Vec<_>, _>>()?;
    let identified = platebench_design::identify::identify(&recordings, arguments.slope_hz_per_k);
    let (found, fits) = identified.map_err(|error| match error {
        RecordingError::Undetermined => Failure::new(Exit::Inconclusive, &error),
        error => Failure::invalid(&error),
    })?;
    let budget = arguments.budget.as_deref().map(|path| Budget::load(path, &known_quantities())).transpose()?;
    let uncertainties = budget.map(|budget| parameter_uncertainties(&found, &budget)).transpose();
    let uncertainties = uncertainties.or_invalid()?.unwrap_or_default();
    let mut document = document(&format!("Identification: {}", arguments.name()), &found, &uncertainties);
    let exit = if found.inconsistencies.is_empty() { Exit::Passed } else { Exit::Inconclusive };
    // The estimates of a doubtful identification are not those of the plate.
    let entry = history.as_ref().filter(|_| exit == Exit::Passed).map(|_| arguments.history_entry(&found, &files));
    let entry = entry.transpose()?;
    let history = history.zip(entry.clone()).map(|(history, entry)| history.with(entry)).transpose();
    let extended = history.as_ref().ok().and_then(Option::as_ref);
    let analysis = extended.map(PlateHistory::analysis);
    let blocks = extended.zip(analysis.as_ref()).map(|(history, analysis)| history.blocks(analysis));
    document.blocks.extend(blocks.into_iter().flatten());
    let output = IdentifyOutput { found: &found, uncertainties: &uncertainties, history: analysis };
    match arguments.format {
        OutputFormat::Human => stdio::show_beside(to_stdout > 0, &stdio::console_text(&document)),
        OutputFormat::Json => stdio::show_json(&output),
    }
    if let Some(path) = &arguments.page {
        let page = if path.extension().is_some_and(|extension| extension == "md") {
            document.to_markdown()
        } else {
            document.blocks.push(Block::heading("Measured (dashed) and fitted response"));
            document.blocks.push(Block::Figures(figures(&recordings, &found, &fits)));
            document.to_html()
        };
        stdio::write_output(path, &page).or_invalid_at(path)?;
    }
    for warning in &found.warnings {
        stdio::note(&format!("warning: {warning}"));
    }
    for inconsistency in &found.inconsistencies {
        exit.show_reason(&format!("doubtful: {inconsistency}"));
    }
    if let Some(path) = &arguments.history {
        history?;
        match entry {
            Some(entry) => PlateHistory::append(path, entry)?,
            None => stdio::note(&format!("{}: not added, because the identification is doubtful", quoted_path(path))),
        }
        output.history.iter().flat_map(HistoryAnalysis::drifts).for_each(|drift| stdio::note(&drift));
    }
    let Some(path) = &arguments.out else { return Ok(exit) };
    if exit != Exit::Passed && !arguments.force {
        let message = "no plate file was written, because the identification is doubtful; --force writes it with the \
                       reasons in it";
        return Err(Failure::new(exit, &message));
    }
    let details = PlateFileDetails {
        name: arguments.name().to_owned(),
        source: describe_source(arguments, &recordings, board.as_ref()),
        reference_temperature_c: arguments.reference_temperature_c,
        limit_vpp: arguments.drive_limit_vpp,
        slope_hz_per_k: arguments.slope_hz_per_k,
    };
    let Some(text) = plate_file(&found, &details) else {
        let message = "no plate file: the recordings do not determine gain, time constant and resonance of the free \
                       plate at a known temperature";
        return Err(Failure::new(Exit::Inconclusive, &message));
    };
    parse_plate(path, &text)?;
    if stdio::is_stdout(path) {
        stdio::show(&text);
    } else {
        write_new(path, text.as_bytes()).or_invalid_at(path)?;
        stdio::note(&format!("plate file: {}", quoted_path(path)));
    }
    if details.limit_vpp.is_none() {
        stdio::note(
            "the plate file has the highest recorded drive as drive limit; --drive-limit-vpp VPP sets the amplifier's \
             limit",
        );
    }
    Ok(exit)
}

/// The tables of all recordings. Fails if there is none, or one twice.
fn find_recordings(arguments: &IdentifyArgs) -> Result<Vec<PathBuf>, Failure> {
    let mut files = Vec::new();
    for path in &arguments.recordings {
        collect_tables(path, &mut files)?;
    }
    // A second copy adds no evidence.
    let mut known = HashSet::new();
    if let Some(path) = files.iter().find(|path| !known.insert(path.canonicalize().unwrap_or_else(|_| (*path).clone())))
    {
        let path = quoted_path(path);
        return Err(Failure::invalid(&format!("{path} is named twice, expected each recording once")));
    }
    if files.is_empty() {
        return Err(Failure::new(
            Exit::NothingToRun,
            &"no recording was found; name a run folder, a trace or a CSV file",
        ));
    }
    Ok(files)
}

fn describe_source(arguments: &IdentifyArgs, recordings: &[Recording], board: Option<&Board>) -> String {
    let recordings = count(recordings.len(), "recording");
    let names: Vec<String> = arguments.recordings.iter().map(|path| path.display().to_string()).collect();
    let board = board.map_or_else(String::new, |board| format!("; {}", board.describe_instruments()));
    format!("platebench identify, {recordings}: {}{board}", names.join(", "))
}

/// Adds the file `path`, or the tables below the folder `path`, sorted by name.
fn collect_tables(path: &Path, files: &mut Vec<PathBuf>) -> Result<(), Failure> {
    if !path.is_dir() {
        files.push(path.to_owned());
        return Ok(());
    }
    // A run folder contains copies of its inputs too, so only its traces are read.
    let traces = path.join("traces");
    let folder = if traces.is_dir() { traces } else { path.to_owned() };
    let mut entries = fs::read_dir(folder).and_then(Iterator::collect::<Result<Vec<_>, _>>).or_invalid_at(path)?;
    entries.sort_by_key(fs::DirEntry::path);
    for entry in entries {
        let is_link = entry.file_type().or_invalid_at(path)?.is_symlink();
        let path = entry.path();
        if path.is_dir() && !is_link || path.extension().is_some_and(|extension| extension == "csv") {
            collect_tables(&path, files)?;
        }
    }
    Ok(())
}

fn read_recording(path: &Path, arguments: &IdentifyArgs) -> Result<Recording, Failure> {
    let name = path.display().to_string();
    if let Some(columns) = &arguments.columns {
        let file = open_regular_file(path, MAX_TABLE_BYTES).or_invalid_at(path)?;
        let (recording, dialect) = external_csv::read(&name, file, columns).or_invalid()?;
        note_dialect(path, Some(dialect));
        return Ok(recording);
    }
    let signal = match arguments.signal {
        SignalSource::Sensed => platebench_model::recording::SampleSource::Sensed,
        SignalSource::True => platebench_model::recording::SampleSource::True,
    };
    let rows = platebench_model::trace::read_trace(path);
    let rows = rows.map_err(|error| {
        let has_other_titles = matches!(error, TraceError::Content { line: 1, .. });
        let hint = if has_other_titles { proposed_columns(path) } else { String::new() };
        Failure::invalid(&format!("{error}{hint}"))
    })?;
    Recording::from_trace(name, &rows, signal).or_invalid_at(path)
}

/// Prints what differs from a CSV with titles in its first line.
pub(crate) fn note_dialect(path: &Path, dialect: Option<Dialect>) {
    if let Some(dialect) = dialect.filter(|dialect| !dialect.is_plain()) {
        stdio::note(&format!("{}: {dialect}", quoted_path(path)));
    }
}

fn proposed_columns(path: &Path) -> String {
    let file = open_regular_file(path, MAX_TABLE_BYTES).ok();
    let proposed = file.and_then(external_csv::propose_columns).map(|columns| {
        format!(
            " From its titles: --columns '{columns}'; write units that say peak to peak, peak or RMS in place of UNIT"
        )
    });
    let otherwise = " `platebench identify --help` lists roles and units";
    format!("\nA table of another program needs --columns.{}", proposed.as_deref().unwrap_or(otherwise))
}

fn figures(recordings: &[Recording], found: &Identification, fits: &[DirectFit]) -> Vec<Figure> {
    let fitted =
        found.recordings.iter().filter_map(|whole| recordings.iter().find(|each| each.name == whole.recording));
    let mut figures = Vec::new();
    for (recording, fit) in fitted.zip(fits).take(MAX_DRAWN_RECORDINGS) {
        let of = |part: fn(&platebench_plate::Complex64) -> f64| {
            let measured = recording.outputs.iter().map(|output| (output.t * 1e3, part(&output.w))).collect();
            (measured, recording.outputs.iter().zip(&fit.curve).map(|(output, w)| (output.t * 1e3, part(w))).collect())
        };
        for (name, (measured, fitted)) in [("Wd", of(|w| w.re)), ("Wq", of(|w| w.im))] {
            let chart = FitChart { title: format!("{name}, {}", recording.name), unit: "µm", measured, fitted };
            figures.push(Figure::new(chart.svg(), chart.title));
        }
    }
    figures
}
