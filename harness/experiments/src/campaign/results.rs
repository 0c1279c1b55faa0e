//! Writes `results.csv` and `results.parquet`: one row per trial.

use crate::campaign::bench_error::RowErrors;
use crate::campaign::definition::Campaign;
use crate::campaign::distribution::Variable;
use crate::campaign::error::CampaignError;
use crate::campaign::row::TrialRow;
use parquet::basic::{Compression, LogicalType, Repetition, Type as Physical};
use parquet::data_type::{ByteArray, ByteArrayType, DoubleType, Int64Type};
use parquet::errors::ParquetError;
use parquet::file::metadata::KeyValue;
use parquet::file::properties::WriterProperties;
use parquet::file::writer::{SerializedFileWriter, SerializedRowGroupWriter};
use parquet::schema::types::Type;
use platebench_document::parquet::{write_column, write_optional_column};
use platebench_document::without_formula;
use platebench_model::scenario::Metric;
use platebench_model::trace::{AtPath, OutputFile, OutputFolder};
use platebench_verdict::uncertainty::ErrorOrigin;
use std::fs::File;
use std::io::{self, BufWriter};
use std::path::{Path, PathBuf};
use std::sync::Arc;

pub const CSV_FILE: &str = "results.csv";
pub const PARQUET_FILE: &str = "results.parquet";
/// Row groups do not depend on shards, so that the number of shards does not change the file.
const GROUP_ROWS: usize = 16_384;
const UNIT_SUFFIXES: [(&str, &str); 12] = [
    ("_n", "N"),
    ("_k", "K"),
    ("_ms", "ms"),
    ("_hz", "Hz"),
    ("_vpp", "Vpp"),
    ("_um", "µm"),
    ("_c", "°C"),
    ("_percent", "%"),
    ("_um_rms", "µm"),
    ("_um_per_vpp", "µm/Vpp"),
    ("_hz_per_k", "Hz/K"),
    ("_hz_per_n", "Hz/N"),
];

/// Unit according to the suffix of the last name with `_` in the key; empty without a unit.
pub fn unit_of_key(key: &str) -> &'static str {
    let named = key.split('.').rev().find(|name| name.contains('_')).unwrap_or_default();
    let fitting = UNIT_SUFFIXES.iter().filter(|(suffix, _)| named.ends_with(suffix));
    fitting.max_by_key(|(suffix, _)| suffix.len()).map_or("", |(_, unit)| unit)
}

/// Key and unit.
pub(crate) fn axis_label(variable: &Variable) -> String {
    with_unit(&variable.key, unit_of_key(&variable.key))
}

/// The name alone if `unit` is empty.
pub(crate) fn with_unit(name: &str, unit: &str) -> String {
    if unit.is_empty() { name.to_owned() } else { format!("{name}, {unit}") }
}

pub(crate) struct ResultsWriter<'a> {
    campaign: &'a Campaign,
    rows: Vec<(TrialRow, Vec<RowErrors>)>,
    csv: csv::Writer<BufWriter<OutputFile>>,
    csv_path: PathBuf,
    parquet: SerializedFileWriter<File>,
    parquet_file: OutputFile,
    parquet_path: PathBuf,
}

impl<'a> ResultsWriter<'a> {
    pub(crate) fn new(folder: &Path, campaign: &'a Campaign) -> Result<Self, CampaignError> {
        let output = OutputFolder::open(folder)?;
        let [csv_path, parquet_path] = [CSV_FILE, PARQUET_FILE].map(|name| folder.join(name));
        let mut csv = csv::Writer::from_writer(BufWriter::new(output.create_file(CSV_FILE)?));
        csv.write_record(columns(campaign).iter().map(|name| without_formula(name).into_owned()))
            .map_err(io::Error::from)
            .at(&csv_path)?;
        let parquet_file = output.create_file(PARQUET_FILE)?;
        let file = parquet_file.file().try_clone().at(&parquet_path)?;
        let properties = WriterProperties::builder()
            .set_compression(Compression::SNAPPY)
            .set_created_by(format!("platebench {}", env!("CARGO_PKG_VERSION")))
            .set_key_value_metadata(Some(metadata(campaign)))
            .build();
        let parquet = schema(campaign)
            .and_then(|schema| SerializedFileWriter::new(file, Arc::new(schema), Arc::new(properties)))
            .map_err(CampaignError::write(&parquet_path))?;
        Ok(Self { campaign, rows: Vec::with_capacity(GROUP_ROWS), csv, csv_path, parquet, parquet_file, parquet_path })
    }

