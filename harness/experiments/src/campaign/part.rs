//! Writes and reads parts, the files with the results of one shard each.
//!
//! A part is a Parquet file of numbers. Its metadata contain the SHA-256 of the plan, the number of
//! the shard and the SHA-256 of the file itself. This digest is computed while 64 characters `0`
//! are in its place.

use crate::campaign::definition::Campaign;
use crate::campaign::error::CampaignError;
use crate::campaign::plan::CampaignPlan;
use crate::campaign::row::{END_KEY, ShardEnd, TrialRow};
use parquet::basic::{Compression, Repetition, Type as Physical};
use parquet::column::reader::get_typed_column_reader;
use parquet::data_type::DoubleType;
use parquet::errors::ParquetError;
use parquet::file::metadata::KeyValue;
use parquet::file::properties::WriterProperties;
use parquet::file::reader::{FileReader, SerializedFileReader};
use parquet::file::writer::SerializedFileWriter;
use parquet::schema::types::Type;
use platebench_model::record::sha256;
use platebench_model::trace::{AtPath, AtomicFile, read_regular_file, write_atomically};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;

const GROUP_ROWS: usize = 4096;
const DIGEST_KEY: &str = "file_sha256";
const NO_DIGEST: [u8; 64] = [b'0'; 64];
const MAX_PART_BYTES: u64 = 8 << 30;

/// Collects the rows of a shard in memory. [`Self::commit`] writes the file.
pub(crate) struct PartWriter {
    path: PathBuf,
    columns: usize,
    rows: Vec<TrialRow>,
    writer: SerializedFileWriter<Vec<u8>>,
}

impl PartWriter {
    pub(crate) fn new(
        path: PathBuf,
        plan: &CampaignPlan,
        campaign: &Campaign,
        shard: u32,
    ) -> Result<Self, CampaignError> {
        let columns = column_count(campaign);
        let metadata = [
            ("plan", plan.sha256.clone()),
            ("shard", shard.to_string()),
            (DIGEST_KEY, String::from_utf8_lossy(&NO_DIGEST).into_owned()),
        ];
        let metadata = metadata.map(|(key, value)| KeyValue::new(key.to_owned(), value)).to_vec();
        let properties =
            WriterProperties::builder().set_compression(Compression::SNAPPY).set_key_value_metadata(Some(metadata));
        let writer = schema(columns)
            .and_then(|schema| SerializedFileWriter::new(Vec::new(), Arc::new(schema), Arc::new(properties.build())))
            .map_err(CampaignError::write(&path))?;
        Ok(Self { path, columns, rows: Vec::with_capacity(GROUP_ROWS), writer })
    }

    /// The caller adds rows in the order of their trials.
    pub(crate) fn push(&mut self, row: TrialRow) -> Result<(), CampaignError> {
        self.rows.push(row);
        if self.rows.len() == GROUP_ROWS { self.write_group() } else { Ok(()) }
    }

    fn write_group(&mut self) -> Result<(), CampaignError> {
        let mut columns = vec![Vec::with_capacity(self.rows.len()); self.columns];
        for row in self.rows.drain(..) {
            columns.iter_mut().zip(row.encode()).for_each(|(column, value)| column.push(value));
        }
        let mut write = || {
            let mut group = self.writer.next_row_group()?;
            for values in &columns {
                let Some(mut column) = group.next_column()? else { break };
                column.typed::<DoubleType>().write_batch(values, None, None)?;
                column.close()?;
            }
            group.close().map(drop)
        };
        write().map_err(CampaignError::write(&self.path))
    }

    pub(crate) fn commit(mut self, end: ShardEnd) -> Result<(), CampaignError> {
        if let Some(end) = end.encode() {
            self.writer.append_key_value_metadata(KeyValue::new(END_KEY.to_owned(), end));
        }
        if !self.rows.is_empty() {
            self.write_group()?;
        }
        let mut bytes = self.writer.into_inner().map_err(CampaignError::write(&self.path))?;
        let digest = sha256(&bytes);
        if let Some(place) = digest_place(&bytes)
            && let Some(place) = bytes.get_mut(place..place + NO_DIGEST.len())
        {
            place.copy_from_slice(digest.as_bytes());
        }
        Ok(write_atomically(&self.path, &bytes).at(&self.path)?)
    }
}

