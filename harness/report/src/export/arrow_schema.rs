//! Encodes the columns as an Arrow schema. Parquet stores it under the key `ARROW:schema`, because
//! it has no other metadata of columns.
//!
//! Source: Arrow columnar format, `Schema.fbs` and `Message.fbs`. The slots are numbered in the
//! order of the fields in these files.

use crate::export::columns::{FLAG_COLUMNS, NUMBER_COLUMNS};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use flatbuffers::{FlatBufferBuilder, TableFinishedWIPOffset, VOffsetT, WIPOffset};

pub(crate) const KEY: &str = "ARROW:schema";

type Table = WIPOffset<TableFinishedWIPOffset>;

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

/// Returns the schema of the table that [`crate::export::parquet`] writes, in base64.
pub(crate) fn encode() -> String {
    let mut builder = FlatBufferBuilder::new();
    let keys = [
        ("scenario", ArrowType::Text),
        ("trial", ArrowType::Unsigned { bits: 32 }),
        ("seed", ArrowType::Unsigned { bits: 64 }),
    ];
    let mut fields: Vec<Table> = Vec::new();
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
) -> Table {
    let name = builder.create_string(name);
    let metadata: Vec<Table> = metadata
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
    let children = builder.create_vector::<Table>(&[]);
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
