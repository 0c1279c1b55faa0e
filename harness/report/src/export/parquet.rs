//! Writes Parquet: a table per scenario with all trials.
//!
//! The key-value metadata contain `unit.<column>`, `meaning.<column>`, the scenario and the Arrow
//! schema. The Arrow schema repeats unit and meaning per column. Memory holds one row group of at
//! most `ROW_GROUP_ROWS` rows.
//!
//! Source of the Arrow schema: Arrow columnar format, `Schema.fbs` and `Message.fbs`. The slots are numbered in the
//! order of the fields in these files. It is stored under the key `ARROW:schema`, because Parquet has no other metadata
//! of columns.

use crate::export::source::{ExportError, ExportScenario, FLAG_COLUMNS, NUMBER_COLUMNS};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use flatbuffers::{FlatBufferBuilder, TableFinishedWIPOffset, VOffsetT, WIPOffset};
use parquet::basic::{Compression, LogicalType, Repetition, Type as Physical};
use parquet::data_type::{BoolType, ByteArray, ByteArrayType, DoubleType, Int32Type, Int64Type};
use parquet::errors::ParquetError;
use parquet::file::metadata::KeyValue;
use parquet::file::properties::WriterProperties;
use parquet::file::writer::SerializedFileWriter;
use parquet::schema::types::{Type, TypePtr};
use platebench_document::parquet::{write_column, write_optional_column};
use platebench_model::trace::Row;
use std::fs::File;
use std::path::Path;
use std::sync::Arc;

/// A row group has about 7 MB of numbers: 13 columns of 8 bytes per row.
const ROW_GROUP_ROWS: usize = 65_536;

pub(crate) fn write(source: &ExportScenario<'_>, file: &File, path: &Path) -> Result<(), ExportError> {
    let format_error = ExportError::format::<ParquetError>(path);
    let facts = source.metadata().into_iter().map(|(name, value)| (name.to_owned(), value));
    let units = NUMBER_COLUMNS.iter().map(|number| (format!("unit.{}", number.name()), number.unit.to_owned()));
    let meanings = NUMBER_COLUMNS.iter().map(|number| (number.name(), number.meaning));
    let meanings = meanings.chain(FLAG_COLUMNS.iter().map(|flag| (flag.name, flag.meaning)));
    let meanings = meanings.map(|(name, meaning)| (format!("meaning.{name}"), meaning.to_owned()));
    let schema_text = (ARROW_KEY.to_owned(), encode_arrow_schema());
    let metadata =
        facts.chain(units).chain(meanings).chain([schema_text]).map(|(key, value)| KeyValue::new(key, value)).collect();
    let properties = WriterProperties::builder()
        .set_compression(Compression::SNAPPY)
        .set_created_by(format!("{} {}", source.run.tool.name, source.run.tool.version))
        .set_key_value_metadata(Some(metadata))
        .build();
    let schema = schema().map_err(&format_error)?;
    let mut writer = SerializedFileWriter::new(file, schema, Arc::new(properties)).map_err(&format_error)?;
    let mut rows = Vec::new();
    for trial in &source.trials {
        for row in trial.rows()? {
            rows.push((trial.index, trial.seed, row?));
            if rows.len() == ROW_GROUP_ROWS {
                write_group(&rows, source.name, &mut writer).map_err(&format_error)?;
                rows.clear();
            }
        }
    }
    if !rows.is_empty() {
        write_group(&rows, source.name, &mut writer).map_err(&format_error)?;
    }
    writer.close().map_err(&format_error)?;
    Ok(())
}

fn schema() -> Result<TypePtr, ParquetError> {
    let repeated = |name: &str, physical, logical, repetition| {
        let column = Type::primitive_type_builder(name, physical).with_repetition(repetition);
        column.with_logical_type(logical).build().map(Arc::new)
    };
    let column = |name: &str, physical, logical| repeated(name, physical, logical, Repetition::REQUIRED);
    let unsigned = |bit_width| Some(LogicalType::integer(bit_width, false));
    let mut fields = vec![
        column("scenario", Physical::BYTE_ARRAY, Some(LogicalType::String))?,
        column("trial", Physical::INT32, unsigned(32))?,
        column("seed", Physical::INT64, unsigned(64))?,
    ];
    for number in NUMBER_COLUMNS {
        let repetition = if number.can_be_unknown() { Repetition::OPTIONAL } else { Repetition::REQUIRED };
        fields.push(repeated(number.name(), Physical::DOUBLE, None, repetition)?);
    }
    for flag in FLAG_COLUMNS {
        fields.push(column(flag.name, Physical::BOOLEAN, None)?);
    }
    Type::group_type_builder("trace").with_fields(fields).build().map(Arc::new)
}