fn column_count(campaign: &Campaign) -> usize {
    TrialRow::column_count(campaign.variables.len(), campaign.template.scenario.expectations.len())
}

fn schema(columns: usize) -> Result<Type, ParquetError> {
    let column = |index: usize| {
        let name = format!("c{index}");
        let column = Type::primitive_type_builder(&name, Physical::DOUBLE);
        column.with_repetition(Repetition::REQUIRED).build().map(Arc::new)
    };
    let fields = (0..columns).map(column).collect::<Result<_, _>>()?;
    Type::group_type_builder("part").with_fields(fields).build()
}

/// Position of the digest, which follows its key and its length (Thrift's compact protocol).
fn digest_place(bytes: &[u8]) -> Option<usize> {
    let key = DIGEST_KEY.as_bytes();
    let key_at = bytes.windows(key.len()).rposition(|window| window == key)?;
    let after = bytes.get(key_at + key.len()..)?;
    let is_hex = |window: &[u8]| window.iter().all(u8::is_ascii_hexdigit);
    let skipped = after.windows(NO_DIGEST.len()).take(8).position(is_hex)?;
    Some(key_at + key.len() + skipped)
}

/// Reads a part with one row group in memory at a time.
pub(crate) struct PartReader<'a> {
    path: PathBuf,
    reader: SerializedFileReader<std::fs::File>,
    columns: usize,
    campaign: &'a Campaign,
    first: u64,
    end: ShardEnd,
}

impl<'a> PartReader<'a> {
    /// Fails with [`CampaignError::Damaged`] or [`CampaignError::OtherPart`].
    pub(crate) fn open(
        folder: &Path,
        plan: &CampaignPlan,
        campaign: &'a Campaign,
        shard: u32,
    ) -> Result<Self, CampaignError> {
        let path = plan.part_path(folder, shard);
        let damaged = |why| CampaignError::Damaged { path: path.clone(), why };
        let mut bytes = read_regular_file(&path, MAX_PART_BYTES).at(&path)?;
        let place = digest_place(&bytes).ok_or_else(|| damaged("it contains no SHA-256"))?;
        let digest = bytes.get_mut(place..place + NO_DIGEST.len()).ok_or_else(|| damaged("it contains no SHA-256"))?;
        let stored = String::from_utf8_lossy(digest).into_owned();
        digest.copy_from_slice(&NO_DIGEST);
        if sha256(&bytes) != stored {
            return Err(damaged("its SHA-256 does not match its content"));
        }
        drop(bytes);
        let file = std::fs::File::open(&path).at(&path)?;
        let reader = SerializedFileReader::new(file).map_err(|_| damaged("it is not a Parquet file"))?;
        let metadata = reader.metadata().file_metadata();
        let value = |key: &str| {
            let pairs = metadata.key_value_metadata()?;
            pairs.iter().find(|pair| pair.key == key)?.value.clone()
        };
        let trials = plan.trials_of(shard);
        let rows = u64::try_from(metadata.num_rows()).unwrap_or_default();
        let is_own = value("plan").as_deref() == Some(&*plan.sha256) && value("shard") == Some(shard.to_string());
        let columns = column_count(campaign);
        let is_complete = rows == trials.end - trials.start && metadata.schema_descr().num_columns() == columns;
        if !is_own {
            return Err(CampaignError::OtherPart(path));
        }
        if !is_complete {
            return Err(damaged("its rows or columns are not those of its shard"));
        }
        let end = value(END_KEY).map_or_else(ShardEnd::default, |end| ShardEnd::decode(&end));
        Ok(Self { reader, columns, campaign, first: trials.start, end, path })
    }

    /// Fails with [`CampaignError::Damaged`] if a row contradicts itself.
    pub(crate) fn check_rows(&self) -> Result<(), CampaignError> {
        self.rows(&mut |_| Ok(()))
    }

    pub(crate) fn end(&self) -> ShardEnd {
        self.end
    }

    pub(crate) fn rows(
        &self,
        each: &mut dyn FnMut(TrialRow) -> Result<(), CampaignError>,
    ) -> Result<(), CampaignError> {
        let mut trial = self.first;
        let damaged = |why| CampaignError::Damaged { path: self.path.clone(), why };
        for group in 0..self.reader.num_row_groups() {
            let columns = self.group(group).map_err(CampaignError::write(&self.path))?;
            for row in 0..columns.first().map_or(0, Vec::len) {
                let numbers: Option<Vec<f64>> = columns.iter().map(|column| column.get(row).copied()).collect();
                let row = numbers.and_then(|numbers| TrialRow::decode(trial, &numbers, self.campaign.variables.len()));
                let row = row.ok_or_else(|| damaged("its rows cannot be read"))?;
                if !row.agrees_with_limits(self.campaign)? {
                    return Err(damaged("a margin or a verdict contradicts the values"));
                }
                each(row)?;
                trial += 1;
            }
        }
        Ok(())
    }