    /// `errors` has one element per expectation.
    pub(crate) fn push(&mut self, row: TrialRow, errors: Vec<RowErrors>) -> Result<(), CampaignError> {
        self.write_csv(&row, &errors)?;
        self.rows.push((row, errors));
        if self.rows.len() == GROUP_ROWS { self.write_group() } else { Ok(()) }
    }

    fn write_csv(&mut self, row: &TrialRow, errors: &[RowErrors]) -> Result<(), CampaignError> {
        let mut fields = vec![row.trial.to_string(), self.campaign.seed_of(row.trial).to_string()];
        let variables = self.campaign.variables.iter().zip(&row.draws);
        fields
            .extend(variables.map(|(variable, draw)| without_formula(&variable.distribution.text(*draw)).into_owned()));
        for (value, margin) in row.values.iter().zip(&row.margins) {
            fields.extend([value, margin].map(|number| number_field(known(Some(number)))));
        }
        fields.push(row.verdict_text().to_owned());
        fields.push(row.cause.map(|cause| cause.to_string()).unwrap_or_default());
        fields.extend(errors.iter().flatten().map(|error| number_field(*error)));
        Ok(self.csv.write_record(fields).map_err(io::Error::from).at(&self.csv_path)?)
    }

    fn write_group(&mut self) -> Result<(), CampaignError> {
        let rows = std::mem::take(&mut self.rows);
        let mut write = || {
            let mut group = self.parquet.next_row_group()?;
            write_columns(&mut group, self.campaign, &rows)?;
            group.close().map(drop)
        };
        write().map_err(CampaignError::write(&self.parquet_path))
    }

    pub(crate) fn commit(mut self) -> Result<(), CampaignError> {
        if !self.rows.is_empty() {
            self.write_group()?;
        }
        self.parquet.close().map_err(CampaignError::write(&self.parquet_path))?;
        self.parquet_file.commit()?;
        let buffer = self.csv.into_inner().map_err(csv::IntoInnerError::into_error).at(&self.csv_path)?;
        let file = buffer.into_inner().map_err(io::IntoInnerError::into_error).at(&self.csv_path)?;
        Ok(file.commit()?)
    }
}

/// `None` for a value that was never reached and for its margin.
fn known(number: Option<&f64>) -> Option<f64> {
    number.copied().filter(|number| number.is_finite())
}

fn number_field(number: Option<f64>) -> String {
    number.map_or_else(String::new, |number| format!("{number:?}"))
}

fn columns(campaign: &Campaign) -> Vec<String> {
    let mut columns = vec!["trial".to_owned(), "seed".to_owned()];
    columns.extend(campaign.variables.iter().map(|variable| variable.key.clone()));
    for name in campaign.expectation_names() {
        columns.extend([name.clone(), format!("{name}_margin")]);
    }
    columns.extend(["verdict".to_owned(), "cause".to_owned()]);
    columns.extend(error_columns(campaign).map(|(name, _)| name));
    columns
}

/// Names of the columns with the bench's own errors, with the metric that has the unit.
fn error_columns(campaign: &Campaign) -> impl Iterator<Item = (String, Metric)> {
    campaign.template.scenario.expectations.iter().flat_map(|expectation| {
        ErrorOrigin::ALL.map(|origin| (format!("{}_error_{}", expectation.name, origin.name()), expectation.metric))
    })
}

fn metadata(campaign: &Campaign) -> Vec<KeyValue> {
    let keys = campaign.variables.iter().map(|variable| (variable.key.clone(), unit_of_key(&variable.key)));
    let expectations = campaign.template.scenario.expectations.iter();
    let values = expectations.map(|expectation| (expectation.name.clone(), expectation.metric.spec().unit.symbol()));
    let errors = error_columns(campaign).map(|(name, metric)| (name, metric.spec().unit.symbol()));
    let units = keys.chain(values).chain(errors).filter(|(_, unit)| !unit.is_empty());
    let units = units.map(|(column, unit)| (format!("unit.{column}"), unit.to_owned()));
    let title = ("title".to_owned(), campaign.title.clone());
    std::iter::once(title).chain(units).map(|(key, value)| KeyValue::new(key, value)).collect()
}