fn write_group(
    rows: &[(u32, u64, Row)],
    scenario: &str,
    writer: &mut SerializedFileWriter<&File>,
) -> Result<(), ParquetError> {
    let mut group = writer.next_row_group()?;
    write_column::<ByteArrayType>(&mut group, &vec![ByteArray::from(scenario); rows.len()])?;
    // Parquet stores unsigned numbers in the bits of signed numbers.
    write_column::<Int32Type>(&mut group, &rows.iter().map(|(trial, ..)| trial.cast_signed()).collect::<Vec<_>>())?;
    write_column::<Int64Type>(&mut group, &rows.iter().map(|(_, seed, _)| seed.cast_signed()).collect::<Vec<_>>())?;
    let rows = || rows.iter().map(|(_, _, row)| row);
    for number in NUMBER_COLUMNS {
        if number.can_be_unknown() {
            write_optional_column::<DoubleType>(&mut group, rows().map(|row| number.known_value(row)))?;
        } else {
            write_column::<DoubleType>(&mut group, &rows().map(|row| number.column.value(row)).collect::<Vec<_>>())?;
        }
    }
    for flag in FLAG_COLUMNS {
        let set: Vec<bool> = rows().map(|row| row.flags.contains(flag.flag)).collect();
        write_column::<BoolType>(&mut group, &set)?;
    }
    group.close().map(drop)
}

const ARROW_KEY: &str = "ARROW:schema";

type ArrowTable = WIPOffset<TableFinishedWIPOffset>;

const METADATA_V5: i16 = 4;
const HEADER_IS_SCHEMA: u8 = 1;
const DOUBLE_PRECISION: i16 = 2;
const ALIGNMENT: usize = 8;

#[derive(Clone, Copy)]
enum ArrowType {
    Unsigned { bits: i32 },
    Double,
    Text,
    Boolean,
}

impl ArrowType {
    const fn number(self) -> u8 {
        match self {
            Self::Unsigned { .. } => 2,
            Self::Double => 3,
            Self::Text => 5,
            Self::Boolean => 6,
        }
    }
}

const fn slot(number: VOffsetT) -> VOffsetT {
    4 + 2 * number
}

/// Returns the schema of the table, in base64.
fn encode_arrow_schema() -> String {
    let mut builder = FlatBufferBuilder::new();
    let keys = [
        ("scenario", ArrowType::Text),
        ("trial", ArrowType::Unsigned { bits: 32 }),
        ("seed", ArrowType::Unsigned { bits: 64 }),
    ];
    let mut fields: Vec<ArrowTable> = Vec::new();
    for (name, kind) in keys {
        fields.push(field(&mut builder, name, kind, false, &[]));
    }
    for number in NUMBER_COLUMNS {
        let metadata = [("unit", number.unit), ("meaning", number.meaning)];
        fields.push(field(&mut builder, number.name(), ArrowType::Double, number.can_be_unknown(), &metadata));
    }
    for flag in FLAG_COLUMNS {
        fields.push(field(&mut builder, flag.name, ArrowType::Boolean, false, &[("meaning", flag.meaning)]));
    }
    let fields = builder.create_vector(&fields);
    let start = builder.start_table();
    builder.push_slot_always(slot(1), fields);
    let schema = builder.end_table(start);
    let start = builder.start_table();
    builder.push_slot_always(slot(0), METADATA_V5);
    builder.push_slot_always(slot(1), HEADER_IS_SCHEMA);
    builder.push_slot_always(slot(2), schema);
    let message = builder.end_table(start);
    builder.finish(message, None);
    let data = builder.finished_data();
    let length = data.len().next_multiple_of(ALIGNMENT);
    // An encapsulated message consists of continuation marker, padded length and message.
    let mut bytes = u32::MAX.to_le_bytes().to_vec();
    bytes.extend((length as u32).to_le_bytes());
    bytes.extend(data);
    bytes.resize(ALIGNMENT + length, 0);
    STANDARD.encode(bytes)
}

fn field(
    builder: &mut FlatBufferBuilder<'_>,
    name: &str,
    kind: ArrowType,
    is_nullable: bool,
    metadata: &[(&str, &str)],
) -> ArrowTable {
    let name = builder.create_string(name);
    let metadata: Vec<ArrowTable> = metadata
        .iter()
        .map(|(key, value)| {
            let (key, value) = (builder.create_string(key), builder.create_string(value));
            let start = builder.start_table();
            builder.push_slot_always(slot(0), key);
            builder.push_slot_always(slot(1), value);
            builder.end_table(start)
        })
        .collect();
    let metadata = builder.create_vector(&metadata);
    let children = builder.create_vector::<ArrowTable>(&[]);
    let start = builder.start_table();
    match kind {
        // Slot 1, `is_signed`, is false by default.
        ArrowType::Unsigned { bits } => builder.push_slot_always(slot(0), bits),
        ArrowType::Double => builder.push_slot_always(slot(0), DOUBLE_PRECISION),
        ArrowType::Text | ArrowType::Boolean => {}
    }
    let details = builder.end_table(start);
    let start = builder.start_table();
    builder.push_slot_always(slot(0), name);
    builder.push_slot_always(slot(1), is_nullable);
    builder.push_slot_always(slot(2), kind.number());
    builder.push_slot_always(slot(3), details);
    builder.push_slot_always(slot(5), children);
    builder.push_slot_always(slot(6), metadata);
    builder.end_table(start)
}