    fn group(&self, group: usize) -> Result<Vec<Vec<f64>>, ParquetError> {
        let group = self.reader.get_row_group(group)?;
        let rows = usize::try_from(group.metadata().num_rows()).unwrap_or_default();
        let column = |index: usize| {
            let mut values = Vec::with_capacity(rows);
            let mut reader = get_typed_column_reader::<DoubleType>(group.get_column_reader(index)?);
            reader.read_records(rows, None, None, &mut values)?;
            Ok(values)
        };
        (0..self.columns).map(column).collect()
    }
}

pub(crate) fn create(path: &Path) -> Result<AtomicFile, CampaignError> {
    Ok(AtomicFile::create(path).at(path)?)
}

pub(crate) fn finish(mut file: AtomicFile, path: &Path) -> Result<(), CampaignError> {
    Ok(file.flush().and_then(|()| Ok(file.commit()?)).at(path)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_model::record::Verdict;
    use platebench_rig::RigSpec;
    use rstest::rstest;

    /// Writes a part with one row and reads it. The digest of the part is always right.
    fn read_back(vary: &str, value: f64, margin: f64, verdict: Verdict) -> Result<(), CampaignError> {
        let folder = tempfile::tempdir().unwrap();
        let campaign = Campaign::example(folder.path(), vary, "[plan]\nmethod = \"random\"\ntrials = 1\n");
        let plan = CampaignPlan::new(&campaign, folder.path(), &RigSpec::hosted(), 1).unwrap();
        plan.write(folder.path()).unwrap();
        let row = TrialRow {
            draws: vec![3.0],
            values: vec![value],
            margins: vec![margin],
            errors: vec![0.0; 3],
            ..TrialRow::example(0, verdict, margin)
        };
        let mut part = PartWriter::new(plan.part_path(folder.path(), 1), &plan, &campaign, 1).unwrap();
        part.push(row).unwrap();
        part.commit(ShardEnd::default()).unwrap();
        PartReader::open(folder.path(), &plan, &campaign, 1).unwrap().check_rows()
    }

    const FORCE: &str = "\"profile.finger_force_n\" = { uniform = [0.0, 5.0] }";
    const LIMIT: &str = "\"expect.0.at_most\" = { uniform = [1.0, 5.0] }";

    #[rstest]
    #[case::pass(FORCE, 1.5, 0.25, Verdict::Pass)]
    #[case::fail(FORCE, 2.5, -0.25, Verdict::Fail)]
    #[case::fail_by_violation(FORCE, 1.5, 0.25, Verdict::Fail)]
    #[case::no_value(FORCE, f64::NAN, f64::NEG_INFINITY, Verdict::Fail)]
    #[case::varied_limit(LIMIT, 1.5, 0.5, Verdict::Pass)]
    fn accepts_a_row_that_agrees_with_the_limit(
        #[case] vary: &str,
        #[case] value: f64,
        #[case] margin: f64,
        #[case] verdict: Verdict,
    ) {
        read_back(vary, value, margin, verdict).unwrap();
    }

    #[rstest]
    #[case::margin(FORCE, 2.5, 0.25, Verdict::Pass)]
    #[case::verdict(FORCE, 2.5, -0.25, Verdict::Pass)]
    #[case::value(FORCE, 1.0, 0.25, Verdict::Pass)]
    #[case::no_value(FORCE, f64::NAN, f64::NEG_INFINITY, Verdict::Pass)]
    #[case::varied_limit(LIMIT, 1.5, 0.25, Verdict::Pass)]
    fn rejects_an_edited_margin_or_verdict(
        #[case] vary: &str,
        #[case] value: f64,
        #[case] margin: f64,
        #[case] verdict: Verdict,
    ) {
        let error = read_back(vary, value, margin, verdict).unwrap_err();
        assert!(error.to_string().contains("a margin or a verdict contradicts the values"), "{error}");
    }
}