fn schema(campaign: &Campaign) -> Result<Type, ParquetError> {
    let column = |name: &str, physical, logical, repetition| {
        let column = Type::primitive_type_builder(name, physical).with_repetition(repetition);
        column.with_logical_type(logical).build().map(Arc::new)
    };
    let number = |name: &str, repetition| column(name, Physical::DOUBLE, None, repetition);
    let text = |name: &str, repetition| column(name, Physical::BYTE_ARRAY, Some(LogicalType::String), repetition);
    let whole = |name: &str| column(name, Physical::INT64, None, Repetition::REQUIRED);
    let mut fields = vec![whole("trial")?, whole("seed")?];
    for variable in &campaign.variables {
        let (name, repetition) = (&*variable.key, Repetition::REQUIRED);
        fields.push(if variable.is_number() { number(name, repetition) } else { text(name, repetition) }?);
    }
    for name in campaign.expectation_names() {
        fields.push(number(&name, Repetition::OPTIONAL)?);
        fields.push(number(&format!("{name}_margin"), Repetition::OPTIONAL)?);
    }
    fields.push(text("verdict", Repetition::REQUIRED)?);
    fields.push(text("cause", Repetition::OPTIONAL)?);
    for (name, _) in error_columns(campaign) {
        fields.push(number(&name, Repetition::OPTIONAL)?);
    }
    Type::group_type_builder("trials").with_fields(fields).build()
}

type Group<'a> = SerializedRowGroupWriter<'a, File>;

fn write_columns(
    group: &mut Group<'_>,
    campaign: &Campaign,
    rows: &[(TrialRow, Vec<RowErrors>)],
) -> Result<(), ParquetError> {
    let (rows, errors): (Vec<&TrialRow>, Vec<&Vec<RowErrors>>) = rows.iter().map(|(row, errors)| (row, errors)).unzip();
    let whole = |of: &dyn Fn(&TrialRow) -> u64| -> Vec<i64> { rows.iter().map(|row| of(row).cast_signed()).collect() };
    write_column::<Int64Type>(group, &whole(&|row| row.trial))?;
    write_column::<Int64Type>(group, &whole(&|row| campaign.seed_of(row.trial)))?;
    for (index, variable) in campaign.variables.iter().enumerate() {
        let draws = rows.iter().map(|row| row.draws.get(index).copied().unwrap_or(f64::NAN));
        if variable.is_number() {
            let numbers: Vec<_> = draws.map(|draw| variable.distribution.number(draw).unwrap_or(f64::NAN)).collect();
            write_column::<DoubleType>(group, &numbers)?;
        } else {
            let texts: Vec<_> = draws.map(|draw| ByteArray::from(&*variable.distribution.text(draw))).collect();
            write_column::<ByteArrayType>(group, &texts)?;
        }
    }
    for index in 0..campaign.template.scenario.expectations.len() {
        write_optional_column::<DoubleType>(group, rows.iter().map(|row| known(row.values.get(index))))?;
        write_optional_column::<DoubleType>(group, rows.iter().map(|row| known(row.margins.get(index))))?;
    }
    let verdicts: Vec<_> = rows.iter().map(|row| ByteArray::from(row.verdict_text())).collect();
    write_column::<ByteArrayType>(group, &verdicts)?;
    write_optional_column::<ByteArrayType>(
        group,
        rows.iter().map(|row| Some(ByteArray::from(&*row.cause?.to_string()))),
    )?;
    for expectation in 0..campaign.template.scenario.expectations.len() {
        for origin in 0..ErrorOrigin::ALL.len() {
            let error = |errors: &&Vec<RowErrors>| *errors.get(expectation)?.get(origin)?;
            write_optional_column::<DoubleType>(group, errors.iter().map(error))?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::campaign::distribution::{Choice, Distribution};
    use parquet::file::reader::{FileReader, SerializedFileReader};
    use platebench_model::record::Verdict;

    #[test]
    fn a_value_that_was_never_reached_is_null() {
        let folder = tempfile::tempdir().unwrap();
        let vary = "\"profile.finger_force_n\" = { steps = [0.0, 1.0, 2] }";
        let campaign = Campaign::example(folder.path(), vary, "[plan]\nmethod = \"grid\"\ntrials = 1\n");
        let mut writer = ResultsWriter::new(folder.path(), &campaign).unwrap();
        let reached = TrialRow { draws: vec![0.0], values: vec![1.5], ..TrialRow::example(0, Verdict::Pass, 0.25) };
        let never = TrialRow {
            draws: vec![1.0],
            values: vec![f64::NAN],
            ..TrialRow::example(1, Verdict::Fail, f64::NEG_INFINITY)
        };
        writer.push(reached, vec![[Some(0.5), Some(0.25), None, Some(0.0)]]).unwrap();
        writer.push(never, vec![[None; 4]]).unwrap();
        writer.commit().unwrap();
        let csv = std::fs::read_to_string(folder.path().join(CSV_FILE)).unwrap();
        let expected = "trial,seed,profile.finger_force_n,settling_time_ms,settling_time_ms_margin,verdict,cause,\
            settling_time_ms_error_numerical,settling_time_ms_error_quantisation,settling_time_ms_error_sensor,\
            settling_time_ms_error_statistics\n0,1,0,1.5,0.25,pass,,0.5,0.25,,0.0\n1,2,1,,,fail,,,,,\n";
        assert_eq!(csv, expected);
        let file = File::open(folder.path().join(PARQUET_FILE)).unwrap();
        let reader = SerializedFileReader::new(file).unwrap();
        let rows: Vec<_> = reader.get_row_iter(None).unwrap().map(|row| row.unwrap().to_string()).collect();
        assert_eq!(rows[1].matches("null").count(), 7, "{}", rows[1]);
        assert_eq!(rows[0].matches("null").count(), 2, "{}", rows[0]);
    }

    #[test]
    fn texts_are_no_formulas() {
        let folder = tempfile::tempdir().unwrap();
        let vary = "\"controller.law\" = { each = [\"dq-pi\", \"deadbeat\"] }";
        let plan = "[plan]\nmethod = \"grid\"\ntrials = 1\n";
        let mut campaign = Campaign::example_with(folder.path(), "name = \"=1+1\"\n", vary, plan);
        // A scenario with an unknown law is not played, but a list may contain any text.
        let listed = ["@law", "+law", "-1", "\tlaw"].map(|text| Choice::Text(text.to_owned())).to_vec();
        campaign.variables[0].distribution = Distribution::Choices(listed);
        let mut writer = ResultsWriter::new(folder.path(), &campaign).unwrap();
        for draw in 0..4_u32 {
            let row = TrialRow { values: vec![-1.5], ..TrialRow::example(u64::from(draw), Verdict::Pass, -0.25) };
            writer.push(row, vec![[None; 4]]).unwrap();
        }
        writer.commit().unwrap();
        let csv = std::fs::read_to_string(folder.path().join(CSV_FILE)).unwrap();
        let lines: Vec<_> = csv.lines().collect();
        assert!(lines[0].starts_with("trial,seed,controller.law,'=1+1,'=1+1_margin,verdict,cause,"), "{csv}");
        for (line, law) in lines[1..].iter().zip(["'@law", "'+law", "-1", "'\tlaw"]) {
            assert_eq!(line.split(',').nth(2), Some(law), "{csv}");
            assert!(line.contains(",-1.5,-0.25,pass,"), "{csv}");
        }
        // Parquet is no spreadsheet, so its names stay.
        let file = File::open(folder.path().join(PARQUET_FILE)).unwrap();
        let reader = SerializedFileReader::new(file).unwrap();
        assert_eq!(reader.metadata().file_metadata().schema().get_fields()[3].name(), "=1+1");
    }

    #[test]
    fn the_unit_of_a_key_is_in_its_last_name_with_one() {
        for (key, unit) in [
            ("profile.finger_force_n", "N"),
            ("profile.setpoint_um.hold.1.1", "µm"),
            ("plate.mode.gain_um_per_vpp", "µm/Vpp"),
            ("plate.sensor.noise_um_rms", "µm"),
            ("controller.law", ""),
        ] {
            assert_eq!(unit_of_key(key), unit, "{key}");
        }
    }
}
